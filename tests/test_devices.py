"""A batch on several devices, or in two processes, gives the same numbers as on one."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "many_devices.py"
CHEAP = os.environ["XLA_FLAGS"]
LIMIT = 400
"""Time limit of a process [s], generous for a busy machine."""


def started(*options):
    """Starts a process without JAX and XLA variables of this one."""
    own = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    own |= {"JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu", "XLA_FLAGS": CHEAP}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, *map(str, options)], env=own, cwd=ROOT, **pipes)


def finished(*processes):
    """Returns the outputs of processes; fails with their error messages."""
    try:
        outputs = [process.communicate(timeout=LIMIT) for process in processes]
    except subprocess.TimeoutExpired:
        for process in processes:
            process.kill()
        said = "\n".join(process.communicate()[1] for process in processes)
        pytest.fail(f"not done after {LIMIT} s:\n{said}")
    for process, (_, complaint) in zip(processes, outputs, strict=True):
        assert process.returncode == 0, complaint
    return [output for output, _ in outputs]


def free_port():
    """Returns a port on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]


def test_two_processes_get_the_numbers_of_one(tmp_path):
    """Compares final states, loss, gradient, and each step of a search, in the example."""
    files = tmp_path / "two.npz", tmp_path / "one.npz"
    small = [EXAMPLE, "--worlds", 8, "--steps", 5, "--devices", 1, "--save"]
    joined = ["--coordinator", f"localhost:{free_port()}", "--processes", 2, "--process"]
    printed = finished(*(started(*small, files[0], *joined, i) for i in range(2)))
    assert "2 devices, processes: 2" in printed[0]
    assert "loss" not in printed[1]
    finished(started(*small, files[1]))
    two, one = (np.load(file) for file in files)
    assert two.files == one.files
    assert one["q"].shape == (8, 9)
    assert np.max(np.std(one["q"], axis=0)) > 1e-3
    assert np.min(np.abs([one["d_stiffness"], one["d_damping"]])) > 1e-6
    assert one["history"][-1] < one["history"][0]
    for name in one.files:
        np.testing.assert_allclose(two[name], one[name], rtol=1e-11, atol=1e-13, err_msg=name)


FOUR_DEVICES = """
import jax
jax.config.update("jax_num_cpu_devices", 4)
import dataclasses, jax.numpy as jnp, numpy as np, jaxcon as jc
from benchmarks import devices, mechanisms, roofline
from benchmarks.throughput import worlds

def same(x, y, tolerance=1e-12):
    for a, b in zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)

def met(compiled):
    return devices.exchanges(compiled.as_text())

one, all = (jax.make_mesh((n,), ("x",)) for n in (1, 4))  # Explicit, as JAX makes them
run, state = devices.world("four-bar", 5, jnp.float64)
gain, batch = jnp.asarray(50.0), worlds(state, 8)
apart = jc.shard(batch)
plain = jax.jit(jax.vmap(run, in_axes=(None, 0)))
compiled = plain.lower(gain, apart).compile()
assert met(compiled) == {}
found = compiled(gain, apart)
assert len(found.q.sharding.device_set) == 4
same(found, plain(gain, batch))

compiled = jax.jit(devices.mean(run)).lower(gain, apart).compile()
assert met(compiled) == {"all-reduce": 1}
found, expected = compiled(gain, apart), jax.jit(devices.mean(run, one))(gain, batch)
assert abs(expected[1]) > 1e-6
same(found, expected)

found = roofline.over_all(16, "float32")  # the peak is that of as many cores as the rates
assert found.size == 64 and len(found.sharding.device_set) == 4
assert met(roofline.sweeps(2, 3).lower(found).compile()) == {}
total = jax.jit(lambda x: jnp.sort(x))  # in which devices must meet, and are seen to
assert met(total.lower(apart.time).compile())

def loss(p, key):
    return jnp.sum((p - jax.random.normal(key, (2,))) ** 2)

bowl, key = (lambda p: loss(p, jax.random.key(0))), jax.random.key(1)
for f, own in ((loss, {"samples": 8}), (bowl, {"restarts": 4, "spread": 1.0})):
    own |= {"steps": 12, "key": key}
    a, b = (jc.tune(f, jnp.zeros(2), mesh=m, **own) for m in (None, all))
    same((a.params, a.histories), (b.params, b.histories))

scene = jc.Scene(dim=2)
scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
scene.add(jc.Distance("rod", jc.WORLD, "bob"))
system, start = scene.build()
method = jc.Method(stabilizer=jc.Projection(), solver=jc.solvers.Sparse())  # until all are done
start = jc.init(system, method, start.q, start.v)
swing = jax.vmap(lambda s: jc.step(system, method, s, None, 1e-3)[0])
apart = jc.shard(worlds(start, 4))
together = jax.jit(swing).lower(apart).compile()
assert met(together) == {}
alone = jax.jit(jc.devices.over_devices(lambda _, batch: swing(batch))).lower(0.0, apart).compile()
assert met(alone) == {}
same(alone(0.0, apart), together(apart))

# by default: a branch for bodies that turn fast in space, and one for loops in singular positions
for name in ("chain-5", "four-bar"):
    built, start = mechanisms.find(name).build(jnp.float64)
    turning = dataclasses.replace(worlds(start, 8), v=9.0 * worlds(start, 8).v)
    go = jax.jit(jax.vmap(lambda s: jc.rollout(built, jc.Method(), s, None, 2e-3, 3)[0]))
    compiled = go.lower(jc.shard(turning)).compile()
    assert met(compiled) == {}
    same(compiled(jc.shard(turning)), go(turning))

# chunks of worlds: a chunk has worlds of each device
from jaxcon.execution import rollout
run, state = devices.world("four-bar", 3, jnp.float64)
batch = worlds(state, 40)
expected = jax.jit(jax.vmap(run, in_axes=(None, 0)))(gain, batch)
slope = jax.jit(devices.mean(run, one))(gain, batch)
rollout.chunk_size = lambda velocities: 2
for given, exchanged in ((jc.shard(batch), {}), (batch, {})):
    compiled = jax.jit(jax.vmap(run, in_axes=(None, 0))).lower(gain, given).compile()
    assert met(compiled) == exchanged
    same(compiled(gain, given), expected)
compiled = jax.jit(devices.mean(run)).lower(gain, jc.shard(batch)).compile()
assert met(compiled) == {"all-reduce": 1}
same(compiled(gain, jc.shard(batch)), slope)
total = jax.jit(jax.grad(lambda g, s: jnp.mean(jax.vmap(run, in_axes=(None, 0))(g, s).q)))
compiled = total.lower(gain, jc.shard(batch)).compile()
assert met(compiled) == {"all-reduce": 1}
same(compiled(gain, jc.shard(batch)), total(gain, batch))

def refused(words, function, *args, **own):
    try:
        function(*args, **own)
    except (ValueError, TypeError) as error:
        assert words in str(error), error
    else:
        raise AssertionError(f"not refused: {words}")

refused("10 worlds does not divide over 4 devices; take 12", jc.shard, jnp.ones(10))
refused("must be one of JAX, such as", jc.shard, jnp.ones(4), jax.devices())
whole = jc.devices.over_devices(lambda p, x: x, all)
refused("over_devices: a batch of 6", whole, 0.0, jnp.ones(6))
refused("['t'] of the batch has no first axis", jc.shard, {"t": 1.0, "x": jnp.ones(4)})
refused("must have as many worlds, got", jc.shard, {"x": jnp.ones(4), "y": jnp.ones(8)})
refused("samples=7 does not", jc.tune, loss, 0.0, samples=7, key=key, mesh=all)
"""


def test_four_devices_work_apart_and_sum_gradients_once():
    finished(started("-c", FOUR_DEVICES))


TWO_DEVICES = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
import numpy as np
from benchmarks import devices
from jaxcon import environments
from jaxcon.environments import vector

def made(count):
    return environments.GymnasiumVectorEnv("CartPole", 6, 4, devices=count)

def played(envs, start=None):
    random = np.random.default_rng(0)
    seen = [envs.reset(seed=3) if start is None else envs.restore(start)]
    for _ in range(7):
        seen.append(envs.step(random.uniform(-1, 1, (6, 1))))
    seen.append(envs.reset(options={"reset_mask": np.arange(6) % 3 == 0}))
    return seen

def same(x, y):
    for a, b in zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)

one, two = made(1), made(2)
found = played(two)
same(found, played(one))
assert len(two.copies.episode.state.q.sharding.device_set) == 2
assert len(found[3][0].sharding.device_set) == 2
assert np.asarray(found[4][3]).all()  # each began anew on the way
assert np.any(np.asarray(found[-1][0]) != np.asarray(found[-2][0]))
kept = two.save()
same(played(made(2), start=kept), played(made(1), start=kept))
lowered = vector._advance.lower(
    two.environment, two.copies, two._spread(np.zeros((6, 1))), "NextStep", None, two.mesh)
assert devices.exchanges(lowered.compile().as_text()) == {}

def refused(words, *args, **own):
    try:
        environments.GymnasiumVectorEnv("CartPole", *args, **own)
    except ValueError as error:
        assert words in str(error), error
    else:
        raise AssertionError(f"not refused: {words}")

refused("from 1 to the 2 of JAX, got 3", 6, devices=3)
refused("num_envs=5 does not divide over 2 devices", 5, devices=2)
"""


def test_copies_over_two_devices_get_the_numbers_of_one():
    finished(started("-c", TWO_DEVICES))


A_ROBOT = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
import jax.numpy as jnp
import numpy as np
import jaxcon as jc
from benchmarks import legged

robot = jc.from_mjcf(legged.load("hopper"), dtype=jnp.float32)
method = robot.method()
poses = np.stack([legged.start(legged.load("hopper"), i) for i in range(4)])
states = jax.vmap(lambda q: legged.begun(robot, method, q))(jnp.asarray(poses, jnp.float32))
u = jnp.zeros(robot.system.layout.n_u, jnp.float32)
step = jax.jit(jax.vmap(lambda s: jc.step(robot.system, method, s, u, 0.002)[0]))
together, apart = step(states), step(jc.shard(states))
for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(apart), strict=True):
    np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
"""


def test_a_robot_with_constant_parameters_steps_on_two_devices():
    """Constants of all worlds would be cut by the number of the device, which no kernel knows."""
    pytest.importorskip("mujoco")
    finished(started("-c", A_ROBOT))
