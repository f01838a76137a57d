"""Coordinates, rows and operations that a scene needs, from a particle to a humanoid.

    python -m benchmarks.needed [--scenes particle rod …] [--batch 256] [--counts] [--json FILE]

Each scene adds a feature to the previous scene. Operations are those of one world's step, counted
by `jaxcon.staging.operations`. Of a conditional, the cheapest branch counts. Of a loop of unknown
length, such as that of a contact solver, one iteration counts. Instructions are those of the
program before compilation.

Time is that of a step of one world in a batch on one device, in float32, with semi-implicit Euler,
Baumgarte and the solver of `jc.Method.auto`. `--counts` skips the timing.
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
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import mechanisms, timing
from jaxcon.analysis.work import seconds, work
from jaxcon.contact.rows import count_bounds
from jaxcon.methods.choice import words


@dataclass(frozen=True)
class Need:
    """Size and cost of one scene.

    Attributes:
        scene: name of the scene.
        positions: number of position coordinates.
        velocities: number of velocities.
        rows: number of equality rows.
        bounded: number of inequality rows.
        operations: arithmetic operations of one world's step.
        instructions: instructions of the program.
        solver: the chosen solver.
        step: time of a step per world [s], None if not measured.
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


def particle(dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds a particle in the plane in free fall."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0)
    return scene.build()


def rod(dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds a particle in the plane on a rod."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


def ball(dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds a ball in space that falls on a floor with friction."""
    scene = jc.Scene(dtype=dtype)
    scene.add_body("ball", inertia=jc.inertia.sphere(0.5, 0.1), position=(0, 0, 1))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=0.1, friction=0.4))
    return scene.build()


def mechanism(name: str) -> Callable[[Any], tuple[Any, jc.State]]:
    """Returns the builder of one of the benchmarks' mechanisms."""
    return lambda dtype: mechanisms.find(name).build(dtype)


def robot(name: str, ignore: tuple[str, ...] = ()) -> Callable[[Any], tuple[Any, jc.State]]:
    """Returns the builder of one of Gymnasium's models."""

    def build(dtype: DTypeLike) -> tuple[Any, jc.State]:
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


def measure(name: str, batch: int | None, dtype: DTypeLike = np.float32) -> Need:
    """Counts coordinates, rows and operations of one scene.

    If a batch size is given, it also times a step.
    """
    system, state = SCENES[name](dtype)
    method = jc.Method.auto(system, state, batch or 1)
    layout = system.layout
    control = np.zeros(layout.n_u, dtype) if layout is not None and layout.n_u else None
    count = work(system, method, state, control)
    rows = jax.eval_shape(lambda s: jc.violation(system, s), state).position.shape[0]
    return Need(
        name,
        len(state.q),
        len(state.v),
        rows,
        count_bounds(system, state.q, state.v),
        count.usual,
        count.instructions,
        words(method.solver),
        None if batch is None else seconds(system, method, state, control, batch),
    )


HEAD = """
| scene | positions | velocities | rows | inequalities | operations | instructions | step | solver |
|---|---|---|---|---|---|---|---|---|"""


def line(need: Need) -> str:
    """Formats the needs of one scene as a table row."""
    step = "-" if need.step is None else f"{1e6 * need.step:.3g} µs"
    numbers = (need.positions, need.velocities, need.rows, need.bounded)
    cells = [need.scene, *numbers, f"{need.operations:.0f}", need.instructions, step]
    return "| " + " | ".join(map(str, [*cells, f"`{need.solver}`"])) + " |"


def main() -> None:
    """Prints the table of scenes and writes the file of `--json`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--counts", action="store_true", help="skip the timing")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    print(timing.machine())
    print(HEAD)
    rows = []
    for name in options.scenes:
        rows.append(measure(name, None if options.counts else options.batch))
        print(line(rows[-1]), flush=True)
    if options.json:
        result = {"machine": timing.machine(), "batch": options.batch, "rows": rows}
        options.json.write_text(json.dumps(timing.plain(result), indent=1) + "\n")


if __name__ == "__main__":
    main()
