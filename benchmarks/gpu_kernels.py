"""Kernels and bytes of a program for a GPU, counted without a GPU.

XLA's compiler for CUDA needs a description of the device only, here that of an H100. It comes with
`pip install "jax[cuda12]"`. The optimized program then shows what would be launched: each fusion,
library call and copy is a kernel. What a kernel reads and writes is counted once; of an array that
it only slices, the slice.

The counts are those of one call. The kernels of a loop count as often as the loop runs, or once if
XLA does not know how often. Of a conditional, the branch with the most kernels counts.
"""

from __future__ import annotations

import importlib.util
import math
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple
from unittest import mock

import jax
import numpy as np
from jax.experimental import topologies

NEEDED = "jax_cuda12_plugin"
"""The package with XLA's compiler for CUDA."""

H100 = """
gpu_device_info {
  threads_per_block_limit: 1024
  threads_per_warp: 32
  shared_memory_per_block: 49152
  shared_memory_per_core: 233472
  threads_per_core_limit: 2048
  core_count: 132
  fpus_per_core: 128
  block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535
  block_dim_limit_z: 65535
  memory_bandwidth: 3352320000000
  l2_cache_size: 52428800
  clock_rate_ghz: 1.98
  device_memory_size: 84942979072
  shared_memory_per_block_optin: 232448
  cuda_compute_capability { major: 9 }
  registers_per_core_limit: 65536
  registers_per_block_limit: 65536
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 8 patch: 0 }
runtime_version { major: 12 minor: 8 patch: 0 }
device_description_str: "NVIDIA H100 80GB HBM3"
"""
"""The numbers of an H100 that XLA asks for, from NVIDIA's data sheet and XLA's own descriptions."""

NOTHING = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all"}
NOTHING |= {"opt-barrier", "partition-id", "replica-id"}
"""Instructions that launch no kernel."""

SIZES = {"pred": 1, "s8": 1, "u8": 1, "s16": 2, "u16": 2, "f16": 2, "bf16": 2, "s32": 4, "u32": 4}
SIZES |= {"f32": 4, "s64": 8, "u64": 8, "f64": 8, "c64": 8, "c128": 16}
"""Bytes of a number of each type."""


class Kernels(NamedTuple):
    """The kernels of a program.

    Attributes:
        launched: the number of kernels that one call launches.
        moved: what they read and write [B].
        waits: the number of conditions that the host reads back: branches, and iterations of loops
            whose number is not known.
    """

    launched: int = 0
    moved: int = 0
    waits: int = 0

    def plus(self, other: Kernels, times: int = 1) -> Kernels:
        """Returns the sum with another program that runs several times."""
        return Kernels(*(x + times * y for x, y in zip(self, other, strict=True)))


class Instruction(NamedTuple):
    """An instruction of an optimized program, as XLA prints it."""

    name: str
    shape: str
    opcode: str
    operands: tuple[str, ...]
    attributes: str

    def called(self, key: str) -> list[str]:
        """Returns the names of the computations in an attribute, such as "body"."""
        found = re.search(rf"{key}=(\{{[^}}]*\}}|%?[\w.\-]+)", self.attributes)
        return re.findall(r"[\w.\-]+", found[1]) if found else []


def is_available() -> bool:
    """Returns True if XLA's compiler for CUDA is installed."""
    return importlib.util.find_spec(NEEDED) is not None


def count(function: Callable[..., Any], *args: Any) -> Kernels:
    """Compiles a function for an H100 and counts its kernels.

    While it is traced, `jax.default_backend()` returns "gpu", as it would beside a GPU.

    Args:
        function: the function.
        args: its arguments, pytrees of arrays or of their shapes and dtypes.
    """
    target = {"platform": "cuda", "target_config": H100, "topology": "1x1x1"}
    topology: Any = topologies.get_topology_desc(**target)
    place = jax.sharding.SingleDeviceSharding(topology.devices[0])
    shapes = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(np.shape(x), x.dtype, sharding=place), args
    )
    with mock.patch.object(jax, "default_backend", return_value="gpu"):
        lowered = jax.jit(function).lower(*shapes)
    return Program(lowered.compile().as_text()).kernels()


class Program:
    """An optimized program, read from its text.

    Args:
        text: the text that XLA prints of a compiled program.
    """

    def __init__(self, text: str) -> None:
        self.computations: dict[str, list[Instruction]] = {}
        self.entry = ""
        inside: list[Instruction] = []
        head = re.compile(r"(ENTRY )?%?([\w.\-]+) \(.*\) -> .* \{$")
        row = re.compile(r"\s+(?:ROOT )?%?([\w.\-]+) = (\(.*?\)|\S+) ([\w\-]+)\((.*?)\)(.*)$")
        for line in text.splitlines():
            if found := head.match(line):
                inside = self.computations[found[2]] = []
                self.entry = found[2] if found[1] else self.entry
            elif found := row.match(line):
                operands = tuple(re.findall(r"%([\w.\-]+)", found[4]))
                inside.append(Instruction(found[1], found[2], found[3], operands, found[5]))

    def kernels(self, name: str = "") -> Kernels:
        """Counts the kernels of one call of a computation, by default of the whole program."""
        own = self.computations[name or self.entry]
        sizes = {x.name: bytes_of(x.shape) for x in own}
        total = Kernels()
        for x in own:
            if x.opcode == "while":
                known = re.search(r'known_trip_count":\{"n":"(\d+)"', x.attributes)
                total = total.plus(self.kernels(*x.called("body")), int(known[1]) if known else 1)
                if not known:
                    total = total.plus(self.kernels(*x.called("condition"))).plus(Kernels(waits=1))
            elif x.opcode == "conditional":
                names = x.called("branch_computations")
                names = names or [*x.called("true_computation"), *x.called("false_computation")]
                branches = [self.kernels(branch) for branch in names]
                total = total.plus(max(branches)).plus(Kernels(waits=1))
            elif x.opcode == "call":
                total = total.plus(self.kernels(*x.called("to_apply")))
            elif x.opcode not in NOTHING:
                total = total.plus(Kernels(1, self._moved(x, sizes)))
        return total

    def _moved(self, kernel: Instruction, sizes: Mapping[str, int]) -> int:
        """Returns what a kernel reads and writes [B].

        Args:
            kernel: the instruction that launches it.
            sizes: size of each value of its computation [B].
        """
        if kernel.opcode != "fusion":
            read = sum(sizes.get(x, 0) for x in set(kernel.operands))
            return read + bytes_of(kernel.shape)
        (name,) = kernel.called("calls")
        own = self.computations[name]
        inputs = [x for x in own if x.opcode == "parameter"]
        read = sum(_read(own, x, bytes_of(x.shape)) for x in inputs)
        return read + bytes_of(kernel.shape) + sum(_kept(own))


def _read(own: list[Instruction], value: Instruction, whole: int) -> int:
    """Returns how much of a value the instructions of a fusion read [B]; of slices, the slices."""
    read = 0
    for user in (x for x in own if value.name in x.operands):
        first = user.operands[0] == value.name
        if user.opcode in ("slice", "dynamic-slice") and first:
            read += bytes_of(user.shape)
        elif user.opcode == "bitcast":
            read += _read(own, user, whole)
        elif not (user.opcode == "dynamic-update-slice" and first):
            return whole
    return min(read, whole)


def _kept(own: list[Instruction]) -> Iterator[int]:
    """Yields, for each result that a fusion updates in place, minus what it leaves alone [B]."""
    sizes = {x.name: bytes_of(x.shape) for x in own}
    for x in own:
        users = [user.opcode for user in own if x.name in user.operands]
        if x.opcode == "dynamic-update-slice" and set(users) <= {"tuple", "bitcast"}:
            yield sizes[x.operands[1]] - sizes[x.name]


def bytes_of(shape: str) -> int:
    """Returns the size of a shape as XLA prints it, such as "(f32[3,8]{1,0}, s32[])" [B]."""
    arrays = re.findall(r"(\w+)\[([\d,]*)\]", shape)
    return sum(
        SIZES.get(kind, 4) * math.prod(int(n) for n in dims.split(",") if n)
        for kind, dims in arrays
        if kind in SIZES
    )
