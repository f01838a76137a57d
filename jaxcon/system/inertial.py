"""Changes of the ten inertial parameters of a body in a system.

The coordinates of a body are those of its principal frame P, at its center of mass, where M is
constant and diagonal. Users work with the frame F in which they gave the body. Changed parameters
move P within the body, by a vector p and a turn A, both in the old P. The frame F, and all points
and axes that elements fix to the body, stay in place on it. In the new P they are

    points  s → Aᵀ (s − p),   directions  u → Aᵀ u,   turns  q_a* q_b → A_a* (q_a* q_b) A_b,

where q_a* q_b is the orientation of body b in body a, and A_a and A_b are the turns of both bodies'
principal frames.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.geometry import quaternion
from jaxcon.geometry.inertia import Inertia
from jaxcon.geometry.pose import Pose
from jaxcon.geometry.solid import resolve_inertia, resolve_mass
from jaxcon.system.elements import Elements, Grid, Numbers, element_at, side_by_side
from jaxcon.system.layout import Layout, Place
from jaxcon.system.state import MethodMemory, State, checked_system

if TYPE_CHECKING:
    from jaxcon.system.body_system import BodySystem, MassProperties

E = TypeVar("E")

POINTS = {"anchor", "start", "end"}
DIRECTIONS = {"axis", "first", "second", "normal", "travel", "edge"}
"""The first words of the names of fields with points (`POINTS`) or directions (`DIRECTIONS`)."""
SIDES = {"b": 1, "c": 2}
"""The index of the body whose frame a field uses, by the last word of the field's name.

Other fields are in the frame of the first body, or of the second if `Element.in_b` names them.
"""


class Changed(NamedTuple):
    """The changed inertial parameters of a body.

    Attributes:
        mass, moments: new values [kg], [kg m²].
        offset: pose of the user's frame in the principal frame; None if they coincide.
        shift: pose of the new principal frame in the old one; None if it stays in place. The pose
            has no orientation if the frame does not turn.
    """

    mass: Array
    moments: Array | None
    offset: Pose | None
    shift: Pose | None


class Shift(NamedTuple):
    """Shifts of the principal frames of the bodies on one side of elements, as lanes (element,).

    Attributes:
        position: p [m].
        turn: A as a unit quaternion; None if no body turns.
    """

    position: Vector
    turn: Vector | None


def numbers(properties: MassProperties, i: int, offset: Pose | None) -> dict[str, Any]:
    """Returns the inertial parameters of one body by name, as `with_params` takes them.

    Args:
        properties: mass properties of the group of the body.
        i: index of the body in the group.
        offset: pose of the user's frame in the principal frame; None if they coincide.
    """
    fields = {"mass": properties.mass[i]}
    if properties.moments is None:
        return fields
    moments = element_at(properties.moments, i)
    frame = _identity(moments) if offset is None else offset.inverse
    fields |= {"inertia": moments, "center": frame.position}
    return fields | ({} if moments.ndim == 0 else {"axes": frame.orientation})


def changed(
    name: str, given: Mapping[str, Any], known: Mapping[str, Any], offset: Pose | None
) -> Changed:
    """Replaces some inertial parameters of a body.

    Args:
        name: name of the body.
        given: new values, by field.
        known: all current values, from `numbers`.
        offset: pose of the user's frame in the principal frame; None if they coincide.

    Raises:
        ValueError: a wrong shape, a value out of range, or a parameter given twice.
    """
    owner, dtype = f"body '{name}'", known["mass"].dtype
    if "center" not in known:
        return Changed(resolve_mass(f"particle '{name}'", given["mass"], dtype), None, None, None)
    dim = len(known["center"])
    whole = isinstance(given.get("inertia"), Inertia)
    if whole and len(given) > 1:
        raise ValueError(
            f"{owner}: an Inertia brings mass, center and axes; give it alone, without"
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
    frame = Pose(center, quaternion.normalize(given["axes"]) if turns else axes)
    shift = frame if offset is None else offset.then(frame)
    shift = shift if turns else Pose(shift.position)
    return Changed(solid.mass, solid.moments, frame.inverse, shift)


def moved(element: E, shifts: Mapping[str, Pose], layout: Layout) -> E:
    """Expresses the points and axes of a group of elements in shifted principal frames.

    Elements with a user's function do not change, because the function gets the user's frames.

    Args:
        element: the group of elements.
        shifts: for each shifted body, the pose of its new principal frame in the old one.
        layout: layout of the system.

    Raises:
        ValueError: the principal axes of a body turn, and an element depends on them.
    """
    if not shifts or not isinstance(element, Elements):
        return element
    sides = [_side(place, shifts, layout) for place in element.places]
    if all(side is None for side in sides):
        return element
    if element.law.by_principal_axes and any(s and s.turn is not None for s in sides):
        raise ValueError(
            f"with_params: {list(element.names)} go by the principal axes of their bodies, which"
            " must not turn; build the scene with the new inertia."
        )
    params = {
        field: _moved(
            field,
            x,
            sides,
            1 if field in element.law.in_b else SIDES.get(field.rpartition("_")[2], 0),
        )
        for field, x in element.params.items()
    }
    return dataclasses.replace(element, params=params)


def restate(state: State, before: BodySystem, after: BodySystem) -> State:
    """Converts a state to a system with other principal frames.

    q and v describe centers of mass and principal axes. If `with_params` changes `center`, `axes`
    or a full `inertia`, the same motion of the user's frames has other values of q and v. After
    other changes the state stays as it is.

    Args:
        state: state of one world of `before`.
        before: the system of the state.
        after: the system `before` with other numbers, from `BodySystem.with_params`.

    Returns:
        The state of `after`. The method's memory depends on the old frames, so only the multipliers
        of inequality constraints are kept if frames changed. For a method with other memory, pass
        the result s to `jc.init(after, method, s.q, s.v, s.time, s.turns)`.

        Concrete frames are compared by values. Traced frames count as changed unless both systems
        contain the same arrays. A function under `jit` that takes one system and changes it with
        `with_params` therefore keeps the memory. A function that takes both systems as arguments
        returns the right q and v. It drops the memory if a body's principal frame differs from its
        user's frame.

    Raises:
        TypeError, ValueError: the state does not belong to `before`, or the systems differ in more
            than numbers.
    """
    before = checked_system(before, state)
    if getattr(after, "layout", None) != before.layout:
        raise ValueError("restate: the systems must have the same bodies in the same order.")
    q, v, offsets, memory = state.q, state.v, before.offsets, state.memory
    others = [
        name
        for name in offsets | after.offsets
        if not _same_tree(offsets.get(name), after.offsets.get(name))
    ]
    for name in others:
        group = before.layout.groups[before.layout.locate(name)[0]]
        offset = after.offsets.get(name)
        motion = before.motion(name, state.q, state.v)
        motion = motion.seen_from(None if offset is None else offset.inverse)
        x, y = group.kind.coordinates(motion)
        q, v = q.at[before.layout.q(name)].set(x), v.at[before.layout.v(name)].set(y)
    if others:  # multipliers do not depend on body frames; accelerations and histories do
        multipliers = MethodMemory(*memory).contact_multipliers
        kept = MethodMemory(contact_multipliers=multipliers)
        memory = kept if jax.tree.leaves(multipliers) else ()
    return dataclasses.replace(state, q=q, v=v, memory=memory)


def _placed(
    owner: str, solid: Inertia, given: Mapping[str, Any], default: Pose | None
) -> dict[str, Any]:
    """Returns new values of `center` and `axes`, the principal frame in the user's frame.

    Values that do not change are left out.

    Args:
        owner: first words of errors.
        solid: the new inertia, with a center and axes if its form has them.
        given: new values, by field.
        default: center and axes for an `Inertia` without them; None to keep the body's center and
            axes.

    Raises:
        ValueError: axes given twice, or axes that are no quaternion.
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
    """Returns the identity pose in NumPy arrays, which stay concrete while JAX traces."""
    dim = 2 if moments.ndim == 0 else 3
    origin: Any = np.zeros(dim, moments.dtype)
    return Pose(origin, None if dim == 2 else np.eye(4, dtype=moments.dtype)[0])


def _same(x: Scalar, y: Scalar) -> bool:
    """Returns True if two arrays are concrete and equal."""
    return checks.is_concrete((x, y)) and np.array_equal(x, y)


def _same_tree(x: PyTree, y: PyTree) -> bool:
    """Returns True if two trees have the same structure, and arrays that are identical or equal."""
    if jax.tree.structure(x) != jax.tree.structure(y):
        return False
    pairs = zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True)
    return all(a is b or _same(a, b) for a, b in pairs)


def _side(place: Place, shifts: Mapping[str, Pose], layout: Layout) -> Shift | None:
    """Returns the shifts of the bodies on one side of elements; None if all bodies stay."""
    if place.group is None:
        return None
    names = layout.groups[place.group].names
    poses = [shifts.get(names[i]) for i in place.indices]
    shifted = [x for x in poses if x is not None]
    if not shifted:
        return None
    like = shifted[0].position
    position = [jnp.zeros_like(like) if x is None else x.position for x in poses]
    if all(x.orientation is None for x in shifted):
        return Shift(Vector.of(side_by_side(position)), None)
    identity = jnp.eye(4, dtype=like.dtype)[0]
    turn = [identity if x is None or x.orientation is None else x.orientation for x in poses]
    return Shift(Vector.of(side_by_side(position)), Vector.of(side_by_side(turn)))


def _moved(field: str, x: Numbers, sides: list[Shift | None], side: int) -> Numbers:
    """Converts one field of elements from the old principal frames to the new ones.

    Args:
        field: name of the field.
        x: values of the field.
        sides: the shifts of the bodies on each side; None if they stay.
        side: index of the side whose frames the field uses.
    """
    word = field.partition("_")[0]
    if word == "orientation":
        a, b = (None if side is None else side.turn for side in sides)
        x = x if a is None else quaternion.multiply(quaternion.conjugate(a), x)
        return x if b is None else quaternion.multiply(x, b)
    shift = sides[side] if word in POINTS or word in DIRECTIONS else None
    if shift is None:
        return x
    if isinstance(x, Grid):
        lanes = Vector(*(x.values[..., i] for i in range(x.values.shape[-1])))
        wide = jax.tree.map(lambda lane: lane[:, None], shift)
        return Grid(jnp.stack(tuple(_fixed(word, lanes, wide)), axis=-1))
    return _fixed(word, Vector.of(x), shift)


def _fixed(word: str, x: Vector, shift: Shift) -> Vector:
    """Expresses points or directions of bodies in the new principal frames.

    Args:
        word: first word of the field's name; it says whether x is a point or a direction.
        x: the points or directions in the old frames.
        shift: pose of the new frames relative to the old ones.
    """
    x = x - shift.position if word in POINTS else x
    return x if shift.turn is None else quaternion.rotate(quaternion.conjugate(shift.turn), x)
