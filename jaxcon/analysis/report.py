"""What a scene amounts to, and the checklist of a method on it. Host code, for people."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxcon.analysis import traps
from jaxcon.analysis.memory import Memory, memory
from jaxcon.analysis.probe import Probe, probe
from jaxcon.analysis.traps import OFF, TRAPS, Known
from jaxcon.analysis.work import Work, seconds, work
from jaxcon.constraints.rows import Rows
from jaxcon.core.status import Status
from jaxcon.core.typing import PyTree
from jaxcon.dynamics.rank import UnitRows, dependent_rows, linearized
from jaxcon.model.state import State, at
from jaxcon.simulation.choice import Choice, choose
from jaxcon.simulation.method import Method
from jaxcon.simulation.stability import largest_stable_rate


@dataclass(frozen=True)
class Report:
    """The structure of a system at one state; `print` it.

    Attributes:
        coordinates, velocities: n_q, n_v.
        rows: n_c.
        rank: number of independent rows.
        degrees_of_freedom: n_v − rank.
        redundant: (constraint, row in it) of each row that depends on those before it.
        conflicts: by constraint, what least squares leave of φ, φ̇ and γ: the part that no
            displacement, velocity or acceleration can take away, because rows contradict each
            other; only of constraints where there is such a part.
        condition: of J M⁻¹ Jᵀ with rows scaled to unit length, independent rows only.
        violation: ‖φ‖ and ‖φ̇‖ by constraint; both ‖ψ‖ where it holds velocities alone.
        memory: of a world in a batch [B], where a method was given.
        bounded: names of what has bounded rows, limits, friction and contact, left out of the rest.
        off: names of the constraints with ‖φ‖ above 1e-4; those that hold velocities have no φ.
        choice: the solver that `Method.auto` takes, and why.
        work: operations of a step of one world, where a method was given.
        seconds: what a step of one world takes in a batch on this device [s], where that was asked.
        gains: α and β of the feedback, and the largest α = β that is stable [1/s], where a method
            and a step were given.
        probe: what some steps from the state left open, likewise.
        warnings: by trap, "gains", "singular", "order", "over-constrained", "start", "nonlinear",
            "dense" and "iterations", of those in which the scene and the method are; a method is
            needed, and for some a step.
    """

    coordinates: int
    velocities: int
    rows: int
    rank: int
    degrees_of_freedom: int
    redundant: tuple[tuple[str, int], ...]
    condition: float
    violation: dict[str, tuple[float, float]]
    memory: Memory | None = None
    conflicts: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    off: tuple[str, ...] = ()
    bounded: tuple[str, ...] = ()
    choice: Choice | None = None
    work: Work | None = None
    seconds: float | None = None
    gains: tuple[float, float, float] | None = None
    probe: Probe | None = None
    warnings: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        lines = [
            f"{self.coordinates} coordinates, {self.velocities} velocities",
            f"{self.rows} constraint rows of rank {self.rank}: "
            f"{self.degrees_of_freedom} degrees of freedom",
            f"condition of the independent rows: {self.condition:.2g}",
        ]
        if self.bounded:
            lines.append(f"besides, rows with bounds: {', '.join(self.bounded)}")
        if self.redundant:
            named = ", ".join(f"{name}[{row}]" for name, row in self.redundant)
            lines.append(
                f"redundant rows (each depends on rows before it here): {named}; the default"
                " solver takes them as they are, but shares forces among them as it chooses; to"
                " know these, keep only independent rows, as with a joint of fewer rows in the"
                " loop, unless this is a singular position, which another state tells"
            )
        if self.conflicts:
            lines.append(
                "contradicting constraints, and what no motion can take away of them; keep those"
                " that agree, or rank them by jc.Priority"
            )
            lines += [
                f"  {name}: {phi:.2e} of φ, {rate:.2e} of φ̇, {bias:.2e} of φ̈"
                for name, (phi, rate, bias) in self.conflicts.items()
            ]
        lines += self._of_method()
        lines += [
            f"  {name}: violation {phi:.2e}, rate {rate:.2e}"
            for name, (phi, rate) in self.violation.items()
        ]
        if self.off:
            lines.append(
                f"off {', '.join(self.off)}: print(jc.assemble(system, state)) takes it to the"
                " nearest positions that meet them, or names those that cannot be met"
            )
        lines += [f"warning, {TRAPS[name][0]}: {said}" for name, said in self.warnings.items()]
        return "\n".join(lines)

    def _of_method(self) -> list[str]:
        """What is said of cost, gains and what is to be expected, and which solver suits."""
        lines = [str(x) for x in (self.work, self.memory) if x]
        if self.seconds is not None:
            lines.append(f"{1e6 * self.seconds:.3g} µs a step of one world on this device")
        if self.gains:
            α, β, most = self.gains
            lines.append(
                f"gains α = {α:.4g}, β = {β:.4g} 1/s; α = β is stable up to {most:.4g} 1/s here"
            )
        if self.probe:
            code = self.probe.status
            ended = "" if code == Status.OK else f"; they end as {code.name}"
            lines.append(
                f"expected violation: {self.probe.violation:.1e}, the worst |φ| in"
                f" {self.probe.steps} steps from here, without the first half{ended}"
            )
        return [*lines, str(self.choice)] if self.choice and self.choice.efforts else lines


def report(
    system: Any,
    state: State,
    method: Method | None = None,
    dt: float | None = None,
    *,
    control: PyTree = None,
    batch: int = 1,
    timed: bool = False,
) -> Report:
    """The checklist: freedoms, redundancy and condition; with a method, cost, gains and traps.

    Rows are compared in the metric of M⁻¹, scaled to unit length; a row counts as dependent where
    the part that earlier rows do not explain is below 1e-9 (float64) or 1e-4 (float32).

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: of one world.
        method: by which the system is to be stepped, for operations, memory and warnings; memory
            compiles a step and takes seconds. None leaves these out.
        dt: h, () [s], for gains, the violation to be expected, which takes some steps, and the
            warnings that depend on it; None leaves these out.
        control: of a step of one world, as of `step`.
        batch: worlds that are to be stepped together, for the choice of a solver and the time.
        timed: whether to measure the time of a step, with a batch of so many.

    Returns:
        A `Report`.
    """
    system = at(system, state, "jc.report(system, s)")
    rows, dense_j, dense_m = linearized(system, state)
    unit = UnitRows(rows.layout, dense_j, dense_m)
    dependent = dependent_rows(unit.values, unit.tolerance)
    singular = np.linalg.svd(np.delete(unit.values, dependent, axis=0), compute_uv=False)
    rank = len(unit.values) - len(dependent)
    violation = {
        name: (float(rows.violation[name]), float(rows.violation.rate(name)))
        for name in rows.layout.names
    }
    conflicts = _conflicts(rows, unit)
    choice = choose(system, state, batch, dependent=len(dependent))
    scene: dict[str, Any] = {
        "coordinates": state.q.shape[0],
        "velocities": state.v.shape[0],
        "rows": len(unit.values),
        "rank": rank,
        "degrees_of_freedom": state.v.shape[0] - rank,
        "redundant": tuple(unit.owners[i] for i in dependent),
        "condition": float((singular[0] / singular[-1]) ** 2) if len(singular) else 1.0,
        "violation": violation,
        "off": tuple(
            name
            for name, (size, _) in violation.items()
            if size > OFF and name not in rows.layout.velocity_level
        ),
        "bounded": tuple(name for group in system.bounds for name in group.names),
        "conflicts": conflicts,
        "choice": choice,
    }
    if method is None:
        return Report(**scene)
    tried = None if dt is None else probe(system, method, state, control, float(dt))
    known = Known(
        system, state, method, None if dt is None else float(dt), rows, unit, dense_m, dependent,
        tuple(conflicts), choice, tried,
    )  # fmt: skip
    return Report(
        **scene,
        memory=memory(system, method, state, control),
        work=work(system, method, state, control),
        seconds=seconds(system, method, state, control, batch) if timed else None,
        gains=None if dt is None else _gains(method, float(dt)),
        probe=tried,
        warnings=traps.found(known),
    )


def _gains(method: Method, dt: float) -> tuple[float, float, float]:
    """α, β, and the largest stable α = β [1/s]."""
    return *traps.asked_gains(method, dt), largest_stable_rate(method.integrator, dt)


def _conflicts(rows: Rows, unit: UnitRows) -> dict[str, tuple[float, float, float]]:
    """What least squares leave of φ, φ̇ and γ, of the constraints where they leave any."""
    left = [unit.contradicting(x) for x in (rows.residual, rows.rate, rows.bias)]
    return {
        name: (left[0].get(name, 0.0), left[1].get(name, 0.0), left[2].get(name, 0.0))
        for name in rows.layout.names
        if any(name in part for part in left)
    }
