"""Kernels against the same functions compiled by XLA.

Those for NVIDIA's GPUs are run on the CPU by `ptx_machine`.
"""

import dataclasses
import functools
import inspect
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import ptx_machine
import pytest
from jax.extend.core import Literal

import jaxcon as jc
from benchmarks import legged, mechanisms
from jaxcon.staging import batch_last, chunks, cpu, cuda, entries, kernels, llvm, ptx
from jaxcon.staging.elementary import FUNCTIONS
from jaxcon.staging.thread import UnsupportedError

DT = 0.002
CALL = "__gpu$xla.gpu.ptx"


PLATFORMS = {"cpu": cpu.Cpu(), "cuda": cuda.Cuda()}


@pytest.fixture(params=PLATFORMS)
def platform(request):
    return PLATFORMS[request.param]


@kernels.kernel_p.def_impl
def _(*args: Any, text: str, shapes: Any, worlds: int, in_place: bool) -> list[Any]:
    params = {"text": text, "shapes": shapes, "worlds": worlds, "in_place": in_place}
    if not text.startswith(ptx.HEADER):
        return jax.jit(functools.partial(kernels.kernel_p.bind, **params))(*args)
    results = [np.full(shape, 77, dtype) for shape, dtype in shapes]  # every entry is written
    ptx_machine.run(text, [np.array(x) for x in args] + results)
    return list(map(jnp.asarray, results))


def by_xla(function: Callable[..., Any], *args: Any) -> Any:
    """Evaluates a function without kernels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXCON_KERNELS", "off")
        return jax.jit(lambda *xs: function(*xs))(*args)


def by_threads(platform: kernels.Platform, function: Callable[..., Any], *args: Any) -> Any:
    """Evaluates a function, with each native function in it as a kernel."""
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    values = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    values |= dict(zip(closed.jaxpr.invars, jax.tree.leaves(args), strict=True))
    count = 0

    def read(x: Any) -> Any:
        return jnp.asarray(x.val, x.aval.dtype) if isinstance(x, Literal) else values[x]

    for equation in closed.jaxpr.eqns:
        given, params = [jnp.asarray(read(x)) for x in equation.invars], equation.params
        if equation.primitive is batch_last.native_p:
            results: Any = kernels.run(platform, params["fun"], given, params["rank"])
            count += 1
        elif equation.primitive is chunks.worlds_p:
            results = chunks.in_kernel(platform)(*given, fun=params["fun"], batch=params["batch"])
            count += 1
        else:
            results = equation.primitive.bind(*given, **params)
        if not equation.primitive.multiple_results:
            results = [results]
        values.update(zip(equation.outvars, results, strict=True))
    assert count
    return jax.tree.unflatten(jax.tree.structure(shapes), list(map(read, closed.jaxpr.outvars)))


def assert_close(x: Any, y: Any, share: float) -> None:
    """Asserts that two trees differ by at most a share of the largest entry of each array."""
    for a, b in zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=0, atol=share * np.abs(b).max(initial=1e-30))


def batch(name: str, dtype: Any, worlds: int = 3) -> tuple[Any, jc.State]:
    """Returns a scene, and a batch of states of different speeds."""
    system, state = mechanisms.find(name).build(dtype)
    random = np.random.default_rng(0).standard_normal((worlds, *state.v.shape))
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (worlds, *x.shape)), state)
    return system, dataclasses.replace(states, v=states.v + jnp.asarray(0.3 * random, dtype))


@pytest.mark.parametrize(
    ("name", "dtype", "share"),
    [
        ("pendulum", np.float32, 1e-6),
        ("four-bar", np.float32, 1e-5),
        ("four-bar", np.float64, 1e-14),
        ("chain-5", np.float64, 1e-13),
    ],
)
def test_a_step_is_that_on_the_cpu(platform, name, dtype, share):
    with jax.enable_x64(dtype == np.float64):
        system, states = batch(name, dtype)
        step = jax.vmap(lambda s: jc.step(system, jc.Method(), s, None, DT)[0])
        assert_close(by_threads(platform, step, states), by_xla(step, states), share)


@pytest.mark.parametrize("name", ["pendulum", "four-bar"])
def test_a_gradient_is_that_on_the_cpu(platform, name):
    with jax.enable_x64(True):
        system, states = batch(name, np.float64)

        def loss(v: Any, dt: Any) -> Any:
            moved = dataclasses.replace(states, v=v)
            step = jax.vmap(lambda s: jc.step(system, jc.Method(), s, None, dt)[0])
            return jnp.sum(step(moved).q ** 2)

        slope = jax.grad(loss, argnums=(0, 1))  # dt is shared: its slope is a sum over worlds
        h = jnp.asarray(DT)
        assert_close(by_threads(platform, slope, states.v, h), by_xla(slope, states.v, h), 1e-12)


def test_a_robot_on_the_floor_steps_as_on_the_cpu(platform):
    with jax.enable_x64(True):
        robot = jc.from_mjcf(str(legged.ASSETS / "hopper.xml"), dtype=jnp.float64)
        method, system, model = robot.method(), robot.system, legged.load("hopper")
        poses = jnp.asarray([legged.start(model, seed) for seed in range(2)])
        states = jax.jit(jax.vmap(lambda q: legged.begun(robot, method, q)))(poses)
        u = jnp.zeros((400, system.layout.n_u))

        def fall(state: jc.State) -> jc.State:
            return jc.rollout(system, method, state, u, DT, 400, record=lambda s, i: None)[0]

        landed = jax.jit(jax.vmap(fall))(states)
        step = jax.vmap(lambda s: jc.step(system, method, s, u[0], DT)[0])
        here, there = by_threads(platform, step, landed), by_xla(step, landed)
        assert any(np.abs(x).max(initial=0) > 0 for x in there.memory)  # it stands on the floor
        assert_close((here.q, here.v), (there.q, there.v), 1e-9)


def test_nested_batches_and_single_worlds(platform):
    system, states = batch("pendulum", np.float32, 6)
    step = lambda s: jc.step(system, jc.Method(), s, None, DT)[0]  # noqa: E731
    twice = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), states)
    assert_close(
        by_threads(platform, jax.vmap(jax.vmap(step)), twice), jax.vmap(jax.vmap(step))(twice), 1e-6
    )
    one = jax.tree.map(lambda x: x[0], states)
    text = lowered(step, one)
    assert text.count(CALL) == 1


def rollouts(
    platform: kernels.Platform, name: str, worlds: int = 3, steps: int = 6, **options: Any
) -> tuple[Any, Any, Any]:
    """Returns a rollout of a scene, that of a batch as one kernel, and the batch.

    The rollout is traced as for more worlds than fit into a chunk.
    """
    system, states = batch(name, np.float64, worlds)

    def run(state: jc.State) -> Any:
        return jc.rollout(system, jc.Method(), state, None, DT, steps, **options)

    many = jax.tree.map(lambda x: jax.ShapeDtypeStruct((4096, *x.shape[1:]), x.dtype), states)
    closed, shapes = jax.make_jaxpr(jax.vmap(run), return_shape=True)(many)
    (equation,) = (x for x in closed.jaxpr.eqns if x.primitive is chunks.worlds_p)
    fun, axes = equation.params["fun"], equation.params["batch"].axes

    def kernel(states: jc.State) -> Any:
        leaves = iter(jax.tree.leaves(states))
        args = [jnp.arange(steps) if a is None else next(leaves) for a in axes]
        results = kernels.run_worlds(platform, fun.closed, args, axes, worlds)
        results = [jnp.moveaxis(x, -1, 0) for x in results]
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return functools.partial(by_xla, jax.vmap(run)), kernel, states


@pytest.mark.parametrize(
    "options",
    [{}, {"every": 3}, {"record": lambda state, info: None}, {"record": lambda s, i: s.v[0] > 0}],
    ids=["all", "every third", "none", "flag"],
)
@pytest.mark.parametrize("name", ["pendulum", "four-bar"])
def test_a_rollout_is_that_on_the_cpu(platform, name, options, monkeypatch):
    monkeypatch.setattr(entries, "MAX_UNROLLED", 0)
    with jax.enable_x64(True):
        run, kernel, states = rollouts(platform, name, **options)
        assert_close(kernel(states), run(states), 1e-13)


def test_the_gradient_of_a_rollout_of_many_worlds(platform):
    """The kernel also returns what the reverse pass needs of each step."""
    with jax.enable_x64(True):
        system, states = batch("pendulum", np.float64, 513)  # more than fit into a chunk

        def loss(v: Any) -> Any:
            run = jax.vmap(lambda s: jc.rollout(system, jc.Method(), s, None, DT, 3)[0].q)
            return jnp.sum(run(dataclasses.replace(states, v=v)) ** 2)

        slope = jax.grad(loss)
        assert_close(by_threads(platform, slope, states.v), by_xla(slope, states.v), 1e-12)


def test_a_result_that_worlds_share_counts_once(platform):
    """Its cotangent belongs to no world, so that XLA evaluates the transpose."""
    shared = lambda p, x: (2 * p, p * x)  # noqa: E731

    def loss(p: Any, x: Any) -> Any:
        a, b = jax.vmap(lambda x: batch_last.call(shared, p, x))(x)
        return a[0] + b.sum()

    p, x = jnp.asarray(3.0), jnp.arange(1.0, 5.0)
    assert jax.grad(loss)(p, x) == 12
    with pytest.raises(UnsupportedError, match="share a cotangent"):
        by_threads(platform, jax.grad(loss), p, x)


UNSUPPORTED = {
    "erf": lambda x: jax.lax.erf(x),
    "int8": lambda x: x.astype(jnp.int8),
    "many places": lambda x: jnp.arange(5000.0)[x[0, 0].astype(int)] + x,
    "remainder": lambda x: x % 3,
    "unsigned": lambda x: -x.astype(jnp.uint32),
    "long sort": lambda x: x + jnp.sort(jnp.tile(x[0], 20))[0],
    "large matrix": lambda x: x + jnp.linalg.cholesky(jnp.eye(60) + x[0, 0])[0, 0],
    "keys": lambda x: x + jax.random.uniform(jax.random.key(0), x.shape),
    "long": lambda x: jax.lax.fori_loop(
        0, 10**5, lambda i, y: jax.lax.fori_loop(0, 10**5, lambda j, z: z * 0.5 + 1, y), x
    ),
}


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_what_has_no_instructions_is_left_to_xla(name):
    x = jnp.ones((4, 3))
    assert CALL in lowered(jax.vmap(lambda x: batch_last.call(jnp.sin, x)), x)
    function = UNSUPPORTED[name]
    assert CALL not in lowered(jax.vmap(lambda x: batch_last.call(function, x)), x)


def test_keys_and_empty_batches_are_left_to_xla():
    draw = lambda x, key: (x + 1, key)  # noqa: E731
    keys = jax.random.split(jax.random.key(0), 4)
    mapped = jax.vmap(lambda x, key: batch_last.call(draw, x, key))
    assert CALL not in lowered(mapped, jnp.ones(4), keys)
    assert CALL not in lowered(jax.vmap(lambda x: batch_last.call(jnp.sin, x)), jnp.ones((0, 3)))


def test_a_call_outside_of_jit_has_a_thread_for_each_world():
    step, states = pendulums()
    closed = jax.make_jaxpr(step)(states)
    (equation,) = (x for x in closed.jaxpr.eqns if x.primitive is batch_last.native_p)
    fun, rank = equation.params["fun"], equation.params["rank"]
    args = [jnp.zeros(x.aval.shape, x.aval.dtype) for x in equation.invars]
    assert "grid_x = 2" in lowered(functools.partial(fun.compiled, rank=rank), *args)


def evaluated(
    platform: kernels.Platform, function: Callable[..., Any], *args: Any, worlds: int = 1
) -> list[np.ndarray]:
    """Evaluates a function of arrays as a kernel, in worlds that share the arguments."""
    closed = jax.make_jaxpr(function)(*args)
    given = [jnp.asarray(x) for x in args]
    results = kernels.run_worlds(platform, closed, given, [None] * len(args), worlds)
    return [np.asarray(x[..., -1]) for x in results]


def expected(function: Callable[..., Any], *args: np.ndarray) -> list[Any]:
    """Evaluates a function of arrays by XLA."""
    return jax.tree.leaves(jax.jit(function)(*args))


SPECIAL = np.array([0.0, -0.0, 1.0, -1.5, 2.5, 0.5, 3e7, np.inf, -np.inf, np.nan])
GRID = np.stack(np.meshgrid(SPECIAL, SPECIAL), -1).reshape(-1, 2)
BINARY = {
    "max": jnp.maximum,
    "min": jnp.minimum,
    "eq": jnp.equal,
    "ne": jnp.not_equal,
    "lt": jnp.less,
    "ge": jnp.greater_equal,
    "add": jnp.add,
    "sub": jnp.subtract,
    "div": jnp.divide,
    "atan2": jnp.arctan2,
}
UNARY = {
    "floor": jnp.floor,
    "ceil": jnp.ceil,
    "round": jnp.round,
    "sign": jax.lax.sign,
    "is_finite": jnp.isfinite,
    "abs": jnp.abs,
    "neg": jnp.negative,
    "integer": lambda x: x.astype(jnp.int32),
    "integer of its size": lambda x: x.astype(int),
    "sine of zeros": lambda x: jnp.sin(jnp.where(x == 0, x, 0)),
    "bool": lambda x: x.astype(bool),
    "power": lambda x: x**-3,
    "rsqrt": jax.lax.rsqrt,
    "clamp": lambda x: jnp.clip(x, -1, 1),
    "halves away": lambda x: jax.lax.round(x, jax.lax.RoundingMethod.AWAY_FROM_ZERO),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", [*BINARY, *UNARY])
def test_special_numbers(platform, name, dtype):
    with jax.enable_x64(dtype == np.float64):
        function = BINARY.get(name) or UNARY[name]
        args = GRID.T.astype(dtype) if name in BINARY else [SPECIAL.astype(dtype)]
        (here,), (there,) = evaluated(platform, function, *args), expected(function, *args)
        np.testing.assert_allclose(here, there, rtol=4 * np.finfo(dtype).eps)
        if np.issubdtype(here.dtype, np.floating) and name not in ("max", "min", "sub", "add"):
            numbers = ~np.isnan(here)
            signs = np.signbit(here)[numbers], np.signbit(np.asarray(there))[numbers]
            np.testing.assert_array_equal(*signs)


REAL = np.linspace(-30, 30, 61)
RANGES = {
    "sin": np.concatenate([REAL, [1e3, -1e5, 1e8, np.inf, np.nan]]),
    "cos": np.concatenate([REAL, [1e3, -1e5, 1e8, np.inf, np.nan]]),
    "tan": REAL,
    "atan": np.concatenate([REAL, np.linspace(-2, 2, 41), [np.inf, -np.inf, np.nan]]),
    "asin": np.linspace(-1, 1, 41),
    "acos": np.concatenate([np.linspace(-1, 1, 41), [1.5]]),
    "exp": np.concatenate([REAL, [-800, 800, 88.5, -103, 0, np.inf, -np.inf, np.nan]]),
    "log": np.concatenate([np.geomspace(1e-40, 1e30, 71), [0, 1, -1, np.inf, np.nan]]),
    "tanh": np.concatenate([REAL, np.linspace(-0.2, 0.2, 21), [np.inf, np.nan]]),
    "logistic": REAL,
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", [x for x in FUNCTIONS if x != "atan2"])
def test_elementary_functions(platform, name, dtype):
    """Against the exact values of the rounded arguments, in 80 bits."""
    x = RANGES[name].astype(dtype)
    if platform is PLATFORMS["cpu"]:  # XLA lets CPUs take subnormal numbers for 0
        x = x[(x == 0) | ~(np.abs(x) < np.finfo(dtype).tiny)]
    function = getattr(jax.lax, name)
    with jax.enable_x64(dtype == np.float64), np.errstate(all="ignore"):
        wide = x.astype(np.longdouble)
        exact = {
            "asin": np.arcsin,
            "acos": np.arccos,
            "atan": np.arctan,
            "logistic": lambda y: 1 / (1 + np.exp(-y)),
        }.get(name) or getattr(np, name)
        if name in ("tanh", "logistic") and dtype == np.float64:
            with pytest.raises(UnsupportedError):
                evaluated(platform, function, x)
            return
        (here,) = evaluated(platform, function, x)
        right = exact(wide).astype(dtype)
        bound = 3e-7 if dtype == np.float32 else 1e-15
        error = np.abs(here - right) / np.maximum(np.abs(right), 1)
        error = np.where((here == right) | (np.isnan(here) & np.isnan(right)), 0, error)
        # tan is steep near its poles, and the tiniest results have few bits
        assert np.max(error) <= (8 if name == "tan" else 1) * bound, x[np.argmax(error)]


def swapped(x: Any, y: Any) -> Any:
    """Carries values that change places, under a condition on one of them."""
    return jax.lax.while_loop(
        lambda c: c[2] < 5, lambda c: (c[1], c[0] + 1, c[2] + 1), (x, y, jnp.int32(0))
    )


def each_row(x: Any) -> Any:
    """Halves each number until it is small: `vmap` gives the loop a condition for each of them."""
    return jax.vmap(lambda y: jax.lax.while_loop(lambda z: jnp.abs(z) > 0.3, lambda z: z / 2, y))(x)


def branched(x: Any, y: Any) -> Any:
    def deep() -> Any:
        return jax.lax.cond(y > 1, lambda: (x * 2, y), lambda: (x, y + x))

    return jax.lax.cond(x > 0, deep, lambda: (y, x))


def nested(x: Any, y: Any) -> Any:
    """Runs loops within branches within a loop, as often as each world needs."""

    def body(carry: Any) -> Any:
        k, z = carry
        halved = lambda: jax.lax.while_loop(lambda w: w > 1, lambda w: w / 2, z)  # noqa: E731
        far = jax.lax.cond(z > 0, halved, lambda: z * z)
        return k + 1, jax.lax.fori_loop(0, 3, lambda i, w: w + y / (i + 1), far)

    return jax.lax.while_loop(lambda c: (c[0] < 9) & (jnp.abs(c[1]) < 50), body, (0, x))


def scanned(x: Any) -> Any:
    def body(carry: Any, row: Any) -> Any:
        return carry * 2 + row[0], carry + row[1]

    return jax.lax.scan(body, x[0, 0], x), jax.lax.scan(body, x[0, 0], x, reverse=True)


def at_each(x: Any) -> Any:
    """Reads and replaces the row of each round."""

    def body(i: Any, y: Any) -> Any:
        row = jax.lax.dynamic_index_in_dim(y, i, 0, keepdims=False)
        return jax.lax.dynamic_update_index_in_dim(y, 2 * row + i, i, 0)

    return jax.lax.fori_loop(0, 3, body, x)


def repeated(x: Any) -> Any:
    return jax.lax.fori_loop(0, 7, lambda i, c: c * 0.5 + 1, x)


def moved(x: Any) -> Any:
    wide = jnp.pad(x, ((1, 2), (0, 1)), constant_values=3)
    cut = jax.lax.pad(x, jnp.float32(5), ((-1, 0, 0), (0, 1, 1)))
    parts = jnp.concatenate([x.T, x.T + 1], 1), x[::-1, 1:], x[jnp.array([2, 0])], jnp.stack([x, x])
    return wide, cut, parts, jnp.cumsum(x, 0), jnp.cumsum(x[::-1], 1), x.reshape(2, 3) @ x


def replaced(x: Any) -> Any:
    twice = jnp.array([2, 0, 2])
    return (
        x.at[1].set(0),
        x.at[jnp.array([2, 0])].set(x[:2]),
        x.at[twice].add(x),
        x.at[:, 1].set(x[:, 0]),
        x.at[1:, 0].add(jnp.float32(1)),
        x.at[jnp.array([0, 2]), jnp.array([1, 0])].set(jnp.array([5, 6], jnp.float32)),
    )


def reduced(x: Any) -> Any:
    flags = x > 1
    return (
        jax.lax.scan(lambda c, y: (c + y, c), x[0, 0], x[:, 0]),
        jnp.sum(x, 1),
        jnp.max(x),
        jnp.min(x, 0),
        flags.any(),
        flags.all(0),
        jnp.prod(x, 1),
        jnp.argmax(x, 1),
        jnp.argmin(x),
        jnp.einsum("ij,kj->ik", x, x),
    )


def at_place(x: Any, k: Any) -> Any:
    return jax.lax.dynamic_index_in_dim(x, k, 0), jax.lax.dynamic_update_slice_in_dim(
        x, x[:1], k, 0
    )


def at_index(x: Any, k: Any) -> Any:
    """Reads and replaces rows at a traced index, which may lie beyond the array."""
    some, others = jnp.array([0, 2], jnp.int32), jnp.array([1, 0])
    return (
        x.at[k].get(mode="clip"),
        x.at[k].get(mode="fill"),
        x.at[k].get(mode="fill", fill_value=4),
        x.astype(jnp.int32).at[k].get(mode="fill"),
        (x > 0).at[k].get(mode="fill"),
        x.at[:, k].get(mode="fill"),
        x.at[:, others].get(),
        x.at[some, others].get(),
        x.at[some + k].get(mode="fill"),
        x.at[jnp.array([0, 9])].get(mode="fill"),
        x.at[k].set(x[0]),
        x.at[k].add(x[0], mode="clip"),
        x.at[k, 1].set(5.0),
        x.at[k, k - 1].get(mode="fill"),
        x.at[k, k - 1].get(mode="clip"),
        x.at[k, k - 1].set(5.0),
        x[:1].at[k].set(5.0),
        x[0, 0].at[...].set(5.0) + x,
        x[0, 0].at[...].add(5.0) + x,
        x.at[some + k].add(x[:2]),
        x.at[jnp.array([0, 9])].set(5.0),
        x.at[k].max(x[0]),
        x.at[some + k].min(x[:2]),
        x.at[jnp.array([0, 0])].mul(x[:2]),
        jax.ops.segment_max(x, jnp.array([2, 0, 2]), 3),
    )


def by_table(x: Any) -> Any:
    """Loops over the rows of known numbers, and of numbers that are not in memory."""
    table = np.array([[0.5, 1.0], [2.0, -1.0], [0.25, 3.0]], np.float32)
    known = jax.lax.scan(lambda c, row: (row[0] * c + row[1], None), x, jnp.asarray(table))[0]
    return jax.lax.scan(lambda c, row: (c * row[None], None), known, 2 * x)[0]


def largest(x: Any) -> Any:
    """The largest entries, among equal ones and infinite ones, and of all."""
    y = jnp.concatenate([x, x[:1], jnp.full((1, 2), -jnp.inf, x.dtype), x[2:] * jnp.nan])
    some = jax.lax.top_k(y.T, 3)
    return *some, *jax.lax.top_k(-x, 2), *jax.lax.top_k(y.T, 6)


def ranked(x):
    """Sorts with equal keys, infinite ones and NaN, and along either axis."""
    y = jnp.concatenate([x, x[:1], jnp.full((1, 2), jnp.inf, x.dtype), x[2:] * jnp.nan, -x])
    return jnp.sort(y, 0), jnp.argsort(y, 0), jnp.sort(x, 1), jnp.argsort(jnp.round(x[:, 0]))


def of_nothing(x: Any) -> Any:
    none = x[:0]
    return (
        jnp.sum(none, 0)[None] + x,
        jnp.prod(none) + x,
        jnp.max(none, 0, initial=3)[None] + x,
        jnp.min(none, 0, initial=3)[None] + x,
        jnp.any(none > 0) | (x > 0),
        jnp.all(none > 0, 0)[None] & (x > 0),
        jnp.max(none > 0, initial=False) | (x > 0),
        jnp.min(none > 0, initial=True) & (x > 0),
        jax.lax.reduce_and(none.astype(jnp.int32), (0,))[None] + x.astype(jnp.int32),
        none.T @ none + x[:2],
    )


def iterated(x: Any) -> Any:
    return jax.lax.scan(lambda c, _: (c * 0.5 + 1, None), x, None, length=7)[0]


def whole(x: Any) -> Any:
    k = x.astype(jnp.int32)
    return (
        k // 2,
        k * 3 - 1,
        jnp.abs(k),
        k & 3,
        k | 4,
        k ^ 1,
        ~k,
        -k,
        jnp.sign(k),
        k.astype(jnp.float32),
        jax.lax.bitcast_convert_type(x, jnp.int32) & -4096,
        jax.lax.bitcast_convert_type(k, jnp.float32),
    )


def logical(x: Any) -> Any:
    p, q = x > 0, x > 1
    return (
        p & q,
        p | q,
        p ^ q,
        ~p,
        p == q,
        jnp.where(p, q, ~q),
        p & True,
        q | False,
        p.astype(jnp.int32),
    )


ARRAY = np.array([[1.0, -2.0], [3.5, 0.25], [2.0, 7.0]], np.float32)
PLACES = [-4, 0, 1, 2, 9]
CASES: list[tuple[Callable[..., Any], Sequence[np.ndarray]]] = [
    (swapped, (np.float32(1), np.float32(5))),
    *[(branched, (np.float32(x), np.float32(y))) for x in (-1, 1) for y in (0, 2)],
    (each_row, (ARRAY[:, 0],)),
    (scanned, (ARRAY,)),
    (repeated, (ARRAY,)),
    (at_each, (ARRAY,)),
    (moved, (ARRAY,)),
    (replaced, (ARRAY,)),
    (reduced, (ARRAY,)),
    *[(at_place, (ARRAY, np.int32(k))) for k in PLACES],
    *[(at_index, (ARRAY, np.int32(k))) for k in PLACES],
    (by_table, (ARRAY,)),
    (iterated, (ARRAY,)),
    (largest, (ARRAY,)),
    (ranked, (ARRAY,)),
    (of_nothing, (ARRAY,)),
    (whole, (4 * ARRAY,)),
    (logical, (ARRAY,)),
]


@pytest.mark.parametrize(("function", "args"), CASES)
def test_operations(platform, function, args):
    check_operations(platform, function, args)


def decomposed(x):
    """Decompositions and solves of regular, singular, indefinite and stacked matrices."""
    definite = x @ x.T + jnp.eye(3, dtype=x.dtype)
    y = jnp.concatenate([x, x[:, :1] * x[::-1, 1:] + 0.3], 1)
    half = jnp.linalg.cholesky(definite, symmetrize_input=False)
    factors = jax.scipy.linalg.lu_factor(y)
    sides, flags = ((True, x), (False, x.T)), (False, True)
    solve = jax.lax.linalg.triangular_solve
    return (
        half,
        jnp.linalg.cholesky(-definite, symmetrize_input=False),
        jnp.linalg.cholesky(jnp.stack([definite, 2 * definite])),
        jax.scipy.linalg.cho_solve((half, True), x),
        *factors,
        *(jax.scipy.linalg.lu_solve(factors, x, trans=trans) for trans in (0, 1)),
        *jax.lax.linalg.lu(jnp.stack([y, y[::-1], y.T, 0 * y])),
        *(
            solve(matrix, b, left_side=side, lower=lower, transpose_a=turned, unit_diagonal=unit)
            for matrix, lower in ((half, True), (y, False))
            for (side, b), turned, unit in itertools.product(sides, flags, flags)
        ),
    )


@pytest.mark.parametrize("x", [ARRAY, ARRAY[::-1], -ARRAY])
def test_decompositions_of_small_matrices(platform, x):
    here = evaluated(platform, decomposed, x.astype(np.float64))
    for a, b in zip(here, expected(decomposed, x.astype(np.float64)), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def held(x):
    """A loop whose rows are read afterwards: numbers, flags and whole numbers of each round."""

    def visit(carry, row):
        carry = jnp.sin(carry) + row
        return carry, (carry[0] * x, carry > 0.3, jnp.sum(carry > 0, dtype=jnp.int32))

    last, (numbers, flags, places) = jax.lax.scan(
        visit, x[0], jnp.asarray([0.5, -1.0, 2.0], x.dtype)
    )
    return last, numbers[1] - numbers[2].sum(), flags[0] ^ flags[2], places[::-1] + 1, numbers


@pytest.mark.parametrize(
    "function", [scanned, repeated, reduced, at_each, by_table, iterated, held]
)
def test_loops_that_are_not_written_round_by_round(platform, function, monkeypatch):
    for limit in ("MAX_UNROLLED", "MAX_UNROLLED_HELD", "MAX_ITERATED"):
        monkeypatch.setattr(entries, limit, 0)
    check_operations(platform, function, (ARRAY,))


def through_rows(x):
    """Loops in both directions whose rows, long and of all kinds, lie in no argument or result."""

    def forth(carry, row):
        carry = jnp.sin(carry) + row.sum(0) * x[0]
        return carry, (carry[:, None] * row.T, carry > 0.2, jnp.sum(carry > 0, dtype=jnp.int32))

    def back(carry, rows):
        numbers, flags, count = rows
        carry = 0.5 * carry + jnp.where(flags, numbers.sum(1), count.astype(x.dtype))
        return carry, carry * numbers[:, 0]

    wide = jnp.cos(jnp.arange(60, dtype=x.dtype)).reshape(5, 6, 2) * x[0, 0]
    middle, rows = jax.lax.scan(forth, x[0], wide)
    last, ends = jax.lax.scan(back, middle, rows, reverse=True)
    return last, ends[1] * 2 + rows[0][3, 1, 0], jax.lax.scan(back, last, rows)[0]


@pytest.mark.parametrize("worlds", [3, 37])
@pytest.mark.parametrize("long", [False, True])
def test_rows_of_long_loops_lie_in_local_arrays(worlds, long, monkeypatch):
    """Values and gradients, in threads that take part and in others, and round after round."""
    for limit in ("MAX_UNROLLED", "MAX_UNROLLED_HELD", "MAX_ITERATED", "MAX_HELD", "MAX_CHOSEN"):
        monkeypatch.setattr(entries, limit, 0)
    if long:
        monkeypatch.setattr(cpu, "LONG", range(10**9))

    def function(x):
        turn = lambda c, _: (through_rows(c)[2][None] + c, None)  # noqa: E731
        thrice = lambda y: jax.lax.scan(turn, y, None, 3)[0]  # noqa: E731
        some = jax.lax.cond(x[0, 0] > 0, thrice, lambda y: y, x)
        slope = jax.grad(lambda y: jnp.sum(through_rows(y)[0] ** 2))(x)
        return *through_rows(x), some, slope

    x = np.random.default_rng(worlds).standard_normal((worlds, 3, 2))
    one = jax.make_jaxpr(function)(x[0])
    lengths = []
    count = kernels.count_of
    monkeypatch.setattr(kernels, "count_of", lambda x: lengths.append(count(x)) or lengths[-1])
    here = kernels.run_worlds(PLATFORMS["cpu"], one, [jnp.asarray(x)], [0], worlds)
    for a, b in zip(here, expected(jax.vmap(function), x), strict=True):
        np.testing.assert_allclose(np.moveaxis(np.asarray(a), -1, 0), b, rtol=1e-11, atol=1e-11)
    assert lengths[0] < 4000  # loops, not rounds one by one


def check_operations(platform, function, args):
    here = evaluated(platform, function, *map(np.asarray, args))
    for x, y in zip(here, expected(function, *args), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=1e-6)


@pytest.mark.parametrize("worlds", [2, 7, 16, 37, 70])
@pytest.mark.parametrize("function", [swapped, branched, each_row, nested, scanned])
@pytest.mark.parametrize("long", [False, True])
def test_worlds_take_their_own_branches_and_rounds(platform, function, worlds, long, monkeypatch):
    """With long programs, four groups of lanes evaluate each piece of a kernel in turn."""
    if long:
        monkeypatch.setattr(cpu, "LONG", range(10**9))
        monkeypatch.setattr(entries, "MAX_UNROLLED", 0)
    random = np.random.default_rng(worlds)
    count = len(inspect.signature(function).parameters)
    shape = {each_row: (3,), scanned: ARRAY.shape}.get(function, ())
    args = [3 * random.standard_normal((worlds, *shape)) for _ in range(count)]
    one = jax.make_jaxpr(function)(*(x[0] for x in args))
    given = list(map(jnp.asarray, args))
    here = kernels.run_worlds(platform, one, given, [0] * count, worlds)
    for x, y in zip(here, expected(jax.vmap(function), *args), strict=True):
        np.testing.assert_allclose(np.moveaxis(np.asarray(x), -1, 0), y, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(
    ("worlds", "long"), [(1, False), (5, False), (16, False), (19, False), (19, True), (37, True)]
)
def test_worlds_that_two_groups_of_lanes_have_step_once(worlds, long, monkeypatch):
    """A kernel on a CPU writes its results in place of its arguments."""
    if long:
        monkeypatch.setattr(cpu, "LONG", range(10**9))
    with jax.enable_x64(True):
        system, states = batch("four-bar", np.float64, worlds)

        def end(state: jc.State) -> jc.State:
            record = lambda state, info: None  # noqa: E731
            return jc.rollout(system, jc.Method(), state, None, DT, 5, record=record)[0]

        fall = jax.vmap(end)
        assert_close(jax.jit(fall)(states), by_xla(fall, states), 1e-12)


@pytest.fixture
def folder(tmp_path):
    """A folder for compiled programs, in place of that of other tests."""
    names = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
    before = {name: jax.config.values[name] for name in names}
    for name, value in zip(names, (str(tmp_path), 0.0), strict=True):
        jax.config.update(name, value)
    yield tmp_path
    for name, value in before.items():
        jax.config.update(name, value)


def test_machine_code_is_kept_beside_the_programs_of_jax(folder):
    assert cpu.stored_code("name", lambda: b"code") == b"code"
    assert cpu.stored_code("name", lambda: b"other") == b"code"
    (file,) = folder.iterdir()
    file.write_bytes(file.read_bytes()[:-1])  # as after a full disk
    assert cpu.stored_code("name", lambda: b"again") == b"again"
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 60.0)
    assert cpu.stored_code("quick", lambda: b"code") == b"code"
    assert cpu.stored_code("quick", lambda: b"other") == b"other"
    jax.config.update("jax_compilation_cache_dir", None)
    assert cpu.stored_code("name", lambda: b"other") == b"other"


def test_long_programs_have_memory_of_their_own(monkeypatch):
    """Places of values are then a result that nothing reads, and not on the stack."""
    system, states = batch("chain-5", np.float32, 16)
    step = lambda s: jc.step(system, jc.Method(), s, None, DT)[0]  # noqa: E731
    assert "xui8>" not in jax.jit(jax.vmap(step)).lower(states).as_text()
    monkeypatch.setattr(llvm, "MAX_STACK", 0)
    program = jax.jit(jax.vmap(lambda s: step(s)))
    assert "xui8>" in program.lower(states).as_text()
    assert_close(program(states), by_xla(jax.vmap(step), states), 1e-5)


def counted_down(x: Any) -> Any:
    """Ends for whole numbers only, such as arguments, and not for results."""
    end = lambda y: jax.lax.while_loop(lambda z: z != 0, lambda z: z - 1, y)  # noqa: E731
    return jax.vmap(end)(x.reshape(-1)).reshape(x.shape) - 0.5


@pytest.mark.parametrize("worlds", [1, 16, 17, 35])
def test_worlds_do_not_wait_for_worlds_that_are_done(worlds):
    x = jnp.arange(1.0, worlds + 1)
    mapped = jax.vmap(lambda x: batch_last.call(counted_down, x))
    np.testing.assert_array_equal(jax.jit(mapped)(x), -0.5)


def test_loops_over_the_rows_of_rows(platform):
    """Only the inner loop reads from memory."""

    def total(x: Any) -> Any:
        row = lambda c, r: (jax.lax.scan(lambda c, y: (0.5 * c + y, None), c, r)[0], None)  # noqa: E731
        return jax.lax.scan(row, 0.0, x)[0]

    x = np.random.default_rng(0).standard_normal((66, 70)).astype(np.float32)
    np.testing.assert_allclose(*evaluated(platform, total, x), *expected(total, x), rtol=1e-5)


def test_results_of_other_dtypes_are_left_to_xla():
    x = jnp.ones((4, 3))
    both = lambda x: (x + 1, jnp.full(x.shape, 3, jnp.int8))  # noqa: E731
    pair = jax.vmap(lambda x: batch_last.call(both, x))
    assert pair(x)[1].dtype == np.int8


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_angles_without_a_sine_have_none(platform, dtype):
    with jax.enable_x64(dtype == np.float64):
        (here,) = evaluated(platform, jnp.sin, np.array([1e15, 1e16, 1e30], dtype))
        assert list(np.isnan(here)) == [False, True, True]


def test_a_result_without_the_axis_of_worlds_is_an_error():
    with pytest.raises(ValueError, match="without the axis of its worlds"):
        batch_last.call(lambda x: (x + 1, jnp.arange(3)), jnp.ones(2))


def lowered(function: Callable[..., Any], *args: Any) -> str:
    """Returns the program for NVIDIA's GPUs before XLA compiles it; this needs no GPU."""
    return jax.jit(function).trace(*args).lower(lowering_platforms=("cuda",)).as_text()


@functools.cache
def pendulums(worlds: int = 64) -> tuple[Callable[..., Any], Any]:
    system, states = batch("pendulum", np.float32, worlds)
    return jax.vmap(lambda s: jc.step(system, jc.Method(), s, None, DT)[0]), states


def test_a_step_is_one_kernel():
    step, states = pendulums()
    text = lowered(step, states)
    assert text.count(CALL) == 1
    for other in ("multiply", "case", "while", "select"):
        assert f"stablehlo.{other}" not in text


def test_a_rollout_of_many_worlds_is_one_kernel():
    system, states = batch("pendulum", np.float32, 4096)
    run = jax.vmap(lambda s: jc.rollout(system, jc.Method(), s, None, DT, 100))
    text = lowered(run, states)
    assert text.count(CALL) == 1
    assert "stablehlo.while" not in text
    # loops that would take seconds are left to several kernels
    run = jax.vmap(lambda s: jc.rollout(system, jc.Method(), s, None, DT, 10**6)[0])
    assert "stablehlo.while" in lowered(run, states)


def test_kernels_can_be_turned_off(monkeypatch):
    step, states = pendulums()
    monkeypatch.setenv("JAXCON_KERNELS", "off")
    assert CALL not in lowered(lambda s: step(s), states)


def test_exported_programs_have_no_kernels():
    step, states = pendulums()
    exported = jax.export.export(jax.jit(step), platforms=["cuda"])(states)
    assert CALL not in exported.mlir_module()
