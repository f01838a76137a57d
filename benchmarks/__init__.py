"""Benchmarks: studies that run longer than a test. The tests run a small version of each."""
