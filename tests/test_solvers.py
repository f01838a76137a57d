"""All solvers leave no residual, agree with each other, and report systems without a solution."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import DIFFERENCE, ROUND_OFF

import jaxcon as jc
from jaxcon.constraints.rows import saddle
from jaxcon.core.lanes import Vector
from jaxcon.linear.jacobian import Block, Columns, Jacobian
from jaxcon.linear.saddle import Diagonal, Full, Saddle
from jaxcon.linear.sparse import Sparse

SOLVERS = {"schur": jc.solvers.Schur(), "dense": jc.solvers.Dense(), "sparse": Sparse()}
every_solver = pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)


def iterative(dtype):
    """Returns conjugate gradients with a tolerance of eight units of rounding."""
    return {"cg": jc.solvers.ConjugateGradients(tolerance=8 * float(jnp.finfo(dtype).eps))}


MORE = SOLVERS | iterative("float64")
every_solver_and_iterative = pytest.mark.parametrize("solver", MORE.values(), ids=MORE)


def problem(name, dtype="float64"):
    """The saddle system of a scene off its constraints, with a random right-hand side."""
    built = scenes.build(name, dtype)
    s, random = built.off, scenes.seeded(name, "solvers")
    rows = scenes.linearized(built.system, s.q, s.v, s.time)
    force = jnp.asarray(random.normal(size=s.v.shape), dtype)
    target = jnp.asarray(random.normal(size=rows.bias.shape), dtype)
    return saddle(built.system, s.q, rows, force, target)


def residuals(system, solution):
    """Returns the residuals of both rows, each relative to the largest of its terms."""
    m, j = np.asarray(system.mass.dense(), float), np.asarray(system.jacobian.dense(), float)
    a, multipliers = (np.asarray(x, float) for x in solution[:2])
    first = (m @ a, np.asarray(system.force, float), j.T @ multipliers)
    second = (np.abs(j) @ np.abs(a), np.asarray(system.target, float))
    return (
        np.linalg.norm(first[0] - first[1] - first[2]) / max(map(np.linalg.norm, first)),
        np.linalg.norm(j @ a - second[1]) / max(map(np.linalg.norm, second)),
    )


LOOPS = tuple(name for name in scenes.ALL if name.endswith("loop"))
CASES = [(name, "float64") for name in scenes.NAMES]
CASES += [(name, "float32") for name in (*LOOPS, *scenes.OTHERS)]


@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_all_solvers_leave_no_residual_and_agree(name, dtype):
    system = problem(name, dtype)
    solutions = {
        key: jax.jit(lambda solver=solver: solver.solve(system))()
        for key, solver in (SOLVERS | iterative(dtype)).items()
    }
    for key, solution in solutions.items():
        assert solution.status == jc.Status.OK
        assert solution.acceleration.dtype == dtype
        assert max(residuals(system, solution)) < ROUND_OFF[np.dtype(dtype)], key
    if dtype == "float64":
        dense = solutions.pop("dense")
        for solution in solutions.values():
            for got, expected in zip(solution[:2], dense[:2], strict=True):
                np.testing.assert_allclose(got, expected, rtol=1e-8, atol=1e-8)


def small(jacobian, mass, force, target, compliance=None):
    """Returns the saddle system of plain arrays."""
    rows, n = jacobian.shape
    columns = Columns(0, n, 1, (0,))
    value = tuple(Vector(*(jnp.asarray([x]) for x in row)) for row in jacobian)
    arrays = (jnp.asarray(x) for x in (force, target))
    mass = jnp.asarray(mass)
    mass = Diagonal(mass) if mass.ndim == 1 else Full(mass)
    compliance = None if compliance is None else jnp.asarray(compliance)
    return Saddle(mass, next(arrays), _jacobian(value, columns, rows, n), next(arrays), compliance)


def _jacobian(value, columns, rows, n):
    return Jacobian((Block(value, 0, columns),), (rows, n))


RANDOM = np.random.default_rng(0)
J = RANDOM.normal(size=(2, 4))
MASS = RANDOM.uniform(1, 2, size=4)
SPREAD = RANDOM.normal(size=(4, 4))
FULL = SPREAD @ SPREAD.T + np.eye(4)
FORCE, TARGET, COMPLIANCE = RANDOM.normal(size=4), RANDOM.normal(size=2), np.array([0.3, 0.0])


@every_solver_and_iterative
@pytest.mark.parametrize("mass", [MASS, FULL], ids=["diagonal", "full"])
@pytest.mark.parametrize("compliance", [None, COMPLIANCE], ids=["hard", "compliant"])
def test_small_systems_against_numpy(solver, mass, compliance):
    dense = np.diag(mass) if mass.ndim == 1 else mass
    c = np.zeros(2) if compliance is None else compliance
    matrix = np.block([[dense, -J.T], [J, np.diag(c)]])
    expected = np.linalg.solve(matrix, np.concatenate([FORCE, TARGET]))
    a, multipliers, status = solver.solve(small(J, mass, FORCE, TARGET, compliance))
    np.testing.assert_allclose(np.concatenate([a, multipliers]), expected, rtol=1e-12)
    assert status == jc.Status.OK


@every_solver_and_iterative
def test_no_rows_is_free_motion(solver):
    system = Saddle(
        Diagonal(jnp.asarray(MASS)), jnp.asarray(FORCE), Jacobian((), (0, 4)), jnp.zeros(0)
    )
    a, multipliers, status = solver.solve(system)
    np.testing.assert_allclose(a, FORCE / MASS)
    assert multipliers.shape == (0,)
    assert status == jc.Status.OK


@every_solver_and_iterative
def test_derivative_by_every_number_is_that_of_the_solution(solver):
    """Forward and reverse mode equal central differences of NumPy's solution."""
    names = ("jacobian", "mass", "force", "target", "compliance")
    values = dict(zip(names, (J, FULL, FORCE, TARGET, COMPLIANCE), strict=True))
    direction = {name: np.random.default_rng(1).normal(size=x.shape) for name, x in values.items()}
    direction["mass"] = direction["mass"] + direction["mass"].T
    weight = np.arange(1.0, 7.0)

    def plain(s):
        x = {name: values[name] + s * direction[name] for name in names}
        matrix = np.block(
            [[x["mass"], -x["jacobian"].T], [x["jacobian"], np.diag(x["compliance"])]]
        )
        return weight @ np.linalg.solve(matrix, np.concatenate([x["force"], x["target"]]))

    def ours(x):
        return jnp.asarray(weight) @ jnp.concatenate(solver.solve(small(**x))[:2])

    expected = (plain(1e-5) - plain(-1e-5)) / 2e-5
    x, dx = jax.tree.map(jnp.asarray, (values, direction))
    _, forward = jax.jit(lambda: jax.jvp(ours, (x,), (dx,)))()
    gradient = jax.jit(jax.grad(ours))(x)
    reverse = sum(np.sum(gradient[name] * direction[name]) for name in names)
    np.testing.assert_allclose([forward, reverse], expected, rtol=DIFFERENCE)


@every_solver
def test_the_same_row_twice_is_singular(solver):
    twice = np.concatenate([J, J[:1]])
    assert solver.solve(small(twice, MASS, FORCE, np.ones(3))).status == jc.Status.SINGULAR


@every_solver
def test_an_empty_row_is_singular(solver):
    rows = np.concatenate([J, np.zeros((1, 4))])
    assert solver.solve(small(rows, MASS, FORCE, np.ones(3))).status == jc.Status.SINGULAR


@every_solver_and_iterative
def test_compliance_makes_dependent_rows_regular(solver):
    twice = np.concatenate([J, J[:1]])
    system = small(twice, MASS, FORCE, np.ones(3), np.full(3, 0.1))
    solution = solver.solve(system)
    assert solution.status == jc.Status.OK
    np.testing.assert_allclose(solution.multipliers[0], solution.multipliers[2], rtol=1e-12)


@every_solver_and_iterative
@pytest.mark.parametrize("units", [1e-6, 1e6])
def test_units_do_not_decide_what_is_singular(solver, units):
    rows = J * np.array([[units], [1.0]])
    assert solver.solve(small(rows, MASS, FORCE, TARGET)).status == jc.Status.OK
    assert solver.solve(small(J, MASS * units, FORCE, TARGET)).status == jc.Status.OK


@every_solver_and_iterative
@pytest.mark.parametrize("what", ["force", "target", "mass", "jacobian"])
def test_a_nan_is_not_finite(solver, what):
    values = {"jacobian": J, "mass": MASS, "force": FORCE, "target": TARGET}
    values[what] = values[what].copy()
    values[what].flat[0] = np.nan
    assert solver.solve(small(**values)).status == jc.Status.NON_FINITE


@pytest.mark.parametrize("name", ["distance-2d-tree", "revolute-3d-between", "arm"])
@every_solver
def test_a_constraint_given_twice_is_singular_in_a_scene(solver, name):
    system = problem(name)
    again = [
        dataclasses.replace(b, start=b.start + len(system.target)) for b in system.jacobian.blocks
    ]
    jacobian = Jacobian(
        (*system.jacobian.blocks, *again), (2 * len(system.target), system.jacobian.shape[1])
    )
    twice = dataclasses.replace(system, jacobian=jacobian, target=jnp.tile(system.target, 2))
    assert solver.solve(twice).status == jc.Status.SINGULAR
