"""`repr` of scenes, systems, states, methods and infos, and slices of trajectories."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.scenes import four_bar


def scene():
    result = jc.Scene(dim=2, dtype=jnp.float32)
    for i in range(12):
        result.add_particle(f"bob{i}", mass=1.0, position=(i + 1.0, 0.0))
    result.add(jc.Distance("rod", jc.WORLD, "bob0"))
    result.add(jc.PlaneContact("floor", jc.WORLD, "bob1", point=(0.0, -1.0)))
    result.add(jc.Spring("spring", "bob1", "bob2", stiffness=1.0))
    return result


NAMES = "bob0, bob1, bob2, bob3, bob4, bob5 and 6 more"


def test_scenes_and_systems():
    expected = f"""Scene in the plane, float32
  bodies        {NAMES}
  Distance      rod
  PlaneContact  floor
  Spring        spring"""
    assert repr(scene()) == expected
    system, _ = scene().build()
    expected = f"""BodySystem
  q, v          24, 24 float32, in the plane
  bodies        {NAMES}
  Distance      rod
  PlaneContact  floor
  Spring        spring"""
    assert repr(system) == expected
    assert repr(jax.jit(lambda s: s)(system)) == expected


def test_states_methods_and_infos():
    system, state = four_bar()
    method = jc.Method(jc.RK4(), contact_solver=jc.solvers.GaussSeidel(20))
    assert (
        repr(method)
        == """Method
  integrator      RK4()
  stabilizer      Baumgarte()
  solver          RankSafe()
  contact_solver  GaussSeidel(sweeps=20)"""
    )
    assert (
        repr(state)
        == """State
  q       (9,) float64
  v       (9,) float64
  time    0 s
  status  OK"""
    )
    final, path = jc.rollout(system, jc.Method(), state, None, 1e-2, 10)
    assert "time    0.01 to 0.1 s" in repr(path)
    _, info = jc.step(system, jc.Method(), final, None, 1e-2)
    text = repr(info)
    assert "time          0.1 s" in text
    assert "of ground_crank" in text
    assert "violation     worst" in text
    _, infos = jc.rollout(system, jc.Method(), state, None, 1e-2, 10, record=lambda s, i: i)
    assert repr(infos[3]).splitlines()[1].split() == ["time", "0.03", "s"]


def test_summaries_while_tracing_and_of_trees_of_axes():
    system, state = four_bar()
    seen = []

    def traced(s, m):
        seen.append((repr(s), repr(m), repr(jc.step(system, m, s, None, 1e-3)[1]), repr(system)))
        return s

    jax.jit(traced)(state, jc.Method())
    assert "of shape" not in seen[0][0]
    assert "(9,) float64" in seen[0][0]
    assert repr(jax.tree.map(lambda x: 0, state)).startswith("State")
    assert repr(jax.eval_shape(lambda: state)).startswith("State")
    assert repr(jax.tree.map(lambda x: None, jc.Method())).startswith("Method")
    assert repr(jax.tree.map(lambda x: "x", state)).startswith("State")
    shapes = jax.eval_shape(lambda s: jc.step(system, jc.Method(), s, None, 1e-3)[1], state)
    assert "(9,) float64" in repr(shapes)
    assert repr(jax.tree.map(lambda x: 0, shapes)).startswith("StepInfo")


def spring(q, v, t, u, p):
    return -q


def test_generalized_coordinates():
    system = jc.GeneralizedSystem(mass=lambda q, p: jnp.eye(2), force=spring)
    assert (
        repr(system)
        == """GeneralizedCoordinates
  mass   <lambda>
  force  spring"""
    )


def test_a_trajectory_has_a_length_and_parts():
    system, state = four_bar()
    final, path = jc.rollout(system, jc.Method(), state, None, 1e-2, 10)
    assert len(path) == 10
    assert bool(final)
    np.testing.assert_array_equal(path[9].q, final.q)
    np.testing.assert_array_equal(path[-1].q, final.q)
    np.testing.assert_array_equal(path[::5].time, path.time[::5])
    assert [float(s.time) for s in path] == pytest.approx(np.arange(1, 11) / 100)
    for index in (10, -11, (10,), jnp.int32(10)):
        with pytest.raises(IndexError, match="is out of range: an axis has 10"):
            path[index]
    for index in ((0, 1), (..., 0), None):
        with pytest.raises(IndexError, match=r"along its leading axes alone, of shape \(10,\)"):
            path[index]
    for call in (len, lambda s: s[0], list):
        with pytest.raises(TypeError, match="a State of one world has no length"):
            call(final)
    batch = jax.vmap(lambda v: state.replace(v=v))(jnp.ones((4, 9)))
    assert (len(batch), batch[1].v.shape) == (4, (9,))
    with pytest.raises(TypeError, match="speed"):
        state.replace(speed=1.0)
