"""Execution: steps, rollouts, initial states, and the memory of the reverse pass."""
