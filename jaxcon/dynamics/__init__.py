"""Floor 4: from a scene to accelerations and multipliers."""
