"""Floor 1: rotations, poses and inertia."""
