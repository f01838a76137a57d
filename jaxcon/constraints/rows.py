"""All constraint rows of a system at one instant."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.base import blocks_of
from jaxcon.constraints.primitives import Row
from jaxcon.constraints.redundancy import has_loops
from jaxcon.core import checks, numerics
from jaxcon.core.pytree import pytree, static
from jaxcon.core.summary import listed
from jaxcon.core.typing import Array, Scalar
from jaxcon.linear.jacobian import Block, Jacobian
from jaxcon.linear.saddle import Mass, Saddle

if TYPE_CHECKING:
    from jaxcon.contact.rows import BoundRows, Reactions
    from jaxcon.core.doubled import Doubled
    from jaxcon.protocols import Constraint, System
    from jaxcon.system.body_system import Snapshot
    from jaxcon.system.jump import Jump


@dataclass(frozen=True)
class RowLayout:
    """The row numbers of each constraint.

    Attributes:
        entries: (name, first row, number of rows, stride) of each constraint.
        free: numbers of the rows that have no φ, in ascending order; a position projection leaves
            them out. A rolling constraint has rows with and without a φ.
        inertial: names of rotors, which constrain nothing but resist acceleration.
        loops: True if rows may be linearly dependent: in closed loops, and in a user's function
            with several rows.
        vectors: rows of joints that are components of one vector along arbitrary axes, as (first
            row, number of elements, row numbers within each element). An example is the three rows
            of two coincident points.
    """

    entries: tuple[tuple[str, int, int, int], ...]
    free: tuple[int, ...] = ()
    inertial: tuple[str, ...] = ()
    loops: bool = False
    vectors: tuple[tuple[int, int, tuple[int, ...]], ...] = ()

    @property
    def velocity_level(self) -> tuple[str, ...]:
        """The names of the constraints that have no row with a φ."""
        return tuple(name for name in self.names if not np.any(self.holonomic[self.rows(name)]))

    @property
    def holonomic(self) -> np.ndarray:
        """A mask of the rows that have a φ, (n_c,)."""
        return ~np.isin(np.arange(self.size), self.free)

    @property
    def holds(self) -> np.ndarray:
        """A mask of the rows that remove a degree of freedom, (n_c,): all but rows of rotors."""
        holds = np.ones(self.size, bool)
        for name in self.inertial:
            holds[self.rows(name)] = False
        return holds

    @property
    def holding(self) -> np.ndarray:
        """The numbers of the rows that remove a degree of freedom."""
        return np.flatnonzero(self.holds)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the constraints, in the order of their groups."""
        return tuple(name for name, *_ in self.entries)

    def rows(self, name: str) -> np.ndarray:
        """Returns the row numbers of a constraint.

        Raises:
            ValueError: no constraint has this name.
        """
        if not isinstance(name, str) or name not in self._places:
            raise ValueError(f"constraint '{name}' is unknown; known are {list(self.names)}.")
        first, count, stride = self._places[name]
        return first + stride * np.arange(count)

    def isotropic(self, x: Array) -> Array:
        """Averages numbers over the rows that are components of one vector.

        The entries of a diagonal such as that of J M⁻¹ Jᵀ depend on the axes chosen for a vector;
        their mean over its components does not.

        Args:
            x: one number for each row, (n_c,).

        Returns:
            The numbers, (n_c,), equal for rows that are components of one vector.
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
    """The constraint violation of a state; `violation["hinge"]` is the violation of one constraint.

    Batches and trajectories have leading axes and are read in the same way.

    Attributes:
        position: φ of each row, (n_c,); zero for velocity-level rows.
        velocity: φ̇ of each row, or ψ of velocity-level rows, (n_c,).
        layout: the row numbers of each constraint.
    """

    position: Array
    velocity: Array
    layout: RowLayout = static()

    @property
    def worst(self) -> Array:
        """The largest |φ| of all rows, ()."""
        return jnp.max(jnp.abs(self.position), axis=-1, initial=0)

    @property
    def worst_rate(self) -> Array:
        """The largest |φ̇| of all rows, ()."""
        return jnp.max(jnp.abs(self.velocity), axis=-1, initial=0)

    def __repr__(self) -> str:
        """Describes one world by a line for each constraint; a batch or tracer by array shapes."""
        concrete = checks.is_concrete((self.position, self.velocity))
        if np.ndim(self.position) != 1 or not concrete:
            shapes = f"position {np.shape(self.position)}, velocity {np.shape(self.velocity)}"
            return f"Violation({shapes} of {listed(self.layout.names)})"
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
        """Returns ‖φ‖ of a constraint over its rows with a φ, or ‖ψ‖ if no row has a φ, ()."""
        if name in self.layout.velocity_level:
            return self.rate(name)
        return _norm(self.position[..., self.layout.rows(name)])

    def rate(self, name: str) -> Array:
        """Returns ‖φ̇‖ or ‖ψ‖ of a constraint, ().

        Args:
            name: name of the constraint.
        """
        return _norm(self.velocity[..., self.layout.rows(name)])


def _norm(x: Array) -> Array:
    """Returns the Euclidean norm over the last axis."""
    return numerics.norm(jnp.moveaxis(x, -1, 0))


@pytree
class Rows:
    """The constraints of a system, linearized: φ̈ = J a + γ.

    Attributes:
        residual: φ of each row, (n_c,); zero for velocity-level rows.
        rate: φ̇ of each row, or ψ of velocity-level rows, (n_c,).
        jacobian: J = ∂φ̇/∂v, (n_c, n_v).
        bias: γ, the part of φ̈ without accelerations, (n_c,).
        layout: the row numbers of each constraint.
        compliance: the diagonal of C in J a + C λ = b, (n_c,); None if C is zero.
        mass: M, set within a step for stabilizers that weight rows by it; otherwise None.
        reactions: the response of the inequality rows; None without inequality rows.
        swings: squared angular rate of each rod [rad²/s²], (element,), by the number of the rods'
            first row.
        inequalities: the inequality rows of a step; None if there are none, or none are needed.
        target: b of J a + C λ = b, (n_c,); None until a stabilizer has chosen it.
        noise: the rounding error of b, a number or (n_c,); None if unknown.
        force: a generalized force added by the stabilizer, (n_v,) [N, N m]; None for none.
    """

    residual: Array
    rate: Array
    jacobian: Jacobian
    bias: Array
    layout: RowLayout = static()
    compliance: Array | None = None
    mass: Mass | None = None
    reactions: Reactions | None = None
    swings: dict[int, Array] = dataclasses.field(default_factory=dict)
    inequalities: BoundRows | None = None
    target: Array | None = None
    noise: Scalar | None = None
    force: Array | None = None

    def with_target(self, target: Array, noise: Scalar | None = None) -> Rows:
        """Returns the rows with the right-hand side b of J a + C λ = b.

        Args:
            target: b, (n_c,).
            noise: the rounding error of b, a number or (n_c,); None if unknown.
        """
        return dataclasses.replace(self, target=target, noise=noise)

    @property
    def right_hand_side(self) -> Array:
        """The right-hand side b of J a + C λ = b, (n_c,).

        Raises:
            TypeError: no stabilizer has chosen b.
        """
        if self.target is None:
            raise TypeError(
                "these rows have no target b: Stabilizer.constraint_equations must return"
                " rows.with_target(b)."
            )
        return self.target

    @property
    def jump(self) -> Jump | None:
        """The velocity jump by impacts at the end of a step; None if no impact can occur."""
        return None if self.reactions is None else self.reactions.jump

    @property
    def violation(self) -> Violation:
        """The violations of the constraints: φ in position and φ̇ in velocity."""
        return Violation(self.residual, self.rate, self.layout)

    def earlier(self, delay: Array) -> Rows:
        """Returns the rows with φ̇ at the earlier time t − τ, for a constant v.

        φ̇(q ⊖ τ v, v, t − τ) = φ̇ − τ γ to first order. Velocity-level rows and rotors are
        unchanged: ψ must vanish at q itself, and rotors constrain nothing.

        Args:
            delay: τ, () [s].
        """
        held = self.layout.holds & self.layout.holonomic
        held = held.reshape(-1, *(1,) * (self.bias.ndim - 1))
        rate = self.rate - jnp.where(held, delay[None] * self.bias, 0)
        return dataclasses.replace(self, rate=rate)

    def only(self, kept: np.ndarray) -> Rows:
        """Keeps the rows in a mask; every other row becomes the trivial equation λ = b.

        Args:
            kept: the mask of the rows that stay, (n_c,).
        """
        if kept.all():
            return self
        open_ = jnp.asarray(~kept, self.bias.dtype).reshape(-1, *(1,) * (self.bias.ndim - 1))
        stiff = 0.0 if self.compliance is None else self.compliance * (1 - open_)
        compliance = jnp.broadcast_to(stiff + open_, self.bias.shape)
        jacobian = self.jacobian.only(kept, self.bias)
        return dataclasses.replace(self, jacobian=jacobian, compliance=compliance)


def linearize(
    system: System,
    q: Array,
    v: Array,
    t: Doubled | Scalar,
    inequalities: Callable[[Snapshot], BoundRows] | None = None,
) -> Rows:
    """Linearizes every constraint at one instant: φ, φ̇, J and γ.

    Args:
        system: the system with the constraints.
        q: positions, (n_q,).
        v: velocities, (n_v,).
        t: time, () [s].
        inequalities: a function snapshot → inequality rows; None if they are not needed.

    Returns:
        The rows, grouped by constraints of equal structure.
    """
    snapshot = system.snapshot(q, v, t)
    groups = [(group, group.rows(snapshot)) for group in system.constraints]
    blocks: list[list[Block]] = []
    entries: list[tuple[str, int, int, int]] = []
    free: list[int] = []
    swings: dict[int, Array] = {}
    vectors: list[tuple[int, int, tuple[int, ...]]] = []
    start = 0
    for group, rows in groups:
        k = len(group.names)
        blocks.append(blocks_of(snapshot.system, group.places, rows, start))
        if group.has_vectors:
            dim = snapshot.system.layout.dim
            vectors += [(start, k, component) for component in components(rows, blocks[-1], dim)]
        if rows:  # a joint without rows, such as a Span, only measures a coordinate
            entries += [(name, start + i, len(rows), k) for i, name in enumerate(group.names)]
        for row in rows:
            if row.swing is not None:
                swings[start] = jnp.asarray(row.swing)
            if not row.holonomic:
                free += range(start, start + k)
            start += k
    jacobian = Jacobian(tuple(b for own in blocks for b in own), (start, v.shape[0]))
    residual, rate, bias = (_flat(groups, field, v) for field in ("value", "rate", "bias"))
    soft = any(row.compliance is not None for _, rows in groups for row in rows)
    compliance = _flat(groups, "compliance", v) if soft else None
    inertial = tuple(name for group, _ in groups if group.is_inertia for name in group.names)
    driven = [group.driven for group, _ in groups if group.driven is not None]
    closing = (b for (group, _), b in zip(groups, blocks, strict=True) if group.closes_loops)
    loops = has_loops(closing) or len(set(driven)) < len(driven)
    loops |= any(not group.independent and len(rows) > 1 for group, rows in groups)
    layout = RowLayout(tuple(entries), tuple(free), inertial, loops, tuple(vectors))
    bounds = None if inequalities is None else inequalities(snapshot)
    return Rows(
        residual, rate, jacobian, bias, layout, compliance, swings=swings, inequalities=bounds
    )


def saddle(
    system: System,
    q: Array,
    rows: Rows,
    force: Array,
    target: Array,
    noise: Scalar | None = None,
) -> Saddle:
    """Returns the saddle system M a = f + Jᵀλ, J a + C λ = b.

    Args:
        system: the system with the mass matrix M.
        q: positions, (n_q,).
        rows: the linearized constraints.
        force: f, (n_v,).
        target: b, (n_c,).
        noise: the rounding error of b; see `Saddle`.
    """
    mass = system.mass(q) if rows.mass is None else rows.mass
    layout = rows.layout
    return Saddle(mass, force, rows.jacobian, target, rows.compliance, noise, layout.loops, layout)


def keeps_rows(system: Saddle, rows: Rows) -> bool:
    """Returns True if a stabilizer has returned the very arrays of J and C that it was given.

    `Penalty`, for example, makes joints compliant.

    Args:
        system: the saddle system of the rows that the stabilizer returned.
        rows: the rows that it was given.
    """
    return system.jacobian is rows.jacobian and system.compliance is rows.compliance


def components(rows: list[Row], blocks: list[Block], dim: int) -> list[tuple[int, ...]]:
    """Groups the rows of a joint that are components of one vector, either of lengths or of angles.

    The pulls (∂φ̇/∂v) of an angle have no force part. These zeros are known during tracing.

    Args:
        rows: the rows of the joints.
        blocks: the blocks of their Jacobian.
        dim: 2 or 3.

    Returns:
        The groups of two or more rows, as row numbers within a joint.
    """

    def turns(r: int) -> bool:
        linear = [x for block in blocks for x in list(block.value[r])[:dim]]
        return all(isinstance(x, int | float) and x == 0 for x in linear)

    kinds: dict[tuple[bool, bool], list[int]] = {}
    for r, row in enumerate(rows):
        kinds.setdefault((turns(r), row.holonomic), []).append(r)
    return [tuple(group) for group in kinds.values() if len(group) > 1]


def layout_of(system: System, q: Array, v: Array, t: Doubled | Scalar) -> RowLayout:
    """Returns the row numbers of each constraint, by tracing the rows without computing them."""
    return jax.eval_shape(linearize, system, q, v, t).layout


def _flat(groups: list[tuple[Constraint, list[Row]]], field: str, like: Array) -> Array:
    """Concatenates one field of all rows, in order, to an array (n_c,); None counts as zero."""
    lanes = []
    for group, rows in groups:
        shape = (len(group.names), *like.shape[1:])
        for row in rows:
            lane = getattr(row, field)
            x = jnp.asarray(0.0 if lane is None else lane, like.dtype)
            lanes.append(jnp.broadcast_to(x, shape))
    return jnp.concatenate(lanes) if lanes else jnp.zeros((0, *like.shape[1:]), like.dtype)
