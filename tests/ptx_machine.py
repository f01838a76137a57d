"""Runs the text of a kernel on the CPU, one thread after the other, as NVIDIA's manual defines it.

Only the instructions that `jaxcon.staging` writes are known; any other one is an error.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxcon.core.host import ELEMENTWISE

DTYPES = {"f32": np.float32, "f64": np.float64, "s32": np.int32, "s64": np.int64}
DTYPES |= {"u32": np.uint32, "u64": np.uint64, "pred": np.bool_, "u8": np.uint8}


def run(text: str, arrays: Sequence[np.ndarray], block: int = 32) -> None:
    """Runs a kernel on arrays in memory, which it changes in place.

    Args:
        text: the kernel.
        arrays: contiguous arrays, in the order of its parameters.
        block: the number of threads in a block; whole blocks run, as many as `threads` needs.
    """
    registers, labels, lines = _parsed(text)
    threads = next(int(x[-1]) for _, name, x in lines if name == "setp.ge.u32")
    memory = [x.reshape(-1).view(np.uint8) for x in arrays]
    with np.errstate(all="ignore"):
        for thread in range(-(-threads // block) * block):
            _run_thread(lines, labels, registers, memory, divmod(thread, block))


Line = tuple[str | None, str, list[str]]
"""The predicate that guards a line, its instruction, and its operands."""


def _parsed(text: str) -> tuple[dict[str, str], dict[str, int], list[Line]]:
    """Returns the types of registers, the places of labels, and the lines."""
    registers: dict[str, str] = {}
    labels: dict[str, int] = {}
    lines: list[Line] = []
    body = text[text.index("{") + 1 : text.rindex("}")]
    for line in filter(None, map(str.strip, body.splitlines())):
        if line.startswith(".reg"):
            _, kind, names = line.rstrip(";").split(maxsplit=2)
            registers |= {name.strip(): kind[1:] for name in names.split(",")}
        elif line.endswith(":"):
            labels[line[:-1]] = len(lines)
        else:
            found = re.fullmatch(r"(?:@(!?%\w+) )?([\w.]+)(?: (.*))?;", line)
            assert found, line
            operands = [x.strip() for x in found[3].split(",")] if found[3] else []
            lines.append((found[1], found[2], operands))
    return registers, labels, lines


def _run_thread(
    lines: list[Line],
    labels: dict[str, int],
    registers: dict[str, str],
    memory: list[np.ndarray],
    place: tuple[int, int],
) -> None:
    """Runs one thread to its end."""
    values: dict[str, Any] = {}
    position = 0

    def read(x: str, kind: str) -> Any:
        if x.startswith(("%v", "%w")):
            return values[x]
        if x in ("%ctaid.x", "%tid.x"):
            return np.uint32(place[x == "%tid.x"])
        if x.startswith("0f"):
            return np.uint32(int(x[2:], 16)).view(np.float32)
        if x.startswith("0d"):
            return np.uint64(int(x[2:], 16)).view(np.float64)
        return DTYPES[kind](int(x))

    while True:
        guard, name, operands = lines[position]
        position += 1
        if guard and bool(values[guard.lstrip("!")]) == guard.startswith("!"):
            continue
        if name == "ret":
            return
        if name == "bra":
            position = labels[operands[0]]
            continue
        *head, kind = name.split(".")
        if head[0] == "ld" and head[1] == "param":
            values[operands[0]] = (int(operands[1].strip("[p]")), 0)  # an array and an offset
        elif head[0] == "ld":
            array, offset = _place(operands[1], values)
            dtype = np.dtype(DTYPES[kind])
            number = memory[array][offset : offset + dtype.itemsize].view(dtype)[0]
            values[operands[0]] = DTYPES[registers[operands[0]]](number)
        elif head[0] == "st":
            array, offset = _place(operands[0], values)
            dtype = np.dtype(DTYPES[kind])
            number = np.asarray(read(operands[1], kind)).astype(dtype)
            memory[array][offset : offset + dtype.itemsize] = number.reshape(1).view(np.uint8)
        elif head[0] == "cvta":
            pass
        elif name == "mad.wide.u32":
            array, offset = values[operands[3]]
            values[operands[0]] = array, offset + int(values[operands[1]]) * int(operands[2])
        elif name in ("add.u64", "add.s64") and isinstance(values.get(operands[1]), tuple):
            array, offset = values[operands[1]]
            values[operands[0]] = array, offset + int(read(operands[2], kind))
        else:
            like = registers[operands[0]] if kind.startswith("b") else kind
            given = [read(x, like) for x in operands[1:]]
            result = _computed(head, kind, given)
            target = DTYPES[registers[operands[0]]]
            if head[0] == "mov" and kind in ("b32", "b64"):
                values[operands[0]] = np.asarray(result).view(target)[()]
            else:
                assert np.dtype(target) == np.asarray(result).dtype, (name, operands)
                values[operands[0]] = target(result)


def _place(x: str, values: dict[str, Any]) -> tuple[int, int]:
    """Returns the array and the offset of an address such as "[%v3+8]"."""
    base, _, offset = x.strip("[]").partition("+")
    array, start = values[base]
    return array, start + int(offset or 0)


def _computed(head: list[str], kind: str, x: list[Any]) -> Any:
    """Returns the result of an instruction on numbers."""
    name = head[0]
    if name == "cvt":
        return _converted(head[1:], kind, x[0])
    if name == "setp":
        return _compared(head[1], x[0], x[1])
    if name == "testp":
        return np.isfinite(x[0])
    if name == "selp":
        return x[0] if x[2] else x[1]
    if name == "fma":
        if kind == "f32":
            return np.float32(np.float64(x[0]) * np.float64(x[1]) + np.float64(x[2]))
        return np.float64(np.longdouble(x[0]) * np.longdouble(x[1]) + np.longdouble(x[2]))
    if name == "copysign":
        return np.copysign(x[1], x[0])
    if name in ("max", "min") and kind.startswith("f"):
        return (np.fmax if name == "max" else np.fmin)(*x)
    if name in ("shl", "shr"):
        return type(x[0])(x[0] << type(x[0])(x[1]) if name == "shl" else x[0] >> type(x[0])(x[1]))
    if name == "mad":
        return type(x[0])(x[0] * x[1] + x[2])
    if name == "div" and not kind.startswith("f"):
        return type(x[0])(math.trunc(int(x[0]) / int(x[1])))
    if name == "rem":
        return type(x[0])(math.fmod(int(x[0]), int(x[1])))
    return FUNCTIONS[name](*x)


def _compared(how: str, x: Any, y: Any) -> Any:
    """Returns the result of a comparison."""
    if how == "nan":
        return np.isnan(x) | np.isnan(y)
    if how == "ne" and isinstance(x, np.floating):
        return (x != y) & ~np.isnan(x) & ~np.isnan(y)
    return FUNCTIONS["ne" if how == "neu" else how](x, y)


def _converted(how: list[str], kind: str, x: Any) -> Any:
    """Returns a number as another type, rounded as the instruction says."""
    rounding = how[0] if how[0].startswith("r") else None
    target = DTYPES[how[-1]]
    whole = {"rmi": np.floor, "rpi": np.ceil, "rni": np.rint, "rzi": np.trunc}
    if rounding in whole:
        assert isinstance(x, np.floating)
        x = whole[rounding](x)
        if np.issubdtype(target, np.integer):
            info = np.iinfo(target)
            if np.isnan(x):  # 0 in 32 bits; else only the first bit is set
                wide = x.dtype.itemsize == 8 or info.bits == 64
                return target(info.min if info.min else 1 << (info.bits - 1)) if wide else target(0)
            limited = min(max(float(x), float(info.min)), float(info.max))
            return target(min(max(int(limited), int(info.min)), int(info.max)))
    return target(x)


SAME = ("add", "sub", "mul", "div", "neg", "abs", "sqrt", "max", "min", "and", "or", "xor", "not")
SAME += ("eq", "ne", "lt", "le", "gt", "ge")
FUNCTIONS: dict[str, Callable[..., Any]] = {name: ELEMENTWISE[name] for name in SAME}
FUNCTIONS["mov"] = lambda x: x
