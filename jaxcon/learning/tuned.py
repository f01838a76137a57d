"""The result of a search by gradients."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from jaxcon.core.typing import Array, PyTree
from jaxcon.learning.descent import Search, Stop
from jaxcon.learning.leaves import Space

REASONS = {
    Stop.RUNNING: "every step was taken",
    Stop.STALLED: "the loss fell no more",
    Stop.NO_STEP: "however short the step from the last point, the loss or its gradient is not"
    " finite, or the loss far worse",
    Stop.LED_NOWHERE: "the optimizer's step from the last point is not finite, though the loss and"
    " its gradient are",
}

CLOSE = 1e-3
"""Estimated relative distance of every parameter from a minimum below which it converged."""
LATE = 0.01
"""Share of the whole fall of a loss that its second half of steps may have if they were enough."""
RECENT = 0.1
"""Share of the steps over which the present progress is measured."""


@dataclass(frozen=True)
class Tuned:
    """The best parameters that were found; `print` it.

    Attributes:
        params: like those given.
        loss: there; the mean over keys that were held fixed where the loss takes keys.
        aux: what the loss returned beside it there, with a first axis of keys where it takes some.
        lost: at how many of those keys the loss is not finite; it is the mean over the others.
        history: losses by step of the start that led there, (steps,).
        histories: of every start, (restarts, steps), NaN after its end.
        steps: how many that start took.
        best_step: how many steps led to `params`; 0 is the start. Where the loss takes no keys,
            `history[best_step]` is its loss.
        refused: how many steps were taken back, since the loss or its gradient was not finite, or
            the loss far worse than before.
        converged: whether every parameter is within 0.1 % of a minimum, by the curvature along the
            last steps: of its size, found or at the start. The minimum may be a local one. False
            where nothing tells it.
        stopped: why it took no more, in words.
        bounded: the names of leaves that lie on a bound, with one of their numbers at least.
    """

    params: PyTree
    loss: float
    aux: PyTree
    lost: int
    history: np.ndarray
    histories: np.ndarray
    steps: int
    best_step: int
    refused: int
    converged: bool
    stopped: str
    bounded: tuple[str, ...] = ()

    @property
    def table(self) -> dict[str, str]:
        """The parameters as text, by name of leaf; long arrays by their shape."""
        leaves = jax.tree_util.tree_leaves_with_path(self.params)
        named = (
            (jax.tree_util.keystr(k, simple=True, separator="/"), np.asarray(x)) for k, x in leaves
        )
        return {
            name or "the parameter": np.array2string(x, precision=6) if x.size < 7 else f"{x.shape}"
            for name, x in named
        }

    def __str__(self) -> str:
        finite = self.history[np.isfinite(self.history)]
        first = f", from {finite[0]:.4g}" if finite.size else ""
        best = f" at step {self.best_step} of {self.steps}"
        lines = [f"loss {self.loss:.4g}{first},{best}: {self.stopped}"]
        own = {name or "the parameter" for name in self.bounded}
        ends = {name: ", on its bound" if name in own else "" for name in self.table}
        lines += [f"  {name} = {x}{ends[name]}" for name, x in self.table.items()]
        if len(self.histories) > 1:
            lines.append(f"the best of {len(self.histories)} starts")
        if self.lost:
            lines.append(
                f"the loss is not finite at {self.lost} of its keys: a mean over the others"
            )
        if self.refused:
            were = "1 step was" if self.refused == 1 else f"{self.refused} steps were"
            what = "the loss or its gradient was not finite, or the loss far worse"
            lines.append(f"{were} taken back: {what}")
        return "\n".join(lines)


def result(
    space: Space, starts: tuple[Array, ...], search: Search, losses: np.ndarray, broken: str
) -> Tuned:
    """The result of the best start.

    Args:
        space: of the parameters.
        starts: where each search began.
        search: of all starts.
        losses: (starts, steps).
        broken: what ended it from outside, in words.

    Raises:
        ValueError: nothing was found.
    """
    best = search.best
    if not np.any(np.isfinite(best.loss)):
        raise ValueError(
            "tune: the loss is not finite at the start, nor found so from there: begin where it is,"
            " or try several starts by restarts= and spread=."
        )
    index = int(np.lexsort((best.loss, best.lost))[0])
    one, start = jax.tree.map(lambda x: x[index], (search, starts))
    taken, stop = int(one.step), Stop(int(one.stop))
    history = losses[index, :taken]
    outlook = Outlook.of(space, start, one, history)
    reason = REASONS[stop] + (outlook.words if stop in (Stop.RUNNING, Stop.STALLED) else "")
    return Tuned(
        params=space.decode(one.best.y),
        loss=float(one.best.loss),
        aux=one.best.aux,
        lost=int(one.best.lost),
        history=history,
        histories=losses,
        steps=taken,
        best_step=int(one.best.step),
        refused=int(one.refused),
        converged=outlook.converged,
        stopped=broken if broken and stop == Stop.RUNNING else reason,
        bounded=_bounded(space, one.best.y),
    )


def _bounded(space: Space, y: tuple[Array, ...]) -> tuple[str, ...]:
    """The names of leaves that lie on a bound."""
    ends = zip(space.names, y, *space.limits, strict=True)
    return tuple(name for name, z, low, high in ends if np.any((z <= low) | (z >= high)))


@dataclass(frozen=True)
class Outlook:
    """An estimate of the remaining distance at the end of a search.

    Attributes:
        distance: largest relative change of a parameter that is left to a minimum; NaN where the
            curvature is not known.
        leaf: name of that parameter.
        pace: by which the loss fell in each of the last steps.
        late: share of the fall of the loss in the second half of the steps; NaN where there are
            too few to tell.
    """

    distance: float
    leaf: str
    pace: float
    late: float

    @classmethod
    def of(
        cls, space: Space, start: tuple[Array, ...], search: Search, history: np.ndarray
    ) -> Outlook:
        """The outlook of a search, by the quasi-Newton step from its best point.

        A slow slide through a valley has a small gradient and hardly lowers the loss; the step
        −H⁻¹ g is long there none the less, since the curvature is as small.
        """
        steps = space.split(search.ahead)
        leaves = zip(steps, search.best.y, start, space.positive, strict=True)
        distances = [
            float(np.max(np.abs(d) / _size(z, z0, log), initial=0)) for d, z, z0, log in leaves
        ]
        furthest = int(np.argmax(distances))
        return cls(distances[furthest], space.names[furthest], *_pace(history))

    @property
    def converged(self) -> bool:
        """True where every parameter is close to the minimum; False where that is unknown."""
        return self.distance <= CLOSE

    @property
    def words(self) -> str:
        """The estimate in words."""
        if self.converged:
            return (
                f", and it converged: within {self.distance:.1e} (relative) of a minimum, possibly"
                " a local one"
            )
        name = f"'{self.leaf}'" if self.leaf else "the parameter"
        if np.isfinite(self.distance):
            far = f"by about {self.distance:.1g}" if self.distance < 1 else "far"
            pace = f"still fell by {self.pace:.1e} a step" if self.pace > 0 else "fell no more"
            return (
                f" before it converged: by the curvature, {name} may be off a minimum {far},"
                f" relative to its size, and the loss {pace}; ask for more, or fit recordings with"
                " jc.identify"
            )
        if np.isnan(self.late):
            return " before it converged: too few to tell more; ask for more"
        if self.late <= LATE:
            return (
                f", and the second half of them lowered the loss by no more than {LATE:.0%} of its"
                " fall"
            )
        return (
            f" before it converged: {self.late:.0%} of the fall of the loss is that of the second"
            " half of them; ask for more, or give an optimizer of a higher rate"
        )


def _size(y: Array, start: Array, log: bool) -> np.ndarray | float:
    """The size to which a change of y is related: 1 for logarithms, else the larger of y and start.

    A start at 0 says nothing of the size, and counts as 1.
    """
    if log:
        return 1.0
    size = np.abs(np.asarray(start))
    size = np.where(size > np.finfo(size.dtype).eps ** 0.5, size, 1)
    return np.maximum(size, np.abs(np.asarray(y)))


def _pace(history: np.ndarray) -> tuple[float, float]:
    """The fall of the least loss by step, recently, and its share in the second half of steps."""
    finite = history[np.isfinite(history)]
    if finite.size < 4:
        return np.nan, np.nan
    least = np.minimum.accumulate(finite)
    recent = max(int(RECENT * finite.size), 1)
    pace = (least[-1 - recent] - least[-1]) / recent
    whole, late = least[0] - least[-1], least[finite.size // 2] - least[-1]
    return float(pace), float(late / whole) if whole > 0 else 0.0
