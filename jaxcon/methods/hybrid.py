"""Stabilizers combined by the size of the violation: soft, feedback, projection (chapter 3.5.2)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core import checks
from jaxcon.core.numerics import finite_or_nan
from jaxcon.core.pytree import exportable, pytree, static
from jaxcon.core.typing import Array, Scalar
from jaxcon.linear.saddle import Solution
from jaxcon.methods.baumgarte import Baumgarte, Unstabilized, check_stabilizer
from jaxcon.methods.gains import column, squares
from jaxcon.protocols import Solver, Stabilizer, System
from jaxcon.system.state import State


@exportable
class HybridMemory(NamedTuple):
    """The three stabilizers of a `Hybrid`, or their memories.

    Attributes:
        small, middle, large: the stabilizer for small, medium or large violations, or its memory;
            () for a stabilizer without memory.
    """

    small: Any = ()
    middle: Any = ()
    large: Any = ()


GENTLE = 50.0
"""The largest default gain of feedback combined with springs [1/s]."""


@pytree
class Hybrid(checks.Checked, Stabilizer):
    """Springs for small violations, feedback for medium ones, projection for large ones.

    Every constraint has its own weight w, a smooth function of the norm ‖φ‖ over its rows:

        soft   w = 1/(1 + (‖φ‖/soft_below)^2n)      J a + (w C₁ + (1 − w) C₂) λ = w b₁ + (1 − w) b₂
        large  w = 1 − 1/(1 + (Φ/project_above)^2n)   q ⊕ w Δq,  v + w Δv

    C₁ and b₁ belong to the soft law, C₂ and b₂ to the feedback. Δq and Δv are the correction after
    the step. Φ is the norm of φ over all rows of the system, since a projection moves all bodies.
    The weights are ½ at the thresholds `soft_below` and `project_above`. At ten times a threshold,
    the law that acts below it has the weight 10⁻²ⁿ. Laws are blended, never switched, so gradients
    exist everywhere. Velocity-level rows have no φ and follow `middle`. A failed projection stops
    its world, whatever the weight of the projection. A projection with a single iteration fails
    only if its solver fails.

    Attributes:
        small: the stabilizer for small violations, an implicit `Penalty`.
        middle: the stabilizer for medium violations; its default gains are at most 50/s.
        large: the stabilizer whose `correct` acts on large violations, or None.
        soft_below: threshold on ‖φ‖ below which constraints are soft.
        project_above: threshold on Φ above which the state is projected.
        sharpness: exponent n of the weights; a larger n makes the transitions steeper.
    """

    small: Any
    middle: Any = Baumgarte()
    large: Any = None
    soft_below: Any = 1e-6
    project_above: Any = 1e-2
    sharpness: int = static(default=2)

    def check(self) -> None:
        """Checks the three stabilizers, the two thresholds and the sharpness.

        Raises:
            TypeError: `small`, `middle` or `large` is not a stabilizer, or a threshold is not a
                number.
            ValueError: a threshold is not positive, soft_below exceeds project_above, or the
                sharpness is not a positive integer; `large` makes no correction after a step, or
                `small` or `middle` makes one.
        """
        sizes = self.soft_below, self.project_above
        for what, size in zip(("soft_below", "project_above"), sizes, strict=True):
            if size is None or isinstance(size, Mapping):
                raise TypeError(f"Hybrid: {what} must be one number, got {size!r}.")
            checks.check("Hybrid", what, size, (), above=0)
        if all(map(checks.is_concrete, sizes)) and np.any(np.greater(*sizes)):
            raise ValueError(
                f"Hybrid: soft_below={sizes[0]} must not exceed project_above={sizes[1]}; a"
                " constraint is soft below the one, and projected above the other."
            )
        checks.count("Hybrid", "sharpness", self.sharpness)
        for what, part in self._parts()._asdict().items():
            check_stabilizer("Hybrid", what, part)
            if bool(part.corrects) == (what == "large" and self.large is not None):
                continue
            reason = "corrects after a step, as only large does; take feedback or springs"
            if what == "large":
                reason = "corrects nothing after a step; take a Projection, or None"
            raise ValueError(f"Hybrid: {what}={type(part).__name__} {reason}.")

    def _parts(self) -> HybridMemory:
        """Returns the three stabilizers, with `Unstabilized()` in place of large=None."""
        return HybridMemory(
            self.small, self.middle, Unstabilized() if self.large is None else self.large
        )

    def _with_parts(self, function: Callable[[Stabilizer], Stabilizer]) -> Hybrid:
        """Returns the `Hybrid` with function(stabilizer) in place of each of its stabilizers."""
        small, middle, large = map(function, self._parts())
        large = None if self.large is None else large
        return dataclasses.replace(self, small=small, middle=middle, large=large)

    def resolve(self, gains: tuple[Scalar, Scalar]) -> Hybrid:
        """Returns a copy in which missing gains are replaced by (α, β), but by at most 50/s.

        Gains that remove an error in one step give the bodies a velocity. The springs, which act if
        φ is small, would only reverse that velocity.
        """
        alpha, beta = (jnp.minimum(jnp.asarray(x), GENTLE) for x in gains)
        return self._with_parts(lambda part: part.resolve((alpha, beta)))

    def cap_gains(self, stable_rate: Callable[[float], Scalar]) -> Hybrid:
        """Returns a copy in which all gains are below the largest stable β.

        Args:
            stable_rate: function of the smallest damping ratio α/β of a stabilizer's gains; returns
                the largest stable β [1/s].
        """
        return self._with_parts(lambda part: part.cap_gains(stable_rate))

    def constraint_equations(self, rows: Rows, memory: HybridMemory, dt: Array) -> Rows:
        """Returns the rows with the weighted means of b and C over `small` and `middle`.

        Raises:
            ValueError: `small` or `middle` applies a force, or has a `solve` method of its own.
        """
        memory = HybridMemory(*memory)
        small = self.small.constraint_equations(rows, memory.small, dt)
        middle = self.middle.constraint_equations(rows, memory.middle, dt)
        forced = small.force is not None or middle.force is not None
        if forced or self.small.solves or self.middle.solves:
            raise ValueError(
                "Hybrid: small and middle must act by J a + C λ = b alone, to be mixed; take an"
                " implicit `Penalty`, and no `AugmentedLagrangian`."
            )
        size = finite_or_nan(jnp.asarray(self.soft_below, rows.bias.dtype))[None]
        w = 1 - self.beyond(squares(rows.residual / size, rows.layout))
        w = jnp.where(column(rows.layout.holonomic, rows), w, 0)
        target = w * small.right_hand_side + (1 - w) * middle.right_hand_side
        none = jnp.zeros_like(rows.bias)
        soft, stiff = (none if x is None else x for x in (small.compliance, middle.compliance))
        mixed = dataclasses.replace(rows, compliance=w * soft + (1 - w) * stiff)
        return mixed.with_target(target)

    def beyond(self, square: Array) -> Array:
        """Returns the weight x²ⁿ/(1 + x²ⁿ) of a violation; `square` is x².

        x is the violation divided by its threshold. For x > 1 the weight is computed as
        1/(1 + x⁻²ⁿ), since x²ⁿ may overflow.
        """
        near = square <= 1
        power = jnp.where(near, square, 1 / jnp.where(near, 1, square)) ** self.sharpness
        return jnp.where(near, power, 1) / (1 + power)

    def init(self, system: System, q: Array, v: Array) -> HybridMemory:
        """Returns the memories of the three stabilizers at the start of a simulation."""
        return HybridMemory(*(part.init(system, q, v) for part in self._parts()))

    def advance(self, rows: Rows, memory: HybridMemory, dt: Array) -> HybridMemory:
        """Returns the memories of the three stabilizers after a step that began with these rows."""
        pairs = zip(self._parts(), HybridMemory(*memory), strict=True)
        return HybridMemory(*(part.advance(rows, part_memory, dt) for part, part_memory in pairs))

    def remember(self, memory: HybridMemory, solution: Solution) -> HybridMemory:
        """Returns the memories of the three stabilizers after a step with this solution."""
        pairs = zip(self._parts(), HybridMemory(*memory), strict=True)
        return HybridMemory(*(part.remember(part_memory, solution) for part, part_memory in pairs))

    @property
    def corrects(self) -> tuple[str, ...]:
        """The levels that `large` corrects: "position", "velocity", both or none."""
        return self._parts().large.corrects

    @property
    def remembers(self) -> bool:
        """True if one of the three stabilizers has a memory."""
        return any(part.remembers for part in self._parts())

    def correct(
        self,
        system: System,
        solver: Solver,
        before: State,
        state: State,
        memory: HybridMemory,
        dt: Array,
    ) -> tuple[State, Array]:
        """Returns the state moved by w times the correction of `large`, and a status.

        The weight w rises smoothly from 0 to 1 with the norm of φ. It is ½ at `project_above`.
        """
        if self.large is None:
            return state, jnp.zeros_like(state.status)
        new, code = self.large.correct(
            system, solver, before, state, HybridMemory(*memory).large, dt
        )
        residual = linearize(system, state.q, state.v, state.instant).residual
        size = finite_or_nan(jnp.asarray(self.project_above, residual.dtype))[None]
        w = self.beyond(jnp.sum((residual / size) ** 2, axis=0))[None]
        q = system.normalize(state.q + w * (new.q - state.q))
        return dataclasses.replace(new, q=q, v=state.v + w * (new.v - state.v)), code
