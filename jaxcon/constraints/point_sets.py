"""Several points of one body, each of which may touch: as given, or the corners of a box."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import Grid, label, own_point
from jaxcon.model.layout import Place

AXES = ("axis_x", "axis_y", "axis_z")
"""The axes of a frame that an element fixes to its body."""


def box_corners(size: Any, position: Any = None, orientation: Any = None) -> Array:
    """The corners of a box, as `center` of a contact of points.

    Args:
        size: its edges, (dim,) [m].
        position: of its middle, (dim,) [m]; the origin unless given.
        orientation: an angle () [rad] in the plane, a quaternion (4,) in space; along the axes
            unless given.

    Returns:
        (2^dim, dim) [m], the last coordinate changing fastest.

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


def own_points(element: Any, what: str, points: Any, pose: Pose) -> Any:
    """A world point in the frame of its body, (dim,), or several of them, a Grid of (k, dim).

    Raises:
        ValueError: a wrong shape, not finite, or off a particle.
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
    element: Any, pose: Pose, own: Pose, names: tuple[str, str] = ("position", "orientation")
) -> tuple[Array, dict[str, Array]]:
    """Where an element fixes a frame to its body: the origin, and the axes by name.

    Args:
        element: with the world's numbers at assembly, each None for those of the body itself.
        pose: of the body's principal frame.
        own: the frame in which the user gave the body, in that frame.
        names: of the two fields.

    Raises:
        ValueError: a wrong shape, or an orientation without length.
    """
    owner, dim, dtype = label(element), pose.position.shape[0], pose.position.dtype
    place, turn = (getattr(element, name) for name in names)
    origin, axes = own.position, own.rotation.T
    if place is not None:
        origin = pose.local_point(own_point(element, names[0], place, pose))
    if turn is not None:
        turn = _orientation(owner, names[1], turn, dim, dtype)
        axes = jax.vmap(pose.local_direction)(Pose(origin, turn).rotation.T)
    return origin, dict(zip(AXES, axes, strict=False))


def given_points(p: dict[str, Any]) -> Vector | None:
    """The points of each element, lanes (element, k); None where each has but one."""
    if not isinstance(p["anchor_b"], Grid):
        return None
    points = p["anchor_b"].values
    return Vector(*(points[:, :, i] for i in range(points.shape[2])))


def corners(p: dict[str, Any]) -> Vector:
    """The corners of boxes in the frames of their bodies, lanes (element, 2^dim)."""
    halves = [p[axis] * (size / 2) for axis, size in zip(AXES, p["size"], strict=False)]
    every = []
    for signs in _signs(len(halves)):
        corner = p["anchor_b"]
        for sign, half in zip(signs, halves, strict=True):
            corner = corner + half * float(sign)
        every.append(corner)
    return Vector(*(jnp.stack(lanes, axis=1) for lanes in zip(*every, strict=True)))


def spread(p: dict[str, Any], points: Vector) -> dict[str, Any]:
    """The numbers of an element at each of its points, lanes (element × point,)."""
    count = points[0].shape[1]

    def each(x: Any) -> Any:
        return x if isinstance(x, Grid) else jnp.repeat(x, count, axis=0)

    def flat(x: Lane) -> Lane:
        return x.reshape(-1, *x.shape[2:])

    repeated = jax.tree.map(each, p, is_leaf=lambda x: isinstance(x, Grid))
    return repeated | {"anchor_b": points.map(flat)}


def spread_place(place: Place, count: int) -> Place:
    """The bodies of elements, once for each point."""
    indices = tuple(i for i in place.indices for _ in range(count))
    return Place(place.group, indices, tuple(n for n in place.fixed for _ in range(count)))


def _orientation(owner: str, what: str, given: Any, dim: int, dtype: Any) -> Array:
    """An angle () in the plane, a unit quaternion (4,) in space, checked."""
    turn = checks.real(owner, what, given, dtype, () if dim == 2 else (4,))
    if dim == 2:
        checks.radians(owner, what, turn)
        return turn
    checks.nonzero(owner, what, turn)
    return turn / jnp.sqrt(jnp.sum(turn * turn))


def _signs(dim: int) -> np.ndarray:
    """Returns the signs of the corners of a box, (2^dim, dim)."""
    return np.array(list(itertools.product((-1.0, 1.0), repeat=dim)))


def _several(points: Any) -> bool:
    """Returns True where these are the points of a set."""
    try:
        return points is not None and jnp.asarray(points).ndim == 2
    except (TypeError, ValueError, OverflowError):
        return False
