"""Kernels for CPUs, compiled by LLVM and called by XLA as a function of another library.

XLA computes a step by hundreds of loops over the batch. Here a step is one function: its vector
registers hold a number of as many worlds as they have lanes, so that all values of a world stay in
the first cache.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import llvmlite.binding
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import mlir

from jaxcon.staging import llvm
from jaxcon.staging.kernels import NAME, called, kernel_p
from jaxcon.staging.thread import Instruction, Layout, Local, Statement, count_of

OPTIMIZATION = 1
"""LLVM's level of optimization. At level 2, code is no faster and takes longer to compile."""


LONG = range(150_000, 400_000)
"""The numbers of instructions of programs that groups of lanes evaluate together.

Such a program does not fit into the second cache, and the values of four groups fit into the third.
The half-cheetah's gradient of 121,000 instructions gains 16 % from groups of lanes, the walker's of
112,000 loses 13 %; the ant's of 165,000 gains 30 %, and the humanoid's step of 221,000 gains 20 %.
The humanoid's gradient of 562,000 gained 20 % in one run, and lost as much in another.
"""

GROUPS = 4
"""The number of groups of lanes that evaluate each piece of a long program in turn."""


class Cpu:
    """The CPU of this machine; see `Platform`."""

    max_length = 800_000
    max_arrays = 10_000
    max_places = 64
    max_local = 16_384

    def text(
        self,
        program: Sequence[Statement],
        worlds: int,
        arrays: Sequence[Layout],
        results: int,
        local: Sequence[Local],
    ) -> str:
        """Returns the text of a kernel."""
        lanes = min(_register_bytes() // _size(program), 1 << (worlds.bit_length() - 1))
        groups = min(GROUPS, worlds // lanes) if count_of(program) in LONG else 1
        return llvm.text(program, NAME, worlds, arrays, results, lanes, groups, local)


def _size(program: Sequence[Statement]) -> int:
    """Returns the median size of the floats that a program reads; 4 if it reads none."""
    loads = [x for x in program if isinstance(x, Instruction) and x.name == "load"]
    sizes = [x.result.dtype.itemsize for x in loads if x.result and x.result.dtype.kind == "f"]
    return int(np.median(sizes)) if sizes else 4


@functools.cache
def _features() -> Any:
    """Returns which instructions this machine has, by name; none if LLVM cannot tell."""
    try:
        return llvmlite.binding.get_host_cpu_features()
    except RuntimeError:
        return llvmlite.binding.FeatureMap()


@functools.cache
def _machine() -> Any:
    """Returns LLVM's compiler for the CPU of this machine."""
    llvmlite.binding.initialize_native_target()
    llvmlite.binding.initialize_native_asmprinter()
    return llvmlite.binding.Target.from_default_triple().create_target_machine(
        cpu=llvmlite.binding.get_host_cpu_name(),
        features=_features().flatten(),
        opt=OPTIMIZATION,
        jit=True,
        codemodel="jitdefault",
    )


@functools.cache
def _register_bytes() -> int:
    """Returns the size of a vector register."""
    for feature, size in (("avx512f", 64), ("avx2", 32)):
        if _features().get(feature):
            return size
    return 16


class _Compiler:
    """Compiles kernels, and keeps their machine code as long as the process lives.

    Where JAX keeps compiled programs on disk, the machine code of kernels is kept beside them.
    """

    def __init__(self) -> None:
        self._names: set[str] = set()
        self._lock = threading.Lock()

    @functools.cached_property
    def _engine(self) -> Any:
        """The memory of all machine code, from the first kernel on."""
        return llvmlite.binding.create_mcjit_compiler(
            llvmlite.binding.parse_assembly(""), _machine()
        )

    def target(self, text: str) -> str:
        """Returns the name by which XLA calls a kernel; compiles it if it is new."""
        name = f"jaxcon_{hashlib.sha256(text.encode()).hexdigest()[:40]}"
        with self._lock:
            if name not in self._names:
                self._register(name, text.replace(f"@{NAME}(", f"@{name}("))
                self._names.add(name)
        return name

    def _register(self, name: str, text: str) -> None:
        code = stored_code(
            name, lambda: _machine().emit_object(llvmlite.binding.parse_assembly(text))
        )
        self._engine.add_object_file(llvmlite.binding.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        address = self._engine.get_function_address(name)
        function = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(address)
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(function), platform="cpu")


COMPILER = _Compiler()


def stored_code(name: str, compiled: Callable[[], bytes]) -> bytes:
    """Returns machine code from JAX's folder of compiled programs; compiles and stores new code.

    As for programs, code that is compiled quickly is not stored.

    Args:
        name: the name of the kernel.
        compiled: returns the machine code.
    """
    settings = jax.config.values
    folder = settings["jax_compilation_cache_dir"]
    if not (folder and settings["jax_enable_compilation_cache"]) or "://" in folder:
        return compiled()
    path = Path(folder) / f"{name}-{_processor()}.o"
    size = hashlib.sha256().digest_size
    with contextlib.suppress(OSError):
        stored = path.read_bytes()
        if hashlib.sha256(stored[size:]).digest() == stored[:size]:
            return stored[size:]
    start = time.perf_counter()
    code = compiled()
    if time.perf_counter() - start < settings["jax_persistent_cache_min_compile_time_secs"]:
        return code
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}")
        part.write_bytes(hashlib.sha256(code).digest() + code)
        part.replace(path)  # at once, since other processes may read it
    return code


@functools.cache
def _processor() -> str:
    """Returns a name for all on which the machine code of a kernel depends besides its text."""
    machine = _machine()
    parts = machine.triple, llvmlite.binding.get_host_cpu_name(), str(OPTIMIZATION)
    parts += (
        _features().flatten(),
        str(llvmlite.binding.llvm_version_info),
    )
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:16]


def _lowered(
    ctx: mlir.LoweringRuleContext,
    *args: Any,
    text: str,
    shapes: Any,
    worlds: int,
    in_place: bool,
) -> Sequence[Any]:
    """The lowering rule: a call of the kernel, whose arrays lie in memory with the batch last."""
    results = list(ctx.avals_out)
    if size := llvm.scratch(text):
        results.append(ShapedArray((size,), np.dtype(np.uint8)))
    return list(called(ctx, args, COMPILER.target(text), results, in_place))[: len(shapes)]


mlir.register_lowering(kernel_p, _lowered, platform="cpu")
