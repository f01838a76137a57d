"""The traps of constrained dynamics, and whether a scene and a method are in one (chapter 3.11)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis.estimate import contact_operations, solved_rows
from jaxcon.analysis.known import Known, asked_gains
from jaxcon.constraints.bounds import BoundRows, kinds_of, linearize_at_rest, linearize_bounds
from jaxcon.constraints.contact import Rope, Touches
from jaxcon.constraints.contact_default import EXACT_UP_TO, default_contact_solver
from jaxcon.constraints.limits import Limit
from jaxcon.core import host
from jaxcon.dynamics.impacts import PREFIX, doubt
from jaxcon.dynamics.rank import linearized
from jaxcon.simulation.choice import innermost, several, words
from jaxcon.simulation.integrators import SemiImplicitEuler
from jaxcon.simulation.method import Method
from jaxcon.simulation.stability import instability, parts
from jaxcon.solvers.bounded import is_exact
from jaxcon.solvers.conjugate_gradients import ConjugateGradients
from jaxcon.solvers.gauss_seidel import GaussSeidel
from jaxcon.solvers.interior_point import InteriorPoint
from jaxcon.solvers.nearest_rows import Nearest
from jaxcon.solvers.priority import Lexicographic
from jaxcon.solvers.proximal import RankSafe

OFF = 1e-4
"""‖φ‖ [m, rad] from which on a report speaks of it."""
MOVING = 1e-3
"""‖φ̇‖ or ‖ψ‖ [m/s, rad/s] from which on it speaks of that."""
WEAK = 1e-2
"""Singular value of n unit rows, times n, below which a direction is nearly lost."""
CURVED = 0.1
"""The share of φ that one linear correction may leave before the way is called curved."""
SUDDEN = 0.5
"""h β from which on feedback takes an error away in about one step."""
COARSE = 1.0
"""Angle of the fastest motion in a step [rad] above which the step is called too long."""
FINE = 0.2
"""Angle of the fastest motion in a step [rad] that is recommended."""
DEARER = 3.0
"""How many times the operations of elimination are worth a word."""
MANY = 12
"""Rows from which on that matters."""
FEW_NAMES = 3
"""Names of elements that a report lists in one place."""
OF_SCENE = ("range", "overlap")
"""Traps of a scene and a state alone, whatever the method."""


def found(known: Known, only: Iterable[str] | None = None) -> dict[str, str]:
    """Warnings by trap, of those of `TRAPS` in which the scene or the method is.

    Args:
        known: the scene and the method.
        only: names of the traps to look for; all unless given.
    """
    told = ((name, TRAPS[name][1](known)) for name in (TRAPS if only is None else only))
    return {name: words for name, words in told if words}


def listed(names: Sequence[str]) -> str:
    """Returns the first names, and how many others there are."""
    rest = len(names) - FEW_NAMES
    if rest <= 0:
        return ", ".join(names)
    return f"{', '.join(names[:FEW_NAMES])} and {several(rest, 'other')}"


def gains(known: Known) -> str | None:
    """Trap 1: feedback or springs that the step cannot follow."""
    if known.dt is None:
        return None
    return instability(known.method, known.dt, known.system, known.state)


def coarse(known: Known) -> str | None:
    """Trap 11: a step too long for the motion, whatever the constraints are held by."""
    angle = known.angle
    if not angle or max(angle.turn, angle.swing) <= COARSE:
        return None
    said = []
    if angle.turn > COARSE:
        said.append(f"'{angle.turning.name}' turns by {angle.turn:.2g} rad in a step")
    if angle.swing > COARSE:
        where = ""
        if angle.limit and angle.swing > angle.limit:
            name = type(known.method.integrator).__name__
            where = f", where oscillations are stable with {name} below {angle.limit:.3g}"
        said.append(
            f"gravity and springs can move '{angle.swinging.name}' at"
            f" {angle.swinging.value:.3g} rad/s, h ω = {angle.swing:.2g}{where}"
        )
    fastest = max(angle.turning.value, angle.swinging.value)
    return (
        f"{'; '.join(said)}. Take dt of {FINE / fastest:.2g} s or less. A step that is too long may"
        " end with status OK: a status tells failures, not errors. Watch info.violation and"
        " jc.energy, or give the method a Recovery with a limit, which ends as VIOLATED."
    )


def singular(known: Known) -> str | None:
    """Trap 2: a position, or masses, in which rows lose their rank, or nearly do."""
    if known.dependent:
        if not known.passing:
            return None
        names = _numbered(known, known.dependent)
        return (
            f"rows of {names} depend on others here, but not beside this position: it is singular."
            f" Its forces are not unique, and the motion may branch. {_taken(known)}"
        )
    if not len(known.unit.values):
        return None
    u, _, _ = known.unit.svd
    n, least = len(u), known.unit.least
    eps = float(jnp.finfo(known.state.q.dtype).eps)
    shares = 1 / np.maximum(np.diag(np.linalg.pinv(known.unit.values @ known.unit.values.T)), 1)
    if least > WEAK / n and np.min(shares) > 10 * n * eps:
        return None
    names = _names(known, [int(i) for i in np.argsort(-np.abs(u[:, -1]))[:2]])
    if known.even.least > WEAK / n:
        return (
            f"rows of {names} nearly depend on others, not by their position but by the masses:"
            " something light holds something heavy, shakes faster than most steps can follow, and"
            " what the heavy one adds is lost in rounding. Give the light one more mass, or take"
            " GeneralizedAlpha(), which damps this shaking, and float64."
        )
    return (
        f"rows of {names} nearly depend on others: a force along them hardly moves anything, so"
        f" that forces are up to {1 / max(least, eps):.1g} times as large as elsewhere, and so are"
        " the errors of rounding. Move away from this position, or take float64 and RankSafe(),"
        " the solver of a Method that names none."
    )


def order(known: Known) -> str | None:
    """Trap 3: what is left depends on the order in which rows are taken."""
    swept = getattr(known.method.bounded, "solver", known.method.bounded)
    if not isinstance(swept, GaussSeidel) or known.probe is None or not known.system.bounds:
        return None
    if not known.probe.missed > float(jnp.finfo(known.state.q.dtype).eps) ** 0.5:
        return None
    return (
        f"GaussSeidel takes bounded rows one after the other, and {swept.sweeps} sweeps leave"
        f" {known.probe.missed:.1g} m/s of their laws open: the result depends on the order in"
        " which elements were added. Take more sweeps, or InteriorPoint(), which takes all rows at"
        " once; joints are always taken at once."
    )


def overconstrained(known: Known) -> str | None:
    """Trap 4: more rows than are needed, or rows that contradict each other."""
    if known.conflicts:
        return (
            f"{', '.join(known.conflicts)} contradict each other: no motion meets all of them."
            " Leave one out, correct its numbers, or rank them by jc.Priority."
        )
    if not known.dependent or known.passing:
        return None
    count, names = len(known.dependent), _numbered(known, known.dependent)
    return (
        f"redundant: {several(count, 'row')} of {names} repeat what others say. The motion is"
        " right, but how forces are shared among these rows is not determined: take joints with"
        f" fewer rows if you need them. {_taken(known)}"
    )


def start(known: Known) -> str | None:
    """Trap 5: a start off the constraints."""
    layout, off, moving, slips = known.rows.layout, [], [], []
    h = known.dt or 0.0
    for name, (size, rate) in known.violation.items():
        if name in layout.inertial:
            continue
        drift = h * float(np.linalg.norm(np.asarray(known.rows.bias)[layout.rows(name)]))
        fast = rate > MOVING + drift  # v may be half a step old
        if name in layout.velocity_level:
            slips += [name] if fast else []
        elif size > OFF:
            off.append(name)
        elif fast:
            moving.append(name)
    said = []
    if off:
        said.append(f"{', '.join(off)} are not closed (φ ≠ 0)")
    if moving:
        said.append(f"the velocities tear at {', '.join(moving)} (φ̇ ≠ 0)")
    if off or moving:
        said = [" and ".join(said) + ": begin with jc.assemble(system, state).state"]
    if slips:
        said.append(f"{', '.join(slips)} slip at the start, which feedback lets decay")
    return "; ".join(said) + "." if said else None


def curved(known: Known) -> str | None:
    """Trap 6: one linear correction of an error for which the constraints are too curved."""
    φ = np.asarray(known.rows.residual, np.float64)
    if known.dt is None or not np.max(np.abs(φ), initial=0) > OFF or not _linear(known):
        return None
    own = φ[known.unit.numbers] / known.unit.length
    x = np.linalg.lstsq(known.unit.values, -own, rcond=known.unit.tolerance)[0]
    there = known.moved(known.velocities(x))
    left = np.asarray(linearized(known.system, there)[0].residual)
    share = np.linalg.norm(left) / np.linalg.norm(φ)
    if share < CURVED:
        return None
    return (
        f"one linear correction of this start leaves {100 * share:.0f} % of the error, since the"
        " constraints are curved; the method makes it in about one step. Begin with"
        " jc.assemble(system, state).state, or take Projection(), which iterates, or gentle gains"
        " such as Baumgarte.critical(rate=50.0)."
    )


def dense(known: Known) -> str | None:
    """Trap 7: dense matrices where J is sparse, or where few of many contacts touch."""
    if slow := _slow_contact(known):
        return slow
    efforts, name = known.choice.efforts, type(innermost(known.method.solver)).__name__
    if name not in ("Dense", "Schur") or "Sparse" not in efforts or known.rows.layout.size < MANY:
        return None
    ratio = efforts[name].operations / efforts["Sparse"].operations
    if ratio < DEARER:
        return None
    return (
        f"{name}() fills a matrix with zeros: each joint touches two bodies only. Elimination along"
        f" the structure takes {ratio:.0f} times fewer operations: {words(known.choice.solver)}."
    )


def _slow_contact(known: Known) -> str | None:
    """The warning of an interior point with more rows than it is fast for."""
    kinds = kinds_of(known.system, known.state.q, known.state.v)
    solver = getattr(known.method.bounded, "solver", known.method.bounded)
    if kinds is None or not isinstance(solver, InteriorPoint):
        return None
    rows = solved_rows(known.method.bounded, kinds)
    other = contact_operations(GaussSeidel(), kinds)
    if rows <= EXACT_UP_TO or known.cost.contact < DEARER * other:
        return None
    rest, point = known.cost.operations - known.cost.contact, (known.state.q, known.state.v)
    said = (
        f"InteriorPoint() inverts a matrix of {rows} inequality rows in each iteration, about"
        f" {known.cost.contact:.2g} operations a step, where GaussSeidel() takes {other:.2g} and"
        f" all else {rest:.2g}."
    )
    nearest = "jc.Nearest(jc.InteriorPoint(), contacts=8) where only few act at a time"
    if isinstance(default_contact_solver(known.system, *point), InteriorPoint):
        return (
            f"{said} Take {nearest}, or GaussSeidel() where no light body carries heavy ones, since"
            " bodies may rest on each other here."
        )
    return f"{said} Leave out bounded=, which then is GaussSeidel(), or take {nearest}."


def iterations(known: Known) -> str | None:
    """Trap 8: more iterations than bring anything."""
    solver = innermost(known.method.solver)
    if isinstance(solver, ConjugateGradients) and (said := _swept(known, solver.iterations)):
        return said
    for part, field, enough in _counted(known.method):
        if getattr(part, field) > enough:
            return (
                f"{type(part).__name__}({field}={getattr(part, field)}) repeats what {enough} or"
                " fewer usually do, in every step; a shorter step with fewer of them is better for"
                " the same time."
            )
    return None


def _swept(known: Known, rounds: int) -> str | None:
    """Returns the warning of more conjugate gradients than bring anything, or None."""
    n, efforts, better = known.rows.layout.size, known.choice.efforts, words(known.choice.solver)
    if 0 < 2 * n + 10 < rounds:
        return (
            f"ConjugateGradients makes {rounds} iterations for {several(n, 'row')}, and is done"
            f" after about as many as there are rows: take iterations={n + 5}, or {better}."
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


def bound_rows(known: Known) -> BoundRows | None:
    """The inequality constraints of a scene by shape; None where there are none."""
    if not known.system.bounds or not hasattr(known.system, "layout"):
        return None
    return jax.eval_shape(linearize_at_rest, known.system, known.state.q, known.state.v)


def colliding(known: Known) -> tuple[str, ...]:
    """The names of the elements that have impacts."""
    rows = bound_rows(known)
    if rows is None:
        return ()
    owners = rows.layout.owners[np.flatnonzero(rows.ends)]
    return tuple(rows.layout.names[i] for i in dict.fromkeys(owners.tolist()))


def impact(known: Known) -> str | None:
    """Trap 9: gradients of plain steps through impacts that lack their time."""
    method, rows = known.method, bound_rows(known)
    if method.events is not None or rows is None:
        return None
    if rows.lands:  # a robot has dozens, and one line names them
        rows = dataclasses.replace(rows, lands=(listed(rows.lands),))
    solver = method.resolve(known.system, known.state).bounded
    some = isinstance(solver, Nearest) and solver.leaves_out(rows.kinds)
    shared = isinstance(method.integrator, SemiImplicitEuler) and rows.restitution is None
    shares = type(solver).__name__ if shared and not is_exact(solver) else None
    said = doubt(rows, shares, some)
    return None if said is None else said.removeprefix(PREFIX)


def outside(known: Known) -> str | None:
    """Trap 10: a joint that starts outside the range of a hard limit, which moves it in slowly."""
    beyond, rates = [], []
    for group, θ in _limited(known):
        numbers = {field: np.asarray(x) for field, x in group.params.items()}
        if "stiffness" in numbers:  # a spring brings it back
            continue
        joint = known.system.constraints[group.along.group].joint
        unit = joint.coordinates[group.along.name]
        below, above = numbers["lower"] - θ, θ - numbers["upper"]
        for i in np.flatnonzero(np.maximum(below, above) > OFF):
            side = "below lower" if below[i] > above[i] else "above upper"
            far = max(below[i], above[i])
            beyond.append(f"{group.names[i]} ({far:.2g} {unit} {side})")
            rates.append(f"{numbers['recovery'][i]:.2g} {unit}/s")
    if not beyond:
        return None
    return (
        f"joints start outside their limits: {listed(beyond)}. They return at"
        f" {' or '.join(dict.fromkeys(rates))} at most: start within the range, or set recovery= of"
        " the limit."
    )


def overlapping(known: Known) -> str | None:
    """Trap 11: hard contacts that start in overlap, which they leave slowly."""
    rows = bound_rows(known)
    contacts = [g for g in known.system.bounds if isinstance(g, Touches) and g.law is not Rope]
    if rows is None or not contacts:
        return None
    names = {name for group in contacts for name in group.names}
    gap = np.asarray(host.evaluate(_gaps, known.system, known.state))
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


def _gaps(system: Any, state: Any) -> jax.Array:
    """The gaps of the inequality constraints at a state, (n,)."""
    h = jnp.ones((), state.q.dtype)
    control = jnp.zeros(system.layout.n_u, state.q.dtype)
    return linearize_bounds(system, state.q, state.v, state.instant, control, h).gap


def _limited(known: Known) -> list[tuple[Any, np.ndarray]]:
    """The groups of joint limits, each with the coordinates (elements,) that they limit."""
    groups = [g for g in known.system.bounds if getattr(g, "law", None) is Limit]
    if not groups:
        return []
    coordinates = [group.along for group in groups]

    def read(system: Any, state: Any) -> list[Any]:
        snapshot = system.snapshot(state.q, state.v, state.instant)
        return [coordinate.read(snapshot).value for coordinate in coordinates]

    return list(zip(groups, host.evaluate(read, known.system, known.state), strict=True))


TRAPS: dict[str, tuple[str, Callable[[Known], str | None]]] = {
    "gains": ("gains too large for the step", gains),
    "step": ("a step too long for the motion", coarse),
    "singular": ("rows that are singular, or nearly", singular),
    "order": ("the order of rows matters", order),
    "over-constrained": ("more rows than freedoms to take", overconstrained),
    "start": ("inconsistent start", start),
    "nonlinear": ("one linear step is not enough", curved),
    "dense": ("dense matrices", dense),
    "iterations": ("too many iterations", iterations),
    "impacts": ("gradients through impacts", impact),
    "range": ("a start outside joint limits", outside),
    "overlap": ("contacts that start in overlap", overlapping),
}
"""By name: the trap in words, and how it is found."""


def _counted(method: Method) -> list[tuple[Any, str, int]]:
    """Parts of a method that repeat something in every step, and how often is enough."""
    swept = getattr(method.bounded, "solver", method.bounded)
    found = [(method.solver, "rounds", 5), (swept, "sweeps", 100)]
    found += [(p, "iterations", 5) for p in parts(method.stabilizer) if hasattr(p, "stiffness")]
    return [(part, field, enough) for part, field, enough in found if hasattr(part, field)]


def _linear(known: Known) -> bool:
    """Returns True where the method makes one linear correction of a start that is off."""
    stabilizer = known.method.stabilizer
    if "position" in stabilizer.corrects:
        return getattr(stabilizer, "iterations", 1) == 1
    return asked_gains(known.method, known.dt or 0.0)[1] * (known.dt or 0.0) > SUDDEN


def _taken(known: Known) -> str:
    """What the solver makes of dependent rows."""
    solver = known.method.solver
    safe = isinstance(solver, ConjugateGradients | Lexicographic)
    safe |= isinstance(solver, RankSafe) and (known.rows.layout.loops or solver.always)
    if safe or getattr(solver, "tikhonov", None) is not None:
        return f"{type(solver).__name__} takes them as they are."
    return f"{words(solver)} refuses them as SINGULAR: take {words(known.choice.solver)}."


def _names(known: Known, rows: list[int]) -> str:
    """The constraints of some unit rows, each once."""
    return ", ".join(dict.fromkeys(known.unit.owners[i][0] for i in rows))


def _numbered(known: Known, rows: list[int]) -> str:
    """The constraints of some unit rows, each with the numbers of these rows in it."""
    numbers: dict[str, list[str]] = {}
    for i in rows:
        name, row = known.unit.owners[i]
        numbers.setdefault(name, []).append(str(row))
    return ", ".join(f"{name}[{', '.join(rows)}]" for name, rows in numbers.items())
