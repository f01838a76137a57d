"""Feedback of constraint errors at acceleration level (chapter 3.3); wrappers of stabilizers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Rows
from jaxcon.core import checks
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.linear.saddle import Saddle, Solution
from jaxcon.methods.gains import Gain, by_row, check_gains, sums
from jaxcon.protocols import Solver, Stabilizer, System
from jaxcon.system.state import State

SHARE = 5e-4
"""The largest rounding noise β² ε that `RisingBaumgarte` allows.

It is a fraction of Σ|γ_i| over the rows of a constraint.
"""


@pytree
class Unstabilized(checks.Checked, Stabilizer):
    """No feedback, b = −γ: constraints hold at acceleration level only, and errors grow."""

    def constraint_equations(self, rows: Rows, memory: PyTree, dt: Array) -> Rows:
        """Returns the rows with the target b = −γ of J a + C λ = b, where φ̈ = J a + γ."""
        return rows.with_target(-rows.bias)

    @property
    def reduces_errors(self) -> bool:
        """False: errors grow."""
        return False


@pytree
class Baumgarte(checks.Checked, Stabilizer):
    """Feedback b = −γ − 2α φ̇ − β² φ, with which the error obeys φ̈ + 2α φ̇ + β² φ = 0.

    Velocity-level rows have φ = 0, and their error decays as ψ̇ = −2α ψ. A gain is a number, an
    array by row (n_c,), or a mapping from constraint names to numbers. A shell pattern such as
    "leg*" names a group of constraints. Constraints that a mapping leaves out get the default.
    Gains are leaves of the pytree.

    With `SemiImplicitEuler`, the feedback acts on the half-step rate

        p = φ̇ − ½hγ = (φ − φ⁻)/h + O(h²)

    in place of φ̇, where q⁻ and φ⁻ are q and φ one step before. The reason: v leads from q⁻ to q,
    so it belongs to the time h/2 before q. At that time the rate of the constraint is p. Feedback
    of φ̇ would drive φ̇ to zero although it should be ½hγ. This would do work on the motion: energy
    would grow in proportion to h, and φ would have an error of h²γ/2. The feedback of
    velocity-level rows acts on ψ at q itself.

    Default gains suit the integrator at the step size in use. For semi-implicit Euler they are
    proportional to 1/h. For Runge–Kutta methods they have a bound that does not depend on h. The
    reason: the stages violate the constraints by O(h²), so β² = O(1/h²) would cause an error of
    order zero.

    In float32, the default β of semi-implicit Euler is at most 917/s if bodies move slowly, since
    β² times the rounding error of φ is noise in the multipliers. If constraints accelerate fast, β
    rises up to 1/h. For a rotor 0.1 m off its axis at h = 0.1 ms, β rises if the rotor turns faster
    than about 45 rad/s. Gains given by the user do not change: Baumgarte(0.5/h, 1/h) suits fast
    bodies at every h.

    Attributes:
        alpha: gain α of the rate [1/s]; None for the default.
        beta: gain β of the position error [1/s]; None for the default.
        fallback: default (α, β) for constraints without a gain [1/s]; None until the integrator
            sets it.

    References:
        Baumgarte, Stabilization of constraints and integrals of motion in dynamical systems (1972).
    """

    alpha: Any = None
    beta: Any = None
    fallback: Any = None

    def check(self) -> None:
        """Checks that gains are non-negative and finite. Traced gains are not checked.

        Raises:
            ValueError: a gain is out of range.
        """
        check_gains("Baumgarte", alpha=self.alpha, beta=self.beta)

    @classmethod
    def critical(cls, rate: Gain) -> Baumgarte:
        """Returns feedback with α = β = rate [1/s], the fastest decay without oscillation.

        Args:
            rate: a number, an array by row (n_c,), or a mapping by constraint name.
        """
        return cls(rate, rate)

    @classmethod
    def from_rate(cls, rate: Gain, damping_ratio: Scalar) -> Baumgarte:
        """Returns feedback with β = rate [1/s] and α = ζ β; ζ = 1 is critical damping.

        Args:
            rate: a number, an array by row (n_c,), or a mapping by constraint name.
            damping_ratio: ζ, a number or an array (n_c,). Errors oscillate for ζ < 1.
        """
        return cls(jax.tree.map(lambda x: damping_ratio * x, rate), rate)

    @property
    def is_default(self) -> bool:
        """True if no gain is given, so that the integrator chooses all gains."""
        return type(self) is Baumgarte and self.alpha is self.beta is self.fallback is None

    def rising(self, limit: Scalar) -> Baumgarte:
        """Returns `RisingBaumgarte(limit=limit)` if no gain is given; otherwise returns itself."""
        return RisingBaumgarte(limit=limit) if self.is_default else self

    def steady(self, gains: tuple[Scalar, Scalar]) -> Baumgarte:
        """Returns a copy with `fallback` = (α, β) [1/s] if no gain is given; otherwise itself."""
        return dataclasses.replace(self, fallback=gains) if self.is_default else self

    def resolve(self, gains: tuple[Scalar, Scalar]) -> Self:
        """Returns the stabilizer with each missing gain replaced by its default.

        The defaults are the field `fallback` if it is set, otherwise `gains`, (α, β) [1/s].
        """
        fallback = gains if self.fallback is None else self.fallback
        alpha = fallback[0] if self.alpha is None else self.alpha
        beta = fallback[1] if self.beta is None else self.beta
        return dataclasses.replace(self, alpha=alpha, beta=beta, fallback=fallback)

    def constraint_equations(self, rows: Rows, memory: PyTree, dt: Array) -> Rows:
        """Returns the rows with the target b = −γ − 2α φ̇ − β² φ, and the rounding error of b."""
        alpha, beta = self.gains(rows)
        noise = 64 * float(jnp.finfo(rows.bias.dtype).eps) * beta * beta
        b = -rows.bias - 2 * alpha * rows.rate - beta * beta * rows.residual
        return rows.with_target(b, noise)

    def gains(self, rows: Rows) -> tuple[Array, Array]:
        """Returns the gains α and β of each row, (n_c,) or (1,) [1/s]."""
        alpha = by_row(self.alpha, self.fallback[0], rows)
        return alpha, by_row(self.beta, self.fallback[1], rows)


@pytree
class RisingBaumgarte(Baumgarte):
    """Feedback with small default gains, which rise if constraints accelerate fast.

    The rounding error ε of φ [m] causes a spurious acceleration β² ε. The default β is therefore
    small for slow motions. It rises until the spurious acceleration is 5e-4 of Σ|γ_i| over the rows
    of the constraint, where γ is the part of φ̈ without accelerations. If a body turns at
    ω [rad/s], γ is ω² times the lever arm. If β were only a few times ω, errors of the steps would
    add up, and energy would drift by percents.

    Attributes:
        limit: the largest β [1/s].
    """

    limit: Any = None

    def gains(self, rows: Rows) -> tuple[Array, Array]:
        """Returns the gains α and β of each row, (n_c,) or (1,) [1/s]."""
        alpha, beta = super().gains(rows)
        square = SHARE / float(jnp.finfo(rows.bias.dtype).eps) * sums(abs(rows.bias), rows.layout)
        rises = square > beta * beta
        risen = jnp.sqrt(jnp.where(rises, square, beta * beta))
        risen = jnp.minimum(jnp.where(rises, risen, beta), by_row(self.limit, None, rows))
        return jnp.where(rises, risen / 2, alpha), risen


@pytree
class Wrapper(Stabilizer):
    """A stabilizer around an inner one, to which it forwards all methods that it does not override.

    `completes` is not forwarded. It presumes the target b = −γ, but a wrapper may choose another b.

    Attributes:
        inner_field: name of the field that has the inner stabilizer.
    """

    inner_field: ClassVar[str]

    @property
    def inner(self) -> Stabilizer:
        """The inner stabilizer, in the field named by `inner_field`."""
        return getattr(self, self.inner_field)

    def init(self, system: System, q: Array, v: Array) -> Any:
        """Returns the memory of the inner stabilizer at the start of a simulation."""
        return self.inner.init(system, q, v)

    def advance(self, rows: Rows, memory: Any, dt: Array) -> Any:
        """Returns the memory of the inner stabilizer after a step that began with these rows."""
        return self.inner.advance(rows, memory, dt)

    def remember(self, memory: Any, solution: Solution) -> Any:
        """Returns the memory of the inner stabilizer after a step with this solution."""
        return self.inner.remember(memory, solution)

    @property
    def remembers(self) -> bool:
        """True if this stabilizer or the inner one has a memory."""
        return type(self).init is not Wrapper.init or self.inner.remembers

    def solve(
        self, solver: Solver, rows: Rows, memory: Any, dt: Array, system: Saddle
    ) -> Solution | None:
        """Returns the solution by the inner stabilizer; None to use the solver of the method."""
        return self.inner.solve(solver, rows, memory, dt, system)

    @property
    def solves(self) -> bool:
        """True if this stabilizer or the inner one solves the saddle system by itself."""
        return type(self).solve is not Wrapper.solve or self.inner.solves

    def correct(
        self,
        system: System,
        solver: Solver,
        before: State,
        state: State,
        memory: Any,
        dt: Array,
    ) -> tuple[State, Array]:
        """Returns the state corrected by the inner stabilizer, and a status."""
        return self.inner.correct(system, solver, before, state, memory, dt)

    @property
    def reduces_errors(self) -> bool:
        """False if the inner stabilizer lets errors grow."""
        return self.inner.reduces_errors

    @property
    def corrects(self) -> tuple[str, ...]:
        """The levels that the inner stabilizer corrects: "position", "velocity", both or none."""
        return self.inner.corrects

    def resolve(self, gains: tuple[Scalar, Scalar]) -> Self:
        """Returns a copy whose inner stabilizer has (α, β) [1/s] in place of missing gains."""
        return self.with_inner(self.inner.resolve(gains))

    def rising(self, limit: Scalar) -> Self:
        """Returns a copy whose inner default gains may rise up to β = limit [1/s]."""
        return self.with_inner(self.inner.rising(limit))

    def steady(self, gains: tuple[Scalar, Scalar]) -> Self:
        """Returns a copy whose inner default gains are (α, β) [1/s] and do not rise."""
        return self.with_inner(self.inner.steady(gains))

    def cap_gains(self, stable_rate: Callable[[float], Scalar]) -> Self:
        """Returns a copy whose inner stabilizer has gains below the largest stable β.

        Args:
            stable_rate: function of the smallest damping ratio α/β of the gains; returns the
                largest stable β [1/s].
        """
        return self.with_inner(self.inner.cap_gains(stable_rate))

    def with_inner(self, inner: Stabilizer) -> Self:
        """Returns a copy with another inner stabilizer."""
        return dataclasses.replace(self, **{self.inner_field: inner})


def weakened(rows: Rows, factor: Array) -> Rows:
    """Returns the rows with φ scaled by r² and φ̇ by r: feedback then has the gains r α and r β.

    Args:
        rows: the linearized constraints, with φ, φ̇, J and γ.
        factor: r, the factor of the gains, (n_c,) or (1,).
    """
    residual, rate = factor * factor * rows.residual, factor * rows.rate
    return dataclasses.replace(rows, residual=residual, rate=rate)


def check_stabilizer(owner: str, what: str, part: Any) -> None:
    """Checks a stabilizer that is a field of another class.

    Args:
        owner: the name of the class with the field, for error messages.
        what: the name of the field.
        part: the value that the user gave.

    Raises:
        TypeError: the value is not a stabilizer.
        ValueError: a number of the stabilizer is out of range.
    """
    if isinstance(part, type) or not hasattr(part, "constraint_equations"):
        raise TypeError(f"{owner}: {what} must be a stabilizer like Baumgarte(), got {part!r}.")
    checks.derives(owner, what, part, Stabilizer)
    part.check()


def asks_nothing(stabilizer: Stabilizer) -> bool:
    """Returns True if a stabilizer has no gains, so that integrators like RATTLE accept it."""
    default = type(stabilizer) is Baumgarte and stabilizer.alpha is stabilizer.beta is None
    return default or type(stabilizer) is Unstabilized
