"""Floor 7: pictures. matplotlib is imported inside, so that simulating needs none."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.pictures import MISSING, pyplot
from jaxcon.core.typing import Array, PyTree
from jaxcon.simulation.method import Method
from jaxcon.simulation.rollout import rollout


def canvas(width: float, height: float, dpi: float) -> Any:
    """A canvas with a figure of its own, which needs no window and no pyplot.

    Args:
        width: [inch].
        height: [inch].
        dpi: dots per inch.

    Raises:
        ImportError: matplotlib is not installed; names the extra that brings it.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(MISSING) from error
    return FigureCanvasAgg(Figure(figsize=(width, height), dpi=dpi))


def links(system: Any, q: Any) -> dict[str, np.ndarray]:
    """For each moving body the world points (n, dim) where joints and springs hold it [m].

    Bodies held at one point only are drawn from their centre of mass.

    Args:
        system: a `BodySystem`.
        q: positions, (n_q,).
    """
    found = _links(system, q)
    return {name: np.asarray(found[name]) for name in system.layout.bodies}


@jax.jit
def _links(system: Any, q: Array) -> dict[str, Array]:
    """Compiled once for all pictures of a mechanism."""
    v = jnp.zeros(system.n_v, q.dtype)
    layout = system.layout
    result = {}
    for name in layout.bodies:
        motion = system.principal_motion(name, q, v)
        anchors = []
        for group in (*system.constraints, *system.forces):
            anchors += _anchors(group, layout.locate(name))
        points = [motion.position] if len(anchors) < 2 else []
        points += [motion.point(jnp.asarray(a)) for a in anchors]
        result[name] = jnp.stack(points)
    return result


def _anchors(group: Any, located: tuple[int, int]) -> list[Any]:
    """Where the elements of a group hold a body, in its frame."""
    found = []
    for side, place in zip(("anchor_a", "anchor_b"), getattr(group, "places", ()), strict=False):
        if place.group == located[0] and isinstance(group.params, dict) and side in group.params:
            hits = [i for i, index in enumerate(place.indices) if index == located[1]]
            found += [group.get(i)[side] for i in hits]
    return found


def draw(system: Any, q: Any, axes: Any = None, **style: Any) -> Any:
    """Draws each body as a line through the points where it is held.

    Args:
        system: a `BodySystem`.
        q: positions, (n_q,).
        axes: matplotlib axes; new ones unless given. Scenes in space are drawn seen along y.
        style: for the lines.

    Returns:
        The axes.
    """
    axes = pyplot().subplots()[1] if axes is None else axes
    first, second = (0, 1) if system.layout.dim == 2 else (0, 2)
    for i, (name, points) in enumerate(links(system, q).items()):
        options = {"color": f"C{i}", "marker": "o", "markersize": 3, "lw": 2, "label": name}
        axes.plot(points[:, first], points[:, second], **(options | style))
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]" if second == 1 else "z [m]")
    return axes


def animate(system: Any, path: Any, interval: float, axes: Any = None, **style: Any) -> Any:
    """Draws a motion, a frame for each row of a path, in axes that hold all of it.

    Args:
        system: a `BodySystem`.
        path: positions, (frames, n_q), such as `trajectory.q` of a rollout.
        interval: time between frames [s].
        axes: matplotlib axes, which keep their limits; new ones unless given, outside of pyplot.
        style: for the lines.

    Returns:
        matplotlib's `FuncAnimation`: `save("motion.gif", writer="pillow")` writes it, `to_jshtml()`
        shows it in a notebook. Keep it until then.
    """
    from matplotlib.animation import FuncAnimation

    frames = [list(links(system, q).values()) for q in path]
    own = axes is None
    if own:
        figure = canvas(4.0, 3.2, 80).figure
        figure.set_layout_engine("constrained")
        axes = figure.add_subplot()
    first = len(axes.lines)
    draw(system, path[0], axes, **style)
    lines, shown = axes.lines[first:], (0, 1 if system.layout.dim == 2 else 2)
    if own:
        _hold(axes, np.concatenate([points for frame in frames for points in frame])[:, shown])

    def show(i: int) -> list[Any]:
        for line, points in zip(lines, frames[i], strict=True):
            line.set_data(*points[:, shown].T)
        return lines

    return FuncAnimation(axes.figure, show, len(frames), interval=1000 * interval)


def _hold(axes: Any, points: np.ndarray) -> None:
    """Limits around points (n, 2), a twentieth of the larger side beyond them."""
    low, high = points.min(0), points.max(0)
    edge = 0.05 * float(np.max(high - low)) + 1e-3
    axes.set(xlim=(low[0] - edge, high[0] + edge), ylim=(low[1] - edge, high[1] + edge))


INK = "#22303c"
"""Color of outlines."""
BEFORE, AFTER = "#8a949e", "#c8501e"
"""Colors of default and tuned gains."""
NM = 1e9
"""Nanometers in a meter."""
PARTS = {"crank": "#c8501e", "coupler": "#2f6f9f", "rocker": "#3f8f5f"}
"""Colors of the links of a four-bar."""


def main_job(tuning: Any, fresh: Any, world: PyTree, step: float, path: str) -> None:
    """One picture: the mechanism through a turn, the loss, and errors of copies not tuned on.

    Args:
        tuning: a `Tuning` of the demo.
        fresh: a `Validation` of the demo.
        world: a four-bar, (system, state).
        step: h [s].
        path: where the picture is written.
    """
    plt = pyplot()
    style = {
        "font.size": 10,
        "axes.titlesize": 11,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.edgecolor": INK,
        "legend.frameon": False,
        "legend.fontsize": 10,
        "legend.title_fontsize": 10,
    }
    with plt.rc_context(style):
        figure, axes = plt.subplots(
            1, 3, figsize=(14, 4.4), width_ratios=(1.25, 1, 1), layout="constrained"
        )
        figure.get_layout_engine().set(wspace=0.06)
        _draw_turn(axes[0], world, step)
        _draw_loss(axes[1], tuning)
        _draw_errors(axes[2], fresh)
        figure.savefig(path, dpi=120)
        plt.close(figure)


def _draw_turn(axes: Any, world: PyTree, step: float) -> None:
    """A four-bar through one turn of its crank: links, pins, ground, and traces of its points."""
    system, state = world
    now, frames = links(system, state.q), _turn(system, state, step)
    center = frames["coupler"].mean(axis=1)
    tip = frames["coupler"][:, 0]
    axes.plot(*frames["crank"][:, 1].T, color=PARTS["crank"], lw=1.2, ls=":")
    axes.plot(*tip.T, color=PARTS["rocker"], lw=1.2, ls=":")
    axes.plot(*center.T, color=PARTS["coupler"], lw=1.8, label="path of the coupler's center")
    for i in np.linspace(0, len(center) - 1, 9)[1:-1].astype(int):
        _draw_links(axes, {k: x[i] for k, x in frames.items()}, width=2.5, alpha=0.2)
    for pivot in (now["crank"][0], now["rocker"][-1]):
        _draw_ground(axes, pivot)
    _draw_links(axes, now, width=8)
    axes.plot(*center[0], "o", ms=5.5, mfc=PARTS["coupler"], mec="white", zorder=7)
    for name, points in now.items():
        _label_link(axes, name, *points)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    axes.set(xlabel="x [m]", ylabel="y [m]", title="A crank-rocker through one turn")
    axes.legend(loc="upper left")


def _turn(system: Any, state: Any, step: float) -> dict[str, np.ndarray]:
    """The hinges of each link from the start until its crank has turned once, (n, 2, 2) [m]."""
    dt = jnp.asarray(step, state.q.dtype)
    run = jax.jit(lambda s: rollout(system, Method(), s, None, dt, 800, every=4)[1].q)
    q = jnp.concatenate([state.q[None], run(state)])
    frames = {k: np.asarray(x) for k, x in jax.vmap(_links, (None, 0))(system, q).items()}
    along = frames["crank"][:, 1] - frames["crank"][:, 0]
    angle = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
    after = np.nonzero(np.abs(angle - angle[0]) >= 2 * np.pi)[0]
    return {k: x[: after[0] + 1] if after.size else x for k, x in frames.items()}


def _label_link(axes: Any, name: str, start: np.ndarray, end: np.ndarray) -> None:
    """The name of a link, along it on its lower or right-hand side."""
    along = (end - start) / np.hypot(*(end - start))
    across = np.array([along[1], -along[0]])
    across = across if across[0] > across[1] else -across
    angle = np.degrees(np.arctan2(along[1], along[0]))
    axes.annotate(
        name,
        (start + end) / 2,
        14 * across,
        textcoords="offset points",
        ha="center",
        va="center",
        rotation=(angle + 90) % 180 - 90,
        rotation_mode="anchor",
        color=PARTS.get(name, INK),
        zorder=8,
    )


def _draw_links(axes: Any, points: dict[str, np.ndarray], width: float, alpha: float = 1) -> None:
    """Rods between their hinges, and the pins; thick ones with an outline."""
    solid = alpha == 1
    for name, (start, end) in points.items():
        x, y = zip(start, end, strict=True)
        line = {"solid_capstyle": "round", "zorder": 4 if solid else 2}
        if solid:
            axes.plot(x, y, color=INK, lw=width + 2, **line)
        axes.plot(x, y, color=PARTS.get(name, INK), lw=width, alpha=alpha, **line)
    if solid:
        pins = np.concatenate(list(points.values()))
        axes.plot(*pins.T, "o", ms=width - 1, mfc="white", mec=INK, mew=1.3, zorder=6)


def _draw_ground(axes: Any, pivot: np.ndarray, size: float = 0.075) -> None:
    """A fixed bearing: a triangle on hatched ground, its height `size` [m]."""
    from matplotlib.patches import Polygon, Rectangle

    x, y = pivot
    foot = [(x, y), (x - 0.7 * size, y - size), (x + 0.7 * size, y - size)]
    axes.add_patch(Polygon(foot, facecolor="#dfe3e7", edgecolor=INK, lw=1.3, zorder=3))
    ground = (x - 1.2 * size, y - 1.6 * size), 2.4 * size, 0.6 * size
    axes.add_patch(
        Rectangle(*ground, facecolor="none", edgecolor=INK, hatch="/////", lw=0, zorder=3)
    )
    axes.plot([x - 1.2 * size, x + 1.2 * size], [y - size] * 2, color=INK, lw=1.3, zorder=3)


def _draw_loss(axes: Any, tuning: Any) -> None:
    """The loss of each iteration, the best so far, and that of the default gains."""
    seen = NM * np.where(np.isfinite(tuning.history), tuning.history, np.nan)
    best, default = np.fmin.accumulate(seen), NM * tuning.before
    label = f"default gains on these {tuning.copies}: {default:.3g} nm"
    axes.axhline(default, color=BEFORE, ls="--", lw=1.8, label=label)
    tried = f"tried, from default + integral: {seen[0]:.3g} nm"
    axes.plot(seen, "o", ms=4, color=AFTER, alpha=0.4, mew=0, label=tried)
    label = f"best so far, at last {best[-1]:.3g} nm"
    axes.step(np.arange(len(best)), best, where="post", color=AFTER, lw=2, label=label)
    title = f"Tuning: error of the {tuning.copies} linkages tuned on"
    axes.set(xlabel="iteration of tuning", title=title)
    _error_axis(axes)
    low, high = np.nanmin(seen), max(default, np.nanmax(seen))
    axes.set_ylim(0.9 * low, high * (high / low) ** 0.3)  # room for the legend
    axes.legend(loc="upper right")


def _draw_errors(axes: Any, fresh: Any) -> None:
    """The median and the middle 90 % of the copies, by time."""
    for rms, mean, color, label in zip(
        fresh.rms, fresh.mean, (BEFORE, AFTER), ("default", "tuned"), strict=True
    ):
        low, middle, high = NM * np.quantile(rms, (0.05, 0.5, 0.95), axis=1)
        axes.fill_between(fresh.times, low, high, color=color, alpha=0.25, lw=0)
        label = f"{label} gains on these {rms.shape[1]}: {NM * mean:.3g} nm"
        axes.plot(fresh.times, middle, color=color, lw=1.6, label=label)
    copies, less = fresh.rms.shape[2], fresh.mean[0] / fresh.mean[1]
    axes.set(xlabel="time [s]", title=f"Check: {copies} other linkages, {less:.1f} times less")
    _error_axis(axes)
    axes.set_xlim(0, None)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** 0.35)  # room for the legend
    axes.legend(loc="upper right", title="line: median; band: 90 % of the linkages")


def _error_axis(axes: Any) -> None:
    """A logarithmic axis of errors [nm] with plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set(yscale="log", ylabel="rms joint error φ [nm]")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e6e9ec", lw=0.8)
    axes.set_axisbelow(True)
