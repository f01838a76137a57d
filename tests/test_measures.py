"""Coordinates of joints without rows: angles of rotation, thrusters and tendons.

Their rates and biases are compared with automatic differentiation of their values and rates.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DERIVATIVE

import jaxcon as jc
from jaxcon.constraints.base import blocks_of
from jaxcon.linear.jacobian import Jacobian
from jaxcon.system import coordinates

DT = 1e-3


def bodies(dtype=None, **gravity):
    """Three bodies in space without joints."""
    scene = jc.Scene(dim=3, dtype=dtype, **gravity)
    for i, name in enumerate("abc"):
        turn = jc.quaternion.exp(jnp.array([0.3, -0.2 * i, 0.1], scene.dtype))
        scene.add_body(
            name,
            mass=1.0 + i,
            inertia=(0.3, 0.4, 0.5 + 0.1 * i),
            position=(0.4 * i, 0.1, -0.2),
            quaternion=turn,
        )
    return scene


ELEMENTS = {
    "angle": [jc.joints.RotationAngle("x", "a", "b")],
    "angle in the world": [jc.joints.RotationAngle("x", jc.WORLD, "b")],
    "thrust": [jc.joints.Thrust("x", "a", "b", (0.2, 0.3, 0), (1, 2, 0), (0.3, 0, 1))],
    "thrust in the world": [jc.joints.Thrust("x", jc.WORLD, "b", (0.2, 0.3, 0), (1, 2, 0))],
}


def row(system, q, v, joint="x"):
    """Returns value, rate, bias and Jacobian (n_v,) of the only coordinate of a joint."""
    snapshot = system.snapshot(q, v, 0.0)
    where = coordinates.directory(system.constraints)
    end = coordinates.find(system.constraints, where, "test", joint, None)
    found = coordinates.at(coordinates.numbered(system.counted), [end]).read(snapshot)
    places = system.constraints[end[0]].select((end[1],)).places
    jacobian = Jacobian(tuple(blocks_of(system, places, [found], 0)), (1, v.shape[0]))
    return found.value[0], found.rate[0], jnp.broadcast_to(found.bias, (1,))[0], jacobian.dense()[0]


@pytest.mark.parametrize("name", ELEMENTS)
def test_rates_and_biases_are_derivatives(name):
    scene = bodies()
    for element in ELEMENTS[name]:
        scene.add(element)
    system, state = scene.build()

    def compare(key):
        """Returns pairs of numbers that must be equal, at a random state."""
        keys = jax.random.split(key)
        q = system.retract(state.q, jax.random.uniform(keys[0], state.v.shape, minval=-0.7))
        v = jax.random.normal(keys[1], state.v.shape)
        slopes = system.kinematics(q, v), jnp.zeros_like(v)
        found, change = jax.jvp(lambda *x: row(system, *x)[:2], (q, v), slopes)
        value, rate, bias, jacobian = row(system, q, v)
        along = rate if "thrust" in name else change[0]  # the value of a thrust is zero
        return (rate, bias, jacobian @ v), (along, change[1], found[1])

    keys = jax.random.split(jax.random.key(0), 100)
    got, expected = jax.jit(jax.vmap(compare))(keys)
    for x, y in zip(got, expected, strict=True):
        np.testing.assert_allclose(x, y, atol=DERIVATIVE)


def test_a_rotation_angle_and_its_force_at_assembly_are_zero():
    scene = bodies()
    scene.add(jc.joints.RotationAngle("x", "a", "b"))
    system, state = scene.build()
    v = jnp.ones_like(state.v)
    slopes = jax.jacrev(lambda q: row(system, q, v)[:3])(state.q)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slopes))
    np.testing.assert_array_equal(row(system, state.q, v)[3], 0)


def test_a_ball_joint_stops_at_its_largest_angle():
    """A pendulum on a ball joint falls and stops at 0.5 rad, in float32 and in batches."""
    scene = jc.Scene(dim=3, dtype=jnp.float32)
    scene.add_body("rod", mass=1.0, inertia=(0.1, 0.1, 0.01), position=(0.3, 0.2, 0.5))
    scene.add(jc.Spherical("ball", jc.WORLD, "rod", point=(0, 0, 0)))
    scene.add(jc.joints.RotationAngle("turn", jc.WORLD, "rod", (0, 0, 0)))
    scene.add(jc.Limit("cone", "turn", upper=0.5))
    system, state = scene.build()

    def fall(speed):
        start = state.replace(v=state.v.at[5].set(speed))
        end, _ = jc.rollout(system, jc.Method(), start, None, 5e-3, 200)
        return jc.coordinate(system, end, "turn"), end.status

    angles, status = jax.jit(jax.vmap(fall))(jnp.array([0.0, 1.0, -1.0], jnp.float32))
    assert not np.any(status)
    np.testing.assert_allclose(angles, 0.5, atol=1e-4)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_thruster_accelerates_a_body(dtype):
    """The force acts along the body's axis; its gradient by the control is the acceleration."""
    scene = bodies(dtype, gravity=(0, 0, 0))
    scene.add(jc.joints.Thrust("jet", jc.WORLD, "a", force=(0, 0, 2), torque=(0, 0.5, 0)))
    scene.add(jc.Motor("engine", "jet", gear=3.0))
    system, state = scene.build()

    def lifted(u):
        info = jc.forward_dynamics(system, state, u[None], jc.Method(), DT)
        return info.acceleration[system.layout.v("a")][:3]

    u = jnp.asarray(0.7, dtype)
    np.testing.assert_allclose(jax.jit(lifted)(u), [0, 0, 6 * u], atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(lifted))(u), [0, 0, 6], atol=1e-6)
