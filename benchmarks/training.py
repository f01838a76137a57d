"""Checks that the learning examples reach their stated returns, over five seeds.

    python -m benchmarks.training [--tasks CartPole …] [--seeds 0 1 2 3 4] [--seconds 900]
        [--json training.json] [--picture training.png]

Each task is trained by `examples/learn_ppo.py` or `examples/learn_apg.py` without changes. Seeds
run in sequence in one process, so that only the first seed compiles; its time includes compilation.
An evaluation is the mean return of 64 episodes without noise from fresh initial states. A seed
reaches the goal at its first evaluation with at least the goal's return. The last return is the
evaluation after all updates.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import timing
from jaxcon import environments

sys.path.insert(0, str(timing.ROOT / "examples"))

import learn_apg  # noqa: E402
import learn_ppo  # noqa: E402
from learning import Algorithm, Look, learning  # noqa: E402

ALGORITHMS = (learn_ppo.PPO, learn_apg.APG)


class Row(NamedTuple):
    """Results of one task under one algorithm.

    Attributes:
        task: name of the task.
        algorithm: name of the algorithm.
        goal: the return to reach.
        curves: the evaluations of each seed.
    """

    task: str
    algorithm: str
    goal: float
    curves: list[list[Look]]

    @property
    def reached(self) -> list[Look | None]:
        """The first evaluation of each seed that reaches the goal, None if none does."""
        return [next((x for x in c if x.earned >= self.goal), None) for c in self.curves]

    def __str__(self) -> str:
        """Formats the results of the task as a table row."""
        reached = [x for x in self.reached if x is not None]
        last = [curve[-1].earned for curve in self.curves]
        ends = f"{min(last):.0f} to {max(last):.0f}"
        name = f"| {self.task} | {self.algorithm} | {self.goal:.0f}"
        if not reached:
            return f"{name} | 0 of {len(last)} | - | - | - | {ends} |"
        spans = [span([x[i] for x in reached]) for i in range(3)]
        return f"{name} | {len(reached)} of {len(last)} | {' | '.join(spans)} | {ends} |"


def span(numbers: list[float]) -> str:
    """Formats the minimum and the maximum of values."""
    return f"{min(numbers):.3g} to {max(numbers):.3g}"


def measure(algorithm: Algorithm, task: str, seeds: list[int], seconds: float) -> Row:
    """Trains a task with every seed, for at most `seconds` each."""
    setting, environment, curves = algorithm.settings[task], environments.make(task), []
    for seed in seeds:
        curve: list[Look] = []
        for _, look in learning(algorithm, environment, setting, seed):
            curve.append(look)
            if look.seconds > seconds:
                break
        curves.append(curve)
        print(f"{task} {algorithm.name} seed {seed}: {curve[-1]}", file=sys.stderr, flush=True)
    return Row(task, algorithm.name, setting.goal, curves)


def draw(rows: list[Row], picture: str) -> None:
    """Plots the learning curves of all seeds, one panel per row."""
    from jaxcon import view

    pyplot = view.pyplot()
    size = {"figsize": (4 * len(rows), 3.5), "squeeze": False, "layout": "constrained"}
    figure, panels = pyplot.subplots(1, len(rows), **size)
    for row, axes in zip(rows, panels[0], strict=True):
        for seed, curve in enumerate(row.curves):
            axes.plot([x.actions for x in curve], [x.earned for x in curve], label=f"seed {seed}")
        axes.axhline(row.goal, color="gray", ls="--")
        axes.set(title=f"{row.task}, {row.algorithm}", xlabel="actions")
    panels[0][0].set(ylabel="mean return")
    panels[0][0].legend(fontsize=8)
    figure.savefig(picture)
    pyplot.close(figure)


def save(rows: list[Row], path: str) -> None:
    """Writes all evaluations as JSON."""
    rows_json: list[dict[str, Any]] = [
        row._asdict() | {"curves": [[x._asdict() for x in c] for c in row.curves]} for row in rows
    ]
    Path(path).write_text(json.dumps({"machine": timing.machine(), "rows": rows_json}, indent=1))


def main() -> None:
    """Prints the table and writes results and picture."""
    tasks = [(a, task) for a in ALGORITHMS for task in a.settings]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="*", default=[task for _, task in tasks])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2, 3, 4])
    parser.add_argument("--seconds", type=float, default=900.0, help="time limit of a seed [s]")
    parser.add_argument("--json", default="training.json")
    parser.add_argument("--picture", default="training.png")
    options = parser.parse_args()
    print(timing.machine())
    print("| task | algorithm | goal | reached by | updates | actions | seconds | last return |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    rows = []
    for algorithm, task in tasks:
        if task in options.tasks:
            rows.append(measure(algorithm, task, options.seeds, options.seconds))
            print(rows[-1], flush=True)
    save(rows, options.json)
    draw(rows, options.picture)


if __name__ == "__main__":
    main()
