"""Roots that are differentiated where they lie, not along the way to them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.somewhere import somewhere
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
    leading: int | None = None,
    prepared: Callable[[], tuple[Operator, Operator]] | None = None,
) -> tuple[Array, Any]:
    """x with f(x) = 0, and whatever else its iteration tells; exact to every order of derivative.

    f′(x) ẋ = y is solved by rounds of ẋ ← ẋ + P (y − f′(x) ẋ), which converges as an iteration
    x ← x − P f(x) does near its end, and so is its transpose.

    A root gives a tangent to all that f closes over, of zeros where that does not move. Where f has
    no finite derivative by it, as 1/h² has none at h = 0, zero times that is NaN: such factors are
    made before f, or, if they are choices without a derivative, have it stopped inside f.

    Args:
        function: f, (n, …) → (n, …).
        start: (n, …).
        iterate: (f, start) → the root and anything more; never differentiated.
        rounds: how many at most.
        inverse: y → P y, near to f′(x)⁻¹ y.
        transposed: y → Pᵀ y.
        leading: how many entries say whether only rounding is left; all unless given.
        prepared: in place of P and Pᵀ, what makes them, once, where a derivative is taken.
    """

    def tangent(linear: Operator, right: Array) -> Array:
        down, up = (inverse, transposed) if prepared is None else prepared()
        return jax.lax.custom_linear_solve(
            linear, right, _refined(down, rounds, leading), _refined(up, rounds, leading)
        )

    return jax.lax.custom_root(function, start, iterate, tangent, has_aux=True)


def _refined(
    inverse: Operator, rounds: int, leading: int | None
) -> Callable[[Operator, Array], Array]:
    def refine(linear: Operator, right: Array) -> Array:
        down = settle(lambda x: inverse(linear(x) - right), inverse(right), rounds, leading=leading)
        return down[0]

    return refine


def settle(
    down: Operator,
    x: Array,
    rounds: int,
    rounding: Any = 0.0,
    leading: int | None = None,
    stopped: Any = False,
) -> tuple[Array, Array]:
    """x ← x − d(x), until in every world only rounding is left of d, or the rounds are over.

    Args:
        down: d, (n, …) → (n, …).
        x: where to begin, (n, …).
        rounds: how many at most.
        rounding: what rounding makes of x besides its own spacing, a number or one by world.
        leading: how many entries are looked at; all unless given.
        stopped: worlds for which nothing is done.

    Returns:
        x, and the last d.
    """
    spacing = 4 * float(jnp.finfo(x.dtype).eps)

    def goes(x: Array, step: Array) -> Array:
        size, moved = (jnp.max(jnp.abs(y[:leading]), axis=0, initial=0) for y in (x, step))
        return (moved > spacing * size + rounding) & ~jnp.asarray(stopped)

    def unsettled(known: tuple[Array, Array, Array]) -> Array:
        count, x, step = known
        return (count < rounds) & somewhere(goes(x, step))

    def once(known: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, x, step = known
        going, new = goes(x, step)[None], down(x)
        return count + 1, jnp.where(going, x - new, x), jnp.where(going, new, step)

    start = jnp.zeros((), jnp.int32), x, jnp.full_like(x, jnp.inf)
    return jax.lax.while_loop(unsettled, once, start)[1:]
