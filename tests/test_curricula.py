"""Curricula of environments: schedules, random worlds, feasible actions, layers of control."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize
from tolerances import DIFFERENCE

import jaxcon as jc
from jaxcon import environments
from jaxcon.core.pytree import pytree
from jaxcon.environments import exploration
from jaxcon.environments.tasks.cart_pole import CartPole


@pytest.fixture(scope="module")
def cart():
    return environments.make("CartPole")


def test_schedules_have_their_closed_forms():
    t = jnp.array([0.0, 10.0, 20.0])
    np.testing.assert_allclose(environments.decay(t, 0.5, 10.0), 0.5 * np.exp([0.0, -1.0, -2.0]))
    episodes = jnp.array([0, 99, 100, 150, 200, 900])
    found = environments.warm_up(episodes, 100, 200)
    np.testing.assert_allclose(found, [0.1, 0.1, 0.1, 0.55, 1.0, 1.0])
    found = environments.by_performance(jnp.array([-1e3, 2.0, 5.0, 1e3]), 10.0, 110.0, 2.0, 3.0)
    half = 1 / (1 + np.exp(-1.0))
    np.testing.assert_allclose(found, [10.0, 60.0, 10.0 + 100.0 * half, 110.0])
    slope = jax.grad(lambda p: environments.by_performance(p, 1.0, 2.0))(0.0)
    np.testing.assert_allclose(slope, 0.25)


def test_schedules_refuse_what_has_no_meaning():
    with pytest.raises(ValueError, match="time must be positive"):
        environments.decay(1.0, 1.0, 0.0)
    with pytest.raises(ValueError, match="end must lie beyond begin"):
        environments.warm_up(1, 200, 100)
    with pytest.raises(ValueError, match="width must be positive"):
        environments.by_performance(1.0, 1.0, 2.0, width=-1.0)


def test_stiffness_goes_into_leaves_and_constraints_give_way_as_hookes_law_says(cart):
    """Springs under the rail sag by m g/k; one trace serves all stiffnesses of a curriculum."""
    episode = cart.reset(jax.random.key(0))
    traces = []

    @jax.jit
    def sag(k):
        traces.append(1)
        soft = environments.with_stiffness(cart, {"rail": k}, {"rail": 0.3 * k})
        soft = dataclasses.replace(soft, skip=300)
        state = jc.init(soft.system, soft.method, episode.state.q, episode.state.v)
        after = soft.transition(dataclasses.replace(episode, state=state), jnp.zeros(1))
        return jc.position(soft.system, after.state, "cart")[1]

    for k in (1e3, 4e3):
        np.testing.assert_allclose(sag(k), -1.3 * 9.81 / k, rtol=0.02)
    assert len(traces) == 1


def test_numbers_vary_within_their_shares_and_by_copy(cart):
    shares = {"cart": {"mass": 0.2}, "pole1": {"mass": 0.5, "inertia": 0.5}}

    @jax.jit
    @jax.vmap
    def drawn(key):
        params = environments.vary(cart, key, shares).system.params
        return params["cart"]["mass"], params["pole1"]["mass"], params["pole1"]["inertia"]

    found = drawn(jax.random.split(jax.random.key(0), 400))
    for x, nominal, share in zip(found, (1.0, 0.3, 0.009), (0.2, 0.5, 0.5), strict=True):
        factor = np.asarray(x).ravel() / nominal
        assert np.all(np.abs(factor - 1) <= share)
        assert np.ptp(factor) > 1.9 * share
        assert abs(np.mean(factor) - 1) < 4 * share / np.sqrt(3 * 400)
    assert abs(np.corrcoef(found[1], np.ravel(found[2]))[0, 1]) < 0.2
    with pytest.raises(ValueError, match="'pole1' has no 'length', it has"):
        environments.vary(cart, jax.random.key(0), {"pole1": {"length": 0.1}})
    with pytest.raises(ValueError, match=r"'gravity' has no numbers; .* \['cart', 'pivot1', "):
        environments.vary(cart, jax.random.key(0), {"gravity": {"y": 0.1}})
    with pytest.raises(ValueError, match="'pole9' has no numbers"):
        environments.vary(cart, jax.random.key(0), {"pole9": {"mass": 0.1}})


def test_noise_moves_what_constraints_ask_for(cart):
    @jax.jit
    @jax.vmap
    def off(key):
        own, key = jax.random.split(key)
        world = environments.jitter(cart, own, {"pivot1": {"anchor_b": 1e-3}})
        episode = world.reset(key)
        return jc.violation(world.system, episode.state)["pivot1"]

    found = np.asarray(off(jax.random.split(jax.random.key(0), 400)))
    np.testing.assert_allclose(np.sqrt(np.mean(found**2)), np.sqrt(2) * 1e-3, rtol=0.15)


def test_projection_is_the_nearest_point():
    """Nearest points at a corner, on an edge, inside, and with dependent or contradictory rows."""
    rows = jnp.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [2.0, 2.0]])
    bounds = jnp.array([1.0, 1.0, 1.5, 3.0])
    cases = {(3.0, 0.2): (1.0, 0.2), (2.0, 2.0): (0.75, 0.75), (-1.0, 0.3): (-1.0, 0.3)}
    cases |= {(2.0, 0.9): (1.0, 0.5), (0.9, 0.9): (0.75, 0.75)}
    project = jax.jit(exploration.project)
    for x, nearest in cases.items():
        np.testing.assert_allclose(project(jnp.array(x), rows, bounds), nearest, atol=1e-6)
    rows, bounds = jnp.array([[1.0], [-1.0]]), jnp.array([-1.0, -1.0])  # a ≤ −1 and a ≥ 1
    assert abs(float(project(jnp.array([5.0]), rows, bounds)[0])) < 1e-3
    single = [jnp.asarray(x, jnp.float32) for x in ((2.0, 2.0), np.eye(2), (1.0, 1.0))]
    found = project(*single)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, 1.0, atol=1e-3)


def test_projection_is_that_of_an_active_set_method():
    project, random = jax.jit(exploration.project), np.random.default_rng(0)
    for _ in range(5):
        rows, bounds = random.normal(size=(12, 6)), random.uniform(0.05, 1.0, 12)
        x = 3 * random.normal(size=6)
        inside = {"type": "ineq", "fun": lambda a, G=rows, h=bounds: h - G @ a}
        least = optimize.minimize(
            lambda a, x=x: np.sum((a - x) ** 2) / 2,
            np.zeros(6),
            method="SLSQP",
            constraints=[inside],
            options={"ftol": 1e-14, "maxiter": 300},
        )
        np.testing.assert_allclose(project(x, rows, bounds), least.x, atol=1e-6)


def test_projection_has_the_derivative_of_the_nearest_point():
    rows, bounds = jnp.array([[1.0, 1.0], [1.0, 0.0]]), jnp.array([1.5, 4.0])
    x = jnp.array([2.0, 1.0])
    slope = jax.jit(jax.jacobian(exploration.project, argnums=(0, 2)))(x, rows, bounds)
    np.testing.assert_allclose(slope[0], [[0.5, -0.5], [-0.5, 0.5]], atol=1e-6)
    np.testing.assert_allclose(slope[1], [[0.5, 0.0], [0.5, 0.0]], atol=1e-6)


def slow(episode, most):
    """Returns the limit of the cart's speed (≤ 0 if satisfied); v[0] is the cart's velocity."""
    return jnp.stack([episode.state.v[0] - most, -episode.state.v[0] - most])


def test_actions_and_noise_are_taken_as_far_as_limits_allow(cart):
    """A push of 20 N on 1.3 kg adds 0.15 m/s in a step of 10 ms, which is a linear problem."""
    assert cart.system.layout.v("cart")[0] == 0
    world = dataclasses.replace(cart, skip=1)
    episode = world.reset(jax.random.key(0))

    def held(wanted, noise, most):
        limits = functools.partial(slow, most=most)
        return environments.feasible_action(world, episode, wanted[None], limits, noise)[0]

    def along(*x):
        return jax.jvp(held, x, tuple(map(jnp.ones_like, x)))

    both = jax.jit(along)  # also the derivative along (1, 1, 1)
    speed = jax.jit(lambda a: world.transition(episode, a[None]).state.v[0])
    wanted, noise, most = jnp.asarray(0.3), jnp.asarray(0.05), jnp.asarray(0.1)
    action, slope = both(wanted, noise, most)  # within the limits
    np.testing.assert_allclose(action, 0.35, atol=1e-6)
    np.testing.assert_allclose(slope, 2.0, atol=DIFFERENCE)
    action, slope = both(wanted, noise + 5.0, most)
    assert action < 0.9
    np.testing.assert_allclose(speed(action), 0.1, atol=1e-6)
    farther, _ = both(wanted, noise + 5.0, most + 0.01)  # the derivative by the limit alone
    np.testing.assert_allclose(slope, (farther - action) / 0.01, rtol=DIFFERENCE)
    action, _ = both(wanted - 5.0, noise, most)
    np.testing.assert_allclose(speed(action), -0.1, atol=1e-6)
    action, _ = both(wanted, noise + 5.0, most + 10.0)
    np.testing.assert_allclose(action, 1.0, atol=1e-6)  # the bound of actions


def test_limits_are_kept_in_whichever_unit_they_are(cart):
    """The push could move the cart by 1.5 mm. The limit holds in any unit, also in float32."""
    world = environments.make("CartPole", skip=1, dtype="float32")
    episode = world.reset(jax.random.key(0))
    start = episode.state.q[:1]

    @jax.jit
    def held(unit):
        def limits(episode):
            return unit * (episode.state.q[:1] - start - 5e-4)

        action = environments.feasible_action(world, episode, jnp.ones(1, "float32"), limits)
        return action[0], world.transition(episode, action).state.q[0] - start[0]

    for unit in (1e-4, 1.0, 1e4):
        action, moved = held(jnp.float32(unit))
        assert -1 < action < 0.9
        np.testing.assert_allclose(moved, 5e-4, atol=1e-6)


def cruise(environment, episode, target):
    """A controller that drives the cart at a target speed of up to 1 m/s."""
    speed = jc.velocity(environment.system, episode.state, "cart")[0]
    return 2.0 * (target - speed[None])


def test_a_slow_policy_sets_what_a_fast_controller_follows(cart):
    layered = environments.Layered.build(cart, cruise, ("speed, of 1 m/s",), hold=10)
    assert layered.horizon == 50
    step = jax.jit(lambda world, episode, action: world.step(episode, action))
    episode, outcome = step(layered, layered.reset(jax.random.key(0)), jnp.array([0.4]))
    assert episode.steps == 1
    np.testing.assert_allclose(outcome.observation[1], 0.4, atol=0.05)
    np.testing.assert_allclose(episode.state.time, 10 * cart.skip * cart.dt)
    changed = layered.system.with_params({"push": {"gear": 0.0}})
    still, _ = step(dataclasses.replace(layered, system=changed), episode, jnp.array([-0.4]))
    assert jc.velocity(cart.system, still.state, "cart")[0] > 0.2  # nothing brakes it
    with pytest.raises(ValueError, match="hold must be a whole number from 1"):
        environments.Layered.build(cart, cruise, ("speed",), hold=0)


@pytree
class Passing(CartPole):
    """A task that is over only at the end of the third action."""

    def terminal(self, episode):
        return jnp.round(episode.state.time / (self.skip * self.dt)) == 3


def test_a_target_ends_where_the_task_is_over_on_the_way(cart):
    values = {f.name: getattr(cart, f.name) for f in dataclasses.fields(cart)}
    layered = environments.Layered.build(Passing(**values), cruise, ("speed",), hold=10)
    episode, outcome = jax.jit(layered.step)(layered.reset(jax.random.key(0)), jnp.array([0.4]))
    np.testing.assert_allclose(episode.state.time, 3 * cart.skip * cart.dt)
    assert outcome.terminated


@pytree
class Racing(CartPole):
    """A task whose reward is the mean speed during an action, as in the half-cheetah."""

    def reward(self, before, action, after):
        came, went = (episode.state.q[0] for episode in (before, after))
        return (went - came) / (self.skip * self.dt)


def test_a_reward_by_time_is_over_the_time_of_a_target(cart):
    values = {f.name: getattr(cart, f.name) for f in dataclasses.fields(cart)}
    layered = environments.Layered.build(Racing(**values), cruise, ("speed",), hold=10)
    start = layered.reset(jax.random.key(0))
    episode, outcome = jax.jit(layered.step)(start, jnp.array([0.4]))
    seconds = 10 * cart.skip * cart.dt
    moved = episode.state.q[0] - start.state.q[0]
    np.testing.assert_allclose(outcome.reward, moved / seconds, rtol=1e-12)
