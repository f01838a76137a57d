"""Tasks for reinforcement learning, one per file."""
