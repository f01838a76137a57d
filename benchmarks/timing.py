"""Measures rates and compile times, and describes the machine."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxcon as jc
from jaxcon.core.cores import cores

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Rate:
    """Work per second: median, minimum and maximum over several repeats."""

    median: float
    least: float
    most: float

    def __str__(self) -> str:
        """Formats the rate in millions, with its range."""
        spread = f"{self.least / 1e6:.3g} to {self.most / 1e6:.3g}"
        return f"{self.median / 1e6:.3g} M ({spread})"


SECONDS = 0.2
"""Minimum duration of a repeat, so that clock and scheduler have little influence [s]."""


def rate(run: Callable[[], Any], work: float, repeats: int = 5, seconds: float = SECONDS) -> Rate:
    """Measures the rate of a function that returns arrays or None and has run before.

    Args:
        run: the function.
        work: amount of work in one call.
        repeats: number of repeats.
        seconds: minimum duration of a repeat, which calls the function at least once [s].
    """
    rates = []
    for _ in range(repeats):
        calls, elapsed, start = 0, 0.0, time.perf_counter()
        while not calls or elapsed < seconds:
            jax.block_until_ready(run())
            calls, elapsed = calls + 1, time.perf_counter() - start
        rates.append(work * calls / elapsed)
    return Rate(float(np.median(rates)), min(rates), max(rates))


def in_turn(runs: Sequence[Callable[[], Any]], work: float, repeats: int = 5) -> np.ndarray:
    """Measures the rates of functions that have run before, (repeats, functions).

    Functions alternate in each repeat, so that a change in the machine's speed affects all.
    """
    return np.array([[rate(run, work, 1).median for run in runs] for _ in range(repeats)])


def compile_seconds(function: Callable[..., Any], *args: Any) -> tuple[Any, float]:
    """Compiles a function.

    If JAX's disk cache is on, the time is that of reading the cache.

    Returns:
        The compiled function, and the time of tracing and compiling [s].
    """
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*args).compile()
    return compiled, time.perf_counter() - start


def yardstick(repeats: int = 3) -> float:
    """Returns the compile time of a fixed program in plain JAX, the median of several [s]."""

    def program(x: jax.Array) -> jax.Array:
        for i in range(50):
            x = jax.numpy.tanh(x @ x) * (1.0 + 0.01 * i)
        return x

    start = jax.numpy.eye(8)
    times = [compile_seconds(lambda x: program(x), start)[1] for _ in range(repeats)]
    return float(np.median(times))


def in_process(
    arguments: list[str], environment: dict[str, str], limit: float, late: str
) -> dict[str, Any] | str:
    """Runs a module in its own process.

    Args:
        arguments: arguments of `python -m`.
        environment: environment of the process.
        limit: time limit [s].
        late: beginning of the message for a timeout; the limit follows.

    Returns:
        The JSON output of the process, or the reason of a failure.
    """
    try:
        process = subprocess.run(
            [sys.executable, "-m", *arguments],
            capture_output=True,
            text=True,
            timeout=limit,
            cwd=ROOT,
            check=True,
            env=environment,
        )
    except subprocess.TimeoutExpired:
        return f"{late} {limit:g} s"
    except subprocess.CalledProcessError as error:
        return f"fails: {(error.stderr.strip().splitlines() or ['?'])[-1]}"
    return json.loads(process.stdout.splitlines()[-1])


def with_flags(flags: str) -> dict[str, str]:
    """Returns the environment of this process with additional XLA flags."""
    return os.environ | {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()}


def use_all_cores() -> None:
    """Gives JAX one device per core, with XLA's own options. Must be called before JAX is used."""
    jax.config.update("jax_num_cpu_devices", cores())


def over_devices(worlds: Any, batch: int) -> Any:
    """Shards a batch over all devices if its size is divisible by their number."""
    return worlds if batch % jax.device_count() else jc.shard(worlds)


def machine() -> dict[str, Any]:
    """Describes the machine and package versions, for files of results."""
    return {
        "cores": cores(),
        "processor": platform.processor() or platform.machine(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "peers": versions(),
    }


def versions() -> dict[str, str]:
    """Returns the versions of the installed packages MuJoCo and MJX."""
    from importlib import metadata

    installed = {}
    for package in ("mujoco", "mujoco-mjx"):
        try:
            installed[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return installed


def plain(value: Any) -> Any:
    """Converts a result to JSON data. Non-finite numbers become None."""
    if hasattr(value, "__dataclass_fields__"):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {str(key): plain(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [plain(x) for x in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
