"""Rates with their spread, compile times, and the machine on which they were measured."""

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

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Rate:
    """Work per second: the median of several repeats and their extremes."""

    median: float
    least: float
    most: float

    def __str__(self) -> str:
        """As a table shows it, in millions."""
        spread = f"{self.least / 1e6:.3g} to {self.most / 1e6:.3g}"
        return f"{self.median / 1e6:.3g} M ({spread})"


SECONDS = 0.2
"""How long a repeat lasts at least, so that neither the clock nor the scheduler decides."""


def rate(run: Callable[[], Any], work: float, repeats: int = 5, seconds: float = SECONDS) -> Rate:
    """How much work a second a function does that returns arrays or None; it has run before.

    Args:
        run: the function.
        work: of one call.
        repeats: how many.
        seconds: for which a repeat calls it again and again, once at least.
    """
    rates = []
    for _ in range(repeats):
        calls, spent, start = 0, 0.0, time.perf_counter()
        while not calls or spent < seconds:
            jax.block_until_ready(run())
            calls, spent = calls + 1, time.perf_counter() - start
        rates.append(work * calls / spent)
    return Rate(float(np.median(rates)), min(rates), max(rates))


def in_turn(runs: Sequence[Callable[[], Any]], work: float, repeats: int = 5) -> np.ndarray:
    """Rates of functions that have run before, (repeats, functions).

    One after the other in each repeat, so that a machine that becomes slower slows them all.
    """
    return np.array([[rate(run, work, 1).median for run in runs] for _ in range(repeats)])


def compile_seconds(function: Callable[..., Any], *args: Any) -> tuple[Any, float]:
    """The compiled function, and how long tracing and compiling it took [s].

    JAX's cache on the disk, where it is turned on, makes this the time of reading it.
    """
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*args).compile()
    return compiled, time.perf_counter() - start


def yardstick(repeats: int = 3) -> float:
    """How long a fixed program of plain JAX takes to compile here, the median of several [s]."""

    def program(x: jax.Array) -> jax.Array:
        for i in range(50):
            x = jax.numpy.tanh(x @ x) * (1.0 + 0.01 * i)
        return x

    start = jax.numpy.eye(8)
    spent = [compile_seconds(lambda x: program(x), start)[1] for _ in range(repeats)]
    return float(np.median(spent))


def in_process(
    arguments: list[str], environment: dict[str, str], limit: float, late: str
) -> dict[str, Any] | str:
    """What a module prints as JSON when run in a process of its own, or why there is nothing.

    Args:
        arguments: of `python -m`.
        environment: of the process.
        limit: on its time [s].
        late: what to say where it takes longer.
    """
    try:
        done = subprocess.run(
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
    return json.loads(done.stdout.splitlines()[-1])


def with_flags(flags: str) -> dict[str, str]:
    """The environment of this process with more flags for XLA."""
    return os.environ | {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()}


def cores() -> int:
    """How many this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def use_all_cores() -> None:
    """Makes JAX see one device a core; to be called before JAX is used."""
    jax.config.update("jax_num_cpu_devices", cores())


def over_devices(worlds: Any, batch: int) -> Any:
    """A batch spread over all devices, where it can be divided among them."""
    return worlds if batch % jax.device_count() else jc.shard(worlds)


def machine() -> dict[str, Any]:
    """What a file of results says about where they were measured."""
    return {
        "cores": cores(),
        "processor": platform.processor() or platform.machine(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "peers": versions(),
    }


def versions() -> dict[str, str]:
    """Of the peers that are installed."""
    from importlib import metadata

    found = {}
    for package in ("mujoco", "mujoco-mjx"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def plain(value: Any) -> Any:
    """A result as JSON can hold it; numbers that are not finite are null."""
    if hasattr(value, "__dataclass_fields__"):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {str(key): plain(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [plain(x) for x in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
