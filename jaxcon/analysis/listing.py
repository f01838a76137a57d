"""Text tables of the runs of `tradeoff`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxcon.analysis.front import Run

COLUMNS = ("error", "angle", "violation", "energy", "cost", "alone", "gradient", "memory")
"""The fields of a `Run` in the table."""
LEGEND = (
    "error: the largest distance from the reference [m, or of q], < where it tells no less;"
    " angle: the largest turn from it [rad]",
    "violation: the worst |φ| [m, rad]; energy: by how much it is off [J]",
    "cost, alone, gradient: time for a simulated second of one world [s]: in the batch, by itself,"
    " in the batch with its gradient; memory: of a world in the batch [B]",
)
"""The meaning and units of the columns."""


def table(runs: Sequence[Run]) -> list[str]:
    """Returns the lines of a table: a header, then a line per run. A dash means not measured."""
    width = max([len("method"), *(len(run.name) for run in runs)])
    head = f"{'method':{width}s}  {'precision':9s}  {'h [s]':8s}"
    lines = [head + "".join(f"{name:>11s}" for name in COLUMNS)]
    for run in runs:
        line = f"{run.name:{width}s}  {run.dtype:9s}  {run.dt:<8.3g}"
        lines.append(f"{line}{figures(run)}  {run.note}".rstrip())
    return lines


def figures(run: Run) -> str:
    """Formats the measured values of a run as table cells.

    For a diverged run, returns the reason for the divergence in place of the values.
    """
    if not run.ok:
        return f"  diverged: {run.outcome}"
    values = {name: getattr(run, name) for name in COLUMNS}
    shown = {name: "-" if math.isnan(x) else f"{x:.2e}" for name, x in values.items()}
    shown["error"] = shown["error"] if run.told else f"<{shown['error']}"
    return "".join(f"{x:>11s}" for x in shown.values())
