"""The programs of the README, the guide and the examples run as printed."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import optax
import pytest

import jaxcon as jc

ROOT = Path(__file__).parents[1]


QUICK = {name: ["--updates", "1"] for name in ("learn_apg", "learn_ppo")}
"""Arguments that shorten examples which would take minutes."""


def blocks(path: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL)


def ran(path: Path) -> dict:
    """Runs the programs of a page in order, in one namespace, and returns its names."""
    names: dict = {}
    for block in blocks(path):
        exec(block, names)  # noqa: S102
    return names


TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]


@pytest.mark.parametrize("page", [p for p in TEXTS if blocks(p)], ids=lambda p: p.stem)
def test_programs_of_the_readme_and_the_guide_run_page_by_page(page, capsys):
    if any("jc.use_all_cores(" in block for block in blocks(page)):  # before JAX is used
        program = "\n".join(blocks(page))
        subprocess.run([sys.executable, "-c", program], check=True)
        return
    names = ran(page)
    if page.stem == "README":  # its comment states the first printed line
        said = re.search(r"print\(.*# (\[.*?\])", page.read_text())
        assert said
        found, known = capsys.readouterr().out.splitlines()[0], said[1]
        both = [np.fromstring(text.strip("[]"), sep=" ") for text in (found, known)]
        np.testing.assert_allclose(*both, atol=1e-3)
    if page.stem == "control":  # the policy balances the pole
        upright = jc.orientation(names["system"], names["final"], "pole")
        assert abs(float(upright)) < 0.02
    if page.stem == "tune":  # the default search finds both numbers; Adam hardly does

        def loss(p):
            return jc.learning.losses.tracking(names["height"](p), names["seen"])

        adam = optax.adam(optax.cosine_decay_schedule(0.2, 500))
        slow = jc.tune(loss, names["guess"], positive=True, steps=500, optimizer=adam)
        for tuned, close in ((names["tuned"], 1e-9), (slow, 1e-2)):
            found = tuned.params["spring"]
            np.testing.assert_allclose([found["stiffness"], found["damping"]], [8, 1], rtol=close)
        assert names["tuned"].converged
        assert not slow.converged
        for name, (x, error) in names["cut"].table.items():
            assert abs(x - {"spring/stiffness": 8, "spring/damping": 1}[name]) < 3 * error


def test_every_page_of_the_guide_has_a_program():
    assert [p.stem for p in TEXTS if not blocks(p)] == ["index"]


def test_readme_opens_with_ten_lines_and_two_commands():
    readme = (ROOT / "README.md").read_text()
    lines = [line for line in blocks(ROOT / "README.md")[0].splitlines() if line]
    assert len(lines) == 10
    commands = re.findall(r"```sh\n(.*?)\n```", readme, re.DOTALL)
    assert [c.count("\n") for c in commands] == [0, 0]
    assert "python -m jaxcon" in commands[0]
    assert "python -m pytest" in commands[1]


@pytest.mark.parametrize("example", sorted((ROOT / "examples").glob("*.py")), ids=lambda p: p.stem)
def test_example_runs(example, tmp_path):
    environment = os.environ | {"MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, str(example), *QUICK.get(example.stem, [])],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_main_job_small(tmp_path):
    picture = tmp_path / "picture.png"
    command = [sys.executable, "-m", "jaxcon", "--copies", "64", "--seconds", "1"]
    done = subprocess.run(
        [*command, "--picture", str(picture)], capture_output=True, text=True, check=True
    )
    assert "environment-steps per second" in done.stdout
    said = re.search(r"the tuned gains leave ([\d.]+) times less", done.stdout)
    assert said
    assert float(said[1]) > 3  # on linkages outside the training set
    assert picture.stat().st_size > 10_000


def test_verify_writes_json_and_refuses_unknown_cases(tmp_path):
    command = [sys.executable, "-m", "jaxcon", "verify"]
    unknown = subprocess.run(
        [*command, "no_such_case"], capture_output=True, text=True, check=False
    )
    assert unknown.returncode == 2
    assert "no_such_case" in unknown.stdout


def test_andrews_of_the_example_meets_its_reference():
    example = runpy.run_path(str(ROOT / "examples" / "andrews.py"))
    assert example["relative_error"]() < 1e-8
