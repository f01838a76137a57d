"""Second derivatives through every solver, and first ones in both orders of grad and vmap.

The reference solves the same equations with LAPACK and differentiates that solution.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_solvers import COMPLIANCE, FORCE, MASS, TARGET, small
from tolerances import DERIVATIVE

import jaxcon as jc
from jaxcon.contact.bounded import Bounded, RowCounts, implicit_multipliers

RANDOM = np.random.default_rng(4)
ROWS = RANDOM.normal(size=(3, 2, 4))
WEIGHTS = RANDOM.normal(size=6)
X = jnp.asarray(RANDOM.normal(size=(2, 3)))


@dataclasses.dataclass(frozen=True)
class Named:
    """A layout that assigns rows to named constraints."""

    names: tuple = ("high", "low")

    def rows(self, name):
        return [self.names.index(name)]


def equations(x):
    """Returns J, M, f, b and C, all nonlinear in x."""
    jacobian = ROWS[0] + jnp.sin(x[0]) * ROWS[1] + x[1] * x[2] * ROWS[2]
    soft = (1 + x[2] ** 2) * COMPLIANCE
    return jacobian, (1 + x[1] ** 2) * MASS, x[2] ** 2 * FORCE, jnp.cos(x[0]) * TARGET, soft


def outcome(*found):
    found = jnp.concatenate(found)
    return jnp.sin(WEIGHTS[: len(found)] @ found)


def solved(solver, x):
    system = dataclasses.replace(small(*equations(x)), layout=Named())
    return outcome(*solver.solve(system)[:2])


def eliminated(x):
    jacobian, mass, force, target, compliance = equations(x)
    rows = [[jnp.diag(mass), -jacobian.T], [jacobian, jnp.diag(compliance)]]
    return outcome(jnp.linalg.solve(jnp.block(rows), jnp.concatenate([force, target])))


@functools.cache
def derivatives(value):
    """Returns a function of worlds: vmap of Hessian and gradient, and gradient of vmap."""

    def slope(x, *known):
        own = jax.grad(value)(x, *known)
        return own, own

    inside = jax.jit(jax.vmap(jax.jacfwd(slope, has_aux=True)))
    outside = jax.jit(jax.grad(lambda x, *known: jnp.sum(jax.vmap(value)(x, *known))))
    return lambda *known: (*inside(X, *known), outside(X, *known))


def same(found, expected):
    for got, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=DERIVATIVE * np.max(np.abs(wanted)))


SOLVERS = {
    "schur": jc.solvers.Schur(),
    "dense": jc.solvers.Dense(),
    "sparse": jc.solvers.Sparse(),
    "cg": jc.solvers.ConjugateGradients(tolerance=1e-15, iterations=10),
    "rank-safe": jc.solvers.RankSafe(jc.solvers.Schur(), always=True),
    "priority": jc.solvers.Priority({"low": 1}),
}


@pytest.mark.parametrize("name", SOLVERS)
def test_equalities(name):
    same(derivatives(functools.partial(solved, SOLVERS[name]))(), derivatives(eliminated)())


KINDS = RowCounts(single=1, boxes=1, contacts=1, tangents=2)
SPREAD = RANDOM.normal(size=(5, 7))
OFFSET = np.array([-3.0, -9.0, -4.0, 5.0, 3.0])


def problem(x):
    """Returns a problem of a stop that is hit, a brake at its bound, and a sliding contact."""
    spread = SPREAD * (1 + 0.1 * jnp.sin(x[0])) + 0.1 * x[1] * x[2]
    offset = OFFSET * (1 + 0.1 * jnp.cos(x[1])) + 0.1 * x[2] ** 2
    most = 0.5 + 0.1 * jnp.sin(x[0])
    return spread @ spread.T / 5, offset, most, 0.2 + 0.1 * jnp.cos(x[2])


def bounded(x):
    matrix, offset, most, friction = (y[..., None] for y in problem(x))
    return Bounded(matrix, offset, -most[None], most[None], friction[None], KINDS)


def differentiated(x, found):
    """Solves with constants, then applies the implicit derivative of the laws, as a step does."""
    own = bounded(x)
    live = own.lower, own.upper, own.coefficients
    fixed = jax.lax.stop_gradient(own)
    multipliers = implicit_multipliers(fixed, found[:, None], own.velocity, live, None)
    return outcome(multipliers[:, 0])


def slipping(x):
    """Solves the active laws by Newton's method; two last iterations carry two derivatives."""
    matrix, offset, most, friction = problem(x)

    def unmet(y):
        u = matrix @ y + offset
        slip = u[3:] / jnp.sqrt(u[3:] @ u[3:])
        return jnp.concatenate([u[:1], y[1:2] - most, u[2:3], y[3:] + friction * y[2] * slip])

    def newton(y):
        return y - jnp.linalg.solve(jax.jacfwd(unmet)(y), unmet(y))

    start = jnp.asarray([2.0, 0.5, 4.0, -0.9, 0.0])
    root = jax.lax.fori_loop(0, 10, lambda _, y: newton(y), start)
    return outcome(newton(newton(jax.lax.stop_gradient(root))))


LAWS = {"interior point": jc.solvers.InteriorPoint(), "sweeps": jc.solvers.GaussSeidel(sweeps=100)}


@pytest.mark.parametrize("name", LAWS)
def test_bounds(name):
    worlds = jax.tree.map(lambda *y: jnp.concatenate(y, -1), *map(bounded, X))
    found = jax.jit(LAWS[name].solve)(worlds, jnp.zeros_like(worlds.offset))
    same(derivatives(differentiated)(found.T), derivatives(slipping)())


def test_a_tableau_may_be_lists_and_arrays():
    own = jc.integrators.RungeKutta([[1.0]], np.array([0.5, 0.5]))
    assert own == jc.integrators.RungeKutta(((1.0,),), (0.5, 0.5))
    assert hash(own) == hash(jc.integrators.RungeKutta(((1.0,),), (0.5, 0.5)))
    for a, b in ((None, None), ([[1.0]], "ab"), ([1.0], [0.5, 0.5])):
        with pytest.raises(TypeError, match="RungeKutta: a must be rows of numbers"):
            jc.integrators.RungeKutta(a, b)
