"""Starts of an identification on their way, side by side, and what a checkpoint holds of them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxcon.core import checkpoint as files
from jaxcon.core.ends import ENDS, bar, words
from jaxcon.core.typing import PyTree
from jaxcon.learning.information import noise_left
from jaxcon.learning.least_squares import Fit, Progress, least_squares, side_by_side
from jaxcon.learning.stretches import FARTHEST, Stretches

HORIZONS = (1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Parts of a recording that are fitted one after another where the fit of the whole is poor."""
EXCESS = 2.0
"""Ratio of residuals to their noise above which the noise does not explain them."""
DOUBT = 1.2
"""Ratio above which parts of the recording are tried; that costs time and spoils nothing."""
PROGRAM = "the simulation, another option, or the version of jax"
"""Causes of a different compiled program, for the error message."""


class End(NamedTuple):
    """The fit that a start led to, and the noise by which its residuals were divided."""

    fit: Fit
    noise: float

    @property
    def cost(self) -> float:
        """½ ‖r‖² in the units of residuals that were not divided."""
        return float(self.noise**2 * self.fit.costs[-1])

    @property
    def broken(self) -> bool:
        """True if the search was ended from outside."""
        return self.fit.broken

    def broken_by(self, reason: str) -> End:
        """A copy marked as ended from outside for this reason."""
        return End(dataclasses.replace(self.fit, stopped=reason, broken=True), self.noise)


@dataclass
class Attempt:
    """One start of an identification.

    Ends of stretches come closer to the nodes by decades. Noise that nobody gave is estimated again
    after each decade, since how well ends should meet nodes depends on it. Without nodes there is
    one decade, and nothing depends on it.

    The longer an oscillation is recorded, the more local minima the fit has. If the residuals of a
    fit without nodes exceed their noise, a second one goes from the start through longer and longer
    parts of the recording. The better of the two counts.

    Attributes:
        problem: the recording.
        begin: its parameters by their scale, (p,).
        continuity: standard deviation of the gaps between ends and nodes in the last decade.
        steps: the limit for each decade and each part of the recording.
        widths: standard deviation of the gaps by decade; empty before the start was evaluated.
        noise: factor on the noise of the data.
        decade: index of the present decade.
        known: progress of the present fit.
        direct: the finished fit of the whole recording, once parts of it are fitted; else None.
        horizon: index of the part that is fitted, in `HORIZONS`.
    """

    problem: Stretches
    begin: np.ndarray
    continuity: float
    steps: int
    widths: tuple[float, ...] = ()
    noise: float = 1.0
    decade: int = 0
    known: Progress | None = None
    direct: Progress | None = None
    horizon: int = 0

    def run(self) -> Generator[Any, Any, End]:
        """Yields (unknowns, continuity, noise) and is sent (r, J) there; returns where it ended.

        Raises:
            ValueError: the residuals or their derivatives are not finite at the start.
        """
        if not self.widths:
            yield from self._look()
        if self.direct is not None and self.direct.goes_on(self.steps):  # more were asked for
            self.known, self.direct, self.horizon = self.direct, None, 0
        if self.direct is not None:
            end = End((yield from self._fitted(self.direct)), self.noise)
        else:
            end = yield from self._by_decades()
            if end.broken or self.problem.gaps or not unexplained(self.problem, end, DOUBT):
                return end
            self.direct, self.known = self.known, Progress(self.begin)
        return (yield from self._by_horizons(end))

    def _by_decades(self) -> Generator[Any, Any, End]:
        """Fits the whole recording, with narrower gaps from decade to decade."""
        end = None
        while True:
            try:
                end = End((yield from self._fitted(self.known)), self.noise)
            except ENDS as error:
                if end is None:
                    raise  # there is nothing to be lost
                return end.broken_by(words(error))
            if end.broken or self.decade + 1 == len(self.widths):
                return end
            self._narrow(end.fit)

    def _by_horizons(self, direct: End) -> Generator[Any, Any, End]:
        """Fits longer and longer parts of the recording; returns the better of this and `direct`.

        Parts with no more numbers than parameters are skipped.
        """
        fit, scatter = direct.fit, self.problem.scatter(direct.fit.residual)
        while True:
            share = HORIZONS[self.horizon]
            if self.problem.observed_until(share) > self.begin.size:
                # without a prior, parameters that a short part hardly tells would follow its noise
                tie = scatter / FARTHEST if share < 1 else 0.0
                try:
                    fit = yield from self._fitted(self.known, share, tie)
                except ENDS as error:
                    return direct.broken_by(words(error))
                if fit.broken:
                    return direct.broken_by(fit.stopped)
                self.known = Progress(fit.z) if share < 1 else self.known
            if share == HORIZONS[-1]:
                return min(direct, End(fit, self.noise), key=lambda end: end.cost)
            self.horizon += 1

    def _fitted(
        self, known: Progress | None, horizon: float = 1.0, tie: float = 0.0
    ) -> Generator[Any, Any, Fit]:
        """Fits a part of the recording.

        Args:
            known: where the fit begins.
            horizon: end of the part, as a share of the time.
            tie: weight of the rows tie · (z − begin), a prior on the parameters.
        """
        assert known is not None
        problem, width, noise = self.problem, self.widths[self.decade], self.noise
        precision = problem.precision(width, noise)
        fit = least_squares(known, problem.limits, self.steps, precision, self.note, problem.reach)
        found: Any = ()
        how: Callable[..., Any] = functools.partial(next, fit)
        while True:
            try:
                z = how(*found)
            except StopIteration as end:
                return end.value
            try:
                r, J = yield z, width, noise
            except ENDS as error:
                found, how = (error,), fit.throw
                continue
            r, J = problem.until(horizon, r, J)
            if tie:
                r = np.append(r, tie * (z - self.begin))
                J = np.concatenate([J, tie * np.eye(z.size)])
            found, how = ((r, J),), fit.send

    def note(self, known: Progress) -> None:
        """Records the progress of the present fit."""
        self.known = known

    def _look(self) -> Any:
        """Evaluates the start, and derives the decades from its gaps."""
        problem, start = self.problem, np.append(self.begin, self.problem.nodes)
        residual, slopes = yield start, 1.0, 1.0
        if not (np.all(np.isfinite(residual)) and np.all(np.isfinite(slopes))):
            raise ValueError(
                "identify: the residuals or their derivatives are not finite at the start; simulate"
                " and its gradient must be finite there."
            )
        self.known, widths = Progress(start), problem.widths(residual, self.continuity)
        if self._estimated:  # what is missed at the start is the least that is known of it
            self.noise = problem.typical(residual)
            widths = [*widths, self.continuity]
        self.widths = tuple(widths)

    def _narrow(self, fit: Fit) -> None:
        """Goes on to the next decade, with the noise estimated again."""
        if self._estimated:
            problem, width = self.problem, self.widths[self.decade]
            left = remaining(problem, fit, problem.condensed(fit.jacobian, width), self.noise)
            again = problem.typical(fit.residual * self.noise)
            own = again if np.isnan(left) else self.noise * left
            self.noise = max(own, problem.least)
        self.decade, self.known = self.decade + 1, Progress(fit.z)

    @property
    def _estimated(self) -> bool:
        return self.problem.noise is None and self.problem.gaps > 0

    @property
    def contents(self) -> dict[str, np.ndarray]:
        """Arrays for a checkpoint; z is empty before the start was evaluated."""
        fields = {name: getattr(self, name) for name in ("widths", "noise", "decade", "horizon")}
        fields |= _contents(self.known)
        fields |= {f"direct_{name}": x for name, x in _contents(self.direct).items()}
        return {name: np.asarray(x) for name, x in fields.items()}

    def restore(self, contents: dict[str, np.ndarray]) -> None:
        """Goes on from a checkpoint."""
        self.widths = tuple(contents["widths"].tolist())
        self.noise = float(contents["noise"])
        self.decade, self.horizon = int(contents["decade"]), int(contents["horizon"])
        self.known, self.direct = _restored(contents), _restored(contents, "direct_")


def _contents(known: Progress | None) -> dict[str, Any]:
    """Fields of a `Progress` for a checkpoint; z is empty for None."""
    return dataclasses.asdict(known or Progress(np.zeros(0)))


def _restored(contents: dict[str, np.ndarray], prefix: str = "") -> Progress | None:
    """The `Progress` in a checkpoint, None if z is empty."""
    z, damping, costs, stopped = (
        contents[prefix + field.name] for field in dataclasses.fields(Progress)
    )
    if not z.size:
        return None
    return Progress(z, float(damping), tuple(costs.tolist()), str(stopped))


def remaining(problem: Stretches, fit: Fit, J: np.ndarray, noise: float) -> float:
    """The ratio of the noise left by a fit to the noise it began with; J is condensed."""
    rows, told = fit.residual.size - problem.gaps, problem.told(noise)
    return noise_left(dataclasses.replace(fit, jacobian=J), rows, problem.observed, told)


def unexplained(problem: Stretches, end: End, excess: float = EXCESS) -> bool:
    """True if residuals exceed noise and rounding by this ratio; False if that is not known."""
    residual = end.fit.residual
    return problem.share(residual, end.noise) > 0 and problem.excess(residual) > excess


def searched(
    problem: Stretches, attempts: list[Attempt], save: Callable[[], None], progress: bool | None
) -> list[End | None]:
    """Runs all starts in one batch; returns their ends, None for a start that is not finite.

    Raises:
        ValueError: no start is finite.
    """

    def evaluate(asked: dict[int, Any]) -> dict[int, Any]:
        some = next(iter(asked.values()))  # in the place of those that have ended
        found = problem.evaluate([asked.get(i, some) for i in range(len(attempts))])
        return {i: found[i] for i in asked}

    with bar(progress, desc="identifying") as seen:

        def after() -> None:
            seen.update()
            save()

        found = side_by_side([attempt.run() for attempt in attempts], evaluate, after)
    return [x if isinstance(x, End) else None for x in found]


def remembered(problem: Stretches, attempts: list[Attempt], file: Path) -> Callable[[], None]:
    """Restores attempts from a file, if it exists; returns a function that writes them to it.

    Raises:
        ValueError: the file holds something else.
    """
    about = _about(problem, attempts)
    if file.exists():
        like = [attempt.contents for attempt in attempts]
        for attempt, x in zip(attempts, files.read(file, like, about, "identify"), strict=True):
            attempt.restore(x)
    written: list[Any] = []

    def save() -> None:
        state = [id(attempt.known) for attempt in attempts]
        if state != written:
            files.write(file, about, [attempt.contents for attempt in attempts])
            written[:] = state

    return save


def _about(problem: Stretches, attempts: list[Attempt]) -> dict[str, Any]:
    """The properties of a search that must match those in a checkpoint, by their description."""
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
