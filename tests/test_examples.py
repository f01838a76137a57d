"""The README and the examples run as they stand."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


QUICK = {name: ["--updates", "1"] for name in ("learn_apg", "learn_ppo")}
"""Arguments of examples that take minutes without them."""


def blocks(file: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / file).read_text(), re.DOTALL)


def test_readme_code_runs_in_order():
    code = blocks("README.md")
    assert len(code) >= 4
    names: dict = {}
    for block in code:
        exec(block, names)  # noqa: S102
    assert names["path"].q.shape[0] == 2000
    assert abs(float(names["angles"][-1])) < 0.02  # the policy of the README balances its pole


def test_readme_opens_with_ten_lines_and_two_commands():
    readme = (ROOT / "README.md").read_text()
    lines = [line for line in blocks("README.md")[0].splitlines() if line]
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
    assert "tuned" in done.stdout
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
