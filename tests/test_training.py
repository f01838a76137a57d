"""Small learning examples, returns of policies, and the interface of Brax."""

import dataclasses
import functools
import importlib
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcon import environments

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "examples")]

import learn_apg  # noqa: E402
import learn_ppo  # noqa: E402

from benchmarks import curricula, exploration, training  # noqa: E402


@pytest.fixture(autouse=True)
def promoting():
    """Allows mixed dtypes, because Optax and Brax mix integers and floats."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="module")
def cart():
    return environments.make("CartPole", skip=1, horizon=6)


def test_a_return_is_the_sum_until_an_episode_ends(cart):
    """One episode ends because the cart leaves a short track, another at its time limit."""
    cart = dataclasses.replace(cart, horizon=80)

    def push(seen):
        return jnp.stack([jnp.where(seen[0] > 0, 1.0, 0.0)])

    found = jax.jit(lambda e, k: environments.returns(e, push, k, 4))(cart, jax.random.key(0))
    step, ends = jax.jit(lambda e, a: cart.step(e, a)), []
    for number, earned in enumerate(found):
        episode, total = cart.reset(jax.random.fold_in(jax.random.key(0), number)), 0.0
        for _ in range(80):
            episode, outcome = step(episode, push(cart.observe(episode)))
            total += outcome.reward
            if outcome.terminated | outcome.truncated:
                break
        ends.append(int(episode.steps))
        np.testing.assert_allclose(earned, total, rtol=1e-12)
    assert len(set(ends)) > 1
    with pytest.raises(ValueError, match="has no horizon"):
        environments.returns(dataclasses.replace(cart, horizon=None), push, jax.random.key(0), 1)


def test_analytic_gradients_improve_the_window_they_come_from(cart):
    """Twenty updates from the same copies improve the reward; the gradient equals differences."""
    setting = learn_apg.Setting(0.0, 20, copies=3, window=8, rate=0.02)
    learner = learn_apg.begin(cart, setting, jax.random.key(0))
    update = jax.jit(learn_apg.update, static_argnums=1)
    rewards, start = [], learner
    for _ in range(setting.updates):
        learner, reward = update(cart, setting, learner)
        learner = learner._replace(copies=start.copies, x=start.x, seen=start.seen)
        rewards.append(float(reward))
    assert all(np.diff(rewards) > 0)


def test_advantages_are_sums_of_surprises_until_an_episode_ends():
    setting = learn_ppo.Setting(0.0, 1, discount=0.9)
    random = np.random.default_rng(0)
    now, after, reward = random.normal(size=(3, 6, 2))
    terminated, ended = np.zeros((2, 6, 2), bool)
    terminated[2, 0] = ended[2, 0] = ended[4, 1] = True
    dummy = jnp.zeros(())
    sample = learn_ppo.Sample(dummy, dummy, dummy, reward, dummy, terminated, ended)
    found = learn_ppo.advantages(setting, now, after, sample)
    for copy in range(2):
        for t in range(6):
            total = 0.0
            for k in range(t, 6):
                then = 0.0 if terminated[k, copy] else after[k, copy]
                surprise = 0.1 * reward[k, copy] + 0.9 * then - now[k, copy]
                total += (0.9 * learn_ppo.TRACE) ** (k - t) * surprise
                if ended[k, copy]:
                    break
            np.testing.assert_allclose(found[t, copy], total, rtol=1e-12)


def test_what_led_to_more_becomes_likelier(cart):
    setting = learn_ppo.Setting(0.0, 1, copies=8, window=8, epochs=2, batches=2, rate=3e-3)
    learner = learn_ppo.begin(cart, setting, jax.random.key(0))
    _, samples = learn_ppo.collect(cart, setting, learner, None)
    x, sample = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), (samples.x, samples))
    gain = jax.random.normal(jax.random.key(1), sample.reward.shape)
    after = learn_ppo.improve(setting, learner, (x, sample, gain, gain))
    likely = jax.vmap(functools.partial(learn_ppo.likelihood, after.params))(x, sample.action)
    assert jnp.sum((gain - gain.mean()) * (likely - sample.likely)) > 0
    assert jnp.max(jnp.abs(likely - sample.likely)) < 0.5


def test_the_benchmark_finds_the_first_look_at_the_goal():
    looks = [training.Look(i, 10 * i, float(i), earned) for i, earned in enumerate((1.0, 3.0, 2.0))]
    row = training.Row("CartPole", "ppo", 2.5, [looks, looks[:1]])
    assert row.reached == [looks[1], None]
    assert "| 1 of 2 | 1 to 1 | 10 to 10 |" in str(row)
    assert "| 0 of 2 |" in str(row._replace(goal=4.0))


def test_arms_of_the_study_are_what_they_are_called():
    def stiffness(name):
        arm = curricula.ARMS[name]
        return [float(arm.stiffness(x, r)) for x, r in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0))]

    np.testing.assert_allclose(stiffness("k warmed up from 1e4 to 1e5"), [1e4, 5.5e4, 1e5])
    np.testing.assert_allclose(stiffness("k warmed up from 1e2 to 1e5"), [1e2, 10**3.5, 1e5])
    low, middle, high = stiffness("k by performance, 1e3 to 1e5")
    np.testing.assert_allclose((low, middle, high), [1.66e3, 5.05e4, 9.93e4], rtol=0.01)
    fading = curricula.ARMS["hard, σ = 10 mm exp(−t/τ)"].noise
    np.testing.assert_allclose([fading(0.0), fading(0.25)], [1e-2, 1e-2 / np.e])


def test_a_cart_that_is_pushed_to_the_end_of_its_track_stops_where_limits_say():
    """Pushes with full force, either way, for a second and a half."""
    arms = exploration.arms()

    def pushed(name, push):
        def act(episode, _):
            episode = arms[name].transition(episode, push[None])
            return episode, (arms[name].terminal(episode), arms[name].cart(episode)[0])

        return jax.lax.scan(act, arms[name].reset(jax.random.key(0)), None, 75)[1]

    pushes = jnp.array([1.0, -1.0])
    over, _ = jax.jit(jax.vmap(functools.partial(pushed, "free")))(pushes)
    assert over.any(axis=1).all()
    over, x = jax.jit(jax.vmap(functools.partial(pushed, "feasible")))(pushes)
    assert not over.any()
    np.testing.assert_allclose(x[:, -1], exploration.KEPT * pushes, atol=0.03)


@pytest.mark.filterwarnings("ignore")  # warnings of Brax's own imports
def test_brax_sees_the_same_episodes(cart):
    pytest.importorskip("brax")
    from brax.envs.wrappers.training import wrap

    env = environments.BraxEnv(cart)
    assert (env.observation_size, env.action_size, env.backend) == (5, 1, "jaxcon")
    wrapped, keys = wrap(env, episode_length=3), jax.random.split(jax.random.PRNGKey(0), 2)
    first = state = jax.jit(wrapped.reset)(keys)
    step, ours = jax.jit(wrapped.step), jax.jit(jax.vmap(cart.step))
    episodes, actions = jax.vmap(cart.reset)(keys), jnp.array([[0.5], [-0.2]])
    for i in range(3):
        state = step(state, actions)
        episodes, outcome = ours(episodes, actions)
        np.testing.assert_allclose(state.reward, outcome.reward, rtol=1e-9)
        np.testing.assert_array_equal(state.done, i == 2)
        if i < 2:
            np.testing.assert_allclose(state.obs, outcome.observation, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(state.obs, first.obs)
    assert not jnp.any(state.metrics["diverged"])
    assert jnp.all(step(state, jnp.full((2, 1), jnp.nan)).done)


@pytest.mark.filterwarnings("ignore")  # warnings of Brax's own imports
def test_brax_draws_worlds_for_its_copies(cart):
    pytest.importorskip("brax")
    from brax.envs.wrappers.training import wrap

    keys = jax.random.split(jax.random.PRNGKey(1), 2)

    def drawn(world):
        worlds = jax.vmap(lambda k: environments.vary(world, k, {"cart": {"mass": 0.5}}))(keys)
        return worlds, jax.tree.map(lambda _: 0, worlds)

    wrapped = wrap(environments.BraxEnv(cart), episode_length=3, randomization_fn=drawn)
    push = jnp.ones((2, 1))
    state = jax.jit(wrapped.step)(jax.jit(wrapped.reset)(keys), push)
    worlds, _ = drawn(cart)
    started = jax.vmap(lambda world, key: world.reset(key))(worlds, keys)
    _, outcome = jax.jit(jax.vmap(lambda w, e, a: w.step(e, a)))(worlds, started, push)
    np.testing.assert_allclose(state.obs, outcome.observation, rtol=1e-9, atol=1e-12)
    masses = worlds.system.params["cart"]["mass"]
    assert abs(masses[0] - masses[1]) > 0.05


TRAINED_BY_BRAX = """
import importlib, jax, jax.numpy as jnp
if not hasattr(jax, "device_put_replicated"):  # which Brax 0.14.2 still calls
    copied = lambda x, n: jnp.stack([jnp.asarray(x)] * n)
    jax.device_put_replicated = lambda tree, on: jax.tree.map(lambda x: copied(x, len(on)), tree)
from jaxcon import environments

own = {
    "sac": {"min_replay_size": 16, "max_replay_size": 64, "grad_updates_per_step": 1},
    "ppo": {"unroll_length": 4, "num_minibatches": 2, "num_updates_per_batch": 1},
}
for name, options in own.items():
    train, seen = importlib.import_module(f"brax.training.agents.{name}.train").train, []
    train(
        environment=environments.BraxEnv("CartPole", skip=1), num_timesteps=64, episode_length=8,
        num_envs=4, num_eval_envs=2, num_evals=2, batch_size=8, **options,
        progress_fn=lambda _, metrics: seen.append(metrics))
    before, after = (float(x["eval/episode_reward"]) for x in seen)
    losses = [float(x) for what, x in seen[1].items() if what.endswith("loss")]
    print(name, before, after, losses)
    assert losses and all(jnp.isfinite(x) for x in losses), losses
    assert 0 < before < 8 and 0 < after < 8 and before != after, (before, after)
    assert seen[1]["eval/episode_diverged"] == 0
"""


def test_what_trains_on_brax_trains_on_ours():
    """A few updates run, too few to learn, in float32 as in Brax."""
    pytest.importorskip("brax")
    own = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    program = [sys.executable, "-W", "ignore", "-c", TRAINED_BY_BRAX]
    pipes = {"capture_output": True, "text": True, "cwd": ROOT}
    result = subprocess.run(program, env=own | {"JAX_PLATFORMS": "cpu"}, timeout=400, **pipes)
    assert result.returncode == 0, result.stderr


def test_without_brax_there_is_a_hint(monkeypatch):
    for name in [x for x in sys.modules if x.split(".")[0] == "brax"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "brax", None)
    monkeypatch.delitem(sys.modules, "jaxcon.environments.brax", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'jaxcon\[brax\]'"):
        importlib.import_module("jaxcon.environments.brax")
