"""The command line: `python -m jaxcon` and `python -m jaxcon verify`."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns its exit status."""
    parser = argparse.ArgumentParser(prog="python -m jaxcon", description=__doc__)
    commands = parser.add_subparsers(dest="command")
    demo = commands.add_parser("demo", help="simulate linkages and tune gains (the default)")
    for target in (parser, demo):
        target.add_argument("--copies", type=int, default=1024, help="number of linkages")
        target.add_argument("--seconds", type=float, default=5.0, help="simulated seconds")
        target.add_argument("--picture", default="jaxcon.png", help="where to write the picture")
    verify = commands.add_parser("verify", help="compare with reference cases")
    verify.add_argument("cases", nargs="*", help="names of cases; all unless given")
    verify.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    options = parser.parse_args(arguments)
    if options.command == "verify":
        return run_verify(options.cases, options.json)
    return run_demo(options.copies, options.seconds, options.picture)


def run_demo(copies: int, seconds: float, picture: str) -> int:
    """Simulates many linkages, tunes their gains and draws a picture."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    from jaxcon import demo

    demo.main(copies, seconds, picture)
    return 0


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
