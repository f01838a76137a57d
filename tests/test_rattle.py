"""RATTLE: order, reversibility, bounded energy, conserved momenta, and derivatives."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE, IDENTITY

import jaxcon as jc
from jaxcon.core import numerics

METHOD = jc.Method(jc.integrators.RATTLE())


def pendulum():
    """A particle on a rod of 1 m, released level."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=2.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


def double_pendulum():
    """Two rods in the plane, released level."""
    scene = jc.Scene(dim=2)
    for i in range(2):
        before = f"b{i - 1}" if i else jc.WORLD
        scene.add_body(f"b{i}", mass=1.0, inertia=1 / 12, position=(i + 0.5, 0.0))
        scene.add(jc.Revolute(f"hinge{i}", before, f"b{i}", point=(float(i), 0.0)))
    return scene.build()


def chain():
    """Two bodies in space on a ball joint and a hinge, in free rotation."""
    scene = jc.Scene()
    scene.add_body("a", mass=1.0, inertia=(0.02, 0.05, 0.04), position=(0.5, 0.0, 0.0))
    scene.add_body("b", mass=0.5, inertia=(0.01, 0.03, 0.02), position=(1.0, 0.4, 0.0))
    scene.add(jc.Spherical("ball", jc.WORLD, "a", point=(0.0, 0.0, 0.0)))
    scene.add(jc.Revolute("hinge", "a", "b", point=(1.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0)))
    system, state = scene.build()
    v = state.v.at[jnp.array([6, 7])].set(jnp.array([3.0, -2.0]))  # ω_x, allowed by the joints
    return system, dataclasses.replace(state, v=v)


def top():
    """A heavy top that spins fast about its axis."""
    scene = jc.Scene()
    scene.add_body(
        "top",
        mass=1.0,
        inertia=(0.06, 0.06, 0.01),
        position=(0.0, 0.1, 0.2),
        quaternion=np.array([1.0, -0.229, 0.0, 0.0]) / np.hypot(1.0, 0.229),
        angular_velocity=(0.0, 0.0, 60.0),
    )
    scene.add(jc.Spherical("tip", jc.WORLD, "top", point=(0.0, 0.0, 0.0)))
    system, state = scene.build()
    return system, jc.assemble(system, state).check()


def tumbling():
    """Two free bodies joined by a rod; one rotates about its middle axis."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body("a", mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0.1, 2.0, 0.1))
    scene.add_body("b", mass=2.0, inertia=(1.0, 1.5, 2.0), position=(1.0, 0.5, 0.0))
    scene.add(jc.Distance("rod", "a", "b", point_a=(0.5, 0.0, 0.0), point_b=(1.0, 0.0, 0.0)))
    system, state = scene.build()
    return system, jc.assemble(system, state).check()


SCENES = {f.__name__: f for f in (pendulum, double_pendulum, chain, top, tumbling)}


@functools.cache
def scene(name):
    """Returns system, state, and (state, h, n) → states after n steps and at 8 times."""
    system, state = SCENES[name]()

    @jax.jit
    def run(state, dt, steps):
        def step(_, s):
            return jc.step(system, METHOD, s, None, dt)[0]

        def part(s, _):
            s = jax.lax.fori_loop(0, steps // 8, step, s)
            return s, s

        return jax.lax.scan(part, state, None, length=8)

    return system, state, run


@pytest.mark.parametrize("name", SCENES)
def test_second_order_and_reversible(name):
    """Halving the step shows the order; reversed velocities lead back to the start."""
    system, state, run = scene(name)
    time = 0.1 if name == "top" else 0.4
    ends = [run(state, time / n, n)[0] for n in (40, 80, 160)]
    errors = [float(jnp.max(jnp.abs(a.q - b.q))) for a, b in zip(ends, ends[1:], strict=False)]
    assert 1.9 < np.log2(errors[0] / errors[1]) < 2.1
    left = jc.violation(system, ends[0])
    assert float(left.worst) < IDENTITY
    assert float(left.worst_rate) < 1e-11  # speeds are up to 60 rad/s
    back, _ = run(dataclasses.replace(ends[0], v=-ends[0].v), time / 40, 40)
    assert float(jnp.max(jnp.abs(back.q - state.q))) < IDENTITY


@pytest.mark.parametrize("name", SCENES)
def test_energy_stays_within_a_band(name):
    """The energy error in the second half of a long run is that of the first half: no drift."""
    system, state, run = scene(name)
    steps, dt = (8000, 1e-3) if name == "top" else (8000, 1e-2)
    if name == "double_pendulum":
        dt = 4e-3
    parts = [state]
    for _ in range(4):  # records 32 states
        parts.append(run(parts[-1], dt, steps // 4)[0])
    path = [run(s, dt, steps // 4)[1] for s in parts[:-1]]
    energy = jax.vmap(lambda s: jc.energy(system, s))(
        jax.tree.map(lambda *x: jnp.concatenate(x), *path)
    )
    start = float(jc.energy(system, state).total)
    off = np.abs(energy.total - start) / np.max(energy.kinetic)
    assert int(parts[-1].status) == jc.Status.OK
    assert off.max() < 2e-3
    assert off[16:].max() < 2 * off[:16].max()


def test_momenta_of_a_free_system_are_kept():
    system, state, run = scene("tumbling")
    end, _ = run(state, 1e-2, 800)
    for momentum in (jc.momentum, jc.angular_momentum):
        before, after = momentum(system, state), momentum(system, end)
        np.testing.assert_allclose(after, before, atol=1e-11)
    assert float(jnp.max(jnp.abs(end.q - state.q))) > 0.5


def test_one_step_of_a_particle_by_hand():
    """From rest q⁺ = (cos θ, −sin θ) with sin θ = g h²/2."""
    system, state = pendulum()
    h, g, m = 0.1, 9.81, 2.0
    new, info = jax.jit(lambda s: jc.step(system, METHOD, s, None, h))(state)
    drop = g * h * h / 2
    x = np.sqrt(1 - drop**2)
    np.testing.assert_allclose(new.q, [x, -drop], atol=IDENTITY)
    V = (np.array([x, -drop]) - [1.0, 0.0]) / h
    pulled = V - np.array([0.0, g * h / 2])
    tangent = np.array([-drop, -x])
    np.testing.assert_allclose(new.v, tangent * (tangent @ pulled), atol=IDENTITY)
    np.testing.assert_allclose(info.multipliers, [2 * m * V[0] / h], rtol=1e-11)
    np.testing.assert_allclose(info.acceleration, new.v / h, rtol=1e-11)


def test_a_motion_in_time_is_followed():
    """A slider on a driven rail: positions and velocities are exact at the end of every step."""
    motion = jc.Scene(dim=2)
    motion.add_body("slider", mass=1.0, inertia=1.0)
    motion.add(jc.Prismatic("rail", jc.WORLD, "slider", axis=(1.0, 0.0)))
    motion.add(jc.joints.Drive("drive", "rail", lambda t, p: jnp.sin(t)))
    system, state = motion.build()
    state = dataclasses.replace(state, v=state.v.at[0].set(1.0))
    end, path = jax.jit(lambda s: jc.rollout(system, METHOD, s, None, 0.1, 10))(state)
    assert abs(float(end.q[0]) - np.sin(1.0)) < IDENTITY
    assert abs(float(end.v[0]) - np.cos(1.0)) < IDENTITY


def damped(parameter):
    """Returns the height of a pendulum on a damped spring after ten steps."""
    hung = jc.Scene(dim=2)
    hung.add_particle("bob", mass=2.0, position=(1.0, 0.0))
    hung.add(jc.Distance("rod", jc.WORLD, "bob"))
    hung.add(
        jc.Spring(
            "spring", jc.WORLD, "bob", point_a=(2.0, 0.5), stiffness=20.0, damping=parameter[0]
        )
    )
    system, state = hung.build()
    state = dataclasses.replace(state, v=state.v.at[1].set(parameter[1]))
    return jc.rollout(system, METHOD, state, None, 0.02, 10)[0].q[1]


def test_forces_of_velocities_and_derivatives():
    """The gradient equals central differences in forward and in reverse mode."""
    x, h = jnp.array([3.0, 0.4]), 1e-5
    value, gradient = jax.jit(damped), jax.jit(jax.grad(damped))
    differences = [(value(x + h * e) - value(x - h * e)) / (2 * h) for e in jnp.eye(2)]
    np.testing.assert_allclose(gradient(x), differences, rtol=DIFFERENCE)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(damped))(x), gradient(x), rtol=1e-9)


def test_the_derivative_of_a_step_in_space():
    """Differentiates by velocities and a moment of inertia, at a rotation of 0.2 rad a step."""
    system, state = top()

    def end(x):
        inertia = jnp.stack([0.06 + x[0], jnp.full_like(x[0], 0.05), jnp.full_like(x[0], 0.01)])
        changed = system.with_params({"top": {"inertia": inertia}})
        start = dataclasses.replace(state, v=state.v * (1 + x[1]))
        new, _ = jc.step(changed, METHOD, start, None, 0.003)
        return jnp.sum(jnp.sin(new.q)) + jnp.sum(jnp.cos(new.v))

    x, h = jnp.array([1e-3, 0.1]), 1e-6
    value = jax.jit(end)
    differences = [(value(x + h * e) - value(x - h * e)) / (2 * h) for e in jnp.eye(2)]
    np.testing.assert_allclose(jax.jit(jax.grad(end))(x), differences, rtol=DIFFERENCE)


def test_float32_and_batches():
    system, state, _ = scene("double_pendulum")
    low = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == float else x, (system, state))
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), low[1])
    run = jax.jit(jax.vmap(lambda s: jc.rollout(low[0], METHOD, s, None, 5e-3, 100)[0]))
    ends = run(batch)
    assert ends.status.tolist() == [jc.Status.OK] * 2
    left = jax.vmap(lambda s: jc.violation(low[0], s).worst)(ends)
    assert float(jnp.max(left)) < 2e-6


def test_the_energy_of_float32_does_not_drift():
    """A double pendulum over 1e5 steps; solving for whole momenta would drift by 5e-3 J."""
    system, state = jax.tree.map(
        lambda x: x.astype(np.float32) if x.dtype == float else x, double_pendulum()
    )
    run = jax.jit(
        lambda s: jc.rollout(
            system, METHOD, s, None, 1e-3, 100_000, record=total_energy(system), every=10
        )
    )
    end, energy = run(state)
    assert int(end.status) == jc.Status.OK
    tenths = np.float64(energy).reshape(10, -1).mean(axis=1)
    assert np.max(np.abs(tenths - tenths[0])) < 1.5e-3  # 1e-4 of the 15 J of the fall


def total_energy(system):
    """Returns a function that records the total energy [J] of a rollout."""
    return lambda state, info: jc.energy(system, state).total


def test_steps_too_large_say_so():
    _, state, run = scene("top")
    end, _ = run(state, 0.05, 8)
    assert int(end.status) == jc.Status.NOT_CONVERGED


def test_what_it_refuses():
    """Messages give the reason, and what to do instead."""
    system, state = pendulum()
    for stabilizer in (jc.Baumgarte.critical(10.0), jc.Projection()):
        with pytest.raises(ValueError, match="keeps positions and velocities"):
            jc.step(system, jc.Method(jc.integrators.RATTLE(), stabilizer), state, None, 0.1)
    skating = jc.Scene(dim=2)
    skating.add_body("skate", mass=1.0, inertia=1.0)
    skating.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0)))
    with pytest.raises(ValueError, match="blade"):
        jc.step(skating.build()[0], METHOD, skating.build()[1], None, 0.1)
    spun = jc.Scene(dim=2)
    spun.add_body("wheel", mass=1.0, inertia=1.0)
    spun.add(jc.Revolute("axle", jc.WORLD, "wheel", point=(0.0, 0.0)))
    spun.add(jc.joints.Armature("rotor", "axle", inertia=1.0))
    with pytest.raises(ValueError, match="rotor"):
        jc.step(spun.build()[0], METHOD, spun.build()[1], None, 0.1)
    curved = jc.GeneralizedSystem(
        mass=lambda q, p: 1.0 + q**2, force=lambda q, v, t, u, p: jnp.zeros_like(q)
    )
    with pytest.raises(ValueError, match="mass matrix depends on q"):
        jc.step(curved, METHOD, jc.init(curved, METHOD, jnp.ones(2), jnp.ones(2)), None, 0.1)


def test_the_coefficient_of_the_inverse_exponential():
    """The values equal those of the formula, also at π.

    The derivative is continuous where the series takes over.
    """
    s = jnp.array([0.0, 1 - 1e-9, 1 + 1e-9, np.pi**2, 25.0])
    θ = np.sqrt(np.asarray(s[1:]))
    expected = [1 / 12, *((1 - θ / 2 / np.tan(θ / 2)) / θ**2)]
    np.testing.assert_allclose(numerics.inverse_exponential(s), expected, rtol=1e-14)
    slopes = jax.vmap(jax.grad(numerics.inverse_exponential))(s)
    np.testing.assert_allclose(slopes[0], 1 / 720, rtol=1e-14)
    np.testing.assert_allclose(slopes[1], slopes[2], rtol=1e-8)
