"""Dormand–Prince methods: order conditions, measured orders, stability polynomials."""

import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc

METHODS = {"Dopri5": (jc.integrators.Dopri5, 5, 6), "Dopri8": (jc.integrators.Dopri8, 8, 12)}
"""The integrator, its order, and its number of stages."""


@functools.cache
def trees(order):
    """Returns rooted trees of `order` nodes, each the sorted tuple of its root's subtrees."""
    return {tuple(sorted(forest)) for forest in forests(order - 1)}


def forests(nodes, largest=None):
    """Yields the multisets of trees with `nodes` nodes in total."""
    if nodes == 0:
        yield ()
    for order in range(min(nodes, largest or nodes), 0, -1):
        for count in range(1, nodes // order + 1):
            for same in itertools.combinations_with_replacement(sorted(trees(order)), count):
                rest = nodes - count * order
                if rest == 0 or order > 1:
                    yield from ((*same, *others) for others in forests(rest, order - 1))


def size(tree):
    return 1 + sum(map(size, tree))


def density(tree):
    return size(tree) * math.prod(map(density, tree))


def weights(tree, a):
    """Returns the elementary weight of a tree, for each stage."""
    return math.prod((a @ weights(branch, a) for branch in tree), start=np.ones(len(a)))


def tableau(method):
    a = np.zeros((len(method.b), len(method.b)))
    for i, row in enumerate(method.a, 1):
        a[i, :i] = row
    return a, np.asarray(method.b)


def test_rooted_trees_are_counted_right():
    assert [len(trees(n)) for n in range(1, 9)] == [1, 1, 2, 4, 9, 20, 48, 115]


@pytest.mark.parametrize("name", METHODS)
def test_conditions_hold_up_to_the_order_and_not_beyond(name):
    build, order, stages = METHODS[name]
    a, b = tableau(build())
    assert len(b) == stages

    def unmet(n):
        return max(abs(b @ weights(t, a) - 1 / density(t)) for t in trees(n))

    assert max(map(unmet, range(1, order + 1))) < 1e-13
    assert unmet(order + 1) > 1e-6


@pytest.mark.parametrize("name", METHODS)
def test_the_stability_polynomial_is_the_exponential_up_to_the_order(name):
    build, order, stages = METHODS[name]
    powers = build().amplify(np.poly1d([1.0, 0.0])).coeffs[::-1]
    exponential = [1 / math.factorial(k) for k in range(order + 1)]
    np.testing.assert_allclose(powers[: order + 1], exponential, rtol=0, atol=1e-13)
    assert len(powers) == stages + 1


def one(q, p):
    return jnp.ones_like(q)


@pytest.mark.parametrize("name", METHODS)
def test_a_step_of_an_oscillator_is_the_stability_polynomial(name):
    integrator = METHODS[name][0]()
    oscillator = jc.GeneralizedSystem(mass=one, force=lambda q, v, t, u, p: -q)
    method = jc.Method(integrator)
    state = jc.init(oscillator, method, jnp.asarray([1.0]), jnp.asarray([0.0]))
    new, _ = jc.step(oscillator, method, state, None, 0.5)
    expected = integrator.amplify(0.5j)
    np.testing.assert_allclose([new.q[0], -new.v[0]], [expected.real, expected.imag], IDENTITY)


def swing(q, v, t, u, p):
    return -4 * jnp.sin(q) + jnp.cos(t)


@pytest.mark.parametrize(("name", "counts"), [("Dopri5", (40, 80)), ("Dopri8", (12, 16))])
def test_order_on_a_forced_pendulum(name, counts):
    """The error at time 2 decreases with h at the expected order; the reference has small steps."""
    build, order, _ = METHODS[name]
    system = jc.GeneralizedSystem(mass=one, force=swing)

    def end(integrator, steps):
        method = jc.Method(integrator)
        state = jc.init(system, method, jnp.asarray([1.0]), jnp.asarray([0.0]))
        run = jax.jit(lambda s: jc.rollout(system, method, s, None, 2 / steps, steps)[0])
        final = run(state)
        return np.array([final.q[0], final.v[0]])

    exact = end(jc.integrators.Dopri8(), 200)
    np.testing.assert_allclose(end(jc.RK4(), 4000), exact, rtol=0, atol=1e-11)
    errors = [np.linalg.norm(end(build(), n) - exact) for n in counts]
    slope = np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0])
    assert slope == pytest.approx(order, abs=0.15)
