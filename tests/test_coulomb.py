"""Limit cases of Coulomb's law: a block that is pulled, and Painlevé's rod."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.verification import references

FORMS = {case["id"]: case for case in references.load("contact_closed_forms")["cases"]}
G = 9.81


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_a_block_stays_until_it_is_pulled_hard_enough(dtype):
    case = FORMS["block_pulled"]
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("block", mass=2.0, position=(0.0, 0.0))
    scene.add(jc.forces.Force("pull", "block", (1.0, 0.0)))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "block", friction=0.5))
    system, state = scene.build()

    def speed(pull):
        changed = system.with_params({"pull": {"force": jnp.stack([pull, 0 * pull])}})
        final, _ = jc.rollout(changed, jc.Method(), state, None, jnp.asarray(1e-3, dtype), 20)
        return final.v[0]

    pulls = jnp.asarray([0.999 * case["F_limit"], 1.001 * case["F_limit"], 15.0], dtype)
    want = 0.02 * np.array([0.0, 0.001 * case["F_limit"] / 2, case["acceleration_at_F_15"]])
    tight = 1e-12 if dtype == jnp.float64 else 1e-5
    np.testing.assert_allclose(jax.jit(jax.vmap(speed))(pulls), want, atol=tight)


@pytest.mark.parametrize("solver", [jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel(sweeps=300)])
def test_a_rod_that_cannot_slide_jams(solver):
    """Painlevé's paradox: for p < 0 no force lets the tip slide, and an impulse stops it.

    The energy must not increase. Each angle is followed by its mirror image.
    """
    case = FORMS["painleve_rod"]
    scene = jc.Scene(dim=2)
    scene.add_body("rod", mass=1.0, inertia=1 / 3, position=(-1.0, 0.0), velocity=(2.0, 0.0))
    scene.add(jc.PlaneContact("tip", jc.WORLD, "rod", center=(0.0, 0.0), friction=1.0))
    system, state = scene.build()
    method = jc.Method(contact_solver=solver)
    state = jc.init(system, method, state.q, state.v)

    def once(angle, friction, side):
        changed = system.with_params({"tip": {"friction": friction}})
        turn = jnp.where(side > 0, -angle, angle - jnp.pi)
        q = jnp.stack([-side * jnp.cos(angle), jnp.sin(angle), turn])
        start = dataclasses.replace(state, q=q, v=side * state.v)
        new, info = jc.step(changed, method, start, None, 1e-3)
        gain = jc.energy(changed, new).total - jc.energy(changed, start).total
        slip = new.v[0] + jnp.sin(angle) * new.v[2]
        force = info.reactions["tip"] * jnp.stack([jnp.ones(()), side])
        return force, info.reactions.residual, gain, side * slip

    angles, frictions = jnp.asarray([np.pi / 3, np.arctan(2.0)]), jnp.asarray([1.0, 1.5])
    cases = *(jnp.repeat(x, 2) for x in (angles, frictions)), jnp.asarray([1.0, -1.0] * 2)
    found = jax.jit(jax.vmap(once))(*cases)
    np.testing.assert_allclose(found[1], 0.0, atol=1e-12)
    for x in (found[0], *found[2:]):
        np.testing.assert_allclose(x[1::2], x[::2], rtol=1e-9, atol=1e-12)  # rounding of φ/h²
    forces, _, gain, slip = (x[::2] for x in found)
    np.testing.assert_allclose(forces[0, 0], G / case["p_at_theta_60deg_mu_1"], rtol=1e-9)
    assert float(slip[0]) > 1.9
    np.testing.assert_allclose(slip[1], 0.0, atol=1e-12)
    assert float(gain[1]) < -0.1
    assert np.all(gain < 0)
    assert 0.1 < np.abs(forces[1, 1]) < 1.5 * forces[1, 0]
