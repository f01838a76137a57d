"""Inertia of solids, compared with Gauss quadrature over their volume."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY, QUADRATURE

import jaxcon as jc
from jaxcon.geometry import inertia

MASS = 2.5


def gauss(low, high, n=12):
    x, w = np.polynomial.legendre.leggauss(n)
    return low + (high - low) * (x + 1) / 2, w * (high - low) / 2


def product(*rules):
    """Returns points (k, axis) and weights (k,) of a product of one-dimensional rules."""
    points = np.array(list(itertools.product(*(x for x, _ in rules))))
    weights = np.array([np.prod(w) for w in itertools.product(*(w for _, w in rules))])
    return points, weights


def ring(n=16):
    """Returns the periodic trapezoidal rule, exact for trigonometric polynomials."""
    return 2 * np.pi * np.arange(n) / n, np.full(n, 2 * np.pi / n)


def box(a, b, c):
    return product(gauss(-a / 2, a / 2), gauss(-b / 2, b / 2), gauss(-c / 2, c / 2))


def cylinder(radius, low, high):
    polar, weights = product(gauss(0, radius), ring(), gauss(low, high))
    r, angle, z = polar.T
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1), weights * r


def ball(radius, low=-1.0, high=1.0, center=0.0):
    """The zone of a ball with low < cos(polar angle) < high."""
    polar, weights = product(gauss(0, radius), ring(), gauss(low, high))
    r, angle, c = polar.T
    s = np.sqrt(1 - c**2)
    points = np.stack([r * s * np.cos(angle), r * s * np.sin(angle), r * c + center], -1)
    return points, weights * r**2


def together(*parts):
    return np.concatenate([p for p, _ in parts]), np.concatenate([w for _, w in parts])


def moments(points, weights):
    """Returns the moments of inertia of a solid of mass MASS about the axes."""
    density = MASS / np.sum(weights)
    squares = np.sum(density * weights[:, None] * points**2, axis=0)
    return np.sum(squares) - squares


SOLIDS = {
    "sphere": (inertia.sphere(MASS, 0.7), ball(0.7)),
    "box": (inertia.box(MASS, (0.3, 0.5, 0.9)), box(0.3, 0.5, 0.9)),
    "cylinder": (inertia.cylinder(MASS, 0.4, 1.1), cylinder(0.4, -0.55, 0.55)),
    "capsule": (
        inertia.capsule(MASS, 0.4, 1.1),
        together(cylinder(0.4, -0.55, 0.55), ball(0.4, 0, 1, 0.55), ball(0.4, -1, 0, -0.55)),
    ),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_moments_are_the_integrals_over_the_solid(name):
    solid, (points, weights) = SOLIDS[name]
    assert float(solid.mass) == MASS
    np.testing.assert_allclose(
        np.array(solid.moments, float), moments(points, weights), rtol=QUADRATURE
    )


def test_a_rod_is_a_cylinder_along_x():
    points, weights = cylinder(0.1, -0.6, 0.6)
    got = np.array(inertia.rod(MASS, length=1.2, radius=0.1).moments, float)
    np.testing.assert_allclose(got, moments(points[:, [2, 0, 1]], weights), rtol=QUADRATURE)


def random_tensor(values, seed=0):
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return axes @ np.diag(values) @ axes.T


TENSORS = {
    "distinct": random_tensor([1.0, 1.5, 2.0]),
    "two equal": random_tensor([1.0, 1.5, 1.5]),
    "all equal": 1.3 * np.eye(3),
    "diagonal": np.diag([2.0, 1.0, 1.5]),
}


@pytest.mark.parametrize("name", TENSORS)
def test_principal_axes_give_the_tensor_back(name):
    tensor = jnp.asarray(TENSORS[name])
    solid = inertia.from_tensor(MASS, tensor)
    r = jc.quaternion.matrix(solid.axes)
    np.testing.assert_allclose(r @ jnp.diag(solid.moments) @ r.T, tensor, atol=IDENTITY)
    assert np.linalg.det(r) > 0


@pytest.mark.parametrize("name", TENSORS)
def test_gradients_by_the_tensor_are_finite(name):
    for derivative in (forward, reverse):
        assert jnp.all(jnp.isfinite(derivative(jnp.asarray(TENSORS[name]))))


def numbers(tensor):
    solid = inertia.from_tensor(MASS, tensor)
    return jnp.concatenate([solid.moments, solid.axes])


forward, reverse = jax.jit(jax.jacfwd(numbers)), jax.jit(jax.jacrev(numbers))


def test_gradient_of_the_tensor_that_the_axes_give_back():
    direction = random_tensor([0.3, -0.2, 0.5], seed=1)

    def back(tensor):
        moments, axes = inertia.principal_axes(tensor)
        return axes @ jnp.diag(moments) @ axes.T

    tensor = jnp.asarray(TENSORS["distinct"])
    _, tangent = jax.jvp(back, (tensor,), (jnp.asarray(direction),))
    np.testing.assert_allclose(tangent, direction, atol=IDENTITY)


def test_gradient_of_moments_is_that_of_eigenvalues_where_they_repeat():
    tensor, direction = jnp.asarray(TENSORS["two equal"]), jnp.eye(3)
    _, tangent = jax.jvp(lambda x: inertia.principal_axes(x)[0], (tensor,), (direction,))
    np.testing.assert_allclose(tangent, np.ones(3), atol=IDENTITY)


def turn_after_build(tensor):
    """Returns the orientation of a free body after 0.2 s, by its inertia tensor."""
    scene = jc.Scene(gravity=(0, 0, 0))
    scene.add_body("top", mass=1.0, inertia=tensor, angular_velocity=(1.0, 2.0, 0.5))
    system, state = scene.build()
    method = jc.Method(integrator=jc.RK4())
    state, _ = jc.rollout(system, method, state, None, 0.05, 4)
    return jc.orientation(system, state, "top")


def test_motion_does_not_depend_on_the_choice_of_axes():
    """A body given by a tensor follows Euler's equations in the user's own frame."""
    tensor, omega = TENSORS["distinct"], np.array([1.0, 2.0, 0.5])
    turn, h = np.eye(3), 1e-4
    for _ in range(2000):
        middle = omega + h / 2 * np.linalg.solve(tensor, np.cross(tensor @ omega, omega))
        x, y, z = h * middle
        small = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = turn @ (np.eye(3) + small + small @ small / 2)
        omega = omega + h * np.linalg.solve(tensor, np.cross(tensor @ middle, middle))
    got = jc.quaternion.matrix(jax.jit(turn_after_build)(jnp.asarray(tensor)))
    np.testing.assert_allclose(got, turn, atol=1e-5)


@pytest.mark.parametrize("name", TENSORS)
def test_the_derivative_by_the_tensor_is_that_of_the_motion(name):
    """Includes products of inertia where moments coincide, so that principal axes jump."""
    tensor, direction = TENSORS[name], random_tensor([0.3, -0.2, 0.5], seed=1)
    slope = np.sum(gradient_after_build(jnp.asarray(tensor)) * direction)
    ends = [value_after_build(jnp.asarray(tensor + h * direction)) for h in (1e-4, -1e-4)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-4, rtol=0, atol=3e-7)
    assert abs(slope) > 1e-3


OF_PLATES = {
    "diagonal": np.diag([2.0, 0.5, 1.9]),
    "z is not principal": np.array([[2.0, 0.1, 0.2], [0.1, 1.5, -0.3], [0.2, -0.3, 1.9]]),
}


@pytest.mark.parametrize("name", OF_PLATES)
def test_the_plane_takes_the_moment_about_z(name):
    """`from_tensor` sorts principal moments, so that none of them need belong to z."""
    tensor = jnp.asarray(OF_PLATES[name])

    def build(**solid):
        scene = jc.Scene(dim=2)
        scene.add_body("plate", **solid)
        return scene.build()[0]

    def moment(tensor):
        solid = inertia.from_tensor(1.0, tensor)
        given = build(inertia=solid).params["plate"]["inertia"]
        changed = build(mass=1.0, inertia=1.0).with_params({"plate": {"inertia": solid}})
        return jnp.stack([given, changed.params["plate"]["inertia"]])

    np.testing.assert_allclose(moment(tensor), [1.9, 1.9], rtol=IDENTITY)
    slopes = jax.jit(jax.jacrev(moment))(tensor)
    expected = np.zeros((3, 3))
    expected[2, 2] = 1.0
    np.testing.assert_allclose(slopes, [expected, expected], atol=IDENTITY)


@jax.jit
def value_after_build(tensor):
    return jnp.sum(turn_after_build(tensor))


gradient_after_build = jax.jit(jax.grad(value_after_build))
