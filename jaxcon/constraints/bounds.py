"""All rows of a system whose multipliers are bounded, at one instant.

A step asks them at velocity level, once: with u = φ̇ at the end of the step, a one-sided row wants
u ≥ u*, a box wants u = u* as far as its multiplier suffices, and a contact wants its normal u ≥ u*
and its tangents to rest as far as friction suffices.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.base import gather
from jaxcon.constraints.bound_layout import BoundLayout
from jaxcon.constraints.primitives import Row
from jaxcon.core import numerics
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane
from jaxcon.model.elements import Grid
from jaxcon.model.layout import Place
from jaxcon.solvers.bounded import Disc, Kinds
from jaxcon.solvers.jacobian import Block, Gathered, Jacobian
from jaxcon.solvers.nearest_rows import Choice

ORDER = ("single", "box", "contact")


class BoundSet(NamedTuple):
    """The rows of equal elements.

    Attributes:
        law: "single", "box" or "contact".
        rows: of each element: one, or the normal and the tangents of a contact.
        rolls, spins: of the relative angular velocity along the tangents and about the normal of a
            contact that resists it.
        places: the bodies on which the rows pull.
        target: u* of the first row, lanes (element,).
        lower, upper: bounds of boxes.
        friction: μ of contacts.
        rolling, spinning: the lengths by which their moments are bounded [m].
        compliance: C of the first row, by which u* is missed per unit of multiplier.
        restitution: e; None where nothing can bounce.
        far: the gap of a second stop, opposite to that of the first row; None without.
        points: how many each element has, one after the other; None where an element is one.
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

    @property
    def order(self) -> tuple[int, int]:
        """By law; what resists turning comes last, so that those of one kind are in succession."""
        turning = (bool(self.rolls), bool(self.spins))
        return ORDER.index(self.law), ((0, 0), (1, 0), (1, 1), (0, 1)).index(turning)

    @property
    def hard(self) -> bool:
        """True where it answers an impact by an impulse, as no friction, motor or spring does."""
        return self.law != "box" and isinstance(self.compliance, float)


class BoundGroup(Protocol):
    """A group of equal elements with bounded multipliers."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the elements."""
        ...

    def bounds(self, snapshot: Any, control: Any, dt: Any) -> BoundSet:
        """The rows at one instant, and what a step of dt wants of them."""
        ...


@pytree
class BoundRows:
    """The bounded rows of a system, ordered as `solvers.bounded` says.

    Attributes:
        gap: φ (n,); zero where a row has none.
        rate: φ̇ (n,).
        target: u* (n,); NaN of an element of which a number is not finite.
        compliance: the diagonal of C, (n,).
        lower, upper: (boxes,).
        friction: (contacts,).
        resistance: by disc of `kinds.turning`, (its contacts,).
        jacobian: (n, n_v); `Gathered` of rows that are chosen by their numbers.
        restitution: e, (n,), negative of rows that do not bounce; None where nothing can.
        far: the gap of a second stop, opposite to the first, (n,), infinite of rows that have none;
            None where no row has one.
        layout: rows by element.
        kinds: how many rows of each law.
        hard: which rows answer an impact, (n,); of a contact its normal says so for all.
        ends: which of these have a gap that closes, (n,).
        paired: which have a second stop, (n,).
        lands: names of contacts and ropes without restitution on bodies that turn.
        rate_change: h J̇ v (n,), the change of φ̇ in a step of constant v, as of
            `Dynamics.rate_change`. Of rows that make impacts; zero of others. None where it is left
            out.
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
    kinds: Kinds = static()
    hard: tuple[bool, ...] = static(default=())
    ends: tuple[bool, ...] = static(default=())
    paired: tuple[bool, ...] = static(default=())
    lands: tuple[str, ...] = static(default=())
    rate_change: Array | None = None

    def change(self, acceleration: Array, dt: Array, share: float = 1.0) -> Array:
        """h J a + s h J̇ v, (n,): the change of φ̇ in a step of h."""
        change = dt[None] * self.jacobian.apply(acceleration)
        return change if self.rate_change is None else change + share * self.rate_change

    def largest_change(self, acceleration: Array, dt: Array) -> Array:
        """h (|J| |a| + |J̇ v|), (n,): the change of φ̇ if no terms cancelled."""
        most = dt[None] * self.jacobian.reach(acceleration)
        return most if self.rate_change is None else most + jnp.abs(self.rate_change)

    def finite(self, bare: Array) -> Array:
        """True where all numbers of the rows are finite, ().

        Args:
            bare: J_b M⁻¹ J_bᵀ on the diagonal, (n,), which says so of J.
        """
        numbers = (self.gap, self.rate, self.target, self.compliance, bare)
        return jnp.all(functools.reduce(jnp.logical_and, map(jnp.isfinite, numbers)), axis=0)

    def chosen(self, choice: Choice) -> BoundRows:
        """Some of the rows."""
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
            rate_change=None if self.rate_change is None else choice.take(self.rate_change),
            kinds=choice.kinds,
        )

    def passes(self, free: Array, dt: Array) -> Array:
        """Which rows would pass their second stop in a step, (n,), a constant.

        None does that is beyond it already: between stops that have crossed, the nearer one acts.

        Args:
            free: u at its end without multipliers, (n,), away from the first stop.
            dt: the length of the step, () [s].
        """
        assert self.far is not None
        return jax.lax.stop_gradient((self.far >= 0) & (dt[None] * free > self.far))

    def facing(self, second: Array, dt: Array) -> BoundRows:
        """The rows with the second stop in place of the first where that is asked for, (n,)."""
        assert self.far is not None
        gap, sign = jnp.where(second, self.far, 0), jnp.where(second, -1, 1).astype(dt.dtype)
        return dataclasses.replace(
            self,
            gap=jnp.where(second, gap, self.gap),
            rate=sign * self.rate,
            rate_change=None if self.rate_change is None else sign * self.rate_change,
            target=jnp.where(second, -numerics.safe_divide(gap, dt[None]), self.target),
            jacobian=self.jacobian.scaled(sign, np.array(self.paired)),  # type: ignore[union-attr]
            far=None,
        )


def linearize_bounds(system: Any, q: Array, v: Array, t: Any, control: Any, dt: Any) -> BoundRows:
    """Every bounded row at one instant."""
    snapshot = system.snapshot(q, v, t)
    pairs = [
        (group.names, _told(group, group.bounds(snapshot, control, dt))) for group in system.bounds
    ]
    lands = _lands(system, pairs)
    pairs.sort(key=lambda pair: pair[1].order)
    sets = [own for _, own in pairs]
    sizes = [len(names) * (own.points or 1) for names, own in pairs]
    kinds = _kinds(sets, sizes)
    columns = _columns(sets, sizes, v)
    starts = list(itertools.accumulate((column.size for column in columns), initial=0))
    blocks = [
        b for c, start in zip(columns, starts, strict=False) for b in c.blocks(snapshot, start)
    ]

    def every(field: str) -> Array:
        return jnp.concatenate([c.flat([getattr(r, field) for r in c.rows]) for c in columns])

    first, bouncy = columns[0], any(s.restitution is not None for s in sets)
    paired = any(s.far is not None for s in sets)
    gaps = [s.rows[0].value if s.rows[0].holonomic else 0.0 for s in sets]
    rest = (kinds.size - first.size, *v.shape[1:])

    def once(lanes: list[Any], none: float = 0.0) -> Array:
        own = first.flat([none if x is None else x for x in lanes])
        return jnp.concatenate([own, jnp.full(rest, none, v.dtype)])

    def of(field: str) -> Array:
        return first.flat([getattr(s, field) for s in sets])

    return BoundRows(
        once(gaps),
        every("rate"),
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
    )


def _told(group: Any, own: BoundSet) -> BoundSet:
    """The rows with u* = NaN of elements of which a number is not finite.

    Laws compare such numbers, and a comparison with NaN is false: the element would vanish.
    """
    numbers = getattr(group, "numbers", group.params)
    finite = jnp.ones((), bool)
    for field, x in numbers.items():
        good = _not_nan if field in getattr(group, "endless", ()) else jnp.isfinite
        for lane in () if isinstance(x, Grid) else jax.tree.leaves(x):
            finite &= good(lane)
    if own.points is not None and finite.ndim:
        finite = jnp.repeat(finite, own.points, axis=0)
    return own._replace(target=jnp.where(finite, own.target, jnp.nan))


def _not_nan(x: Lane) -> Array:
    return ~jnp.isnan(x)


def _lands(system: Any, pairs: list[tuple[tuple[str, ...], BoundSet]]) -> tuple[str, ...]:
    """The names of contacts and ropes without restitution on bodies that turn."""
    groups = getattr(getattr(system, "layout", None), "groups", ())
    names: list[str] = []
    for group, (own, rows) in zip(system.bounds, pairs, strict=True):
        on_joint = hasattr(group, "along")  # its coordinate is the same wherever the bodies are
        if on_joint or not (rows.hard and rows.rows[0].holonomic) or rows.restitution is not None:
            continue
        kinds = [groups[p.group].kind for p in rows.places if p.group is not None and groups]
        if any(kind.n_v > system.layout.dim for kind in kinds):
            names += own
    return tuple(names)


class _Column:
    """The first rows of all elements, or one tangent or turn of all contacts that have it."""

    def __init__(self, members: list[tuple[BoundSet, int, Row]], like: Array) -> None:
        self.members, self.like = members, like
        self.rows = [row for *_, row in members]
        self.size = sum(size for _, size, _ in members)

    def flat(self, lanes: list[Lane]) -> Array:
        """One array of lanes (element,)."""
        shape, dtype = self.like.shape[1:], self.like.dtype
        pairs = zip(lanes, self.members, strict=True)
        return jnp.concatenate(
            [jnp.broadcast_to(jnp.asarray(x, dtype), (k, *shape)) for x, (_, k, _) in pairs]
        )

    def place(self, own: BoundSet) -> int | None:
        """Where the rows of a set begin; None where it has none here."""
        place = 0
        for known, size, _ in self.members:
            if known is own:
                return place
            place += size
        return None

    def blocks(self, snapshot: Any, start: int) -> list[Block]:
        """J, from this row on."""
        blocks = []
        for own, k, row in self.members:
            for columns, value in gather(snapshot, own.places, [row]).jacobian:
                blocks.append(Block(value, start, columns))
            start += k
        return blocks


def _columns(sets: list[BoundSet], sizes: list[int], like: Array) -> list[_Column]:
    """The rows in their order: normals, then each tangent, roll and spin of those that have it."""
    columns = []
    for field in ("rows", "rolls", "spins"):
        own = [(s, k, getattr(s, field)) for s, k in zip(sets, sizes, strict=True)]
        for rank in range(max((len(rows) for *_, rows in own), default=0)):
            members = [(s, k, rows[rank]) for s, k, rows in own if rank < len(rows)]
            columns.append(_Column(members, like))
    return columns


def _resistance(sets: list[BoundSet], sizes: list[int], like: Array) -> tuple[Array, ...]:
    """The lengths by which rolling and spinning are resisted, by disc."""
    found = []
    for rows, length in (("rolls", "rolling"), ("spins", "spinning")):
        own = [(s, k, s.rows[0]) for s, k in zip(sets, sizes, strict=True) if getattr(s, rows)]
        if own:
            found.append(_Column(own, like).flat([getattr(s, length) for s, *_ in own]))
    return tuple(found)


def _kinds(sets: list[BoundSet], sizes: list[int]) -> Kinds:
    counts: dict[str, int] = dict.fromkeys(ORDER, 0)
    turning: dict[str, list[int]] = {"rolls": [], "spins": []}
    ranks = {"rolls": 0, "spins": 0}
    for own, k in zip(sets, sizes, strict=True):
        for field, contacts in turning.items():
            if rows := getattr(own, field):
                contacts += range(counts["contact"], counts["contact"] + k)
                ranks[field] = len(rows)
        counts[own.law] += k
    tangents = max((len(s.rows) - 1 for s in sets if s.law == "contact"), default=0)
    discs = (Disc(own[0], len(own), ranks[f]) for f, own in turning.items() if own)
    return Kinds(counts["single"], counts["box"], counts["contact"], tangents, tuple(discs))


def _by_row(flags: list[bool], sizes: list[int], kinds: Kinds) -> tuple[bool, ...]:
    """What is said of the first rows of sets, by row; false for tangents."""
    first = [flag for flag, k in zip(flags, sizes, strict=True) for _ in range(k)]
    return (*first, *(False,) * (kinds.size - len(first)))


def _layout(
    pairs: list[tuple[tuple[str, ...], BoundSet]], columns: list[_Column], starts: list[int]
) -> BoundLayout:
    entries = []
    for names, own in pairs:
        firsts = [
            start + place
            for column, start in zip(columns, starts, strict=False)
            if (place := column.place(own)) is not None
        ]
        each = own.points or 1
        entries += [
            (name, tuple(first + i * each for first in firsts), own.points)
            for i, name in enumerate(names)
        ]
    return BoundLayout(tuple(entries))


def kinds_of(system: Any, q: Array, v: Array) -> Kinds | None:
    """The numbers of inequality rows of a system by law; None in a system without."""
    if not system.bounds:
        return None
    return jax.eval_shape(linearize_at_rest, system, q, v).kinds


def count_bounds(system: Any, q: Array, v: Array) -> int:
    """How many bounded rows a system has."""
    kinds = kinds_of(system, q, v)
    return 0 if kinds is None else kinds.size


def linearize_at_rest(system: Any, q: Array, v: Array) -> BoundRows:
    """The inequality rows at time 0, without control, for their structure.

    Args:
        system: with bounds.
        q: positions, (n_q, …), worlds along trailing axes.
        v: velocities, (n_v, …).
    """
    layout, batch = getattr(system, "layout", None), (1,) * (q.ndim - 1)
    control = None if layout is None else jnp.zeros((layout.n_u, *batch), q.dtype)
    t, dt = jnp.zeros(batch, q.dtype), jnp.ones(batch, q.dtype)
    return linearize_bounds(system, q, v, t, control, dt)


def has_ends(system: Any, q: Array, v: Array, t: Any, control: Any, dt: Any) -> bool:
    """Returns True where a system has hard stops, ropes or contacts: rows that make impacts."""
    if not system.bounds:
        return False
    return any(jax.eval_shape(linearize_bounds, system, q, v, t, control, dt).ends)
