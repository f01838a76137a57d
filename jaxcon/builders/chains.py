"""Builders of inextensible ropes and rods as chains of links."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.builders.scene import Scene
from jaxcon.constraints.joints import Distance, Revolute, Spherical
from jaxcon.core import checks
from jaxcon.core.typing import PyTree, Scalar
from jaxcon.system.elastic import Bending, Flexure
from jaxcon.system.layout import WORLD

NEWTON = 200
"""The largest number of Newton steps to find a hanging chain; about a dozen is usual."""


@dataclass(frozen=True)
class Chain:
    """The names of the bodies and elements of a rope or rod, in order from its start.

    Attributes:
        bodies: particles of a rope, links of a rod.
        joints: distances of a rope or joints of a rod, including those at attached ends.
        springs: bending elements.
    """

    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    springs: tuple[str, ...]


def hanging(
    start: PyTree, end: PyTree, length: float, links: int, gravity: PyTree = None
) -> np.ndarray:
    """Finds the joints of a chain of equal links that hangs at rest between two points.

    Equal masses hang at the joints. The tension of link i is Tᵢ = (H, V + i), with a horizontal and
    an upward component, in units of the weight at a joint. The links lie along their tensions and
    span the gap Δ between the ends: Σ s Tᵢ / ‖Tᵢ‖ = Δ, with the length s of a link. Newton's method
    finds the (H, V) that minimizes the convex function Σ s ‖Tᵢ‖ − (H, V)·Δ, whose gradient vanishes
    there.

    Args:
        start: first end, (dim,) [m].
        end: last end, (dim,) [m]; not above or below the start.
        length: length of the whole chain, more than the distance of the ends [m].
        links: the number of links.
        gravity: direction of gravity, (dim,); along the last axis downwards unless given.

    Returns:
        The ends and the joints between them, (links + 1, dim) [m].

    Raises:
        ValueError: the chain is too short, one end lies above the other, or a link would be under
            pressure.
    """
    a, b = (_known(what, x) for what, x in (("start", start), ("end", end)))
    length = float(_known("length", length, (), above=0))
    checks.count("hanging", "links", links, 2)
    if a.shape not in ((2,), (3,)) or a.shape != b.shape:
        raise ValueError(
            f"hanging: start and end must be points (2,) or (3,), got shapes {a.shape} and"
            f" {b.shape}."
        )
    gravity = None if gravity is None else _known("gravity", gravity, a.shape)
    up = np.eye(len(a))[-1] if gravity is None else -gravity
    checks.nonzero("hanging", "gravity", up)
    up = up / np.linalg.norm(up)
    rise = float((b - a) @ up)
    level = b - a - rise * up
    reach = float(np.linalg.norm(level))
    if not length > np.hypot(reach, rise):
        raise ValueError(
            f"hanging: a length of {length:g} m does not reach over"
            f" {np.hypot(reach, rise):g} m; give more."
        )
    if reach < 1e-6 * length:
        raise ValueError("hanging: the ends lie above one another; give the points yourself.")
    along = _tensions(np.array([reach, rise]), length / links, links)
    steps = length / links * along / np.linalg.norm(along, axis=1, keepdims=True)
    way = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    missed = np.linalg.norm(way[-1] - (reach, rise))
    if missed > 1e-9 * length:
        raise ValueError(
            f"hanging: {links} links of {length / links:g} m cannot hang in a gap of {reach:g} m by"
            f" {abs(rise):g} m without a link under pressure; take more and shorter links, or give"
            " the points yourself."
        )
    return a + way[:, :1] * (level / reach) + way[:, 1:] * up


def _known(what: str, x: PyTree, shape: tuple[int, ...] | None = None, **limits: Any) -> np.ndarray:
    """Checks an argument of `hanging`, which must be concrete; returns it as a NumPy array.

    Args:
        what: the name of the argument, for error messages.
        x: its value.
        shape: the required shape; None for any shape.
        limits: bounds on the value; see `checks.check`.
    """
    return np.asarray(checks.check("hanging", what, x, shape, **limits), float)


def _tensions(gap: np.ndarray, step: float, links: int) -> np.ndarray:
    """Returns the tensions of the links of a hanging chain, (links, 2), by Newton's method.

    The tension of link i is (H, V + i), with a horizontal and an upward component, in units of the
    weight at a joint.

    Args:
        gap: the horizontal and the vertical distance between the ends, (2,) [m].
        step: the length of a link [m].
        links: the number of links.
    """
    weights = np.column_stack([np.zeros(links), np.arange(links)])
    x = np.array([links / 2, -(links - 1) / 2])

    def value(x: np.ndarray) -> float:
        return step * np.linalg.norm(x + weights, axis=1).sum() - gap @ x

    for _ in range(NEWTON):
        force = x + weights
        size = np.linalg.norm(force, axis=1, keepdims=True)
        unit = force / size
        slope = step * unit.sum(0) - gap
        across = np.column_stack([-unit[:, 1], unit[:, 0]]) / np.sqrt(size)
        move = -np.linalg.solve(step * across.T @ across, slope)
        share = 1.0
        while share > 1e-12 and (
            x[0] + share * move[0] <= 0
            or value(x + share * move) > value(x) + 1e-14 * abs(value(x))
        ):
            share /= 2
        x = x + share * move
        if np.linalg.norm(move) <= 1e-15 * np.linalg.norm(x) or share <= 1e-12:
            break
    return x + weights


def rope(
    scene: Scene,
    name: str,
    points: Any,
    mass: Scalar,
    *,
    start: str | None = WORLD,
    end: str | None = None,
    bending: Scalar | None = None,
) -> Chain:
    """Adds an inextensible rope: particles at points, and `Distance` joints between them.

    The rope satisfies ‖∂r/∂s‖ = 1 along its arc length s. Each particle has half the mass of its
    adjacent links. An attached end has no particle; half the mass of its link is left out.

    Args:
        scene: the scene to which the rope is added.
        name: name of the rope; its elements are called name.1, name.link0, name.bend1.
        points: positions of the particles and ends, (links + 1, dim) [m]; `hanging` returns points
            at rest.
        mass: mass of the whole rope [kg].
        start: name of the body to which the first point is attached; None for a free end.
        end: name of the body to which the last point is attached; None for a free end.
        bending: bending stiffness B = E I [N m²]; none unless given.

    Returns:
        The names of the rope's bodies, joints and springs.

    Raises:
        ValueError: points of a wrong shape, or two points at one place.
    """
    label = f"rope '{name}'"
    mass = checks.real(label, "mass", mass, scene.dtype, above=0)
    if bending is not None:
        bending = checks.real(label, "bending", bending, scene.dtype, least=0)
    xp, points = _points(scene, label, points)
    lengths = xp.sqrt(xp.sum((points[1:] - points[:-1]) ** 2, axis=1))
    share = mass / xp.sum(lengths) * lengths / 2
    pad = np.pad if checks.is_concrete(share) else jnp.pad  # only the mass may be traced
    masses = pad(share, (1, 0)) + pad(share, (0, 1))
    n = len(points) - 1
    nodes = [f"{name}.{i}" for i in range(n + 1)]
    ends = {0: start, n: end}
    held = {i: body for i, body in ends.items() if body is not None}
    for i, node in enumerate(nodes):
        if i not in held:
            scene.add_particle(node, mass=masses[i], position=points[i])
    joints, springs = [], []
    owner = [held.get(i, node) for i, node in enumerate(nodes)]
    place = {i: points[i] for i in held}
    for i in range(n):
        joints.append(f"{name}.link{i}")
        sides = {"point_a": place.get(i), "point_b": place.get(i + 1)}
        scene.add(Distance(joints[-1], owner[i], owner[i + 1], **sides))
    for i in range(1, n) if bending is not None else ():
        springs.append(f"{name}.bend{i}")
        sides = {"point_a": place.get(i - 1), "point_c": place.get(i + 1)}
        before, middle, after = owner[i - 1 : i + 2]
        scene.add(Bending(springs[-1], before, middle, after, bending, **sides))
    bodies = tuple(node for i, node in enumerate(nodes) if i not in held)
    return Chain(bodies, tuple(joints), tuple(springs))


def rod(
    scene: Scene,
    name: str,
    points: Any,
    mass: Scalar,
    *,
    radius: Scalar | None = None,
    start: str | None = WORLD,
    end: str | None = None,
    bending: Scalar | None = None,
    twisting: Scalar = 0.0,
    straight: bool = True,
) -> Chain:
    """Adds a rod: rigid links between points, on revolute joints in the plane, spherical in space.

    The x axes of the links lie along the rod. In space, the frames of the links follow the rod
    without twist.

    Args:
        scene: the scene to which the rod is added.
        name: name of the rod; its elements are called name.0, name.joint0, name.bend1.
        points: ends of the links, (links + 1, dim) [m], concrete numbers.
        mass: mass of the whole rod [kg].
        radius: radius of the rod's round cross-section [m]; required in space.
        start: name of the body on which the first end turns; None for a free end.
        end: name of the body on which the last end turns; None for a free end.
        bending: bending stiffness B = E I [N m²]; none unless given.
        twisting: torsional stiffness G J ≤ 2 B [N m²]; in space.
        straight: True if the rod is relaxed when straight; False if relaxed in the given shape.

    Returns:
        The names of the rod's bodies, joints and springs.

    Raises:
        ValueError: points of a wrong shape or traced, two points at one place, or no radius.
    """
    label = f"rod '{name}'"
    if not checks.is_concrete(points):
        raise ValueError(f"{label}: its points must be known numbers, not traced ones.")
    if scene.dim == 3 and radius is None:
        raise ValueError(f"{label}: in space a radius is needed for the moments of its links.")
    thick = 1.0 if radius is None else radius
    thick = checks.real(label, "radius", thick, scene.dtype, above=0)
    mass = checks.real(label, "mass", mass, scene.dtype, above=0)
    checks.flag(label, "straight", straight)
    if bending is not None:
        bending = checks.real(label, "bending", bending, scene.dtype, least=0)
    twisting = checks.real(label, "twisting", twisting, scene.dtype, least=0)
    _, points = _points(scene, label, points)
    gaps = np.diff(points, axis=0)
    lengths = np.linalg.norm(gaps, axis=1)
    angles = np.unwrap(np.arctan2(gaps[:, 1], gaps[:, 0]))  # successive angles do not jump by 2π
    turns = angles if scene.dim == 2 else _frames(gaps / lengths[:, None])
    links = [f"{name}.{i}" for i in range(len(lengths))]
    for i, link in enumerate(links):
        m, s = mass * (lengths[i] / lengths.sum()), lengths[i]
        middle = (points[i] + points[i + 1]) / 2
        if scene.dim == 2:
            scene.add_body(link, mass=m, inertia=m * s**2 / 12, position=middle, angle=turns[i])
            scene.allow_turns(link)
            continue
        across = m * (3 * thick**2 + s**2) / 12
        inertia = jnp.stack(
            [jnp.asarray(x, scene.dtype) for x in (m * thick**2 / 2, across, across)]
        )
        scene.add_body(link, mass=m, inertia=inertia, position=middle, quaternion=turns[i])
    joint = Revolute if scene.dim == 2 else Spherical
    owners, joints, springs = [start, *links, end], [], []
    for i, (a, b) in enumerate(zip(owners[:-1], owners[1:], strict=True)):
        if a is not None and b is not None:
            joints.append(f"{name}.joint{i}")
            scene.add(joint(joints[-1], a, b, point=points[i]))
    for i in range(1, len(links)) if bending is not None else ():
        springs.append(f"{name}.bend{i}")
        s = (lengths[i - 1] + lengths[i]) / 2
        scene.add(Flexure(springs[-1], links[i - 1], links[i], bending / s, twisting / s, straight))
    return Chain(tuple(links), tuple(joints), tuple(springs))


def _points(scene: Scene, owner: str, points: Any) -> tuple[Any, Any]:
    """Checks the points of a rope or rod.

    Args:
        scene: the scene, with the dimension and the dtype.
        owner: the name of the rope or rod, for error messages.
        points: the user's points, (links + 1, dim) [m].

    Returns:
        The module for computations with the points: NumPy, or jax.numpy if they are traced.
        The points as an array of this module.

    Raises:
        ValueError: the points have a wrong shape, or two successive points are at one place.
    """
    xp = np if checks.is_concrete(points) else jnp
    given = checks.check(owner, "points", points)
    points = checks.real(owner, "points", points, scene.dtype, np.shape(given))
    if xp is np:  # `real` returns a JAX array, which is traced under jit
        points = np.asarray(given, scene.dtype)
    if points.ndim != 2 or points.shape[1] != scene.dim or len(points) < 3:
        raise ValueError(
            f"{owner}: points must have shape (links + 1, {scene.dim}) with 2 links or more, got"
            f" {points.shape}."
        )
    if xp is np:
        gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if not np.all(gaps > 0):
            i = int(np.argmin(gaps > 0))
            raise ValueError(
                f"{owner}: points {i} and {i + 1} must be apart and finite, got"
                f" {checks.numerals(points[i])} and {checks.numerals(points[i + 1])}."
            )
    return xp, points


def _frames(tangents: np.ndarray) -> np.ndarray:
    """Returns the orientations of the links of a rod without twist, as quaternions, (links, 4).

    The x axis of each link lies along its tangent. The frame of a link follows from the frame of
    the link before by the shortest turn between their tangents.

    Args:
        tangents: the unit tangents of the links, (links, 3).
    """
    result = []
    turn, before = np.array([1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    for t in tangents:
        turn = _product(_shortest(before, t), turn)
        result.append(turn / np.linalg.norm(turn))
        before = t
    return np.array(result, tangents.dtype)


def _shortest(u: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Returns the quaternion, (4,), of the shortest turn from unit vector u to unit vector w.

    The quaternion is proportional to (1 + u·w, u × w).
    """
    half = np.append(1 + u @ w, np.cross(u, w))
    if half[0] < 1e-12:  # w = −u: half a turn about any normal of u
        normal = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
        half = np.append(0.0, normal)
    return half / np.linalg.norm(half)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the Hamilton product of two quaternions, in NumPy."""
    return np.append(
        a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    )
