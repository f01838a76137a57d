"""Floor 1: the saddle system and what solves it. No joint is known here."""
