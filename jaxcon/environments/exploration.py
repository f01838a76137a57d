"""Exploring where constraints allow it: the nearest action that keeps limits.

a = argmin ½ ‖a − (a_raw + ε)‖²   so that   −1 ≤ a ≤ 1   and   c(after a) ≤ 0 to first order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core.typing import Array
from jaxcon.environments.environment import Environment, Episode

ITERATIONS = 30
"""The iterations of Newton's method; each leaves at most a fifth of μ."""
INWARD = 0.95
"""How far an iteration goes of the way to the nearest bound."""


class Point(NamedTuple):
    """A guess: the point a (k,), the multipliers λ (m,) and the slacks s (m,), both positive."""

    a: Array
    λ: Array
    s: Array


def feasible_action(
    environment: Environment,
    episode: Episode,
    action: Any,
    limits: Callable[[Episode], Array],
    noise: Any = 0.0,
) -> Array:
    """The action nearest to a wanted one, plus noise, after which the limits are kept.

    The limits are linearized along the wanted action. Where no action keeps them all, they are
    missed by least squares, each in the unit of |c| + |∇c|; two that are opposite make an equality.
    It is differentiable in the action, the noise and the environment.

    Args:
        environment: which acts.
        episode: where it stands.
        action: a_raw, (k,).
        limits: c, from an episode to numbers (m,) that are to be ≤ 0.
        noise: ε, (k,) or ().

    Returns:
        The action, (k,), within −1 to 1.

    Raises:
        ValueError: the action has another shape than the environment's (at trace time).
    """
    wanted = jnp.asarray(action, environment.dtype) + noise
    at = environment.allowed(wanted)

    def after(a: Array) -> Array:
        return limits(environment.act(episode, a))  # unclipped: a clip has no slope

    # forward mode: there are few actions
    value, slope = scaled(after(at), jax.jacfwd(after)(at))
    eye = jnp.eye(len(at), dtype=at.dtype)
    rows = jnp.concatenate([slope, eye, -eye])
    bounds = jnp.concatenate([slope @ at - value, jnp.ones(2 * len(at), at.dtype)])
    return jnp.clip(project(wanted, rows, bounds), -1, 1)


def scaled(value: Array, slope: Array) -> tuple[Array, Array]:
    """Limits and their slopes in units of their own, in which a row is |∇c| + |c| = 1.

    A millimetre for a whole action would else be given up before a thousandth of the action is.

    Args:
        value: c, (m,).
        slope: ∇c, (m, k).
    """
    size = jax.lax.stop_gradient(jnp.sum(jnp.abs(slope), axis=1) + jnp.abs(value))
    size = jnp.where(size > 0, size, 1)
    return value / size, slope / size[:, None]


def project(x: Array, rows: Array, bounds: Array) -> Array:
    """The point a nearest to x with G a ≤ h, by an interior-point method of fixed length.

    It solves a − x + Gᵀλ = 0, s = h − G a + δ λ, λ s = μ for small μ; δ lets rows that contradict
    each other be missed by least squares. The derivative is that of this solution.

    Args:
        x: (k,).
        rows: G, (m, k); k and m of a few tens at most.
        bounds: h, (m,).

    Returns:
        a, (k,).
    """
    eps = float(jnp.finfo(x.dtype).eps)
    soft = last = eps**0.6  # smaller, and rounding would show in the derivative
    size = 1 + jnp.max(jnp.abs(bounds - rows @ x), initial=0)
    ones = jnp.ones_like(bounds)
    start = jax.lax.stop_gradient(Point(x, size * ones, size * ones))
    fixed = jax.lax.stop_gradient((x, rows, bounds))

    def iterate(point: Point, _: Any) -> tuple[Point, None]:
        aim = jnp.maximum(0.2 * jnp.mean(point.λ * point.s), last)
        change = newton(point, residual(point, *fixed, soft, aim), fixed[1], soft)
        both = jnp.concatenate([point.λ, point.s]), jnp.concatenate([change.λ, change.s])
        shrinks = both[1] < 0
        far = jnp.where(shrinks, -both[0] / jnp.where(shrinks, both[1], -1), jnp.inf)
        length = jnp.minimum(INWARD * jnp.min(far, initial=jnp.inf), 1)
        return jax.tree.map(lambda p, c: p + length * c, point, change), None

    found = jax.lax.stop_gradient(jax.lax.scan(iterate, start, None, ITERATIONS)[0])
    # one step of Newton's method from the solution has its derivative, by the implicit function
    # theorem, where the matrix is held constant
    left = residual(found, x, rows, bounds, soft, last)
    return found.a + newton(found, left, fixed[1], soft).a


def residual(point: Point, x: Array, rows: Array, bounds: Array, soft: float, aim: Any) -> Point:
    """What is left of the three conditions: of the point, of the complementarity, of the rows."""
    a, λ, s = point
    return Point(a - x + rows.T @ λ, λ * s - aim, s - bounds + rows @ a - soft * λ)


def newton(point: Point, left: Point, rows: Array, soft: float) -> Point:
    """The step that takes away what is left, to first order; the slacks and multipliers eliminated.

    Δs = −r_s − G Δa + δ Δλ and λ Δs + s Δλ = −r_λ give Δλ = (G Δa + r_s − r_λ/λ)/(s/λ + δ).
    """
    _, λ, s = point
    weight = 1 / (s / λ + soft)
    open_ = left.s - left.λ / λ
    matrix = jnp.eye(rows.shape[1], dtype=rows.dtype) + (rows.T * weight[None]) @ rows
    a = jnp.linalg.solve(matrix, -left.a - rows.T @ (weight * open_))
    λ_step = weight * (rows @ a + open_)
    return Point(a, λ_step, -left.s - rows @ a + soft * λ_step)
