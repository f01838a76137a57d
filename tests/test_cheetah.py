"""The half-cheetah: observations, rewards, starts and motions equal Gymnasium's."""

import dataclasses
import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon import environments
from jaxcon.environments.tasks import cheetah

pytest.importorskip("mujoco")
CHEAP = jc.Method(solver=jc.solvers.Schur(), contact_solver=jc.solvers.GaussSeidel(4))
EXACT = 1e-9


@functools.cache
def built():
    """Returns the environment, 256 starts, and the function that places it at (qpos, qvel)."""
    environment = environments.make("HalfCheetah", method=CHEAP)
    starts = jax.jit(jax.vmap(environment.reset))(jax.random.split(jax.random.key(3), 256))
    return environment, starts, jax.jit(jax.vmap(environment.place))


@functools.cache
def peer():
    return gymnasium.make("HalfCheetah-v5").unwrapped


def test_what_is_seen_and_earned_is_what_gymnasium_says():
    """States at the start, near it, and far from it with angles beyond whole turns."""
    (environment, starts, place), other, random = built(), peer(), np.random.default_rng(0)
    size = np.repeat([0.02, 0.15, 3.0], 8)[:, None]
    qpos, qvel = (scale * size * random.normal(size=(24, 9)) for scale in (1, 40))
    qpos[-2:, 2] += (7.0, -20.0)
    there = jax.tree.map(lambda x: x[:24], starts)
    there = dataclasses.replace(there, state=place(jnp.asarray(qpos), jnp.asarray(qvel)))
    actions = random.uniform(-1, 1, (24, 6))
    before = jax.tree.map(lambda x: jnp.roll(x, 1, axis=0), there)
    reward, terminated, _ = jax.jit(jax.vmap(environment.judge))(
        before, jnp.asarray(actions), there
    )
    seen = jax.jit(jax.vmap(environment.observe))(there)
    for i, action in enumerate(actions):
        other.set_state(qpos[i], qvel[i])
        wanted = other._get_rew((qpos[i, 0] - qpos[i - 1, 0]) / other.dt, action)[0]
        np.testing.assert_allclose(seen[i], other._get_obs(), rtol=EXACT, atol=EXACT)
        np.testing.assert_allclose(reward[i], wanted, rtol=EXACT, atol=EXACT)
    assert not terminated.any()


def test_actions_and_their_time_are_gymnasiums():
    environment, other = built()[0], peer()
    assert len(environment.actions) == other.action_space.shape[0]
    assert np.all(np.abs([other.action_space.low, other.action_space.high]) == 1)
    assert float(environment.dt) == other.model.opt.timestep
    assert environment.skip == other.frame_skip
    assert environment.horizon == gymnasium.spec("HalfCheetah-v5").max_episode_steps


def test_episodes_start_as_scattered_as_gymnasiums():
    """Compares the standard deviation of all 2,304 entries together and of each entry."""
    (environment, starts, _), other = built(), peer()
    read = jax.jit(jax.vmap(lambda episode: environment.coordinates(episode)))
    theirs = []
    for seed in range(256):
        other.reset(seed=seed)
        theirs.append((other.data.qpos.copy(), other.data.qvel.copy()))
    for x, y in zip(read(starts), zip(*theirs, strict=True), strict=True):
        assert np.std(x) == pytest.approx(np.std(y), rel=0.05)
        assert np.max(np.abs(x)) == pytest.approx(np.max(np.abs(y)), rel=0.3)
        assert np.min(np.std(x, axis=0)) > 0.85 * np.std(x)
        assert abs(np.mean(x)) < 0.1 * np.std(x)


def test_copies_move_as_gymnasiums_and_stand_on_the_ground():
    """Checks one program thrice: driven high above the ground, with a NaN action, and in a fall.

    With steps of half a millisecond the two integrators hardly differ.
    """
    h, other = 5e-4, gymnasium.make("HalfCheetah-v5").unwrapped
    other.model.opt.timestep, other.frame_skip = h, 16
    environment = environments.make("HalfCheetah", dt=h, skip=16, method=CHEAP)
    envs = environments.GymnasiumVectorEnv(environment, 7, render_mode="rgb_array")
    envs.reset(seed=0)
    qpos, still = 5.0 * np.eye(9)[[1] * 7], np.zeros((7, 9))
    episode = dataclasses.replace(envs.copies.episode, state=built()[2](qpos, still))
    envs.copies = dataclasses.replace(envs.copies, episode=episode)
    actions = np.concatenate([np.eye(6), np.full((1, 6), np.nan)])
    seen, _, _, truncated, info = envs.step(actions)
    rates = []
    for action in actions[:6]:
        other.set_state(qpos[0], still[0])
        rates.append(other.step(action)[0][8:])
    moved = np.abs(rates).max(axis=1, keepdims=True)
    assert np.all(moved > 0.5)
    assert np.max(np.abs(np.asarray(seen[:6, 8:]) - rates) / moved) < 0.02
    assert truncated.tolist() == info["diverged"].tolist() == [False] * 6 + [True]
    seen, _, _, truncated, info = envs.step(np.zeros((7, 6)))
    assert not truncated.any()
    assert not info["diverged"].any()
    assert np.all(seen[:6, 0] > 4)
    assert abs(seen[6, 0]) < 0.1  # was reset

    envs.reset(seed=1)
    envs.environment = dataclasses.replace(environment, dt=jnp.asarray(0.01))
    first = envs.render()[0]
    for _ in range(18):
        seen, *_, info = envs.step(np.zeros((7, 6)))
        assert info["violation"].max() < 0.02
    radii = np.array([capsule.radius for capsule in environment.capsules])
    for i in range(7):
        episode = jax.tree.map(lambda x, i=i: x[i], envs.copies.episode)
        ends, x = cheetah._drawn(environment, episode)
        assert abs(np.min(ends[..., 2] - radii[:, None])) < 1e-3
        (left, right), _ = environment.window(episode)
        assert (left + right) / 2 == pytest.approx(float(x))
    assert np.max(np.abs(seen[:, 8:])) < 0.1
    assert np.any(envs.render()[0] != first)


def test_its_capsules_are_those_of_the_file():
    (environment, starts, _), other = built(), peer()
    start = jax.tree.map(lambda x: x[0], starts)
    ends, _ = cheetah._drawn(environment, start)
    other.set_state(*map(np.asarray, environment.coordinates(start)))
    for g, (capsule, points) in enumerate(zip(environment.capsules, ends, strict=True), 1):
        middle, (radius, half) = np.mean(points, axis=0), other.model.geom_size[g, :2]
        np.testing.assert_allclose(middle, other.data.geom_xpos[g], atol=EXACT)
        assert np.linalg.norm(points[1] - points[0]) == pytest.approx(2 * half)
        assert capsule.radius == radius


def test_where_the_file_comes_from_is_told(monkeypatch):
    monkeypatch.setattr(cheetah, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"half_cheetah.xml comes with .*'jaxcon\[rl,mujoco\]'"):
        environments.make("HalfCheetah")
