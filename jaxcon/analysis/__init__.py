"""Floor 7: what a state means: energy, violation, wrenches, rank."""
