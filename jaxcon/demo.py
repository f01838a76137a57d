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
import optax
from tqdm import tqdm

from jaxcon import scenes
from jaxcon.analysis.quantities import energy
from jaxcon.core.status import raise_for_status
from jaxcon.core.typing import Array, PyTree
from jaxcon.learning import losses, tuning
from jaxcon.simulation.method import Method
from jaxcon.simulation.rollout import rollout
from jaxcon.solvers.sparse import Sparse
from jaxcon.stabilization.baumgarte import Baumgarte

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
    return jax.jit(jax.vmap(scenes.four_bar))(lengths, masses)


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


def loss(gains: Array, worlds: PyTree, steps: int) -> Array:
    """The size of the violation over rows, time and worlds, as `losses.violation`.

    Args:
        gains: (α, β) [1/s].
        worlds: batch of systems and states.
        steps: of the rollout that is differentiated.
    """
    method = dataclasses.replace(METHOD, stabilizer=Baumgarte(*gains))

    def one(system: Any, state: Any) -> Any:
        dt = jnp.asarray(STEP, state.q.dtype)
        return rollout(system, method, state, None, dt, steps, record=lambda s, i: i.violation)[1]

    return losses.violation(jax.vmap(one)(*worlds), STEP)


@dataclass(frozen=True)
class Tuning:
    """Gains (α, β) [1/s] with their loss at three stages, and the loss by iteration."""

    start: tuple[np.ndarray, float]
    default: tuple[np.ndarray, float]
    tuned: tuple[np.ndarray, float]
    history: np.ndarray


def tune(worlds: PyTree, steps: int = 250, iterations: int = 60, rate: float = 1.0) -> Tuning:
    """Adam on log α and log β from a poor start, by gradients through the rollout."""
    dtype = worlds[1].q.dtype
    start = jnp.full(2, rate, dtype)
    default = jnp.asarray(Method().integrator.default_gains(STEP), dtype)
    optimizer = optax.adam(optax.cosine_decay_schedule(0.3, iterations))
    own = functools.partial(loss, worlds=worlds, steps=steps)
    found = tuning.tune(own, start, positive=True, steps=iterations, optimizer=optimizer)
    before = float(jax.jit(own)(default))
    return Tuning(
        (np.asarray(start), float(found.history[0])),
        (np.asarray(default), before),
        (np.asarray(found.params), found.loss),
        found.history,
    )


def main(copies: int = 1024, seconds: float = 5.0, picture: str = "jaxcon.png") -> None:
    """Simulates, tunes, prints and draws."""
    worlds = linkages(copies)
    print(f"{copies} crank-rocker four-bars, closed loops, h = {STEP * 1e3:g} ms, {seconds:g} s")
    result = simulate(worlds, seconds)
    print(f"  compiled in {result.compile_time:.1f} s on {jax.devices()[0].device_kind}")
    print(f"  {result.throughput:,.0f} environment-steps per second")
    print(f"  worst violation {result.violation.max():.2e} m")
    print(f"  energy drift: median {result.drift[0]:.2e}, worst {result.drift[1]:.2e} (relative)")
    tuned = tune(jax.tree.map(lambda x: x[:64], worlds))
    print("Baumgarte gains by gradient through 250 steps of 64 linkages")
    for label in ("start", "default", "tuned"):
        (alpha, beta), value = getattr(tuned, label)
        print(
            f"  {label:8s} alpha {alpha:7.2f}  beta {beta:7.2f} 1/s   violation {10**value:.2e} m"
        )
    from jaxcon import view

    view.main_job(result, tuned, jax.tree.map(lambda x: x[0], worlds), STEP, picture)
    print(f"wrote {picture}")
