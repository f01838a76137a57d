"""The results that `tradeoff` saves in a file and resumes from, and its time budget."""

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

from jaxcon.analysis.front import LeftOut, Run, StabilityLimit
from jaxcon.analysis.reference import Reference
from jaxcon.analysis.sweep import Unit
from jaxcon.analysis.trials import Course, Observation, Points
from jaxcon.core import checkpoint as files
from jaxcon.methods.method import Method

OWNER = "tradeoff"
ROOT = Path(files.__file__).parents[1]
"""The directory of the package."""
SLOWER = 1.3
"""The factor by which a task may take longer than the longest task of its kind so far."""
FIRST = 5
"""The factor by which the first task of a kind may take longer than tasks of other kinds.

For example, for RK4 on five bodies in 3D, compiling the gradient takes three minutes, but the runs
take only half a minute.
"""

GRADIENT = 3
"""The factor by which the first gradient may take longer than compiling the runs of its method.

On a four-bar, the measured factor is 1.5 to 2.2. The time of later gradients is predicted from the
first gradient.
"""


@dataclass(frozen=True)
class Wanted:
    """A method to measure, with precision and step sizes.

    Attributes:
        name: name of the method.
        method: the method.
        dtype: "float32" or "float64".
        dts: the user's step sizes [s]; None for default step sizes.
    """

    name: str
    method: Method
    dtype: str
    dts: tuple[float, ...] | None

    @property
    def key(self) -> str:
        """The key of this method's results in the ledger; it is the same in every process."""
        leaves, structure = jax.tree.flatten(self.method)
        # functions print with their addresses, which differ between processes
        plain = re.sub(r" at 0x[0-9a-f]+", "", str(structure))
        digest = files.digest(plain, str(self.dts), *leaves)
        return f"{self.name}, {self.dtype}, {digest}"


@dataclass
class Ledger:
    """The reference solution and the results so far, saved in a file.

    Attributes:
        file: path of the file; None keeps results in memory only.
        about: the settings of the comparison, which must match the settings in the file.
        contents: reference and results as JSON values.
    """

    file: Path | None
    about: dict[str, Any]
    contents: dict[str, Any] = field(default_factory=lambda: {"reference": None, "units": {}})

    @classmethod
    def open(cls, file: str | Path | None, course: Course, batch: int) -> Ledger:
        """Returns the ledger of an existing file, or a new one.

        Raises:
            ValueError: the file belongs to another comparison; the message says which setting
                differs.
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
        ledger = cls(path, about)
        if path.exists():
            (text,) = files.read(path, [np.zeros(())], about, OWNER)
            ledger.contents = json.loads(str(text))
        return ledger

    def save(self) -> None:
        """Writes the results to the file, if there is one."""
        if self.file is not None:
            files.write(self.file, self.about, [np.array(json.dumps(self.contents))])

    @property
    def reference(self) -> Reference | None:
        """The saved reference solution; None if there is none yet."""
        values = self.contents["reference"]
        if values is None:
            return None
        arrays = {
            "points": Points(*map(np.array, values["points"])),
            "seen": Observation(*map(np.array, values["seen"])),
            "error": np.array(values["error"]),
        }
        return Reference(**values | arrays)

    def keep(self, reference: Reference) -> None:
        """Saves the reference solution."""
        self.contents["reference"] = {
            name: jax.tree.map(lambda x: x.tolist() if isinstance(x, np.ndarray) else x, value)
            for name, value in vars(reference).items()
        }
        self.save()

    def __contains__(self, wanted: Wanted) -> bool:
        return wanted.key in self.contents["units"]

    def __getitem__(self, wanted: Wanted) -> Unit:
        values = self.contents["units"][wanted.key]
        return Unit(
            tuple(Run(**run, method=wanted.method) for run in values["runs"]),
            StabilityLimit(**values["limit"]) if values["limit"] else None,
            tuple(LeftOut(**x) for x in values["left_out"]),
            values["differentiated"],
            values["compiling"],
        )

    def __setitem__(self, wanted: Wanted, unit: Unit) -> None:
        runs = [dataclasses.replace(run, method=None) for run in unit.runs]
        values = asdict(dataclasses.replace(unit, runs=()))
        values["runs"] = [{k: x for k, x in asdict(run).items() if k != "method"} for run in runs]
        self.contents["units"][wanted.key] = values
        self.save()


@functools.cache
def code() -> str:
    """Returns a digest of all modules of the package, since changed code may change results."""
    modules = sorted(ROOT.rglob("*.py"))
    return files.digest(*(f"{path.relative_to(ROOT)}\n{path.read_text()}" for path in modules))


class Clock:
    """The time budget of a comparison.

    Attributes:
        budget: the budget [s].
    """

    def __init__(self, budget: float) -> None:
        self.budget, self.begin = budget, time.perf_counter()
        self.longest: dict[str, float] = {}

    @property
    def spent(self) -> float:
        """The time since the clock was created [s]."""
        return time.perf_counter() - self.begin

    @property
    def left(self) -> float:
        """The remaining budget [s]; negative once it is exceeded."""
        return self.budget - self.spent

    def asks(self, work: str, guess: float | None = None) -> float:
        """Returns an upper estimate of the duration of one more task of a kind [s].

        Args:
            work: the kind of the task, such as "runs".
            guess: estimate for the first task of its kind [s]; by default a multiple of the longest
                task of any kind.
        """
        if guess is None:
            guess = FIRST * max(self.longest.values(), default=0.0)
        return SLOWER * self.longest.get(work, guess)

    def lasts(self, work: str, share: float = 1.0, guess: float | None = None) -> bool:
        """Predicts whether one more task of a kind will end within a share of the budget.

        Args:
            work: the kind of the task, such as "runs".
            share: the share of the budget.
            guess: estimate for the first task of its kind [s], as in `asks`.
        """
        return self.spent + self.asks(work, guess) < share * self.budget

    @contextlib.contextmanager
    def timing(self, work: str) -> Iterator[None]:
        """Measures the time spent in a `with` block, and updates the longest time of its kind.

        Args:
            work: the kind of the task in the block, such as "runs".
        """
        begin = self.spent
        yield
        self.longest[work] = max(self.longest.get(work, 0.0), self.spent - begin)
