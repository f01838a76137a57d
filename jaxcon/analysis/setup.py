"""A scene with its state and a method, and lazily computed quantities for reports. Host code."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis.estimate import Cost, cost
from jaxcon.analysis.motion import StepAngle, step_angle
from jaxcon.analysis.probe import Probe, begun, probe
from jaxcon.constraints.rank import UnitRows, dependent_rows, linearized
from jaxcon.constraints.rows import Rows
from jaxcon.core import checks, host
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.execution.validation import checked_control, idle
from jaxcon.methods.choice import Choice, choose
from jaxcon.methods.method import Method, check_method
from jaxcon.methods.stability import default_gains, parts
from jaxcon.protocols import System
from jaxcon.system.body_system import BodySystem
from jaxcon.system.state import State, checked_system

ASIDE = 0.05
"""The largest entry of the displacement to a nearby state [m, rad].

The rank of J at the given state is compared with the rank at this nearby state.
"""
NEWTON = 20
"""The largest number of Newton iterations to satisfy the constraints at a displaced state."""


@dataclass(frozen=True)
class Setup:
    """A scene at a state, with a method, and quantities derived from them.

    Attributes:
        system: the system, as `checked_system` returns it for the state.
        state: state of one world.
        method: the method that steps the scene.
        dt: step size h [s]; None if not given.
        control: control input of a step, or None.
        batch: number of worlds stepped together.
        rows: the linearized constraint rows.
        mass: M, (n_v, n_v).
        jacobian: J, (n_c, n_v).
        measured: True if steps may be compiled and run.
    """

    system: System
    state: State
    method: Method
    dt: float | None
    control: PyTree
    batch: int
    rows: Rows
    mass: np.ndarray
    jacobian: np.ndarray
    measured: bool = True

    @classmethod
    def of(
        cls,
        system: System,
        state: State,
        method: Method | None = None,
        dt: Scalar | None = None,
        control: PyTree = None,
        batch: int = 1,
        measured: bool = True,
    ) -> Setup:
        """Returns the `Setup` of a user's arguments, which are checked first.

        The constraints are linearized at the state. Without a method, the default `Method` is used.
        """
        system = checked_system(system, state, "jc.report(system, s)")
        if dt is not None:
            checks.check("report", "dt", dt, (), above=0)
        has_method = method is not None or dt is not None
        method = Method() if method is None else method
        check_method(method)
        method = method.resolve(system, state)
        if has_method:
            state = begun(system, method, state)
        rows, jacobian, mass = linearized(system, state)
        h = None if dt is None else float(dt)
        control = checked_control("report", system, idle(system, control), state.q.dtype)
        for leaf in jax.tree.leaves(control):
            if not checks.is_discrete(leaf):
                checks.check("report", "control", leaf)
        return cls(system, state, method, h, control, batch, rows, mass, jacobian, measured)

    @cached_property
    def unit(self) -> UnitRows:
        """The rows of the constraint Jacobian, scaled to unit length in the metric of M⁻¹."""
        return UnitRows(self.rows.layout, self.jacobian, self.mass)

    @cached_property
    def even(self) -> UnitRows:
        """The unit-length rows for another mass matrix, in which every body has mass 1.

        Radii of gyration stay the same, so moments of inertia are divided by the mass of the body.
        A comparison with `unit` shows the effect of mass ratios. For systems without bodies, both
        are equal.
        """
        if not isinstance(self.system, BodySystem):
            return self.unit
        groups = tuple(
            dataclasses.replace(
                p,
                mass=jnp.ones_like(p.mass),
                moments=jax.tree.map(lambda x, m=p.mass: x / m, p.moments),
            )
            for p in self.system.inertia
        )
        even = dataclasses.replace(self.system, inertia=groups)
        mass = host.evaluate(_mass, even, self.state.q)
        return UnitRows(self.rows.layout, self.jacobian, mass)

    @cached_property
    def dependent(self) -> list[int]:
        """Indices of the unit-length rows that depend linearly on rows before them."""
        return dependent_rows(self.unit.values, self.unit.tolerance)

    @cached_property
    def conflicts(self) -> dict[str, tuple[float, float, float]]:
        """Nonzero least-squares residuals of φ, φ̇ and γ, by constraint.

        A nonzero residual means that no displacement, velocity or acceleration satisfies all rows.
        """
        rows = self.rows
        φ, rate, bias = (self.unit.contradicting(x) for x in (rows.residual, rows.rate, rows.bias))
        return {
            name: (φ.get(name, 0.0), rate.get(name, 0.0), bias.get(name, 0.0))
            for name in rows.layout.names
            if name in φ or name in rate or name in bias
        }

    @cached_property
    def choice(self) -> Choice:
        """The solver that `jc.Method.auto` chooses for this scene, with the reasons."""
        return choose(self.system, self.state, self.batch, dependent=len(self.dependent))

    @cached_property
    def cost(self) -> Cost:
        """The estimated number of operations to compute the accelerations with the method."""
        return cost(self.system, self.method, self.state, self.choice)

    @cached_property
    def angle(self) -> StepAngle | None:
        """The angles of the fastest motions in one step; None without a step size."""
        return step_angle(self)

    @cached_property
    def probe(self) -> Probe | None:
        """The violation after some steps; None without a step size or if `measured` is False."""
        if self.dt is None or not self.measured:
            return None
        return probe(self.system, self.method, self.state, self.control, self.dt)

    @cached_property
    def violation(self) -> dict[str, tuple[float, float]]:
        """The violation (‖φ‖, ‖φ̇‖) by constraint; for a velocity constraint ψ = 0, both are ‖ψ‖."""
        layout, violation = self.rows.layout, {}
        φ, rate = (np.asarray(x, np.float64) for x in (self.rows.residual, self.rows.rate))
        for name in layout.names:
            fast = float(np.linalg.norm(rate[layout.rows(name)]))
            size = float(np.linalg.norm(φ[layout.rows(name)]))
            violation[name] = (fast if name in layout.velocity_level else size, fast)
        return violation

    @cached_property
    def passing(self) -> bool:
        """True at a singular position, where more rows are dependent than at a nearby position."""
        _, s, vt = self.unit.svd
        free = vt[int(np.sum(s > self.unit.tolerance)) :]
        if not self.dependent or not len(free):
            return False
        # a random direction in the null space of J stands for a generic motion
        along = self.velocities(np.random.default_rng(0).normal(size=len(free)) @ free)
        beside = self._closed(self.moved(ASIDE * along / np.max(np.abs(along))))
        if beside is None:
            return False
        return len(dependent_rows(beside.values, beside.tolerance)) < len(self.dependent)

    def _closed(self, state: State) -> UnitRows | None:
        """Moves a state onto the constraints, and returns the unit-length rows at that position.

        Uses Newton's method with the shortest steps in the metric of M. The result is None if the
        method does not converge.
        """
        for _ in range(NEWTON):
            rows, jacobian, mass = linearized(self.system, state)
            unit = UnitRows(rows.layout, jacobian, mass)
            open_by = np.asarray(rows.residual, np.float64)[unit.numbers] / unit.length
            if np.max(np.abs(open_by), initial=0) < unit.tolerance:
                return unit
            x = np.linalg.lstsq(unit.values, -open_by, rcond=unit.tolerance)[0]
            factor = np.linalg.cholesky(np.asarray(mass, np.float64))
            state = self._displaced(state, np.linalg.solve(factor.T, x))
        return None

    def velocities(self, x: np.ndarray) -> np.ndarray:
        """Returns the displacement Δ = L⁻ᵀ x, (n_v,). L is the Cholesky factor of M = L Lᵀ.

        Args:
            x: coordinates in which the metric of M is the identity, (n_v,).
        """
        return np.linalg.solve(np.linalg.cholesky(np.asarray(self.mass, np.float64)).T, x)

    def moved(self, step: np.ndarray) -> State:
        """Returns the state with its position q displaced to q ⊕ Δ, by `System.retract`.

        Args:
            step: displacement Δ, (n_v,).
        """
        return self._displaced(self.state, step)

    def _displaced(self, state: State, step: np.ndarray) -> State:
        """Returns a given state with its position q displaced to q ⊕ Δ, by `System.retract`.

        Args:
            state: the state to displace.
            step: displacement Δ, (n_v,).
        """
        move = np.asarray(step, state.q.dtype)
        return dataclasses.replace(state, q=host.evaluate(_retract, self.system, state.q, move))


def _mass(system: System, q: Array) -> Array:
    """Returns the mass matrix M, (n_v, n_v)."""
    return system.mass(q).dense()


def _retract(system: System, q: Array, step: Array) -> Array:
    """Returns the displaced position q ⊕ Δ, (n_q,); `step` is Δ (n_v,)."""
    return system.retract(q, step)


def asked_gains(method: Method, dt: float) -> tuple[float, float]:
    """Returns the scalar gains (α, β) of the method's feedback [1/s].

    If the stabilizer consists of several parts, the first part with scalar gains counts. If no part
    has scalar gains, returns the default gains.
    """
    for part in parts(method.stabilizer_for(jnp.asarray(dt))):
        pair = [getattr(part, name, None) for name in ("alpha", "beta")]
        if all(x is not None and not isinstance(x, dict) and np.ndim(x) == 0 for x in pair):
            return float(pair[0]), float(pair[1])  # type: ignore[arg-type]
    α, β = default_gains(method, jnp.asarray(dt))
    return float(α), float(β)
