"""The report on a scene and a method: structure, cost and warnings. Host code."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from jaxcon.analysis import traps
from jaxcon.analysis.estimate import Cost
from jaxcon.analysis.memory import Memory, memory
from jaxcon.analysis.motion import StepAngle
from jaxcon.analysis.probe import Probe
from jaxcon.analysis.setup import Setup, asked_gains
from jaxcon.analysis.traps import OF_SCENE, OFF, TRAPS, listed
from jaxcon.analysis.work import Work, seconds, work
from jaxcon.core import checks
from jaxcon.core.status import MEANING, Status
from jaxcon.core.typing import PyTree
from jaxcon.methods.choice import Choice, several
from jaxcon.methods.method import Method
from jaxcon.methods.stability import largest_stable_rate
from jaxcon.protocols import System
from jaxcon.system.state import State

CONFLICT_ADVICE = "; keep those that agree, or rank them by jc.solvers.Priority"


@dataclass(frozen=True)
class Report:
    """The structure of a system at one state, and the checks of a method on it; `print` it.

    "Rows" are rows of the constraint Jacobian J.

    Attributes:
        coordinates, velocities: the numbers n_q of coordinates and n_v of velocities.
        rows: n_c, the number of constraint rows, without rotor rows.
        rotor_rows: number of rows of rotors (`Armature`). They add inertia but remove no degree of
            freedom.
        rank: number of independent rows.
        degrees_of_freedom: n_v − rank.
        redundant: (constraint name, row index within the constraint) of each row that depends
            linearly on rows before it.
        conflicts: nonzero least-squares residuals of φ, φ̇ and γ, by constraint. A nonzero residual
            means that rows contradict each other: no displacement, velocity or acceleration
            satisfies all of them.
        condition: condition number of J M⁻¹ Jᵀ for the independent rows, scaled to unit length.
        violation: (‖φ‖, ‖φ̇‖) by constraint. For a velocity constraint ψ = 0, both are ‖ψ‖.
        memory: memory of one world in a batch [B]; None unless `measure` was set.
        bounded: names of the elements with inequality constraints (limits, friction, contacts).
            `rows` and `rank` do not include their rows.
        off: names of the constraints with ‖φ‖ above 1e-4. Velocity constraints have no φ.
        impacts: names of the elements that can have impacts. Gradients are right for one impact at
            a time.
        choice: the solver that `jc.Method.auto` chooses, and the reasons.
        cost: operations to compute the accelerations of one world, estimated from the structure;
            None without a method.
        work: operations of a step of one world, counted from its trace; None unless `measure` was
            set.
        seconds: measured time of a step per world of a batch on this device [s]; None unless
            `timed` was set.
        gains: feedback gains α and β, and the largest stable β at the same ratio α / β [1/s]; None
            without a method and a step size.
        probe: the violation after a few steps from the state; None unless `measure` was set.
        angle: the angles by which the fastest motions turn or oscillate in one step; None without a
            method and a step size.
        warnings: warnings about typical mistakes ("traps"), by trap. The traps are "gains", "step",
            "singular", "order", "over-constrained", "start", "nonlinear", "dense", "iterations",
            "impacts", "range" and "overlap". All but the last two are checked only with a method.
            Some also need a step size, and "order" needs `measure`.
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
            lines.append(f"inequality constraints (not counted above): {listed(self.bounded)}")
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
                " solver accepts them, but how it shares forces among them is arbitrary; if these"
                " forces matter, keep only independent rows, for example by a joint with fewer rows"
                " in the loop; if rows are independent at another state, this position is singular"
            )
        if self.conflicts:
            lines.append(
                "contradicting constraints, with the residuals that no motion can remove"
                + ("" if "over-constrained" in self.warnings else CONFLICT_ADVICE)
            )
            lines += [
                f"  {name}: {phi:.2e} of φ, {rate:.2e} of φ̇, {bias:.2e} of φ̈"
                for name, (phi, rate, bias) in self.conflicts.items()
            ]
        lines += [str(x) for x in (self.cost, self.work, self.memory) if x]
        if self.seconds is not None:
            lines.append(
                f"{1e6 * self.seconds:.3g} µs a step of one world on this device (measured)"
            )
        if self.gains and any(self.gains[:2]):
            α, β, β_max = self.gains
            lines.append(
                f"gains α = {α:.4g}, β = {β:.4g} 1/s; at this ratio β is stable up to"
                f" {β_max:.4g} 1/s"
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
        if self.choice and self.choice.efforts:
            lines.append(str(self.choice))
        lines += [
            f"  {name}: violation {phi:.2e}, rate {rate:.2e}"
            for name, (phi, rate) in self.violation.items()
        ]
        if self.off and "start" not in self.warnings:
            lines.append(
                f"off {', '.join(self.off)}: print(jc.assemble(system, state)) moves it to the"
                " nearest positions that satisfy them, or names the ones that cannot be satisfied"
            )
        lines += [f"warning, {TRAPS[name][0]}: {text}" for name, text in self.warnings.items()]
        return "\n".join(lines)

    @property
    def _redundancy_warned(self) -> bool:
        """True if a warning already names the redundant rows."""
        return "singular" in self.warnings or (
            "over-constrained" in self.warnings and not self.conflicts
        )


def report(
    system: System,
    state: State,
    method: Method | None = None,
    dt: float | None = None,
    *,
    control: PyTree = None,
    batch: int = 1,
    measure: bool = False,
    timed: bool = False,
) -> Report:
    """Reports the structure and rank of a scene; with a method also costs, gains and warnings.

    Rows are scaled to unit length in the metric of M⁻¹. A row counts as dependent if its component
    orthogonal to all earlier rows is shorter than 1e-9 (float64) or 1e-4 (float32).

    The report uses the structure of the scene and one linearization on the host. Nothing is
    compiled unless `measure` or `timed` is set.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        state: state of one world. Its method memory is ignored.
        method: method whose costs and warnings are reported; None leaves them out.
        dt: step size h, () [s]. None leaves out gains, the expected violation and the warnings that
            depend on the step size.
        control: control input of one world for one step, as in `jc.step`.
        batch: number of worlds stepped together. It affects the choice of a solver and the measured
            time.
        measure: True traces a step to count its operations, compiles it to get its memory, and runs
            some steps to get the expected violation. This takes seconds, or minutes for hundreds of
            rows.
        timed: True measures the time of a step of the batch.

    Returns:
        A `jc.analysis.Report`.

    Raises:
        TypeError: an argument is not a system, a state or a method.
        ValueError: the step size is not positive, or shapes do not fit the system.
    """
    checks.flag("report", "measure", measure)
    checks.flag("report", "timed", timed)
    checks.count("report", "batch", batch)
    setup = Setup.of(system, state, method, dt, control, batch, measure)
    unit, layout = setup.unit, setup.rows.layout
    rank = len(unit.values) - len(setup.dependent)
    independent = np.delete(unit.values, setup.dependent, axis=0)
    σ = np.linalg.svd(independent, compute_uv=False)
    gains = None
    if method is not None and setup.dt is not None:
        α, β = asked_gains(setup.method, setup.dt)
        ratio = α / β if β > 0 else 1.0
        gains = (α, β, largest_stable_rate(setup.method.integrator, setup.dt, ratio))
    args = setup.system, setup.method, setup.state, setup.control
    return Report(
        coordinates=state.q.shape[0],
        velocities=state.v.shape[0],
        rows=len(unit.values),
        rank=rank,
        degrees_of_freedom=state.v.shape[0] - rank,
        redundant=tuple(unit.owners[i] for i in setup.dependent),
        condition=float((σ[0] / σ[-1]) ** 2) if len(σ) else 1.0,
        violation=setup.violation,
        off=tuple(
            name
            for name, (size, _) in setup.violation.items()
            if size > OFF and name not in layout.velocity_level
        ),
        bounded=tuple(name for group in setup.system.bounds for name in group.names),
        impacts=traps.colliding(setup),
        conflicts=setup.conflicts,
        choice=setup.choice,
        rotor_rows=layout.size - len(unit.values),
        warnings=traps.warnings_of(setup, OF_SCENE if method is None else None),
        cost=None if method is None else setup.cost,
        memory=memory(*args) if measure and method is not None else None,
        work=work(*args) if measure and method is not None else None,
        seconds=seconds(*args, setup.batch) if timed and method is not None else None,
        gains=gains,
        angle=None if method is None else setup.angle,
        probe=None if method is None else setup.probe,
    )
