"""Finds the impacts that make derivatives of a function wrong. Host code."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import numpy as np

from jaxcon.contact.impacts import Seen
from jaxcon.core import notices
from jaxcon.core.typing import Array, PyTree

MANY = 3
"""The number of impacts of a row within `FEW` steps at which they count as accumulating."""
FEW = 20
"""The number of steps within which `MANY` impacts of a row count as accumulating."""


class Hit(NamedTuple):
    """An impact of one contact or limit row in one world.

    Attributes:
        name: name of the element.
        row: (row index, world index).
        bounces: True if the impact is fast enough to bounce.
        time: time at the start of the step [s].
        dt: step size h [s].
    """

    name: str
    row: tuple[int, int]
    bounces: bool
    time: float
    dt: float


def cases(
    f: Callable[[list[Array]], PyTree], at: list[Array], moves: Iterable[list[Array]]
) -> list[str]:
    """Describes the impacts during an evaluation of f at which f has no derivative.

    Such impacts are simultaneous, grazing or accumulating.

    Args:
        f: function from a list of arrays to a pytree of arrays.
        at: the arrays at which f is differentiated.
        moves: changes of `at`. Impacts are also counted at `at` plus and minus each change.

    Returns:
        One text for each of the three kinds of impacts that occurs.
    """
    with notices.observed() as seen:
        program = jax.jit(f)

        def met(x: list[Array]) -> list[Hit]:
            seen.clear()  # observations of the previous point
            jax.block_until_ready(program(x))
            impacts = [observation for observation in seen if isinstance(observation[0], Seen)]
            return [hit for observation in impacts for hit in _hits(*observation)]

        here = met(at)
        beside = [
            met([x + sign * dx for x, dx in zip(at, move, strict=True)])
            for move in moves
            for sign in (1, -1)
        ]
    notes = (_simultaneous(here), _grazing(here, beside), _accumulating(here))
    return [note for note in notes if note]


def _hits(kind: Seen, *values: np.ndarray) -> list[Hit]:
    """Converts an observation of one step to a list of its impacts, over all rows and worlds.

    Args:
        kind: the label of the observation, with the layout of the inequality rows.
        values: four arrays. The first two are the masks of impacts and of bounces, (rows, worlds).
            The last two are the time and the step size of each world, (worlds,).
    """
    hits, bounces = (x.reshape(len(x), -1) for x in values[:2])
    time, dt = (x.ravel() for x in values[2:])
    names, owners = kind.layout.names, kind.layout.owners
    return [
        Hit(names[owners[i]], (int(i), int(w)), bool(bounces[i, w]), float(time[w]), float(dt[w]))
        for i, w in np.argwhere(hits)
    ]


def _simultaneous(hits: list[Hit]) -> str | None:
    """Describes the first simultaneous impacts; None if there are none.

    Impacts are simultaneous if several rows of one world have them in the same step.
    """
    steps: dict[tuple[int, float], list[Hit]] = defaultdict(list)
    for hit in hits:
        steps[hit.row[1], hit.time].append(hit)
    for (_, time), together in steps.items():
        if len(together) > 1:
            names = ", ".join(dict.fromkeys(hit.name for hit in together))
            return f"simultaneous impacts: {len(together)} of {names} in the step at {time:.6g} s"
    return None


def _grazing(here: list[Hit], beside: list[list[Hit]]) -> str | None:
    """Describes a grazing impact; None if there is none.

    Such an impact is too slow to bounce, or a small change of the arguments adds or removes it.

    Args:
        here: impacts at the arguments.
        beside: impacts at each changed value of the arguments.
    """
    slow = next((hit for hit in here if not hit.bounces), None)
    if slow is not None:
        return f"a grazing impact: {slow.name} hits at {slow.time:.6g} s too slowly to bounce"
    counts = [_by_name(hits) for hits in (here, *beside)]
    for name in dict.fromkeys(name for count in counts for name in count):
        numbers = sorted({count.get(name, 0) for count in counts})
        if len(numbers) > 1:
            several = " or ".join(map(str, numbers))
            return f"a grazing impact: {name} hits {several} times, depending on x"
    return None


def _accumulating(hits: list[Hit]) -> str | None:
    """Describes the first accumulating impacts; None if there are none.

    Impacts accumulate if one row has `MANY` of them within `FEW` steps.
    """
    rows: dict[tuple[str, tuple[int, int]], list[Hit]] = defaultdict(list)
    for hit in hits:
        rows[hit.name, hit.row].append(hit)
    for (name, _), impacts in rows.items():
        for first, last in zip(impacts, impacts[MANY - 1 :], strict=False):
            if last.time - first.time <= FEW * first.dt:
                return (
                    f"accumulating impacts: {name} hits {MANY} times within {FEW} steps from"
                    f" {first.time:.6g} s on"
                )
    return None


def _by_name(hits: list[Hit]) -> dict[str, int]:
    """Returns the number of impacts of each element, by name."""
    counts: dict[str, int] = defaultdict(int)
    for hit in hits:
        counts[hit.name] += 1
    return dict(counts)
