"""User-defined constraints, compared with rows derived by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DERIVATIVE, IDENTITY

import jaxcon as jc
from jaxcon.constraints.rows import linearize


def rows_of(system, state):
    return linearize(system, state.q, state.v, state.time)


def circle(q, t, p):
    return (q @ q - (p["radius"] * (1 + t)) ** 2)[None]


def unit_mass(q, p):
    return jnp.ones_like(q)


def no_force(q, v, t, u, p):
    return jnp.zeros_like(q)


def test_holonomic_on_coordinates_by_hand():
    """φ = x² + y² − r²(1 + t)², hence φ̇ = 2 q·v − 2 r²(1 + t) and γ = 2 v·v − 2 r²."""
    system = jc.GeneralizedSystem(
        mass=unit_mass,
        force=no_force,
        constraints=(jc.joints.Holonomic(circle),),
        params={"radius": jnp.asarray(1.5)},
    )
    q, v, t = np.array([1.0, 2.0]), np.array([0.3, -0.7]), 0.5
    rows = rows_of(system, jc.init(system, jc.Method(), q, v, time=t))
    np.testing.assert_allclose(rows.residual, [5 - 2.25 * 2.25], rtol=IDENTITY)
    np.testing.assert_allclose(rows.rate, [2 * q @ v - 4.5 * 1.5], rtol=IDENTITY)
    np.testing.assert_allclose(rows.jacobian.dense(), [2 * q], rtol=IDENTITY)
    np.testing.assert_allclose(rows.bias, [2 * v @ v - 4.5], rtol=IDENTITY)


def knife(q, v, t, p):
    return jnp.stack([v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2]), v[2] - p["spin"] * t**2])


def test_velocity_level_on_coordinates_by_hand():
    system = jc.GeneralizedSystem(
        mass=unit_mass,
        force=no_force,
        constraints=(jc.joints.VelocityLevel(knife),),
        params={"spin": jnp.asarray(0.8)},
    )
    q, v, t = np.array([1.0, 2.0, 0.6]), np.array([0.3, -0.7, 1.1]), 0.5
    rows = rows_of(system, jc.init(system, jc.Method(), q, v, time=t))
    s, c = np.sin(0.6), np.cos(0.6)
    np.testing.assert_array_equal(rows.residual, np.zeros(2))
    np.testing.assert_allclose(rows.rate, [v[0] * s - v[1] * c, v[2] - 0.8 * t**2], rtol=IDENTITY)
    np.testing.assert_allclose(rows.jacobian.dense(), [[s, -c, 0], [0, 0, 1]], rtol=IDENTITY)
    expected = [v[2] * (v[0] * c + v[1] * s), -1.6 * t]
    np.testing.assert_allclose(rows.bias, expected, rtol=IDENTITY)


def meeting(a, b, t, p):
    return b.point(p["b"]) - a.point(p["a"])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("partner", [jc.WORLD, "wall", "first"])
def test_holonomic_on_bodies_is_the_joint_that_it_describes(dim, partner):
    """A user-defined coincidence of points has the φ, φ̇, γ and J of `Coincident`."""
    point = np.arange(1.0, dim + 1)
    turn = {"angle": 0.7} if dim == 2 else {"quaternion": (0.5, 0.5, -0.5, 0.5)}

    def build(add):
        scene = jc.Scene(dim=dim)
        inertia = 1.0 if dim == 2 else (1.0, 1.2, 1.4)
        for name in ("first", "second"):
            spin = 0.4 if dim == 2 else (0.1, 0.7, -0.3)
            scene.add_body(name, mass=1.0, inertia=inertia, angular_velocity=spin, **turn)
        scene.add_body("wall", fixed=True, position=(0.5,) * dim, **turn)
        add(scene)
        return scene.build()

    joint = jc.joints.Coincident("pin", partner, "second", point=point)
    system, state = build(lambda scene: scene.add(joint))
    local = {}
    for side, name in (("a", partner), ("b", "second")):
        pose = system.motion(name, state.q, state.v).pose
        local[side] = pose.local_point(jnp.asarray(point))
    user = jc.joints.Holonomic(meeting, bodies=(partner, "second"), name="pin", params=local)
    mine, _ = build(lambda scene: scene.add(user))
    ours, theirs = rows_of(system, state), rows_of(mine, state)
    for field in ("residual", "rate", "bias"):
        got, expected = getattr(theirs, field), getattr(ours, field)
        np.testing.assert_allclose(got, expected, rtol=DERIVATIVE, atol=DERIVATIVE)
    np.testing.assert_allclose(
        theirs.jacobian.dense(), ours.jacobian.dense(), rtol=DERIVATIVE, atol=DERIVATIVE
    )


def rolling(wheel, t, p):
    return (wheel.velocity[0] + p["radius"] * wheel.angular_velocity)[None]


def test_a_wheel_that_rolls_without_slipping():
    """A pull F accelerates a rolling hoop with F/2m, and friction is F/2."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("wheel", mass=2.0, inertia=2.0 * 0.3**2)
    scene.add(jc.forces.Force("pull", "wheel", force=(5.0, 0.0)))
    params = {"radius": 0.3}
    scene.add(jc.joints.VelocityLevel(rolling, bodies=("wheel",), name="roll", params=params))
    system, state = scene.build()
    a, multipliers, _ = jc.forward_dynamics(system, state, None, jc.Method(), 1e-3)
    np.testing.assert_allclose(a, [5 / 4, 0, -5 / 4 / 0.3], rtol=IDENTITY)
    np.testing.assert_allclose(multipliers, [-5 / 2], rtol=IDENTITY)


def test_velocity_level_rows_decay_under_feedback():
    """Feedback gives ψ̇ = −2α ψ."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("wheel", mass=2.0, inertia=0.2, velocity=(1.0, 0.0))
    scene.add(
        jc.joints.VelocityLevel(rolling, bodies=("wheel",), name="roll", params={"radius": 0.3})
    )
    system, state = scene.build()
    method = jc.Method(stabilizer=jc.Baumgarte.critical(rate=4.0), integrator=jc.RK4())
    for _ in range(5):
        state, _ = jc.step(system, method, state, None, 0.01)
    psi = jc.violation(system, state).rate("roll")
    np.testing.assert_allclose(psi, np.exp(-2 * 4.0 * 0.05), rtol=1e-6)


def test_parameters_of_a_user_are_leaves():
    scene = jc.Scene(dim=2)
    scene.add_body("wheel", mass=2.0, inertia=0.2, angular_velocity=1.0)
    scene.add(
        jc.joints.VelocityLevel(rolling, bodies=("wheel",), name="roll", params={"radius": 0.3})
    )
    system, state = scene.build()
    assert system.params["roll"]["params"]["radius"] == 0.3
    other = system.with_params({"roll": {"params": {"radius": jnp.asarray(0.5)}}})
    np.testing.assert_allclose(rows_of(other, state).rate, [0.5])
