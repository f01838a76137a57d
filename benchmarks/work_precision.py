"""Cost and error of motions against step size in jaxcon.

Every run halves the step size of the previous run. The error is that of one world. The cost is the
time of all cores per world and simulated second in a batch, without compilation, the median of
repeats.
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
"""Error below which step sizes are not halved further."""
ALIKE = 1.5
"""Smallest factor by which a halved step must reduce the error. Otherwise the error stalls."""
STARTS = 8
"""Number of points along the motion at which worlds of a batch start."""
SPAN = 0.05
"""Approximate duration of a repeat [s]."""
FEW, MANY = 4, 2000
"""Bounds on the number of steps in a repeat."""
CLOSE = 1e-2
"""Error bound of the run that provides start points and the timed step size."""
BATCH, OTHERS = 256, (64, 1024)
"""Batch size for all methods, and additional batch sizes for the best methods."""


@dataclass(frozen=True)
class Point:
    """Cost and error of one run.

    Attributes:
        code: "jaxcon", "MuJoCo C" or "MJX".
        setting: method, precision and other choices.
        dt: step size h [s].
        error: error at the end of the motion [m] or [rad].
        cost: time of all cores per simulated second and world, in a batch [s].
        note: batch size, and XLA flags if chosen.
    """

    code: str
    setting: str
    dt: float
    error: float
    cost: float
    note: str = ""


METHODS: dict[str, tuple[Any, Any]] = {
    "semi-implicit Euler": (jc.SemiImplicitEuler(), jc.Baumgarte()),
    "Heun": (jc.integrators.Heun(), jc.Baumgarte()),
    "RK4": (jc.RK4(), jc.Baumgarte()),
    "order 6": (butcher(), jc.Baumgarte()),
    "RATTLE": (jc.integrators.RATTLE(), jc.Baumgarte()),
    "generalized-α": (jc.integrators.GeneralizedAlpha(), jc.Baumgarte()),
}
"""Integrators and stabilizers. The last two integrators enforce constraints themselves."""
SINGLE = ("semi-implicit Euler", "RK4")
"""Methods that also run in float32."""
FIXED = {"generalized-α": 16}
"""Fixed batch sizes.

Generalized-α runs only with this batch size. With 256 worlds on two CPU devices, the factorization
of its dense matrices did not return.
"""
ITERATES = ("RATTLE", "generalized-α")
"""Methods that need more iterations at larger step sizes."""


def halved(
    motion: Motion, error_of: Callable[[int], float], limit: float
) -> Iterator[tuple[int, float]]:
    """Yields numbers of steps, each double the previous number, with their errors.

    It stops when errors no longer fall, or when a run takes too long.

    Args:
        motion: the motion, with the number of steps of its coarsest run.
        error_of: (steps) → error.
        limit: CPU time limit of a run [s]. Other processes do not affect CPU time.
    """
    steps, previous, stalled = motion.first, float("inf"), 0
    while True:
        begin = time.process_time()
        error = error_of(steps)
        elapsed = time.process_time() - begin
        yield steps, error
        stalled = stalled + 1 if np.isfinite(previous) and error > previous / ALIKE else 0
        if error <= ENOUGH or stalled == 2 or 2 * elapsed > limit:
            return
        steps, previous = 2 * steps, error


def step_seconds(run: Callable[[int], Any], repeats: int = 5) -> float:
    """Returns the time of a step, the median of several runs of many steps [s].

    Args:
        run: runs a given number of steps.
        repeats: number of repeats.
    """

    def seconds_per_step(count: int) -> float:
        begin = time.perf_counter()
        run(count)
        return (time.perf_counter() - begin) / count

    run(FEW)  # the first run allocates memory
    count = int(np.clip(SPAN / seconds_per_step(FEW), FEW, MANY))
    return float(np.median([seconds_per_step(count) for _ in range(repeats)]))


class Ours:
    """A jaxcon method on a form of a motion, compiled once for all step sizes."""

    def __init__(self, motion: Motion, form: Form, name: str, dtype: str) -> None:
        self.motion, self.form, self.name, self.dtype = motion, form, name, dtype
        self.label = label_of(form, name, dtype)
        self.method = jc.Method(*METHODS[name], form.solver)
        with self.precision():
            self.system, start = form.build(jnp.dtype(dtype))
            self.start = jc.init(self.system, self.method, start.q, start.v)
            self.one = jax.jit(self.travel).lower(self.start, *self.numbers(1.0, 1)).compile()

    def precision(self) -> Any:
        """Returns a context manager for the precision of the method's arrays."""
        return jax.enable_x64(self.dtype == "float64")

    def numbers(self, dt: float, steps: int) -> tuple[jax.Array, jax.Array]:
        """Returns step size and number of steps as array arguments."""
        return jnp.asarray(dt, self.dtype), jnp.asarray(steps, jnp.int32)

    def travel(self, state: jc.State, dt: jax.Array, steps: jax.Array) -> jc.State:
        """Steps one world `steps` times and returns its state."""
        control = None if self.form.control is None else jnp.full(1, self.form.control, self.dtype)

        def step(_: Any, state: jc.State) -> jc.State:
            return jc.step(self.system, self.method, state, control, dt)[0]

        return jax.lax.fori_loop(0, steps, step, state)

    def error(self, steps: int) -> float:
        """Returns the error of a run, infinite if it failed."""
        with self.precision():
            final = self.one(self.start, *self.numbers(self.motion.seconds / steps, steps))
            q, status = np.asarray(final.q, np.float64), int(final.status)
        if status not in (jc.Status.OK, jc.Status.CONFLICT):
            return float("inf")
        return self.motion.error(self.form.places(self.system, q))

    def cost(self, batch: int, steps: int) -> Callable[[float], float]:
        """Compiles a batch of worlds that start along a run.

        Returns:
            A function from the step size h to the cost of a simulated second.
        """
        with self.precision():
            numbers = functools.partial(self.numbers, self.motion.seconds / steps)
            starts = [self.one(self.start, *numbers(i * steps // STARTS)) for i in range(STARTS)]
            index = np.arange(batch) * STARTS // batch
            worlds = jax.tree.map(lambda *x: jnp.stack(x)[index], *starts)
            worlds = timing.over_devices(worlds, batch)
            # One program per device: in a common program, devices would wait for each other
            # in every step of a method that iterates.
            batch_travel = jax.vmap(self.travel, (0, None, None))
            travel = jc.devices.over_devices(
                lambda arguments, batch_worlds: batch_travel(batch_worlds, *arguments)
            )
            compiled, _ = timing.compile_seconds(travel, self.numbers(1.0, 1), worlds)

        def seconds_of(dt: float) -> float:
            def run(count: int) -> Any:
                with self.precision():
                    arguments = self.numbers(dt, count)
                return jax.block_until_ready(compiled(arguments, worlds))

            return step_seconds(run) / batch / dt

        return seconds_of

    def points(self, limit: float) -> list[Point]:
        """Runs the method at all step sizes, and times it at one batch size."""
        runs = list(halved(self.motion, self.error, limit))
        return self.priced(runs, FIXED.get(self.name, BATCH))

    def priced(self, runs: Sequence[tuple[int, float]], batch: int) -> list[Point]:
        """Adds costs to runs.

        Methods in `ITERATES` are timed at each step size, other methods once.
        """
        finite = [(steps, error) for steps, error in runs if np.isfinite(error)]
        if not finite:
            return []
        timed = next((steps for steps, error in finite if error < CLOSE), finite[-1][0])
        cost, seconds = self.cost(batch, timed), self.motion.seconds
        step = None if self.name in ITERATES else cost(seconds / timed) / timed
        return [
            Point("jaxcon", self.label, seconds / n, error, price, f"batch {batch}")
            for n, error in finite
            for price in [n * step if step else cost(seconds / n)]
        ]


def label_of(form: Form, name: str, dtype: str) -> str:
    """Returns the name of a method in tables."""
    return ", ".join(part for part in (name, dtype, form.name) if part)


class Runs:
    """All jaxcon methods on a motion, each compiled on first use."""

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
        """Returns the compiled method with a label."""
        if label not in self.made:
            self.made[label] = Ours(self.motion, *self.known[label])
        return self.made[label]

    def all(self, limit: float, labels: Sequence[str] | None = None) -> Iterator[list[Point]]:
        """Yields the runs of each method at one batch size.

        `refused` receives the reasons why methods refuse the motion.

        Args:
            limit: CPU time limit of a run of one world [s].
            labels: labels of the methods, by default all.
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
        """Repeats selected runs at other batch sizes."""
        for label in dict.fromkeys(point.setting for point in points):
            selected = [point for point in points if point.setting == label]
            runs = [(round(self.motion.seconds / point.dt), point.error) for point in selected]
            for batch in batches if self.of(label).name not in FIXED else ():
                yield self.of(label).priced(runs, batch)
