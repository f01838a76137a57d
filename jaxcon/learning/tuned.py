"""The result of `tune`, and its verdict on convergence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import Array
from jaxcon.learning.curvature import PAIRS
from jaxcon.learning.descent import Search, Stop
from jaxcon.learning.leaves import Space, flat
from jaxcon.learning.optimizer import OptimizerMemory

REASONS = {
    Stop.RUNNING: "every step was taken",
    Stop.STALLED: "the loss fell no more",
    Stop.NO_STEP: "however short the step from the last point, the loss or its gradient is not"
    " finite, or the loss far worse",
    Stop.LED_NOWHERE: "the optimizer's step from the last point is not finite, though the loss and"
    " its gradient are",
}

CLOSE = 1e-3
"""The relative distance of every parameter to a minimum below which a search has converged."""
LATE = 0.01
"""The share of the total loss decrease below which the second half of the steps counts as idle."""
RECENT = 0.1
"""The share of steps, at the end, over which the current rate of progress is measured."""


@dataclass(frozen=True)
class Tuned:
    """The best parameters found by `tune`; `print` it for a summary.

    Attributes:
        params: the best parameters, in the structure of the start.
        loss: the loss at `params`. With samples, it is the mean over a fixed set of keys.
        aux: auxiliary output of the loss at `params`. With samples, it has a first axis of keys.
        lost: number of keys at which the loss is not finite. The mean excludes them.
        history: loss at each step of the search from the best start, (steps,).
        histories: loss at each step of all searches, (restarts, steps). NaN after a search has
            ended.
        steps: number of steps of the search from the best start.
        best_step: number of steps taken before `params`; 0 is the start. Without samples,
            `history[best_step]` is `loss`.
        refused: number of rejected steps, after which the loss or its gradient was not finite, or
            the loss much larger than before.
        converged: True if every parameter is within 0.1 % of a minimum, which may be local. The
            distance is estimated from the curvature of the loss along the last steps. It is
            relative to the parameter's initial or final magnitude, whichever is larger. False if no
            estimate is possible.
        stopped: the reason why the search ended, as text.
        bounded: names of the leaves with at least one number on a bound.
    """

    params: Any
    loss: float
    aux: Any
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
        """The parameters as text, by name of leaf; long arrays as their shapes."""
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
        bounded = {name or "the parameter" for name in self.bounded}
        for name, x in self.table.items():
            lines.append(f"  {name} = {x}" + ", on its bound" * (name in bounded))
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
    """Converts the search from the best start to a `Tuned`.

    Args:
        space: map between parameters and search coordinates.
        starts: initial points, with a first axis of starts.
        search: final states of all searches, with a first axis of starts.
        losses: losses by start and step, (starts, steps).
        broken: description of the interrupt or machine error that stopped the search; or empty.

    Raises:
        ValueError: no search has found a finite loss.
    """
    best = search.best
    if not np.any(np.isfinite(best.loss)):
        raise ValueError(
            "tune: the loss is not finite at the start, nor found so from there: begin where it is,"
            " or try several starts by restarts= and spread=."
        )
    index = int(np.lexsort((best.loss, best.lost))[0])
    search, start = jax.tree.map(lambda x: x[index], (search, starts))
    best, taken, stop = search.best, int(search.step), Stop(int(search.stop))
    history = losses[index, :taken]
    outlook = Outlook.of(space, start, search, history)
    reason = REASONS[stop] + (outlook.words if stop in (Stop.RUNNING, Stop.STALLED) else "")
    ends = zip(space.names, best.y, *space.limits, strict=True)
    return Tuned(
        params=space.decode(best.y),
        loss=float(best.loss),
        aux=best.aux,
        lost=int(best.lost),
        history=history,
        histories=losses,
        steps=taken,
        best_step=int(best.step),
        refused=int(search.refused),
        converged=outlook.converged,
        stopped=broken if broken and stop == Stop.RUNNING else reason,
        bounded=tuple(name for name, y, low, high in ends if np.any((y <= low) | (y >= high))),
    )


@dataclass(frozen=True)
class Outlook:
    """An estimate of how far the end of a search is from a minimum.

    Attributes:
        distance: estimated relative distance to a minimum, the largest of all parameters; NaN if
            the curvature is unknown.
        leaf: name of the parameter with this distance.
        pace: average decrease of the loss per step over the last steps.
        late: share of the total decrease of the loss that the second half of the steps achieved;
            NaN for too few steps.
    """

    distance: float
    leaf: str
    pace: float
    late: float

    @classmethod
    def of(
        cls, space: Space, start: tuple[Array, ...], search: Search, history: np.ndarray
    ) -> Outlook:
        """Estimates the distance to a minimum by the quasi-Newton step −H⁻¹ g at the best point.

        This step reveals slow progress through a narrow valley. There the gradient g is small and
        the loss hardly decreases. But the curvature is small too, so the step is long. An optimizer
        of the user may not have explored the curvature in all directions: the step is then at least
        the bound `Secants.cautious_step`, if there are not more parameters than secant pairs.
        """
        steps = space.split(search.ahead)
        if search.secants is not None and not isinstance(search.origin.memory, OptimizerMemory):
            free = np.asarray(space.free(search.best.y, search.best.slope))
            if free.size <= PAIRS:
                slopes = (search.best.slope, search.first_slope)
                slope, first = (np.asarray(flat(x)[0]) for x in slopes)
                bound = search.secants.cautious_step(slope, first, free)
                steps = space.split(jnp.maximum(jnp.abs(search.ahead), bound.astype(slope.dtype)))
        leaves = zip(steps, search.best.y, start, space.positive, strict=True)
        distances = [
            float(np.max(np.abs(d) / _size(z, z0, log), initial=0)) for d, z, z0, log in leaves
        ]
        furthest = int(np.argmax(distances))
        return cls(distances[furthest], space.names[furthest], *_pace(history))

    @property
    def converged(self) -> bool:
        """True if every parameter is close to a minimum; False if the distance is unknown."""
        return self.distance <= CLOSE

    @property
    def words(self) -> str:
        """A description of the estimate, as the end of a sentence."""
        if self.converged:
            return (
                f", and it converged: within {self.distance:.1e} (relative) of a minimum, possibly"
                " a local one"
            )
        name = f"'{self.leaf}'" if self.leaf else "the parameter"
        if not np.isnan(self.distance):
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
    """Returns the divisor of a relative change of y: 1 for logarithms, else max(|y|, |start|).

    A start near 0 counts as 1.
    """
    if log:
        return 1.0
    size = np.abs(np.asarray(start))
    size = np.where(size > np.finfo(size.dtype).eps ** 0.5, size, 1)
    return np.maximum(size, np.abs(np.asarray(y)))


def _pace(history: np.ndarray) -> tuple[float, float]:
    """Returns how fast the lowest loss decreased: `pace` and `late` of an `Outlook`.

    `pace` is the average decrease per step over the last steps. `late` is the share of the total
    decrease that the second half of the steps achieved. Both are NaN for fewer than four finite
    losses.

    Args:
        history: losses by step.
    """
    finite = history[np.isfinite(history)]
    if finite.size < 4:
        return np.nan, np.nan
    least = np.minimum.accumulate(finite)
    recent = max(int(RECENT * finite.size), 1)
    pace = (least[-1 - recent] - least[-1]) / recent
    whole, late = least[0] - least[-1], least[finite.size // 2] - least[-1]
    return float(pace), float(late / whole) if whole > 0 else 0.0
