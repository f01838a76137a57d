"""All rows of a system at one instant."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.armature import Armatures
from jaxcon.constraints.base import Joints, RowSet
from jaxcon.constraints.custom import Custom
from jaxcon.constraints.drive import Drives
from jaxcon.constraints.redundancy import has_loops
from jaxcon.core import checks, numerics
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane
from jaxcon.solvers.jacobian import Block, Jacobian
from jaxcon.solvers.saddle import Mass


@dataclass(frozen=True)
class RowLayout:
    """Which rows belong to which constraint.

    Attributes:
        entries: (name, first, rows, stride) of each.
        free: numbers of the rows that have no φ, in ascending order; a position projection leaves
            them out. Rolling has both kinds in one constraint.
        inertial: names of those that hold nothing, but resist acceleration: rotors.
        loops: whether rows may depend on each other, as those of closed loops do, and several of a
            user's function.
        vectors: rows of joints that are components of one vector, along axes chosen by a frame or
            by assembly: (first, elements, rows of each element), such as the three of a meeting
            point.
    """

    entries: tuple[tuple[str, int, int, int], ...]
    free: tuple[int, ...] = ()
    inertial: tuple[str, ...] = ()
    loops: bool = False
    vectors: tuple[tuple[int, int, tuple[int, ...]], ...] = ()

    @property
    def velocity_level(self) -> tuple[str, ...]:
        """Names of the constraints of which no row has a φ."""
        return tuple(name for name in self.names if not np.any(self.holonomic[self.rows(name)]))

    @property
    def holonomic(self) -> np.ndarray:
        """A mask of the rows that have a φ, (n_c,)."""
        return ~np.isin(np.arange(self.size), self.free)

    @property
    def holds(self) -> np.ndarray:
        """A mask of the rows that take away a freedom, (n_c,): all but those of rotors."""
        holds = np.ones(self.size, bool)
        for name in self.inertial:
            holds[self.rows(name)] = False
        return holds

    @property
    def holding(self) -> np.ndarray:
        """Numbers of the rows that take away a freedom."""
        return np.flatnonzero(self.holds)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the constraints, in the order in which they were grouped."""
        return tuple(name for name, *_ in self.entries)

    def rows(self, name: str) -> np.ndarray:
        """The row numbers of a constraint.

        Raises:
            ValueError: no constraint has this name.
        """
        if not isinstance(name, str) or name not in self._places:
            raise ValueError(f"constraint '{name}' is unknown; known are {list(self.names)}.")
        first, count, stride = self._places[name]
        return first + stride * np.arange(count)

    def isotropic(self, x: Array) -> Array:
        """x by row, (n_c,), in which the components of one vector share their mean.

        The mean of a diagonal, as of J M⁻¹ Jᵀ, over the components of a vector does not depend on
        the axes that were chosen for them; its entries do.
        """
        for first, elements, rows in self.vectors:
            places = first + elements * np.array(rows)[:, None] + np.arange(elements)
            mean = jnp.mean(x[places], axis=0)
            x = x.at[places].set(jnp.broadcast_to(mean, (len(rows), *mean.shape)))
        return x

    @cached_property
    def _places(self) -> dict[str, list[int]]:
        return {name: place for name, *place in self.entries}

    @property
    def size(self) -> int:
        """The number of rows."""
        return sum(count for _, _, count, _ in self.entries)


@pytree
class Violation:
    """How far a state is off its constraints; `violation["hinge"]` is that of one.

    Batches and trajectories of it, with leading axes, are read in the same way.

    Attributes:
        position: φ by row (n_c,); zero for velocity-level rows.
        velocity: φ̇ or ψ by row (n_c,).
        layout: rows by constraint.
    """

    position: Array
    velocity: Array
    layout: RowLayout = static()

    @property
    def worst(self) -> Array:
        """max |φ| over rows, ()."""
        return jnp.max(jnp.abs(self.position), axis=-1, initial=0)

    @property
    def worst_rate(self) -> Array:
        """max |φ̇| over rows, ()."""
        return jnp.max(jnp.abs(self.velocity), axis=-1, initial=0)

    def __repr__(self) -> str:
        """A line for each constraint of one world; shapes while tracing and in batches."""
        known = checks.is_concrete((self.position, self.velocity))
        if np.ndim(self.position) != 1 or not known:
            shapes = f"position {np.shape(self.position)}, velocity {np.shape(self.velocity)}"
            return f"Violation({shapes} of {', '.join(self.layout.names)})"
        φ, rate = (np.asarray(x, float) for x in (self.position, self.velocity))
        lines = []
        for name in self.layout.names:
            rows = self.layout.rows(name)
            size, fast = (f"{np.linalg.norm(x[rows]):.3g}" for x in (φ, rate))
            moving = f"{fast} m/s or rad/s"
            whole = name in self.layout.velocity_level
            lines.append(f"{name}: {moving if whole else f'{size} m or rad, rate {moving}'}")
        return "\n".join(lines) or "no constraints"

    def __getitem__(self, name: str) -> Array:
        """‖φ‖ of a constraint, over the rows that have a φ; ‖ψ‖ where none has, ()."""
        if name in self.layout.velocity_level:
            return self.rate(name)
        return _norm(self.position[..., self.layout.rows(name)])

    def rate(self, name: str) -> Array:
        """‖φ̇‖ or ‖ψ‖ of a constraint, ().

        Args:
            name: of the constraint.
        """
        return _norm(self.velocity[..., self.layout.rows(name)])


def _norm(x: Array) -> Array:
    """The norm over the last axis."""
    return numerics.norm(jnp.moveaxis(x, -1, 0))


@pytree
class Rows:
    """The constraints of a system, linearized: φ̈ = J a + γ.

    Attributes:
        residual: φ (n_c,); zero for velocity-level rows.
        rate: φ̇ (n_c,), or ψ.
        jacobian: J = ∂φ̇/∂v, (n_c, n_v).
        bias: γ (n_c,).
        layout: rows by constraint.
        compliance: the diagonal of C, (n_c,); None where it is zero.
        mass: M, where a step tells it to those who weigh rows.
        reactions: what bounded rows did, where there are any.
        swings: squares of the rates at which rods turn, (element,) [rad²/s²], by first row.
    """

    residual: Array
    rate: Array
    jacobian: Jacobian
    bias: Array
    layout: RowLayout = static()
    compliance: Array | None = None
    mass: Mass | None = None
    reactions: Any = None
    swings: dict[int, Array] = dataclasses.field(default_factory=dict)

    @property
    def violation(self) -> Violation:
        """φ and φ̇ by constraint."""
        return Violation(self.residual, self.rate, self.layout)

    def earlier(self, age: Array) -> Rows:
        """Returns the rows with their rates at t − age, () [s], had v always been what it is.

        φ̇(q ⊖ age v, v, t − age) = φ̇ − age γ to first order. Rows of velocities alone hold ψ at q
        itself, and rotors hold nothing: theirs are as they are.
        """
        held = self.layout.holds & self.layout.holonomic
        held = held.reshape(-1, *(1,) * (self.bias.ndim - 1))
        rate = self.rate - jnp.where(held, age[None] * self.bias, 0)
        return dataclasses.replace(self, rate=rate)

    def only(self, kept: np.ndarray) -> Rows:
        """Returns the rows; those that are not kept, (n_c,), say λ = b and act on nothing."""
        if kept.all():
            return self
        open_ = jnp.asarray(~kept, self.bias.dtype).reshape(-1, *(1,) * (self.bias.ndim - 1))
        known = 0.0 if self.compliance is None else self.compliance * (1 - open_)
        compliance = jnp.broadcast_to(known + open_, self.bias.shape)
        jacobian = self.jacobian.only(kept, self.bias)
        return dataclasses.replace(self, jacobian=jacobian, compliance=compliance)


def linearize(system: Any, q: Array, v: Array, t: Any) -> Rows:
    """φ, φ̇, J and γ of every constraint at one instant.

    Args:
        system: with `constraints`.
        q: positions, (n_q,).
        v: velocities, (n_v,).
        t: time, () [s].

    Returns:
        The rows, grouped by constraints of equal structure.
    """
    snapshot = system.snapshot(q, v, t)
    sets = [group.rows(snapshot) for group in system.constraints]
    blocks: list[Block] = []
    entries: list[tuple[str, int, int, int]] = []
    free: list[int] = []
    swings: dict[int, Array] = {}
    vectors: list[tuple[int, int, tuple[int, ...]]] = []
    start = 0
    for group, rows in zip(system.constraints, sets, strict=True):
        k = len(group.names)
        if isinstance(group, Joints):
            vectors += [(start, k, own) for own in components(rows, snapshot.system.layout.dim)]
        swings |= {start + k * r: jnp.asarray(x) for r, x in rows.swings.items()}
        blocks += [Block(value, start, columns) for columns, value in rows.jacobian]
        if rows.value:  # a joint may be there to be read and driven only
            entries += [(name, start + i, len(rows.value), k) for i, name in enumerate(group.names)]
        free += [
            start + k * r + i
            for r, known in enumerate(rows.holonomic)
            if not known
            for i in range(k)
        ]
        start += k * len(rows.value)
    jacobian = Jacobian(tuple(blocks), (start, v.shape[0]))
    residual, rate, bias = (_flat(sets, field, v) for field in ("value", "rate", "bias"))
    soft = any(rows.compliance is not None for rows in sets)
    compliance = _flat(sets, "compliance", v) if soft else None
    rotors = (g for g in system.constraints if isinstance(g, Armatures))
    inertial = tuple(name for group in rotors for name in group.names)
    pairs = list(zip(system.constraints, sets, strict=True))
    loops = has_loops(rows for group, rows in pairs if not isinstance(group, Armatures | Drives))
    drives = [group.along for group, _ in pairs if isinstance(group, Drives)]
    driven = [(along.group, along.joints, along.name) for along in drives]
    loops |= len(set(driven)) < len(driven)
    loops |= any(isinstance(group, Custom) and len(rows.value) > 1 for group, rows in pairs)
    layout = RowLayout(tuple(entries), tuple(free), inertial, loops, tuple(vectors))
    return Rows(residual, rate, jacobian, bias, layout, compliance, swings=swings)


def components(rows: RowSet, dim: int) -> list[tuple[int, ...]]:
    """Rows of a joint that are components of one vector: its lengths, and its turns.

    A turn pulls at no point, and the zeros of its pulls are known while tracing.
    """

    def turns(r: int) -> bool:
        linear = [x for _, pulls in rows.jacobian for x in list(pulls[r])[:dim]]
        return all(isinstance(x, int | float) and x == 0 for x in linear)

    kinds: dict[tuple[bool, bool], list[int]] = {}
    for r, holonomic in enumerate(rows.holonomic):
        kinds.setdefault((turns(r), holonomic), []).append(r)
    return [tuple(own) for own in kinds.values() if len(own) > 1]


def layout_of(system: Any, q: Array, v: Array, t: Any) -> RowLayout:
    """Which rows belong to which constraint, without computing them."""
    return jax.eval_shape(linearize, system, q, v, t).layout


def _flat(sets: list[RowSet], field: str, like: Array) -> Array:
    """One array (n_c,) from lanes, row-major inside each set."""
    lanes = [
        _spread(lane, rows, like)
        for rows in sets
        for lane in getattr(rows, field) or (0.0,) * len(rows.value)
    ]
    return jnp.concatenate(lanes) if lanes else jnp.zeros((0, *like.shape[1:]), like.dtype)


def _spread(lane: Lane, rows: RowSet, like: Array) -> Array:
    elements = len(rows.jacobian[0][0].indices)
    return jnp.broadcast_to(jnp.asarray(lane, like.dtype), (elements, *like.shape[1:]))
