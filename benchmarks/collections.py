"""Counts how many models of public collections `jc.from_mjcf` reads.

    python -m benchmarks.collections FOLDER … [--verbose]

Every .xml file below the folders that MuJoCo itself compiles is a model. A model is read whole, or
refused with reasons; `python -m jaxcon model FILE` prints the same reasons for one file. A model
that is read with a warning counts as whole, unless the warning says that something is left out. A
folder may be an unpacked wheel of dm_control, mujoco-mjx, brax, playground or gymnasium. Nothing is
compiled by JAX.
"""

from __future__ import annotations

import argparse
import collections
import importlib
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxcon.io.overview import overview


@dataclass
class Counts:
    """The results of a collection.

    Attributes:
        tried: number of models that MuJoCo compiles.
        whole: number of models that are read.
        reasons: number of models by the reason of their refusal.
    """

    tried: int = 0
    whole: int = 0
    reasons: collections.Counter[str] = field(default_factory=collections.Counter)


def models(folder: Path) -> list[Path]:
    """Returns the files below a folder that MuJoCo compiles and in which something moves."""
    library: Any = importlib.import_module("mujoco")

    found = []
    for path in sorted(folder.rglob("*.xml")):
        try:
            compiled = library.MjModel.from_xml_path(str(path))
        except ValueError:  # a part of a model, or one whose files are elsewhere
            continue
        if compiled.nv:
            found.append(path)
    return found


def kind(reason: str) -> str:
    """Returns the beginning of a reason, without the names of objects."""
    words = reason.removeprefix("from_mjcf: ").replace('"', "'").split(" '")[0].split()
    return " ".join(words[:6])


def count(paths: Sequence[Path], verbose: bool = False) -> Counts:
    """Reads models, and counts which of them are read whole."""
    result = Counts()
    for path in paths:
        result.tried += 1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                found = overview(path)
            except (ValueError, TypeError) as error:  # an error of jaxcon's, not a refusal
                found, reasons = None, (f"{type(error).__name__}: {error}",)
            else:
                reasons = found.refused
        result.whole += not reasons
        result.reasons.update({kind(x) for x in reasons})
        if verbose and reasons:
            print(path, *reasons, sep="\n    ", flush=True)
    return result


def main(given: list[str] | None = None) -> int:
    """Prints the counts of each folder, and the reasons of refusals."""
    text = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("benchmarks.collections", None, __doc__, formatter_class=text)
    parser.add_argument("folders", nargs="+", type=Path, help="folders with models")
    parser.add_argument("--verbose", action="store_true", help="print the reasons of each file")
    options = parser.parse_args(given)
    reasons: collections.Counter[str] = collections.Counter()
    print("| folder | models | read whole | refused |\n|---|---|---|---|")
    for folder in options.folders:
        counts = count(models(folder), options.verbose)
        refused = counts.tried - counts.whole
        print(f"| {folder.name} | {counts.tried} | {counts.whole} | {refused} |", flush=True)
        reasons += counts.reasons
    print("\n| reason | models |\n|---|---|")
    for reason, number in reasons.most_common():
        print(f"| {reason} | {number} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
