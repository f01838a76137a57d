"""Methods compared on one scene, checked by other integrators and by theory."""

import dataclasses
import json
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxcon as jc
from jaxcon.__main__ import main
from jaxcon.analysis import ledger, reference, sweep
from jaxcon.analysis.front import LeftOut, Run
from jaxcon.analysis.listing import table
from jaxcon.analysis.tradeoff import _go
from jaxcon.analysis.trials import Course, Inputs, Observer, Points, Problem, Trip

G, HORIZON = 9.81, 1.0
METHODS = {
    "Euler": jc.Method(solver=jc.solvers.Sparse()),
    "RK4": jc.Method(jc.RK4(), solver=jc.solvers.Sparse()),
    "both": jc.Method(jc.integrators.RATTLE(), jc.Projection()),
}


def double_pendulum(dtype=None):
    """Two particles on rods of 1 m, released level."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G), dtype=dtype)
    scene.add_particle("first", mass=1.0, position=(1.0, 0.0))
    scene.add_particle("second", mass=1.0, position=(2.0, 0.0))
    scene.add(jc.Distance("upper", jc.WORLD, "first"))
    scene.add(jc.Distance("lower", "first", "second"))
    return scene.build()


def by_others(times):
    """Returns the motion in two angles by Dormand and Prince's order eight, (times, 2, 2) [m]."""

    def rate(_, y):
        a, b, wa, wb = y
        c, s = np.cos(a - b), np.sin(a - b)
        mass = np.array([[2.0, c], [c, 1.0]])
        force = [-s * wb**2 - 2 * G * np.sin(a), s * wa**2 - G * np.sin(b)]
        return np.concatenate([[wa, wb], np.linalg.solve(mass, force)])

    start, options = [np.pi / 2, np.pi / 2, 0.0, 0.0], {"rtol": 1e-13, "atol": 1e-13}
    y = solve_ivp(rate, (0, times[-1]), start, "DOP853", times, **options).y
    first = np.stack([np.sin(y[0]), -np.cos(y[0])], -1)
    return np.stack([first, first + np.stack([np.sin(y[1]), -np.cos(y[1])], -1)], 1)


def compare(**options):
    system, state = double_pendulum()
    known = {"methods": METHODS, "batch": 4, "budget": 1e5, "progress": False}
    return jc.tradeoff(system, state, HORIZON, **known | options)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("tradeoff") / "found.npz"


@pytest.fixture(scope="module")
def result(file):
    return compare(file=file)


@pytest.mark.parametrize("asked", [1e-2, 1e-4, 1e-7])
def test_what_is_recommended_is_as_accurate_as_asked(result, asked):
    chosen = result.recommend(error=asked)
    assert chosen.error <= asked
    with jax.enable_x64(chosen.dtype == "float64"):
        system, state = double_pendulum(chosen.dtype)
        steps = round(HORIZON / chosen.dt)
        run = jax.jit(lambda s: jc.rollout(system, chosen.method, s, None, chosen.dt, steps)[1])
        part = steps // 10
        places = np.asarray(run(state).q, np.float64)[part - 1 :: part].reshape(10, 2, 2)
    exact = by_others(np.linspace(0, HORIZON, 11)[1:])
    off = np.max(np.linalg.norm(np.swapaxes(places, 1, 2) - exact, axis=-1))
    assert off <= asked
    np.testing.assert_allclose(off, chosen.error, rtol=0.05, atol=1e-6 if asked > 1e-7 else 1e-10)


def test_the_front_falls_and_nothing_cheaper_is_as_accurate(result):
    front = result.front
    assert len(front) > 2
    for one, next_one in zip(front, front[1:], strict=False):
        assert one.cost < next_one.cost
        assert one.error > next_one.error
    for run in result.runs:
        assert not run.ok or not any(run.cost < x.cost and run.error < x.error for x in front)
    assert result.recommend(cost=math.inf) is front[-1]
    with pytest.raises(ValueError, match="least is"):
        result.recommend(cost=1e-12)
    with pytest.raises(ValueError, match="the reference itself"):
        result.recommend(error=1e-16)
    with pytest.raises(ValueError, match="either error"):
        result.recommend()
    for wrong in (True, -1.0, 0.0, math.nan, "1e-3", [1e-3]):
        with pytest.raises(ValueError, match="recommend: error= "):
            result.recommend(error=wrong)
        with pytest.raises(ValueError, match="recommend: cost= "):
            result.recommend(cost=wrong)


def test_the_limit_of_stability_is_that_of_the_exact_law():
    """Feedback of rate β is stable under RK4 up to β h = 2.785; failed runs above it are listed."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    scene.add_particle("bob", mass=1.0, position=(0.1, -math.sqrt(0.99)))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    stiff = {"stiff": jc.Method(jc.RK4(), jc.Baumgarte.critical(100.0), jc.solvers.Sparse())}
    known = {"dtypes": ("float64",), "dts": (0.3, 0.06, 0.03, 0.02, 0.01), "gradients": False}
    found = jc.tradeoff(*scene.build(), 3.0, methods=stiff, batch=4, **known, progress=False)
    exact = jc.stabilizers.largest_stable_rate(jc.RK4(), 1.0) / 100.0
    (limit,) = found.limits
    assert 0.95 * exact < limit.stable < limit.unstable < 1.05 * exact
    bad = [run for run in found.runs if not run.ok]
    assert [run.dt for run in bad] == [0.3, 0.06, 0.03]
    assert all(f"{run.dt:.3g} s ({run.outcome})" in str(found) for run in bad)
    assert all(run.dt < exact for run in found.front)


def test_a_scene_at_rest_does_not_diverge_by_rounding():
    """Nothing moves, while float32 resolves the energy to seven digits only."""
    down = np.array([math.sin(0.3), -math.cos(0.3)])
    scene = jc.Scene(dim=2, gravity=G * down)
    scene.add_particle("bob", mass=1.3, position=1.1 * down)
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    known = {"methods": {"RK4": METHODS["RK4"]}, "dtypes": "float32", "dts": 0.1, "batch": 2}
    found = jc.tradeoff(*scene.build(), 1.0, **known, gradients=False, progress=False)
    assert [run.outcome for run in found.runs] == ["ok"]
    assert found.recommend(error=1e-5).dt == 0.1


def test_what_does_not_fit_is_listed_with_its_reason(result):
    refused = [x for x in result.left_out if x.name == "both"]
    assert [x.dtype for x in refused] == ["float64", "float32"]
    assert all("Projection has no place beside it" in x.reason for x in refused)
    assert "both" in str(result)


def test_costs_of_gradients_and_memory_are_there(result):
    for run in result.runs:
        if run.ok:
            figures = np.array([run.cost, run.alone, run.gradient, run.memory])
            assert np.all(np.isfinite(figures) & (figures > 0))


def test_a_second_call_goes_on_and_lists_what_it_has_no_time_for(result, file, monkeypatch):
    def never(*_):
        raise AssertionError("it ran again")

    monkeypatch.setattr(sweep.Sweep, "measure", never)
    monkeypatch.setattr(sweep.Sweep, "gradients", never)
    more = METHODS | {"Heun": jc.Method(jc.integrators.Heun())}
    again = compare(file=file, methods=more, budget=1e-3)
    assert [run.plain() for run in again.runs] == [run.plain() for run in result.runs]
    late = [x.name for x in again.left_out if "no time" in x.reason]
    assert late == ["Heun", "Heun"]
    system, state = double_pendulum()
    with pytest.raises(ValueError, match="not the same: the horizon"):
        jc.tradeoff(system, state, 2.0, methods=METHODS, batch=4, file=file, progress=False)


def test_the_keyboard_ends_it_with_what_was_found(result, file, monkeypatch):
    def pressed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep.Sweep, "measure", pressed)
    found = compare(file=file, methods=METHODS | {"Heun": jc.Method(jc.integrators.Heun())})
    assert found.runs
    assert [x.name for x in found.left_out if "keyboard" in x.reason] == ["Heun", "Heun"]


def test_the_diagram_and_the_file_of_figures(result, tmp_path):
    picture = tmp_path / "diagram.png"
    result.plot(picture)
    assert picture.stat().st_size > 10_000
    found = json.loads(result.to_json(tmp_path / "figures.json"))
    assert len(found["runs"]) == len(result.runs)
    assert len(result.table.splitlines()) == len(result.runs) + 1


def test_the_diagram_has_the_unit_of_its_runs(result):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    for unit in ("m", "of q"):
        runs = tuple(dataclasses.replace(run, unit=unit) for run in result.runs)
        axes = dataclasses.replace(result, runs=runs).plot()
        assert axes.get_ylabel() == f"error [{unit}]"
        pyplot.close(axes.figure)


def test_the_table_names_its_numbers_above_them(result):
    lines = result.table.splitlines()
    places = [m.end() for m in re.finditer(r"error|angle|violation|energy|cost|alone", lines[0])]
    shown = {(run.name, run.dtype, f"{run.dt:.3g}"): run for run in result.runs}
    for line in lines[1:]:
        name, dtype, dt = re.split(r"  +", line)[:3]
        run = shown.pop((name, dtype, dt))
        assert line[: places[0]].endswith(f"{run.error:.2e}")
        assert line[: places[4]].endswith(f"{run.cost:.2e}")
    assert not shown
    for unit in ("[m, or of q]", "[rad]", "[J]", "one world [s]", "[B]"):
        assert unit in str(result)
    run = result.front[0]
    assert f"h = {run.dt:.3g} s: error {run.error:.2g} m, violation" in str(run)
    late = dataclasses.replace(run, gradient=math.nan, name="a" * 60, told=False)
    assert re.search(
        rf"^a{{60}}  .* <{run.error:.2e} .* - ", "\n".join(table([late])), re.MULTILINE
    )
    lost = dataclasses.replace(run, outcome="NON_FINITE at 0.5 s")
    assert str(lost).endswith("diverged, NON_FINITE at 0.5 s")


def test_a_result_without_runs_says_so_in_words_and_in_its_picture(result, tmp_path):
    late = [LeftOut("RK4", dtype, "no time") for dtype in ("float64", "float32")]
    empty = dataclasses.replace(result, runs=(), limits=(), left_out=tuple(late), seconds=61.0)
    assert "empty: no method was run in 61 s" in str(empty)
    assert str(empty).endswith("left out:\n  no time:\n    RK4, float64, float32")
    empty.plot(tmp_path / "diagram.png")
    assert (tmp_path / "diagram.png").stat().st_size > 5_000
    with pytest.raises(ValueError, match="no method was run"):
        empty.recommend(error=1e-3)


def made(horizon):
    system, state = double_pendulum()
    problem = Problem(system, Points.of(jax.device_get(state)), horizon, Inputs(10))
    observe = Observer(problem)
    course = reference.Course(problem, reference.method_for(system), np.float64)
    return reference.make(course, observe, 0.0, 60.0)


def test_the_error_of_the_reference_is_no_less_than_it_is():
    found = made(2.0)
    q = found.points.q[1:].reshape(10, 2, 2)
    off = np.linalg.norm(np.swapaxes(q, 1, 2) - by_others(found.points.time[1:]), axis=-1)
    assert np.all(np.max(off, axis=1) <= found.error + 1e-11)  # error of by_others
    assert found.floor < 1e-9
    assert found.until == 2.0


def test_a_chaotic_motion_is_compared_as_far_as_the_reference_is_good():
    found = made(30.0)
    assert 9.0 < found.until < 30.0
    assert found.last == round(found.until / 3.0)
    assert found.floor < 1e-3 * found.size
    assert found.error[-1] > 10 * found.floor


class Told:
    """A fake course whose runs have given errors at ten times: arrays (10,) or numbers."""

    def __init__(self, *off):
        self.problem = Problem(*free_mass_at_rest(), 1.0, Inputs(10))
        self.off = iter(off)

    def compile(self):
        pass

    def go(self, dt, count):
        t = np.linspace(0.1, 1.0, 10)
        q = np.stack([1.0 + t, np.zeros(10) + next(self.off)], axis=1)
        points = Points(q, np.ones((10, 2)), t, np.zeros((10, 0)))
        return Trip(dt, points, jc.Status.OK, 0.0, 0.0)


def free_mass_at_rest():
    system, state = free_mass()
    return system, Points.of(jax.device_get(state))


def test_a_reference_does_not_trust_two_runs_that_agree_by_chance():
    course = Told(1e-3, 1e-5 + 5e-9, 1e-5, 0.0, 2e-8, 3e-8, 5e-8, 8e-8)
    found = reference.make(course, Observer(course.problem), 0.0, 60.0)
    off = np.abs(found.points.q[1:, 1])
    assert np.all(off <= 2 * found.error)
    assert found.floor < 1e-7


def test_of_chaotic_runs_those_that_agree_the_longest_are_the_reference():
    late = np.where(np.arange(10) < 8, 0.0, 1.0)
    wild = [0.5 + 0.0 * late, -0.4 + 0.0 * late]  # 0.9 apart, less than the others at the end
    fine = [1e-5 + late, 2e-5 - 0.3 * late, 2e-5 + 1.2 * late, 2e-5 - late]
    course = Told(*wild, *fine)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reference, "MOST", reference.FIRST << 5)
        found = reference.make(course, Observer(course.problem), 0.0, 60.0)
    assert found.until == 0.8


def free_mass():
    """A free particle of 2 kg in the plane."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("mass", mass=2.0, position=(1.0, 0.0))
    scene.add(jc.forces.ExternalWrench("push", "mass"))
    return scene.build()


def test_the_first_run_of_a_program_is_not_timed(monkeypatch):
    """A first run can take ten times as long as the next; here it pretends to take 1,000 s."""
    go, begun = Course.go, set()

    def slow_at_first(self, dt, count):
        trip, first = go(self, dt, count), self not in begun
        begun.add(self)
        slow = first and self.dtype == np.float32
        return dataclasses.replace(trip, seconds=1e3) if slow else trip

    monkeypatch.setattr(Course, "go", slow_at_first)
    known = {"methods": {"RK4": jc.Method(jc.RK4())}, "batch": 2, "gradients": False}
    found = jc.tradeoff(
        *free_mass(), 1.0, np.ones((1, 2)), dtypes=("float32",), budget=1e7, **known
    )
    assert len(found.runs) > 1
    assert all(run.alone < 100 for run in found.runs)


def test_single_precision_where_double_is_turned_off():
    """RK4 is exact at every step under forces that change every half second."""
    with jax.enable_x64(False):
        system, state = free_mass()
        push = np.array([[2.0, 0.0], [-4.0, 6.0]])
        known = {"methods": {"RK4": jc.Method(jc.RK4())}, "batch": 2, "gradients": False}
        found = jc.tradeoff(system, state, 1.0, push, dts=(0.1, 0.04), **known, progress=False)
        assert state.q.dtype == jnp.float32
        assert not jax.config.read("jax_enable_x64")
    assert [run.dtype for run in found.runs] == ["float64"] * 2 + ["float32"] * 2
    assert [run.dt for run in found.runs[:2]] == [0.1, 1 / 30]
    assert all(run.error < 1e-14 for run in found.runs[:2])
    assert all(run.error < 1e-6 for run in found.runs[2:])
    assert all(math.isnan(run.gradient) for run in found.runs)


@pytest.mark.parametrize("kind", ["rows", "policy"])
def test_inputs_mean_the_same_at_every_step(kind):
    """RK4 integrates forces held for 0.2 s exactly, with two or seven steps each."""
    system, state = free_mass()
    rows = np.random.default_rng(0).normal(size=(5, 2))
    held = {"rows": (rows, None), "policy": (lambda s: -3.0 * s.q - s.v, 0.2)}[kind]
    inputs = Inputs.of(system, *held, 1.0)
    problem = Problem(system, Points.of(jax.device_get(state)), 1.0, inputs)
    course = reference.Course(problem, jc.Method(jc.RK4()), np.float64)
    course.compile()
    x, v = np.array([1.0, 0.0]), np.zeros(2)
    for i in range(5):
        a = (rows[i] if kind == "rows" else -3.0 * x - v) / 2.0
        x, v = x + 0.2 * v + 0.02 * a, v + 0.2 * a
    for count in (2, 7):
        trip = course.go(problem.dt(count), count)
        np.testing.assert_allclose(trip.points.q[-1], x, rtol=1e-12)
        np.testing.assert_allclose(trip.points.v[-1], v, rtol=1e-12)


def test_inputs_are_held_for_the_same_time_at_every_step():
    scene = jc.Scene(dim=2)
    scene.add_particle("mass", mass=1.0)
    scene.add(jc.forces.ExternalWrench("push", "mass"))
    system, _ = scene.build()
    assert Inputs.of(system, None, None, 1.0).parts == 10
    assert Inputs.of(system, np.ones(2), None, 1.0).rows.shape == (10, 2)
    held = Inputs.of(system, np.arange(6.0).reshape(3, 2), None, 1.0)
    np.testing.assert_array_equal(held.rows[:, 0], np.repeat([0.0, 2.0, 4.0], 4))
    assert Inputs.of(system, lambda s: s.q, 0.05, 1.0).parts == 20
    with pytest.raises(ValueError, match="need hold="):
        Inputs.of(system, lambda s: s.q, None, 1.0)
    with pytest.raises(ValueError, match="must divide the horizon"):
        Inputs.of(system, lambda s: s.q, 0.3, 1.0)
    with pytest.raises(ValueError, match=r"2 channels of \['push'\].*\(4, 3\)"):
        Inputs.of(system, np.ones((4, 3)), None, 1.0)
    with pytest.raises(ValueError, match="belongs to controls that are a function"):
        Inputs.of(system, np.ones((4, 2)), 0.1, 1.0)


def test_a_turn_in_space_counts_as_the_way_of_its_points():
    """A rotation θ and a displacement d give √(d² + k²θ²); k² = 0.3/2 for the largest moment."""
    scene = jc.Scene()
    scene.add_body("block", mass=2.0, inertia=(0.3, 0.2, 0.15))
    system, state = scene.build()
    ruler, angle = reference.Ruler(system, state.q), 0.7
    turned = np.array(state.q)
    turned[system.layout.q("block")] = [0.3, 0, 0.4, -np.cos(angle / 2), 0, -np.sin(angle / 2), 0]
    far, turn = ruler(np.array(state.q)[None], turned[None])
    np.testing.assert_allclose(turn, angle, rtol=1e-12)
    np.testing.assert_allclose(far, np.hypot(0.5, np.sqrt(0.15) * angle), rtol=1e-12)


def test_what_went_far_away_is_infinitely_far_without_a_warning():
    system, start = free_mass_at_rest()
    far, _ = reference.Ruler(system, start.q)(start.q[None], np.array([[1e200, -1e200]]))
    assert far == [math.inf]


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"dts": (2.0,)}, ValueError, "steps within the horizon"),
        ({"dtypes": ("float16",)}, ValueError, "float16"),
        ({"methods": [jc.Method()]}, TypeError, "mapping from names"),
        ({"methods": {"RK4": jc.RK4()}}, TypeError, "jc.Method"),
        ({"batch": 0}, ValueError, "batch"),
        ({"budget": 0.0}, ValueError, "budget"),
    ],
)
def test_bad_options_are_named(options, error, words):
    with pytest.raises(error, match=words):
        compare(**options)


def test_a_step_asked_for_that_takes_longer_than_the_budget_is_listed():
    """That step would need ten billion steps, so that it is not run."""
    system, state = free_mass()
    known = {"methods": {"RK4": jc.Method(jc.RK4())}, "batch": 2, "gradients": False}
    asked = {"dts": (0.1, 1e-10), "dtypes": ("float64",), "budget": 30.0, "progress": False}
    found = jc.tradeoff(system, state, 1.0, **known, **asked)
    assert [run.dt for run in found.runs] == [0.1]
    assert any("each run would take" in x.reason for x in found.left_out)
    assert str(found)


def test_the_first_gradient_is_not_begun_where_it_may_outlast_the_budget():
    """The first gradient compiles longer than any run; a second one lasts as long as the first."""
    clock = ledger.Clock(300.0)
    assert clock.lasts("runs")
    clock.longest["runs"] = 36.0
    assert clock.lasts("runs")
    clock.begin -= 183.0
    assert clock.lasts("runs")
    assert not clock.lasts("gradients")
    clock.longest["gradients"] = 80.0
    assert clock.lasts("gradients")


class Watch:
    """A manual clock in place of `time`."""

    now = 0.0

    def perf_counter(self):
        return self.now


@pytest.mark.parametrize(
    ("slow", "runs", "gradients"),
    [
        (1.0, ["a", "b", "c"], ["a", "b", "c"]),
        (2.0, ["a", "b", "c"], ["a", "b"]),
        (4.0, ["a", "b", "c"], []),
        (10.0, ["a"], []),
        (20.0, [], []),
    ],
)
def test_the_budget_bounds_all_of_it(monkeypatch, slow, runs, gradients):
    """Every part takes `slow` times as long; parts that are left out are listed."""
    watch, done, slopes = Watch(), [], []
    monkeypatch.setattr(ledger, "time", watch)
    run = Run("", "float64", 0.1, "ok", 1e-3, True, 0.0, 0.0, 0.0, 1.0, cost=1.0)

    class Timed:
        def measure(self, name, method, dtype):
            done.append(name)
            watch.now += slow
            return sweep.Unit((dataclasses.replace(run, name=name),), compiling=0.7 * slow)

        def gradients(self, unit):
            slopes.append(unit.runs[0].name)
            watch.now += 2 * slow
            return dataclasses.replace(unit, differentiated=True)

    clock = ledger.Clock(20.0)
    with clock.timing("reference"):
        watch.now += slow
    wanted = [ledger.Wanted(name, jc.Method(), "float64", None) for name in "abc"]
    late = _go(Timed(), ledger.Ledger(None, {}), clock, wanted, (True, False))
    assert (done, slopes) == (runs, gradients)
    assert clock.spent <= 1.5 * 20.0
    assert {x.name for x in late} == set("abc") - set(gradients)


def test_one_step_and_one_precision_need_no_list_and_one_world_no_batch():
    system, state = free_mass()
    known = {"methods": {"RK4": jc.Method(jc.RK4())}, "batch": 2, "gradients": False}
    found = jc.tradeoff(system, state, 1.0, dts=0.1, dtypes="float64", **known, progress=False)
    assert [(run.dt, run.dtype) for run in found.runs] == [(0.1, "float64")]
    many = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    with pytest.raises(ValueError, match=r"one world, got a state with q of shape \(2, 2\)"):
        jc.tradeoff(system, many, 1.0)


def test_what_fails_while_it_runs_is_listed_and_the_rest_goes_on(monkeypatch):
    def short_of_memory(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")

    def full(*_):
        raise OSError("no space left on device")

    system, state = free_mass()
    known = {"methods": {"RK4": jc.Method(jc.RK4())}, "batch": 2, "gradients": False}
    known |= {"dts": (0.1,), "dtypes": ("float64",), "progress": False}
    monkeypatch.setattr(sweep.Pace, "seconds", short_of_memory)
    found = jc.tradeoff(system, state, 1.0, **known)
    assert ["RESOURCE_EXHAUSTED" in x.reason for x in found.left_out] == [True]
    monkeypatch.setattr(sweep.Sweep, "measure", full)
    found = jc.tradeoff(system, state, 1.0, **known)
    assert ["no space left" in x.reason for x in found.left_out] == [True]


def test_what_other_code_found_is_not_gone_on_from(result, file, monkeypatch):
    monkeypatch.setattr(ledger, "code", lambda: "other")
    with pytest.raises(ValueError, match="not the same: the code of jaxcon"):
        compare(file=file)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--seconds", "-1"], "--seconds: must be positive and finite, got -1"),
        (["--error", "nan"], "--error: must be positive and finite, got nan"),
        (["--cost", "0"], "--cost: must be positive and finite, got 0"),
        (["--batch", "0"], "--batch: must be a whole number from 1, got 0"),
    ],
)
def test_the_command_line_refuses_a_number_before_it_begins(options, words, capsys):
    with pytest.raises(SystemExit):
        main(["tradeoff", "four_bar", *options])
    assert words in capsys.readouterr().err


def test_the_command_line_says_what_it_cannot_use_before_it_begins(capsys, tmp_path):
    scene = tmp_path / "scene.py"
    scene.write_text("def nothing():\n    return None\n")
    assert main(["tradeoff", f"{scene}:nothing"]) == 2
    assert "nothing in" in (said := capsys.readouterr().out)
    assert "must return (system, state)" in said
    assert main(["tradeoff", str(scene)]) == 2
    assert "scene.py:function" in capsys.readouterr().out
    assert main(["tradeoff", f"{tmp_path}/none.py:drop"]) == 2
    assert f"there is no file {tmp_path}/none.py" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["tradeoff", "four_bar", "--picture", f"{tmp_path}/none/diagram.png"])
    assert "there is no folder for" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["tradeoff", "four_bar", "--json", str(tmp_path)])
    assert "is a folder" in capsys.readouterr().err


def test_a_scene_that_nobody_knows_is_named_by_the_command_line(capsys):
    assert main(["tradeoff", "five_bar"]) == 2
    assert "four_bar" in capsys.readouterr().out


def test_a_start_off_its_constraints_is_taken_there():
    system, state = double_pendulum()
    off = dataclasses.replace(state, q=state.q.at[1].add(0.01))
    problem = Problem(system, Points.of(jax.device_get(off)), 1.0, Inputs(10))
    observe = Observer(problem)
    on, moved = reference.started(problem, observe)
    assert 1e-3 < moved < 2e-2
    assert observe(Points(*(x[None] for x in on.start))).violation[0] < 1e-9
