"""Integrators, stabilizers, and `Method`, which combines them with the solvers."""
