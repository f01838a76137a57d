"""Batches over several devices.

Placement of a batch: shard.
Functions over devices: over_devices.
"""

from jaxcon.core.devices import over_devices, shard


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "shard",
    "over_devices",
]
