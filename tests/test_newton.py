"""Newton's method for inequality rows of trees of bodies, and its parts."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from benchmarks import laws as study
from jaxcon.constraints.joint_trees import tree_equations
from jaxcon.constraints.rows import linearize, saddle
from jaxcon.contact import newton
from jaxcon.contact.body_slope import inverses
from jaxcon.contact.body_space import BodySpace, tree_below
from jaxcon.contact.bordered import Bordered, Directions
from jaxcon.contact.bounded import FrictionDisc, RowCounts, laws
from jaxcon.contact.contact_blocks import law_blocks
from jaxcon.contact.contact_default import default_contact_solver
from jaxcon.contact.rows import linearize_bounds
from jaxcon.core.lanes import Vector
from jaxcon.linear.articulated import Articulated, Reflections
from jaxcon.staging.batch_last import native_p

H = 2e-3
SWEEPS = jc.Method(contact_solver=jc.solvers.GaussSeidel(sweeps=400))
NEWTON = jc.Method(contact_solver=jc.solvers.Newton(iterations=100, tolerance=1e-12))
dims = pytest.mark.parametrize("dim", [2, 3])


def biped(dim, dtype=jnp.float64, limbs=False):
    """A trunk on two legs with stops, friction and rotors; feet that roll and slide on a floor.

    With `limbs`, the shins touch each other, too, with friction and rolling, and a rope and a
    contact without friction connect thighs and trunk.
    """

    def at(x, z):
        return (x, z) if dim == 2 else (x, 0.1 * x, z)

    scene = jc.Scene(dim=dim, dtype=dtype)
    moments = 0.03 if dim == 2 else (0.03, 0.04, 0.05)
    scene.add_body("trunk", mass=3.0, inertia=moments, position=at(0.0, 0.42))
    axis = {} if dim == 2 else {"axis": (0.0, 1.0, 0.0)}
    for side, x in (("left", -0.15), ("right", 0.15)):
        small = 2e-3 if dim == 2 else (2e-3, 2e-3, 1e-3)
        scene.add_body(f"{side} thigh", mass=0.5, inertia=small, position=at(x, 0.32))
        scene.add_body(f"{side} shin", mass=0.3, inertia=small, position=at(x, 0.12))
        hip, knee = f"{side} hip", f"{side} knee"
        scene.add(jc.Revolute(hip, "trunk", f"{side} thigh", point=at(x, 0.42), **axis))
        scene.add(jc.Revolute(knee, f"{side} thigh", f"{side} shin", point=at(x, 0.22), **axis))
        scene.add(jc.joints.Armature(f"{hip} rotor", hip, 0.004))
        scene.add(jc.contacts.Limit(f"{hip} stop", hip, lower=-0.4, upper=0.5))
        scene.add(jc.contacts.Limit(f"{knee} stop", knee, lower=-0.02, upper=1.5))
        scene.add(jc.contacts.JointFriction(f"{knee} rub", knee, max_force=0.05))
        spin = {} if dim == 2 else {"spinning": 1e-3}
        foot = jc.PlaneContact(
            f"{side} foot",
            jc.WORLD,
            f"{side} shin",
            radius=0.02,
            center=at(x, 0.02),
            friction=0.6,
            rolling=2e-3,
            **spin,
        )
        scene.add(foot)
        corners = np.array([at(1.4 * x, z) for z in (0.38, 0.42, 0.46)])
        scene.add(jc.PlaneContact(f"{side} end", jc.WORLD, "trunk", center=corners, friction=0.3))
    if limbs:
        between = jc.contacts.CapsuleContact
        shins = {"radius_a": 0.13, "radius_b": 0.13, "friction": 0.5, "rolling": 1e-3}
        for end, x in (("a", -0.15), ("b", 0.15)):
            shins[f"segment_{end}"] = np.array([at(x, z) for z in (0.04, 0.2)])
        scene.add(between("shins", "left shin", "right shin", **shins))
        scene.add(between("knees", "left thigh", "right shin", radius_a=0.1, radius_b=0.1))
        rope = {"point_a": at(-0.15, 0.32), "point_b": at(0.15, 0.32), "length": 0.31}
        scene.add(jc.contacts.Rope("rope", "left thigh", "right thigh", **rope))
    return scene.build()


def scissors(dim, dtype=jnp.float64, touching=True):
    """A trunk with two short legs, a rotor, a stop, a rough hip, and feet that slide and roll.

    With `touching`, the legs touch each other, with friction and rolling.
    """

    def at(x, z):
        return (x, z) if dim == 2 else (x, 0.1 * x, z)

    scene = jc.Scene(dim=dim, dtype=dtype)
    moments = 0.03 if dim == 2 else (0.03, 0.04, 0.05)
    axis = {} if dim == 2 else {"axis": (0.0, 1.0, 0.0)}
    scene.add_body("trunk", mass=3.0, inertia=moments, position=at(0.0, 0.22))
    for side, x in (("left", -0.1), ("right", 0.1)):
        leg, hip = f"{side} leg", f"{side} hip"
        scene.add_body(leg, mass=0.5, inertia=moments, position=at(x, 0.12))
        scene.add(jc.Revolute(hip, "trunk", leg, point=at(x, 0.22), **axis))
        foot = {"radius": 0.02, "center": at(x, 0.02), "friction": 0.6, "rolling": 2e-3}
        foot |= {} if dim == 2 else {"spinning": 1e-3}
        scene.add(jc.PlaneContact(f"{side} foot", jc.WORLD, leg, **foot))
    scene.add(jc.joints.Armature("rotor", "left hip", 0.004))
    scene.add(jc.contacts.Limit("stop", "right hip", lower=-0.02, upper=0.5))
    scene.add(jc.contacts.JointFriction("rub", "left hip", max_force=0.05))
    if touching:
        touch = {"radius_a": 0.1, "radius_b": 0.1, "friction": 0.5, "rolling": 1e-3}
        scene.add(jc.contacts.CapsuleContact("legs", "left leg", "right leg", **touch))
    return scene.build()


def begun(system, method, state, speed=1.0, seed=0):
    """Returns a state with random velocities that the joints allow."""
    random = np.random.default_rng(seed)
    v = jnp.asarray(speed * random.normal(size=len(state.v)), state.v.dtype)
    return jc.init(system, method, state.q, v)


def space_of(system, state):
    """Returns the equations in body space, dense matrices M, J, J_b of a world, and the rows."""
    q, v, t = state.q, state.v, state.time
    rows = linearize(system, q, v, t)
    equations = saddle(system, q, rows, jnp.zeros_like(v), jnp.zeros_like(rows.bias))
    bounds = linearize_bounds(system, q, v, t, None, jnp.asarray(H, q.dtype))
    tree = tree_below(system, equations.jacobian, equations.layout, bounds)
    assert tree is not None
    space = BodySpace.of(tree_equations(system, q, v, tree, equations), bounds)
    hard = np.asarray(rows.layout.holds)
    whole = np.asarray(rows.jacobian.dense())
    joints, rotors = whole[hard], whole[~hard]
    inertia = 1 / np.asarray(equations.compliance)[~hard]
    mass = np.diag(np.asarray(equations.mass.values)) + rotors.T @ (inertia[:, None] * rotors)
    return space, mass, joints, np.asarray(bounds.jacobian.dense()), bounds


@dims
@pytest.mark.parametrize("limbs", [False, True])
def test_elimination_along_the_joints_is_that_of_dense_algebra(dim, limbs):
    """N (Nᵀ (M + Jᵀ D J) N)⁻¹ Nᵀ Jᵀ λ and the inverse mass of each row, for random D and λ."""
    system, state = biped(dim, limbs=limbs)
    state = begun(system, SWEEPS, state)
    space, mass, joints, rows, bounds = space_of(system, state)
    _, sizes, basis = np.linalg.svd(joints)
    basis = basis[np.sum(sizes > 1e-10) :].T
    random, order = np.random.default_rng(1), space.order
    slope, λ = random.uniform(0, 50, len(rows)), random.normal(size=len(rows))
    none = [
        (jnp.zeros(disc.count), Vector(*(jnp.zeros(disc.count),) * disc.rank))
        for disc in bounds.kinds.discs
    ]
    stiff = space.stiffened(jnp.asarray(slope[order]), bounds.kinds, none)
    factors = Articulated(space.motions, *stiff)
    between = np.ravel(space.between(jnp.zeros(len(rows))))
    assert between.any() == limbs
    if limbs:
        d = jnp.asarray(slope[order])
        terms = Directions.of(between, bounds.kinds, d, none)
        factors = Bordered(space, factors, terms, space.pair_rows)
    z, y = factors.solve(*space.pull(jnp.asarray(λ[order])))
    found = np.empty(len(rows))
    found[order] = np.asarray(space.rows_of(y, z, jnp.zeros(len(rows))))
    whole = basis.T @ (mass + rows.T @ (slope[:, None] * rows)) @ basis
    expected = rows @ basis @ np.linalg.solve(whole, basis.T @ rows.T @ λ)
    np.testing.assert_allclose(found, expected, atol=1e-11 * np.abs(expected).max())
    free = space.equations.factors
    met = np.empty(len(rows))
    met[order] = np.asarray(space.mobility(free, jnp.zeros(len(rows)))[0])
    inverse = basis @ np.linalg.solve(basis.T @ mass @ basis, basis.T)
    exact, pairs = np.diag(rows @ inverse @ rows.T), np.empty(len(rows), bool)
    pairs[order] = between
    np.testing.assert_allclose(met[~pairs], exact[~pairs], rtol=1e-9, atol=1e-12)
    assert (met[pairs] > exact[pairs] / 2).all()  # g ≤ 2 (g₁ + g₂) for rows between two bodies


@pytest.mark.parametrize(("rows", "size"), [(1, 3), (2, 3), (3, 6), (5, 6), (6, 6)])
def test_the_complement_is_orthonormal_and_normal_to_the_rows(rows, size):
    given = np.random.default_rng(rows).normal(size=(rows, size, 4))
    basis = Reflections([Vector(*jnp.asarray(x)) for x in given], size).complement
    columns = np.array([[np.broadcast_to(x, 4) for x in b] for b in basis]).reshape(-1, size, 4)
    assert len(columns) == size - rows
    for w in range(4):
        np.testing.assert_allclose(columns[..., w] @ given[..., w].T, 0, atol=1e-13)
        np.testing.assert_allclose(
            columns[..., w] @ columns[..., w].T, np.eye(size - rows), atol=1e-13
        )


def test_the_slope_of_the_laws_is_their_derivative():
    """D = −∂Λ/∂u for stops, boxes, sticking and sliding contacts, and rolling resistance."""
    kinds = RowCounts(3, 3, 4, 2, (FrictionDisc(1, 2, 2),))
    random = np.random.default_rng(2)

    def one(n, low, high):
        return jnp.asarray(random.uniform(low, high, n))

    laws = newton.Laws(
        kinds,
        kinds.largest(one(kinds.size, 0.5, 2)),
        jnp.asarray(np.r_[one(kinds.normal + 4, 0, 1), np.zeros(kinds.size - kinds.normal - 4)]),
        one(3, -1, 0),
        one(3, 0, 1),
        (one(4, 0.2, 1.0), one(2, 0.1, 0.4)),
        jnp.asarray(np.arange(kinds.size) != 1),
    )
    for seed in range(20):
        random = np.random.default_rng(seed)
        center = jnp.asarray(random.normal(size=kinds.size))
        u = jnp.asarray(random.normal(size=kinds.size))
        diagonal, discs = laws.slope(center, u)
        matrix = np.diag(np.asarray(diagonal))
        for disc, first, (b, t) in zip(kinds.discs, kinds.starts, discs, strict=False):
            for i in range(disc.count):
                own = [first + r * disc.count + i for r in range(disc.rank)]
                along = np.array([x[i] for x in t])
                matrix[np.ix_(own, own)] -= float(b[i]) * np.outer(along, along)
        expected = -jax.jacobian(laws.project, 1)(center, u)
        np.testing.assert_allclose(matrix, expected, atol=1e-12)


def dense(blocks, n):
    """Returns the matrix of contact blocks, (n, n)."""
    return np.stack([np.asarray(blocks.apply(x)) for x in jnp.eye(n)], axis=1)


def test_blocks_of_contacts_are_those_of_dense_algebra():
    """A x, Aᵀ x, A⁻¹, A B and the derivatives of the laws, for all kinds of rows."""
    kinds = RowCounts(2, 2, 4, 2, (FrictionDisc(1, 2, 2), FrictionDisc(1, 2, 1)))
    n, random = kinds.size, np.random.default_rng(0)
    scale = np.asarray(kinds.by_contact(jnp.asarray(random.uniform(1, 2, n))))
    λ = jnp.asarray(random.normal(size=n) + 1)
    u, live = (
        jnp.asarray(random.normal(size=n)),
        (jnp.asarray([-1.0, 0.0]), jnp.asarray([0.5, 2.0])),
    )
    live = (*live, tuple(jnp.asarray(random.uniform(0.1, 1, x.count)) for x in kinds.discs))
    for width in (None, jnp.asarray([0.3])):
        of_multipliers, of_velocity = law_blocks(kinds, scale, λ, u, live, width)
        law = functools.partial(laws, kinds, scale, live=live, width=width)
        jacobians = jax.jacobian(law, (0, 1))(λ, u)
        e, f = dense(of_multipliers, n), dense(of_velocity, n)
        np.testing.assert_allclose(e, jacobians[0], atol=1e-12)
        np.testing.assert_allclose(f, jacobians[1], atol=1e-12)
        weights = jnp.asarray(kinds.by_contact(jnp.asarray(random.uniform(1, 2, n))))
        whole = of_multipliers.plus(of_velocity.scaled(weights), 0.1)
        b = e + f * np.asarray(weights) + 0.1 * np.eye(n)
        np.testing.assert_allclose(dense(whole, n), b, atol=1e-12)
        pulled = np.stack([np.asarray(whole.pull(x)) for x in jnp.eye(n)], axis=1)
        np.testing.assert_allclose(pulled, b.T, atol=1e-12)
        np.testing.assert_allclose(dense(whole.inverse(), n), np.linalg.inv(b), atol=1e-10)
        np.testing.assert_allclose(dense(whole @ of_multipliers, n), b @ e, atol=1e-12)
        acts = random.random(n) < 0.5
        np.testing.assert_allclose(dense(whole.masked(acts), n), acts[:, None] * b, atol=1e-12)


@dims
@pytest.mark.parametrize("limbs", [False, True])
def test_the_slope_of_a_solution_is_inverted_along_the_joints(dim, limbs):
    """(E + F (G + C + R))⁻¹ and its transpose, where contacts stick, slide and are open."""
    system, state = biped(dim, limbs=limbs)
    state = begun(system, SWEEPS, state)
    space, mass, joints, rows, bounds = space_of(system, state)
    kinds, n, random = bounds.kinds, len(rows), np.random.default_rng(2)
    _, sizes, basis = np.linalg.svd(joints)
    basis = basis[np.sum(sizes > 1e-10) :].T
    g = H * rows @ basis @ np.linalg.solve(basis.T @ mass @ basis, basis.T @ rows.T)
    scale = np.asarray(kinds.largest(jnp.asarray(np.maximum(np.diag(g), 1e-9))))
    λ = jnp.asarray(np.where(random.random(n) < 0.3, 0, random.uniform(-1, 2, n)))
    u = jnp.asarray(0.3 * scale * random.normal(size=n))
    live = (bounds.lower, bounds.upper, (bounds.friction, *bounds.resistance))
    compliance = np.where(np.arange(n) < kinds.starts[0], 0.1 * scale, 0)
    movable = np.diag(g) > 1e-12
    numbers = jnp.asarray(compliance), jnp.asarray(movable), jnp.asarray(H)
    down, up = inverses(space, kinds, jnp.asarray(scale), *numbers, live, None, λ, u)
    e, f = (dense(x, n) for x in law_blocks(kinds, jnp.asarray(scale), λ, u, live, None))
    f = movable[:, None] * f
    eps = np.finfo(float).eps
    slope = e + f @ (g + np.diag(compliance + eps**0.4 * scale)) + eps**0.75 * np.eye(n)
    assert np.linalg.matrix_rank(f) > 0.2 * n
    right = random.normal(size=n)
    for operator, matrix in ((down, slope), (up, slope.T)):
        found = np.asarray(operator(jnp.asarray(right)))
        np.testing.assert_allclose(matrix @ found, right, atol=1e-5 * np.abs(found).max())


@dims
@pytest.mark.parametrize("limbs", [False, True])
def test_a_fall_is_that_of_many_sweeps(dim, limbs):
    """The two legs land, slide, roll and meet their stops, and each other with `limbs`.

    The two differ by the drift φ of the joints, which the tree of bodies does not see.
    """
    system, state = biped(dim, limbs=limbs)
    finals = []

    def rolled(s, method, steps):
        def record(s, info):
            return s.v, info.reactions.multipliers

        return jc.rollout(system, method, s, None, H, steps, record=record)

    for method in (SWEEPS, NEWTON):
        start = begun(system, method, state)
        final, (v, λ) = jax.jit(rolled, static_argnums=(1, 2))(start, method, 150)
        assert final.status == 0
        finals.append((np.asarray(v), np.asarray(λ)))
    (v, λ), (w, μ) = finals
    # stops, joint friction and feet act; few of the rows between limbs do
    assert (np.abs(λ) > 1e-6).any(axis=0).mean() > (0.3 if limbs else 0.4)
    first = np.flatnonzero(np.abs(λ).max(axis=1))[0]
    np.testing.assert_allclose(w[: first + 20], v[: first + 20], atol=2e-6)
    np.testing.assert_allclose(w, v, atol=1e-4)


@pytest.mark.parametrize(
    ("dim", "dtype", "touching"), [(2, jnp.float64, True), (3, jnp.float32, False)]
)
def test_a_batch_moves_like_its_worlds(dim, dtype, touching):
    system, state = scissors(dim, dtype, touching)
    method = jc.Method(contact_solver=jc.solvers.Newton())
    starts = [begun(system, method, state, seed=seed) for seed in range(5)]

    def run(s):
        return jc.rollout(system, method, s, None, H, 60, record=lambda s, i: None)[0]

    together = jax.jit(jax.vmap(run))(jax.tree.map(lambda *x: jnp.stack(x), *starts))
    assert (together.status == 0).all()
    assert together.q.dtype == dtype
    tight = 2e-3 if dtype == jnp.float32 else 1e-9
    alone = jax.jit(run)
    for i, start in enumerate(starts[:2]):
        np.testing.assert_allclose(together.v[i], alone(start).v, atol=tight)


@pytest.mark.parametrize(("dim", "touching"), [(2, False), (3, True)])
def test_gradients_are_differences(dim, touching):
    """Checks a gradient of a rollout in which each row acts in all steps or in none.

    Where a contact begins, the drift of the joints is an error of the laws and of the gradient.
    """
    system, state = scissors(dim, touching=touching)

    def loss(scale):
        start = begun(system, NEWTON, state, seed=1)
        start = jc.init(system, NEWTON, start.q, scale * start.v)
        final, λ = jc.rollout(system, NEWTON, start, None, H, 40, record=multipliers)
        return jnp.sum(final.q**2), λ

    def multipliers(s, info):
        return info.reactions.multipliers

    both = jax.jit(jax.value_and_grad(loss, has_aux=True))
    eps = 1e-6
    ((up, _), _), ((down, _), _) = (both(1.0 + sign * eps) for sign in (1, -1))
    (_, λ), gradient = both(1.0)
    assert (np.abs(λ) > 1e-6).any(axis=0).mean() > 0.6
    np.testing.assert_allclose(gradient, (up - down) / (2 * eps), rtol=1e-6)


def test_a_world_with_a_parameter_that_is_no_number_stops_alone():
    system, state = biped(2)
    state = begun(system, NEWTON, state)
    states = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    broken = states.v.at[0, 0].set(jnp.nan)
    states = dataclasses.replace(states, v=broken)
    new = jax.jit(jax.vmap(lambda s: jc.step(system, NEWTON, s, None, H)[0]))(states)
    assert new.status[0] != 0
    assert new.status[1] == 0


def test_it_is_the_default_for_robots_on_the_floor():
    system, state = biped(3)
    assert isinstance(default_contact_solver(system, state.q, state.v), jc.solvers.Newton)


def test_joints_that_a_penalty_makes_soft_take_sweeps():
    system, state = biped(2)
    penalty = jc.stabilizers.Penalty.from_time(0.01)
    ends = []
    for solver in (jc.solvers.Newton(), jc.solvers.GaussSeidel()):
        method = jc.Method(stabilizer=penalty, contact_solver=solver)
        start = begun(system, method, state)
        ends.append(jc.rollout(system, method, start, None, H, 40, record=lambda s, i: None)[0].q)
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-12)


def test_a_welded_body_and_separate_trees_move_as_by_sweeps():
    """A joint without freedom, bodies of their own, and a body hinged to the world."""
    scene = jc.Scene(dim=3)
    moments = (0.02, 0.03, 0.04)
    for i, x in enumerate((0.0, 1.0, 2.0, 3.0)):
        scene.add_body(f"{i}", mass=1.0 + i, inertia=moments, position=(x, 0.0, 0.105))
        corners = np.array([(x + a, b, 0.0) for a in (-0.1, 0.1) for b in (-0.1, 0.1)])
        scene.add(jc.PlaneContact(f"floor {i}", jc.WORLD, f"{i}", center=corners, friction=0.4))
    scene.add_body("load", mass=0.5, inertia=moments, position=(0.0, 0.0, 0.3))
    scene.add(jc.joints.Fixed("weld", "0", "load"))
    scene.add(jc.Revolute("hinge", jc.WORLD, "3", point=(3.2, 0.0, 0.1), axis=(0.0, 1.0, 0.0)))
    scene.add(jc.joints.Armature("rotor", "hinge", 0.05))
    system, state = scene.build()
    ends = []
    for method in (SWEEPS, NEWTON):
        v = state.v.at[:5].set(1.0).at[10:15].set(-0.2)
        start = jc.init(system, method, state.q, v)
        ends.append(jc.rollout(system, method, start, None, H, 60, record=lambda s, i: None)[0])
        assert ends[-1].status == 0
    np.testing.assert_allclose(ends[1].q, ends[0].q, atol=1e-6)
    equations = linearize(system, state.q, state.v, state.time)
    bounds = linearize_bounds(system, state.q, state.v, state.time, None, jnp.asarray(H))
    tree = tree_below(system, equations.jacobian, equations.layout, bounds)
    assert sorted(x.freedom for x in tree.branches) == [0, 1, 6]


def test_bodies_that_cannot_move_and_steps_of_no_length_have_finite_reactions():
    scene = jc.Scene(dim=2)
    scene.add_body("post", mass=1.0, inertia=0.1, position=(0.0, 0.1))
    scene.add(jc.joints.Fixed("weld", jc.WORLD, "post"))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "post", radius=0.1, friction=0.5))
    system, state = scene.build()
    for h in (H, 0.0):
        new, info = jc.step(system, NEWTON, jc.init(system, NEWTON, state.q, state.v), None, h)
        assert new.status == 0
        assert np.isfinite(info.reactions.residual)


def test_a_bounce_moves_all_bodies_of_a_mechanism():
    """A foot bounces on the floor, and a hinge carries the impact to another body.

    Neither `Newton` nor an `ActiveSet`, whose second foot is far away, solves for each row alone.
    """
    scene = jc.Scene(dim=2)
    scene.add_body("a", mass=1.0, inertia=0.02, position=(0.0, 0.3))
    scene.add_body("b", mass=1.0, inertia=0.02, position=(0.3, 0.3))
    scene.add(jc.Revolute("hinge", "a", "b", point=(0.15, 0.3)))
    for name, center in (("foot", (0.05, 0.105)), ("far", (0.0, 1.0))):
        bouncy = {"radius": 0.1, "center": center, "friction": 0.3, "restitution": 0.4}
        scene.add(jc.PlaneContact(name, jc.WORLD, "a", **bouncy))
    system, state = scene.build()
    some = jc.solvers.ActiveSet(jc.solvers.InteriorPoint(), contacts=1)
    ends = []
    for method in (SWEEPS, NEWTON, jc.Method(contact_solver=some)):
        start = jc.init(system, method, state.q, state.v.at[2:4].set(-2.0))
        ends.append(jc.rollout(system, method, start, None, H, 6, record=lambda s, i: None)[0])
    assert abs(ends[0].v[5]) > 1  # the impact turns the body that does not touch the floor
    for end in ends[1:]:
        np.testing.assert_allclose(end.v, ends[0].v, atol=1e-9)


def test_the_rows_of_a_disc_have_one_inverse_mass():
    """An arm that turns about x cannot move its tip along x, but along the other tangent."""
    scene = jc.Scene(dim=3)
    scene.add_body("arm", mass=0.01, inertia=(1e-4, 1e-4, 1e-4), position=(0.0, 0.0, 0.1))
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, -0.2, 0.1), axis=(1.0, 0.0, 0.0)))
    scene.add(jc.joints.Armature("rotor", "hinge", 1e-4))
    tip = {"center": (0.0, 0.2, 0.0), "friction": 0.5, "rolling": 1e-3}
    scene.add(jc.PlaneContact("tip", jc.WORLD, "arm", **tip))
    system, state = scene.build()
    space, _, _, rows, bounds = space_of(system, state)
    n, solver = len(rows), NEWTON.contact_solver
    bare, h = jnp.sum(jnp.asarray(rows) ** 2, axis=1), jnp.asarray(H)
    none = jnp.zeros(n)
    _, mass, movable, _ = newton.multipliers(space, bounds, none, none, None, bare, h, solver)
    assert not movable.all()
    for disc in bounds.kinds.split(mass).discs:
        np.testing.assert_array_equal(disc[0], disc[1])


def test_contacts_between_free_bodies_move_as_by_sweeps():
    """Three balls in a row collide with friction: no joints, and each contact between two trees."""
    scene = jc.Scene(dim=3)
    for i in range(3):
        position = (0.02 * i, 0.0, 0.21 * i)
        scene.add_body(f"{i}", mass=1.0 + i, inertia=(0.1, 0.1, 0.1), position=position)
    for i in range(2):
        touch = jc.contacts.CapsuleContact
        radii = {"radius_a": 0.1, "radius_b": 0.1, "friction": 0.5}
        scene.add(touch(f"touch {i}", f"{i}", f"{i + 1}", **radii))
    system, state = scene.build()
    ends = []
    for method in (SWEEPS, NEWTON):
        start = jc.init(system, method, state.q, state.v.at[8].set(-1.0).at[0].set(0.3))
        ends.append(jc.rollout(system, method, start, None, H, 60, record=lambda s, i: None)[0])
    assert abs(ends[0].v[6]) > 0.1  # the impact passes through
    np.testing.assert_allclose(ends[1].v, ends[0].v, atol=1e-6)


def test_after_an_impact_the_next_step_starts_without_its_impulse():
    """A block slides to a stop with restitution, another rests on two feet beside it."""
    scene = jc.Scene(dim=2)
    scene.add_body("block", mass=3.0, inertia=0.1, position=(0.0, 0.1))
    feet = np.array([(-0.2, 0.0), (0.2, 0.0)])
    scene.add(jc.PlaneContact("feet", jc.WORLD, "block", center=feet, friction=0.5))
    scene.add_body("slider", mass=1.0, inertia=0.1, position=(0.0, 0.4))
    scene.add(jc.Prismatic("rail", "block", "slider", point=(0.0, 0.4), axis=(1.0, 0.0)))
    scene.add(jc.contacts.Limit("stop", "rail", upper=0.1, restitution=0.5))
    system, state = scene.build()
    method = jc.Method(contact_solver=jc.solvers.Newton(iterations=1))
    calm = jc.Method(contact_solver=jc.solvers.Newton())
    state = jc.init(system, calm, state.q, state.v.at[1].set(2.0))
    step = jax.jit(jc.step)
    hits = []
    for _ in range(60):
        state, info = step(system, calm, state, None, H)
        hits.append(abs(float(info.reactions["stop"][0])))
        if hits[-1] > 100:  # an impulse over h
            break
    assert hits[-1] > 100
    λ = state.memory.contact_multipliers
    assert np.abs(λ).max() < 50
    _, info = step(system, method, state, None, H)
    assert info.reactions.residual < 1e-2


def test_a_derivative_of_newton_starts_from_its_solution_and_one_of_sweeps_does_not():
    system, state = biped(2)

    def natives(jaxpr):
        for equation in jaxpr.eqns:
            if equation.primitive is native_p:
                yield equation.params["fun"]

    for solver, expected in ((jc.solvers.Newton(), True), (jc.solvers.GaussSeidel(), False)):
        method = jc.Method(contact_solver=solver)
        start = jc.init(system, method, state.q, state.v)
        closed = jax.make_jaxpr(lambda s, m=method: jc.step(system, m, s, None, H)[0])(start)
        (native,) = natives(closed.jaxpr)
        assert (native.guess is not None) == expected


@pytest.mark.parametrize(
    ("name", "dtype", "most"),
    [
        ("column", "float64", 0),  # the topmost block is a thousand times heavier
        ("chain", "float64", 0.01),
        ("box", "float64", 0.02),
        ("chain", "float32", 0.02),
        ("box", "float32", 0.03),
    ],
)
def test_random_states_meet_the_laws_to_rounding(name, dtype, most):
    """All but a few of the worlds; those take more iterations than a step has."""
    solver = jc.solvers.Newton(tolerance=1e-6 if dtype == "float32" else 1e-10)
    beyond = study.beyond(study.measure(name, jnp.dtype(dtype), solver, 400), dtype)
    assert max(beyond.complementarity, beyond.cone, beyond.separation) <= most * 400
    assert beyond.energy == 0
