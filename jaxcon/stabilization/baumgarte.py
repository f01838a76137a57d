"""Feedback on the acceleration level (chapter 3.3)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Rows
from jaxcon.core import checks
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import State
from jaxcon.solvers.saddle import Saddle, Solution
from jaxcon.stabilization.gains import by_row, check_gains, sums

SHARE = 5e-4
"""The noise of default feedback, β² ε, as a share of the accelerations of a constraint."""


class Law(NamedTuple):
    """What a stabiliser asks of the rows at one instant: J a + C λ = b.

    Attributes:
        rows: with J and C.
        target: b, (n_c,).
        force: what is added to f, (n_v,); None where nothing is.
        noise: what b may be off by rounding, a number or (n_c,); None where that is not known.
        solve: (solver, saddle) → solution, where the solver's own is not what is meant.
    """

    rows: Rows
    target: Array
    force: Array | None = None
    noise: Any = None
    solve: Callable[[Any, Saddle], Solution] | None = None


@pytree
class Unstabilized(checks.Checked):
    """b = −γ: constraints hold at the acceleration level only, and errors grow with time."""

    def init(self, system: Any, q: Array, v: Array) -> PyTree:
        """No memory."""
        return ()

    def resolve(self, gains: tuple[Any, Any]) -> Unstabilized:
        """Itself: there is nothing to choose."""
        return self

    def rising(self, limit: Any) -> Unstabilized:
        """Itself; default gains rise up to β = limit [1/s] where their rows accelerate fast."""
        return self

    def steady(self, gains: tuple[Any, Any]) -> Unstabilized:
        """Itself; default gains are these (α, β) [1/s] and do not rise."""
        return self

    def bounded(self, stable_rate: Callable[[float], Any]) -> Unstabilized:
        """Itself; one that changes its gains asks here up to which β it may, by least α/β."""
        return self

    def target(self, rows: Rows, memory: PyTree, dt: Any) -> Array:
        """b (n_c,)."""
        return -rows.bias

    def impose(self, rows: Rows, memory: PyTree, dt: Any) -> Law:
        """The rows as they are, with their target."""
        return Law(rows, self.target(rows, memory, dt))

    def advance(self, rows: Rows, memory: PyTree, dt: Any) -> PyTree:
        """The memory after a step that started with these rows."""
        return memory

    def remember(self, memory: PyTree, solution: Solution) -> PyTree:
        """Returns the memory after what was solved at the start of the step."""
        return memory

    @property
    def corrects(self) -> tuple[str, ...]:
        """What it moves after a step: "position", "velocity", both or nothing."""
        moves = type(self).correct is not Unstabilized.correct
        return ("position", "velocity") if moves else ()

    @property
    def completes(self) -> bool:
        """Returns True where it completes each step, as `Projection()` does.

        It then finds the constraint forces by which q⁺ keeps φ = 0, and v⁺ keeps φ̇ = 0 at q⁺.
        """
        return False

    @property
    def remembers(self) -> bool:
        """Returns True where it has a memory."""
        return type(self).init is not Unstabilized.init

    def correct(
        self, system: Any, solver: Any, before: State, state: State, memory: PyTree, dt: Any
    ) -> Any:
        """The state after a step, corrected, and a status of its own: here as it is."""
        return state, jnp.zeros_like(state.status)


@pytree
class Baumgarte(Unstabilized):
    """b = −γ − 2α φ̇ − β² φ, so that the error obeys φ̈ + 2α φ̇ + β² φ = 0.

    Velocity-level rows have φ = 0 and decay as ψ̇ = −2α ψ. Every gain is a leaf. It is a number,
    an array by row (n_c,), or a mapping from constraint names to numbers, with the default for the
    others; a shell pattern such as "leg*" names a group of constraints.

    The default is what suits the integrator at the step used: gains in proportion to 1/h for
    semi-implicit Euler, and bounded independently of h for Runge–Kutta methods, whose stages
    violate the constraints by O(h²), which β² of O(1/h²) would turn into an error of order zero.
    In float32, β of semi-implicit Euler is no more than 917/s where bodies move slowly: β² times
    the rounding of φ is noise in the multipliers. It rises up to 1/h where constraints accelerate
    fast: at h = 0.1 ms a rotor 0.1 m off its axis is so held from about 45 rad/s on. Gains of your
    own are taken as they are: Baumgarte(0.5/h, 1/h) holds fast bodies at every h.

    Attributes:
        alpha: α [1/s].
        beta: β [1/s].
        fallback: (α, β) of the constraints without gains of their own [1/s].

    References:
        Baumgarte, Stabilization of constraints and integrals of motion in dynamical systems (1972).
    """

    alpha: Any = None
    beta: Any = None
    fallback: Any = None

    def check(self) -> None:
        """Checks that gains are zero or more and finite, as far as they are known.

        Raises:
            ValueError: one is not.
        """
        check_gains("Baumgarte", alpha=self.alpha, beta=self.beta)

    @classmethod
    def critical(cls, rate: Any) -> Baumgarte:
        """α = β = rate [1/s]: the fastest decay without oscillation.

        Args:
            rate: number, array by row (n_c,), or a mapping by constraint name.
        """
        return cls(rate, rate)

    @classmethod
    def from_rate(cls, rate: Any, damping_ratio: Any) -> Baumgarte:
        """β = rate [1/s] and α = ζ β: 1 is critical, less oscillates, more is slow.

        Args:
            rate: number, array by row (n_c,), or a mapping by constraint name.
            damping_ratio: ζ, a number or array (n_c,).
        """
        return cls(jax.tree.map(lambda x: damping_ratio * x, rate), rate)

    @property
    def is_default(self) -> bool:
        """True where all gains are left to the integrator."""
        return type(self) is Baumgarte and self.alpha is self.beta is self.fallback is None

    def rising(self, limit: Any) -> Baumgarte:
        """With default gains a `RisingBaumgarte`, with gains of its own itself."""
        return RisingBaumgarte(limit=limit) if self.is_default else self

    def steady(self, gains: tuple[Any, Any]) -> Baumgarte:
        """With default gains these (α, β), which do not rise, with gains of its own itself."""
        return dataclasses.replace(self, fallback=gains) if self.is_default else self

    def resolve(self, gains: tuple[Any, Any]) -> Baumgarte:
        """Returns the stabilizer with these (α, β) where none were given."""
        fallback = gains if self.fallback is None else self.fallback
        alpha = fallback[0] if self.alpha is None else self.alpha
        beta = fallback[1] if self.beta is None else self.beta
        return dataclasses.replace(self, alpha=alpha, beta=beta, fallback=fallback)

    def impose(self, rows: Rows, memory: PyTree, dt: Any) -> Law:
        """The rows as they are; b has the rounding of φ, some ε of a metre, times β²."""
        _, beta = self.gains(rows)
        noise = 64 * float(jnp.finfo(rows.bias.dtype).eps) * beta * beta
        return Law(rows, self.target(rows, memory, dt), noise=noise)

    def target(self, rows: Rows, memory: PyTree, dt: Any) -> Array:
        """b (n_c,)."""
        alpha, beta = self.gains(rows)
        return -rows.bias - 2 * alpha * rows.rate - beta * beta * rows.residual

    def gains(self, rows: Rows) -> tuple[Array, Array]:
        """α and β by row, (n_c,) or (1,) [1/s]."""
        alpha = by_row(self.alpha, self.fallback[0], rows)
        return alpha, by_row(self.beta, self.fallback[1], rows)


@pytree
class RisingBaumgarte(Baumgarte):
    """Default gains that are held low by precision, and rise where constraints accelerate fast.

    The rounding ε of φ, in metres, makes an acceleration of β² ε. It may be 5e-4 of the γ of the
    constraint, Σ|γ_i|. Where bodies turn at ω [rad/s], γ is ω² times the lever arm, and gains of a
    few ω would let the errors of steps add up: energy then drifts by percents.

    Attributes:
        limit: the largest β [1/s].
    """

    limit: Any = None

    def gains(self, rows: Rows) -> tuple[Array, Array]:
        """α and β by row, (n_c,) or (1,) [1/s]."""
        alpha, beta = super().gains(rows)
        square = SHARE / float(jnp.finfo(rows.bias.dtype).eps) * sums(abs(rows.bias), rows.layout)
        rises = square > beta * beta
        risen = jnp.sqrt(jnp.where(rises, square, beta * beta))
        risen = jnp.minimum(jnp.where(rises, risen, beta), by_row(self.limit, None, rows))
        return jnp.where(rises, risen / 2, alpha), risen


def check_stabilizer(owner: str, what: str, part: Any) -> None:
    """Checks a stabiliser that is part of something else.

    Raises:
        TypeError: it is none.
        ValueError: its own numbers are wrong.
    """
    if isinstance(part, type) or not (hasattr(part, "impose") and hasattr(part, "correct")):
        raise TypeError(f"{owner}: {what} must be a stabiliser like Baumgarte(), got {part!r}.")
    if hasattr(part, "check"):
        part.check()


def completes_steps(stabilizer: Any) -> bool:
    """Returns True for a stabilizer that completes each step; one of a user's need not say so."""
    return getattr(stabilizer, "completes", False)


def asks_nothing(stabilizer: Any) -> bool:
    """Returns True for a stabilizer without gains, which leaves constraints to others."""
    default = type(stabilizer) is Baumgarte and stabilizer.alpha is stabilizer.beta is None
    return default or type(stabilizer) is Unstabilized
