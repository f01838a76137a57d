"""What the numbers of bounded elements may be, when they are built and when they are changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Lane
from jaxcon.model.elements import Elements

POSITIVE = ("stiffness", "recovery", "size")
NOT_NEGATIVE = (
    *("restitution", "damping", "friction", "rolling", "spinning"),
    *("most", "rate", "radius", "radius_a", "radius_b"),
)


@pytree
class Ranged(Elements):
    """Bounded elements of one class, `law`."""

    law: Any = static(default=None)

    def check_numbers(self, name: str, numbers: Mapping[str, Any]) -> None:
        """Checks the numbers of one element, by field."""
        check_ranges(name, numbers)


def check_ranges(owner: str, numbers: Mapping[str, Any]) -> None:
    """Checks the numbers of a bounded element by their fields, as far as they are known.

    Raises:
        ValueError: one is out of range, or a lower end is not below the upper one.
    """
    for field in numbers.keys() & {*POSITIVE, *NOT_NEGATIVE}:
        limit: Any = {"above": 0} if field in POSITIVE else {"least": 0}
        checks.check(owner, field, numbers[field], **limit)
    e = numbers.get("restitution", 0.0)
    if checks.is_concrete(e) and e > 1:
        raise ValueError(f"{owner}: restitution must lie in 0 to 1, got {float(e):g}.")
    if "lower" in numbers:
        check_ends(owner, numbers["lower"], numbers["upper"])


def check_ends(owner: str, lower: Any, upper: Any) -> None:
    """Checks that there is something between two stops.

    Raises:
        ValueError: there is nothing.
    """
    if checks.is_concrete((lower, upper)) and not lower < upper:
        raise ValueError(
            f"{owner}: lower must be below upper, got {checks.numerals(lower)} and"
            f" {checks.numerals(upper)}; what does not move at all is a Fixed joint or a Drive."
        )


def not_negative(x: Lane) -> Lane:
    """A coefficient that only takes energy out; a negative one, as a traced one can be, is none."""
    return jnp.where(x < 0, 0, x)
