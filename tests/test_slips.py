"""Steps split where sliding ends: stops, transitions to rolling, and derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.verification import references

FORMS = {case["id"]: case for case in references.load("contact_closed_forms")["cases"]}
EXACT = 1e-6
"""Tolerance of event-located stepping against closed forms."""
G, INERTIA, R = 9.81, 0.02, 0.1


def disc():
    """A disc of 1 kg on a floor; with radius zero it is a block that does not rotate."""
    scene = jc.Scene(dim=2)
    scene.add_body("disc", mass=1.0, inertia=INERTIA, position=(0.0, 0.0))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "disc", radius=R, friction=0.4))
    return scene.build()


def stops(v, friction):
    """Returns the stopping distance v²/(2 μ g)."""
    return v**2 / (2 * friction * G)


def slides_back(v, friction, slope=np.pi / 6):
    """Returns the position after sliding up a slope by v²/2a, and back.

    Upwards the speed falls at the rate a = g (sin α + μ cos α); downwards it grows at the rate
    b = g (sin α − μ cos α).
    """
    along, across = G * np.sin(slope), friction * G * np.cos(slope)
    up, down = along + across, along - across
    return v**2 / (2 * up) - down * (1 - v / up) ** 2 / 2


def rolls(v, friction):
    """Returns the position of a disc that slides until v − μ g t = r ω with ω = μ g r t/I."""
    ends = v / (friction * G * (1 + R**2 / INERTIA))
    return v - friction * G * (ends**2 / 2 + ends * (1 - ends))


def test_where_sliding_ends_is_exact_and_so_are_derivatives():
    """50 steps of RK4 in a second; without `slips` the derivatives are off by a thousandth."""
    system, state = disc()
    some = jc.solvers.GaussSeidel(8, warm=False)
    method = jc.Method(jc.RK4(), contact_solver=some, events=jc.integrators.Events(slips=True))

    def place(v, friction, slope, radius):
        gravity = -G * jnp.stack([jnp.sin(slope), jnp.cos(slope)])
        changes = {"friction": friction, "radius": radius}
        changed = system.with_params({"floor": changes, "gravity": gravity})
        q, v = state.q.at[1].set(radius), state.v.at[0].set(v)
        start = dataclasses.replace(state, q=q, v=v)
        final, impacts = jc.rollout(
            changed, method, start, None, 0.02, 50, record=lambda s, i: i.impacts.count
        )
        return final.q[0], jnp.sum(impacts)

    def both(v, friction, *others):
        move = lambda s: place(v + 0.6 * s, friction - 0.1 * s, *others)  # noqa: E731
        return jax.jvp(move, (0.0,), (1.0,), has_aux=True)

    v, friction = np.array([3.0, 2.0, 3.0]), np.array([0.4, 0.3, 0.4])
    others = jnp.asarray([0.0, np.pi / 6, 0.0]), jnp.asarray([0.0, 0.0, R])
    found, slopes, impacts = jax.jit(jax.vmap(both))(v, friction, *others)
    np.testing.assert_array_equal(impacts, 0)
    for i, form in enumerate((stops, slides_back, rolls)):
        ends = [form(v[i] + 0.6 * s, friction[i] - 0.1 * s) for s in (1e-6, -1e-6)]
        np.testing.assert_allclose(found[i], form(v[i], friction[i]), atol=EXACT)
        np.testing.assert_allclose(slopes[i], (ends[0] - ends[1]) / 2e-6, rtol=EXACT)
    case = FORMS["sliding_stop_gradient"]
    np.testing.assert_allclose(found[0], case["stop_distance"], atol=EXACT)
    np.testing.assert_allclose(slopes[0], 0.6 * case["d_dv0"] - 0.1 * case["d_dmu"], atol=EXACT)


def test_the_choice_is_true_or_false():
    system, state = disc()
    with pytest.raises(ValueError, match="slips must be True or False, got 'yes'"):
        jc.step(system, jc.Method(events=jc.integrators.Events(slips="yes")), state, None, 1e-3)
