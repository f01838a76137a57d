"""Impacts in plain steps: values and derivatives beside closed forms, for explicit integrators."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxcon as jc
from jaxcon.analysis import encounters
from jaxcon.analysis.setup import Setup
from jaxcon.analysis.traps import impact, listed
from jaxcon.core import notices

G, R, H = 9.81, 0.1, 1e-3
ONE_PERCENT, TWO_PERCENT = 1e-2, 2e-2
"""Tolerances of derivatives with plain steps of 1 ms, and of differences over 5 mm."""
INTEGRATORS = {
    "SIE": jc.SemiImplicitEuler(),
    "RK4": jc.RK4(),
    "Heun": jc.integrators.Heun(),
    "Euler": jc.integrators.ExplicitEuler(),
}


def landed(system, state, integrator, time, where, of):
    """Returns the function (change of the start, parameters) → values `of` the final state."""
    method = jc.Method(integrator)

    def run(x, params):
        changed = system.with_params(params) if params else system
        start = jc.init(changed, method, *where(state, x))
        final, _ = jc.rollout(
            changed, method, start, None, H, round(time / H), record=lambda s, i: None
        )
        return of(final)

    return run


def held_to(run, x, params, want, mode="forward", tight=ONE_PERCENT):
    """Compares derivatives of a rollout with exact ones and with differences over 5 mm.

    The start takes 7 positions, so that the impact falls at 7 phases of a step.

    Args:
        run: (x, params) → values, (n,).
        x: the number to differentiate by.
        params: parameters by case (leading axis), or None.
        want: the exact (x, case) → values; None to compare with differences alone.
        mode: "forward" or "reverse".
        tight: tolerance relative to the largest derivative.
    """
    cases = 1 if params is None else len(jax.tree.leaves(params)[0])
    phases = x + np.linspace(0, 1.5e-3, 7)
    dtype = jax.eval_shape(run, jnp.asarray(x), jax.tree.map(lambda p: p[0], params)).dtype

    def both(x, params):
        if mode == "forward":
            return jax.jvp(lambda x: run(x, params), (x,), (jnp.ones_like(x),))
        slope, value = jax.jacrev(lambda x: (run(x, params),) * 2, has_aux=True)(x)
        return value, slope

    every = jax.vmap(both, in_axes=(0, None))
    if params is not None:
        every = jax.vmap(every, in_axes=(None, 0))
    points = np.concatenate([phases, phases - 2.5e-3, phases + 2.5e-3])
    values, slopes = jax.jit(every)(jnp.asarray(points, dtype), params)
    values, slopes = (np.asarray(x, float).reshape(cases, 3, 7, -1) for x in (values, slopes))
    for i in range(cases):
        for j, y in enumerate(phases):
            apart = (values[i, 2, j] - values[i, 1, j]) / 5e-3
            size = np.abs(apart).max()
            if want is not None:
                exact = (want(y + 1e-6, i) - want(y - 1e-6, i)) / 2e-6
                size = np.abs(exact).max()
                np.testing.assert_allclose(slopes[i, 0, j], exact, atol=tight * size, rtol=0)
            np.testing.assert_allclose(apart, slopes[i, 0, j], atol=TWO_PERCENT * size, rtol=0)


def disc(dtype=None, friction=0.5, restitution=None):
    """A disc of 1.3 kg and 0.1 m over a floor, moving sideways."""
    scene = jc.Scene(dim=2, dtype=dtype)
    moving = {"position": (0.0, 1.1), "velocity": (1.0, 0.0)}
    scene.add_body("disc", mass=1.3, inertia=1.3 * R * R / 2, **moving)
    own = {} if restitution is None else {"restitution": restitution}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "disc", radius=R, friction=friction, **own))
    return scene.build()


def by_height(state, z):
    return state.q.at[1].set(z), state.v


def bounced(z, friction, e, time):
    """Returns the exact (x, z) of the disc after one bounce or landing.

    With μ (1 + e) v large enough the slip ends in the impact, and the speed falls by a third.
    """
    v = np.sqrt(2 * G * (z - R))
    rest = time - v / G
    along = max(1 - friction * (1 + e) * v, 2 / 3)
    slides = friction * G * rest * rest / 2 if e == 0 and along > 2 / 3 else 0
    up = e * v * rest - G * rest * rest / 2 if e else 0
    return np.array([v / G + along * rest - slides, R + up])


DISC = {"friction": np.array([0.5, 0.02, 0.5, 0.02]), "restitution": np.array([0.6, 0.6, 0.0, 0.0])}


@pytest.mark.parametrize(
    ("name", "mode", "dtype"),
    [
        ("RK4", "reverse", jnp.float64),
        ("Heun", "forward", jnp.float64),
        ("Euler", "forward", jnp.float64),
        ("SIE", "reverse", jnp.float32),
    ],
)
def test_a_disc_bounces_or_lands_sticking_and_sliding(name, mode, dtype):
    """A case that bounces and sticks has d(x, z)/dz = (0.0753, 0.9892) at 0.9 s."""
    system, state = disc(dtype, restitution=0.6)
    run = landed(system, state, INTEGRATORS[name], 0.9, by_height, lambda s: s.q[:2])
    params = {"floor": {k: jnp.asarray(x, dtype) for k, x in DISC.items()}}

    def want(z, i):
        return bounced(z, DISC["friction"][i], DISC["restitution"][i], 0.9)

    exact = (want(1.1 + 1e-6, 0) - want(1.1 - 1e-6, 0)) / 2e-6
    np.testing.assert_allclose(exact, [0.0753, 0.9892], atol=1e-4)
    held_to(run, 1.1, params, want, mode)


@pytest.mark.parametrize("name", ["SIE", "RK4"])
def test_a_ball_bounces(name):
    """At 0.8 s the derivative of the height by the initial height is 0.7617."""
    scene = jc.Scene(dim=3)
    scene.add_body("ball", mass=1.0, inertia=(4e-3,) * 3, position=(0.0, 0.0, 1.0))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=R, restitution=0.8))
    system, state = scene.build()

    def where(state, z):
        return state.q.at[2].set(z), state.v

    def want(z, _):
        v = np.sqrt(2 * G * (z - R))
        rest = 0.8 - v / G
        return np.array([R + 0.8 * v * rest - G * rest * rest / 2])

    exact = (want(1.0 + 1e-6, 0) - want(1.0 - 1e-6, 0)) / 2e-6
    np.testing.assert_allclose(exact, 0.7617, atol=1e-4)
    held_to(
        landed(system, state, INTEGRATORS[name], 0.8, where, lambda s: s.q[2:3]), 1.0, None, want
    )


def test_a_disc_lands_without_restitution():
    """A landing of a contact without restitution is an impact, too."""
    system, state = disc()
    run = landed(system, state, jc.SemiImplicitEuler(), 0.9, by_height, lambda s: s.q[:1])
    params = {"floor": {"friction": jnp.asarray([0.5, 0.02])}}
    held_to(run, 1.1, params, lambda z, i: bounced(z, (0.5, 0.02)[i], 0.0, 0.9)[:1], "reverse")


def test_a_block_lands_and_slides_to_rest():
    """The block travels v t* + (v − μ g t*)²/2μg, with the time of the fall t* = √(2z/g)."""
    scene = jc.Scene(dim=2)
    scene.add_particle("block", mass=2.0, position=(0.0, 0.3), velocity=(4.0, 0.0))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "block", friction=0.45))
    system, state = scene.build()
    run = landed(system, state, jc.SemiImplicitEuler(), 1.2, by_height, lambda s: s.q[:1])

    def want(z, _):
        t = np.sqrt(2 * z / G)
        return np.array([4 * t + (4 - 0.45 * G * t) ** 2 / (2 * 0.45 * G)])

    held_to(run, 0.3, None, want, "reverse")


def test_a_block_slides_into_a_wall_and_back():
    """The friction of the table changes its direction at the time of the impact."""
    scene = jc.Scene(dim=2)
    scene.add_particle("block", mass=1.0, position=(0.0, 0.0), velocity=(3.0, 0.0))
    scene.add(jc.PlaneContact("table", jc.WORLD, "block", friction=0.3))
    wall = {"normal": (-1.0, 0.0), "point": (0.6, 0.0), "restitution": 0.5}
    scene.add(jc.PlaneContact("wall", jc.WORLD, "block", **wall))
    system, state = scene.build()

    def where(state, x):
        return state.q.at[0].set(x), state.v

    run = landed(system, state, jc.SemiImplicitEuler(), 0.5, where, lambda s: s.q[:1])

    def want(x, _):
        a = 0.3 * G
        v = np.sqrt(9 - 2 * a * (0.6 - x))
        rest = 0.5 - (3 - v) / a
        return np.array([0.6 - 0.5 * v * rest + a * rest * rest / 2])

    held_to(run, 0.0, None, want)


@pytest.mark.parametrize("name", ["SIE", "RK4"])
def test_a_hinged_rod_strikes_a_floor_with_its_end(name):
    """The impact passes through a joint, and the end moves on a circle; θ̇ changes to −e θ̇."""
    inertia, mass, arm = 0.06, 1.0, 0.4
    scene = jc.Scene(dim=2)
    moving = {"velocity": (0.0, -arm), "angular_velocity": -1.0}
    scene.add_body("rod", mass=mass, inertia=inertia, position=(arm, 0.5), **moving)
    scene.add(jc.Revolute("hinge", jc.WORLD, "rod", point=(0.0, 0.5)))
    end = {"center": (0.8, 0.5), "point": (0.0, 0.1), "friction": 0.4, "restitution": 0.6}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "rod", **end))
    system, state = scene.build()

    def where(state, x):
        return state.q, state.v * x

    run = landed(system, state, INTEGRATORS[name], 0.5, where, lambda s: s.q[2:3])

    def fall(_, y):
        return [y[1], -mass * G * arm * np.cos(y[0]) / (inertia + mass * arm * arm)]

    def strikes(_, y):
        return y[0] + np.arcsin(0.4 / 0.8)

    strikes.terminal, strikes.direction = True, -1
    exactly = {"rtol": 1e-11, "atol": 1e-12}

    def want(x, _):
        down = solve_ivp(fall, (0, 1), [0.0, -x], events=strikes, **exactly)
        θ, ω = down.y[:, -1]
        up = solve_ivp(fall, (down.t[-1], 0.5), [θ, -0.6 * ω], **exactly)
        return up.y[:1, -1]

    held_to(run, 1.0, None, want)


@pytest.mark.parametrize("e", [0.5, None])
def test_a_weight_on_a_rope_jerks(e):
    """A thrown weight falls until the rope is taut, and keeps its speed across the rope."""
    scene = jc.Scene(dim=2)
    scene.add_particle("weight", mass=2.0, position=(0.3, -0.5), velocity=(1.0, 0.0))
    own = {} if e is None else {"restitution": e}
    rope = {"length": 1.0, "point_a": (0.0, 0.0)} | own
    scene.add(jc.contacts.Rope("rope", jc.WORLD, "weight", **rope))
    system, state = scene.build()
    time = 0.35
    run = landed(system, state, jc.SemiImplicitEuler(), time, by_height, lambda s: s.q)

    def want(z, _):
        def off(t):
            return (0.3 + t) ** 2 + (z - G * t * t / 2) ** 2 - 1

        low, high = 0.0, 0.6
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if off(middle) < 0 else (low, middle)
        t = low
        p, v = np.array([0.3 + t, z - G * t * t / 2]), np.array([1.0, -G * t])
        n = p / np.linalg.norm(p)
        v = v - (1 + (e or 0)) * (v @ n) * n
        rest = time - t
        if e:
            return p + v * rest - np.array([0.0, G * rest * rest / 2])
        angle, rate = np.arctan2(p[0], -p[1]), v @ np.array([-p[1], p[0]])
        path = solve_ivp(
            lambda _, y: [y[1], -G * np.sin(y[0])], (0, rest), [angle, rate], rtol=1e-11, atol=1e-12
        )
        return np.array([np.sin(path.y[0, -1]), -np.cos(path.y[0, -1])])

    held_to(run, -0.5, None, want)


@pytest.mark.parametrize(
    ("name", "frictions", "e"),
    [("SIE", (0.05, 1.0), 0.7), ("RK4", (1.0,), 0.7), ("SIE", (0.05, 1.0), 0.0)],
)
def test_two_discs_strike_aslant(name, frictions, e):
    """Contacts that slide or stick along a tangent that rotates while the discs approach."""
    m, inertia, time = np.array([1.0, 0.7]), np.array([5e-3, 4e-3]), 0.8
    p0, v0 = np.array([[0.0, 0.0], [0.8, 0.08]]), np.array([[2.0, 0.0], [-0.5, 0.1]])
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    for k, body in enumerate("ab"):
        scene.add_body(body, mass=m[k], inertia=inertia[k], position=p0[k], velocity=v0[k])
    touch = {"radius_a": R, "radius_b": R, "friction": 1.0, "restitution": e}
    scene.add(jc.contacts.CapsuleContact("touch", "a", "b", **touch))
    system, state = scene.build()

    def where(state, x):
        moved = state.q.at[0].add(x)
        return moved, state.v

    run = landed(system, state, INTEGRATORS[name], time, where, lambda s: s.q)

    def want(x, i):
        p, v = p0 + np.array([[x, 0.0], [0.0, 0.0]]), v0
        d, u = p[1] - p[0], v[1] - v[0]
        a, b, c = u @ u, d @ u, d @ d - 4 * R * R
        t = (-b - np.sqrt(b * b - a * c)) / a
        p = p + v * t
        n = (p[1] - p[0]) / (2 * R)
        s = np.array([-n[1], n[0]])
        normal = -(1 + e) * (u @ n) / np.sum(1 / m)
        along = -(u @ s) / np.sum(1 / m + R * R / inertia)
        along = np.clip(along, -frictions[i] * normal, frictions[i] * normal)
        pull = normal * n + along * s
        v = v + np.array([-pull, pull]) / m[:, None]
        ω = -R * along / inertia
        end = p + v * (time - t)
        angles = ω * (time - t)
        return np.array([*end[:, 0], *end[:, 1], *angles])

    order = np.asarray(state.q)  # x of both, y of both, angles of both
    np.testing.assert_allclose(order, [0.0, 0.8, 0.0, 0.08, 0.0, 0.0])
    held_to(run, 0.0, {"touch": {"friction": jnp.asarray(frictions)}}, want)


def test_a_slide_with_a_spring_and_a_damper_strikes_a_stop():
    """The force of the damper jumps at the impact."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("slide", mass=1.0, inertia=1.0)
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, 0.0)))
    scene.add(jc.forces.JointSpring("spring", "rail", stiffness=4.0, damping=0.5))
    scene.add(jc.Limit("stop", "rail", lower=-0.2, restitution=0.5))
    system, state = scene.build()

    def where(state, x):
        return state.q.at[0].set(x), state.v

    run = landed(system, state, jc.SemiImplicitEuler(), 1.5, where, lambda s: s.q[:1])

    def swings(_, y):
        return [y[1], -4 * y[0] - 0.5 * y[1]]

    def strikes(_, y):
        return y[0] + 0.2

    strikes.terminal, strikes.direction = True, -1
    exactly = {"rtol": 1e-11, "atol": 1e-12}

    def want(x, _):
        there = solve_ivp(swings, (0, 2), [x, 0.0], events=strikes, **exactly)
        y, v = there.y[:, -1]
        return solve_ivp(swings, (there.t[-1], 1.5), [y, -0.5 * v], **exactly).y[:1, -1]

    held_to(run, 0.8, None, want)


SPIN = (9.0, 14.0, -20.0)
THROWN = (0.7, -0.3, 0.0)
MOMENTS = np.array([4e-3, 6e-3, 9e-3])
CORNER = np.array([0.05, 0.04, -0.05])
"""A body of 1.3 kg that spins by 26 rad/s, about no principal axis, and may hit with a corner."""


def turned(q):
    """Returns the rotation matrix of a quaternion."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def thrown(z, time, corner, sticks, e=0.6, mass=1.3):
    """Returns position and quaternion after one impact, by Newton's and Euler's equations.

    In a sticking impact the contact point loses its tangential velocity and (1 + e) times its
    normal velocity. Without friction the impulse is along the normal alone.
    """

    def arm(y):
        return turned(y[3:7]) @ CORNER if corner else np.array([0.0, 0.0, -R])

    def flies(_, y):
        (w, *u), ω = y[3:7], y[10:]
        turn = np.array([-np.dot(u, ω), *(w * ω + np.cross(u, ω))]) / 2
        return np.concatenate([y[7:10], turn, [0, 0, -G], np.cross(MOMENTS * ω, ω) / MOMENTS])

    def gap(_, y):
        return y[2] + arm(y)[2]

    gap.terminal, gap.direction = True, -1
    exactly = {"rtol": 1e-11, "atol": 1e-12}
    start = np.concatenate([[0, 0, z, 1, 0, 0, 0], THROWN, SPIN])
    down = solve_ivp(flies, (0, 2), start, events=gap, **exactly)
    y = down.y[:, -1]
    r, axes = arm(y), turned(y[3:7])
    across = np.cross(np.eye(3), r)  # v + ω × r is v + across.T @ ω
    softness = np.eye(3) / mass + across @ axes @ np.diag(1 / MOMENTS) @ axes.T @ across.T
    u = y[7:10] + np.cross(axes @ y[10:], r)
    want = -np.array([u[0], u[1], (1 + e) * u[2]])
    impulse = np.linalg.solve(softness, want) if sticks else np.zeros(3)
    if not sticks:
        impulse[2] = want[2] / softness[2, 2]
    Δv = np.concatenate([impulse / mass, axes.T @ np.cross(r, impulse) / MOMENTS])
    y = y + np.concatenate([np.zeros(7), Δv])
    return solve_ivp(flies, (down.t[-1], time), y, **exactly).y[:7, -1]


@pytest.mark.parametrize("name", ["SIE", "RK4"])
def test_a_body_that_spins_fast_in_space_strikes_a_floor(name):
    """Impacts of a corner or a rim, sticking or frictionless, with unequal moments of inertia."""
    z, time = 0.6, 0.44
    scene = jc.Scene()
    moving = {"velocity": THROWN, "angular_velocity": SPIN, "position": (0.0, 0.0, z)}
    scene.add_body("body", mass=1.3, inertia=tuple(MOMENTS), **moving)
    scene.add(jc.PlaneContact("floor", jc.WORLD, "body", radius=R, friction=2.0, restitution=0.6))
    system, state = scene.build()

    def where(state, z):
        return state.q.at[2].set(z), state.v

    run = landed(system, state, INTEGRATORS[name], time, where, lambda s: s.q)
    corner = np.array([True, True, False, False])
    sticks = np.array([True, False, True, False])
    params = {"friction": jnp.where(sticks, 2.0, 0.0), "radius": jnp.where(corner, 0.0, R)}
    params["anchor_b"] = jnp.where(corner[:, None], CORNER, 0.0)
    # skipped: the free flight of semi-implicit Euler and its derivatives are of first order
    want = None if name == "SIE" else lambda z, i: thrown(z, time, corner[i], sticks[i])
    # the error is a fraction of h|ω|, here 0.026
    held_to(run, z, {"floor": params}, want, tight=1.5e-2)


def bar(restitution=None):
    """A bar over a floor, which it may hit with one end."""
    scene = jc.Scene(dim=2)
    scene.add_body("bar", mass=1.0, inertia=0.1, position=(0.0, 0.5), angle=0.3)
    own = {} if restitution is None else {"restitution": restitution}
    scene.add(jc.PlaneContact("tip", jc.WORLD, "bar", center=(-0.4, 0.4), friction=0.5, **own))
    return scene.build()


def height_by(system, state, method):
    """Returns the function from the height z to the height one step later."""

    def height(z):
        start = jc.init(system, method, state.q.at[1].set(z), state.v)
        return jc.step(system, method, start, None, H)[0].q[1]

    return height


def test_a_gradient_that_lacks_the_time_of_impacts_warns_once(monkeypatch):
    """The warning comes when the gradient is traced, not when the step is.

    Report and check repeat it.
    """
    monkeypatch.setattr(notices, "_given", set())
    system, state = bar()
    method = jc.Method(contact_solver=jc.solvers.GaussSeidel())
    height = height_by(system, state, method)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        jax.jit(height).lower(0.5)
        assert caught == []
        for _ in range(2):
            jax.jit(jax.grad(height)).lower(0.5)
    assert len(caught) == 1
    assert "gradients through impacts: beside GaussSeidel a landing of tip takes two" in str(
        caught[0].message
    )
    check = jc.check_gradients(height, 0.5)
    assert len(check.notes) == 1
    assert "note, gradients through impacts: beside GaussSeidel a landing of tip" in str(check)
    said = jc.report(system, state, method=method, dt=H)
    assert "a landing of tip takes two steps" in said.warnings["impacts"]
    assert "warning, gradients through impacts: beside GaussSeidel" in str(said)


@pytest.mark.parametrize("case", ["default", "restitution", "RK4", "events", "particle"])
def test_no_gradient_warns_that_has_the_time_of_impacts(case, monkeypatch):
    monkeypatch.setattr(notices, "_given", set())
    system, state = bar(jnp.zeros(()) if case == "restitution" else None)
    if case == "particle":
        scene = jc.Scene(dim=2)
        scene.add_particle("ball", mass=1.0, position=(0.0, 0.5))
        scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", friction=0.5))
        system, state = scene.build()
    sweeps = {"contact_solver": jc.solvers.GaussSeidel()}
    parts = {"default": {}, "RK4": sweeps | {"integrator": jc.RK4()}}
    parts["events"] = sweeps | {"events": jc.integrators.Events()}
    method = jc.Method(**parts.get(case, sweeps))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(jax.grad(height_by(system, state, method))).lower(0.5)
    assert impact(Setup.of(system, state, method, H)) is None


def vee(restitution=0.6):
    """A ball over two planes that meet below it in a V."""
    scene = jc.Scene(dim=2)
    scene.add_particle("ball", mass=1.0, position=(0.0, 0.1))
    for name, x in (("left", 0.5), ("right", -0.5)):
        scene.add(
            jc.PlaneContact(
                name, jc.WORLD, "ball", normal=(x, 1.0), point=(0.0, 0.0), restitution=restitution
            )
        )
    return scene.build()


def ball(restitution):
    """A ball over a floor."""
    scene = jc.Scene(dim=2)
    scene.add_particle("ball", mass=1.0, position=(0.0, 0.1))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", restitution=restitution))
    return scene.build()


def started(scene, place, time):
    """Returns the function from a start x to the position and velocity after a given time."""
    system, state = scene
    method = jc.Method()

    def run(x):
        start = jc.init(system, method, state.q.at[place].set(x), state.v)
        last = jc.rollout(system, method, start, None, H, round(time / H), record=lambda s, i: None)
        return last[0].q, last[0].v

    return run


@pytest.mark.parametrize(
    ("scene", "place", "at", "time", "case"),
    [
        (vee(), 0, 0.0, 0.2, "simultaneous impacts: 2 of left, right in the step at 0.142"),
        (ball(0.6), 1, 0.1, 0.1428, "a grazing impact: floor hits 0 or 1 times, depending on x"),
    ],
    ids=["simultaneous", "grazing"],
)
def test_impacts_that_may_have_no_derivative_are_named(scene, place, at, time, case):
    """Checks the rollout from x and the rollouts from both neighbors of x."""
    run = started(scene, place, time)
    found = encounters.cases(lambda x: run(x[0]), [jnp.asarray(at)], [[jnp.asarray(5e-3)]])
    assert any(case in words for words in found)


def test_a_check_names_the_impacts_that_have_no_derivative():
    found = jc.check_gradients(started(ball(0.3), 1, 0.4), 0.1)
    assert not found.ok
    case = "accumulating impacts: floor hits 3 times within 20 steps"
    assert any(case in note for note in found.notes)


def test_a_report_names_what_has_impacts():
    system, state = vee()
    said = jc.report(system, state)
    assert said.impacts == ("left", "right")
    assert "impacts of left, right: gradients are right for one impact at a time" in str(said)
    hung = jc.Scene(dim=2)
    hung.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    hung.add(jc.Distance("rod", jc.WORLD, "bob"))
    assert jc.report(*hung.build()).impacts == ()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_tumbling_box_that_lands_on_corners_warns_once(dim, monkeypatch):
    """Covers contacts without restitution under semi-implicit Euler; the report says the same."""
    monkeypatch.setattr(notices, "_given", set())
    scene = jc.Scene(dim=dim)
    where = (0.0, 0.5) if dim == 2 else (0.0, 0.0, 0.5)
    inertia, spin = (0.01, 2.0) if dim == 2 else ((0.01, 0.02, 0.03), (2.0, 1.0, 0.5))
    scene.add_body("box", mass=1.0, inertia=inertia, position=where, angular_velocity=spin)
    names = []
    for i in range(2 ** (dim - 1)):
        side = (0.1 if i % 2 else -0.1, 0.1 if i // 2 else -0.1)[: dim - 1]
        names.append(f"corner {i}")
        corner = (*side, 0.4)
        scene.add(jc.PlaneContact(names[-1], jc.WORLD, "box", center=corner, friction=0.5))
    system, state = scene.build()
    method = jc.Method(contact_solver=jc.solvers.GaussSeidel())

    def height(z):
        start = jc.init(system, method, state.q.at[dim - 1].set(z), state.v)
        return jc.step(system, method, start, None, H)[0].q[dim - 1]

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            jax.jit(jax.grad(height)).lower(0.5)
    told = [str(x.message) for x in caught if notices_of_impacts(x)]
    assert len(told) == 1
    assert f"a landing of {', '.join(names)} takes two steps" in told[0]
    said = jc.report(system, state, method)
    assert f"a landing of {listed(names)} takes two steps" in said.warnings["impacts"]
    assert said.impacts == tuple(names)


def notices_of_impacts(warning):
    """Returns True for a warning that a gradient through impacts may be wrong."""
    return str(warning.message).startswith("gradients through impacts")
