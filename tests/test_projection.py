"""Projections: nearest points, conserved quantities, and derivatives."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE, IDENTITY

import jaxcon as jc
from jaxcon.constraints.rows import linearize
from jaxcon.core import status
from jaxcon.geometry import quaternion
from jaxcon.scenes import four_bar

PROJECTION = jc.Projection()
STANDING, HERE = np.eye(3), np.zeros(3)


def projecting(system, stabilizer=PROJECTION, solver=None):
    """Returns the compiled function (system, state) → projected state."""
    solver = jc.solvers.RankSafe() if solver is None else solver
    method = jc.Method(stabilizer=stabilizer, solver=solver)

    @jax.jit
    def project(system, state):
        start = jc.init(system, method, state.q, state.v, state.time)
        return jc.step(system, method, start, None, 0.0)[0]

    return project


def moved(state, size, seed=0, velocity=0.0):
    """Returns a state off its constraints."""
    rng = np.random.default_rng(seed)
    q, v = (rng.normal(size=x.shape) for x in (state.q, state.v))
    dtype = state.q.dtype
    return dataclasses.replace(
        state,
        q=state.q + size * jnp.asarray(q, dtype),
        v=state.v + velocity * jnp.asarray(v, dtype),
    )


def dumbbell(masses=(1.0, 3.0)):
    """Two particles at a distance of 1 in the plane."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    for i, mass in enumerate(masses):
        scene.add_particle(f"p{i}", mass=mass, position=(float(i), 0.0))
    scene.add(jc.Distance("rod", "p0", "p1"))
    return scene.build()


def arm(turn=STANDING, shift=HERE, hinges=1, dtype=None):
    """A link in space on a door with one or two hinges; the scene is rotated and shifted."""
    scene = jc.Scene(gravity=tuple(turn @ (0.0, 0.0, -9.81)), dtype=dtype)
    attitude = np.asarray(quaternion.from_matrix(jnp.asarray(turn)))
    solid = {"mass": 2.0, "inertia": (0.1, 0.2, 0.15), "quaternion": attitude}
    for i, name in enumerate(("door", "link")):
        scene.add_body(name, position=turn @ (0.5 + i, 0.0, 0.2 * i) + shift, **solid)
    axis = turn @ (0.0, 0.0, 1.0)
    for i in range(hinges):
        hinge = turn @ (0.0, 0.0, 0.8 * i) + shift
        scene.add(jc.Revolute(f"hinge{i}", jc.WORLD, "door", point=hinge, axis=axis))
    scene.add(jc.Spherical("elbow", "door", "link", point=turn @ (1.0, 0.0, 0.1) + shift))
    return scene.build()


def skate():
    """A blade at the end of a rod of length 1."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("skate", mass=2.0, inertia=0.5, position=(1.0, 0.0), angle=0.3)
    scene.add(jc.Distance("rod", jc.WORLD, "skate"))
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(0.0, 1.0)))
    return scene.build()


@pytest.mark.parametrize(("metric", "shares"), [("mass", (0.75, 0.25)), ("euclidean", (0.5, 0.5))])
def test_a_dumbbell_by_hand(metric, shares):
    """Corrections along the rod are inversely proportional to the masses, or equal."""
    system, state = dumbbell()
    q, v = jnp.array([-0.2, 1.2, 0.0, 0.0]), jnp.array([0.0, 1.0, 2.0, 5.0])
    state = dataclasses.replace(state, q=q, v=v)
    new = projecting(system, jc.Projection(metric=metric))(system, state)
    a, b = shares
    np.testing.assert_allclose(new.q, [-0.2 + 0.4 * a, 1.2 - 0.4 * b, 0.0, 0.0], atol=IDENTITY)
    np.testing.assert_allclose(new.v, [a, 1.0 - b, 2.0, 5.0], atol=IDENTITY)


@pytest.mark.parametrize(
    ("metric", "dtype", "bound"),
    [("mass", jnp.float64, 1e-12), ("euclidean", jnp.float32, 2e-6)],
)
def test_a_door_with_two_hinges_is_projected_to_rounding(metric, dtype, bound):
    """The rows are redundant, and the error is a tenth of the scene's size."""
    system, state = arm(hinges=2, dtype=dtype)
    new = projecting(system, jc.Projection(metric=metric))(system, moved(state, 0.1, 1, 1.0))
    left = jc.violation(system, new)
    assert not status.failed(new.status)
    assert float(left.worst) < bound
    assert float(left.worst_rate) < bound


def test_the_point_solves_its_equations():
    """M d = J(q*)ᵀ μ and φ(q* ⊕ d) = 0; for velocities M Δv = J(q)ᵀ μ."""
    system, state = four_bar()
    start = moved(state, 0.05, 2, 1.0)
    new = projecting(system)(system, start)
    mass = np.asarray(system.mass(start.q).values)
    for q, step in ((start.q, new.q - start.q), (new.q, new.v - start.v)):
        normal = np.asarray(linearize(system, q, start.v, start.time).jacobian.dense()).T
        force = mass * np.asarray(step)
        left = force - normal @ np.linalg.lstsq(normal, force, rcond=None)[0]
        assert np.max(np.abs(left)) < IDENTITY
        assert np.max(np.abs(step)) > 1e-2


def test_symmetries_are_kept():
    """Exercise 3: rotating and shifting the scene commutes with the projection."""
    system, state = arm()
    start, project = moved(state, 0.05, 3, 0.5), projecting(system)
    new = project(system, start)
    turn = np.asarray(quaternion.matrix(quaternion.exp(jnp.array([0.4, -0.7, 1.1]))))
    shift = np.array([0.3, -0.2, 0.5])
    other, standing = arm(turn, shift)
    p = quaternion.from_matrix(jnp.asarray(turn))

    def placed(s):
        x, q = s.q[:6].reshape(3, 2), s.q[6:].reshape(4, 2)
        u = s.v[:6].reshape(3, 2)
        x = turn @ np.asarray(x) + shift[:, None]
        q = quaternion.multiply(jnp.stack([p, p], 1), q)
        return np.concatenate([x.ravel(), q.ravel()]), np.append(turn @ np.asarray(u), s.v[6:])

    q, v = placed(start)
    placed_start = dataclasses.replace(standing, q=jnp.asarray(q), v=jnp.asarray(v))
    other_new = project(other, placed_start)
    for got, expected in zip((other_new.q, other_new.v), placed(new), strict=True):
        np.testing.assert_allclose(got, expected, atol=IDENTITY)


def triangle(order):
    """Three particles joined by rods, which are listed in the given order."""
    scene = jc.Scene(dim=2)
    for i, place in enumerate([(0.0, 0.0), (1.0, 0.0), (0.3, 0.8)]):
        scene.add_particle(f"p{i}", mass=1.0 + i, position=place)
    rods = [jc.Distance(f"rod{i}", f"p{i}", f"p{(i + 1) % 3}") for i in range(3)]
    for i in order:
        scene.add([*rods, jc.Distance("top", jc.WORLD, "p2", point_a=(0.3, 2.0))][i])
    return scene.build()


def test_the_order_in_which_constraints_are_listed_does_not_matter():
    ends = []
    for order in ((0, 1, 2, 3), (3, 1, 0, 2)):
        system, state = triangle(order)
        new = projecting(system)(system, moved(state, 0.05, 7, 1.0))
        ends.append(np.concatenate([new.q, new.v]))
    np.testing.assert_allclose(*ends, atol=IDENTITY)


def test_rows_of_velocities_are_part_of_the_second_projection_only():
    system, state = skate()
    start = moved(state, 0.1, 4, 1.0)
    new = projecting(system)(system, start)
    left = jc.violation(system, new)
    assert float(left.worst) < IDENTITY
    assert float(left.worst_rate) < IDENTITY
    assert float(jnp.abs(jc.violation(system, start).rate("blade"))) > 0.1
    radius = np.linalg.norm(start.q[:2])
    np.testing.assert_allclose(new.q, [*(start.q[:2] / radius), start.q[2]], atol=IDENTITY)


def test_a_motion_in_time_is_followed():
    """A rotor and a driven coordinate: φ̇ = 0 contains ∂φ/∂t, and the rotor adds inertia."""
    scene = jc.Scene(dim=2)
    scene.add_body("a", mass=1.0, inertia=1.0)
    scene.add_body("b", mass=1.0, inertia=1.0)
    scene.add(jc.Prismatic("rail", jc.WORLD, "a", axis=(1.0, 0.0)))
    scene.add(jc.Prismatic("slide", "a", "b", axis=(1.0, 0.0)))
    scene.add(jc.joints.Drive("drive", "slide", lambda t, p: 2.0 * t))
    scene.add(jc.joints.Armature("rotor", "rail", inertia=2.0))
    system, state = scene.build()
    state = dataclasses.replace(state, time=jnp.asarray(0.5))
    new = projecting(system)(system, state)
    np.testing.assert_allclose(new.q[:2], [-0.25, 0.75], atol=IDENTITY)  # 3 kg and 1 kg share 1 m
    np.testing.assert_allclose(new.v[:2], [-0.5, 1.5], atol=IDENTITY)


def test_generalized_coordinates_with_a_full_mass_matrix():
    mass = np.array([[2.0, 0.5], [0.5, 1.0]])
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.asarray(mass),
        force=lambda q, v, t, u, p: jnp.zeros_like(q),
        constraints=(jc.joints.Holonomic(lambda q, t, p: jnp.stack([q @ q - 1.0]), name="circle"),),
    )
    method = jc.Method(stabilizer=PROJECTION)
    start = jc.init(system, method, jnp.array([1.0, 0.2]), jnp.array([1.0, 1.0]))
    project = jax.jit(jax.vmap(lambda s: jc.step(system, method, s, None, 0.0)[0]))
    new = jax.tree.map(lambda x: x[0], project(jax.tree.map(lambda x: x[None], start)))
    assert abs(float(new.q @ new.q) - 1) < IDENTITY
    assert abs(float(new.q @ new.v)) < IDENTITY
    pull = mass @ (new.q - start.q)  # parallel to J(q*)
    assert abs(pull[0] * start.q[1] - pull[1] * start.q[0]) < IDENTITY


def test_every_third_step_and_the_batch():
    """Projects in the third step only; worlds of a batch may have different step counts."""
    system, state = dumbbell()
    method = jc.Method(stabilizer=jc.Projection(every=3))
    start = jc.init(system, method, moved(state, 0.1).q, state.v)
    memory = start.memory._replace(stabilizer=jnp.asarray([0, 1], jnp.int32))
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), dataclasses.replace(start, memory=()))
    batch = dataclasses.replace(batch, memory=memory)
    step = jax.jit(jax.vmap(lambda s: jc.step(system, method, s, None, 1e-3)[0]))
    closed = []
    for _ in range(4):
        batch = step(batch)
        worst = jax.vmap(lambda s: jc.violation(system, s).worst)(batch)
        closed.append((worst < IDENTITY).tolist())
    assert closed == [[False, False], [False, True], [True, True], [True, True]]


def test_what_does_not_arrive_says_so():
    system, state = four_bar()
    start = moved(state, 0.05)
    late = projecting(system, jc.Projection(iterations=2))(system, start)
    assert int(late.status) == jc.Status.NOT_CONVERGED
    np.testing.assert_array_equal(late.q, start.q)
    once = projecting(system, jc.Projection(iterations=1))(system, start)
    first, then = (jc.violation(system, s).worst for s in (start, once))
    assert int(once.status) == jc.Status.OK
    assert 1e-5 < then < first**2  # the projection is linearized
    easy = jc.Projection(tolerance=jc.stabilizers.Tolerance(0.05, speed=100.0, force=1.0))
    np.testing.assert_array_equal(projecting(system, easy)(system, start).q, start.q)


def test_half_steps_halve_the_error():
    system, state = dumbbell()
    start = dataclasses.replace(state, q=jnp.array([-0.2, 1.2, 0.0, 0.0]))
    new = projecting(system, jc.Projection(factor=0.5, iterations=1))(system, start)
    assert abs(float(jc.violation(system, new).worst) - 0.2) < IDENTITY


def test_coupled_velocities_contain_the_correction():
    """The velocity is v + d/h, as if the step had led there, less its part along the rod."""
    system, state = dumbbell((1.0, 1.0))
    q = jnp.array([-0.1, 1.1, 0.0, 0.3])
    start = dataclasses.replace(state, q=q, v=jnp.zeros(4))
    method = jc.Method(stabilizer=jc.Projection(coupled=True))
    start = jc.init(system, method, start.q, start.v)
    new = jax.jit(lambda s: jc.step(system, method, s, None, 0.1)[0])(start)
    d = np.asarray(new.q - q)  # without the correction nothing moves
    along = np.array([new.q[1] - new.q[0], new.q[3] - new.q[2]])
    normal = np.array([-along[0], along[0], -along[1], along[1]])
    expected = d / 0.1 - normal * (normal @ d / 0.1) / (normal @ normal)
    np.testing.assert_allclose(new.v, expected, atol=IDENTITY)


def test_choices_that_do_not_exist_are_refused():
    bad = {"metric": "size", "iterations": 0, "every": 0, "factor": 1.5}
    for what, value in bad.items():
        with pytest.raises(ValueError, match=f"Projection: {what}"):
            jc.Projection(**{what: value})


def on_circle(q):
    """Returns a linear function of the projection of a particle to a circle of radius 1."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("bead", mass=2.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bead"))
    system, state = scene.build()
    method = jc.Method(stabilizer=PROJECTION)
    new, _ = jc.step(system, method, dataclasses.replace(state, q=q), None, 0.0)
    return new.q @ jnp.array([0.3, -0.8])


def test_first_and_second_derivatives_by_hand():
    q = jnp.array([0.7, 0.9])

    def by_hand(q):
        return q @ jnp.array([0.3, -0.8]) / jnp.sqrt(q @ q)

    for transform in (jax.grad, jax.hessian):
        got = jax.jit(transform(on_circle))(q)
        np.testing.assert_allclose(got, transform(by_hand)(q), atol=IDENTITY)


def by_newton(system, start):
    """Returns q = q* ⊕ M⁻¹J(q*)ᵀ μ by 12 iterations of Newton's method with dense matrices."""
    normal = linearize(system, start.q, start.v, start.time).jacobian.dense()
    away = normal.T / system.mass(start.q).values[:, None]

    def round_of_newton(μ, _):
        q = start.q + away @ μ
        rows = linearize(system, q, start.v, start.time)
        return μ - jnp.linalg.solve(rows.jacobian.dense() @ away, rows.residual), None

    return start.q + away @ jax.lax.scan(round_of_newton, jnp.zeros(len(normal)), None, 12)[0]


def test_the_derivative_is_that_of_the_root():
    """Derivatives by a length and by q* equal those of the dense iteration, and differences."""
    system, state = four_bar()
    start = moved(state, 0.05, 5)
    weight = jnp.asarray(np.random.default_rng(6).normal(size=9))
    method = jc.Method(stabilizer=PROJECTION)

    def with_length(x):
        anchor = system.params["crank_coupler"]["anchor_a"] + jnp.stack([x[0], 0.0 * x[0]])
        changed = system.with_params({"crank_coupler": {"anchor_a": anchor}})
        return changed, dataclasses.replace(start, q=start.q + x[1] * weight)

    def projected(x, speeds=1.0):
        changed, world = with_length(x)
        new, _ = jc.step(changed, method, world, None, 0.0)
        return weight @ new.q + speeds * jnp.sum(jnp.sin(new.v))

    def plain(x):
        return weight @ by_newton(*with_length(x))

    x, h = jnp.array([0.01, 0.02]), 1e-5
    gradient = jax.jit(jax.grad(projected))
    np.testing.assert_allclose(gradient(x, 0.0), jax.jit(jax.grad(plain))(x), rtol=1e-9)
    value = jax.jit(projected)
    differences = [(value(x + h * e) - value(x - h * e)) / (2 * h) for e in jnp.eye(2)]
    np.testing.assert_allclose(gradient(x), differences, rtol=DIFFERENCE)
    forward = jax.jit(jax.jacfwd(projected))(x)
    np.testing.assert_allclose(forward, gradient(x), rtol=1e-9)


@pytest.mark.parametrize(
    "solver", [jc.solvers.Dense(), jc.solvers.ConjugateGradients()], ids=["dense", "cg"]
)
def test_solvers_agree_and_batches_are_loops(solver):
    system, state = four_bar()
    worlds = [moved(state, 0.03, seed, 1.0) for seed in range(3)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *worlds)
    reference, method = projecting(system), jc.Method(stabilizer=PROJECTION, solver=solver)
    got = jax.jit(jax.vmap(lambda s: jc.step(system, method, s, None, 0.0)[0]))(batch)
    for i, world in enumerate(worlds):
        expected = reference(system, world)
        np.testing.assert_allclose(got.q[i], expected.q, atol=1e-10)
        np.testing.assert_allclose(got.v[i], expected.v, atol=1e-8)


def door():
    """A door on two hinges: ten rows of rank five."""
    scene = jc.Scene()
    scene.add_body("door", mass=20.0, inertia=(2.0, 3.0, 1.0), position=(0.5, 0.1, 1.0))
    for name, height in (("lower", 0.3), ("upper", 1.7)):
        point = (0.0, 0.0, height)
        scene.add(jc.Revolute(name, jc.WORLD, "door", point=point, axis=(0.0, 0.0, 1.0)))
    return scene.build()


def test_a_linearized_projection_hears_a_solver_that_does_not_converge():
    """A door that is off both of its hinges has contradictory rows."""
    system, state = door()
    still, off = jc.Projection(iterations=1, velocity=False), moved(state, 1e-3)
    few = jc.solvers.ConjugateGradients(iterations=2)
    for solver, expected in ((few, jc.Status.NOT_CONVERGED), (jc.solvers.RankSafe(), jc.Status.OK)):
        _, code = still.project(system, solver, off, off, jnp.asarray(1e-3))
        assert code == expected


def test_conjugate_gradients_project_redundant_rows_with_their_gradient():
    """Three bars carry a coupler, so that rows are redundant.

    Results equal those of elimination.
    """
    scene = jc.Scene(dim=2)
    half = 0.5 * np.array([np.cos(1.9), -np.sin(1.9)])
    solid = {"mass": 1.0, "inertia": 0.1}
    scene.add_body("coupler", **solid, position=(1.0 + 2 * half[0], 2 * half[1]))
    for i in range(3):
        foot = np.array([float(i), 0.0])
        scene.add_body(f"bar{i}", **solid, position=foot + half, angle=-1.9)
        scene.add(jc.Revolute(f"foot{i}", jc.WORLD, f"bar{i}", point=foot))
        scene.add(jc.Revolute(f"head{i}", f"bar{i}", "coupler", point=foot + 2 * half))
    system, state = scene.build()

    def end(solver, gravity):
        heavy = system.with_params({"gravity": jnp.stack([0.0 * gravity, gravity])})
        method = jc.Method(stabilizer=PROJECTION, solver=solver)
        final, code = jc.rollout(
            heavy, method, state, None, 5e-3, 40, record=lambda s, info: info.status
        )
        return final.q[0], code

    found = []
    for solver in (jc.solvers.RankSafe(), jc.solvers.ConjugateGradients()):
        run = jax.jit(jax.value_and_grad(functools.partial(end, solver), has_aux=True))
        (place, code), slope = run(-9.81)
        assert np.all(code == jc.Status.OK)
        found.append((place, slope))
    assert abs(found[0][1]) > 1e-3
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)


@pytest.mark.parametrize("tolerance", [None, 1e-5])
def test_a_linearized_projection_leaves_what_is_there(tolerance):
    """The rows contradict each other only by rounding, which the projection must ignore."""
    system, state = door()
    still = jc.Projection(iterations=1, velocity=False, tolerance=tolerance)
    few = jc.solvers.ConjugateGradients(iterations=30)
    noise = 1e-16 * np.random.default_rng(1).standard_normal((4, 7))

    def place(shift, noise):
        start = dataclasses.replace(state, q=(state.q + noise).at[0].add(shift))
        new, code = still.project(system, few, start, start, jnp.asarray(1e-3))
        return new.q[0], (new.q - start.q, code)

    places = jax.jit(jax.vmap(jax.value_and_grad(place, has_aux=True), (None, 0)))
    (_, (change, code)), slope = places(0.0, noise)
    assert (code == jc.Status.OK).all()
    np.testing.assert_allclose(change, 0, atol=1e-14)
    # of a shift along x, the share of a rotation about the hinges remains: m y²/(m r² + I)
    np.testing.assert_allclose(slope, 20 * 0.1**2 / (20 * 0.26 + 1.0), rtol=1e-9)


def test_projection_keeps_the_order_of_runge_kutta():
    """Halving the step on a double pendulum shows the fourth order."""
    scene = jc.Scene(dim=2)
    for i in range(2):
        scene.add_particle(f"p{i}", mass=1.0, position=(i + 1.0, 0.0))
        scene.add(jc.Distance(f"rod{i}", f"p{i - 1}" if i else jc.WORLD, f"p{i}"))
    system, state = scene.build()
    method = jc.Method(jc.RK4(), PROJECTION)

    @jax.jit
    def run(dt, steps):
        return jax.lax.fori_loop(
            0, steps, lambda _, s: jc.step(system, method, s, None, dt)[0], state
        )

    ends = [run(1.0 / n, n).q for n in (40, 80, 160)]
    errors = [float(jnp.max(jnp.abs(a - b))) for a, b in zip(ends, ends[1:], strict=False)]
    order = np.log2(errors[0] / errors[1])
    assert 3.8 < order < 4.4


@pytest.mark.parametrize("solver", [jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel()])
def test_a_contact_follows_what_is_projected(solver):
    """A ball on a lift y* = A (1 − cos ωt): λ = m (g + ÿ*) to first order, two steps late."""
    size, rate, m, g = 0.1, 6.0, 2.0, 9.81
    scene = jc.Scene(dim=2, gravity=(0.0, -g))
    scene.add_body("lift", mass=3.0, inertia=1.0)
    scene.add_body("ball", mass=m, inertia=0.01, position=(0.0, 0.1))
    scene.add(jc.Prismatic("rail", jc.WORLD, "lift", axis=(0.0, 1.0)))
    scene.add(jc.joints.Drive("motor", "rail", lambda t, p: size * (1 - jnp.cos(rate * t))))
    scene.add(jc.PlaneContact("floor", "lift", "ball", radius=0.1, friction=0.5))
    system, state = scene.build()
    method = jc.Method(stabilizer=jc.Projection(), contact_solver=solver)
    state = jc.init(system, method, state.q, state.v)

    def run(h):
        def seen(s, info):
            gap = (jc.position(system, s, "ball") - jc.position(system, s, "lift"))[1] - 0.1
            off = jc.violation(system, s)
            return s.time, info.reactions["floor"][0], gap, off.worst, off.worst_rate

        return jc.rollout(system, method, state, None, h, 250, record=seen)[1]

    steps = jnp.asarray([4e-3, 1e-3])
    time, force, gap, *off = jax.jit(jax.vmap(run))(steps)
    h = steps[:, None]
    want = m * (g + size * rate**2 * jnp.cos(rate * (time - h / 2)))
    late = jnp.abs(force - want)[:, 2:] / (m * size * rate**3 * h)
    assert jnp.all(late < 2)
    # a step errs by ÿ* h²/2; the next step corrects a fifth of an overlap
    assert jnp.all(jnp.abs(gap) < 5 * size * rate**2 * h**2 / 2)
    assert max(float(jnp.max(x)) for x in off) < 1e-14
