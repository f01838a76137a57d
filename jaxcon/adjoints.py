"""Memory and truncation of the reverse pass of a rollout.

Exact gradients: EveryStep, Checkpoints, Reversible.
Truncated or discounted gradients: Truncated, Discounted.
"""

from jaxcon.execution.adjoints import Checkpoints, Discounted, EveryStep, Truncated
from jaxcon.execution.reversible import Reversible


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "EveryStep",
    "Checkpoints",
    "Reversible",
    "Truncated",
    "Discounted",
]
