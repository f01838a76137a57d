"""Studies that take longer than a test; each has a small version among the tests."""
