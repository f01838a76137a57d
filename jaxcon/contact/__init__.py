"""Inequality constraints (contact, limits, friction, motors), their solvers, and impacts."""
