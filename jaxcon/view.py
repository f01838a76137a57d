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


def main_job(result: Any, tuning: Any, world: PyTree, step: float, path: str) -> None:
    """One picture: the mechanism through a turn, violation over time, and the loss."""
    plt = pyplot()
    system, state = world
    dt = jnp.asarray(step, state.q.dtype)
    run = jax.jit(lambda s: rollout(system, Method(), s, None, dt, 300, every=30))
    _, trajectory = run(state)
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4))
    for i, q in enumerate(trajectory.q):
        draw(system, q, left, alpha=0.2 + 0.08 * i, label=None)
    draw(system, state.q, left)
    left.legend(fontsize=8, loc="lower right")
    left.set_title("a crank-rocker through one turn")
    middle.semilogy(result.times, result.violation)
    middle.set(xlabel="time [s]", ylabel="worst |φ| of all copies [m]", title="violation")
    right.plot(10**tuning.history, label="tuning")
    right.axhline(10 ** tuning.default[1], color="gray", ls="--", label="default gains")
    right.set(yscale="log", xlabel="iteration", ylabel="rms of φ and h φ̇ [m]")
    right.set_title("gains tuned by gradient")
    right.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)
