"""What a search by gradients found."""

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
    Stop.NOT_FINITE: "the loss or its gradient is not finite around the last point, however short"
    " the step",
    Stop.LED_NOWHERE: "the optimizer's step from the last point is not finite, though the loss and"
    " its gradient are",
}


LATE = 0.01
"""Share of the whole fall of a loss that its second half of steps may have where it converged."""


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
        refused: how many of these were taken back, their loss or its gradient not being finite.
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
    refused: int
    stopped: str
    bounded: tuple[str, ...] = ()

    @property
    def table(self) -> dict[str, str]:
        """What was found, in words, by leaf; long arrays by their shape."""
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
        lines = [f"loss {self.loss:.4g}{first}, after {self.steps} steps: {self.stopped}"]
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
            what = "the loss or its gradient was not finite"
            lines.append(f"{self.refused} steps were taken back: {what}")
        return "\n".join(lines)


def result(space: Space, search: Search, losses: np.ndarray, broken: str) -> Tuned:
    """What the best start found.

    Args:
        space: of the parameters.
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
    one = jax.tree.map(lambda x: x[index], search)
    taken, stop = int(one.step), Stop(int(one.stop))
    history = losses[index, :taken]
    reason = REASONS[stop] + (_late(history) if stop == Stop.RUNNING else "")
    return Tuned(
        params=space.decode(one.best.y),
        loss=float(one.best.loss),
        aux=one.best.aux,
        lost=int(one.best.lost),
        history=history,
        histories=losses,
        steps=taken,
        refused=int(one.refused),
        stopped=broken if broken and stop == Stop.RUNNING else reason,
        bounded=_bounded(space, one.best.y),
    )


def _bounded(space: Space, y: tuple[Array, ...]) -> tuple[str, ...]:
    """The names of leaves that lie on a bound."""
    ends = zip(space.names, y, *space.limits, strict=True)
    return tuple(name for name, z, low, high in ends if np.any((z <= low) | (z >= high)))


def _late(history: np.ndarray) -> str:
    """What the second half of the steps says of whether they were enough, in words."""
    finite = history[np.isfinite(history)]
    if finite.size < 4:
        return " before it converged: too few to tell more; ask for more"
    least = np.minimum.accumulate(finite)
    whole, late = least[0] - least[-1], least[finite.size // 2] - least[-1]
    if late <= LATE * whole:
        return (
            f", and the second half of them lowered the loss by no more than {LATE:.0%} of its fall"
        )
    share = f"{late / whole:.0%}"
    return (
        f" before it converged: {share} of the fall of the loss is that of the second half of them;"
        " ask for more, or give an optimizer of a higher rate"
    )
