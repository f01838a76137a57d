"""Contacts and ropes: closed forms, energy, Coulomb's law, gradients through impacts."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.contact.contact import across_axes
from jaxcon.core.lanes import Vector
from jaxcon.verification import references

H = 1e-3
FORMS = {case["id"]: case for case in references.load("contact_closed_forms")["cases"]}
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
dtypes = pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])


def run(system, state, h, steps, method=None, every=1):
    """Rolls out and returns the recorded states and reactions."""
    method = jc.Method() if method is None else method
    state = jc.init(system, method, state.q, state.v)
    return recorded(system, method, state, jnp.asarray(h, state.q.dtype), steps, every)


@functools.partial(jax.jit, static_argnames=("steps", "every"))
def recorded(system, method, state, h, steps, every):
    """Rolls out; scenes that differ only in numbers share one compiled program."""

    def record(s, i):
        return s, i.reactions

    return jc.rollout(system, method, state, None, h, steps, record=record, every=every)[1]


def ball(velocity, spin=(0.0, 0.0, 0.0), height=1e-9, gravity=0.0, **contact):
    """A ball of 1 kg and radius 0.1 m over a floor."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -gravity))
    inertia = jc.inertia.sphere(1.0, 0.1)
    scene.add_body(
        "ball", inertia=inertia, position=(0, 0, 0.1 + height), velocity=velocity,
        angular_velocity=spin,
    )  # fmt: skip
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=0.1, **contact))
    return scene.build()


def box(slope, friction, dtype=None, size=(0.4, 0.3, 0.1)):
    """A box on four corners; the slope tilts gravity, not the floor."""
    turned = (9.81 * np.sin(slope), 0.0, -9.81 * np.cos(slope))
    scene = jc.Scene(dim=3, gravity=turned, dtype=dtype)
    a, b, c = size
    scene.add_body("box", inertia=jc.inertia.box(2.0, size), position=(0, 0, c / 2))
    for k, (x, y) in enumerate(CORNERS):
        corner = (x * a / 2, y * b / 2, 0.0)
        scene.add(jc.PlaneContact(f"{k}", jc.WORLD, "box", center=corner, friction=friction))
    return scene.build()


def test_a_ball_bounces_as_high_as_it_should():
    case = FORMS["bouncing_ball"]
    system, state = ball((0.0, 0.0, 0.0), height=1.0, gravity=9.81, restitution=0.8)
    h = 2.5e-4
    states, _ = run(system, state, h, 8800)
    height = np.asarray(states.q[:, 2]) - 0.1
    times = [0.0, *case["impact_times"]]
    for k in (1, 2, 3):
        between = height[int(times[k] / h) : int(times[k + 1] / h)]
        assert abs(between.max() / case["apex_heights"][k - 1] - 1) < 0.01
    assert height.min() > -1e-12


@pytest.mark.parametrize("name", ["sphere_floor_stick", "sphere_floor_slip"])
def test_an_impact_with_friction(name):
    """The reference is planar with its spin about z; that axis is −y of this scene."""
    after = FORMS[name]["after"]
    start, spin = ((1.0, 0.0, -2.0), 0.0) if "stick" in name else ((4.0, 0.0, -2.0), 5.0)
    system, state = ball(start, (0.0, -spin, 0.0), friction=0.3, restitution=0.7)
    states, _ = run(system, state, 1e-4, 2)
    found = states.v[-1]
    want = [after["vx"], 0.0, after["vy"], 0.0, -after["w"], 0.0]
    np.testing.assert_allclose(found, want, atol=1e-9)


def test_balls_that_meet():
    """A central collision, and a cradle by Newton's simultaneous impact law."""
    case = FORMS["central_collision"]
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    scene.add_particle("a", mass=2.0, position=(0, 0, 0), velocity=(3.0, 0, 0))
    scene.add_particle("b", mass=5.0, position=(0.2, 0, 0), velocity=(-1.0, 0, 0))
    scene.add(
        jc.contacts.CapsuleContact("touch", "a", "b", radius_a=0.1, radius_b=0.1, restitution=0.6)
    )
    states, _ = run(*scene.build(), H, 1)
    np.testing.assert_allclose(states.v[-1, :2], [case["v1_after"], case["v2_after"]], rtol=1e-9)
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    for i in range(3):
        scene.add_particle(f"{i}", mass=1.0, position=(0.2 * i, 0), velocity=(float(i == 0), 0))
    for i in range(2):
        touch = {"radius_a": 0.1, "radius_b": 0.1, "restitution": 1.0}
        scene.add(jc.contacts.CapsuleContact(f"touch {i}", f"{i}", f"{i + 1}", **touch))
    states, reactions = run(*scene.build(), H, 1)
    np.testing.assert_allclose(states.v[-1, :3], [-1 / 3, 2 / 3, 2 / 3], rtol=1e-9)
    np.testing.assert_allclose(reactions.kept, 1.0)


def test_a_rod_that_falls_on_its_tip():
    case = FORMS["rod_tip_impact"]
    turn = np.pi / 6
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    position, tip = (0.0, 0.5 * np.sin(turn)), (0.5 * np.cos(turn), 0.0)
    scene.add_body("rod", mass=1.0, inertia=1 / 12, position=position, velocity=(0.0, -2.0))
    scene.add(jc.PlaneContact("tip", jc.WORLD, "rod", center=tip, restitution=0.5))
    states, reactions = run(*scene.build(), 1e-5, 1)
    np.testing.assert_allclose(states.v[-1, 1], case["com_velocity_after"], rtol=1e-6)
    np.testing.assert_allclose(abs(states.v[-1, 2]), case["abs_omega_after"], rtol=1e-6)
    np.testing.assert_allclose(1e-5 * reactions["tip"][0, 0], case["normal_impulse"], rtol=1e-6)


def test_a_bowling_ball_slides_then_rolls():
    """The reference has y up and rolls along z; here z is up and x is along the lane."""
    want = FORMS["bowling_ball"]["states"][-1]
    errors = []
    for h in (2e-3, 1e-3):
        scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -9.8))
        scene.add_body(
            "ball", mass=6.35, inertia=(0.0296,) * 3, position=(0, 0, 0.10795),
            velocity=(8.0, 0.0, 0.0), angular_velocity=(-8 * np.pi, 0.0, 0.0),
        )  # fmt: skip
        lane = jc.PlaneContact("lane", jc.WORLD, "ball", radius=0.10795, friction=0.12)
        scene.add(lane)
        states, _ = run(*scene.build(), h, int(2.4 / h), every=int(2.4 / h))
        place, speed = states.q[-1, :2], states.v[-1, :2]
        errors.append(np.abs(place - np.array([want["z"], want["x"]])).max())
        np.testing.assert_allclose(speed, [want["vz"], want["vx"]], rtol=1e-6)
    assert errors[1] < 2e-3
    np.testing.assert_allclose(errors[0] / errors[1], 2.0, rtol=0.1)


@dtypes
@pytest.mark.parametrize("friction", [0.3, 0.7])
def test_a_box_on_a_slope(friction, dtype):
    """The box slides with g (sin α − μ cos α) or stays; its corners together bear m g cos α."""
    case = FORMS["block_incline"]
    system, state = box(np.pi / 6, friction, dtype)
    states, reactions = run(system, state, H, 400)
    tight = 1e-9 if dtype == jnp.float64 else 2e-4
    want = 0.4 * case["acceleration"] if friction < np.tan(np.pi / 6) else 0.0
    np.testing.assert_allclose(states.v[-1, 0], want, atol=tight)
    np.testing.assert_allclose(states.v[-1, 1:], 0.0, atol=10 * tight)
    np.testing.assert_allclose(states.q[-1, 2], 0.05, atol=tight)
    bearing = sum(reactions[f"{k}"][-1, 0] for k in range(4))
    np.testing.assert_allclose(bearing / 2.0, case["normal_over_m"], rtol=10 * tight)
    assert np.all(states.status == 0)


@pytest.mark.parametrize("slope", [0.95, 1.05])
def test_a_box_topples_beyond_its_corner(slope):
    """A tall box with high friction stays while tan α < width/height."""
    system, state = box(np.arctan(slope * 0.5), 2.0, size=(0.1, 0.1, 0.2))
    states, _ = run(system, state, 2e-3, 400)
    tilt = np.abs(np.asarray(states.q[-1, 5]))
    assert tilt > 0.05 if slope > 1 else tilt < 1e-6


def test_what_is_missed_over_random_states_of_a_box():
    """Contact laws and the friction cone hold for 2,000 boxes thrown into the floor."""
    system, state = box(0.4, 0.5)
    method = jc.Method()

    def thrown(key):
        place, speed = (jax.random.normal(k, (6,)) for k in jax.random.split(key))
        q = system.retract(state.q, 3e-3 * place)
        new, info = jc.step(system, method, dataclasses.replace(state, q=q, v=speed), None, 2e-3)
        every = jnp.stack([info.reactions[f"{k}"] for k in range(4)])
        return every, info.reactions.residual, jnp.max(jnp.abs(speed)), new.status

    keys = jax.random.split(jax.random.PRNGKey(1), 2000)
    every, missed, speed, status = map(np.asarray, jax.jit(jax.vmap(thrown))(keys))
    assert np.all(status == 0)
    normal, slip = every[..., 0], np.linalg.norm(every[..., 1:], axis=-1)
    assert np.mean(normal > 0) > 0.2
    assert np.all(normal >= 0)
    assert np.all(slip <= 0.5 * normal * (1 + 1e-9) + 1e-9)
    assert np.mean(missed / speed > 1e-8) < 1e-3


def test_no_impact_adds_energy():
    """Rods fall on a rough floor. Without the energy cap, one in eight impacts would add energy.

    Every other tip starts such that it reaches the floor at the end of the step: only its
    restitution acts in that step.
    """
    turn = np.pi / 6
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("rod", mass=1.0, inertia=1 / 12, position=(0.0, 0.5 * np.sin(turn)))
    tip = (0.5 * np.cos(turn), 0.0)
    floor = jc.PlaneContact("tip", jc.WORLD, "rod", center=tip, restitution=0.9, friction=1.0)
    scene.add(floor)
    system, state = scene.build()

    def gained(v, above):
        v = v * jnp.asarray([2.0, 2.0, 8.0])
        rate = v[1] + tip[0] * v[2]
        q = state.q.at[1].add(1e-4 * above * jnp.maximum(-rate, 0))
        start = dataclasses.replace(state, q=q, v=v)
        new, info = jc.step(system, jc.Method(), start, None, 1e-4)
        energies = [jc.energy(system, s).kinetic for s in (new, start)]
        return energies[0] - energies[1], energies[1], info.reactions.kept

    speeds = jax.random.normal(jax.random.PRNGKey(0), (2000, 3))
    above = jnp.arange(2000.0) % 2
    gain, energy, kept = map(np.asarray, jax.jit(jax.vmap(gained))(speeds, above))
    assert np.max(gain / energy) < 1e-12
    assert 0.05 < np.mean(kept < 1) < 0.3


@dtypes
def test_a_column_with_a_heavy_block_stays_up(dtype):
    """Ten guided blocks, the topmost a thousand times heavier."""
    scene = jc.Scene(dim=2, dtype=dtype)
    for i in range(10):
        mass = 1000.0 if i == 9 else 1.0
        scene.add_body(f"{i}", mass=mass, inertia=mass, position=(0.0, 0.05 + 0.1 * i))
        scene.add(jc.Prismatic(f"guide {i}", jc.WORLD, f"{i}", axis=(0.0, 1.0)))
        below = jc.PlaneContact("floor", jc.WORLD, "0", center=(0.0, 0.0))
        touch = {"radius_a": 0.05, "radius_b": 0.05, "friction": 0.5}
        scene.add(
            below
            if i == 0
            else jc.contacts.CapsuleContact(f"{i - 1}:{i}", f"{i - 1}", f"{i}", **touch)
        )
    system, state = scene.build()
    states, _ = run(system, state, 5e-3, 400, every=400)
    tight = 1e-12 if dtype == jnp.float64 else 2e-6
    np.testing.assert_allclose(states.q[-1], state.q, atol=tight)


@pytest.mark.parametrize("integrator", [jc.SemiImplicitEuler(), jc.RK4()], ids=["SIE", "RK4"])
def test_a_rope_catches_a_weight(integrator):
    scene = jc.Scene(dim=3)
    scene.add_particle("weight", mass=1.0, position=(0.3, 0.0, -0.5))
    scene.add(jc.contacts.Rope("rope", jc.WORLD, "weight", length=1.0, point_a=(0.0, 0.0, 0.0)))
    system, state = scene.build()
    states, reactions = run(system, state, H, 1500, jc.Method(integrator=integrator))
    length = np.linalg.norm(np.asarray(states.q), axis=1)
    slack = np.asarray(reactions["rope"])[:, 0] < 1e-9
    assert slack[:200].all()
    assert not slack[400:450].any()
    assert length.max() < 1.0 + (1e-4 if isinstance(integrator, jc.SemiImplicitEuler) else 1e-2)
    energy = jax.vmap(lambda s: jc.energy(system, s).total)(states)
    assert float(energy.max() - energy[0]) < 0.02


def test_gradients_through_a_bounce_contain_its_time():
    """y(T) = r + e (−v T − (y₀ − r)). Ignoring the time of impact gives ∂y/∂y₀ the wrong sign."""
    case = references.load("grad_contact_zhong")["task1"]
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("ball", mass=1.0, position=(0.0, 1.0))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=0.1, restitution=1.0))
    system, state = scene.build()

    def height(y, v):
        start = dataclasses.replace(state, q=state.q.at[1].set(y), v=state.v.at[1].set(v))
        return jc.rollout(system, jc.Method(), start, None, 1 / 480, 480)[0].q[1]

    value, slopes = jax.jit(jax.value_and_grad(height, (0, 1)))(1.0, -2.0)
    np.testing.assert_allclose(value, case["h"], rtol=1e-9)
    np.testing.assert_allclose(slopes, [case["dh_dy0"], case["dh_dvy0"]], rtol=1e-6)


def falling(dtype=None, restitution=0.7, ceiling=False):
    """A ball of radius 0.1 m in the plane, above a floor or below a ceiling."""
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81), dtype=dtype)
    scene.add_particle("ball", mass=1.0, position=(0.0, 0.5))
    side = {"point": (0.0, 1.1), "normal": (0.0, -1.0)} if ceiling else {}
    end = jc.PlaneContact("end", jc.WORLD, "ball", radius=0.1, restitution=restitution, **side)
    scene.add(end)
    return scene.build()


def height(world, z, e, g, v, h, steps, last=-1):
    """Returns the height of the ball of `falling` after steps of h, started at height z with v.

    `last` is the index of the step after which the height is read.
    """
    system, state = world
    own = {"end": {"restitution": e}, "gravity": jnp.stack([0 * g, -g])}
    start = dataclasses.replace(state, q=state.q.at[1].set(z), v=state.v.at[1].set(v))
    h = jnp.asarray(h, state.q.dtype)
    path = jc.rollout(system.with_params(own), jc.Method(), start, None, h, steps)[1]
    return path.q[last, 1]


slopes = jax.jit(jax.grad(height, (1, 2, 3, 4)), static_argnames="steps")
"""Derivatives of `height` by place, restitution, gravity and velocity."""


def bounced(z, e, g, v, end, duration):
    """Returns y after one bounce at y = `end`, reached with speed √(v² + 2 g (z − end))."""
    there = jnp.sqrt(v * v + 2 * g * (z - end))
    up = jnp.where(end > z, 1, -1)
    left = duration - (v - up * there) / g
    return end - up * e * there * left - g * left * left / 2


STEP, STEPS = 4e-3, 120


@jax.jit
def values_and_slopes(world, speed, z, e, g):
    """Returns heights from many starts z, with derivatives by z, restitution and gravity."""

    def found(z, e, g):
        return height(world, z, e, g, speed + STEP * g / 2, STEP, STEPS)

    return jax.vmap(jax.value_and_grad(found, (0, 1, 2)), in_axes=(0, None, None))(z, e, g)


@dtypes
@pytest.mark.parametrize(("ceiling", "speed"), [(False, 0.0), (True, 5.0)])
def test_what_falls_and_bounces_does_so_exactly(dtype, ceiling, speed):
    """Heights and derivatives are exact if v₀ is the velocity half a step before z."""
    world = falling(dtype, ceiling=ceiling)
    end = 1.0 if ceiling else 0.1

    def want(z, e, g):
        return bounced(z, e, g, speed, end, STEP * STEPS)

    z = np.linspace(0.39, 0.41, 41)
    numbers, axes = (0.7, 9.81), {"in_axes": (0, None, None)}
    reference = jax.vmap(jax.value_and_grad(want, (0, 1, 2)), **axes)(z, *numbers)
    value, slopes = values_and_slopes(world, *(jnp.asarray(x, dtype) for x in (speed, z, *numbers)))
    tight = 1e-11 if dtype == jnp.float64 else 1e-4
    for a, b in zip((value, *slopes), (reference[0], *reference[1]), strict=True):
        np.testing.assert_allclose(a, b, atol=tight)


@dtypes
@pytest.mark.parametrize("ceiling", [False, True])
def test_what_hardly_arrives_has_finite_derivatives(dtype, ceiling):
    """Gravity turns the ball before it arrives, or the speed is so small that v² underflows."""
    h = 2.0**-10
    world = falling(dtype, ceiling=ceiling)
    toward, end = (1.0, 1.0) if ceiling else (-1.0, 0.1)
    speeds = (0.0, 1e-160, 1e-25, 1e-20, 1e-9, h * 4, h * 8)
    for gap, speed, g in itertools.product((0.0, 1e-30, 1e-6), speeds, (0.0, 8.0)):
        numbers = (end - toward * gap, 0.5, g, toward * speed)
        found = slopes(world, *(jnp.asarray(x, dtype) for x in (*numbers, h)), steps=1)
        assert np.all(np.isfinite(found)), (gap, speed, g, found)


def test_the_gradient_by_place_through_a_bounce_halves_its_error_with_the_step():
    """The derivative is ∂y/∂z = −e + (1 + e) g d/v from rest, d the time after the bounce.

    A step reads the initial v as that of half a step before z, hence the error of first order.
    """
    world = falling()
    z = np.linspace(0.49, 0.51, 41)
    numbers, axes = (0.7, 9.81), {"in_axes": (0, None, None)}
    want = jax.vmap(jax.grad(lambda z, e, g: bounced(z, e, g, 0.0, 0.1, 0.6)), **axes)(z, *numbers)

    @jax.jit
    def found(h, last):
        slope = jax.grad(lambda z, e, g: height(world, z, e, g, 0.0, h, 600, last))
        return jax.vmap(slope, **axes)(z, *numbers)

    steps = (4e-3, 2e-3, 1e-3)
    errors = [np.abs(found(h, round(0.6 / h) - 1) - want).max() for h in steps]
    assert errors[0] < 0.013
    np.testing.assert_allclose(np.divide(errors[1:], errors[:-1]), 0.5, atol=0.01)


def test_events_have_the_gradient_by_place_through_a_bounce():
    """With events the derivative is exact, also for a start at rest."""
    system, state = falling()
    method, h, z, g, e = (
        jc.Method(integrator=jc.RK4(), events=jc.integrators.Events()),
        2e-2,
        0.503,
        9.81,
        0.7,
    )

    def height(z):
        start = jc.init(system, method, state.q.at[1].set(z), state.v)
        return jc.rollout(system, method, start, None, h, round(0.6 / h))[0].q[1]

    v = np.sqrt(2 * g * (z - 0.1))
    truth = -e + (1 + e) * g * (0.6 - v / g) / v
    np.testing.assert_allclose(jax.jit(jax.grad(height))(z), truth, rtol=1e-6)


@dtypes
@pytest.mark.parametrize("restitution", [0.3, 0.7])
def test_what_has_ceased_to_bounce_stays(dtype, restitution):
    system, state = falling(dtype, restitution)
    h = jnp.asarray(2e-3, dtype)
    states, _ = run(system, state, h, 2000)
    y, v = np.asarray(states.q[-1000:, 1]), np.asarray(states.v[-1000:, 1])
    rounding = float(jnp.finfo(dtype).eps)
    assert np.ptp(y) <= rounding
    assert abs(y[-1] - 0.1) <= rounding
    assert np.abs(v).max() < 1e-3 * 9.81 * float(h)
    numbers = [jnp.asarray(x, dtype) for x in (0.5, restitution, 9.81, 0.0)]
    found = slopes((system, state), *numbers, h, steps=2000)
    np.testing.assert_allclose(found[:3], 0, atol=1e-6)


def test_a_ball_without_loss_goes_on_bouncing():
    """The velocity v belongs half a step before y."""
    h, g = 1e-3, 9.81
    system, state = falling(restitution=1.0)
    states, _ = run(system, state, h, 10000)
    y, v = np.asarray(states.q[:, 1]), np.asarray(states.v[:, 1])
    energy = (v - h * g / 2) ** 2 / 2 + g * y
    assert int(((v[1:] > 0) & (v[:-1] < 0)).sum()) > 15
    np.testing.assert_allclose(energy, energy[0], rtol=1e-11)


def test_a_ball_on_a_spring_between_walls_gains_no_energy():
    """The spring force changes the velocity on the way to a wall and back."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("ball", mass=1.0, position=(0.03, 0.0))
    for name, side in (("left", 1.0), ("right", -1.0)):
        wall = {"point": (-0.1 * side, 0.0), "normal": (side, 0.0), "restitution": 1.0}
        scene.add(jc.PlaneContact(name, jc.WORLD, "ball", **wall))
    scene.add(jc.Spring("spring", jc.WORLD, "ball", stiffness=100.0, rest_length=0.0))
    system, state = scene.build()
    state = dataclasses.replace(state, v=state.v.at[0].set(2.0))
    states, _ = run(system, state, 1e-3, 10000)
    energy = np.asarray(jax.vmap(lambda s: jc.energy(system, s).total)(states))
    assert energy.max() < 1.05 * 2.045


@pytest.mark.parametrize("force", ["push", "spring"])
def test_a_ball_that_is_pressed_down_comes_to_rest(force):
    """No bounce locks to the phase of the steps, where it would regain the energy that it loses."""
    scene = jc.Scene(dim=2)
    scene.add_particle("ball", mass=1.0, position=(0.0, 0.5))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=0.1, restitution=0.9))
    spring = jc.Spring("spring", jc.WORLD, "ball", 50.0, rest_length=0.0, point_a=(0.0, 0.1))
    scene.add(jc.forces.Force("push", "ball", (0.0, -50.0)) if force == "push" else spring)
    system, state = scene.build()

    def last(z):
        start = dataclasses.replace(state, q=state.q.at[1].set(z))
        final, path = jc.rollout(system, jc.Method(), start, None, 2e-3, 10000, every=10)
        return jnp.max(path.q[-200:, 1])

    heights = np.asarray(jax.jit(jax.vmap(last))(np.linspace(0.3, 0.7, 32)))
    np.testing.assert_allclose(heights, 0.1, atol=1e-9)


@pytest.mark.parametrize("push", [1000.0, -1000.0])
@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_a_ball_bounces_off_a_plate_that_is_pressed_to_a_floor_or_a_ceiling(push, speed):
    """The force on the plate is balanced by its support and does not change the bounce.

    A floor takes the impulse. A ceiling does not: there the plate recoils, as masses 1 and 0.1 do.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("plate", mass=1.0, inertia=1.0, position=(0.0, 0.0))
    scene.add_particle("ball", mass=0.1, position=(0.0, 0.2))
    scene.add(jc.Prismatic("guide", jc.WORLD, "plate", axis=(0.0, 1.0)))
    scene.add(jc.PlaneContact("end", jc.WORLD, "plate", normal=(0.0, np.sign(push))))
    scene.add(jc.forces.Force("push", "plate", (0.0, -push)))
    touch = {"radius_a": 0.05, "radius_b": 0.05, "restitution": 1.0}
    scene.add(jc.contacts.CapsuleContact("touch", "plate", "ball", **touch))
    system, state = scene.build()
    state = dataclasses.replace(state, v=jnp.asarray([0.0, 0.0, 0.0, 0.0, -speed]))
    states, _ = run(system, state, 1e-3, 400)
    leaves = speed if push > 0 else speed * (1 - 0.1) / (1 + 0.1)
    assert float(states.v[-1, -1]) == pytest.approx(leaves, rel=1e-9)


@pytest.mark.parametrize("restitution", [0.0, 0.9])
def test_what_a_floor_bears_does_not_fall_when_it_bounces_off_a_wall(restitution):
    """A ball slides into a wall that leans over the floor by 45°.

    The ball leaves straight up and falls from then on. The velocity v belongs half a step before q.
    """
    scene = jc.Scene(dim=2)
    scene.add_particle("ball", mass=1.0, position=(0.0, 0.0))
    floor = {} if restitution == 0 else {"restitution": restitution}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", **floor))
    wall = {"point": (0.1003, 0.0), "normal": (-(0.5**0.5), 0.5**0.5), "restitution": 1.0}
    scene.add(jc.PlaneContact("wall", jc.WORLD, "ball", **wall))
    system, state = scene.build()
    state = dataclasses.replace(state, v=jnp.asarray([1.0, 0.0]))
    states, _ = run(system, state, H, 200)
    away = np.asarray(states.v) @ np.asarray(wall["normal"])
    fallen = 9.81 * (H / 2 - 0.1003 % H)
    assert away[np.argmax(away > 0)] == pytest.approx(0.5**0.5 * (1 - fallen), rel=1e-9)


def test_what_friction_bears_does_not_fall_when_it_bounces():
    """A block slides down a rail at constant speed, because friction is as large as its weight.

    On its way up, gravity and friction both slow it. The velocity v belongs half a step before q.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81))
    scene.add_body("block", mass=1.0, inertia=1.0, position=(0.0, 0.1003))
    scene.add(jc.Prismatic("rail", jc.WORLD, "block", axis=(0.0, 1.0)))
    scene.add(jc.contacts.JointFriction("friction", "rail", 9.81))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "block", restitution=1.0))
    system, state = scene.build()
    state = dataclasses.replace(state, v=jnp.asarray([0.0, -1.0, 0.0]))
    states, _ = run(system, state, H, 150)
    slowed = 2 * 9.81 * (H / 2 - 0.1003 % H)
    assert float(states.v[:, 1].max()) == pytest.approx(1.0 - slowed, rel=1e-9)


def test_gradients_through_a_collision():
    case = references.load("grad_two_balls_nimble")
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("a", mass=1.0, position=(0.0, 0.0))
    scene.add_particle("b", mass=1.0, position=(0.52, 0.0))
    touch = {"radius_a": 0.1, "radius_b": 0.1, "restitution": 1.0}
    scene.add(jc.contacts.CapsuleContact("touch", "a", "b", **touch))
    system, state = scene.build()

    def place(x):
        still = jnp.zeros(2)
        q, v = jnp.concatenate([x[:2], still]), jnp.concatenate([x[2:], still])
        start = dataclasses.replace(state, q=q, v=v)
        return jc.rollout(system, jc.Method(), start, None, 1 / 240, 240)[0].q[1]

    value, slope = jax.jit(jax.value_and_grad(place))(jnp.asarray([0.0, 0.52, 1.0, 0.0]))
    np.testing.assert_allclose(value, 1.2, rtol=1e-9)
    np.testing.assert_allclose(slope, case["exact_gradient_d_x2T_d_x1_x2_v0_u0"], atol=1e-6)


def test_gradients_of_where_a_block_stops():
    """The stopping distance is d = v²/(2 μ g), to first order in h."""
    case = FORMS["sliding_stop_gradient"]
    scene = jc.Scene(dim=2)
    scene.add_particle("block", mass=1.0, position=(0.0, 0.0))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "block", friction=0.4))
    system, state = scene.build()

    @jax.jit
    @functools.partial(jax.value_and_grad, argnums=(0, 1))
    def both(v, friction, h, last):
        changed = system.with_params({"floor": {"friction": friction}})
        start = dataclasses.replace(state, v=state.v.at[0].set(v))
        return jc.rollout(changed, jc.Method(), start, None, h, 800)[1].q[last, 0]

    want = np.array([case["stop_distance"], case["d_dv0"], case["d_dmu"]])
    for steps in (400, 800):
        value, slopes = both(3.0, 0.4, 1 / steps, steps - 1)
        relative = np.abs(np.array([value, *slopes]) / want - 1)
        assert relative.max() < 4 / steps


@dtypes
def test_gradients_at_rest_are_finite(dtype):
    """A box lies still on a floor without friction, and on one with friction."""
    system, state = box(0.0, jnp.asarray(0.5, dtype), dtype)

    @jax.jit
    @jax.grad
    def slope(x):
        changed = system.with_params({"0": {"friction": x[0]}, "box": {"mass": x[1]}})
        start = dataclasses.replace(state, v=state.v + x[2])
        final, _ = jc.rollout(changed, jc.Method(), start, None, jnp.asarray(H, dtype), 3)
        return jnp.sum(final.q)

    for friction in (0.0, 0.5):
        assert np.isfinite(slope(jnp.asarray([friction, 2.0, 0.0], dtype))).all()


@dtypes
def test_what_has_left_the_floor_does_not_stick_in_a_derivative(dtype):
    """A rough ball without slip, in the air or leaving: ∂v⁺/∂v is the identity."""
    scene = jc.Scene(dim=3, dtype=dtype)
    scene.add_body("ball", inertia=jc.inertia.sphere(1.0, 0.1), position=(0, 0, 0.1))
    resists = {"friction": 0.5, "rolling": 0.01, "spinning": 0.01}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=0.1, **resists))
    system, state = scene.build()
    h = jnp.asarray(H, dtype)

    def speed(v, height):
        start = dataclasses.replace(state, q=state.q.at[2].add(height), v=v)
        return jc.step(system, jc.Method(), start, None, h)[0].v

    heights, rises = jnp.asarray([1.0, 0.0, 0.0], dtype), jnp.asarray([0.0, 0.1, -0.1], dtype)
    speeds = jnp.zeros((3, 6), dtype).at[:, 2].set(rises)
    slopes = jax.jit(jax.vmap(jax.jacfwd(speed)))(speeds, heights)
    np.testing.assert_allclose(slopes[:2], [np.eye(6)] * 2, atol=1e-6)
    np.testing.assert_allclose(slopes[2], 0 * np.eye(6), atol=1e-3)


@pytest.mark.parametrize(
    "solver", [jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel()], ids=["point", "sweeps"]
)
def test_there_is_no_friction_without_a_normal_force(solver):
    """A slider on a rail beside a floor: the rail carries it, so the floor exerts no friction."""
    scene = jc.Scene(dim=2)
    scene.add_body("slide", mass=2.0, inertia=1.0, velocity=(1.0, 0.0))
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, 0.0)))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "slide", friction=0.5))
    states, reactions = run(*scene.build(), H, 20, jc.Method(contact_solver=solver))
    np.testing.assert_allclose(reactions["floor"], 0.0, atol=1e-9)
    np.testing.assert_allclose(states.v[-1, 0], 1.0, rtol=1e-9)


def test_two_discs_that_touch_keep_their_momenta():
    """Forces act at one point, equal and opposite, before and after the discs overlap."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    for name, x, v, spin in (("a", 0.0, 1.0, 3.0), ("b", 0.235, -1.0, 2.0)):
        scene.add_body(
            name, mass=1.0, inertia=0.02, position=(x, 0.02 * x), velocity=(v, 0.1),
            angular_velocity=spin,
        )  # fmt: skip
    touch = {"radius_a": 0.1, "radius_b": 0.1, "friction": 0.8}
    scene.add(jc.contacts.CapsuleContact("touch", "a", "b", **touch))
    system, state = scene.build()
    states, _ = run(system, state, 1e-2, 6)
    linear = jax.vmap(lambda s: jc.momentum(system, s))(states)
    angular = jax.vmap(lambda s: jc.angular_momentum(system, s))(states)
    assert abs(float(states.v[-1, 0] - state.v[0])) > 0.1
    np.testing.assert_allclose(linear, linear[:1] + 0 * linear, atol=1e-12)
    np.testing.assert_allclose(angular, angular[0] + 0 * angular, atol=1e-9)


def test_deep_overlap_ends_slowly():
    """A ball that starts inside the floor comes out at the recovery speed."""
    system, state = ball((0.0, 0.0, 0.0), height=-0.08, recovery=0.05)
    states, _ = run(system, state, H, 2000)
    assert np.all(states.status == 0)
    assert float(jnp.abs(states.v).max()) < 0.05 + 1e-9
    assert float(states.q[-1, 2]) > 0.1 - 1e-4


@dtypes
@pytest.mark.parametrize("dim", [2, 3])
def test_two_balls_at_one_place_separate(dim, dtype):
    """They part along the x axis at the recovery speed, by values and derivatives."""
    scene = jc.Scene(dim=dim, gravity=np.zeros(dim), dtype=dtype)
    for name in "ab":
        scene.add_particle(name, mass=1.0, position=np.ones(dim))
    touch = {"radius_a": 0.01, "radius_b": 0.01, "recovery": 0.5}
    scene.add(jc.contacts.CapsuleContact("touch", "a", "b", **touch))
    system, state = scene.build()
    method = jc.Method(contact_solver=jc.solvers.GaussSeidel(2, warm=False))

    def apart(recovery, q):
        changed = system.with_params({"touch": {"recovery": recovery}})
        last, _ = jc.rollout(changed, method, state.replace(q=q), None, H, 100)
        a, b = (jc.position(system, last, name) for name in "ab")
        return b - a, (b - a, last.status)

    given = jnp.asarray(0.5, dtype), state.q
    slopes, (off, status) = jax.jit(jax.jacfwd(apart, argnums=(0, 1), has_aux=True))(*given)
    assert status == jc.Status.OK
    np.testing.assert_allclose(off, 0.1 * 0.5 * np.eye(dim)[0], atol=1e-5)
    np.testing.assert_allclose(slopes[0], 0.1 * np.eye(dim)[0], rtol=1e-3)
    assert jnp.all(jnp.isfinite(slopes[1]))


@pytest.mark.parametrize(
    ("a", "b", "longer"),
    [
        ((1.0, 0.0, 0.0), (0.3, 2.0, 0.0), None),
        ((1.0, 1.0, 0.0), (0.5, 0.5, 0.0), None),
        ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0), None),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), None),
        ((1.0, 2.0), (0.0, 1.0), 0),
        ((0.0, 1.0), (1.0, 2.0), 1),
        ((0.0, 0.0), (0.0, 0.0), None),
    ],
    ids=["crossing", "parallel", "one ball", "balls", "plane", "plane, b longer", "discs"],
)
@dtypes
def test_where_axes_meet_the_normal_is_across_them(a, b, longer, dtype):
    """In space both axes are normal to it, in the plane the longer one; it is x for balls."""

    def across(axes):
        skew = jnp.linalg.norm(jnp.cross(*axes)) > 0
        return across_axes(*(Vector(*x[:, None]) for x in axes), skew[None]).stack()[:, 0]

    axes = jnp.asarray([a, b], dtype)
    n = across(axes)
    np.testing.assert_allclose(jnp.linalg.norm(n), 1.0, rtol=1e-6)
    np.testing.assert_allclose((axes @ n)[slice(None) if longer is None else longer], 0, atol=1e-6)
    if not any(a + b):
        np.testing.assert_array_equal(n, np.eye(len(a))[0])
    assert jnp.all(jnp.isfinite(jax.jacrev(across)(axes)))


@pytest.mark.parametrize("dim", [2, 3])
def test_capsules_touch_where_they_are_nearest(dim):
    """The gap equals the smallest distance over a grid of point pairs."""
    rng = np.random.default_rng(0)
    for _ in range(4):
        ends = rng.normal(size=(2, 2, dim))
        ends[1] += 2.0
        scene = jc.Scene(dim=dim)
        for name, own in zip("ab", ends, strict=True):
            inertia = 1.0 if dim == 2 else (1.0, 1.0, 1.0)
            scene.add_body(name, mass=1.0, inertia=inertia, position=own.mean(axis=0))
        scene.add(
            jc.contacts.CapsuleContact(
                "touch", "a", "b", radius_a=0.1, radius_b=0.2, segment_a=ends[0],
                segment_b=ends[1],
            )
        )  # fmt: skip
        system, state = scene.build()
        gap = jc.step(system, jc.Method(), state, None, 1e-6)[1].reactions.gap[0]
        s = np.linspace(0, 1, 801)[:, None]
        a, b = (e[0] + s * (e[1] - e[0]) for e in ends)
        apart = np.linalg.norm(a[:, None] - b[None], axis=-1).min()
        np.testing.assert_allclose(gap, apart - 0.3, atol=1e-3)


@pytest.mark.parametrize(
    ("element", "match"),
    [
        (jc.PlaneContact("c", jc.WORLD, "ball", friction=-0.1), "friction"),
        (jc.PlaneContact("c", jc.WORLD, "ball", radius=-0.1), "radius"),
        (jc.PlaneContact("c", jc.WORLD, "ball", restitution=2.0), "restitution must lie in 0 to 1"),
        (jc.PlaneContact("c", jc.WORLD, "ball", normal=(0, 0, 0)), "normal"),
        (jc.PlaneContact("c", jc.WORLD, "bal"), "body 'bal' is unknown"),
        (jc.contacts.CapsuleContact("c", "ball", "ball"), "to itself"),
        (jc.contacts.CapsuleContact("c", jc.WORLD, "ball"), "give radius_a, radius_b or both"),
        (jc.contacts.Rope("r", jc.WORLD, "ball", length=-1.0), "Rope 'r': length must be positive"),
    ],
)
def test_bad_numbers_are_refused(element, match):
    scene = jc.Scene(dim=3)
    scene.add_body("ball", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0, 0, 1))
    scene.add(element)
    with pytest.raises(ValueError, match=match):
        scene.build()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("angle", "radius"), [(1.46, 0.01), (0.0035, 0.01), (0.0035, 0.001)])
def test_capsules_whose_axes_cross_part_along_the_normal_of_both(angle, radius, dim, dtype):
    """The computed closest points differ by rounding, whose direction must not be the normal.

    In the plane the normal is that of the longer axis, the second.
    """
    first = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0]])
    turned = np.arctan2(0.1, 1.0) + angle
    along_second = np.array([np.cos(turned), np.sin(turned), 0.0])
    second = np.array([0.33, 0.033, 0.0]) + np.outer([-0.37, 0.77], along_second)
    scene = jc.Scene(dim=dim, dtype=dtype, gravity=np.zeros(dim))
    inertia = 0.1 if dim == 2 else (0.1, 0.1, 0.1)
    scene.add_body("body", mass=1.0, inertia=inertia, position=second.mean(axis=0)[:dim])
    ends = {"segment_a": first[:, :dim], "segment_b": second[:, :dim]}
    touch = jc.contacts.CapsuleContact(
        "touch", jc.WORLD, "body", radius_a=radius, radius_b=radius, recovery=0.05, **ends
    )
    scene.add(touch)
    system, state = scene.build()
    end, _ = jc.step(system, jc.Method(), state, None, 1e-2)
    along = np.asarray(end.v[:dim] / np.linalg.norm(end.v[:dim]))
    axis = np.diff(second[:, :dim], axis=0)[0] / np.linalg.norm(np.diff(second, axis=0))
    assert end.status == jc.Status.OK
    assert np.linalg.norm(end.v[:dim]) > radius
    if dim == 3:
        np.testing.assert_allclose(abs(along), [0.0, 0.0, 1.0], atol=1e-5)
    else:
        assert abs(along @ axis) < 1e-5


def test_small_balls_far_from_the_origin_do_not_touch_before_they_meet():
    """In float32 coordinates of 20 m are rounded to 2 µm, a fiftieth of a radius."""
    scene = jc.Scene(dim=3, dtype="float32", gravity=np.zeros(3))
    for name, z in (("a", 20.0), ("b", 20.0004)):
        scene.add_body(name, mass=1.0, inertia=(1e-8,) * 3, position=(20.0, 20.0, z))
    scene.add(jc.contacts.CapsuleContact("touch", "a", "b", radius_a=1e-4, radius_b=1e-4))
    system, state = scene.build()
    end, info = jc.step(system, jc.Method(), state, None, 1e-3)
    np.testing.assert_array_equal(end.v, 0.0)
    np.testing.assert_allclose(info.reactions.gap[0], 2e-4, atol=1e-5)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("dim", [2, 3])
def test_nearly_parallel_capsules_apart_have_their_distance_as_gap(dim, dtype):
    """Over small angles, rounding decides whether axes count as parallel."""
    first = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])[:, :dim]
    scene = jc.Scene(dim=dim, dtype=dtype, gravity=np.zeros(dim))
    inertia = 0.1 if dim == 2 else (0.1, 0.1, 0.1)
    scene.add_body("body", mass=1.0, inertia=inertia)
    ends = {"segment_a": first, "segment_b": first}
    scene.add(
        jc.contacts.CapsuleContact("touch", jc.WORLD, "body", radius_a=0.01, radius_b=0.01, **ends)
    )
    system, state = scene.build()

    def gap(angle):
        half = jnp.array([jnp.cos(angle / 2), 0.0, 0.0, jnp.sin(angle / 2)], dtype)
        turn = angle[None] if dim == 2 else half
        place = jnp.array([0.0, -0.05, 0.0], dtype)[:dim]
        at = dataclasses.replace(state, q=jnp.concatenate([place, turn]))
        return jc.step(system, jc.Method(), at, None, 1e-6)[1].reactions.gap[0]

    angles = np.concatenate([np.linspace(1e-3, 2e-3, 200), 10.0 ** np.linspace(-9, -3, 50)])
    gaps = jax.jit(jax.vmap(gap))(jnp.asarray(angles, dtype))
    np.testing.assert_allclose(gaps, 0.03 - np.sin(angles), atol=1.1e-3)
