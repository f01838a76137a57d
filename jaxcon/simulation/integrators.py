"""How a step advances q and v. An integrator sees the system through `accelerate` alone.

`accelerate(q, v, t)` returns the solution of the saddle system there and its rows. Each integrator
also says how it transforms a constraint error under feedback, which decides which gains are stable.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.core import status
from jaxcon.core.pytree import pytree, static
from jaxcon.model.state import State

Accelerate = Callable[[Any, Any, Any], Any]


@pytree
class SemiImplicitEuler:
    """v⁺ = v + h a(q, v), q⁺ = q ⊕ h v⁺: first order, one solve, symplectic without constraints."""

    def advance(self, accelerate: Accelerate, system: Any, state: State, dt: Any) -> Any:
        """The state one step later, and the solution and rows at its start."""
        solution, rows = accelerate(state.q, state.v, state.time)
        v = state.v + dt * solution.acceleration
        q = system.retract(state.q, dt * v)
        return dataclasses.replace(state, q=q, v=v, time=state.time + dt), solution, rows

    def default_gains(self, dt: Any) -> tuple[Any, Any]:
        """α = 1/(2h), β = 1/h [1/s]: the gains for which an error is gone after one step.

        φ⁺ = φ + h φ̇⁺ with φ̇⁺ = φ̇ + h (J a + γ) vanishes where J a = −γ − φ̇/h − φ/h². Both roots
        of the error's recursion are then 0, as far from instability as they can be, and the step is
        SHAKE with its constraint linearized: the energy stays bounded better than at any other gain.
        """
        return 0.5 / dt, 1.0 / dt

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """The factor by which an error (φ, φ̇) may grow in one step: a spectral radius.

        φ̇⁺ = (1 − 2hα) φ̇ − hβ² φ and φ⁺ = φ + h φ̇⁺.
        """
        damped, pulled = 1 - 2 * dt * alpha, -dt * beta**2
        return spectral_radius([[1 + dt * pulled, dt * damped], [pulled, damped]])


@pytree
class RungeKutta:
    """An explicit Runge–Kutta method by its tableau.

    Stages move q along q̇ = N(q) v and bring quaternions back to unit length. The vector field so
    extended off the unit sphere agrees with the true one on it: the order is that of the tableau.

    Attributes:
        a: rows of the strictly lower triangle.
        b: weights.

    References:
        Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), section IV.4.
    """

    a: tuple[tuple[float, ...], ...] = static()
    b: tuple[float, ...] = static()

    def advance(self, accelerate: Accelerate, system: Any, state: State, dt: Any) -> Any:
        """The state one step later, and the solution and rows at its start."""
        q, v, t = state.q, state.v, state.time
        stages = [accelerate(q, v, t)]
        slopes = [(system.kinematics(q, v), stages[0][0].acceleration)]
        for weights in self.a:
            dq, dv = combine(weights, slopes)
            q_i, v_i = system.normalize(q + dt * dq), v + dt * dv
            stages.append(accelerate(q_i, v_i, t + dt * sum(weights)))
            slopes.append((system.kinematics(q_i, v_i), stages[-1][0].acceleration))
        dq, dv = combine(self.b, slopes)
        solution, rows = stages[0]
        for stage, _ in stages[1:]:
            solution = solution._replace(status=status.first(solution.status, stage.status))
        q, v = system.normalize(q + dt * dq), v + dt * dv
        return dataclasses.replace(state, q=q, v=v, time=t + dt), solution, rows

    def default_gains(self, dt: Any) -> tuple[Any, Any]:
        """α = β = 10 /s, and less where h is so large that 0.4/h is below it."""
        rate = jnp.minimum(10.0, 0.4 / dt)
        return rate, rate

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """max |R(h s)| over the roots s of s² + 2α s + β² = 0, R the stability polynomial."""
        error = np.array([[0.0, 1.0], [-(beta**2), -2 * alpha]]) * dt
        slopes: list[np.ndarray] = []
        for weights in ((), *self.a):
            stage = sum((w * k for w, k in zip(weights, slopes, strict=True)), np.eye(2))
            slopes.append(error @ stage)
        return spectral_radius(sum((w * k for w, k in zip(self.b, slopes, strict=True)), np.eye(2)))


def ExplicitEuler() -> RungeKutta:  # noqa: N802
    """v⁺ = v + h a, q⁺ = q + h q̇: first order, for comparison only."""
    return RungeKutta((), (1.0,))


def Heun() -> RungeKutta:  # noqa: N802
    """The trapezoidal method of Heun: second order, two solves."""
    return RungeKutta(((1.0,),), (0.5, 0.5))


def RK4() -> RungeKutta:  # noqa: N802
    """The classical method of Kutta: fourth order, four solves."""
    return RungeKutta(((0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6))


def combine(weights: tuple[float, ...], slopes: list[Any]) -> tuple[Any, Any]:
    """Σ wᵢ (q̇ᵢ, aᵢ), without the terms of weight zero."""
    used = [(w, slope) for w, slope in zip(weights, slopes, strict=True) if w]
    dq = functools.reduce(operator.add, (w * slope[0] for w, slope in used))
    return dq, functools.reduce(operator.add, (w * slope[1] for w, slope in used))


def spectral_radius(matrix: Any) -> float:
    """The largest modulus of an eigenvalue."""
    return float(np.max(np.abs(np.linalg.eigvals(np.asarray(matrix, np.float64)))))
