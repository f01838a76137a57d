"""The inequality rows of a system, linearized at one instant.

A step evaluates these rows once, at velocity level. u = φ̇ is the velocity of a row at the end of
the step, and u* its target. A one-sided row requires u ≥ u*. A box requires u = u* within the
bounds of its multiplier. A contact requires u ≥ u* along its normal, and zero slip along its
tangents within the friction bound.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.base import blocks_of
from jaxcon.constraints.primitives import Row
from jaxcon.contact.bounded import FrictionDisc, RowCounts
from jaxcon.contact.nearest_rows import RowChoice
from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane, PyTree, Scalar
from jaxcon.linear.islands import islands, nonzeros
from jaxcon.linear.jacobian import Block, Gathered, Jacobian
from jaxcon.system.elements import Grid
from jaxcon.system.layout import Place

if TYPE_CHECKING:
    from jaxcon.core.doubled import Doubled
    from jaxcon.protocols import InequalityGroup, System
    from jaxcon.system.body_system import Snapshot


class UnknownElementError(KeyError, ValueError):
    """An unknown element name; also a KeyError, since `Reactions` is a mapping."""

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True)
class BoundLayout:
    """The assignment of inequality rows to elements.

    Attributes:
        entries: for each element, its name, the indices of its rows, and its number of points. If
            an element has several points, the indices are those of the first point; each further
            point adds 1. The number is None for an element with a single point.
    """

    entries: tuple[tuple[str, tuple[int, ...], int | None], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The element names, in the order of their rows."""
        return tuple(name for name, *_ in self.entries)

    def rows(self, name: str) -> np.ndarray:
        """Returns the row indices of an element, (rows,), or of its points, (points, rows).

        Raises:
            UnknownElementError: no element has this name.
        """
        if not isinstance(name, str) or name not in self._places:
            raise UnknownElementError(f"element '{name}' is unknown; known are {list(self.names)}.")
        rows, points = self._places[name]
        one = np.array(rows)
        return one if points is None else np.arange(points)[:, None] + one[None]

    @property
    def owners(self) -> np.ndarray:
        """The index of the element to which each row belongs, (n,)."""
        rows = [self.rows(name).ravel() for name in self.names]
        owners = np.zeros(sum(map(len, rows)), np.int32)
        for i, own in enumerate(rows):
            owners[own] = i
        return owners

    @cached_property
    def _places(self) -> dict[str, Any]:
        return {name: place for name, *place in self.entries}


@pytree
class Reactions(Mapping[str, Array]):
    """The response of inequality rows in a step; `reactions["stop"]` is the force of one element.

    This is a mapping from element names to forces, with `in`, `iter`, `len`, `items()` and `get`.

    Attributes:
        multipliers: mean multipliers λ over the step [N, N m], (n,). An impact adds its impulse
            divided by h. If an impact occurs in the second half of a semi-implicit step, λ does not
            include the load of a one-sided row before the impact.
        gap: gap φ at the start of the step, (n,); zero for rows without a gap.
        residual: the largest violation of the laws, as a velocity, ().
        kept: fraction of the rebound that is kept after the cap on energy, from 0 to 1, (); 1
            without a cap.
        jump: change of velocity and displacement by impacts within the step. None if impacts are
            not possible, and after an integrator has applied it.
        layout: assignment of rows to elements.
        direction: the sign of the force λ of the stop that acted; see `BoundRows.direction`.
        lasting: multipliers without the impulses of impacts, (n,), from which the next step starts;
            None if impacts are not possible.
    """

    multipliers: Array
    gap: Array
    residual: Array
    kept: Array
    jump: Any
    layout: BoundLayout = static()
    direction: Array | None = None
    lasting: Array | None = None
    # a mapping compares its items, which are arrays without a single truth value
    __eq__ = object.__eq__
    __hash__ = object.__hash__  # type: ignore[assignment]

    def without_jump(self) -> Reactions:
        """Returns the reactions without `jump` and `lasting`, which the step has used."""
        return dataclasses.replace(self, jump=None, lasting=None)

    def __iter__(self) -> Iterator[str]:
        """Iterates over the names of the elements."""
        return iter(self.layout.names)

    def __len__(self) -> int:
        """Returns the number of elements."""
        return len(self.layout.names)

    def __getitem__(self, name: str) -> Array:
        """Returns λ of an element: (1,), or (1 + t,) for a contact with t tangents, normal first.

        Rolling and spinning resistance follow, with moments about the tangents and about the normal
        [N m]. An element with k points, such as a box, has a leading axis of points, (k, …).
        """
        return self.multipliers[..., self.layout.rows(name)]


ORDER = ("single", "box", "contact")


class BoundSet(NamedTuple):
    """The inequality rows of elements of the same structure.

    Attributes:
        law: "single", "box" or "contact".
        rows: rows of each element: a single row, or the normal and the tangents of a contact.
        rolls, spins: rows of rolling and spinning resistance: the relative angular velocity about
            the tangents, and about the normal of a contact.
        places: the bodies on which the rows act.
        target: target velocity u* of the first row, lanes (element,).
        lower, upper: bounds on λ of boxes.
        friction: coefficient of friction μ of contacts.
        rolling, spinning: length c of the bound ‖τ‖ ≤ c λ_n on the moments of resistance [m].
        compliance: compliance C of the first row.
        restitution: coefficient of restitution e; None if no element can bounce.
        far: gap of a second stop, opposite to that of the first row; None without a second stop.
        points: number of points of each element, stored consecutively; None for a single point.
        place: points at which contact forces act, world frame; None for other rows.
        direction: sign of the force λ along the joint coordinate; None without `far`.
    """

    law: str
    rows: tuple[Row, ...]
    places: tuple[Place, ...]
    target: Lane
    lower: Lane = 0.0
    upper: Lane = 0.0
    friction: Lane = 0.0
    rolls: tuple[Row, ...] = ()
    rolling: Lane = 0.0
    spins: tuple[Row, ...] = ()
    spinning: Lane = 0.0
    compliance: Lane = 0.0
    restitution: Lane | None = None
    far: Lane | None = None
    points: int | None = None
    place: Vector | None = None
    direction: Lane | None = None

    @property
    def order(self) -> tuple[int, int]:
        """The sort key: first the law, then the presence of rolling and spinning resistance."""
        turning = (bool(self.rolls), bool(self.spins))
        return ORDER.index(self.law), ((0, 0), (1, 0), (1, 1), (0, 1)).index(turning)

    @property
    def hard(self) -> bool:
        """True if the rows respond to impacts; False for joint friction, motors and soft stops."""
        return self.law != "box" and isinstance(self.compliance, float)


@pytree
class BoundRows:
    """The inequality rows of a system, in the order given in `contact.bounded`.

    Attributes:
        gap: gap φ, (n,); zero for rows without a gap.
        rate: rate φ̇ of the gap, or velocity of the row, (n,).
        target: target velocity u*, (n,); NaN for elements with a non-finite parameter.
        compliance: diagonal of C, (n,).
        lower, upper: bounds on λ of the boxes, (boxes,).
        friction: coefficient of friction, (contacts,).
        resistance: for each disc of `kinds.turning`, the length c of its bound, (contacts of the
            disc,) [m].
        jacobian: Jacobian ∂φ̇/∂v, (n, n_v); a `Gathered` one if rows were chosen by index.
        restitution: coefficient of restitution e, (n,), negative for rows that do not bounce; None
            if no row can bounce.
        far: gap of a second stop, opposite to the first, (n,), infinite for rows without a second
            stop; None if no row has one.
        layout: assignment of rows to elements.
        kinds: numbers of rows by law.
        hard: mask of the rows that respond to impacts, (n,). For a contact, only the entry of the
            normal is set.
        ends: mask of the `hard` rows with a gap, (n,).
        paired: mask of the rows with a second stop, (n,).
        lands: names of contacts and ropes without restitution on bodies that turn.
        acts: mask of the active rows, (n,). Tangents have the entry of their normal. None if all
            rows are active.
        rate_change: the change h J̇ v of φ̇ in a step of constant v, (n,); see
            `Response.rate_change`. Zero for rows without impacts; None if it is neglected.
        direction: sign of the force λ of a stop along its coordinate, (n,): 1 for a lower stop,
            −1 for an upper stop; None if no row has a second stop.
    """

    gap: Array
    rate: Array
    target: Array
    compliance: Array
    lower: Array
    upper: Array
    friction: Array
    resistance: tuple[Array, ...]
    jacobian: Jacobian
    restitution: Array | None
    far: Array | None
    layout: BoundLayout = static()
    kinds: RowCounts = static()
    hard: tuple[bool, ...] = static(default=())
    ends: tuple[bool, ...] = static(default=())
    paired: tuple[bool, ...] = static(default=())
    lands: tuple[str, ...] = static(default=())
    rate_change: Array | None = None
    acts: Array | None = None
    direction: Array | None = None

    @property
    def pressed(self) -> np.ndarray:
        """A mask of the velocities, (n_v,), of bodies on which one-sided rows may act."""
        ends, result = np.asarray(self.ends, bool), np.zeros(self.jacobian.shape[1], bool)
        for block in self.jacobian.blocks:
            m, k = block.shape
            acting = ends[block.start : block.start + m * k].reshape(m, k).any(axis=0)
            result[block.columns.index()[:, acting]] = True
        return result

    def change(self, acceleration: Array, dt: Array, share: float = 1.0) -> Array:
        """Returns h J a + s h J̇ v, (n,), the change of φ̇ in a step of h; `share` is s."""
        change = dt[None] * self.jacobian.apply(acceleration)
        return change if self.rate_change is None else change + share * self.rate_change

    def largest_change(self, acceleration: Array, dt: Array) -> Array:
        """Returns h (|J| |a| + |J̇ v|), (n,), an upper bound on the change of φ̇ in a step."""
        most = dt[None] * self.jacobian.reach(acceleration)
        return most if self.rate_change is None else most + jnp.abs(self.rate_change)

    def finite(self, bare: Array) -> Array:
        """Returns True if all numbers of the rows are finite, ().

        Args:
            bare: diagonal of J_b M⁻¹ J_bᵀ, (n,), where J_b is the Jacobian of these rows. It is not
                finite if J_b is not.
        """
        numbers = (self.gap, self.rate, self.target, self.compliance, bare)
        return jnp.all(functools.reduce(jnp.logical_and, map(jnp.isfinite, numbers)), axis=0)

    def chosen(self, choice: RowChoice) -> BoundRows:
        """Selects the rows that `ActiveSet` has chosen to solve."""
        e, far = self.restitution, self.far
        return dataclasses.replace(
            self,
            gap=choice.take(self.gap),
            rate=choice.take(self.rate),
            target=choice.take(self.target),
            compliance=choice.take(self.compliance),
            friction=choice.contacts(self.friction),
            jacobian=Gathered(self.jacobian.pulls(choice.places().astype(self.rate.dtype))),
            restitution=None if e is None else choice.take(e),
            far=None if far is None else choice.take(far),
            direction=None,
            rate_change=None if self.rate_change is None else choice.take(self.rate_change),
            kinds=choice.kinds,
        )

    def passes(self, free: Array, dt: Array) -> Array:
        """Returns a mask of the rows that would pass their second stop in a step, (n,), a constant.

        Rows already beyond their second stop are excluded: if the stops have crossed, the nearer
        one acts.

        Args:
            free: velocity u at the end of the step without multipliers, (n,), positive away from
                the first stop.
            dt: step size h, () [s].
        """
        assert self.far is not None
        return jax.lax.stop_gradient((self.far >= 0) & (dt[None] * free > self.far))

    def facing(self, second: Array, dt: Array) -> BoundRows:
        """Replaces the first stop by the second one in the rows of the mask `second`, (n,)."""
        assert self.far is not None
        gap, sign = jnp.where(second, self.far, 0), jnp.where(second, -1, 1).astype(dt.dtype)
        return dataclasses.replace(
            self,
            gap=jnp.where(second, gap, self.gap),
            rate=sign * self.rate,
            rate_change=None if self.rate_change is None else sign * self.rate_change,
            target=jnp.where(second, -numerics.safe_divide(gap, dt[None]), self.target),
            jacobian=self.jacobian.scaled(sign, np.array(self.paired)),  # type: ignore[union-attr]
            direction=None if self.direction is None else sign * self.direction,
            far=None,
        )


def linearize_bounds(
    system: System, q: Array, v: Array, t: Doubled | Scalar, control: PyTree, dt: Array
) -> BoundRows:
    """Returns all inequality rows of a system at a state and time; see `bound_rows`."""
    return bound_rows(system.snapshot(q, v, t), control, dt)


def bound_rows(snapshot: Snapshot, control: PyTree, dt: Array) -> BoundRows:
    """Returns all inequality rows at one instant, with their target velocities for a step of dt.

    Args:
        snapshot: snapshot of a system with inequality constraints.
        control: control input u.
        dt: step size h, () [s].
    """
    system, v = snapshot.system, snapshot.v
    pairs = [(x.names, _checked(x, x.bounds(snapshot, control, dt))) for x in system.bounds]
    lands = _lands(system, pairs)
    pairs.sort(key=lambda pair: pair[1].order)
    sets = [bound_set for _, bound_set in pairs]
    sizes = [len(names) * (bound_set.points or 1) for names, bound_set in pairs]
    kinds = _kinds(sets, sizes)
    columns = _columns(sets, sizes, v)
    starts = list(itertools.accumulate((column.size for column in columns), initial=0))
    blocks = [
        b for c, start in zip(columns, starts, strict=False) for b in c.blocks(snapshot, start)
    ]

    def concatenated(field: str) -> Array:
        return jnp.concatenate([c.flat([getattr(r, field) for r in c.rows]) for c in columns])

    first, bouncy = columns[0], any(s.restitution is not None for s in sets)
    paired = any(s.far is not None for s in sets)
    gaps = [s.rows[0].value if s.rows[0].holonomic else 0.0 for s in sets]
    rest = (kinds.size - first.size, *v.shape[1:])

    def once(lanes: list[Any], none: float = 0.0) -> Array:
        values = first.flat([none if x is None else x for x in lanes])
        return jnp.concatenate([values, jnp.full(rest, none, v.dtype)])

    def of(field: str) -> Array:
        return first.flat([getattr(s, field) for s in sets])

    return BoundRows(
        once(gaps),
        concatenated("rate"),
        once([s.target for s in sets]),
        once([s.compliance for s in sets]),
        of("lower")[kinds.single : kinds.normal],
        of("upper")[kinds.single : kinds.normal],
        of("friction")[kinds.normal :],
        _resistance(sets, sizes, v),
        Jacobian(tuple(blocks), (kinds.size, v.shape[0])),
        once([s.restitution for s in sets], -1.0) if bouncy else None,
        once([s.far for s in sets], jnp.inf) if paired else None,
        _layout(pairs, columns, starts),
        kinds,
        _by_row([s.hard for s in sets], sizes, kinds),
        _by_row([s.hard and s.rows[0].holonomic for s in sets], sizes, kinds),
        _by_row([s.far is not None for s in sets], sizes, kinds),
        lands,
        direction=once([s.direction for s in sets], 1.0) if paired else None,
    )


def _checked(group: InequalityGroup, bound_set: BoundSet) -> BoundSet:
    """Sets u* = NaN for elements with a non-finite parameter.

    The laws compare numbers, and comparisons with NaN are false. An element with such a parameter
    would silently have no effect. u* = NaN stops its world instead.
    """
    finite = jnp.ones((), bool)
    for field, x in group.numbers.items():
        good = _not_nan if field in group.unbounded_fields else jnp.isfinite
        for lane in () if isinstance(x, Grid) else jax.tree.leaves(x):
            finite &= good(lane)
    if bound_set.points is not None and finite.ndim:
        finite = jnp.repeat(finite, bound_set.points, axis=0)
    return bound_set._replace(target=jnp.where(finite, bound_set.target, jnp.nan))


def _not_nan(x: Lane) -> Array:
    """Returns True where a number is not NaN."""
    return ~jnp.isnan(x)


def _lands(system: System, pairs: list[tuple[tuple[str, ...], BoundSet]]) -> tuple[str, ...]:
    """Returns the names of contacts and ropes without restitution on bodies that turn."""
    layout = system.layout
    if layout is None:
        return ()
    names: list[str] = []
    for group, (element_names, rows) in zip(system.bounds, pairs, strict=True):
        # rows on joint coordinates do not count: they do not depend on where the bodies are
        on_joint = group.coordinate is not None
        if on_joint or not (rows.hard and rows.rows[0].holonomic) or rows.restitution is not None:
            continue
        kinds = [layout.groups[p.group].kind for p in rows.places if p.group is not None]
        if any(kind.n_v > layout.dim for kind in kinds):
            names += element_names
    return tuple(names)


class _Column:
    """Consecutive inequality rows with the same role in their elements.

    These are the first rows of all elements, or the i-th tangents of all contacts, or the i-th
    rolling or spinning rows of all contacts that have them.
    """

    def __init__(self, members: list[tuple[BoundSet, int, Row]], like: Array) -> None:
        self.members, self.like = members, like
        self.rows = [row for *_, row in members]
        self.size = sum(size for _, size, _ in members)

    def flat(self, lanes: list[Lane]) -> Array:
        """Concatenates lanes (element,) of all sets to one array."""
        shape, dtype = self.like.shape[1:], self.like.dtype
        pairs = zip(lanes, self.members, strict=True)
        return jnp.concatenate(
            [jnp.broadcast_to(jnp.asarray(x, dtype), (k, *shape)) for x, (_, k, _) in pairs]
        )

    def place(self, bound_set: BoundSet) -> int | None:
        """Returns the index of a set's first row in this column; None if there is no such row."""
        place = 0
        for member, size, _ in self.members:
            if member is bound_set:
                return place
            place += size
        return None

    def blocks(self, snapshot: Snapshot, start: int) -> list[Block]:
        """Returns the blocks of J for this column, whose first row is `start`."""
        blocks = []
        for bound_set, k, row in self.members:
            blocks += blocks_of(snapshot.system, bound_set.places, [row], start)
            start += k
        return blocks


def _columns(sets: list[BoundSet], sizes: list[int], like: Array) -> list[_Column]:
    """Returns the columns in order: first rows, then tangents, rolling and spinning rows."""
    columns = []
    for field in ("rows", "rolls", "spins"):
        candidates = [(s, k, getattr(s, field)) for s, k in zip(sets, sizes, strict=True)]
        for rank in range(max((len(rows) for *_, rows in candidates), default=0)):
            members = [(s, k, rows[rank]) for s, k, rows in candidates if rank < len(rows)]
            columns.append(_Column(members, like))
    return columns


def _resistance(sets: list[BoundSet], sizes: list[int], like: Array) -> tuple[Array, ...]:
    """Returns the length c of rolling and spinning resistance [m], for each disc."""
    coefficients = []
    for rows, length in (("rolls", "rolling"), ("spins", "spinning")):
        members = [(s, k, s.rows[0]) for s, k in zip(sets, sizes, strict=True) if getattr(s, rows)]
        if members:
            coefficients.append(
                _Column(members, like).flat([getattr(s, length) for s, *_ in members])
            )
    return tuple(coefficients)


def _kinds(sets: list[BoundSet], sizes: list[int]) -> RowCounts:
    """Returns the number of inequality rows of each law."""
    counts: dict[str, int] = dict.fromkeys(ORDER, 0)
    turning: dict[str, list[int]] = {"rolls": [], "spins": []}
    ranks = {"rolls": 0, "spins": 0}
    for bound_set, k in zip(sets, sizes, strict=True):
        for field, contacts in turning.items():
            if rows := getattr(bound_set, field):
                contacts += range(counts["contact"], counts["contact"] + k)
                ranks[field] = len(rows)
        counts[bound_set.law] += k
    tangents = max((len(s.rows) - 1 for s in sets if s.law == "contact"), default=0)
    discs = (FrictionDisc(x[0], len(x), ranks[field]) for field, x in turning.items() if x)
    return RowCounts(counts["single"], counts["box"], counts["contact"], tangents, tuple(discs))


def _by_row(flags: list[bool], sizes: list[int], kinds: RowCounts) -> tuple[bool, ...]:
    """Repeats the flag of each set for each of its elements; the rows of discs get False."""
    first = [flag for flag, k in zip(flags, sizes, strict=True) for _ in range(k)]
    return (*first, *(False,) * (kinds.size - len(first)))


def _layout(
    pairs: list[tuple[tuple[str, ...], BoundSet]], columns: list[_Column], starts: list[int]
) -> BoundLayout:
    """Returns the layout: the row indices of each element, by name."""
    entries = []
    for names, bound_set in pairs:
        firsts = [
            start + place
            for column, start in zip(columns, starts, strict=False)
            if (place := column.place(bound_set)) is not None
        ]
        each = bound_set.points or 1
        entries += [
            (name, tuple(first + i * each for first in firsts), bound_set.points)
            for i, name in enumerate(names)
        ]
    return BoundLayout(tuple(entries))


def kinds_of(system: System, q: Array, v: Array) -> RowCounts | None:
    """Returns the numbers of inequality rows of a system by law; None if there are none."""
    if not system.bounds:
        return None
    return jax.eval_shape(linearize_at_rest, system, q, v).kinds


def count_bounds(system: System, q: Array, v: Array) -> int:
    """Returns the number of inequality rows of a system."""
    kinds = kinds_of(system, q, v)
    return 0 if kinds is None else kinds.size


def linearize_at_rest(system: System, q: Array, v: Array) -> BoundRows:
    """Returns the inequality rows at time 0 without control, to read their structure.

    Args:
        system: a system with inequality constraints.
        q: positions, (n_q, …), with worlds along trailing axes.
        v: velocities, (n_v, …).
    """
    layout, batch = system.layout, (1,) * (q.ndim - 1)
    control = None if layout is None else jnp.zeros((layout.n_u, *batch), q.dtype)
    t, dt = jnp.zeros(batch, q.dtype), jnp.ones(batch, q.dtype)
    return linearize_bounds(system, q, v, t, control, dt)


def has_ends(
    system: System, q: Array, v: Array, t: Doubled | Scalar, control: PyTree, dt: Array
) -> bool:
    """Returns True if a system has hard stops, ropes or contacts, whose rows have impacts."""
    if not system.bounds:
        return False
    return any(jax.eval_shape(linearize_bounds, system, q, v, t, control, dt).ends)


def reaches(jacobian: Jacobian, bounds: Jacobian) -> np.ndarray:
    """Marks the velocities that the multiplier of each inequality row may change.

    These are all velocities of the islands on which the row acts. An island is a set of velocities
    that equality rows couple.

    Args:
        jacobian: the Jacobian of the equality rows, (n_c, n_v); only its structure is read.
        bounds: the Jacobian of the inequality rows, (n, n_v); only its structure is read.

    Returns:
        A mask, (n_v, n).
    """
    _, of_velocities = islands(jacobian)
    acts = np.zeros((max(of_velocities, default=-1) + 1, bounds.shape[0]), bool)
    rows, columns = nonzeros(bounds)
    acts[of_velocities[columns], rows] = True
    return acts[of_velocities]


def rows_beside_contact(jacobian: Jacobian, bounds: BoundRows, multipliers: Array) -> Array | None:
    """Marks the equality rows in whose island a joint limit or a contact is active.

    An island is a set of rows and velocities that are coupled to each other. Joint friction and
    velocity-limited motors do not count.

    Args:
        jacobian: the Jacobian of the equality rows, (n_c, n_v).
        bounds: the inequality rows; only their structure is read.
        multipliers: the multipliers of the inequality rows, (n, …); nonzero where a row is active.

    Returns:
        A mask of the equality rows, (n_c, …). None if no joint limit or contact touches an island
        that contains equality rows.
    """
    of_rows, of_velocities = islands(jacobian)
    touches = np.zeros((max(of_velocities, default=-1) + 1, len(multipliers)), bool)
    rows, columns = nonzeros(bounds.jacobian)
    touches[of_velocities[columns], rows] = True
    touches[:, ~bounds.kinds.one_sided] = False
    touched = touches[of_rows]
    reaching = np.flatnonzero(touched.any(axis=0))
    if not reaching.size:
        return None
    acting = multipliers != 0
    if touched[:, reaching].all():  # all islands share one mask
        acting = jnp.any(acting[reaching], axis=0)
        return jnp.broadcast_to(acting, (len(of_rows), *acting.shape))
    patterns, which = np.unique(touched, axis=0, return_inverse=True)
    worlds = acting.reshape(len(acting), -1).astype(jnp.float32)
    touching = jnp.asarray(patterns, jnp.float32) @ worlds > 0
    return touching.reshape(len(patterns), *acting.shape[1:])[which.reshape(-1)]
