"""The systems and states that the scene builder returns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import IDENTITY

import jaxcon as jc

both = pytest.mark.parametrize("dim", [2, 3])


def rigid(dim):
    return {"mass": 1.0, "inertia": 0.8 if dim == 2 else (0.8, 1.1, 1.5)}


def test_gravity_points_down_the_last_axis_unless_given():
    for dim, expected in ((2, (0, -9.81)), (3, (0, 0, -9.81))):
        scene = jc.Scene(dim=dim)
        scene.add_particle("a", mass=1.0)
        np.testing.assert_array_equal(scene.build()[0].params["gravity"], expected)
    scene = jc.Scene(dim=2, gravity=(1, 2))
    scene.add_particle("a", mass=1.0)
    np.testing.assert_array_equal(scene.build()[0].gravity, (1, 2))


def test_a_quaternion_is_brought_to_unit_length():
    scene = jc.Scene()
    scene.add_body("a", **rigid(3), quaternion=(0, 3, 0, 4))
    system, state = scene.build()
    np.testing.assert_allclose(jc.orientation(system, state, "a"), (0, 0.6, 0, 0.8))


@both
def test_positions_are_read_in_the_frame_in_which_they_were_given(dim):
    """The simulated frame of "second" is at its center of mass, not where the user gave it."""
    scene = jc.Scene(dim=dim)
    place, speed = np.arange(1.0, dim + 1), np.arange(2.0, dim + 2)
    spin = 0.7 if dim == 2 else np.array([0.7, -0.2, 0.4])
    solid = jc.inertia.Inertia(2.0, 0.7, center=(0.2, -0.1))
    turn = {"angle": 0.5}
    if dim == 3:
        tensor = jnp.asarray([[1.0, 0.1, 0.2], [0.1, 1.2, 0.0], [0.2, 0.0, 1.1]])
        solid = jc.inertia.from_tensor(2.0, tensor, center=(0.2, -0.1, 0.3))
        turn = {"quaternion": (0.8, 0.0, 0.6, 0.0)}
    scene.add_body(
        "a", inertia=solid, position=place, velocity=speed, angular_velocity=spin, **turn
    )
    system, state = scene.build()
    np.testing.assert_allclose(jc.position(system, state, "a"), place, atol=IDENTITY)
    np.testing.assert_allclose(jc.velocity(system, state, "a"), speed, atol=IDENTITY)
    np.testing.assert_allclose(jc.angular_velocity(system, state, "a"), spin, atol=IDENTITY)
    expected = 0.5 if dim == 2 else (0.8, 0.0, 0.6, 0.0)
    np.testing.assert_allclose(jc.orientation(system, state, "a"), expected, atol=IDENTITY)
    center = jc.position(system, state, "a", point=solid.center)
    np.testing.assert_allclose(state.q[:dim], center, atol=IDENTITY)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["coincident", "distance", "revolute", "prismatic", "fixed"])
@pytest.mark.parametrize("wall", ["first", "second"])
def test_joints_to_a_fixed_body_hold_at_assembly(dim, kind, wall):
    """A fixed body belongs to the world, wherever it is."""
    scene = jc.Scene(dim=dim)
    turn = {"angle": 0.4} if dim == 2 else {"quaternion": (0.5, 0.5, 0.5, -0.5)}
    for name in ("first", "second"):
        fixed = {"fixed": True} if name == wall else rigid(dim)
        scene.add_body(name, position=np.arange(1.0, dim + 1), **turn, **fixed)
    point, axis = np.full(dim, 0.7), np.arange(2.0, dim + 2)
    for element in scenes.JOINTS[kind].make(
        scenes.Site("first", "second", dim, point, axis, point + axis)
    ):
        scene.add(element)
    system, state = scene.build()
    assert jc.violation(system, state).worst < IDENTITY


@both
def test_a_hinge_on_a_fixed_body_is_a_hinge_on_the_world(dim):
    """The motion is the same, whether the user names the world or the fixed body."""
    point, finals = np.full(dim, 0.7), []
    axis = None if dim == 2 else (0.0, 1.0, 1.0)
    for base in (jc.WORLD, "wall"):
        scene = jc.Scene(dim=dim)
        turn = {"angle": 0.4} if dim == 2 else {"quaternion": (0.5, 0.5, 0.5, -0.5)}
        scene.add_body("wall", fixed=True, position=(1.0,) * dim, **turn)
        scene.add_body("door", **rigid(dim))
        scene.add(jc.Revolute("hinge", base, "door", point=point, axis=axis))
        system, state = scene.build()
        finals.append(jc.step(system, jc.Method(), state, None, 0.01)[0].v)
    np.testing.assert_allclose(finals[0], finals[1], atol=IDENTITY)


def test_a_spring_to_a_fixed_body_acts_at_the_point_given():
    scene = jc.Scene(dim=2, gravity=(0, 0))
    scene.add_body("wall", fixed=True, position=(1.0, 1.0), angle=0.4)
    scene.add_particle("bob", mass=1.0)
    scene.add(jc.Spring("s", "wall", "bob", 3.0, rest_length=0.0, point_a=(2.0, 0.0)))
    system, state = scene.build()
    np.testing.assert_allclose(system.force(state.q, state.v, state.time), (6.0, 0.0), atol=1e-12)


def test_equal_joints_are_gathered():
    scene = jc.Scene(dim=2)
    for i in range(4):
        scene.add_particle(f"p{i}", mass=1.0, position=(i + 1.0, 0.0))
        a = jc.WORLD if i == 0 else f"p{i - 1}"
        scene.add(jc.Distance(f"d{i}", a, f"p{i}"))
    system, state = scene.build()
    assert len(system.constraints) == 2
    assert system.params["d2"]["length"] == 1
    assert jc.report(system, state).rank == 4


def test_a_scene_is_built_under_jit_vmap_and_grad():
    def height(length):
        scene = jc.Scene(dim=2)
        scene.add_body("a", mass=1.0, inertia=length**2 / 12, position=jnp.stack([length / 2, 0.0]))
        scene.add(jc.Revolute("hinge", jc.WORLD, "a", point=(0.0, 0.0)))
        system, state = scene.build()
        solution = jc.forward_dynamics(system, state, None, jc.Method(), 1e-3)
        return solution.acceleration[2]

    # a rod released level has the acceleration −3g/2l
    lengths = jnp.asarray([1.0, 2.0])
    np.testing.assert_allclose(jax.jit(jax.vmap(height))(lengths), -1.5 * 9.81 / lengths)
    np.testing.assert_allclose(jax.grad(height)(2.0), 1.5 * 9.81 / 4, rtol=1e-10)


def test_a_scene_in_space_is_built_under_jit():
    """Some numbers are known and some are traced."""
    known = jnp.asarray([1.0, 1.0, 1.0])

    def start(mass, moment):
        scene = jc.Scene()
        scene.add_body("a", mass=mass, inertia=(moment, 1.0, 1.0), position=(1.0, 2.0, 3.0))
        scene.add_body("b", mass=1.0, inertia=known)
        scene.add(jc.Revolute("hinge", "a", "b", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0)))
        system, state = scene.build()
        return state.q, system.params["a"]

    q, params = jax.jit(start)(2.0, 1.5)
    np.testing.assert_array_equal(q[:6], (1, 0, 2, 0, 3, 0))
    assert params["mass"] == 2.0
    np.testing.assert_array_equal(params["inertia"], (1.5, 1.0, 1.0))


def test_only_a_body_with_an_angle_may_be_allowed_turns():
    scene = jc.Scene(dim=2)
    scene.add_body("spiral", mass=1.0, inertia=1.0, angle=10.0)
    scene.add_particle("bead", mass=1.0)
    for name in ("spirel", "bead"):
        with pytest.raises(ValueError, match=rf"got '{name}'; known are \['spiral'\]"):
            scene.allow_turns(name)
    scene.allow_turns("spiral")
    scene.build()  # without a warning
    scene = jc.Scene(dim=3)
    scene.add_body("spiral", **rigid(3))
    with pytest.raises(ValueError, match="bodies in space .* got 'spiral'"):
        scene.allow_turns("spiral")


def test_mixed_dimensions_of_rank_are_not_needed():
    """Integers, lists, tuples and NumPy arrays are accepted as numbers."""
    scene = jc.Scene(dim=3, gravity=[0, 0, -10], dtype=jnp.float32)
    scene.add_body("a", mass=1, inertia=[1, 1, 1], position=np.ones(3), quaternion=[1, 0, 0, 0])
    scene.add_particle("b", mass=np.float64(2), position=[0, 0, 1])
    scene.add(jc.Distance("d", "a", "b", length=np.float64(1.5), point_a=[1, 1, 1]))
    scene.add(jc.Revolute("h", jc.WORLD, "a", point=[0, 0, 0], axis=np.array([0, 1, 0])))
    scene.add(jc.Spring("s", "a", "b", 3, 1, 0))
    system, state = scene.build()
    for leaf in jax.tree.leaves((system, state.q, state.v, state.time)):
        assert leaf.dtype == jnp.float32
