"""The program of a thread as text in PTX, the language of NVIDIA's GPUs.

The text has no limit on registers: the driver of the GPU assigns them when it loads the program.

Reference: NVIDIA, Parallel Thread Execution ISA, version 7.0.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Sequence

import numpy as np

from jaxcon.staging.thread import (
    Address,
    Branch,
    Counter,
    Instruction,
    Layout,
    Loop,
    Register,
    Repeat,
    Scalar,
    Statement,
    is_float,
    pointers_of,
)

HEADER = ".version 7.0\n.target sm_70\n.address_size 64\n"
"""The version of the language and the oldest GPUs that run it: Volta, of 2017."""

BLOCK = 32
"""Threads in a block. A block is one warp, so that small batches spread over the whole GPU."""

MAX_OFFSET = 2**31
"""The bytes that an address within an instruction may add."""

KINDS = {"float32": "f32", "float64": "f64", "int32": "s32", "int64": "s64", "uint32": "u32"}
KINDS |= {"uint64": "u64", "bool": "pred"}
TYPES = {np.dtype(name): kind for name, kind in KINDS.items()}
"""The type of a register for each dtype."""

BITS = {"f32": "b32", "s32": "b32", "u32": "b32", "f64": "b64", "s64": "b64", "u64": "b64"}
"""The type of the bits of a register."""

ROUNDED = {"floor": "rmi", "ceil": "rpi", "round": "rni", "truncate": "rzi"}
"""How each operation converts a number to an integer, kept as a float."""

SHIFTS = {"shift_left": "shl.b", "shift_right_arithmetic": "shr.s"}


def text(program: Sequence[Statement], name: str, threads: int, arrays: Sequence[Layout]) -> str:
    """Returns the text of a kernel.

    Args:
        program: the program of a thread.
        name: the name of the kernel.
        threads: the number of threads that have a world.
        arrays: the layouts of all arrays.
    """
    writer = _Writer(arrays)
    writer.start(threads)
    writer.block(program)
    params = ",\n".join(f".param .u64 p{k}" for k in range(len(arrays)))
    declared = [
        f".reg .{kind} {', '.join(registers)};" for kind, registers in writer.registers.items()
    ]
    body = "\n".join([*declared, *writer.lines, "ret;"])
    # each thread may use all the registers that the GPU has for one
    limits = f".maxntid {BLOCK}, 1, 1\n.minnctapersm 1"
    return f"{HEADER}\n.visible .entry {name}(\n{params})\n{limits}\n{{\n{body}\n}}\n"


class _Writer:
    """Writes the lines of a kernel.

    Attributes:
        arrays: the layouts of all arrays.
        lines: the lines written so far.
        registers: the names of the registers of each type; a mapping keeps them in order, once.
    """

    def __init__(self, arrays: Sequence[Layout]) -> None:
        self.arrays = arrays
        self.lines: list[str] = []
        self.registers: dict[str, dict[str, None]] = {}
        self._count = itertools.count()
        self._pointers: dict[tuple[int, tuple[tuple[Counter, int], ...]], str] = {}

    def _named(self, name: str, kind: str) -> str:
        """Declares a register, and returns its name."""
        self.registers.setdefault(kind, {})[name] = None
        return name

    def _new(self, kind: str) -> str:
        """Returns a new register of the writer's own."""
        return self._named(f"%w{next(self._count)}", kind)

    def _register(self, x: Register) -> str:
        return self._named(f"%v{x.number}", _type(x))

    def _value(self, x: Scalar) -> str:
        """Returns an operand; a float by its bits."""
        if isinstance(x, Register):
            return self._register(x)
        if x.dtype == np.float32:
            return "0f" + struct.pack(">f", float(x)).hex().upper()
        if x.dtype == np.float64:
            return "0d" + struct.pack(">d", float(x)).hex().upper()
        return str(int(x))

    def _line(self, instruction: str, *operands: str) -> None:
        self.lines.append(f"{instruction} {', '.join(operands)};")

    def start(self, threads: int) -> None:
        """Writes the start, which ends surplus threads and finds the addresses of arrays."""
        block, size, place = (self._new("u32") for _ in range(3))
        outside = self._new("pred")
        self._line("mov.u32", block, "%ctaid.x")
        self._line("mov.u32", size, "%tid.x")
        self._line("mad.lo.u32", place, block, str(BLOCK), size)
        self._line("setp.ge.u32", outside, place, str(threads))
        self.lines.append(f"@{outside} ret;")
        for k, array in enumerate(self.arrays):
            first = self._pointers[k, ()] = self._new("u64")
            self._line("ld.param.u64", first, f"[p{k}]")
            self._line("cvta.to.global.u64", first, first)
            if array.world:
                self._line("mad.wide.u32", first, place, str(array.world), first)

    def block(self, statements: Sequence[Statement]) -> None:
        """Writes the statements of a block."""
        for statement in statements:
            match statement:
                case Instruction("load", Register() as result, address=Address() as address):
                    self._load(result, address)
                case Instruction("store", _, (x,), address=Address() as address):
                    self._store(x, address)
                case Instruction("set" | "assign", _, (Register() as register, x)):
                    self._assign(register, x)
                case Instruction(name, Register() as result, operands):
                    self._operation(name, result, operands)
                case Branch():
                    self._branch(statement)
                case Loop():
                    self._loop(statement)
                case Repeat():
                    self._repeat(statement)

    def _branch(self, branch: Branch) -> None:
        label = f"B{next(self._count)}"
        self.lines.append(f"@!{self._value(branch.which)} bra {label}_else;")
        self.block(branch.taken)
        self.lines += [f"bra {label}_end;", f"{label}_else:"]
        self.block(branch.others)
        self.lines.append(f"{label}_end:")

    def _loop(self, loop: Loop) -> None:
        label = f"L{next(self._count)}"
        self.lines.append(f"{label}:")
        self.block(loop.condition)
        if isinstance(loop.goes_on, Register):
            self.lines.append(f"@!{self._value(loop.goes_on)} bra {label}_end;")
        elif not loop.goes_on:
            self.lines.append(f"bra {label}_end;")
        self.block(loop.body)
        self.lines += [f"bra {label};", f"{label}_end:"]

    def _repeat(self, repeat: Repeat) -> None:
        label, counter = f"L{next(self._count)}", self._new("u32")
        ends = self._new("pred")
        self._line("mov.u32", counter, "0")
        self.lines.append(f"{label}:")
        for array, _, moves in pointers_of(repeat.counter, repeat.body):
            *before, (_, entries) = moves
            stride = entries * self.arrays[array].entry
            pointer = self._pointers[array, moves] = self._new("u64")
            start = self._pointers[array, tuple(before)]
            if stride < MAX_OFFSET:
                self._line("mad.wide.u32", pointer, counter, str(stride), start)
            else:
                self._line("cvt.u64.u32", pointer, counter)
                self._line("mad.lo.u64", pointer, pointer, str(stride), start)
        self.block(repeat.body)
        self._line("add.u32", counter, counter, "1")
        self._line("setp.lt.u32", ends, counter, str(repeat.length))
        self.lines.append(f"@{ends} bra {label};")

    def _address(self, address: Address) -> str:
        pointer = self._pointers[address.array, address.moves]
        offset = address.entry * self.arrays[address.array].entry
        if offset >= MAX_OFFSET:
            far = self._new("u64")
            self._line("add.u64", far, pointer, str(offset))
            pointer, offset = far, 0
        return f"[{pointer}+{offset}]"

    def _load(self, result: Register, address: Address) -> None:
        if result.dtype != bool:
            self._line(f"ld.global.{_type(result)}", self._register(result), self._address(address))
            return
        byte = self._new("u32")
        self._line("ld.global.u8", byte, self._address(address))
        self._line("setp.ne.u32", self._register(result), byte, "0")

    def _store(self, x: Scalar, address: Address) -> None:
        value, kind = self._value(x), "u32" if x.dtype == bool else _type(x)
        if x.dtype == bool or not isinstance(x, Register):  # stores take no predicates or numbers
            stored = self._new(kind)
            if isinstance(x, Register):
                self._line("selp.u32", stored, "1", "0", value)
            else:
                self._line(f"mov.{kind}", stored, value)
            value = stored
        kind = "u8" if x.dtype == bool else kind
        self._line(f"st.global.{kind}", self._address(address), value)

    def _assign(self, register: Register, x: Scalar) -> None:
        name, value = self._register(register), self._value(x)
        if x.dtype == bool and not isinstance(x, Register):
            self._line("setp.ne.u32", name, value, "0")
        else:
            self._line(f"mov.{_type(register)}", name, value)

    def _operation(self, name: str, result: Register, operands: Sequence[Scalar]) -> None:
        """Writes an operation on numbers."""
        x, kind = operands[0], _type(operands[0])
        bits = BITS.get(kind, kind)
        values = [self._register(result), *map(self._value, operands)]
        match name:
            case "select":
                which, *cases = values[1:]
                self._line(f"selp.{_type(result)}", values[0], *cases, which)
            case "convert":
                self._convert(result, x)
            case "bits":
                self._line(f"mov.{BITS[_type(result)]}", *values)
            case "eq" | "ne" | "lt" | "le" | "gt" | "ge":
                how = "neu" if name == "ne" and is_float(x) else name
                self._line(f"setp.{how}.{kind}", *values)
            case "unordered":
                self._line(f"setp.nan.{kind}", *values)
            case "finite":
                self._line(f"testp.finite.{kind}", *values)
            case "and" | "or" | "xor" | "not":
                self._line(f"{name}.{bits}", *values)
            case "shift_left" | "shift_right_arithmetic":
                self._line(f"{SHIFTS[name]}{bits[1:]}", *values)
            case "floor" | "ceil" | "round" | "truncate":
                self._line(f"cvt.{ROUNDED[name]}.{kind}.{kind}", *values)
            case "max" | "min":
                self._line(f"{name}.{kind}", *values)
                if is_float(x):
                    self._propagate_nan(result, operands)
            case "mul" if not is_float(x):
                self._line(f"mul.lo.{kind}", *values)
            case "div" | "sqrt" | "fma" if is_float(x):
                self._line(f"{name}.rn.{kind}", *values)
            case "copysign":  # PTX takes the sign from the first operand
                size, sign = values[1:]
                self._line(f"copysign.{kind}", values[0], sign, size)
            case _:
                self._line(f"{name}.{kind}", *values)

    def _propagate_nan(self, result: Register, operands: Sequence[Scalar]) -> None:
        """Makes the result NaN if an operand is."""
        either = [self._value(x) for x in operands if isinstance(x, Register) or np.isnan(x)]
        bad, name, kind = self._new("pred"), self._register(result), _type(result)
        self._line(f"setp.nan.{kind}", bad, either[0], either[-1])
        self._line(f"selp.{kind}", name, self._value(result.dtype.type(np.nan)), name, bad)

    def _convert(self, result: Register, x: Scalar) -> None:
        """Writes the conversion of a number to another dtype."""
        new, old = _type(result), _type(x)
        name, value = self._register(result), self._value(x)
        if is_float(x) and not is_float(result):
            self._line(f"cvt.rzi.{new}.{old}", name, value)
            if "64" in old + new:  # NaN becomes 0 in 32 bits only
                bad = self._new("pred")
                self._line(f"setp.nan.{old}", bad, value, value)
                self._line(f"selp.{new}", name, "0", name, bad)
            return
        rounding = ".rn" if is_float(result) and (new, old) != ("f64", "f32") else ""
        self._line(f"cvt{rounding}.{new}.{old}", name, value)


def _type(x: Scalar) -> str:
    """Returns the type of a register for a scalar."""
    return TYPES[x.dtype]
