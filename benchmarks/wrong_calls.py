"""Calls with wrong arguments: each must raise an error that names the argument.

    python -m benchmarks.wrong_calls [--sample N] [--seed K] [--limit SECONDS] [--only TEXT]

A door is one argument of a public call, with valid values for all other arguments. `Takes`
describes the valid values of the argument. Wrong values follow from it: other types, shapes, dtypes
and ranges. Each call has one of four outcomes:

- refused: a ValueError or TypeError whose message names the argument,
- raw: another error of Python, NumPy or JAX, or an error that does not name the argument,
- accepted: no error,
- hung: no answer within the limit.

The last three outcomes must not occur. Such calls are listed.
"""

from __future__ import annotations

import argparse
import random
import re
import signal
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import wrong_doors
from benchmarks.wrong_doors import Door, Takes

EXPECTED = (ValueError, TypeError, FileNotFoundError, jc.SimulationError)
"""Documented error types."""

OUTCOMES = ("refused", "accepted", "raw", "hung")
LIMIT = 20.0
"""Time limit of a call [s]."""


class HungError(BaseException):
    """An exception at the time limit of a call.

    It is a BaseException, so that `except Exception` does not catch it.
    """


@dataclass(frozen=True)
class Call:
    """A call with one wrong value of an argument.

    Attributes:
        door: the call and its open argument.
        label: description of the wrong value.
        value: the wrong value.
    """

    door: Door
    label: str
    value: Any

    def __str__(self) -> str:
        return f"{self.door.name} = {self.label}"

    def outcome(self, limit: float = LIMIT) -> tuple[str, str]:
        """Makes the call. Returns one of `OUTCOMES`, and the error message."""

        def stop(*_: Any) -> None:
            raise HungError

        handler = signal.signal(signal.SIGALRM, stop)
        signal.setitimer(signal.ITIMER_REAL, limit)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self.door.call(self.value)
        except HungError:
            return "hung", f"no answer in {limit:g} s"
        except Exception as error:
            kind = "refused" if self._named(error) else "raw"
            return kind, f"{type(error).__name__}: {str(error)[:300]}"
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, handler)
        return "accepted", ""

    def _named(self, error: Exception) -> bool:
        """Returns True if the error is documented and its message names the argument."""
        if not isinstance(error, EXPECTED):
            return False
        return any(re.search(pattern, str(error)) for pattern in self.door.words)


def calls() -> Iterator[Call]:
    """Yields every door with all its wrong values, then the calls of `SPECIAL`."""
    for door in wrong_doors.doors():
        for label, value in wrong_values(door.takes):
            yield Call(door, label, value)
    for label, (call, words) in wrong_doors.SPECIAL.items():
        yield Call(Door(label, call, Takes(), words), "as it says", None)


def wrong_values(takes: Takes) -> Iterator[tuple[str, Any]]:
    """Yields values that an argument must refuse, with their names."""
    if takes.kind == "one":
        yield "as it says", None
        return
    for label, value, tags in VALUES:
        if tags & takes.allows:
            continue
        yield label, value
    if takes.kind == "real":
        yield from _wrong_numbers(takes)
    if takes.kind == "count":
        for label, value in COUNTS.items():
            yield label, value
        yield "below the smallest count", takes.least - 1


VALUES: list[tuple[str, Any, frozenset[str]]] = [
    (label, value, frozenset(tags.split()))
    for label, value, tags in [
        ("None", None, "none"),
        ("a string", "no such thing", "string"),
        ("a string of a number", "1.0", "string"),
        ("an empty string", "", "string"),
        ("bytes", b"1.0", ""),
        ("True", True, "flag"),
        ("False", False, "flag"),
        ("a boolean of NumPy", np.True_, "mask"),
        ("a complex number", 1 + 1j, ""),
        ("a complex number without imaginary part", 1 + 0j, ""),
        ("a date", np.datetime64("2026-01-01"), ""),
        ("a duration", np.timedelta64(1, "s"), ""),
        ("an object", object(), ""),
        ("a class", float, "function"),
        ("a function", lambda *_: None, "function"),
        ("a dictionary", {1: 1.0}, "tree"),
        ("a set", {1.0}, ""),
        ("an ellipsis", ..., ""),
        ("a ragged list", [[1.0], [1.0, 2.0]], "tree"),
        ("a list of strings", ["a", "b", "c"], "strings"),
        ("a key of random numbers", jax.random.key(0), "key"),
        ("an integer beyond every dtype", 10**400, ""),
    ]
]

COUNTS = {
    "half": 1.5,
    "a float": 2.0,
    "NaN": float("nan"),
    "an array": np.array([1, 2]),
    "an integer beyond 64 bits": 2**70,
    "minus five": -5,
}


def _wrong_numbers(takes: Takes) -> Iterator[tuple[str, Any]]:
    """Yields numbers of the wrong kind, shape or range, with their names."""
    good = np.asarray(takes.good, float)
    first = np.zeros(good.shape)
    first[(0,) * good.ndim] = 1

    def put(x: float) -> np.ndarray:
        return np.where(first > 0, x, good)

    yield "booleans", np.ones(good.shape, bool)
    yield "booleans of JAX", jnp.ones(good.shape, bool)
    yield "complex numbers", good + 0j
    yield "complex numbers of JAX", jnp.asarray(good + 1j)
    yield "dates", np.full(good.shape, np.datetime64("2026-01-01"))
    yield "strings of numbers", np.full(good.shape, "1.0")
    yield "objects", np.full(good.shape, None, object)
    if "NaN" not in takes.allows:
        yield "NaN", put(np.nan)
        if not takes.unread:
            yield "NaN of JAX", jnp.asarray(put(np.nan))
        if good.ndim:
            yield "a list with NaN", [float("nan"), *good.tolist()[1:]]
    if good.ndim:
        yield "a list with True", [True, *good.tolist()[1:]]
        yield "a list with None", [None, *good.tolist()[1:]]
    if "infinity" not in takes.allows:
        yield "infinity", put(np.inf)
        yield "minus infinity", put(-np.inf)
    if takes.dtype is not None:
        yield "another dtype", jnp.asarray(good, jnp.float16)
        yield "beyond the range", put(1e300)
    if takes.shaped:
        yield "a leading axis", good[None]
        yield "a leading axis, of JAX", jnp.asarray(good[None], takes.dtype)
        if "batch" not in takes.allows:
            yield "a trailing axis", good[..., None]
        yield "no components", np.zeros((*good.shape[:-1], 0))
        yield "one component too many" if good.ndim else "two numbers", np.append(good, 1.0)
    if takes.sign != "any":
        yield "a negative number", put(-1.0)
        if not takes.unread:
            yield "a negative number of JAX", jnp.asarray(put(-1.0), takes.dtype)
    if takes.sign == "positive":
        yield "zero", put(0.0)
    if takes.most is not None:
        yield "beyond the largest", put(takes.most * 1.5 + 0.5)


def run(chosen: list[Call], limit: float = LIMIT, show: bool = True) -> Counter[str]:
    """Makes the calls, prints unexpected outcomes and returns the number of calls by outcome."""
    counts: Counter[str] = Counter()
    for call in chosen:
        kind, message = call.outcome(limit)
        counts[kind] += 1
        if show and kind != "refused":
            print(f"{kind:9} {call}: {message}", flush=True)
    return counts


def sample(number: int | None, seed: int) -> list[Call]:
    """Returns a random sample of the generated calls, and all hand-written calls."""
    everything = list(calls())
    if number is None:
        return everything
    special = [call for call in everything if call.label == "as it says"]
    generated = [call for call in everything if call.label != "as it says"]
    return [*random.Random(seed).sample(generated, min(number, len(generated))), *special]


def main() -> int:
    """Makes the calls and prints how many had each outcome.

    The exit status is 1 if a wrong call was not refused.
    """
    parser = argparse.ArgumentParser(description="Makes wrong calls of the public interface.")
    parser.add_argument("--sample", type=int, default=None, help="number of calls (default: all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=LIMIT)
    parser.add_argument("--only", default="", help="text that the name of a door must contain")
    options = parser.parse_args()
    chosen = [c for c in sample(options.sample, options.seed) if options.only in c.door.name]
    counts = run(chosen, options.limit)
    print(f"tried {sum(counts.values())}, " + ", ".join(f"{k} {counts[k]}" for k in OUTCOMES))
    return int(counts["refused"] != sum(counts.values()))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main())
