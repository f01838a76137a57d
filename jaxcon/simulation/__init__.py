"""Floor 6: steps and rollouts."""
