"""The saddle system of trees of bodies, eliminated along the joints."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

import jaxcon as jc
from jaxcon.constraints.base import Joints, blocks_of
from jaxcon.constraints.joint_trees import tree_equations
from jaxcon.constraints.rows import linearize, saddle
from jaxcon.contact.body_space import tree_below
from jaxcon.contact.rows import linearize_bounds
from jaxcon.core.lanes import Vector
from jaxcon.core.status import Status
from jaxcon.execution.shell import has_user_parts
from jaxcon.linear.articulated import Reflections
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.tree_equations import TreeEquations

H = 2e-3
dims = pytest.mark.parametrize("dim", [2, 3])


def trees(dim, dtype=jnp.float64, contact=True):
    """Three trees with all that may differ: sides of joints, depths, welds, rotors, a free body."""

    def at(x, z):
        return (x, z) if dim == 2 else (x, 0.2 * x, z)

    scene = jc.Scene(dim=dim, dtype=dtype)
    moments = 0.03 if dim == 2 else (0.03, 0.04, 0.05)
    for i in range(8):
        place = at(0.4 * i, 0.5 + 0.1 * (i % 3))
        scene.add_body(f"{i}", mass=1.0 + 0.3 * i, inertia=moments, position=place)
    hinge = {} if dim == 2 else {"axis": (0.2, 1.0, 0.1)}
    slide = {"axis": at(1.0, 0.3)}
    scene.add(jc.Revolute("a", "0", "1", point=at(0.2, 0.6), **hinge))
    scene.add(jc.Revolute("b", "2", "1", point=at(0.6, 0.5), **hinge))  # the child comes first
    scene.add(jc.Revolute("c", "2", "3", point=at(1.0, 0.6), **hinge))
    scene.add(jc.Prismatic("d", "4", "0", point=at(1.6, 0.5), **slide))
    scene.add(jc.joints.Fixed("weld", "3", "5"))
    scene.add(jc.Revolute("e", "6", jc.WORLD, point=at(2.2, 0.5), **hinge))
    for i, joint in enumerate("abde"):
        scene.add(jc.joints.Armature(f"rotor {joint}", joint, 0.05 + 0.1 * i))
    if contact:
        scene.add(jc.PlaneContact("floor", jc.WORLD, "7", radius=0.1, friction=0.4))
    return scene.build()


def equations_of(system, q, v):
    """Returns the saddle system with random right-hand sides, and its equations along the tree."""
    random, t = np.random.default_rng(1), jnp.zeros((), q.dtype)
    rows = linearize(system, q, v, t)
    f, b = (jnp.asarray(random.normal(size=len(x)), q.dtype) for x in (v, rows.bias))
    equations = saddle(system, q, rows, f, b)
    bounds = linearize_bounds(system, q, v, t, None, jnp.asarray(H, q.dtype))
    tree = tree_below(system, equations.jacobian, equations.layout, bounds)
    assert tree is not None
    return equations, tree_equations(system, q, v, tree, equations)


def dense_solution(equations):
    """Returns a and λ by dense algebra."""
    m, j = np.asarray(equations.mass.dense()), np.asarray(equations.jacobian.dense())
    n = len(m)
    matrix = np.block([[m, -j.T], [j, np.diag(np.asarray(equations.compliance))]])
    x = np.linalg.solve(matrix, np.r_[equations.force, equations.target])
    return x[:n], x[n:]


@dims
def test_it_is_the_solution_of_dense_algebra(dim):
    system, state = trees(dim)
    equations, factored = equations_of(system, state.q, state.v)
    a, λ, status = factored.solver(equations)(equations.force, equations.target)
    assert status == Status.OK
    for found, expected in zip((a, λ), dense_solution(equations), strict=True):
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * scale)


@dims
def test_a_drift_of_the_joints_leaves_an_error_of_its_square(dim):
    system, state = trees(dim)
    errors = []
    for size in (1e-4, 1e-5):
        shift = size * np.random.default_rng(0).normal(size=len(state.q))
        q = system.normalize(state.q + jnp.asarray(shift))
        equations, factored = equations_of(system, q, state.v)
        a, _, _ = factored.solver(equations)(equations.force, equations.target)
        expected = dense_solution(equations)[0]
        errors.append(np.abs(a - expected).max() / np.abs(expected).max())
    assert errors[0] < 1e-6
    assert errors[1] < 2e-2 * errors[0]


@dims
def test_a_step_in_single_precision_is_that_of_dense_matrices(dim):
    """Also where other numbers of the process are in double precision."""
    system, state = trees(dim, jnp.float32)
    ends = []
    for solver in (jc.solvers.RankSafe(), jc.solvers.Dense()):
        method = jc.Method(solver=solver, contact_solver=jc.solvers.Newton())
        start = jc.init(system, method, state.q, state.v + 0.1)
        new, info = jax.jit(jc.step)(system, method, start, None, H)
        assert new.v.dtype == jnp.float32
        assert new.status == 0
        ends.append((new.v, info.multipliers))
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=2e-5)
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=2e-4 * np.abs(ends[1][1]).max())


@dims
def test_gradients_of_joint_forces_are_differences(dim):
    """λ of joints and rotors, and the new v, are differentiated by q and v."""
    system, state = trees(dim)
    method = jc.Method(solver=jc.solvers.Sparse(), contact_solver=jc.solvers.Newton())
    start = jc.init(system, method, state.q, state.v + 0.3)

    def loss(x):
        q, v = jnp.split(x, [len(start.q)])
        new, info = jc.step(system, method, dataclasses.replace(start, q=q, v=v), None, H)
        weights = jnp.cos(jnp.arange(len(info.multipliers), dtype=q.dtype))
        return weights @ info.multipliers + jnp.sum(new.v**2)

    both = jax.jit(jax.value_and_grad(loss))
    x = jnp.concatenate([start.q, start.v])
    gradient, eps = both(x)[1], 1e-5
    for seed in range(4):
        way = jnp.asarray(np.random.default_rng(seed).normal(size=len(x)))
        (up, _), (down, _) = (both(x + sign * eps * way) for sign in (1, -1))
        np.testing.assert_allclose(gradient @ way, (up - down) / (2 * eps), rtol=1e-6)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_robots_without_contact_move_as_by_dense_matrices(dtype, monkeypatch):
    """Two worlds of a batch, by Runge and Kutta's method; λ and the new v."""
    system, state = trees(3, dtype, contact=False)
    factored, solver = [], TreeEquations.solver

    def noted(equations, saddle):
        factored.append(equations)
        return solver(equations, saddle)

    monkeypatch.setattr(TreeEquations, "solver", noted)
    rows = linearize(system, state.q, state.v, state.time)
    joints = np.asarray(rows.jacobian.dense(), float)[np.asarray(rows.layout.holds)]
    speeds = np.random.default_rng(0).normal(size=(2, len(state.v)))
    speeds = jnp.asarray(speeds - speeds @ np.linalg.pinv(joints) @ joints, dtype)  # held by joints
    ends, used = [], []
    for linear_solver in (jc.solvers.RankSafe(), jc.solvers.Dense()):
        method = jc.Method(jc.RK4(), solver=linear_solver)

        def stepped(v, method=method):
            new, info = jc.step(system, method, dataclasses.replace(state, v=v), None, H)
            return new.v, info.multipliers, new.status

        *numbers, status = jax.jit(jax.vmap(stepped))(speeds)
        assert (status == 0).all()
        ends.append(numbers)
        used.append(len(factored))
    assert 0 < used[0] == used[1]  # by the first method alone
    tight = 1e-4 if dtype == jnp.float32 else 1e-10
    for found, expected in zip(*ends, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=tight * np.abs(expected).max())


def hinges(count, rotor):
    """A chain of hinges in space, of which the first may have a rotor."""
    scene = jc.Scene(dim=3)
    for i in range(count):
        scene.add_body(f"{i}", mass=1.0, inertia=(0.1, 0.2, 0.3), position=(float(i), 0, 0))
        parent = str(i - 1) if i else jc.WORLD
        ends = {"point": (i - 0.5, 0, 0), "axis": (0, 1.0, 0.2 * i)}
        scene.add(jc.Revolute(f"hinge {i}", parent, f"{i}", **ends))
    if rotor:
        scene.add(jc.joints.Armature("rotor", "hinge 0", 0.1))
    return scene.build()


def test_gradients_without_contact_are_differences():
    system, state = hinges(2, rotor=True)

    def loss(x):
        q, v = jnp.split(x, [len(state.q)])
        moved = dataclasses.replace(state, q=q, v=v)
        new, info = jc.step(system, jc.Method(), moved, None, H)
        weights = jnp.cos(jnp.arange(len(info.multipliers), dtype=q.dtype))
        return weights @ info.multipliers + jnp.sum(new.v**2)

    both = jax.jit(jax.value_and_grad(loss))
    x = jnp.concatenate([state.q, state.v + 0.3])
    gradient, eps = both(x)[1], 1e-5
    for seed in range(3):
        way = jnp.asarray(np.random.default_rng(seed).normal(size=len(x)))
        (up, _), (down, _) = (both(x + sign * eps * way) for sign in (1, -1))
        np.testing.assert_allclose(gradient @ way, (up - down) / (2 * eps), rtol=1e-6)


def test_chains_and_planar_scenes_without_contact_keep_their_factors(monkeypatch):
    def refused(*_):
        raise AssertionError("the joints were eliminated along the tree")

    monkeypatch.setattr(TreeEquations, "solver", refused)
    system, state = trees(2, contact=False)
    assert jc.step(system, jc.Method(), state, None, H)[0].status == 0
    for rotor in (False, True):
        system, state = hinges(3, rotor)
        if not rotor:
            assert jc.step(system, jc.Method(), state, None, H)[0].status == 0
            continue
        with pytest.raises(AssertionError, match="along the tree"):
            jc.step(system, jc.Method(), state, None, H)


@pytest.mark.parametrize(("rows", "size"), [(1, 3), (2, 3), (5, 6), (6, 6)])
def test_reflections_invert_the_rows(rows, size):
    random = np.random.default_rng(rows)
    given, b = random.normal(size=(rows, size, 3)), random.normal(size=(rows, 3))
    factored = Reflections([Vector(*jnp.asarray(x)) for x in given], size)
    assert not factored.dependent.any()
    x = np.stack(factored.least([*jnp.asarray(b)]))
    λ = random.normal(size=(rows, 3))
    back = factored.coefficients(Vector(*jnp.asarray(np.einsum("rsw,rw->sw", given, λ))))
    np.testing.assert_allclose(np.stack(back), λ, atol=1e-12)
    for w in range(3):
        expected = np.linalg.lstsq(given[..., w], b[:, w], rcond=None)[0]
        np.testing.assert_allclose(x[:, w], expected, atol=1e-12)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_only_dependent_rows_are_dependent_whatever_the_unit_of_length(unit):
    """Rows of a hinge at (unit, 2 unit, 0) about the z axis, in single precision."""
    x, y = unit, 2 * unit
    rows = [(0, 0, -y, 1, 0, 0), (0, 0, x, 0, 1, 0), (y, -x, 0, 0, 0, 1), (1, 0, 0, 0, 0, 0)]
    for last, expected in (((0, 1, 0, 0, 0, 0), False), ((1, 0, 0, 0, 0, 0), True)):
        given = [Vector(*(jnp.full(1, c, jnp.float32) for c in row)) for row in (*rows, last)]
        assert Reflections(given, 6).dependent.all() == expected


def test_rows_of_numbers_keep_the_dtype_of_the_others():
    """An angular row before a linear one, in single precision beside double precision."""
    rows = [Vector(1.0, 0.0, 0.0), Vector(jnp.ones(2, jnp.float32), 0.0, 1.0)]
    factored = Reflections([row.map(jnp.float32) if i else row for i, row in enumerate(rows)], 3)
    assert all(x.dtype == jnp.float32 for x in factored.least([jnp.ones(2, jnp.float32)] * 2))


def test_deep_trees_in_single_precision_keep_their_factors(monkeypatch):
    def refused(*_):
        raise AssertionError("the joints were eliminated along the tree")

    monkeypatch.setattr(TreeEquations, "solver", refused)
    for links in (12, 14):
        scene = jc.Scene(dim=2, dtype=jnp.float32)
        for i in range(links):
            scene.add_body(f"{i}", mass=1.0, inertia=0.1, position=(float(i), 0.2))
            parent = str(i - 1) if i else jc.WORLD
            scene.add(jc.Revolute(f"hinge {i}", parent, f"{i}", point=(i - 0.5, 0.2)))
        scene.add(jc.PlaneContact("floor", jc.WORLD, "3", radius=0.1))
        system, state = scene.build()
        method = jc.Method(contact_solver=jc.solvers.Newton())
        start = jc.init(system, method, state.q, state.v)
        if links == 14:
            assert jc.step(system, method, start, None, H)[0].status == 0
            continue
        with pytest.raises(AssertionError, match="along the tree"):
            jc.step(system, method, start, None, H)


def test_a_body_without_mass_is_singular():
    for mass in (0.0, -1.0):
        scene = jc.Scene(dim=2, dtype=jnp.float32)
        scene.add_body("a", mass=1.0, inertia=0.1)
        scene.add_body("b", mass=1.0, inertia=0.1, position=(1.0, 0.0))
        scene.add(jc.Revolute("hinge", "a", "b", point=(0.5, 0.0)))
        scene.add(jc.PlaneContact("floor", jc.WORLD, "a", radius=0.1))
        system, state = scene.build()
        method = jc.Method(contact_solver=jc.solvers.Newton())

        def status(mass, system=system, method=method, state=state):
            changed = system.with_params({"b": {"mass": mass}})
            start = jc.init(system, method, state.q, state.v)
            return jc.step(changed, method, start, None, H)[0].status

        assert jax.jit(status)(jnp.float32(mass)) == Status.SINGULAR


@pytest.mark.parametrize(
    "parts",
    [
        {"solver": jc.solvers.Schur()},
        {"solver": jc.solvers.Sparse(tikhonov=1e-8)},
        {"solver": jc.solvers.RankSafe(always=True)},
        {"stabilizer": jc.stabilizers.Unstabilized()},
        {"stabilizer": jc.stabilizers.Unstabilized(), "recovery": jc.stabilizers.Recovery()},
    ],
)
def test_other_solvers_and_motions_without_feedback_keep_their_factors(parts, monkeypatch):
    def refused(*_):
        raise AssertionError("the joints were eliminated along the tree")

    monkeypatch.setattr(TreeEquations, "solver", refused)
    system, state = trees(2)
    method = jc.Method(contact_solver=jc.solvers.Newton(), **parts)
    start = jc.init(system, method, state.q, state.v)
    assert jc.step(system, method, start, None, H)[0].status == 0
    other = jc.Method(contact_solver=jc.solvers.Newton(), integrator=jc.RK4())
    start = jc.init(system, other, state.q, state.v)
    with pytest.raises(AssertionError, match="along the tree"):
        jc.step(system, other, start, None, H)


SIDES = [*scenes.parts(2, "between"), *scenes.parts(3, "between")]


@pytest.mark.parametrize("name", SIDES)
def test_relative_joints_do_not_resist_a_common_motion(name):
    built = scenes.build(name)
    system, q = built.system, built.state.q
    joints = [x for x in system.constraints if isinstance(x, Joints)]
    assert all(x.relative for x in joints)

    def rates(v):
        snapshot = system.snapshot(q, v, 0.0)
        rows = [tuple(blocks_of(system, x.places, x.rows(snapshot), 0)) for x in joints]
        shapes = [(x[0].shape[0] * x[0].shape[1], len(v)) for x in rows if x]
        held = [x for x in rows if x]
        return [Jacobian(*x).apply(v) for x in zip(held, shapes, strict=True)]

    def common_motion():
        frame = system.snapshot(q, built.off.v, 0.0).frames[0]
        x, ẋ = frame.position, Vector(0.3, -0.5, 0.7)
        if len(x) == 2:
            return Vector(ẋ[0] - 0.9 * x[1], ẋ[1] + 0.9 * x[0], 0.9).stack().ravel()
        ω = Vector(0.2, 0.9, -0.4)
        return Vector(*(ẋ + ω.cross(x)), *(frame.rotation.T @ ω)).stack().ravel()

    for any_rates, common in zip(rates(built.off.v), rates(common_motion()), strict=True):
        assert np.abs(any_rates).max() > 1e-2
        np.testing.assert_allclose(common, 0, atol=1e-12)


@dataclasses.dataclass(frozen=True)
class Counterweight(jc.extend.Joint):
    """A joint of a user's own: as one body sinks, the other rises on the same vertical line."""

    def attach(self, a, b):
        return {"sum": a.position[2] + b.position[2], "anchor_a": 0 * a.position}

    @staticmethod
    def rows(p, a, b):
        at_a, at_b = a.point(p["anchor_a"]), b.point(p["anchor_a"])
        up = Vector(0.0, 0.0, 1.0)
        height = jc.extend.Row(
            at_a.position[2] + at_b.position[2] - p["sum"],
            at_a.velocity[2] + at_b.velocity[2],
            at_a.bias[2] + at_b.bias[2],
            (at_a.pull(up), at_b.pull(up)),
        )
        return [*jc.extend.meet(at_a, at_b)[:2], height]


@pytest.mark.parametrize("contact", [False, True])
def test_joints_of_a_user_are_not_eliminated_along_the_tree(contact):
    """Without contact and with `Newton`; a common motion of both bodies changes the rows."""
    scene = jc.Scene(dim=3)
    for i, x in enumerate((0.5, 2.0, 2.0)):
        size = {"mass": 1.0 + i, "inertia": (0.03, 0.04, 0.05)}
        scene.add_body(f"{i}", position=(x, 0.0, 1.0 + i), **size)
    scene.add(jc.Revolute("hinge", jc.WORLD, "0", point=(0, 0, 1), axis=(0, 1, 0)))
    scene.add(jc.joints.Armature("rotor", "hinge", 0.3))
    scene.add(Counterweight("cable", "1", "2"))
    if contact:
        scene.add(jc.PlaneContact("floor", jc.WORLD, "0", radius=0.99999, friction=0.4))
    system, state = scene.build()
    ends = []
    for solver in (jc.solvers.RankSafe(), jc.solvers.Dense()):
        method = jc.Method(solver=solver, contact_solver=jc.solvers.Newton())
        start = jc.init(system, method, state.q, state.v)
        ends.append(jax.jit(jc.step)(system, method, start, None, H))
    (new, info), (expected, other) = ends
    assert new.status == expected.status == 0
    assert has_user_parts(system, jc.Method())  # its rows may take derivatives
    # Atwood's machine: v = h g (m₂ − m₁) / (m₁ + m₂)
    heights = np.asarray(new.v).reshape(6, 3)[2]
    np.testing.assert_allclose(heights[1:], [H * 9.81 / 5, -H * 9.81 / 5], rtol=1e-6)
    np.testing.assert_allclose(new.v, expected.v, atol=1e-12)
    np.testing.assert_allclose(info.multipliers, other.multipliers, atol=1e-9)


class OwnRows:
    """Rows of a user's own."""

    @staticmethod
    def rows(p, a, b):
        return jc.Revolute.rows(p, a, b)


class OwnCoordinate(jc.Revolute):
    """A joint of the library with a coordinate of a user's own."""

    @staticmethod
    def coordinate(name, p, a, b):
        return jc.Revolute.coordinate(name, p, a, b)


class Mixed(OwnRows, jc.Revolute):
    """A joint of the library with rows from another class."""


class Said(OwnRows, jc.Revolute):
    """As above, and says that they depend on relative motion only."""

    relative = True


class Renamed(Said):
    """A joint with all that `Said` has."""


def test_only_the_class_that_defines_rows_says_on_what_they_depend():
    assert jc.joints.Spherical.relative  # with the rows of Coincident
    assert [x.relative for x in (jc.extend.Joint, OwnCoordinate, Mixed)] == [False] * 3
    assert [x.relative for x in (Said, Renamed)] == [True] * 2


@dataclasses.dataclass(frozen=True)
class Pin:
    """The rows of a joint whose law is no class of joints."""

    coordinates = {}

    @staticmethod
    def rows(p, a, b):
        return jc.extend.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"]))


class Pinned(jc.joints.Coincident):
    """A joint whose rows a law of its own returns."""

    kind = Pin()


def test_a_law_that_is_no_class_of_joints_is_not_eliminated_along_the_tree():
    scene = jc.Scene(dim=3)
    scene.add_body("0", mass=1.0, inertia=(0.03, 0.04, 0.05), position=(0.5, 0.0, 1.0))
    scene.add(Pinned("pin", jc.WORLD, "0", point=(0, 0, 1)))
    system, state = scene.build()
    (pins,) = system.constraints
    assert not pins.relative
    ends = [
        jc.step(system, jc.Method(solver=solver), state, None, H)[0].v
        for solver in (jc.solvers.RankSafe(), jc.solvers.Dense())
    ]
    np.testing.assert_allclose(*ends, atol=1e-13)
