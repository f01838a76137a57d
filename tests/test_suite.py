"""The benchmark suite: comparison with a baseline, and costs at equal error."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

import benchmarks  # noqa: E402
from benchmarks import __main__ as command  # noqa: E402
from benchmarks import equal_error, motions, pictures, suite  # noqa: E402
from benchmarks import work_precision as runs  # noqa: E402
from benchmarks import work_precision_peers as peers  # noqa: E402
from benchmarks.entries import ENTRIES  # noqa: E402
from benchmarks.suite import HIGHER, LOWER, Baseline, Entry, Found, Metric, Outcome  # noqa: E402
from benchmarks.work_precision import Point  # noqa: E402

PARTS = {"peers", "roofline", "work_precision_peers"}
"""Modules with their own command that belong to an entry of another name."""
NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("better", "now", "before", "worse"),
    [
        (HIGHER, 6.7, 10.0, False),
        (HIGHER, 6.6, 10.0, True),
        (HIGHER, 100.0, 10.0, False),
        (LOWER, 14.9, 10.0, False),
        (LOWER, 15.1, 10.0, True),
        (LOWER, 0.1, 10.0, False),
        (LOWER, 0.9, 0.0, False),  # both values are below the floor
        (LOWER, 1.6, 0.0, True),
        (LOWER, NAN, 10.0, True),
        (HIGHER, INF, 10.0, True),
        (HIGHER, 1.0, NAN, False),
    ],
)
def test_a_number_may_get_worse_by_its_tolerance(better, now, before, worse):
    assert Metric("x", now, "", better, 1.5, floor=1.0).worse_than(before) is worse


def test_a_baseline_keeps_what_transfers_and_names_what_got_worse(tmp_path):
    old = Outcome((Metric("ratio", 2.0), suite.seconds("time", 3.0), Metric("none", NAN)))
    found = {"a": old, "b": Outcome(failed="fails"), "c": Outcome(left_out="needs x")}
    Baseline().updated("quick", found, {"cores": 2}).write(tmp_path / "baseline.json")
    baseline = Baseline.read(tmp_path / "baseline.json")
    assert baseline.values == {"quick": {"a": {"ratio": 2.0}}}
    assert baseline.machines == {"quick": {"a": {"cores": 2}}}
    assert baseline.worse("quick", {"a": old}) == []
    assert baseline.worse("full", {"a": Outcome((Metric("ratio", 0.1),))}) == []
    assert baseline.worse("quick", {"a": Outcome((Metric("ratio", 1.0),))}) == [
        "a: ratio was 2 and is 1"
    ]
    assert baseline.worse("quick", {"a": Outcome((Metric("other", 1.0),))}) == [
        "a: ratio is missing"
    ]
    assert baseline.worse("quick", found) == ["b: fails"]
    again = baseline.updated("quick", {"d": Outcome((Metric("x", 1.0),))}, {})
    assert again.of("quick", "a") == {"ratio": 2.0}


@pytest.fixture
def fakes(monkeypatch):
    """Entries of a fake suite: one with settable values, one that fails, one that is skipped."""
    values = {"fast": 4.0}

    def fast(quick):
        return Found((Metric("ratio", values["fast"] / (2 if quick else 1)),), Path.touch)

    def breaks(quick):
        raise ValueError("no scene")

    entries = {
        "fast": Entry("fast", "Is fast.", fast),
        "breaks": Entry("breaks", "Breaks.", breaks),
        "absent": Entry("absent", "Is not there.", fast, ("no_such_package",)),
    }
    monkeypatch.setattr(command, "ENTRIES", entries)
    return values


def test_the_command_compares_and_updates(fakes, tmp_path, capsys):
    base, out = tmp_path / "baseline.json", tmp_path / "out.json"
    compare = ["--compare", str(base)]
    assert command.main(["fast", *compare, "--update", "--json", str(out)]) == 0
    kept = json.loads(out.read_text())
    assert kept["entries"]["fast"]["metrics"][0]["value"] == 4.0
    assert (tmp_path / kept["entries"]["fast"]["picture"]).exists()
    assert command.main(["fast", *compare]) == 0
    assert command.main(["fast", "--quick", *compare]) == 0  # quick runs have their own baseline
    fakes["fast"] = 1.0
    assert command.main(["fast", *compare]) == 1
    assert "fast: ratio was 4 and is 1" in capsys.readouterr().out
    assert command.main(["fast", "absent"]) == 0
    assert "needs no_such_package" in capsys.readouterr().out
    assert command.main(["breaks", "fast"]) == 1
    shown = capsys.readouterr().out
    assert "ValueError('no scene')" in shown
    assert "| fast | ratio | 1 |" in shown


def test_the_command_says_what_there_is(fakes, capsys):
    assert command.main(["--list"]) == 0
    assert "Is fast." in capsys.readouterr().out
    with pytest.raises(SystemExit):
        command.main(["slow"])
    assert "unknown benchmarks ['slow']" in capsys.readouterr().err


def test_every_study_is_in_the_suite():
    folder = Path(benchmarks.__file__).parent
    studies = {x.stem for x in folder.glob("*.py") if "\ndef main() -> None:" in x.read_text()}
    assert studies - PARTS <= set(ENTRIES)
    assert all(entry.about.endswith(".") for entry in ENTRIES.values())


def test_a_couple_of_entries_run_small(tmp_path, capsys):
    out = tmp_path / "out.json"
    names = ["equal_error", "needed"]
    assert command.main([*names, "--quick", "--json", str(out)]) == 0, capsys.readouterr().out
    entries = json.loads(out.read_text())["entries"]
    assert (tmp_path / entries["equal_error"]["picture"]).stat().st_size > 1000
    for name in names:
        metrics = entries[name]["metrics"]
        assert len({m["name"] for m in metrics}) == len(metrics) > 1
        assert all(m["value"] > 0 for m in metrics)


STEPS = {"pendulum": 2000, "double pendulum": 600, "four-bar": 200, "Andrews": 1200}


@pytest.mark.parametrize("name", list(motions.MOTIONS))
def test_both_codes_come_to_the_known_end(name):
    """The comparison with MuJoCo, which closes loops softly, runs only if MuJoCo is installed."""
    motion, steps = motions.MOTIONS[name](), STEPS[name]
    for form in motion.forms:
        assert runs.Ours(motion, form, "RK4", "float64").error(steps) < 5e-6
    pytest.importorskip("mujoco")
    model = peers.mujoco_model(motion, "RK4", motion.seconds / steps)
    assert peers.mujoco_path(motion, model, steps)[0] < 2e-5


def line(errors, cost=1.0, setting="a", code="jaxcon"):
    """Returns runs at halved steps, each twice as costly as the one before."""
    steps = enumerate(errors)
    return [Point(code, setting, 0.5**i, error, cost * 2.0**i) for i, error in steps]


def test_costs_are_those_of_a_line_in_the_logarithms():
    points = line([1e-1, 1e-3, 1e-5, 1e-7])
    assert equal_error.priced(points, 1e-3) == pytest.approx(2.0)
    assert equal_error.priced(points, 1e-4) == pytest.approx(2 * 2**0.5)
    assert equal_error.priced(points, 1.0) == 1.0
    assert equal_error.priced(points, 1e-8) == INF


def test_an_error_that_passes_through_zero_does_not_count():
    lucky = line([INF, 1e-1, 1e-9, 1e-3, 1e-5])
    assert equal_error.priced(lucky, 1e-3) == pytest.approx(4.0)
    assert equal_error.priced(lucky, 5e-4) > 8.0
    assert equal_error.priced(line([INF, INF, 1e-5]), 1e-4) == 4.0


def test_the_cheapest_method_of_each_code_is_compared():
    slow, good = line([1e-1, 1e-2, 1e-3], 1.0, "slow"), line([1e-2, 1e-6], 8.0, "good")
    points = [*slow, *good, *line([1e-1, 1e-2], 3.0, "theirs", "MuJoCo C")]
    assert equal_error.best(points, "jaxcon", 1e-2).setting == "slow"
    assert equal_error.best(points, "jaxcon", 1e-5).setting == "good"
    assert equal_error.ratio(points, "MuJoCo C", 1e-2) == pytest.approx(3.0)
    assert equal_error.ratio(points, "MuJoCo C", 1e-5) is None
    rows = equal_error.lines(motions.pendulum(), points, ("jaxcon", "MuJoCo C"))
    assert "| 3 |" in rows[0]
    assert "not reached" in rows[-1]
    assert "not run" in rows[0]


def test_what_cannot_be_compared_is_said(fakes, tmp_path, capsys):
    none, base = str(tmp_path / "none.json"), str(tmp_path / "baseline.json")
    (other := tmp_path / "other.json").write_text('{"machine": {}}')
    for words, wrong in {
        "there is no baseline": ["--compare", none],
        "name fast before it": ["--compare", "fast"],
        "other.json is no baseline": ["--compare", str(other)],
        "there is no folder": ["--json", f"{tmp_path}/none/out.json"],
        "is a folder": ["--json", str(tmp_path)],
    }.items():
        with pytest.raises(SystemExit):
            command.main(["fast", *wrong])
        assert words in capsys.readouterr().err
    assert command.main(["fast", "breaks", "--update", "--compare", base]) == 1
    assert Baseline.read(Path(base)).of("full", "fast") == {"ratio": 4.0}
    assert command.main(["fast", "--quick", "--compare", base]) == 0
    assert "baseline.json has no values for fast" in capsys.readouterr().out


def test_the_picture_of_equal_error_is_small_and_says_what_is_on_its_axes(tmp_path, monkeypatch):
    """Draws invented runs of as many methods as in a real study."""
    errors, kept = 10.0 ** -np.arange(12), {}
    runs_of = [
        line(0.5 * errors, 1e-6 * (1 + i) * 10**j, f"method {i}", code)
        for j, code in enumerate(equal_error.CODES)
        for i in range(8)
    ]
    points = [point for runs in runs_of for point in runs]
    plain = pictures.save
    monkeypatch.setattr(pictures, "save", lambda f, path: (kept.update(figure=f), plain(f, path)))
    found = [(make(), points) for make in motions.MOTIONS.values()]
    equal_error.draw([*found[:3], (found[3][0], line([INF, INF]))], tmp_path / "picture.png")
    assert 5_000 < (tmp_path / "picture.png").stat().st_size < 80_000
    panels = kept["figure"].axes
    assert [axes.get_title() for axes in panels] == list(motions.MOTIONS)
    for axes, (motion, _) in zip(panels, found, strict=True):
        assert axes.get_xscale() == axes.get_yscale() == "log"
        assert axes.get_ylabel().endswith(f"[{motion.unit}]")
        assert axes.get_xlabel().endswith("[s]")
    thick = [x for x in panels[0].get_lines() if x.get_label() in equal_error.CODES]
    cheapest = [x.get_xdata()[np.argmin(np.abs(x.get_ydata() - 1e-3))] for x in thick]
    np.testing.assert_allclose(np.divide(cheapest[1:], cheapest[:-1]), 10.0, rtol=1e-6)


def test_steps_are_halved_until_they_no_longer_matter():
    motion = motions.pendulum()
    found = dict(runs.halved(motion, lambda n: (100 / n) ** 4, 1e9))
    assert min(found.values()) <= runs.ENOUGH < sorted(found.values())[1]
    stalled = list(runs.halved(motion, lambda n: max(1.0 / n, 1e-3), 1e9))
    assert [error > 1e-3 for _, error in stalled[-4:]] == [True, False, False, False]
    errors = iter([1e-3, 5e-3, 1e-3, 1e-5, 1e-10])  # the first error is small by chance
    assert len(list(runs.halved(motion, lambda n: next(errors), 1e9))) == 5
    assert len(list(runs.halved(motion, lambda n: INF, 0.0))) == 1


def test_stages_are_kept_and_not_run_again(tmp_path):
    file = tmp_path / "found.json"
    record = equal_error.Record.of(file, resume=False)
    record.run("double pendulum, jaxcon", iter([line([INF, 1e-2])]))
    again = equal_error.Record.of(file, resume=True)
    again.run("double pendulum, jaxcon", iter([line([1.0])]))
    assert again.points("double pendulum") == line([INF, 1e-2])
    assert again.points("pendulum") == []
    assert not equal_error.Record.of(file, resume=False).stages
    assert np.isfinite(again.seconds["double pendulum, jaxcon"])
