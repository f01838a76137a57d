"""Where the violation of a simulation comes from, and which gains suit it (chapter 3.5.1)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis.quantities import angular_momentum, energy, momentum
from jaxcon.analysis.report import Report, report
from jaxcon.constraints.rows import linearize
from jaxcon.core import checks
from jaxcon.core.status import MEANING, Status
from jaxcon.core.typing import Array
from jaxcon.dynamics.assembly import assemble
from jaxcon.dynamics.rank import UnitRows, linearized
from jaxcon.model.state import State, at
from jaxcon.simulation.method import Method
from jaxcon.simulation.rollout import rollout
from jaxcon.simulation.stability import default_gains, instability, largest_stable_rate
from jaxcon.simulation.step import controls_in

WEAK = 1e-2
"""Singular values of the rows, scaled to unit length, below which a direction is nearly lost."""

METHODS = {
    "initial": "what is gone when the start is assembled first; take jc.assemble",
    "integration": "what is gone when the step is halved; take a smaller one, or a projection",
    "round-off": "ε Σ |∂φ/∂q| |q|: what rounding of q alone makes of φ; take float64",
    "conflict": "what least squares leave of φ: no motion takes it away; see report",
    "rank": "what lies in combinations of rows that hardly any motion changes; see report",
}
"""Each source of an error: how it is told from the others, and what helps."""


@dataclass(frozen=True)
class Diagnosis:
    """Where the violation of a simulation comes from; `print` it.

    Attributes:
        violation: the largest |φ| of the simulation.
        sources: the part of it by source, as of `METHODS`; they need not add up.
        gains: (α, β) of the method's feedback at this step unless others are given [1/s].
        stable_rate: the largest α = β that is stable at this step [1/s].
        energy: at the start and at the end [J].
        momentum: linear and angular at the start and at the end; None where there are no bodies.
        report: of the start.
        trouble: what the status of the end says, and which gains are unstable, in words.
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
        """The largest; "unknown" where the run grew without bound, so that none can be told."""
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
    system: Any, method: Method, state: State, controls: Any, dt: float, steps: int = 100
) -> Diagnosis:
    """Simulates three times and tells the sources of the violation apart.

    As given, from the assembled start, and from there with half the step: what the first two differ
    by came with the start, what the last two differ by is made by the step. Round-off, conflict and
    rank are found by the rows where the first one ends. `METHODS` says it of each.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: the start, of one world.
        controls: as of `rollout`.
        dt: h, () [s].
        steps: how many.

    Returns:
        A `Diagnosis`.
    """
    checks.count("diagnose", "steps", steps)
    checks.check("diagnose", "dt", dt, (), above=0)
    assembled = assemble(system, state).state
    assembled = dataclasses.replace(assembled, status=state.status, memory=state.memory)
    finer = controls
    if controls is not None and not callable(controls):
        controls = controls_in(state.q.dtype, controls)
        finer = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x), 2, axis=0), controls)
    end, given = _simulate(system, method, state, controls, dt, steps)
    _, closed = _simulate(system, method, assembled, controls, dt, steps)
    _, halved = _simulate(system, method, assembled, finer, dt / 2, 2 * steps, every=2)
    sources = {
        "initial": _largest(given - closed),
        "integration": _largest(closed - halved),
        "round-off": _rounding(system, end),
        **_lost(system, end),
    }
    gains = default_gains(method, jnp.asarray(dt, state.q.dtype))
    bodies = hasattr(system, "layout")
    return Diagnosis(
        violation=_largest(given),
        sources=sources,
        gains=(float(gains[0]), float(gains[1])),
        stable_rate=largest_stable_rate(method.integrator, float(dt)),
        energy=(float(energy(system, state).total), float(energy(system, end).total)),
        momentum=(_momenta(system, state), _momenta(system, end)) if bodies else None,
        report=report(system, state),
        trouble=_trouble(system, method, state, end, float(dt)),
    )


def _trouble(system: Any, method: Method, state: State, end: State, dt: float) -> tuple[str, ...]:
    """What became of the world, and which gains are unstable, in words."""
    code = Status(int(end.status))
    ended = f"{code.name} at {float(end.time):.4g} s: {MEANING[code]}" if code else None
    found = ended, instability(method, dt, system, state)
    return tuple(words for words in found if words)


def _simulate(
    system: Any, method: Method, state: State, controls: Any, dt: Any, steps: int, every: int = 1
) -> tuple[State, np.ndarray]:
    """The end, and φ at the start and after each recorded step, (steps / every + 1, n_c)."""
    policy = controls if callable(controls) else None
    arrays = None if policy else controls
    end, path = _run(policy, steps, every, system, method, state, arrays, dt)
    return end, np.asarray(path, np.float64)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _run(policy: Any, steps: int, every: int, *args: Any) -> tuple[State, Array]:
    system, method, state, controls, dt = args

    def record(state: State, _: Any = None) -> Array:
        return linearize(at(system, state), state.q, state.v, state.instant).residual

    controls = policy or controls
    end, path = rollout(system, method, state, controls, dt, steps, record=record, every=every)
    return end, jnp.concatenate([record(state)[None], path])


def _largest(path: np.ndarray) -> float:
    return float(np.max(np.abs(path), initial=0))


def _rounding(system: Any, state: State) -> float:
    """ε max_i Σ_j |∂φ_i/∂q_j| |q_j|: what rounding each q_j does to φ."""

    def residual(q: Array) -> Array:
        return linearize(at(system, state), q, state.v, state.instant).residual

    slope = np.asarray(jax.jit(jax.jacfwd(residual))(state.q), np.float64)
    return _largest(np.abs(slope) @ np.abs(state.q)) * float(jnp.finfo(state.q.dtype).eps)


def _lost(system: Any, state: State) -> dict[str, float]:
    """The parts of φ in combinations of rows that no motion changes, or hardly any."""
    rows, jacobian, mass = linearized(at(system, state), state)
    unit = UnitRows(rows.layout, jacobian, mass)
    return {
        "conflict": _largest(unit.within(rows.residual, -1.0, unit.tolerance)),
        "rank": _largest(unit.within(rows.residual, unit.tolerance, WEAK)),
    }


def _momenta(system: Any, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular momentum of all bodies."""
    return np.asarray(momentum(system, state)), np.asarray(angular_momentum(system, state))
