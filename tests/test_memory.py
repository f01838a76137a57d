"""Memory estimates by world, compared with XLA's plans for batches of other sizes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon import scenes as scenes_of_library

CLOSE = 0.2
"""Relative tolerance of a memory estimate; XLA plans each batch size anew."""


def chain(links, dtype):
    """A chain of rods on hinges in space; with one rod, a pendulum."""
    scene, before = jc.Scene(dtype=dtype), jc.WORLD
    for i in range(links):
        rod = jc.inertia.rod(1.0, length=1.0, radius=0.05)
        middle, end = (i + 0.5, 0.0, 0.0), (float(i), 0.0, 0.0)
        scene.add_body(f"link{i}", inertia=rod, position=middle)
        scene.add(jc.Revolute(f"hinge{i}", before, f"link{i}", end, (0.0, 1.0, 0.0)))
        before = f"link{i}"
    return scene.build()


SCENES = {
    "pendulum": lambda: chain(1, jnp.float64),
    "four-bar": scenes_of_library.four_bar,
    "chain": lambda: chain(4, jnp.float32),
}


def planned(function, state, worlds):
    """Returns the bytes that XLA plans for a batch: (arguments, results and temporaries)."""
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (worlds, *x.shape)), state)
    plan = jax.jit(jax.vmap(function)).lower(batch).compile().memory_analysis()
    return plan.argument_size_in_bytes, plan.output_size_in_bytes + plan.temp_size_in_bytes


@pytest.mark.parametrize(
    ("name", "solver"),
    [
        *((name, jc.solvers.Sparse()) for name in SCENES),
        ("four-bar", jc.solvers.Schur()),
        ("four-bar", jc.solvers.RankSafe()),
    ],
)
def test_memory_of_other_batches_is_foretold(name, solver):
    (system, state), method = SCENES[name](), jc.Method(solver=solver)
    memory = jc.analysis.memory(system, method, state)
    for worlds in (100, 2000):
        given, other = planned(lambda s: jc.step(system, method, s, None, 2e-3), state, worlds)
        assert given == memory.state * worlds
        assert abs(memory.working * worlds / other - 1) < CLOSE
        assert abs(memory.of(worlds) / (given + other) - 1) < CLOSE


def test_a_rollout_takes_what_a_step_takes():
    """A rollout without records needs at most the memory of a step, less that of the info."""
    system, state = scenes_of_library.four_bar()
    method = jc.Method(solver=jc.solvers.Sparse())
    memory = jc.analysis.memory(system, method, state)

    def run(s):
        return jc.rollout(system, method, s, None, 2e-3, 50, record=lambda s, i: None)[0]

    given, other = planned(run, state, 400)
    told = jax.eval_shape(lambda s: jc.step(system, method, s, None, 2e-3)[1], state)
    told = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(told))
    assert 0.7 < (given + other) / (memory.of(400) - 400 * told) < 1 + CLOSE
    # a CPU steps some worlds at a time: more of them need less each
    assert sum(planned(run, state, 4000)) / 4000 < 0.85 * (given + other) / 400


def test_a_report_has_it_where_a_method_is_given():
    system, state = chain(1, jnp.float32)
    assert jc.report(system, state).memory is None
    report = jc.report(system, state, jc.Method(), measure=True)
    assert report.memory == jc.analysis.memory(system, jc.Method(), state)
    assert report.memory.state == (7 + 6 + 2 + 1) * 4  # time has two parts
    assert "64 B of state" in str(report)


def test_control_is_that_of_a_step():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    system, state = scene.build()
    control = [1.0] * system.layout.n_u
    assert jc.analysis.memory(system, jc.Method(), state, control).working > 0
    with pytest.raises(ValueError, match=r"control must have shape .*got a dict with push \(2,\)"):
        jc.analysis.memory(system, jc.Method(), state, {"push": np.zeros(2)})
    with pytest.raises(ValueError, match="control must have shape"):
        jc.analysis.memory(system, jc.Method(), state, [*control, 1.0])


LENGTHS = (100, 1000, 10000)


def bob():
    """A pendulum bob on a rod in the plane."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


def planned_gradient(system, method, state, steps, adjoint, worlds=300):
    """Returns the bytes that XLA plans for a gradient by initial positions."""

    def end(q, state):
        start = dataclasses.replace(state, q=q)
        run = functools.partial(jc.rollout, record=lambda s, i: None, adjoint=adjoint)
        return jnp.sum(run(system, method, start, None, 2e-3, steps)[0].q)

    return planned(lambda s: jax.grad(end)(s.q, s), state, worlds)[1]


def test_memory_of_gradients_is_foretold_and_grows_as_a_root():
    (system, state), method = bob(), jc.Method(solver=jc.solvers.Sparse())
    memory = jc.analysis.gradient_memory(system, method, state)
    adjoints = {"every step": jc.adjoints.EveryStep(), "root": jc.adjoints.Checkpoints()}
    exponents = {}
    for name, adjoint in adjoints.items():
        found = []
        for steps in LENGTHS:
            found.append(planned_gradient(system, method, state, steps, adjoint))
            assert abs(memory.of(300, steps, adjoint) / found[-1] - 1) < CLOSE, (name, steps)
        growing = np.array(found) - memory.of(300, 0)
        exponents[name] = np.polyfit(np.log(LENGTHS), np.log(growing), 1)[0]
    assert abs(exponents["every step"] - 1.0) < 0.02
    assert abs(exponents["root"] - 0.5) < 0.02
    assert memory.of(300, 1000, jc.adjoints.Truncated(5, jc.adjoints.Checkpoints())) == memory.of(
        300, 1000, jc.adjoints.Checkpoints()
    )
    assert f"{memory.state} B by checkpoint" in str(memory)
    with pytest.raises(ValueError, match="worlds must be a whole number from 1, got 1.5"):
        memory.of(1.5, 10)
    with pytest.raises(ValueError, match="steps must be a whole number from 0, got -3"):
        memory.of(64, -3)
