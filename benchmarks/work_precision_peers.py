"""Cost and error of motions against step size in MuJoCo in C and MJX.

MuJoCo in C has one thread per core and records nothing. MJX runs in one process per XLA setting;
only the first process measures errors. Both codes run without contacts. Closed loops are as stiff
as both codes allow, or nearly so.
"""

from __future__ import annotations

import argparse
import functools
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers, timing
from benchmarks.motions import MOTIONS, Motion
from benchmarks.work_precision import BATCH, CLOSE, SPAN, STARTS, Point, halved, step_seconds

TREES = (("RK4", 1, 2.0), ("Euler", 1, 2.0), ("implicitfast", 1, 2.0))
LOOPS = (*TREES, ("RK4", 1, 3.0), ("RK4", 3, 3.0))
"""Settings of MuJoCo in C: integrator, Newton iterations, time constant of equalities in steps.

Two steps are the shortest and stiffest time constant that MuJoCo allows. With RK4, three steps are
often better, as a comparison of constants from 0.5 to 50 steps showed.
"""
MJX = (("RK4", "float64"), ("RK4", "float32"), ("Euler", "float32"))
"""Integrators and precisions of MJX, with one iteration and a time constant of three steps."""
LONG = 4.0
"""CPU time limit of a run of one world in MJX [s]."""


Setting = tuple[str, int, float]


def mujoco_model(
    motion: Motion, integrator: str, dt: float, iterations: int = 1, constant: float = 2.0
) -> Any:
    """Returns MuJoCo's model at a step size. The time constant of its loops is given in steps."""
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)  # the default handler writes a log file
    model = mujoco.MjModel.from_xml_string(motion.mjcf())
    model.opt.timestep, model.opt.iterations, model.opt.tolerance = dt, iterations, 0.0
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if not motion.gravity:
        model.opt.gravity[:] = 0
    model.eq_solref[:] = (constant * dt, 1.0)
    return model


def mujoco_start(motion: Motion, model: Any) -> Any:
    """Returns MuJoCo's data in the initial state of a motion."""
    import mujoco

    data = mujoco.MjData(model)
    data.qvel[:] = motion.rates
    return data


def in_c(
    motion: Motion, limit: float = 1.0, settings: Sequence[Setting] | None = None
) -> Iterator[list[Point]]:
    """Yields the runs of MuJoCo in C, one list for each setting."""
    for setting in settings or (LOOPS if motion.loops else TREES):
        integrator, iterations, constant = setting
        label = f"{integrator}, float64"
        label += f", closed in {constant:g} h, {iterations} iterations" if motion.loops else ""

        def make(dt: float, s: Setting = setting) -> Any:
            return mujoco_model(motion, s[0], dt, *s[1:])

        yield list(_by_mujoco(motion, label, make, limit))


def _by_mujoco(motion: Motion, label: str, make: Callable[[float], Any], limit: float) -> Any:
    """Yields the runs of one setting.

    Only one step size is timed, since MuJoCo's effort per step is fixed.
    """
    states_of: dict[int, np.ndarray] = {}

    def error_of(steps: int) -> float:
        error, states_of[steps] = mujoco_path(motion, make(motion.seconds / steps), steps)
        return error

    runs = [(n, x) for n, x in halved(motion, error_of, limit) if np.isfinite(x)]
    if not runs:
        return
    timed = next((n for n, x in runs if x < CLOSE), runs[-1][0])
    states = np.repeat(states_of[timed], BATCH // STARTS, axis=0)
    step = 1 / mujoco_rate(make(motion.seconds / timed), states)
    for n, error in runs:
        note = f"batch {BATCH}"
        yield Point("MuJoCo C", label, motion.seconds / n, error, n * step / motion.seconds, note)


def mujoco_path(motion: Motion, model: Any, steps: int) -> tuple[float, np.ndarray]:
    """Simulates a motion in MuJoCo.

    Returns:
        The error of the run, and states along it, (STARTS, full physics state).
    """
    import mujoco

    data, spec = mujoco_start(motion, model), mujoco.mjtState.mjSTATE_FULLPHYSICS
    states = np.zeros((STARTS, mujoco.mj_stateSize(model, spec)))
    for i, state in enumerate(states):
        mujoco.mj_getState(model, data, state, spec)
        mujoco.mj_step(model, data, (i + 1) * steps // STARTS - i * steps // STARTS)
    bad = any(warning.number for warning in data.warning)
    return float("inf") if bad else mujoco_error(motion, model, data.qpos), states


def mujoco_error(motion: Motion, model: Any, qpos: np.ndarray) -> float:
    """Returns the error of a final configuration qpos of a motion, measured in MuJoCo."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return motion.error(motion.seen(model, data))


def mujoco_rate(model: Any, states: np.ndarray) -> float:
    """Measures world-steps per second of MuJoCo in C on all cores, from a batch of states."""
    trial_rate = peers.rate_of(model, states, 4, repeats=1).median
    steps = int(np.clip(SPAN * trial_rate / len(states), 4, 2000))
    return peers.rate_of(model, states, steps, repeats=3).median


class Traced:
    """MJX on a motion with one integrator, compiled once for all step sizes."""

    def __init__(self, motion: Motion, integrator: str, dtype: str) -> None:
        from mujoco import mjx

        self.motion, self.dtype = motion, dtype
        self.host = mujoco_model(motion, integrator, 1e-3)
        self.host.opt.ls_iterations = 4
        self.data = mujoco_start(motion, self.host)
        with self.precision():
            self.model, self.state = mjx.put_model(self.host), mjx.put_data(self.host, self.data)
        self.closing = self.host.eq_solref.shape

    def precision(self) -> Any:
        """Returns a context manager for the precision of the arrays."""
        return jax.enable_x64(self.dtype == "float64")

    def numbers(self, dt: float, steps: int) -> tuple[jax.Array, jax.Array]:
        """Returns step size and number of steps as array arguments."""
        return jnp.asarray(dt, self.dtype), jnp.asarray(steps, jnp.int32)

    def travel(self, data: Any, dt: jax.Array, steps: jax.Array) -> Any:
        """Returns qpos after a number of steps of one world."""
        closing = jnp.broadcast_to(jnp.stack([3 * dt, jnp.ones_like(dt)]), self.closing)
        model = self.model.tree_replace({"opt.timestep": dt, "eq_solref": closing})
        step = functools.partial(peers.mjx_step(), model)

        def step_once(_: Any, data: Any) -> Any:
            # In 64 bits, MJX widens integers of models with tendons; the loop needs fixed dtypes.
            return jax.tree.map(lambda new, old: new.astype(old.dtype), step(data), data)

        return jax.lax.fori_loop(0, steps, step_once, data).qpos

    def runs(self, limit: float) -> list[tuple[int, float]]:
        """Returns numbers of steps with their errors."""
        with self.precision():
            compiled = jax.jit(self.travel).lower(self.state, *self.numbers(1.0, 1)).compile()

        def error_of(steps: int) -> float:
            with self.precision():
                qpos = compiled(self.state, *self.numbers(self.motion.seconds / steps, steps))
            return mujoco_error(self.motion, self.host, np.asarray(qpos, np.float64))

        return list(halved(self.motion, error_of, limit))

    def step_cost(self, batch: int, dt: float) -> float:
        """Returns the time of a step per world in a batch of equal worlds [s].

        Worlds may be equal because the number of solver iterations is fixed.
        """
        with self.precision():
            worlds = jax.tree.map(lambda x: jnp.stack([x] * batch), self.state)
            worlds = timing.over_devices(worlds, batch)
            travel = jax.vmap(self.travel, (0, None, None))
            compiled, _ = timing.compile_seconds(travel, worlds, *self.numbers(dt, 1))

            def run(count: int) -> Any:
                return jax.block_until_ready(compiled(worlds, *self.numbers(dt, count)))

            return step_seconds(run) / batch


def in_mjx(motion: Motion, limit: float = 90.0) -> tuple[list[Point], list[str]]:
    """Returns the runs of MJX, each with the better XLA setting, and the reasons for missing runs.

    Args:
        motion: the motion to run.
        limit: time limit of each process [s].
    """
    errors: dict[str, list[Any]] = {}
    costs: dict[str, list[tuple[float, str]]] = {}
    notes = []
    for flags in peers.FLAGS:
        results, note = _elsewhere(motion, flags, limit, not errors)
        notes += [note] if note else []
        errors |= results.get("errors", {})
        for label, cost in results.get("costs", {}).items():
            costs.setdefault(label, []).append((cost, flags))
    points = []
    for label, candidates in costs.items():
        cost, flags = min(candidates)
        batch = f"batch {BATCH}, {flags}".rstrip(", ")
        for steps, error in errors.get(label, []):
            dt = motion.seconds / steps
            error = float("inf") if error is None else error
            points.append(Point("MJX", label, dt, error, cost / dt, batch))
    return points, notes


def _elsewhere(
    motion: Motion, flags: str, limit: float, errors: bool
) -> tuple[dict[str, Any], str]:
    """Runs MJX in a process of its own until it ends or reaches the limit [s].

    Returns:
        The results so far, and the reason if the process did not finish, otherwise "".
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "found.json"
        arguments = ["benchmarks.work_precision_peers", "--mjx", motion.name, "--file", str(file)]
        arguments += ["--errors"] if errors else []
        status = timing.in_process(arguments, timing.with_flags(flags), limit, "is not done in")
        results = json.loads(file.read_text()) if file.exists() else {}
    note = f"MJX, {motion.name}, {flags or 'default'}: {status}" if isinstance(status, str) else ""
    return results, note


def mjx_here(motion: Motion, file: Path, errors: bool) -> None:
    """Writes costs and errors of MJX to a file.

    Without `errors`, it writes only the costs of the first two settings.
    """
    results: dict[str, dict[str, Any]] = {"errors": {}, "costs": {}}
    for integrator, dtype in MJX if errors else MJX[:2]:
        label, traced = f"{integrator}, {dtype}", Traced(motion, integrator, dtype)
        if errors:
            results["errors"][label] = timing.plain(traced.runs(LONG))
        results["costs"][label] = traced.step_cost(BATCH, motion.seconds / motion.first / 4)
        file.write_text(json.dumps(results))


def main() -> None:
    """Runs MJX for one motion in this process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mjx", metavar="MOTION", required=True, choices=list(MOTIONS))
    parser.add_argument("--file", type=Path, required=True)
    parser.add_argument("--errors", action="store_true", help="measure errors too")
    options = parser.parse_args()
    timing.use_all_cores()
    mjx_here(MOTIONS[options.mjx](), options.file, options.errors)
    print(json.dumps({}))


if __name__ == "__main__":
    main()
