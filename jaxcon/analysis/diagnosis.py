"""The causes of constraint violation in a simulation, and suitable gains (chapter 3.5.1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis.report import Report, report
from jaxcon.builders.assembly import assemble
from jaxcon.constraints.rank import UnitRows, linearized
from jaxcon.constraints.rows import linearize
from jaxcon.core import checks
from jaxcon.core.status import MEANING, Status
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.execution.rollout import rollout
from jaxcon.execution.validation import controls_in
from jaxcon.methods.method import Method
from jaxcon.methods.stability import default_gains, instability, largest_stable_rate
from jaxcon.protocols import System
from jaxcon.readout.quantities import angular_momentum, energy, momentum
from jaxcon.step import StepInfo
from jaxcon.system.body_system import BodySystem
from jaxcon.system.state import State, checked_system

WEAK = 1e-2
"""The threshold on singular values of unit-length rows below which rows are nearly dependent."""

METHODS = {
    "initial": "disappears when the start is assembled first; use jc.assemble",
    "integration": "decreases when the step is halved; use a smaller step, or a projection",
    "round-off": "ε Σ |∂φ/∂q| |q|, the error of φ by rounding q; use float64",
    "conflict": "least-squares residual of φ, which no motion removes; see report",
    "rank": "φ in combinations of rows that hardly any motion changes; see report",
}
"""The measurement and the remedy of each cause of violation, by name of the cause."""


@dataclass(frozen=True)
class Diagnosis:
    """The causes of the constraint violation in a simulation; `print` it.

    Attributes:
        violation: the largest |φ| of the simulation.
        sources: the estimated violation from each cause, with the keys of `METHODS`. The estimates
            need not add up to `violation`.
        gains: default feedback gains (α, β) of the method at this step size [1/s].
        stable_rate: the largest stable α = β at this step size [1/s].
        energy: energy at the start and at the end [J].
        momentum: (linear, angular) momentum at the start and at the end; None for systems without
            bodies.
        report: report on the initial state.
        trouble: warnings: the meaning of a failure status at the end, and unstable gains.
    """

    violation: float
    sources: dict[str, float]
    gains: tuple[float, float]
    stable_rate: float
    energy: tuple[float, float]
    momentum: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] | None
    report: Report
    trouble: tuple[str, ...] = ()

    @property
    def main_source(self) -> str:
        """The key of the largest cause in `sources`; "unknown" if the simulation diverged."""
        if not all(np.isfinite(x) for x in (self.violation, *self.sources.values())):
            return "unknown"
        return max(self.sources, key=lambda name: self.sources[name])

    def __str__(self) -> str:
        lines = [*self.trouble]
        lines.append(f"violation up to {self.violation:.2e}, most of it from: {self.main_source}")
        lines += [f"  {name}: {x:.2e}, {METHODS[name]}" for name, x in self.sources.items()]
        lines.append(f"energy {self.energy[0]:.6g} J → {self.energy[1]:.6g} J")
        if self.momentum:
            (p, spin), (p_end, spin_end) = self.momentum
            lines.append(f"momentum {p} → {p_end} kg m/s, angular {spin} → {spin_end} kg m²/s")
        lines.append(
            f"gains at this step where none are given: α = {self.gains[0]:.4g},"
            f" β = {self.gains[1]:.4g} 1/s; given ones with α = β are stable up to"
            f" {self.stable_rate:.4g} 1/s"
        )
        return "\n".join([*lines, str(self.report)])


def diagnose(
    system: System,
    method: Method,
    state: State,
    controls: PyTree | Callable[[State], PyTree],
    dt: float,
    steps: int = 100,
) -> Diagnosis:
    """Simulates three times to separate the causes of constraint violation.

    The first run begins at the given state. The second begins at the assembled state, which
    satisfies the constraints. The third begins at the assembled state, too, but has half the step
    size. The difference of the first two runs shows the error of the initial state. The difference
    of the last two shows the integration error. Errors by round-off, conflicting rows and rank
    deficiency follow from the constraint rows at the end of the first run.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        method: integrator, stabilizer and solver.
        state: initial state of one world.
        controls: control inputs, as in `jc.rollout`.
        dt: step size h, () [s].
        steps: number of steps.

    Returns:
        A `jc.analysis.Diagnosis`.
    """
    checks.count("diagnose", "steps", steps)
    checks.check("diagnose", "dt", dt, (), above=0)
    assembled = assemble(system, state).state
    assembled = dataclasses.replace(assembled, status=state.status, memory=state.memory)
    finer = controls
    if controls is not None and not callable(controls):
        for leaf in jax.tree.leaves(controls):
            if not checks.is_discrete(leaf):
                checks.numbers("diagnose", "controls", leaf)
        controls = controls_in(state.q.dtype, controls)
        finer = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x), 2, axis=0), controls)
    end, φ_given = _simulate(system, method, state, controls, dt, steps)
    _, φ_assembled = _simulate(system, method, assembled, controls, dt, steps)
    _, φ_halved = _simulate(system, method, assembled, finer, dt / 2, 2 * steps, every=2)
    sources = {
        "initial": _largest(φ_given - φ_assembled),
        "integration": _largest(φ_assembled - φ_halved),
        "round-off": _rounding(system, end),
        **_lost(system, end),
    }
    gains = default_gains(method, jnp.asarray(dt, state.q.dtype))
    momenta = None
    if isinstance(system, BodySystem):
        momenta = _momenta(system, state), _momenta(system, end)
    code = Status(int(end.status))
    ended = f"{code.name} at {float(end.time):.4g} s: {MEANING[code]}" if code else None
    notes = ended, instability(method, float(dt), system, state)
    return Diagnosis(
        violation=_largest(φ_given),
        sources=sources,
        gains=(float(gains[0]), float(gains[1])),
        stable_rate=largest_stable_rate(method.integrator, float(dt)),
        energy=(float(energy(system, state).total), float(energy(system, end).total)),
        momentum=momenta,
        report=report(system, state),
        trouble=tuple(note for note in notes if note),
    )


def _simulate(
    system: System,
    method: Method,
    state: State,
    controls: PyTree | Callable[[State], PyTree],
    dt: Scalar,
    steps: int,
    every: int = 1,
) -> tuple[State, np.ndarray]:
    """Runs a rollout and records the constraint residual φ.

    Returns:
        The final state, and φ at the start and at each recorded step, (steps / every + 1, n_c).
    """
    policy = controls if callable(controls) else None
    arrays = None if policy else controls
    end, path = _run(policy, steps, every, system, method, state, arrays, dt)
    return end, np.asarray(path, np.float64)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _run(
    policy: Callable[[State], PyTree] | None,
    steps: int,
    every: int,
    system: System,
    method: Method,
    state: State,
    controls: PyTree,
    dt: Scalar,
) -> tuple[State, Array]:
    """Runs a rollout and records the constraint residual φ; compiled.

    Returns:
        The final state, and φ at the start and at each recorded step, (steps / every + 1, n_c).
    """

    def record(state: State, _: StepInfo | None = None) -> Array:
        return linearize(checked_system(system, state), state.q, state.v, state.instant).residual

    inputs = policy or controls
    end, path = rollout(system, method, state, inputs, dt, steps, record=record, every=every)
    return end, jnp.concatenate([record(state)[None], path])


def _largest(path: np.ndarray) -> float:
    """Returns the largest absolute value of an array; 0 if it is empty."""
    return float(np.max(np.abs(path), initial=0))


def _rounding(system: System, state: State) -> float:
    """Returns the largest error of φ due to rounding of q: ε max_i Σ_j |∂φ_i/∂q_j| |q_j|."""

    def residual(q: Array) -> Array:
        return linearize(checked_system(system, state), q, state.v, state.instant).residual

    slope = np.asarray(jax.jit(jax.jacfwd(residual))(state.q), np.float64)
    return _largest(np.abs(slope) @ np.abs(state.q)) * float(jnp.finfo(state.q.dtype).eps)


def _lost(system: System, state: State) -> dict[str, float]:
    """Returns the largest violations due to conflicting rows and to nearly dependent rows.

    φ is split by the singular values of the unit-length rows of J.

    Returns:
        "conflict": the largest part of φ at zero singular values, which no displacement changes.
        "rank": the largest part of φ at small nonzero singular values, up to `WEAK`. Only large
            displacements change it.
    """
    rows, jacobian, mass = linearized(checked_system(system, state), state)
    unit = UnitRows(rows.layout, jacobian, mass)
    return {
        "conflict": _largest(unit.within(rows.residual, -1.0, unit.tolerance)),
        "rank": _largest(unit.within(rows.residual, unit.tolerance, WEAK)),
    }


def _momenta(system: BodySystem, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Returns the total linear momentum and the total angular momentum of all bodies."""
    return np.asarray(momentum(system, state)), np.asarray(angular_momentum(system, state))
