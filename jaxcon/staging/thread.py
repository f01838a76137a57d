"""The instructions by which one thread computes in one world.

A `Thread` computes with scalars, which are registers or numbers known when the program is written.
Each method appends the instructions of one operation and returns the scalar that holds the result.
Operations on known numbers are evaluated at once, and an operation on the same scalars is written
only once. Products and sums may be contracted to one rounding.

`ptx` writes the instructions as text for NVIDIA's GPUs, and `llvm` for CPUs, where the lanes of a
vector register are the threads. There is no limit on registers: compilers of the text assign them.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxcon.core.host import ELEMENTWISE
from jaxcon.core.typing import T
from jaxcon.staging.constants import NEUTRAL

MAX_REGISTERS = 1_000_000
"""The largest number of registers that a thread may name, so that writing ends in seconds."""

DTYPES = {np.dtype(x) for x in ("float32", "float64", "int32", "int64", "uint32", "uint64", "bool")}
"""The dtypes of registers."""

WRITES = ("set", "assign")
"""Instructions that write their first operand."""

COMPARISONS = ("eq", "ne", "lt", "le", "gt", "ge")
LOGICAL = ("and", "or", "xor")


class UnsupportedError(Exception):
    """A program contains an operation that has no instructions here."""


class _TooLongError(Exception):
    """A trial of `Thread.tried` exceeds its largest number of instructions."""


@dataclass(frozen=True, slots=True)
class Register:
    """A register of a thread.

    Attributes:
        number: its number, which is unique within the thread.
        dtype: the NumPy dtype of its value; bool for a predicate.
    """

    number: int
    dtype: np.dtype


Scalar = Register | np.generic
"""A number in a register, or one that is known."""


class Local(NamedTuple):
    """An array of numbers of a thread in memory that the kernel needs for itself."""

    entries: int
    dtype: np.dtype


class Counter(NamedTuple):
    """The number of the current round of a loop of a known number of rounds, from 0."""

    number: int


class Address(NamedTuple):
    """The place of a number in memory.

    Attributes:
        array: the number of the array.
        entry: the number of the entry in the flat array of a world.
        moves: pairs of the counter of a loop around this place, from the outermost, and of the
            entries that each round adds.
    """

    array: int
    entry: int = 0
    moves: tuple[tuple[Counter, int], ...] = ()


class Layout(NamedTuple):
    """How an array lies in memory, with the worlds along the last axis.

    Attributes:
        world: the bytes between an entry in a world and in the next one; 0 if they share it.
        entry: the bytes between an entry and the next one in a world.
    """

    world: int
    entry: int


class Instruction(NamedTuple):
    """An operation on scalars.

    Attributes:
        name: the name of the operation, as in `INSTRUCTIONS`. Furthermore: `convert` and `bits`, to
            the dtype of the result; `select` (predicate, if true, if false); `load` and `store`;
            `set` and `assign`, which write the second operand to the first one, a register. Threads
            that do not take part in a branch or in a round keep the register after `assign`, and
            may lose it after `set`. `fetch` reads a local array. Unlike `load`, it keeps its place
            after all that is written before.
        result: the register of its result, which no other instruction writes; None if the
            instruction must be kept.
        operands: its operands.
        reads: the numbers of the registers that it reads.
        address: the place in memory of `load`, `store` and `fetch`.
    """

    name: str
    result: Register | None
    operands: tuple[Scalar, ...]
    reads: tuple[int, ...]
    address: Address | None = None

    @property
    def keeps_place(self) -> bool:
        """True for what is written to memory or to registers, and for reads of local arrays."""
        return self.result is None or self.name == "fetch"


class Branch(NamedTuple):
    """A conditional.

    Attributes:
        which: the predicate.
        taken: the statements that are executed if it is True.
        others: those executed if it is False.
    """

    which: Register
    taken: list[Statement]
    others: list[Statement]


class Loop(NamedTuple):
    """A loop that ends under a condition.

    Attributes:
        condition: the statements that evaluate the condition, before each round.
        goes_on: the condition.
        body: the statements of a round.
    """

    condition: list[Statement]
    goes_on: Scalar
    body: list[Statement]


class Repeat(NamedTuple):
    """A loop of a known number of rounds.

    Attributes:
        counter: the number of the current round.
        length: the number of rounds.
        body: the statements of a round.
    """

    counter: Counter
    length: int
    body: list[Statement]


class Piece(NamedTuple):
    """Instructions that a writer of text takes together.

    Attributes:
        instructions: the instructions.
        apart: True if they are to be a function of their own.
    """

    instructions: Sequence[Instruction]
    apart: bool


Statement = Instruction | Branch | Loop | Repeat | Piece


class Thread:
    """The program of one thread, written from top to bottom.

    Attributes:
        statements: the statements written so far, in the block that is being written.
        length: the number of instructions written so far.
        local: the local arrays, whose numbers follow those of arguments and results.
    """

    def __init__(self, arrays: int = 0) -> None:
        """Begins a program.

        Args:
            arrays: the number of arrays that are arguments or results.
        """
        self.statements: list[Statement] = []
        self.length = 0
        self.local: list[Local] = []
        self._arrays = arrays
        self._limit = math.inf  # the length at which a trial ends
        self._count = itertools.count()
        # results of instructions, by instruction and operands; an inner table for each loop or
        # branch, since its results do not exist outside of it
        self._known: list[dict[Any, Register]] = [{}]

    def new(self, dtype: Any) -> Register:
        """Returns a new register.

        Raises:
            UnsupportedError: registers have no such dtype.
        """
        dtype = np.dtype(dtype)
        _check(dtype)
        number = next(self._count)
        if number > MAX_REGISTERS:
            raise UnsupportedError(f"more than {MAX_REGISTERS} registers")
        return Register(number, dtype)

    def emit(self, name: str, dtype: Any, *operands: Scalar) -> Register:
        """Appends an instruction; returns the register of its result.

        Args:
            name: its name.
            dtype: the dtype of the result.
            operands: the operands.
        """
        dtype = np.dtype(dtype)
        key = name, dtype.char, tuple(map(_identity, operands))
        for known in reversed(self._known):
            if key in known:
                return known[key]
        result = self.new(dtype)
        self._append(Instruction(name, result, operands, _numbers(operands)))
        self._known[-1][key] = result
        return result

    def _append(self, instruction: Instruction) -> None:
        self.statements.append(instruction)
        self.length += 1
        if self.length > self._limit:
            raise _TooLongError

    def load(self, address: Address, dtype: Any) -> Register:
        """Reads a number from memory; a bool from a byte.

        If an argument lends its memory to a result, all numbers must be read before any is written.
        """
        result = self.new(dtype)
        self._append(Instruction("load", result, (), (), address))
        return result

    def allocate(self, entries: int, dtype: Any) -> Address:
        """Returns the first place of a new local array."""
        _check(np.dtype(dtype))
        self.local.append(Local(entries, np.dtype(dtype)))
        return Address(self._arrays + len(self.local) - 1)

    def fetch(self, address: Address, dtype: Any) -> Register:
        """Reads a number from a local array, after all that was written to it before."""
        result = self.new(dtype)
        self._append(Instruction("fetch", result, (), (), address))
        return result

    def store(self, address: Address, x: Scalar) -> None:
        """Writes a number to memory; a bool as a byte.

        Raises:
            UnsupportedError: registers have no such dtype.
        """
        _check(x.dtype)
        self._append(Instruction("store", None, (x,), _numbers((x,)), address))

    def copied(self, x: Scalar) -> Register:
        """Returns a new register that holds x, and that may be written again."""
        result = self.new(x.dtype)
        self.assign(result, x, "set")
        return result

    def assign(self, register: Register, x: Scalar, name: str = "assign") -> None:
        """Writes x to a register that may be written again; see `Instruction`."""
        self._append(Instruction(name, None, (register, x), _numbers((x,))))

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
            if name != "div" or dtype.kind == "f":
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
        return self.emit("select", x.dtype, which, x, y)

    def fma(self, a: Scalar, b: Scalar, c: Scalar) -> Register:
        """Returns a b + c, rounded once."""
        return self.emit("fma", a.dtype, a, b, c)

    def convert(self, x: Scalar, dtype: Any) -> Scalar:
        """Returns a number as another dtype, as `lax.convert_element_type` does.

        A float becomes the nearest integer towards 0 that the dtype has, and NaN becomes 0.
        """
        target = np.dtype(dtype)
        if x.dtype == target:
            return x
        whole = is_float(x) and target.kind in "iu"
        if not isinstance(x, Register) and not whole:
            return x.astype(target)
        if x.dtype == bool:
            return self.select(x, target.type(1), target.type(0))
        if target.kind == "b":
            return self.apply("ne", x, x.dtype.type(0))
        return self.emit("convert", target, x)

    def bits(self, x: Scalar, dtype: Any) -> Scalar:
        """Returns the bits of a number as a number of another dtype of the same size."""
        if not isinstance(x, Register):
            return x.view(dtype)
        return self.emit("bits", dtype, x)

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
        first, x = self._captured(taken)
        second, y = self._captured(others)
        results: list[Scalar] = []
        for a, b in zip(x, y, strict=True):
            if is_same(a, b):
                results.append(a)
                continue
            result = self.new(a.dtype)
            self.length += 2
            first.append(Instruction("set", None, (result, a), _numbers((a,))))
            second.append(Instruction("assign", None, (result, b), _numbers((b,))))
            results.append(result)
        self.statements.append(Branch(which, first, second))
        return results

    def _captured(self, write: Callable[[], T]) -> tuple[list[Statement], T]:
        """Returns the statements that a function writes, and its results."""
        before, self.statements = self.statements, []
        self._known.append({})
        results = write()
        self._known.pop()
        written, self.statements = self.statements, before
        return written, results

    def tried(self, write: Callable[[], T], max_length: int | None) -> T | None:
        """Writes what a function writes; nothing, and returns None, if that is too long.

        Args:
            write: the function; returns its results.
            max_length: the largest number of instructions; None if there is no limit.
        """
        if max_length is None:
            return write()
        before, limit, depth = self.length, self._limit, len(self._known)
        arrays = len(self.local)
        outside, self.statements = self.statements, []
        self._known.append({})
        self._limit = min(limit, before + max_length)
        try:
            results = write()
        except _TooLongError:
            if limit <= before + max_length:  # an outer trial ends first
                raise
            del self._known[depth:], self.local[arrays:]
            self.length, self.statements = before, outside
            return None
        finally:
            self._limit = limit
        written, self.statements = self.statements, outside
        known = self._known.pop()
        self.statements += written
        self._known[-1] |= known
        return results

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
        carried = [self.copied(x) for x in start]

        def write() -> tuple[list[Statement], Scalar]:
            # the body may use results of the condition
            goes_on = condition(carried)
            before, self.statements = self.statements, []
            self._carry(carried, body(carried))
            return before, goes_on

        body_statements, (before, goes_on) = self._captured(write)
        self.statements.append(Loop(before, goes_on, body_statements))
        return list(carried)

    def repeat(
        self,
        length: int,
        body: Callable[[Counter, Sequence[Scalar]], Sequence[Scalar]],
        start: Sequence[Scalar],
    ) -> list[Scalar]:
        """Writes a loop of a known number of rounds; returns the last values.

        Args:
            length: the number of rounds.
            body: writes one round, from its number and the carried values; returns new ones.
            start: the carried values at the start.
        """
        carried = [self.copied(x) for x in start]
        counter = Counter(next(self._count))
        written, _ = self._captured(lambda: self._carry(carried, body(counter, carried)))
        self.statements.append(Repeat(counter, length, written))
        return list(carried)

    def _carry(self, carried: Sequence[Register], results: Sequence[Scalar]) -> None:
        """Writes the results of a round to the registers of carried values."""
        pairs = zip(carried, results, strict=True)
        moved = [(register, x) for register, x in pairs if not is_same(register, x)]
        # a new value that is another carried register must be read before that one is written
        values = [
            self.copied(x) if isinstance(x, Register) and x in carried else x for _, x in moved
        ]
        for (register, _), x in zip(moved, values, strict=True):
            self.assign(register, x)

    def program(self) -> list[Statement]:
        """Returns the whole program, without instructions whose result is not used.

        Each number is computed where it is first needed, so that few are kept at a time.
        """
        every = set().union(*map(_reads, self.statements))
        return _ordered(_used(_written(self.statements, every), set()))


def _written(statements: Sequence[Statement], read: set[int]) -> list[Statement]:
    """Returns a block without what is written to registers that nothing reads.

    Args:
        statements: the statements of the block.
        read: the numbers of the registers that are read anywhere.
    """

    def is_needed(statement: Statement) -> bool:
        if not isinstance(statement, Instruction) or statement.name not in WRITES:
            return True
        register: Any = statement.operands[0]
        return register.number in read

    change = functools.partial(_written, read=read)
    return [inner(x, change) for x in statements if is_needed(x)]


def _check(dtype: np.dtype) -> None:
    """Raises an `UnsupportedError` if registers have no such dtype."""
    if dtype not in DTYPES:
        raise UnsupportedError(f"numbers of dtype {dtype.name}")


def _used(statements: Sequence[Statement], read: set[int]) -> list[Statement]:
    """Returns the statements whose results are read, in their order.

    Args:
        statements: the statements of a block.
        read: the numbers of the registers that are read after the block. Those that the block reads
            are added.
    """
    kept: list[Statement] = []
    for statement in reversed(statements):
        match statement:
            case Instruction(_, result, _):
                if result is not None and result.number not in read:
                    continue
                read.update(statement.reads)
            case Branch(which, taken, others):
                statement = Branch(which, _used(taken, read), _used(others, read))
                read.add(which.number)
            case Loop(condition, goes_on, body):
                body = _used(body, read)
                if isinstance(goes_on, Register):
                    read.add(goes_on.number)
                statement = Loop(_used(condition, read), goes_on, body)
            case Repeat(counter, length, body):
                statement = Repeat(counter, length, _used(body, read))
        kept.append(statement)
    return kept[::-1]


def _ordered(statements: Sequence[Statement]) -> list[Statement]:
    """Returns a block in which each instruction is followed by its first reader, if possible.

    Operands that need more registers come first. What is written to memory, or to registers that
    are written again, keeps its place, after all that is read before. So do reads of local arrays.

    Reference: Sethi and Ullman, The Generation of Optimal Code for Arithmetic Expressions (1970).
    """
    free: dict[int, Instruction] = {}  # instructions that have no place yet, by their result
    needs: dict[int, int] = {}  # the number of registers that each of them needs
    for statement in statements:
        if isinstance(statement, Instruction) and statement.result and not statement.keeps_place:
            below = sorted((needs.get(x, 0) for x in statement.reads), reverse=True)
            number = statement.result.number
            free[number] = statement
            needs[number] = max([1, *(need + k for k, need in enumerate(below))])
    placed: list[Statement] = []

    def place(wanted: Sequence[int]) -> None:
        """Places instructions, each one after its operands."""
        stack = [(x, False) for x in reversed(wanted)]
        while stack:
            number, is_ready = stack.pop()
            if number not in free:
                continue
            if is_ready:
                placed.append(free.pop(number))
                continue
            stack.append((number, True))
            operands = [x for x in free[number].reads if x in free]
            # the last one on the stack is placed first
            stack += [(x, False) for x in sorted(operands, key=needs.__getitem__)]

    def kind(statement: Statement) -> str:
        if isinstance(statement, Instruction):
            return "fetch" if statement.name == "fetch" else "write"
        return "block"

    kept = (x for x in statements if not isinstance(x, Instruction) or x.keeps_place)
    for what, group in itertools.groupby(kept, kind):
        roots: list[Any] = list(group)
        if what != "block":  # later writes of a group do not depend on earlier ones
            place([x for root in roots for x in root.reads])
            placed += roots
            continue
        for root in roots:
            place(sorted(_reads(root)))
            placed.append(inner(root, _ordered))
    place(list(free))
    return placed


def _numbers(operands: Sequence[Scalar]) -> tuple[int, ...]:
    """Returns the numbers of the registers among operands."""
    return tuple([x.number for x in operands if isinstance(x, Register)])


def _reads(statement: Statement) -> set[int]:
    """Returns the numbers of the registers that a statement reads, in its blocks, too."""
    match statement:
        case Instruction():
            return set(statement.reads)
        case Branch(which, first, second):
            return {which.number}.union(*map(_reads, first), *map(_reads, second))
        case Loop(condition, goes_on, body):
            also = {goes_on.number} if isinstance(goes_on, Register) else set()
            return also.union(*map(_reads, condition), *map(_reads, body))
        case Repeat(_, _, body):
            return set().union(*map(_reads, body))
        case Piece(instructions):
            return set().union(*map(_reads, instructions))


def inner(
    statement: Statement, change: Callable[[Sequence[Statement]], list[Statement]]
) -> Statement:
    """Returns a statement with its blocks changed."""
    match statement:
        case Branch(which, first, second):
            return Branch(which, change(first), change(second))
        case Loop(condition, goes_on, body):
            return Loop(change(condition), goes_on, change(body))
        case Repeat(counter, length, body):
            return Repeat(counter, length, change(body))
        case _:
            return statement


def count_of(statements: Sequence[Statement]) -> int:
    """Returns the number of instructions in a block, and in blocks within it."""
    count = 0
    for statement in statements:
        match statement:
            case Instruction():
                count += 1
            case Branch(_, first, second) | Loop(first, _, second):
                count += count_of(first) + count_of(second)
            case Repeat(_, _, body):
                count += count_of(body)
            case Piece(instructions):
                count += len(instructions)
    return count


def addresses(statements: Sequence[Statement]) -> list[Address]:
    """Returns the addresses of all instructions in a block, and in blocks within it."""
    found: list[Address] = []
    for statement in statements:
        match statement:
            case Instruction():
                found += [] if statement.address is None else [statement.address]
            case Branch(_, taken, others):
                found += addresses(taken) + addresses(others)
            case Loop(condition, _, body):
                found += addresses(condition) + addresses(body)
            case Repeat(_, _, body):
                found += addresses(body)
            case Piece(instructions):
                found += addresses(instructions)
    return found


def pointers_of(counter: Counter, body: Sequence[Statement]) -> list[Address]:
    """Returns the places that the body of a loop starts from, once; their last move is the loop's.

    Loops within the body go on from these places.
    """
    found: set[Address] = set()
    for array, _, moves in addresses(body):
        for k, (mover, _) in enumerate(moves, 1):
            if mover == counter:
                found.add(Address(array, 0, moves[:k]))
    return sorted(found)


def is_same(x: Scalar, y: Scalar) -> bool:
    """Returns True if two scalars are the same register, or the same known number."""
    return _identity(x) == _identity(y)


def _identity(x: Scalar) -> Any:
    """Returns a value that is equal for the same registers, and for known numbers of equal bits."""
    return x.number if isinstance(x, Register) else (x.dtype.char, x.tobytes())


def is_float(x: Scalar) -> bool:
    """Returns True for a floating-point number."""
    return x.dtype.kind == "f"


def _plain(name: str) -> Callable[..., Scalar]:
    """Makes an operation of one instruction."""
    return lambda thread, *operands: thread.emit(name, operands[0].dtype, *operands)


def _of(kinds: str, name: str) -> Callable[..., Scalar]:
    """Makes an operation of one instruction on numbers whose dtypes are of the given kinds."""

    def write(thread: Thread, *operands: Scalar) -> Scalar:
        if operands[0].dtype.kind not in kinds:
            raise UnsupportedError(f"{name} of {operands[0].dtype.name}")
        return thread.emit(name, operands[0].dtype, *operands)

    return write


FLOATS, SIGNED = "f", "bif"
"""Kinds of dtypes: floats, and all but unsigned integers."""


def _compare(name: str) -> Callable[..., Scalar]:
    def write(thread: Thread, x: Scalar, y: Scalar) -> Scalar:
        if x.dtype == bool:
            if name not in ("eq", "ne"):
                raise UnsupportedError(f"{name} of bool")
            unequal = thread.apply("xor", x, y)
            return unequal if name == "ne" else thread.apply("not", unequal)
        return thread.emit(name, bool, x, y)

    return write


def _logical(name: str) -> Callable[..., Scalar]:
    def write(thread: Thread, x: Scalar, y: Scalar) -> Scalar:
        if x.dtype != bool:
            return thread.emit(name, x.dtype, x, y)
        for known, other in ((x, y), (y, x)):
            if isinstance(known, Register):
                continue
            if name == "xor":
                return thread.apply("not", other) if known else other
            return other if bool(known) == (name == "and") else known
        if is_same(x, y):
            return np.False_ if name == "xor" else x
        return thread.emit(name, bool, x, y)

    return write


def _extremum(name: str) -> Callable[..., Scalar]:
    """Makes max or min, which is NaN if an operand is NaN."""

    def write(thread: Thread, x: Scalar, y: Scalar) -> Scalar:
        if x.dtype == bool:
            return thread.apply("or" if name == "max" else "and", x, y)
        return thread.emit(name, x.dtype, x, y)

    return write


def _sign(thread: Thread, x: Scalar) -> Scalar:
    if x.dtype.kind == "u":
        raise UnsupportedError(f"sign of {x.dtype.name}")
    zero, one = x.dtype.type(0), x.dtype.type(1)
    negative = thread.select(thread.apply("lt", x, zero), x.dtype.type(-1), x)
    return thread.select(thread.apply("gt", x, zero), one, negative)  # of ±0 and NaN, x itself


def _rsqrt(thread: Thread, x: Scalar) -> Scalar:
    return thread.apply("div", x.dtype.type(1), thread.apply("sqrt", x))


def _quotient(name: str) -> Callable[..., Scalar]:
    """Makes a quotient or a remainder; of integers by known numbers other than 0 and −1 only."""

    def write(thread: Thread, x: Scalar, y: Scalar) -> Scalar:
        if is_float(x):
            if name == "rem":
                raise UnsupportedError("a remainder of floats")
        elif isinstance(y, Register) or y in (0, -1):
            raise UnsupportedError("a quotient of integers")
        return thread.emit(name, x.dtype, x, y)

    return write


def _clamp(thread: Thread, low: Scalar, x: Scalar, high: Scalar) -> Scalar:
    return thread.apply("min", thread.apply("max", low, x), high)


def _shift(name: str) -> Callable[..., Scalar]:
    """Makes a shift by a known number of bits, less than the dtype has."""

    def write(thread: Thread, x: Scalar, by: Scalar) -> Scalar:
        if isinstance(by, Register) or not 0 <= int(by) < 8 * x.dtype.itemsize:
            raise UnsupportedError(f"{name} by a traced number")
        return _of(SIGNED, name)(thread, x, by)

    return write


INSTRUCTIONS: dict[str, Callable[..., Scalar]] = {
    "add": _plain("add"),
    "add_any": _plain("add"),
    "sub": _plain("sub"),
    "mul": _plain("mul"),
    "div": _quotient("div"),
    "rem": _quotient("rem"),
    "neg": _of(SIGNED, "neg"),
    "abs": _of(SIGNED, "abs"),
    "square": lambda thread, x: thread.apply("mul", x, x),
    "sqrt": _of(FLOATS, "sqrt"),
    "rsqrt": _rsqrt,
    "floor": _of(FLOATS, "floor"),
    "ceil": _of(FLOATS, "ceil"),
    "max": _extremum("max"),
    "min": _extremum("min"),
    "clamp": _clamp,
    "sign": _sign,
    "is_finite": lambda thread, x: thread.emit("finite", bool, x),
    "not": _plain("not"),
    "shift_left": _shift("shift_left"),
    "shift_right_arithmetic": _shift("shift_right_arithmetic"),
}
"""The instructions of each elementwise primitive: (thread, *operands) → result."""
INSTRUCTIONS |= {name: _compare(name) for name in COMPARISONS}
INSTRUCTIONS |= {name: _logical(name) for name in LOGICAL}
