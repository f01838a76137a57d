"""Properties of all environments, in pure JAX and behind Gymnasium's interfaces."""

import dataclasses
import functools
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.functional_jax_env import FunctionalJaxEnv
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import JaxToNumpy, RecordEpisodeStatistics
from tolerances import DIFFERENCE

import jaxcon as jc
from jaxcon import environments
from jaxcon.environments import copies

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import environment_peers  # noqa: E402
from benchmarks import environments as benchmark  # noqa: E402

TASKS = list(environments.TASKS)
CHEAP = {
    "CatRighting": {"method": jc.Method(jc.integrators.RATTLE(), solver=jc.solvers.Schur())},
    "FiveBarHopper": {
        "method": jc.Method(solver=jc.solvers.Schur(), contact_solver=jc.solvers.GaussSeidel(2))
    },
    "HalfCheetah": {
        "method": jc.Method(solver=jc.solvers.Schur(), contact_solver=jc.solvers.GaussSeidel(2))
    },
    "StewartBalancing": {"method": jc.Method(solver=jc.solvers.Schur())},
}
"""Options that make a task compile faster."""


def single(task="CartPole", **options):
    return gymnasium.make(f"jaxcon/{task}-v0", **CHEAP.get(task, {}) | options)


def many(n=4, task="CartPole", **options):
    mode = {"vectorization_mode": "vector_entry_point"}
    return gymnasium.make_vec(f"jaxcon/{task}-v0", num_envs=n, **mode, **options)


def pushes(steps, n=4, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, n, 1))


def play(envs, actions):
    """Returns the results of all actions as NumPy arrays."""
    return [jax.tree.map(np.asarray, envs.step(a)) for a in actions]


def same(x, y):
    """Checks bitwise equality."""
    jax.tree.map(np.testing.assert_array_equal, x, y)


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_finds_nothing_to_warn_of(task):
    """Warnings are errors here; the checker of Gymnasium also renders an image."""
    env = single(task)
    check_env(env.unwrapped)
    built = environments.make(task, **CHEAP.get(task, {}))
    assert env.spec.max_episode_steps == built.horizon
    assert len(env.observation_space.low) == len(built.observed)
    assert {c.unit for c in built.observed} <= {"1", "m", "m/s", "rad", "rad/s"}


def test_a_time_limit_is_gymnasiums():
    """`horizon` is refused: Gymnasium's limit overrides it, giving 500 actions instead of 50."""
    assert gymnasium.make("jaxcon/CartPole-v0", max_episode_steps=50).spec.max_episode_steps == 50
    with pytest.raises(ValueError, match="max_episode_steps"):
        gymnasium.make("jaxcon/CartPole-v0", horizon=50)
    with pytest.raises(ValueError, match="max_episode_steps"):
        gymnasium.make_vec("jaxcon/CartPole-v0", num_envs=2, horizon=50)
    assert many(max_episode_steps=-1).environment.horizon is None  # −1 means no limit
    with pytest.raises(ValueError, match="max_episode_steps must be a whole number from 1, got 0"):
        many(max_episode_steps=0)
    with pytest.raises(ValueError, match="num_envs must be a whole number from 1, got 2.5"):
        many(2.5)


def test_a_seed_is_that_of_the_copies_that_a_mask_resets():
    envs, mask = many(3), np.array([True, False, True])
    fresh, _ = envs.reset(seed=5)
    other, _ = envs.reset(seed=6)
    chosen, _ = envs.reset(seed=5, options={"reset_mask": mask})
    np.testing.assert_array_equal(chosen, np.where(mask[:, None], fresh, other))
    assert np.all(np.any(fresh != other, axis=1))


@pytest.mark.parametrize("task", TASKS)
def test_episodes_start_on_the_constraints_and_earn_from_0_to_1(task):
    built = environments.make(task, **CHEAP.get(task, {}))

    def off(key):
        episode = built.reset(key)
        found = jc.violation(built.system, episode.state)
        action = jnp.ones(len(built.actions))
        return found.worst, found.worst_rate, built.judge(episode, action, episode)[0]

    keys = jax.random.split(jax.random.key(0), 16)
    position, rate, reward = jax.jit(jax.vmap(off))(keys)
    assert jnp.max(position) < 1e-12
    assert jnp.max(rate) < 1e-12
    if task != "HalfCheetah":  # the reward of the half-cheetah is Gymnasium's
        assert jnp.all((reward >= 0) & (reward <= 1))
        assert len(jnp.unique(reward)) == len(keys)


def test_float32_stays_float32():
    env = single("FourBarTracking", dtype="float32")
    observation, _ = env.reset(seed=0)
    assert observation.dtype == env.observation_space.dtype == np.float32
    for _ in range(3):
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
    assert observation.dtype == np.float32
    assert not terminated
    assert not truncated
    assert info["status"] == "OK"


def test_a_seed_gives_the_same_rollout_bit_for_bit():
    actions = pushes(12)
    runs = []
    for seed in (3, 3, 4):
        envs = many(max_episode_steps=5)  # every copy has three episodes
        runs.append([envs.reset(seed=seed), play(envs, actions)])
    same(runs[0], runs[1])
    assert np.all(runs[0][0][0] != runs[2][0][0])


def test_a_copy_starts_as_it_does_among_fewer():
    few, more = (np.asarray(many(n).reset(seed=1)[0]) for n in (2, 4))
    same(few, more[:2])


def test_what_was_saved_goes_on_bit_for_bit():
    """Saved states continue beyond the next reset, through a file, and in another object."""
    actions = pushes(12)
    envs = many(max_episode_steps=5)
    envs.reset(seed=0)
    play(envs, actions[:3])
    saved = envs.save()
    kept = pickle.dumps(saved)
    expected = play(envs, actions[3:])
    same(saved["copies"], pickle.loads(kept)["copies"])
    other = many(max_episode_steps=5)
    other.restore(saved)
    same(play(other, actions[3:]), expected)
    same(saved["copies"], pickle.loads(kept)["copies"])
    other.restore(pickle.loads(kept))
    same(play(other, actions[3:]), expected)

    one = single().unwrapped
    one.reset(seed=5)
    one.step(actions[0, 0])
    kept = pickle.dumps(one.save())
    expected = [one.step(a) for a in actions[:3, 0]] + [one.reset()]
    other = single().unwrapped
    other.restore(pickle.loads(kept))
    same([other.step(a) for a in actions[:3, 0]] + [other.reset()], expected)


def test_a_copy_that_diverges_is_truncated_and_reset_and_the_others_do_not_notice():
    actions = pushes(4)
    bad = actions.copy()
    bad[1, 2] = np.nan
    healthy, hit = many(), many()
    for envs in (healthy, hit):
        envs.reset(seed=0)
    expected, found = play(healthy, actions), play(hit, bad)
    others = np.array([0, 1, 3])
    for (*x, _), (*y, _) in zip(expected, found, strict=True):
        same([a[others] for a in x], [a[others] for a in y])
    observation, reward, terminated, truncated, info = found[1]
    assert truncated.tolist() == info["diverged"].tolist() == [False, False, True, False]
    assert jc.Status(info["status"][2]) == jc.Status.NON_FINITE
    assert reward[2] == 0
    assert not terminated.any()
    assert np.isfinite(observation).all()
    same(observation[2], found[0][0][2])  # the last finite observation
    observation, reward, terminated, truncated, info = found[2]
    assert not truncated.any()
    assert not info["diverged"].any()
    assert reward[2] == 0  # the action that resets has no reward
    assert abs(observation[2, 0]) < 0.1  # near the start again
    assert not np.array_equal(observation[2], expected[0][0][2])


def test_one_copy_refuses_what_is_no_action():
    env = single().unwrapped
    env.reset(seed=0)
    for bad in (np.zeros(2), 0.0, [np.nan]):
        with pytest.raises(ValueError, match=r"must be 1 numbers from -1 to 1 \(push"):
            env.step(bad)
    start = env.save()
    far, _, *_ = env.step([5.0])
    env.restore(start)
    same(far, env.step([1.0])[0])  # clipped, as in Gymnasium's pendulum


def test_many_copies_refuse_what_are_no_actions():
    envs = many()
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(4, 1\), got \(4,\)"):
        envs.step(np.zeros(4))
    with pytest.raises(ValueError, match="CartPole: actions must be real numbers, got"):
        envs.step([["left"]] * 4)


def test_what_was_saved_elsewhere_is_refused():
    envs, one = many(), single().unwrapped
    envs.reset(seed=0)
    one.reset(seed=0)
    with pytest.raises(ValueError, match=r"episode\.state\.q as float64\(4, 6\), and .*\(3, 6\)"):
        many(3).restore(envs.save())
    with pytest.raises(ValueError, match="another task, precision or number of copies"):
        single("Parking").unwrapped.restore(one.save())


def test_gymnasiums_wrappers_see_arrays_of_numpy():
    """Episodes have three actions; the fourth action resets."""
    envs = RecordEpisodeStatistics(JaxToNumpy(many(max_episode_steps=3)))
    envs.reset(seed=0)
    seen = [envs.step(action) for action in pushes(8)]
    assert isinstance(seen[0][0], np.ndarray)
    for end in (2, 6):
        found = seen[end][4]["episode"]
        np.testing.assert_array_equal(found["l"], 3)
        np.testing.assert_allclose(found["r"], sum(x[1] for x in seen[end - 2 : end + 1]))


def test_unknown_names_and_options_are_told():
    with pytest.raises(gymnasium.error.NameNotFound):
        gymnasium.make("jaxcon/CartPolo-v0")
    with pytest.raises(ValueError, match="known are CartPole, "):
        environments.make("CartPolo")
    with pytest.raises(TypeError, match="its options are lengths, masses"):
        environments.make("CartPole", length=1.0)
    with pytest.raises(ValueError, match="CartPole: skip must be a whole number from 1, got 0"):
        environments.make("CartPole", skip=0)
    with pytest.raises(ValueError, match="horizon must be a whole number from 1, got -3"):
        environments.make("CartPole", horizon=-3)
    for wrong in ({"masses": (0.3, 0.3)}, {"lengths": 0.6}, {"lengths": (), "masses": ()}):
        with pytest.raises(ValueError, match="lengths and masses must be as many, one for each"):
            environments.make("CartPole", **wrong)
    with pytest.raises(ValueError, match=r"lengths must have shape \(4,\), got \(3,\)"):
        environments.make("FourBarTracking", lengths=(1.0, 0.3, 0.9))
    whole = environments.make("FourBarTracking", lengths=(4, 1, 3, 3))  # dt must stay a float
    assert whole.dt == 5e-3
    with pytest.raises(ValueError, match="built already"):
        environments.make(environments.make("CartPole"), cart=2.0)
    env, envs = single().unwrapped, many()
    for reset in (env.reset, envs.reset):
        with pytest.raises(ValueError, match=r"unknown options \['speed'\]"):
            reset(options={"speed": 1.0})
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step([0.0])
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros((4, 1)))
    with pytest.raises(ValueError, match="render_mode must be None or 'rgb_array'"):
        environments.GymnasiumEnv("CartPole", render_mode="ansi")
    before = envs.np_random.bit_generator.state
    with pytest.raises(ValueError, match="4 bools, got float64"):
        envs.reset(seed=3, options={"reset_mask": np.ones(4)})
    assert envs.np_random.bit_generator.state == before


def test_time_is_up_for_one_copy_and_for_many():
    env = single(max_episode_steps=3)
    env.reset(seed=0)
    assert [env.step([0.0])[3] for _ in range(3)] == [False, False, True]
    envs = many(max_episode_steps=3)
    start, _ = envs.reset(seed=0)
    seen = play(envs, np.zeros((8, 4, 1)))
    assert [bool(x[3].all()) for x in seen] == [i in (2, 6) for i in range(8)]
    assert [bool(x[3].any()) for x in seen] == [i in (2, 6) for i in range(8)]
    assert np.all(seen[3][1] == 0)  # the action that resets
    assert np.all(seen[2][1] > 0)
    assert np.all(seen[3][0] != start)  # with new keys


def test_when_copies_are_reset_is_a_choice():
    """Each reset mode reports the same motion, with the first observation at its own call."""
    actions = pushes(4)
    seen = {}
    for mode in ("NextStep", "SameStep", "Disabled"):
        envs = many(max_episode_steps=3, autoreset_mode=mode)
        assert envs.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode(mode)
        envs.reset(seed=0)
        seen[mode] = play(envs, actions)
    close = functools.partial(np.testing.assert_allclose, rtol=0, atol=1e-15)  # three programs
    close(seen["SameStep"][2][4]["final_obs"], seen["NextStep"][2][0])
    close(seen["SameStep"][2][0], seen["NextStep"][3][0])
    jax.tree.map(close, seen["Disabled"][2][:4], seen["NextStep"][2][:4])
    assert seen["Disabled"][3][3].all()  # stays over
    before = np.asarray(envs.copies.episode.steps)
    mask = np.array([True, False, False, True])
    observation, _ = envs.reset(options={"reset_mask": mask})
    assert np.asarray(envs.copies.episode.steps).tolist() == np.where(mask, 0, before).tolist()
    assert np.all(np.abs(np.asarray(observation)[mask, 0]) < 0.1)


def test_a_mode_that_is_unknown_is_told():
    """Gymnasium's enumeration is refused: it equals no mode name and would never reset a copy."""
    environment = environments.make("CartPole")
    start, _ = copies.begin(environment, jax.random.key(0), 2)
    for mode in ("next_step", gymnasium.vector.AutoresetMode.NEXT_STEP):
        with pytest.raises(ValueError, match="mode must be one of NextStep, SameStep, Disabled"):
            environments.advance(environment, start, jnp.zeros((2, 1)), mode)


def heavier(environment, key):
    mass = jax.random.uniform(key, (), minval=1.0, maxval=2.0)
    changed = environment.system.with_params({"cart": {"mass": mass}})
    return dataclasses.replace(environment, system=changed)


def test_worlds_are_drawn_afresh_for_each_copy_and_episode():
    envs = many(max_episode_steps=2, randomize=heavier)
    envs.reset(seed=0)

    def masses():
        world = envs.copies.world
        return np.asarray(jax.vmap(lambda w: w.system.params["cart"]["mass"])(world))

    first = masses()
    assert len(set(first)) == 4
    play(envs, np.zeros((2, 4, 1)))
    same(masses(), first)
    envs.step(np.zeros((4, 1)))
    assert np.all(masses() != first)
    assert np.all((masses() >= 1) & (masses() <= 2))


def test_numbers_of_an_environment_can_be_changed_without_a_new_trace():
    environment = environments.make("CartPole")
    episode = environment.reset(jax.random.key(0))
    traces = []

    @jax.jit
    def step(environment, episode):
        traces.append(1)
        return environment.step(episode, jnp.ones(1))[1].observation

    light = step(environment, episode)
    changed = environment.system.with_params({"cart": {"mass": 5.0}})
    heavy = step(dataclasses.replace(environment, system=changed), episode)
    assert len(traces) == 1
    assert 3 < light[1] / heavy[1] < 5  # speeds after one push without and with a load


def test_gymnasium_drives_the_functional_interface():
    env = FunctionalJaxEnv(environments.FunctionalEnv("CartPole"))
    observation, info = env.reset(seed=0)
    for _ in range(3):
        assert np.asarray(observation) in env.observation_space
        observation, reward, terminated, _, info = env.step(np.ones(1))
    assert observation[1] > 0
    assert 0 <= reward <= 1
    assert not terminated
    assert not info["diverged"]


def test_params_of_the_functional_interface_make_worlds():
    functional = environments.FunctionalEnv("CartPole")
    lengths = jnp.array([[0.4], [0.8]])
    build = functools.partial(environments.CartPole.build, skip=20)
    worlds = jax.jit(jax.vmap(lambda x: build(lengths=x)))(lengths)

    @jax.jit
    @jax.vmap
    def speed(world):
        episode = functional.initial(jax.random.key(0), world)
        episode = functional.transition(episode, jnp.ones(1), None, world)
        return functional.observation(episode, None, world)[1]

    found = speed(worlds)
    assert abs(found[0] - found[1]) > 1e-3


def test_reward_is_differentiated_through_actions_and_physics():
    environment = environments.make("CartPole", skip=4)
    episode = environment.reset(jax.random.key(1))

    def earned(numbers):
        changed = environment.system.with_params({"cart": {"mass": numbers[0]}})
        world = dataclasses.replace(environment, system=changed)
        return world.step(episode, numbers[1:])[1].reward

    at, step, value = jnp.array([1.2, 0.3]), 1e-5, jax.jit(earned)
    nudged = [value(at + e) - value(at - e) for e in step * jnp.eye(2)]
    found = jax.jit(jax.grad(earned))(at)
    np.testing.assert_allclose(found, np.array(nudged) / (2 * step), rtol=DIFFERENCE)


def test_a_picture_shows_where_the_episode_stands():
    env = single("CartPole", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.dtype == np.uint8
    assert first.shape[2] == 3
    same(env.render(), first)
    for _ in range(20):
        env.step([1.0])
    assert np.any(env.render() != first)
    env.close()
    envs = many(2, render_mode="rgb_array")
    envs.reset(seed=0)
    left, right = envs.render()
    assert left.shape == right.shape == first.shape
    assert np.any(left != right)


def test_without_gymnasium_there_are_pure_functions_and_a_hint():
    program = """
import sys
sys.modules["gymnasium"] = None
import jaxcon as jc
assert "Parking" in jc.environments.TASKS
try:
    jc.environments.GymnasiumEnv
except ImportError as error:
    assert "jaxcon[rl]" in str(error), error
else:
    raise AssertionError("no error")
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_whoever_is_chosen_starts_as_its_key_says():
    """Resets chosen copies: none, all, and numbers around the three sizes that are compiled."""
    environment, count = environments.make("CartPole"), 400
    start, _ = jax.jit(copies.begin, static_argnums=(2,))(environment, jax.random.key(0), count)
    expected = jax.jit(jax.vmap(environment.reset))(start.episode.key).state.q
    restart, order = jax.jit(copies.restart), np.random.default_rng(1).permutation(count)
    for number in (0, 1, 64, 65, 100, 101, 400):
        chosen = order < number
        after = restart(environment, start, jnp.asarray(chosen)).episode.state.q
        np.testing.assert_allclose(after[chosen], expected[chosen], rtol=1e-14)
        assert np.all(after[chosen, 0] != start.episode.state.q[chosen, 0])
        same(after[~chosen], start.episode.state.q[~chosen])


def test_copies_that_are_simulated_by_lots_move_as_all_at_once(monkeypatch):
    environment = environments.make("CartPole")
    start, _ = copies.begin(environment, jax.random.key(0), 6)
    actions = jnp.linspace(-1.0, 1.0, 6)[:, None]

    def places(count, x):
        monkeypatch.setattr(environments.CartPole, "at_once", count)
        return copies.simulate(environment, start, x).state.q

    programs = (str(jax.make_jaxpr(functools.partial(places, n))(actions)) for n in (6, 3))
    once, lot_by_lot = (program.count("scan[") for program in programs)
    assert lot_by_lot == once + 1
    whole, lots = places(6, actions), places(3, actions)
    np.testing.assert_allclose(lots, whole, rtol=1e-6, atol=1e-6)
    slopes = (jax.grad(lambda x, n=n: jnp.sum(places(n, x)[:, 0]))(actions) for n in (6, 3))
    np.testing.assert_allclose(*slopes, rtol=1e-5)
    sizes = [copies.chunk_size(count, 128) for count in (100, 128, 1000, 4096, 4099)]
    assert sizes == [None, None, 125, 128, None]


def test_restarts_are_differentiated():
    """A reset copy does not depend on its previous state; the others do."""
    environment = environments.make("CartPole")
    start, _ = copies.begin(environment, jax.random.key(0), 3)
    chosen = jnp.array([False, True, False])

    def total(q):
        episode = start.episode
        state = dataclasses.replace(episode.state, q=q)
        moved = dataclasses.replace(start, episode=dataclasses.replace(episode, state=state))
        return jnp.sum(copies.restart(environment, moved, chosen).episode.state.q)

    slope = jax.jit(jax.grad(total))(start.episode.state.q)
    same(slope, np.where(chosen[:, None], 0.0, np.ones_like(slope)))


def test_the_benchmark_counts_what_it_says():
    row = benchmark.measure("CartPole", copies=8, steps=2, repeats=1)
    assert row.skip == 2
    assert row.resets == 0
    np.testing.assert_allclose(row.share, row.interface / row.bare)


def test_a_row_beside_others_counts_what_it_says():
    case = environment_peers.Case("pole", "gymnasium", "InvertedPendulum-v5", "sync", 2)
    run = environment_peers.measure(case, enough=0.0, repeats=1)
    assert (run.copies, run.action, run.steps) == (2, 0.04, 2)
    assert run.rate.least > 0
    told = environment_peers.line(case, run)
    assert told.endswith(f" {0.04 * run.rate.median:.3g} s/s |")
    assert told.count("|") == environment_peers.HEAD.splitlines()[1].count("|")
    assert environment_peers.line(case, "fails").count("|") == told.count("|")
