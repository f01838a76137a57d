"""Adjoints of rollouts: gradients that use less memory, and truncated or discounted gradients."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc
from jaxcon.execution.adjoints import faded
from jaxcon.execution.segments import kept

METHOD = jc.Method()
DT = 0.01


def pushed():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=2.0, position=(1.0, 0.0), velocity=(0.0, 1.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    return scene.build()


SYSTEM, STATE = pushed()


def outcome(x, adjoint, steps, every, feedback=False):
    """Returns a number that depends on the final state and on every recorded state and force."""
    system = SYSTEM.with_params({"bob": {"mass": x["mass"]}})
    state = dataclasses.replace(STATE, v=x["v"])
    controls = (lambda s: x["u"][0] * s.v) if feedback else x["u"][:steps]

    def record(state, info):
        return {"end": state.q[0] * state.v[1], "pull": info.multipliers[0]}

    run = functools.partial(jc.rollout, record=record, every=every, adjoint=adjoint)
    final, kept = run(system, METHOD, state, controls, x["dt"], steps)
    weights = 1.0 + jnp.arange(1.0 * (steps // every))
    return final.q @ final.v + weights @ kept["end"] + 1e-2 * weights @ kept["pull"]


def numbers():
    random = np.random.default_rng(0)
    own = {"mass": 2.0, "v": [0.0, 1.0], "u": random.normal(size=(12, 2)), "dt": DT}
    return {name: jnp.asarray(x) for name, x in own.items()}


@functools.cache
def gradient(adjoint, *shape):
    """Returns the value and the gradient of `outcome`."""
    return jax.jit(jax.value_and_grad(lambda x: outcome(x, adjoint, *shape)))(numbers())


def close(got, expected, tolerance=IDENTITY):
    for path, leaf in jax.tree.leaves_with_path(expected):
        other = functools.reduce(lambda tree, key: tree[getattr(key, "key", None)], path, got)
        scale = np.max(np.abs(leaf), initial=1e-3)
        np.testing.assert_allclose(other, leaf, rtol=0, atol=tolerance * scale, err_msg=str(path))


DEFAULT = jc.adjoints.EveryStep()
SAME = [
    (jc.adjoints.Checkpoints(), 11, 1, False),
    (jc.adjoints.Checkpoints(), 12, 4, False),
    (jc.adjoints.Checkpoints(), 12, 6, True),
    (jc.adjoints.Checkpoints(levels=3), 11, 1, True),
    (jc.adjoints.Checkpoints(segments=(6, 2)), 12, 3, False),
    (jc.adjoints.Checkpoints(segments=5), 12, 12, False),
    (jc.adjoints.Truncated(20), 11, 1, False),
    (jc.adjoints.Discounted(1.0, within=jc.adjoints.Checkpoints()), 11, 1, True),
]


@pytest.mark.parametrize(("adjoint", "steps", "every", "feedback"), SAME)
def test_the_gradient_is_that_of_every_step(adjoint, steps, every, feedback):
    value, slope = gradient(adjoint, steps, every, feedback)
    expected_value, expected = gradient(DEFAULT, steps, every, feedback)
    np.testing.assert_allclose(value, expected_value, rtol=IDENTITY)
    close(slope, expected)


def test_a_spatial_body_in_float32():
    """Both gradients agree within the rounding errors of the rollout, and are float32."""
    scene = jc.Scene(dtype=jnp.float32)
    rod = jc.inertia.rod(1.0, length=1.0, radius=0.05)
    scene.add_body("rod", inertia=rod, position=(0.5, 0.0, 0.0), angular_velocity=(0.0, 1.0, 0.3))
    scene.add(jc.Spherical("hinge", jc.WORLD, "rod", (0.0, 0.0, 0.0)))
    system, state = scene.build()
    weights = jnp.linspace(-1, 1, len(state.q), dtype=jnp.float32)

    def value(x, adjoint):
        start = dataclasses.replace(state, v=x["v"])
        changed = system.with_params({"rod": {"mass": x["mass"]}})
        dt = jnp.asarray(DT, jnp.float32)
        return weights @ jc.rollout(changed, METHOD, start, None, dt, 6, adjoint=adjoint)[0].q

    x = {"v": state.v, "mass": jnp.float32(1.0)}
    both = jax.jit(lambda x: [jax.grad(value)(x, a) for a in (DEFAULT, jc.adjoints.Checkpoints())])(
        x
    )
    assert {leaf.dtype for leaf in jax.tree.leaves(both)} == {jnp.dtype(jnp.float32)}
    assert np.max(np.abs(both[0]["v"])) > 1e-2
    close(both[1], both[0], 1e-5)


def test_forward_mode_and_batches_in_both_orders():
    x = numbers()
    worlds = jnp.stack([x["v"], 2 * x["v"], -x["v"]])

    def value(v):
        return outcome(x | {"v": v}, jc.adjoints.Checkpoints(), 11, 1)

    slope = jax.jit(jax.grad(value))
    expected = jnp.stack([slope(v) for v in worlds])
    inside = jax.jit(jax.vmap(jax.grad(value)))(worlds)
    outside = jax.jit(jax.grad(lambda vs: jnp.sum(jax.vmap(value)(vs))))(worlds)
    direction = jnp.array([0.3, -0.7])
    forward = jax.jit(lambda v: jax.jvp(value, (v,), (direction,))[1])(x["v"])
    np.testing.assert_allclose(inside, expected, rtol=1e-11)
    np.testing.assert_allclose(outside, expected, rtol=1e-11)
    np.testing.assert_allclose(forward, expected[0] @ direction, rtol=1e-11)


def test_a_failed_world_has_no_gradient_and_the_others_do_not_notice():
    x = numbers()
    worlds = jnp.stack([x["v"], jnp.full(2, jnp.nan)])
    shared = jnp.asarray(2.0)

    def total(mass, adjoint, worlds):
        def value(v):
            system = SYSTEM.with_params({"bob": {"mass": mass}})
            state = dataclasses.replace(STATE, v=v)
            return jc.rollout(system, METHOD, state, x["u"], DT, 12, adjoint=adjoint)[0].q[1]

        return jnp.sum(jax.vmap(value)(worlds))

    got = jax.jit(
        jax.grad(functools.partial(total, adjoint=jc.adjoints.Checkpoints(), worlds=worlds))
    )
    alone = functools.partial(total, adjoint=DEFAULT, worlds=worlds[:1])
    np.testing.assert_allclose(got(shared), jax.jit(jax.grad(alone))(shared), rtol=1e-11)


@pytest.mark.parametrize("integrator", [jc.SemiImplicitEuler(), jc.integrators.Heun()])
def test_the_derivative_by_h_exists_where_h_is_zero(integrator):
    """The derivative is the velocity."""

    def place(h):
        return jc.step(SYSTEM, jc.Method(integrator), STATE, None, h)[0].q

    np.testing.assert_allclose(jax.jacfwd(place)(0.0), STATE.v, atol=1e-12)


def free(steps, adjoint):
    """Returns the gradients (dq_T/dv_0, dq_T/du) of a free particle's end, and those of its path.

    The particle is pushed along a line.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("bob", mass=2.0)
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    system, state = scene.build()

    def end(v, controls):
        start = dataclasses.replace(state, v=jnp.stack([v, 0.0 * v]))
        controls = jnp.stack([controls, 0.0 * controls], axis=-1)
        final, path = jc.rollout(system, METHOD, start, controls, DT, steps, adjoint=adjoint)
        return final.q[0], path.q[:, 0]

    return jax.jit(jax.jacrev(end, argnums=(0, 1)))(jnp.asarray(1.0), jnp.zeros(steps))


def effects(steps, count):
    """Returns dq_j+1/du_i = (h²/m)(j − i + 1) · count(i, j), exact for semi-implicit Euler."""
    j, i = np.mgrid[:steps, :steps]
    return np.where(i <= j, DT**2 / 2.0 * (j - i + 1) * count(i, j), 0.0)


@pytest.mark.parametrize("within", [DEFAULT, jc.adjoints.Checkpoints(segments=3)])
def test_a_truncated_gradient_by_hand(within):
    (by_v, by_u), (_, path_by_u) = free(10, jc.adjoints.Truncated(4, within))
    assert by_v == 0.0
    table = effects(10, lambda i, j: i // 4 == j // 4)
    np.testing.assert_allclose(path_by_u, table, rtol=1e-12)
    np.testing.assert_allclose(by_u, table[-1], rtol=1e-12)


@pytest.mark.parametrize("within", [DEFAULT, jc.adjoints.Checkpoints()])
def test_a_discounted_gradient_by_hand(within):
    (by_v, by_u), (_, path_by_u) = free(10, jc.adjoints.Discounted(0.7, within))
    np.testing.assert_allclose(by_v, 0.7**10 * 10 * DT, rtol=1e-12)
    table = effects(10, lambda i, j: 0.7 ** (j - i).clip(0))
    np.testing.assert_allclose(path_by_u, table, rtol=1e-12)
    np.testing.assert_allclose(by_u, table[-1], rtol=1e-12)


def test_a_cut_stops_what_is_not_finite():
    """Without the cut, 0 · ∞ would give NaN."""

    def value(x):
        state = dataclasses.replace(STATE, q=jnp.stack([x, x]))
        return jnp.sum(jnp.sqrt(faded(state, 0.0).q))

    assert jax.grad(value)(0.0) == 0.0


def test_no_steps_lead_nowhere_whatever_is_kept():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    for adjoint in (
        DEFAULT,
        jc.adjoints.Checkpoints(),
        jc.adjoints.Checkpoints(levels=3),
        jc.adjoints.Reversible(),
    ):
        method = (
            jc.Method(jc.integrators.RATTLE())
            if isinstance(adjoint, jc.adjoints.Reversible)
            else jc.Method()
        )
        start = jc.init(system, method, state.q, state.v)
        final, path = jc.rollout(system, method, start, None, 1e-2, 0, adjoint=adjoint)
        np.testing.assert_array_equal(final.q, start.q)
        assert path.q.shape == (0, 2)


@pytest.mark.parametrize("steps", [1, 2, 10, 100, 1000, 4097])
@pytest.mark.parametrize("levels", [1, 2, 3])
def test_states_kept_grow_as_a_root(steps, levels):
    sizes = jc.adjoints.Checkpoints(levels=levels).sizes(steps, STATE)
    assert sum(kept(steps, sizes)) <= levels * (steps ** (1 / levels) + 1)


@pytest.mark.parametrize(
    ("steps", "levels", "expected"),
    [(1000, 2, (40,)), (1000, 3, (100, 10)), (300, 2, (20,)), (500, 3, (50, 10)), (997, 2, (32,))],
)
def test_segments_are_whole_where_that_keeps_hardly_more(steps, levels, expected):
    """Segments of equal length need no condition within steps; a prime number of steps has none."""
    adjoint = jc.adjoints.Checkpoints(levels=levels)
    assert adjoint.sizes(steps, STATE) == expected
    program = jax.make_jaxpr(
        lambda s: jc.rollout(SYSTEM, METHOD, s, None, 1e-2, steps, adjoint=adjoint)
    )
    assert (" cond[" in str(program(STATE))) == (steps == 997)


def test_a_budget_takes_as_few_levels_as_it_can():
    own = sum(x.nbytes for x in jax.tree.leaves(STATE))

    def sizes(states):
        return jc.adjoints.Checkpoints(budget=states * own).sizes(1000, STATE)

    assert sizes(1000) == ()
    assert sizes(999) == sizes(65) == (40,)
    assert sizes(64) == (32,)
    assert sizes(63) == (100, 10)
    assert jc.adjoints.Checkpoints(budget=own).sizes(0, STATE) == ()
    with pytest.raises(ValueError, match=r"budget=40 bytes.*least"):
        jc.adjoints.Checkpoints(budget=40).sizes(1000, STATE)


@pytest.mark.parametrize(
    ("adjoint", "error", "match"),
    [
        (jc.adjoints.Checkpoints, TypeError, "adjoint must be a value"),
        ("sqrt", TypeError, "adjoint must be a value"),
        (
            jc.adjoints.Truncated(3, within=jc.adjoints.Checkpoints),
            TypeError,
            "adjoint must be a value",
        ),
        (jc.adjoints.Checkpoints(levels=0), ValueError, "levels must be a whole number"),
        (jc.adjoints.Checkpoints(segments=(6, 4)), ValueError, "divisor of the one before"),
        (jc.adjoints.Checkpoints(segments=3, budget=9), ValueError, "exclude each other"),
        (jc.adjoints.Checkpoints(levels=3, segments=3), ValueError, "exclude each other"),
        (jc.adjoints.Checkpoints(segments=[2]), ValueError, "as a tuple"),
        (jc.adjoints.Checkpoints(segments=()), ValueError, "as a tuple of one number or more"),
        (jc.adjoints.Checkpoints(budget="1MB"), ValueError, "budget must be a real number"),
        (jc.adjoints.Truncated(0), ValueError, "steps must be a whole number"),
        (jc.adjoints.Discounted(-0.5), ValueError, "factor must lie between 0 and 1"),
        (jc.adjoints.Discounted(1.5), ValueError, "factor must lie between 0 and 1"),
        (jc.adjoints.Discounted(np.array([0.5, 0.9])), ValueError, r"one number, got shape \(2,\)"),
    ],
)
def test_what_is_no_adjoint_is_refused(adjoint, error, match):
    with pytest.raises(error, match=match):
        jc.rollout(SYSTEM, METHOD, STATE, jnp.zeros((6, 2)), DT, 6, adjoint=adjoint)


def test_the_numbers_of_an_adjoint_of_a_user_are_checked():
    class Own(jc.extend.Adjoint):
        def check(self):
            raise ValueError("Own: its number is wrong")

        def scan(self, path):
            return path.scan()

        def kept(self, steps, state):
            return (steps,)

    system, state = pushed()
    for adjoint in (Own(), jc.adjoints.Truncated(5, within=Own())):
        with pytest.raises(ValueError, match="Own: its number is wrong"):
            jc.rollout(system, jc.Method(), state, None, 1e-3, 2, adjoint=adjoint)
