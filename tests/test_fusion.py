import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.core.native import Native
from jaxcon.scenes import four_bar

X = np.linspace(0.3, 1.7, 24).reshape(4, 6)
Y = np.linspace(-1.0, 2.0, 24).reshape(4, 6)


def chain_of_shared_values(x, y):
    """Each value is needed twice by the next: 2⁴⁰ operations if none is stored."""
    a, b = x, y
    for _ in range(40):
        a, b = 0.5 * (a * b + a), 0.5 * (a * b - b)
    return [a, b]


def rows_and_loops(x, y):
    def body(carry, row):
        turned = jnp.sin(carry) * row + jnp.cos(carry)
        return turned * turned - 0.1 * turned, turned + row

    last, rows = jax.lax.scan(body, x[0], jnp.concatenate([x, y * 2.0]))
    return [last, rows[::-1], jnp.stack([last, x[1]])]


def reductions(x, y):
    return [
        jnp.sum(x * y, axis=0),
        jnp.max(x + y, axis=0),
        jnp.min(x.reshape(2, 2, 6), axis=(0, 1)),
        jnp.all(x > y, axis=0),
        jnp.any(x[:3] > y[:3], axis=0),
        jnp.sum(x, axis=1),
    ]


def arguments_that_do_not_matter(x, y):
    same = jnp.where(y > 0, x, x)
    return [same * 2.0, x**0 + 0.0 * x, jnp.where(True, x, y), x * jnp.ones((4, 6)) - 0.0]


def matrices(x, y):
    a = x @ x.T + 4 * jnp.eye(4)
    factor = jnp.linalg.cholesky(a)
    return [factor * 2.0 + jnp.sin(a), jnp.linalg.solve(a, y * x)]


def results_as_they_come(x, y):
    return [x, jnp.zeros((2, 3)), x, x + y, jnp.zeros((0, 3))]


FUNCTIONS = [
    chain_of_shared_values,
    rows_and_loops,
    reductions,
    arguments_that_do_not_matter,
    matrices,
    results_as_they_come,
]


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("constant", [False, True])
def test_the_results_are_those_of_the_function(function, constant):
    cut = Native(function).settled
    x, y = jnp.asarray(X), jnp.asarray(Y)
    if constant:
        found = jax.jit(lambda x: cut(x, np.ones_like(Y)))(x)
        expected = function(x, jnp.ones_like(y))
    else:
        found, expected = jax.jit(cut)(x, y), function(x, y)
    for a, b in zip(found, expected, strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_shared_values_are_computed_once():
    text = jax.jit(Native(chain_of_shared_values).settled).lower(X, Y).compile().as_text()
    assert len(re.findall(r" multiply\(", text)) < 8 * 40


def unread(text):
    """Arguments of kernels that nothing in them reads."""
    found = []
    for part in text.split("\n\n"):
        if re.match(r"\s*%kernel", part):
            names = re.findall(r"(%[\w.]+) = \S+ parameter\(", part)
            found += [n for n in names if len(re.findall(re.escape(n) + r"(?![\w.])", part)) < 2]
    return found


@pytest.mark.parametrize(
    "function",
    [chain_of_shared_values, rows_and_loops, arguments_that_do_not_matter],
    ids=lambda f: f.__name__,
)
def test_kernels_read_all_their_arguments(function):
    cut = Native(function).settled
    for run, args in ((cut, (X, Y)), (lambda x: cut(x, np.zeros_like(Y)), (X,))):
        text = jax.jit(run).lower(*args).compile().as_text()
        assert "%kernel" in text
        assert not unread(text)


@pytest.mark.parametrize(
    "solver",
    [jc.Sparse(), jc.Schur(), jc.ConjugateGradients()],
    ids=["sparse", "schur", "cg"],
)
def test_kernels_of_a_step_and_its_gradient_read_all_their_arguments(solver):
    system, state = four_bar()
    batch = jax.vmap(lambda q: jc.State(q, state.v, state.time, state.status, state.memory))(
        jnp.tile(state.q, (5, 1))
    )

    def speed(s):
        new, _ = jc.step(system, jc.Method(solver=solver), s, None, 1e-3)
        return jnp.sum(new.v**2)

    for run in (jax.vmap(speed), jax.vmap(jax.grad(speed, allow_int=True))):
        assert not unread(jax.jit(run).lower(batch).compile().as_text())


def test_what_a_function_does_besides_is_done(capsys):
    def loud(x, y):
        jax.debug.callback(lambda z: print("seen", float(z)), x[0, 0])
        return [x + y]

    jax.block_until_ready(jax.jit(Native(loud).settled)(X, Y))
    jax.effects_barrier()
    assert "seen 0.3" in capsys.readouterr().out


def test_it_can_be_left_to_the_compiler(monkeypatch):
    monkeypatch.setenv("JAXCON_STAGES", "off")
    left = jax.jit(Native(chain_of_shared_values).settled).lower(X, Y).as_text()
    assert "inlineable" not in left


SHARDED = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
import jax.numpy as jnp, numpy as np, jaxcon as jc
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxcon.scenes import four_bar
system, state = four_bar()
method = jc.Method(solver=jc.Sparse())
worlds = jax.vmap(lambda x: jc.State(state.q, x * state.v, state.time, state.status, state.memory))
batch = worlds(jnp.linspace(0.5, 1.0, 32))
run = jax.jit(jax.vmap(lambda s: jc.rollout(system, method, s, None, 2e-3, 20)[0].q))
mesh = Mesh(np.asarray(jax.devices()), ("worlds",))
spread = jax.device_put(batch, NamedSharding(mesh, PartitionSpec("worlds")))
found = run(spread)
assert len(found.sharding.device_set) == 2
np.testing.assert_allclose(found, run(batch), rtol=0, atol=1e-5)
"""


def test_a_batch_over_two_devices():
    subprocess.run([sys.executable, "-c", SHARDED], check=True, timeout=300)
