"""Runs the searches from all starts of an identification in one batch, with checkpoints."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxcon.core import checkpoint as files
from jaxcon.core.interrupts import STOP_EXCEPTIONS, describe_error, progress_bar
from jaxcon.core.typing import PyTree
from jaxcon.learning.information import noise_left
from jaxcon.learning.least_squares import Fit, FitProgress, Values, least_squares, side_by_side
from jaxcon.learning.stretches import FARTHEST, Point, Stretches

HORIZONS = (1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Shares of a recording, fitted one after another if the fit of the whole recording is poor."""
EXCESS = 2.0
"""The ratio of residuals to noise above which noise does not explain the residuals."""
DOUBT = 1.2
"""The ratio of residuals to noise above which fits of parts of the recording are tried.

It is smaller than `EXCESS`: such fits cost time, but never worsen the result.
"""
PROGRAM = "the simulation, another option, or the version of jax"
"""Possible causes of a changed program, for the error message of a checkpoint."""


class End(NamedTuple):
    """The final fit from one start, and the factor `noise` that divides its data residuals."""

    fit: Fit
    noise: float

    @property
    def cost(self) -> float:
        """The final cost ½ ‖r‖², multiplied by `noise`².

        Costs of starts with different `noise` can thus be compared.
        """
        return float(self.noise**2 * self.fit.costs[-1])

    @property
    def broken(self) -> bool:
        """True if an interrupt or a machine error stopped the search."""
        return self.fit.broken

    def broken_by(self, reason: str) -> End:
        """Returns a copy that is marked as stopped by an interrupt or error, with this reason."""
        return End(dataclasses.replace(self.fit, stopped=reason, broken=True), self.noise)


@dataclass
class Attempt:
    """The search from one start of an identification.

    With nodes, the recording is cut into segments (stretches), and a sequence of fits closes the
    gaps between segments. Each fit, called a decade, allows a tenth of the gap that the previous
    fit allowed. If the user gave no noise, it is estimated again after each decade, since the
    weight of the gaps depends on the noise. Without nodes there is one decade.

    The longer the recording of an oscillation, the more local minima the fit has. If the residuals
    of a fit without nodes exceed the noise of the data, a second fit begins at `begin`. It covers
    longer and longer parts of the recording. The better of the two fits is the result.

    Attributes:
        problem: the least-squares problem of the recording.
        begin: initial parameters, divided by their scales, (p,).
        continuity: allowed standard deviation of the gaps in the last decade.
        steps: maximum number of steps of each fit.
        widths: allowed standard deviation of the gaps in each decade; empty before the start is
            evaluated.
        noise: factor by which the standard deviation of the data is multiplied.
        decade: index of the current decade.
        progress: state of the current fit.
        direct: the finished fit of the whole recording, stored while parts of the recording are
            fitted; otherwise None.
        horizon: index into `HORIZONS` of the part that is being fitted.
    """

    problem: Stretches
    begin: np.ndarray
    continuity: float
    steps: int
    widths: tuple[float, ...] = ()
    noise: float = 1.0
    decade: int = 0
    progress: FitProgress | None = None
    direct: FitProgress | None = None
    horizon: int = 0

    def run(self) -> Generator[Point, Values, End]:
        """Runs the search as a generator, so that several searches can be evaluated in one batch.

        It repeatedly yields a point, and is sent the residuals r and their Jacobian J at that
        point. Finally, it returns an `End`.

        Raises:
            ValueError: r or J is not finite at the start.
        """
        if not self.widths:
            yield from self._evaluate_start()
        # after a resume with more steps, the fit of the whole recording continues
        if self.direct is not None and self.direct.goes_on(self.steps):
            self.progress, self.direct, self.horizon = self.direct, None, 0
        if self.direct is not None:
            end = End((yield from self._fitted(self.direct)), self.noise)
        else:
            end = yield from self._by_decades()
            if end.broken or self.problem.gaps or not unexplained(self.problem, end, DOUBT):
                return end
            self.direct, self.progress = self.progress, FitProgress(self.begin)
        return (yield from self._by_horizons(end))

    def _by_decades(self) -> Generator[Point, Values, End]:
        """Fits the whole recording repeatedly; each fit allows smaller gaps between segments."""
        end = None
        while True:
            try:
                end = End((yield from self._fitted(self.progress)), self.noise)
            except STOP_EXCEPTIONS as error:
                if end is None:
                    raise  # no earlier result would be lost
                return end.broken_by(describe_error(error))
            if end.broken or self.decade + 1 == len(self.widths):
                return end
            self._narrow(end.fit)

    def _by_horizons(self, direct: End) -> Generator[Point, Values, End]:
        """Fits longer and longer parts of the recording.

        Parts with no more data than parameters are skipped.

        Args:
            direct: the fit of the whole recording from the start.

        Returns:
            The better of the resulting fit and `direct`.
        """
        fit, scatter = direct.fit, self.problem.scatter(direct.fit.residual)
        while True:
            share = HORIZONS[self.horizon]
            if self.problem.observed_until(share) > self.begin.size:
                # without a prior, parameters that a short part does not determine would fit noise
                tie = scatter / FARTHEST if share < 1 else 0.0
                try:
                    fit = yield from self._fitted(self.progress, share, tie)
                except STOP_EXCEPTIONS as error:
                    return direct.broken_by(describe_error(error))
                if fit.broken:
                    return direct.broken_by(fit.stopped)
                self.progress = FitProgress(fit.z) if share < 1 else self.progress
            if share == HORIZONS[-1]:
                return min(direct, End(fit, self.noise), key=lambda end: end.cost)
            self.horizon += 1

    def _fitted(
        self, progress: FitProgress | None, horizon: float = 1.0, tie: float = 0.0
    ) -> Generator[Point, Values, Fit]:
        """Fits the recording from its beginning to the time `horizon`.

        Args:
            progress: the state from which the fit starts or resumes.
            horizon: end of the fitted part, as a share of the recording's duration.
            tie: weight of a prior on the parameters z: adds the residuals tie · (z − begin).
        """
        assert progress is not None
        problem, width, noise = self.problem, self.widths[self.decade], self.noise
        precision = problem.precision(width, noise)
        fit = least_squares(
            progress, problem.limits, self.steps, precision, self.note, problem.reach
        )
        resume: Callable[[], np.ndarray] = functools.partial(next, fit)
        while True:
            try:
                z = resume()
            except StopIteration as end:
                return end.value
            try:
                r, J = yield z, width, noise
            except STOP_EXCEPTIONS as error:
                resume = functools.partial(fit.throw, error)
                continue
            r, J = problem.until(horizon, r, J)
            if tie:
                r = np.append(r, tie * (z - self.begin))
                J = np.concatenate([J, tie * np.eye(z.size)])
            resume = functools.partial(fit.send, (r, J))

    def note(self, progress: FitProgress) -> None:
        """Stores the progress of the current fit."""
        self.progress = progress

    def _evaluate_start(self) -> Generator[Point, Values, None]:
        """Evaluates the residuals at the start, and derives the gaps that each fit allows."""
        problem, start = self.problem, np.append(self.begin, self.problem.nodes)
        residual, slopes = yield start, 1.0, 1.0
        if not (np.all(np.isfinite(residual)) and np.all(np.isfinite(slopes))):
            raise ValueError(
                "identify: the residuals or their derivatives are not finite at the start; simulate"
                " and its gradient must be finite there."
            )
        self.progress, widths = FitProgress(start), problem.widths(residual, self.continuity)
        if self._estimated:  # the residuals at the start give the first estimate
            self.noise = problem.typical(residual)
            widths = [*widths, self.continuity]
        self.widths = tuple(widths)

    def _narrow(self, fit: Fit) -> None:
        """Prepares the next fit: allows smaller gaps, and estimates noise that was not given."""
        if self._estimated:
            problem, width = self.problem, self.widths[self.decade]
            left = remaining(problem, fit, problem.condensed(fit.jacobian, width), self.noise)
            typical = problem.typical(fit.residual * self.noise)
            noise = typical if np.isnan(left) else self.noise * left
            self.noise = max(noise, problem.least)
        self.decade, self.progress = self.decade + 1, FitProgress(fit.z)

    @property
    def _estimated(self) -> bool:
        """True if the noise is estimated again after each fit of the whole recording."""
        return self.problem.noise is None and self.problem.gaps > 0

    @property
    def contents(self) -> dict[str, np.ndarray]:
        """The state of the search as arrays for a checkpoint.

        The unknowns, entry "z", are an empty array before the start is evaluated.
        """
        fields = {name: getattr(self, name) for name in ("widths", "noise", "decade", "horizon")}
        fields |= _contents(self.progress)
        fields |= {f"direct_{name}": x for name, x in _contents(self.direct).items()}
        return {name: np.asarray(x) for name, x in fields.items()}

    def restore(self, contents: dict[str, np.ndarray]) -> None:
        """Sets the state of the search from the contents of a checkpoint."""
        self.widths = tuple(contents["widths"].tolist())
        self.noise = float(contents["noise"])
        self.decade, self.horizon = int(contents["decade"]), int(contents["horizon"])
        self.progress, self.direct = _restored(contents), _restored(contents, "direct_")


def _contents(progress: FitProgress | None) -> dict[str, np.ndarray | float | tuple | str]:
    """Returns the fields of a `FitProgress` for a checkpoint.

    None is stored as a `FitProgress` whose array of unknowns, z, is empty.
    """
    return dataclasses.asdict(progress or FitProgress(np.zeros(0)))


def _restored(contents: dict[str, np.ndarray], prefix: str = "") -> FitProgress | None:
    """Returns the `FitProgress` stored in a checkpoint; None if its array of unknowns is empty.

    Args:
        contents: the arrays of the checkpoint, by name.
        prefix: the text before the name of each field of the `FitProgress`.
    """
    z, damping, costs, stopped = (
        contents[prefix + field.name] for field in dataclasses.fields(FitProgress)
    )
    if not z.size:
        return None
    return FitProgress(z, float(damping), tuple(costs.tolist()), str(stopped))


def remaining(problem: Stretches, fit: Fit, J: np.ndarray, noise: float) -> float:
    """Returns the ratio of the noise seen in the residuals of a fit to the noise that it assumed.

    It is NaN if no degree of freedom is left.

    Args:
        problem: the least-squares problem of the recording.
        fit: a fit of all unknowns.
        J: the Jacobian of the fit, transformed by `Stretches.condensed`.
        noise: the factor by which the residuals are divided.
    """
    rows, precision = fit.residual.size - problem.gaps, problem.data_precision(noise)
    return noise_left(dataclasses.replace(fit, jacobian=J), rows, problem.observed, precision)


def unexplained(problem: Stretches, end: End, excess: float = EXCESS) -> bool:
    """Returns True if residuals exceed both `excess` times the noise and the rounding errors.

    If the noise is unknown, returns False.
    """
    residual = end.fit.residual
    return problem.share(residual, end.noise) > 0 and problem.excess(residual) > excess


def searched(
    problem: Stretches, attempts: list[Attempt], save: Callable[[], None], progress: bool | None
) -> list[End | None]:
    """Runs the searches from all starts in one batch.

    Returns:
        The final fit from each start; None for a start at which residuals are not finite.

    Raises:
        ValueError: the residuals are finite at no start.
    """

    def evaluate(points: dict[int, Point]) -> dict[int, Values]:
        """Returns (r, J) at the point of each running search, by index of the search."""
        filler = next(iter(points.values()))  # keeps the batch size when searches end
        values = problem.evaluate([points.get(i, filler) for i in range(len(attempts))])
        return {i: values[i] for i in points}

    with progress_bar(progress, desc="identifying") as shown:

        def after() -> None:
            """Updates the progress bar and writes the checkpoint."""
            shown.update()
            save()

        ends = side_by_side([attempt.run() for attempt in attempts], evaluate, after)
    return [x if isinstance(x, End) else None for x in ends]


def remembered(problem: Stretches, attempts: list[Attempt], file: Path) -> Callable[[], None]:
    """Restores searches from a checkpoint file, if it exists.

    Returns:
        A function that writes the searches to the file.

    Raises:
        ValueError: the file is not a checkpoint of this search.
    """
    about = _about(problem, attempts)
    if file.exists():
        like = [attempt.contents for attempt in attempts]
        for attempt, x in zip(attempts, files.read(file, like, about, "identify"), strict=True):
            attempt.restore(x)
    written: list[int] = []

    def save() -> None:
        """Writes the checkpoint, if any search has made progress since the last write."""
        state = [id(attempt.progress) for attempt in attempts]
        if state != written:
            files.write(file, about, [attempt.contents for attempt in attempts])
            written[:] = state

    return save


def _about(problem: Stretches, attempts: list[Attempt]) -> dict[str, object]:
    """Returns {description: value} for the settings that a search and its checkpoint must share."""
    first, space = attempts[0], problem.space
    limits: PyTree = [*space.low, *space.high]
    numbers = [np.asarray(x) for x in jax.tree.leaves(problem.seen)]
    return {
        "the leaves or their shapes": [list(space.names), [list(x.shape) for x in space.low]],
        "the number of restarts": len(attempts),
        "the number of steps": first.steps if problem.gaps else None,
        "the continuity": float(first.continuity),
        "the version of jaxcon": sorted(first.contents),
        "the bounds": files.digest(*limits),
        "the data or their noise": files.digest(*numbers, str(problem.noise is None)),
        "the start, the spread, the key or the nodes": files.digest(
            *(attempt.begin for attempt in attempts), problem.scale, problem.nodes
        ),
        PROGRAM: files.digest(problem.program(len(attempts))),
    }
