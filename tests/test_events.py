"""Steps split at impacts: closed forms, order, the derivative of the time, and rest."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.verification import references

FORMS = {case["id"]: case for case in references.load("contact_closed_forms")["cases"]}
EXACT = 1e-6
"""Tolerance of event-located stepping against closed forms."""
R = 0.1


def falling(dtype=None):
    """A ball in the plane over a floor, as a particle with a contact radius."""
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81), dtype=dtype)
    scene.add_particle("ball", mass=1.0, position=(0.0, 1.0 + R))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=R, restitution=0.8))
    return scene.build()


def located(integrator=None, **choices):
    return jc.Method(
        jc.RK4() if integrator is None else integrator, events=jc.integrators.Events(**choices)
    )


def march(system, method):
    """Returns the function (state, h, n) → state after n steps; compiled once for all h and n."""

    def run(state, h, n):
        start = jc.init(system, method, state.q, state.v)
        return jax.lax.fori_loop(0, n, lambda _, s: jc.step(system, method, s, None, h)[0], start)

    return jax.jit(run)


def bounced(y, v, e, g, end):
    """Returns the height after bounces on a floor at R, and its derivatives by y, v and e."""

    def height(y, v, e):
        y, t = y - R, 0.0
        while True:
            speed = np.sqrt(v * v + 2 * g * y)
            fall = (v + speed) / g if g else (-y / v if v < 0 else np.inf)
            if not t + fall < end:
                rest = end - t
                return R + y + v * rest - g * rest * rest / 2
            y, v, t = 0.0, e * speed, t + fall

    x, d = np.array([y, v, e]), 1e-6 * np.eye(3)
    return height(*x), [(height(*(x + k)) - height(*(x - k))) / 2e-6 for k in d]


def test_bounces_and_their_derivatives_are_those_of_closed_forms():
    """Bounces, a bounce without gravity, no impact, rest, and a graze, with 480 steps each.

    Without the time of impact the derivatives of the first four have the wrong sign.
    """
    zhong = references.load("grad_contact_zhong")["task1"]
    system, state = falling()
    method = located()

    def end(x, e, g, time):
        changed = system.with_params({"floor": {"restitution": e}, "gravity": g * jnp.eye(2)[1]})
        q, v = state.q.at[1].set(x[0]), state.v.at[1].set(x[1])
        start = jc.init(changed, method, q, v)
        final, times = jc.rollout(
            changed, method, start, None, time / 480, 480, record=lambda s, i: i.impacts.times[0]
        )
        return final.q[1], times

    graze = -np.sqrt(2 * 9.81 * 0.5)
    worlds = np.array(
        [
            [1.0 + R, 0.0, 0.8, -9.81, 2.0],
            [0.4, -1.0, 0.9, -9.81, 1.3],
            [0.3, 2.0, 0.7, -9.81, 1.3],
            [1.0, -2.0, 1.0, 0.0, 1.0],
            [9.0, 1.0, 0.8, -9.81, 1.0],
            [R, 0.0, 0.8, -9.81, 1.0],
            [0.5 + R, graze, 0.8, 9.81, 0.4],
        ]
    )
    x, e, g, time = worlds[:, :2], *worlds[:, 2:].T
    slopes = jax.value_and_grad(end, (0, 1), has_aux=True)
    (found, times), (by_start, by_e) = jax.jit(jax.vmap(slopes))(x, e, g, time)
    for i, (y, v, e_, g_, time_) in enumerate(worlds[:5]):
        value, slope = bounced(y, v, e_, -g_, time_)
        np.testing.assert_allclose(found[i], value, atol=EXACT)
        np.testing.assert_allclose([*by_start[i], by_e[i]], slope, atol=EXACT, rtol=EXACT)
    first = np.asarray(times[0])
    want = [float(t) for t in FORMS["bouncing_ball"]["impact_times"]]
    np.testing.assert_allclose(first[np.isfinite(first)], [t for t in want if t < 2], atol=EXACT)
    np.testing.assert_allclose(found[3], float(zhong["h"]), atol=EXACT)
    np.testing.assert_allclose(by_start[3], [zhong["dh_dy0"], zhong["dh_dvy0"]], atol=EXACT)
    np.testing.assert_allclose(found[5], R, atol=1e-12)
    assert np.isfinite(by_start).all()
    assert np.isfinite(by_e).all()


def test_derivatives_are_right_after_the_value_was_computed():
    """JAX may keep the trace of a branch from the value, which has no rules of derivatives."""
    scene = jc.Scene(dim=2)
    scene.add_body("disc", mass=1.0, inertia=0.1, position=(0.0, 0.1005))
    touch = {"radius": 0.1, "friction": 0.5, "restitution": 0.5}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "disc", **touch))
    system, state = scene.build()
    method = located(jc.SemiImplicitEuler())

    def after(v):
        start = dataclasses.replace(state, v=v)
        return jc.rollout(system, method, start, None, 1e-3, 1)[0].v @ jnp.asarray([1.0, 0.3, -2.0])

    total = jax.jit(jax.vmap(after))
    v, eps = np.array([1.0, -1.0, 0.3]), 1e-6
    up, down = np.split(total(np.concatenate([v + eps * np.eye(3), v - eps * np.eye(3)])), 2)
    slope = jax.jit(jax.grad(lambda v: jnp.sum(total(v))))(jnp.asarray(v[None]))[0]
    np.testing.assert_allclose(slope, (up - down) / (2 * eps), atol=1e-6)
    np.testing.assert_allclose(slope[1], -0.894, atol=0.01)


def test_derivatives_through_a_collision():
    """Uses forward mode along one direction that changes all four numbers."""
    case = references.load("grad_two_balls_nimble")
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("a", mass=1.0, position=(0.0, 0.0))
    scene.add_particle("b", mass=1.0, position=(0.52, 0.0))
    touch = {"radius_a": 0.1, "radius_b": 0.1, "restitution": 1.0}
    scene.add(jc.contacts.CapsuleContact("touch", "a", "b", **touch))
    system, state = scene.build()
    method = located(jc.SemiImplicitEuler())

    def place(x):
        still = jnp.zeros(2)
        q, v = jnp.concatenate([x[:2], still]), jnp.concatenate([x[2:], still])
        start = dataclasses.replace(state, q=q, v=v)
        return jc.rollout(system, method, start, None, 1 / 24, 24)[0].q[1]

    x, along = jnp.asarray([0.0, 0.52, 1.0, 0.0]), jnp.asarray([0.3, -0.7, 0.5, 1.2])
    value, slope = jax.jit(lambda x: jax.jvp(place, (x,), (along,)))(x)
    np.testing.assert_allclose(value, 1.2, atol=EXACT)
    exact = np.array(case["exact_gradient_d_x2T_d_x1_x2_v0_u0"], float)
    np.testing.assert_allclose(slope, along @ exact, atol=EXACT)


def oscillator():
    """A mass on a rail; without its stop at −0.6 it moves as x = cos 2t."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("slide", mass=1.0, inertia=1.0)
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, 0.0)))
    scene.add(jc.forces.JointSpring("spring", "rail", stiffness=4.0))
    scene.add(jc.Limit("stop", "rail", lower=-0.6, restitution=0.5))
    system, state = scene.build()
    return system, dataclasses.replace(state, q=state.q.at[0].set(1.0))


def struck(time):
    """Returns the exact position of the oscillator between its first and second impact."""
    first = np.arccos(-0.6) / 2
    rate = 0.5 * 2 * np.sin(2 * first)
    angle = 2 * (time - first)
    return -0.6 * np.cos(angle) + rate / 2 * np.sin(angle)


def test_an_impact_keeps_the_order_of_the_integrator():
    """RK4 has order four with events, and about two in plain steps, which also locate impacts."""
    system, state = oscillator()
    end, orders = 1.7, []
    for method in (located(), jc.Method(jc.RK4())):
        run = march(system, method)
        counts = np.array([20, 40, 80, 160, 320])
        errors = [abs(float(run(state, end / n, n).q[0]) - struck(end)) for n in counts]
        orders.append(-np.polyfit(np.log(counts), np.log(errors), 1)[0])
    assert orders[0] > 3.7
    assert 1.5 < orders[1] < 3.0


def test_what_a_step_tells_of_its_impacts():
    """The info has the time, the element and the mean force of the impulse; time ends at t + h."""
    system, state = falling()
    method = located()
    start = jc.init(system, method, state.q.at[1].set(R + 0.01), state.v.at[1].set(-2.0))
    new, info = jax.jit(lambda s: jc.step(system, method, s, None, 0.05))(start)
    speed = np.sqrt(4 + 2 * 9.81 * 0.01)
    when = (speed - 2) / 9.81
    assert int(info.impacts.count) == 1
    assert info.impacts.names[int(info.impacts.elements[0])] == "floor"
    np.testing.assert_allclose(info.impacts.times, [when], rtol=1e-9)
    np.testing.assert_allclose(info.reactions["floor"][0], 1.8 * speed / 0.05, rtol=1e-9)
    np.testing.assert_allclose(new.v[1], 0.8 * speed - 9.81 * (0.05 - when), rtol=1e-9)
    assert float(new.time) == 0.05


def test_several_impacts_in_one_step():
    """A slider needs 10 ms from stop to stop; a step has 38 ms."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("slide", mass=1.0, inertia=1.0, velocity=(1.0, 0.0))
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, 0.0)))
    scene.add(jc.Limit("ends", "rail", -0.005, 0.005, restitution=1.0))
    system, state = scene.build()
    method = located(jc.SemiImplicitEuler(), splits=4)
    start = jc.init(system, method, state.q, state.v)
    new, info = jax.jit(lambda s: jc.step(system, method, s, None, 0.038))(start)
    assert int(info.impacts.count) == 4
    np.testing.assert_allclose(info.impacts.times, [0.005, 0.015, 0.025, 0.035], atol=1e-9)
    np.testing.assert_allclose([new.q[0], new.v[0]], [-0.002, 1.0], atol=1e-9)


def test_balls_that_touch_are_struck_together():
    """Newton's simultaneous impact law, for a gap that closes within the step."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    for i, x in enumerate((-0.21, 0.0, 0.2)):
        scene.add_particle(f"{i}", mass=1.0, position=(x, 0.0), velocity=(float(i == 0), 0.0))
    for i in range(2):
        touch = {"radius_a": 0.1, "radius_b": 0.1, "restitution": 1.0}
        scene.add(jc.contacts.CapsuleContact(f"touch {i}", f"{i}", f"{i + 1}", **touch))
    system, state = scene.build()
    new = march(system, located(jc.SemiImplicitEuler()))(state, 0.1, 1)
    np.testing.assert_allclose(new.v[:3], [-1 / 3, 2 / 3, 2 / 3], atol=EXACT)
    np.testing.assert_allclose(new.q[:3], [-0.23, 0.06, 0.26], atol=EXACT)


def test_impacts_with_friction():
    """The references are planar with the spin about z; that axis is −y of this scene."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    scene.add_body("ball", inertia=jc.inertia.sphere(1.0, 0.1), position=(0, 0, 0.11))
    floor = jc.PlaneContact("floor", jc.WORLD, "ball", radius=0.1, friction=0.3, restitution=0.7)
    scene.add(floor)
    system, state = scene.build()
    run = march(system, located(jc.SemiImplicitEuler()))
    for name, start, spin in (("stick", 1.0, 0.0), ("slip", 4.0, 5.0)):
        after = FORMS[f"sphere_floor_{name}"]["after"]
        v = jnp.asarray([start, 0.0, -2.0, 0.0, -spin, 0.0])
        new = run(dataclasses.replace(state, v=v), 0.02, 1)
        want = [after["vx"], 0.0, after["vy"], 0.0, -float(after["w"]), 0.0]
        np.testing.assert_allclose(new.v, np.array(want, float), atol=EXACT)
        np.testing.assert_allclose(new.q[2], 0.1 + 0.015 * 1.4, atol=EXACT)


def test_a_rope_jerks():
    """A weight falls until the rope is taut, and rebounds with half the speed."""
    scene = jc.Scene(dim=3)
    scene.add_particle("weight", mass=2.0, position=(0.0, 0.0, -0.5))
    ends = {"length": 1.0, "point_a": (0.0, 0.0, 0.0)}
    scene.add(jc.contacts.Rope("rope", jc.WORLD, "weight", restitution=0.5, **ends))
    system, state = scene.build()
    new = march(system, located())(state, 0.02, 22)
    fall = np.sqrt(1 / 9.81)
    rest = 0.44 - fall
    height = -1 + 0.5 * 9.81 * fall * rest - 9.81 * rest**2 / 2
    np.testing.assert_allclose(new.q, [0.0, 0.0, height], atol=EXACT)


@pytest.mark.parametrize(
    ("integrator", "dtype"),
    [(jc.SemiImplicitEuler(), jnp.float32), (jc.RK4(), jnp.float64)],
    ids=["SIE", "RK4"],
)
def test_a_ball_comes_to_lie(integrator, dtype):
    """After the time of infinitely many bounces the ball rests, and it never gains energy.

    Two errors are tolerated: semi-implicit Euler adds ½ m (g h)² a step to a fall, and a resting
    contact with Runge–Kutta methods penetrates by ¼ g h².
    """
    system, state = falling(dtype)
    changed = system.with_params({"floor": {"restitution": 0.5}})
    method = located(integrator)
    start = jc.init(changed, method, state.q, state.v)
    h = 5e-3

    def record(s, i):
        return s.q[1] - R, jc.energy(changed, s).total, i.impacts.count

    def rolled(s):
        return jc.rollout(changed, method, s, None, jnp.asarray(h, dtype), 400, record=record)

    final, (gap, energy, count) = jax.jit(rolled)(start)
    tight = 1e-9 if dtype == jnp.float64 else 1e-5
    assert int(final.status) == 0
    assert float(gap.min()) > -9.81 * h * h / 4 - tight
    assert 4 < int(count.sum()) < 30
    assert float(jnp.diff(energy).max()) < 0.5 * (9.81 * h) ** 2 * 1.01
    np.testing.assert_allclose(gap[-1], 0.0, atol=tight)
    np.testing.assert_allclose(final.v, 0.0, atol=tight)


def test_what_has_no_end_has_no_trace_of_events(monkeypatch):
    """Friction alone makes no impact: the program equals that without events, without a warning."""
    scene = jc.Scene(dim=2)
    scene.add_body("slide", mass=1.0, inertia=1.0)
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, 0.0)))
    scene.add(jc.contacts.JointFriction("rub", "rail", max_force=1.0))
    scene.add(jc.Limit("soft", "rail", upper=1.0, stiffness=10.0))
    system, state = scene.build()

    def program(system, state, method):
        return jax.jit(lambda s: jc.step(system, method, s, None, 1e-3)).lower(state).as_text()

    events = located(jc.SemiImplicitEuler())
    texts = [program(system, state, method) for method in (events, jc.Method())]
    assert texts[0] == texts[1]  # the same kernel
    monkeypatch.setenv("JAXCON_KERNELS", "off")  # branches of kernels are not in the text of XLA
    sizes = [len(program(system, state, method)) for method in (events, jc.Method())]
    assert sizes[0] == sizes[1]
    branches = [
        [program(*built, method).count("stablehlo.case") for method in (events, jc.Method())]
        for built in (falling(), (system, state))
    ]
    assert branches[0][0] > branches[0][1]
    assert branches[1][0] == branches[1][1]


@pytest.mark.parametrize(
    ("method", "match"),
    [
        (
            lambda: jc.Method(events=jc.integrators.Events(splits=0)),
            "Events: splits must be a whole number",
        ),
        (
            lambda: jc.Method(events=jc.integrators.Events(iterations=0)),
            "Events: iterations must be a whole",
        ),
        (
            lambda: jc.Method(events=jc.integrators.Events),
            r"events must be a value such as Events\(\)",
        ),
        (lambda: jc.Method(events=True), r"events must be a value such as Events\(\)"),
        (
            lambda: jc.Method(jc.integrators.RATTLE(), events=jc.integrators.Events()),
            "inequality rows of \\['floor'\\]",
        ),
    ],
)
def test_bad_choices_are_refused(method, match):
    system, state = falling()
    with pytest.raises((ValueError, TypeError), match=match):
        jc.step(system, method(), state, None, 1e-3)


def test_points_of_one_element_strike_as_one():
    """A bar falls flat on both ends: each leaves with e times its speed.

    The info names the floor.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("bar", mass=1.0, inertia=0.1, position=(0.0, 0.1), velocity=(0.0, -1.0))
    scene.add_particle("bead", mass=1.0, position=(5.0, 9.0))
    scene.add(jc.PlaneContact("roof", jc.WORLD, "bead", friction=0.2))
    ends = np.array([[-0.5, 0.1], [0.5, 0.1]])
    touch = {"center": ends, "friction": 0.5, "restitution": 0.6}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "bar", **touch))
    system, state = scene.build()
    method = jc.Method(jc.RK4(), events=jc.integrators.Events())
    start = jc.init(system, method, state.q, state.v)
    new, info = jax.jit(lambda s: jc.step(system, method, s, None, 0.2))(start)
    np.testing.assert_allclose(info.impacts.times, [0.1], atol=1e-12)
    assert info.impacts.names[int(info.impacts.elements[0])] == "floor"
    np.testing.assert_allclose(jc.velocity(system, new, "bar"), [0.0, 0.6], atol=1e-9)
    np.testing.assert_allclose(jc.position(system, new, "bar"), [0.0, 0.06], atol=1e-9)


def test_what_nearest_rows_leave_out_of_an_impact_shows_in_the_residual():
    """Two beads hit the floor at once and one row is solved: the other bead keeps closing."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    for i in range(2):
        scene.add_particle(f"{i}", mass=1.0, position=(float(i), 0.01), velocity=(0.0, -1.0))
        scene.add(jc.PlaneContact(f"floor {i}", jc.WORLD, f"{i}", restitution=0.5))
    system, state = scene.build()
    missed = []
    for stops in (1, 2):
        some = jc.solvers.ActiveSet(jc.solvers.GaussSeidel(sweeps=5, warm=False), stops=stops)
        method = jc.Method(contact_solver=some, events=jc.integrators.Events())
        info = jax.jit(lambda s, m=method: jc.step(system, m, s, None, 0.02))(state)[1]
        missed.append(float(info.reactions.residual))
    np.testing.assert_allclose(missed, [1.0, 0.0], atol=1e-9)
