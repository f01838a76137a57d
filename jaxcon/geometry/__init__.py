"""Rotations, poses, inertia of solids, and height fields."""
