"""Compares methods on a scene: errors from a reference, costs on this device. Host code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from jaxcon.analysis import reference as references
from jaxcon.analysis.choices import methods_for
from jaxcon.analysis.costs import Batch
from jaxcon.analysis.front import COORDINATES, METERS, LeftOut, Tradeoff, front_of
from jaxcon.analysis.ledger import GRADIENT, Clock, Ledger, Wanted
from jaxcon.analysis.sweep import Sweep
from jaxcon.analysis.trials import Course, Inputs, Observer, Points, Problem
from jaxcon.core import checks
from jaxcon.core.interrupts import STOP_EXCEPTIONS, describe_error, progress_bar
from jaxcon.core.typing import DType, PyTree
from jaxcon.methods.method import Method, check_method
from jaxcon.protocols import System
from jaxcon.system.state import State, checked_system

DTYPES = ("float64", "float32")
NO_TIME = "no time was left of the budget"
REFERENCE_SHARE = 0.1
"""The share of the budget for the runs of the reference."""
EARLY = 0.75
"""The share of the budget within which the gradient of the first method is timed early.

Early means before the runs of the other methods. The gradient is timed later if it is predicted to
exceed this share.
"""
OVER = 1.5
"""The share of the budget for the first method; above 1, since any result needs one method."""
RUNS_SHARE = 0.7
"""The share of the budget for runs. The rest is for gradients, if it suffices for at least one."""


def tradeoff(
    system: System,
    state: State,
    horizon: float,
    controls: PyTree | Callable[[State], PyTree] = None,
    *,
    hold: float | None = None,
    methods: Mapping[str, Method] | None = None,
    dtypes: Sequence[str | DType] | str = DTYPES,
    dts: Sequence[float] | float | None = None,
    batch: int = 256,
    budget: float = 300.0,
    gradients: bool = True,
    file: str | Path | None = None,
    progress: bool | None = None,
) -> Tradeoff:
    """Compares errors and costs of methods, precisions and step sizes on one scene.

    A method combines an integrator, a stabilizer and solvers.

    The reference solution is a run of order six in float64. In scenes with inequality constraints,
    it is a run of RK4 with `jc.integrators.Events`. Its step size is halved until two runs agree.
    Their difference is the error estimate. For a chaotic motion the reference is accurate only up
    to some time, and errors are measured up to that time.

    The horizon is cut into equal parts: at least ten, or with a policy one for each interval
    `hold`. The error of a run is its largest distance from the reference at the ends of these
    parts. Costs are measured on this device, in a batch whose worlds start at different points of
    the reference. The result includes diverged runs. It also lists all skipped methods and
    measurements, with reasons.

    If the initial state violates constraints, it is moved to the nearest positions and velocities
    that satisfy them. Runs in float64 work even if float64 is disabled in JAX; the JAX
    configuration is not changed.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        state: state of one world.
        horizon: simulated time of each run [s].
        controls: None, an array, or a function of the state (a policy). Each row of an array is
            held for an equal part of the horizon; a single row is a constant control. A policy is
            evaluated at the start of each interval `hold`. Model inputs that change within a step
            as time-dependent forces of the system.
        hold: time for which each control value of a policy is held [s]; must divide the horizon.
        methods: methods by name, the most important first; by default methods that suit the scene.
        dtypes: "float32", "float64" or both.
        dts: one or several step sizes [s], each reduced until it divides a part of the horizon. The
            default is the length of a part and 1/2, 1/5, 1/10, … of it, as long as errors decrease.
        batch: number of worlds in the batch for the cost measurements.
        budget: time budget [s]. Measurements that are predicted to exceed it are skipped and
            listed. Only a compilation that has begun may exceed it.
        gradients: True also times gradients. The gradient of the first method is timed early, if it
            fits in three quarters of the budget. The others are timed after all runs, methods on
            the Pareto front first.
        file: path of a file, written after each method. Results in an existing file are reused.
        progress: True shows a tqdm progress bar; None shows it in terminals and notebooks.

    Returns:
        A `jc.analysis.Tradeoff`. After a keyboard interrupt it contains the results so far.

    Raises:
        ValueError: a number is out of range, a policy has no `hold`, or the file belongs to another
            comparison.
        TypeError: `methods` is not a mapping from names to methods.
        SimulationError: the reference fails within the horizon, or the initial state cannot be
            moved onto the constraints.
    """
    if np.ndim(getattr(state, "q", ())) > 1:
        raise ValueError(
            f"tradeoff: takes the start of one world, got a state with q of shape {state.q.shape};"
            " take one of a batch or a trajectory, jax.tree.map(lambda x: x[0], states)."
        )
    checked_system(system, state, "jc.tradeoff(system, s, horizon)")
    checks.flag("tradeoff", "gradients", gradients)
    if progress is not None:
        checks.flag("tradeoff", "progress", progress)
    dtypes = (dtypes,) if isinstance(dtypes, str) else dtypes
    dts = (dts,) if isinstance(dts, int | float) else dts
    _check(horizon, methods, dtypes, dts, batch, budget)
    clock, horizon = Clock(budget), float(horizon)
    start = Points(*(np.asarray(x, np.float64) for x in Points.of(state)))
    problem = Problem(system, start, horizon, Inputs.of(system, controls, hold, horizon))
    observe = Observer(problem)
    problem, moved = references.started(problem, observe)
    course = Course(problem, references.method_for(system), np.float64)
    ledger = Ledger.open(file, course, batch)
    reference = ledger.reference
    if reference is None:
        with clock.timing("reference"):
            reference = references.make(course, observe, moved, REFERENCE_SHARE * budget)
        ledger.keep(reference)
    steps = None if dts is None else tuple(map(float, dts))
    shared = Batch.of(problem, reference, batch)
    sweep = Sweep(problem, reference, observe, shared, steps, budget, lambda: clock.left)
    by_name = methods_for(observe.system, reference) if methods is None else methods
    wanted = [
        Wanted(name, method, np.dtype(dtype).name, steps)
        for name, method in by_name.items()
        for dtype in dtypes
    ]
    late = _go(sweep, ledger, clock, wanted, (gradients, progress))
    units = [ledger[choice] for choice in wanted if choice in ledger]
    return Tradeoff(
        tuple(run for unit in units for run in unit.runs),
        tuple(unit.limit for unit in units if unit.limit),
        tuple([x for unit in units for x in unit.left_out] + late),
        horizon,
        reference.until,
        reference.floor,
        _words(sweep),
        batch,
        clock.spent,
    )


def _go(
    sweep: Sweep,
    ledger: Ledger,
    clock: Clock,
    wanted: list[Wanted],
    options: tuple[bool, bool | None],
) -> list[LeftOut]:
    """Measures all methods, then times gradients, as long as the budget lasts.

    Args:
        sweep: measures one method.
        ledger: saved results, to which new ones are added.
        clock: the remaining budget.
        wanted: methods and precisions, the most important first.
        options: (`gradients`, `progress`) of `tradeoff`.

    Returns:
        The measurements that did not fit the budget, or came after an interrupt.
    """
    gradients, progress = options
    bar = progress_bar(
        progress, total=len(wanted) * (1 + gradients), desc="tradeoff", unit="method"
    )
    reason = NO_TIME
    try:
        with bar:
            for i, choice in enumerate(wanted):
                bar.set_postfix_str(f"{choice.name}, {choice.dtype}")
                first = ledger[wanted[0]].compiling if wanted[0] in ledger else 0.0
                slope = clock.asks("gradients", GRADIENT * first or None)
                reserved = gradients and slope < (1 - RUNS_SHARE) * clock.budget
                # the first method gets all of the budget, since without any run there is no result
                share = OVER if i == 0 else RUNS_SHARE if reserved else 1.0
                guess = clock.longest.get("reference", 0.0)
                if choice not in ledger and clock.lasts("runs", share, guess):
                    with clock.timing("runs"):
                        ledger[choice] = sweep.measure(choice.name, choice.method, choice.dtype)
                if gradients and i == 0:  # early: later there may be no time
                    _differentiate(sweep, ledger, clock, choice, EARLY)
                bar.update()
            for choice in _by_use(ledger, wanted) if gradients else ():
                bar.set_postfix_str(f"gradient of {choice.name}, {choice.dtype}")
                _differentiate(sweep, ledger, clock, choice)
                bar.update()
    except STOP_EXCEPTIONS as error:
        reason = describe_error(error)
    late = [LeftOut(x.name, x.dtype, reason) for x in wanted if x not in ledger]
    for choice in _by_use(ledger, wanted) if gradients else ():
        if not ledger[choice].differentiated:
            late.append(LeftOut(choice.name, choice.dtype, f"its gradient: {reason}"))
    return late


def _differentiate(
    sweep: Sweep, ledger: Ledger, clock: Clock, choice: Wanted, share: float = 1.0
) -> None:
    """Times the gradient of a measured method, if it fits in a share of the budget.

    Does nothing if the method is not measured, has no stable run, or its gradient is already timed.

    Args:
        sweep: measures the gradient.
        ledger: saved results, which are updated.
        clock: the remaining budget.
        choice: the method and its precision.
        share: the share of the budget within which the gradient must be predicted to end.
    """
    if choice not in ledger:
        return
    unit = ledger[choice]
    if unit.differentiated or not any(run.ok for run in unit.runs):
        return
    guess = GRADIENT * unit.compiling or None
    if clock.lasts("gradients", share, guess):
        with clock.timing("gradients"):
            ledger[choice] = sweep.gradients(unit)


def _by_use(ledger: Ledger, wanted: list[Wanted]) -> list[Wanted]:
    """Returns the measured methods with a stable run, methods on the Pareto front first."""
    stable = [x for x in wanted if x in ledger and any(run.ok for run in ledger[x].runs)]
    front = {(r.name, r.dtype) for r in front_of(run for x in stable for run in ledger[x].runs)}
    return sorted(stable, key=lambda x: (x.name, x.dtype) not in front)


def _words(sweep: Sweep) -> tuple[str, ...]:
    """Describes the reference and the device in lines of text."""
    reference, problem = sweep.reference, sweep.problem
    device = f"{jax.devices()[0].device_kind} ({jax.default_backend()})"
    unit = METERS if problem.system.layout is not None else COORDINATES
    lines = [
        f"{problem.horizon:g} s; cost: time on {device} for a simulated second of one world,"
        f" alone or of {sweep.batch.worlds}",
        f"reference: {reference.steps} steps, off by at most {reference.floor:.1e} {unit} of a"
        f" motion of {reference.size:.2g}",
    ]
    if reference.until < problem.horizon * (1 - 1e-9):
        lines.append(
            f"errors are measured up to {reference.until:.3g} s only; at the end the reference"
            f" may be off by {reference.error[-1]:.1e}, since the motion is sensitive"
        )
    if reference.moved:
        lines.append(f"the start was off its constraints; it moved by {reference.moved:.2g} kg^½ m")
    if problem.system.bounds:
        lines.append("violations are those of the joints, without limits and contacts")
    return tuple(lines)


def _check(
    horizon: float,
    methods: Mapping[str, Method] | None,
    dtypes: Sequence[str | DType],
    dts: Sequence[float] | None,
    batch: int,
    budget: float,
) -> None:
    """Checks the arguments of `tradeoff`.

    Raises:
        ValueError: a number is out of range.
        TypeError: `methods` is not a mapping from names to methods.
    """
    checks.check("tradeoff", "horizon", horizon, (), above=0)
    checks.check("tradeoff", "budget", budget, (), above=0)
    checks.count("tradeoff", "batch", batch)
    if dts is not None:
        if not isinstance(dts, Sequence | np.ndarray) or isinstance(dts, str):
            raise ValueError(f"tradeoff: dts must be steps [s], got {checks.shortened(dts)}.")
        checks.check("tradeoff", "dts", list(dts), (len(dts),), above=0)
        if not len(dts) or max(map(float, dts)) > float(horizon):
            raise ValueError(
                f"tradeoff: dts must be steps within the horizon of {horizon:g} s, got {dts}."
            )
    try:
        names = [x if isinstance(x, str) else np.dtype(x).name for x in dtypes]
    except TypeError as error:
        raise TypeError(
            f"tradeoff: dtypes must be some of {DTYPES}, got {checks.shortened(dtypes)}."
        ) from error
    if not names or set(names) - set(DTYPES):
        raise ValueError(f"tradeoff: dtypes must be some of {DTYPES}, got {names}.")
    if methods is not None:
        if not isinstance(methods, Mapping) or not methods:
            raise TypeError(
                "tradeoff: methods must be a mapping from names to methods, such as"
                f" {{'Euler': jc.Method(), 'RK4': jc.Method(jc.RK4())}}, got {methods!r}."
            )
        for method in methods.values():
            check_method(method)
