"""Foundations without mechanics: pytrees, lanes, safe numerics, input checks and status codes."""
