"""Which method to take on a scene: errors against a reference, costs on this device. Host code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

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
from jaxcon.core.ends import ENDS, bar, words
from jaxcon.core.typing import PyTree
from jaxcon.model.state import State, at
from jaxcon.simulation.method import Method, check_method

DTYPES = ("float64", "float32")
NO_TIME = "no time was left of the budget"
REFERENCE_SHARE = 0.1
"""The share of the budget that the runs of the reference may take."""
EARLY = 0.75
"""The share of the budget up to which the gradient of the first method may last."""
OVER = 1.5
"""The share of the budget up to which the first method may last: without it there is no result."""
RUNS_SHARE = 0.7
"""The share of the budget after which only gradients are begun, where the rest lasts for one."""


def tradeoff(
    system: Any,
    state: State,
    horizon: float,
    controls: PyTree | Callable[[State], PyTree] = None,
    *,
    hold: float | None = None,
    methods: Mapping[str, Method] | None = None,
    dtypes: Sequence[Any] = DTYPES,
    dts: Sequence[float] | float | None = None,
    batch: int = 256,
    budget: float = 300.0,
    gradients: bool = True,
    file: str | Path | None = None,
    progress: bool | None = None,
) -> Tradeoff:
    """Error against cost of integrators × stabilisers × solvers × precisions × h on one scene.

    The reference is made here: a run of order six (beside bounded rows RK4 with `Events`) in
    float64 with halved steps until two agree, whose difference is what it may be off. Where a
    motion is chaotic it is good for a part of the horizon only, and errors are counted up to there.
    Errors are the largest distances at the ends of the parts, ten or more, of the horizon. Costs
    are measured on this device, in a batch whose worlds start all along the reference. Runs that
    diverge are among the results, as is what there was no time for, with the reason.

    A start that is off its constraints is taken to the nearest positions and velocities on them.
    The configuration of JAX stays as it is, also where float64 is turned off.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: of one world.
        horizon: how long the runs are [s].
        controls: None; an array with rows, each held for an equal part of the horizon, one row for
            a constant; or a function of the state, read at the start of each `hold`. Inputs that
            change within a step belong into the system, as forces of t.
        hold: the time for which each value of a function is held, of which the horizon is a
            multiple [s].
        methods: by name, the most important first; unless given those that suit the scene.
        dtypes: precisions, of "float32" and "float64", or one of them.
        dts: steps, or one, each shortened until it divides a part of the horizon [s]; unless given
            a tenth of the horizon, and 1/2, 1/5, 1/10, … of that as long as errors fall.
        batch: how many worlds share the device where costs are measured.
        budget: of time [s]. What it would not last for, judged by what was measured before, is
            listed and not run. Only a compilation that was begun may outlast it.
        gradients: whether gradients are timed: of the first method where three quarters of the
            budget last for it, and after all else those of the front first.
        file: written after each method. Where it exists what it holds is not run again.
        progress: whether a bar of tqdm is shown; if None, in terminals and notebooks.

    Returns:
        The `Tradeoff`. What was done before the keyboard interrupts, too.

    Raises:
        ValueError: bad numbers, controls that mean another thing at every step, or a file of
            another scene.
        TypeError: something else than methods.
        SimulationError: the scene itself does not get through the horizon, or its start cannot be
            brought onto its constraints.
    """
    if np.ndim(getattr(state, "q", ())) > 1:
        raise ValueError(
            f"tradeoff: takes the start of one world, got a state with q of shape {state.q.shape};"
            " take one of a batch or a trajectory, jax.tree.map(lambda x: x[0], states)."
        )
    at(system, state, "jc.tradeoff(system, s, horizon)")
    checks.flag("tradeoff", "gradients", gradients)
    dtypes = (dtypes,) if isinstance(dtypes, str) else dtypes
    dts = (dts,) if isinstance(dts, int | float) else dts
    _check(horizon, methods, dtypes, dts, (batch, budget))
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
    own = methods_for(observe.system, reference) if methods is None else methods
    wanted = [Wanted(name, m, np.dtype(x).name, steps) for name, m in own.items() for x in dtypes]
    left = _go(sweep, ledger, clock, wanted, (gradients, progress))
    units = [ledger[one] for one in wanted if one in ledger]
    return Tradeoff(
        tuple(run for unit in units for run in unit.runs),
        tuple(unit.limit for unit in units if unit.limit),
        tuple([x for unit in units for x in unit.left_out] + left),
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
    """Measures what is wanted, and then gradients; says what there was no time for."""
    gradients, progress = options
    shown = bar(progress, total=len(wanted) * (1 + gradients), desc="tradeoff", unit="method")
    reason = NO_TIME
    try:
        with shown:
            for i, one in enumerate(wanted):
                shown.set_postfix_str(f"{one.name}, {one.dtype}")
                first = ledger[wanted[0]].compiling if wanted[0] in ledger else 0.0
                slope = clock.asks("gradients", GRADIENT * first or None)
                kept = gradients and slope < (1 - RUNS_SHARE) * clock.budget
                # the first gets all there is, as without any run there is nothing to say
                share = OVER if i == 0 else RUNS_SHARE if kept else 1.0
                guess = clock.longest.get("reference", 0.0)
                if one not in ledger and clock.lasts("runs", share, guess):
                    with clock.timing("runs"):
                        ledger[one] = sweep.measure(one.name, one.method, one.dtype)
                if gradients and i == 0:  # later there may be no time for any gradient
                    _differentiate(sweep, ledger, clock, one, EARLY)
                shown.update()
            for one in _by_use(ledger, wanted) if gradients else ():
                shown.set_postfix_str(f"gradient of {one.name}, {one.dtype}")
                _differentiate(sweep, ledger, clock, one)
                shown.update()
    except ENDS as error:
        reason = words(error)
    late = [LeftOut(one.name, one.dtype, reason) for one in wanted if one not in ledger]
    for one in _by_use(ledger, wanted) if gradients else ():
        if not ledger[one].differentiated:
            late.append(LeftOut(one.name, one.dtype, f"its gradient: {reason}"))
    return late


def _differentiate(
    sweep: Sweep, ledger: Ledger, clock: Clock, one: Wanted, share: float = 1.0
) -> None:
    """Measures the gradients of a method that has runs, where a share of the budget lasts."""
    if one not in ledger:
        return
    unit = ledger[one]
    if unit.differentiated or not any(run.ok for run in unit.runs):
        return
    guess = GRADIENT * unit.compiling or None
    if clock.lasts("gradients", share, guess):
        with clock.timing("gradients"):
            ledger[one] = sweep.gradients(unit)


def _by_use(ledger: Ledger, wanted: list[Wanted]) -> list[Wanted]:
    """Returns what was measured and did not diverge everywhere, what is on the front first."""
    able = [one for one in wanted if one in ledger and any(run.ok for run in ledger[one].runs)]
    front = {(x.name, x.dtype) for x in front_of(run for one in able for run in ledger[one].runs)}
    return sorted(able, key=lambda one: (one.name, one.dtype) not in front)


def _words(sweep: Sweep) -> tuple[str, ...]:
    """What a result says of the reference and of the device."""
    reference, problem = sweep.reference, sweep.problem
    device = f"{jax.devices()[0].device_kind} ({jax.default_backend()})"
    unit = METERS if hasattr(problem.system, "layout") else COORDINATES
    lines = [
        f"{problem.horizon:g} s; cost: time on {device} for a simulated second of one world,"
        f" alone or of {sweep.batch.worlds}",
        f"reference: {reference.steps} steps, off by at most {reference.floor:.1e} {unit} of a"
        f" motion of {reference.size:.2g}",
    ]
    if reference.until < problem.horizon * (1 - 1e-9):
        lines.append(
            f"that is up to {reference.until:.3g} s, as far as errors are counted; at the end it"
            f" may be off by {reference.error[-1]:.1e}, so sensitive is the motion"
        )
    if reference.moved:
        lines.append(f"the start was off its constraints; it moved by {reference.moved:.2g} kg^½ m")
    if problem.system.bounds:
        lines.append("violations are those of the joints, without limits and contacts")
    return tuple(lines)


def _check(horizon: Any, methods: Any, dtypes: Any, dts: Any, numbers: tuple[Any, Any]) -> None:
    """Checks what a user gave.

    Raises:
        ValueError: bad numbers.
        TypeError: something else than methods.
    """
    batch, budget = numbers
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
