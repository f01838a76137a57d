"""Solvers of the saddle system M a = f + Jᵀλ, J a + C λ = b; no code here knows joints."""
