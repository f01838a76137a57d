"""Gears, racks, belts, differentials, pulleys and cams, against hand calculations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc

both = pytest.mark.parametrize("dim", [2, 3])
FREE = jc.Method(stabilizer=jc.stabilizers.Unstabilized())
MOMENTS = {"a": 0.7, "b": 0.2, "c": 0.4}


def shafts(dim, *elements, **spin):
    """Wheels a, b, c on parallel axes, each on a hinge of its own, and a slider of 3 kg."""
    scene = jc.Scene(dim=dim, gravity=(0.0,) * dim)
    z = None if dim == 2 else (0, 0, 1)
    for i, (name, moment) in enumerate(MOMENTS.items()):
        place = (float(i),) + (0.0,) * (dim - 1)
        inertia = moment if dim == 2 else (1.0, 1.0, moment)
        rate = spin.get(name, 0.0)
        scene.add_body(
            name,
            mass=1.0,
            inertia=inertia,
            position=place,
            angular_velocity=rate if dim == 2 else (0.0, 0.0, rate),
        )
        scene.add(jc.Revolute(name + "_hinge", jc.WORLD, name, point=place, axis=z))
        scene.add(jc.Motor(name + "_motor", name + "_hinge"))
    inertia = 1.0 if dim == 2 else (1.0, 1.0, 1.0)
    speed = (spin.get("slider", 0.0),) + (0.0,) * (dim - 1)
    scene.add_body("slider", mass=3.0, inertia=inertia, velocity=speed)
    scene.add(jc.Prismatic("rail", jc.WORLD, "slider", axis=(1.0, 0.0, 0.0)[:dim]))
    for element in elements:
        scene.add(element)
    return scene.build()


def idle(_):
    """Returns zero torques for the motors."""
    return jnp.zeros(len(MOMENTS))


@jax.jit
def accelerations(system, state, *torques):
    """Returns the accelerations of the wheels' angles and the slider, and λ of the coupling."""
    control = jnp.zeros(3).at[: len(torques)].set(jnp.asarray(torques, float))
    solution = jc.forward_dynamics(system, state, control, FREE, 1e-3)
    angles = [solution.acceleration[system.layout.v(name)[-1]] for name in MOMENTS]
    slider = solution.acceleration[system.layout.v("slider")[0]]
    layout = jax.eval_shape(jc.violation, system, state).layout
    return [*angles, slider], solution.multipliers[layout.rows("coupling")]


@both
def test_a_gear_multiplies_speed_and_divides_torque(dim):
    """With θ_b = r θ_a the equations are (I_a + r² I_b) θ̈_a = τ_a and λ = I_b θ̈_b."""
    system, state = shafts(dim, jc.joints.Gear("coupling", "a_hinge", "b_hinge", ratio=-3.0))
    (a, b, c, _), (torque,) = accelerations(system, state, 5.0)
    np.testing.assert_allclose([a, b, c], [2.0, -6.0, 0.0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(torque, -1.2, rtol=1e-9)


@both
def test_a_rack_moves_by_the_radius_times_the_angle(dim):
    """The equation is (I + m r²) θ̈ = τ."""
    system, state = shafts(dim, jc.joints.RackAndPinion("coupling", "a_hinge", "rail", radius=0.1))
    (a, _, _, slider), (force,) = accelerations(system, state, 7.3)
    np.testing.assert_allclose([a, slider, force], [10.0, 1.0, 3.0], rtol=1e-9)


@both
def test_a_belt_runs_at_one_speed(dim):
    system, state = shafts(dim, jc.joints.Belt("coupling", "a_hinge", "b_hinge", 0.1, 0.2))
    (a, b, *_), (pull,) = accelerations(system, state, 1.5)
    np.testing.assert_allclose([a, b], [2.0, 1.0], rtol=1e-9)
    np.testing.assert_allclose(0.2 * pull, 0.2 * b, rtol=1e-9)


@both
def test_a_differential_shares_the_torque(dim):
    """θ_a + θ_b = 2 θ_c; the torques are λ on each shaft and −2 λ on the carrier."""
    coupling = jc.joints.Differential("coupling", "a_hinge", "b_hinge", "c_hinge")
    system, state = shafts(dim, coupling)
    (a, b, c, _), (torque,) = accelerations(system, state, 0.0, 0.0, 4.0)
    np.testing.assert_allclose(a + b, 2 * c, rtol=1e-9)
    np.testing.assert_allclose([0.7 * a, 0.2 * b], [torque, torque], rtol=1e-9)
    np.testing.assert_allclose(0.4 * c, 4.0 - 2 * torque, rtol=1e-9)


@both
def test_a_cam_follows_its_polynomial(dim):
    """θ_b = P(θ_a), hence θ̈_b = P′ θ̈_a + P″ θ̇_a²."""
    c = (0.0, 0.5, 2.0, -1.0)
    cam = jc.joints.PolynomialCoupling("coupling", "a_hinge", "b_hinge", c)
    system, state = shafts(dim, cam, a=3.0, b=1.5)
    (a, b, *_), _ = accelerations(system, state, 1.0)
    np.testing.assert_allclose(b, 0.5 * a + 4.0 * 9.0, rtol=1e-9)
    fine = jc.Method(jc.RK4())
    run = jax.jit(lambda s: jc.rollout(system, fine, s, idle, 1e-3, 200)[0])
    final = run(state)
    x, y = (jc.coordinate(system, final, f"{name}_hinge") for name in "ab")
    assert abs(x) > 0.1
    np.testing.assert_allclose(y, np.polynomial.Polynomial(c)(float(x)), atol=1e-9)


@both
def test_a_gear_holds_over_many_turns(dim):
    system, state = shafts(
        dim, jc.joints.Gear("coupling", "a_hinge", "b_hinge", 2.5), a=20.0, b=50.0
    )
    run = jax.jit(lambda s: jc.rollout(system, jc.Method(), s, idle, 1e-2, 200)[0])
    final = run(state)
    assert final.status == jc.Status.OK
    a, b = (jc.coordinate(system, final, f"{name}_hinge") for name in "ab")
    np.testing.assert_allclose([a, b], [40.0, 100.0], rtol=1e-9)


@both
def test_a_planetary_gear_on_its_carrier(dim):
    """Sun a and planet b turn on one carrier c: ω_b − ω_c = −(ω_a − ω_c) z_a/z_b."""
    scene = jc.Scene(dim=dim, gravity=(0.0,) * dim)
    z = None if dim == 2 else (0, 0, 1)
    for name, x in (("sun", 0.0), ("carrier", 0.0), ("planet", 1.0)):
        moment = 0.6 if name == "sun" else 0.3
        inertia = moment if dim == 2 else (1.0, 1.0, moment)
        scene.add_body(name, mass=1.0, inertia=inertia, position=(x,) + (0.0,) * (dim - 1))
    origin, arm = (0.0,) * dim, (1.0,) + (0.0,) * (dim - 1)
    scene.add(jc.Revolute("main", jc.WORLD, "carrier", point=origin, axis=z))
    scene.add(jc.Revolute("sun_hinge", "carrier", "sun", point=origin, axis=z))
    scene.add(jc.Revolute("planet_hinge", "carrier", "planet", point=arm, axis=z))
    scene.add(jc.joints.Gear("mesh", "sun_hinge", "planet_hinge", ratio=-1.0))
    scene.add(jc.Motor("motor", "main"))
    system, state = scene.build()
    u = jnp.asarray([2.0])
    results = [
        jc.forward_dynamics(system, state, u, dataclasses.replace(FREE, solver=s), 1e-3)
        for s in (jc.solvers.Dense(), jc.solvers.Schur(), jc.solvers.Sparse())
    ]
    for solution in results:
        spin = {n: solution.acceleration[system.layout.v(n)[-1]] for n in system.layout.bodies}
        relative = [spin[n] - spin["carrier"] for n in ("sun", "planet")]
        assert abs(relative[0]) > 0.1
        np.testing.assert_allclose(relative[1], -relative[0], rtol=1e-9)
        np.testing.assert_allclose(solution.acceleration, results[0].acceleration, atol=1e-9)
        # the torque of 2 N m changes the angular momentum of all three bodies about the fixed axis
        momentum = 0.3 * sum(spin.values()) + 0.3 * spin["sun"] + 1.0 * spin["carrier"]
        np.testing.assert_allclose(momentum, 2.0, rtol=1e-9)


@both
@pytest.mark.parametrize("parts", [1.0, 2.0])
def test_a_block_and_tackle(dim, parts):
    """Atwood's machine with n parts of rope; λ is the tension.

    The acceleration is ÿ_a = (m_b/n − m_a) g / (m_a + m_b/n²).
    """
    scene = jc.Scene(dim=dim)
    down = (0.0,) * (dim - 1) + (-1.0,)
    for name, mass, x in (("left", 1.0, 0.0), ("right", 3.0, 1.0)):
        place = (x,) + down[1:]
        scene.add_particle(name, mass=mass, position=place)
        scene.add(jc.joints.Span(name + "_rope", jc.WORLD, name, point_a=(x,) + (0.0,) * (dim - 1)))
    scene.add(jc.joints.Pulley("pulley", "left_rope", "right_rope", parts))
    system, state = scene.build()
    solution = jc.forward_dynamics(system, state, None, FREE, 1e-3)
    g = 9.81
    rise = solution.acceleration[system.layout.v("left")[-1]]
    fall = solution.acceleration[system.layout.v("right")[-1]]
    expected = (3.0 / parts - 1.0) * g / (1.0 + 3.0 / parts**2)
    np.testing.assert_allclose([rise, fall], [expected, -expected / parts], rtol=1e-9)
    np.testing.assert_allclose(solution.multipliers, [-(g + expected)], rtol=1e-9)


def test_the_gradient_by_a_ratio():
    """Differentiates θ̈_a = τ/(I_a + r² I_b) by r."""
    system, state = shafts(3, jc.joints.Gear("coupling", "a_hinge", "b_hinge", ratio=-3.0))

    def spin(ratio):
        other = system.with_params({"coupling": {"ratio": ratio}})
        return accelerations(other, state, 5.0)[0][0]

    np.testing.assert_allclose(jax.jit(jax.grad(spin))(-3.0), 5.0 * 2 * 3 * 0.2 / 2.5**2, rtol=1e-9)


def test_gears_of_one_kind_share_their_code():
    couplings = [
        jc.joints.Gear("coupling", "a_hinge", "b_hinge", 2.0),
        jc.joints.Gear("other", "b_hinge", "c_hinge", 2.0),
    ]
    system, state = shafts(3, *couplings)
    groups = [g for g in system.constraints if "other" in g.names]
    assert groups[0].names == ("coupling", "other")
    (a, b, c, _), _ = accelerations(system, state, 5.0)
    np.testing.assert_allclose([b, c], [2 * a, 4 * a], rtol=1e-9)
    np.testing.assert_allclose(a, 5.0 / (0.7 + 4 * 0.2 + 16 * 0.4), rtol=IDENTITY * 1e3)


def test_the_multiplier_is_read_by_name():
    system, state = shafts(2, jc.joints.Gear("coupling", "a_hinge", "b_hinge", ratio=-3.0))
    control = jnp.asarray([5.0, 0.0, 0.0])
    solution = jc.forward_dynamics(system, state, control, FREE, 1e-3)
    torque = jc.multipliers(solution, "coupling")
    np.testing.assert_allclose(torque, [-1.2], rtol=1e-9)


def test_a_coordinate_is_not_coupled_with_itself():
    with pytest.raises(ValueError, match="Gear 'g'.*with itself.*a_hinge"):
        shafts(2, jc.joints.Gear("g", "a_hinge", "a_hinge", 2.0))
