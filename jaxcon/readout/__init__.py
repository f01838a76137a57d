"""Quantities computed from a state: energy, momentum, wrenches, positions."""
