"""Instructions of one thread of an NVIDIA GPU, as text in the language PTX.

A `Thread` computes with scalars, which are registers or numbers known when the program is written.
Each method appends the instructions of one operation and returns the scalar that holds the result.
Operations on known numbers are evaluated at once, and an operation on the same scalars is written
only once. Products and sums may be contracted to one rounding, as XLA permits on GPUs.

The text has no limit on registers: the driver of the GPU assigns them when it loads the program.

Reference: NVIDIA, Parallel Thread Execution ISA, version 7.0.
"""

from __future__ import annotations

import itertools
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxcon.core.host import ELEMENTWISE
from jaxcon.staging.constants import NEUTRAL

HEADER = ".version 7.0\n.target sm_70\n.address_size 64\n"
"""The version of the language and the oldest GPUs that run it: Volta, of 2017."""

BLOCK = 32
"""Threads in a block. A block is one warp, so that small batches spread over the whole GPU."""

MAX_REGISTERS = 250_000
"""The largest number of registers that a thread may name, so that writing ends in seconds."""

MAX_OFFSET = 2**31
"""The bytes that an address within an instruction may add."""

TYPES = {"float32": "f32", "float64": "f64", "int32": "s32", "int64": "s64", "uint32": "u32"}
TYPES |= {"uint64": "u64", "bool": "pred"}
"""The type of a register for each dtype."""

BITS = {"f32": "b32", "s32": "b32", "u32": "b32", "f64": "b64", "s64": "b64", "u64": "b64"}
"""The type of the bits of a register."""

COMPARISONS = ("eq", "ne", "lt", "le", "gt", "ge")
LOGICAL = ("and", "or", "xor")


class UnsupportedError(Exception):
    """A program contains an operation that has no instructions here."""


@dataclass(frozen=True, slots=True)
class Register:
    """A register of a thread.

    Attributes:
        name: its name in the text.
        dtype: the NumPy dtype of its number; bool for a predicate.
    """

    name: str
    dtype: np.dtype


Scalar = Register | np.generic
"""A number in a register, or one that is known."""


class Line(NamedTuple):
    """A line of the text.

    Attributes:
        text: the line.
        result: the name of the register that it writes; None if it must be kept.
        read: the scalars that it reads.
    """

    text: str
    result: str | None
    read: tuple[Scalar, ...]


class Thread:
    """The text of one thread, written from top to bottom.

    Attributes:
        lines: the lines written so far.
    """

    def __init__(self) -> None:
        self.lines: list[Line] = []
        self._count = itertools.count()
        self._registers: dict[str, list[str]] = {}
        self._arrays: list[Register] = []
        # results of instructions, by instruction and operands; an inner table for each loop or
        # branch, since its results do not exist outside of it
        self._known: list[dict[Any, Register]] = [{}]

    def new(self, dtype: Any) -> Register:
        """Returns a new register.

        Raises:
            UnsupportedError: registers have no such dtype.
        """
        dtype = np.dtype(dtype)
        if dtype.name not in TYPES:
            raise UnsupportedError(f"numbers of dtype {dtype.name}")
        number = next(self._count)
        if number > MAX_REGISTERS:
            raise UnsupportedError(f"more than {MAX_REGISTERS} registers")
        name = f"%v{number}"
        self._registers.setdefault(TYPES[dtype.name], []).append(name)
        return Register(name, dtype)

    def emit(self, instruction: str, dtype: Any, *operands: Scalar) -> Register:
        """Appends an instruction; returns the register of its result.

        Args:
            instruction: its name with types, such as "add.f32".
            dtype: the dtype of the result.
            operands: the operands.
        """
        texts = tuple(map(_text, operands))
        key = instruction, np.dtype(dtype).name, texts
        for known in reversed(self._known):
            if key in known:
                return known[key]
        result = self.new(dtype)
        self.lines.append(
            Line(f"{instruction} {', '.join((result.name, *texts))};", result.name, operands)
        )
        self._known[-1][key] = result
        return result

    def load(self, address: str, dtype: Any) -> Register:
        """Reads a number from memory; a bool from a byte.

        All numbers must be read before any is written, since arrays may share memory.
        """
        if np.dtype(dtype) == bool:
            byte = self._load(address, "u8", np.uint32)
            return self.emit("setp.ne.u32", bool, byte, np.uint32(0))
        return self._load(address, _type(np.dtype(dtype)), dtype)

    def _load(self, address: str, kind: str, dtype: Any) -> Register:
        result = self.new(dtype)
        text = f"ld.global.{kind} {result.name}, [{address}];"
        base = Register(address.split("+")[0], np.dtype(np.uint64))
        self.lines.append(Line(text, result.name, (base,)))
        return result

    def store(self, address: str, x: Scalar) -> None:
        """Writes a number to memory; a bool as a byte."""
        kind = _type(x.dtype)
        if kind == "pred":
            x, kind = self.select(x, np.uint32(1), np.uint32(0)), "u8"
        if not isinstance(x, Register):  # stores take registers only
            x = self.copied(x)
        base = Register(address.split("+")[0], np.dtype(np.uint64))
        self._keep(f"st.global.{kind} [{address}], {_text(x)};", x, base)

    def copied(self, x: Scalar) -> Register:
        """Returns a new register that holds x, and that may be written again."""
        result = self.new(x.dtype)
        self.assign(result, x)
        return result

    def assign(self, register: Register, x: Scalar) -> None:
        """Writes x to a register that may be written again."""
        kind = _type(register.dtype)
        if kind == "pred" and not isinstance(x, Register):
            self._keep(f"setp.ne.u32 {register.name}, {int(x)}, 0;")
        else:
            self._keep(f"mov.{kind} {register.name}, {_text(x)};", x)

    def _keep(self, text: str, *read: Scalar) -> None:
        self.lines.append(Line(text, None, read))

    def apply(self, name: str, *operands: Scalar) -> Scalar:
        """Returns the result of an elementwise primitive of JAX.

        Args:
            name: the name of the primitive.
            operands: its operands.

        Raises:
            UnsupportedError: the primitive has no instructions here.
        """
        if not any(isinstance(x, Register) for x in operands) and name in ELEMENTWISE:
            dtype = operands[0].dtype
            if name != "div" or np.issubdtype(dtype, np.inexact):
                with np.errstate(all="ignore"):
                    known: Any = np.asarray(ELEMENTWISE[name](*operands))
                return known[()]
        for place, neutral in NEUTRAL.get(name, ()):
            constant, other = operands[place], operands[1 - place]
            if isinstance(constant, Register):
                continue
            if name == "mul" and constant == 0:
                return other.dtype.type(0)
            if constant == neutral:
                return other
        if name not in INSTRUCTIONS:
            raise UnsupportedError(name)
        return INSTRUCTIONS[name](self, *operands)

    def select(self, which: Scalar, x: Scalar, y: Scalar) -> Scalar:
        """Returns x if the predicate `which` is True, otherwise y."""
        if not isinstance(which, Register):
            return x if which else y
        if is_same(x, y):
            return x
        if x.dtype == bool:
            inside = self.apply("and", which, x)
            return self.apply("or", inside, self.apply("and", self.apply("not", which), y))
        return self.emit(f"selp.{_type(x.dtype)}", x.dtype, x, y, which)

    def fma(self, a: Scalar, b: Scalar, c: Scalar) -> Register:
        """Returns a b + c, rounded once."""
        return self.emit(f"fma.rn.{_type(a.dtype)}", a.dtype, a, b, c)

    def convert(self, x: Scalar, dtype: Any) -> Scalar:
        """Returns a number as another dtype, as `lax.convert_element_type` does."""
        target = np.dtype(dtype)
        if x.dtype == target:
            return x
        floating = np.issubdtype(x.dtype, np.inexact)
        whole = np.issubdtype(target, np.integer)
        if not isinstance(x, Register) and not (floating and whole):
            return x.astype(target)
        new, old = _type(target), _type(x.dtype)
        if old == "pred":
            return self.select(x, target.type(1), target.type(0))
        if new == "pred":
            return self.apply("ne", x, x.dtype.type(0))
        if floating and whole:
            rounding = ".rzi"
        elif np.issubdtype(target, np.inexact) and (new, old) != ("f64", "f32"):
            rounding = ".rn"
        else:
            rounding = ""
        result = self.emit(f"cvt{rounding}.{new}.{old}", target, x)
        if floating and whole and "64" in old + new:  # NaN becomes 0 in 32 bits only
            nan = self.emit(f"setp.nan.{old}", bool, x, x)
            return self.select(nan, target.type(0), result)
        return result

    def bits(self, x: Scalar, dtype: Any) -> Register:
        """Returns the bits of a number as a number of another dtype of the same size."""
        return self.emit(f"mov.{BITS[_type(np.dtype(dtype))]}", dtype, x)

    def branch(
        self,
        which: Register,
        taken: Callable[[], Sequence[Scalar]],
        others: Callable[[], Sequence[Scalar]],
    ) -> list[Scalar]:
        """Writes a branch; returns the results of the function that is taken.

        Args:
            which: the predicate.
            taken: writes what is computed if the predicate is True; returns its results.
            others: the same for False.
        """
        label = f"B{next(self._count)}"
        first, x = self._captured(taken)
        second, y = self._captured(others)
        pairs = list(zip(x, y, strict=True))
        results = [a if is_same(a, b) else self.new(a.dtype) for a, b in pairs]
        moved = [(r, a, b) for r, (a, b) in zip(results, pairs, strict=True) if not is_same(a, b)]
        self._keep(f"@!{which.name} bra {label}_else;", which)
        self.lines += first
        for register, a, _ in moved:
            self.assign(register, a)  # type: ignore[arg-type]
        self._keep(f"bra {label}_end;")
        self._keep(f"{label}_else:")
        self.lines += second
        for register, _, b in moved:
            self.assign(register, b)  # type: ignore[arg-type]
        self._keep(f"{label}_end:")
        return results

    def _captured(self, write: Callable[[], Sequence[Scalar]]) -> tuple[list[Line], list[Scalar]]:
        """Returns the lines that a function writes, and its results."""
        before, self.lines = self.lines, []
        self._known.append({})
        results = list(write())
        self._known.pop()
        written, self.lines = self.lines, before
        return written, results

    def loop(
        self,
        condition: Callable[[Sequence[Scalar]], Scalar],
        body: Callable[[Sequence[Scalar]], Sequence[Scalar]],
        start: Sequence[Scalar],
    ) -> list[Scalar]:
        """Writes a loop that runs as long as the condition holds; returns the last values.

        Args:
            condition: writes the condition on the carried values, before each round.
            body: writes one round; returns the new carried values.
            start: the carried values at the start.
        """
        label = f"L{next(self._count)}"
        carried = [self.copied(x) for x in start]
        self._keep(f"{label}:")
        self._known.append({})
        goes_on = condition(carried)
        if isinstance(goes_on, Register):
            self._keep(f"@!{goes_on.name} bra {label}_end;", goes_on)
        elif not goes_on:
            self._keep(f"bra {label}_end;")
        results = body(carried)
        pairs = zip(carried, results, strict=True)
        moved = [(register, x) for register, x in pairs if not is_same(register, x)]
        others = {r.name for r in carried}
        # a new value that is another carried register must be read before that one is written
        values = [
            self.copied(x) if isinstance(x, Register) and x.name in others else x for _, x in moved
        ]
        for (register, _), x in zip(moved, values, strict=True):
            self.assign(register, x)
        self._known.pop()
        self._keep(f"bra {label};")
        self._keep(f"{label}_end:")
        return list(carried)

    def start(self, threads: int, strides: Sequence[int]) -> None:
        """Writes the start, which ends surplus threads and finds the addresses of arrays.

        Args:
            threads: the number of threads that have a world.
            strides: for each array, the bytes between the entries of a world and of the next one.
        """
        block, size, place = (self.new(np.uint32) for _ in range(3))
        outside = self.new(bool)
        self._keep(f"mov.u32 {block.name}, %ctaid.x;")
        self._keep(f"mov.u32 {size.name}, %tid.x;")
        self._keep(f"mad.lo.u32 {place.name}, {block.name}, {BLOCK}, {size.name};")
        self._keep(f"setp.ge.u32 {outside.name}, {place.name}, {threads};")
        self._keep(f"@{outside.name} ret;")
        for k, stride in enumerate(strides):
            first = self.new(np.uint64)
            self._keep(f"ld.param.u64 {first.name}, [p{k}];")
            self._keep(f"cvta.to.global.u64 {first.name}, {first.name};")
            if stride:
                self._keep(f"mad.wide.u32 {first.name}, {place.name}, {stride}, {first.name};")
            self._arrays.append(first)

    def pointer(self, array: int) -> Register:
        """Returns the address of the first entry of an array, in this thread's world."""
        return self._arrays[array]

    def moved(self, pointer: Register, by: Scalar, stride: int) -> Register:
        """Returns the address `by` strides further, where `by` is an index of a loop [B]."""
        far = self.apply("mul", self.convert(by, np.int64), np.int64(stride))
        return self.emit("add.s64", np.uint64, pointer, far)

    def address(self, pointer: Register, offset: int) -> str:
        """Returns the address of an entry, at an offset from another address [B]."""
        if offset < MAX_OFFSET:
            return f"{pointer.name}+{offset}"
        return self.emit("add.u64", np.uint64, pointer, np.uint64(offset)).name

    def text(self, name: str, pointers: int) -> str:
        """Returns the whole program, without instructions whose result is not used.

        Args:
            name: the name of the program.
            pointers: the number of arrays that it takes.
        """
        params = ",\n".join(f".param .u64 p{k}" for k in range(pointers))
        used: set[str] = set()
        kept: list[str] = []
        for line in reversed(self.lines):
            if line.result is None or line.result in used:
                kept.append(line.text)
                used.update(x.name for x in line.read if isinstance(x, Register))
        named = {name for text in kept for name in _names(text)}
        declared = [
            f".reg .{kind} {', '.join(x for x in registers if x in named)};"
            for kind, registers in self._registers.items()
            if not named.isdisjoint(registers)
        ]
        body = "\n".join([*declared, *reversed(kept), "ret;"])
        # each thread may use all the registers that the GPU has for one
        limits = f".maxntid {BLOCK}, 1, 1\n.minnctapersm 1"
        return f"{HEADER}\n.visible .entry {name}(\n{params})\n{limits}\n{{\n{body}\n}}\n"


def is_same(x: Scalar, y: Scalar) -> bool:
    """Returns True if two scalars are the same register, or the same known number."""
    if isinstance(x, Register) or isinstance(y, Register):
        return isinstance(x, Register) and isinstance(y, Register) and x.name == y.name
    return x.dtype == y.dtype and x.tobytes() == y.tobytes()


def _names(text: str) -> list[str]:
    """Returns the names of the registers in a line."""
    return re.findall(r"%v\d+", text)


def _type(dtype: np.dtype) -> str:
    """Returns the type of a register of this dtype."""
    if dtype.name not in TYPES:
        raise UnsupportedError(f"numbers of dtype {dtype.name}")
    return TYPES[dtype.name]


def _text(x: Scalar) -> str:
    """Returns an operand as text; a float by its bits."""
    if isinstance(x, Register):
        return x.name
    if x.dtype == np.float32:
        return "0f" + struct.pack(">f", float(x)).hex().upper()
    if x.dtype == np.float64:
        return "0d" + struct.pack(">d", float(x)).hex().upper()
    _type(x.dtype)  # an error if there is none
    return str(int(x))


def _is_float(x: Scalar) -> bool:
    return np.issubdtype(x.dtype, np.floating)


def _plain(name: str, *, integers: str | None = None) -> Callable[..., Scalar]:
    """Makes an operation of one instruction, with another name for integers."""

    def write(thread: Thread, *operands: Scalar) -> Scalar:
        x = operands[0]
        instruction = name if _is_float(x) or integers is None else integers
        return thread.emit(f"{instruction}.{_type(x.dtype)}", x.dtype, *operands)

    return write


def _float_only(instruction: str) -> Callable[..., Scalar]:
    """Makes an operation of one instruction on floats; its types follow the dot in `{}`."""

    def write(thread: Thread, *operands: Scalar) -> Scalar:
        x = operands[0]
        if not _is_float(x):
            raise UnsupportedError(f"{instruction} of {x.dtype.name}")
        return thread.emit(instruction.format(_type(x.dtype)), x.dtype, *operands)

    return write


def _signed(name: str) -> Callable[..., Scalar]:
    """Makes an operation of one instruction on numbers that have a sign."""

    def write(thread: Thread, x: Scalar) -> Scalar:
        if x.dtype.name.startswith("uint"):
            raise UnsupportedError(f"{name} of {x.dtype.name}")
        return thread.emit(f"{name}.{_type(x.dtype)}", x.dtype, x)

    return write


def _compare(name: str) -> Callable[..., Scalar]:
    def write(thread: Thread, x: Scalar, y: Scalar) -> Scalar:
        if x.dtype == bool:
            if name not in ("eq", "ne"):
                raise UnsupportedError(f"{name} of bool")
            unequal = thread.apply("xor", x, y)
            return unequal if name == "ne" else thread.apply("not", unequal)
        how = "neu" if name == "ne" and _is_float(x) else name
        return thread.emit(f"setp.{how}.{_type(x.dtype)}", bool, x, y)

    return write


def _logical(name: str) -> Callable[..., Scalar]:
    def write(thread: Thread, x: Scalar, y: Scalar) -> Scalar:
        if x.dtype != bool:
            return thread.emit(f"{name}.{BITS[_type(x.dtype)]}", x.dtype, x, y)
        for known, other in ((x, y), (y, x)):
            if isinstance(known, Register):
                continue
            if name == "xor":
                return thread.apply("not", other) if known else other
            return other if bool(known) == (name == "and") else known
        if is_same(x, y):
            return np.False_ if name == "xor" else x
        return thread.emit(f"{name}.pred", bool, x, y)

    return write


def _not(thread: Thread, x: Scalar) -> Scalar:
    kind = _type(x.dtype)
    return thread.emit(f"not.{BITS.get(kind, kind)}", x.dtype, x)


def _extremum(name: str) -> Callable[..., Scalar]:
    """Makes max or min, which is NaN if an operand is NaN."""

    def write(thread: Thread, x: Scalar, y: Scalar) -> Scalar:
        if x.dtype == bool:
            return thread.apply("or" if name == "max" else "and", x, y)
        kind = _type(x.dtype)
        result = thread.emit(f"{name}.{kind}", x.dtype, x, y)
        if not _is_float(x):
            return result
        nan = [z for z in (x, y) if isinstance(z, Register) or np.isnan(z)]
        bad = thread.emit(f"setp.nan.{kind}", bool, nan[0], nan[-1])
        return thread.select(bad, x.dtype.type(np.nan), result)

    return write


def _sign(thread: Thread, x: Scalar) -> Scalar:
    if x.dtype.name.startswith("uint"):
        raise UnsupportedError(f"sign of {x.dtype.name}")
    zero, one = x.dtype.type(0), x.dtype.type(1)
    negative = thread.select(thread.apply("lt", x, zero), x.dtype.type(-1), x)
    return thread.select(thread.apply("gt", x, zero), one, negative)  # of ±0 and NaN, x itself


def _finite(thread: Thread, x: Scalar) -> Scalar:
    return thread.emit(f"testp.finite.{_type(x.dtype)}", bool, x)


def _rsqrt(thread: Thread, x: Scalar) -> Scalar:
    return thread.apply("div", x.dtype.type(1), thread.apply("sqrt", x))


def _remainder(thread: Thread, x: Scalar, y: Scalar) -> Scalar:
    if _is_float(x):
        raise UnsupportedError("a remainder of floats")
    return thread.emit(f"rem.{_type(x.dtype)}", x.dtype, x, y)


def _clamp(thread: Thread, low: Scalar, x: Scalar, high: Scalar) -> Scalar:
    return thread.apply("min", thread.apply("max", low, x), high)


def _shift(shift: str) -> Callable[..., Scalar]:
    def write(thread: Thread, x: Scalar, by: Scalar) -> Scalar:
        if x.dtype.name.startswith("uint"):
            raise UnsupportedError(f"{shift} of {x.dtype.name}")
        kind = BITS[_type(x.dtype)] if shift == "shl" else _type(x.dtype)
        return thread.emit(f"{shift}.{kind}", x.dtype, x, thread.convert(by, np.uint32))

    return write


INSTRUCTIONS: dict[str, Callable[..., Scalar]] = {
    "add": _plain("add"),
    "add_any": _plain("add"),
    "sub": _plain("sub"),
    "mul": _plain("mul", integers="mul.lo"),
    "div": _plain("div.rn", integers="div"),
    "rem": _remainder,
    "neg": _signed("neg"),
    "abs": _signed("abs"),
    "square": lambda thread, x: thread.apply("mul", x, x),
    "sqrt": _float_only("sqrt.rn.{}"),
    "rsqrt": _rsqrt,
    "floor": _float_only("cvt.rmi.{0}.{0}"),
    "ceil": _float_only("cvt.rpi.{0}.{0}"),
    "max": _extremum("max"),
    "min": _extremum("min"),
    "clamp": _clamp,
    "sign": _sign,
    "is_finite": _finite,
    "not": _not,
    "shift_left": _shift("shl"),
    "shift_right_arithmetic": _shift("shr"),
}
"""The instructions of each elementwise primitive: (thread, *operands) → result."""
INSTRUCTIONS |= {name: _compare(name) for name in COMPARISONS}
INSTRUCTIONS |= {name: _logical(name) for name in LOGICAL}
