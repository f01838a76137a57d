"""The same of MuJoCo in C and of MJX.

MuJoCo in C has a thread a core and records nothing. MJX runs in processes of its own, one for each
setting of XLA, both without contacts; its errors are those of the first. Closed loops are as stiff
as both allow, or nearly so.
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
"""Integrators of MuJoCo in C, iterations of Newton's method, and the time constant of equalities in
steps, of which two are the least and stiffest that it allows; beside RK4 three are often better, as
constants of 0.5 to 50 steps showed."""
MJX = (("RK4", "float64"), ("RK4", "float32"), ("Euler", "float32"))
"""Integrators and precisions of MJX, with one iteration and a time constant of three steps."""
LONG = 4.0
"""Limit of a run of one world in MJX, which takes longer than others [s]."""


Setting = tuple[str, int, float]


def mujoco_model(
    motion: Motion, integrator: str, dt: float, iterations: int = 1, constant: float = 2.0
) -> Any:
    """MuJoCo's model at a step, its loops with a time constant of so many steps."""
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)  # or it writes a file
    model = mujoco.MjModel.from_xml_string(motion.mjcf())
    model.opt.timestep, model.opt.iterations, model.opt.tolerance = dt, iterations, 0.0
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if not motion.gravity:
        model.opt.gravity[:] = 0
    model.eq_solref[:] = (constant * dt, 1.0)
    return model


def mujoco_start(motion: Motion, model: Any) -> Any:
    """MuJoCo's data at the start."""
    import mujoco

    data = mujoco.MjData(model)
    data.qvel[:] = motion.rates
    return data


def in_c(
    motion: Motion, limit: float = 1.0, settings: Sequence[Setting] | None = None
) -> Iterator[list[Point]]:
    """The runs of MuJoCo in C with each setting."""
    for setting in settings or (LOOPS if motion.loops else TREES):
        integrator, iterations, constant = setting
        label = f"{integrator}, float64"
        label += f", closed in {constant:g} h, {iterations} iterations" if motion.loops else ""

        def make(dt: float, s: Setting = setting) -> Any:
            return mujoco_model(motion, s[0], dt, *s[1:])

        yield list(_by_mujoco(motion, label, make, limit))


def _by_mujoco(motion: Motion, label: str, make: Callable[[float], Any], limit: float) -> Any:
    """The cost of a step is that of one that is neither long nor short: effort is fixed."""
    visits: dict[int, np.ndarray] = {}

    def error_of(steps: int) -> float:
        error, visits[steps] = mujoco_path(motion, make(motion.seconds / steps), steps)
        return error

    runs = [(n, x) for n, x in halved(motion, error_of, limit) if np.isfinite(x)]
    if not runs:
        return
    near = next((n for n, x in runs if x < CLOSE), runs[-1][0])
    states = np.repeat(visits[near], BATCH // STARTS, axis=0)
    step = 1 / mujoco_rate(make(motion.seconds / near), states)
    for n, error in runs:
        note = f"batch {BATCH}"
        yield Point("MuJoCo C", label, motion.seconds / n, error, n * step / motion.seconds, note)


def mujoco_path(motion: Motion, model: Any, steps: int) -> tuple[float, np.ndarray]:
    """The error of a run, and states along it, (STARTS, full physics state)."""
    import mujoco

    data, spec = mujoco_start(motion, model), mujoco.mjtState.mjSTATE_FULLPHYSICS
    states = np.zeros((STARTS, mujoco.mj_stateSize(model, spec)))
    for i, state in enumerate(states):
        mujoco.mj_getState(model, data, state, spec)
        mujoco.mj_step(model, data, (i + 1) * steps // STARTS - i * steps // STARTS)
    bad = any(warning.number for warning in data.warning)
    return float("inf") if bad else mujoco_error(motion, model, data.qpos), states


def mujoco_error(motion: Motion, model: Any, qpos: np.ndarray) -> float:
    """Of a configuration at the end."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return motion.error(motion.seen(model, data))


def mujoco_rate(model: Any, states: np.ndarray) -> float:
    """World-steps a second of all cores."""
    few = peers.rate_of(model, states, 4, repeats=1).median
    steps = int(np.clip(SPAN * few / len(states), 4, 2000))
    return peers.rate_of(model, states, steps, repeats=3).median


class Traced:
    """MJX on a motion with one integrator, compiled once for every step."""

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
        """In which its arrays are made."""
        return jax.enable_x64(self.dtype == "float64")

    def numbers(self, dt: float, steps: int) -> tuple[jax.Array, jax.Array]:
        """h and a number of steps as arguments."""
        return jnp.asarray(dt, self.dtype), jnp.asarray(steps, jnp.int32)

    def travel(self, data: Any, dt: jax.Array, steps: jax.Array) -> Any:
        """qpos after so many steps of one world."""
        closing = jnp.broadcast_to(jnp.stack([3 * dt, jnp.ones_like(dt)]), self.closing)
        model = self.model.tree_replace({"opt.timestep": dt, "eq_solref": closing})
        step = functools.partial(peers.mjx_step(), model)

        def one(_: Any, data: Any) -> Any:
            # with a tendon, 64 bits make integers of MJX wider than they were
            return jax.tree.map(lambda new, old: new.astype(old.dtype), step(data), data)

        return jax.lax.fori_loop(0, steps, one, data).qpos

    def runs(self, limit: float) -> list[tuple[int, float]]:
        """Errors by steps."""
        with self.precision():
            one = jax.jit(self.travel).lower(self.state, *self.numbers(1.0, 1)).compile()

        def error_of(steps: int) -> float:
            with self.precision():
                qpos = one(self.state, *self.numbers(self.motion.seconds / steps, steps))
            return mujoco_error(self.motion, self.host, np.asarray(qpos, np.float64))

        return list(halved(self.motion, error_of, limit))

    def step_cost(self, batch: int, dt: float) -> float:
        """Of a step of one world in a batch, all alike: iterations are fixed [s]."""
        with self.precision():
            worlds = jax.tree.map(lambda x: jnp.stack([x] * batch), self.state)
            worlds = timing.over_devices(worlds, batch)
            travel = jax.vmap(self.travel, (0, None, None))
            many, _ = timing.compile_seconds(travel, worlds, *self.numbers(dt, 1))

            def run(count: int) -> Any:
                return jax.block_until_ready(many(worlds, *self.numbers(dt, count)))

            return step_seconds(run) / batch


def in_mjx(motion: Motion, limit: float = 90.0) -> tuple[list[Point], list[str]]:
    """The runs of MJX, each at the better setting of XLA, and why others are missing.

    Args:
        motion: which.
        limit: of each of its processes [s].
    """
    errors: dict[str, list[Any]] = {}
    costs: dict[str, list[tuple[float, str]]] = {}
    notes = []
    for flags in peers.FLAGS:
        found, note = _elsewhere(motion, flags, limit, not errors)
        notes += [note] if note else []
        errors |= found.get("errors", {})
        for label, cost in found.get("costs", {}).items():
            costs.setdefault(label, []).append((cost, flags))
    points = []
    for label, own in costs.items():
        cost, flags = min(own)
        said = f"batch {BATCH}, {flags}".rstrip(", ")
        for steps, error in errors.get(label, []):
            dt = motion.seconds / steps
            error = float("inf") if error is None else error
            points.append(Point("MJX", label, dt, error, cost / dt, said))
    return points, notes


def _elsewhere(
    motion: Motion, flags: str, limit: float, errors: bool
) -> tuple[dict[str, Any], str]:
    """What a process of MJX had found when it ended or was stopped, and why it was."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "found.json"
        given = ["benchmarks.work_precision_peers", "--mjx", motion.name, "--file", str(file)]
        given += ["--errors"] if errors else []
        ended = timing.in_process(given, timing.with_flags(flags), limit, "is not done in")
        found = json.loads(file.read_text()) if file.exists() else {}
    said = f"MJX, {motion.name}, {flags or 'default'}: {ended}" if isinstance(ended, str) else ""
    return found, said


def mjx_here(motion: Motion, file: Path, errors: bool) -> None:
    """Costs, and errors too, written as they are found; without errors, costs of the first two."""
    found: dict[str, dict[str, Any]] = {"errors": {}, "costs": {}}
    for integrator, dtype in MJX if errors else MJX[:2]:
        label, traced = f"{integrator}, {dtype}", Traced(motion, integrator, dtype)
        if errors:
            found["errors"][label] = timing.plain(traced.runs(LONG))
        found["costs"][label] = traced.step_cost(BATCH, motion.seconds / motion.first / 4)
        file.write_text(json.dumps(found))


def main() -> None:
    """One process of MJX."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mjx", metavar="MOTION", required=True, choices=list(MOTIONS))
    parser.add_argument("--file", type=Path, required=True)
    parser.add_argument("--errors", action="store_true", help="find errors, too")
    given = parser.parse_args()
    timing.use_all_cores()
    mjx_here(MOTIONS[given.mjx](), given.file, given.errors)
    print(json.dumps({}))


if __name__ == "__main__":
    main()
