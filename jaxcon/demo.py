"""The main job of the command line: a thousand linkages, and gains tuned by gradient."""

from __future__ import annotations

import dataclasses
import functools
import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxcon import scenes
from jaxcon.analysis.quantities import energy
from jaxcon.core.status import raise_for_status
from jaxcon.core.typing import Array, PyTree
from jaxcon.learning import losses, tuning
from jaxcon.model.state import State
from jaxcon.simulation.initialize import init
from jaxcon.simulation.method import Method
from jaxcon.simulation.rollout import rollout
from jaxcon.solvers.sparse import Sparse
from jaxcon.stabilization.pid import PID

STEP = 2e-3
"""h [s]"""
METHOD = Method(solver=Sparse())
"""Semi-implicit Euler, default feedback, sparse elimination."""


@dataclass(frozen=True)
class Simulation:
    """What the batch did.

    Attributes:
        throughput: environment-steps per second, compilation excluded.
        compile_time: [s].
        times: at the ends of the chunks [s].
        violation: max |φ| over worlds and steps of each chunk [m].
        drift: |E − E₀| / max kinetic energy at the start, median and worst.
    """

    throughput: float
    compile_time: float
    times: np.ndarray
    violation: np.ndarray
    drift: tuple[float, float]


_four_bars = jax.jit(jax.vmap(lambda lengths, masses: scenes.four_bar(lengths, masses)))
"""Builds a batch; compiled once for all of a size."""


def linkages(copies: int, seed: int = 0) -> PyTree:
    """Crank-rockers with lengths spread by 5 % and masses by 30 %, all able to turn over.

    With those spreads crank + ground stays below coupler + rocker and the crank the shortest rod
    (Grashof's condition); cranks start at 10 rad/s.
    """
    keys = jax.random.split(jax.random.key(seed))
    lengths = jnp.asarray(scenes.CRANK_ROCKER)
    lengths = lengths * jax.random.uniform(keys[0], (copies, 4), minval=0.95, maxval=1.05)
    masses = jax.random.uniform(keys[1], (copies, 3), minval=0.7, maxval=1.3)
    masses = masses * jnp.array([0.3, 0.9, 0.7])
    return _four_bars(lengths, masses)


def simulate(worlds: PyTree, seconds: float, chunks: int = 50) -> Simulation:
    """Runs every world for some simulated seconds under jit(vmap(rollout))."""
    systems, states = worlds
    steps = round(seconds / STEP / chunks)

    def record(state: Any, info: Any) -> Array:
        return info.violation.worst

    def run(system: Any, state: Any) -> Any:
        dt = jnp.asarray(STEP, state.q.dtype)
        final, worst = rollout(system, METHOD, state, None, dt, steps, record=record)
        return final, jnp.max(worst)

    begin = time.perf_counter()
    compiled = jax.jit(jax.vmap(run)).lower(systems, states).compile()
    compile_time = time.perf_counter() - begin
    start = jax.vmap(energy)(systems, states)
    worst, spent = [], 0.0
    for _ in tqdm(range(chunks), desc="simulating", unit="chunk", disable=None):
        begin = time.perf_counter()
        states, off = jax.block_until_ready(compiled(systems, states))
        spent += time.perf_counter() - begin
        worst.append(float(off.max()))
    raise_for_status(states)
    end = jax.vmap(energy)(systems, states)
    drift = jnp.abs(end.total - start.total) / start.kinetic
    throughput = states.status.size * steps * chunks / spent
    times = STEP * steps * np.arange(1, chunks + 1)
    spread = float(jnp.median(drift)), float(jnp.max(drift))
    return Simulation(throughput, compile_time, times, np.array(worst), spread)


def feedback(gains: PyTree) -> Method:
    """The method with PID feedback of these gains, `proportional`, `derivative` and `integral`."""
    return dataclasses.replace(METHOD, stabilizer=PID(**gains))


def default_gains(dtype: Any) -> PyTree:
    """K_p = β² [1/s²] and K_d = 2α [1/s] of the default feedback, and K_i = 0 [1/s³]."""
    alpha, beta = METHOD.integrator.default_gains(jnp.asarray(STEP, dtype))
    return {"proportional": beta**2, "derivative": 2 * alpha, "integral": 0 * alpha}


def errors(gains: PyTree, worlds: PyTree, steps: int) -> tuple[State, Array]:
    """The final states and φ [m] of every step, (copies, steps, rows), from consistent starts."""
    method = feedback(gains)

    def run(system: Any, state: Any) -> Any:
        start = init(system, method, state.q, state.v)
        dt = jnp.asarray(STEP, state.q.dtype)
        return rollout(
            system, method, start, None, dt, steps, record=lambda s, i: i.violation.position
        )

    return jax.vmap(run)(*worlds)


def loss(gains: PyTree, worlds: PyTree, steps: int) -> Array:
    """log₁₀ of the root mean square of φ over rows, time and copies, () [m]."""
    final, off = errors(gains, worlds, steps)
    return losses.unless_failed(jnp.log10(jnp.mean(off**2)) / 2, final)


@dataclass(frozen=True)
class Tuning:
    """Gains before and after, by name [1/s², 1/s, 1/s³], and the way between them.

    Attributes:
        default: of the default feedback.
        tuned: found from there, with an integral.
        history: rms of φ by iteration [m].
        before: the same by default [m].
        copies: how many linkages the loss is a mean over.
    """

    default: dict[str, float]
    tuned: dict[str, float]
    history: np.ndarray
    before: float
    copies: int


def tune(worlds: PyTree, steps: int = 250, iterations: int = 30) -> Tuning:
    """Tunes PID gains by gradients through the rollout, from the default and a small integral.

    The error after a step is what the step itself adds, and changes little from one to the next.
    Proportional and derivative gains leave it as it is; an integral takes most of it away.
    """
    default = default_gains(worlds[1].q.dtype)
    start = default | {"integral": default["derivative"] ** 3 / 10}
    own = functools.partial(loss, worlds=worlds, steps=steps)
    found = tuning.tune(own, start, positive=True, steps=iterations)
    before = 10 ** float(jax.jit(own)(default))
    before_after = [{name: float(x) for name, x in g.items()} for g in (default, found.params)]
    return Tuning(
        default=before_after[0],
        tuned=before_after[1],
        history=10.0**found.history,
        before=before,
        copies=worlds[1].status.size,
    )


@dataclass(frozen=True)
class Validation:
    """Errors with default and tuned gains on copies that were not used in tuning, (2, …) [m].

    Attributes:
        times: middles of windows [s], (windows,).
        rms: of φ by window and copy, (2, windows, copies).
        worst: |φ| of all, (2,).
    """

    times: np.ndarray
    rms: np.ndarray
    worst: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """rms of φ over all copies and time, (2,)."""
        return np.sqrt(np.mean(self.rms**2, axis=(1, 2)))


def validate(found: Tuning, worlds: PyTree, seconds: float, windows: int = 100) -> Validation:
    """Runs fresh copies with default and tuned gains, by one compiled program."""
    length = max(round(seconds / STEP / windows), 1)
    dtype = worlds[1].q.dtype

    def run(gains: Any, system: Any, state: Any) -> Any:
        method = feedback(gains)
        start = init(system, method, state.q, state.v)
        dt = jnp.asarray(STEP, dtype)

        def record(state: Any, info: Any) -> Any:
            off = info.violation.position
            return jnp.mean(off**2), jnp.max(jnp.abs(off))

        return rollout(system, method, start, None, dt, length * windows, record=record)

    compiled = jax.jit(jax.vmap(run, (None, 0, 0)))
    rms, worst = [], []
    for gains in (found.default, found.tuned):
        given = {name: jnp.asarray(x, dtype) for name, x in gains.items()}
        final, (square, most) = compiled(given, *worlds)
        raise_for_status(final)
        square = np.asarray(square).reshape(-1, windows, length)
        rms.append(np.sqrt(square.mean(axis=2)).T)
        worst.append(np.max(most))
    times = STEP * length * (np.arange(windows) + 0.5)
    return Validation(times, np.array(rms), np.array(worst))


def main(copies: int = 1024, seconds: float = 5.0, picture: str = "jaxcon.png") -> None:
    """Simulates, tunes, prints and draws."""
    worlds = linkages(copies)
    print(f"{copies} crank-rocker four-bars, closed loops, h = {STEP * 1e3:g} ms, {seconds:g} s")
    result = simulate(worlds, seconds)
    print(f"  compiled in {result.compile_time:.1f} s on {jax.devices()[0].device_kind}")
    print(f"  {result.throughput:,.0f} environment-steps per second")
    print(f"  worst violation {result.violation.max():.2e} m")
    print(f"  energy drift: median {result.drift[0]:.2e}, worst {result.drift[1]:.2e} (relative)")
    found = tune(jax.tree.map(lambda x: x[:64], worlds))
    print(f"feedback gains by gradient through 250 steps of {found.copies} linkages")
    for label, gains in (("default", found.default), ("tuned", found.tuned)):
        p, d, i = (gains[name] for name in ("proportional", "derivative", "integral"))
        print(f"  {label:8s} K_p {p:8.3g} 1/s²   K_d {d:6.3g} 1/s   K_i {i:8.3g} 1/s³")
    fresh = validate(found, linkages(copies, seed=1), seconds)
    print(f"{copies} other linkages for {seconds:g} s")
    for label, mean, worst in zip(("default", "tuned"), fresh.mean, fresh.worst, strict=True):
        print(f"  {label:8s} joint errors {mean:.2e} m rms, {worst:.2e} m at worst")
    print(f"  the tuned gains leave {fresh.mean[0] / fresh.mean[1]:.1f} times less (rms)")
    from jaxcon import view

    view.main_job(found, fresh, jax.tree.map(lambda x: x[0], worlds), STEP, picture)
    print(f"wrote {picture}")
