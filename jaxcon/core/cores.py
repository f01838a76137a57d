"""All cores of a CPU, and the compiler options that suit it."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax

from jaxcon.core import checks


def widest() -> int:
    """Returns the size of the vectors of this CPU [bit]: 512 with AVX-512, otherwise 256."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return 256
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="ignore")
    except OSError:
        return 256
    return 512 if "avx512f" in flags and "avx512vl" in flags else 256


# XLA's own default is 256
compiler_options: Mapping[str, Any] = MappingProxyType(
    {"xla_cpu_prefer_vector_width": 512} if widest() == 512 else {}
)
"""XLA's options with which steps run fastest: `jax.jit(f, compiler_options=jc.compiler_options)`.

On a CPU with AVX-512, loops over worlds then use vectors of 512 bit, which XLA does not by default.
Other machines need no options, and the mapping is empty.
"""


def cores() -> int:
    """Returns the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def use_all_cores(count: int | None = None) -> int:
    """Makes each core of the CPU a device of JAX; call it before anything else that uses JAX.

    One program runs on one core. `jc.shard(states)` then lays a batch over all cores, and
    `jax.jit(jax.vmap(run))` simulates a part of it on each, without communication. The environments
    take `devices=count`.

    All programs of the process are also compiled with `jc.compiler_options`, which are added to the
    environment variable XLA_FLAGS. `PJRT_NPROC` is set to twice the number of devices, unless it is
    set already: jaxlib factors dense matrices on the threads that run devices, and with fewer
    threads, all of them may wait for each other.

    Args:
        count: the number of devices; None for the number of cores that the process may use.

    Returns:
        The number of devices.

    Raises:
        RuntimeError: JAX has been used before, and cannot be changed any more.
        ValueError: `count` is not a positive integer.
    """
    if count is not None:
        checks.count("use_all_cores", "count", count)
    number = cores() if count is None else int(count)
    try:
        jax.config.update("jax_num_cpu_devices", number)
    except RuntimeError as error:
        if jax.default_backend() == "cpu" and jax.local_device_count() == number:
            return number
        raise RuntimeError(
            "use_all_cores: JAX has been used before, so that its devices are fixed; call"
            " jc.use_all_cores() first, before any array is made."
        ) from error
    flags = os.environ.get("XLA_FLAGS", "")
    chosen = [f"--{k}={v}" for k, v in compiler_options.items() if f"--{k}=" not in flags]
    os.environ["XLA_FLAGS"] = " ".join([*flags.split(), *chosen])
    os.environ.setdefault("PJRT_NPROC", str(2 * number))
    return number
