"""Exploration within limits: the nearest action that satisfies linearized inequalities.

The action is a = argmin ½ ‖a − (a_raw + ε)‖² subject to −1 ≤ a ≤ 1 and c(after a) ≤ 0. Here a_raw
is the desired action, ε the noise and c the limits, linearized at the desired action.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core import checks, functions
from jaxcon.core.typing import Array, Scalar
from jaxcon.environments.environment import Environment, Episode, check_environment

ITERATIONS = 30
"""The number of Newton iterations. Each reduces the barrier parameter μ at most fivefold."""
INWARD = 0.95
"""The fraction of the distance to the nearest bound that one iteration may cover."""


class ExploredPoint(NamedTuple):
    """A primal–dual iterate: action a (k,), multipliers λ (m,) > 0 and slacks s (m,) > 0."""

    a: Array
    λ: Array
    s: Array


def feasible_action(
    environment: Environment,
    episode: Episode,
    action: Scalar,
    limits: Callable[[Episode], Array],
    noise: Array | float = 0.0,
) -> Array:
    """Returns the action within limits that is nearest to the desired action plus noise.

    The limits c apply to the episode after the action, and are linearized at the desired action. If
    no action satisfies all of them, their violations are minimized by least squares, each scaled by
    the sum |c| + |∇c|. Two opposite limits act as an equality. The result is differentiable with
    respect to the action, the noise and the environment.

    Args:
        environment: the environment.
        episode: the episode before the action.
        action: a_raw, the desired action, (k,).
        limits: c, a function from an episode to numbers (m,) that must be ≤ 0.
        noise: ε, (k,) or ().

    Returns:
        The action, (k,), within −1 to 1.

    Raises:
        ValueError: the action or the noise is not real or has the wrong shape for the environment
            (at trace time).
        TypeError: another argument has the wrong type, or the limits are not an array (m,).
    """
    owner = "feasible_action"
    check_environment(owner, environment)
    checks.instance(owner, "episode", episode, Episode, "an Episode, the result of reset or step")
    checks.takes(owner, "limits", limits, ("episode",))
    checks.numbers(owner, "action", action)
    noise = checks.check(owner, "noise", noise)
    desired = jnp.asarray(action, environment.dtype) + jnp.asarray(noise, environment.dtype)
    at = environment.allowed(desired)

    def after(a: Array) -> Array:
        ahead = environment.act(episode, a)  # not clipped: a clip has zero slope
        c = functions.array(owner, "limits", functions.call(owner, "limits", limits, ahead))
        if c.ndim != 1:
            raise TypeError(f"{owner}: limits must return an array (m,), got shape {c.shape}.")
        return c

    # forward mode: there are few actions
    value, slope = scaled(after(at), jax.jacfwd(after)(at))
    eye = jnp.eye(len(at), dtype=at.dtype)
    rows = jnp.concatenate([slope, eye, -eye])
    bounds = jnp.concatenate([slope @ at - value, jnp.ones(2 * len(at), at.dtype)])
    return jnp.clip(project(desired, rows, bounds), -1, 1)


def scaled(value: Array, slope: Array) -> tuple[Array, Array]:
    """Scales each limit and its slope such that |∇c| + |c| = 1.

    Without the scaling, a limit that varies little over the range of an action would be violated
    rather than satisfied.

    Args:
        value: c, the limits, (m,).
        slope: ∇c, their slopes by the action, (m, k).
    """
    size = jax.lax.stop_gradient(jnp.sum(jnp.abs(slope), axis=1) + jnp.abs(value))
    size = jnp.where(size > 0, size, 1)
    return value / size, slope / size[:, None]


def project(x: Array, rows: Array, bounds: Array) -> Array:
    """Returns the point a nearest to x with G a ≤ h, by a fixed number of interior-point steps.

    Solves a − x + Gᵀλ = 0, s = h − G a + δ λ, λ s = μ for small μ and δ. λ are multipliers and s
    are slacks. Contradictory rows cannot all be satisfied; the term δ λ lets them be violated in
    the least-squares sense. The result is differentiated implicitly at the solution of these
    equations.

    Args:
        x: the desired point, (k,).
        rows: G, (m, k); k and m of a few tens at most.
        bounds: h, (m,).

    Returns:
        The point a, (k,).
    """
    eps = float(jnp.finfo(x.dtype).eps)
    soft = last = eps**0.6  # with smaller values, rounding errors dominate the derivative
    size = 1 + jnp.max(jnp.abs(bounds - rows @ x), initial=0)
    ones = jnp.ones_like(bounds)
    start = jax.lax.stop_gradient(ExploredPoint(x, size * ones, size * ones))
    fixed = jax.lax.stop_gradient((x, rows, bounds))

    def iterate(point: ExploredPoint, _: None) -> tuple[ExploredPoint, None]:
        μ = jnp.maximum(0.2 * jnp.mean(point.λ * point.s), last)
        change = newton(point, residual(point, *fixed, soft, μ), fixed[1], soft)
        positive, delta = (jnp.concatenate([p.λ, p.s]) for p in (point, change))
        shrinks = delta < 0
        to_bound = jnp.where(shrinks, -positive / jnp.where(shrinks, delta, -1), jnp.inf)
        length = jnp.minimum(INWARD * jnp.min(to_bound, initial=jnp.inf), 1)
        return jax.tree.map(lambda p, c: p + length * c, point, change), None

    solution = jax.lax.stop_gradient(jax.lax.scan(iterate, start, None, ITERATIONS)[0])
    # implicit differentiation: one Newton step from the solution, with its matrix held constant,
    # has the derivative of the solution
    r = residual(solution, x, rows, bounds, soft, last)
    return solution.a + newton(solution, r, fixed[1], soft).a


def residual(
    point: ExploredPoint, x: Array, rows: Array, bounds: Array, soft: float, μ: float | Array
) -> ExploredPoint:
    """Returns the residuals of the optimality conditions at a point, as an `ExploredPoint`.

    The conditions are a − x + Gᵀλ = 0 (stationarity), λ s = μ (complementarity) and
    s = h − G a + δ λ. Here G is `rows`, h is `bounds` and δ is `soft`.
    """
    a, λ, s = point
    return ExploredPoint(a - x + rows.T @ λ, λ * s - μ, s - bounds + rows @ a - soft * λ)


def newton(point: ExploredPoint, r: ExploredPoint, rows: Array, soft: float) -> ExploredPoint:
    """Returns the Newton step for the residual r, with slacks and multipliers eliminated.

    Δs = −r_s − G Δa + δ Δλ and λ Δs + s Δλ = −r_λ give Δλ = (G Δa + r_s − r_λ/λ)/(s/λ + δ). Here G
    is `rows` and δ is `soft`.
    """
    _, λ, s = point
    weight = 1 / (s / λ + soft)
    reduced = r.s - r.λ / λ
    matrix = jnp.eye(rows.shape[1], dtype=rows.dtype) + (rows.T * weight[None]) @ rows
    a = jnp.linalg.solve(matrix, -r.a - rows.T @ (weight * reduced))
    λ_step = weight * (rows @ a + reduced)
    return ExploredPoint(a, λ_step, -r.s - rows @ a + soft * λ_step)
