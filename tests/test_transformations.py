"""jit, vmap, grad and jvp of a step, for all joints with several integrators and solvers."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from derivatives import assert_batched_either_way
from tolerances import DIFFERENCE, IDENTITY

import jaxcon as jc
from jaxcon.linear.sparse import Sparse

INTEGRATORS = {"euler": jc.SemiImplicitEuler(), "heun": jc.integrators.Heun(), "rk4": jc.RK4()}
SOLVERS = {"schur": jc.solvers.Schur(), "dense": jc.solvers.Dense(), "sparse": Sparse()}
SOLVERS["cg"] = jc.solvers.ConjugateGradients(tolerance=1e-14)
DT = 1e-3


def method_of(integrator, solver):
    return jc.Method(integrator=INTEGRATORS[integrator], solver=SOLVERS[solver])


def close(got, expected, tolerance=IDENTITY):
    """Compares leaf by leaf, relative to the largest entry of each."""
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        np.testing.assert_allclose(
            a, b, rtol=0, atol=tolerance * (1 + np.max(np.abs(b), initial=0))
        )


CASES = [
    *((name, "euler", "sparse") for name in scenes.parts(2, "loop")),
    *((name, "rk4", "schur") for name in scenes.parts(2, "tree")),
    *((name, "euler", "schur") for name in scenes.core(3, "loop")),
    *((name, "heun", "dense") for name in scenes.core(3, "tree")),
    ("mixed-2d", "heun", "sparse"),
    ("mixed-3d", "euler", "dense"),
    ("mixed-2d", "euler", "cg"),
    ("polar", "heun", "dense"),
    ("polar", "rk4", "sparse"),
    ("arm", "rk4", "schur"),
]
"""Scenes with every kind of row twice; each integrator and each solver occurs."""
EAGER = [case for case in CASES if case[0] not in scenes.core(3, "loop")]


@functools.cache
def compiled_step(name, integrator, solver):
    system, method = scenes.build(name).system, method_of(integrator, solver)
    return jax.jit(lambda state: jc.step(system, method, state, None, DT))


@pytest.mark.parametrize(("name", "integrator", "solver"), EAGER)
def test_jit_is_eager(name, integrator, solver):
    built = scenes.build(name)
    with jax.disable_jit():
        eager = jc.step(built.system, method_of(integrator, solver), built.state, None, DT)
    same_step(compiled_step(name, integrator, solver)(built.state), eager)


def same_step(got, expected):
    """States agree to rounding; forces agree less, since feedback divides rounding of φ by h²."""
    close(got[0], expected[0])
    close(got[1], expected[1], 1e-16 / DT**2 * 1e3)


def several(built):
    """Returns states on the constraints, off them, and at twice the velocity; also as a batch."""
    states = [built.state, built.off, dataclasses.replace(built.state, v=2 * built.state.v)]
    return states, jax.tree.map(lambda *x: jnp.stack(x), *states)


@pytest.mark.parametrize(("name", "integrator", "solver"), CASES)
def test_vmap_is_a_loop(name, integrator, solver):
    built = scenes.build(name)
    system, method = built.system, method_of(integrator, solver)
    states, batch = several(built)
    one = compiled_step(name, integrator, solver)
    expected = jax.tree.map(lambda *x: jnp.stack(x), *(one(s) for s in states))
    got = jax.jit(jax.vmap(lambda s: jc.step(system, method, s, None, DT)))(batch)
    for i in range(len(states)):
        ours, theirs = (jax.tree.map(lambda x, i=i: x[i], tree) for tree in (got, expected))
        same_step(ours, theirs)


STEPS = 20
GRADIENTS = [
    *((name, "euler", "schur") for name in scenes.parts(2, "loop")),
    *((name, "heun", "dense") for name in scenes.parts(2, "tree")),
    *((name, "euler", "schur") for name in scenes.core(3, "tree")),
    ("revolute-3d-between", "heun", "dense"),
    ("fixed-3d-loop", "euler", "schur"),
    ("distance-2d-between", "rk4", "sparse"),
    ("mixed-2d", "euler", "sparse"),
    ("revolute-2d-loop", "euler", "cg"),
]


def numbers(built):
    """Returns the numbers to differentiate by: position, velocity, masses, one of each joint."""
    params = built.system.params
    own = {f"{name}.{field}": params[name][field] for name, field in built.parameters}
    return {"position": jnp.zeros_like(built.state.v), "velocity": built.state.v} | own


def outcome(built, method, x):
    """Returns a number that depends on every coordinate of the final state."""
    changes = {}
    for name, field in built.parameters:
        changes.setdefault(name, {})[field] = x[f"{name}.{field}"]
    q = built.system.retract(built.state.q, x["position"])
    start = dataclasses.replace(built.state, q=q, v=x["velocity"])
    final, _ = jc.rollout(built.system.with_params(changes), method, start, None, DT, STEPS)
    random = np.random.default_rng(0)
    weights = (random.normal(size=final.q.shape), random.normal(size=final.v.shape))
    return final.q @ jnp.asarray(weights[0]) + final.v @ jnp.asarray(weights[1])


@pytest.mark.parametrize(("name", "integrator", "solver"), GRADIENTS)
def test_reverse_and_forward_mode_are_central_differences(name, integrator, solver):
    built = scenes.build(name)
    x = numbers(built)

    def value(x):
        return outcome(built, method_of(integrator, solver), x)

    gradient = jax.jit(jax.grad(value))(x)
    along = jax.jit(lambda x, dx: jax.jvp(value, (x,), (dx,)))
    for name, direction in directions(x):
        forward = along(x, direction)[1]
        reverse = dot(gradient, direction)
        # feedback moves a displaced state back within a step, which is far from linear
        slope = difference(
            lambda x: along(x, x)[0], x, direction, 5e-5 if name == "position" else 3e-4
        )
        scale = max(abs(float(slope)), 1e-2)
        assert abs(float(forward - reverse)) < 1e-9 * scale, name
        assert abs(float(forward - slope)) < DIFFERENCE * scale, name


def directions(x):
    """Yields one random direction for each named number, zero in the others."""
    random = np.random.default_rng(1)
    for name in x:
        yield (
            name,
            {
                key: jax.tree.map(lambda leaf: jnp.asarray(random.normal(size=leaf.shape)), part)
                if key == name
                else jax.tree.map(jnp.zeros_like, part)
                for key, part in x.items()
            },
        )


def dot(a, b):
    return sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def difference(f, x, direction, h=3e-4):
    """Returns the derivative along a direction by fourth-order central differences."""

    def at(s):
        return f(jax.tree.map(lambda a, d: a + s * h * d, x, direction))

    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)


def test_gradients_at_rest_and_at_the_identity_are_finite():
    """Bodies are upright and at rest without gravity; each joint has a spring of length zero."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0))
    for kind in ("fixed", "revolute", "prismatic", "driven_revolute", "holonomic"):
        pair = f"{kind} first", f"{kind} second"
        for name in pair:
            scene.add_body(name, mass=1.0, inertia=(1.0, 1.0, 1.0))
        axis = np.array([0.0, 0.0, 1.0])
        site = scenes.Site(*pair, 3, np.zeros(3), axis, np.ones(3), suffix=f" {kind}")
        for element in scenes.JOINTS[kind].make(site):
            scene.add(element)
        scene.add(jc.Spring(f"{kind} spring", jc.WORLD, pair[0], stiffness=1.0, damping=1.0))
    system, state = scene.build()

    def value(q, v, params):
        start = dataclasses.replace(state, q=q, v=v)
        final, _ = jc.rollout(system.with_params(params), jc.Method(), start, None, DT, 3)
        return jnp.sum(final.q) + jnp.sum(final.v)

    gradient = jax.jit(jax.grad(value, argnums=(0, 1, 2)))(state.q, state.v, system.params)
    for path, leaf in jax.tree.leaves_with_path(gradient):
        assert jnp.all(jnp.isfinite(leaf)), path


def test_gradient_of_the_step_size_and_the_gains():
    built = scenes.build("revolute-2d-loop")

    def value(x):
        method = jc.Method(stabilizer=jc.Baumgarte(x["alpha"], x["beta"]))
        final, _ = jc.rollout(built.system, method, built.off, None, x["dt"], STEPS)
        return jnp.sum(final.q**2)

    x = {"alpha": jnp.asarray(20.0), "beta": jnp.asarray(30.0), "dt": jnp.asarray(DT)}
    gradient, run = jax.jit(jax.grad(value))(x), jax.jit(value)
    for name in x:
        direction = {key: jnp.asarray(float(key == name)) * x[key] for key in x}
        slope = difference(run, x, direction)
        np.testing.assert_allclose(dot(gradient, direction), slope, rtol=DIFFERENCE)


def counted(a, b, t, p):
    TRACES.append(1)
    return scenes.breathing(a, b, t, p)


TRACES = []


def test_a_step_is_traced_once_for_three_sets_of_numbers():
    scene = jc.Scene(dim=2)
    scene.add_body("link", mass=1.0, inertia=1.0, position=(1.0, 0.0))
    params = {"anchor": jnp.zeros(2), "square": 1.0}
    scene.add(jc.joints.Holonomic(counted, (jc.WORLD, "link"), name="joint", params=params))
    system, state = scene.build()
    step = jax.jit(lambda *args: jc.step(*args))
    seen = []
    for i in range(1, 4):
        method = jc.Method(stabilizer=jc.Baumgarte(jnp.asarray(10.0 * i), jnp.asarray(20.0 * i)))
        changes = {
            "link": {"mass": float(i)},
            "joint": {"params": params | {"square": jnp.asarray(1.0 * i)}},
        }
        changes["joint"]["params"]["anchor"] = jnp.asarray([0.1 * i, 0.0])
        step(system.with_params(changes), method, state, None, jnp.asarray(1e-3 * i))
        seen.append(len(TRACES))
    assert seen[0] == seen[1] == seen[2]
    assert step._cache_size() == 1


def test_a_second_build_of_a_scene_is_not_a_second_trace():
    step = jax.jit(lambda *args: jc.step(*args))
    for mass in (1.0, 2.0):
        scene = jc.Scene(dim=2)
        scene.add_body("link", mass=mass, inertia=1.0)
        scene.add(jc.Revolute("hinge", jc.WORLD, "link", point=(0.0, 1.0)))
        system, state = scene.build()
        step(system, jc.Method(), state, None, 1e-3)
    assert step._cache_size() == 1


@pytest.mark.parametrize(("name", "integrator", "solver"), CASES)
def test_no_float64_in_a_float32_step(name, integrator, solver):
    built, method = scenes.build(name, "float32"), method_of(integrator, solver)
    if integrator == "euler":  # the other integrators have the default gains
        gain = jnp.asarray(20.0, jnp.float32)
        method = dataclasses.replace(method, stabilizer=jc.Baumgarte(gain, gain))
    solver = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), method.solver)
    method = dataclasses.replace(method, solver=solver)

    def step(state, method, dt):
        return jc.step(built.system, method, state, None, dt)

    jaxpr = jax.make_jaxpr(step)(built.state, method, jnp.asarray(DT, jnp.float32))
    assert "f32" in str(jaxpr)
    assert "f64" not in str(jaxpr)


def test_no_float64_in_the_derivative_of_a_float32_step():
    built = scenes.build("mixed-3d", "float32")

    def value(v):
        state = dataclasses.replace(built.state, v=v)
        return jnp.sum(jc.step(built.system, jc.Method(), state, None, DT)[0].q)

    assert "f64" not in str(jax.make_jaxpr(jax.grad(value))(built.state.v))


@pytest.mark.parametrize("name", scenes.SELECTED)
def test_a_float32_world_survives_a_thousand_steps(name):
    built = scenes.build(name, "float32")
    method, dt = jc.Method(), jnp.asarray(DT, jnp.float32)
    final, _ = jax.jit(lambda s: jc.rollout(built.system, method, s, None, dt, 1000, every=1000))(
        built.state
    )
    assert final.status == jc.Status.OK
    assert final.q.dtype == jnp.float32
    violation = jc.violation(built.system, final)
    for constraint in violation.layout.names:
        assert violation[constraint] < 1e-3, constraint


def test_a_force_may_branch():
    """A `lax.cond` works in both orders of `grad` and `vmap`.

    Its other branch has no derivative.
    """

    def force(q, v, t, control, k):
        return jax.lax.cond(q[0] > 0, lambda: -k * jnp.sqrt(q), lambda: -k * q)

    def value(k, v):
        system = jc.GeneralizedSystem(mass=lambda q, k: jnp.eye(1), force=force, params=k)
        state = jc.init(system, jc.Method(), jnp.array([0.1]), v[None])
        return jc.rollout(system, jc.Method(), state, None, 1e-2, 20)[0].q[0]

    speeds = np.array([1.0, -1.0, -2.0])
    assert_batched_either_way(value, 2.0, speeds, 1e-12)
