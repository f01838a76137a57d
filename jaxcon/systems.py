"""Vakonomic systems, states for changed inertia, and types of results.

Vakonomic systems: Vakonomic, vakonomic.
States for changed inertia: restate.
Results: Assembly, Energy.
"""

from jaxcon.builders.assembly import Assembly
from jaxcon.builders.vakonomic import Vakonomic, vakonomic
from jaxcon.system.inertial import restate
from jaxcon.system.state import Energy


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "Vakonomic",
    "vakonomic",
    "restate",
    "Assembly",
    "Energy",
]
