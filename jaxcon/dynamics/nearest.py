"""The nearest point of a surface: min ½ ‖y‖² subject to c(y) = 0, small and dense.

`restore` finds a point of the surface from a start, `polish` the nearest one from there. Neither is
differentiated: `implicit` gives the derivative of their result by the equations that it solves.
Rows may be redundant, as those of spatial loops are: singular values below `cutoff` count as zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import numerics
from jaxcon.core.typing import Array

Surface = Callable[[Array], Array]

ATTEMPTS = 4
"""Starts from which the surface is sought; all but the first are random."""
RESTORATIONS = 60
"""Steps of one attempt."""
POLISHINGS = 40
"""Steps along the surface; near its end each doubles the digits."""
STIFFNESS = 10.0
"""ρ, for rows of length 1."""
CURVATURE = 1e-3
"""The least curvature of ½ ‖y‖² along the surface that a step goes by."""


def cutoff(dtype: Any) -> float:
    """Singular values that count as zero, relative to the largest."""
    return 1e-9 if dtype == np.float64 else 1e-4


def pseudoinverse(matrix: Array) -> Array:
    """J⁺ (n, m) of J (m, n), by its singular values above the cutoff."""
    return jnp.linalg.pinv(matrix, rtol=cutoff(matrix.dtype))


def restore(surface: Surface, start: Array, tolerance: Array) -> tuple[Array, Array]:
    """A point where |c| ≤ tolerance, from the start; where there is none, the least ‖c‖ seen.

    A start may be stationary by symmetry, as a linkage drawn as one line is. Where the first
    attempt ends off the surface, others leave from random points as far away as c is.

    Args:
        surface: c, (n,) → (m,).
        start: (n,).
        tolerance: (m,).

    Returns:
        y (n,), and whether it is on the surface, ().
    """
    kicks = jnp.asarray(np.random.default_rng(0).normal(size=(ATTEMPTS, start.size)), start.dtype)

    def go(state: Any) -> Array:
        k, _, c = state
        return (k < ATTEMPTS) & ~jnp.all(jnp.abs(c) <= tolerance)

    def attempt(state: Any) -> Any:
        k, best, c = state
        kicked = start + kicks[k] * jnp.max(jnp.abs(c))
        found, left = _descend(surface, jnp.where(k == 0, start, kicked), tolerance)
        closer = left @ left < c @ c  # not so where it is NaN
        return k + 1, jnp.where(closer, found, best), jnp.where(closer, left, c)

    unknown = jnp.full_like(tolerance, jnp.inf)
    first = (jnp.zeros((), jnp.int32), start, unknown)
    _, y, c = jax.lax.while_loop(go, attempt, first)
    return y, jnp.all(jnp.abs(c) <= tolerance)


def _descend(surface: Surface, start: Array, tolerance: Array) -> tuple[Array, Array]:
    """Levenberg–Marquardt: p = −Jᵀ (J Jᵀ + μ)⁻¹ c, μ in proportion to ‖c‖; returns y and c.

    Quadratic where the surface is, also where rows are redundant on it. It goes on below the
    tolerance for as long as that helps, since next to the surface redundant rows still look
    independent. The first round only looks at the start, so that c and J are written into the
    program once.

    References:
        Yamashita and Fukushima, On the rate of convergence of the Levenberg–Marquardt method,
        Computing 15 (2001).
    """
    unit = jnp.eye(len(tolerance), dtype=start.dtype)

    def go(state: Any) -> Array:
        k, _, (c, _), damping, _, better = state
        there = jnp.all(jnp.abs(c) <= tolerance) & ~better
        return (k < RESTORATIONS) & (damping < 1e9) & ~there

    def step(state: Any) -> Any:
        k, y, (c, j), damping, size, _ = state
        μ = damping * numerics.safe_divide(numerics.norm(c), size)
        down = j.T @ jax.scipy.linalg.solve(j @ j.T + μ * unit, c, assume_a="pos")
        new = jnp.where(k == 0, y, y - down)
        seen = _value_and_jacobian(surface, new)
        better = seen[0] @ seen[0] < c @ c  # not so where it is NaN
        y, seen = jax.tree.map(lambda a, b: jnp.where(better, a, b), (new, seen), (y, (c, j)))
        size = jnp.where(k == 0, numerics.norm(seen[0]), size)
        return k + 1, y, seen, damping * jnp.where(better, 0.25, 8.0), size, better

    unknown = jnp.full_like(tolerance, jnp.inf)
    flat = jnp.zeros((*tolerance.shape, *start.shape), start.dtype)
    damping = jnp.asarray(1e-2, start.dtype)
    first = (
        jnp.zeros((), jnp.int32),
        start,
        (unknown, flat),
        damping,
        unknown[0],
        jnp.ones((), bool),
    )
    _, y, (c, _), *_ = jax.lax.while_loop(go, step, first)
    return y, c


def _value_and_jacobian(surface: Surface, y: Array) -> tuple[Array, Array]:
    jacobian, value = jax.jacfwd(lambda x: (surface(x),) * 2, has_aux=True)(y)
    return value, jacobian


class Tangent(NamedTuple):
    """The surface at a point: c, multipliers λ = J⁺ᵀ y, and a step to the nearest point.

    Attributes:
        normal: −J⁺ c.
        along: tangent to the surface.
    """

    value: Array
    multipliers: Array
    normal: Array
    along: Array


def tangent(surface: Surface, y: Array) -> Tangent:
    """Newton's step of y = Jᵀλ, c = 0, whose curvature along the surface is taken as positive.

    With W = 1 − Σ λᵢ ∇²cᵢ and P the projector on the tangent space, P W P t = −P (y + W n).
    """
    c, j = _value_and_jacobian(surface, y)
    inverse = pseudoinverse(j)
    multipliers = inverse.T @ y
    unit = jnp.eye(len(y), dtype=y.dtype)
    curvature = unit - jax.jacfwd(jax.grad(lambda x: multipliers @ surface(x)))(y)
    projector = unit - inverse @ j
    projector = (projector + projector.T) / 2
    normal = -inverse @ c
    values, vectors = jnp.linalg.eigh(projector @ curvature @ projector + unit - projector)
    slope = vectors.T @ (projector @ (y + curvature @ normal))
    along = -projector @ (vectors @ (slope / jnp.maximum(jnp.abs(values), CURVATURE)))
    return Tangent(c, multipliers, normal, along)


def polish(surface: Surface, start: Array, tolerance: Array) -> Array:
    """The point of the surface nearest to 0, from one on the surface.

    Steps are halved along the surface where they do not lower ½ ‖y‖² − λᵀc + ½ ρ ‖c‖², the
    augmented Lagrangian, which near the end never refuses a full one.

    References:
        Nocedal and Wright, Numerical Optimization (2006), sections 15.4 and 18.3.
    """
    eps = float(jnp.finfo(start.dtype).eps)

    def go(state: Any) -> Array:
        k, _, _, done = state
        return (k < POLISHINGS) & ~done

    def step(state: Any) -> Any:
        k, y, share, _ = state
        at = tangent(surface, y)
        new = y + at.normal + share * at.along
        size = numerics.norm(at.normal) + numerics.norm(at.along)
        small = size <= eps**0.5 * numerics.norm(y) + jnp.min(tolerance)

        def merit(x: Array, c: Array) -> Array:
            return x @ x / 2 - at.multipliers @ c + STIFFNESS * (c @ c) / 2

        left = surface(new)
        lower = merit(new, left) < merit(y, at.value)
        better = lower | (small & jnp.all(jnp.isfinite(left)))
        share = jnp.where(better, jnp.minimum(1, 2 * share), share / 2)
        done = (small & jnp.all(jnp.abs(left) <= tolerance)) | (share < eps)
        return k + 1, jnp.where(better, new, y), share, done

    one = jnp.ones((), start.dtype)
    first = (jnp.zeros((), jnp.int32), start, one, jnp.zeros((), bool))
    return jax.lax.while_loop(go, step, first)[1]


def implicit(surface: Surface, y: Array) -> Array:
    """y itself, as the solution of y − Jᵀλ = 0, c(y) = 0 under any change of c.

    Exact to every order, by `lax.custom_root`. Where rows are redundant and a change makes them
    contradict each other, the derivative is that of the least-squares compromise.
    """
    n = len(y)

    def equations(z: Array) -> Array:
        value, pull = jax.vjp(surface, z[:n])
        return jnp.concatenate([z[:n] - pull(z[n:])[0], value])

    def tangent_solve(linear: Any, right: Array) -> Array:
        matrix = jax.vmap(linear, out_axes=1)(jnp.eye(len(right), dtype=right.dtype))
        return pseudoinverse(matrix) @ right

    fixed = jax.lax.stop_gradient(y)
    multipliers = pseudoinverse(jax.jacfwd(surface)(fixed)).T @ fixed
    root = jax.lax.stop_gradient(jnp.concatenate([fixed, multipliers]))
    return jax.lax.custom_root(equations, root, lambda _, z: z, tangent_solve)[:n]
