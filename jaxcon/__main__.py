"""The command line: `python -m jaxcon`, `python -m jaxcon verify` and `… tradeoff SCENE`."""

from __future__ import annotations

import argparse
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
"""The scenes of `jaxcon.scenes` that the command line knows, by name."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns its exit status."""
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
    _add_tradeoff(commands)
    options = parser.parse_args(arguments)
    for path in (getattr(options, name, None) for name in ("picture", "json", "file")):
        if path and not Path(path).absolute().parent.is_dir():
            parser.error(f"there is no folder for {path}")
        if path and Path(path).is_dir():
            parser.error(f"{path} is a folder; name a file in it")
    if options.command == "verify":
        return run_verify(options.cases, options.json)
    if options.command == "tradeoff":
        return run_tradeoff(options)
    return run_demo(options.copies, options.seconds, options.picture)


def positive(text: str) -> float:
    """A number that is positive and finite, of an option."""
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"must be positive and finite, got {text}")
    return number


def whole(text: str) -> int:
    """A whole number from 1, of an option."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1, got {text}")
    return number


def run_demo(copies: int, seconds: float, picture: str) -> int:
    """Simulates many linkages, tunes their gains and draws a picture."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    from jaxcon import demo

    demo.main(copies, seconds, picture)
    return 0


def _add_tradeoff(commands: Any) -> None:
    """The options of `tradeoff`."""
    command = commands.add_parser("tradeoff", help="which method to take on a scene")
    command.add_argument(
        "scene",
        help="a name from jaxcon.scenes, a model of MuJoCo (.xml, .urdf), or file.py:function,"
        " which returns (system, state)",
    )
    command.add_argument("--seconds", type=positive, default=1.0, help="simulated seconds")
    command.add_argument("--error", type=positive, help="recommend for at most this error [m]")
    command.add_argument("--cost", type=positive, help="recommend for at most this cost [s/s]")
    command.add_argument("--budget", type=positive, default=300.0, help="seconds that it may take")
    command.add_argument("--batch", type=whole, default=256, help="worlds that share the device")
    command.add_argument("--file", metavar="FILE", help="goes on from there if interrupted")
    command.add_argument("--picture", help="where to write the work-precision diagram")
    command.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    command.add_argument("--all", action="store_true", help="print every run")


def run_tradeoff(options: argparse.Namespace) -> int:
    """Compares methods on a scene; 1 where none is as accurate or as cheap as asked."""
    begin = time.perf_counter()
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxcon.analysis.tradeoff import tradeoff
    from jaxcon.core.status import SimulationError

    known = {"batch": options.batch, "file": options.file}
    try:
        system, state = find_scene(options.scene)
        # importing and building count, too, but leave something of the budget to compare with
        spent = time.perf_counter() - begin
        known["budget"] = max(options.budget - spent, options.budget / 2)
        result = tradeoff(system, state, options.seconds, **known)
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
    for what in ("error", "cost"):
        most = getattr(options, what)
        if most is not None:
            try:
                chosen = result.recommend(**{what: most})
                unit = chosen.unit if what == "error" else "s/s"
                print(f"\n{what} of at most {most:g} {unit}: {chosen}")
            except ValueError as error:
                print(error)
                return 1
    return 0


def find_scene(name: str) -> Any:
    """The system and state of a name, of a model, or of a function in a file.

    Raises:
        ValueError: there is none.
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
    """Compares with the reference cases in float64; 1 where one fails."""
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
        for row in rows:  # JSON has no infinity: null is "no bound", or a figure that is none
            row.update((k, None) for k in ("value", "bound") if not math.isfinite(row[k]))
        file.write_text(json.dumps(rows, indent=1) + "\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
