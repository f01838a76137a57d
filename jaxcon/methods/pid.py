"""PID control: feedback of a constraint error, its rate and its integral (chapter 3.3.4)."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Rows
from jaxcon.core import checks
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, Scalar
from jaxcon.methods.gains import Gain, by_row, check_gains, zeros_by_row
from jaxcon.protocols import Stabilizer, System


@pytree
class PID(checks.Checked, Stabilizer):
    """PID feedback b = −γ − K_d φ̇ − K_p φ − K_i ∫φ dt.

    The integral removes the error that a steady disturbance causes. The characteristic equation of
    the error is s³ + K_d s² + K_p s + K_i = 0; the error decays if K_i < K_d K_p. The memory is the
    integral, updated once a step by ∫φ⁺ = ∫φ + h φ. It is clamped to |K_i ∫φ| ≤ limit
    (anti-windup), and leaves this bound as soon as φ changes sign. The clamp is continuous. While
    it is active, the gradient of the integral with respect to φ is zero. Velocity-level rows have φ
    = 0, so only K_d acts on them. Each gain is a number, an array by row, or a mapping by
    constraint as in `Baumgarte`.

    Attributes:
        proportional: gain K_p of φ [1/s²]; β² of the integrator's default gains if None.
        derivative: gain K_d of φ̇ [1/s]; 2α of the integrator's default gains if None.
        integral: gain K_i of ∫φ dt [1/s³].
        limit: the largest |K_i ∫φ| [unit of φ̈]; None for no limit.
        fallback: default (α, β) for constraints without a gain [1/s].

    References:
        Åström and Hägglund, Advanced PID Control (2006), section 3.5.
    """

    proportional: Any = None
    derivative: Any = None
    integral: Any = 0.0
    limit: Any = None
    fallback: Any = None

    def check(self) -> None:
        """Checks the gains and the limit of the integral.

        Raises:
            ValueError: a gain or the limit is negative or not a number.
        """
        check_gains(
            "PID",
            proportional=self.proportional,
            derivative=self.derivative,
            limit=self.limit,
        )
        check_gains("PID", optional=False, integral=self.integral)

    @property
    def alpha(self) -> Gain | None:
        """The equivalent Baumgarte gain α = K_d / 2 [1/s]; None if K_d is not given."""
        return jax.tree.map(lambda x: x / 2, self.derivative)

    @property
    def beta(self) -> Gain | None:
        """The equivalent Baumgarte gain β = √K_p [1/s]; None if K_p is not given."""
        return jax.tree.map(lambda x: x**0.5, self.proportional)

    def init(self, system: System, q: Array, v: Array) -> Array:
        """Returns the integral ∫φ dt of each row at the start: zero, (n_c,)."""
        return zeros_by_row(system, q, v)

    def resolve(self, gains: tuple[Scalar, Scalar]) -> PID:
        """Returns the controller with K_d = 2α and K_p = β² in place of missing gains.

        (α, β) is the field `fallback` if it is set, otherwise `gains`.
        """
        fallback: Any = gains if self.fallback is None else self.fallback
        proportional = fallback[1] ** 2 if self.proportional is None else self.proportional
        derivative = 2 * fallback[0] if self.derivative is None else self.derivative
        return dataclasses.replace(
            self, proportional=proportional, derivative=derivative, fallback=fallback
        )

    def constraint_equations(self, rows: Rows, memory: Array, dt: Array) -> Rows:
        """Returns the rows with the target b = −γ − K_d φ̇ − K_p φ − K_i ∫φ dt."""
        alpha, beta = self.fallback
        proportional = by_row(self.proportional, beta * beta, rows, "PID")
        derivative = by_row(self.derivative, 2 * alpha, rows, "PID")
        pull = proportional * rows.residual + by_row(self.integral, 0.0, rows, "PID") * memory
        return rows.with_target(-rows.bias - derivative * rows.rate - pull)

    def advance(self, rows: Rows, memory: Array, dt: Array) -> Array:
        """Returns the integral ∫φ dt of each row after the step, (n_c,)."""
        integral = memory + dt[None] * rows.residual
        if self.limit is None:
            return integral
        gain = by_row(self.integral, 0.0, rows, "PID")
        # a finite number: the derivative of limit/K_i would be NaN for an infinite limit
        limit = by_row(self.limit, float(jnp.finfo(gain.dtype).max) ** 0.5, rows, "PID")
        bound = jnp.where(gain > 0, limit / jnp.where(gain > 0, gain, 1), jnp.inf)
        return jnp.clip(integral, -bound, bound)
