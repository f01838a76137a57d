"""The robots from Gymnasium's files see, earn and end as Gymnasium's own at the same states."""

import dataclasses
import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon import environments
from jaxcon.environments.tasks import runners

pytest.importorskip("mujoco")
PEERS = {"HalfCheetah": "HalfCheetah-v5", "Hopper": "Hopper-v5"}
CHEAP = jc.Method(solver=jc.Sparse(), bounded=jc.GaussSeidel(4))
EXACT = 1e-9


@functools.cache
def built(task):
    return environments.make(task, method=CHEAP)


@functools.cache
def peer(task):
    return gymnasium.make(PEERS[task]).unwrapped


def states(task, count=24):
    """Positions and velocities near the start and far from it, where angles have whole turns."""
    random, at = np.random.default_rng(0), peer(task)
    near = np.repeat([0.02, 0.15, 3.0], count // 3)[:, None]
    qpos = at.init_qpos + near * random.normal(size=(count, at.model.nq))
    qpos[-2:, 2] += (7.0, -20.0)
    return qpos, 40 * near * random.normal(size=(count, at.model.nv))


def episodes(task, qpos, qvel):
    environment = built(task)
    place = jax.jit(jax.vmap(environment.place))
    start = jax.jit(jax.vmap(environment.reset))(jax.random.split(jax.random.key(0), len(qpos)))
    return dataclasses.replace(start, state=place(jnp.asarray(qpos), jnp.asarray(qvel)))


@pytest.mark.parametrize("task", PEERS)
def test_what_is_seen_earned_and_over_is_what_gymnasium_says(task):
    environment, other = built(task), peer(task)
    qpos, qvel = states(task)
    there = episodes(task, qpos, qvel)
    actions = np.random.default_rng(1).uniform(-1, 1, (len(qpos), len(environment.actions)))
    before = jax.tree.map(lambda x: jnp.roll(x, 1, axis=0), there)
    judge = jax.jit(jax.vmap(environment.judge))
    reward, terminated, _ = judge(before, jnp.asarray(actions), there)
    seen = jax.jit(jax.vmap(environment.observe))(there)

    wanted = []
    for i, action in enumerate(actions):
        other.set_state(qpos[i], qvel[i])
        speed = (qpos[i, 0] - qpos[i - 1, 0]) / other.dt
        ends = not getattr(other, "is_healthy", True)
        wanted.append((other._get_obs(), other._get_rew(speed, action)[0], ends))
    observations, rewards, ends = (np.array(x) for x in zip(*wanted, strict=True))
    np.testing.assert_allclose(seen, observations, rtol=EXACT, atol=EXACT)
    np.testing.assert_allclose(reward, rewards, rtol=EXACT, atol=EXACT)
    assert terminated.tolist() == ends.tolist()
    assert set(ends.tolist()) == ({False, True} if task == "Hopper" else {False})


@pytest.mark.parametrize("task", PEERS)
def test_actions_and_their_time_are_gymnasiums(task):
    environment, other = built(task), peer(task)
    assert len(environment.actions) == other.action_space.shape[0]
    assert np.all(np.abs([other.action_space.low, other.action_space.high]) == 1)
    assert float(environment.dt) == other.model.opt.timestep
    assert environment.skip == other.frame_skip
    assert environment.horizon == gymnasium.spec(PEERS[task]).max_episode_steps
    finer = environments.make(task, dt=float(environment.dt) / 2, method=CHEAP)
    assert finer.skip == 2 * environment.skip
    assert finer.speed(*2 * [finer.reset(jax.random.key(0))]) == 0


@pytest.mark.parametrize("task", PEERS)
def test_episodes_start_as_scattered_as_gymnasiums(task):
    """Means and widths of all entries together, of 2,000 numbers and more in each."""
    environment, other = built(task), peer(task)
    keys = jax.random.split(jax.random.key(3), 256)

    def begun(key):
        qpos, qvel = environment.coordinates(environment.reset(key))
        return qpos - environment.tree.reference, qvel

    ours = [np.asarray(x) for x in jax.jit(jax.vmap(begun))(keys)]
    theirs = []
    for seed in range(256):
        other.reset(seed=seed)
        theirs.append((other.data.qpos - other.init_qpos, other.data.qvel - other.init_qvel))
    for x, y in zip(ours, map(np.array, zip(*theirs, strict=True)), strict=True):
        assert np.std(x) == pytest.approx(np.std(y), rel=0.05)
        assert abs(np.mean(x)) < 0.1 * np.std(x)
        assert np.max(np.abs(x)) == pytest.approx(np.max(np.abs(y)), rel=0.3)
        assert np.min(np.std(x, axis=0)) > 0.8 * np.std(x)  # no entry stays where it is


@pytest.mark.parametrize("task", PEERS)
def test_each_motor_turns_what_gymnasiums_does(task):
    """High above the ground; half a millisecond of both integrators apart."""
    h, other = 5e-4, gymnasium.make(PEERS[task]).unwrapped
    environment = environments.make(task, dt=h, skip=16, method=CHEAP)
    other.model.opt.timestep, other.frame_skip = h, 16
    qpos = other.init_qpos + 0.0
    qpos[1] += 5.0
    if task == "Hopper":
        qpos[3:] -= 0.5, 0.5, 0.0  # away from stops
    start = environment.reset(jax.random.key(0))
    state = environment.place(jnp.asarray(qpos), jnp.zeros(other.model.nv))
    start = dataclasses.replace(start, state=state)
    actions = np.eye(len(environment.actions))
    step = jax.jit(jax.vmap(lambda a: environment.step(start, a)[1].observation))
    found = np.asarray(step(jnp.asarray(actions)))[:, other.model.nq - 1 :]
    expected = []
    for action in actions:
        other.set_state(qpos, np.zeros(other.model.nv))
        expected.append(other.step(action)[0][other.model.nq - 1 :])
    moved = np.abs(expected).max(axis=1, keepdims=True)
    assert np.all(moved > 0.05)
    assert np.max(np.abs(found - expected) / moved) < 0.02


def test_copies_run_and_one_that_diverges_is_begun_anew():
    """A cheetah behind the vector interface: it falls on the ground, moves, and is drawn."""
    envs = environments.GymnasiumVectorEnv(built("HalfCheetah"), 3, render_mode="rgb_array")
    start, _ = envs.reset(seed=0)
    first = envs.render()
    random = np.random.default_rng(0)
    for i in range(12):
        actions = random.uniform(-1, 1, (3, 6))
        if i == 10:
            actions[1] = np.nan
        seen, reward, terminated, truncated, info = envs.step(actions)
        assert truncated.tolist() == info["diverged"].tolist() == [False, i == 10, False]
        assert not terminated.any()
        assert np.isfinite(seen).all()
        assert (reward[1] == 0) == (i >= 10)
    assert np.abs(seen[1, :8]).max() < 0.1 < np.abs(seen[0, :8]).max()
    low = min(float(runners._drawn(envs.environment, e)[0][..., 2].min()) for e in each(envs, 3))
    assert 0.0 < low < 0.3
    assert np.any(envs.render()[0] != first[0])
    assert info["violation"].max() < 0.02


def each(envs, n):
    return [jax.tree.map(lambda x, i=i: x[i], envs.copies.episode) for i in range(n)]


def test_a_picture_follows_the_robot():
    environment = built("HalfCheetah")
    qpos = environment.tree.reference.at[0].set(7.25)
    episode = environment.reset(jax.random.key(0))
    moved = dataclasses.replace(episode, state=environment.place(qpos, 0 * qpos))
    (left, right), _ = environment.window(moved)
    assert (left + right) / 2 == pytest.approx(7.25)
    (ends, _), other = runners._drawn(environment, moved), peer("HalfCheetah")
    other.set_state(np.asarray(qpos), np.zeros(len(qpos)))
    for capsule, points in zip(environment.capsules, np.asarray(ends), strict=True):
        ours = points.mean(axis=0)
        geoms = range(1, other.model.ngeom)
        distance = [np.linalg.norm(other.data.geom_xpos[g] - ours) for g in geoms]
        assert min(distance) < 1e-9, capsule.body
        g = geoms[int(np.argmin(distance))]
        length = np.linalg.norm(points[1] - points[0])
        assert length == pytest.approx(2 * other.model.geom_size[g, 1])


def test_where_the_file_comes_from_is_told(monkeypatch):
    monkeypatch.setattr(runners, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"half_cheetah.xml comes with .*'jaxcon\[rl,mujoco\]'"):
        environments.make("HalfCheetah")
