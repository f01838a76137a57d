"""Constraints held by springs and dampers instead of exactly (chapter 3.5.2)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import RowLayout, Rows
from jaxcon.core import checks
from jaxcon.core.numerics import safe_divide
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import State
from jaxcon.solvers.proximal import own_diagonal
from jaxcon.solvers.saddle import Solution
from jaxcon.stabilization.baumgarte import Baumgarte, Law, Unstabilized, check_stabilizer
from jaxcon.stabilization.gains import by_row, check_gains, column, named
from jaxcon.stabilization.projection import Projection


@pytree
class Penalty(Unstabilized):
    """λ = −k φ − d φ̇: a spring and a damper along each row.

    Implicit, they act as they will stand after a step h of semi-implicit Euler, φ⁺ = φ + h φ̇⁺:

        J a + C λ = b,    C = 1/s,    b = −γ − φ̇/h − k φ/s,    s = h (d + h k)

    which is stable along the row for every k and d, and for k → ∞ the hard constraint with an error
    that is gone after one step. s carries a floor of ε/A_ii, ε the precision and 1/A_ii the mass
    that the row feels: k = d = 0 leaves a free body but for a damper that takes the share ε of φ̇ in
    a step, and gradients by k and d are finite there and are those of the spring. Explicit, λ is a
    force at the start of the step, and so at each stage; with semi-implicit Euler it is stable for
    k < 4 m/h² only. λ is reported either way.

    Rows of velocities have φ = 0 and feel the damper alone. Rotors stay as they are.

    Attributes:
        stiffness: k [N/m], [N m/rad]: a number for all constraints, an array by row, or a mapping
            as of `Baumgarte`, and then only the constraints that it names are soft.
        damping: d [N s/m], [N m s/rad], in the same way; 0 where a mapping leaves one out.
        time: T [s] instead of a stiffness: k = m/T² at each instant. 1/m is A_ii, and for the
            components of one vector, such as the three of a meeting point, the mean of theirs, so
            that no direction of the world is preferred. The rows of a user's function stay alone.
        damping_ratio: ζ of d = 2 ζ m/T.
        others: stabiliser of the constraints that stay hard.
        implicit: whether λ is that after the step.
    """

    stiffness: Any = None
    damping: Any = 0.0
    time: Any = None
    damping_ratio: Any = 1.0
    others: Any = Baumgarte()
    implicit: bool = static(default=True)

    @classmethod
    def from_time(
        cls, time: Any, damping_ratio: Any = 1.0, others: Any = None, implicit: bool = True
    ) -> Penalty:
        """A spring that has frequency 1/T and damping ratio ζ along its row alone.

        Of a vector, such as the three rows of a meeting point, that holds on the mean over its
        directions: all have one stiffness, whichever way the world frame is turned.

        Args:
            time: T [s], a number, array by row or mapping by constraint.
            damping_ratio: ζ, in the same way.
            others: stabiliser of the constraints that stay hard; `Baumgarte()` unless given.
            implicit: as of the class.
        """
        others = Baumgarte() if others is None else others
        return cls(time=time, damping_ratio=damping_ratio, others=others, implicit=implicit)

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            TypeError: `others` is no stabiliser.
            ValueError: one is negative or no number, there is no or more than one of stiffness and
                time, or the others are projected.
        """
        if (self.stiffness is None) == (self.time is None):
            raise ValueError("Penalty: give a stiffness, or a time by `Penalty.from_time`.")
        checks.flag("Penalty", "implicit", self.implicit)
        check_gains("Penalty", stiffness=self.stiffness)
        check_gains("Penalty", optional=False, damping=self.damping)
        check_gains("Penalty", optional=False, damping_ratio=self.damping_ratio)
        check_gains("Penalty", strictly=True, time=self.time)
        if isinstance(self.others, Projection):
            raise ValueError(
                "Penalty: others=Projection() would project the soft constraints, too, and no"
                " spring would be left; take feedback for those that stay hard."
            )
        check_stabilizer("Penalty", "others", self.others)

    def init(self, system: Any, q: Array, v: Array) -> PyTree:
        """Returns the memory of the stabilizer of the other rows."""
        return self.others.init(system, q, v)

    def resolve(self, gains: tuple[Any, Any]) -> Penalty:
        """Returns the penalty with the gains of the other rows resolved."""
        return dataclasses.replace(self, others=self.others.resolve(gains))

    def bounded(self, stable_rate: Callable[[float], Any]) -> Penalty:
        """Returns the penalty with the gains of the other rows bounded."""
        return dataclasses.replace(self, others=self.others.bounded(stable_rate))

    def target(self, rows: Rows, memory: PyTree, dt: Any) -> Array:
        """b (n_c,)."""
        return self.impose(rows, memory, dt).target

    def impose(self, rows: Rows, memory: PyTree, dt: Any) -> Law:
        """The rows, some of them soft."""
        hard = self.others.impose(rows, memory, dt)
        soft = self.soft(rows.layout)
        if not soft.any():
            return hard
        law = self._implicit if self.implicit else self._explicit
        return law(rows, hard, soft, dt)

    def soft(self, layout: RowLayout) -> np.ndarray:
        """Which rows are soft, (n_c,).

        Raises:
            ValueError: a name or pattern is unknown, or a damping is given for a hard constraint.
        """
        main, second = self._given()
        soft = named(main, layout, "Penalty")
        if isinstance(second, Mapping) and np.any(named(second, layout, "Penalty") & ~soft):
            raise ValueError(
                f"Penalty: damping is given for {sorted(second)}, but only {sorted(main)} are soft;"
                " name each in both."
            )
        return soft

    def _given(self) -> tuple[Any, Any]:
        if self.time is None:
            return self.stiffness, self.damping
        return self.time, self.damping_ratio

    def constants(self, rows: Rows) -> tuple[Array, Array]:
        """k and d by row, (n_c,), of no meaning where a row is hard."""
        main, second = self._given()
        if self.time is None:
            k, d = by_row(main, 0.0, rows, "Penalty"), by_row(second, 0.0, rows, "Penalty")
        else:
            time = by_row(main, 1.0, rows, "Penalty")
            m = 1 / rows.layout.isotropic(felt(rows))
            k = m / (time * time)
            d = 2 * by_row(second, 1.0, rows, "Penalty") * m / time
        return jnp.where(column(rows.layout.holonomic, rows), k, 0), d

    def _implicit(self, rows: Rows, hard: Law, soft: np.ndarray, dt: Any) -> Law:
        k, d = self.constants(rows)
        h, chosen = dt[None], column(soft, rows)
        compliance = yielding(h * (d + h * k), rows)
        target = -rows.bias - safe_divide(rows.rate, h) - k * rows.residual * compliance
        known = hard.rows.compliance
        rest = jnp.zeros_like(compliance) if known is None else known
        rows = dataclasses.replace(hard.rows, compliance=jnp.where(chosen, compliance, rest))
        return hard._replace(rows=rows, target=jnp.where(chosen, target, hard.target))

    def _explicit(self, rows: Rows, hard: Law, soft: np.ndarray, dt: Any) -> Law:
        k, d = self.constants(rows)
        chosen = column(soft, rows)
        multipliers = jnp.where(chosen, -k * rows.residual - d * rows.rate, 0)
        force = rows.jacobian.transpose(multipliers)
        force = force if hard.force is None else force + hard.force
        target = jnp.where(chosen, multipliers, hard.target)
        return hard._replace(rows=hard.rows.only(~soft), target=target, force=force)

    def advance(self, rows: Rows, memory: PyTree, dt: Any) -> PyTree:
        """The memory of the others."""
        return self.others.advance(rows, memory, dt)

    def remember(self, memory: PyTree, solution: Solution) -> PyTree:
        """The memory of the others."""
        return self.others.remember(memory, solution)

    @property
    def corrects(self) -> tuple[str, ...]:
        """What the others move after a step."""
        return self.others.corrects

    @property
    def remembers(self) -> bool:
        """Returns True where the others have a memory."""
        return self.others.remembers

    def correct(
        self, system: Any, solver: Any, before: State, state: State, memory: PyTree, dt: Any
    ) -> Any:
        """As the others are corrected."""
        return self.others.correct(system, solver, before, state, memory, dt)


def felt(rows: Rows) -> Array:
    """A_ii = (J M⁻¹ Jᵀ)_ii by row, (n_c,), but not 0, which a row that moves nothing has."""
    own = own_diagonal(mass_of(rows), rows.jacobian, rows.bias.ndim - 1)
    return jnp.where(own > 0, own, 1)


def mass_of(rows: Rows) -> Any:
    """M of the rows.

    Raises:
        TypeError: they do not carry it.
    """
    if rows.mass is None:
        raise TypeError("these rows carry no mass matrix; a step gives it by `Dynamics`.")
    return rows.mass


def yielding(inertia: Array, rows: Rows) -> Array:
    """C = 1/s with s = s₀ + ε/A_ii, written as A_ii/(s₀ A_ii + ε), (n_c,); A_ii held constant.

    Args:
        inertia: s₀ (n_c,) [kg].
        rows: the constraints.
    """
    own = jax.lax.stop_gradient(felt(rows))
    return own / (inertia * own + jnp.finfo(own.dtype).eps)
