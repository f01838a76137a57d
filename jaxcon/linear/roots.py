"""Root finding with implicit differentiation: the iteration itself is never differentiated."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import derivatives
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array

Operator = Callable[[Array], Array]


def implicit(
    function: Operator,
    start: Array,
    iterate: Callable[[Operator, Array], tuple[Array, Any]],
    rounds: int,
    inverse: Operator = lambda x: x,
    transposed: Operator = lambda x: x,
    leading: int | None = None,
    prepared: Callable[[], tuple[Operator, Operator]] | None = None,
) -> tuple[Array, Any]:
    """Finds a root x of f(x) = 0, with implicit derivatives of every order.

    Where no derivative is taken, only the iteration is traced.

    The tangent equation f′(x) ẋ = y is solved iteratively, by ẋ ← ẋ + P (y − f′(x) ẋ). The
    transposed equation is solved in the same way, with Pᵀ. Both converge like the iteration
    x ← x − P f(x) near the root.

    JAX assigns a tangent, possibly zero, to every number that f closes over. If the derivative of f
    with respect to such a number is infinite, as for 1/h² at h = 0, even a zero tangent gives NaN.
    Compute such factors outside of f. If they have no meaningful derivative, stop their gradient
    inside f.

    Args:
        function: f, (n, …) → (n, …).
        start: the initial x, (n, …).
        iterate: (f, start) → the root and any auxiliary results; never differentiated.
        rounds: the largest number of rounds for the tangent equation.
        inverse: the preconditioner y → P y, an approximation of f′(x)⁻¹ y.
        transposed: the transposed preconditioner y → Pᵀ y.
        leading: the number of leading entries of x that are tested for convergence; None for all.
        prepared: a function () → (P, Pᵀ) that is called only if a derivative is taken; None to use
            the arguments `inverse` and `transposed`.

    Returns:
        The root and the auxiliary results.
    """
    if not derivatives.may_be_taken():
        return iterate(function, start)

    def refined(inverse: Operator) -> Callable[[Operator, Array], Array]:
        return lambda linear, right: refine(
            lambda x: inverse(linear(x) - right), inverse(right), rounds, leading=leading
        )[0]

    def tangent(linear: Operator, right: Array) -> Array:
        down, up = (inverse, transposed) if prepared is None else prepared()
        return jax.lax.custom_linear_solve(linear, right, refined(down), refined(up))

    return jax.lax.custom_root(function, start, iterate, tangent, has_aux=True)


def solve_symmetric(multiply: Operator, right: Array, inverse: Operator) -> Array:
    """Solves A x = b for a symmetric A, with implicit derivatives of every order.

    Args:
        multiply: x ↦ A x.
        right: b, (n, …).
        inverse: b ↦ A⁻¹ b; never differentiated.
    """
    if not derivatives.may_be_taken():
        return inverse(right)
    return jax.lax.custom_linear_solve(multiply, right, lambda _, b: inverse(b), symmetric=True)


def refine(
    down: Operator,
    x: Array,
    rounds: int,
    rounding: Array | float = 0.0,
    leading: int | None = None,
    stopped: Array | bool = False,
) -> tuple[Array, Array]:
    """Iterates x ← x − d(x) until the step d is at the level of rounding in every world.

    Args:
        down: the step d, (n, …) → (n, …).
        x: the initial x, (n, …).
        rounds: the largest number of iterations.
        rounding: the rounding error of x, in addition to its floating-point spacing; one number for
            all worlds, or one for each world.
        leading: the number of leading entries that are tested for convergence; None for all.
        stopped: a mask of worlds that are not iterated.

    Returns:
        x and the last step d, (n, …) each.
    """
    spacing = 4 * float(jnp.finfo(x.dtype).eps)

    def goes(x: Array, step: Array) -> Array:
        """Returns a mask of the worlds whose last step is above the level of rounding."""
        size, moved = (jnp.max(jnp.abs(y[:leading]), axis=0, initial=0) for y in (x, step))
        return (moved > spacing * size + rounding) & ~jnp.asarray(stopped)

    def advance(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, x, step = state
        going, new = goes(x, step)[None], down(x)
        return count + 1, jnp.where(going, x - new, x), jnp.where(going, new, step)

    return jax.lax.while_loop(
        lambda state: (state[0] < rounds) & somewhere(goes(*state[1:])),
        advance,
        (jnp.zeros((), jnp.int32), x, jnp.full_like(x, jnp.inf)),
    )[1:]
