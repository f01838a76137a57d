"""Inequality rows of which only the nearest are solved."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.contact.bounded import probes

DT = 2e-3


@functools.cache
def rope(dim: int, dtype: str = "float64"):
    """Six beads on rods; the left two lie on the floor, the others are above it."""
    gravity = (0.0,) * (dim - 1) + (-9.81,)
    scene = jc.Scene(dim=dim, gravity=gravity, dtype=jnp.dtype(dtype))
    for i in range(6):
        height = 0.05 if i < 2 else 0.05 + 0.1 * (i - 1)
        scene.add_particle(f"b{i}", mass=1.0 + i, position=(0.2 * i, *(0.0,) * (dim - 2), height))
        if i:
            scene.add(jc.Distance(f"rod{i}", f"b{i - 1}", f"b{i}"))
        scene.add(jc.PlaneContact(f"touch{i}", jc.WORLD, f"b{i}", radius=0.05, friction=0.4))
    scene.add(
        jc.contacts.Rope("leash", jc.WORLD, "b0", length=0.5, point_a=(-0.3,) + (0.0,) * (dim - 1))
    )
    return scene.build()


def run(bounded, system, start, steps=40, v=None):
    """Returns the last state and the residual of inequality rows in each step."""
    method = jc.Method(solver=jc.solvers.Sparse(), contact_solver=bounded)
    state = jc.init(system, method, start.q, start.v if v is None else v)

    def record(state, info):
        return info.reactions.residual

    return jc.rollout(system, method, state, None, DT, steps, record=record)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("solver", [jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel(100)])
def test_what_does_not_touch_may_be_left_out(dim, solver):
    system, start = rope(dim)
    push = start.v.at[:6].add(0.3)  # so that the beads on the floor slide to the right
    whole, _ = jax.jit(lambda v: run(solver, system, start, v=v))(push)
    some = jc.solvers.ActiveSet(solver, contacts=4, stops=1)
    few, missed = jax.jit(lambda v: run(some, system, start, v=v))(push)
    np.testing.assert_allclose(few.q, whole.q, atol=1e-12)
    np.testing.assert_allclose(few.v, whole.v, atol=1e-10)
    assert np.max(missed) < 1e-9


def test_too_few_show_in_the_residual():
    system, start = rope(2)
    _, missed = jax.jit(lambda: run(jc.solvers.ActiveSet(contacts=1), system, start, 2))()
    assert missed[0] > 0.5 * 9.81 * DT  # the second bead falls freely for a step


@pytest.mark.parametrize("solver", [jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel(30)])
def test_what_joints_hold_takes_no_place(solver):
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81))
    for name, x in (("a", 0.0), ("b", 0.08)):
        scene.add_particle(name, mass=1.0, position=(x, 0.05))
        scene.add(jc.PlaneContact(f"floor {name}", jc.WORLD, name, radius=0.05, friction=0.3))
    scene.add(jc.Distance("rod", "a", "b"))  # keeps the overlap as it is
    scene.add(jc.contacts.CapsuleContact("held", "a", "b", radius_a=0.05, radius_b=0.05))
    system, start = scene.build()
    final, missed = jax.jit(
        lambda: run(jc.solvers.ActiveSet(solver, contacts=2), system, start, 3)
    )()
    np.testing.assert_allclose(final.v, 0, atol=1e-12)
    np.testing.assert_allclose(missed, 0, atol=1e-12)


def test_no_row_of_many_is_taken_for_held():
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81), dtype=jnp.float32)
    for i in range(400):
        scene.add_particle(f"b{i}", mass=10.0 ** (i % 7 - 3), position=(0.3 * i, 0.05))
        scene.add(jc.PlaneContact(f"c{i}", jc.WORLD, f"b{i}", radius=0.05, friction=0.4))
    system, start = scene.build()
    some = jc.solvers.ActiveSet(
        jc.solvers.GaussSeidel(5), contacts=399
    )  # the last bead falls freely
    final, missed = jax.jit(lambda: run(some, system, start, 1))()
    falling = np.flatnonzero(np.abs(final.v[400:]) > 1e-6)
    assert len(falling) == 1
    assert missed[0] > 0.9 * 9.81 * DT


def test_probes_do_not_cancel_along_a_chain():
    """Probe loads of stops at neighboring hinges, of either sign, must not cancel."""
    row = np.array([-0.5, 0.5, 1.0, -1.0, -0.5, 0.5])
    for dtype in ("float32", "float64"):
        sides = np.stack(probes(jnp.zeros(600, dtype)))
        felt = np.stack([np.abs(np.convolve(side, row[::-1], "valid")) for side in sides]).max(0)
        assert felt.min() > 1e-3


@pytest.mark.parametrize(
    "solver",
    [
        lambda x: jc.solvers.Sparse(tikhonov=1e-10 * x),
        lambda x: jc.solvers.Schur(tikhonov=1e-10 * x),
        lambda x: jc.solvers.ConjugateGradients(tolerance=1e-12 * x),
        lambda x: jc.solvers.RankSafe(share=1e-9 * x, always=True),
        lambda x: jc.solvers.Priority({"rod1": 1}, cutoff=1e-9 * x, damping=3e-3 * x),
    ],
)
def test_numbers_of_a_solver_may_differ_by_world(solver):
    system, start = rope(2)

    def end(x):
        method = jc.Method(solver=solver(x), contact_solver=jc.solvers.GaussSeidel(20))
        state = jc.init(system, method, start.q, start.v)
        return jc.step(system, method, state, None, DT)[0].v

    together = jax.jit(jax.vmap(end))(jnp.asarray([1.0, 2.0]))
    shared = jax.jit(jax.vmap(lambda _: end(1.0)))(jnp.zeros(2))
    np.testing.assert_allclose(together[0], shared[0], atol=1e-9)
    np.testing.assert_allclose(together[0], jax.jit(lambda: end(1.0))(), atol=1e-9)


def test_as_many_as_there_are_are_all(monkeypatch):
    monkeypatch.setenv("JAXCON_KERNELS", "off")  # operations of kernels are not in the text of XLA
    system, start = rope(2)

    def program(bounded):
        return jax.jit(lambda: run(bounded, system, start, 2)[0].q).lower().as_text()

    assert "top_k" not in program(jc.solvers.ActiveSet(contacts=6, stops=9))
    assert "top_k" in program(jc.solvers.ActiveSet(contacts=5))


def test_each_world_has_its_own():
    system, start = rope(2, "float32")
    lifts = jnp.asarray([0.0, 0.3, -0.05], jnp.float32)
    some = jc.solvers.ActiveSet(jc.solvers.GaussSeidel(50), contacts=3)

    def end(lift):
        q = start.q.at[6:12].add(lift * jnp.linspace(0, 1, 6, dtype=jnp.float32))
        moved = dataclasses.replace(start, q=q)
        return run(some, system, moved, 20)[0].q

    together = jax.jit(jax.vmap(end))(lifts)
    alone = jnp.stack([jax.jit(end)(lift) for lift in lifts])
    np.testing.assert_allclose(together, alone, atol=2e-6)
    assert np.isfinite(together).all()


def test_derivatives_are_those_of_all_rows():
    system, start = rope(2)

    def end(bounded, push):
        return run(bounded, system, start, 20, v=start.v.at[:6].add(push))[0].q[0]

    some, every = (
        jc.solvers.ActiveSet(jc.solvers.GaussSeidel(50), contacts=3),
        jc.solvers.GaussSeidel(50),
    )
    push = 0.3
    reverse = jax.jit(jax.grad(functools.partial(end, some)))(push)
    forward = jax.jit(jax.jacfwd(functools.partial(end, some)))(push)
    value = jax.jit(functools.partial(end, every))
    difference = (value(push + 1e-5) - value(push - 1e-5)) / 2e-5
    np.testing.assert_allclose([forward, reverse], difference, rtol=1e-6)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (
            lambda: jc.solvers.ActiveSet(contacts=0),
            "ActiveSet: contacts must be a whole number from 1",
        ),
        (lambda: jc.solvers.ActiveSet(stops=2.0), "ActiveSet: stops must be a whole number from 1"),
        (
            lambda: jc.solvers.ActiveSet(jc.solvers.Sparse()),
            "ActiveSet: solver must be one of inequality rows",
        ),
        (
            lambda: jc.solvers.ActiveSet(jc.solvers.ActiveSet()),
            "ActiveSet: solver must be one of inequality rows",
        ),
    ],
)
def test_wrong_choices_are_named(wrong, says):
    with pytest.raises(ValueError, match=says):
        wrong()
