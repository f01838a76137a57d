"""Roots that are differentiated where they lie, not along the way to them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

from jaxcon.core.typing import Array

Operator = Callable[[Array], Array]


def itself(x: Array) -> Array:
    """x."""
    return x


def implicit(
    function: Operator,
    start: Array,
    iterate: Callable[[Operator, Array], tuple[Array, Any]],
    rounds: int,
    inverse: Operator = itself,
    transposed: Operator = itself,
) -> tuple[Array, Any]:
    """x with f(x) = 0, and whatever else its iteration tells; exact to every order of derivative.

    f′(x) ẋ = y is solved by rounds of ẋ ← ẋ + P (y − f′(x) ẋ), which converges as an iteration
    x ← x − P f(x) does near its end, and so is its transpose.

    Args:
        function: f, (n, …) → (n, …).
        start: (n, …).
        iterate: (f, start) → the root and anything more; never differentiated.
        rounds: how many.
        inverse: y → P y, near to f′(x)⁻¹ y.
        transposed: y → Pᵀ y.
    """

    def tangent(linear: Operator, right: Array) -> Array:
        return jax.lax.custom_linear_solve(
            linear, right, _refined(inverse, rounds), _refined(transposed, rounds)
        )

    return jax.lax.custom_root(function, start, iterate, tangent, has_aux=True)


def _refined(inverse: Operator, rounds: int) -> Callable[[Operator, Array], Array]:
    def refine(linear: Operator, right: Array) -> Array:
        def once(_: Any, x: Array) -> Array:
            return x + inverse(right - linear(x))

        return jax.lax.fori_loop(0, rounds, once, inverse(right))

    return refine
