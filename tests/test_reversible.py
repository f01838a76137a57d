"""Reversible adjoints: states are recomputed backwards, and lost states are detected."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.execution.step import undo

METHOD = jc.Method(jc.integrators.RATTLE())
DT = 2e-3


def double_pendulum():
    """Two rods in the plane, released level, with a motor and a damper between them."""
    scene = jc.Scene(dim=2)
    for i in range(2):
        before = f"b{i - 1}" if i else jc.WORLD
        scene.add_body(f"b{i}", mass=1.0, inertia=1 / 12, position=(i + 0.5, 0.0))
        scene.add(jc.Revolute(f"hinge{i}", before, f"b{i}", point=(float(i), 0.0)))
    scene.add(jc.forces.JointDamper("friction", "hinge1", damping=0.05))
    scene.add(jc.Motor("motor", "hinge1"))
    return scene.build()


def test_a_thousand_steps_have_the_gradient_of_every_step():
    """Derivatives by initial velocity, mass, damping, controls and h agree, records included."""
    system, state = double_pendulum()

    def value(x, adjoint):
        numbers = {"b0": {"mass": x["mass"]}, "friction": {"damping": x["damping"]}}
        changed = system.with_params(numbers)
        start = dataclasses.replace(state, v=state.v + x["push"] * jnp.ones_like(state.v))

        def record(s, info):
            return jc.energy(changed, s).total, info.multipliers[0]

        run = functools.partial(jc.rollout, record=record, adjoint=adjoint)
        final, (energy, pull) = run(changed, METHOD, start, x["u"], x["dt"], 1000)
        return final.q[3] * final.v[4] + jnp.mean(energy) + 0.01 * jnp.mean(pull**2)

    x = {"mass": 1.0, "damping": 0.05, "dt": DT, "push": 0.0, "u": np.full((1000, 1), 0.1)}
    x = jax.tree.map(jnp.asarray, x)
    found, expected = (
        jax.jit(jax.value_and_grad(functools.partial(value, adjoint=adjoint)))(x)
        for adjoint in (jc.adjoints.Reversible(), jc.adjoints.EveryStep())
    )
    assert min(np.max(np.abs(x)) for x in jax.tree.leaves(expected)) > 1e-4
    for got, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-10 * np.max(np.abs(wanted)))


def bob(damping=0.0, dtype=jnp.float64):
    """A particle on a rod with a damper and a control force."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0), velocity=(0.0, 1.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    place = {"point_a": (0.0, 2.0)}
    scene.add(jc.Spring("spring", jc.WORLD, "bob", stiffness=1.0, damping=damping, **place))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    return scene.build()


SYSTEM, STATE = bob(0.3)
WORLDS = jnp.array([[0.0, 1.0], [0.0, -0.5], [jnp.nan, 0.0]])
"""Three worlds; the last one fails at once."""


def along(v, mass, adjoint, every=1, steps=12):
    """Returns a value of a rollout by velocity and mass; the record closes over both."""
    system = SYSTEM.with_params({"bob": {"mass": mass}})
    start = dataclasses.replace(STATE, v=v)
    controls = jnp.stack([0.1 * jnp.arange(1.0 * steps)] * 2, axis=1) * v[1]

    def record(state, info):
        return mass * state.q[0] * v[1] * state.v[1], info.multipliers, info.status

    run = functools.partial(jc.rollout, record=record, every=every, adjoint=adjoint)
    final, (speed, pull, _) = run(system, METHOD, start, controls, 1e-2, steps)
    return final.q[1] + jnp.sum(speed) + jnp.sum(pull)


def test_batches_in_both_orders_strides_and_failed_worlds():
    """The gradient is truncated every five steps; a failed world does not affect the others."""

    def one(v, mass, adjoint):
        return jax.grad(along, argnums=(0, 1))(v, mass, adjoint, 3)

    back = jc.adjoints.Truncated(5, within=jc.adjoints.Reversible(segments=4))

    @jax.jit
    def expected(worlds):
        return jax.vmap(lambda v: one(v, 1.0, jc.adjoints.Truncated(5)))(worlds)

    @jax.jit
    def inside(worlds):
        return jax.vmap(lambda v: one(v, 1.0, back))(worlds)

    @jax.jit
    def outside(worlds, mass):
        def total(worlds, mass):
            each = jax.vmap(lambda v: along(v, mass, back, 3))
            return jnp.sum(each(worlds))

        return jax.grad(total, argnums=(0, 1))(worlds, mass)

    by_v, by_mass = (np.array(x) for x in expected(WORLDS))
    assert np.all(by_v[2] == 0)
    assert np.all(np.abs(by_mass[:2]) > 1e-2)
    np.testing.assert_allclose(inside(WORLDS)[0], by_v, rtol=1e-10)
    np.testing.assert_allclose(inside(WORLDS)[1], by_mass, rtol=1e-10)
    np.testing.assert_allclose(outside(WORLDS, 1.0)[0], by_v, rtol=1e-10)
    np.testing.assert_allclose(outside(WORLDS, 1.0)[1], np.sum(by_mass), rtol=1e-10)


def test_a_step_back_of_a_body_in_space_that_counts_its_turns():
    """The rotation passes the angle at which an uncounted angle would jump by 2 π."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0))
    body = {"inertia": jc.inertia.box(1.0, (0.4, 0.3, 0.2)), "position": (0.2, 0.0, 0.0)}
    scene.add_body("body", **body, velocity=(0.0, 0.0, -1.8), angular_velocity=(0.0, 9.0, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "body", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)))
    scene.add(jc.forces.JointSpring("spring", "hinge", stiffness=0.2))
    scene.add(jc.forces.JointDamper("damper", "hinge", damping=0.01))
    system, state = scene.build()
    state = jc.init(system, METHOD, state.q, state.v)

    @jax.jit
    def there_and_back(state):
        there, path = jc.rollout(system, METHOD, state, None, 2e-2, 40)
        again = jax.lax.scan(
            lambda s, _: (undo(system, METHOD, s, None, 2e-2),) * 2, there, None, 39
        )[1]
        return path, again

    path, again = there_and_back(state)
    assert np.max(path.turns) > 3.3
    np.testing.assert_allclose(again.q[::-1], path.q[:-1], atol=1e-11)
    np.testing.assert_allclose(again.v[::-1], path.v[:-1], atol=1e-10)


def test_a_step_back_undoes_a_step():
    """The scene has a damper, a control, and a time-dependent drive."""
    scene = jc.Scene(dim=2)
    scene.add_body("arm", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    scene.add_particle("bob", mass=0.5, position=(2.0, 0.0), velocity=(0.0, 1.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)))
    scene.add(jc.Distance("rod", "arm", "bob", point_a=(1.0, 0.0)))
    scene.add(jc.joints.Drive("turn", "hinge", lambda t, _: jnp.sin(3.0 * t)))
    scene.add(jc.Spring("spring", jc.WORLD, "bob", stiffness=20.0, damping=2.0))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    system, state = scene.build()
    state = jc.assemble(system, state).check()
    control = jnp.array([3.0, -1.0])

    @jax.jit
    def there_and_back(state):
        first, _ = jc.step(system, METHOD, state, control, 1e-2)
        second, _ = jc.step(system, METHOD, first, control, 1e-2)
        return first, undo(system, METHOD, second, control, 1e-2)

    first, again = there_and_back(state)
    np.testing.assert_allclose(again.q, first.q, atol=1e-13)
    np.testing.assert_allclose(again.v, first.v, atol=1e-11)
    np.testing.assert_allclose(again.time, first.time, atol=1e-15)


def test_states_that_are_lost_on_the_way_leave_no_wrong_gradient():
    """Backwards, rounding grows as the damper damps: by e^36 here, or by e^1.8 in segments."""
    system, state = bob(12.0, jnp.float32)

    def end(mass, adjoint):
        changed = system.with_params({"bob": {"mass": mass}})
        return jc.rollout(changed, METHOD, state, None, jnp.float32(1e-2), 600, adjoint=adjoint)[
            0
        ].v[1]

    lost, kept, expected = (
        jax.jit(jax.grad(functools.partial(end, adjoint=adjoint)))(jnp.float32(0.5))
        for adjoint in (
            jc.adjoints.Reversible(),
            jc.adjoints.Reversible(segments=30),
            jc.adjoints.EveryStep(),
        )
    )
    assert np.isnan(lost)
    np.testing.assert_allclose(kept, expected, rtol=1e-3)


def test_small_motions_are_as_lost_as_large_ones():
    """The loss of states does not depend on the scale: a stiff damper, from 1 m and from 1 µm."""
    slow = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.ones_like(q), force=lambda q, v, t, u, p: -q - p * v, params=10.0
    )

    def share(damping, size):
        own = dataclasses.replace(slow, params=damping)
        state = jc.init(own, METHOD, jnp.array([size]), jnp.array([-0.1 * size]))
        final, _ = jc.rollout(own, METHOD, state, None, 1e-2, 370, adjoint=jc.adjoints.Reversible())
        return (final.q[0] / size) ** 2

    found = jax.jit(jax.vmap(jax.grad(share), (None, 0)))(10.0, jnp.array([1.0, 1e-6]))
    assert np.all(np.isnan(found)), found


def planned(steps, adjoint, worlds=300):
    """Returns the bytes that XLA plans for a gradient by velocities."""

    def end(v):
        start = dataclasses.replace(STATE, v=v)
        return jnp.sum(jc.rollout(SYSTEM, METHOD, start, None, DT, steps, adjoint=adjoint)[0].q)

    batch = jax.ShapeDtypeStruct((worlds, 2), jnp.float64)
    plan = jax.jit(jax.vmap(jax.grad(end))).lower(batch).compile().memory_analysis()
    return plan.output_size_in_bytes + plan.temp_size_in_bytes


def test_memory_does_not_grow_with_the_steps():
    """Only the step numbers of both passes grow, once for all worlds; the estimate has them."""
    short, long = planned(100, jc.adjoints.Reversible()), planned(10_000, jc.adjoints.Reversible())
    assert long - short < 2 * 8 * 9_900
    memory = jc.analysis.gradient_memory(SYSTEM, METHOD, STATE)
    assert abs(memory.of(300, 10_000, jc.adjoints.Reversible()) / long - 1) < 0.1
    assert long < memory.of(300, 100)


REFUSED = {
    "Euler": (jc.Method(), "SemiImplicitEuler is not symmetric"),
    "Runge–Kutta": (jc.Method(jc.RK4()), "RungeKutta is not symmetric"),
    "implicit": (jc.Method(jc.integrators.GeneralizedAlpha()), "GeneralizedAlpha is not symmetric"),
    "recovery": (
        jc.Method(jc.integrators.RATTLE(), recovery=jc.stabilizers.Recovery()),
        "`Recovery` is not reversible",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_methods_that_forget_are_refused(name):
    method, why = REFUSED[name]
    start = jc.init(SYSTEM, method, STATE.q, STATE.v)
    with pytest.raises(ValueError, match=rf"Reversible: .*{why}.*take Checkpoints\(\)"):
        jc.rollout(SYSTEM, method, start, None, DT, 5, adjoint=jc.adjoints.Reversible())


def test_controls_that_are_a_function_of_the_state_are_refused():
    with pytest.raises(ValueError, match=r"a function of the state.*take Checkpoints\(\)"):
        jc.rollout(SYSTEM, METHOD, STATE, lambda s: -s.v, DT, 5, adjoint=jc.adjoints.Reversible())
    with pytest.raises(ValueError, match="segments must be a whole number"):
        jc.rollout(SYSTEM, METHOD, STATE, None, DT, 5, adjoint=jc.adjoints.Reversible(segments=0))


def test_forward_mode_is_refused():
    with pytest.raises(
        TypeError, match=r"no forward-mode derivative.*adjoint=jc.adjoints.EveryStep\(\)"
    ):
        jax.jvp(lambda v: along(v, 1.0, jc.adjoints.Reversible()), (WORLDS[0],), (WORLDS[1],))
