"""Derivatives in many states, singular ones included: none is NaN or wrong."""

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
    """Restitution weighs works of 1e-20 J, whose inverse squares overflow in float32."""
    row = gradient_states.measure("ball on a plane", 3, "projection", "float32", 486, 0)
    assert row.broken == 0, row


def test_a_bounce_and_its_derivatives_are_the_same_at_every_speed():
    """A rod strikes with its end; in a few of many states the energy cap limits the restitution.

    Without gravity the outcome is proportional to the velocities. Works of 1e-22 J have squares
    that underflow in float32.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0), dtype=jnp.float32)
    scene.add_body("rod", mass=1.0, inertia=0.08, position=(0.0, 0.4))
    end = jc.PlaneContact("c", jc.WORLD, "rod", center=(0.35, 0.0), friction=0.9, restitution=0.8)
    scene.add(end)
    system, start = scene.build()
    start = jc.init(system, jc.Method(), start.q, start.v)
    ways = np.random.default_rng(0).normal(size=(300, 3))

    def after(v):
        state = dataclasses.replace(start, v=v)
        return jc.step(system, jc.Method(), state, None, jnp.float32(1e-3))[0].v

    def all_of(v):
        return [jax.vmap(f)(v) for f in (after, jax.jacfwd(after), jax.jacrev(after))]

    run = jax.jit(all_of)
    v, forward, reverse = map(np.asarray, run(jnp.asarray(ways, jnp.float32)))
    energy = np.array([0.5, 0.5, 0.04]) * ways**2
    kept = np.sum(np.array([0.5, 0.5, 0.04]) * v**2, axis=1) / np.sum(energy, axis=1)
    struck = np.abs(v - ways).max(axis=1) > 1e-3
    assert np.sum(struck & (np.abs(kept - 1) < 1e-5)) > 5  # limited by the energy cap
    for size in (1e-9, 1e-12, 1e-16):
        slow = map(np.asarray, run(jnp.asarray(ways * size, jnp.float32)))
        for got, own in zip(slow, (v * size, forward, reverse), strict=True):
            np.testing.assert_allclose(got, own, rtol=0, atol=2e-5 * np.max(np.abs(own)))


@pytest.mark.parametrize(
    "integrator", [jc.integrators.RATTLE(), jc.integrators.GeneralizedAlpha(0.9)], ids=repr
)
def test_steps_of_hardly_any_length_have_finite_tangents_in_single_precision(integrator):
    """The equations are divided by h or h², whose derivatives overflow in float32."""
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
    """Returns a finite force whose derivative is not finite where the gap is zero."""
    gap = b.position - a.position
    wrench = jnp.append(p["stiffness"] * gap * jnp.sqrt(jnp.sqrt(gap @ gap)), 0.0 * t)
    return wrench, -wrench


def test_what_is_not_finite_is_counted_where_it_occurs(monkeypatch):
    own = jc.forces.CustomForce("joint", ("a", "b"), drag, params={"stiffness": 2.0})
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
