"""Contact of shapes: gaps against independent references, and bodies that fall, stand and roll."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from tolerances import DIFFERENCE

import jaxcon as jc
from jaxcon.contact import shape_contact
from jaxcon.contact.rows import linearize_bounds
from jaxcon.core.lanes import Vector
from jaxcon.geometry import boxes, solids
from jaxcon.geometry.solids import Solid
from jaxcon.shapes import Box, Capsule, Cylinder, Ellipsoid, Hull, Plane, Sphere
from jaxcon.staging import kernels

EXACT = 1e-8
"""Tolerance of closed forms, for shapes of about a meter."""
POSES = 1000
SIGNS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


class Poses:
    """Random shapes in random poses, as arrays (pose, …)."""

    def __init__(self, seed, spread=1.0, count=POSES):
        rng = np.random.default_rng(seed)
        self.center = spread * rng.normal(size=(count, 3))
        turns = Rotation.random(count, random_state=seed)
        self.axes = np.swapaxes(turns.as_matrix(), 1, 2)  # rows are the axes
        self.radius = rng.uniform(0.2, 1.0, count)
        self.half = rng.uniform(0.2, 1.0, count)
        self.halves = rng.uniform(0.2, 1.0, (count, 3))

    def local(self, points):
        """Returns points (pose, 3) in the frames of the shapes."""
        return np.einsum("nij,nj->ni", self.axes, points - self.center)

    def solid(self, kind, dtype=np.float64):
        """Returns the shapes as lanes."""

        def lanes(x):
            return Vector(*map(jnp.asarray, np.asarray(x, dtype).T))

        axes = tuple(lanes(self.axes[:, i]) for i in range(3))
        given = {
            "plane": {"axes": axes[2:]},
            "ball": {"radius": self.radius},
            "capsule": {"axes": axes[2:], "radius": self.radius, "half": self.half},
            "cylinder": {"axes": axes, "radius": self.radius, "half": self.half},
            "box": {"axes": axes, "half": lanes(self.halves)},
            "ellipsoid": {"axes": axes, "half": lanes(self.halves)},
        }[kind]
        given = {k: jnp.asarray(x, dtype) if k == "radius" else x for k, x in given.items()}
        if kind in ("capsule", "cylinder"):
            given["half"] = jnp.asarray(self.half, dtype)
        return Solid(lanes(self.center), **given)


def array(vector):
    """Returns a Vector of lanes as an array (pose, 3)."""
    return np.stack(np.broadcast_arrays(*vector), axis=-1)


def signed(excess):
    """Returns the distance from the excess over each pair of sides, negative inside."""
    outside = np.linalg.norm(np.maximum(excess, 0), axis=-1)
    return outside + np.minimum(excess.max(axis=-1), 0)


def box_distance(x, shape):
    """Returns the signed distance of points in the frame of boxes."""
    return signed(np.abs(x) - shape.halves)


def cylinder_distance(x, shape):
    """Returns the signed distance of points in the frame of cylinders."""
    across = np.hypot(x[:, 0], x[:, 1]) - shape.radius
    return signed(np.stack([across, np.abs(x[:, 2]) - shape.half], -1))


def ellipsoid_distance(x, shape):
    """Returns the signed distance of points in the frame of ellipsoids, by bisection."""
    a = shape.halves
    low, high = -(a.min(axis=1) ** 2), 1 + np.linalg.norm(x, axis=1) * a.max(axis=1)
    for _ in range(200):
        t = (low + high) / 2
        beyond = np.sum((a * x / (a * a + t[:, None])) ** 2, axis=1) > 1
        low, high = np.where(beyond, t, low), np.where(beyond, high, t)
    nearest = a * a * x / (a * a + t[:, None])
    return np.sign(t) * np.linalg.norm(x - nearest, axis=1)


def plane_distance(x, shape):
    """Returns the heights of points in the frame of planes."""
    return x[:, 2]


DISTANCES = {
    "plane": plane_distance,
    "box": box_distance,
    "cylinder": cylinder_distance,
    "ellipsoid": ellipsoid_distance,
}


def least(distance, low=-1.0, high=1.0):
    """Returns the minimum of convex functions of t, by golden sections."""
    share = (np.sqrt(5) - 1) / 2
    low, high = np.full(POSES, low), np.full(POSES, high)
    for _ in range(80):
        x, y = high - share * (high - low), low + share * (high - low)
        first = distance(x) < distance(y)
        low, high = np.where(first, low, x), np.where(first, y, high)
    ends = [distance(np.full(POSES, t)) for t in (-1.0, 1.0)]
    return np.minimum(distance((low + high) / 2), np.minimum(*ends))


@functools.lru_cache
def gaps(function, kinds, seed=0, spread=1.0, dtype=np.float64):
    """Returns two sets of shapes, and the gaps, normals and places of their contact points."""
    shapes = Poses(seed, spread), Poses(seed + 1, spread)
    solid = [s.solid(kind, dtype) for s, kind in zip(shapes, kinds, strict=True)]
    found = jax.jit(function)(*solid)
    distance = np.stack([np.asarray(x.distance) for x in found], -1)
    normal, place = (
        np.stack([array(getattr(x, n)) for x in found], 1) for n in ("normal", "place")
    )
    return *shapes, distance, normal, place


@pytest.mark.parametrize(
    ("function", "kind"),
    [
        (solids.plane_ball, "plane"),
        (solids.box_ball, "box"),
        (solids.cylinder_ball, "cylinder"),
        (solids.ellipsoid_ball, "ellipsoid"),
    ],
)
def test_gaps_to_a_ball_are_those_of_distance_functions(function, kind):
    """The place lies halfway between the surfaces along the normal."""
    shape, ball, gap, normal, place = gaps(function, (kind, "ball"))
    distance = DISTANCES[kind]
    want = distance(shape.local(ball.center), shape) - ball.radius
    np.testing.assert_allclose(gap[:, 0], want, atol=EXACT)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, atol=EXACT)
    half = normal[:, 0] * gap / 2
    np.testing.assert_allclose(distance(shape.local(place[:, 0] - half), shape), 0, atol=EXACT)
    reach = np.linalg.norm(place[:, 0] + half - ball.center, axis=1)
    np.testing.assert_allclose(reach, ball.radius, atol=EXACT)
    assert 0.1 < np.mean(gap < 0) < 0.9


@pytest.mark.parametrize(
    ("function", "kind"),
    [
        (solids.plane_capsule, "plane"),
        (solids.box_capsule, "box"),
        (solids.cylinder_capsule, "cylinder"),
    ],
)
def test_the_smallest_gap_to_a_capsule_is_that_of_its_axis(function, kind):
    """The references are minima along the axis. Deeper than its radius, a capsule is not exact."""
    shape, capsule, gap, normal, place = gaps(function, (kind, "capsule"), 2)
    distance, along = DISTANCES[kind], capsule.axes[:, 2] * capsule.half[:, None]

    def at(t):
        return distance(shape.local(capsule.center + along * t[:, None]), shape)

    want, outside = least(at), least(at) > 0
    assert np.mean(outside) > 0.3
    reach = want - capsule.radius
    np.testing.assert_allclose(gap.min(axis=1)[outside], reach[outside], atol=EXACT)
    for k in range(gap.shape[1]):  # each point is that of a ball on the axis
        half = normal[:, k] * gap[:, k, None] / 2
        below, above = place[:, k] - half, place[:, k] + half
        np.testing.assert_allclose(distance(shape.local(below), shape)[outside], 0, atol=EXACT)
        center = above + normal[:, k] * capsule.radius[:, None]
        x = capsule.local(center)
        assert np.all(np.abs(x[:, :2]) < EXACT)
        assert np.all(np.abs(x[:, 2]) <= capsule.half + EXACT)


def supports(kind, shape, normals):
    """Returns the largest extent of shapes along unit normals (pose, 3), from their centers."""
    n = np.einsum("nij,nj->ni", shape.axes, normals)
    if kind == "cylinder":
        return shape.radius * np.hypot(n[:, 0], n[:, 1]) + shape.half * np.abs(n[:, 2])
    if kind == "box":
        return np.sum(shape.halves * np.abs(n), axis=1)
    return np.linalg.norm(shape.halves * n, axis=1)


@pytest.mark.parametrize(
    ("function", "kind", "count"),
    [
        (solids.plane_cylinder, "cylinder", 5),
        (boxes.plane_box, "box", 4),
        (solids.plane_ellipsoid, "ellipsoid", 1),
    ],
)
def test_the_lowest_point_over_a_plane_is_that_of_the_support_function(function, kind, count):
    plane, shape, gap, normal, place = gaps(function, ("plane", kind), 4)
    n = plane.axes[:, 2]
    height = np.sum(n * (shape.center - plane.center), axis=1)
    assert gap.shape[1] == count
    np.testing.assert_allclose(gap.min(axis=1), height - supports(kind, shape, n), atol=EXACT)
    np.testing.assert_allclose(normal, np.broadcast_to(n[:, None], normal.shape), atol=EXACT)
    points = place + normal * gap[..., None] / 2  # on the surface of the shape
    for k in range(count):
        x = shape.local(points[:, k])
        if kind == "ellipsoid":
            np.testing.assert_allclose(np.sum((x / shape.halves) ** 2, axis=1), 1, atol=EXACT)
        else:
            assert np.all(DISTANCES[kind](x, shape) < EXACT)


def corners(shape):
    """Returns the corners of boxes, (pose, 8, 3)."""
    halves = SIGNS * shape.halves[:, None]
    return shape.center[:, None] + np.einsum("nki,nij->nkj", halves, shape.axes)


def test_boxes_overlap_by_the_depth_of_their_difference():
    """The depth is the distance of the origin from the hull of all differences of corners.

    Faces are preferred, so the depth may exceed it by 1 % of the smallest half edge.
    """
    a, b, gap, normal, place = gaps(boxes.box_box, ("box", "box"), 6, 0.5)
    first, second = corners(a), corners(b)
    least_half = np.minimum(a.halves.min(axis=1), b.halves.min(axis=1))
    overlapping = 0
    for i in range(400):
        hull = ConvexHull((second[i][:, None] - first[i][None]).reshape(-1, 3))
        depth = hull.equations[:, 3].max()
        if depth < 0:
            overlapping += 1
            off = gap[i].min() - depth
            assert -0.0101 * least_half[i] < off < EXACT
    assert overlapping > 100
    best = np.argmin(gap, axis=1)
    n = normal[np.arange(POSES), best]
    apart = np.einsum("nki,ni->nk", second, n).min(1) - np.einsum("nki,ni->nk", first, n).max(1)
    exists = gap < (a.halves.sum(axis=1) + b.halves.sum(axis=1))[:, None] - EXACT
    assert np.all(exists.any(axis=1) | (apart > 0))  # overlapping boxes have a contact point
    there = gap.min(axis=1)
    assert np.all(there >= apart - EXACT)
    assert np.mean(np.abs(there - apart)[apart < 0] < EXACT) > 0.9
    x, y = (np.einsum("nij,nkj->nki", s.axes, place - s.center[:, None]) for s in (a, b))
    inside = [np.max(np.abs(x) - s.halves[:, None], axis=-1) for x, s in ((x, a), (y, b))]
    half = np.maximum(np.abs(gap) / 2, 0) + EXACT
    assert np.all((inside[0] < half) | ~exists)
    assert np.all((inside[1] < half) | ~exists)


PAIRS = [
    (solids.plane_ball, "plane", "ball"),
    (solids.plane_cylinder, "plane", "cylinder"),
    (solids.plane_ellipsoid, "plane", "ellipsoid"),
    (boxes.plane_box, "plane", "box"),
    (solids.box_ball, "box", "ball"),
    (solids.cylinder_ball, "cylinder", "ball"),
    (solids.ellipsoid_ball, "ellipsoid", "ball"),
    (solids.box_capsule, "box", "capsule"),
    (solids.cylinder_capsule, "cylinder", "capsule"),
    (boxes.box_box, "box", "box"),
]
NAMES = [f"{a} {b}" for _, a, b in PAIRS]
pairs = pytest.mark.parametrize(("function", "first", "second"), PAIRS, ids=NAMES)


def moving(solid, velocity, spin):
    """Returns the rates of the center and the axes of a solid that moves and turns."""
    return Solid(
        velocity,
        tuple(spin.cross(u) for u in solid.axes),
        *jax.tree.map(jnp.zeros_like, solid[2:4]),
    )


def nearest_of(function):
    """Returns a function that returns the smallest gap only."""

    def smallest(a, b):
        found = function(a, b)
        distances = jnp.stack([x.distance for x in found])
        place = jnp.stack([x.place.stack() for x in found])
        normal = jnp.stack([x.normal.stack() for x in found])
        best = jnp.arange(len(found))[:, None] == jnp.argmin(distances, axis=0)[None]
        vectors = (jnp.sum(jnp.where(best[:, None], x, 0), axis=0) for x in (normal, place))
        return jnp.sum(jnp.where(best, distances, 0), axis=0), *vectors

    return smallest


@pairs
def test_gaps_change_by_the_relative_velocity_of_the_two_bodies(function, first, second):
    """φ̇ = n·(ṗ_b − ṗ_a) at the place, the row of the step.

    Exceptions are capsules whose axis is inside, and boxes that are apart, or touch at clipped
    corners.
    """
    shapes = Poses(8, 0.6), Poses(9, 0.6)
    a, b = (s.solid(kind) for s, kind in zip(shapes, (first, second), strict=True))
    rng = np.random.default_rng(10)
    v, w, u, s = (Vector(*map(jnp.asarray, rng.normal(size=(3, POSES)))) for _ in range(4))

    @jax.jit
    def rates(a, b):
        tangents = moving(a, v, w), moving(b, u, s)
        (gap, normal, place), (rate, *_) = jax.jvp(nearest_of(function), (a, b), tangents)
        n, x = Vector.of(normal), Vector.of(place)
        relative = u + s.cross(x - b.center) - v - w.cross(x - a.center)
        return gap, rate, n.dot(relative), n.stack().T

    gap, rate, want, n = map(np.asarray, rates(a, b))
    assert np.all(np.isfinite(rate))
    exact = np.ones(POSES, bool)
    if second == "capsule" and first != "plane":
        exact = gap > EXACT - shapes[1].radius  # the axis is outside
    if function is boxes.box_box:
        kinds = zip((first, second), shapes, strict=True)
        reach = sum(supports(kind, s, n) for kind, s in kinds)
        apart = np.sum(n * (shapes[1].center - shapes[0].center), axis=1) - reach
        exact = (np.abs(gap - apart) < EXACT) & (gap < 0)
    assert np.mean(exact) > 0.5
    np.testing.assert_allclose(rate[exact], want[exact], rtol=EXACT, atol=EXACT)


SINGULAR = {
    "coincident": {},
    "touching": {"offset": (0.0, 0.0, 0.6)},
    "no size": {"size": 0.0},
    "tiny": {"size": 1e-4},
    "edge to edge": {"offset": (0.6, 0.6, 0.0)},
}


@pairs
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gaps_and_derivatives_are_finite_everywhere(function, first, second, dtype):
    """Covers coincident centers, parallel and perpendicular axes, touching faces and no sizes."""
    turns = [np.eye(3), np.eye(3)[[1, 2, 0]], np.eye(3)[[2, 0, 1]] * [[1], [1], [-1]]]
    cases = list(itertools.product(turns, SINGULAR.values()))
    a, b = Poses(0, count=len(cases)), Poses(1, count=len(cases))
    a.center[:], a.axes[:] = 0.0, np.eye(3)
    for i, (turn, case) in enumerate(cases):
        b.center[i], b.axes[i] = case.get("offset", (0.0, 0.0, 0.0)), turn
        for s in (a, b):
            s.radius[i] = s.half[i] = case.get("size", 0.3)
            s.halves[i] = case.get("size", 0.3)
    given = a.solid(first, dtype), b.solid(second, dtype)

    @jax.jit
    def total(a, b):
        found = function(a, b)
        return sum(
            jnp.sum(g.distance) + sum(jnp.sum(x) for x in (*g.normal, *g.place)) for g in found
        )

    slopes = jax.grad(total, argnums=(0, 1))(*given)
    assert total(*given).dtype == dtype
    for x in jax.tree.leaves((total(*given), slopes)):
        assert np.all(np.isfinite(x))


@pairs
def test_gaps_in_single_precision(function, first, second):
    """Points may swap; the smallest gap is that in double precision."""
    double = gaps(function, (first, second), 12)[2].min(axis=1)
    single = gaps(function, (first, second), 12, dtype=np.float32)[2].min(axis=1)
    assert single.dtype == np.float32
    off = np.abs(single - double)
    if function is boxes.box_box:
        # faces are preferred by 1 % of the smallest half edge; rounding chooses among equal ones
        overlaps = double < 0
        smallest = np.minimum(*(Poses(seed).halves.min(axis=1) for seed in (12, 13)))
        assert np.sum(overlaps) > 50
        assert np.all(off[overlaps] < 0.0101 * smallest[overlaps] + 1e-5)
        assert np.all(single[~overlaps] > -1e-5)
        return
    outside = double > EXACT - Poses(13).radius if second == "capsule" else True
    assert np.all(off[outside] < 1e-5)


TURN = np.array([np.cos(0.2), 0.6 * np.sin(0.2), 0.8 * np.sin(0.2), 0.0])
LYING = (np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0)
"""The orientation of a shape whose axis z lies along −y."""
TABLES = [Plane(), Box((0.8, 0.8, 0.2)), Cylinder(0.5, 0.2), Ellipsoid((0.5, 0.5, 0.3))]
BODIES = [
    (Sphere(0.1), jc.inertia.sphere(1.0, 0.1), 0.1),
    (Capsule(0.05, 0.3), jc.inertia.capsule(1.0, 0.05, 0.3), 0.2),
    (Cylinder(0.1, 0.2), jc.inertia.cylinder(1.0, 0.1, 0.2), 0.15),
    (Box((0.1, 0.2, 0.3)), jc.inertia.box(1.0, (0.1, 0.2, 0.3)), 0.2),
    (Ellipsoid((0.1, 0.12, 0.15)), jc.inertia.box(1.0, (0.2, 0.2, 0.3)), 0.15),
]


def falls(dtype):
    """A scene in which each shape falls on each of its partners, 1 m above the ground."""
    scene, names = jc.Scene(dtype=dtype), []
    for i, (table, (shape, inertia, above)) in enumerate(itertools.product(TABLES, BODIES)):
        kinds = type(table), type(shape)
        if not shape_contact.ShapePair(*kinds).supported:
            continue
        x, top = 3.0 * i, getattr(table, "length", 0.2) / 2 if kinds[0] is not Plane else 0.0
        top = 0.3 if kinds[0] is Ellipsoid else top
        if kinds[0] is not Plane:
            table = dataclasses.replace(table, position=(x, 0.0, 0.0))
        names.append(f"{kinds[0].__name__} and {kinds[1].__name__}")
        place = (x + 0.02, 0.01, top + above + 0.1)
        scene.add_body(f"{i}", inertia=inertia, position=place, quaternion=TURN)
        ends = (jc.WORLD, f"{i}", table, shape)
        if i % 2:  # the order does not matter
            ends = (f"{i}", jc.WORLD, shape, table)
        scene.add(jc.contacts.ShapeContact(names[-1], *ends, friction=0.5))
    points = np.array([(1, 0, 0), (-1, 1, 0), (-1, -1, 0), (0, 0, 1)]) * 0.1 + (-3.0, 0.0, 0.2)
    scene.add_body("hull", mass=1.0, inertia=(0.01, 0.01, 0.01), position=(-3.0, 0.0, 0.2))
    scene.add(jc.contacts.ShapeContact("h", jc.WORLD, "hull", Plane(), Hull(points), friction=0.5))
    return scene.build()


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_each_shape_falls_on_each_partner(monkeypatch, dtype):
    """The bodies fall for a second. They penetrate by less than 1 mm, and a step is a kernel."""
    programs, write = [], kernels._program
    monkeypatch.setattr(
        kernels, "_program", lambda *given: programs.append(write(*given)) or programs[-1]
    )
    system, state = falls(dtype)
    method = jc.Method()
    state = jc.init(system, method, state.q, state.v)
    h = jnp.asarray(2e-3, dtype)

    def record(s, i):
        return jnp.min(i.reactions.gap)

    final, depth = jax.jit(lambda s: jc.rollout(system, method, s, None, h, 500, record=record))(
        state
    )
    jc.raise_for_status(final)
    assert depth.dtype == dtype
    assert -1e-3 < np.min(depth) < 1e-4
    assert np.all(np.isfinite(final.q))
    assert programs
    assert not [x for x in programs if isinstance(x, str)]  # why there is no kernel


def run(system, state, method, h, steps):
    """Returns the final state and the smallest gap, in a compiled rollout."""
    state = jc.init(system, method, state.q, state.v)

    def record(s, i):
        return jnp.min(i.reactions.gap)

    go = jax.jit(lambda s: jc.rollout(system, method, s, None, h, steps, record=record))
    final, least = go(state)
    jc.raise_for_status(final)
    return final, np.min(least)


def test_a_cylinder_stands_on_its_end_and_another_one_rolls():
    """A cylinder rolls down a slope of angle α with ⅔ g sin α; a slope of 0.2 rad holds one."""
    scene, slope = jc.Scene(), 0.2
    normal = np.array([np.sin(slope), 0.0, np.cos(slope)])
    upright = (np.cos(slope / 2), 0.0, np.sin(slope / 2), 0.0)
    plane = Plane(normal)
    inertia, shape = jc.inertia.cylinder(2.0, 0.1, 0.4), Cylinder(0.1, 0.4)
    turns = {"standing": upright, "rolling": LYING}
    for name, height in (("standing", 0.2), ("rolling", 0.1)):
        scene.add_body(name, inertia=inertia, position=height * normal, quaternion=turns[name])
        touch = {"shape_a": plane, "shape_b": shape, "friction": 0.6}
        scene.add(jc.contacts.ShapeContact(f"{name} floor", jc.WORLD, name, **touch))
    system, state = scene.build()
    final, _ = run(system, state, jc.Method(), 2e-3, 300)
    speed = np.linalg.norm(jc.velocity(system, final, "rolling"))
    np.testing.assert_allclose(speed, 0.6 * 2 / 3 * 9.81 * np.sin(slope), rtol=1e-9)
    moved = jc.position(system, final, "standing") - 0.2 * normal
    np.testing.assert_allclose(moved, 0.0, atol=1e-9)
    np.testing.assert_allclose(jc.velocity(system, final, "standing"), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("count", "solver"),
    [(2, jc.solvers.InteriorPoint()), (3, jc.solvers.Newton()), (10, jc.solvers.InteriorPoint())],
    ids=["2", "3", "10"],
)
def test_a_stack_of_boxes_stands(count, solver):
    """The boxes are turned about the vertical and shifted, so that their edges cross."""
    scene, box, size = jc.Scene(), Box((0.2, 0.2, 0.1)), (0.2, 0.2, 0.1)
    for i in range(count):
        turn = (np.cos(0.1 * i), 0.0, 0.0, np.sin(0.1 * i))
        place = (0.02 * (i % 2), 0.0, 0.1 * i + 0.05)
        scene.add_body(f"{i}", inertia=jc.inertia.box(1.0, size), position=place, quaternion=turn)
        below = (jc.WORLD, Plane()) if i == 0 else (f"{i - 1}", box)
        ends = (below[0], f"{i}", below[1], box)
        scene.add(jc.contacts.ShapeContact(f"under {i}", *ends, friction=0.5))
    system, state = scene.build()
    final, gap = run(system, state, jc.Method(contact_solver=solver), 2e-3, 500)
    assert gap > -1e-6
    np.testing.assert_allclose(final.q, state.q, atol=1e-5)


SHAPES = {
    "corner": (Box((4.0, 4.0, 0.2)), Box((0.2, 0.2, 0.3)), (0.0, 0.0, 0.31)),
    "side": (Cylinder(1.0, 0.2), Sphere(0.1), (0.3, 0.0, 0.206)),
    "rim": (Plane(), Cylinder(0.1, 0.3), (0.0, 0.0, 0.186)),
    "end": (Box((4.0, 4.0, 0.2)), Capsule(0.1, 0.3), (0.0, 0.0, 0.34)),
}
SIZES = {"corner": ("size_b", (0.2, 0.2, 0.3)), "side": ("radius_b", 0.1), "rim": ("length_b", 0.3)}
SIZES |= {"end": ("length_b", 0.3)}


@pytest.mark.parametrize("names", [("side",), ("corner", "rim", "end")], ids=" ".join)
def test_gradients_of_falls_are_those_of_differences(names):
    """A box lands on a corner, a ball on a cylinder, a cylinder on its rim, a capsule on a box.

    The derivatives of the end by a factor of the size, by friction and by the speed at the start.
    """
    scene = jc.Scene()
    for name in names:
        table, shape, place = SHAPES[name]
        inertia = jc.inertia.box(1.0, (0.2, 0.2, 0.3))
        velocity = (0.3, 0.0, -0.5)
        scene.add_body(name, inertia=inertia, position=place, quaternion=TURN, velocity=velocity)
        touch = {"friction": 0.2, "restitution": 0.3}
        scene.add(jc.contacts.ShapeContact(f"{name} law", jc.WORLD, name, table, shape, **touch))
    system, state = scene.build()
    method = jc.Method()
    state = jc.init(system, method, state.q, state.v)

    def end(x):
        changes = {}
        for name in names:
            field, size = SIZES[name]
            changes[f"{name} law"] = {field: jnp.asarray(size) * x[0], "friction": 0.2 * x[1]}
        start = dataclasses.replace(state, v=state.v + x[2])
        changed = system.with_params(changes)
        return jnp.sum(jc.rollout(changed, method, start, None, 1e-3, 40)[0].q ** 2)

    at = jnp.asarray([1.0, 1.0, 0.0])
    step = 1e-6 * jnp.eye(3)
    worlds = jnp.concatenate([at[None], at[None] + step, at[None] - step])
    ends, slopes = jax.jit(jax.vmap(jax.value_and_grad(end)))(worlds)
    assert np.sort(np.abs(slopes[0]))[1] > 1e-4  # a ball that sticks does not depend on friction
    differences = (ends[1:4] - ends[4:]) / 2e-6
    np.testing.assert_allclose(slopes[0], differences, rtol=100 * DIFFERENCE, atol=EXACT)


def first_rows(element, **body):
    """Returns the gaps and rates of the points of one contact of a body that moves."""
    scene = jc.Scene()
    given = {"mass": 1.0, "inertia": (1.0, 1.0, 1.0), "position": (0.1, 0.2, 0.4)}
    moving_body = {"velocity": (0.1, 0.2, 0.3), "angular_velocity": (0.3, 0.1, 0.2)}
    scene.add_body("b", **(given | moving_body | body))
    scene.add(element)
    system, state = scene.build()
    rows = linearize_bounds(system, state.q, state.v, state.time, None, jnp.asarray(1e-3))
    places = np.atleast_2d(rows.layout.rows("c"))[:, 0]
    return np.asarray(rows.gap)[places], np.asarray(rows.rate)[places]


def test_the_margin_is_a_distance_and_the_order_does_not_matter():
    table, shape = Box((0.4, 0.4, 0.2)), Capsule(0.1, 0.3, (0.1, 0.0, 0.4), TURN)
    gap, rate = first_rows(jc.contacts.ShapeContact("c", jc.WORLD, "b", table, shape))
    wide = jc.contacts.ShapeContact("c", jc.WORLD, "b", table, shape, margin=0.05)
    np.testing.assert_allclose(first_rows(wide)[0], gap - 0.05, atol=1e-15)
    turned = jc.contacts.ShapeContact("c", "b", jc.WORLD, shape, table)
    np.testing.assert_allclose(first_rows(turned), (gap, rate), atol=1e-12)
    assert gap.shape == (2,)


def test_shapes_lie_where_the_body_was_given():
    """Without a place of their own they follow the user's frame, not the principal axes."""
    tensor = jnp.asarray([[2.0, 0.3, 0.1], [0.3, 3.0, -0.2], [0.1, -0.2, 2.5]])
    off = jc.inertia.from_tensor(2.0, tensor, center=jnp.asarray([0.1, -0.2, 0.3]))
    body = {"mass": None, "inertia": off, "position": (0.1, 0.2, 1.0), "quaternion": TURN}
    size = (0.4, 0.3, 0.1)
    found, _ = first_rows(jc.contacts.ShapeContact("c", jc.WORLD, "b", Plane(), Box(size)), **body)
    heights = jc.contacts.box_corners(size, (0.1, 0.2, 1.0), TURN)[:, 2]
    np.testing.assert_allclose(found.min(), heights.min(), atol=1e-12)
    off = np.abs(found[:, None] - heights[None])
    assert off.min(axis=1).max() < 1e-12


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"shape_b": Box((1.0, 1.0))}, r"'c': shape_b.size must have shape \(3,\), got \(2,\)"),
        ({"shape_b": Box((1.0, 1.0, 0.0))}, "shape_b.size must be positive"),
        ({"shape_b": Sphere(-1.0)}, "shape_b.radius must be zero or more"),
        ({"shape_b": Sphere("1")}, "shape_b.radius must be a real number"),
        ({"shape_b": Capsule(0.1, -1.0)}, "shape_b.length"),
        ({"shape_b": Cylinder(0.0, 1.0)}, "shape_b.radius must be positive"),
        ({"shape_b": Cylinder(0.1, np.nan)}, "shape_b.length"),
        ({"shape_b": Ellipsoid((1.0, 1.0, -1.0))}, "shape_b.radii must be positive"),
        ({"shape_b": Hull([(0.0, 0.0, 0.0)])}, r"shape_b.points must have shape"),
        ({"shape_b": Hull((0.0, 0.0, 0.0))}, r"shape_b.points must have shape \(k, 3\)"),
        ({"shape_b": Box((1.0,) * 3, position=(0.0,))}, r"shape_b.position must have shape \(3,"),
        ({"shape_b": Box((1.0,) * 3, orientation=(0.0,) * 4)}, "shape_b.orientation must have a"),
        ({"shape_a": Plane(normal=(0.0, 0.0, 0.0))}, "shape_a.normal must have a length"),
        ({"shape_a": Plane(point=(0.0, 0.0))}, r"shape_a.point must have shape \(3,\)"),
        ({"shape_b": Plane()}, "no contact of a Plane with a Plane; a Plane has contacts with Sph"),
        ({"shape_a": Sphere(1.0), "shape_b": Sphere(1.0)}, "use jc.contacts.CapsuleContact"),
        ({"body_b": "dot", "shape_b": Box((1.0,) * 3)}, "shape_b is a Box, but .* a particle"),
        ({"body_a": "dot", "shape_b": Sphere(1.0)}, "shape_a is a Plane, but .* a particle"),
        ({"friction": -1.0}, "friction"),
        ({"restitution": 1.5}, "lie in 0 to 1"),
        ({"margin": -1.0}, "margin must"),
        ({"damping": 1.0}, "damping is of a soft stop"),
    ],
)
def test_bad_numbers_are_refused(given, match):
    scene = jc.Scene()
    scene.add_body("b", mass=1.0, inertia=(1.0, 1.0, 1.0))
    scene.add_particle("dot", mass=1.0)
    usual = {"body_a": jc.WORLD, "body_b": "b", "shape_a": Plane(), "shape_b": Sphere(0.1)}
    with pytest.raises(ValueError, match=match):  # noqa: PT012
        scene.add(jc.contacts.ShapeContact("c", **(usual | given)))
        scene.build()


def test_what_is_no_shape_is_refused():
    scene = jc.Scene()
    scene.add_body("b", mass=1.0, inertia=(1.0, 1.0, 1.0))
    scene.add(jc.contacts.ShapeContact("c", jc.WORLD, "b", Plane(), 0.1))
    with pytest.raises(TypeError, match="'c': shape_b must be a shape such as .*, got float"):
        scene.build()


def test_changed_numbers_are_checked():
    scene = jc.Scene()
    scene.add_body("b", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, 1.0))
    shapes = {"shape_a": Plane(), "shape_b": Cylinder(0.1, 0.2)}
    scene.add(jc.contacts.ShapeContact("c", jc.WORLD, "b", **shapes))
    system, _ = scene.build()
    assert float(system.with_params({"c": {"radius_b": 0.3}}).params["c"]["radius_b"]) == 0.3
    with pytest.raises(ValueError, match="radius_b must be positive"):
        system.with_params({"c": {"radius_b": 0.0}})
    with pytest.raises(ValueError, match=r"no \['friction'\].*friction=jnp.zeros"):
        system.with_params({"c": {"friction": 0.3}})
