import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from functions import (
    FUNCTIONS,
    WIDE,
    arguments_that_do_not_matter,
    chain_of_shared_values,
    loops_in_branches,
    rows_and_loops,
)

import jaxcon as jc
from jaxcon.scenes import four_bar
from jaxcon.staging import batch_last, fusion
from jaxcon.staging.batch_last import Native
from jaxcon.staging.operations import count
from jaxcon.staging.program import Program

X = np.linspace(0.3, 1.7, 24).reshape(4, 6)
Y = np.linspace(-1.0, 2.0, 24).reshape(4, 6)


def staged(function):
    """Returns the function, run in stages (kernels)."""
    native = Native(function)
    return lambda *args: fusion.run_staged(native, args)


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("constant", [False, True], ids=["", "constant"])
def test_the_results_are_those_of_the_function(function, dtype, constant):
    x, y = jnp.asarray(X, dtype), jnp.asarray(Y, dtype)
    if constant:
        found = jax.jit(lambda x: staged(function)(x, np.ones(Y.shape, dtype)))(x)
        expected = function(x, jnp.ones_like(y))
    else:
        found, expected = jax.jit(staged(function))(x, y), function(x, y)
    compare(found, expected)


@pytest.mark.parametrize("per_operand", [0, 10**9], ids=["outside", "inside"])
@pytest.mark.parametrize("sign", [1, -1])
def test_branches_with_loops_may_be_inside_or_outside_of_kernels(per_operand, sign, monkeypatch):
    monkeypatch.setattr(fusion, "PER_OPERAND", per_operand)
    x, y = sign * jnp.asarray(X), jnp.asarray(Y)
    stages = fusion.Stages(jax.make_jaxpr(loops_in_branches)(x, y), apart=True)
    assert (len(stages.parts) == 1) == (per_operand > 0)
    compare(jax.jit(stages)(x, y), loops_in_branches(x, y))


@pytest.mark.parametrize("per_operand", [0, 10**9], ids=["outside", "inside"])
@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
def test_a_last_function_takes_the_results(function, per_operand, monkeypatch):
    monkeypatch.setattr(fusion, "PER_OPERAND", per_operand)
    x, y = jnp.asarray(X), jnp.asarray(Y)

    def negated(*results):
        return [-jnp.asarray(z, float) for z in results]

    run = jax.jit(lambda x, y: fusion.run_staged(Native(function), (x, y), negated))
    compare(run(x, y), negated(*function(x, y)))


@pytest.mark.parametrize("function", WIDE, ids=lambda f: f.__name__)
def test_arrays_may_be_wide(function):
    x, y = (jnp.asarray(np.tile(z, (1, 20_000))) for z in (X, Y))
    compare(jax.jit(staged(function))(x, y), function(x, y))


def compare(found, expected):
    for a, b in zip(found, expected, strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        rounding = 1e-12 if a.dtype == np.float64 else 2e-5
        np.testing.assert_allclose(a, b, rtol=rounding, atol=rounding)


def test_two_arguments_may_be_the_same_array():
    def turned(a, b):
        turned = b.reshape(-1)[::-1].reshape(b.shape)
        return [a + b[::-1], a + jnp.sum(b, axis=0)[None], a - turned]

    def run(x):
        z = jnp.sin(x) * 1.5
        return batch_last.call(turned, z, z)

    z = np.sin(X) * 1.5
    compare(jax.jit(run)(X), [z + z[::-1], z + z.sum(axis=0), z - z[::-1, ::-1]])


def test_cotangents_may_be_equal():
    def function(x):
        return [x, jnp.broadcast_to(jnp.sum(x, axis=0), x.shape)]

    found = jax.jit(jax.grad(lambda x: sum(map(jnp.sum, batch_last.call(function, x)))))(X)
    np.testing.assert_allclose(found, np.full(X.shape, 5.0))


def a_user_force(q, v, t, u, p):
    """Returns a force with concatenations, slices and a loop."""
    joined = jnp.concatenate([q, v])
    twice = jnp.concatenate([joined[:4], joined[:4]])
    return jax.lax.fori_loop(0, 3, lambda i, f: f + p["k"] @ f, -jnp.sin(twice[2:6]))


def test_a_step_with_such_functions_is_that_of_the_compiler_alone(monkeypatch):
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.ones(4),
        force=a_user_force,
        constraints=(
            jc.joints.Holonomic(lambda q, t, p: jnp.stack([q[:2] @ q[:2] - 1.0]), name="rod"),
        ),
        params={"k": jnp.asarray(np.random.default_rng(0).normal(size=(4, 4)))},
    )
    state = jc.init(system, jc.Method(), jnp.array([0.0, 1.0, 0.2, 0.3]), jnp.ones(4) * 0.1)
    batch = jax.tree.map(lambda x: jnp.stack([x, x, x]), state)

    def run(s):
        return jc.step(system, jc.Method(), s, None, 1e-2)[0]

    found = jax.jit(jax.vmap(run))(batch)
    monkeypatch.setenv("JAXCON_STAGES", "off")
    jax.clear_caches()
    expected = jax.jit(jax.vmap(run))(batch)
    compare([found.q, found.v], [expected.q, expected.v])


def test_a_loop_that_only_prints(capsys):
    def loud(x, y):
        def body(carry, row):
            jax.debug.callback(lambda z: print("row", float(z)), row[0])
            return carry, None

        jax.lax.scan(body, 0, x)
        return [x + y]

    jax.block_until_ready(jax.jit(staged(loud))(X, Y))
    jax.effects_barrier()
    assert capsys.readouterr().out.count("row") == 4


def test_shared_values_are_computed_once():
    text = jax.jit(staged(chain_of_shared_values)).lower(X, Y).compile().as_text()
    assert len(re.findall(r" multiply\(", text)) < 8 * 40


def unread(text):
    """Returns the arguments that a kernel does not read."""
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
    cut = staged(function)
    for run, args in ((cut, (X, Y)), (lambda x: cut(x, np.zeros_like(Y)), (X,))):
        text = jax.jit(run).lower(*args).compile().as_text()
        assert "%kernel" in text
        assert not unread(text)


@pytest.mark.parametrize(
    "solver",
    [jc.solvers.Sparse(), jc.solvers.Schur(), jc.solvers.ConjugateGradients()],
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

    jax.block_until_ready(jax.jit(staged(loud))(X, Y))
    jax.effects_barrier()
    assert "seen 0.3" in capsys.readouterr().out


def test_it_can_be_left_to_the_compiler(monkeypatch):
    monkeypatch.setenv("JAXCON_STAGES", "off")
    left = jax.jit(staged(chain_of_shared_values)).lower(X, Y).as_text()
    assert "inlineable" not in left


@jax.custom_jvp
def own_tangent(x):
    return jnp.sin(x)


own_tangent.defjvp(lambda xs, dxs: (own_tangent(*xs), dxs[0] * jnp.cos(xs[0])))


@jax.custom_vjp
def own_cotangent(x):
    return jnp.sin(x)


own_cotangent.defvjp(lambda x: (own_cotangent(x), x), lambda x, dy: (dy * jnp.cos(x),))


def root(x):
    """Returns the root y of y + y = sin x, with implicit differentiation."""

    def solve(function, start):
        return start - function(start) / 2

    return jax.lax.custom_root(
        lambda y: y + y - jnp.sin(x), x, solve, lambda linear, b: b / linear(jnp.ones_like(b))
    )


CALLING = {
    "jit": jax.jit(jnp.sin),
    "checkpoint": jax.checkpoint(jnp.sin),
    "tangent of a checkpoint": lambda x: jax.jvp(jax.checkpoint(jnp.sin), (x,), (x,))[1],
    "custom_jvp": own_tangent,
    "custom_vjp": own_cotangent,
    "custom_root": root,
    "relu": jax.nn.relu,
}


@pytest.mark.parametrize("name", CALLING)
def test_functions_that_are_only_called_are_inlined(name):
    """Calls are inlined, whatever primitive of JAX they use; each would split a kernel."""
    function = Native(lambda x: [CALLING[name](x) * 2])
    program = Program(function.traced(((4, 6), np.dtype("float64"))), fusion._settled_body)
    known = fusion.ARITHMETIC | fusion.COSTLY | fusion.MOVES
    assert {op.name for op in program.operations} <= known
    assert program.operations
    (found,) = fusion.run_staged(function, [jnp.asarray(X)])
    np.testing.assert_allclose(found, CALLING[name](jnp.asarray(X)) * 2, rtol=1e-14)
    counted = count(jax.make_jaxpr(CALLING[name])(jnp.asarray(X)).jaxpr)
    assert counted >= X.size


TWO_OPERANDS = fusion._names("add sub mul max min eq ne lt le gt ge nextafter div pow atan2 rem")


def functions_of(name):
    """Returns functions that consist of the named operation alone."""
    if name == "integer_pow":
        return [partial(jax.lax.integer_pow, y=y) for y in (-3, 2, 15, 1023)]
    if name == "round":
        return [partial(jax.lax.round, rounding_method=x) for x in jax.lax.RoundingMethod]
    if name in ("not", "and", "or", "xor"):
        operation = getattr(jnp, f"logical_{name}")
        return [lambda x: operation(*([x > 0.3, x < 0.6][: 1 if name == "not" else 2]))]
    if name == "clamp":
        return [lambda x: jax.lax.clamp(jnp.zeros_like(x), x, jnp.ones_like(x))]
    if name == "select_n":
        return [lambda x: jax.lax.select_n(x > 0.3, x, 2 * x)]
    if name == "add_any":
        return [lambda x: x + 1]
    operation = getattr(jax.lax, name)
    return [(lambda x: operation(x, 2 * x)) if name in TWO_OPERANDS else operation]


@pytest.mark.parametrize("name", sorted(fusion.ARITHMETIC | fusion.COSTLY))
def test_no_operation_costs_more_than_is_said(name):
    for dtype in ("float32", "float64"):
        x = jnp.linspace(0.1, 0.9, 128, dtype=dtype)
        for function in functions_of(name):
            cost = jax.jit(function).lower(x).compile().cost_analysis()
            found = cost.get("flops", 0) + 2 * cost.get("transcendentals", 0)
            assert found <= fusion.work(name) * x.size


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", ["asinh", "mul"])
def test_a_single_result_is_alone_up_to_what_the_compiler_divides_among_threads(name, dtype):
    """The longest light chain compiles with one result; one twice as long needs a second."""
    x = jnp.linspace(0.1, 0.9, 128, dtype=dtype)
    operation = {"asinh": jnp.arcsinh, "mul": lambda x: x * x + 0.1}[name]

    def chain(x, length):
        for _ in range(length):
            x = operation(0.5 * x)
        return x

    def is_light(length):
        stages = fusion.Stages(jax.make_jaxpr(chain, static_argnums=1)(x, length))
        return stages.is_light(stages.program.inputs, stages.program.outputs)

    longest = max(n for n in range(1, 150) if is_light(n))
    assert 4 < longest < 149
    for length, light in ((longest, True), (2 * longest, False)):

        def kernel(x, length=length, light=light):
            (y,) = fusion.uninlined(lambda x: [chain(x, length)], [x], light)
            return fusion.uninlined(lambda y: [y + 1, y * 2], [y])

        found = jax.jit(lambda x, kernel=kernel: fusion._kernel(kernel, [x]))(x)
        compare(found, [chain(x, length) + 1, chain(x, length) * 2])


def test_a_light_stage_of_one_result_has_no_other():
    """A second result would need a buffer, and each buffer costs a look-up in every call."""

    def chain(x):
        for _ in range(5):
            x = jnp.sin(x) * x
        return [x * x, x + 1]

    text = jax.jit(staged(chain)).lower(X).as_text()
    results = re.findall(r"func private @stage.*-> (.*) {", text)
    assert any("," not in x for x in results)
    assert not any("i1" in x for x in results)
