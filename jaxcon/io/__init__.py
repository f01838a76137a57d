"""Floor 7: models of other programs."""
