"""Sets of contact points on a body: points that the user gives, or the corners of a box."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, DType, PyTree
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import BetweenBodies, Grid, label, own_point
from jaxcon.system.layout import Place

AXES = ("axis_x", "axis_y", "axis_z")
"""The names of the axes of a frame that an element fixes to its body."""


def box_corners(size: PyTree, position: PyTree = None, orientation: PyTree = None) -> Array:
    """Returns the corners of a box, for the field `center` of a contact.

    Args:
        size: edge lengths of the box, (dim,) [m].
        position: center of the box, (dim,) [m]. If None, the origin.
        orientation: orientation of the box, an angle () [rad] in the plane, a quaternion (4,) in
            space. If None, its edges are along the axes.

    Returns:
        The corners, (2^dim, dim) [m]; the last coordinate changes fastest.

    Raises:
        ValueError: a wrong shape, an edge that is not positive, or an orientation without length.
    """
    size = jnp.asarray(checks.check("box_corners", "size", size, above=0))
    if size.ndim != 1 or size.shape[0] not in (2, 3):
        raise ValueError(f"box_corners: size must have shape (2,) or (3,), got {size.shape}.")
    size = size.astype(jnp.result_type(size, float))
    owner, dim, dtype = "box_corners", len(size), size.dtype
    middle, turn = jnp.zeros_like(size), None
    if position is not None:
        middle = checks.real(owner, "position", position, dtype, (dim,))
    if orientation is not None:
        turn = _orientation(owner, "orientation", orientation, dim, dtype)
    halves = jnp.asarray(_signs(dim), dtype) * size[None] / 2
    return jax.vmap(Pose(middle, turn).point)(halves)


def own_points(element: BetweenBodies, what: str, points: Any, pose: Pose) -> Any:
    """Converts world points to the frame of their body: one point (dim,), or a Grid of (k, dim).

    Raises:
        ValueError: the points have a wrong shape, are not finite, or are away from a particle.
    """
    if not _several(points):
        return pose.local_point(own_point(element, what, points, pose))
    owner, dim = label(element), pose.position.shape[0]
    if len(points) < 2:
        raise ValueError(
            f"{owner}: {what} must have shape ({dim},), or (k, {dim}) for several points, got"
            f" {np.shape(points)}."
        )
    shape = (len(points), dim)
    points = checks.real(owner, what, points, pose.position.dtype, shape)
    if pose.orientation is None:
        raise ValueError(f"{owner}: {what} has {shape[0]} points, but a particle is one.")
    return Grid(jax.vmap(pose.local_point)(points))


def own_frame(
    element: BetweenBodies,
    pose: Pose,
    user_frame: Pose,
    names: tuple[str, str] = ("position", "orientation"),
    given: tuple[Any, Any] | None = None,
) -> tuple[Array, dict[str, Array]]:
    """Returns the frame that an element fixes to its body: the origin, and the axes by name.

    Args:
        element: the element. Its two fields are given in the world frame at assembly; if a field is
            None, the user's frame of the body is used.
        pose: pose of the body's principal frame.
        user_frame: pose of the user's frame of the body, relative to the principal frame.
        names: names of the two fields, for error messages.
        given: the values of the two fields. If None, they are attributes of the element.

    Raises:
        ValueError: a field has a wrong shape, or a quaternion is zero.
    """
    owner, dim, dtype = label(element), pose.position.shape[0], pose.position.dtype
    place, turn = (getattr(element, name) for name in names) if given is None else given
    origin, axes = user_frame.position, user_frame.rotation.T
    if place is not None:
        origin = pose.local_point(own_point(element, names[0], place, pose))
    if turn is not None:
        turn = _orientation(owner, names[1], turn, dim, dtype)
        axes = jax.vmap(pose.local_direction)(Pose(origin, turn).rotation.T)
    return origin, dict(zip(AXES, axes, strict=False))


def given_points(p: dict[str, Any]) -> Vector | None:
    """Returns the points of elements as lanes (element, k); None if each element has one point."""
    if not isinstance(p["anchor_b"], Grid):
        return None
    points = p["anchor_b"].values
    return Vector(*(points[:, :, i] for i in range(points.shape[2])))


def corners(p: dict[str, Any]) -> Vector:
    """Returns the corners of boxes in the frames of their bodies, lanes (element, 2^dim)."""
    halves = [p[axis] * (size / 2) for axis, size in zip(AXES, p["size"], strict=False)]
    result = []
    for signs in _signs(len(halves)):
        corner = p["anchor_b"]
        for sign, half in zip(signs, halves, strict=True):
            corner = corner + half * float(sign)
        result.append(corner)
    return Vector(*(jnp.stack(lanes, axis=1) for lanes in zip(*result, strict=True)))


def spread(p: dict[str, Any], points: Vector) -> dict[str, Any]:
    """Repeats each element's parameters once per contact point, as lanes (element × point,)."""
    count = points[0].shape[1]

    def each(x: Array | Grid) -> Array | Grid:
        return x if isinstance(x, Grid) else jnp.repeat(x, count, axis=0)

    def flat(x: Array) -> Array:
        return x.reshape(-1, *x.shape[2:])

    repeated = jax.tree.map(each, p, is_leaf=lambda x: isinstance(x, Grid))
    return repeated | {"anchor_b": points.map(flat)}


def spread_place(place: Place, count: int) -> Place:
    """Repeats each element's body once per contact point of the element, `count` times."""
    indices = tuple(i for i in place.indices for _ in range(count))
    return Place(place.group, indices, tuple(n for n in place.fixed for _ in range(count)))


def _orientation(owner: str, what: str, given: PyTree, dim: int, dtype: DType) -> Array:
    """Returns a checked orientation: an angle () in the plane, a unit quaternion (4,) in space."""
    turn = checks.real(owner, what, given, dtype, () if dim == 2 else (4,))
    if dim == 2:
        checks.radians(owner, what, turn)
        return turn
    checks.nonzero(owner, what, turn)
    return turn / jnp.sqrt(jnp.sum(turn * turn))


def _signs(dim: int) -> np.ndarray:
    """Returns the signs of the coordinates of a box's corners, (2^dim, dim)."""
    return np.array(list(itertools.product((-1.0, 1.0), repeat=dim)))


def _several(points: PyTree) -> bool:
    """Returns True for an array of points, (k, dim)."""
    try:
        return points is not None and jnp.asarray(points).ndim == 2
    except (TypeError, ValueError, OverflowError):
        return False
