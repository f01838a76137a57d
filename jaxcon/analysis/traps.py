"""Warnings about typical mistakes in constrained simulations ("traps", chapter 3.11). Host code.

Each trap has a function, which returns a warning if the scene or the method makes the mistake, and
None otherwise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis.estimate import contact_operations, solved_rows
from jaxcon.analysis.setup import Setup, asked_gains
from jaxcon.constraints.rank import linearized
from jaxcon.contact.contact import Contacts, Rope
from jaxcon.contact.contact_default import EXACT_UP_TO, default_contact_solver
from jaxcon.contact.gauss_seidel import GaussSeidel
from jaxcon.contact.impacts import PREFIX, doubt
from jaxcon.contact.interior_point import InteriorPoint
from jaxcon.contact.limits import Bounds, Limit
from jaxcon.contact.nearest_rows import ActiveSet
from jaxcon.contact.rows import BoundRows, kinds_of, linearize_at_rest, linearize_bounds
from jaxcon.core import host, summary
from jaxcon.core.typing import Array, Lane
from jaxcon.linear.conjugate_gradients import ConjugateGradients
from jaxcon.linear.priority import Lexicographic
from jaxcon.linear.proximal import RankSafe
from jaxcon.linear.schur import Schur
from jaxcon.linear.sparse import Sparse
from jaxcon.methods.choice import innermost, several, words
from jaxcon.methods.integrators import SemiImplicitEuler
from jaxcon.methods.method import Method
from jaxcon.methods.multipliers import AugmentedLagrangian
from jaxcon.methods.stability import instability, parts
from jaxcon.protocols import ContactSolver, System
from jaxcon.system.state import State

OFF = 1e-4
"""The threshold on ‖φ‖ [m, rad] above which a report mentions it."""
MOVING = 1e-3
"""The threshold on ‖φ̇‖ or ‖ψ‖ [m/s, rad/s] above which a report mentions it."""
WEAK = 1e-2
"""The threshold on n σ_min below which n unit-length rows count as nearly dependent.

σ_min is their smallest singular value.
"""
CURVED = 0.1
"""The share of φ that may remain after a linear correction before constraints count as curved."""
SUDDEN = 0.5
"""The threshold on step size times gain, h β, above which feedback removes an error in one step."""
COARSE = 1.0
"""The angle of the fastest motion in a step [rad] above which the step counts as too long."""
FINE = 0.2
"""The recommended angle of the fastest motion in a step [rad]."""
DEARER = 3.0
"""The multiple of a better solver's operations above which a report warns about a solver."""
MANY = 12
"""The least number of constraint rows at which `DEARER` applies."""
FEW_NAMES = 3
"""The largest number of element names that a report lists in one place."""
OF_SCENE = ("range", "overlap")
"""Names of the traps that depend only on scene and state, not on the method."""


def warnings_of(setup: Setup, only: Iterable[str] | None = None) -> dict[str, str]:
    """Returns warnings about the mistakes that the scene or the method makes, by trap.

    Args:
        setup: the scene, its state and the method.
        only: names of the traps to check; None for all.
    """
    checks = ((name, TRAPS[name][1](setup)) for name in (TRAPS if only is None else only))
    return {name: warning for name, warning in checks if warning}


def listed(names: Sequence[str]) -> str:
    """Returns a text of the first `FEW_NAMES` names and the number of the remaining ones."""
    return summary.listed(names, FEW_NAMES, lambda rest: several(rest, "other"))


def gains(setup: Setup) -> str | None:
    """Returns a warning if feedback gains or springs are too stiff for the step size (trap 1)."""
    if setup.dt is None:
        return None
    return instability(setup.method, setup.dt, setup.system, setup.state)


def coarse(setup: Setup) -> str | None:
    """Returns a warning if the step size is too large for the fastest motion (trap 11)."""
    angle = setup.angle
    if not angle or max(angle.turn, angle.swing) <= COARSE:
        return None
    causes = []
    if angle.turn > COARSE:
        causes.append(f"'{angle.turning.name}' turns by {angle.turn:.2g} rad in a step")
    if angle.swing > COARSE:
        where = ""
        if angle.limit and angle.swing > angle.limit:
            name = type(setup.method.integrator).__name__
            where = f", where oscillations are stable with {name} below {angle.limit:.3g}"
        causes.append(
            f"gravity and springs can move '{angle.swinging.name}' at"
            f" {angle.swinging.value:.3g} rad/s, h ω = {angle.swing:.2g}{where}"
        )
    fastest = max(angle.turning.value, angle.swinging.value)
    return (
        f"{'; '.join(causes)}. Take dt of {FINE / fastest:.2g} s or less. A step that is too long"
        " may end with status OK: a status tells failures, not errors. Watch info.violation and"
        " jc.energy, or give the method a Recovery with a limit, which ends as VIOLATED."
    )


def singular(setup: Setup) -> str | None:
    """Returns a warning if the position is singular, or rows are nearly dependent (trap 2).

    Rows may be nearly dependent due to the position, or due to extreme mass ratios.
    """
    if setup.dependent:
        if not setup.passing:
            return None
        names = _numbered(setup, setup.dependent)
        return (
            f"rows of {names} depend on others here, but not beside this position: it is singular."
            f" Its forces are not unique, and the motion may branch. {_taken(setup)}"
        )
    if not len(setup.unit.values):
        return None
    u, _, _ = setup.unit.svd
    n, least = len(u), setup.unit.least
    eps = float(jnp.finfo(setup.state.q.dtype).eps)
    # the share of each row's squared length outside the span of all other rows
    shares = 1 / np.maximum(np.diag(np.linalg.pinv(setup.unit.values @ setup.unit.values.T)), 1)
    if least > WEAK / n and np.min(shares) > 10 * n * eps:
        return None
    names = _names(setup, [int(i) for i in np.argsort(-np.abs(u[:, -1]))[:2]])
    if setup.even.least > WEAK / n:
        return (
            f"rows of {names} nearly depend on others, not by their position but by the masses:"
            " a light body holds a heavy one, vibrates faster than most steps resolve, and loses"
            " digits to rounding. Give the light body more mass, or use"
            " GeneralizedAlpha(), which damps this vibration, and float64."
        )
    return (
        f"rows of {names} nearly depend on others: a force along them hardly moves anything, so"
        f" that forces are up to {1 / max(least, eps):.1g} times as large as elsewhere, and so are"
        " the errors of rounding. Move away from this position, or take float64 and RankSafe(),"
        " the solver of a Method that names none."
    )


def order(setup: Setup) -> str | None:
    """Returns a warning if results depend on the order of the inequality rows (trap 3).

    They do if the sweeps of `GaussSeidel` leave a residual. The residual is only known if the setup
    has a `probe`.
    """
    swept = _inner(setup.method.contact_solver)
    if not isinstance(swept, GaussSeidel) or setup.probe is None or not setup.system.bounds:
        return None
    if not setup.probe.missed > float(jnp.finfo(setup.state.q.dtype).eps) ** 0.5:
        return None
    return (
        f"GaussSeidel takes inequality rows one after the other, and {swept.sweeps} sweeps leave"
        f" a residual of {setup.probe.missed:.1g} m/s: the result depends on the order in"
        " which elements were added. Take more sweeps, or InteriorPoint(), which takes all rows at"
        " once; joints are always taken at once."
    )


def _inner(solver: ContactSolver | None) -> ContactSolver | None:
    """Returns the solver inside an `ActiveSet`, or the given contact solver itself."""
    return solver.solver if isinstance(solver, ActiveSet) else solver


def overconstrained(setup: Setup) -> str | None:
    """Returns a warning if constraint rows are redundant or contradict each other (trap 4)."""
    if setup.conflicts:
        return (
            f"{', '.join(setup.conflicts)} contradict each other: no motion meets all of them."
            " Leave one out, correct its numbers, or rank them by jc.solvers.Priority."
        )
    if not setup.dependent or setup.passing:
        return None
    count, names = len(setup.dependent), _numbered(setup, setup.dependent)
    return (
        f"redundant: {several(count, 'row')} of {names} depend on others. The motion is"
        " right, but how forces are shared among these rows is not determined: take joints with"
        f" fewer rows if you need them. {_taken(setup)}"
    )


def start(setup: Setup) -> str | None:
    """Returns a warning if the initial state violates constraints (trap 5)."""
    layout, off, fast, slips = setup.rows.layout, [], [], []
    h = setup.dt or 0.0
    for name, (size, rate) in setup.violation.items():
        if name in layout.inertial:
            continue
        drift = h * float(np.linalg.norm(np.asarray(setup.rows.bias)[layout.rows(name)]))
        is_fast = rate > MOVING + drift  # v may lag by half a step
        if name in layout.velocity_level:
            slips += [name] if is_fast else []
        elif size > OFF:
            off.append(name)
        elif is_fast:
            fast.append(name)
    parts = []
    if off:
        parts.append(f"{', '.join(off)} are not closed (φ ≠ 0)")
    if fast:
        parts.append(f"the velocities tear at {', '.join(fast)} (φ̇ ≠ 0)")
    if off or fast:
        parts = [" and ".join(parts) + ": begin with jc.assemble(system, state).state"]
    if slips:
        parts.append(f"{', '.join(slips)} slip at the start, which feedback lets decay")
    return "; ".join(parts) + "." if parts else None


def curved(setup: Setup) -> str | None:
    """Returns a warning if one linear correction cannot remove the initial violation (trap 6).

    The reason is the curvature of the constraints. Only methods that correct a violation by one
    linear step are checked.
    """
    φ = np.asarray(setup.rows.residual, np.float64)
    if setup.dt is None or not np.max(np.abs(φ), initial=0) > OFF or not _linear(setup):
        return None
    unit_φ = φ[setup.unit.numbers] / setup.unit.length
    x = np.linalg.lstsq(setup.unit.values, -unit_φ, rcond=setup.unit.tolerance)[0]
    corrected = setup.moved(setup.velocities(x))
    rest = np.asarray(linearized(setup.system, corrected)[0].residual)
    share = np.linalg.norm(rest) / np.linalg.norm(φ)
    if share < CURVED:
        return None
    return (
        f"one linear correction of this start leaves {100 * share:.0f} % of the error, since the"
        " constraints are curved; the method makes it in about one step. Begin with"
        " jc.assemble(system, state).state, or take Projection(), which iterates, or gentle gains"
        " such as Baumgarte.critical(rate=50.0)."
    )


def dense(setup: Setup) -> str | None:
    """Returns a warning if a solver spends many operations on a dense matrix (trap 7).

    This concerns `Dense` and `Schur`, although J is sparse, and `InteriorPoint` with many
    inequality rows.
    """
    if slow := _slow_contact(setup):
        return slow
    efforts, name = setup.choice.efforts, type(innermost(setup.method.solver)).__name__
    if name not in ("Dense", "Schur") or "Sparse" not in efforts or setup.rows.layout.size < MANY:
        return None
    ratio = efforts[name].operations / efforts["Sparse"].operations
    if ratio < DEARER:
        return None
    return (
        f"{name}() fills a matrix with zeros: each joint touches two bodies only. Elimination along"
        f" the structure takes {ratio:.0f} times fewer operations: {words(setup.choice.solver)}."
    )


def _slow_contact(setup: Setup) -> str | None:
    """Returns a warning if `InteriorPoint` takes many more operations than `GaussSeidel` would.

    The warning is None if it does not, or if the method uses another contact solver.
    """
    kinds = kinds_of(setup.system, setup.state.q, setup.state.v)
    solver = setup.method.contact_solver_for(setup.system, setup.state)
    if kinds is None or not isinstance(_inner(solver), InteriorPoint):
        return None
    rows = solved_rows(solver, kinds)
    other = contact_operations(GaussSeidel(), kinds, setup.state.q.dtype)
    if rows <= EXACT_UP_TO or setup.cost.contact < DEARER * other:
        return None
    rest = setup.cost.operations - setup.cost.contact
    problem = (
        f"InteriorPoint() inverts a matrix of {rows} inequality rows in each iteration, about"
        f" {setup.cost.contact:.2g} operations a step, where GaussSeidel() takes {other:.2g} and"
        f" all else {rest:.2g}."
    )
    nearest = (
        "jc.solvers.ActiveSet(jc.solvers.InteriorPoint(), contacts=8) where only few act at a time"
    )
    default = default_contact_solver(setup.system, setup.state.q, setup.state.v)
    if isinstance(default, InteriorPoint):
        return (
            f"{problem} Take {nearest}, or GaussSeidel() where no light body carries heavy ones,"
            " since bodies may rest on each other here."
        )
    chosen = f"{type(default).__name__}()"
    return f"{problem} Leave out contact_solver=, which then is {chosen}, or take {nearest}."


def iterations(setup: Setup) -> str | None:
    """Returns a warning if a part of the method makes more iterations than needed (trap 8)."""
    solver = innermost(setup.method.solver)
    if isinstance(solver, ConjugateGradients) and (text := _swept(setup, solver.iterations)):
        return text
    for part, field, count, enough in _counted(setup.method):
        if count > enough:
            return (
                f"{type(part).__name__}({field}={count}) is more than the {enough}"
                " that usually suffice in every step; a shorter step with fewer of them is more"
                " accurate in the same time."
            )
    return None


def _swept(setup: Setup, rounds: int) -> str | None:
    """Returns a warning if `ConjugateGradients` makes more iterations than useful, or None.

    Args:
        setup: the scene, its state and the method.
        rounds: number of iterations.
    """
    n, efforts, better = setup.rows.layout.size, setup.choice.efforts, words(setup.choice.solver)
    if 0 < 2 * n + 10 < rounds:
        return (
            f"ConjugateGradients makes {rounds} iterations for {several(n, 'row')}, but"
            f" converges in about as many iterations as rows: use iterations={n + 5}, or {better}."
        )
    if "Sparse" not in efforts or n < MANY:
        return None
    share = rounds / ConjugateGradients().iterations
    ratio = share * efforts["ConjugateGradients"].operations / efforts["Sparse"].operations
    if ratio < DEARER:
        return None
    return (
        f"{rounds} iterations of ConjugateGradients take {ratio:.0f} times the operations of"
        f" elimination, which is exact: {better}."
    )


def bound_rows(setup: Setup) -> BoundRows | None:
    """Returns the inequality rows of a scene as shapes and dtypes; None if it has none."""
    if not setup.system.bounds or setup.system.layout is None:
        return None
    return jax.eval_shape(linearize_at_rest, setup.system, setup.state.q, setup.state.v)


def colliding(setup: Setup) -> tuple[str, ...]:
    """Returns the names of the elements that can have impacts."""
    rows = bound_rows(setup)
    if rows is None:
        return ()
    owners = rows.layout.owners[np.flatnonzero(rows.ends)]
    return tuple(rows.layout.names[i] for i in dict.fromkeys(owners.tolist()))


def impact(setup: Setup) -> str | None:
    """Returns a warning if gradients of the method through impacts may be wrong (trap 9)."""
    method, rows = setup.method, bound_rows(setup)
    if method.events is not None or rows is None:
        return None
    if rows.lands:  # a robot may have dozens of such elements, so only some are named
        rows = dataclasses.replace(rows, lands=(listed(rows.lands),))
    solver = method.contact_solver_for(setup.system, setup.state)
    leaves_out = isinstance(solver, ActiveSet) and solver.leaves_out(rows.kinds)
    shared = isinstance(method.integrator, SemiImplicitEuler) and rows.restitution is None
    shares = type(solver).__name__ if shared and not solver.exact else None
    warning = doubt(rows, shares, leaves_out)
    return None if warning is None else warning.removeprefix(PREFIX)


def outside(setup: Setup) -> str | None:
    """Returns a warning if joints start outside their hard limits (trap 10).

    Such joints return into their range at a limited speed, the parameter `recovery`.
    """
    joints, rates = [], []
    for group, θ in _limited(setup):
        params = {field: np.asarray(x) for field, x in group.params.items()}
        if "stiffness" in params:  # a soft limit: a spring moves the joint back
            continue
        joint = setup.system.constraints[group.coordinate.group].law
        unit = joint.coordinates[group.coordinate.name]
        below, above = params["lower"] - θ, θ - params["upper"]
        for i in np.flatnonzero(np.maximum(below, above) > OFF):
            side = "below lower" if below[i] > above[i] else "above upper"
            distance = max(below[i], above[i])
            joints.append(f"{group.names[i]} ({distance:.2g} {unit} {side})")
            rates.append(f"{params['recovery'][i]:.2g} {unit}/s")
    if not joints:
        return None
    return (
        f"joints start outside their limits: {listed(joints)}. They return at"
        f" {' or '.join(dict.fromkeys(rates))} at most: start within the range, or set recovery= of"
        " the limit."
    )


def overlapping(setup: Setup) -> str | None:
    """Returns a warning if hard contacts start in penetration (trap 12).

    Such contacts separate at a limited speed, the parameter `recovery`.
    """
    rows = bound_rows(setup)
    contacts = [g for g in setup.system.bounds if isinstance(g, Contacts) and g.law is not Rope]
    if rows is None or not contacts:
        return None
    names = {name for group in contacts for name in group.names}
    gap = np.asarray(host.evaluate(_gaps, setup.system, setup.state))
    deepest: dict[str, float] = {}
    for row in np.flatnonzero(rows.kinds.one_sided & np.array(rows.hard) & (gap < -OFF)):
        name = rows.layout.names[rows.layout.owners[row]]
        if name in names:
            deepest[name] = max(float(-gap[row]), deepest.get(name, 0.0))
    if not deepest:
        return None
    speeds = {
        f"{float(speed):.2g} m/s"
        for group in contacts
        for name, speed in zip(group.names, np.asarray(group.params["recovery"]), strict=True)
        if name in deepest
    }
    return (
        f"contacts start in overlap: {listed([f'{x} ({d:.2g} m)' for x, d in deepest.items()])}."
        f" They part at {' or '.join(sorted(speeds))} at most: start clear of each other, or set"
        " recovery= of the contact."
    )


def _gaps(system: System, state: State) -> Array:
    """Returns the gaps of all inequality constraints at a state, (n,)."""
    h = jnp.ones((), state.q.dtype)
    assert system.layout is not None  # contacts exist only between bodies
    control = jnp.zeros(system.layout.n_u, state.q.dtype)
    return linearize_bounds(system, state.q, state.v, state.instant, control, h).gap


def _limited(setup: Setup) -> list[tuple[Bounds, np.ndarray]]:
    """Returns the groups of joint limits, each with the values of its coordinates, (elements,)."""
    groups = [g for g in setup.system.bounds if isinstance(g, Bounds) and g.law is Limit]
    if not groups:
        return []

    def read(system: System, state: State) -> list[Lane]:
        snapshot = system.snapshot(state.q, state.v, state.instant)
        return [group.coordinate.read(snapshot).value for group in groups]

    return list(zip(groups, host.evaluate(read, setup.system, setup.state), strict=True))


TRAPS: dict[str, tuple[str, Callable[[Setup], str | None]]] = {
    "gains": ("gains too large for the step", gains),
    "step": ("a step too long for the motion", coarse),
    "singular": ("rows that are singular, or nearly", singular),
    "order": ("the order of rows matters", order),
    "over-constrained": ("redundant or contradicting rows", overconstrained),
    "start": ("inconsistent start", start),
    "nonlinear": ("one linear step is not enough", curved),
    "dense": ("dense matrices", dense),
    "iterations": ("too many iterations", iterations),
    "impacts": ("gradients through impacts", impact),
    "range": ("a start outside joint limits", outside),
    "overlap": ("contacts that start in overlap", overlapping),
}
"""For each trap its title, and the function that returns a warning or None."""


def _counted(method: Method) -> list[tuple[object, str, int, int]]:
    """Returns the iterative parts of a method, with their numbers of iterations.

    Each entry has the part, the name of its field with the number of iterations, this number, and
    a number of iterations that usually suffices.
    """
    counts: list[tuple[object, str, int, int]] = []
    if isinstance(method.solver, RankSafe):
        counts.append((method.solver, "rounds", method.solver.rounds, 5))
    if isinstance(swept := _inner(method.contact_solver), GaussSeidel):
        counts.append((swept, "sweeps", swept.sweeps, 100))
    return counts + [
        (part, "iterations", part.iterations, 5)
        for part in parts(method.stabilizer)
        if isinstance(part, AugmentedLagrangian)
    ]


def _linear(setup: Setup) -> bool:
    """Returns True if the method corrects an initial violation by one linear step.

    Methods that project positions do so with one iteration; feedback does so with a large gain.
    """
    stabilizer = setup.method.stabilizer
    if "position" in stabilizer.corrects:
        return getattr(stabilizer, "iterations", 1) == 1
    return asked_gains(setup.method, setup.dt or 0.0)[1] * (setup.dt or 0.0) > SUDDEN


def _taken(setup: Setup) -> str:
    """Returns a sentence on how the method's solver treats dependent rows."""
    solver = setup.method.solver
    safe = isinstance(solver, ConjugateGradients | Lexicographic)
    safe |= isinstance(solver, RankSafe) and (setup.rows.layout.loops or solver.always)
    safe |= isinstance(solver, Sparse | Schur) and solver.tikhonov is not None
    if safe:
        return f"{type(solver).__name__} takes them as they are."
    return f"{words(solver)} refuses them as SINGULAR: take {words(setup.choice.solver)}."


def _names(setup: Setup, rows: list[int]) -> str:
    """Lists the names of the constraints that have the given rows, each name once, as text.

    Args:
        setup: the scene, its state and the method.
        rows: indices of unit-length rows.
    """
    return ", ".join(dict.fromkeys(setup.unit.owners[i][0] for i in rows))


def _numbered(setup: Setup, rows: list[int]) -> str:
    """Lists the given rows by constraint as text, such as "hinge[0, 2], weld[5]".

    Args:
        setup: the scene, its state and the method.
        rows: indices of unit-length rows. The text has the index of each within its constraint.
    """
    numbers: dict[str, list[str]] = {}
    for i in rows:
        name, row = setup.unit.owners[i]
        numbers.setdefault(name, []).append(str(row))
    return ", ".join(f"{name}[{', '.join(rows)}]" for name, rows in numbers.items())
