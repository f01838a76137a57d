"""Baumgarte gains that follow the violation: by its size now, or by its history."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxcon.constraints.rows import Rows, layout_of
from jaxcon.core import checks, numerics
from jaxcon.core.pytree import exportable, pytree, static
from jaxcon.core.typing import Array, PyTree
from jaxcon.stabilization.baumgarte import Baumgarte, Unstabilized
from jaxcon.stabilization.gains import by_row, check_between, check_gains, column, squares


@pytree
class AdaptiveBaumgarte(Baumgarte):
    """α = s α₀ and β = s β₀ with s = f + (1 − f) x²/(1 + x²) and x = ‖φ‖/size (chapter 3.3.4).

    ‖φ‖ is the norm over the rows of one constraint. Near the constraint the gains are f α₀, f β₀,
    far from it α₀, β₀; the damping ratio α/β stays, and an error never lacks damping. s depends
    on ‖φ‖² alone and is smooth everywhere, φ = 0 included. Rows of velocities, which have no φ,
    keep s = 1.

    Attributes:
        alpha: α₀ [1/s].
        beta: β₀ [1/s].
        fallback: (α₀, β₀) of the constraints without gains of their own [1/s].
        size: ε, at which the gains are half way [unit of φ].
        floor: f, between 0 and 1.
    """

    size: Any = 1e-3
    floor: Any = 0.2

    def check(self) -> None:
        """Checks the gains.

        Raises:
            ValueError: one is negative, `size` is zero, or `floor` above 1.
        """
        owner = "AdaptiveBaumgarte"
        check_gains(owner, alpha=self.alpha, beta=self.beta)
        check_gains(owner, strictly=True, optional=False, size=self.size)
        check_between(owner, "floor", self.floor, 0, 1)

    def target(self, rows: Rows, memory: PyTree, dt: Any) -> Array:
        """b (n_c,)."""
        scale = self.scale(rows)
        alpha = scale * by_row(self.alpha, self.fallback[0], rows)
        beta = scale * by_row(self.beta, self.fallback[1], rows)
        return -rows.bias - 2 * alpha * rows.rate - beta * beta * rows.residual

    def scale(self, rows: Rows) -> Array:
        """s by row, (n_c,)."""
        floor = by_row(self.floor, AdaptiveBaumgarte.floor, rows, "AdaptiveBaumgarte")
        size = by_row(self.size, AdaptiveBaumgarte.size, rows, "AdaptiveBaumgarte")
        square = squares(rows.residual / size, rows.layout)
        # of ∞/∞ there would be no derivative where x² is beyond float32, as next to a singular spot
        grown = 1 - (1 - floor) / (1 + square)
        return jnp.where(column(rows.layout.holonomic, rows), grown, 1)


LEAST_RATIO = 0.5
"""The least damping ratio of a sliding window."""


@exportable
class History(NamedTuple):
    """What a sliding window remembers.

    Attributes:
        residuals: φ of the last steps, the newest last, (window, n_c).
        raised: u = ln(β/rate), (n_c,).
        damping: o, the share of oscillation, (n_c,).
        seen: how many steps, ().
    """

    residuals: Array
    raised: Array
    damping: Array
    seen: Array


@pytree
class SlidingWindowBaumgarte(Unstabilized):
    """β = rate eᵘ and α = (ζ + (1 − ζ) o) β, where u follows the last steps (exercise 5).

    u⁺ = u + η (max(τ, 0) (1 − o) − o − r u), from the window of the last φ of each row, where

        τ = (E₂ − E₁)/(E₁ + E₂ + δ²)      trend: E₁, E₂ the mean φ² of its halves, the newer last
        o = 1 − ‖Σ (φ, δ)‖ / Σ ‖(φ, δ)‖   oscillation: 0 for one sign, 1 for as much of each

    A violation that grows raises β, one that oscillates lowers it and brings α up to β, and under
    any other β goes back to the rate. τ and o are smooth for δ > 0, and 0 where φ is far below δ.
    ζ ≤ α/β ≤ 1 always, β stays within `reach` of the rate, and below `margin` times the largest β
    at which the integrator is stable at h for every such ratio. Nothing is adapted until the window
    is full; rows of velocities, without φ, keep their gains. A step of h = 0 has no limit: with
    limit=None such a world ends in NON_FINITE.

    Attributes:
        rate: β to start with [1/s], as gains of `Baumgarte` are given; if None, that of the
            integrator, and no more than a quarter of the limit.
        damping_ratio: ζ, from ½ to 1.
        speed: η, by how much ln β may change in a step.
        recovery: r, the share of u that is forgotten, in units of η.
        reach: β stays between rate/reach and rate·reach.
        noise: δ, what counts as no violation [unit of φ].
        margin: the share of the limit that is used, below 1.
        limit: the largest stable β [1/s]; if None, that of the integrator at h.
        fallback: (α, β) of the integrator [1/s].
        window: how many steps are remembered, 4 or more.
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
        """Checks the numbers.

        Raises:
            ValueError: one is out of its range.
        """
        owner = "SlidingWindowBaumgarte"
        check_gains(owner, rate=self.rate)
        check_between(owner, "damping_ratio", self.damping_ratio, LEAST_RATIO, 1)
        for what in ("speed", "recovery"):
            checks.check(owner, what, getattr(self, what), (), least=0)
        checks.check(owner, "noise", self.noise, (), above=0)
        checks.check(owner, "reach", self.reach, (), least=1)
        checks.check(owner, "margin", self.margin, (), least=0, most=1)
        checks.check(owner, "limit", self.limit, (), above=0, optional=True)
        checks.count(owner, "window", self.window, 4)

    def init(self, system: Any, q: Array, v: Array) -> History:
        """A window that has seen nothing."""
        n_c = layout_of(system, q, v, jnp.zeros((), q.dtype)).size
        rows = jnp.zeros(n_c, q.dtype)
        seen = jnp.zeros((), q.dtype)
        return History(jnp.zeros((self.window, n_c), q.dtype), rows, rows, seen)

    def resolve(self, gains: tuple[Any, Any]) -> SlidingWindowBaumgarte:
        """Returns the stabilizer with these (α, β) where there is no rate."""
        return self if self.fallback is not None else dataclasses.replace(self, fallback=gains)

    def bounded(self, stable_rate: Callable[[float], Any]) -> SlidingWindowBaumgarte:
        """Returns the stabilizer with its rate below the limit of the integrator."""
        limit = stable_rate(LEAST_RATIO) if self.limit is None else self.limit
        default = jnp.minimum(self.fallback[1], limit / 4)
        rate = default if self.rate is None else self.rate
        fallback = (self.fallback[0], default)
        return dataclasses.replace(self, limit=limit, rate=rate, fallback=fallback)

    def target(self, rows: Rows, memory: History, dt: Any) -> Array:
        """b (n_c,)."""
        alpha, beta = self.gains(rows, memory)
        return -rows.bias - 2 * alpha * rows.rate - beta * beta * rows.residual

    def gains(self, rows: Rows, memory: History) -> tuple[Array, Array]:
        """α and β by row, (n_c,) [1/s]."""
        rate, bound = self._bounds(rows)
        beta = jnp.minimum(rate * jnp.exp(memory.raised), bound)
        beta = jnp.where(self._finite(rows), beta, jnp.nan)
        ratio = by_row(self.damping_ratio, SlidingWindowBaumgarte.damping_ratio, rows, "ratio")
        ratio = jnp.clip(ratio, LEAST_RATIO, 1)
        return (ratio + (1 - ratio) * memory.damping) * beta, beta

    def _bounds(self, rows: Rows) -> tuple[Array, Array]:
        """The rate to start with, and the largest β."""
        dtype = rows.bias.dtype
        rate = by_row(self.rate, self.fallback[1], rows, "SlidingWindowBaumgarte")
        limit = jnp.asarray(self.margin, dtype) * jnp.asarray(self.limit, dtype)
        return rate, limit[None]

    def _finite(self, rows: Rows) -> Array:
        """True by row where all numbers are finite and δ is positive; elsewhere there is no gain.

        Otherwise the clips of `advance` would hide it, and keep its derivative, NaN.
        """
        numbers = (self.damping_ratio, self.speed, self.recovery, self.noise)
        others = (by_row(x, 0.0, rows, "SlidingWindowBaumgarte") for x in numbers)
        finite = functools.reduce(
            jnp.logical_and, map(jnp.isfinite, (*self._bounds(rows), *others))
        )
        reach, noise = (jnp.asarray(x, rows.bias.dtype)[None] for x in (self.reach, self.noise))
        return finite & (reach >= 1) & (noise > 0)

    def advance(self, rows: Rows, memory: History, dt: Any) -> History:
        """The memory with the φ of this step."""
        dtype = rows.bias.dtype
        residuals = jnp.concatenate([memory.residuals[1:], rows.residual[None]])
        seen = memory.seen + 1
        trend, oscillation = judge(residuals, jnp.asarray(self.noise, dtype)[None])
        rate, bound = self._bounds(rows)
        most = jnp.asarray(self.reach, dtype)[None]
        reach = jnp.log(most)
        back = jnp.asarray(self.recovery, dtype)[None] * memory.raised
        pull = jnp.maximum(trend, 0) * (1 - oscillation) - oscillation - back
        # clipped first: the logarithm of 0 has no derivative
        top = jnp.log(jnp.clip(numerics.safe_divide(bound, rate), 1 / most, most))
        raised = jnp.clip(memory.raised + jnp.asarray(self.speed, dtype)[None] * pull, -reach, top)
        full = (seen >= self.window)[None] & column(rows.layout.holonomic, rows)
        return History(
            residuals,
            jnp.where(full, raised, memory.raised),
            jnp.where(full, oscillation, memory.damping),
            seen,
        )


def judge(residuals: Array, noise: Array) -> tuple[Array, Array]:
    """Trend and oscillation of each row over a window, (n_c,).

    Args:
        residuals: φ, the newest last, (window, n_c).
        noise: δ, (1,).
    """
    window = residuals.shape[0]
    square = residuals * residuals
    older = jnp.mean(square[: window // 2], axis=0)
    newer = jnp.mean(square[-(window // 2) :], axis=0)
    trend = (newer - older) / (newer + older + noise * noise)
    total = jnp.sum(residuals, axis=0)
    length = jnp.sum(jnp.sqrt(square + (noise * noise)[None]), axis=0)
    straight = numerics.safe_sqrt(total * total + (window * noise) ** 2)
    return trend, 1 - straight / length
