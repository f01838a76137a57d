import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc


@pytest.fixture(scope="module")
def built():
    scene = jc.Scene(dim=2)
    scene.add_body("a", mass=1, inertia=1, position=(1, 2), angle=3, velocity=(4, 5))
    scene.add_particle("p", mass=1, position=(6, 7), velocity=(8, 9))
    scene.add_body("b", mass=1, inertia=1, position=(10, 11), angle=6, angular_velocity=13)
    scene.add_body("wall", fixed=True, position=(1, 1))
    scene.add(jc.forces.ExternalWrench("pull", "p"))
    scene.add(jc.forces.ExternalWrench("push", "b"))
    return scene.build()


def test_coordinates_are_component_major_by_kind(built):
    system, state = built
    np.testing.assert_array_equal(state.q, [1, 10, 2, 11, 3, 6, 6, 7])
    np.testing.assert_array_equal(state.v, [4, 0, 5, 0, 0, 13, 8, 9])
    assert system.layout.n_q == system.layout.n_v == 8


def test_names_find_their_indices(built):
    layout = built[0].layout
    np.testing.assert_array_equal(layout.q("b"), [1, 3, 5])
    np.testing.assert_array_equal(layout.v("p"), [6, 7])
    assert layout.bodies == ("a", "b", "p")
    assert "wall" in layout.fixed


def test_control_channels_follow_each_other(built):
    layout = built[0].layout
    assert layout.n_u == 5
    assert layout.control("pull") == slice(0, 2)
    assert layout.control("push") == slice(2, 5)


def test_a_quaternion_has_more_coordinates_than_velocities():
    scene = jc.Scene()
    for name in ("a", "b"):
        scene.add_body(name, mass=1, inertia=(1, 1, 1), angular_velocity=(1, 2, 3))
    system, state = scene.build()
    assert (system.layout.n_q, system.layout.n_v) == (14, 12)
    np.testing.assert_array_equal(state.q[system.layout.q("b")], [0, 0, 0, 1, 0, 0, 0])
    np.testing.assert_array_equal(state.v[system.layout.v("b")], [0, 0, 0, 1, 2, 3])
    assert state.q.dtype == jnp.float64


@pytest.mark.parametrize(("name", "why"), [("wall", "is fixed"), ("nobody", "is unknown")])
def test_bodies_without_coordinates_are_not_found(built, name, why):
    with pytest.raises(ValueError, match=f"'{name}' {why}.*'a', 'b', 'p'"):
        built[0].layout.q(name)


def test_unknown_control_channel(built):
    with pytest.raises(ValueError, match="'pusher' has no control channel.*'pull', 'push'"):
        built[0].layout.control("pusher")
