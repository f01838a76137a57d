"""The work–precision diagram of a `Tradeoff`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxcon.core.pictures import pyplot

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxcon.analysis.front import Tradeoff

TOP = 0.98
"""The height of the marks of diverged runs, as a fraction of the diagram's height."""


def draw(result: Tradeoff, onto: Axes | str | Path | None = None) -> Axes:
    """Plots error over cost for the runs of a `Tradeoff`, with a line per method and precision.

    Args:
        result: the comparison to draw.
        onto: matplotlib axes, or the path of an image file; new axes by default.

    Returns:
        The matplotlib axes.
    """
    path = onto if isinstance(onto, str | Path) else None
    axes: Any = pyplot().subplots(figsize=(9, 6))[1] if onto is None or path else onto
    names = list(dict.fromkeys(run.name for run in result.runs))
    for (name, dtype), runs in result.grouped.items():
        timed = [run for run in runs if run.ok and run.cost > 0]
        style = {"color": f"C{names.index(name) % 10}", "ls": "-" if dtype == "float64" else "--"}
        x, y = [run.cost for run in timed], [run.error for run in timed]
        axes.plot(x, y, **style, marker="o", ms=4, label=f"{name}, {dtype}")
        if timed:  # a diverged run appears at the estimated cost of all its steps
            step = timed[0].cost * timed[0].dt
            x = [step / run.dt for run in runs if not run.ok]
            transform = axes.get_xaxis_transform()
            axes.plot(x, [TOP] * len(x), transform=transform, marker="x", **style | {"ls": ""})
    x, y = [run.cost for run in result.front], [run.error for run in result.front]
    axes.plot(x, y, color="0.8", lw=8, zorder=0, label="front")
    axes.axhline(result.floor, color="0.5", ls=":", label="error of the reference")
    axes.plot([], [], color="k", marker="x", ls="", label="diverged")
    if not result.front:  # a logarithmic axis needs positive limits
        axes.set(xlim=(1e-6, 1.0), ylim=(1e-12, 1.0))
        axes.text(
            0.5, 0.5, "no run was both stable and timed", transform=axes.transAxes, ha="center"
        )
    axes.set(xscale="log", yscale="log", xlabel="time for a simulated second of a world [s]")
    units = dict.fromkeys(f"[{run.unit}]" for run in result.runs)
    axes.set(ylabel=" ".join(["error", *units]))
    axes.set(title=f"{result.horizon:g} s, {result.batch} worlds")
    axes.legend(fontsize=7)
    if path:
        axes.figure.savefig(path, dpi=120, bbox_inches="tight")
        pyplot().close(axes.figure)
    return axes
