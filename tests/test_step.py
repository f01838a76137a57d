"""One step of each integrator, compared with its definition."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import IDENTITY

import jaxcon as jc

FREE = jc.Method(stabilizer=jc.stabilizers.Unstabilized())


def falling(dim=2):
    scene = jc.Scene(dim=dim)
    scene.add_particle("bob", mass=2.0, position=(1.0,) * dim, velocity=(3.0,) * dim)
    return scene.build()


def test_semi_implicit_euler_by_hand():
    system, state = falling()
    new, info = jc.step(system, FREE, state, None, 0.1)
    v = np.array([3.0, 3.0 - 0.981])
    np.testing.assert_allclose(new.v, v, rtol=IDENTITY)
    np.testing.assert_allclose(new.q, 1.0 + 0.1 * v, rtol=IDENTITY)
    np.testing.assert_allclose(info.acceleration, [0, -9.81])
    np.testing.assert_allclose(new.time, 0.1)


@pytest.mark.parametrize(
    ("integrator", "q"),
    [
        (jc.integrators.ExplicitEuler(), [1.3, 1.3]),
        (jc.integrators.Heun(), [1.3, 1.3 - 9.81 * 0.005]),
        (jc.RK4(), [1.3, 1.3 - 9.81 * 0.005]),
    ],
)
def test_runge_kutta_by_hand(integrator, q):
    system, state = falling()
    method = dataclasses.replace(FREE, integrator=integrator)
    new, _ = jc.step(system, method, state, None, 0.1)
    np.testing.assert_allclose(new.q, q, rtol=IDENTITY)
    np.testing.assert_allclose(new.v, [3.0, 3.0 - 0.981], rtol=IDENTITY)


def swing(q, v, t, u, p):
    return -p * jnp.sin(q) + jnp.cos(t)


def one(q, p):
    return jnp.ones_like(q)


ORDERS = {"ExplicitEuler": 1, "SemiImplicitEuler": 1, "Heun": 2, "RK4": 4}


@pytest.mark.parametrize("name", ORDERS)
def test_order_on_a_forced_pendulum(name):
    """The error at time 1 falls with h at the expected order.

    The reference is a fine NumPy solution.
    """
    system = jc.GeneralizedSystem(mass=one, force=swing, params=jnp.asarray(4.0))
    method = jc.Method(integrator=getattr(jc.integrators, name)())
    state = jc.init(system, method, jnp.asarray([1.0]), jnp.asarray([0.0]))
    run = jax.jit(lambda dt, n: _march(system, method, state, dt, n), static_argnums=1)
    exact = fine_pendulum()
    steps = (40, 80) if ORDERS[name] > 1 else (400, 800)
    errors = [abs(float(run(1.0 / n, n)) - exact) for n in steps]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(ORDERS[name], abs=0.15)


def _march(system, method, state, dt, n):
    return jc.rollout(system, method, state, None, dt, n)[0].q[0]


def fine_pendulum(steps=4000):
    """Returns q(1) of q̈ = −4 sin q + cos t by classical Runge–Kutta with small steps."""
    y, h = np.array([1.0, 0.0]), 1.0 / steps

    def f(t, y):
        return np.array([y[1], -4 * np.sin(y[0]) + np.cos(t)])

    for i in range(steps):
        t = i * h
        k1 = f(t, y)
        k2 = f(t + h / 2, y + h / 2 * k1)
        k3 = f(t + h / 2, y + h / 2 * k2)
        k4 = f(t + h, y + h * k3)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return y[0]


@pytest.mark.parametrize("solver", [jc.solvers.Schur(), jc.solvers.Dense()])
def test_pendulum_forces_by_hand(solver):
    """At rest and level the rod force is 0; moving at the bottom it is m (g + v²/l)."""
    for place, speed, expected in (((2.0, 0.0), (0.0, 0.0), 0.0), ((0.0, -2.0), (3.0, 0.0), 14.31)):
        scene = jc.Scene(dim=2)
        scene.add_particle("bob", mass=1.0, position=place, velocity=speed)
        scene.add(jc.Distance("rod", jc.WORLD, "bob"))
        system, state = scene.build()
        method = dataclasses.replace(FREE, solver=solver)
        a, multipliers, status = jc.forward_dynamics(system, state, None, method, 1e-3)
        np.testing.assert_allclose(multipliers, [-expected], atol=IDENTITY)
        assert status == jc.Status.OK


@pytest.mark.parametrize("name", ["revolute-3d-loop", "mixed-2d", "arm"])
def test_feedback_makes_errors_decay_as_they_should(name):
    """J a + γ = −2α φ̇ − β² φ, with gains as a number, by row, and by name."""
    built = scenes.build(name)
    rows = scenes.linearized(built.system, built.off.q, built.off.v, built.off.time)
    size, names = rows.layout.size, rows.layout.names
    by_name = (dict.fromkeys(names, 3.0), dict.fromkeys(names, 5.0))
    by_row = (np.full(size, 3.0), np.full(size, 5.0))
    for alpha, beta in ((3.0, 5.0), by_row, by_name):
        method = jc.Method(stabilizer=jc.Baumgarte(alpha, beta))
        a = jc.forward_dynamics(built.system, built.off, None, method, 1e-3).acceleration
        got = rows.jacobian.apply(a) + rows.bias
        np.testing.assert_allclose(got, -6 * rows.rate - 25 * rows.residual, rtol=1e-8, atol=1e-8)


def test_gains_by_name_leave_the_others_to_the_fallback():
    built = scenes.build("mixed-2d")
    rows = scenes.linearized(built.system, built.off.q, built.off.v, built.off.time)
    stabilizer = jc.Baumgarte({"rod": 3.0}, {"rod": 3.0}, fallback=(7.0, 7.0))
    a = jc.forward_dynamics(
        built.system, built.off, None, jc.Method(stabilizer=stabilizer), 1e-3
    ).acceleration
    rate = np.full(rows.layout.size, 7.0)
    rate[rows.layout.rows("rod")] = 3.0
    got = rows.jacobian.apply(a) + rows.bias
    np.testing.assert_allclose(
        got, -2 * rate * rows.rate - rate**2 * rows.residual, rtol=1e-8, atol=1e-8
    )


def test_from_rate_and_critical():
    assert jc.Baumgarte.critical(rate=4.0).alpha == jc.Baumgarte.critical(rate=4.0).beta == 4.0
    gains = jc.Baumgarte.from_rate(4.0, damping_ratio=0.5)
    assert (gains.alpha, gains.beta) == (2.0, 4.0)


@pytest.mark.parametrize("integrator", [jc.SemiImplicitEuler(), jc.integrators.Heun(), jc.RK4()])
def test_quaternions_stay_of_unit_length(integrator):
    built = scenes.build("revolute-3d-loop")
    method = jc.Method(integrator=integrator)
    state, _ = jc.step(built.system, method, built.state, None, 0.01)
    q = state.q[built.system.layout.q("first")[3:]]
    np.testing.assert_allclose(np.linalg.norm(q), 1.0, rtol=IDENTITY)


def test_info_is_what_the_step_saw_at_its_start():
    built = scenes.build("mixed-2d")
    method = jc.Method(jc.integrators.Heun())
    _, info = jc.step(built.system, method, built.off, None, 1e-3)
    expected = jc.forward_dynamics(built.system, built.off, None, method, 1e-3)
    np.testing.assert_allclose(info.acceleration, expected.acceleration, rtol=IDENTITY)
    np.testing.assert_allclose(info.multipliers, expected.multipliers, rtol=IDENTITY)
    before = jc.violation(built.system, built.off)
    np.testing.assert_allclose(info.violation.position, before.position, atol=IDENTITY)
    assert info.status == jc.Status.OK


def test_control_reaches_the_body():
    built = scenes.build("mixed-2d")
    control = jnp.asarray([1.0, 2.0, 3.0])
    pushed, _ = jc.step(built.system, jc.Method(), built.state, control, 1e-3)
    alone, _ = jc.step(built.system, jc.Method(), built.state, None, 1e-3)
    assert np.any(np.abs(pushed.v - alone.v) > 1e-4)
    nothing, _ = jc.step(built.system, jc.Method(), built.state, 0 * control, 1e-3)
    # two programs, which round differently where multiplications and additions are fused
    np.testing.assert_allclose(nothing.v, alone.v, rtol=IDENTITY, atol=1e-16)
