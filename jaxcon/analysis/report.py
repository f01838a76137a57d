"""What a scene amounts to, and the checklist of a method on it. Host code, for people."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxcon.analysis import traps
from jaxcon.analysis.estimate import Cost
from jaxcon.analysis.known import Known, asked_gains
from jaxcon.analysis.memory import Memory, memory
from jaxcon.analysis.motion import StepAngle
from jaxcon.analysis.probe import Probe
from jaxcon.analysis.traps import OF_SCENE, OFF, TRAPS, listed
from jaxcon.analysis.work import Work, seconds, work
from jaxcon.core import checks
from jaxcon.core.status import MEANING, Status
from jaxcon.core.typing import PyTree
from jaxcon.model.state import State
from jaxcon.simulation.choice import Choice, several
from jaxcon.simulation.method import Method
from jaxcon.simulation.stability import largest_stable_rate

CONFLICT_ADVICE = "; keep those that agree, or rank them by jc.Priority"


@dataclass(frozen=True)
class Report:
    """The structure of a system at one state; `print` it.

    Attributes:
        coordinates, velocities: n_q, n_v.
        rows: n_c, of the rows that take away a freedom; rotors do not.
        rotor_rows: number of rows of rotors (`Armature`).
        rank: number of independent rows.
        degrees_of_freedom: n_v − rank.
        redundant: (constraint, row in it) of each row that depends on those before it.
        conflicts: by constraint, what least squares leave of φ, φ̇ and γ: the part that no
            displacement, velocity or acceleration can take away, because rows contradict each
            other; only of constraints where there is such a part.
        condition: of J M⁻¹ Jᵀ with rows scaled to unit length, independent rows only.
        violation: ‖φ‖ and ‖φ̇‖ by constraint; both ‖ψ‖ where it holds velocities alone.
        memory: of a world in a batch [B], where it was asked to measure.
        bounded: names of what has bounded rows, limits, friction and contact, left out of the rest.
        off: names of the constraints with ‖φ‖ above 1e-4; those that hold velocities have no φ.
        impacts: names of the elements that have impacts, through which a gradient is right for one
            impact at a time.
        choice: the solver that `Method.auto` takes, and why.
        cost: operations of the accelerations of one world by part, estimated from the structure,
            where a method was given.
        work: operations of a step of one world, counted from its trace, where it was asked to
            measure.
        seconds: what a step of one world takes in a batch on this device [s], where that was asked.
        gains: α and β of the feedback, and the largest β that is stable at their ratio [1/s], where
            a method and a step were given.
        probe: what some steps from the state left open, where it was asked to measure.
        angle: how far the fastest motion turns or swings in a step, where a method and a step were
            given.
        warnings: by trap, "gains", "step", "singular", "order", "over-constrained", "start",
            "nonlinear", "dense", "iterations", "impacts", "range" and "overlap", of those in which
            the scene and the method are. All but the last two need a method, some a step, and
            "order" to measure.
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
    angle: StepAngle | None = None
    probe: Probe | None = None
    warnings: dict[str, str] = field(default_factory=dict)
    cost: Cost | None = None
    impacts: tuple[str, ...] = ()
    rotor_rows: int = 0

    def __str__(self) -> str:
        kind = "joint" if self.rotor_rows else "constraint"
        rotors = f" and {several(self.rotor_rows, 'rotor row')}" if self.rotor_rows else ""
        lines = [
            f"{self.coordinates} coordinates, {self.velocities} velocities",
            f"{self.rows} {kind} rows of rank {self.rank}{rotors}: "
            f"{several(self.degrees_of_freedom, 'degree')} of freedom",
            f"condition of the independent rows: {self.condition:.2g}",
        ]
        if self.bounded:
            lines.append(f"besides, rows with bounds: {listed(self.bounded)}")
        if self.impacts:
            lines.append(
                f"impacts of {listed(self.impacts)}: gradients are right for one impact at a time,"
                " not where impacts are grazing, simultaneous or accumulating, which"
                " jc.check_gradients names"
            )
        if self.redundant and not self._redundancy_warned:
            named = ", ".join(f"{name}[{row}]" for name, row in self.redundant)
            lines.append(
                f"redundant rows (each depends on rows before it here): {named}; the default"
                " solver takes them as they are, but shares forces among them as it chooses; to"
                " know these, keep only independent rows, as with a joint of fewer rows in the"
                " loop, unless this is a singular position, which another state tells"
            )
        if self.conflicts:
            lines.append(
                "contradicting constraints, and what no motion can take away of them"
                + ("" if "over-constrained" in self.warnings else CONFLICT_ADVICE)
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
        if self.off and "start" not in self.warnings:
            lines.append(
                f"off {', '.join(self.off)}: print(jc.assemble(system, state)) takes it to the"
                " nearest positions that meet them, or names those that cannot be met"
            )
        lines += [f"warning, {TRAPS[name][0]}: {said}" for name, said in self.warnings.items()]
        return "\n".join(lines)

    @property
    def _redundancy_warned(self) -> bool:
        """Returns True where a warning names the redundant rows."""
        return "singular" in self.warnings or (
            "over-constrained" in self.warnings and not self.conflicts
        )

    def _of_method(self) -> list[str]:
        """What is said of cost, gains and what is to be expected, and which solver suits."""
        lines = [str(x) for x in (self.cost, self.work, self.memory) if x]
        if self.seconds is not None:
            lines.append(
                f"{1e6 * self.seconds:.3g} µs a step of one world on this device (measured)"
            )
        if self.gains and any(self.gains[:2]):
            α, β, most = self.gains
            lines.append(
                f"gains α = {α:.4g}, β = {β:.4g} 1/s; at this ratio β is stable up to"
                f" {most:.4g} 1/s"
            )
        if self.angle:
            lines.append(str(self.angle))
        if self.probe:
            code = self.probe.status
            if Status.OK < code < Status.CONFLICT:
                lines.append(
                    f"{self.probe.steps} steps from here fail, {code.name}:"
                    f" {MEANING[code].split(';')[0]}"
                )
            else:
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
    measure: bool = False,
    timed: bool = False,
) -> Report:
    """The checklist: freedoms, redundancy and condition; with a method, cost, gains and traps.

    Rows are compared in the metric of M⁻¹, scaled to unit length; a row counts as dependent where
    the part that earlier rows do not explain is below 1e-9 (float64) or 1e-4 (float32).

    The report answers from the structure of the scene and one linearization on the host: nothing is
    compiled unless `measure` or `timed` asks for it.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: of one world; what it remembers of a method is left out.
        method: by which the system is to be stepped, for cost and warnings. None leaves these out.
        dt: h, () [s], for gains, the violation to be expected, and the warnings that depend on it;
            None leaves these out.
        control: of a step of one world, as of `step`.
        batch: worlds that are to be stepped together, for the choice of a solver and the time.
        measure: whether to trace a step to count its operations, to compile it for its memory, and
            to run some steps for the violation to be expected. This takes seconds, and minutes
            where there are hundreds of rows.
        timed: whether to measure the time of a step, with a batch of so many.

    Returns:
        A `Report`.

    Raises:
        TypeError: something else than a system, a state and a method.
        ValueError: a step that is not positive, or shapes that are not those of the system.
    """
    checks.flag("report", "measure", measure)
    checks.flag("report", "timed", timed)
    checks.count("report", "batch", batch)
    known = Known.of(system, state, method, dt, control, batch, measure)
    unit, layout = known.unit, known.rows.layout
    rank = len(unit.values) - len(known.dependent)
    independent = np.delete(unit.values, known.dependent, axis=0)
    singular = np.linalg.svd(independent, compute_uv=False)
    found = Report(
        coordinates=state.q.shape[0],
        velocities=state.v.shape[0],
        rows=len(unit.values),
        rank=rank,
        degrees_of_freedom=state.v.shape[0] - rank,
        redundant=tuple(unit.owners[i] for i in known.dependent),
        condition=float((singular[0] / singular[-1]) ** 2) if len(singular) else 1.0,
        violation=known.violation,
        off=tuple(
            name
            for name, (size, _) in known.violation.items()
            if size > OFF and name not in layout.velocity_level
        ),
        bounded=tuple(name for group in known.system.bounds for name in group.names),
        impacts=traps.colliding(known),
        conflicts=known.conflicts,
        choice=known.choice,
        rotor_rows=layout.size - len(unit.values),
        warnings=traps.found(known, OF_SCENE if method is None else None),
    )
    return found if method is None else _with_method(found, known, measure, timed)


def _with_method(found: Report, known: Known, measure: bool, timed: bool) -> Report:
    """Returns the report with the findings that belong to the method."""
    args = known.system, known.method, known.state, known.control
    gains = None
    if known.dt is not None:
        α, β = asked_gains(known.method, known.dt)
        ratio = α / β if β > 0 else 1.0
        gains = (α, β, largest_stable_rate(known.method.integrator, known.dt, ratio))
    return dataclasses.replace(
        found,
        cost=known.cost,
        memory=memory(*args) if measure else None,
        work=work(*args) if measure else None,
        seconds=seconds(*args, known.batch) if timed else None,
        gains=gains,
        angle=known.angle,
        probe=known.probe,
    )
