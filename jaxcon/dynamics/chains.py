"""Inextensible ropes and rods: builders of chains, linear in the number of links."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.joints import Distance, Revolute, Spherical
from jaxcon.core import checks
from jaxcon.dynamics.scene import Scene
from jaxcon.model.elastic import Bending, Flexure
from jaxcon.model.layout import WORLD

NEWTON = 200
"""Steps in which a hanging chain is found; a dozen is usual."""


@dataclass(frozen=True)
class Chain:
    """Names of what a builder added, from the start on.

    Attributes:
        bodies: particles of a rope, links of a rod.
        joints: distances or joints, those at attached ends included.
        springs: bending elements.
    """

    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    springs: tuple[str, ...]


def hanging(start: Any, end: Any, length: float, links: int, gravity: Any = None) -> np.ndarray:
    """Where the joints of a chain of equal links hang at rest between two points.

    Equal masses at the joints. With T = (H, V + i) in link i, horizontally and upwards, in units of
    a joint's weight, the links lie along T and span the gap: ∇ Σ s ‖Tᵢ‖ = Δ, a convex problem in
    (H, V), by Newton's method.

    Args:
        start: (dim,) [m].
        end: (dim,) [m]; not above or below the start.
        length: of the whole chain, more than the distance [m].
        links: how many.
        gravity: its direction, (dim,); along the last axis downwards unless given.

    Returns:
        The ends and the joints between them, (links + 1, dim) [m].

    Raises:
        ValueError: the chain is too short, or the ends lie above one another.
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


def _known(what: str, x: Any, shape: tuple[int, ...] | None = None, **limits: Any) -> np.ndarray:
    """Numbers of a chain, which are not traced."""
    return np.asarray(checks.check("hanging", what, x, shape, **limits), float)


def _tensions(gap: np.ndarray, step: float, links: int) -> np.ndarray:
    """(H, V + i) of each link, (links, 2)."""
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
    mass: Any,
    *,
    start: str | None = WORLD,
    end: str | None = None,
    bending: Any = None,
) -> Chain:
    """Adds an inextensible rope: particles at points, ‖∂r/∂s‖ = 1 as distances between them.

    Each particle bears half of the links beside it. At an attached end there is no particle, and
    its half link rests on what it is attached to.

    Args:
        scene: to which it is added.
        name: of the rope; its parts are called name.1, name.link0, name.bend1.
        points: (links + 1, dim) [m]; `hanging` finds those at rest.
        mass: of the whole rope [kg].
        start: name of what the first point is attached to; None where it is free.
        end: the same of the last point.
        bending: B = E I [N m²]; none unless given.

    Returns:
        The names.

    Raises:
        ValueError: points of a wrong shape, or two of them at one place.
    """
    label = f"rope '{name}'"
    mass = checks.real(label, "mass", mass, scene.dtype, above=0)
    if bending is not None:
        bending = checks.real(label, "bending", bending, scene.dtype, least=0)
    xp, points = _points(scene, label, points)
    lengths = xp.sqrt(xp.sum((points[1:] - points[:-1]) ** 2, axis=1))
    share = mass / xp.sum(lengths) * lengths / 2
    masses = xp.pad(share, (1, 0)) + xp.pad(share, (0, 1))
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
        before, own, after = owner[i - 1 : i + 2]
        scene.add(Bending(springs[-1], before, own, after, bending, **sides))
    bodies = tuple(node for i, node in enumerate(nodes) if i not in held)
    return Chain(bodies, tuple(joints), tuple(springs))


def rod(
    scene: Scene,
    name: str,
    points: Any,
    mass: Any,
    *,
    radius: Any = None,
    start: str | None = WORLD,
    end: str | None = None,
    bending: Any = None,
    twisting: Any = 0.0,
    straight: bool = True,
) -> Chain:
    """Adds a rod: rigid links between points, on revolute joints in the plane, spherical in space.

    The links' x axes lie along the rod; in space their frames follow it without twist.

    Args:
        scene: to which it is added.
        name: of the rod; its parts are called name.0, name.joint0, name.bend1.
        points: (links + 1, dim) [m], known numbers.
        mass: of the whole rod [kg].
        radius: of its round section [m]; in space.
        start: name of what the first end turns on; None where it is free.
        end: the same of the last end.
        bending: B = E I [N m²]; none unless given.
        twisting: G J ≤ 2 B [N m²]; in space.
        straight: whether it is relaxed when straight; otherwise as it is given.

    Returns:
        The names.

    Raises:
        ValueError: points of a wrong shape or traced, two of them at one place, or no radius.
    """
    label = f"rod '{name}'"
    if not checks.is_concrete(points):
        raise ValueError(f"{label}: its points must be known numbers, not traced ones.")
    if scene.dim == 3 and radius is None:
        raise ValueError(f"{label}: in space a radius is needed for the moments of its links.")
    thick: Any = radius
    if radius is not None:
        thick = checks.real(label, "radius", radius, scene.dtype, above=0)
    mass = checks.real(label, "mass", mass, scene.dtype, above=0)
    checks.flag(label, "straight", straight)
    if bending is not None:
        bending = checks.real(label, "bending", bending, scene.dtype, least=0)
    twisting = checks.real(label, "twisting", twisting, scene.dtype, least=0)
    _, points = _points(scene, label, points)
    gaps = np.diff(points, axis=0)
    lengths = np.linalg.norm(gaps, axis=1)
    turns = _angles(gaps) if scene.dim == 2 else _frames(gaps / lengths[:, None])
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
    """numpy and an array of its, or those of JAX where the points are traced."""
    xp = np if checks.is_concrete(points) else jnp
    shape = np.shape(checks.check(owner, "points", points))
    points = xp.asarray(checks.real(owner, "points", points, scene.dtype, shape))
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


def _angles(gaps: np.ndarray) -> np.ndarray:
    """Returns the angles of links in the plane, without jumps [rad]."""
    return np.unwrap(np.arctan2(gaps[:, 1], gaps[:, 0]))


def _frames(tangents: np.ndarray) -> np.ndarray:
    """Quaternions that turn x to each tangent, each from the one before by the shortest turn."""
    result = []
    turn, before = np.array([1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    for t in tangents:
        turn = _product(_shortest(before, t), turn)
        result.append(turn / np.linalg.norm(turn))
        before = t
    return np.array(result, tangents.dtype)


def _shortest(u: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The quaternion that turns one unit vector to another the shortest way: (1 + u·w, u × w)."""
    half = np.append(1 + u @ w, np.cross(u, w))
    if half[0] < 1e-12:  # opposite: half a turn about any normal
        normal = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
        half = np.append(0.0, normal)
    return half / np.linalg.norm(half)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton's product on the host."""
    return np.append(
        a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    )
