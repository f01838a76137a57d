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
from jaxcon.learning.stretches import Stretches

PROGRAM = "the simulation, another option, or the version of jax"
"""What the compiled program tells apart."""


class End(NamedTuple):
    """Where a start led, and the noise by which its residuals were divided."""

    fit: Fit
    noise: float

    @property
    def cost(self) -> float:
        """½ ‖r‖² as if they had not been."""
        return float(self.noise**2 * self.fit.costs[-1])

    @property
    def broken(self) -> bool:
        """Whether it was ended from outside."""
        return self.fit.broken


@dataclass
class Attempt:
    """One start of an identification.

    Ends of stretches come closer to the nodes by decades. Noise that nobody gave is estimated again
    after each decade, since how well ends should meet nodes depends on it. Without nodes there is
    one decade, and nothing depends on it.

    Attributes:
        problem: the recording.
        begin: its parameters by their scale, (p,).
        continuity: by how much ends may miss nodes at last.
        steps: for each decade.
        widths: by how much they may in each; empty before the start was looked at.
        noise: by which that of the data is multiplied.
        decade: which it is in.
        known: how far it has come there.
    """

    problem: Stretches
    begin: np.ndarray
    continuity: float
    steps: int
    widths: tuple[float, ...] = ()
    noise: float = 1.0
    decade: int = 0
    known: Progress | None = None

    def run(self) -> Generator[Any, Any, End]:
        """Yields (unknowns, continuity, noise) and is sent (r, J) there; returns where it ended.

        Raises:
            ValueError: the residuals or their derivatives are not finite at the start.
        """
        if not self.widths:
            yield from self._look()
        end = None
        while True:
            width, noise = self.widths[self.decade], self.noise
            precision = self.problem.precision(width, noise)
            assert self.known is not None
            limits, reach = self.problem.limits, self.problem.reach
            fit = least_squares(self.known, limits, self.steps, precision, self.note, reach)
            try:
                end = End((yield from _at(fit, width, noise)), noise)
            except ENDS as error:
                if end is None:
                    raise  # there is nothing to be lost
                broken = dataclasses.replace(end.fit, stopped=words(error), broken=True)
                return End(broken, end.noise)
            if end.broken or self.decade + 1 == len(self.widths):
                return end
            self._narrow(end.fit)

    def note(self, known: Progress) -> None:
        """Takes over how far it has come."""
        self.known = known

    def _look(self) -> Any:
        """The decades, by how much ends miss nodes at the start."""
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
        """On to the next decade."""
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
        """What a checkpoint holds of it; nothing of unknowns before the start was looked at."""
        known = self.known or Progress(np.zeros(0))
        fields = dataclasses.asdict(known) | {
            name: getattr(self, name) for name in ("widths", "noise", "decade")
        }
        return {name: np.asarray(x) for name, x in fields.items()}

    def restore(self, contents: dict[str, np.ndarray]) -> None:
        """Goes on from a checkpoint."""
        self.widths = tuple(contents["widths"].tolist())
        self.noise, self.decade = float(contents["noise"]), int(contents["decade"])
        if self.widths:
            costs, stopped = tuple(contents["costs"].tolist()), str(contents["stopped"])
            self.known = Progress(contents["z"], float(contents["damping"]), costs, stopped)


def remaining(problem: Stretches, fit: Fit, J: np.ndarray, noise: float) -> float:
    """The noise that a fit leaves, by that with which it began; J is condensed."""
    rows, told = fit.residual.size - problem.gaps, problem.told(noise)
    return noise_left(dataclasses.replace(fit, jacobian=J), rows, problem.observed, told)


def _at(fit: Any, width: float, noise: float) -> Any:
    """A fit that asks for residuals of this continuity and noise."""
    found, how = (), functools.partial(next, fit)
    while True:
        try:
            z = how(*found)
        except StopIteration as end:
            return end.value
        try:
            found, how = ((yield z, width, noise),), fit.send
        except ENDS as error:
            found, how = (error,), fit.throw


def searched(
    problem: Stretches, attempts: list[Attempt], save: Callable[[], None], progress: bool | None
) -> list[End | None]:
    """Where starts led, looked at in one batch; None where one could not begin.

    Raises:
        ValueError: none could.
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
    """What writes attempts to a file, after they went on from what was written there before.

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
    """What a checkpoint belongs to."""
    first, space = attempts[0], problem.space
    limits: PyTree = [*space.low, *space.high]
    numbers = [np.asarray(x) for x in jax.tree.leaves(problem.seen)]
    return {
        "the leaves or their shapes": [list(space.names), [list(x.shape) for x in space.low]],
        "the number of restarts": len(attempts),
        "the number of steps": first.steps if problem.gaps else None,
        "the continuity": float(first.continuity),
        "the bounds": files.digest(*limits),
        "the data or their noise": files.digest(*numbers, str(problem.noise is None)),
        "the start, the spread, the key or the nodes": files.digest(
            *(attempt.begin for attempt in attempts), problem.scale, problem.nodes
        ),
        PROGRAM: files.digest(problem.program(len(attempts))),
    }
