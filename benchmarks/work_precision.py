"""What a motion costs and how far off it ends, by step, in jaxcon.

Every run has half the step of the one before. Its error is that of one world; its cost is that of a
batch over all cores, without compilation, by world and simulated second, from a median of repeats.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import timing
from benchmarks.motions import Form, Motion
from jaxcon.analysis.reference import butcher

ENOUGH = 1e-9
"""Error at which steps are halved no more."""
ALIKE = 1.5
"""By which an error must fall with half the step, or something else than the step makes it."""
STARTS = 8
"""Worlds of a batch start at so many places along the motion."""
SPAN = 0.05
"""How long a repeat takes, about [s]; of as many steps, within these:"""
FEW, MANY = 4, 2000
CLOSE = 1e-2
"""Error of the run along which worlds start, and whose steps are timed."""
BATCH, OTHERS = 256, (64, 1024)
"""Worlds that everything is tried with, and those that the best are tried with, too."""


@dataclass(frozen=True)
class Point:
    """One run.

    Attributes:
        code: "jaxcon", "MuJoCo C" or "MJX".
        setting: the method, its precision, and what else there was to choose.
        dt: h [s].
        error: at the end of the motion [m] or [rad].
        cost: of all cores for a simulated second of one world in a batch [s].
        note: of the batch, and of XLA where it was chosen.
    """

    code: str
    setting: str
    dt: float
    error: float
    cost: float
    note: str = ""


METHODS: dict[str, tuple[Any, Any]] = {
    "semi-implicit Euler": (jc.SemiImplicitEuler(), jc.Baumgarte()),
    "Heun": (jc.Heun(), jc.Baumgarte()),
    "RK4": (jc.RK4(), jc.Baumgarte()),
    "order 6": (butcher(), jc.Baumgarte()),
    "RATTLE": (jc.RATTLE(), jc.Baumgarte()),
    "generalized-α": (jc.GeneralizedAlpha(), jc.Baumgarte()),
}
"""Integrators and what keeps constraints beside them; the last two do so themselves."""
SINGLE = ("semi-implicit Euler", "RK4")
"""Those that are tried in float32, too."""
FIXED = {"generalized-α": 16}
"""Worlds of those that are tried with no others: its dense matrices, factored for 256 worlds over
two devices of a CPU, did not come back."""
ITERATES = ("RATTLE", "generalized-α")
"""Those whose steps may cost more where they are long."""


def halved(
    motion: Motion, error_of: Callable[[int], float], limit: float
) -> Iterator[tuple[int, float]]:
    """Numbers of steps, doubled, and errors, until steps no longer matter or a run takes too long.

    Args:
        motion: with its coarsest run.
        error_of: runs it with so many steps.
        limit: of a run, in time of the processor, which other work does not change [s].
    """
    steps, before, idle = motion.first, float("inf"), 0
    while True:
        begin = time.process_time()
        error = error_of(steps)
        spent = time.process_time() - begin
        yield steps, error
        idle = idle + 1 if np.isfinite(before) and error > before / ALIKE else 0
        if error <= ENOUGH or idle == 2 or 2 * spent > limit:
            return
        steps, before = 2 * steps, error


def step_seconds(run: Callable[[int], Any], repeats: int = 5) -> float:
    """How long a step takes, the median of several runs of many steps [s].

    Args:
        run: does so many steps.
        repeats: how many.
    """

    def lasts(count: int) -> float:
        begin = time.perf_counter()
        run(count)
        return (time.perf_counter() - begin) / count

    run(FEW)  # the first touches memory that the later ones have
    count = int(np.clip(SPAN / lasts(FEW), FEW, MANY))
    return float(np.median([lasts(count) for _ in range(repeats)]))


class Ours:
    """A method on a form of a motion, compiled once for every step."""

    def __init__(self, motion: Motion, form: Form, name: str, dtype: str) -> None:
        self.motion, self.form, self.name, self.dtype = motion, form, name, dtype
        self.label = label_of(form, name, dtype)
        self.method = jc.Method(*METHODS[name], form.solver)
        with self.precision():
            self.system, start = form.build(jnp.dtype(dtype))
            self.start = jc.init(self.system, self.method, start.q, start.v)
            self.one = jax.jit(self.travel).lower(self.start, *self.numbers(1.0, 1)).compile()

    def precision(self) -> Any:
        """In which its arrays are made."""
        return jax.enable_x64(self.dtype == "float64")

    def numbers(self, dt: float, steps: int) -> tuple[jax.Array, jax.Array]:
        """h and a number of steps as arguments."""
        return jnp.asarray(dt, self.dtype), jnp.asarray(steps, jnp.int32)

    def travel(self, state: jc.State, dt: jax.Array, steps: jax.Array) -> jc.State:
        """So many steps of one world."""
        control = None if self.form.control is None else jnp.full(1, self.form.control, self.dtype)

        def one(_: Any, state: jc.State) -> jc.State:
            return jc.step(self.system, self.method, state, control, dt)[0]

        return jax.lax.fori_loop(0, steps, one, state)

    def error(self, steps: int) -> float:
        """Of a run; infinite where it failed."""
        with self.precision():
            final = self.one(self.start, *self.numbers(self.motion.seconds / steps, steps))
            q, status = np.asarray(final.q, np.float64), int(final.status)
        if status not in (jc.Status.OK, jc.Status.CONFLICT):
            return float("inf")
        return self.motion.error(self.form.places(self.system, q))

    def cost(self, batch: int, steps: int) -> Callable[[float], float]:
        """Compiles a batch spread along a run of so many steps; h → cost of a simulated second."""
        with self.precision():
            numbers = functools.partial(self.numbers, self.motion.seconds / steps)
            along = [self.one(self.start, *numbers(i * steps // STARTS)) for i in range(STARTS)]
            index = np.arange(batch) * STARTS // batch
            worlds = jax.tree.map(lambda *x: jnp.stack(x)[index], *along)
            worlds = timing.over_devices(worlds, batch)
            # methods that iterate would have devices wait for each other in every step
            each = jax.vmap(self.travel, (0, None, None))
            travel = jc.over_devices(lambda given, own: each(own, *given))
            many, _ = timing.compile_seconds(travel, self.numbers(1.0, 1), worlds)

        def measured(dt: float) -> float:
            def run(count: int) -> Any:
                with self.precision():
                    given = self.numbers(dt, count)
                return jax.block_until_ready(many(given, worlds))

            return step_seconds(run) / batch / dt

        return measured

    def points(self, limit: float) -> list[Point]:
        """Runs of one batch by steps."""
        runs = list(halved(self.motion, self.error, limit))
        return self.priced(runs, FIXED.get(self.name, BATCH))

    def priced(self, runs: Sequence[tuple[int, float]], batch: int) -> list[Point]:
        """Steps and errors with their cost: of one step where it is the same in all, else each."""
        able = [(steps, error) for steps, error in runs if np.isfinite(error)]
        if not able:
            return []
        near = next((steps for steps, error in able if error < CLOSE), able[-1][0])
        cost, seconds = self.cost(batch, near), self.motion.seconds
        step = None if self.name in ITERATES else cost(seconds / near) / near
        return [
            Point("jaxcon", self.label, seconds / n, error, price, f"batch {batch}")
            for n, error in able
            for price in [n * step if step else cost(seconds / n)]
        ]


def label_of(form: Form, name: str, dtype: str) -> str:
    """What a table calls a method."""
    return ", ".join(part for part in (name, dtype, form.name) if part)


class Runs:
    """The methods of jaxcon on a motion, each compiled once and when it is first needed."""

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self.made: dict[str, Ours] = {}
        self.refused: dict[str, str] = {}
        self.known = {
            label_of(form, name, dtype): (form, name, dtype)
            for form in motion.forms
            for dtype, names in (("float64", METHODS), ("float32", SINGLE))
            for name in names
        }

    def of(self, label: str) -> Ours:
        """One of them."""
        if label not in self.made:
            self.made[label] = Ours(self.motion, *self.known[label])
        return self.made[label]

    def all(self, limit: float, labels: Sequence[str] | None = None) -> Iterator[list[Point]]:
        """The runs of each method, all of one batch; why there are none is in `refused`.

        Args:
            limit: of a run of one world [s].
            labels: of the methods, all unless given.
        """
        for label in labels or self.known:
            try:
                made = self.of(label)
            except ValueError as reason:
                self.refused[label] = str(reason)
                continue
            yield made.points(limit)

    def again(
        self, points: Sequence[Point], batches: Sequence[int] = OTHERS
    ) -> Iterator[list[Point]]:
        """Runs of some of them again in other batches."""
        for label in dict.fromkeys(point.setting for point in points):
            own = [point for point in points if point.setting == label]
            runs = [(round(self.motion.seconds / point.dt), point.error) for point in own]
            for batch in batches if self.of(label).name not in FIXED else ():
                yield self.of(label).priced(runs, batch)
