"""Sparse elimination compared with the dense solver on chains, trees, loops and separate parts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE

import jaxcon as jc
from jaxcon.constraints.rows import linearize, saddle
from jaxcon.linear import graphs, ordering
from jaxcon.linear.saddle import Diagonal, Saddle
from jaxcon.linear.sparse import Sparse


def particles(places, rods, ground=()):
    """Particles joined by rods in pairs, and to the world."""
    scene, random = jc.Scene(dim=2), np.random.default_rng(0)
    for i, place in enumerate(places):
        mass, velocity = random.uniform(0.5, 2.0), random.normal(size=2)
        scene.add_particle(f"p{i}", mass=mass, position=place, velocity=velocity)
    for a, b in rods:
        scene.add(jc.Distance(f"{a}-{b}", f"p{a}", f"p{b}"))
    for a in ground:
        scene.add(jc.Distance(f"{a}", jc.WORLD, f"p{a}", point_a=(a + 0.3, 5.0)))
    return scene.build()


def scatter(n):
    """Returns points along a line with random offsets."""
    return np.column_stack([np.arange(n), np.random.default_rng(1).normal(size=n)])


def links(n, closed):
    """A chain of rigid links in the plane, hung at its start and, if closed, at its end."""
    scene, random = jc.Scene(dim=2), np.random.default_rng(2)
    points = scatter(n + 1)
    for i in range(n):
        scene.add_body(
            f"l{i}",
            mass=random.uniform(0.5, 2.0),
            inertia=random.uniform(0.5, 2.0),
            position=(points[i] + points[i + 1]) / 2,
            angular_velocity=random.normal(),
        )
        a = jc.WORLD if i == 0 else f"l{i - 1}"
        scene.add(jc.Revolute(f"j{i}", a, f"l{i}", point=points[i]))
    if closed:
        scene.add(jc.Revolute("end", f"l{n - 1}", jc.WORLD, point=points[n]))
    return scene.build()


def with_a_global_row(n):
    """A chain of particles, and two rows that each involve all of them."""
    scene, random = jc.Scene(dim=2), np.random.default_rng(7)
    for i, place in enumerate(scatter(n)):
        scene.add_particle(f"p{i}", mass=random.uniform(0.5, 2.0), position=place)
        a = jc.WORLD if i == 0 else f"p{i - 1}"
        scene.add(jc.Distance(f"{i}", a, f"p{i}", **({} if i else {"point_a": (0.0, 5.0)})))
    bodies = tuple(f"p{i}" for i in range(n))

    def centre(*args):
        mean = sum(x.position for x in args[:-2]) / n
        return mean - jnp.array([5.5, 0.0])

    scene.add(jc.joints.Holonomic(centre, bodies, name="centre"))
    return scene.build()


GRAPHS = {
    "one": lambda: particles(scatter(1), [], [0]),
    "two apart": lambda: particles(scatter(2), [], [0, 1]),
    "short chain": lambda: particles(scatter(3), [(0, 1), (1, 2)], [0]),
    "long chain": lambda: particles(scatter(20), [(i, i + 1) for i in range(19)], [0]),
    "chain backwards": lambda: particles(scatter(20), [(i + 1, i) for i in range(19)][::-1], [19]),
    "chain hung at both ends": lambda: particles(
        scatter(12), [(i, i + 1) for i in range(11)], [0, 11]
    ),
    "star": lambda: particles(scatter(7), [(0, i) for i in range(1, 7)], [0]),
    "tree": lambda: particles(scatter(15), [((i - 1) // 2, i) for i in range(1, 15)], [0]),
    "two chains": lambda: particles(
        scatter(16), [(i, i + 1) for i in range(15) if i != 7], [0, 15]
    ),
    "truss": lambda: particles(
        scatter(8), [(i, i + 1) for i in range(7)] + [(i, i + 2) for i in range(6)], [0, 3]
    ),
    "chain that a user's row touches everywhere": lambda: with_a_global_row(12),
    "links": lambda: links(10, False),
    "links in a loop": lambda: links(10, True),
}
every_graph = pytest.mark.parametrize("name", GRAPHS)


def problem(name):
    system, state = GRAPHS[name]()
    rows = linearize(system, state.q, state.v, state.time)
    random = np.random.default_rng(3)
    force = jnp.asarray(random.normal(size=state.v.shape))
    target = jnp.asarray(random.normal(size=rows.bias.shape))
    return saddle(system, state.q, rows, force, target)


WAYS = {
    "runs": Sparse(run=2),
    "some": Sparse(run=4),
    "unrolled": Sparse(run=1000),
    "levels": Sparse(order="levels"),
}


@every_graph
@pytest.mark.parametrize("way", WAYS)
def test_the_solution_is_that_of_the_dense_solver(name, way):
    system = problem(name)
    expected = jc.solvers.Dense().solve(system)
    got = jax.jit(lambda: WAYS[way].solve(system))()
    assert got.status == jc.Status.OK
    np.testing.assert_allclose(got.acceleration, expected.acceleration, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got.multipliers, expected.multipliers, rtol=1e-8, atol=1e-8)


def steps_of(name, **options):
    """Returns the steps of the elimination, each a set of nodes eliminated together."""
    return steps_for(problem(name).jacobian, **options)


def steps_for(jacobian, **options):
    structure = tuple((b.start, b.shape[0], b.columns) for b in jacobian.blocks)
    return ordering.plan(structure, **options).steps


def test_a_row_that_touches_everything_borders_a_run():
    run, *_ = (s for s in steps_of("chain that a user's row touches everywhere") if not is_batch(s))
    assert len(run.nodes) >= 8
    assert [node.size for node in run.border] == [2]


def test_levels_of_a_chain_grow_with_its_logarithm():
    counts = []
    for n in (8, 16, 32):
        system, state = particles(scatter(n), [(i, i + 1) for i in range(n - 1)], [0])
        steps = steps_for(linearize(system, state.q, state.v, state.time).jacobian, order="levels")
        assert all(map(is_batch, steps))
        assert sum(len(step.nodes) for step in steps) == n
        assert max(len(step.nodes) for step in steps) >= n // 2 - 1
        counts.append(len(steps))
    assert max(np.diff(counts)) <= 2  # an end has fewer neighbors, so there may be a level more


def test_levels_beside_a_row_that_touches_everything_grow_with_the_logarithm():
    counts = []
    for n in (16, 32):
        system, state = with_a_global_row(n)
        jacobian = jax.eval_shape(lambda s=system, x=state: linearize(s, x.q, x.v, x.time).jacobian)
        steps = steps_for(jacobian, order="levels")
        assert sum(len(step.nodes) for step in steps) == n + 1
        assert [node.size for node in steps[-1].nodes] == [2]
        counts.append(len(steps))
    assert max(np.diff(counts)) <= 2


@pytest.mark.parametrize("hubs", [0, 1, 3])
def test_rounds_beside_hubs_grow_with_the_logarithm(hubs):
    rounds = []
    for n in (16, 64, 256, 1024):
        graph = {i: {i - 1, i + 1} & set(range(n)) for i in range(n)}
        for hub in range(n, n + hubs):
            graph[hub] = set(graph)
            for node in graph[hub]:
                graph[node].add(hub)
        order, later = graphs.independent_sets(graph)
        level = dict.fromkeys(order, 1)
        for node in order:
            for other in later[node]:
                level[other] = max(level[other], level[node] + 1)
        rounds.append(max(level.values()))
    assert max(np.diff(rounds)) <= 3


def test_levels_beside_a_row_that_touches_everything_solve_it():
    system, state = with_a_global_row(14)
    random = np.random.default_rng(8)
    force, target = (jnp.asarray(random.normal(size=n)) for n in (state.v.size, 16))

    @jax.jit
    def solutions():
        rows = linearize(system, state.q, state.v, state.time)
        problem = saddle(system, state.q, rows, force, target)
        return [solver.solve(problem) for solver in (Sparse(order="levels"), jc.solvers.Dense())]

    (*found, status), (*expected, _) = solutions()
    assert status == jc.Status.OK
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-12 * np.max(np.abs(y)))


def is_batch(step):
    return isinstance(step, ordering.EliminationBatch)


def test_equal_branches_are_eliminated_at_once():
    steps = steps_of("star")
    assert max(len(step.nodes) for step in steps) == 1  # all nodes are neighbors at the center
    legs = steps_of("two chains", run=1000)
    assert len(legs) < 16


@pytest.mark.parametrize("name", ["long chain", "truss", "links in a loop"])
def test_with_compliance(name):
    system = problem(name)
    compliance = jnp.asarray(np.random.default_rng(4).uniform(0, 1, size=system.target.shape))
    system = dataclasses.replace(system, compliance=compliance)
    expected = jc.solvers.Dense().solve(system)
    got = jax.jit(lambda: Sparse().solve(system))()
    np.testing.assert_allclose(got.multipliers, expected.multipliers, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["truss", "links"])
def test_compliance_and_regularisation_are_one_problem(name):
    system = problem(name)
    compliance = jnp.asarray(np.random.default_rng(4).uniform(0, 1, size=system.target.shape))
    system = dataclasses.replace(system, compliance=compliance)
    j, w = system.jacobian.dense(), 1 / system.mass.values
    added = 0.1 * (jnp.einsum("ri,i,ri->r", j, w, j) + compliance)
    expected = jc.solvers.Dense().solve(dataclasses.replace(system, compliance=compliance + added))
    for solver in (jc.solvers.Sparse, jc.solvers.Schur, jc.solvers.ConjugateGradients):
        got = jax.jit(lambda s=solver: s(tikhonov=0.1).solve(system))()
        np.testing.assert_allclose(got.multipliers, expected.multipliers, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("way", WAYS)
def test_a_system_may_be_an_argument_of_a_compiled_function(way):
    system = problem("tree")
    got = jax.jit(WAYS[way].solve)(system)
    np.testing.assert_allclose(
        got.multipliers, jc.solvers.Dense().solve(system).multipliers, rtol=1e-9
    )


@pytest.mark.parametrize("name", ["tree", "links in a loop"])
def test_its_gradient_is_that_of_the_dense_solver(name):
    system = problem(name)
    random = np.random.default_rng(5)
    weights = [jnp.asarray(random.normal(size=x.shape)) for x in (system.force, system.target)]

    blocks = [block.value for block in system.jacobian.blocks]

    def spread(block, x):
        return jnp.broadcast_to(x, block.shape[1:])

    def value(solver, mass, force, target, scale):
        """Returns a value by numbers of the system and a factor of each Jacobian block."""
        scaled = [
            dataclasses.replace(block, value=tuple(row * spread(block, x) for row in value))
            for block, value, x in zip(system.jacobian.blocks, blocks, scale, strict=True)
        ]
        jacobian = dataclasses.replace(system.jacobian, blocks=tuple(scaled))
        changed = Saddle(Diagonal(mass), force, jacobian, target)
        a, multipliers, _ = solver.solve(changed)
        return weights[0] @ a + weights[1] @ multipliers

    numbers = (system.mass.values, system.force, system.target, jnp.ones(len(blocks)))
    ours, dense = (
        jax.jit(jax.grad(lambda *x, s=solver: value(s, *x), argnums=(0, 1, 2, 3)))(*numbers)
        for solver in (Sparse(), jc.solvers.Dense())
    )
    for got, expected in zip(ours, dense, strict=True):
        np.testing.assert_allclose(got, expected, rtol=DIFFERENCE, atol=1e-8)


def test_a_batch_is_a_loop():
    system = problem("long chain")
    random = np.random.default_rng(6)
    forces = jnp.asarray(random.normal(size=(3, *system.force.shape)))

    def one(force):
        return Sparse().solve(dataclasses.replace(system, force=force))

    batch, alone = jax.jit(jax.vmap(one))(forces), jax.jit(one)
    for i, force in enumerate(forces):
        np.testing.assert_allclose(batch.multipliers[i], alone(force).multipliers, rtol=1e-11)


@pytest.mark.parametrize("name", ["short chain", "long chain", "links"])
def test_a_dependent_row_is_singular(name):
    """The last rod occurs twice, at the end of the elimination order or in its middle."""
    system, state = GRAPHS[name]()
    rows = linearize(system, state.q, state.v, state.time)
    last = rows.jacobian.blocks[-1]
    n = rows.layout.size
    members = [b for b in rows.jacobian.blocks if b.start == last.start]
    more = [dataclasses.replace(b, start=n) for b in members]
    size = last.shape[0] * last.shape[1]
    jacobian = dataclasses.replace(
        rows.jacobian, blocks=(*rows.jacobian.blocks, *more), shape=(n + size, state.v.shape[0])
    )
    twice = dataclasses.replace(
        saddle(system, state.q, rows, state.v, jnp.ones(n)), jacobian=jacobian
    )
    twice = dataclasses.replace(twice, target=jnp.ones(n + size))
    assert jax.jit(lambda: Sparse().solve(twice))().status == jc.Status.SINGULAR


def hinge_twice(dtype):
    """A link on two hinges at the same point: two of four rows are redundant."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_body("link", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    for name in ("one", "two"):
        scene.add(jc.Revolute(name, jc.WORLD, "link", point=(0.0, 0.0)))
    return scene.build()


@pytest.mark.parametrize("solver", [jc.solvers.Sparse, jc.solvers.Schur])
@pytest.mark.parametrize(
    ("dtype", "share", "bound"), [("float32", 1e-5, 1e-3), ("float64", 1e-10, 1e-8)]
)
def test_regularised_redundant_rows_share_the_load(solver, dtype, share, bound):
    system, state = hinge_twice(np.dtype(dtype))
    plain = jc.forward_dynamics(system, state, None, jc.Method(solver=solver()), 1e-3)
    assert plain.status == jc.Status.SINGULAR
    method = jc.Method(solver=solver(tikhonov=share))
    found = jc.forward_dynamics(system, state, None, method, 1e-3)
    assert found.status == jc.Status.OK
    # the end of the rod falls freely about the hinge: a = m g l / (I + m l²) l
    turn = -9.81 * 0.5 / (0.1 + 0.25)
    np.testing.assert_allclose(found.acceleration, [0.0, 0.5 * turn, turn], rtol=bound, atol=bound)
    one, two = found.multipliers.reshape(2, 2).T
    np.testing.assert_allclose(one, two, rtol=1e-2, atol=1e-2)


def test_a_regularised_solution_has_a_gradient():
    system, state = hinge_twice(np.float64)

    def turn(mass):
        changed = system.with_params({"link": {"mass": mass}})
        method = jc.Method(solver=jc.solvers.Sparse(tikhonov=1e-10))
        return jc.forward_dynamics(changed, state, None, method, 1e-3).acceleration[2]

    # derivative of −m g l / (I + m l²) by m
    exact = -9.81 * 0.5 * 0.1 / (0.1 + 0.25) ** 2
    np.testing.assert_allclose(jax.grad(turn)(1.0), exact, rtol=1e-6)


def test_a_full_mass_matrix_is_regularised_too():
    rod = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.array([[2.0, 0.5], [0.5, 1.0]]),
        force=lambda q, v, t, u, p: jnp.array([1.0, -2.0]),
        constraints=(
            jc.joints.Holonomic(lambda q, t, p: jnp.stack([q[0], 2 * q[0]]), name="twice"),
        ),
    )
    state = jc.init(rod, jc.Method(), jnp.zeros(2), jnp.zeros(2))
    method = jc.Method(solver=Sparse(tikhonov=1e-10))
    found = jc.forward_dynamics(rod, state, None, method, 1e-3)
    assert found.status == jc.Status.OK
    np.testing.assert_allclose(found.acceleration, [0.0, -2.0], atol=1e-8)
