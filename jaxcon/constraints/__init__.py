"""Equality constraints: joints, couplings, rolling, and their rows φ, φ̇, J, γ. No solvers."""
