"""Hand-written rows compared with derivatives of their residual, off the constraints.

For q̇ = N(q) v with v constant: φ̇ = ∂φ/∂q N v + ∂φ/∂t, J = ∂φ̇/∂v, γ = dφ̇/dt. The residuals are
compared with formulas that are written here with matrices.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import DERIVATIVE, DIFFERENCE, ROUND_OFF

import jaxcon as jc
from jaxcon.constraints import primitives
from jaxcon.constraints.rows import linearize


def by_hand(system, q, v, t):
    rows = scenes.linearized(system, q, v, t)
    return rows.residual, rows.rate, rows.jacobian.dense(), rows.bias


def by_derivation(system, level, q, v, t):
    """Returns φ̇, J, γ and ∂φ/∂t by differentiation of φ, or of ψ in rows where `level` is True."""

    def residual(q, t):
        return linearize(system, q, jnp.zeros_like(v), t).residual

    def rate(q, v, t):
        given = linearize(system, q, v, t).rate
        derived = jax.jvp(residual, (q, t), (system.kinematics(q, v), jnp.ones_like(t)))[1]
        return jnp.where(level, given, derived)

    # one compilation for all derivatives of the rate
    derive = jax.jit(lambda v, dq, dv, dt: jax.jvp(rate, (q, v, t), (dq, dv, dt)))
    still, moving = jnp.zeros_like(q), jnp.zeros_like(v)
    value, bias = derive(v, system.kinematics(q, v), moving, jnp.ones_like(t))
    columns = [derive(v, still, unit, jnp.zeros_like(t))[1] for unit in jnp.eye(len(v))]
    return value, jnp.stack(columns, 1), bias, derive(moving, still, moving, jnp.zeros_like(t))[0]


def level_rows(built):
    """Returns a mask of the rows that have no φ."""
    layout = layout_of(built)
    level = np.zeros(layout.size, bool)
    for name, held in built.velocity_level:
        level[layout.rows(name)[held:]] = True
    return level


def layout_of(built):
    return scenes.linearized(built.system, built.off.q, built.off.v, built.off.time).layout


@pytest.mark.parametrize("name", [n for n in scenes.NAMES if "loop" not in n])
def test_rows_are_derivatives_of_the_residual(name):
    """Loops are left out: their joints have the rows of joints between two moving bodies."""
    built = scenes.build(name)
    level, s = level_rows(built), built.off
    residual, rate, jacobian, bias = by_hand(built.system, s.q, s.v, s.time)
    expected = by_derivation(built.system, level, s.q, s.v, s.time)
    layout = layout_of(built)
    np.testing.assert_array_equal(layout.holonomic, ~level)
    close = {"rtol": DERIVATIVE, "atol": DERIVATIVE}
    for constraint in layout.names:
        rows = layout.rows(constraint)
        close["err_msg"] = constraint
        np.testing.assert_allclose(rate[rows], expected[0][rows], **close)
        np.testing.assert_allclose(jacobian[rows], expected[1][rows], **close)
        np.testing.assert_allclose(bias[rows], expected[2][rows], **close)
        moved = jacobian[rows] @ s.v + expected[3][rows]
        np.testing.assert_allclose(moved, rate[rows], **close)
    assert np.all(np.abs(residual[~level]) > 1e-6), "the state is not off the constraints"
    np.testing.assert_array_equal(residual[level], 0)


@pytest.mark.parametrize("name", [n for n in scenes.ALL if "between" in n])
def test_rows_of_single_precision_are_those_of_double_precision(name):
    """The results differ only by rounding of sums of the same float32 numbers."""
    built = scenes.build(name, "float32")
    state = built.off
    found = by_hand(built.system, state.q, state.v, state.time)
    system, state = jax.tree.map(to_double, (built.system, state))
    expected = by_hand(system, state.q, state.v, state.time)
    single, double = np.dtype("float32"), np.dtype("float64")
    for got, exact in zip(found, expected, strict=True):
        assert (got.dtype, exact.dtype) == (single, double)
        size = 1 + np.max(np.abs(exact))
        np.testing.assert_allclose(got, exact, rtol=0, atol=ROUND_OFF[single] * size)


def to_double(x):
    return x.astype(jnp.float64) if x.dtype == jnp.float32 else x


@pytest.mark.parametrize("dim", [2, 3])
def test_rates_along_a_motion_in_time(dim):
    """Compares rates with central differences of a motion at constant v."""
    built = scenes.build(f"mixed-{dim}d")
    system, s, h = built.system, built.off, 1e-5
    keep = ~level_rows(built)
    ahead, behind = (
        by_hand(system, system.retract(s.q, x * s.v), s.v, s.time + x) for x in (h, -h)
    )
    _, rate, _, bias = by_hand(system, s.q, s.v, s.time)
    slope = (ahead[0] - behind[0]) / (2 * h)
    np.testing.assert_allclose(rate[keep], slope[keep], rtol=DIFFERENCE, atol=DIFFERENCE)
    slope = (ahead[1] - behind[1]) / (2 * h)
    np.testing.assert_allclose(bias, slope, rtol=DIFFERENCE, atol=DIFFERENCE)


class Body:
    """A body's frame, as position and rotation matrix; the world's frame for the name WORLD."""

    def __init__(self, built, name):
        dim = built.system.layout.dim
        self.x, self.r = np.zeros(dim), np.eye(dim)
        if name == jc.WORLD:
            return
        q = np.asarray(built.off.q)[built.system.layout.q(name)]
        self.x = q[:dim]
        if dim == 2:
            c, s = np.cos(q[2]), np.sin(q[2])
            self.r = np.array([[c, -s], [s, c]])
        else:
            self.r = matrix(q[3:])

    def point(self, anchor):
        return self.x + self.r @ np.asarray(anchor)


def matrix(q):
    """Returns the rotation matrix (w + k)(w + k) of a unit quaternion, with k the cross product."""
    w, (x, y, z) = q[0], q[1:]
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * k + 2 * k @ k


def gap(p, a, b):
    return b.point(p["anchor_b"]) - a.point(p["anchor_a"])


def distance(p, a, b):
    return [np.linalg.norm(gap(p, a, b)) - p["length"]]


def revolute(p, a, b):
    if "axis" not in p:
        return gap(p, a, b)
    n, across = a.r @ p["axis"], (b.r @ p["first_b"], b.r @ p["second_b"])
    return [*gap(p, a, b), *(n @ u for u in across)]


def universal(p, a, b):
    return [*gap(p, a, b), (a.r @ p["axis_a"]) @ (b.r @ p["axis_b"])]


def turned(p, a, b):
    """Returns the remaining angle in the plane, or 2 sin(θ/2) n of the rotation in space."""
    if a.x.shape == (2,):
        left = a.r.T @ b.r
        angle = np.arctan2(left[1, 0], left[0, 0]) - p["orientation"]
        return [np.angle(np.exp(1j * angle))]
    left = a.r.T @ b.r @ matrix(np.asarray(p["orientation"])).T
    sine = np.array([left[2, 1] - left[1, 2], left[0, 2] - left[2, 0], left[1, 0] - left[0, 1]]) / 2
    cosine = (np.trace(left) - 1) / 2
    return sine / np.cos(np.arccos(cosine) / 2)


def fixed(p, a, b):
    return [*gap(p, a, b), *turned(p, a, b)]


def prismatic(p, a, b):
    normals = [p[side] for side in ("first_a", "second_a") if side in p]
    return [*((a.r @ u) @ gap(p, a, b) for u in normals), *turned(p, a, b)]


def across(p, a, b):
    """Returns the cosines between an axis of a and the two normals of the axis in b."""
    return [(a.r @ p["axis"]) @ (b.r @ p[side]) for side in ("first_b", "second_b")]


def point_on_line(p, a, b):
    normals = [p[side] for side in ("first_a", "second_a") if side in p]
    return [(a.r @ u) @ gap(p, a, b) for u in normals]


def point_on_plane(p, a, b):
    return [(a.r @ p["axis"]) @ gap(p, a, b)]


def planar(p, a, b):
    return [*point_on_plane(p, a, b), *across(p, a, b)]


def cylindrical(p, a, b):
    return [*point_on_line(p, a, b), *across(p, a, b)]


def screw(p, a, b):
    """Returns φ of the screw: travel minus lead times turns, modulo whole turns."""
    pointer = b.r @ p["first_b"]
    turns = np.arctan2((a.r @ p["second_a"]) @ pointer, (a.r @ p["first_a"]) @ pointer) / 2 / np.pi
    left = (a.r @ p["axis"]) @ gap(p, a, b) / p["lead"] - turns
    return [*cylindrical(p, a, b), p["lead"] * (left - np.round(left))]


def constant_velocity(p, a, b):
    """Returns φ = (1 + cos β) sin τ, with the bend β of the shafts and the remaining twist τ."""
    n, m = (
        np.cross(x.r @ p["first" + s], x.r @ p["second" + s]) for x, s in ((a, "_a"), (b, "_b"))
    )
    k = np.cross(m, n)
    cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    back = np.eye(3) + cross + cross @ cross / (1 + n @ m)  # the smallest rotation from m to n
    u, w, pointer = a.r @ p["first_a"], a.r @ p["second_a"], back @ b.r @ p["first_b"]
    return [*gap(p, a, b), (1 + n @ m) * np.sin(np.arctan2(w @ pointer, u @ pointer))]


def revolute_spherical(p, a, b):
    return [*point_on_plane(p, a, b), *distance(p, a, b)]


RESIDUALS = {
    "coincident": gap,
    "spherical": gap,
    "distance": distance,
    "revolute": revolute,
    "universal": universal,
    "fixed": fixed,
    "prismatic": prismatic,
    "cylindrical": cylindrical,
    "screw": screw,
    "planar": planar,
    "parallel": across,
    "constant_velocity": constant_velocity,
    "point_on_line": point_on_line,
    "point_on_plane": point_on_plane,
    "spherical_spherical": distance,
    "revolute_spherical": revolute_spherical,
}
FORMULAS = [
    f"{kind}-{dim}d-{topology}"
    for kind in RESIDUALS
    for dim in scenes.JOINTS[kind].dims
    for topology in ("tree", "between")
]


@pytest.mark.parametrize("name", FORMULAS)
def test_residual_is_the_formula(name):
    built = scenes.build(name)
    pair = (jc.WORLD, "first") if name.endswith("tree") else ("first", "second")
    p = {key: np.asarray(x) for key, x in built.system.params["joint"].items()}
    expected = np.array(RESIDUALS[name.split("-")[0]](p, *(Body(built, b) for b in pair)))
    off = built.off
    got = np.array(scenes.linearized(built.system, off.q, off.v, off.time).residual)
    if "orientation" in p and built.system.layout.dim == 2:  # planar angles include whole turns
        got[-1] = np.angle(np.exp(1j * got[-1]))
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", scenes.NAMES)
def test_rows_hold_where_the_scene_was_assembled(name):
    built = scenes.build(name)
    assert jc.violation(built.system, built.state).worst < 1e-13


FREEDOM = {
    "coincident": (1, 3),
    "spherical": (None, 3),
    "distance": (2, 5),
    "revolute": (1, 1),
    "prismatic": (1, 1),
    "universal": (None, 2),
    "cylindrical": (None, 2),
    "screw": (None, 1),
    "planar": (None, 3),
    "parallel": (None, 4),
    "constant_velocity": (None, 2),
    "point_on_line": (2, 4),
    "point_on_plane": (2, 5),
    "point_on_curve": (2, 4),
    "spherical_spherical": (None, 5),
    "revolute_spherical": (None, 4),
    "fixed": (0, 0),
    "driven_revolute": (0, 0),
    "driven_prismatic": (0, 0),
    "driven_universal_a": (None, 1),
    "driven_universal_b": (None, 1),
    "driven_sleeve": (None, 1),
    "driven_shaft": (None, 1),
    "driven_planar": (None, 2),
    "pulley": (2, 5),
    "cam": (0, 0),
    "rolling_sphere": (None, 3),
    "rolling_cylinder": (None, 1),
    "rolling_disc": (1, 3),
    "knife_edge": (2, 4),
    "telescope": (None, 2),
    "gimbal": (None, 2),
    "holonomic": (2, 5),
    "velocity_level": (2, 5),
    "momentum": (2, 3),
}


@pytest.mark.parametrize("name", scenes.names("tree"))
def test_joints_leave_their_freedom(name):
    kind, dim, _ = name.split("-")
    built = scenes.build(name)
    left = jc.report(built.system, built.off).degrees_of_freedom
    assert left == FREEDOM[kind][int(dim[0]) - 2]


@pytest.mark.parametrize("dim", [2, 3])
def test_a_distance_of_zero_has_no_direction_and_is_finite(dim):
    scene = jc.Scene(dim=dim)
    scene.add_particle("a", mass=1.0, position=(1.0,) * dim)
    scene.add(jc.Distance("rod", jc.WORLD, "a"))
    system, state = scene.build()

    def rows(q):
        found = linearize(system, q, jnp.ones(dim), state.time)
        return found.residual, found.rate, found.jacobian.dense(), found.bias

    derivatives = (rows, jax.jacfwd(rows), jax.jacrev(rows))
    for leaf in jax.tree.leaves([f(jnp.zeros(dim)) for f in derivatives]):
        assert jnp.all(jnp.isfinite(leaf))


@pytest.mark.parametrize("stabilizer", [jc.Baumgarte, jc.stabilizers.AdaptiveBaumgarte])
def test_a_rod_flung_far_away_has_its_derivative_in_float32(stabilizer):
    """Large intermediate products must not overflow; the formula divides before it multiplies."""

    def slope(dtype):
        scene = jc.Scene(dim=2, dtype=dtype)
        scene.add_particle("a", mass=1.0, position=(1.0, 0.0))
        scene.add(jc.Distance("rod", jc.WORLD, "a"))
        system, state = scene.build()
        method = jc.Method(stabilizer=stabilizer(dtype(20.0), dtype(20.0)))

        def motion(q):
            moved = dataclasses.replace(state, q=q, v=jnp.array([0.0, 3e9], dtype))
            return jc.forward_dynamics(system, moved, None, method, dtype(1e-2)).acceleration

        q, way = (jnp.array(x, dtype) for x in ([6e8, 0.0], [6e21, 1e21]))
        return jax.jit(lambda q, way: jax.jvp(motion, (q,), (way,))[1])(q, way)

    np.testing.assert_allclose(slope(jnp.float32), slope(jnp.float64), rtol=1e-4)


@pytest.mark.parametrize(
    "kind", ["fixed", "prismatic", "driven_revolute", "screw", "telescope", "gimbal"]
)
def test_derivatives_of_rows_at_the_identity_are_finite(kind):
    """Both bodies have the identity orientation, and the joint is as at assembly."""
    scene = jc.Scene()
    for name in ("first", "second"):
        scene.add_body(name, mass=1.0, inertia=(1.0, 1.0, 1.0))
    site = scenes.Site("first", "second", 3, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.ones(3))
    for element in scenes.JOINTS[kind].make(site):
        scene.add(element)
    system, state = scene.build()

    def rows(q):
        return by_hand(system, q, state.v, state.time)

    for leaf in jax.tree.leaves(jax.jit(jax.jacrev(rows))(state.q)):
        assert jnp.all(jnp.isfinite(leaf))


@pytest.mark.parametrize("radius", [0.0, 1e-10, 1e-8, 1e-6, 0.1])
def test_an_angle_has_derivatives_close_to_its_axis_in_float32(radius):
    """θ, θ̇ and γ of atan2 by (c, s, ċ, ṡ) equal those in float64; on the axis they are zero."""

    def angle(x):
        c, s = (primitives.Row(x[i], x[i + 2], 0 * x[i], (x[i], x[i])) for i in (0, 1))
        row = primitives.bearing(c, s)
        return jnp.stack([row.value, row.rate, row.bias])

    def derivatives(dtype):
        x = jnp.asarray([0.6 * radius, -0.8 * radius, 1e-3, 2e-3], dtype)
        return [np.asarray(d(angle)(x), np.float64) for d in (jax.jacfwd, jax.jacrev)]

    for got, expected in zip(derivatives("float32"), derivatives("float64"), strict=True):
        assert np.all(np.isfinite(got))
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4 * np.max(np.abs(expected)))
        assert radius > 0 or not np.any(got)
