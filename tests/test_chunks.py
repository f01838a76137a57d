"""Large batches are simulated in chunks of worlds, with the same values and derivatives."""

import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE, IDENTITY

import jaxcon as jc
from benchmarks import large_batches
from jaxcon.execution import rollout
from jaxcon.staging import chunks
from jaxcon.staging.operations import inside

MOST = 4
STEPS = 5
SHARED = jnp.asarray([0.7, -0.4])


def motion(x, shared, most=MOST):
    """A motion of one world: its end, and two numbers of each step. Nothing of it is linear."""

    def run():
        def step(state, i):
            state = jnp.sin(shared[0] * state + x) + shared[1] * i
            return state, jnp.stack([state, state * shared[1]])

        return jax.lax.scan(step, x, jnp.arange(STEPS) / STEPS)

    return chunks.by_world(run, most, (x, shared)) if most else run()


def loss(x, shared, most=MOST):
    end, path = motion(x, shared, most)
    return end**2 + jnp.sum(path**3) + shared[0] * end


def total(x, shared, most=MOST):
    return jnp.sum(jax.vmap(partial(loss, most=most), (0, None))(x, shared))


def worlds(x, shared, most):
    return jax.vmap(lambda x: motion(x, shared, most)[0])(x)


def stopped(x, shared, most):
    """Loops on a result that has no tangent; this has a derivative in reverse mode."""

    def run():
        end, _ = motion(x, shared, 0)
        return end, jax.lax.stop_gradient(end)

    end, still = chunks.by_world(run, most, (x, shared)) if most else run()
    return end * jax.lax.while_loop(lambda y: y < 1.0, lambda y: y + 0.3, still)


def several(x, shared, most):
    """A batch of batches: the first has its own shared values, the second its own worlds."""
    return jax.vmap(lambda a: jax.vmap(lambda b: motion(b, a, most))(x))(
        jnp.stack([shared, -shared, 2 * shared])
    )


def population(x, shared, most):
    all_shared = jnp.outer(jnp.linspace(0.5, 1, 3), shared)
    return jnp.sum(jax.vmap(lambda a: total(x, a, most))(all_shared) ** 2)


TRANSFORMED = {
    "vmap": lambda x, a, most: jax.vmap(lambda x: motion(x, a, most))(x),
    "vmap, last axis": lambda x, a, most: jax.vmap(
        lambda x: jax.vmap(lambda x: motion(x, a, most), in_axes=-1, out_axes=-1)(x)
    )(jnp.stack([x, 2 * x])),
    "vmap(vmap)": several,
    "vmap(grad)": lambda x, a, most: jax.vmap(
        jax.grad(partial(loss, most=most), (0, 1)), (0, None)
    )(x, a),
    "vmap(grad) by shared values alone": lambda x, a, most: jax.vmap(
        jax.grad(partial(loss, most=most)), (None, 0)
    )(x[0], jnp.outer(x, a)),
    "grad(vmap)": lambda x, a, most: jax.grad(partial(total, most=most), (0, 1))(x, a),
    "grad(vmap(vmap))": lambda x, a, most: jax.grad(partial(population, most=most), (0, 1))(x, a),
    "vmap(grad(vmap))": lambda x, a, most: jax.vmap(
        jax.grad(partial(total, most=most), (0, 1)), (None, 0)
    )(x, jnp.stack([a, 2 * a, -a])),
    "jvp": lambda x, a, most: jax.jvp(partial(total, most=most), (x, a), (x + 1, a - 1)),
    "linearize": lambda x, a, most: jax.linearize(partial(total, most=most), x, a)[1](x + 1, a - 1),
    "vmap(jvp)": lambda x, a, most: jax.vmap(
        lambda t: jax.jvp(partial(total, most=most), (x, a), (t * x, t * a))
    )(jnp.arange(3.0)),
    "hessian": lambda x, a, most: jax.hessian(partial(total, most=most), (0, 1))(x, a),
    "grad(grad)": lambda x, a, most: jax.jacrev(jax.jacrev(partial(total, most=most), 1), (0, 1))(
        x, a
    ),
    "grad(jvp)": lambda x, a, most: jax.grad(
        lambda a: jax.jvp(partial(total, most=most), (x, a), (x + 1, a - 1))[1]
    )(a),
    "jvp(grad)": lambda x, a, most: jax.jvp(
        jax.grad(partial(total, most=most), (0, 1)), (x, a), (x + 1, a - 1)
    ),
    "grad by a cotangent": lambda x, a, most: jax.grad(
        lambda c: jnp.sum(jax.vjp(partial(worlds, most=most), x, a)[1](c)[1] ** 2)
    )(x**2),
    "transpose of a vjp": lambda x, a, most: jax.linear_transpose(
        lambda c: jax.vjp(partial(worlds, most=most), x, a)[1](c)[1], x
    )(a),
    "no tangent": lambda x, a, most: jax.grad(
        lambda a: jnp.sum(jax.vmap(lambda x: stopped(x, a, most))(x))
    )(a),
    "checkpoint": lambda x, a, most: jax.grad(jax.checkpoint(partial(total, most=most)), (0, 1))(
        x, a
    ),
    "scan": lambda x, a, most: jax.grad(
        lambda a: jnp.sum(
            jax.lax.scan(
                lambda x, _: (jax.vmap(partial(loss, most=most), (0, None))(x, a), None),
                x,
                length=2,
            )[0]
        )
    )(a),
    "scan, mapped": lambda x, a, most: jax.vmap(
        lambda a: jax.lax.scan(lambda s, _: (loss(s, a, most), s), x[0], length=3)
    )(jnp.outer(x, a)),
    "cond": lambda x, a, most: jax.grad(
        lambda a: jax.lax.cond(x[0] < 2, partial(total, most=most), lambda x, a: a[0], x, a)
    )(a),
    "some results": lambda x, a, most: jax.grad(
        lambda a: jnp.sum(jax.vmap(lambda x: motion(x, a, most)[1])(x))
    )(a),
}


@pytest.mark.parametrize("worlds", [1, MOST, MOST + 1, 5 * MOST + 2])
@pytest.mark.parametrize("name", TRANSFORMED)
def test_chunks_change_no_value_and_no_derivative(name, worlds):
    x = jnp.linspace(-1.0, 1.0, worlds)
    function = TRANSFORMED[name]
    expected = jax.jit(partial(function, most=0))(x, SHARED)
    for got in (jax.jit(partial(function, most=MOST))(x, SHARED), function(x, SHARED, MOST)):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, IDENTITY, IDENTITY * worlds),
            got,
            expected,
        )


def pendulum():
    scene = jc.Scene(dim=2)
    scene.add_body("rod", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "rod", point=(0.0, 0.0)))
    return scene.build()


SYSTEM, STATE = pendulum()


def cart():
    scene = jc.Scene(dim=2)
    scene.add_body("cart", mass=1.0, inertia=0.1, position=(0.0, 0.0))
    scene.add(jc.Prismatic("rail", jc.WORLD, "cart", point=(0.0, 0.0), axis=(1.0, 0.0)))
    scene.add(jc.Motor("push", "rail"))
    return scene.build()


CART = cart()


def swung(speed, gain, steps=3):
    """A pendulum that starts at a speed: its last state, and its angle after each step."""
    start = dataclasses.replace(STATE, v=STATE.v * 0 + speed * jnp.asarray([0.0, 0.5, 1.0]))
    system = SYSTEM.with_params({"gravity": gain * SYSTEM.params["gravity"]})
    return jc.rollout(system, jc.Method(), start, None, 1e-3, steps, record=lambda s, _: s.q[2])


@pytest.fixture
def few(monkeypatch):
    """Chunks of eight worlds."""
    monkeypatch.setattr(rollout, "chunk_size", lambda velocities: 8)


@pytest.mark.parametrize("worlds", [1, 7, 9, 30])
def test_a_rollout_of_a_batch_is_that_of_its_worlds(few, worlds):
    speeds, gains = jnp.linspace(-2.0, 2.0, worlds), jnp.linspace(0.5, 1.5, worlds)
    run = jax.jit(jax.vmap(swung))

    def loops(*args):
        return run.lower(*args).as_text().count("stablehlo.while")

    assert loops(speeds, gains) == loops(speeds[:8], gains[:8]) + (worlds > 8)
    final, path = run(speeds, gains)
    assert path.shape == (worlds, 3)
    for i in (0, worlds - 1):
        one, angles = jax.jit(swung)(speeds[i], gains[i])
        np.testing.assert_allclose(final.q[i], one.q, IDENTITY, IDENTITY)
        np.testing.assert_allclose(path[i], angles, IDENTITY, IDENTITY)


def test_a_gradient_by_what_worlds_share_is_the_sum_of_their_gradients(few):
    speeds = jnp.linspace(-2.0, 2.0, 19)

    def angle(gain, speed):
        return swung(speed, gain)[1][-1] ** 2

    slopes = jax.jit(jax.vmap(jax.grad(angle), (None, 0)))(1.1, speeds)
    whole = jax.jit(jax.grad(lambda g: jnp.sum(jax.vmap(angle, (None, 0))(g, speeds))))(1.1)
    np.testing.assert_allclose(whole, jnp.sum(slopes), 1e2 * IDENTITY)
    step = 1e-5
    ends = [jnp.sum(jax.vmap(angle, (None, 0))(g, speeds)) for g in (1.1 - step, 1.1 + step)]
    np.testing.assert_allclose(whole, (ends[1] - ends[0]) / (2 * step), DIFFERENCE)


@pytest.mark.parametrize("worlds", [9, 26])
def test_gradients_of_a_policy_and_of_each_world_do_not_depend_on_chunks(worlds, monkeypatch):
    """The weights of the policy are shared; the start of each world is its own."""
    speeds = jnp.linspace(-2.0, 2.0, worlds)

    def end(weights, speed):
        start = dataclasses.replace(CART[1], v=CART[1].v * 0 + speed * jnp.asarray([1.0, 0.0, 0.0]))

        def policy(s):
            return jnp.tanh(weights[0] * s.q[:1] + weights[1] * s.v[:1])

        final, path = jc.rollout(
            CART[0], jc.Method(), start, policy, 1e-2, 4, record=lambda s, _: s.q[0]
        )
        return final.q[0] ** 2 + jnp.sum(path * weights[0])

    def loss(weights, speeds):
        return jnp.sum(jax.vmap(end, (None, 0))(weights, speeds))

    found = []
    for most in (8, 1000):
        monkeypatch.setattr(rollout, "chunk_size", lambda velocities, most=most: most)
        found.append(jax.jit(jax.value_and_grad(loss, (0, 1)))(SHARED, speeds))
        found[-1] += (jax.jit(jax.hessian(loss))(SHARED, speeds),)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, 1e2 * IDENTITY), *found)


def test_functions_with_collectives_or_without_forward_mode_run_as_they_are():
    def averaged(x):
        def run():
            return jax.lax.scan(lambda x, _: (jnp.sin(x - jax.lax.pmean(x, "all")), x), x, length=3)

        return chunks.by_world(run, 4, x)

    @jax.custom_vjp
    def own(x):
        return x**2

    own.defvjp(lambda x: (x**2, x), lambda x, slope: (7.0 * x * slope,))

    def squared(x):
        return chunks.by_world(lambda: own(x), 4, x)

    x = jnp.linspace(0.0, 1.0, 10)
    expected = x
    for _ in range(3):
        expected = jnp.sin(expected - jnp.mean(expected))
    found, _ = jax.jit(jax.vmap(averaged, axis_name="all"))(x)
    np.testing.assert_allclose(found, expected, IDENTITY, IDENTITY)
    np.testing.assert_allclose(jax.vmap(jax.grad(squared))(x), 7 * x, IDENTITY)


def test_a_symbolic_batch_is_not_cut(few):
    (size,) = jax.export.symbolic_shape("n")
    shapes = [jax.ShapeDtypeStruct((size,), jnp.float64)] * 2
    exported = jax.export.export(jax.jit(jax.vmap(swung)))(*shapes)
    speeds, gains = jnp.linspace(-2.0, 2.0, 11), jnp.ones(11)
    found, expected = exported.call(speeds, gains)[1], jax.vmap(swung)(speeds, gains)[1]
    np.testing.assert_allclose(found, expected, IDENTITY, IDENTITY)


def test_the_study_of_large_batches_compares_with_chunks_by_hand():
    found = large_batches.compare("pendulum", 32, sizes=(8, 16))
    assert set(found.by_hand) == {8, 16}
    assert found.ratio > 0
    assert found.exchanges == {}


def test_reverse_mode_keeps_residuals_and_forward_mode_does_not():
    """Residuals are results of the first function, which JAX must ask for in reverse mode."""
    x = jnp.linspace(-1.0, 1.0, 9)
    programs = [
        jax.make_jaxpr(jax.grad(total))(x, SHARED),
        jax.make_jaxpr(lambda x: jax.jvp(total, (x, SHARED), (x, SHARED)))(x),
    ]
    results = [
        [len(e.outvars) for e in p.jaxpr.eqns if e.primitive is chunks.worlds_p] for p in programs
    ]
    assert results[0][0] > 2
    assert results[1] == [2, 2]  # values, and tangents


def natives(jaxpr):
    """The calls of native functions in a jaxpr and in its loops."""
    for e in jaxpr.eqns:
        yield from (
            [e] if e.primitive.name == "native" else itertools.chain(*map(natives, inside(e)))
        )


def test_what_is_not_recorded_is_not_computed_in_chunks(few):
    """The results of a step are its state, and an info that no one reads here."""
    traced = jax.make_jaxpr(jax.vmap(swung))(jnp.ones(9), jnp.ones(9)).jaxpr
    (chunk,) = (e for e in traced.eqns if e.primitive is chunks.worlds_p)
    (step,) = natives(chunk.params["jaxpr"].jaxpr)
    assert len(step.outvars) == len(jax.tree.leaves(STATE))
