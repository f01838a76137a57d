"""Soft, fed back or projected, by the size of the violation (chapter 3.5.2)."""

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
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import State
from jaxcon.solvers.saddle import Solution
from jaxcon.stabilization.baumgarte import Baumgarte, Law, Unstabilized, check_stabilizer
from jaxcon.stabilization.gains import column, squares


@exportable
class Parts(NamedTuple):
    """One thing for each range of violations; memories of nothing are ()."""

    small: PyTree = ()
    middle: PyTree = ()
    large: PyTree = ()


GENTLE = 50.0
"""The largest of default gains beside springs [1/s]."""


@pytree
class Hybrid(Unstabilized):
    """Springs where the violation is small, feedback in the middle, projection where it is large.

    Every constraint has its own weight, by ‖φ‖ over its rows, smooth in ln ‖φ‖ and at ‖φ‖ = 0:

        soft   w = 1/(1 + (‖φ‖/soft_below)^2n)      J a + (w C₁ + (1 − w) C₂) λ = w b₁ + (1 − w) b₂
        large  w = 1 − 1/(1 + (Φ/project_above)^2n)   q ⊕ w Δq,  v + w Δv

    with C₁, b₁ the soft law, C₂, b₂ the feedback, Δ the correction after the step, and Φ the norm
    of all φ, since a projection moves everything. At the two sizes the weights are ½, and at ten
    times a size the other side has 10⁻²ⁿ. Nothing switches, so gradients exist everywhere; between
    the ranges the law is the mixture and neither of the two. Rows of velocities, which have no φ,
    follow the middle. A projection that fails ends its world whatever its weight; one of a single
    iteration only where its solver does.

    Attributes:
        small: stabiliser whose law is that of small violations, an implicit `Penalty`.
        middle: stabiliser of the middle; default gains are held to 50/s.
        large: stabiliser whose `correct` large violations get, or None.
        soft_below: ‖φ‖ up to which constraints are soft.
        project_above: Φ from which the state is projected.
        sharpness: n.
    """

    small: Any
    middle: Any = Baumgarte()
    large: Any = None
    soft_below: Any = 1e-6
    project_above: Any = 1e-2
    sharpness: int = static(default=2)

    def check(self) -> None:
        """Checks the parts and the sizes.

        Raises:
            TypeError: a part is no stabiliser, or a size no number.
            ValueError: a size is not positive, the two are the wrong way round, the sharpness is no
                positive integer, `large` corrects nothing, or `small` acts by a force or a solver
                of its own, which cannot be mixed.
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
        self._check_parts()

    def _check_parts(self) -> None:
        """Checks that laws are where laws belong, and what corrects is where that belongs."""
        for what, part in self._parts()._asdict().items():
            check_stabilizer("Hybrid", what, part)
            if bool(part.corrects) == (what == "large" and self.large is not None):
                continue
            if what == "large":
                reason = "corrects nothing after a step; take a Projection, or None"
            else:
                reason = "corrects after a step, as only large does; take feedback or springs"
            raise ValueError(f"Hybrid: {what}={type(part).__name__} {reason}.")

    def _parts(self) -> Parts:
        return Parts(self.small, self.middle, Unstabilized() if self.large is None else self.large)

    def _map(self, function: Callable[..., Any], *memories: Any) -> Parts:
        return Parts(*map(function, self._parts(), *memories))

    def init(self, system: Any, q: Array, v: Array) -> PyTree:
        """The memories of the parts."""
        return self._map(lambda part: part.init(system, q, v))

    def resolve(self, gains: tuple[Any, Any]) -> Hybrid:
        """Returns the stabilizer with parts that have all their gains, default ones held to 50/s.

        Gains that remove an error in one step do so by a velocity, which springs that take over
        where φ is small would only turn round.
        """
        gains = jnp.minimum(gains[0], GENTLE), jnp.minimum(gains[1], GENTLE)
        small, middle, large = self._map(lambda part: part.resolve(gains))
        large = None if self.large is None else large
        return dataclasses.replace(self, small=small, middle=middle, large=large)

    def bounded(self, stable_rate: Callable[[float], Any]) -> Hybrid:
        """Returns the stabilizer with parts that know their limits."""
        small, middle, large = self._map(lambda part: part.bounded(stable_rate))
        large = None if self.large is None else large
        return dataclasses.replace(self, small=small, middle=middle, large=large)

    def target(self, rows: Rows, memory: PyTree, dt: Any) -> Array:
        """b (n_c,)."""
        return self.impose(rows, memory, dt).target

    def impose(self, rows: Rows, memory: PyTree, dt: Any) -> Law:
        """The mixture of the soft law and the feedback."""
        memory = Parts(*memory)
        small = self.small.impose(rows, memory.small, dt)
        middle = self.middle.impose(rows, memory.middle, dt)
        if any(x is not None for law in (small, middle) for x in (law.force, law.solve)):
            raise ValueError(
                "Hybrid: small and middle must act by J a + C λ = b alone, to be mixed; take an"
                " implicit `Penalty`, and no `AugmentedLagrangian`."
            )
        size = finite_or_nan(jnp.asarray(self.soft_below, rows.bias.dtype))[None]
        w = 1 - self.beyond(squares(rows.residual / size, rows.layout))
        w = jnp.where(column(rows.layout.holonomic, rows), w, 0)
        target = w * small.target + (1 - w) * middle.target
        soft, stiff = (_compliance(law.rows) for law in (small, middle))
        mixed = dataclasses.replace(rows, compliance=w * soft + (1 - w) * stiff)
        return Law(mixed, target)

    def beyond(self, square: Array) -> Array:
        """x²ⁿ/(1 + x²ⁿ) from x², and beyond 1 the same as 1/(1 + x⁻²ⁿ), where x²ⁿ may overflow."""
        near = square <= 1
        power = jnp.where(near, square, 1 / jnp.where(near, 1, square)) ** self.sharpness
        return jnp.where(near, power, 1) / (1 + power)

    def advance(self, rows: Rows, memory: PyTree, dt: Any) -> Parts:
        """The memories of the parts after the step."""
        return self._map(lambda part, own: part.advance(rows, own, dt), Parts(*memory))

    def remember(self, memory: PyTree, solution: Solution) -> Parts:
        """The memories of the parts after what was solved."""
        return self._map(lambda part, own: part.remember(own, solution), Parts(*memory))

    @property
    def corrects(self) -> tuple[str, ...]:
        """What `large` moves after a step."""
        return self._parts().large.corrects

    @property
    def remembers(self) -> bool:
        """Returns True where one of the parts has a memory."""
        return any(part.remembers for part in self._parts())

    def correct(
        self, system: Any, solver: Any, before: State, state: State, memory: PyTree, dt: Any
    ) -> Any:
        """The state moved by the share w of the correction of `large`."""
        if self.large is None:
            return state, jnp.zeros_like(state.status)
        new, code = self.large.correct(system, solver, before, state, Parts(*memory).large, dt)
        residual = linearize(system, state.q, state.v, state.instant).residual
        size = finite_or_nan(jnp.asarray(self.project_above, residual.dtype))[None]
        w = self.beyond(jnp.sum((residual / size) ** 2, axis=0))[None]
        q = system.normalize(state.q + w * (new.q - state.q))
        return dataclasses.replace(new, q=q, v=state.v + w * (new.v - state.v)), code


def _compliance(rows: Rows) -> Array:
    return jnp.zeros_like(rows.bias) if rows.compliance is None else rows.compliance
