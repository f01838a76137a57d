"""Batches over several devices.

Cores of a CPU: use_all_cores, compiler_options.
Placement of a batch: shard.
Functions over devices: over_devices.
"""

from jaxcon.core.cores import compiler_options, use_all_cores
from jaxcon.core.devices import over_devices, shard


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "use_all_cores",
    "compiler_options",
    "shard",
    "over_devices",
]
