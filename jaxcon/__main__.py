"""The command line: `python -m jaxcon`, `… verify`, `… tradeoff SCENE` and `… model FILE`."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
import runpy
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SCENES = ("four_bar", "bicycle")
"""The scenes of `jaxcon.scenes` that the command line accepts by name."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit status.

    Args:
        arguments: command-line arguments; by default `sys.argv[1:]`.
    """
    parser = argparse.ArgumentParser(prog="python -m jaxcon", description=__doc__)
    commands = parser.add_subparsers(dest="command")
    demo = commands.add_parser("demo", help="simulate linkages and tune gains (the default)")
    for target in (parser, demo):
        target.add_argument("--copies", type=whole, default=1024, help="number of linkages")
        target.add_argument("--seconds", type=positive, default=5.0, help="simulated seconds")
        target.add_argument("--picture", default="jaxcon.png", help="where to write the picture")
    verify = commands.add_parser("verify", help="compare with reference cases")
    verify.add_argument("cases", nargs="*", help="names of cases; all unless given")
    verify.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    compare = commands.add_parser("tradeoff", help="which method to take on a scene")
    compare.add_argument(
        "scene",
        help="a name from jaxcon.scenes, a model of MuJoCo (.xml, .urdf), or file.py:function,"
        " which returns (system, state)",
    )
    compare.add_argument("--seconds", type=positive, default=1.0, help="simulated seconds")
    compare.add_argument("--error", type=positive, help="recommend for at most this error [m]")
    compare.add_argument("--cost", type=positive, help="recommend for at most this cost [s/s]")
    compare.add_argument("--budget", type=positive, default=300.0, help="seconds that it may take")
    compare.add_argument("--batch", type=whole, default=256, help="worlds that share the device")
    compare.add_argument("--file", metavar="FILE", help="goes on from there if interrupted")
    compare.add_argument("--picture", help="where to write the work-precision diagram")
    compare.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    compare.add_argument("--all", action="store_true", help="print every run")
    robot = commands.add_parser("model", help="what is read from a model of MuJoCo")
    robot.add_argument("model", metavar="FILE", help="a model (.xml, .urdf)")
    robot.add_argument("--ignore", nargs="*", default=(), help="features to leave out")
    robot.add_argument("--batch", type=whole, default=256, help="worlds of the measured rollout")
    robot.add_argument("--quick", action="store_true", help="read only; compile and run nothing")
    robot.add_argument("--picture", help="where to draw the model at its start")
    options = parser.parse_args(arguments)
    for path in (vars(options).get(name) for name in ("picture", "json", "file")):
        if path and not Path(path).absolute().parent.is_dir():
            parser.error(f"there is no folder for {path}")
        if path and Path(path).is_dir():
            parser.error(f"{path} is a folder; name a file in it")
    if options.command == "verify":
        return run_verify(options.cases, options.json)
    if options.command == "tradeoff":
        return run_tradeoff(options)
    if options.command == "model":
        return run_model(options)
    return run_demo(options.copies, options.seconds, options.picture)


def positive(text: str) -> float:
    """Parses a command-line option as a positive, finite number."""
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"must be positive and finite, got {text}")
    return number


def whole(text: str) -> int:
    """Parses a command-line option as a positive integer."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1, got {text}")
    return number


def run_demo(copies: int, seconds: float, picture: str) -> int:
    """Runs the demo: simulates linkages, tunes their gains and draws a picture. Returns 0."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    from jaxcon import demo
    from jaxcon.core.cores import use_all_cores

    with contextlib.suppress(RuntimeError):  # a program that has used JAX keeps its devices
        use_all_cores()

    demo.main(copies, seconds, picture)
    return 0


def run_tradeoff(options: argparse.Namespace) -> int:
    """Compares methods on a scene and prints the result.

    Returns:
        The exit status: 0 for success, 1 if no method meets the limit on error or cost, 2 if the
        comparison failed.
    """
    begin = time.perf_counter()
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxcon.analysis.tradeoff import tradeoff
    from jaxcon.core.status import SimulationError

    try:
        system, state = find_scene(options.scene)
        # imports and building use up the budget, but the comparison gets at least half of it
        budget = max(options.budget - (time.perf_counter() - begin), options.budget / 2)
        result = tradeoff(
            system, state, options.seconds, batch=options.batch, file=options.file, budget=budget
        )
    except (ValueError, OSError, SimulationError) as error:
        print(error)
        return 2
    print(result)
    if options.all:
        print(result.table)
    if options.json:
        result.to_json(options.json)
    if options.picture:
        os.environ.setdefault("MPLBACKEND", "Agg")
        result.plot(options.picture)
    for what, limit in (("error", options.error), ("cost", options.cost)):
        if limit is not None:
            try:
                chosen = result.recommend(**{what: limit})
                unit = chosen.unit if what == "error" else "s/s"
                print(f"\n{what} of at most {limit:g} {unit}: {chosen}")
            except ValueError as error:
                print(error)
                return 1
    return 0


def run_model(options: argparse.Namespace) -> int:
    """Prints what is read from a model, compiles and times its rollouts, and draws it.

    Returns:
        The exit status: 0 if the model was read, 1 if it is refused, 2 if it cannot be compiled.
    """
    from jaxcon.core.cores import use_all_cores
    from jaxcon.io.overview import overview

    with contextlib.suppress(RuntimeError):  # a program that has used JAX keeps its devices
        use_all_cores()
    try:
        found = overview(options.model, tuple(options.ignore))
    except (ValueError, OSError) as error:
        print(error)
        return 2
    print(found)
    if found.model is None:
        return 1
    if options.picture:
        os.environ.setdefault("MPLBACKEND", "Agg")
        from jaxcon import view

        figure: Any = view.draw(found.model.system, found.model.start.q).figure
        figure.savefig(options.picture)
    if not options.quick:
        compiling, rate = rollout_rate(found.model, options.batch)
        print(f"  a rollout of {options.batch} worlds compiles in {compiling:.1f} s and runs at")
        print(f"  {rate:,.0f} steps/s from the start with zero control, by model.method()")
    return 0


def rollout_rate(model: Any, batch: int, steps: int = 100) -> tuple[float, float]:
    """Compiles and times rollouts of a model by its default method.

    Args:
        model: a `jc.io.MujocoModel`.
        batch: the number of worlds.
        steps: the number of steps of a rollout.

    Returns:
        The seconds of tracing and compiling, and steps of all worlds in a second, as the median of
        five runs.
    """
    import jax
    import jax.numpy as jnp

    import jaxcon as jc

    system, method = model.system, model.method()
    start = jc.init(system, method, model.start.q, model.start.v)
    control = jnp.zeros((steps, system.layout.n_u), start.q.dtype)
    worlds = jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), start)
    if batch % jax.device_count() == 0:
        worlds = jc.shard(worlds)

    def end(state: Any) -> Any:
        given = control if system.layout.n_u else None
        return jc.rollout(system, method, state, given, model.timestep, steps)[0]

    begin = time.perf_counter()
    run = jax.jit(jax.vmap(end)).lower(worlds).compile()
    compiling, seconds = time.perf_counter() - begin, []
    for _ in range(6):
        begin = time.perf_counter()
        jax.block_until_ready(run(worlds))
        seconds.append(time.perf_counter() - begin)
    return compiling, batch * steps / sorted(seconds[1:])[2]


def find_scene(name: str) -> Any:
    """Builds a scene from its name, from a model file, or by calling a function in a Python file.

    Args:
        name: one of `SCENES`, the path of an MJCF or URDF file, or "file.py:function".

    Returns:
        The system and its initial state. For a model file it is a `jc.io.MujocoModel`, which
        unpacks to them.

    Raises:
        ValueError: the name is unknown, the file or function does not exist, or the function does
            not return (system, state).
    """
    from jaxcon import scenes
    from jaxcon.io.mjcf import from_mjcf

    file, _, function = name.rpartition(":")
    if file.endswith(".py"):
        if not Path(file).is_file():
            raise ValueError(f"there is no file {file}.")
        made = runpy.run_path(file).get(function)
        if made is None:
            raise ValueError(f"{file} has no function {function}.")
        built = made()
        try:
            system, state = built
        except (TypeError, ValueError):
            raise ValueError(
                f"{function} in {file} must return (system, state), as scene.build() does, and not"
                f" {type(built).__name__}."
            ) from None
        return system, state
    if name.endswith(".py"):
        raise ValueError(f"{name} may have several scenes; say {name}:function.")
    if Path(name).suffix in (".xml", ".urdf", ".mjcf"):
        return from_mjcf(name)
    if name not in SCENES:
        raise ValueError(
            f"scene '{name}' is unknown; known are {list(SCENES)}, files of models (.xml, .urdf),"
            " and file.py:function."
        )
    return getattr(scenes, name)()


def run_verify(names: Sequence[str], file: Path | None) -> int:
    """Runs verification cases in float64 and prints pass or fail for each check.

    Args:
        names: names of the cases; all if empty.
        file: path of a JSON file for the results; None writes no file.

    Returns:
        The exit status: 0 if all checks pass, 1 if a check fails, 2 if a name is unknown.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxcon import verification

    unknown = set(names) - set(verification.CASES)
    if unknown:
        print(f"unknown cases {sorted(unknown)}; known are {list(verification.CASES)}")
        return 2
    checks = []
    for group in verification.run(names or None):
        for check in group:
            verdict = "pass" if check.passed else "FAIL"
            print(
                f"{verdict}  {check.value:9.2e} <= {check.bound:7.1e}  {check.case}: {check.figure}"
            )
        checks += group
        sys.stdout.flush()
    failed = sum(not check.passed for check in checks)
    print(f"{len(checks) - failed} passed, {failed} failed")
    if file:
        rows = [dataclasses.asdict(check) | {"passed": check.passed} for check in checks]
        for row in rows:  # JSON has no infinity and no NaN: null stands for both
            row.update((k, None) for k in ("value", "bound") if not math.isfinite(row[k]))
        file.write_text(json.dumps(rows, indent=1) + "\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
