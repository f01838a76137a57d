"""Baumgarte gains that adapt to the size of a constraint violation, or to its history."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxcon.constraints.rows import Rows
from jaxcon.core import checks, numerics
from jaxcon.core.pytree import exportable, pytree, static
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.methods.baumgarte import Baumgarte, weakened
from jaxcon.methods.gains import (
    by_row,
    check_gains,
    check_numbers,
    column,
    squares,
    zeros_by_row,
)
from jaxcon.protocols import Stabilizer, System


@pytree
class AdaptiveBaumgarte(Baumgarte):
    """Gains α = s α₀ and β = s β₀, with a scale s that grows with the violation (chapter 3.3.4).

    The scale is s = f + (1 − f) x²/(1 + x²) with x = ‖φ‖/size. ‖φ‖ is the norm over the rows of one
    constraint. The gains are f α₀, f β₀ near the constraint and α₀, β₀ far from it. The damping
    ratio α/β stays the same. s depends on ‖φ‖² alone and is smooth everywhere, φ = 0 included.
    Velocity-level rows have no φ and keep s = 1.

    Attributes:
        alpha: α₀ [1/s].
        beta: β₀ [1/s].
        fallback: default (α₀, β₀) for constraints without a gain [1/s].
        size: the violation ‖φ‖ at which s is halfway between f and 1 [unit of φ].
        floor: the smallest scale f, between 0 and 1.
    """

    size: Any = 1e-3
    floor: Any = 0.2

    def check(self) -> None:
        """Checks the gains, `size` and `floor`.

        Raises:
            ValueError: a gain is negative, `size` is not positive, or `floor` is not in [0, 1].
        """
        owner = "AdaptiveBaumgarte"
        check_gains(owner, alpha=self.alpha, beta=self.beta)
        check_gains(owner, {"above": 0}, optional=False, size=self.size)
        check_gains(owner, {"least": 0, "most": 1}, optional=False, floor=self.floor)

    def constraint_equations(self, rows: Rows, memory: PyTree, dt: Array) -> Rows:
        """Returns the rows with the target b of J a + C λ = b, for the scaled gains.

        The rounding error `noise` of b is computed with the unscaled β₀, so it is an upper bound.
        """
        return super().constraint_equations(weakened(rows, self.scale(rows)), memory, dt)

    def scale(self, rows: Rows) -> Array:
        """Returns the scale s of the gains for each row, (n_c,)."""
        floor = by_row(self.floor, AdaptiveBaumgarte.floor, rows, "AdaptiveBaumgarte")
        size = by_row(self.size, AdaptiveBaumgarte.size, rows, "AdaptiveBaumgarte")
        square = squares(rows.residual / size, rows.layout)
        # x²/(1 + x²) would have the derivative NaN where x² overflows, as near a singular position
        grown = 1 - (1 - floor) / (1 + square)
        return jnp.where(column(rows.layout.holonomic, rows), grown, 1)


LEAST_RATIO = 0.5
"""The smallest damping ratio ζ of a `SlidingWindowBaumgarte`."""


@exportable
class History(NamedTuple):
    """The memory of a `SlidingWindowBaumgarte`.

    Attributes:
        residuals: residuals φ of the last steps, the newest last, (window, n_c).
        raised: logarithm of the raised gain, u = ln(β/rate), (n_c,).
        damping: oscillation o of each row, from 0 to 1, (n_c,).
        seen: the number of steps so far, ().
    """

    residuals: Array
    raised: Array
    damping: Array
    seen: Array


@pytree
class SlidingWindowBaumgarte(checks.Checked, Stabilizer):
    """Gains that follow the violations of the last steps (exercise 5).

    The gains are β = rate eᵘ and α = (ζ + (1 − ζ) o) β. Each step updates u from a window of the
    last φ of each row by u⁺ = u + η (max(τ, 0) (1 − o) − o − r u), with trend τ and oscillation o:

        τ = (E₂ − E₁)/(E₁ + E₂ + δ²)      trend: E₁, E₂ are mean φ² of the older and newer half
        o = 1 − ‖Σ (φ, δ)‖ / Σ ‖(φ, δ)‖   oscillation: 0 for φ of one sign, 1 for balanced signs

    The sums Σ run over the window.

    A growing violation raises β. An oscillating violation lowers β and brings α up to β. Otherwise
    β returns to the rate. τ and o are smooth for δ > 0, and 0 if φ is far below δ. The ratio α/β
    stays between ζ and 1, and β/rate between 1/`reach` and `reach`. β also stays below `margin` ·
    `limit`. Below `limit`, the integrator is stable at step size h for every such ratio α/β.

    Gains do not adapt until the window is full. Velocity-level rows have no φ and keep their gains.
    For h = 0 no limit exists: with limit=None the world stops with status `NON_FINITE`.

    Attributes:
        rate: β at the start [1/s]: a number, an array by row, or a mapping by constraint. If None,
            the integrator's default β, but at most a quarter of the limit.
        damping_ratio: smallest ratio ζ = α/β, from ½ to 1.
        speed: the largest change η of ln β that a trend or an oscillation causes in one step.
        recovery: decay r of u: a step reduces u by η r u.
        reach: largest factor between β and `rate`: β stays between rate/reach and rate·reach.
        noise: noise level δ, below which φ counts as zero [unit of φ].
        margin: the largest β as a fraction of the limit, at most 1.
        limit: the largest stable β [1/s]; if None, the integrator's limit at step size h.
        fallback: default gains (α, β) for constraints without a rate [1/s].
        window: the number of steps in the window, 4 or more.
    """

    rate: Any = None
    damping_ratio: Any = 0.7
    speed: Any = 0.1
    recovery: Any = 0.1
    reach: Any = 10.0
    noise: Any = 1e-9
    margin: Any = 0.9
    limit: Any = None
    fallback: Any = None
    window: int = static(default=8)

    def check(self) -> None:
        """Checks that every field is in its valid range.

        Raises:
            ValueError: a field is out of range.
        """
        owner, ratio = "SlidingWindowBaumgarte", self.damping_ratio
        check_gains(owner, rate=self.rate)
        check_gains(owner, {"least": LEAST_RATIO, "most": 1}, optional=False, damping_ratio=ratio)
        check_numbers(
            self,
            speed={"least": 0},
            recovery={"least": 0},
            noise={"above": 0},
            reach={"least": 1},
            margin={"least": 0, "most": 1},
            limit={"above": 0, "optional": True},
        )
        checks.count(owner, "window", self.window, 4)

    def init(self, system: System, q: Array, v: Array) -> History:
        """Returns an empty window: zeros, and no steps seen."""
        zeros = zeros_by_row(system, q, v)
        window = jnp.zeros((self.window, len(zeros)), q.dtype)
        return History(window, zeros, zeros, jnp.zeros((), q.dtype))

    def resolve(self, gains: tuple[Scalar, Scalar]) -> SlidingWindowBaumgarte:
        """Returns the stabilizer with `fallback` set to (α, β) [1/s], unless it is already set."""
        return self if self.fallback is not None else dataclasses.replace(self, fallback=gains)

    def cap_gains(self, stable_rate: Callable[[float], Scalar]) -> SlidingWindowBaumgarte:
        """Returns the stabilizer with its limit on β and its initial β set.

        A missing `limit` becomes the largest stable β. The default β in `fallback` is reduced to at
        most a quarter of the limit. It also replaces a missing `rate`.

        Args:
            stable_rate: function of the smallest damping ratio α/β; returns the largest stable β
                [1/s].
        """
        limit: Any = stable_rate(LEAST_RATIO) if self.limit is None else self.limit
        default = jnp.minimum(self.fallback[1], limit / 4)
        rate = default if self.rate is None else self.rate
        fallback = (self.fallback[0], default)
        return dataclasses.replace(self, limit=limit, rate=rate, fallback=fallback)

    def constraint_equations(self, rows: Rows, memory: History, dt: Array) -> Rows:
        """Returns the rows with the target b = −γ − 2α φ̇ − β² φ of J a + C λ = b."""
        alpha, beta = self.gains(rows, memory)
        b = -rows.bias - 2 * alpha * rows.rate - beta * beta * rows.residual
        return rows.with_target(b)

    def gains(self, rows: Rows, memory: History) -> tuple[Array, Array]:
        """Returns the gains α and β of each row, (n_c,) [1/s]; NaN if a field is out of range."""
        rate, bound = self._bounds(rows)
        beta = jnp.minimum(rate * jnp.exp(memory.raised), bound)
        # the clips of `advance` hide an invalid number, but its derivative would still be NaN
        numbers = (self.damping_ratio, self.speed, self.recovery, self.noise)
        others = (by_row(x, 0.0, rows, "SlidingWindowBaumgarte") for x in numbers)
        reach, noise = (jnp.asarray(x, rows.bias.dtype)[None] for x in (self.reach, self.noise))
        valid = (reach >= 1) & (noise > 0)
        for x in (rate, bound, *others):
            valid = valid & jnp.isfinite(x)
        beta = jnp.where(valid, beta, jnp.nan)
        ratio = by_row(self.damping_ratio, SlidingWindowBaumgarte.damping_ratio, rows, "ratio")
        ratio = jnp.clip(ratio, LEAST_RATIO, 1)
        return (ratio + (1 - ratio) * memory.damping) * beta, beta

    def _bounds(self, rows: Rows) -> tuple[Array, Array]:
        """Returns the initial β of each row, (n_c,) or (1,), and the largest β, (1,) [1/s]."""
        rate = by_row(self.rate, self.fallback[1], rows, "SlidingWindowBaumgarte")
        margin, limit = (jnp.asarray(x, rows.bias.dtype) for x in (self.margin, self.limit))
        return rate, (margin * limit)[None]

    def advance(self, rows: Rows, memory: History, dt: Array) -> History:
        """Appends φ of the rows at the start of a step to the window, and updates the gains."""
        numbers = self.noise, self.reach, self.recovery, self.speed
        δ, reach, r, η = (jnp.asarray(x, rows.bias.dtype)[None] for x in numbers)
        residuals = jnp.concatenate([memory.residuals[1:], rows.residual[None]])
        seen = memory.seen + 1
        trend, oscillation = trend_and_oscillation(residuals, δ)
        rate, bound = self._bounds(rows)
        pull = jnp.maximum(trend, 0) * (1 - oscillation) - oscillation - r * memory.raised
        # clip before the logarithm, whose derivative at 0 is infinite
        top = jnp.log(jnp.clip(numerics.safe_divide(bound, rate), 1 / reach, reach))
        raised = jnp.clip(memory.raised + η * pull, -jnp.log(reach), top)
        full = (seen >= self.window)[None] & column(rows.layout.holonomic, rows)
        raised = jnp.where(full, raised, memory.raised)
        return History(residuals, raised, jnp.where(full, oscillation, memory.damping), seen)


def trend_and_oscillation(residuals: Array, noise: Array) -> tuple[Array, Array]:
    """Returns the trend τ and the oscillation o of each row over a window of steps, (n_c,) each.

    τ compares the mean φ² of the older and the newer half of the window: it is 0 for no change, and
    near 1 for strong growth. o is 0 if φ keeps its sign, and near 1 if positive and negative φ
    cancel.

    Args:
        residuals: residuals φ, the newest last, (window, n_c).
        noise: noise level δ, (1,).
    """
    window = residuals.shape[0]
    square = residuals * residuals
    older = jnp.mean(square[: window // 2], axis=0)
    newer = jnp.mean(square[-(window // 2) :], axis=0)
    trend = (newer - older) / (newer + older + noise * noise)
    total = jnp.sum(residuals, axis=0)
    length = jnp.sum(jnp.sqrt(square + (noise * noise)[None]), axis=0)
    return trend, 1 - numerics.safe_sqrt(total * total + (window * noise) ** 2) / length
