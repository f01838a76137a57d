"""Derivatives in many states, singular ones among them: none is NaN, and none is wrong."""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

import jaxcon as jc  # noqa: E402
from benchmarks import gradient_scenes, gradient_states  # noqa: E402

CHOICES = [
    ("distance", 2, "projection", "float64"),
    ("spring", 3, "Baumgarte", "float32"),
]


@pytest.mark.parametrize("choice", CHOICES, ids=str)
def test_a_thousand_states_have_finite_derivatives_of_both_modes(choice):
    row = gradient_states.measure(*choice, 1000, 4)
    assert row.broken == 0, row
    assert row.beyond == 0, row
    assert row.off == 0, row
    assert (row.compared > row.undecided) == (choice[-1] == "float64"), row


def test_a_ball_that_hardly_leaves_its_plane_has_finite_derivatives():
    """Restitution weighs works of 1e-20 J there, and one over their squares is beyond float32."""
    row = gradient_states.measure("ball on a plane", 3, "projection", "float32", 486, 0)
    assert row.broken == 0, row


@pytest.mark.parametrize("integrator", [jc.RATTLE(), jc.GeneralizedAlpha(0.9)], ids=repr)
def test_steps_of_hardly_any_length_have_finite_tangents_in_single_precision(integrator):
    """Their equations are divided by h or h², whose derivatives are beyond float32."""
    scene = jc.Scene(dim=2, dtype=jnp.float32)
    scene.add_particle("bob", mass=2.0, position=(1.0, 0.0), velocity=(0.0, 0.5))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, start = scene.build()
    method, dt = jc.Method(integrator), jnp.float32(1e-13)
    start = jc.init(system, method, start.q, start.v)

    def speed(share):
        state = dataclasses.replace(start, v=share * start.v)
        return jc.step(system, method, state, None, dt)[0].v[1]

    slope = jax.jit(jax.jacfwd(speed))(jnp.float32(1.0))
    np.testing.assert_allclose(slope, 0.5, rtol=1e-5)


def drag(a, b, t, u, p):
    """A force of finite size, whose derivative is not where the gap has no length."""
    gap = b.position - a.position
    wrench = jnp.append(p["stiffness"] * gap * jnp.sqrt(jnp.sqrt(gap @ gap)), 0.0 * t)
    return wrench, -wrench


def test_what_is_not_finite_is_counted_where_it_occurs(monkeypatch):
    own = jc.CustomForce("joint", ("a", "b"), drag, params={"stiffness": 2.0})
    monkeypatch.setitem(gradient_scenes.ELEMENTS, "spring", ((2,), lambda n: [own]))
    row = gradient_states.measure("spring", 2, "Baumgarte", "float64", 300, 0)
    met = {kind: count for kind, count in row.reverse.items() if count}
    assert set(met) == {"in one place, at rest", "in one place, moving"}
    assert row.broken == sum(row.forward.values()) + sum(met.values()) > 0


def test_states_are_at_the_spots_that_they_are_named_after():
    subject = gradient_states.subject_of("spring", 2)
    states = gradient_states.drawn(subject, 200)
    kinds = np.array(list(gradient_states.KINDS))[states.kinds]
    rest = kinds == "at rest"
    assert np.all(states.v[rest] == 0)
    assert np.all(states.q[rest] == np.asarray(subject.state.q))
    one = np.char.startswith(kinds, "in one place")
    layout = subject.system.layout
    first, second = (states.q[one][:, layout.q(name)[:2]] for name in ("a", "b"))
    np.testing.assert_array_equal(first, second)
