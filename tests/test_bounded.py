"""Both solvers of inequality rows: the laws hold at random, in degenerate cases, in float32."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.contact import central_path, interior_point, polish
from jaxcon.contact.bounded import Bounded, RowCounts
from jaxcon.linear import gauss_jordan

WORLDS = 2000
dtypes = pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
EXACT = {"float64": 1e-8, "float32": 1e-5}
"""Tolerance of each law by dtype, relative to its largest term."""


def problems(kinds, rank, dtype, friction=0.1):
    """Returns problems with G = J M⁻¹ Jᵀ and c = J v of random rows; batch along the last axis."""
    rng = np.random.default_rng(3)
    jacobian = rng.normal(size=(kinds.size, rank, WORLDS))
    weight = np.exp(rng.normal(size=(rank, WORLDS)))
    matrix = np.einsum("irb,rb,jrb->ijb", jacobian, weight, jacobian)
    offset = np.einsum("irb,rb->ib", jacobian, rng.normal(size=(rank, WORLDS)))
    most = np.abs(rng.normal(size=(kinds.boxes, WORLDS)))
    mu = friction * rng.uniform(size=(kinds.contacts, WORLDS))
    return Bounded(*(jnp.asarray(x, dtype) for x in (matrix, offset, -most, most, mu)), kinds)


def missed(problem, multipliers):
    """Returns the law violation by world, relative to the largest term of u = G λ + c."""
    terms = jnp.sum(jnp.abs(problem.matrix * multipliers[None]), axis=1) + jnp.abs(problem.offset)
    return np.asarray(problem.worst(multipliers) / jnp.max(terms, axis=0))


@dtypes
@pytest.mark.parametrize(
    ("kinds", "rank"),
    [
        (RowCounts(4), 6),
        (RowCounts(4), 3),
        (RowCounts(2, 3), 6),
        (RowCounts(0, 4), 2),
        (RowCounts(1, 1, 2, 2), 12),
    ],
    ids=["stops", "dependent stops", "stops and friction", "dependent friction", "contacts"],
)
def test_interior_point_solves_random_rows(kinds, rank, dtype):
    problem = problems(kinds, rank, dtype)
    solve = jax.jit(lambda p: jc.solvers.InteriorPoint().solve(p, jnp.zeros_like(p.offset)))
    assert missed(problem, solve(problem)).max() < EXACT[np.dtype(dtype).name]


@dtypes
def test_contacts_take_as_many_iterations_as_stops(dtype):
    """After 20 iterations, fewer than 1 % of random problems with contacts are unfinished."""
    problem = interior_point.normalized(problems(RowCounts(1, 1, 2, 2), 12, dtype, 0.5))[2]

    def once(_, point):
        on = interior_point.unfinished(problem, point)[None]
        return jax.tree.map(partial(jnp.where, on), interior_point.iterate(problem, point), point)

    def left():
        point = jax.lax.fori_loop(0, 20, once, central_path.center(problem))
        return interior_point.unfinished(problem, point)

    assert np.mean(jax.jit(left)()) < 0.01


def test_sweeps_come_to_the_same():
    problem = problems(RowCounts(3, 2), 8, jnp.float64)
    zero = jnp.zeros_like(problem.offset)
    exact = jax.jit(lambda p: jc.solvers.InteriorPoint().solve(p, zero))(problem)
    swept = jax.jit(lambda p: jc.solvers.GaussSeidel(sweeps=2000).solve(p, zero))(problem)
    np.testing.assert_allclose(swept, exact, atol=1e-8 * float(jnp.max(jnp.abs(exact))))


def test_more_sweeps_miss_less():
    problem = problems(RowCounts(3, 2), 8, jnp.float64)
    zero = jnp.zeros_like(problem.offset)
    left = [
        np.median(missed(problem, jax.jit(jc.solvers.GaussSeidel(sweeps=n).solve)(problem, zero)))
        for n in (2, 8, 32)
    ]
    assert left[0] > 3 * left[1] > 9 * left[2]


@pytest.mark.parametrize("solver", [jc.solvers.GaussSeidel(), jc.solvers.InteriorPoint()])
def test_solvers_write_in_place(solver):
    """XLA turns a scatter into a loop over a copy, which cannot be part of a fused kernel."""
    problem = problems(RowCounts(3, 2, 2, 2), 8, jnp.float64)
    trace = jax.make_jaxpr(lambda p: solver.solve(p, jnp.zeros_like(p.offset)))(problem)
    assert "scatter" not in str(trace)


@dtypes
def test_the_laws_by_hand(dtype):
    """Four rows: a stop that is hit, a stop that is left, static and sliding friction."""
    kinds = RowCounts(2, 2)
    numbers = ([-3.0, 4.0, 1.0, -5.0], [-2.0, -2.0], [2.0, 2.0])
    offset, lower, upper = (jnp.asarray(x, dtype)[:, None] for x in numbers)
    matrix = 2 * jnp.eye(4, dtype=dtype)[..., None]
    problem = Bounded(matrix, offset, lower, upper, jnp.zeros((0, 1), dtype), kinds)
    for solver in (jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel(sweeps=3)):
        found = solver.solve(problem, jnp.zeros_like(offset))[:, 0]
        np.testing.assert_allclose(found, [1.5, 0.0, -0.5, 2.0], atol=1e-6)


def test_one_corner_of_four_lets_go():
    """A face slides on four corners and cannot close all gaps: three bear, one lifts off."""
    corners = np.array([[x, y, -0.05] for x in (0.2, -0.2) for y in (0.15, -0.15)])
    jacobian = np.array([[*e, *np.cross(r, e)] for e in np.eye(3)[[2, 0, 1]] for r in corners])
    weight = np.diag([0.5, 0.5, 0.5, *1 / np.array([0.016, 0.028, 0.042])])
    velocity = np.array([0.9, 0.5, -1.0, 0.02, -0.03, 0.2])
    unequal = np.concatenate([1e-4 * np.array([1.0, -1.0, -1.0, 1.0]), np.zeros(8)])
    numbers = (jacobian @ weight @ jacobian.T, jacobian @ velocity + unequal)
    none, μ = jnp.zeros((0, 1)), jnp.full((4, 1), 0.5)
    problem = Bounded(
        *(jnp.asarray(x)[..., None] for x in numbers), none, none, μ, RowCounts(0, 0, 4, 2)
    )
    near = jax.jit(jc.solvers.GaussSeidel(sweeps=40).solve)(problem, jnp.zeros((12, 1)))
    found = jax.jit(partial(polish.polished, rounds=12))(problem, near)
    assert missed(problem, found).max() < 1e-14
    assert np.sum(np.asarray(problem.kinds.split(found).normal) > 0) == 3


def test_a_contact_that_jams_is_solved():
    """Friction presses into the floor by more than the normal force lifts: G_nn < μ |G_nt|."""
    matrix = [[0.217, 0.00182, 0.0111], [0.00182, 0.000418, 0.000805], [0.0111, 0.000805, 0.0049]]
    none = jnp.zeros((0, 1))
    problem = Bounded(
        jnp.asarray(matrix)[..., None],
        jnp.asarray([-0.178, -0.00805, 0.73])[:, None],
        none,
        none,
        jnp.full((1, 1), 0.6),
        RowCounts(1, 0, 1, 1),
    )
    assert 0.6 * matrix[1][2] > matrix[1][1]
    found = jax.jit(jc.solvers.InteriorPoint().solve)(problem, jnp.zeros((3, 1)))
    assert missed(problem, found).max() < 1e-9
    assert np.all(np.asarray(found)[:2] > 0)


@pytest.mark.parametrize("n", [3, 7, 50])
def test_inverse_without_pivots(n):
    rng = np.random.default_rng(0)
    half = rng.normal(size=(n, n, 5))
    matrix = np.einsum("ikb,jkb->ijb", half, half) + 0.1 * np.eye(n)[..., None]
    found = gauss_jordan.inverse(jnp.asarray(matrix))
    unit = np.einsum("ijb,jkb->ikb", matrix, found)
    np.testing.assert_allclose(unit, np.eye(n)[..., None] + 0 * unit, atol=1e-9)


def test_zero_rows_do_nothing():
    """A rope whose ends meet has no direction: its row is zero, and its multiplier stays finite."""
    kinds = RowCounts(2)
    matrix = jnp.zeros((2, 2, 1)).at[0, 0].set(1.0)
    offset = jnp.asarray([[-1.0], [0.0]])
    none = jnp.zeros((0, 1))
    problem = Bounded(matrix, offset, none, none, none, kinds)
    for solver in (jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel()):
        found = np.asarray(solver.solve(problem, jnp.zeros_like(offset)))
        assert np.isfinite(found).all()
        np.testing.assert_allclose(found[0], 1.0, rtol=1e-9)
        assert abs(found[1, 0]) < 10


@pytest.mark.parametrize(
    ("part", "match"),
    [
        (lambda: jc.solvers.GaussSeidel(sweeps=0), "sweeps"),
        (lambda: jc.solvers.InteriorPoint(iterations=0), "iterations"),
        (lambda: jc.solvers.GaussSeidel, "InteriorPoint"),
    ],
)
def test_bad_numbers_are_refused(part, match):
    system, state = _ball()
    with pytest.raises((ValueError, TypeError), match=match):
        jc.step(system, jc.Method(contact_solver=part()), state, None, 1e-3)


def _ball():
    scene = jc.Scene(dim=2)
    scene.add_particle("ball", mass=1.0, position=(0.0, 1.0))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball"))
    return scene.build()


@pytest.mark.parametrize(
    "integrator",
    [jc.integrators.RATTLE(), jc.integrators.GeneralizedAlpha()],
    ids=lambda x: type(x).__name__,
)
def test_integrators_without_a_place_for_bounds_say_so(integrator):
    system, state = _ball()
    method = jc.Method(integrator=integrator)
    with pytest.raises(ValueError, match="inequality rows of \\['floor'\\]"):
        jc.step(system, method, jc.init(system, method, state.q, state.v), None, 1e-3)


def test_scenes_without_bounds_have_no_trace_of_them(monkeypatch):
    """The program of a step is the same for both solvers of inequality rows, and has no loop."""
    free, stopped = _hinge(), _hinge(jc.Limit("stop", "hinge", -1.0, 1.0))
    methods = [
        jc.Method(contact_solver=b)
        for b in (jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel(sweeps=7))
    ]
    system, state = free
    assert jc.step(system, methods[0], state, None, 1e-3)[1].reactions is None
    assert _program(*free, methods[0]) == _program(*free, methods[1])  # the same kernel
    monkeypatch.setenv("JAXCON_KERNELS", "off")  # loops of kernels are not in the text of XLA
    assert "stablehlo.while" in _program(*stopped, methods[0])
    assert "stablehlo.while" not in _program(*free, methods[0])
    assert len(_program(*free, methods[0])) == len(_program(*free, methods[1]))


def _hinge(*elements):
    scene = jc.Scene(dim=2)
    scene.add_body("link", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "link", point=(0.0, 0.0)))
    for element in elements:
        scene.add(element)
    return scene.build()


def _program(system, state, method):
    """Returns the text of the lowered program of a step."""
    return jax.jit(lambda s: jc.step(system, method, s, None, 1e-3)).lower(state).as_text()
