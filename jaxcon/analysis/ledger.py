"""What a comparison of methods has found so far: on disk, so that it can go on; and its time."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import re
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxcon.analysis.front import LeftOut, Limit, Run
from jaxcon.analysis.reference import Reference
from jaxcon.analysis.sweep import Unit
from jaxcon.analysis.trials import Course, Points, Seen
from jaxcon.core import checkpoint as files
from jaxcon.simulation.method import Method

OWNER = "tradeoff"
ROOT = Path(files.__file__).parents[1]
"""The folder of the package."""
SLOWER = 1.3
"""How much longer a piece of work may take than the longest one before it."""
FIRST = 5
"""How much longer than those of others the first of a kind may take, as to compile a gradient: of
RK4 on five bodies in space three minutes, where its runs in both batches took half of one."""

GRADIENT = 3
"""How much longer than compiling the runs of a method its gradient may take: 1.5 to 2.2 on a
four-bar. This is for the first one; the next are judged by it."""


@dataclass(frozen=True)
class Wanted:
    """A method in a precision, at steps that were asked for."""

    name: str
    method: Method
    dtype: str
    dts: tuple[float, ...] | None

    @property
    def key(self) -> str:
        """Under which it is kept: the same in another process."""
        leaves, structure = jax.tree.flatten(self.method)
        plain = re.sub(r" at 0x[0-9a-f]+", "", str(structure))
        digest = files.digest(plain, str(self.dts), *leaves)
        return f"{self.name}, {self.dtype}, {digest}"


@dataclass
class Ledger:
    """The reference and the units found so far.

    Attributes:
        file: where they are kept; None, and they are not.
        about: what they belong to.
        contents: as JSON holds them.
    """

    file: Path | None
    about: dict[str, Any]
    contents: dict[str, Any] = field(default_factory=lambda: {"reference": None, "units": {}})

    @classmethod
    def open(cls, file: str | Path | None, course: Course, batch: int) -> Ledger:
        """Returns the ledger of a file, where there is one, or a new one.

        Raises:
            ValueError: the file holds another comparison; the message says what is not the same.
        """
        if file is None:
            return cls(None, {})
        path, problem = files.path(file, OWNER), course.problem
        numbers = jax.tree.leaves((problem.system, problem.start, problem.inputs.rows))
        about = {
            "the system, its start or its inputs": files.digest(
                course.lowered.as_text(), *map(str, map(np.shape, numbers)), *numbers
            ),
            "the horizon": problem.horizon,
            "the batch": batch,
            "the device": f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores",
            "the version of jax": jax.__version__,
            "the code of jaxcon": code(),
        }
        found = cls(path, about)
        if path.exists():
            (text,) = files.read(path, [np.zeros(())], about, OWNER)
            found.contents = json.loads(str(text))
        return found

    def save(self) -> None:
        """Writes all of it, where there is a file."""
        if self.file is not None:
            files.write(self.file, self.about, [np.array(json.dumps(self.contents))])

    @property
    def reference(self) -> Reference | None:
        """The reference, where there is one."""
        known = self.contents["reference"]
        if known is None:
            return None
        rows = {name: [np.array(x) for x in known[name]] for name in ("points", "seen")}
        made = {"points": Points(*rows["points"]), "seen": Seen(*rows["seen"])}
        return Reference(**known | made | {"error": np.array(known["error"])})

    def keep(self, reference: Reference) -> None:
        """Takes the reference in."""
        self.contents["reference"] = {
            name: jax.tree.map(lambda x: x.tolist() if isinstance(x, np.ndarray) else x, value)
            for name, value in vars(reference).items()
        }
        self.save()

    def __contains__(self, wanted: Wanted) -> bool:
        return wanted.key in self.contents["units"]

    def __getitem__(self, wanted: Wanted) -> Unit:
        known = self.contents["units"][wanted.key]
        return Unit(
            tuple(Run(**run, method=wanted.method) for run in known["runs"]),
            Limit(**known["limit"]) if known["limit"] else None,
            tuple(LeftOut(**x) for x in known["left_out"]),
            known["differentiated"],
            known["compiling"],
        )

    def __setitem__(self, wanted: Wanted, unit: Unit) -> None:
        runs = [dataclasses.replace(run, method=None) for run in unit.runs]
        known = asdict(dataclasses.replace(unit, runs=()))
        known["runs"] = [{k: x for k, x in asdict(run).items() if k != "method"} for run in runs]
        self.contents["units"][wanted.key] = known
        self.save()


@functools.cache
def code() -> str:
    """A digest of all modules of the package: what other code found is not to be gone on from."""
    modules = sorted(ROOT.rglob("*.py"))
    return files.digest(*(f"{path.relative_to(ROOT)}\n{path.read_text()}" for path in modules))


class Clock:
    """How much of a budget of time is left.

    Attributes:
        budget: [s].
    """

    def __init__(self, budget: float) -> None:
        self.budget, self.begin = budget, time.perf_counter()
        self.longest: dict[str, float] = {}

    @property
    def spent(self) -> float:
        """So far [s]."""
        return time.perf_counter() - self.begin

    @property
    def left(self) -> float:
        """The rest of the budget [s]; negative beyond it."""
        return self.budget - self.spent

    def asks(self, work: str, guess: float | None = None) -> float:
        """The longest time that one more piece of this kind of work may take [s].

        Args:
            work: its kind.
            guess: for the first of its kind [s]; from the longest of other kinds unless given.
        """
        if guess is None:
            guess = FIRST * max(self.longest.values(), default=0.0)
        return SLOWER * self.longest.get(work, guess)

    def lasts(self, work: str, share: float = 1.0, guess: float | None = None) -> bool:
        """Returns True where a share of the budget lasts for one more piece of this work."""
        return self.spent + self.asks(work, guess) < share * self.budget

    @contextlib.contextmanager
    def timing(self, work: str) -> Iterator[None]:
        """Takes the time of a piece of work."""
        begin = self.spent
        yield
        self.longest[work] = max(self.longest.get(work, 0.0), self.spent - begin)
