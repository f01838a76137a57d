import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Motion, Pose


def random_motion(dim):
    random = np.random.default_rng(dim)
    turn = random.normal(size=() if dim == 2 else 4)
    turn = turn if dim == 2 else turn / np.linalg.norm(turn)
    spin = random.normal(size=() if dim == 2 else 3)
    parts = (random.normal(size=dim), turn, random.normal(size=dim), spin)
    return Motion(*(jnp.asarray(x) for x in parts))


def moved(motion, h):
    """Returns the pose a short time h later, at constant velocities."""
    if motion.position.shape == (2,):
        turned = motion.orientation + h * motion.angular_velocity
    else:
        step = quaternion.exp(h * motion.angular_velocity)
        turned = quaternion.multiply(motion.orientation, step)
    return Pose(motion.position + h * motion.velocity, turned)


def close(a, b, tolerance=IDENTITY):
    np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


both = pytest.mark.parametrize("dim", [2, 3])


@both
def test_rotation_is_orthogonal_and_right_handed(dim):
    r = random_motion(dim).rotation
    close(r @ r.T, np.eye(dim))
    assert np.linalg.det(r) > 0


def test_positive_angles_turn_counterclockwise():
    pose = Pose(jnp.asarray([1.0, 2.0]), jnp.asarray(np.pi / 2))
    close(pose.point(jnp.asarray([1.0, 0.0])), [1, 3])


@both
def test_local_undoes_world(dim):
    pose, x = random_motion(dim).pose, jnp.arange(1.0, dim + 1)
    close(pose.local_point(pose.point(x)), x)
    close(pose.local_direction(pose.direction(x)), x)


@both
@pytest.mark.parametrize("call", ["point", "direction", "local_point", "local_direction"])
def test_jit_is_eager(dim, call):
    pose, x = random_motion(dim).pose, jnp.arange(1.0, dim + 1)
    close(jax.jit(lambda pose, x: getattr(pose, call)(x))(pose, x), getattr(pose, call)(x))


@both
def test_particles_do_not_turn(dim):
    pose = Pose(jnp.arange(1.0, dim + 1))
    close(pose.rotation, np.eye(dim))
    close(pose.point(jnp.ones(dim)), np.arange(2.0, dim + 2))


@both
def test_float32_stays_float32(dim):
    pose = jax.tree.map(lambda x: x.astype(jnp.float32), random_motion(dim))
    assert pose.rotation.dtype == jnp.float32
    assert pose.point_velocity(jnp.ones(dim, jnp.float32)).dtype == jnp.float32


@both
def test_velocity_of_a_point_is_its_rate(dim):
    motion, x, h = random_motion(dim), jnp.arange(1.0, dim + 1), 1e-5
    slope = (moved(motion, h).point(x) - moved(motion, -h).point(x)) / (2 * h)
    close(motion.point_velocity(x), slope, 1e-8)


@both
def test_a_frame_fixed_in_a_body_moves_with_it(dim):
    motion, other, h = random_motion(dim), random_motion(dim), 1e-5
    offset = other.pose
    if dim == 2:
        offset = dataclasses.replace(offset, orientation=jnp.zeros(()))
    seen = motion.seen_from(offset)
    close(seen.position, motion.point(offset.position))
    close(seen.rotation, motion.rotation @ offset.rotation)
    x = jnp.arange(1.0, dim + 1)
    ahead, behind = (moved(motion, s).point(offset.point(x)) for s in (h, -h))
    close(seen.point_velocity(x), (ahead - behind) / (2 * h), 1e-8)


@both
def test_no_offset_is_the_same_frame(dim):
    motion = random_motion(dim)
    assert motion.seen_from(None) is motion
