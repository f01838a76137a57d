"""The command-line demo: simulates a thousand linkages, and tunes feedback gains by gradients."""

from __future__ import annotations

import dataclasses
import functools
import time
from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxcon import scenes
from jaxcon.core.cores import compiler_options
from jaxcon.core.devices import shard
from jaxcon.core.status import raise_for_status
from jaxcon.core.typing import Array, DType
from jaxcon.execution.initialize import init
from jaxcon.execution.rollout import rollout
from jaxcon.learning import losses, tuning
from jaxcon.linear.sparse import Sparse
from jaxcon.methods.method import Method
from jaxcon.methods.pid import PID
from jaxcon.protocols import System
from jaxcon.readout.quantities import energy
from jaxcon.step import StepInfo
from jaxcon.system.body_system import BodySystem
from jaxcon.system.state import State

Gains: TypeAlias = dict[str, Array]
"""The PID gains `proportional` [1/s²], `derivative` [1/s] and `integral` [1/s³], () each."""

STEP = 2e-3
"""The step size h [s]."""
METHOD = Method(solver=Sparse())
"""The method of the demo: semi-implicit Euler, default feedback and sparse elimination."""

Worlds: TypeAlias = tuple[BodySystem, State]
"""A batch of four-bars: systems and initial states, with the worlds along the first axis."""


@dataclass(frozen=True)
class Simulation:
    """The results of simulating a batch of linkages in chunks of steps.

    Attributes:
        throughput: environment steps (steps of single worlds) per second, without compilation.
        compile_time: the time to compile [s].
        times: the simulated times at the ends of the chunks, (chunks,) [s].
        violation: for each chunk, the largest joint error |φ| over worlds and steps, (chunks,) [m].
        drift: the median and the maximum over worlds of the relative energy drift
            |E − E₀| / (initial kinetic energy).
    """

    throughput: float
    compile_time: float
    times: np.ndarray
    violation: np.ndarray
    drift: tuple[float, float]


_four_bars = jax.jit(jax.vmap(lambda lengths, masses: scenes.four_bar(lengths, masses)))
"""Builds a batch of four-bars; compiled once for each batch size."""


def linkages(copies: int, seed: int = 0) -> Worlds:
    """Returns a batch of random crank-rockers; lengths vary by ±5 % and masses by ±30 %.

    All cranks can make full turns by Grashof's condition: the crank is the shortest rod, and
    crank + ground is shorter than coupler + rocker. Cranks start at 10 rad/s.
    """
    keys = jax.random.split(jax.random.key(seed))
    lengths = jnp.asarray(scenes.CRANK_ROCKER)
    lengths = lengths * jax.random.uniform(keys[0], (copies, 4), minval=0.95, maxval=1.05)
    masses = jax.random.uniform(keys[1], (copies, 3), minval=0.7, maxval=1.3)
    masses = masses * jnp.array([0.3, 0.9, 0.7])
    return _four_bars(lengths, masses)


def simulate(worlds: Worlds, seconds: float, chunks: int = 50) -> Simulation:
    """Simulates a batch with jit(vmap(rollout)), in chunks of steps.

    Args:
        worlds: the batch of linkages.
        seconds: the simulated time [s].
        chunks: the number of chunks.
    """
    systems, states = worlds
    steps = round(seconds / STEP / chunks)

    def record(state: State, info: StepInfo) -> Array:
        """Returns the largest joint error |φ| of a step."""
        return info.violation.worst

    def run(system: System, state: State) -> tuple[State, Array]:
        """Simulates one chunk; returns its final state and its largest joint error |φ|."""
        dt = jnp.asarray(STEP, state.q.dtype)
        final, worst = rollout(system, METHOD, state, None, dt, steps, record=record)
        return final, jnp.max(worst)

    begin = time.perf_counter()
    compiled = jax.jit(jax.vmap(run)).lower(systems, states).compile(dict(compiler_options))
    compile_time = time.perf_counter() - begin
    start = jax.vmap(energy)(systems, states)
    worst, spent = [], 0.0
    for _ in tqdm(range(chunks), desc="simulating", unit="chunk", disable=None):
        begin = time.perf_counter()
        states, violation = jax.block_until_ready(compiled(systems, states))
        spent += time.perf_counter() - begin
        worst.append(float(violation.max()))
    raise_for_status(states)
    end = jax.vmap(energy)(systems, states)
    drift = jnp.abs(end.total - start.total) / start.kinetic
    throughput = states.status.size * steps * chunks / spent
    times = STEP * steps * np.arange(1, chunks + 1)
    spread = float(jnp.median(drift)), float(jnp.max(drift))
    return Simulation(throughput, compile_time, times, np.array(worst), spread)


def feedback(gains: Gains) -> Method:
    """Returns the method of the demo with PID feedback instead of the default feedback."""
    return dataclasses.replace(METHOD, stabilizer=PID(**gains))


def default_gains(dtype: DType) -> Gains:
    """Returns the PID gains that are equivalent to the default feedback.

    They are K_p = β² [1/s²], K_d = 2α [1/s] and K_i = 0 [1/s³], with the default feedback
    parameters α and β.
    """
    alpha, beta = METHOD.integrator.default_gains(jnp.asarray(STEP, dtype))
    return {"proportional": beta**2, "derivative": 2 * alpha, "integral": 0 * alpha}


def errors(gains: Gains, worlds: Worlds, steps: int) -> tuple[State, Array]:
    """Simulates a batch with PID feedback, from the given initial positions and velocities.

    Returns:
        The final states, and the joint errors φ of every step, (copies, steps, rows) [m].
    """
    method = feedback(gains)

    def run(system: System, state: State) -> tuple[State, Array]:
        """Simulates one world; returns its final state and the joint errors φ of every step."""
        start = init(system, method, state.q, state.v)
        dt = jnp.asarray(STEP, state.q.dtype)
        return rollout(
            system, method, start, None, dt, steps, record=lambda s, i: i.violation.position
        )

    return jax.vmap(run)(*worlds)


def loss(gains: Gains, worlds: Worlds, steps: int) -> Array:
    """Returns the tuning loss: log₁₀ of the rms joint error φ [m] over rows, steps and linkages.

    The loss is NaN if any world failed.
    """
    final, error = errors(gains, worlds, steps)
    return losses.unless_failed(jnp.log10(jnp.mean(error**2)) / 2, final)


@dataclass(frozen=True)
class Tuning:
    """The result of tuning PID gains; see `Gains` for their names and units.

    Attributes:
        default: the gains of the default feedback, by name.
        tuned: the tuned gains, by name.
        history: the rms joint error φ at each iteration, (iterations,) [m].
        before: the rms joint error φ with the default gains [m].
        copies: the number of linkages over which the loss is averaged.
    """

    default: dict[str, float]
    tuned: dict[str, float]
    history: np.ndarray
    before: float
    copies: int


def tune(worlds: Worlds, steps: int = 250, iterations: int = 30) -> Tuning:
    """Tunes PID gains by gradients through the rollout.

    The search starts from the default gains and a small integral gain. The integrator adds nearly
    the same joint error in every step. Proportional and derivative gains cannot remove such a
    constant error, but an integral gain removes most of it.

    Args:
        worlds: the batch of linkages over which the loss is averaged.
        steps: the number of steps of each rollout.
        iterations: the number of optimizer iterations.
    """
    default = default_gains(worlds[1].q.dtype)
    start = default | {"integral": default["derivative"] ** 3 / 10}
    objective = functools.partial(loss, worlds=worlds, steps=steps)
    result = tuning.tune(objective, start, positive=True, steps=iterations)
    return Tuning(
        default={name: float(x) for name, x in default.items()},
        tuned={name: float(x) for name, x in result.params.items()},
        history=10.0**result.history,
        before=10 ** float(jax.jit(objective)(default)),
        copies=worlds[1].status.size,
    )


@dataclass(frozen=True)
class Validation:
    """The joint errors φ of linkages that were not used for tuning.

    The first axis of `rms` and `worst` enumerates default gains and tuned gains.

    Attributes:
        times: the middles of the time windows, (windows,) [s].
        rms: the rms of φ in each window for each linkage, (2, windows, copies) [m].
        worst: the largest |φ| over all linkages and steps, (2,) [m].
    """

    times: np.ndarray
    rms: np.ndarray
    worst: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """The rms of φ over all linkages and times, with default and tuned gains, (2,) [m]."""
        return np.sqrt(np.mean(self.rms**2, axis=(1, 2)))


def validate(gains: Tuning, worlds: Worlds, seconds: float, windows: int = 100) -> Validation:
    """Simulates linkages with default gains and with tuned gains, by one compiled program.

    Args:
        gains: the default and the tuned gains.
        worlds: a batch of linkages that were not used for tuning.
        seconds: the simulated time [s].
        windows: the number of time windows for which errors are reported.
    """
    length = max(round(seconds / STEP / windows), 1)
    dtype = worlds[1].q.dtype

    def run(gains: Gains, system: System, state: State) -> tuple[State, tuple[Array, Array]]:
        """Simulates one world.

        Returns:
            The final state; and for each step the mean φ² and the largest |φ|, (steps,) each.
        """
        method = feedback(gains)
        start = init(system, method, state.q, state.v)
        dt = jnp.asarray(STEP, dtype)

        def record(state: State, info: StepInfo) -> tuple[Array, Array]:
            """Returns the mean φ² and the largest |φ| over the joint errors of a step."""
            error = info.violation.position
            return jnp.mean(error**2), jnp.max(jnp.abs(error))

        return rollout(system, method, start, None, dt, length * windows, record=record)

    compiled = jax.jit(jax.vmap(run, (None, 0, 0)), compiler_options=dict(compiler_options))
    rms, worst = [], []
    for chosen in (gains.default, gains.tuned):
        final, (square, largest) = compiled(
            {name: jnp.asarray(x, dtype) for name, x in chosen.items()}, *worlds
        )
        raise_for_status(final)
        square = np.asarray(square).reshape(-1, windows, length)
        rms.append(np.sqrt(square.mean(axis=2)).T)
        worst.append(np.max(largest))
    times = STEP * length * (np.arange(windows) + 0.5)
    return Validation(times, np.array(rms), np.array(worst))


def main(copies: int = 1024, seconds: float = 5.0, picture: str = "jaxcon.png") -> None:
    """Runs the demo: simulates linkages, tunes gains, prints the results and draws a picture.

    Args:
        copies: the number of linkages.
        seconds: the simulated time [s].
        picture: the file name of the picture.
    """
    worlds = linkages(copies)
    print(f"{copies} crank-rocker four-bars, closed loops, h = {STEP * 1e3:g} ms, {seconds:g} s")
    divides = copies % jax.local_device_count() == 0
    result = simulate(shard(worlds) if divides else worlds, seconds)
    print(f"  compiled in {result.compile_time:.1f} s on {jax.devices()[0].device_kind}")
    print(f"  {result.throughput:,.0f} environment-steps per second")
    print(f"  worst violation {result.violation.max():.2e} m")
    print(f"  energy drift: median {result.drift[0]:.2e}, worst {result.drift[1]:.2e} (relative)")
    tuned = tune(jax.tree.map(lambda x: x[:64], worlds))
    print(f"feedback gains by gradient through 250 steps of {tuned.copies} linkages")
    for label, gains in (("default", tuned.default), ("tuned", tuned.tuned)):
        p, d, i = (gains[name] for name in ("proportional", "derivative", "integral"))
        print(f"  {label:8s} K_p {p:8.3g} 1/s²   K_d {d:6.3g} 1/s   K_i {i:8.3g} 1/s³")
    fresh = validate(tuned, linkages(copies, seed=1), seconds)
    print(f"{copies} other linkages for {seconds:g} s")
    for label, mean, worst in zip(("default", "tuned"), fresh.mean, fresh.worst, strict=True):
        print(f"  {label:8s} joint errors {mean:.2e} m rms, {worst:.2e} m at worst")
    print(f"  the tuned gains leave {fresh.mean[0] / fresh.mean[1]:.1f} times less (rms)")
    from jaxcon import view

    view.main_job(tuned, fresh, jax.tree.map(lambda x: x[0], worlds), STEP, picture)
    print(f"wrote {picture}")
