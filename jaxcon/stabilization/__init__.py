"""Floor 5: what keeps a state on the constraint manifold."""
