"""Kernels for NVIDIA's GPUs, by XLA's call of a kernel that is given as text.

XLA computes a step by many kernels: a chain of 5 links takes 70 and passes 42 KB a world between
them. Here a step is one kernel that reads the state and writes the next one, and the host waits for
no branch and no loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jax.interpreters import mlir

from jaxcon.staging import ptx
from jaxcon.staging.kernels import NAME, called, kernel_p
from jaxcon.staging.ptx import BLOCK
from jaxcon.staging.thread import Layout, Local, Statement

TARGET = "__gpu$xla.gpu.ptx"
"""XLA's name of a call of a kernel that is given as text."""


class Cuda:
    """NVIDIA's GPUs; see `Platform`.

    The driver assigns registers for longer than a minute, and in tens of gigabytes, for twice as
    many instructions. NVIDIA's limit is 4 KB of addresses of arrays.
    """

    max_length = 75_000
    max_arrays = 500
    max_places = 64
    max_local = 0

    def text(
        self,
        program: Sequence[Statement],
        worlds: int,
        arrays: Sequence[Layout],
        results: int,
        local: Sequence[Local],
    ) -> str:
        """Returns the text of a kernel."""
        return ptx.text(program, NAME, worlds, arrays)


def _lowered(
    ctx: mlir.LoweringRuleContext,
    *args: Any,
    text: str,
    shapes: Any,
    worlds: int,
    in_place: bool,
) -> Sequence[Any]:
    """The lowering rule: a call of the kernel, whose arrays lie in memory with the batch last."""
    number = mlir.ir.IntegerType.get_signless(32)

    def integer(x: int) -> Any:
        return mlir.ir.IntegerAttr.get(number, x)

    blocks = -(-worlds // BLOCK)
    config = {"name": mlir.ir.StringAttr.get(NAME)}
    config |= {"kernel_type": mlir.ir.StringAttr.get("ptx")}
    config |= {"kernel_data": mlir.ir.StringAttr.get(text)}
    config |= {f"grid_{axis}": integer(n) for axis, n in zip("xyz", (blocks, 1, 1), strict=True)}
    config |= {f"block_{axis}": integer(n) for axis, n in zip("xyz", (BLOCK, 1, 1), strict=True)}
    config |= {"shared_mem_bytes": integer(0)}
    last = range(len(args), len(args) + len(shapes))
    config |= {"output_indices": mlir.ir.ArrayAttr.get(list(map(integer, last)))}
    return called(ctx, args, TARGET, ctx.avals_out, in_place, backend_config=config)


mlir.register_lowering(kernel_p, _lowered, platform="cuda")
