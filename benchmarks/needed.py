"""Only what a scene requires: coordinates, rows and operations from a particle to a humanoid.

    python -m benchmarks.needed [--scenes particle rod …] [--batch 256] [--counts] [--json FILE]

Each scene has what the one before it lacks. Operations are those of one world's step as
`jaxcon.core.operations` counts them: of alternatives the cheapest, loops of unknown length as one
round, so that of bounded rows one iteration is counted. Instructions are those of the program
before it is compiled. Time is that of a step of one world in a batch, float32, semi-implicit Euler
with Baumgarte and the solver of `jc.Method.auto`, on one device; `--counts` leaves it out.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms, timing
from jaxcon.analysis.work import seconds, work
from jaxcon.constraints.bounds import count_bounds
from jaxcon.simulation.choice import words


@dataclass(frozen=True)
class Need:
    """What one scene takes.

    Attributes:
        scene: its name.
        positions, velocities: numbers of its state.
        rows, bounded: with free and with bounded multipliers.
        operations: arithmetic of one world's step.
        instructions: of the program.
        solver: that was taken.
        step: time of a step of one world [s]; None where it was not asked.
    """

    scene: str
    positions: int
    velocities: int
    rows: int
    bounded: int
    operations: float
    instructions: int
    solver: str
    step: float | None = None


def particle(dtype: Any) -> tuple[Any, jc.State]:
    """A particle in the plane that falls."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0)
    return scene.build()


def rod(dtype: Any) -> tuple[Any, jc.State]:
    """The same on a rod."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


def ball(dtype: Any) -> tuple[Any, jc.State]:
    """A ball in space that falls on a floor with friction."""
    scene = jc.Scene(dtype=dtype)
    scene.add_body("ball", inertia=jc.inertia.sphere(0.5, 0.1), position=(0, 0, 1))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=0.1, friction=0.4))
    return scene.build()


def mechanism(name: str) -> Callable[[Any], tuple[Any, jc.State]]:
    """One of the benchmarks."""
    return lambda dtype: mechanisms.find(name).build(dtype)


def robot(name: str, ignore: tuple[str, ...] = ()) -> Callable[[Any], tuple[Any, jc.State]]:
    """One of Gymnasium's models."""

    def build(dtype: Any) -> tuple[Any, jc.State]:
        from benchmarks.mjcf_agreement import ASSETS

        system, state = jc.from_mjcf(str(ASSETS / f"{name}.xml"), ignore, dtype=np.dtype(dtype))
        return system, state

    return build


SCENES: dict[str, Callable[[Any], tuple[Any, jc.State]]] = {
    "particle": particle,
    "rod": rod,
    "planar pendulum": mechanism("planar-chain-1"),
    "pendulum": mechanism("pendulum"),
    "four-bar": mechanism("four-bar"),
    "ball on a floor": ball,
    "chain of ten": mechanism("chain-10"),
    "Stewart platform": mechanism("stewart"),
    "hopper": robot("hopper"),
    "humanoid": robot("humanoid"),
}


def measure(name: str, batch: int | None, dtype: Any = np.float32) -> Need:
    """One scene, timed in a batch where one is given."""
    system, state = SCENES[name](dtype)
    method = jc.Method.auto(system, state, batch or 1)
    layout = getattr(system, "layout", None)
    control = np.zeros(layout.n_u, dtype) if layout is not None and layout.n_u else None
    found = work(system, method, state, control)
    rows = jax.eval_shape(lambda s: jc.violation(system, s), state).position.shape[0]
    return Need(
        name,
        len(state.q),
        len(state.v),
        rows,
        count_bounds(system, state.q, state.v),
        found.usual,
        found.instructions,
        words(method.solver),
        None if batch is None else seconds(system, method, state, control, batch),
    )


HEAD = """
| scene | positions | velocities | rows | bounded | operations | instructions | a step | solver |
|---|---|---|---|---|---|---|---|---|"""


def line(need: Need) -> str:
    """A row of the table."""
    step = "-" if need.step is None else f"{1e6 * need.step:.3g} µs"
    numbers = (need.positions, need.velocities, need.rows, need.bounded)
    cells = [need.scene, *numbers, f"{need.operations:.0f}", need.instructions, step]
    return "| " + " | ".join(map(str, [*cells, f"`{need.solver}`"])) + " |"


def main() -> None:
    """Prints the table and writes the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--counts", action="store_true", help="do not measure time")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    print(timing.machine())
    print(HEAD)
    found = []
    for name in options.scenes:
        found.append(measure(name, None if options.counts else options.batch))
        print(line(found[-1]), flush=True)
    if options.json:
        result = {"machine": timing.machine(), "batch": options.batch, "rows": found}
        options.json.write_text(json.dumps(timing.plain(result), indent=1) + "\n")


if __name__ == "__main__":
    main()
