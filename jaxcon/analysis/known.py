"""What is known of a scene and a method before it is judged. Host code."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis.estimate import Cost, cost
from jaxcon.analysis.motion import StepAngle, step_angle
from jaxcon.analysis.probe import Probe, begun, probe
from jaxcon.constraints.rows import Rows
from jaxcon.core import checks, host
from jaxcon.core.typing import Array, PyTree
from jaxcon.dynamics.rank import UnitRows, dependent_rows, linearized
from jaxcon.model.state import State, at
from jaxcon.simulation.choice import Choice, choose
from jaxcon.simulation.method import Method, check_method
from jaxcon.simulation.stability import default_gains, parts
from jaxcon.simulation.step import idle

ASIDE = 0.05
"""How far a configuration is moved to see whether rows depend on each other there, too."""
NEWTON = 20
"""The most iterations by which such a configuration is closed."""


@dataclass(frozen=True)
class Known:
    """A scene at a state, and a method on it.

    Attributes:
        system: as its state remembers it.
        state: of one world.
        method: by which it is to be stepped.
        dt: h [s]; None where it is not known.
        control: of a step, or None.
        batch: worlds that are to be stepped together.
        rows: linearized.
        mass: M, (n_v, n_v).
        jacobian: J, (n_c, n_v).
        measured: whether steps may be compiled and run to see what they do.
    """

    system: Any
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
        system: Any,
        state: State,
        method: Method | None = None,
        dt: Any = None,
        control: PyTree = None,
        batch: int = 1,
        measured: bool = True,
    ) -> Known:
        """Returns what is known of the system, state, method and step that a user gives."""
        system = at(system, state, "jc.report(system, s)")
        if dt is not None:
            checks.check("report", "dt", dt, (), above=0)
        own = Method() if method is None else method
        check_method(own)
        own = own.resolve(system, state)
        if method is not None or dt is not None:
            state = begun(system, own, state)
        rows, jacobian, mass = linearized(system, state)
        h = None if dt is None else float(dt)
        control = idle(system, control)
        return cls(system, state, own, h, control, batch, rows, mass, jacobian, measured)

    @cached_property
    def unit(self) -> UnitRows:
        """The rows at unit length."""
        return UnitRows(self.rows.layout, self.jacobian, self.mass)

    @cached_property
    def even(self) -> UnitRows:
        """The rows as they would be if all bodies had one mass and kept their radii of gyration."""
        if not hasattr(self.system, "inertia"):
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
        """Numbers of the unit rows that depend on those before them."""
        return dependent_rows(self.unit.values, self.unit.tolerance)

    @cached_property
    def conflicts(self) -> dict[str, tuple[float, float, float]]:
        """What least squares leave of φ, φ̇ and γ, of the constraints where they leave any."""
        rows = self.rows
        left = [self.unit.contradicting(x) for x in (rows.residual, rows.rate, rows.bias)]
        return {
            name: (left[0].get(name, 0.0), left[1].get(name, 0.0), left[2].get(name, 0.0))
            for name in rows.layout.names
            if any(name in part for part in left)
        }

    @cached_property
    def choice(self) -> Choice:
        """The solver that `Method.auto` takes."""
        return choose(self.system, self.state, self.batch, dependent=len(self.dependent))

    @cached_property
    def cost(self) -> Cost:
        """The operations of the accelerations under the method, estimated from the structure."""
        return cost(self.system, self.method, self.state, self.choice)

    @cached_property
    def angle(self) -> StepAngle | None:
        """The angles of the fastest motions in a step; None where no step is known."""
        return step_angle(self)

    @cached_property
    def probe(self) -> Probe | None:
        """The violation that some steps leave; None where no step is known or may be run."""
        if self.dt is None or not self.measured:
            return None
        return probe(self.system, self.method, self.state, self.control, self.dt)

    @cached_property
    def violation(self) -> dict[str, tuple[float, float]]:
        """‖φ‖ and ‖φ̇‖ by constraint; ‖ψ‖ twice where it holds velocities alone."""
        layout, found = self.rows.layout, {}
        φ, rate = (np.asarray(x, np.float64) for x in (self.rows.residual, self.rows.rate))
        for name in layout.names:
            fast = float(np.linalg.norm(rate[layout.rows(name)]))
            size = float(np.linalg.norm(φ[layout.rows(name)]))
            found[name] = (fast if name in layout.velocity_level else size, fast)
        return found

    @cached_property
    def passing(self) -> bool:
        """True where fewer rows depend on each other beside this position, which can be left."""
        _, s, vt = self.unit.svd
        free = vt[int(np.sum(s > self.unit.tolerance)) :]
        if not self.dependent or not len(free):
            return False
        along = self.velocities(np.random.default_rng(0).normal(size=len(free)) @ free)
        beside = self._closed(self.moved(ASIDE * along / np.max(np.abs(along))))
        if beside is None:
            return False
        return len(dependent_rows(beside.values, beside.tolerance)) < len(self.dependent)

    def _closed(self, state: State) -> UnitRows | None:
        """The unit rows at the position that closes all constraints near a state.

        Newton's method, each step the least in the metric of M; None where it does not converge.
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
        """A displacement (n_v,) from one in the metric in which rows have unit length."""
        return np.linalg.solve(np.linalg.cholesky(np.asarray(self.mass, np.float64)).T, x)

    def moved(self, step: np.ndarray) -> State:
        """The state at q ⊕ Δ, Δ (n_v,)."""
        return self._displaced(self.state, step)

    def _displaced(self, state: State, step: np.ndarray) -> State:
        move = np.asarray(step, state.q.dtype)
        return dataclasses.replace(state, q=host.evaluate(_retract, self.system, state.q, move))


def _mass(system: Any, q: Array) -> Array:
    return system.mass(q).dense()


def _retract(system: Any, q: Array, step: Array) -> Array:
    return system.retract(q, step)


def asked_gains(method: Method, dt: float) -> tuple[float, float]:
    """(α, β) of the first feedback that has numbers for all rows, or of those without gains."""
    for part in parts(method.feedback(jnp.asarray(dt))):
        pair = [getattr(part, name, None) for name in ("alpha", "beta")]
        if all(x is not None and not isinstance(x, dict) and np.ndim(x) == 0 for x in pair):
            return float(pair[0]), float(pair[1])  # type: ignore[arg-type]
    α, β = default_gains(method, jnp.asarray(dt))
    return float(α), float(β)
