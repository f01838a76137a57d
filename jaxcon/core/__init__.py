"""Floor 0: pytrees, lanes, guards, checks and status codes."""
