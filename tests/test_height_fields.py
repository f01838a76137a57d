"""Contacts with height fields, compared with planes, parabolas and differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE

import jaxcon as jc
from jaxcon.contact.height_fields import above
from jaxcon.contact.rows import linearize_bounds
from jaxcon.core.lanes import Vector
from jaxcon.geometry.heights import Surface

QUICK = jc.solvers.GaussSeidel(sweeps=40)
G = 9.81


def rolling(system, state, steps):
    """Returns the function from h to the trajectory; the few contacts are solved by sweeps."""
    method = jc.Method(contact_solver=QUICK)
    state = jc.init(system, method, state.q, state.v)
    return jax.jit(lambda h: jc.rollout(system, method, state, None, h, steps)[1])


def surface(heights, size, lanes):
    """A surface that all lanes (pairs in contact) share."""
    edges = Vector(*(jnp.full(lanes, x) for x in size))
    return Surface(jnp.asarray(heights)[None], np.zeros(lanes, int), edges)


def test_a_quadratic_is_met_exactly_and_goes_on_straight():
    """Heights, slopes and curvatures are exact up to the edges.

    Beyond, the surface is its tangent.
    """
    x, y = np.linspace(-1, 1, 6), np.linspace(-1.5, 1.5, 4)
    rng = np.random.default_rng(0)

    def f(x, y):
        return 0.3 + 0.1 * x - 0.2 * y + 0.15 * x * x + 0.07 * x * y - 0.1 * y * y

    px, py = rng.uniform(-1, 1, 50), rng.uniform(-1.5, 1.5, 50)
    ground = surface(f(x[:, None], y[None]), (2.0, 3.0), 50)
    shape = ground.at(Vector(jnp.asarray(px), jnp.asarray(py)))
    np.testing.assert_allclose(shape.height, f(px, py), atol=1e-14)
    np.testing.assert_allclose(shape.slope[0], 0.1 + 0.3 * px + 0.07 * py, atol=1e-13)
    np.testing.assert_allclose(shape.slope[1], -0.2 + 0.07 * px - 0.2 * py, atol=1e-13)
    bends = [[shape.bend[i][j] for j in (0, 1)] for i in (0, 1)]
    np.testing.assert_allclose(np.mean(bends, axis=2), [[0.3, 0.07], [0.07, -0.2]], atol=1e-12)
    beyond = ground.at(Vector(jnp.full(50, 1.4), jnp.asarray(py)))
    want = f(1.0, py) + 0.4 * (0.4 + 0.07 * py)
    np.testing.assert_allclose(beyond.height, want, atol=1e-13)
    np.testing.assert_allclose(beyond.slope[1], -0.2 + 0.07 * 1.4 - 0.2 * py, atol=1e-13)


def test_slopes_are_continuous_and_are_those_of_the_heights():
    """Checks cells, edges and corners of rough ground by automatic differentiation."""
    rough = np.random.default_rng(1).normal(size=(6, 5))

    def height(place):
        return surface(rough, (2.0, 3.0), 1).at(Vector(place[:1], place[1:])).height[0]

    both = jax.jit(jax.vmap(jax.value_and_grad(height)))
    lines = np.array([-1.4, -1.0, -0.6, 0.2, 1.0])
    places = np.stack(np.meshgrid(lines, [-1.5, -0.75, 0.3, 1.5, 1.9]), -1).reshape(-1, 2)
    step = np.array([1e-9, 2e-9])
    (low, before), (high, after) = both(places - step), both(places + step)
    np.testing.assert_allclose(low, high, atol=1e-7)
    np.testing.assert_allclose(before, after, atol=1e-6)
    inside = jax.jit(lambda p: surface(rough, (2.0, 3.0), 25).at(Vector(*p.T)).slope.stack().T)
    np.testing.assert_allclose(inside(places + step), after, atol=1e-12)


def test_distances_are_those_to_the_nearest_point():
    """Compares distances over smooth ground with those of a fine search."""
    rng = np.random.default_rng(2)
    heights, size = 0.05 * rng.normal(size=(7, 6)), (2.0, 3.0)
    px, py = rng.uniform(-0.8, 0.8, 8), rng.uniform(-1.2, 1.2, 8)
    ground = surface(heights, size, 8)
    z = np.asarray(ground.at(Vector(jnp.asarray(px), jnp.asarray(py))).height) + 0.2
    found, normal = jax.jit(lambda p: above(ground, p))(Vector(*map(jnp.asarray, (px, py, z))))
    fine = np.stack(np.meshgrid(np.linspace(-0.2, 0.2, 401), np.linspace(-0.2, 0.2, 401)))
    for i in range(8):
        x, y = (fine + np.array([px[i], py[i]])[:, None, None]).reshape(2, -1)
        at = surface(heights, size, len(x)).at(Vector(jnp.asarray(x), jnp.asarray(y))).height
        apart = np.sqrt((x - px[i]) ** 2 + (y - py[i]) ** 2 + (at - z[i]) ** 2)
        np.testing.assert_allclose(found[i], apart.min(), rtol=1e-5)
    np.testing.assert_allclose(normal.dot(normal), 1.0, rtol=1e-14)


def test_on_rough_ground_the_search_ends_where_the_way_is_level():
    """No distance exceeds the vertical one; nearly all results are perpendicular to the ground."""
    rough, count = 2.0 * np.random.default_rng(3).normal(size=(8, 8)), 1000
    rng = np.random.default_rng(4)
    px, py = rng.uniform(-1, 1, (2, count))
    ground = surface(rough, (2.0, 2.0), count)
    below = np.asarray(ground.at(Vector(jnp.asarray(px), jnp.asarray(py))).height)
    point = Vector(*map(jnp.asarray, (px, py, below + rng.uniform(0, 1, count))))
    found, _ = jax.jit(lambda p: above(ground, p))(point)
    assert np.all((found > 0) & (found <= point[2] - below + 1e-12))
    place = jax.jit(ground.nearest)(point)
    shape = ground.at(place)
    off = np.asarray(shape.height - point[2])
    slip = np.hypot(*(np.asarray(place[i] - point[i] + shape.slope[i] * off) for i in (0, 1)))
    assert np.mean(slip > 1e-6) < 0.05


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("shape", ["ball", "box"])
def test_an_inclined_field_is_a_plane(dim, shape):
    """A rough ball, or a box on its corners, bounces, rolls and slides as on a plane.

    The motion continues beyond the edge of the field.
    """
    turn = -0.5 if dim == 2 else np.array([np.cos(0.2), np.sin(0.2), 0.0, 0.0])
    pose = jc.extend.Pose(jnp.zeros(dim), jnp.asarray(turn))
    slope = np.array([-0.3, 0.1])[: dim - 1]
    line = np.linspace(-0.5, 0.5, 5)
    heights = slope[0] * line if dim == 2 else slope[0] * line[:, None] + slope[1] * line[None]
    up = np.asarray(pose.direction(jnp.asarray([*-slope, 1.0])))
    middle = np.array([0.1, -0.2, 0.3])[-dim:]
    start = middle + 0.12 * up / np.linalg.norm(up)
    corners = jc.contacts.box_corners((0.16, 0.12, 0.1)[:dim], start)
    own = {"radius": 0.1} if shape == "ball" else {"center": corners}
    touch = {"friction": 0.3, "restitution": 0.5} | own
    size = 1.0 if dim == 2 else (1.0, 1.0)
    place = {"position": middle, "orientation": turn}
    ends = []
    for floor in (
        jc.PlaneContact("floor", jc.WORLD, "ball", normal=up, point=middle, **touch),
        jc.contacts.HeightFieldContact("floor", jc.WORLD, "ball", heights, size, **place, **touch),
    ):
        scene = jc.Scene(dim=dim)
        inertia = 0.004 if dim == 2 else jc.inertia.sphere(1.0, 0.1)
        mass = {"mass": 1.0} if dim == 2 else {}
        scene.add_body("ball", inertia=inertia, position=start, **mass)
        scene.add(floor)
        ends.append(rolling(*scene.build(), 120)(5e-3))
    assert float(jnp.abs(ends[0].q[-1, :dim] - middle).max()) > 0.5
    assert float(jnp.abs(ends[0].v[:, dim:]).max()) > 1.0  # rotated by friction
    np.testing.assert_allclose(ends[1].q, ends[0].q, atol=1e-12)


R = 0.5
"""The radius of curvature at the bottom of the bowls."""


def parabola(count, dim=2, edge=2.0):
    line = np.linspace(-edge / 2, edge / 2, count)
    return line**2 / (2 * R) if dim == 2 else (line[:, None] ** 2 + line[None] ** 2) / (2 * R)


def swing(foot, radius, share, time):
    """Returns the contact point x of a disc that rolls or slides in z = x²/2R from rest.

    With the slope angle θ and κ = cos³θ/R, the center moves by σ = (1 − r κ)/cos θ per unit of x.
    The conserved energy is (1 + share) ½ σ² ẋ² + g z, so σ ẍ + σ′ ẋ² = −g z′/σ (1 + share).
    """

    def acceleration(x, v):
        c = 1 / np.sqrt(1 + (x / R) ** 2)
        curvature, turned = c**3 / R, -3 * c**5 * x / R**3
        σ = (1 - radius * curvature) / c
        dσ = -radius * turned / c + (1 - radius * curvature) * x / R**2 * c
        rise = x / R - radius * c**3 * x / R**2
        return -G * rise / (σ * σ * (1 + share)) - dσ * v * v / σ

    x, v, h = foot, 0.0, 1e-4
    for _ in range(round(time / h)):
        k = [(v, acceleration(x, v))]
        for a in (h / 2, h / 2, h):
            y = x + a * k[-1][0], v + a * k[-1][1]
            k.append((y[1], acceleration(*y)))
        x, v = (
            (z + h / 6 * (p + 2 * q + 2 * r + s)) for z, p, q, r, s in zip((x, v), *k, strict=True)
        )
    return x


def test_discs_in_a_parabolic_valley():
    """One disc slides and one rolls; the error of their motions is of first order in h."""
    radius, foot = 0.1, 0.3
    up = np.array([-foot / R, 1.0]) / np.hypot(foot / R, 1.0)
    start = np.array([foot, foot**2 / (2 * R)]) + radius * up
    scene = jc.Scene(dim=2)
    shares = {"slides": 0.0, "rolls": 0.5}
    for name, share in shares.items():
        scene.add_body(name, mass=1.0, inertia=0.5 * radius**2, position=start)
        touch = {"radius": radius, "friction": 5.0 if share else 0.0}
        heights = parabola(11)
        scene.add(
            jc.contacts.HeightFieldContact(f"{name} on", jc.WORLD, name, heights, 2.0, **touch)
        )
    system, state = scene.build()
    run = rolling(system, state, 600)
    paths = {2e-3: run(2e-3).q[299], 1e-3: run(1e-3).q[599]}
    for name, share in shares.items():
        end = swing(foot, radius, share, 0.6)
        want = end - radius * end / R / np.hypot(end / R, 1.0)
        off = [float(q[system.layout.q(name)[0]]) - want for q in paths.values()]
        assert abs(off[1]) < 5e-3
        np.testing.assert_allclose(off[0] / off[1], 2.0, rtol=0.15)


def test_a_ball_circles_in_a_paraboloid():
    """Without friction the center circles with ω² = g tan θ/ρ at constant height."""
    radius, foot = 0.1, 0.3
    tilt = np.arctan(foot / R)
    ρ, z = foot - radius * np.sin(tilt), foot**2 / (2 * R) + radius * np.cos(tilt)
    ω = np.sqrt(G * np.tan(tilt) / ρ)
    scene = jc.Scene()
    inertia = jc.inertia.sphere(1.0, radius)
    scene.add_body("ball", inertia=inertia, position=(ρ, 0, z), velocity=(0, ρ * ω, 0))
    bowl = jc.contacts.HeightFieldContact(
        "bowl", jc.WORLD, "ball", parabola(9, 3), (2.0, 2.0), radius=radius
    )
    scene.add(bowl)
    system, state = scene.build()
    found = []
    run = rolling(system, state, 500)
    for h, last in ((2e-3, 249), (1e-3, 499)):
        place = np.asarray(run(h).q[last, :3])
        found.append([np.angle(place[0] + 1j * place[1]) - ω * 0.5, np.hypot(*place[:2]) - ρ])
    found = np.array(found)
    found[:, 0] -= 2 * np.pi * np.round(found[:, 0] / (2 * np.pi))
    assert np.abs(found[1]).max() < 1e-2
    assert np.abs(found[1]).max() < 0.6 * np.abs(found[0]).max()


def terrain(dtype=None):
    """A disc falls on rough ground that belongs to a moving body."""
    rng = np.random.default_rng(5)
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_body("land", mass=5.0, inertia=1.0, position=(0.0, -0.2), angle=0.05)
    place = {"position": (0.02, 0.1), "velocity": (0.2, -1.0)}
    scene.add_body("disc", mass=2.0, inertia=0.003, **place)
    ground = jc.contacts.HeightFieldContact(
        "ground", "land", "disc", 0.03 * rng.normal(size=6), 1.0, radius=0.05, friction=0.4,
        position=(0.0, 0.0), orientation=0.0,
    )  # fmt: skip
    scene.add(ground)
    return scene.build()


def test_gradients_by_heights():
    """The differences come from a batch of worlds, each with its own ground."""
    system, state = terrain()
    method = jc.Method(contact_solver=QUICK)
    state = jc.init(system, method, state.q, state.v)
    given = system.params["ground"]["heights"]
    assert given.shape == (6,)

    def end(x):
        changed = system.with_params({"ground": {"heights": x}})
        return jnp.sum(jc.rollout(changed, method, state, None, 2e-3, 40)[0].q ** 2)

    along = jnp.asarray(np.random.default_rng(6).normal(size=6))
    worlds = jnp.stack([given, given + 1e-6 * along, given - 1e-6 * along])
    ends, slopes = jax.jit(jax.vmap(jax.value_and_grad(end)))(worlds)
    assert np.abs(slopes[0]).max() > 1e-3
    np.testing.assert_allclose(slopes[0] @ along, (ends[1] - ends[2]) / 2e-6, rtol=DIFFERENCE)


def test_a_step_in_float32_is_that_in_float64():
    """Compares velocities and their derivatives by heights, for a disc that hits the ground."""
    found, method = [], jc.Method(contact_solver=jc.solvers.GaussSeidel(sweeps=40, warm=False))
    for dtype in (jnp.float64, jnp.float32):
        system, state = terrain(dtype)
        height = 0.04 if dtype == jnp.float64 else jnp.float32(0.04)
        state = dataclasses.replace(state, q=state.q.at[system.layout.q("disc")[1]].set(height))

        def speed(x, system=system, state=state):
            changed = system.with_params({"ground": {"heights": x}})
            h = jnp.asarray(2e-3, state.q.dtype)
            return jnp.sum(jc.step(changed, method, state, None, h)[0].v)

        given = system.params["ground"]["heights"]
        found.append([*map(np.asarray, jax.jit(jax.value_and_grad(speed))(given))])
    (exact, slope), (value, found32) = found
    assert np.abs(slope).max() > 0.1
    np.testing.assert_allclose(value, exact, rtol=1e-4)
    np.testing.assert_allclose(found32, slope, rtol=1e-3, atol=1e-3 * np.abs(slope).max())


def test_a_box_stands_on_its_corners():
    """The field is a plane, so the gaps are the distances of the corners from that plane."""
    line = np.linspace(-0.5, 0.5, 4)
    corners = jc.contacts.box_corners((0.4, 0.3), (0.1, 0.6), 0.2)
    scene = jc.Scene(dim=2)
    scene.add_body("box", mass=1.0, inertia=0.02, position=(0.1, 0.6), angle=0.2)
    ground = jc.contacts.HeightFieldContact(
        "ground", jc.WORLD, "box", 0.5 * line, 1.0, center=corners
    )
    scene.add(ground)
    system, state = scene.build()
    found = linearize_bounds(system, state.q, state.v, state.time, None, jnp.asarray(1e-3))
    rows = found.layout.rows("ground")
    assert rows.shape == (4, 1)
    want = (corners[:, 1] - 0.5 * corners[:, 0]) / np.hypot(0.5, 1.0)
    np.testing.assert_allclose(found.gap[rows[:, 0]], want, atol=1e-14)


FLAT = np.zeros((4, 5))


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"heights": np.zeros(4)}, r"HeightFieldContact 'h': heights must have shape \(n_x, n_y\)"),
        ({"heights": np.zeros((3, 5))}, r"at least 4 along each axis, got \(3, 5\)"),
        ({"heights": FLAT + np.nan}, "heights must be finite"),
        ({"heights": [[0.0] * 4, [0.0] * 3]}, "'h': heights must be numbers, as many in each row"),
        ({"size": (1.0, 0.0)}, "size must be positive"),
        ({"size": 1.0}, r"size must have shape \(2,\)"),
        ({"radius": -1.0}, "radius"),
        ({"friction": -1.0}, "friction"),
        ({"restitution": 1.5}, "lie in 0 to 1"),
        ({"orientation": (0.0, 0.0, 0.0, 0.0)}, "orientation must have a length"),
        ({"position": (0.0, 0.0)}, r"position must have shape \(3,\)"),
        ({"body_a": "dot"}, "'dot' is a particle"),
    ],
)
def test_bad_numbers_are_refused(given, match):
    scene = jc.Scene()
    scene.add_body("ball", inertia=jc.inertia.sphere(1.0, 0.1))
    scene.add_particle("dot", mass=1.0)
    usual = {"body_a": jc.WORLD, "body_b": "ball", "heights": FLAT, "size": (1.0, 1.0)}
    scene.add(jc.contacts.HeightFieldContact("h", **(usual | given)))
    with pytest.raises(ValueError, match=match):
        scene.build()


def test_heights_of_another_shape_are_refused_later_too():
    system, _ = terrain()
    with pytest.raises(ValueError, match=r"ground\.heights.*shape \(6,\)"):
        system.with_params({"ground": {"heights": np.zeros(7)}})
