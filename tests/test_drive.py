"""Prescribed motion: the coordinate, its explicit time terms, and the drive torque."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc
from jaxcon.constraints.rows import linearize


def wave(t, p):
    return p["size"] * jnp.sin(p["rate"] * t)


def turning(t, p):
    return p["speed"] * t


def wheel(dim, motion, params, **body):
    """A driven wheel on an axis through its center."""
    scene = jc.Scene(dim=dim, gravity=(0.0,) * dim)
    scene.add_body("wheel", mass=1.0, inertia=0.7 if dim == 2 else (0.4, 0.5, 0.7), **body)
    axis = None if dim == 2 else (0, 0, 2)
    scene.add(jc.Revolute("hub", jc.WORLD, "wheel", point=(0,) * dim, axis=axis))
    scene.add(jc.joints.Drive("drive", "hub", motion, params=params))
    return scene.build()


def drive_row(system, state, t=0.0):
    rows = linearize(system, state.q, state.v, jnp.asarray(t))
    (i,) = rows.layout.rows("drive")
    return [float(x[i]) for x in (rows.residual, rows.rate, rows.bias)]


both = pytest.mark.parametrize("dim", [2, 3])
WAVE = {"size": 0.4, "rate": 3.0}


@both
def test_explicit_time_terms(dim):
    """About a fixed axis, φ = θ − θ*, φ̇ = θ̇ − θ̇*, and γ = −θ̈*."""
    spin = 1.1 if dim == 2 else (0.0, 0.0, 1.1)
    system, state = wheel(dim, wave, WAVE, angular_velocity=spin)
    t = 0.3
    expected = [
        -0.4 * np.sin(0.9),
        1.1 - 1.2 * np.cos(0.9),
        3.6 * np.sin(0.9),
    ]
    np.testing.assert_allclose(drive_row(system, state, t), expected, rtol=IDENTITY)


@both
@pytest.mark.parametrize("angle", [0.5, -2.0, 3.0])
def test_the_coordinate_is_the_angle_since_assembly(dim, angle):
    system, state = wheel(dim, wave, WAVE)
    step = jnp.zeros_like(state.v).at[-1].set(angle)
    turned = system.retract(state.q, step)
    rows = linearize(system, turned, state.v, state.time)
    np.testing.assert_allclose(rows.residual[rows.layout.rows("drive")], [angle], rtol=IDENTITY)


@both
def test_torque_is_the_inertia_times_the_acceleration(dim):
    """The multiplier is λ = I θ̈*."""
    system, state = wheel(dim, wave, WAVE)
    state = jax.tree.map(lambda x: x, state)
    method = jc.Method(stabilizer=jc.stabilizers.Unstabilized())
    at = jc.init(system, method, state.q, state.v, time=0.3)
    solution = jc.forward_dynamics(system, at, None, method, 1e-3)
    torque = jc.wrench(solution, "drive")[-1]
    np.testing.assert_allclose(torque, 0.7 * -3.6 * np.sin(0.9), rtol=1e-9)


@both
def test_a_crank_is_driven_round_and_round(dim):
    """The wheel makes two and a half turns and reaches the prescribed angle."""
    spin = 10.0 if dim == 2 else (0.0, 0.0, 10.0)
    system, state = wheel(dim, turning, {"speed": 10.0}, angular_velocity=spin)
    final, _ = jax.jit(
        lambda s: jc.rollout(system, jc.Method(), s, None, 2.5 * np.pi * 2 / 10 / 500, 500)
    )(state)
    assert final.status == jc.Status.OK
    if dim == 2:
        np.testing.assert_allclose(jc.orientation(system, final, "wheel"), 5 * np.pi, atol=1e-9)
    x = jc.position(system, final, "wheel", (1.0,) + (0.0,) * (dim - 1))
    np.testing.assert_allclose(x, (-1.0,) + (0.0,) * (dim - 1), atol=1e-9)


@both
def test_a_slider_is_driven_along_its_axis(dim):
    scene = jc.Scene(dim=dim, gravity=(0.0,) * dim)
    scene.add_body("slide", mass=2.0, inertia=0.7 if dim == 2 else (0.4, 0.5, 0.7))
    axis = (3.0, 4.0, 0.0)[:dim]
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=axis))
    scene.add(jc.joints.Drive("drive", "rail", wave, params=WAVE))
    system, state = scene.build()
    moved = system.retract(state.q, jnp.zeros_like(state.v).at[:2].set(jnp.asarray([0.6, 0.8])))
    rows = linearize(system, moved, state.v, jnp.asarray(0.3))
    expected = 1.0 - 0.4 * np.sin(0.9)
    np.testing.assert_allclose(rows.residual[rows.layout.rows("drive")], [expected])
    np.testing.assert_allclose(rows.bias[rows.layout.rows("drive")], [3.6 * np.sin(0.9)])


def test_the_motion_can_be_changed_and_differentiated():
    system, state = wheel(2, wave, WAVE)

    def error(size):
        other = system.with_params({"drive": {"params": {"size": size, "rate": jnp.asarray(3.0)}}})
        rows = linearize(other, state.q, state.v, jnp.asarray(0.3))
        return rows.residual[rows.layout.rows("drive")[0]]

    np.testing.assert_allclose(jax.grad(error)(jnp.asarray(0.4)), -np.sin(0.9))


def test_a_drive_whose_motion_is_not_a_number():
    with pytest.raises(ValueError, match="Drive 'drive'.*number.*shape \\(1,\\)"):
        wheel(2, lambda t, p: jnp.ones(1) * t, None)
