"""Wrong calls: every public door is given values that it must refuse, by an error that says why.

    python -m benchmarks.wrong_calls [--sample N] [--seed K] [--limit SECONDS] [--only TEXT]

A door is one argument of one call, with all others right. It says what it takes (`Takes`), from
which the wrong values follow: other types, shapes, dtypes, ranges. Of each call one of four is
counted. Refused: ValueError or TypeError whose message names the argument. Raw: another error, of
Python, NumPy or JAX, or one that does not say which argument is meant. Accepted: no error. Hung: no
answer within the limit. The last three must be zero; each of those calls is listed.
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
"""Errors that the documentation speaks of."""

OUTCOMES = ("refused", "accepted", "raw", "hung")
LIMIT = 20.0
"""Seconds after which a call has hung."""


class HungError(BaseException):
    """The limit has passed; no `except Exception` on the way holds it up."""


@dataclass(frozen=True)
class Call:
    """One door and one value that it must refuse."""

    door: Door
    label: str
    value: Any

    def __str__(self) -> str:
        return f"{self.door.name} = {self.label}"

    def outcome(self, limit: float = LIMIT) -> tuple[str, str]:
        """Returns the outcome, one of `OUTCOMES`, and the message or value."""

        def stop(*_: Any) -> None:
            raise HungError

        before = signal.signal(signal.SIGALRM, stop)
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
            signal.signal(signal.SIGALRM, before)
        return "accepted", ""

    def _named(self, error: Exception) -> bool:
        """Returns True where the error is the library's own and names the wrong argument."""
        if not isinstance(error, EXPECTED):
            return False
        return any(re.search(word, str(error)) for word in self.door.words)


def calls() -> Iterator[Call]:
    """Every door with every value that is wrong there."""
    for door in wrong_doors.doors():
        for label, value in wrong_values(door.takes):
            yield Call(door, label, value)
    for label, (call, words) in wrong_doors.SPECIAL.items():
        yield Call(Door(label, call, Takes(), words), "as it says", None)


def wrong_values(takes: Takes) -> Iterator[tuple[str, Any]]:
    """What an argument must not be, by what it takes."""
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
        yield "one below the least", takes.least - 1


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
        ("a boolean of NumPy", np.True_, ""),
        ("a complex number", 1 + 1j, ""),
        ("a complex number without imaginary part", 1 + 0j, ""),
        ("a date", np.datetime64("2026-01-01"), ""),
        ("a duration", np.timedelta64(1, "s"), ""),
        ("an object", object(), ""),
        ("a class", float, "function"),
        ("a function", lambda *_: None, "function"),
        ("a dictionary", {1: 1.0}, ""),
        ("a set", {1.0}, ""),
        ("an ellipsis", ..., ""),
        ("a ragged list", [[1.0], [1.0, 2.0]], ""),
        ("a list of strings", ["a", "b", "c"], "strings"),
        ("a key of random numbers", jax.random.key(0), "key"),
        ("an integer beyond all range", 10**400, ""),
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
    """Numbers of the wrong kind, shape or range."""
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
        yield "an axis before", good[None]
        yield "an axis before, of JAX", jnp.asarray(good[None], takes.dtype)
        if "batch" not in takes.allows:
            yield "an axis behind", good[..., None]
        yield "none of it", np.zeros((*good.shape[:-1], 0))
        yield "one more" if good.ndim else "two", np.append(good, 1.0)
    if takes.sign != "any":
        yield "a negative one", put(-1.0)
        if not takes.unread:
            yield "a negative one of JAX", jnp.asarray(put(-1.0), takes.dtype)
    if takes.sign == "positive":
        yield "zero", put(0.0)
    if takes.most is not None:
        yield "beyond the largest", put(takes.most * 1.5 + 0.5)


def run(chosen: list[Call], limit: float = LIMIT, show: bool = True) -> Counter[str]:
    """How many calls had which outcome; those that should not have are printed."""
    counts: Counter[str] = Counter()
    for call in chosen:
        kind, message = call.outcome(limit)
        counts[kind] += 1
        if show and kind != "refused":
            print(f"{kind:9} {call}: {message}", flush=True)
    return counts


def sample(number: int | None, seed: int) -> list[Call]:
    """Some of all calls; the hand-written ones always."""
    everything = list(calls())
    if number is None:
        return everything
    special = [call for call in everything if call.label == "as it says"]
    others = [call for call in everything if call.label != "as it says"]
    return [*random.Random(seed).sample(others, min(number, len(others))), *special]


def main() -> int:
    """Prints the counts; 1 where a wrong call was not refused."""
    parser = argparse.ArgumentParser(description="Wrong calls of every public door.")
    parser.add_argument("--sample", type=int, default=None, help="calls; all unless given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=LIMIT)
    parser.add_argument("--only", default="", help="doors with this in their name")
    given = parser.parse_args()
    chosen = [c for c in sample(given.sample, given.seed) if given.only in c.door.name]
    counts = run(chosen, given.limit)
    print(f"tried {sum(counts.values())}, " + ", ".join(f"{k} {counts[k]}" for k in OUTCOMES))
    return int(counts["refused"] != sum(counts.values()))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main())
