"""Conjugate gradients compared with dense solutions and with the theory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_solvers import FORCE, FULL, MASS, TARGET, J, small
from test_sparse import GRAPHS, hinge_twice, links, problem
from tolerances import DIFFERENCE

import jaxcon as jc
from jaxcon.constraints.rows import linearize, saddle
from jaxcon.linear.saddle import Diagonal

CG = jc.solvers.ConjugateGradients


def assembled(system, state, seed=3):
    """Returns the saddle system of a scene with a random consistent right-hand side b = J x."""
    rows = linearize(system, state.q, state.v, state.time)
    random = np.random.default_rng(seed)
    force, x = (jnp.asarray(random.normal(size=state.v.shape), state.v.dtype) for _ in range(2))
    return saddle(system, state.q, rows, force, rows.jacobian.apply(x))


def joints_in_space(n, closed, dtype=np.float64):
    """A planar chain of links in space; if closed, its joint rows are redundant."""
    scene, points = jc.Scene(dim=3, dtype=dtype), np.random.default_rng(1).normal(size=(n + 1, 2))
    points = np.column_stack([np.arange(n + 1), points[:, 0], np.zeros(n + 1)])
    for i in range(n):
        a, middle = jc.WORLD if i == 0 else f"l{i - 1}", (points[i] + points[i + 1]) / 2
        scene.add_body(f"l{i}", mass=1.0 + i % 3, inertia=(0.01, 0.1, 0.1), position=middle)
        scene.add(jc.Revolute(f"j{i}", a, f"l{i}", point=points[i], axis=(0.0, 0.0, 1.0)))
    if closed:
        end = {"point": points[n], "axis": (0.0, 0.0, 1.0)}
        scene.add(jc.Revolute("end", f"l{n - 1}", jc.WORLD, **end))
    return scene.build()


def matrices(system):
    """Returns A, its diagonal blocks P, and the right-hand side b − J M⁻¹ f, in float64."""
    j = np.asarray(system.jacobian.dense(), float)
    lift = j.T / np.asarray(system.mass.values, float)[:, None]
    a, right = j @ lift, np.asarray(system.target, float) - lift.T @ np.asarray(system.force, float)
    p = np.zeros_like(a)
    for block in system.jacobian.blocks:
        m, k = block.shape
        for i in range(k):
            rows = np.ix_(*[block.start + i + k * np.arange(m)] * 2)
            p[rows] = a[rows]
    return a, p, right


def iterates(a, p, b, count):
    """Yields the iterates of the textbook conjugate residual method, with P⁻¹ as a matrix."""
    inverse = np.linalg.inv(p)
    x, r = np.zeros_like(b), b
    z = d = inverse @ r
    for _ in range(count):
        pull, y = z @ a @ z, a @ d
        step = pull / (y @ inverse @ y)
        x, r = x + step * d, r - step * y
        z = inverse @ r
        d = z + (z @ a @ z) / pull * d
        yield x


def least(a, p, b, count):
    """Returns the x of least residual, in the norm of P⁻¹, in a Krylov space of `count` vectors."""
    inverse, half = np.linalg.inv(p), np.linalg.cholesky(np.linalg.inv(p)).T
    basis, new = np.zeros((len(b), 0)), inverse @ b
    for _ in range(count):
        for _ in range(2):
            new = new - basis @ (basis.T @ new)
        basis = np.column_stack([basis, new / np.linalg.norm(new)])
        new = inverse @ (a @ basis[:, -1])
    return basis @ np.linalg.lstsq(half @ a @ basis, half @ b)[0]


def multipliers(system, iterations):
    """Returns λ after some iterations, as a NumPy array."""
    return np.asarray(jax.jit(CG(iterations=iterations).solve)(system).multipliers)


@pytest.mark.parametrize("name", GRAPHS)
def test_the_solution_is_that_of_the_dense_solver(name):
    system = problem(name)
    expected = jc.solvers.Dense().solve(system)
    got = jax.jit(CG(tolerance=1e-14).solve)(system)
    assert got.status == jc.Status.OK
    np.testing.assert_allclose(got.acceleration, expected.acceleration, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got.multipliers, expected.multipliers, rtol=1e-8, atol=1e-8)


def test_with_compliance():
    system = problem("links in a loop")
    compliance = jnp.asarray(np.random.default_rng(4).uniform(0, 1, size=system.target.shape))
    system = dataclasses.replace(system, compliance=compliance)
    got = jax.jit(CG(tolerance=1e-14).solve)(system)
    expected = jc.solvers.Dense().solve(system)
    np.testing.assert_allclose(got.multipliers, expected.multipliers, rtol=1e-9, atol=1e-9)


def test_a_full_mass_matrix_is_left_to_schur():
    system = small(J, FULL, FORCE, TARGET)
    for share in (None, 0.1):
        ours, theirs = (
            CG(tikhonov=share).solve(system),
            jc.solvers.Schur(tikhonov=share).solve(system),
        )
        np.testing.assert_array_equal(ours.multipliers, theirs.multipliers)


@pytest.mark.parametrize("count", [1, 3, 7])
def test_the_iterates_leave_the_least_residual(count):
    """The preconditioner has one block for each joint, of two rows and of five."""
    for built in (links(10, True), joints_in_space(6, False)):
        system = assembled(*built)
        expected = least(*matrices(system), count)
        found = multipliers(system, count)
        np.testing.assert_allclose(found, expected, atol=1e-6 * np.max(np.abs(expected)))


def test_every_iteration_brings_a_chain_nearer_to_the_solution():
    """The error decreases in the norm of A, although the method minimizes the residual."""
    system = assembled(*links(10, False))
    a, _, b = matrices(system)
    exact = np.linalg.solve(a, b)
    gaps = [-exact, *(multipliers(system, n) - exact for n in range(2, len(b) + 1, 2))]
    errors = [np.sqrt(gap @ a @ gap) for gap in gaps]
    assert all(after < before for before, after in zip(errors[:-1], errors[1:], strict=True))
    assert errors[-1] < 1e-9 * errors[0]


def test_without_the_preconditioner_it_would_take_more_iterations():
    system = assembled(*joints_in_space(10, False))
    a, p, b = matrices(system)
    exact = np.linalg.solve(a, b)

    def enough(preconditioner):
        for count, x in enumerate(iterates(a, preconditioner, b, 500), start=1):
            if np.sqrt((x - exact) @ a @ (x - exact)) < 1e-6 * np.sqrt(exact @ a @ exact):
                return count
        return 500

    ours, plain = enough(p), enough(np.eye(len(b)))
    assert ours < plain / 2
    gap = multipliers(system, ours) - exact
    assert np.sqrt(gap @ a @ gap) < 1.01e-6 * np.sqrt(exact @ a @ exact)


REDUNDANT = {
    "hinge twice": hinge_twice,
    "four-bar in space": lambda dtype: joints_in_space(3, True, dtype),
    "chain in space, held at both ends": lambda dtype: joints_in_space(8, True, dtype),
}


@pytest.mark.parametrize("name", REDUNDANT)
@pytest.mark.parametrize(("dtype", "bound"), [("float64", 1e-8), ("float32", 1e-3)])
def test_redundant_rows_that_agree_are_solved_however_many_iterations_follow(name, dtype, bound):
    system = assembled(*REDUNDANT[name](np.dtype(dtype)))
    a, _, b = matrices(system)
    assert np.linalg.matrix_rank(a, tol=1e-5) < len(b)
    exact = np.linalg.pinv(a, rcond=1e-6, hermitian=True) @ b
    for iterations in (40, 400):
        got = jax.jit(CG(iterations=iterations).solve)(system)
        assert got.status == jc.Status.OK
        assert got.multipliers.dtype == dtype
        j, found = (np.asarray(x, float) for x in (system.jacobian.dense(), got.multipliers))
        pull, expected = j.T @ found, j.T @ exact
        np.testing.assert_allclose(pull, expected, atol=bound * np.max(np.abs(expected)))
        assert np.linalg.norm(found) < 10 * np.linalg.norm(exact)


def test_redundant_rows_have_a_gradient():
    system, state = hinge_twice(np.float64)

    def turn(mass):
        changed = system.with_params({"link": {"mass": mass}})
        return jc.forward_dynamics(changed, state, None, jc.Method(solver=CG()), 1e-3)

    # derivative of −m g l / (I + m l²) by m
    exact = -9.81 * 0.5 * 0.1 / (0.1 + 0.25) ** 2
    slope = jax.grad(lambda mass: turn(mass).acceleration[2])
    np.testing.assert_allclose(slope(1.0), exact, rtol=1e-9)
    every = jax.grad(lambda mass: jnp.sum(turn(mass).multipliers ** 2))
    assert jnp.isfinite(every(1.0))


TWICE = np.concatenate([J, J[:1]])
EMPTY = np.concatenate([J, np.zeros((1, 4))])


@pytest.mark.parametrize("rows", [TWICE, EMPTY], ids=["twice", "empty"])
def test_rows_without_a_solution_are_told_from_redundant_ones(rows):
    """The rows belong to one constraint, so that a block of the preconditioner is singular."""
    last = {id(TWICE): TARGET[0], id(EMPTY): 0.0}[id(rows)]
    for wrong, status in ((0.0, jc.Status.OK), (1.0, jc.Status.CONFLICT)):
        system = small(rows, MASS, FORCE, np.append(TARGET, last + wrong))
        got = CG().solve(system)
        assert got.status == status
        assert jnp.all(jnp.isfinite(got.multipliers))


@pytest.mark.parametrize("off", [1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize("iterations", [50, 500])
def test_rows_that_disagree_are_met_by_least_squares(off, iterations):
    """λ stays as small as for consistent rows: the inconsistent part of b does not enter it."""
    system = assembled(*joints_in_space(8, True))
    a, p, b = matrices(system)
    values, vectors = np.linalg.eigh(a)
    beyond = vectors[:, values < 1e-9 * values[-1]]
    assert beyond.shape[1] > 0
    off = off * np.linalg.norm(b) * (beyond @ np.ones(beyond.shape[1]))
    target = system.target + jnp.asarray(off)
    got = jax.jit(CG(iterations=iterations).solve)(dataclasses.replace(system, target=target))
    plain = jax.jit(CG(iterations=iterations).solve)(system)
    assert got.status == jc.Status.OK
    # least squares in the norm of P⁻¹
    root = np.linalg.cholesky(np.linalg.inv(p + 1e-8 * np.diag(np.diagonal(p))))
    x = np.linalg.lstsq(root.T @ a, root.T @ (b + off), rcond=1e-9)[0]
    j, inverse_mass = np.asarray(system.jacobian.dense()), 1 / np.asarray(system.mass.values)
    expected = inverse_mass * (np.asarray(system.force) + j.T @ x)
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(got.acceleration, expected, atol=1e-9 * size)
    assert np.linalg.norm(got.multipliers) < 1.1 * np.linalg.norm(plain.multipliers)


def test_tikhonov_solves_rows_that_contradict_each_other():
    system = small(TWICE, MASS, FORCE, np.append(TARGET, TARGET[0] + 0.1))
    ours, theirs = (
        CG(tikhonov=1e-3, tolerance=1e-13).solve(system),
        jc.solvers.Schur(1e-3).solve(system),
    )
    assert ours.status == jc.Status.OK
    np.testing.assert_allclose(ours.multipliers, theirs.multipliers, rtol=1e-9)


def test_the_tolerance_decides_what_has_converged_and_is_a_number():
    system = assembled(*links(10, False))
    solve = jax.jit(lambda x: CG(tolerance=x, iterations=12).solve(system))
    found = [solve(x) for x in (1e-12, 0.01, 0.1)]
    assert [int(x.status) for x in found] == [jc.Status.NOT_CONVERGED, jc.Status.OK, jc.Status.OK]
    assert solve._cache_size() == 1
    a, _, b = matrices(system)
    gaps = [np.linalg.norm(a @ x.multipliers - b) for x in found]
    assert gaps[0] < gaps[1] < gaps[2]
    with pytest.raises(jc.SimulationError, match="NOT_CONVERGED.*iterations"):
        jc.raise_for_status(found[0])


@pytest.mark.parametrize(("dtype", "bound"), [("float32", 2.5e-5), ("float64", 4e-11)])
def test_the_default_tolerance_leaves_two_thirds_of_the_digits(dtype, bound):
    system = assembled(*hinge_twice(np.dtype(dtype)))
    a, p, b = matrices(system)
    p += 1e-9 * np.eye(len(b))
    r = b - a @ np.asarray(jax.jit(CG().solve)(system).multipliers, float)
    assert r @ np.linalg.solve(p, r) < bound**2 * (b @ np.linalg.solve(p, b))


def test_a_batch_is_a_loop():
    """Solves worlds that need no, few and all iterations, and one that fails."""
    system = assembled(*links(6, True))
    zero, random = jnp.zeros_like(system.force), np.random.default_rng(6)
    force = jnp.asarray(random.normal(size=system.force.shape))
    force = jnp.stack([zero, force, 1e6 * force, zero.at[0].set(jnp.nan)])
    target = jnp.stack([0 * system.target, *[system.target] * 3])
    solver = CG(tolerance=jnp.asarray(1e-13))

    def one(force, target):
        return solver.solve(dataclasses.replace(system, force=force, target=target))

    batch, alone = jax.jit(jax.vmap(one))(force, target), jax.jit(one)
    ok, bad = jc.Status.OK, jc.Status.NON_FINITE
    np.testing.assert_array_equal(batch.status, [ok, ok, ok, bad])
    np.testing.assert_array_equal(batch.multipliers[0], 0)
    for i in (1, 2):
        expected = alone(force[i], target[i]).multipliers
        np.testing.assert_allclose(batch.multipliers[i], expected, rtol=1e-10)


def numbers(system):
    return (system.mass.values, system.force, system.target, jnp.ones(len(system.jacobian.blocks)))


def value(solver, system, mass, force, target, scale):
    """Returns a number that depends on all results.

    The arguments replace numbers of the system; `scale` multiplies each block of the Jacobian.
    """
    blocks = [
        dataclasses.replace(block, value=jax.tree.map(lambda x, s=s: x * s, block.value))
        for block, s in zip(system.jacobian.blocks, scale, strict=True)
    ]
    jacobian = dataclasses.replace(system.jacobian, blocks=tuple(blocks))
    changes = {"mass": Diagonal(mass), "force": force, "target": target, "jacobian": jacobian}
    a, multipliers, _ = solver.solve(dataclasses.replace(system, **changes))
    return jnp.sum(jnp.sin(a)) + jnp.sum(multipliers**2)


@pytest.mark.parametrize("name", ["tree", "links in a loop"])
def test_derivatives_are_those_of_the_dense_solver_and_differences(name):
    system = problem(name)
    x = numbers(system)
    random = np.random.default_rng(5)
    direction = tuple(jnp.asarray(random.normal(size=leaf.shape)) for leaf in x)
    ours, dense = (
        jax.jit(jax.grad(lambda x, s=solver: value(s, system, *x)))(x)
        for solver in (CG(tolerance=1e-14), jc.solvers.Dense())
    )
    for got, expected in zip(ours, dense, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-8, atol=1e-8)

    def plain(x):
        return value(CG(tolerance=1e-14), system, *x)

    along = jax.jit(lambda x, dx: jax.jvp(plain, (x,), (dx,))[1])(x, direction)
    ends = (jax.tree.map(lambda a, d, h=h: a + h * d, x, direction) for h in (1e-5, -1e-5))
    ahead, behind = map(jax.jit(plain), ends)
    reverse = sum(jnp.sum(g * d) for g, d in zip(ours, direction, strict=True))
    np.testing.assert_allclose(reverse, along, rtol=1e-9)
    np.testing.assert_allclose(along, (ahead - behind) / 2e-5, rtol=DIFFERENCE)


def test_gradients_of_a_batched_rollout():
    """Gradients inside and outside of vmap equal those of `Sparse`."""
    system, state = links(4, True)
    states = jnp.stack([state.v, 2 * state.v, -state.v])

    def final(solver, v):
        start = dataclasses.replace(state, v=v)
        return jnp.sum(jc.rollout(system, jc.Method(solver=solver), start, None, 1e-3, 5)[0].q ** 2)

    def inside(solver):
        return jax.jit(jax.vmap(jax.grad(lambda v: final(solver, v))))(states)

    def outside(solver):
        return jax.jit(jax.grad(lambda v: jnp.sum(jax.vmap(lambda x: final(solver, x))(v))))(states)

    expected = inside(jc.solvers.Sparse())
    for found in (inside(CG(tolerance=1e-14)), outside(CG(tolerance=1e-14))):
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)


def equations(jaxpr):
    """Yields the equations of a jaxpr and of all jaxprs within it."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in jax.tree.leaves(list(equation.params.values())):
            yield from equations(inner) if hasattr(inner, "eqns") else ()


def program_of(solver, n, dtype=np.float64):
    """Returns the number of rows of a chain of n links, and all equations from its rows to λ."""
    system, state = joints_in_space(n, False, dtype)
    trace = jax.make_jaxpr(lambda state: solver.solve(assembled(system, state)))
    closed, solution = trace(state), jax.eval_shape(lambda: assembled(system, state).target)
    return solution.size, list(equations(closed.jaxpr))


def test_the_program_does_not_grow_with_the_scene():
    (_, short), (_, long) = (program_of(CG(), n) for n in (10, 100))
    assert len(short) == len(long)
    assert [x.primitive.name for x in short] == [x.primitive.name for x in long]


def test_arrays_grow_no_faster_than_the_scene():
    def largest(solver, n):
        n_c, program = program_of(solver, n)
        return n_c, max(y.aval.size for x in program for y in x.outvars)

    (few, small), (many, large) = (largest(CG(), n) for n in (10, 100))
    assert many == 10 * few
    assert large == 10 * small < 2 * many
    assert largest(jc.solvers.Schur(), 10)[1] >= few**2


def test_nothing_in_float32_is_float64():
    _, program = program_of(CG(), 10, np.float32)
    dtypes = {str(y.aval.dtype) for x in program for y in x.outvars}
    assert "float32" in dtypes
    assert "float64" not in dtypes


@pytest.mark.parametrize("load", [1e4, 1e5])
def test_a_chain_holds_a_heavy_load_in_float32(load):
    """The small eigenvalue of A belongs to the load and must not be taken for a redundant row."""
    scene = jc.Scene(dim=2, dtype=np.float32)
    for i in range(5):
        mass = load if i == 4 else 1.0
        scene.add_body(f"link{i}", mass=mass, inertia=mass / 12, position=(0.0, -i - 0.5))
        before = f"link{i - 1}" if i else jc.WORLD
        scene.add(jc.Revolute(f"hinge{i}", before, f"link{i}", point=(0.0, -float(i))))
    system, state = scene.build()
    method = jc.Method(solver=jc.solvers.ConjugateGradients(iterations=1000))
    state = jc.init(system, method, state.q, state.v)
    found = jc.forward_dynamics(system, state, None, method, 1e-2)
    assert found.status == jc.Status.OK
    assert np.max(np.abs(found.acceleration)) < 0.2
    np.testing.assert_allclose(np.max(np.abs(found.multipliers)), 9.81 * (load + 4), rtol=1e-3)
