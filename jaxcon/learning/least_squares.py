"""Levenberg–Marquardt on the host: few unknowns, residuals and Jacobian from a jitted call."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxcon.core.ends import ENDS, words

CONVERGED = "converged"
EVERY_STEP = "every step was taken before it converged"
START = 1e-3
"""μ at the start."""
FAINT = 8
"""Columns of J shorter than this many roundings of the predictions count as zero."""


@dataclass(frozen=True)
class Fit:
    """A minimum of ½ ‖r‖², or the point where the search for it ended.

    Attributes:
        z: unknowns, (n,).
        residual: r there, (m,).
        jacobian: ∂r/∂z there, (m, n).
        free: which unknowns do not press against a bound, (n,).
        costs: ½ ‖r‖² at the start and after each step.
        stopped: why it went no further, in words.
        broken: True if it was ended from outside.
    """

    z: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    free: np.ndarray
    costs: np.ndarray
    stopped: str
    broken: bool


@dataclass(frozen=True)
class Precision:
    """The precision of residuals.

    Attributes:
        tolerance: √ε.
        size: the norm of what they are the differences of.
    """

    tolerance: float
    size: float

    @property
    def rounding(self) -> float:
        """ε by the size."""
        return self.tolerance**2 * self.size

    def scale(self, J: np.ndarray) -> np.ndarray:
        """D, the norms of the columns; infinite where they are rounding alone, (n,)."""
        norms = np.sqrt(np.sum(J * J, axis=0))
        return np.where(norms > FAINT * self.rounding, norms, np.inf)

    def reached(self, J: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """J D⁻¹ = U s V as far as its directions are told: (m, k), (k,), (k, n).

        Units do not matter, for they say nothing of what can be told.
        """
        U, s, V = np.linalg.svd(J / self.scale(J), full_matrices=False)
        k = int(np.sum(s > self.tolerance * np.max(s, initial=0)))
        return U[:, :k], s[:k], V[:k]


@dataclass(frozen=True)
class Progress:
    """The state of a fit: enough to resume it with identical numbers.

    Attributes:
        z: unknowns, (n,).
        damping: μ.
        costs: ½ ‖r‖² at the start and after each step; empty before the start was looked at.
        stopped: why it goes no further, in words; empty while it does.
    """

    z: np.ndarray
    damping: float = START
    costs: tuple[float, ...] = ()
    stopped: str = ""

    def goes_on(self, steps: int) -> bool:
        """True if the fit is not finished and fewer than so many steps were taken."""
        return not self.stopped and len(self.costs) <= steps


def least_squares(
    known: Progress,
    limits: tuple[np.ndarray, np.ndarray],
    steps: int,
    precision: Precision,
    note: Callable[[Progress], None] = lambda known: None,
    reach: Any = np.inf,
) -> Generator[np.ndarray, tuple[np.ndarray, np.ndarray], Fit]:
    """argmin ½ ‖r(z)‖² within limits, by steps −D⁻¹(ĴᵀĴ + μ s₁²)⁻¹ Ĵᵀr, Ĵ = J D⁻¹.

    It yields points and is sent (r, J) there, so that several can be looked at in one batch; it
    returns a `Fit`. What ends a search from outside may be thrown into it.

    D are the norms of the columns. Directions whose singular value is below √ε of the largest are
    not moved along: the data say nothing of them. Unknowns that press against a bound stay there
    for a step.

    Args:
        known: the start, or how far it came before.
        limits: (low, high), each (n,).
        steps: at most so many since the start.
        precision: of r.
        note: is told of each step.
        reach: by how much each unknown may change in one, (n,): a first step by a logarithm leads
            out of all floating numbers otherwise, where no residual tells the way back.

    References:
        Moré, The Levenberg–Marquardt algorithm: implementation and theory (1978).
    """
    r, J = yield known.z
    if not known.costs:
        cost = _cost(r, J)
        stopped = "" if np.isfinite(cost) else _stuck(r, J)
        known = dataclasses.replace(known, costs=(cost,), stopped=stopped)
    here, broken = (known, r, J), ""
    try:
        while here[0].goes_on(steps):
            here = yield from _step(*here, limits, reach, precision)
            note(here[0])
    except ENDS as error:
        broken = words(error)
    known, r, J = here
    stopped = known.stopped or broken or EVERY_STEP
    return Fit(
        known.z, r, J, _free(known.z, r, J, limits), np.array(known.costs), stopped, bool(broken)
    )


def _step(
    known: Progress, r: np.ndarray, J: np.ndarray, limits: Any, reach: Any, precision: Precision
) -> Any:
    """The progress, r and J after a step, which is damped more until it helps."""
    z, damping = known.z, known.damping
    within = np.maximum(limits[0], z - reach), np.minimum(limits[1], z + reach)
    move = _steps(z, r, J, _free(z, r, J, limits), precision)
    last = _negligible(move(0.0), z, r, J, precision)
    while True:
        ahead = np.clip(z + move(0.0 if last else damping), *within)
        found = yield ahead
        cost = _cost(*found)
        better = cost < known.costs[-1]
        if better or last or _negligible(ahead - z, z, r, J, precision):
            break
        damping *= 10
    stopped = CONVERGED if last else "" if better else _stuck(*found)
    if not better:
        return dataclasses.replace(known, stopped=stopped), r, J
    damping = max(damping / 10, precision.tolerance**2)
    return Progress(ahead, damping, (*known.costs, cost), stopped), *found


def side_by_side(
    searches: Sequence[Generator[Any, Any, Any]],
    evaluate: Callable[[dict[int, Any]], dict[int, Any]],
    after: Callable[[], None] = lambda: None,
) -> list[Any]:
    """Runs generators in rounds: each yields a point and is sent its evaluation; returns results.

    Args:
        searches: generators; those that were ended from outside return something `broken`.
        evaluate: points by search → what is found there.
        after: is called after each round.

    Returns:
        Results, or the error that a search ended by, unless all did: then it is raised.
    """
    results: list[Any] = [None] * len(searches)
    asked: dict[int, Any] = {}

    def proceed(i: int, how: Callable[..., Any], *given: Any) -> None:
        try:
            asked[i] = how(*given)
            return
        except StopIteration as end:
            results[i] = end.value
        except (ValueError, *ENDS) as error:
            results[i] = error
        asked.pop(i, None)

    for i, search in enumerate(searches):
        proceed(i, next, search)
    while asked:
        try:
            for i, found in evaluate(asked).items():
                proceed(i, searches[i].send, found)
            after()
            ended = [x for x in results if getattr(x, "broken", False) or isinstance(x, ENDS)]
        except ENDS as error:
            ended = [error]
        if ended:
            error = ended[0] if isinstance(ended[0], BaseException) else KeyboardInterrupt()
            for i in list(asked):
                proceed(i, searches[i].throw, error)
    if all(isinstance(x, BaseException) for x in results):
        raise results[0]
    return results


def _cost(r: np.ndarray, J: np.ndarray) -> float:
    """½ ‖r‖², infinite where it or its derivative is not finite."""
    return float(r @ r / 2) if np.all(np.isfinite(r)) and np.all(np.isfinite(J)) else np.inf


def _stuck(r: np.ndarray, J: np.ndarray) -> str:
    """The reason why no step helps, from the evaluation at the end of a short one."""
    if np.isfinite(_cost(r, J)):
        return "no step, however short, lowers the sum of squares"
    return "the residuals or their derivatives are not finite around the last point"


def _free(z: np.ndarray, r: np.ndarray, J: np.ndarray, limits: Any) -> np.ndarray:
    """A mask of unknowns that do not press against a bound, (n,)."""
    (low, high), slope = limits, J.T @ r
    return ~((z <= low) & (slope > 0) | (z >= high) & (slope < 0))


def _negligible(
    step: np.ndarray, z: np.ndarray, r: np.ndarray, J: np.ndarray, precision: Precision
) -> bool:
    """True if a step changes r negligibly, or both the unknowns and the predictions."""
    effect, tolerance = float(np.linalg.norm(J @ step)), precision.tolerance
    short = bool(np.all(np.abs(step) <= tolerance * (1 + np.abs(z))))
    unseen = effect <= max(tolerance * float(np.linalg.norm(r)), precision.rounding)
    return unseen or (short and effect <= tolerance * precision.size)


def _steps(
    z: np.ndarray, r: np.ndarray, J: np.ndarray, free: np.ndarray, precision: Precision
) -> Callable[[float], np.ndarray]:
    """The Levenberg–Marquardt step (n,) as a function of the damping."""
    (U, s, V), D = precision.reached(J[:, free]), precision.scale(J[:, free])
    along = U.T @ r

    def step(damping: float) -> np.ndarray:
        move = np.zeros_like(z)
        move[free] = -(along * s / (s * s + damping * np.max(s, initial=0) ** 2)) @ V / D
        return move

    return step
