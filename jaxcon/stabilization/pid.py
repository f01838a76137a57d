"""Feedback of a constraint error, its rate and its integral (chapter 3.3.4)."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Rows, layout_of
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree
from jaxcon.stabilization.baumgarte import Unstabilized
from jaxcon.stabilization.gains import by_row, check_gains


@pytree
class PID(Unstabilized):
    """b = −γ − K_d φ̇ − K_p φ − K_i ∫φ dt: the integral takes away what a steady disturbance leaves.

    An error obeys s³ + K_d s² + K_p s + K_i = 0, and decays where K_i < K_d K_p. The integral is
    memory: ∫φ⁺ = ∫φ + h φ once a step, clamped to |K_i ∫φ| ≤ limit (anti-windup), so that it never
    holds more than it may ask for, and leaves its bound as soon as φ changes sign. The clamp is
    continuous; in it the integral has no gradient by φ. Rows of velocities have φ = 0 and feel K_d
    alone. Each gain is a number, an array by row, or a mapping as of `Baumgarte`.

    Attributes:
        proportional: K_p [1/s²]; if None, β² of the integrator's default gains.
        derivative: K_d [1/s]; if None, 2α of them.
        integral: K_i [1/s³].
        limit: the most that K_i ∫φ may ask for [unit of φ̈]; None for no limit.
        fallback: (α, β) of constraints without gains of their own [1/s].

    References:
        Åström and Hägglund, Advanced PID Control (2006), section 3.5.
    """

    proportional: Any = None
    derivative: Any = None
    integral: Any = 0.0
    limit: Any = None
    fallback: Any = None

    def check(self) -> None:
        """Checks the gains.

        Raises:
            ValueError: a gain is negative or no number.
        """
        check_gains(
            "PID",
            proportional=self.proportional,
            derivative=self.derivative,
            limit=self.limit,
        )
        check_gains("PID", optional=False, integral=self.integral)

    @property
    def alpha(self) -> Any:
        """α = K_d / 2 [1/s]."""
        return jax.tree.map(lambda x: x / 2, self.derivative)

    @property
    def beta(self) -> Any:
        """β = √K_p [1/s]."""
        return jax.tree.map(lambda x: x**0.5, self.proportional)

    def init(self, system: Any, q: Array, v: Array) -> Array:
        """∫φ = 0, (n_c,)."""
        layout = layout_of(system, q, v, jnp.zeros((), q.dtype))
        return jnp.zeros(layout.size, q.dtype)

    def resolve(self, gains: tuple[Any, Any]) -> PID:
        """Returns the stabilizer with K_d = 2α and K_p = β² where none were given."""
        fallback = gains if self.fallback is None else self.fallback
        proportional = fallback[1] ** 2 if self.proportional is None else self.proportional
        derivative = 2 * fallback[0] if self.derivative is None else self.derivative
        return dataclasses.replace(
            self, proportional=proportional, derivative=derivative, fallback=fallback
        )

    def target(self, rows: Rows, memory: PyTree, dt: Any) -> Array:
        """b (n_c,)."""
        alpha, beta = self.fallback
        proportional = by_row(self.proportional, beta * beta, rows, "PID")
        derivative = by_row(self.derivative, 2 * alpha, rows, "PID")
        pull = proportional * rows.residual + by_row(self.integral, 0.0, rows, "PID") * memory
        return -rows.bias - derivative * rows.rate - pull

    def advance(self, rows: Rows, memory: PyTree, dt: Any) -> Array:
        """∫φ after the step."""
        sum_ = memory + dt[None] * rows.residual
        if self.limit is None:
            return sum_
        gain = by_row(self.integral, 0.0, rows, "PID")
        # not ∞, of which the derivative of limit/K_i would be NaN
        limit = by_row(self.limit, float(jnp.finfo(gain.dtype).max) ** 0.5, rows, "PID")
        used = gain > 0
        bound = jnp.where(used, limit / jnp.where(used, gain, 1), jnp.inf)
        return jnp.clip(sum_, -bound, bound)
