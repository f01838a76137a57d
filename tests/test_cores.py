"""`use_all_cores` in processes of its own, and results with `compiler_options`."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.core import cores

ROOT = Path(__file__).parents[1]

PROGRAM = """
import os
import jaxcon as jc
count = jc.use_all_cores(COUNT)
import jax, jax.numpy as jnp
assert jax.device_count() == count, jax.devices()
assert int(os.environ["PJRT_NPROC"]) == 2 * count
assert jc.use_all_cores(count) == count
scene = jc.Scene(dim=2)
scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
scene.add(jc.Distance("rod", jc.WORLD, "bob"))
system, state = scene.build()
def run(v):
    start = jc.init(system, jc.Method(), state.q, v)
    return jc.rollout(system, jc.Method(), start, None, 1e-3, 20)[0].q
v = jnp.stack([state.v + 0.1 * i for i in range(2 * count)])
split = jax.jit(jax.vmap(run))(jc.shard(v))
assert len(split.sharding.device_set) == count
print(count, os.environ["XLA_FLAGS"])
print(*[float(x).hex() for x in split.ravel()])
"""


def in_a_process(program, **variables):
    own = {k: x for k, x in os.environ.items() if not k.startswith(("JAX_", "XLA_", "PJRT"))}
    own |= {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)} | variables
    command = [sys.executable, "-c", program]
    return subprocess.run(command, env=own, cwd=ROOT, capture_output=True, text=True, check=False)


def test_each_core_is_a_device():
    one, two = (in_a_process(PROGRAM.replace("COUNT", str(n))) for n in (1, 2))
    assert one.returncode == two.returncode == 0, one.stderr + two.stderr
    flags, worlds = one.stdout.splitlines()
    more_flags, more_worlds = two.stdout.splitlines()
    assert flags.split()[0] == "1"
    assert more_flags.split()[0] == "2"
    # the first two worlds of four are those of two
    assert more_worlds.split()[:4] == worlds.split()
    assert ("vector_width=512" in more_flags) == (cores.widest() == 512)


def test_flags_and_variables_of_the_user_stay():
    program = "import os, jaxcon as jc; n = jc.use_all_cores(); print(n, os.environ['XLA_FLAGS'])"
    flags = "--xla_cpu_prefer_vector_width=128 --xla_cpu_enable_fast_math=false"
    done = in_a_process(program, XLA_FLAGS=flags)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(cores.cores()), *flags.split()]


def test_a_call_after_the_first_use_of_jax_says_so():
    program = "import jax.numpy as jnp; jnp.ones(1); import jaxcon as jc; jc.use_all_cores(3)"
    done = in_a_process(program)
    assert done.returncode == 1
    assert "RuntimeError: use_all_cores: JAX has been used before" in done.stderr


@pytest.mark.parametrize("wrong", [0, -1, 1.5, True, "2"])
def test_the_number_of_devices_is_a_positive_integer(wrong):
    with pytest.raises(ValueError, match=r"use_all_cores: count must be a whole number from 1"):
        jc.use_all_cores(wrong)


def test_results_do_not_depend_on_the_options():
    scene = jc.Scene(dim=3)
    scene.add_body("rod", mass=1.0, inertia=(0.01, 0.02, 0.025), position=(0.5, 0.0, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "rod", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)))
    system, state = scene.build()
    states = jax.vmap(lambda x: jc.init(system, jc.Method(), state.q, state.v + x))(
        jnp.linspace(0, 0.1, 20)
    )

    def run(s):
        return jc.rollout(system, jc.Method(), s, None, 1e-3, 10)[0].q

    plain, fast = (
        jax.jit(jax.vmap(run), compiler_options=options)(states)
        for options in (None, jc.compiler_options)
    )
    np.testing.assert_allclose(fast, plain, rtol=1e-13, atol=1e-13)
