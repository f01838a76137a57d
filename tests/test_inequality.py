"""User-defined inequality constraints, compared with contacts and hand calculations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc

G = 9.81
H = 1e-3
both = pytest.mark.parametrize("dim", [2, 3])
solvers = pytest.mark.parametrize(
    "solver", [jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel()], ids=lambda x: type(x).__name__
)


def above(pose, t, params):
    """Returns φ, the height over a plane."""
    return pose.position[-1:] - params


def inside(pose, t, params):
    """Returns φ = (r² − |x|²)/2 of a bowl about the origin."""
    return (params**2 - pose.position @ pose.position)[None] / 2


def corner(q, t, params):
    """Returns the distances from a fixed wall and from a moving one."""
    return q - jnp.stack([params["wall"], params["speed"] * t])


def ball(dim, element, velocity=0.0, dtype=None):
    """A ball of 2 kg at a height of one meter."""
    rest = (0.0,) * (dim - 1)
    scene = jc.Scene(dim=dim, dtype=dtype)
    inertia = 1.0 if dim == 2 else (1.0, 1.0, 1.0)
    scene.add_body(
        "ball", mass=2.0, inertia=inertia, position=(*rest, 1.0), velocity=(*rest, velocity)
    )
    scene.add(element)
    return scene.build()


def roll(system, state, steps, method=None, h=H):
    method = jc.Method() if method is None else method
    state = jc.init(system, method, state.q, state.v)
    h = jnp.asarray(h, state.q.dtype)
    record = lambda s, i: (s.q, s.v, i.reactions)  # noqa: E731
    return jax.jit(lambda s: jc.rollout(system, method, s, None, h, steps, record=record))(state)


@both
@pytest.mark.parametrize("numbers", [{"restitution": 0.6}, {"stiffness": 4e3, "damping": 9.0}])
def test_height_over_a_plane_is_a_contact_without_friction(dim, numbers):
    own = jc.contacts.Inequality(above, ("ball",), "floor", jnp.asarray(0.2), **numbers)
    point = (*(0.0,) * (dim - 1), 0.2)
    given = jc.PlaneContact("floor", jc.WORLD, "ball", point=point, **numbers)
    found, expected = (roll(*ball(dim, element), 900)[1] for element in (own, given))
    for a, b in zip(found[:2], expected[:2], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-10)
    np.testing.assert_allclose(found[2]["floor"], expected[2]["floor"], atol=1e-6)
    assert np.max(expected[2]["floor"]) > 100.0, "nothing was hit"


@pytest.mark.parametrize(
    ("dim", "solver", "dtype"),
    [
        (3, jc.solvers.InteriorPoint(), "float64"),
        (2, jc.solvers.InteriorPoint(), "float32"),
        (3, jc.solvers.GaussSeidel(), "float32"),
    ],
)
def test_a_ball_rests_in_a_bowl(dim, solver, dtype):
    """φ = (r² − |x|²)/2 has J = −xᵀ, so that λ = m g/r at the bottom."""
    element = jc.contacts.Inequality(inside, ("ball",), "bowl", 2.0)
    system, state = ball(dim, element, dtype=jnp.dtype(dtype))
    method = jc.Method(contact_solver=solver)
    final, (q, _, reactions) = roll(system, state, 1500, method)
    tight = 1e-9 if dtype == "float64" else 2e-6
    np.testing.assert_allclose(jc.position(system, final, "ball")[-1], -2.0, rtol=tight)
    np.testing.assert_allclose(reactions["bowl"][-1], [2 * G / 2], rtol=1e3 * tight)
    assert final.status == jc.Status.OK


@solvers
def test_two_walls_on_generalized_coordinates(solver):
    """A force of (−3, −5) N presses a particle into a corner; one wall moves at 0.5 m/s."""
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.full(2, p["mass"]),
        force=lambda q, v, t, u, p: jnp.asarray([-3.0, -5.0]),
        constraints=[jc.contacts.Inequality(corner, name="walls")],
        params={"mass": jnp.asarray(2.0), "wall": jnp.asarray(-1.0), "speed": jnp.asarray(0.5)},
    )
    method = jc.Method(contact_solver=solver)
    state = jc.init(system, method, jnp.asarray([0.0, 0.3]), jnp.zeros(2))
    final, (_, v, reactions) = roll(system, state, 2000, method)
    np.testing.assert_allclose(final.q, [-1.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(v[-1], [0.0, 0.5], atol=1e-9)
    np.testing.assert_allclose(reactions["walls"][-1], [[3.0], [5.0]], atol=1e-6)


def fall(dim=2):
    element = jc.contacts.Inequality(inside, ("ball",), "bowl", jnp.asarray(1.5), restitution=0.5)
    return ball(dim, element, velocity=-1.0)


def landing(system, state, radius, speed):
    """Returns the height of a ball after it bounces off a bowl."""
    system = system.with_params({"bowl": {"params": radius}})
    start = dataclasses.replace(state, v=state.v * speed)
    final, _ = jc.rollout(system, jc.Method(), start, None, jnp.asarray(2e-3), 400)
    return jc.position(system, final, "ball")[-1]


def test_derivatives_are_differences_and_batches_are_loops():
    system, state = fall()
    run = jax.jit(lambda r, s: landing(system, state, r, s))
    slopes = jax.jit(jax.grad(lambda r, s: landing(system, state, r, s), argnums=(0, 1)))(1.5, 1.0)
    for i, slope in enumerate(slopes):
        step = [0.0, 0.0]
        step[i] = 1e-6
        ends = [run(1.5 + side * step[0], 1.0 + side * step[1]) for side in (1, -1)]
        np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-6, rtol=1e-6)
    radii = jnp.asarray([1.4, 1.5, 1.7])
    together = jax.jit(jax.vmap(lambda r: landing(system, state, r, 1.0)))(radii)
    np.testing.assert_allclose(together, [run(r, 1.0) for r in radii], rtol=1e-12)


def apart(a, b, t, params):
    """Returns φ from a squared distance, whose gradient vanishes at distance zero."""
    gap = b.position - a.position
    return (gap @ gap - params)[None]


def test_a_tangent_is_finite_where_a_row_hardly_moves_anything():
    """There G is 1e-20, and 1/G² overflows in float32; times zero, it must not give NaN."""

    def tangents(dtype):
        scene = jc.Scene(dim=2, dtype=dtype)
        for name in ("a", "b"):
            scene.add_body(name, mass=1.0, inertia=0.8)
        scene.add(jc.contacts.Inequality(apart, ("a", "b"), "law", jnp.asarray(1.0, dtype)))
        system, state = scene.build()
        step = lambda q: jc.step(system, jc.Method(), dataclasses.replace(state, q=q), None, 0.01)  # noqa: E731
        near = state.q.at[system.layout.q("b")[0]].set(2e-10)
        return np.asarray(jax.jit(jax.jacfwd(lambda q: step(q)[0].v))(near), float)

    found, exact = tangents("float32"), tangents("float64")
    size = np.max(np.abs(exact))
    np.testing.assert_allclose(found / size, exact / size, atol=1e-5)


def test_it_goes_with_events_and_with_the_nearest_rows():
    system, state = fall()
    methods = (
        jc.Method(),
        jc.Method(contact_solver=jc.solvers.ActiveSet(jc.solvers.InteriorPoint(), stops=1)),
        jc.Method(events=jc.integrators.Events()),
    )
    ends = [roll(system, state, 400, m)[0].q for m in methods]
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-10)
    np.testing.assert_allclose(ends[2], ends[0], atol=5e-3)


def test_its_numbers_are_leaves():
    system, state = fall()
    changed = system.with_params({"bowl": {"restitution": jnp.asarray(0.25)}})
    assert changed.params["bowl"]["restitution"] == 0.25
    assert jc.violation(changed, state).worst == 0
    with pytest.raises(ValueError, match=r"restitution given as the number 0 leaves no rows"):
        ball(2, jc.contacts.Inequality(inside, ("ball",), "bowl", 2.0))[0].with_params(
            {"bowl": {"restitution": 0.5}}
        )


@pytest.mark.parametrize(
    ("element", "message"),
    [
        (
            jc.contacts.Inequality(lambda p, t, x: p.position[0], ("ball",), "one"),
            r"must return an array",
        ),
        (jc.contacts.Inequality(above, ("bat",), "one", 0.0), "body 'bat' is unknown"),
        (
            jc.contacts.Inequality(above, ("ball",), "one", 0.0, restitution=1.5),
            "must lie in 0 to 1",
        ),
        (
            jc.contacts.Inequality(above, ("ball",), "one", 0.0, stiffness=-1.0),
            "stiffness must be positive",
        ),
        (jc.contacts.Inequality(above, ("ball",), "one", 0.0, 0.5, 10.0), "one or the other"),
        (jc.contacts.Inequality(above, (), "one", 0.0), "bodies must be a tuple of names"),
    ],
)
def test_what_is_refused(element, message):
    with pytest.raises(ValueError, match=message):
        ball(2, element)


def test_restitution_on_generalized_coordinates():
    """A ball on a floor; the system does not know which part of the force is gravity."""

    def force(q, v, t, control, g):
        return jnp.stack([-g])

    def height(e, g):
        floor = jc.contacts.Inequality(lambda q, t, p: q, name="floor", restitution=e)
        system = jc.GeneralizedSystem(
            mass=lambda q, g: jnp.ones(1), force=force, constraints=[floor], params=g
        )
        state = jc.init(system, jc.Method(), jnp.array([0.5]), jnp.zeros(1))
        return jc.rollout(system, jc.Method(), state, None, 1e-3, 500)[0].q[0]

    speed = np.sqrt(9.81)
    left = 0.5 - speed / 9.81
    want = 0.8 * speed * left - 9.81 * left**2 / 2
    value, slope = jax.jit(jax.value_and_grad(height))(0.8, 9.81)
    np.testing.assert_allclose(value, want, atol=3e-3)
    np.testing.assert_allclose(slope, speed * left, atol=6e-3)


def test_a_function_without_rows_is_named():
    element = jc.contacts.Inequality(lambda pose, t, params: jnp.zeros(0), ("ball",), "floor")
    with pytest.raises(ValueError, match=r"Inequality 'floor': the function must return at least"):
        ball(2, element)
