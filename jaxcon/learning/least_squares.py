"""Levenberg–Marquardt on the host, for few unknowns. A caller evaluates residuals and Jacobians."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias, TypeVar

import numpy as np

from jaxcon.core.interrupts import STOP_EXCEPTIONS, describe_error

Values: TypeAlias = tuple[np.ndarray, np.ndarray]
"""The residual r, (m,), and the Jacobian J = ∂r/∂z, (m, n), at one point."""


class FitOutcome(Protocol):
    """The result of a search run by `side_by_side`."""

    @property
    def broken(self) -> bool:
        """True if an interrupt or a machine error stopped the search."""
        ...


P = TypeVar("P")
V = TypeVar("V")
R = TypeVar("R", bound=FitOutcome)

CONVERGED = "converged"
EVERY_STEP = "every step was taken before it converged"
START = 1e-3
"""The initial Levenberg–Marquardt damping μ."""
FAINT = 8
"""The norm up to which a column of the Jacobian counts as zero, relative to the rounding error."""


@dataclass(frozen=True)
class Fit:
    """A minimum of ½ ‖r‖², or the last point of the search for it.

    Attributes:
        z: unknowns, (n,).
        residual: the residual r at z, (m,).
        jacobian: ∂r/∂z at z, (m, n).
        free: mask of the unknowns that a descent step does not push beyond a bound, (n,).
        costs: ½ ‖r‖² at the start and after each step.
        stopped: the reason why the search ended, as text.
        broken: True if an interrupt or a machine error stopped the search.
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
    """The floating-point precision of residuals.

    Attributes:
        tolerance: √ε, with the machine epsilon ε.
        size: the norm of the data. Residuals are differences from data, rounded by ε · size.
    """

    tolerance: float
    size: float

    @property
    def rounding(self) -> float:
        """The rounding error of a residual: machine epsilon ε times the norm of the data."""
        return self.tolerance**2 * self.size

    def scale(self, J: np.ndarray) -> np.ndarray:
        """Returns the norms D of the columns of J, (n,). A column of rounding errors has norm ∞."""
        norms = np.sqrt(np.sum(J * J, axis=0))
        return np.where(norms > FAINT * self.rounding, norms, np.inf)

    def reached(self, J: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the singular value decomposition of J D⁻¹, truncated to its numerical rank k.

        D are the norms of the columns of J.

        Returns:
            U (m, k), s (k,) and V (k, n) with J D⁻¹ ≈ U diag(s) V.
        """
        # columns of equal norm, so that the rank does not depend on the units of the unknowns
        U, s, V = np.linalg.svd(J / self.scale(J), full_matrices=False)
        k = int(np.sum(s > self.tolerance * np.max(s, initial=0)))
        return U[:, :k], s[:k], V[:k]


@dataclass(frozen=True)
class FitProgress:
    """The state of a fit. A fit resumed from it gives identical numbers.

    Attributes:
        z: unknowns, (n,).
        damping: the damping μ.
        costs: ½ ‖r‖² at the start and after each step; empty before the start is evaluated.
        stopped: the reason why the fit ended, as text; empty while it runs.
    """

    z: np.ndarray
    damping: float = START
    costs: tuple[float, ...] = ()
    stopped: str = ""

    def goes_on(self, steps: int) -> bool:
        """Returns True if the fit has neither ended nor taken `steps` steps."""
        return not self.stopped and len(self.costs) <= steps


def least_squares(
    progress: FitProgress,
    limits: tuple[np.ndarray, np.ndarray],
    steps: int,
    precision: Precision,
    note: Callable[[FitProgress], None] = lambda progress: None,
    reach: np.ndarray | float = np.inf,
) -> Generator[np.ndarray, Values, Fit]:
    """Minimizes ½ ‖r(z)‖² over unknowns z within limits, by the Levenberg–Marquardt method.

    This is a generator. It yields a point z, is sent (r, J) at z, and finally returns a `Fit`. The
    points of several fits can thus be evaluated in one batch. Interrupts and machine errors may be
    thrown into it.

    A step is −D⁻¹(ĴᵀĴ + μ s₁²)⁻¹ Ĵᵀr. Here D are the norms of the columns of J, and Ĵ = J D⁻¹. s₁
    is the largest singular value of Ĵ, and μ is the damping. Directions with singular values below
    √ε s₁ are kept fixed, since the data do not determine them. Unknowns on a bound, which a step
    would push beyond it, are kept fixed for that step.

    Args:
        progress: the start, or the state of an interrupted fit.
        limits: lower and upper bounds of z, (n,) each.
        steps: maximum number of steps since the start.
        precision: floating-point precision of r.
        note: callback that receives the progress after each step.
        reach: the largest change of each unknown in one step, (n,). Without it, the first step of
            an unknown that is a logarithm could overflow, and the fit would not recover.

    References:
        Moré, The Levenberg–Marquardt algorithm: implementation and theory (1978).
    """
    r, J = yield progress.z
    if not progress.costs:
        cost = _cost(r, J)
        stopped = "" if np.isfinite(cost) else _stuck(r, J)
        progress = dataclasses.replace(progress, costs=(cost,), stopped=stopped)
    broken = ""
    try:
        while progress.goes_on(steps):
            progress, r, J = yield from _step(progress, r, J, limits, reach, precision)
            note(progress)
    except STOP_EXCEPTIONS as error:
        broken = describe_error(error)
    z, stopped = progress.z, progress.stopped or broken or EVERY_STEP
    costs = np.array(progress.costs)
    return Fit(z, r, J, _free(z, r, J, limits), costs, stopped, bool(broken))


def _step(
    progress: FitProgress,
    r: np.ndarray,
    J: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
    reach: np.ndarray | float,
    precision: Precision,
) -> Generator[np.ndarray, Values, tuple[FitProgress, np.ndarray, np.ndarray]]:
    """Takes one step of a fit: increases the damping until the step lowers ½ ‖r‖².

    This is a generator. It yields each point that it tries, and is sent (r, J) at that point.

    Returns:
        The progress after the step, with r and J at the new point. If no step lowers ½ ‖r‖²,
        the point, r and J are unchanged, and the progress has a reason to stop.
    """
    z, damping = progress.z, progress.damping
    within = np.maximum(limits[0], z - reach), np.minimum(limits[1], z + reach)
    move = _steps(z, r, J, _free(z, r, J, limits), precision)
    last = _negligible(move(0.0), z, r, J, precision)
    while True:
        ahead = np.clip(z + move(0.0 if last else damping), *within)
        values = yield ahead
        cost = _cost(*values)
        better = cost < progress.costs[-1]
        if better or last or _negligible(ahead - z, z, r, J, precision):
            break
        damping *= 10
    stopped = CONVERGED if last else "" if better else _stuck(*values)
    if not better:
        return dataclasses.replace(progress, stopped=stopped), r, J
    damping = max(damping / 10, precision.tolerance**2)
    return FitProgress(ahead, damping, (*progress.costs, cost), stopped), *values


def side_by_side(
    searches: Sequence[Generator[P, V, R]],
    evaluate: Callable[[dict[int, P]], dict[int, V]],
    after: Callable[[], None] = lambda: None,
) -> list[R | BaseException]:
    """Runs search generators in rounds; the points of a round are evaluated in one batch.

    An interrupt or a machine error in one search stops all searches.

    Args:
        searches: generators that yield a point and are sent the values at that point.
        evaluate: function from points to the values at them, both by index of the search.
        after: callback after each round.

    Returns:
        For each search its result, or the exception that ended it.

    Raises:
        BaseException: the exception of the first search, if every search ended with an exception.
    """
    results: dict[int, R | BaseException] = {}
    points: dict[int, P] = {}

    def proceed(i: int, resume: Callable[[], P]) -> None:
        try:
            points[i] = resume()
            return
        except StopIteration as end:
            results[i] = end.value
        except (ValueError, *STOP_EXCEPTIONS) as error:
            results[i] = error
        points.pop(i, None)

    for i, search in enumerate(searches):
        proceed(i, lambda search=search: next(search))
    while points:
        try:
            for i, values in evaluate(points).items():
                proceed(i, lambda i=i, values=values: searches[i].send(values))
            after()
            ended = [results[i] for i in sorted(results)]
            causes = [x for x in ended if _broke(x)]
        except STOP_EXCEPTIONS as error:
            causes = [error]
        if causes:
            cause = causes[0] if isinstance(causes[0], BaseException) else KeyboardInterrupt()
            for i in list(points):
                proceed(i, lambda i=i, cause=cause: searches[i].throw(cause))
    ordered = [results[i] for i in range(len(searches))]
    errors = [x for x in ordered if isinstance(x, BaseException)]
    if len(errors) == len(ordered):
        raise errors[0]
    return ordered


def _broke(result: FitOutcome | BaseException) -> bool:
    """Returns True if an interrupt or a machine error stopped the search with this result."""
    return (
        isinstance(result, STOP_EXCEPTIONS) if isinstance(result, BaseException) else result.broken
    )


def _cost(r: np.ndarray, J: np.ndarray) -> float:
    """Returns the cost ½ ‖r‖²; infinite if r or J is not finite."""
    return float(r @ r / 2) if np.all(np.isfinite(r)) and np.all(np.isfinite(J)) else np.inf


def _stuck(r: np.ndarray, J: np.ndarray) -> str:
    """Returns the reason why no step lowers the cost, given r and J after a short step."""
    if np.isfinite(_cost(r, J)):
        return "no step, however short, lowers the sum of squares"
    return "the residuals or their derivatives are not finite around the last point"


def _free(
    z: np.ndarray, r: np.ndarray, J: np.ndarray, limits: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Returns the mask of unknowns that a descent step does not push beyond a bound, (n,)."""
    (low, high), slope = limits, J.T @ r
    return ~((z <= low) & (slope > 0) | (z >= high) & (slope < 0))


def _negligible(
    step: np.ndarray, z: np.ndarray, r: np.ndarray, J: np.ndarray, precision: Precision
) -> bool:
    """Returns True if a step is too short to matter, by its predicted change J · step of r.

    Either this change is small relative to r, or within rounding errors. Or the step is small
    relative to z, and the change is small relative to the data.
    """
    effect, tolerance = float(np.linalg.norm(J @ step)), precision.tolerance
    short = bool(np.all(np.abs(step) <= tolerance * (1 + np.abs(z))))
    unseen = effect <= max(tolerance * float(np.linalg.norm(r)), precision.rounding)
    return unseen or (short and effect <= tolerance * precision.size)


def _steps(
    z: np.ndarray, r: np.ndarray, J: np.ndarray, free: np.ndarray, precision: Precision
) -> Callable[[float], np.ndarray]:
    """Returns a function from the damping μ to the Levenberg–Marquardt step, (n,)."""
    (U, s, V), D = precision.reached(J[:, free]), precision.scale(J[:, free])
    components = U.T @ r

    def step(damping: float) -> np.ndarray:
        """Returns the step for a damping, (n,); zero for unknowns that are kept fixed."""
        move = np.zeros_like(z)
        move[free] = -(components * s / (s * s + damping * np.max(s, initial=0) ** 2)) @ V / D
        return move

    return step
