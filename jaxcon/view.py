"""Pictures and animations of mechanisms. matplotlib is imported only when they are drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.pictures import MISSING, pyplot
from jaxcon.core.typing import Array
from jaxcon.execution.rollout import rollout
from jaxcon.methods.method import Method
from jaxcon.system.body_system import BodySystem
from jaxcon.system.elements import Elements

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.animation import FuncAnimation
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from jaxcon.demo import Tuning, Validation
    from jaxcon.protocols import Constraint
    from jaxcon.system.state import State

__all__ = [
    "draw",
    "animate",
    "links",
    "canvas",
]


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


def canvas(width: float, height: float, dpi: float) -> FigureCanvasAgg:
    """Returns a canvas with a new figure, independent of windows and pyplot.

    Args:
        width: width of the figure [inch].
        height: height of the figure [inch].
        dpi: dots per inch.

    Raises:
        ImportError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(MISSING) from error
    return FigureCanvasAgg(Figure(figsize=(width, height), dpi=dpi))


def links(system: BodySystem, q: Array | np.ndarray) -> dict[str, np.ndarray]:
    """Returns the anchors of joints and springs on each moving body, by the name of the body.

    If a body has fewer than two anchors, its center of mass is added as the first point.

    Args:
        system: the system.
        q: positions, (n_q,).

    Returns:
        For each body, n points in the world frame, (n, dim) [m].

    Raises:
        ValueError: the positions are not finite real numbers, or have another shape.
        TypeError: the system is not a `BodySystem`.
    """
    return _anchors_of("links", system, q)


def _anchors_of(owner: str, system: BodySystem, q: Array | np.ndarray) -> dict[str, np.ndarray]:
    """Returns `links` of checked arguments; error messages name the function `owner`."""
    _check_system(owner, system)
    q = jnp.asarray(checks.check(owner, "q", q, (system.layout.n_q,)), system.gravity.dtype)
    points = _links(system, q)
    return {name: np.asarray(points[name]) for name in system.layout.bodies}


def _check_system(owner: str, system: BodySystem) -> None:
    """Raises a TypeError that names the function `owner` if the argument is no `BodySystem`."""
    expected = "a BodySystem, as scene.build() makes it"
    checks.instance(owner, "system", system, BodySystem, expected)


@jax.jit
def _links(system: BodySystem, q: Array) -> dict[str, Array]:
    """Computes the anchors on each moving body in the world frame, (n, dim) [m]; compiled.

    If a body has fewer than two anchors, its center of mass is added as the first point.
    """
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


def _anchors(group: Constraint | Elements, located: tuple[int, int]) -> list[Array]:
    """Returns the anchors of a group's elements on one body, in the body frame, (dim,) each [m].

    Args:
        group: a group of constraints or forces.
        located: the index of the body's group, and the index of the body within its group.
    """
    if not isinstance(group, Elements) or not isinstance(group.params, dict):
        return []
    anchors = []
    for side, place in zip(("anchor_a", "anchor_b"), group.places, strict=False):
        if place.group == located[0] and side in group.params:
            hits = [i for i, index in enumerate(place.indices) if index == located[1]]
            anchors += [group.get(i)[side] for i in hits]
    return anchors


def draw(
    system: BodySystem,
    q: Array | np.ndarray,
    axes: Axes | None = None,
    **style: float | str | bool | None,
) -> Axes:
    """Draws each body as a line through its anchors.

    A planar system is drawn in its x-y plane. A spatial system is projected onto the x-z plane.

    Args:
        system: the system.
        q: positions, (n_q,).
        axes: matplotlib axes to draw in; by default, new axes.
        style: options of `matplotlib.axes.Axes.plot`.

    Returns:
        The axes.

    Raises:
        ValueError: the positions are not finite real numbers, or have another shape.
        TypeError: the system is not a `BodySystem`.
    """
    bodies = _anchors_of("draw", system, q)  # before a figure is opened
    if axes is None:
        axes = cast("Axes", pyplot().subplots()[1])
    first, second = (0, 1) if system.layout.dim == 2 else (0, 2)
    for i, (name, points) in enumerate(bodies.items()):
        options: dict[str, Any] = {"color": f"C{i}", "marker": "o", "markersize": 3, "lw": 2}
        options |= {"label": name} | style
        axes.plot(points[:, first], points[:, second], **options)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]" if second == 1 else "z [m]")
    return axes


def animate(
    system: BodySystem,
    path: Array | np.ndarray,
    interval: float,
    axes: Axes | None = None,
    **style: float | str | bool | None,
) -> FuncAnimation:
    """Animates a motion, with one frame for each row of a path.

    Args:
        system: the system.
        path: positions, (frames, n_q), such as `trajectory.q` of a rollout.
        interval: time between frames [s].
        axes: matplotlib axes to draw in, whose limits are not changed. By default, a new figure
            that is independent of pyplot, with limits around the whole motion.
        style: options of `matplotlib.axes.Axes.plot`.

    Returns:
        The animation. Write it with `save("motion.gif", writer="pillow")`, or show it in a notebook
        with `to_jshtml()`. Keep a reference to the animation until it is written or shown.

    Raises:
        ValueError: the path is not finite real numbers (frames, n_q), or the interval is not a
            positive number.
        TypeError: the system is not a `BodySystem`.
    """
    from matplotlib.animation import FuncAnimation

    _check_system("animate", system)
    path, n_q = checks.check("animate", "path", path), system.layout.n_q
    if path.ndim != 2 or not len(path) or path.shape[1] != n_q:
        raise ValueError(
            f"animate: path must have shape (frames, {n_q}), one row for each frame, got"
            f" {path.shape}."
        )
    checks.check("animate", "interval", interval, (), above=0)
    frames = [list(_anchors_of("animate", system, q).values()) for q in path]
    shown = [0, 1 if system.layout.dim == 2 else 2]
    if axes is None:
        figure = canvas(4.0, 3.2, 80).figure
        figure.set_layout_engine("constrained")
        axes = figure.add_subplot()
        draw(system, path[0], axes, **style)
        points = np.concatenate([points for frame in frames for points in frame])[:, shown]
        low, high = points.min(0), points.max(0)
        edge = 0.05 * float(np.max(high - low)) + 1e-3
        axes.set(xlim=(low[0] - edge, high[0] + edge), ylim=(low[1] - edge, high[1] + edge))
        lines = list(axes.lines)
    else:
        first = len(axes.lines)
        draw(system, path[0], axes, **style)
        lines = axes.lines[first:]

    def show(i: int) -> Sequence[Line2D]:
        """Moves the lines to their points in frame i, and returns the lines."""
        for line, points in zip(lines, frames[i], strict=True):
            line.set_data(*points[:, shown].T)
        return lines

    figure = cast("Figure", axes.figure)
    return FuncAnimation(figure, show, len(frames), interval=1000 * interval)


INK = "#22303c"
"""The color of outlines."""
BEFORE, AFTER = "#8a949e", "#c8501e"
"""The colors of results with default gains and with tuned gains."""
NM = 1e9
"""The number of nanometers in a meter."""
PARTS = {"crank": "#c8501e", "coupler": "#2f6f9f", "rocker": "#3f8f5f"}
"""The colors of the links of a four-bar."""


def main_job(
    tuning: Tuning, fresh: Validation, world: tuple[BodySystem, State], step: float, path: str
) -> None:
    """Draws the picture of the demo: mechanism, loss, and errors of linkages not used for tuning.

    Args:
        tuning: the result of tuning the gains.
        fresh: the errors of linkages that were not used for tuning.
        world: the system and initial state of one four-bar.
        step: the step size h [s].
        path: the file name of the picture.
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


def _draw_turn(axes: Axes, world: tuple[BodySystem, State], step: float) -> None:
    """Draws a four-bar through one turn of its crank, with traces of its hinges and coupler."""
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


def _turn(system: BodySystem, state: State, step: float) -> dict[str, np.ndarray]:
    """Simulates one turn of the crank; returns the paths of both hinges of each link.

    Returns:
        For each link, by name, hinge positions (instant, hinge, coordinate), (n, 2, 2) [m].
    """
    dt = jnp.asarray(step, state.q.dtype)
    run = jax.jit(lambda s: rollout(system, Method(), s, None, dt, 800, every=4)[1].q)
    q = jnp.concatenate([state.q[None], run(state)])
    frames = {k: np.asarray(x) for k, x in jax.vmap(_links, (None, 0))(system, q).items()}
    crank = frames["crank"][:, 1] - frames["crank"][:, 0]
    angle = np.unwrap(np.arctan2(crank[:, 1], crank[:, 0]))
    after = np.nonzero(np.abs(angle - angle[0]) >= 2 * np.pi)[0]
    return {k: x[: after[0] + 1] if after.size else x for k, x in frames.items()}


def _label_link(axes: Axes, name: str, start: np.ndarray, end: np.ndarray) -> None:
    """Writes the name of a link beside the link, below it or to its right."""
    direction = (end - start) / np.hypot(*(end - start))
    across = np.array([direction[1], -direction[0]])
    across = across if across[0] > across[1] else -across
    angle = np.degrees(np.arctan2(direction[1], direction[0]))
    axes.annotate(
        name,
        tuple((start + end) / 2),
        tuple(14 * across),
        textcoords="offset points",
        ha="center",
        va="center",
        rotation=(angle + 90) % 180 - 90,
        rotation_mode="anchor",
        color=PARTS.get(name, INK),
        zorder=8,
    )


def _draw_links(axes: Axes, points: dict[str, np.ndarray], width: float, alpha: float = 1) -> None:
    """Draws each link as a rod between its hinges; opaque rods get outlines and pins."""
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


def _draw_ground(axes: Axes, pivot: np.ndarray, size: float = 0.075) -> None:
    """Draws a fixed bearing at a pivot: a triangle of height `size` [m] on hatched ground."""
    from matplotlib.patches import Polygon, Rectangle

    x, y = pivot
    foot = [(x, y), (x - 0.7 * size, y - size), (x + 0.7 * size, y - size)]
    axes.add_patch(Polygon(foot, facecolor="#dfe3e7", edgecolor=INK, lw=1.3, zorder=3))
    ground = (x - 1.2 * size, y - 1.6 * size), 2.4 * size, 0.6 * size
    axes.add_patch(
        Rectangle(*ground, facecolor="none", edgecolor=INK, hatch="/////", lw=0, zorder=3)
    )
    axes.plot([x - 1.2 * size, x + 1.2 * size], [y - size] * 2, color=INK, lw=1.3, zorder=3)


def _draw_loss(axes: Axes, tuning: Tuning) -> None:
    """Plots the loss of each iteration, the best loss so far, and the loss of the default gains."""
    history = NM * np.where(np.isfinite(tuning.history), tuning.history, np.nan)
    best, default = np.fmin.accumulate(history), NM * tuning.before
    label = f"default gains on these {tuning.copies}: {default:.3g} nm"
    axes.axhline(default, color=BEFORE, ls="--", lw=1.8, label=label)
    tried = f"tried, from default + integral: {history[0]:.3g} nm"
    axes.plot(history, "o", ms=4, color=AFTER, alpha=0.4, mew=0, label=tried)
    label = f"best so far, at last {best[-1]:.3g} nm"
    axes.step(np.arange(len(best)), best, where="post", color=AFTER, lw=2, label=label)
    title = f"Tuning: error of the {tuning.copies} linkages tuned on"
    axes.set(xlabel="iteration of tuning", title=title)
    _error_axis(axes)
    low, high = np.nanmin(history), max(default, np.nanmax(history))
    axes.set_ylim(0.9 * low, high * (high / low) ** 0.3)  # room for the legend
    axes.legend(loc="upper right")


def _draw_errors(axes: Axes, fresh: Validation) -> None:
    """Plots the joint errors over time, with default gains and with tuned gains.

    A line shows the median over the linkages. A band contains the middle 90 % of the linkages.
    """
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


def _error_axis(axes: Axes) -> None:
    """Makes the y axis a logarithmic axis of errors [nm] with plain decimal tick labels."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set(yscale="log", ylabel="rms joint error φ [nm]")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e6e9ec", lw=0.8)
    axes.set_axisbelow(True)
