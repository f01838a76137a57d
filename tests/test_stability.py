"""Predicted limits of stable gains, compared with simulations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc

INTEGRATORS = {
    "semi-implicit": jc.SemiImplicitEuler(),
    "explicit": jc.integrators.ExplicitEuler(),
    "heun": jc.integrators.Heun(),
    "rk4": jc.RK4(),
}
every_integrator = pytest.mark.parametrize("name", INTEGRATORS)

# Critical damping puts both roots at −rate: an explicit method is stable where |R(−x)| ≤ 1 with
# x = h rate, for RK4 up to the root 2.785294 of 1 − x + x²/2 − x³/6 + x⁴/24 = 1. For semi-implicit
# Euler the map of (φ, hφ̇) is [[1 − x², 1 − 2x], [−x², 1 − 2x]], of trace 2 − 2x − x² and
# determinant 1 − 2x; the root −1 is reached where 1 + trace + determinant = 0: x² + 4x − 4 = 0.
LIMITS = {"semi-implicit": np.sqrt(8) - 2, "explicit": 2.0, "heun": 2.0, "rk4": 2.785293563405282}


@every_integrator
@pytest.mark.parametrize("dt", [1e-3, 0.02])
def test_the_limit_of_critical_damping(name, dt):
    limit = jc.stabilizers.largest_stable_rate(INTEGRATORS[name], dt)
    assert limit * dt == pytest.approx(LIMITS[name], rel=1e-6)


@pytest.fixture(scope="module")
def gap():
    """A particle off the point to which it is constrained: φ is linear in q."""

    def residual(p, t, _):
        return p.position

    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("a", mass=1.0, position=(0.1, 0.0))
    scene.add(jc.joints.Holonomic(residual, bodies=("a",), name="hold"))
    return scene.build()


@every_integrator
@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_errors_decay_below_the_limit_and_grow_above_it(gap, name, ratio):
    system, state = gap
    dt, integrator = 0.01, INTEGRATORS[name]
    limit = jc.stabilizers.largest_stable_rate(integrator, dt, ratio)

    @jax.jit
    def after(rate):
        method = jc.Method(integrator, jc.Baumgarte.from_rate(rate, ratio))
        final, _ = jc.rollout(system, method, state, None, dt, 2000)
        return jnp.max(jnp.abs(final.q))

    assert after(0.97 * limit) < 0.01
    assert not after(1.03 * limit) < 1.0


@every_integrator
def test_growth_is_the_factor_of_one_step(gap, name):
    """Compares `growth` with the spectral radius of the linear error map of a step."""
    system, _ = gap
    dt, alpha, beta, integrator = 0.01, 30.0, 45.0, INTEGRATORS[name]
    method = jc.Method(integrator, jc.Baumgarte(alpha, beta))
    columns = []
    for q, v in ((1.0, 0.0), (0.0, 1.0)):
        state = jc.init(system, method, jnp.asarray([q, 0.0]), jnp.asarray([v, 0.0]))
        new, _ = jc.step(system, method, state, None, dt)
        columns.append([float(new.q[0]), float(new.v[0])])
    radius = max(abs(np.linalg.eigvals(np.array(columns).T)))
    assert integrator.growth(alpha, beta, dt) == pytest.approx(radius, rel=1e-10)


def test_default_gains_are_stable_at_every_step():
    for integrator in INTEGRATORS.values():
        for dt in (1e-5, 1e-3, 0.1, 1.0):
            alpha, beta = (float(x) for x in integrator.default_gains(dt))
            assert integrator.growth(alpha, beta, dt) < 1


def test_default_gains_of_runge_kutta_do_not_grow_as_the_step_shrinks():
    assert [float(x) for x in jc.RK4().default_gains(1e-6)] == [10, 10]


@pytest.mark.parametrize("gains", [(90.0, 90.0), ({"hold": 90.0}, {"hold": 90.0})])
def test_unstable_gains_warn_and_name_the_limit(gap, gains):
    system, state = gap
    method = jc.Method(stabilizer=jc.Baumgarte(*gains))
    with pytest.warns(UserWarning, match="alpha=90.*unstable at dt=0.01.*largest.*82.8"):
        jc.step(system, method, state, None, 0.01)


def test_stable_gains_do_not_warn(gap):
    system, state = gap
    jc.step(system, jc.Method(stabilizer=jc.Baumgarte.critical(rate=80.0)), state, None, 0.01)
