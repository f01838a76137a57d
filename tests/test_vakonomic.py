"""Variational (vakonomic) equations: conserved quantities, relation to physics, and errors."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.constraints.rows import linearize

IDEAL = jc.Method(integrator=jc.RK4(), stabilizer=jc.stabilizers.Unstabilized())
RATE, PULL, MASS, MOMENT = 1.5, 4.905, 1.3, 0.1


def skate():
    """A skate on an incline with x downhill, spinning, its edge along x."""
    scene = jc.Scene(dim=2, gravity=(PULL, 0.0))
    scene.add_body("skate", mass=MASS, inertia=MOMENT, angular_velocity=RATE)
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0)))
    return scene.build()


def run(system, state, dt=1e-3, steps=500, every=100):
    return jax.jit(lambda s: jc.rollout(system, IDEAL, s, None, dt, steps, every=every)[1])(state)


def test_skate_keeps_energy_and_momentum_of_the_augmented_lagrangian():
    """Conserves m ẋ − μ sin θ − m g t and m ẏ + μ cos θ, with μ of ψ = −ẋ sin θ + ẏ cos θ."""
    system, state = jc.systems.vakonomic(*skate(), {"blade": -0.1})
    path = run(system, state)
    angle, v = path.q[:, 2], path.v.T
    μ = v[3]
    assert np.max(np.abs(μ + 0.1)) > 1e-2
    along = MASS * v[0] - μ * np.sin(angle) - MASS * PULL * path.time
    np.testing.assert_allclose(along, 0, atol=1e-10)
    np.testing.assert_allclose(MASS * v[1] + μ * np.cos(angle), -0.1, atol=1e-10)
    energy = jax.vmap(lambda s: jc.energy(system, s).total)(path)
    np.testing.assert_allclose(energy, MOMENT * RATE**2 / 2, atol=1e-10)
    assert np.max(jax.vmap(lambda s: jc.violation(system, s).worst_rate)(path)) < 1e-10
    physical = run(*skate())
    assert np.max(np.abs(physical.q - path.q)) > 1e-2


def suslov(body, t, axis):
    """Returns ψ = a·ω with the axis a fixed in the body."""
    return (axis @ body.angular_velocity)[None]


def test_momentum_of_a_body_with_a_forbidden_spin_is_constant_in_space():
    """In the variational Suslov problem R (I ω + μ a) is constant.

    The reason is that rotations leave L + μ·ψ unchanged.
    """
    moments, axis = np.array([1.0, 1.4, 2.1]), np.array([0.3, -0.5, 0.8])
    spin = np.cross(axis, [1.0, 2.0, 0.5])
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(
        "body", mass=1.0, inertia=moments, quaternion=(0.8, 0.1, -0.5, 0.3), angular_velocity=spin
    )
    scene.add(jc.joints.VelocityLevel(suslov, ("body",), name="spin", params=axis))
    system, state = jc.systems.vakonomic(*scene.build(), {"spin": 0.7})

    def momentum(s):
        own = moments * s.v[3:6] + system.multipliers(s, "spin") * axis
        return jc.quaternion.rotate(s.q[3:], own)

    path = run(system, state)
    expected = momentum(state)
    assert np.max(np.abs(path.v[:, 6] - 0.7)) > 1e-2
    np.testing.assert_allclose(jax.vmap(momentum)(path), np.tile(expected, (5, 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("integrator", "change"), [(jc.RK4(), 1e-8), (jc.SemiImplicitEuler(), 0.15)], ids=["RK4", "SIE"]
)
def test_a_body_on_a_point_with_a_forbidden_spin_is_projected(integrator, change):
    """The point stays to rounding; the energy error [J] has the order of the method."""
    axis, place = np.array([0.3, -0.5, 0.8]), np.array([0.1, 0.0, 0.0])
    spin = np.cross(axis, [10.0, 20.0, 5.0])
    moving = {"velocity": np.cross(spin, place), "angular_velocity": spin, "position": place}
    scene = jc.Scene()
    scene.add_body("body", mass=1.0, inertia=(0.01, 0.014, 0.021), **moving)
    scene.add(jc.Spherical("point", jc.WORLD, "body", point=(0.0, 0.0, 0.0)))
    scene.add(jc.joints.VelocityLevel(suslov, ("body",), name="spin", params=axis))
    system, state = jc.systems.vakonomic(*scene.build(), {"spin": 0.05})
    method = jc.Method(integrator, jc.Projection())

    def seen(state, info):
        off = jc.violation(system, state)
        return jc.energy(system, state).total, off.worst, off.worst_rate

    start = jc.init(system, method, state.q, state.v)
    final, (energy, *off) = jax.jit(
        lambda s: jc.rollout(system, method, s, None, 1e-3, 200, record=seen)
    )(start)
    assert final.status == jc.Status.OK
    assert np.ptp(energy) < change
    assert np.max(off) < 1e-12


def test_rolling_in_space_keeps_energy_and_the_momenta_of_its_symmetries():
    """A disc on a level plane: translations in the plane leave L + μ·ψ unchanged."""
    scene = jc.Scene()
    scene.add_body("disc", mass=2.0, inertia=(0.2, 0.3, 0.2), angular_velocity=(0.3, 4.0, 0.8))
    axis = (0.0, 1.0, 0.2)
    scene.add(jc.joints.RollingDisc("roll", jc.WORLD, "disc", radius=0.5, axis=axis))
    system, state = scene.build()
    rows = linearize(system, state.q, state.v, state.time)
    slip = np.linalg.pinv(np.asarray(rows.jacobian.dense())) @ np.asarray(rows.rate)
    state = dataclasses.replace(state, v=state.v - slip)
    system, state = jc.systems.vakonomic(system, state, {"roll": np.array([0.4, -0.2])})

    def kept(s):
        """Returns the energy, ∂(L + μ·ψ)/∂ẋ and ∂(L + μ·ψ)/∂ẏ."""
        rows = linearize(system.system, s.q, s.v[:6], s.time)
        μ = jnp.zeros(3).at[system.free].set(system.multipliers(s, "roll"))
        shift = 2.0 * s.v[:6] + rows.jacobian.transpose(μ)
        return jnp.append(jc.energy(system, s).total, shift[:2])

    path = run(system, state)
    assert np.max(np.abs(path.v[-1, 6:] - state.v[6:])) > 1e-2
    np.testing.assert_allclose(jax.vmap(kept)(path), np.tile(kept(state), (5, 1)), atol=1e-8)


def radius_rate(q, v, t, p):
    return (q @ v - jnp.sin(t))[None]


def swinging(constraint):
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.stack([1.0 + q[0] ** 2, 2.0 + 0 * q[1]]),
        force=lambda q, v, t, u, p: jnp.stack([-q[0] * v[0] ** 2, -9.81 + 0 * q[1]]),
        constraints=(constraint,),
    )
    return system, jc.init(system, IDEAL, jnp.asarray([1.0, 0.2]), jnp.asarray([-0.2, 1.0]))


def test_integrable_rows_move_as_the_physical_ones_whatever_the_multiplier():
    system, state = swinging(jc.joints.VelocityLevel(radius_rate, name="row"))
    physical = run(system, state).q
    for μ in (0.0, 3.0):
        path = run(*jc.systems.vakonomic(system, state, {"row": μ}))
        np.testing.assert_allclose(path.q, physical, atol=1e-9)


def full_mass(q, p):
    return jnp.asarray([[2.0, 0.3, 0.1], [0.3, 1.5, 0.2], [0.1, 0.2, 1.0]])


def contact(q, v, t, p):
    return (v[2] - p["slope"] * q[1] * v[0])[None]


def test_stationary_action_of_a_full_mass_matrix_by_euler_lagrange():
    """d/dt ∂L*/∂q̇ = ∂L*/∂q with L* = ½ q̇ᵀMq̇ + μ ψ, by automatic differentiation."""
    p = {"slope": jnp.asarray(0.8)}
    system = jc.GeneralizedSystem(
        mass=full_mass,
        force=lambda q, v, t, u, p: jnp.zeros_like(q),
        constraints=(jc.joints.VelocityLevel(contact, name="row"),),
        params=p,
    )
    q, v, μ = jnp.asarray([0.3, 0.5, 0.1]), jnp.asarray([1.0, -0.4, 0.4]), jnp.asarray([0.6])
    state = jc.init(system, IDEAL, q, v)
    system, state = jc.systems.vakonomic(system, state, {"row": μ})
    rates = jc.forward_dynamics(system, state, None, IDEAL, 1e-3).acceleration
    a, μ̇ = rates[:3], rates[3:]

    def lagrangian(q, v, μ):
        return v @ full_mass(q, p) @ v / 2 + μ @ contact(q, v, 0.0, p)

    momentum = jax.grad(lagrangian, 1)
    left = jax.jvp(momentum, (q, v, μ), (v, a, μ̇))[1]
    np.testing.assert_allclose(left, jax.grad(lagrangian)(q, v, μ), atol=1e-12)
    psi = jax.jvp(lambda q, v: contact(q, v, 0.0, p), (q, v), (v, a))[1]
    np.testing.assert_allclose(psi, 0, atol=1e-12)


def test_batches_and_gradients():
    system, state = jc.systems.vakonomic(*skate(), {"blade": 0.2})

    def end(μ, mass):
        start = jc.State(state.q, state.v.at[3].set(μ), state.time, state.status)
        changed = system.with_params({"skate": {"mass": mass}})
        return jc.rollout(changed, IDEAL, start, None, 1e-2, 20)[0].q[1]

    one = jax.jit(end)
    masses = jnp.asarray([1.0, 1.3, 2.0])
    batch = jax.jit(jax.vmap(end, (None, 0)))(0.2, masses)
    np.testing.assert_allclose(batch, [one(0.2, m) for m in masses], rtol=1e-12)
    h = 1e-5
    slopes = jax.jit(jax.grad(end, (0, 1)))(0.2, 1.3)
    by_μ = (one(0.2 + h, 1.3) - one(0.2 - h, 1.3)) / (2 * h)
    by_mass = (one(0.2, 1.3 + h) - one(0.2, 1.3 - h)) / (2 * h)
    np.testing.assert_allclose(slopes, [by_μ, by_mass], rtol=1e-6)


def test_float32_has_no_float64():
    scene = jc.Scene(dim=2, dtype=jnp.float32)
    scene.add_body("skate", mass=1.0, inertia=0.1, angular_velocity=1.5)
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0)))
    system, state = jc.systems.vakonomic(*scene.build(), {"blade": 0.1})
    dt = jnp.asarray(1e-3, jnp.float32)
    text = str(jax.make_jaxpr(lambda s: jc.step(system, IDEAL, s, None, dt))(state))
    assert "f64" not in text


def test_readers_and_errors():
    system, state = skate()
    wide, start = jc.systems.vakonomic(system, state, {"blade": 0.2})
    np.testing.assert_array_equal(wide.multipliers(start, "blade"), [0.2])
    np.testing.assert_array_equal(wide.physical(start).v, state.v)
    np.testing.assert_array_equal(jc.position(wide, start, "skate"), [0.0, 0.0])
    with pytest.raises(ValueError, match="'blad' is unknown"):
        jc.systems.vakonomic(system, state, {"blad": 0.2})
    with pytest.raises(ValueError, match="'blade'.*\\(1,\\).*\\(2,\\)"):
        jc.systems.vakonomic(system, state, {"blade": np.ones(2)})
    with pytest.raises(ValueError, match=r"state.v must have shape \(4,\), got \(3,\)"):
        jc.step(wide, IDEAL, state, None, 1e-3)
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    with pytest.raises(ValueError, match="'rod' has a φ in each of its rows"):
        jc.systems.vakonomic(*scene.build(), {"rod": 0.2})


def test_bounded_rows_have_no_variational_form():
    scene = jc.Scene(dim=2)
    scene.add_particle("bead", mass=1.0)
    scene.add(jc.contacts.Rope("leash", jc.WORLD, "bead", length=1.0, point_a=(0.5, 0.0)))
    system, state = scene.build()
    with pytest.raises(
        ValueError, match=r"no variational form of the inequality rows of \['leash'\]"
    ):
        jc.systems.vakonomic(system, state)


def test_the_rate_of_the_multipliers_is_minus_lambda_where_fast_turns_are_corrected():
    """A bob whirls around a skate by 0.06 rad a step, so that the step is corrected."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("skate", mass=MASS, inertia=MOMENT)
    scene.add_particle("bob", mass=0.4, position=(0.2, 0.2), velocity=(-12.0, 12.0))
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0)))
    scene.add(jc.Distance("rod", "skate", "bob"))
    system, state = jc.systems.vakonomic(*scene.build(), {"blade": 0.3})
    dt = 1e-3
    plain, _ = jc.step(system, jc.Method(jc.integrators.ExplicitEuler()), state, None, dt)
    new, info = jc.step(system, jc.Method(), state, None, dt)
    rate = (system.multipliers(new, "blade") - 0.3) / dt
    assert np.abs(rate - (system.multipliers(plain, "blade") - 0.3) / dt) > 1e-2
    np.testing.assert_allclose(rate, -jc.multipliers(info, "blade"), rtol=1e-9)
