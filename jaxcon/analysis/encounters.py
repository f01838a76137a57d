"""Which impacts a function meets where its derivatives are wrong. Host code."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxcon.core import notices
from jaxcon.core.typing import Array
from jaxcon.dynamics.impacts import Seen

MANY = 3
"""Impacts of a row within `FEW` steps that count as accumulating."""
FEW = 20
"""Steps within which they do."""


class Hit(NamedTuple):
    """An impact of one row of one world.

    Attributes:
        name: of the element.
        row: its number, and that of the world.
        bounces: whether it is fast enough to bounce.
        time: at the start of the step [s].
        dt: h [s].
    """

    name: str
    row: tuple[int, int]
    bounces: bool
    time: float
    dt: float


def cases(of: Callable[[Any], Any], at: list[Array], moves: Iterable[list[Array]]) -> list[str]:
    """Names the impacts on the way at which derivatives do not exist.

    Args:
        of: a list of arrays → a pytree of arrays.
        at: where.
        moves: of it, to both sides of each of which impacts are counted as well.
    """
    with notices.observed() as seen:
        program = jax.jit(of)

        def met(x: list[Array]) -> list[Hit]:
            seen.clear()
            jax.block_until_ready(program(x))
            return [hit for one in seen if isinstance(one[0], Seen) for hit in _hits(*one)]

        here = met(at)
        beside = [
            met([x + sign * dx for x, dx in zip(at, move, strict=True)])
            for move in moves
            for sign in (1, -1)
        ]
    told = (_simultaneous(here), _grazing(here, beside), _accumulating(here))
    return [words for words in told if words]


def _hits(kind: Seen, *values: np.ndarray) -> list[Hit]:
    """The impacts of one step of all worlds."""
    hits, bounces = (x.reshape(len(x), -1) for x in values[:2])
    time, dt = (x.ravel() for x in values[2:])
    names, owners = kind.layout.names, kind.layout.owners
    return [
        Hit(names[owners[i]], (int(i), int(w)), bool(bounces[i, w]), float(time[w]), float(dt[w]))
        for i, w in np.argwhere(hits)
    ]


def _simultaneous(hits: list[Hit]) -> str | None:
    """Several rows of a world that hit within one step."""
    steps: dict[Any, list[Hit]] = defaultdict(list)
    for hit in hits:
        steps[hit.row[1], hit.time].append(hit)
    for (_, time), together in steps.items():
        if len(together) > 1:
            names = ", ".join(dict.fromkeys(hit.name for hit in together))
            return f"simultaneous impacts: {len(together)} of {names} in the step at {time:.6g} s"
    return None


def _grazing(here: list[Hit], beside: list[list[Hit]]) -> str | None:
    """An impact too slow to bounce, or one that happens on one side of x only."""
    slow = next((hit for hit in here if not hit.bounces), None)
    if slow is not None:
        return f"a grazing impact: {slow.name} hits at {slow.time:.6g} s too slowly to bounce"
    counts = [_by_name(hits) for hits in (here, *beside)]
    for name in dict.fromkeys(name for known in counts for name in known):
        numbers = sorted({known.get(name, 0) for known in counts})
        if len(numbers) > 1:
            several = " or ".join(map(str, numbers))
            return f"a grazing impact: {name} hits {several} times, depending on x"
    return None


def _accumulating(hits: list[Hit]) -> str | None:
    """Many impacts of a row within few steps."""
    rows: dict[Any, list[Hit]] = defaultdict(list)
    for hit in hits:
        rows[hit.name, hit.row].append(hit)
    for (name, _), every in rows.items():
        for first, last in zip(every, every[MANY - 1 :], strict=False):
            if last.time - first.time <= FEW * first.dt:
                return (
                    f"accumulating impacts: {name} hits {MANY} times within {FEW} steps from"
                    f" {first.time:.6g} s on"
                )
    return None


def _by_name(hits: list[Hit]) -> dict[str, int]:
    """The number of impacts by element."""
    counts: dict[str, int] = defaultdict(int)
    for hit in hits:
        counts[hit.name] += 1
    return dict(counts)
