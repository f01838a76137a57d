"""Forces of a step by name: the wrench of each constraint, limit, contact and force element.

An element acts on a body by a generalized force: Jᵀλ of its rows, or the force of a force element.
In space, the generalized force is (F, Rᵀτ): the force F in the world frame, and the torque τ about
the center of mass x, rotated to the body frame. About a point p, the torque is τ + (x − p) × F.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.custom import Custom
from jaxcon.core.checks import shortened
from jaxcon.core.lanes import Vector, times, total
from jaxcon.core.status import failed
from jaxcon.core.typing import Array, PyTree
from jaxcon.staging import batch_last
from jaxcon.staging.failure import mask_failed_gradients
from jaxcon.staging.worlds import batch_of, broadcast_worlds, where_tree
from jaxcon.system.forces import CustomForces
from jaxcon.system.layout import Layout, Place
from jaxcon.system.state import State, with_turns

if TYPE_CHECKING:
    from jaxcon.constraints.rows import RowLayout
    from jaxcon.contact.rows import BoundSet, Reactions
    from jaxcon.execution.step import SolutionAt
    from jaxcon.protocols import Constraint
    from jaxcon.step import StepInfo
    from jaxcon.system.body_system import BodySystem, Snapshot

Pull = tuple[Place, Vector]
"""The bodies on one side of the elements, and the generalized force on each, lanes (element,)."""

KINDS = ("constraints", "bounds", "forces")
"""The fields of a system that hold groups of elements."""


def wrench_in(
    system: BodySystem, info: StepInfo | SolutionAt, name: str, body: str | None = None
) -> Array:
    """Returns the wrench of an element on a body, in the world frame; see `jc.wrench`.

    Args:
        system: the system of the state.
        info: the info of one world, with its state and control.
        name: name of the element.
        body: name of the body; by default the element's last body.

    Raises:
        ValueError: the element is unknown, or does not act on the body.
    """
    layout = system.layout
    groups = [(kind, i, group) for kind in KINDS for i, group in enumerate(getattr(system, kind))]
    place = next((x for x in groups if isinstance(name, str) and name in x[2].names), None)
    if place is None:
        names = [x for *_, group in groups for x in group.names]
        raise ValueError(f"element {shortened(name)} is unknown; known are {names}.")
    kind, index, group = place
    element = group.names.index(name)
    bodies = [side[element] for side in _sides(group, layout)]
    moving = [x for x in bodies if x in layout.places]
    target = bodies[-1] if body is None else body
    sign, acting = 1, [i for i, x in enumerate(moving) if x == target]
    # one moving and one fixed body: action is reaction
    if target in bodies and not acting and len(set(bodies)) == 2:
        sign, acting = -1, [*range(len(moving))]
    if not acting:
        raise ValueError(
            f"body: element '{name}' acts on {bodies}; the wrench on {shortened(target)} does"
            " not follow from theirs."
        )
    read = _reader(kind, index, info.violation.layout)
    given = (system, info.state, info.control, info.multipliers, info.reactions, info.status)
    blocks = batch_last.call(read, *given)
    return sign * total(blocks[i][:, element] for i in acting)


def _sides(group: Any, layout: Layout) -> list[tuple[str, ...]]:
    """Returns the names of the bodies on each side of the elements of a group.

    There is one tuple for each side, such as all first bodies, with one name for each element.
    """
    if isinstance(group, CustomForces):  # forces on fixed bodies are not computed
        return [(body,) for body in group.law.bodies if body in layout.places]
    if isinstance(group, Custom):
        return [(body,) for body in group.law.bodies]
    return [
        place.fixed
        if place.group is None
        else tuple(layout.groups[place.group].names[i] for i in place.indices)
        for place in group.places
    ]


@functools.lru_cache(maxsize=256)
def _reader(kind: str, index: int, layout: RowLayout) -> Callable[..., list[Array]]:
    """Returns a function that computes the wrenches of all elements of one group.

    The function takes (system, state, control, multipliers, reactions, status). It returns one
    array (d, element) for each side whose bodies move; d is the number of components of a wrench.
    In failed worlds, wrenches and their gradients are zero.

    Args:
        kind: the field of the system that holds the group, one of `KINDS`.
        index: the index of the group in this field.
        layout: the row numbers of each equality constraint.
    """

    def blocks(
        system: BodySystem,
        state: State,
        control: PyTree,
        multipliers: Array,
        reactions: Reactions | None,
    ) -> list[Array]:
        system = with_turns(system, state.turns, state.angle_remainder)
        snapshot = system.snapshot(state.q, state.v, state.instant)
        group, anchors = getattr(system, kind)[index], None
        if kind == "constraints":
            pulls = equality_pulls(snapshot, group, layout, multipliers)
        elif kind == "bounds":
            assert reactions is not None
            dt = jnp.ones_like(state.time)  # any value: directions of forces do not depend on it
            rows = group.bounds(snapshot, control, dt)
            pulls, anchors = inequality_pulls(group, rows, reactions), rows.place
            if rows.points is not None:
                return [*_wrenches(snapshot, pulls, None)]
        else:
            pulls = [pull for pull in group.pulls(snapshot, control) if pull[0].group is not None]
            if not pulls:  # no control, no force
                pulls = [(place, Vector()) for place in group.places if place.group is not None]
        return [*_wrenches(snapshot, pulls, anchors or group.anchors(snapshot))]

    def masked(status: Array, *given: Any) -> tuple[list[Array], Array]:
        found = blocks(*given)
        return where_tree(~failed(status), found, [jnp.zeros_like(x) for x in found]), status

    def read(
        system: BodySystem,
        state: State,
        control: PyTree,
        multipliers: Array,
        reactions: Reactions | None,
        status: Array,
    ) -> list[Array]:
        given = (system, state, control, multipliers, reactions, status)
        batch = batch_of(given, state.q.ndim - 1)
        state, status = broadcast_worlds((state, status), batch)
        given = (status, system, state, control, multipliers, reactions)
        return mask_failed_gradients(masked, given, batch)[0]

    return read


def equality_pulls(
    snapshot: Snapshot, group: Constraint, layout: RowLayout, multipliers: Array
) -> list[Pull]:
    """Returns the generalized forces Jᵀλ of constraints, for each side whose bodies move."""
    rows = group.rows(snapshot)
    λ = []
    if rows:  # a joint without rows, such as a Span, only measures a coordinate
        numbers = np.stack([layout.rows(name) for name in group.names])
        λ = list(jnp.moveaxis(multipliers[numbers], 1, 0))
    moving = [(side, place) for side, place in enumerate(group.places) if place.group is not None]
    return [(place, _sum(λ, [row.pulls[side] for row in rows])) for side, place in moving]


def inequality_pulls(group: Any, rows: BoundSet, reactions: Reactions) -> list[Pull]:
    """Returns the generalized forces Jᵀλ of inequality rows, for each side whose bodies move.

    The forces at all contact points of an element are added.

    Args:
        group: the group of inequality elements.
        rows: the rows of the group.
        reactions: the multipliers λ of all inequality rows of the system.
    """
    points, every = rows.points or 1, (*rows.rows, *rows.rolls, *rows.spins)
    numbers = np.stack([reactions.layout.rows(name) for name in group.names])
    numbers = numbers.reshape(-1, len(every))
    λ = list(jnp.moveaxis(reactions.multipliers[numbers], 1, 0))
    if rows.direction is not None:
        # the row is that of the nearer stop; in a fast step the farther one may have acted
        assert reactions.direction is not None
        λ[0] = λ[0] * rows.direction * reactions.direction[numbers[:, 0]]
    pulls = []
    for side, place in enumerate(rows.places):
        if place.group is not None:
            force = _sum(λ, [row.pulls[side] for row in every])
            each = force.map(lambda x: x.reshape(-1, points, *x.shape[1:]).sum(axis=1))
            pulls.append((Place(place.group, place.indices[::points]), each))
    return pulls


def _sum(multipliers: list[Array], pulls: list[Vector]) -> Vector:
    """Returns the generalized force Σ λ_r J_r, summed over rows r, as lanes (element,).

    Args:
        multipliers: λ_r of each row r, (element,).
        pulls: the entries J_r of the Jacobian for each row r. If there are no rows, the result is
            an empty vector.
    """
    if not pulls:  # a joint without rows, such as a Span
        return Vector()
    rows = [[times(x, λ) for x in pull] for λ, pull in zip(multipliers, pulls, strict=True)]
    zero = jnp.zeros_like(multipliers[0])
    return Vector(*(zero + total(x) for x in zip(*rows, strict=True)))


def _wrenches(snapshot: Snapshot, pulls: list[Pull], anchor: Vector | None) -> Iterator[Array]:
    """Yields the wrenches (F, τ) of all elements on each side, (d, element).

    Args:
        snapshot: the system at one instant.
        pulls: the bodies and the generalized forces of each side.
        anchor: the points about which torques are taken, world frame; None for the centers of mass.
    """
    layout, like = snapshot.system.layout, snapshot.q[:1]
    dim = layout.dim
    for place, pull in pulls:
        assert place.group is not None
        frame, shape = snapshot.frame(place), (len(place.indices), *like.shape[1:])
        pull = pull or Vector(*(0.0,) * layout.groups[place.group].kind.n_v)
        force = Vector(*pull[:dim])
        lanes: list[Any] = [*force]
        if len(pull) > dim:
            torque = pull[2] if dim == 2 else frame.rotation @ Vector(*pull[dim:])
            if anchor is not None:
                torque = torque + (frame.position - anchor).cross(force)
            lanes += [torque] if dim == 2 else [*torque]
        yield jnp.stack([jnp.broadcast_to(jnp.asarray(x, like.dtype), shape) for x in lanes])
