"""Floor 8: what is found by derivatives: gains, lengths, controls, and what a recording shows."""
