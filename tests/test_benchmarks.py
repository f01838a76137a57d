"""Small versions of the studies in benchmarks/."""

import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import (  # noqa: E402
    accuracy,
    bounded,
    drift,
    equivalence,
    laws,
    mechanisms,
    native_share,
    residuals,
    roofline,
    stabilisation,
    tables,
    targets,
    throughput,
    timing,
)
from jaxcon.staging import operations  # noqa: E402

SMALL = ("chain-3", "planar-chain-3", "four-bar", "n-four-bar-2", "rope-5", "stewart")


@pytest.mark.parametrize("name", list(stabilisation.STABILIZERS))
def test_every_stabilizer_holds_a_double_pendulum(name):
    """The bound is rounding for projections, and else the error of RK4 steps."""
    row = stabilisation.measure("double_pendulum", np.float64, "RK4", name, 2000, 1e-3)
    assert row.remark == ""
    bound = {"projection": 1e-12, "linearized projection": 1e-12}.get(name, 1e-4)
    assert row.position < bound
    assert row.velocity < max(bound, 1e-12) * 100
    assert row.energy < 1e-3


def test_an_implicit_method_says_what_it_refuses():
    row = stabilisation.measure("pendulum", np.float64, "RATTLE", "PID", 10, 1e-3)
    assert row.remark.startswith("refused: RATTLE")
    assert np.isnan(row.position)


def test_more_sweeps_and_iterations_miss_less():
    solvers = (
        jc.solvers.GaussSeidel(sweeps=3),
        jc.solvers.GaussSeidel(sweeps=300),
        jc.solvers.InteriorPoint(),
    )
    chain, column = (
        [bounded.measure(scene, jnp.dtype("float64"), s, 20)[0].max() for s in solvers]
        for scene in ("chain", "column")
    )
    assert column[0] > column[1] > column[2]
    assert chain[0] > 1e-3
    assert max(*chain[1:], column[2]) < 1e-8


@pytest.mark.parametrize(("scene", "slides"), [("box", 0.3), ("chain", 0.7)])
def test_no_law_of_bounded_rows_is_missed_at_random_states(scene, slides):
    """Signorini's and Coulomb's laws hold one by one. Only recovery may add energy."""
    found = laws.measure(scene, jnp.dtype("float64"), laws.OneProblem(), 600)
    assert laws.beyond(found, "float64") == laws.Laws(0, 0, 0, 0, 0)
    assert np.mean(found.direction > 0) > slides  # a contact that sticks has no direction law


def test_sweeps_that_end_early_are_told_by_their_laws():
    """After few sweeps, contacts still press or penetrate, but friction never leaves its cone."""
    few = laws.measure("box", jnp.dtype("float32"), jc.solvers.GaussSeidel(sweeps=3), 300)
    over = laws.beyond(few, "float32")
    assert min(over.complementarity, over.separation, over.direction) > 5
    assert over.cone == over.energy == 0


def test_drift_grows_without_feedback_and_stays_small_with_it():
    rows = {(r[0], r[1]): r[2:] for r in drift.table(dt=2e-3, seconds=10.0)}
    perturbed, clean, exponent = rows["semi-implicit Euler", "none"]
    assert exponent > 1
    assert clean > 1e-2
    perturbed, clean, _ = rows["RK4", "none"]
    assert abs(perturbed - 1e-2) < 1e-4  # φ̇₀ t, exactly linear
    for integrator in drift.INTEGRATORS:
        perturbed, clean, _ = rows[integrator, "default"]
        assert perturbed < 1e-4
        assert clean < 1e-4


@pytest.mark.parametrize("name", SMALL)
def test_a_mechanism_starts_on_its_constraints_and_stays(name):
    mechanism = mechanisms.find(name)
    system, state = mechanism.build(jnp.float64)
    start = jc.violation(system, state)
    assert max(start.worst, start.worst_rate) < 1e-13

    @jax.jit
    def run(s):
        final, _ = jc.rollout(system, jc.Method(), s, None, 2e-3, 50, record=lambda s, i: None)
        return final, jc.violation(system, final).worst, mechanism.markers(system, final)

    final, violation, places = run(state)
    jc.raise_for_status(final)
    assert violation < targets.VIOLATION * mechanism.link
    assert np.max(np.abs(places - mechanism.markers(system, state))) > 1e-3


@pytest.mark.parametrize("name", SMALL)
def test_mujoco_simulates_the_same_mechanism(name):
    pytest.importorskip("mujoco")
    difference = equivalence.compare(mechanisms.find(name))
    assert difference.same, difference


@pytest.mark.parametrize("name", ["four-bar", "n-four-bar-10", "stewart"])
def test_mujoco_solves_loops_by_one_iteration(name):
    """MuJoCo already stops after one solver iteration, so a limit would not make it faster."""
    mujoco = pytest.importorskip("mujoco")
    model, data = equivalence.model_of(mechanisms.find(name))
    limited, one = equivalence.model_of(mechanisms.find(name))
    limited.opt.iterations, limited.opt.ls_iterations = 1, 4
    assert model.opt.iterations > 1
    for _ in range(500):
        mujoco.mj_step(model, data)
        mujoco.mj_step(limited, one)
        assert data.solver_niter[0] == 1
    np.testing.assert_array_equal(one.qpos, data.qpos)


def test_the_four_bar_is_the_ready_made_one():
    system, state = mechanisms.find("four-bar").build(jnp.float64)
    expected, start = jc.scenes.four_bar()
    for name in ("crank", "coupler", "rocker"):
        for read in (jc.position, jc.velocity, jc.angular_velocity):
            np.testing.assert_allclose(read(system, state, name), read(expected, start, name))


def test_the_motion_of_the_n_four_bar_is_the_published_one():
    """IFToMM A02, N = 2: the position of the top of the first crank after one second."""
    angle = mechanisms.crank_angle(2, 1.0)
    top = np.cos(angle), np.sin(angle)
    np.testing.assert_allclose(top, (-0.19502030194944, -0.98079920566217), atol=1e-9)


def test_an_unknown_mechanism_is_named():
    for name in ("chain", "chain-", "chain-x", "five-bar"):
        with pytest.raises(ValueError, match=f"'{name}' is unknown.*chain-<n>"):
            mechanisms.find(name)


def test_operations_are_counted():
    def polynomial(x):
        return x * x + 3.0 * x

    def looped(x):
        return jax.lax.scan(lambda c, _: (jnp.sin(c), None), x, None, 5)[0].sum()

    assert operations.count(jax.make_jaxpr(polynomial)(np.ones(8)).jaxpr) == 24
    assert operations.count(jax.make_jaxpr(looped)(np.ones(8)).jaxpr) == 48
    assert operations.count(jax.make_jaxpr(jnp.dot)(np.ones((2, 3)), np.ones(3)).jaxpr) == 12


def test_operations_are_counted_once():
    def repeated(x, y):
        """The product and the sine count once, the two sums each, and the unused cosine never."""
        jnp.cos(x)
        return x * y + jax.jit(lambda a, b: b * a)(x, y) + jnp.sin(x), jnp.sin(x)

    def looped(x):
        def body(c, _):
            return c * x + x * c, None

        return jax.lax.scan(body, x, None, 5)[0]

    def solved(x):
        def solve(_, b):
            return b / x + x * x

        return jax.lax.custom_linear_solve(lambda z: x * z, x * x, solve)

    ones = np.ones(8)
    assert operations.count(jax.make_jaxpr(repeated)(ones, ones).jaxpr) == 4 * 8
    assert operations.count(jax.make_jaxpr(looped)(ones).jaxpr) == 5 * 2 * 8
    assert operations.count(jax.make_jaxpr(solved)(ones).jaxpr) == 3 * 8


def test_the_operations_of_a_step_are_counted():
    found = roofline.work("pendulum", jc.Method(), np.float32)
    assert 100 < found.operations < 10_000
    assert found.state == (7 + 6 + 2 + 1) * 4  # q, v, time in two parts, status


def test_a_rate_counts_only_where_the_run_is_accurate():
    work, rate = roofline.Work(1.0, 1), {1: timing.Rate(30.0, 29.0, 31.0)}
    good = accuracy.Accuracy(1e-4, 1e-3, 6e-4, True)
    bad = accuracy.Accuracy(1e-4, 1e-3, 4e-4, True)
    for found, said in ((good, "aim"), (bad, "does not count")):
        peer = timing.Rate(1.0, 1.0, 1.0)
        row = tables.Row("pendulum", "float32", rate, {1: 1.0}, found, work, peer)
        assert tables.verdict(row) == said
    assert not accuracy.Accuracy(1e-2, 0.0, 1.0, True).counts
    assert not accuracy.Accuracy(0.0, 0.0, 1.0, False).counts


def test_a_rate_is_measured():
    rate, seconds = throughput.run_batch("pendulum", jc.Method(), np.float32, 2, work=20, repeats=2)
    assert 0 < rate.least <= rate.median <= rate.most
    assert seconds > 0


def test_a_repeat_calls_until_it_has_lasted_long_enough(monkeypatch):
    """The clock is replaced by one on which a call takes 1/16 s."""
    calls = []
    monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: len(calls) / 16))
    for seconds, expected in ((0.25, 4), (0.2, 4), (0.0, 1)):
        calls.clear()
        rate = timing.rate(lambda: calls.append(None), 3.0, 2, seconds)
        assert len(calls) == 2 * expected
        assert rate.least == rate.most == 48.0


@pytest.mark.parametrize("dtype", residuals.LIMIT)
@pytest.mark.parametrize("name", ["pendulum", "four-bar", "n-four-bar-2"])
def test_every_solver_leaves_only_rounding(name, dtype, monkeypatch):
    monkeypatch.setitem(targets.TIKHONOV, "n-four-bar-2", 1e-5)
    rows = list(residuals.measure(name, dtype, list(residuals.SOLVERS), [0.02]))
    assert len(rows) == len(residuals.SOLVERS)
    assert all(row.verdict == "passes" for row in rows), "\n".join(map(str, rows))
    assert any(row.motion > 0 for row in rows)


def test_a_solution_of_another_system_is_seen():
    """Rejects the solution of the regularized system, and a solution with wrong λ."""
    (plain,) = residuals.systems("four-bar", "float64", [0.0])
    exact = residuals.on_arrays(jc.solvers.Dense().solve, plain)
    numbers, which = residuals.Numbers(plain), ("four-bar", "float64", "-", 0.0)
    softened = residuals.solve(jc.solvers.Dense, plain, residuals.regularized(plain, 1e-6), 1e-6)
    found = residuals.judged(numbers, softened, exact, numbers.condition(), which)
    assert found.verdict == "fails: constraint, distance"
    off = exact._replace(multipliers=exact.multipliers * (1 + 1e-9))
    found = residuals.judged(numbers, off, exact, numbers.condition(), which)
    assert found.verdict == "fails: motion, distance"


@pytest.mark.parametrize("name", ["pendulum", "four-bar"])
def test_steps_batched_by_hand_are_those_of_vmap(name):
    system, state = mechanisms.find(name).build(jnp.float64)
    method, states = jc.Method(), throughput.worlds(state, 3)
    expected = jax.jit(native_share.plain(system, method, 20))(states)
    found = jax.jit(native_share.by_hand(system, method, 20))(native_share.turned(states))
    found = native_share.turned(found, last=False)
    assert np.max(np.abs(expected.v - states.v)) > 1e-3
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=IDENTITY, atol=IDENTITY)
