"""The nearest point of a surface: min ½ ‖y‖² subject to c(y) = 0, small and dense.

`restore` finds a point of the surface from a start. `polish` then finds the point of the surface
nearest to 0. Neither is differentiated; `implicit` differentiates the equations that their result
satisfies. Rows of c may be redundant, as in spatial loops: singular values below `cutoff` count as
zero.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import numerics
from jaxcon.core.typing import Array, DType

Surface = Callable[[Array], Array]

Descent = tuple[Array, Array, tuple[Array, Array], Array, Array, Array]
"""The loop state of `_descend`.

It consists of the step count, y, (c, J) at y, the damping, ‖c‖ at the start, and True if the last
step made ‖c‖ smaller.
"""

ATTEMPTS = 4
"""The number of starts of the search; all but the first are random."""
RESTORATIONS = 60
"""The largest number of steps of one attempt."""
POLISHINGS = 40
"""The largest number of Newton steps along the surface; they converge quadratically."""
STIFFNESS = 10.0
"""The penalty parameter ρ of the augmented Lagrangian, for rows of length one."""
CURVATURE = 1e-3
"""The smallest curvature of ½ ‖y‖² along the surface with which a Newton step is computed."""


def cutoff(dtype: DType) -> float:
    """Returns the cutoff below which singular values, relative to the largest, count as zero."""
    return 1e-9 if dtype == np.float64 else 1e-4


def pseudoinverse(matrix: Array) -> Array:
    """Returns the pseudo-inverse J⁺, (n, m), of a matrix J, (m, n).

    Singular values up to the `cutoff` count as zero.
    """
    return jnp.linalg.pinv(matrix, rtol=cutoff(matrix.dtype))


def restore(surface: Surface, start: Array, tolerance: Array) -> tuple[Array, Array]:
    """Finds a point y on a surface c(y) = 0, to within a tolerance.

    If |c| ≤ tolerance is not reached, the result is the point with the least ‖c‖ that was found.
    ‖c‖ may be stationary at a symmetric start, such as a linkage drawn as one line. If the first
    attempt ends off the surface, further attempts start from random points. Their distance from
    `start` is about the largest |c| that is left.

    Args:
        surface: the function c, (n,) → (m,).
        start: the first start, (n,).
        tolerance: the largest |c| that counts as zero, (m,).

    Returns:
        y (n,), and True if y is on the surface, ().
    """
    kicks = jnp.asarray(np.random.default_rng(0).normal(size=(ATTEMPTS, start.size)), start.dtype)

    def go(state: tuple[Array, Array, Array]) -> Array:
        k, _, c = state
        return (k < ATTEMPTS) & ~jnp.all(jnp.abs(c) <= tolerance)

    def attempt(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        k, best, c = state
        kicked = start + kicks[k] * jnp.max(jnp.abs(c))
        candidate, left = _descend(surface, jnp.where(k == 0, start, kicked), tolerance)
        closer = left @ left < c @ c  # False if either is NaN
        return k + 1, jnp.where(closer, candidate, best), jnp.where(closer, left, c)

    unknown = jnp.full_like(tolerance, jnp.inf)
    first = (jnp.zeros((), jnp.int32), start, unknown)
    _, y, c = jax.lax.while_loop(go, attempt, first)
    return y, jnp.all(jnp.abs(c) <= tolerance)


def _descend(surface: Surface, start: Array, tolerance: Array) -> tuple[Array, Array]:
    """Minimizes ‖c(y)‖ by Levenberg–Marquardt steps.

    A step is p = −Jᵀ (J Jᵀ + μ)⁻¹ c, with the damping μ in proportion to ‖c‖. Convergence is
    quadratic, even if rows of c are redundant on the surface. Steps continue below the tolerance as
    long as they reduce ‖c‖, since redundant rows still look independent near the surface. The first
    round of the loop only evaluates c and J at the start, so that they occur once in the program.

    Args:
        surface: the function c, (n,) → (m,).
        start: the first y, (n,).
        tolerance: the largest |c| that counts as zero, (m,).

    Returns:
        The last point y, (n,), and c(y), (m,).

    References:
        Yamashita and Fukushima, On the rate of convergence of the Levenberg–Marquardt method,
        Computing 15 (2001).
    """
    unit = jnp.eye(len(tolerance), dtype=start.dtype)

    def go(state: Descent) -> Array:
        k, _, (c, _), damping, _, better = state
        there = jnp.all(jnp.abs(c) <= tolerance) & ~better
        return (k < RESTORATIONS) & (damping < 1e9) & ~there

    def step(state: Descent) -> Descent:
        k, y, (c, j), damping, size, _ = state
        μ = damping * numerics.safe_divide(numerics.norm(c), size)
        down = j.T @ jax.scipy.linalg.solve(j @ j.T + μ * unit, c, assume_a="pos")
        new = jnp.where(k == 0, y, y - down)
        seen = _value_and_jacobian(surface, new)
        better = seen[0] @ seen[0] < c @ c  # False if either is NaN
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
    """Returns c(y), (m,), and its Jacobian J, (m, n)."""
    jacobian, value = jax.jacfwd(lambda x: (surface(x),) * 2, has_aux=True)(y)
    return value, jacobian


def tangent(surface: Surface, y: Array) -> tuple[Array, Array, Array, Array]:
    """Computes a Newton step toward the point of a surface c(y) = 0 that is nearest to 0.

    The equations of this point are y = Jᵀλ and c = 0. The step n leads to the surface, and the step
    t along it. t satisfies P W P t = −P (y + W n), with W = 1 − Σ λᵢ ∇²cᵢ and P the projector on
    the tangent space. The eigenvalues of P W P are made positive, so that t is a descent direction.

    Args:
        surface: the function c, (n,) → (m,).
        y: the current point, (n,).

    Returns:
        c(y), (m,); the multipliers λ = J⁺ᵀ y, (m,); the step n = −J⁺ c, (n,); and the step t, (n,).
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
    return c, multipliers, normal, along


def polish(surface: Surface, start: Array, tolerance: Array) -> Array:
    """Finds the point of a surface c(y) = 0 that is nearest to 0, by Newton's method.

    If a step does not lower the augmented Lagrangian ½ ‖y‖² − λᵀc + ½ ρ ‖c‖², its part along the
    surface is halved. Near the solution every full step is accepted.

    Args:
        surface: the function c, (n,) → (m,).
        start: a point on the surface, (n,).
        tolerance: the largest |c| that counts as zero, (m,).

    References:
        Nocedal and Wright, Numerical Optimization (2006), sections 15.4 and 18.3.
    """
    eps = float(jnp.finfo(start.dtype).eps)

    def go(state: tuple[Array, Array, Array, Array]) -> Array:
        k, _, _, done = state
        return (k < POLISHINGS) & ~done

    def step(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        k, y, share, _ = state
        value, multipliers, normal, along = tangent(surface, y)
        new = y + normal + share * along
        size = numerics.norm(normal) + numerics.norm(along)
        small = size <= eps**0.5 * numerics.norm(y) + jnp.min(tolerance)

        def merit(x: Array, c: Array) -> Array:
            return x @ x / 2 - multipliers @ c + STIFFNESS * (c @ c) / 2

        left = surface(new)
        lower = merit(new, left) < merit(y, value)
        better = lower | (small & jnp.all(jnp.isfinite(left)))
        share = jnp.where(better, jnp.minimum(1, 2 * share), share / 2)
        done = (small & jnp.all(jnp.abs(left) <= tolerance)) | (share < eps)
        return k + 1, jnp.where(better, new, y), share, done

    full_step = jnp.ones((), start.dtype)
    first = (jnp.zeros((), jnp.int32), start, full_step, jnp.zeros((), bool))
    return jax.lax.while_loop(go, step, first)[1]


def implicit(surface: Surface, y: Array) -> Array:
    """Returns y unchanged, but with the derivative of the point of a surface nearest to 0.

    The nearest point satisfies y − Jᵀλ = 0 and c(y) = 0, where J is the Jacobian of c. Derivatives
    are exact to every order, by `lax.custom_root`. If a change of parameters makes redundant rows
    contradict each other, the derivative is that of the least-squares solution.

    Args:
        surface: the function c, (n,) → (m,).
        y: the nearest point, (n,), from `polish`.
    """
    n = len(y)

    def equations(z: Array) -> Array:
        value, pull = jax.vjp(surface, z[:n])
        return jnp.concatenate([z[:n] - pull(z[n:])[0], value])

    def tangent_solve(linear: Surface, right: Array) -> Array:
        matrix = jax.vmap(linear, out_axes=1)(jnp.eye(len(right), dtype=right.dtype))
        return pseudoinverse(matrix) @ right

    fixed = jax.lax.stop_gradient(y)
    multipliers = pseudoinverse(jax.jacfwd(surface)(fixed)).T @ fixed
    root = jax.lax.stop_gradient(jnp.concatenate([fixed, multipliers]))
    return jax.lax.custom_root(equations, root, lambda _, z: z, tangent_solve)[:n]
