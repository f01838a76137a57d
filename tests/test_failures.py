"""One world of a batch fails: it stops with a status, and no other world or gradient changes."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_batched_either_way

import jaxcon as jc

WORLDS, SICK, STEPS, DT = 4, 2, 12, 1e-2
HEALTHY = [i for i in range(WORLDS) if i != SICK]


def fading(cart, t, p):
    """Returns ψ of a row that vanishes after the time `until`."""
    return jnp.maximum(p["until"] - t, 0.0) * cart.velocity[1:]


@pytest.fixture(scope="module")
def scene():
    s = jc.Scene(dim=2)
    s.add_body("arm", mass=1.0, inertia=0.3, position=(0.5, 0.0), angular_velocity=1.0)
    s.add_particle("bob", mass=0.5, position=(1.5, 0.0))
    s.add_particle("cart", mass=0.7, position=(0.0, 2.0), velocity=(1.0, 0.0))
    s.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)))
    s.add(jc.Distance("rod", "arm", "bob", point_a=(1.0, 0.0)))
    s.add(jc.joints.VelocityLevel(fading, ("cart",), name="rail", params={"until": 100.0}))
    s.add(jc.Spring("spring", "cart", "bob", stiffness=5.0, rest_length=1.0))
    s.add(jc.forces.ExternalWrench("push", "bob"))
    return s.build()


def healthy_numbers(state):
    """Returns the numbers that differ between the worlds."""
    random = np.random.default_rng(0)
    return {
        "q": np.tile(state.q, (WORLDS, 1)),
        "v": np.asarray(state.v) + 0.1 * random.normal(size=(WORLDS, state.v.shape[0])),
        "control": random.normal(size=(WORLDS, STEPS, 2)),
        "mass": random.uniform(0.5, 1.0, size=WORLDS),
        "stiffness": random.uniform(4.0, 6.0, size=WORLDS),
        "until": np.full(WORLDS, 100.0),
    }


def sicken(numbers, what):
    sick = {key: x.copy() for key, x in numbers.items()}
    if what == "state":
        sick["q"][SICK, 0] = np.nan
    elif what == "velocity":
        sick["v"][SICK, 1] = np.inf
    elif what == "control":
        sick["control"][SICK, 5, 0] = np.nan
    elif what == "mass":
        sick["mass"][SICK] = np.nan
    elif what == "singular later":
        sick["until"][SICK] = 6.5 * DT
    elif what == "singular at once":
        sick["until"][SICK] = 0.0
    elif what == "blow-up":
        sick["stiffness"][SICK] = 1e9
    return sick


NON_FINITE, SINGULAR = jc.Status.NON_FINITE, jc.Status.SINGULAR
# by failure: the status, and the number of steps before it where theory gives one
SICKNESSES = {
    "state": (NON_FINITE, 0),
    "velocity": (NON_FINITE, 0),
    "control": (NON_FINITE, 5),
    "mass": (NON_FINITE, 0),
    "singular later": (SINGULAR, 7),
    "singular at once": (SINGULAR, 0),
    "blow-up": (None, None),
}
every_sickness = pytest.mark.parametrize("what", SICKNESSES)
SOLVERS = {"schur": jc.solvers.Schur(), "dense": jc.solvers.Dense()}


def start(system, state, x):
    changes = {
        "bob": {"mass": x["mass"]},
        "spring": {"stiffness": x["stiffness"]},
        "rail": {"params": {"until": x["until"]}},
    }
    return system.with_params(changes), dataclasses.replace(state, q=x["q"], v=x["v"])


@pytest.fixture(scope="module", params=SOLVERS)
def simulate(scene, request):
    """Returns the function that simulates all worlds: final states, trajectories and infos."""
    method = jc.Method(solver=SOLVERS[request.param])

    def one(x):
        system, state = start(*scene, x)

        def record(state, info):
            return state, info

        return jc.rollout(system, method, state, x["control"], DT, STEPS, record=record)

    return jax.jit(jax.vmap(one))


@every_sickness
def test_status_says_which_world_and_why(scene, simulate, what):
    final, _ = simulate(sicken(healthy_numbers(scene[1]), what))
    code = SICKNESSES[what][0]
    assert np.all(final.status[np.array(HEALTHY)] == jc.Status.OK)
    assert final.status[SICK] != jc.Status.OK
    assert code is None or final.status[SICK] == code


@every_sickness
def test_other_worlds_are_bit_identical(scene, simulate, what):
    numbers = healthy_numbers(scene[1])
    good, sick = simulate(numbers), simulate(sicken(numbers, what))
    for a, b in zip(jax.tree.leaves(good), jax.tree.leaves(sick), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[HEALTHY], np.asarray(b)[HEALTHY])


@every_sickness
def test_the_world_stays_at_its_last_finite_state(scene, simulate, what):
    numbers, (_, life) = healthy_numbers(scene[1]), SICKNESSES[what]
    sick = sicken(numbers, what)
    final, (states, infos) = simulate(sick)
    code = np.asarray(states.status[SICK])
    if life is None:
        life = int(np.argmax(code != 0))
        assert 0 < life < STEPS
    np.testing.assert_array_equal(code != 0, np.arange(STEPS) >= life)
    last = sick["q"][SICK] if life == 0 else states.q[SICK, life - 1]
    for q in (*states.q[SICK, life:], final.q[SICK]):
        np.testing.assert_array_equal(q, last)
    np.testing.assert_array_equal(states.time[SICK, life:], np.full(STEPS - life, life * DT) + 0.0)
    for leaf in (infos.acceleration, infos.multipliers):
        np.testing.assert_array_equal(leaf[SICK, life:], 0)
    if what != "state" and what != "velocity":
        assert np.all(np.isfinite(states.q))
        assert np.all(np.isfinite(states.v))


SHARED = {"gravity": np.array([0.3, -9.81]), "arm": 1.3, "gain": 15.0, "stiffness": 1.0}


def loss(scene, shared, x):
    """Returns the loss of one world by the numbers that all worlds share."""
    system, state = start(*scene, x | {"stiffness": x["stiffness"] * shared["stiffness"]})
    system = system.with_params({"gravity": shared["gravity"], "arm": {"mass": shared["arm"]}})
    method = jc.Method(stabilizer=jc.Baumgarte.critical(rate=shared["gain"]))
    final, kept = jc.rollout(system, method, state, x["control"], DT, STEPS, every=4)
    return jnp.sum(final.q**2) + jnp.sum(final.v**2) + jnp.sum(kept.q)


@pytest.fixture(scope="module")
def gradients(scene):
    """Returns the gradient by the shared numbers outside of vmap, and that of each world inside."""

    def each(shared, x):
        return jax.vmap(lambda x: loss(scene, shared, x))(x)

    def one(shared, x):
        return jax.grad(lambda s: loss(scene, s, x))(shared)

    outside = jax.jit(jax.grad(lambda s, x: jnp.sum(each(s, x))))
    inside = jax.jit(jax.vmap(one, in_axes=(None, 0)))
    return outside, inside


@every_sickness
def test_gradients_are_those_of_the_batch_without_the_world(scene, gradients, what):
    outside, inside = gradients
    shared = jax.tree.map(jnp.asarray, SHARED)
    numbers = healthy_numbers(scene[1])
    sick = sicken(numbers, what)
    good = inside(shared, numbers)
    expected = jax.tree.map(lambda x: np.sum(np.asarray(x)[HEALTHY], axis=0), good)
    by_world = inside(shared, sick)
    summed = jax.tree.map(lambda x: np.sum(x, axis=0), by_world)
    for found in (summed, outside(shared, sick)):
        for name, leaf in found.items():
            np.testing.assert_allclose(leaf, expected[name], rtol=1e-12, err_msg=name)
    for name, leaf in by_world.items():
        np.testing.assert_array_equal(np.asarray(leaf)[SICK], 0, err_msg=name)


def test_forward_mode_stops_too(scene):
    shared = jax.tree.map(jnp.asarray, SHARED)
    sick = sicken(healthy_numbers(scene[1]), "control")
    tangent = jax.tree.map(jnp.ones_like, shared)

    def total(s):
        return jax.vmap(lambda x: loss(scene, s, x))(sick)

    _, change = jax.jit(lambda: jax.jvp(total, (shared,), (tangent,)))()
    assert np.all(np.isfinite(change))
    assert change[SICK] == 0
    assert np.all(change[np.array(HEALTHY)] != 0)


def test_the_gradient_of_one_step_stops_too(scene):
    system, state = scene
    bad = dataclasses.replace(state, v=state.v.at[0].set(jnp.nan))

    def value(gravity):
        changed = system.with_params({"gravity": gravity})
        return jnp.sum(jc.step(changed, jc.Method(), bad, None, DT)[0].q)

    np.testing.assert_array_equal(jax.grad(value)(jnp.asarray([0.0, -9.81])), 0)


def test_the_first_failure_sticks(scene):
    system, state = scene
    failed = dataclasses.replace(state, status=jnp.asarray(jc.Status.SINGULAR, jnp.int32))
    new, info = jc.step(system, jc.Method(), failed, None, DT)
    assert new.status == info.status == jc.Status.SINGULAR
    np.testing.assert_array_equal(new.q, failed.q)
    bad = dataclasses.replace(failed, v=state.v.at[0].set(jnp.nan))
    assert jc.step(system, jc.Method(), bad, None, DT)[0].status == jc.Status.SINGULAR


def test_raise_for_status_names_world_and_cause(scene, simulate):
    good, _ = simulate(healthy_numbers(scene[1]))
    jc.raise_for_status(good)
    for what, words in (("control", "NON_FINITE"), ("singular later", "SINGULAR")):
        final, _ = simulate(sicken(healthy_numbers(scene[1]), what))
        with pytest.raises(jc.SimulationError, match=rf"{words} in 1 of 4 worlds.*world \(2,\)"):
            jc.raise_for_status(final)
    with pytest.raises(jc.SimulationError, match="SINGULAR.*report"):
        jc.raise_for_status(dataclasses.replace(scene[1], status=np.asarray(2)))
    with pytest.raises(jc.SimulationError, match="NaN"):
        jc.raise_for_status(dataclasses.replace(scene[1], status=np.asarray(1)))


def test_a_healthy_world_keeps_its_gradient_through_the_guard(scene):
    """Central differences show that the guard of failed worlds does not block other gradients."""
    x = jax.tree.map(lambda x: x[0], healthy_numbers(scene[1]))
    shared = jax.tree.map(jnp.asarray, SHARED)
    value = jax.jit(lambda s: loss(scene, s, x))
    gradient = jax.jit(jax.grad(lambda s: loss(scene, s, x)))(shared)
    for name in SHARED:
        step = {key: jnp.full_like(y, 1e-5 if key == name else 0) for key, y in shared.items()}
        ahead, behind = (
            value(jax.tree.map(lambda a, d, sign=sign: a + sign * d, shared, step))
            for sign in (1, -1)
        )
        slope = (ahead - behind) / 2e-5
        np.testing.assert_allclose(jnp.sum(gradient[name]), slope, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    "solver", [jc.solvers.Schur(), jc.solvers.Sparse(), jc.solvers.ConjugateGradients()]
)
def test_a_mass_that_is_not_positive_is_singular(solver):
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.stack([1.0 + 0 * q[0], p]),
        force=lambda q, v, t, u, p: -q,
        constraints=(jc.joints.Holonomic(lambda q, t, p: jnp.stack([q[0] - q[1]])),),
        params=jnp.zeros(()),
    )
    state = jc.init(system, jc.Method(), jnp.ones(2), jnp.zeros(2))
    new, _ = jc.step(system, jc.Method(solver=solver), state, None, 1e-3)
    assert new.status == jc.Status.SINGULAR


def test_a_policy_that_fails_in_one_world_does_not_spoil_the_others():
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("b", mass=1.0, inertia=1.0, position=(1.0, 0.0), angle=0.3)
    scene.add(jc.forces.ExternalWrench("w", "b"))
    system, state = scene.build()

    def final(theta, c):
        def policy(s):
            return theta * jnp.stack([0 * c, 0 * c, jnp.sqrt(c) * s.q[2] + 1])

        return jnp.sum(jc.rollout(system, jc.Method(), state, policy, 1e-2, 5)[0].q)

    def gradient(cs):
        return jax.grad(lambda x: jnp.sum(jax.vmap(final, (None, 0))(x, cs)))(0.7)

    sick, healthy = jnp.array([1.0, -1.0, 2.0]), jnp.array([1.0, 2.0])
    np.testing.assert_allclose(gradient(sick), gradient(healthy), rtol=1e-12)


def test_second_derivatives_are_those_of_the_worlds_that_do_not_fail():
    """Combines forward and reverse mode in every order, by numbers that all worlds share."""
    s = jc.Scene(dim=2)
    s.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    s.add(jc.Distance("rod", jc.WORLD, "bob"))
    s.add(jc.Spring("spring", jc.WORLD, "bob", stiffness=5.0, point_a=(0.0, 1.0)))
    system, state = s.build()
    whole = np.array([[0.0, 0.1], [np.nan, 0.0], [0.0, -0.2], [1e200, 0.0]])

    def total(shared, starts):
        own = system.with_params({"spring": {"stiffness": shared[0]}, "bob": {"mass": shared[2]}})

        def one(v):
            begin = dataclasses.replace(state, v=v)
            final, _ = jc.rollout(own, jc.Method(), begin, None, shared[1], 3)
            value = jnp.sum(final.q * final.v) + jnp.sum(final.q**3)
            return jnp.where(final.status == jc.Status.OK, value, 0.0), final.status

        values, status = jax.vmap(one)(starts)
        return jnp.sum(values), status

    shared = jnp.array([5.0, 1e-2, 1.0])
    assert list(total(shared, whole)[1] == jc.Status.OK) == [True, False, True, False]

    def value(starts, shared):
        return total(shared, starts)[0]

    alone = jax.jit(jax.hessian(functools.partial(value, whole[::2])))(shared)
    assert np.max(np.abs(alone)) > 1e-3
    modes = jax.jacfwd, jax.jacrev
    for one, two in itertools.product(modes, modes):
        found = jax.jit(two(one(functools.partial(value, whole))))(shared)
        np.testing.assert_allclose(found, alone, rtol=1e-9, atol=1e-12)


@pytest.fixture(scope="module")
def swing():
    """Returns the function (policy, shared numbers, own number of a world) → final value."""
    s = jc.Scene(dim=2)
    s.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    s.add(jc.Distance("rod", jc.WORLD, "bob"))
    s.add(jc.forces.ExternalWrench("push", "bob"))
    system, state = s.build()

    def value(policy, shared, own):
        changed = system.with_params({"bob": {"mass": shared[1]}})
        begin = dataclasses.replace(state, v=jnp.stack([0 * own, 0.1 * own]))
        controls = functools.partial(policy, shared, own)
        final, _ = jc.rollout(changed, jc.Method(), begin, controls, shared[2], 3)
        return jnp.sum(final.q * final.v) + jnp.sum(final.q**3)

    return value


@pytest.mark.parametrize("inside", [False, True])
def test_second_derivatives_through_a_policy_are_those_of_the_worlds_that_do_not_fail(
    swing, inside
):
    """Combines forward and reverse mode in every order, outside of the batch and inside."""

    def policy(shared, own, s):
        return shared[0] * jnp.stack([jnp.sin(s.v[1]), jnp.sqrt(own * shared[0]) * s.q[0]])

    def second(one, two, own):
        def each(shared, own):
            return swing(policy, shared, own)

        if inside:
            return jnp.sum(jax.vmap(two(one(each)), (None, 0))(shared, own), 0)
        return two(one(lambda x: jnp.sum(jax.vmap(each, (None, 0))(x, own))))(shared)

    shared, own = jnp.array([0.7, 1.0, 1e-2]), np.array([1.0, -1.0, 2.0])
    modes = jax.jacfwd, jax.jacrev
    alone = sum(jax.jit(jax.hessian(functools.partial(swing, policy)))(shared, x) for x in own[::2])
    assert np.min(np.abs(alone)) > 1e-6
    for one, two in itertools.product(modes, modes):
        found = jax.jit(functools.partial(second, one, two))(own)
        np.testing.assert_allclose(found, alone, rtol=1e-9, atol=1e-12)


def test_a_policy_may_return_what_worlds_share(swing):
    """Controls that are the same in all worlds have derivatives by the shared numbers."""

    def value(shared, own):
        return swing(lambda shared, own, s: shared[:1] * jnp.array([1.0, 2.0]), shared, own)

    shared, own = jnp.array([0.7, 1.0, 1e-2]), np.array([1.0, -1.0, 2.0])
    found = jax.grad(lambda x: jnp.sum(jax.vmap(value, (None, 0))(x, own)))(shared)
    np.testing.assert_allclose(found, sum(jax.grad(value)(shared, x) for x in own), rtol=1e-9)


def test_a_policy_may_branch(swing):
    """All orders of `grad` and `vmap` work, although the other branch has no derivative."""

    def value(shared, own):
        def policy(shared, own, s):
            def root():
                return shared[0] * jnp.stack([s.q[1], jnp.sqrt(own * shared[0]) * s.q[0]])

            return jax.lax.cond(own > 0, root, lambda: shared[0] ** 2 * s.q[::-1])

        return swing(policy, shared, own)

    shared, own = jnp.array([0.7, 1.0, 1e-2]), np.array([1.0, -1.0, 2.0])
    assert np.min(np.abs(assert_batched_either_way(value, shared, own, 1e-9))) > 1e-6


def test_a_policy_may_have_a_derivative_of_its_own(swing):
    """A rule of `custom_vjp` works, although JAX can batch it only before it is differentiated."""

    @jax.custom_vjp
    def clipped(x):
        return x

    clipped.defvjp(lambda x: (x, None), lambda _, y: (jnp.clip(y, -1e-3, 1e-3),))

    def value(shared, own):
        def policy(shared, own, s):
            return clipped(shared[0] * jnp.stack([s.q[1], own * s.q[0]]))

        return swing(policy, shared, own)

    shared, own = jnp.array([0.7, 1.0, 1e-2]), np.array([1.0, -1.0, 2.0])
    free = swing(lambda shared, own, s: shared[0] * jnp.stack([s.q[1], own * s.q[0]]), shared, 1.0)
    assert value(shared, 1.0) == free
    assert_batched_either_way(value, shared, own, 1e-9)


def test_forward_dynamics_of_a_singular_world_does_not_spoil_the_gradient_of_the_others():
    """A rod without length has no direction; its world shares a mass with a healthy one."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=1.0))
    system, state = scene.build()
    rods = jnp.array([[0.0, -1.0], [0.0, 0.0]])
    states = jax.vmap(lambda q: dataclasses.replace(state, q=q))(rods)
    method = jc.Method(solver=jc.solvers.Schur())

    def tension(mass):
        heavy = system.with_params({"bob": {"mass": mass}})
        solve = lambda s: jc.forward_dynamics(heavy, s, None, method, 1e-3)  # noqa: E731
        found = jax.vmap(solve)(states)
        return jnp.sum(jnp.where(found.status[:, None] == 0, found.multipliers, 0)), found.status

    slope, status = jax.grad(tension, has_aux=True)(2.0)
    np.testing.assert_array_equal(status, [jc.Status.OK, jc.Status.SINGULAR])
    np.testing.assert_allclose(slope, -9.81, rtol=1e-12)


def test_a_state_with_multipliers_of_contacts_is_stepped_without_contacts():
    """Multipliers are kept in a scene without contacts.

    In a scene with other rows, they are kept if they are not used, and refused if they are.
    """

    def built(floors):
        scene = jc.Scene(dim=2)
        scene.add_particle("ball", mass=1.0, position=(0.0, 0.1))
        for i in range(floors):
            scene.add(jc.PlaneContact(f"floor_{i}", jc.WORLD, "ball", radius=0.1))
        return scene.build()

    method = jc.Method(contact_solver=jc.solvers.GaussSeidel())
    system, state = built(1)
    begun = jc.init(system, method, state.q, state.v)
    bare, _ = built(0)
    for end in (
        jc.step(bare, method, begun, None, 1e-2)[0],
        jc.rollout(bare, method, begun, None, 1e-2, 1)[0],
    ):
        np.testing.assert_allclose(end.v, [0.0, -0.0981], rtol=1e-12)
        assert end.memory.contact_multipliers.shape == (1,)
    exact = jc.Method(contact_solver=jc.solvers.InteriorPoint())
    end, _ = jc.rollout(built(2)[0], exact, begun, None, 1e-2, 1)
    assert end.status == jc.Status.OK
    assert end.memory.contact_multipliers.shape == (1,)
    with pytest.raises(ValueError, match="multipliers of 1 inequality rows, but this scene has 2"):
        jc.step(built(2)[0], method, begun, None, 1e-2)
