"""Floor 2: what a system is and where its coordinates lie."""
