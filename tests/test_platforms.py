"""Programs for a GPU are lowered on a machine without one; nothing is compiled or run."""

import jax
import jax.numpy as jnp
import pytest

import jaxcon as jc


def arm(dtype):
    """The first example of the README."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_body("arm", mass=1.0, inertia=1 / 12, position=(0.5, 0.0))
    scene.add_particle("bob", mass=0.5, position=(2.0, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)))
    scene.add(jc.Distance("rod", "arm", "bob", point_a=(1.0, 0.0)))
    return scene.build()


def ball(dtype):
    """A ball that falls on a floor, and a pendulum on a servo, whose turns are counted."""
    scene = jc.Scene(dim=3, dtype=dtype)
    scene.add_body("ball", mass=1.0, inertia=(0.004, 0.004, 0.004), position=(0.0, 0.0, 0.2))
    scene.add_body("rod", mass=1.0, inertia=(0.1, 0.1, 0.01), position=(1.0, 0.0, -0.5))
    floor = jc.PlaneContact("floor", jc.WORLD, "ball", friction=0.5, radius=0.1, restitution=0.6)
    scene.add(floor)
    scene.add(jc.Revolute("hinge", jc.WORLD, "rod", point=(1.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)))
    scene.add(jc.forces.PositionServo("servo", "hinge", 10.0, 1.0))
    return scene.build()


EVENTS = jc.Method(jc.RK4(), events=jc.integrators.Events())
CASES = [
    (ball, jc.Method()),
    (ball, EVENTS),
    (arm, jc.Method()),
    (arm, jc.Method(jc.integrators.RATTLE())),
]
CASES += [
    (arm, jc.Method(jc.RK4(), jc.Projection())),
    (arm, jc.Method(jc.integrators.GeneralizedAlpha())),
    (arm, jc.Method(solver=jc.solvers.Priority({"rod": 1}))),
]


@pytest.mark.parametrize("form", ["one world", "batch", "gradient"])
@pytest.mark.parametrize(("build", "method"), CASES)
def test_programs_are_lowered_for_a_gpu(build, method, form):
    system, state = build(jnp.float32)
    control = jnp.zeros((3, 1), jnp.float32) if build is ball else None

    def run(v):
        start = jc.init(system, method, state.q, v)
        return jc.rollout(system, method, start, control, 1e-3, 3)[0].q

    function = {"batch": jax.vmap(run), "gradient": jax.grad(lambda v: run(v)[-1])}.get(form, run)
    v = jnp.stack([state.v, state.v]) if form == "batch" else state.v
    program = jax.jit(function).trace(v).lower(lowering_platforms=("cuda",))
    text = program.as_text()
    assert "stablehlo.while" in text
    # a step is one kernel, or worlds are contiguous within it, however the caller stores them
    by_xla = "__gpu$xla.gpu.ptx" not in text
    assert ("LayoutConstraint" in text) == (form == "batch" and by_xla)
    # kernels have no eigenvalues
    assert by_xla == isinstance(method.solver, jc.solvers.Lexicographic)
