"""Points on curves against joints that do the same, and a bead on a wire by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import DERIVATIVE, IDENTITY

import jaxcon as jc

METHOD = jc.Method(stabilizer=jc.stabilizers.Unstabilized())


def circle(x, p):
    """Returns φ of a circle about the origin of a; in space it is normal to an axis."""
    rows = [x @ x - p["radius"] ** 2]
    return jnp.stack(rows if len(x) == 2 else [*rows, x @ p["axis"]])


def on_a_circle(s, center, axis):
    """A point on the user's circle; the frame of a is not at its center of mass."""
    return jc.joints.PointOnCurve(
        *s.joint, circle, point=s.point, params={"radius": 1.0, "axis": axis}
    )


def on_a_rod(s, center, axis):
    """A massless rod with the same motion, hinged to a in space."""
    if s.dim == 2:
        return jc.Distance(*s.joint, point_a=center, point_b=s.point)
    return jc.joints.RevoluteSpherical(*s.joint, hinge=center, ball=s.point, axis=axis)


def held(dim, base, make):
    """Two moving bodies; a point of "first" stays on a circle about the frame of `base`."""
    scene, random = jc.Scene(dim=dim), scenes.seeded(dim, base)
    scenes.add_random_body(scene, "first", random)
    scenes.add_random_body(scene, "second", random)
    turn = {"angle": 0.4} if dim == 2 else {"quaternion": (0.5, 0.5, 0.5, -0.5)}
    scene.add_body("wall", fixed=True, position=(0.3,) * dim, **turn)
    bare, start = scene.build()
    center = np.asarray(jc.position(bare, start, base)) if base != jc.WORLD else np.zeros(dim)
    local = np.array([0.6, 0.8] if dim == 2 else [0.6, 0.0, 0.8])  # normal to the y axis
    axis = np.eye(dim)[1]
    turned = np.eye(dim)
    if base != jc.WORLD:
        columns = [jc.position(bare, start, base, np.eye(dim)[i]) - center for i in range(dim)]
        turned = np.stack(columns, axis=1)
    site = scenes.Site(base, "first", dim, center + turned @ local, axis, center)
    scene.add(make(site, center, turned @ axis if make is on_a_rod else axis))
    system, state = scene.build()
    return system, dataclasses.replace(state, v=scenes.allowed(system, state, state.v))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("base", [jc.WORLD, "wall", "second"])
def test_a_circle_is_a_massless_rod(dim, base):
    """Accelerations and wrenches agree; the frame of "second" is off its center of mass."""
    found = []
    for make in (on_a_circle, on_a_rod):
        system, state = held(dim, base, make)
        assert jc.violation(system, state).worst < IDENTITY
        assert jc.violation(system, state).worst_rate < IDENTITY
        solution = jc.forward_dynamics(system, state, None, METHOD, 1e-3)
        found.append((state.v, solution.acceleration, jc.wrench(solution, "joint")))
    for got, expected in zip(*found, strict=True):
        np.testing.assert_allclose(got, expected, rtol=DERIVATIVE, atol=DERIVATIVE)


def parabola(x, p):
    return jnp.stack([x[1] - 0.5 * p["curvature"] * x[0] ** 2])


def bead_on_wire(curvature):
    """A bead at x = 0.4 with ẋ = 1.3 on y = ½ k x²."""
    scene = jc.Scene(dim=2)
    x, speed = 0.4, 1.3
    place = jnp.stack([jnp.asarray(x), 0.5 * curvature * x**2])
    velocity = jnp.stack([jnp.asarray(speed), curvature * x * speed])
    scene.add_particle("bead", mass=2.0, position=place, velocity=velocity)
    wire = jc.joints.PointOnCurve(
        "wire", jc.WORLD, "bead", parabola, params={"curvature": curvature}
    )
    scene.add(wire)
    return scene.build()


def acceleration(curvature):
    system, state = bead_on_wire(curvature)
    return jc.forward_dynamics(system, state, None, METHOD, 1e-3).acceleration[0]


def by_hand(k, x=0.4, speed=1.3):
    """Returns ẍ by Lagrange's equation (1 + k²x²) ẍ + k² x ẋ² + g k x = 0."""
    return -(k**2 * x * speed**2 + 9.81 * k * x) / (1 + k**2 * x**2)


def test_a_bead_on_a_wire_and_its_gradient_by_hand():
    got, slope = jax.jit(jax.value_and_grad(acceleration))(jnp.asarray(1.7))
    np.testing.assert_allclose(got, by_hand(1.7), rtol=IDENTITY)
    np.testing.assert_allclose(slope, jax.grad(by_hand)(1.7), rtol=DERIVATIVE)


def test_the_force_of_the_wire_is_normal_to_it():
    system, state = bead_on_wire(jnp.asarray(1.7))
    solution = jc.forward_dynamics(system, state, None, METHOD, 1e-3)
    force = jc.wrench(solution, "wire")
    assert abs(force @ jnp.array([1.0, 1.7 * 0.4])) < IDENTITY
    expected = 2.0 * (solution.acceleration + jnp.array([0.0, 9.81]))
    np.testing.assert_allclose(force, expected, rtol=IDENTITY)


def test_worlds_may_have_their_own_curves():
    """A batch over the curvature of a built system equals single worlds."""
    system, state = bead_on_wire(jnp.asarray(1.0))

    def step(k):
        changed = system.with_params({"wire": {"params": {"curvature": k}}})
        return jc.step(changed, jc.Method(), state, None, 1e-3)[0].v

    curvatures = jnp.array([0.5, 1.0, 2.0])
    batch = jax.jit(jax.vmap(step))(curvatures)
    for i, k in enumerate(curvatures):
        np.testing.assert_allclose(batch[i], step(k), rtol=IDENTITY)
