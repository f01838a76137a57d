"""Priority levels of constraints, compared with null-space projections and with other solvers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import DIFFERENCE, ROUND_OFF

import jaxcon as jc
from jaxcon.constraints.rows import RowLayout, linearize, saddle
from jaxcon.core.lanes import Vector
from jaxcon.linear.jacobian import Block, Columns, Jacobian
from jaxcon.linear.saddle import Diagonal, Full, Saddle
from jaxcon.scenes import CRANK_ROCKER, four_bar

RANDOM = np.random.default_rng(3)
NAMES = ("hold", "reach", "reach_far", "rest")
LEVELS = {"reach*": 1, "rest": 2}
J = RANDOM.normal(size=(5, 5))
J[2] = 0.7 * J[0] - 0.2 * J[1]  # depends on the rows of "hold"
J[4] = J[3] + J[1]  # depends on "reach_far" and "hold"
ROWS = {"hold": [0, 1], "reach": [2], "reach_far": [3], "rest": [4]}
SPREAD = RANDOM.normal(size=(5, 5))
MASS = SPREAD @ SPREAD.T + np.eye(5)
FORCE, TARGET = RANDOM.normal(size=5), RANDOM.normal(size=5)
BY_LEVEL = ([0, 1], [2, 3], [4])


def problem(j=J, mass=MASS, force=FORCE, target=TARGET, order=NAMES):
    """A saddle system with named rows, listed by constraint in the given order."""
    rows = np.concatenate([ROWS[name] for name in order])
    starts = np.cumsum([0, *(len(ROWS[name]) for name in order)])
    entries = tuple(
        (name, int(start), len(ROWS[name]), 1) for name, start in zip(order, starts, strict=False)
    )
    j, mass, force, target = (jnp.asarray(x) for x in (j, mass, force, target))
    value = tuple(Vector(*(x[None] for x in row)) for row in j[rows])
    jacobian = Jacobian((Block(value, 0, Columns(0, 5, 1, (0,))),), (5, 5))
    mass = Diagonal(mass) if mass.ndim == 1 else Full(mass)
    return Saddle(mass, force, jacobian, target[rows], layout=RowLayout(entries)), rows


def by_null_spaces(j, mass, force, target, levels):
    """Returns a of the lexicographic problem by null-space projections of normalized rows."""
    root = np.linalg.cholesky(mass)
    b = np.linalg.solve(root, j.T).T
    length = np.linalg.norm(b, axis=1)
    b, target = b / length[:, None], target / length
    y, null = np.linalg.solve(root, force), np.eye(len(force))
    for rows in levels:
        length = np.linalg.norm(b[rows] @ null, 2)
        inverse = np.linalg.pinv(b[rows] @ null, rcond=1e-6 / max(length, 1e-6))
        y = y + inverse @ (target[rows] - b[rows] @ y)
        null = null - inverse @ b[rows] @ null
    return np.linalg.solve(root.T, y)


@pytest.mark.parametrize("mass", [MASS, np.diag(np.diag(MASS))], ids=["full", "diagonal"])
def test_levels_that_contradict_each_other(mass):
    given = np.diag(mass) if np.count_nonzero(mass) == 5 else mass
    system, _ = problem(mass=given)
    a, λ, status = jc.solvers.Priority(LEVELS).solve(system)
    expected = by_null_spaces(J, mass, FORCE, TARGET, BY_LEVEL)
    np.testing.assert_allclose(a, expected, rtol=1e-10)
    np.testing.assert_allclose(J[:2] @ a, TARGET[:2], rtol=1e-12)
    np.testing.assert_allclose(J[3] @ a, TARGET[3], rtol=1e-12)
    assert abs(J[2] @ a - TARGET[2]) > 0.1
    np.testing.assert_allclose(mass @ a, FORCE + J.T @ λ, atol=1e-12)
    np.testing.assert_allclose(λ[jnp.array([2, 4])], 0, atol=1e-12)  # dependent rows have no effect
    assert status == jc.Status.OK


def test_one_level_that_contradicts_itself_is_met_by_least_squares_and_says_so():
    j = J.copy()
    j[1] = 2 * j[0]
    system, _ = problem(j)
    a, _, status = jc.solvers.Priority(LEVELS).solve(system)
    expected = by_null_spaces(j, MASS, FORCE, TARGET, BY_LEVEL)
    np.testing.assert_allclose(a, expected, rtol=1e-10)
    assert status == jc.Status.CONFLICT
    assert jc.solvers.Priority(LEVELS, conflict=np.inf).solve(system).status == jc.Status.OK
    agreeing = TARGET.copy()
    agreeing[1] = 2 * agreeing[0]
    system, _ = problem(j, target=agreeing)
    assert jc.solvers.Priority(LEVELS).solve(system).status == jc.Status.OK


def test_order_within_a_level_does_not_matter():
    reference = jc.solvers.Priority(LEVELS).solve(problem()[0])
    for order in (NAMES[::-1], ("reach_far", "rest", "hold", "reach")):
        system, rows = problem(order=order)
        a, λ, _ = jc.solvers.Priority(LEVELS).solve(system)
        np.testing.assert_allclose(a, reference.acceleration, rtol=1e-12)
        np.testing.assert_allclose(λ, reference.multipliers[rows], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("numbers", [{}, {"damping": 0.0}, {"damping": 0.0, "cutoff": 0.0}])
def test_value_and_gradient_hold_where_rank_is_lost(numbers, dtype):
    """Compares with NumPy's projections and their differences, along a path of constant rank."""
    weight = np.arange(1.0, 6.0)
    direction = [RANDOM.normal(size=x.shape) for x in (J, MASS, FORCE, TARGET)]
    direction[1] = direction[1] + direction[1].T

    def moved(s, array):
        j, mass, force, target = (
            array(x) + s * array(dx)
            for x, dx in zip((J, MASS, FORCE, TARGET), direction, strict=True)
        )
        free = np.eye(5)
        free[2], free[4] = [0.7, -0.2, 0, 0, 0], [0, 1.0, 0, 1.0, 0]
        return array(free) @ j, mass, force, target

    def ours(s):
        numbers_in = moved(s, lambda x: jnp.asarray(x, dtype))
        solution = jc.solvers.Priority(LEVELS, **numbers).solve(problem(*numbers_in)[0])
        return jnp.asarray(weight, dtype) @ solution.acceleration

    ahead, behind = (
        weight @ by_null_spaces(*moved(s, np.asarray), BY_LEVEL) for s in (1e-5, -1e-5)
    )
    zero, one = jnp.asarray([0, 1], dtype)
    value, forward = jax.jit(lambda: jax.jvp(ours, (zero,), (one,)))()
    reverse = jax.jit(jax.grad(ours))(zero)
    rounding = 1e2 * ROUND_OFF[np.dtype(dtype)]
    expected = weight @ by_null_spaces(J, MASS, FORCE, TARGET, BY_LEVEL)
    np.testing.assert_allclose(value, expected, rtol=rounding)
    slope = (ahead - behind) / 2e-5
    np.testing.assert_allclose([forward, reverse], slope, rtol=max(DIFFERENCE, rounding))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", ["polar", "four-bar"])
def test_where_all_agree_levels_change_nothing(name, dtype):
    """Compares with the full solution for a full M, and for a loop with a level per hinge."""
    if name == "polar":
        built = scenes.build(name, dtype)
        solved, s = built.system, built.off
    else:
        solved, s = four_bar(jnp.asarray(CRANK_ROCKER, dtype), jnp.asarray((0.3, 0.9, 0.7), dtype))
    random = scenes.seeded(name, "priority")
    force = jnp.asarray(random.normal(size=s.v.shape), dtype)

    @jax.jit
    def both():
        rows = linearize(solved, s.q, s.v, s.time)
        target = jnp.asarray(random.normal(size=rows.bias.shape), dtype)
        system = saddle(solved, s.q, rows, force, target)
        levels = {name: i % 4 for i, name in enumerate(rows.layout.names)}
        return jc.solvers.Priority(levels).solve(system), jc.solvers.Dense().solve(system)

    found, expected = both()
    assert found.status == jc.Status.OK
    for got, reference in zip(found[:2], expected[:2], strict=True):
        assert got.dtype == dtype
        bound = 1e2 * ROUND_OFF[np.dtype(dtype)] * float(jnp.max(jnp.abs(reference)))
        np.testing.assert_allclose(got, reference, atol=bound)


def test_rows_with_a_compliance_are_met_as_such():
    """J a + C λ = b is equivalent to J a + √C z = b with force-free velocities z of unit mass."""
    c = np.array([0.0, 0.3, 0.2, 0.0, 0.5])
    system, _ = problem()
    a, λ, status = jc.solvers.Priority(LEVELS).solve(
        dataclasses.replace(system, compliance=jnp.asarray(c))
    )
    mass = np.block([[MASS, np.zeros((5, 5))], [np.zeros((5, 5)), np.eye(5)]])
    wider = np.hstack([J, np.diag(np.sqrt(c))])
    force = np.concatenate([FORCE, np.zeros(5)])
    expected = by_null_spaces(wider, mass, force, TARGET, BY_LEVEL)
    np.testing.assert_allclose(a, expected[:5], rtol=1e-10)
    np.testing.assert_allclose(np.sqrt(c) * λ, expected[5:], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(J @ a + c * λ, TARGET, rtol=1e-10)
    assert status == jc.Status.OK


def test_a_world_of_a_batch_goes_on_with_what_its_levels_leave():
    """A slider on a rail is joined to two rods whose lengths cannot both be kept."""
    scene = jc.Scene(dim=2)
    scene.add_body("slider", mass=1.0, inertia=1.0, position=(1.0, 0.0))
    scene.add(jc.Prismatic("rail", jc.WORLD, "slider", axis=(1.0, 0.0)))
    scene.add(jc.Distance("rod", jc.WORLD, "slider", length=1.5, point_a=(0.0, 0.8)))
    scene.add(jc.Distance("other", jc.WORLD, "slider", length=1.2, point_a=(2.0, 0.5)))
    system, state = scene.build()
    method = jc.Method(solver=jc.solvers.Priority({"rod": 1, "other": 2}))
    final, info = jax.jit(jax.vmap(lambda s: jc.rollout(system, method, s, None, 1e-3, 400)))(
        jax.tree.map(lambda x: jnp.stack([x, x]), state)
    )
    final = jax.tree.map(lambda x: x[1], final)
    left = jc.violation(system, final)
    assert left["rail"] < 1e-10
    assert left["rod"] < 1e-10
    assert left["other"] > 1e-2
    assert final.status == jc.Status.OK


def test_a_row_of_zeros_leaves_solution_and_gradient_finite():
    j = J.copy()
    j[0] = j[3] = 0

    def value(j, target):
        a, λ, _ = jc.solvers.Priority(LEVELS).solve(problem(j, target=target)[0])
        return jnp.sum(a**2) + jnp.sum(λ**2)

    slopes = jax.jit(jax.grad(value, (0, 1)))(jnp.asarray(j), jnp.asarray(TARGET))
    for slope in slopes:
        assert np.all(np.isfinite(slope))
        np.testing.assert_array_equal(slope[jnp.array([0, 3])], 0)


def test_a_level_near_the_one_above_it_gives_way():
    """Two unit rows enclose an angle θ. With damping μ the row of the lower level misses the share
    (μ²/(S² + μ²))⁶ of its target, S = sin²θ.
    """
    entries = (("above", 0, 1, 1), ("below", 1, 1, 1))

    def unmet(angle, damping):
        j = jnp.stack([jnp.array([1.0, 0.0]), jnp.stack([jnp.cos(angle), jnp.sin(angle)])])
        value = tuple(Vector(*(x[None] for x in row)) for row in j)
        jacobian = Jacobian((Block(value, 0, Columns(0, 2, 1, (0,))),), (2, 2))
        target, layout = jnp.array([0.0, 1.0]), RowLayout(entries)
        system = Saddle(Diagonal(jnp.ones(2)), jnp.zeros(2), jacobian, target, layout=layout)
        return (
            1 - j[1] @ jc.solvers.Priority({"below": 1}, damping=damping).solve(system).acceleration
        )

    def share(angle, damping):
        return (damping**2 / (jnp.sin(angle) ** 4 + damping**2)) ** 6

    angle, damping = jnp.array([0.03, 0.0548, 0.08]), jnp.array([3e-3, 3e-3, 3e-3])
    both = [jax.jit(jax.vmap(jax.value_and_grad(x, (0, 1)))) for x in (unmet, share)]
    (found, slopes), (expected, exact) = (x(angle, damping) for x in both)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(slopes, exact, rtol=1e-7)


def test_dependent_rows_that_agree_move_as_without_levels():
    system, _ = problem(target=J @ TARGET)
    expected = jc.solvers.RankSafe(always=True).solve(system)
    found = jc.solvers.Priority(LEVELS).solve(system)
    np.testing.assert_allclose(found.acceleration, expected.acceleration, rtol=1e-7)
    np.testing.assert_allclose(J @ found.acceleration, J @ TARGET, rtol=1e-12)
    assert found.status == jc.Status.OK


def test_what_levels_are_refused():
    with pytest.raises(ValueError, match="'rod' must be 0, 1, 2 or 3, got 4"):
        jc.solvers.Priority({"rod": 4})
    with pytest.raises(ValueError, match=r"no constraint 'rood\*'; there are \['hold'"):
        jc.solvers.Priority({"rood*": 1}).solve(problem()[0])
    for x in (-1.0, np.nan):
        with pytest.raises(ValueError, match=f"conflict must be zero or more, got {x}"):
            jc.solvers.Priority({}, conflict=x).check()
    with pytest.raises(ValueError, match="conflict must be a real number, got 'some'"):
        jc.solvers.Priority({}, conflict="some").check()
    for conflict in (None, np.inf):
        jc.solvers.Priority({}, conflict=conflict).check()
    unnamed = dataclasses.replace(problem()[0], layout=None)
    with pytest.raises(ValueError, match="no constraint 'rest'"):
        jc.solvers.Priority({"rest": 1}).solve(unnamed)


@pytest.mark.parametrize("rate", [5.0, 20.0, 50.0])
def test_a_rod_too_short_to_reach_disturbs_no_higher_level(rate):
    """A bob stays 1 m from the origin; a rod of 1.9 m should hold it to a point 3 m away.

    The bob reaches the nearest place, 2 m from that point, where both rows are parallel.
    """
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(0.6, 0.8))
    scene.add(jc.Distance("left", jc.WORLD, "bob", length=1.0))
    scene.add(jc.Distance("right", jc.WORLD, "bob", length=1.9, point_a=(3.0, 0.0)))
    system, state = scene.build()
    method = jc.Method(
        stabilizer=jc.Baumgarte.critical(rate), solver=jc.solvers.Priority({"right": 1})
    )

    def record(s, _):
        found = jc.violation(system, s)
        return found["left"], found["right"]

    run = jax.jit(lambda s: jc.rollout(system, method, s, None, 1e-3, 10000, record=record))
    final, (left, right) = run(state)
    assert final.status == jc.Status.OK
    assert np.max(left) < 1e-2  # while the bob is pulled in, at up to 80 m/s
    assert np.max(left[-1000:]) < 1e-5
    np.testing.assert_allclose(right[-1000:], 0.1, rtol=2e-2)
