"""Chains of bodies.

Builders: rope, rod, hanging.
Result: Chain.
"""

from jaxcon.builders.chains import Chain, hanging, rod, rope


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "rope",
    "rod",
    "hanging",
    "Chain",
]
