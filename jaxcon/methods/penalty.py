"""Constraints replaced by springs and dampers (chapter 3.5.2)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import RowLayout, Rows
from jaxcon.core import checks
from jaxcon.core.numerics import safe_divide
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, PyTree
from jaxcon.linear.proximal import own_diagonal
from jaxcon.methods.baumgarte import Baumgarte, Wrapper, check_stabilizer
from jaxcon.methods.gains import Gain, by_row, check_gains, column, named
from jaxcon.methods.projection import Projection
from jaxcon.protocols import Stabilizer


@pytree
class Penalty(checks.Checked, Wrapper):
    """A spring and a damper along each row in place of the exact constraint: λ = −k φ − d φ̇.

    Implicit springs use φ and φ̇ at the end of a step h of semi-implicit Euler, with φ⁺ = φ + h
    φ̇⁺:

        J a + C λ = b,    C = 1/s,    b = −γ − φ̇/h − k φ/s,    s = h (d + h k)

    A single row is stable for every k and d. For k → ∞ it is the rigid constraint, with an error
    that vanishes in one step. s is increased by ε/A_ii, where ε is the relative precision. 1/A_ii
    with A = J M⁻¹ Jᵀ is the effective mass of the row. With k = d = 0 a body is therefore free
    except for a damper that removes the fraction ε of φ̇ in a step. At k = d = 0, the gradients
    with respect to k and d are finite and equal those of the spring.

    Explicit springs apply λ as a force, computed from φ and φ̇ at the start of the step and at each
    stage. With semi-implicit Euler this is stable only for k < 4 m/h². Both kinds report λ.

    Velocity-level rows have φ = 0, so only the damper acts on them. Rotors do not change.

    Attributes:
        stiffness: stiffness k [N/m], [N m/rad]: a number for all constraints, an array by row, or a
            mapping by constraint as in `Baumgarte`. With a mapping, only the constraints it names
            are soft.
        damping: damping d [N s/m], [N m s/rad], in one of the same forms; 0 for constraints that
            are not in the mapping.
        time: time constant T [s], given in place of a stiffness: k = m/T² at each instant with 1/m
            = A_ii. For the components of one vector, such as the three rows of a ball joint, 1/m is
            the mean of their A_ii. This mean does not depend on the orientation of the axes. Each
            row of a user's function has its own m.
        damping_ratio: damping ratio ζ if a time constant is given, d = 2 ζ m/T.
        others: stabilizer of the constraints that remain rigid.
        implicit: True to use λ at the end of the step, False to use λ at its start.
    """

    stiffness: Any = None
    damping: Any = 0.0
    time: Any = None
    damping_ratio: Any = 1.0
    others: Any = Baumgarte()
    implicit: bool = static(default=True)
    inner_field: ClassVar[str] = "others"

    @classmethod
    def from_time(
        cls,
        time: Gain,
        damping_ratio: Gain = 1.0,
        others: Stabilizer | None = None,
        implicit: bool = True,
    ) -> Penalty:
        """Returns springs with a time constant T in place of a stiffness.

        Each row alone would oscillate with the angular frequency 1/T and the damping ratio ζ. The
        components of a vector, such as the three rows of a ball joint, share one stiffness. It is
        computed from the mean of their inverse effective masses, so it does not depend on the
        orientation of the world frame.

        Args:
            time: time constant T [s]: a number, an array by row or a mapping by constraint.
            damping_ratio: damping ratio ζ, in one of the same forms.
            others: stabilizer of the constraints that remain rigid; `Baumgarte()` if None.
            implicit: True to use λ at the end of the step, False to use λ at its start.
        """
        others = Baumgarte() if others is None else others
        return cls(time=time, damping_ratio=damping_ratio, others=others, implicit=implicit)

    def check(self) -> None:
        """Checks the constants of the springs, and the stabilizer `others`.

        Raises:
            TypeError: `others` is not a stabilizer.
            ValueError: a constant is negative or not a number, `others` is a projection, or not
                exactly one of stiffness and time is given.
        """
        if (self.stiffness is None) == (self.time is None):
            raise ValueError("Penalty: give a stiffness, or a time by `Penalty.from_time`.")
        checks.flag("Penalty", "implicit", self.implicit)
        check_gains("Penalty", stiffness=self.stiffness)
        check_gains("Penalty", optional=False, damping=self.damping)
        check_gains("Penalty", optional=False, damping_ratio=self.damping_ratio)
        check_gains("Penalty", {"above": 0}, time=self.time)
        if isinstance(self.others, Projection):
            raise ValueError(
                "Penalty: others=Projection() would project the soft constraints, too, and no"
                " spring would be left; take feedback for those that stay hard."
            )
        check_stabilizer("Penalty", "others", self.others)

    def constraint_equations(self, rows: Rows, memory: PyTree, dt: Array) -> Rows:
        """Returns the rows with the target b; soft rows also get a compliance or a force."""
        hard = self.others.constraint_equations(rows, memory, dt)
        soft = self.soft(rows.layout)
        if not soft.any():
            return hard
        (k, d), chosen = self.constants(rows), column(soft, rows)
        if not self.implicit:
            multipliers = jnp.where(chosen, -k * rows.residual - d * rows.rate, 0)
            force = rows.jacobian.transpose(multipliers)
            force = force if hard.force is None else force + hard.force
            target = jnp.where(chosen, multipliers, hard.right_hand_side)
            return dataclasses.replace(hard.only(~soft), target=target, force=force)
        # C = 1/s with s = s₀ + ε/A_ii is written A_ii/(s₀ A_ii + ε); A_ii has no derivative here
        h, weight = dt[None], jax.lax.stop_gradient(effective_inverse_mass(rows))
        compliance = weight / (h * (d + h * k) * weight + jnp.finfo(weight.dtype).eps)
        target = -rows.bias - safe_divide(rows.rate, h) - k * rows.residual * compliance
        stiff = jnp.zeros_like(compliance) if hard.compliance is None else hard.compliance
        compliance = jnp.where(chosen, compliance, stiff)
        target = jnp.where(chosen, target, hard.right_hand_side)
        return dataclasses.replace(hard, compliance=compliance, target=target)

    def soft(self, layout: RowLayout) -> np.ndarray:
        """Returns a mask of the soft rows, (n_c,).

        Raises:
            ValueError: a name or pattern is unknown, or a damping is given for a rigid constraint.
        """
        timed = self.time is not None
        main, second = (self.time, self.damping_ratio) if timed else (self.stiffness, self.damping)
        soft = named(main, layout, "Penalty")
        if isinstance(second, Mapping) and np.any(named(second, layout, "Penalty") & ~soft):
            raise ValueError(
                f"Penalty: damping is given for {sorted(second)}, but only {sorted(main)} are soft;"
                " name each in both."
            )
        return soft

    def constants(self, rows: Rows) -> tuple[Array, Array]:
        """Returns the stiffness k and damping d of each row, (n_c,); unused for rigid rows."""
        if self.time is None:
            k, d = (by_row(x, 0.0, rows, "Penalty") for x in (self.stiffness, self.damping))
        else:
            time = by_row(self.time, 1.0, rows, "Penalty")
            m = 1 / rows.layout.isotropic(effective_inverse_mass(rows))
            k = m / (time * time)
            d = 2 * by_row(self.damping_ratio, 1.0, rows, "Penalty") * m / time
        return jnp.where(column(rows.layout.holonomic, rows), k, 0), d


def effective_inverse_mass(rows: Rows) -> Array:
    """Returns A_ii = (J M⁻¹ Jᵀ)_ii of each row, (n_c,); 1 for a row with A_ii = 0.

    Raises:
        TypeError: the rows have no mass matrix.
    """
    if rows.mass is None:
        raise TypeError("these rows carry no mass matrix; a step gives it by `Dynamics`.")
    diagonal = own_diagonal(rows.mass, rows.jacobian, rows.bias.ndim - 1)
    return jnp.where(diagonal > 0, diagonal, 1)
