"""The program of a thread as text in LLVM's language, for the vector registers of a CPU.

Each lane of a vector register is a thread, and has a world of its own. Lanes take a branch
together: it is skipped if no lane needs it, and otherwise leaves the other lanes as they are. A
loop ends when the last lane has ended, and a lane keeps the values with which its own loop ended.

The program is cut into pieces of some hundred instructions, each of which is a function. A value
that another piece reads lies in memory, at a place that later values reuse. LLVM would find such
places itself in a single function, but in a time that grows faster than the program.

A long program does not fit into the caches of instructions. There each piece is evaluated for
several groups of lanes, one after the other, before the next piece: its instructions are read once
for all of them. A branch is skipped if no lane of any group needs it, and a group by itself within.

The function has the interface that XLA defines for functions of other libraries: its argument is a
description of the call, with the addresses of arrays.

References: LLVM Language Reference Manual, version 20; OpenXLA, XLA FFI, `xla/ffi/api/c_api.h`.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxcon.staging.thread import (
    WRITES,
    Address,
    Branch,
    Counter,
    Instruction,
    Layout,
    Local,
    Loop,
    Piece,
    Register,
    Repeat,
    Scalar,
    Statement,
    inner,
    is_float,
    pointers_of,
)

KINDS = {"float32": "float", "float64": "double", "int32": "i32", "int64": "i64", "uint32": "i32"}
KINDS |= {"uint64": "i64", "bool": "i1"}
TYPES = {np.dtype(name): kind for name, kind in KINDS.items()}
"""The type of a register for each dtype. The name of a dtype takes NumPy a microsecond to find."""

BYTES = {"float": 4, "double": 8, "i32": 4, "i64": 8}
"""The size of a number of each type in memory; i1 takes a bit of a vector."""

SUFFIXES = {"float": "f32", "double": "f64"}
"""How the names of LLVM's functions call types."""

FLOAT_COMPARISONS = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
FUNCTIONS = {"sqrt": "sqrt", "abs": "fabs", "floor": "floor", "ceil": "ceil", "round": "rint"}
FUNCTIONS |= {"truncate": "trunc", "fma": "fma", "copysign": "copysign"}
"""LLVM's functions of floats."""

INTEGERS = {"add": "add", "sub": "sub", "mul": "mul", "and": "and", "or": "or", "xor": "xor"}
INTEGERS |= {"shift_left": "shl", "shift_right_arithmetic": "ashr"}

PIECE = 300
"""The number of instructions of a piece."""

WRITE = 5
"""The weight of a `set` or an `assign` in the length of a piece; other instructions have 1."""

FEW = 50
"""The fewest instructions that are a function of their own."""

MAX_STACK = 65_536
"""The most bytes of places on the stack, whose size in XLA's threads is not known."""

SCRATCH = "; bytes of memory: "
LINE = 128
"""The bytes of the largest vector, to a multiple of which places are aligned."""

FRAME = {"extension": 8, "api": 16, "arguments": 72, "results": 112}
"""The offsets of fields in the description of a call, in bytes."""

API_VERSION, KIND, METADATA, METADATA_VERSION, METADATA_TRAITS, DATA = 32, 8, 24, 24, 32, 24
"""Offsets of fields: the version in the description of XLA's interface; the kind of a request, and
the metadata in a request for it; the version and the traits in the metadata; the address of the
numbers of an array."""

IS_METADATA = 1
"""The kind of a request for metadata."""


def text(
    program: Sequence[Statement],
    name: str,
    worlds: int,
    arrays: Sequence[Layout],
    results: int,
    lanes: int,
    groups: int = 1,
    local: Sequence[Local] = (),
) -> str:
    """Returns the text of a function that evaluates a program in all worlds.

    If the number of worlds is no multiple of the lanes, some worlds are evaluated twice. A further
    result is the memory that the function needs; see `scratch`.

    Args:
        program: the program of a thread.
        name: the name of the function.
        worlds: the number of worlds, at least as many as lanes of all groups.
        arrays: the layouts of all arrays.
        results: the number of arrays that are results; they are the last ones.
        lanes: the number of worlds that are evaluated together.
        groups: the number of groups of lanes for which each piece is evaluated.
        local: the local arrays.
    """
    parts = _in_pieces(program)
    places = _Places(parts)
    writer = (
        _Writer(lanes, arrays, local, places)
        if groups == 1
        else _GroupsWriter(lanes, arrays, local, places, groups, _depth(parts))
    )
    writer.start(len(arrays) - results)
    writer.worlds(parts, worlds)
    lines = [f"{SCRATCH}{writer.scratch}"]
    lines += [f"define ptr @{name}(ptr %frame) nounwind {{", "entry:", *writer.lines, "}"]
    return "\n".join([*lines, *writer.functions, *writer.declarations, ""])


def scratch(text: str) -> int:
    """Returns the bytes of memory that the function of a text needs."""
    return int(text.splitlines()[0].removeprefix(SCRATCH))


def _in_pieces(statements: Sequence[Statement]) -> list[Statement]:
    """Returns a block in which pieces take the place of instructions, also in blocks within it."""
    parts: list[Statement] = []
    for is_run, group in itertools.groupby(statements, lambda x: isinstance(x, Instruction)):
        if is_run:
            run: Any = list(group)
            weights = itertools.accumulate(WRITE if x.name in WRITES else 1 for x in run)
            pieces = itertools.groupby(zip(weights, run, strict=True), lambda x: x[0] // PIECE)
            for _, pairs in pieces:
                parts.append(Piece([x for _, x in pairs], len(run) >= FEW))
        else:
            parts += [inner(x, _in_pieces) for x in group]
    return parts


def _depth(parts: Sequence[Statement]) -> int:
    """Returns how deeply branches and loops are nested."""
    deepest = 0
    for part in parts:
        match part:
            case Branch(_, taken, others):
                deepest = max(deepest, 1 + _depth(taken), 1 + _depth(others))
            case Loop(condition, _, body):
                deepest = max(deepest, 1 + _depth(condition), 1 + _depth(body))
            case Repeat(_, _, body):
                deepest = max(deepest, _depth(body))
    return deepest


class _Places:
    """Places in memory for values that several pieces of a program use.

    Attributes:
        of: the place of each register that has one: the type, and the number among those of the
            type.
        count: the number of places of each type.
    """

    def __init__(self, program: Sequence[Statement]) -> None:
        self._position = self._piece = 0
        self._made: dict[int, tuple[int, int]] = {}  # positions and pieces of registers
        self._last: dict[int, int] = {}  # the position of the last use of each register
        self._shared: dict[int, Register] = {}
        self._loops: list[set[int]] = []  # registers that are used in each loop around the position
        self._walk(program)
        self.of: dict[int, tuple[str, int]] = {}
        self.count: dict[str, int] = {}
        self._give()

    def _walk(self, parts: Sequence[Statement]) -> None:
        """Notes where registers are made and used in a block."""
        for part in parts:
            self._piece += 1
            match part:
                case Piece(instructions):
                    for instruction in instructions:
                        self._instruction(instruction)
                case Branch(which, taken, others):
                    self._use(which)
                    self._walk(taken)
                    self._walk(others)
                case Loop(condition, goes_on, body):
                    start = self._enter()
                    self._walk(condition)
                    self._piece += 1
                    self._use(goes_on)
                    self._walk(body)
                    self._leave(start)
                case Repeat(_, _, body):
                    start = self._enter()
                    self._walk(body)
                    self._leave(start)

    def _instruction(self, instruction: Instruction) -> None:
        self._position += 1
        for x in instruction.operands:
            self._use(x)
        if instruction.name in WRITES:
            register: Any = instruction.operands[0]
            self._shared[register.number] = register
        elif instruction.result is not None:
            self._made[instruction.result.number] = self._position, self._piece

    def _use(self, x: Scalar) -> None:
        if not isinstance(x, Register):
            return
        number = x.number
        _, piece = self._made.setdefault(number, (self._position, self._piece))
        self._last[number] = self._position
        if piece != self._piece:
            self._shared[number] = x
        if self._loops:
            self._loops[-1].add(number)

    def _enter(self) -> int:
        self._loops.append(set())
        return self._position

    def _leave(self, start: int) -> None:
        """Ends a loop: what it reads from before must be kept until its last round."""
        used = self._loops.pop()
        for number in used:
            if self._made[number][0] <= start:
                self._last[number] = self._position
        if self._loops:
            self._loops[-1] |= used

    def _give(self) -> None:
        """Gives places to registers in the order in which they are made."""
        free: dict[str, list[int]] = {}
        ends: list[tuple[int, str, int]] = []
        for register in sorted(self._shared.values(), key=lambda x: self._made[x.number]):
            number, kind = register.number, TYPES[register.dtype]
            while ends and ends[0][0] < self._made[number][0]:
                _, other, place = heapq.heappop(ends)
                free[other].append(place)
            if not free.setdefault(kind, []):
                free[kind].append(self.count.get(kind, 0))
                self.count[kind] = self.count.get(kind, 0) + 1
            place = free[kind].pop()
            self.of[number] = kind, place
            heapq.heappush(ends, (self._last[number], kind, place))


class _Writer:
    """Writes the lines of a function.

    Attributes:
        lanes: the number of lanes.
        arrays: the layouts of all arrays.
        places: the places of values in memory.
        scratch: the bytes of memory that it needs besides the stack.
        lines: the lines written so far.
        functions: the lines of the pieces that are functions of their own.
        declarations: the declarations of the functions that it calls; a mapping keeps each once.
    """

    groups = 1

    def __init__(
        self, lanes: int, arrays: Sequence[Layout], local: Sequence[Local], places: _Places
    ) -> None:
        self.lanes, self.places = lanes, places
        own = [x.dtype.itemsize for x in local]
        # entries of a local array are those of all groups
        self.arrays = [*arrays, *(Layout(n, n * lanes * self.groups) for n in own)]
        self._count_given = len(arrays)
        self._types = {dtype: self._vector(kind) for dtype, kind in TYPES.items()}
        sizes = {kind: n * self._bytes(kind) for kind, n in places.count.items()}
        starts = itertools.accumulate((-(-n // LINE) * LINE for n in sizes.values()), initial=0)
        *self._starts, self._total = starts
        spans = [
            -(-x.entries * a.entry // LINE) * LINE
            for x, a in zip(local, self.arrays[len(arrays) :], strict=True)
        ]
        *self._local, self._total_local = itertools.accumulate(spans, initial=0)
        needs = self._total + self._total_local
        self.scratch = needs + LINE if local or self._total > MAX_STACK else 0
        self.lines: list[str] = []
        self.functions: list[str] = []
        self.declarations: dict[str, None] = {}
        self._count = itertools.count()
        self._block = "entry"
        self._pointers: dict[tuple[int, tuple[tuple[Counter, int], ...]], str] = {}
        self._mask: str | None = None  # the lanes that take part; None for all
        self._read: dict[int, str] = {}  # values of places, in the current piece

    def _new(self) -> str:
        return f"%w{next(self._count)}"

    def _line(self, line: str) -> None:
        self.lines.append(line)

    def _result(self, line: str) -> str:
        """Writes an instruction; returns the name of its result."""
        name = self._new()
        self.lines.append(f"{name} = {line}")
        return name

    def _label(self, label: str) -> None:
        """Begins a block."""
        self.lines.append(f"{label}:")
        self._block = label
        self._read = {}

    def _vector(self, kind: str) -> str:
        return kind if self.lanes == 1 else f"<{self.lanes} x {kind}>"

    def _bytes(self, kind: str) -> int:
        """Returns the size of a vector register of this type in memory."""
        return self.lanes * BYTES[kind] if kind in BYTES else -(-self.lanes // 8)

    def _type(self, x: Scalar) -> str:
        return self._types[x.dtype]

    def _value(self, x: Scalar) -> str:
        """Returns an operand."""
        if isinstance(x, Register):
            if x.number not in self.places.of:
                return f"%v{x.number}"
            if x.number not in self._read:
                place = self._place(x.number)
                self._read[x.number] = self._result(f"load {self._type(x)}, ptr {place}")
            return self._read[x.number]
        if x.dtype == bool:
            number = "true" if x else "false"
        elif is_float(x):  # LLVM reads floats as 64-bit numbers
            number = f"0x{int(np.float64(x).view(np.uint64)):016X}"
        else:
            number = str(int(x))
        return number if self.lanes == 1 else f"splat ({TYPES[x.dtype]} {number})"

    def _place(self, number: int) -> str:
        """Returns the address of a place."""
        kind, place = self.places.of[number]
        return self._result(f"getelementptr {self._vector(kind)}, ptr %{kind}s, i64 {place}")

    def _keep(self, register: Register, value: str) -> None:
        """Stores the value of a register, if it has a place."""
        if register.number in self.places.of:
            place = self._place(register.number)
            self._line(f"store {self._type(register)} {value}, ptr {place}")
            self._read[register.number] = value

    def start(self, arguments: int) -> None:
        """Writes the start, which answers XLA's question for metadata and finds all arrays."""
        if not self.scratch:
            for kind, count in self.places.count.items():
                every = f"[{count} x {self._vector(kind)}]"
                self._line(f"%{kind}s = alloca {every}, align {LINE}")
        extension = self._field("%frame", FRAME["extension"])
        asked = self._result(f"icmp ne ptr {extension}, null")
        self._line(f"br i1 {asked}, label %extended, label %arrays")
        self._label("extended")
        kind = self._field(extension, KIND, "i32")
        asked = self._result(f"icmp eq i32 {kind}, {IS_METADATA}")
        self._line(f"br i1 {asked}, label %metadata, label %arrays")
        self._label("metadata")
        api = self._field("%frame", FRAME["api"])
        version = self._field(api, API_VERSION, "i64")
        metadata = self._field(extension, METADATA)
        for offset, x in ((METADATA_VERSION, f"i64 {version}"), (METADATA_TRAITS, "i32 0")):
            place = self._result(f"getelementptr i8, ptr {metadata}, i64 {offset}")
            self._line(f"store {x}, ptr {place}")
        self._line("ret ptr null")
        self._label("arrays")
        lists = [self._field("%frame", FRAME[key]) for key in ("arguments", "results")]
        for k in range(self._count_given):
            of_results = k >= arguments
            place = 8 * (k - arguments if of_results else k)
            array = self._field(lists[of_results], place)
            self._pointers[k, ()] = self._field(array, DATA)
        if self.scratch:
            memory = self._field(
                self._field(lists[True], 8 * (self._count_given - arguments)), DATA
            )
            memory = self._result(f"getelementptr i8, ptr {memory}, i64 {LINE - 1}")
            self.declarations["declare ptr @llvm.ptrmask.p0.i64(ptr, i64)"] = None
            self._line(f"%places = call ptr @llvm.ptrmask.p0.i64(ptr {memory}, i64 {-LINE})")
            for kind, start in zip(self.places.count, self._starts, strict=True):
                self._line(f"%{kind}s = getelementptr i8, ptr %places, i64 {start}")
            for k, start in enumerate(self._local, self._count_given):
                offset = start + self.groups * self._total
                place = self._result(f"getelementptr i8, ptr %places, i64 {offset}")
                self._pointers[k, ()] = place

    def _field(self, pointer: str, offset: int, kind: str = "ptr") -> str:
        """Writes the reading of a field of a structure."""
        place = self._result(f"getelementptr i8, ptr {pointer}, i64 {offset}")
        return self._result(f"load {kind}, ptr {place}")

    def worlds(self, program: Sequence[Statement], worlds: int) -> None:
        """Writes a loop over all worlds. Its last round ends with the last world."""
        together = self.lanes * self.groups
        last = worlds - together
        self._line("br label %group")
        self._label("group")
        self._line("%begun = phi i64 [0, %arrays], [%next, %ended]")
        beyond = self._result(f"icmp sgt i64 %begun, {last}")
        first = self._result(f"select i1 {beyond}, i64 {last}, i64 %begun")
        if worlds % together:
            # worlds that two rounds have take part in the first one only: the second one may find
            # results in place of their arguments
            self._leave_out(self._result(f"sub i64 %begun, {first}"))
        for k, array in enumerate(self.arrays[: self._count_given]):
            if array.world:
                far = self._result(f"mul i64 {first}, {array.world}")
                start = self._pointers[k, ()]
                self._pointers[k, ()] = self._result(f"getelementptr i8, ptr {start}, i64 {far}")
        self.block(program)
        self._line("br label %ended")
        self._label("ended")
        self._line(f"%next = add i64 %begun, {together}")
        more = self._result(f"icmp slt i64 %next, {worlds}")
        self._line(f"br i1 {more}, label %group, label %end")
        self._label("end")
        self._line("ret ptr null")

    def _leave_out(self, done: str) -> None:
        """Lets the first worlds of a round take no part; `done` is their number."""
        self._mask = self._beyond(done, 0)

    def _beyond(self, done: str, group: int) -> str:
        """Returns the lanes of a group without the first worlds, of a number `done`."""
        index = self._vector("i64")
        numbers = ", ".join(f"i64 {group * self.lanes + k}" for k in range(self.lanes))
        done = self._result(f"insertelement {index} poison, i64 {done}, i32 0")
        done = self._result(self._splat(index, done))
        return self._result(f"icmp uge {index} <{numbers}>, {done}")

    def block(self, parts: Sequence[Statement]) -> None:
        """Writes the parts of a block."""
        for part in parts:
            self._read = {}
            match part:
                case Piece(apart=True):
                    self._function(part)
                case Piece(instructions):
                    self._instructions(instructions)
                case Branch():
                    self._branch(part)
                case Loop():
                    self._loop(part)
                case Repeat():
                    self._repeat(part)

    def _function(self, piece: Piece) -> None:
        """Writes a piece as a function, and its call."""
        used = {(x.address.array, x.address.moves) for x in piece.instructions if x.address}
        pointers = [
            *(f"%{kind}s" for kind in self.places.count),
            *(self._pointers[x] for x in sorted(used)),
        ]
        names = {x.name for x in piece.instructions}
        count = len(self.places.count)  # places lie apart from each other and from all arrays
        arguments = [f"ptr {'noalias ' if k < count else ''}{x}" for k, x in enumerate(pointers)]
        if self._mask and names & {"store", "assign"}:
            arguments.append(f"{self._vector('i1')} {self._mask}")
        given = ", ".join(arguments)
        name = f"@piece{next(self._count)}"
        outside, self.lines = self.lines, []
        self._instructions(piece.instructions)
        body, self.lines = self.lines, outside
        self.functions += [f"define internal void {name}({given}) noinline nounwind {{"]
        self.functions += [*body, "ret void", "}"]
        self._line(f"call void {name}({given})")
        self._read = {}

    def _instructions(self, instructions: Sequence[Instruction]) -> None:
        """Writes the instructions of a piece."""
        for instruction in instructions:
            match instruction:
                case Instruction(
                    "load" | "fetch", Register() as result, address=Address() as address
                ):
                    self._load(result, address)
                    self._keep(result, f"%v{result.number}")
                case Instruction("store", _, (x,), address=Address() as address):
                    self._store(x, address)
                case Instruction("set" | "assign" as name, _, (Register() as register, x)):
                    self._assign(register, x, keeps=name == "assign")
                case Instruction(name, Register() as result, operands):
                    value = f"%v{result.number}"
                    self._line(f"{value} = {self._operation(name, result, operands)}")
                    self._keep(result, value)

    def _any(self, mask: str) -> str:
        """Returns a bit: True if it is in any lane."""
        if self.lanes == 1:
            return mask
        bits = self._result(f"bitcast {self._vector('i1')} {mask} to i{self.lanes}")
        return self._result(f"icmp ne i{self.lanes} {bits}, 0")

    def _both(self, x: str, y: str | None) -> str:
        """Returns the lanes that are in both masks; y may be None for all."""
        if y is None or self.lanes == 1:
            return x
        return self._result(f"and {self._vector('i1')} {x}, {y}")

    def _branch(self, branch: Branch) -> None:
        label, before = f"b{next(self._count)}", self._mask
        which = self._value(branch.which)
        kind = self._vector("i1")
        inverse = self._result(f"xor {kind} {which}, {self._value(np.True_)}")
        for part, mask, body in (("", which, branch.taken), ("e", inverse, branch.others)):
            if not body:
                continue
            self._mask = self._both(mask, before)
            some = self._any(self._mask)
            self._line(f"br i1 {some}, label %{label}{part}, label %{label}{part}n")
            self._label(f"{label}{part}")
            self.block(body)
            self._line(f"br label %{label}{part}n")
            self._label(f"{label}{part}n")
        self._mask = before

    def _loop(self, loop: Loop) -> None:
        label, before, entered = f"l{next(self._count)}", self._mask, self._block
        kind, mask, active = self._vector("i1"), self._new(), self._new()
        self._line(f"br label %{label}")
        self._label(label)
        every = self._value(np.True_) if before is None else before
        self._line(f"{mask} = phi {kind} [{every}, %{entered}], [{active}, %{label}r]")
        self._mask = mask
        self.block(loop.condition)
        # in a single lane, all that is executed takes part
        goes_on, known = self._value(loop.goes_on), self._value(np.True_)
        alone = self.lanes == 1
        self._line(f"{active} = and {kind} {goes_on}, {known if alone else mask}")
        some = self._any(active)
        self._line(f"br i1 {some}, label %{label}b, label %{label}n")
        self._label(f"{label}b")
        self._mask = active
        self.block(loop.body)
        self._line(f"br label %{label}r")
        self._label(f"{label}r")
        self._line(f"br label %{label}")
        self._label(f"{label}n")
        self._mask = before

    def _repeat(self, repeat: Repeat) -> None:
        label, entered = f"r{next(self._count)}", self._block
        counter, following = self._new(), self._new()
        self._line(f"br label %{label}")
        self._label(label)
        self._line(f"{counter} = phi i64 [0, %{entered}], [{following}, %{label}r]")
        for array, _, moves in pointers_of(repeat.counter, repeat.body):
            *others, (_, entries) = moves
            stride = entries * self.arrays[array].entry
            far = self._result(f"mul i64 {counter}, {stride}")
            start = self._pointers[array, tuple(others)]
            pointer = self._result(f"getelementptr i8, ptr {start}, i64 {far}")
            self._pointers[array, moves] = pointer
        self.block(repeat.body)
        self._line(f"br label %{label}r")
        self._label(f"{label}r")
        self._line(f"{following} = add i64 {counter}, 1")
        more = self._result(f"icmp slt i64 {following}, {repeat.length}")
        self._line(f"br i1 {more}, label %{label}, label %{label}n")
        self._label(f"{label}n")

    def _address(self, address: Address) -> str:
        pointer = self._pointers[address.array, address.moves]
        offset = address.entry * self.arrays[address.array].entry
        return self._result(f"getelementptr i8, ptr {pointer}, i64 {offset}")

    def _load(self, result: Register, address: Address) -> None:
        name, kind = f"%v{result.number}", TYPES[result.dtype]
        stored = "i8" if kind == "i1" else kind
        whole, place = self._vector(stored), self._address(address)
        if not self.arrays[address.array].world and self.lanes > 1:
            one = self._result(f"load {stored}, ptr {place}")
            one = self._result(f"insertelement {whole} poison, {stored} {one}, i32 0")
            read = self._splat(whole, one)
        else:
            read = f"load {whole}, ptr {place}, align {result.dtype.itemsize}"
        if kind == "i1":
            zero = "0" if self.lanes == 1 else "zeroinitializer"
            read = f"icmp ne {whole} {self._result(read)}, {zero}"
        self._line(f"{name} = {read}")

    def _splat(self, kind: str, x: str) -> str:
        """Returns the first number of a vector in all lanes."""
        first = f"<{self.lanes} x i32> zeroinitializer"
        return f"shufflevector {kind} {x}, {kind} poison, {first}"

    def _store(self, x: Scalar, address: Address) -> None:
        kind, value, place = self._type(x), self._value(x), self._address(address)
        if x.dtype == bool:
            kind, bits = self._vector("i8"), kind
            value = self._result(f"zext {bits} {value} to {kind}")
        if self._mask is not None and self.lanes > 1:
            before = self._result(f"load {kind}, ptr {place}, align {x.dtype.itemsize}")
            value = self._selected(self._mask, kind, value, before)
        self._line(f"store {kind} {value}, ptr {place}, align {x.dtype.itemsize}")

    def _selected(self, mask: str, kind: str, x: str, y: str) -> str:
        """Returns x in the lanes of a mask, and y in the others."""
        return self._result(f"select {self._vector('i1')} {mask}, {kind} {x}, {kind} {y}")

    def _assign(self, register: Register, x: Scalar, keeps: bool) -> None:
        kind, value = self._type(register), self._value(x)
        if keeps and self._mask is not None and self.lanes > 1:
            value = self._selected(self._mask, kind, value, self._value(register))
        self._keep(register, value)

    def _operation(self, name: str, result: Register, operands: Sequence[Scalar]) -> str:
        """Returns an operation on numbers."""
        x, kind = operands[0], self._type(operands[0])
        floats, values = is_float(x), list(map(self._value, operands))
        pair = ", ".join(values[:2])
        unsigned = x.dtype.kind == "u"
        match name:
            case "add" | "sub" | "mul" | "div" if floats:
                return f"f{name} contract {kind} {pair}"
            case "select":
                _, x, _ = operands
                which, *cases = values
                typed = ", ".join(f"{self._type(x)} {y}" for y in cases)
                return f"select {kind} {which}, {typed}"
            case "convert":
                return self._conversion(result, x, values[0])
            case "bits":
                return f"bitcast {kind} {values[0]} to {self._type(result)}"
            case "eq" | "ne" | "lt" | "le" | "gt" | "ge" if floats:
                return f"fcmp {FLOAT_COMPARISONS[name]} {kind} {pair}"
            case "eq" | "ne":
                return f"icmp {name} {kind} {pair}"
            case "lt" | "le" | "gt" | "ge":
                return f"icmp {'u' if unsigned else 's'}{name} {kind} {pair}"
            case "unordered":
                return f"fcmp uno {kind} {pair}"
            case "finite":
                if not floats:
                    return f"icmp eq {kind} {values[0]}, {values[0]}"
                size = self._result(self._call("fabs", kind, values))
                return f"fcmp one {kind} {size}, {self._value(x.dtype.type(np.inf))}"
            case "max" | "min":
                return self._extremum(name, operands)
            case "not":
                ones = np.True_ if x.dtype == bool else x.dtype.type(-1)
                return f"xor {kind} {values[0]}, {self._value(ones)}"
            case "neg" if floats:
                return f"fneg {kind} {values[0]}"
            case "neg":
                return f"sub {kind} {self._value(x.dtype.type(0))}, {values[0]}"
            case "abs" if not floats:
                return self._call("abs", kind, values, "i1 false")
            case "div" | "rem":
                return f"{'u' if unsigned else 's'}{name} {kind} {pair}"
        if name in FUNCTIONS:
            return self._call(FUNCTIONS[name], kind, values)
        return f"{INTEGERS[name]} {kind} {pair}"

    def _call(
        self, name: str, kind: str, values: Sequence[str], *others: str, result: str | None = None
    ) -> str:
        """Returns the call of a function of LLVM's.

        Args:
            name: its name.
            kind: the type of its operands.
            values: these operands.
            others: operands of other types.
            result: the type of its result; None for `kind`.
        """
        result = result or kind
        suffixes = (
            [self._suffix(result)] if result == kind else [self._suffix(result), self._suffix(kind)]
        )
        function = f"@llvm.{name}.{'.'.join(suffixes)}"
        types = [*(kind for _ in values), *(x.split()[0] for x in others)]
        self.declarations[f"declare {result} {function}({', '.join(types)})"] = None
        given = ", ".join([*(f"{kind} {x}" for x in values), *others])
        flags = "contract " if SUFFIXES.get(result.split()[-1].rstrip(">")) else ""
        return f"call {flags}{result} {function}({given})"

    def _suffix(self, kind: str) -> str:
        """Returns how the names of functions call a type."""
        single = kind.split()[-1].rstrip(">")
        name = SUFFIXES.get(single, single)
        return name if self.lanes == 1 else f"v{self.lanes}{name}"

    def _extremum(self, name: str, operands: Sequence[Scalar]) -> str:
        """Returns max or min, which is NaN if an operand is."""
        x, y = operands
        kind, mask = self._type(x), self._vector("i1")
        if not is_float(x):
            sign = "u" if x.dtype.kind == "u" else "s"
            return self._call(f"{sign}{name}", kind, [self._value(x), self._value(y)])
        if not isinstance(y, Register):
            x, y = y, x
        first, second = self._value(x), self._value(y)
        how = "ogt" if name == "max" else "olt"
        # the second one if one of them is NaN
        wins = self._result(f"fcmp {how} {kind} {first}, {second}")
        larger = f"select {mask} {wins}, {kind} {first}, {kind} {second}"
        if not isinstance(x, Register) and not np.isnan(x):
            return larger
        larger, bad = self._result(larger), self._result(f"fcmp uno {kind} {first}, {first}")
        return f"select {mask} {bad}, {kind} {first}, {kind} {larger}"

    def _conversion(self, result: Register, x: Scalar, value: str) -> str:
        """Returns the conversion of a number to another dtype."""
        old, new = self._type(x), self._type(result)
        unsigned = (result if is_float(x) else x).dtype.kind == "u"
        if is_float(x) and is_float(result):
            wider = result.dtype.itemsize > x.dtype.itemsize
            return f"{'fpext' if wider else 'fptrunc'} {old} {value} to {new}"
        if is_float(x):
            sign = "u" if unsigned else "s"
            return self._call(f"fpto{sign}i.sat", old, [value], result=new)
        if is_float(result):
            return f"{'ui' if unsigned else 'si'}tofp {old} {value} to {new}"
        if result.dtype.itemsize == x.dtype.itemsize:
            return f"bitcast {old} {value} to {new}"
        if result.dtype.itemsize < x.dtype.itemsize:
            return f"trunc {old} {value} to {new}"
        return f"{'z' if unsigned else 's'}ext {old} {value} to {new}"


MASK = 8
"""The bytes in memory of the mask of a group: enough for 64 lanes."""


class _GroupsWriter(_Writer):
    """Writes a function that evaluates each piece for several groups of lanes.

    A group has places of its own for values, and masks of its own, which lie in memory.

    Attributes:
        groups: the number of groups.
    """

    def __init__(
        self,
        lanes: int,
        arrays: Sequence[Layout],
        local: Sequence[Local],
        places: _Places,
        groups: int,
        depth: int,
    ) -> None:
        self.groups = groups
        super().__init__(lanes, arrays, local, places)
        masks = groups * (1 + depth) * MASK
        self.scratch = groups * self._total + self._total_local + masks + LINE
        self._depth: int | None = None  # of the masks of the lanes that take part; None for all
        self._nested = 0  # branches and loops around the current place

    def start(self, arguments: int) -> None:
        super().start(arguments)
        every = self.groups * self._total + self._total_local
        self._line(f"%masks = getelementptr i8, ptr %places, i64 {every}")

    def _mask_place(self, depth: int, group: int) -> str:
        """Returns the address of the mask of a group."""
        offset = (depth * self.groups + group) * MASK
        return self._result(f"getelementptr i8, ptr %masks, i64 {offset}")

    def _set_masks(self, depth: int, masks: Sequence[str]) -> None:
        for group, mask in enumerate(masks):
            place = self._mask_place(depth, group)
            self._line(f"store {self._vector('i1')} {mask}, ptr {place}")

    def _masks(self) -> list[str]:
        """Returns the lanes of each group that take part."""
        if self._depth is None:
            return [self._value(np.True_)] * self.groups
        places = [self._mask_place(self._depth, group) for group in range(self.groups)]
        return [self._result(f"load {self._vector('i1')}, ptr {place}") for place in places]

    def _in_groups(self, flag: Scalar) -> list[str]:
        """Returns a predicate in each group."""
        if not isinstance(flag, Register):
            return [self._value(flag)] * self.groups
        kind, values = self._vector("i1"), []
        for group in range(self.groups):
            place, offset = self._place(flag.number), group * self._total
            place = self._result(f"getelementptr i8, ptr {place}, i64 {offset}")
            values.append(self._result(f"load {kind}, ptr {place}"))
        return values

    def _each(self, operation: str, x: Sequence[str], y: Sequence[str]) -> list[str]:
        """Returns the combination of the masks of each group."""
        kind = self._vector("i1")
        return [self._result(f"{operation} {kind} {a}, {b}") for a, b in zip(x, y, strict=True)]

    def _somewhere(self, masks: Sequence[str]) -> str:
        """Returns a bit: True if a lane of any group is in its mask."""
        every = masks[0]
        for mask in masks[1:]:
            every = self._result(f"or {self._vector('i1')} {every}, {mask}")
        return self._any(every)

    def _leave_out(self, done: str) -> None:
        self._set_masks(0, [self._beyond(done, group) for group in range(self.groups)])
        self._depth = 0

    def block(self, parts: Sequence[Statement]) -> None:
        super().block([x._replace(apart=True) if isinstance(x, Piece) else x for x in parts])

    def _function(self, piece: Piece) -> None:
        used = sorted({(x.address.array, x.address.moves) for x in piece.instructions if x.address})
        kinds = list(self.places.count)
        given = [*(f"%{kind}s" for kind in kinds), *(self._pointers[x] for x in used)]
        names = [f"%{kind}s.all" for kind in kinds] + [f"%a{k}" for k in range(len(used))]
        if self._depth is not None:
            given.append(self._mask_place(self._depth, 0))
            names.append("%masks")
        name = f"@piece{next(self._count)}"
        outside = self.lines, self._pointers, self._block
        self.lines, self._pointers = [], dict(self._pointers)
        if self._depth is not None:
            far = self._result(f"mul i64 %group, {MASK}")
            place = self._result(f"getelementptr i8, ptr %masks, i64 {far}")
            self._mask = self._result(f"load {self._vector('i1')}, ptr {place}")
            self._line(f"br i1 {self._any(self._mask)}, label %begin, label %end")
            self._label("begin")
        far = self._result(f"mul i64 %group, {self._total}")
        for kind in kinds:
            self._line(f"%{kind}s = getelementptr i8, ptr %{kind}s.all, i64 {far}")
        for k, key in enumerate(used):
            far = self._result(f"mul i64 %group, {self.lanes * self.arrays[key[0]].world}")
            self._pointers[key] = self._result(f"getelementptr i8, ptr %a{k}, i64 {far}")
        self._instructions(piece.instructions)
        body, (self.lines, self._pointers, self._block) = self.lines, outside
        self._mask, self._read = None, {}
        types = [f"ptr {'noalias ' if k < len(kinds) else ''}{x}" for k, x in enumerate(names)]
        types.append("i64 %group")
        self.functions += [f"define internal void {name}({', '.join(types)}) noinline nounwind {{"]
        self.functions += [*body, "br label %end", "end:", "ret void", "}"]
        for group in range(self.groups):
            self._line(f"call void {name}({', '.join(f'ptr {x}' for x in given)}, i64 {group})")

    def _branch(self, branch: Branch) -> None:
        label, before = f"b{next(self._count)}", self._depth
        self._nested += 1
        # read before the branch, within which the place of the predicate may have another value
        which = self._in_groups(branch.which)
        inverse = self._each("xor", which, [self._value(np.True_)] * self.groups)
        for part, flags, body in (("", which, branch.taken), ("e", inverse, branch.others)):
            if not body:
                continue
            self._depth = before
            masks = flags if before is None else self._each("and", flags, self._masks())
            self._set_masks(self._nested, masks)
            some = self._somewhere(masks)
            self._line(f"br i1 {some}, label %{label}{part}, label %{label}{part}n")
            self._label(f"{label}{part}")
            self._depth = self._nested
            self.block(body)
            self._line(f"br label %{label}{part}n")
            self._label(f"{label}{part}n")
        self._depth = before
        self._nested -= 1

    def _loop(self, loop: Loop) -> None:
        label, before = f"l{next(self._count)}", self._depth
        self._nested += 1
        self._set_masks(self._nested, self._masks())
        self._depth = self._nested
        self._line(f"br label %{label}")
        self._label(label)
        self.block(loop.condition)
        active = self._each("and", self._in_groups(loop.goes_on), self._masks())
        self._set_masks(self._nested, active)
        some = self._somewhere(active)
        self._line(f"br i1 {some}, label %{label}b, label %{label}n")
        self._label(f"{label}b")
        self.block(loop.body)
        self._line(f"br label %{label}")
        self._label(f"{label}n")
        self._depth = before
        self._nested -= 1
