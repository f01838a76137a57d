"""Other inertial parameters of a body that is part of a system: all ten of them.

A body is simulated by its principal frame P, at its centre of mass, where M is constant and
diagonal, and read by the frame F in which the user gave it. Other parameters put P elsewhere in the
body, at p and turned by A as seen from where it was; F, and every point and axis that elements fix
to the body, stay where they are on it:

    points  s → Aᵀ (s − p),   directions  u → Aᵀ u,   turns  q_a* q_b → A_a* (q_a* q_b) A_b.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.lanes import Lane, Vector
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion
from jaxcon.geometry.inertia import Inertia
from jaxcon.geometry.pose import Pose
from jaxcon.geometry.solid import resolve_inertia, resolve_mass
from jaxcon.model.elements import Elements, Grid, element_at, side_by_side
from jaxcon.model.forces import CustomForces
from jaxcon.model.layout import Layout, Place
from jaxcon.model.state import MethodMemory, State, at

POINTS = {"anchor", "start", "end"}
DIRECTIONS = {"axis", "first", "second", "normal", "travel", "edge"}
"""First words of the fields in which elements keep points and directions of their bodies."""
SIDES = {"b": 1, "c": 2}
"""The body in whose frame they are, by the last word; of others the first, or the second where the
element's `in_b` names the field."""


class Changed(NamedTuple):
    """What a body becomes.

    Attributes:
        mass, moments: [kg], [kg m²].
        offset: the user's frame in the principal frame; None where they coincide.
        shift: the new principal frame in the old one, without an orientation where it is not
            turned; None where it stays.
    """

    mass: Array
    moments: Any
    offset: Pose | None
    shift: Pose | None


class Shift(NamedTuple):
    """Shifts of the bodies on one side of elements: lanes (element,); no turn where none turns."""

    position: Vector
    turn: Vector | None


def numbers(properties: Any, i: int, offset: Pose | None) -> dict[str, Any]:
    """The inertial parameters of one body of a group by name, as `with_params` takes them.

    Args:
        properties: `MassProperties` of the group.
        i: its index there.
        offset: the user's frame in the principal frame; None where they coincide.
    """
    fields = {"mass": properties.mass[i]}
    if properties.moments is None:
        return fields
    moments = element_at(properties.moments, i)
    own = _identity(moments) if offset is None else offset.inverse
    fields |= {"inertia": moments, "center": own.position}
    return fields | ({} if moments.ndim == 0 else {"axes": own.orientation})


def changed(
    name: str, given: Mapping[str, Any], known: Mapping[str, Any], offset: Pose | None
) -> Changed:
    """A body with some of its parameters replaced.

    Args:
        name: of the body.
        given: the new ones, by field.
        known: all fields as they are (`numbers`).
        offset: the user's frame in the principal frame; None where they coincide.

    Raises:
        ValueError: a wrong shape, a value out of range, or one thing given twice.
    """
    owner, dtype = f"body '{name}'", known["mass"].dtype
    if "center" not in known:
        return Changed(resolve_mass(f"particle '{name}'", given["mass"], dtype), None, None, None)
    dim = len(known["center"])
    whole = isinstance(given.get("inertia"), Inertia)
    if whole and len(given) > 1:
        raise ValueError(
            f"{owner}: an Inertia brings mass, centre and axes; give it alone, without"
            f" {sorted(set(given) - {'inertia'})}."
        )
    mass = None if whole else given.get("mass", known["mass"])
    solid = resolve_inertia(owner, mass, given.get("inertia", known["inertia"]), dim, dtype)
    given = _placed(owner, solid, given, _identity(solid.moments) if whole else None)
    moves = "center" in given and not _same(given["center"], known["center"])
    turns = "axes" in given and not _same(given["axes"], known["axes"])
    if not moves and not turns:
        return Changed(solid.mass, solid.moments, offset, None)
    center = checks.real(owner, "center", given.get("center", known["center"]), dtype, (dim,))
    axes = known.get("axes")
    own = Pose(center, quaternion.normalize(given["axes"]) if turns else axes)
    shift = own if offset is None else offset.then(own)
    shift = shift if turns else Pose(shift.position)
    return Changed(solid.mass, solid.moments, own.inverse, shift)


def moved(element: Any, shifts: Mapping[str, Pose], layout: Layout) -> Any:
    """A group of elements with what they fix to moved bodies where it was on them.

    A user's function sees the frames that the user gave, and stays as it is.

    Args:
        element: the group.
        shifts: by body, its new principal frame in the old one.
        layout: of the system.

    Raises:
        ValueError: the principal axes of a body turn whose elements go by them.
    """
    if not shifts or not isinstance(element, Elements) or isinstance(element, CustomForces):
        return element
    sides = [_side(place, shifts, layout) for place in element.places]
    if all(side is None for side in sides):
        return element
    law = getattr(element, "joint", None) or getattr(element, "law", None)
    if getattr(law, "by_principal_axes", False) and any(s and s.turn is not None for s in sides):
        raise ValueError(
            f"with_params: {list(element.names)} go by the principal axes of their bodies, which"
            " must not turn; build the scene with the new inertia."
        )
    in_b = getattr(law, "in_b", ())
    params = {
        field: _moved(field, x, sides, 1 if field in in_b else _side_of(field))
        for field, x in element.params.items()
    }
    return dataclasses.replace(element, params=params)


def restate(state: State, before: Any, after: Any) -> State:
    """Returns the motion in coordinates of a system with other principal frames.

    q and v are those of centres of mass and principal axes. After `with_params` has changed
    `center`, `axes` or a full `inertia`, they are others for the same place and motion of the
    frames in which the bodies were given; elsewhere states stay what they are.

    Args:
        state: of one world of `before`.
        before: the system.
        after: the same with other numbers (`BodySystem.with_params`).

    Returns:
        The state of `after`. What a method remembers is of the old frames and left out, but for
        the multipliers of inequality constraints: one with a memory takes
        `jc.init(after, method, s.q, s.v, s.time, s.turns)` of the state s.

    Raises:
        TypeError, ValueError: the state is not one of `before`, or the systems differ in more than
            numbers.
    """
    before = at(before, state)
    if getattr(after, "layout", None) != before.layout:
        raise ValueError("restate: the systems must have the same bodies in the same order.")
    q, v, offsets = state.q, state.v, before.offsets
    others = [n for n in offsets | after.offsets if offsets.get(n) is not after.offsets.get(n)]
    for name in others:
        group = before.layout.groups[before.layout.locate(name)[0]]
        offset = after.offsets.get(name)
        motion = before.motion(name, state.q, state.v)
        motion = motion.seen_from(None if offset is None else offset.inverse)
        x, y = group.kind.coordinates(motion)
        q, v = q.at[before.layout.q(name)].set(x), v.at[before.layout.v(name)].set(y)
    memory = MethodMemory(*state.memory)
    kept = state.memory
    if others:  # forces of contacts have no frame of a body; accelerations and histories have
        multipliers = jax.tree.leaves(memory.bounded)
        kept = MethodMemory(bounded=memory.bounded) if multipliers else ()
    return dataclasses.replace(state, q=q, v=v, memory=kept)


def _placed(
    owner: str, solid: Inertia, given: Mapping[str, Any], default: Pose | None
) -> dict[str, Any]:
    """What is given of where a body's principal frame is in the user's: `center`, `axes`.

    Args:
        owner: what errors begin with.
        solid: with a centre and axes where the inertia brings them.
        given: by field.
        default: both where an `Inertia` leaves them out; None where the body keeps its own.

    Raises:
        ValueError: axes twice, or no quaternion.
    """
    dtype, space = solid.moments.dtype, solid.moments.ndim > 0
    place = {}
    if "center" in given:
        dim = 3 if space else 2
        place["center"] = checks.real(owner, "center", given["center"], dtype, (dim,))
    if default is not None:
        place["center"] = default.position if solid.center is None else solid.center
    if not space:
        return place
    if solid.axes is not None and "axes" in given:
        raise ValueError(f"{owner}: a tensor has axes of its own; give it, or axes and moments.")
    if solid.axes is not None:
        place["axes"] = solid.axes.astype(dtype)
    elif default is not None:
        place["axes"] = default.orientation
    elif "axes" in given:
        axes = checks.real(owner, "axes", given["axes"], dtype, (4,))
        checks.nonzero(owner, "axes", axes)
        place["axes"] = axes
    return place


def _identity(moments: Array) -> Pose:
    """The user's frame where it is the principal one; known also while a function is traced."""
    dim = 2 if moments.ndim == 0 else 3
    origin: Any = np.zeros(dim, moments.dtype)
    return Pose(origin, None if dim == 2 else np.eye(4, dtype=moments.dtype)[0])


def _same(x: Any, y: Any) -> bool:
    """Returns True where two arrays are known to be equal."""
    return checks.is_concrete((x, y)) and np.array_equal(x, y)


def _side(place: Place, shifts: Mapping[str, Pose], layout: Layout) -> Shift | None:
    """How the bodies on one side of elements shift; None where all of them stay."""
    if place.group is None:
        return None
    names = layout.groups[place.group].names
    own = [shifts.get(names[i]) for i in place.indices]
    known = [x for x in own if x is not None]
    if not known:
        return None
    like = known[0].position
    position = [jnp.zeros_like(like) if x is None else x.position for x in own]
    if all(x.orientation is None for x in known):
        return Shift(Vector.of(side_by_side(position)), None)
    one = jnp.eye(4, dtype=like.dtype)[0]
    turn = [one if x is None or x.orientation is None else x.orientation for x in own]
    return Shift(Vector.of(side_by_side(position)), Vector.of(side_by_side(turn)))


def _moved(field: str, x: Any, sides: list[Shift | None], side: int) -> Any:
    """One field of elements, from its values in the old frames."""
    word = field.partition("_")[0]
    if word == "orientation":
        return _turned(x, sides)
    own = sides[side] if word in POINTS or word in DIRECTIONS else None
    if own is None:
        return x
    if isinstance(x, Grid):
        lanes = Vector(*(x.values[..., i] for i in range(x.values.shape[-1])))
        wide = jax.tree.map(lambda lane: lane[:, None], own)
        return Grid(jnp.stack(tuple(_fixed(word, lanes, wide)), axis=-1))
    return _fixed(word, x, own)


def _side_of(field: str) -> int:
    """The body in whose frame a field is, by its last word."""
    return SIDES.get(field.rpartition("_")[2], 0)


def _fixed(word: str, x: Vector, shift: Shift) -> Vector:
    """Points or directions of the bodies as seen from where their frames are now."""
    x = x - shift.position if word in POINTS else x
    return x if shift.turn is None else quaternion.rotate(quaternion.conjugate(shift.turn), x)


def _turned(x: Any, sides: list[Shift | None]) -> Lane | Vector:
    """The orientation of the second body in the first."""
    a, b = (None if side is None else side.turn for side in sides)
    x = x if a is None else quaternion.multiply(quaternion.conjugate(a), x)
    return x if b is None else quaternion.multiply(x, b)
