"""Builders of systems: scenes, chains, assembly."""
