"""Functions batched along the last axis equal plain vmap under every transformation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc
from jaxcon import scenes as scenes_of_library
from jaxcon.execution.shell import has_user_parts
from jaxcon.staging import batch_last


def swing(q, p):
    """A function of two coordinates, written for any number of trailing batch axes."""
    x, y = q[0], q[1]
    pull = p["stiffness"] * (x * x + y * y)
    return {"q": jnp.stack([y - pull * x, jnp.sin(x) * p["gain"][1] + y]), "size": jnp.sqrt(pull)}


def called(q, p):
    return batch_last.call(swing, q, p)


RANDOM = np.random.default_rng(0)
Q = jnp.asarray(RANDOM.normal(size=(5, 2)))
P = {"stiffness": jnp.asarray(1.3), "gain": jnp.asarray([0.4, 0.7])}
PS = {
    "stiffness": jnp.asarray(RANDOM.uniform(1, 2, size=5)),
    "gain": jnp.asarray(RANDOM.normal(size=(5, 2))),
}
ONE = ({"stiffness": None, "gain": None}, {"stiffness": 0, "gain": 0})
SHARED, OWN = (Q, P, (0, ONE[0])), (Q, PS, (0, ONE[1]))
PARTLY = (Q, {"stiffness": PS["stiffness"], "gain": P["gain"]}, (0, {"stiffness": 0, "gain": None}))
ALONE = (Q[0], PS, (None, ONE[1]))
batches = pytest.mark.parametrize(
    ("q", "p", "axes"), [SHARED, OWN, PARTLY, ALONE], ids=["shared", "own", "partly", "alone"]
)


def close(got, expected):
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=IDENTITY, atol=IDENTITY)


def total(function):
    """Returns a function whose value is the sum of squares of all results."""
    return lambda q, p: sum(jnp.sum(x**2) for x in jax.tree.leaves(function(q, p)))


def transformations(f):
    """Returns transformations of a function of one world, by name."""
    g = total(f)
    return {
        "value": f,
        "grad": jax.grad(g, argnums=(0, 1)),
        "jvp": lambda q, p: jax.jvp(f, (q, p), jax.tree.map(jnp.ones_like, (q, p))),
        "hessian": jax.hessian(g),
        "jacfwd": jax.jacfwd(f),
        "jacrev": jax.jacrev(f),
    }


NAMES = tuple(transformations(swing))


@pytest.mark.parametrize("what", NAMES)
def test_one_world(what):
    close(transformations(called)[what](Q[0], P), transformations(swing)[what](Q[0], P))


@batches
@pytest.mark.parametrize("what", NAMES)
def test_vmap_outside(what, q, p, axes):
    ours, plain = (
        jax.jit(jax.vmap(transformations(f)[what], in_axes=axes))(q, p) for f in (called, swing)
    )
    close(ours, plain)


@batches
def test_vmap_inside_grad(q, p, axes):
    """The gradient by a shared number is the sum over worlds."""

    def loss(f):
        return lambda q, p: jnp.sum(jax.vmap(total(f), in_axes=axes)(q, p))

    ours, plain = (jax.jit(jax.grad(loss(f), argnums=(0, 1)))(q, p) for f in (called, swing))
    close(ours, plain)


def test_vmap_of_vmap():
    q = jnp.stack([Q, 2 * Q])
    nested = [
        jax.vmap(jax.vmap(jax.grad(total(f)), in_axes=axes), in_axes=(0, None))(q, PS)
        for f, axes in ((called, OWN[2]), (swing, OWN[2]))
    ]
    close(*nested)


@pytest.mark.parametrize("out", [0, 1])
def test_axes_elsewhere(out):
    found = [
        jax.vmap(lambda q, f=f: f(q, P)["q"], in_axes=1, out_axes=out)(Q.T) for f in (called, swing)
    ]
    close(*found)


def test_scan_of_a_batch_under_grad():
    def final(f):
        def run(q, p):
            step = lambda q, _: (0.1 * f(q, p)["q"], None)  # noqa: E731
            return jnp.sum(jax.lax.scan(step, q, None, 4)[0] ** 2)

        return jax.jit(jax.grad(lambda q, p: jnp.sum(jax.vmap(run, (0, None))(q, p)), (0, 1)))

    close(final(called)(Q, P), final(swing)(Q, P))


def counted(q):
    return {"n": jnp.asarray(3, jnp.int32) + 0 * q[0].astype(jnp.int32), "x": q * 2}


def test_integers_pass_without_a_derivative():
    def value(q):
        found = batch_last.call(counted, q)
        return jnp.sum(found["x"]) + 0.0 * found["n"].astype(float)

    close(jax.vmap(jax.grad(value))(Q), np.full((5, 2), 2.0))
    assert jax.vmap(lambda q: batch_last.call(counted, q)["n"])(Q).dtype == jnp.int32


def test_a_function_is_traced_once_for_a_shape():
    traces = []

    def traced(x):
        traces.append(x.shape)
        return x * 2

    for _ in range(3):
        batch_last.call(traced, jnp.ones(2))
        jax.vmap(lambda x: batch_last.call(traced, x))(jnp.ones((4, 2)))
    assert traces == [(2, 1)], "a batch has the program of one world"


def test_gains_that_are_python_numbers_batch():
    system, state = scenes_of_library.four_bar()
    method = jc.Method(stabilizer=jc.Baumgarte.critical(10))

    def run(v):
        start = dataclasses.replace(state, v=v)
        return jc.rollout(system, method, start, None, 1e-3, 3)[0].q

    batch = jnp.stack([state.v, 2 * state.v])
    np.testing.assert_allclose(jax.vmap(run)(batch), jnp.stack([run(v) for v in batch]), rtol=1e-12)


@pytest.mark.parametrize("transform", [jax.grad, lambda f: jax.jit(jax.grad(f)), jax.vmap])
def test_a_force_that_closes_over_a_traced_number_is_refused(transform):
    def final(k):
        scene = jc.Scene(dim=2)
        scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
        scene.add(jc.forces.CustomForce("pull", ("bob",), lambda m, t, u, p: -k * m.position))
        system, state = scene.build()
        return jc.rollout(system, jc.Method(), state, None, 1e-2, 2)[0].q[0]

    with pytest.raises(TypeError, match="params="):
        transform(final)(jnp.ones(2) if transform is jax.vmap else 1.0)


def test_systems_of_one_structure_keep_their_rows():
    """Pendulums with two and with three coordinates share functions that do not fix the size."""

    def system(n):
        own = jc.GeneralizedSystem(
            mass=ones, force=fall, constraints=(jc.joints.Holonomic(length),)
        )
        return own, jc.init(own, jc.Method(), jnp.eye(n)[0], jnp.zeros(n))

    both = [system(n) for n in (2, 3)]
    for own, state in (*both, both[0]):
        _, info = jc.step(own, jc.Method(), state, None, 1e-3)
        assert info.violation.layout.size == info.violation.position.size == len(state.q) - 1


def ones(q, p):
    return jnp.ones_like(q)


def fall(q, v, t, u, p):
    return -jnp.ones_like(q)


def length(q, t, p):
    return q[:-1] ** 2 + q[1:] ** 2 - q[0] ** 2 - q[1] ** 2


def test_single_precision_is_traced_anew_where_double_is_off():
    """A cached program is traced again once JAX's default float changes, as its constants do."""
    x = jnp.ones(2, jnp.float32)

    def real(x):
        return x * jnp.zeros(()).dtype.itemsize

    found = []
    for double in (True, False, True):
        with jax.enable_x64(double):
            found.append(float(jax.vmap(lambda y: batch_last.call(real, y))(x)[0]))
    assert found == [8, 4, 8]


def test_numbers_that_a_program_knows_are_constants_of_it():
    """Under jit, a closed-over system is constant: only the state and h are arguments of the step.

    Values and tangents are those of a step that takes the system as an argument.
    """
    system, state = scenes_of_library.four_bar()
    method, h = jc.Method(), 1e-3

    def one(system, state):
        return jc.step(system, method, state, None, h)[0]

    def arguments(function, *args):
        called = [x for x in jax.make_jaxpr(function)(*args).eqns if x.primitive.name == "native"]
        return len(called[0].invars)

    moving = len(jax.tree.leaves(state)) + 1
    assert arguments(lambda s: one(system, s), state) == moving
    assert arguments(one, system, state) == moving + len(jax.tree.leaves(system))

    inside, outside = jax.jit(lambda s: one(system, s)), jax.jit(one)
    close(inside(state), outside(system, state))
    tangent = dataclasses.replace(
        jax.tree.map(jnp.zeros_like, state),
        v=jnp.ones_like(state.v),
        status=np.zeros(state.status.shape, jax.dtypes.float0),
    )
    expected = jax.jvp(lambda s: outside(system, s).q, (state,), (tangent,))[1]
    close(jax.jvp(lambda s: inside(s).q, (state,), (tangent,))[1], expected)


def test_equal_constants_share_a_trace():
    before = batch_last._with_constants.cache_info().misses
    for _ in range(3):
        jax.make_jaxpr(lambda q: batch_last.call(swing, q, {"stiffness": 1.37, "gain": P["gain"]}))(
            Q[0]
        )
    assert batch_last._with_constants.cache_info().misses == before + 1


def test_a_batch_outside_jit_compiles_once_for_all_values():
    """Outside of jit no number is a constant, so that other values need no compilation."""
    compiled = []
    for stiffness in (1.1, 1.2):
        p = {"stiffness": jnp.asarray(stiffness), "gain": P["gain"]}
        close(jax.vmap(lambda q, p=p: called(q, p))(Q), jax.vmap(lambda q, p=p: swing(q, p))(Q))
        compiled.append(batch_last._shared.cache_info().misses)
    assert compiled[0] == compiled[1]


def test_a_rollout_outside_jit_has_no_constants():
    """Another mass compiles nothing: numbers of the loop are arguments, although it is traced."""
    made = []
    for mass in (1.0, 1.5):
        scene = jc.Scene(dim=2)
        scene.add_particle("bob", mass=mass, position=(1.0, 0.0))
        scene.add(jc.Distance("rod", jc.WORLD, "bob"))
        system, state = scene.build()
        jc.rollout(system, jc.Method(), state, None, 1e-3, 7)
        caches = batch_last._shared, batch_last._with_constants
        made.append([x.cache_info().misses for x in caches])
    assert made[0] == made[1]


def test_a_derivative_starts_its_iteration_from_the_solution():
    """The factor of the tangent shows from which start the function is evaluated once more."""

    def function(x, start):
        return x * jax.lax.stop_gradient(start), start + 1

    guess = (lambda args: args[1], lambda result: result[1])

    def value(x, start):
        return batch_last.call(function, x, start, guess=guess)[0]

    x, start = jnp.asarray(2.0), jnp.asarray(3.0)
    for transformed in (jax.grad(value), jax.jit(jax.grad(value))):
        assert transformed(x, start) == 4.0
    assert value(x, start) == 6.0
    many = jax.vmap(jax.grad(value))(jnp.ones(3), jnp.arange(3.0))
    np.testing.assert_allclose(many, np.arange(3.0) + 1)


@jc.extend.pytree
class Rosenbrock(jc.SemiImplicitEuler):
    """An integrator of a user's own that differentiates the dynamics: it adds h/2 (∂a/∂q) v."""

    def advance(self, dynamics, state, memory, dt):
        advanced = super().advance(dynamics, state, memory, dt)

        def acceleration(q):
            return dynamics(q, state.v, state.instant)[0].acceleration

        path = dynamics.system.kinematics(state.q, state.v)
        change = jax.jvp(acceleration, (state.q,), (path,))[1]
        (q, v, time), *others = advanced
        return type(advanced)((q, v + dt[None] ** 2 / 2 * change, time), *others)


@pytest.mark.parametrize("solver", [jc.solvers.RankSafe(), jc.solvers.Sparse()])
def test_an_integrator_of_a_user_may_differentiate_the_dynamics(solver):
    """The rules of derivatives are traced for it, but not for a step of the library."""
    scene = jc.Scene(dim=2)
    scene.add_body("a", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    scene.add_body("b", mass=2.0, inertia=0.2, position=(1.0, -0.5))
    scene.add(jc.Revolute("shoulder", jc.WORLD, "a", point=(0.0, 0.0)))
    scene.add(jc.Revolute("elbow", "a", "b", point=(1.0, 0.0)))
    system, state = scene.build()
    v = jnp.asarray([0.0, 1.0, 0.5, 1.0, 0.0, 2.0, 2.0, 2.0])[: len(state.v)]
    plain, own = jc.Method(solver=solver), jc.Method(Rosenbrock(), solver=solver)
    assert has_user_parts(system, own)
    assert not has_user_parts(system, plain)
    state, h = jc.init(system, plain, state.q, v), 1e-3

    def acceleration(x):
        shifted = dataclasses.replace(state, q=state.q + x * v)
        return jc.forward_dynamics(system, shifted, None, plain, h)[0]

    eps = 1e-5
    change = (acceleration(eps) - acceleration(-eps)) / (2 * eps)
    added = jc.step(system, own, state, None, h)[0].v - jc.step(system, plain, state, None, h)[0].v
    assert np.abs(change).max() > 1
    np.testing.assert_allclose(added, h**2 / 2 * change, atol=1e-8 * h**2 * np.abs(change).max())
