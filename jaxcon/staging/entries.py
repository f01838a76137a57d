"""Evaluates a program entry by entry, as the instructions of a thread.

An array becomes an object array of scalars. Operations that move entries, such as slices and
transposes, move these objects and write no instructions. All other operations write the
instructions of each entry of their results.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Var

from jaxcon.core.host import ELEMENTWISE, STRUCTURAL
from jaxcon.core.jaxprs import read_arguments
from jaxcon.staging import matrices
from jaxcon.staging.constants import MOVES
from jaxcon.staging.elementary import FUNCTIONS, rounded
from jaxcon.staging.program import Constant, Operand, Operation, Program
from jaxcon.staging.thread import (
    INSTRUCTIONS,
    Address,
    Counter,
    Register,
    Scalar,
    Thread,
    UnsupportedError,
)

Entries = np.ndarray[Any, np.dtype[np.object_]]
"""An array of scalars."""

PAIRS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_and": "and"}
PAIRS |= {"reduce_or": "or", "reduce_prod": "mul"}
"""The operation on two entries by which each reduction combines them."""

ELEMENTARY = {*INSTRUCTIONS, *FUNCTIONS, *ELEMENTWISE}
ELEMENTARY |= {"bitcast_convert_type", "convert_element_type", "integer_pow", "round", "select_n"}
"""Elementwise primitives. Some of them are only evaluated if all operands are known."""

PLACINGS = ("mesh_cast", "pvary", "reshard", "sharding_constraint")
"""Primitives that only say on which devices an array lies."""

MAX_ROUNDS = 64
"""The largest number of rounds of a loop that is written round by round."""

MAX_UNROLLED = 30_000
"""The largest number of instructions of such a loop, if it can be written as a loop."""

MAX_UNROLLED_HELD = 100_000
"""`MAX_UNROLLED` of a loop whose written rows are read later, and are held in registers."""

MAX_ITERATED = 1000
"""The largest number of instructions of an unrolled loop whose rounds are all alike.

Such a loop reads and writes no rows and counts no rounds, so that unrolling makes nothing known.
"""

MAX_CHOSEN = 64
"""The largest number of entries that are not in memory, of which each round of a loop reads a row.

The row is chosen by its index among all rows.
"""

MAX_HELD = 4096
"""The largest number of entries that all rounds of a loop write to registers."""

MAX_SORTED = 32
"""The largest number of entries that are sorted."""

MAX_LOADS = 4096
"""The largest number of entries of an array in memory that are read outside of loops."""

MAX_WORK = 10**8
"""The largest number of instructions of all loops, over all rounds: about half a second.

A GPU that also shows a screen stops kernels that run for seconds. Rounds of loops that end under a
condition are not counted, since their number is not known.
"""


class Stored:
    """An array in memory, whose entries are read where they are needed.

    Attributes:
        shape, dtype: those of the array.
        local: True for a local array.
    """

    def __init__(
        self,
        thread: Thread,
        first: Address,
        shape: tuple[int, ...],
        dtype: Any,
        local: bool = False,
    ) -> None:
        """Names an array in memory.

        Args:
            thread: the thread that reads or writes it.
            first: the address of its first entry.
            shape: its shape.
            dtype: its dtype.
            local: True for a local array.
        """
        self.thread, self.first, self.local = thread, first, local
        self.shape, self.dtype = tuple(shape), np.dtype(dtype)

    def address(self, entry: int) -> Address:
        """Returns the address of an entry, by its number in the flat array."""
        return self.first._replace(entry=self.first.entry + entry)

    @functools.cached_property
    def entries(self) -> Entries:
        """All entries, which are read once."""
        if math.prod(self.shape) > MAX_LOADS:
            raise UnsupportedError(f"an array of shape {self.shape} outside of a loop")
        result = np.empty(self.shape, object)
        read = self.thread.fetch if self.local else self.thread.load
        for entry, place in enumerate(np.ndindex(self.shape)):
            result[place] = read(self.address(entry), self.dtype)
        return result

    def write(self, values: Entries) -> None:
        """Writes all entries."""
        for entry, number in enumerate(values.ravel()):
            self.thread.store(self.address(entry), number)

    def reshaped(self, shape: tuple[int, ...]) -> Stored:
        """Returns the array in another shape."""
        return Stored(self.thread, self.first, shape, self.dtype, self.local)

    def row(self, index: int | Counter, backward: bool = False) -> Stored:
        """Returns the slice at an index of the first axis, which may be the round of a loop.

        Args:
            index: the index.
            backward: True if the first round of the loop has the last slice.
        """
        size, first = math.prod(self.shape[1:]), self.first
        if isinstance(index, Counter):
            step, start = (-size, (self.shape[0] - 1) * size) if backward else (size, 0)
            moves = (*first.moves, (index, step))
            first = first._replace(entry=first.entry + start, moves=moves)
        else:
            first = first._replace(entry=first.entry + index * size)
        return Stored(self.thread, first, self.shape[1:], self.dtype, self.local)


class _Nowhere:
    """Takes the place of an array in memory for a result that nothing reads."""

    def row(self, index: int | Counter, backward: bool = False) -> _Nowhere:
        """Returns itself."""
        return self

    def write(self, values: Entries) -> None:
        """Writes nothing."""


NOWHERE = _Nowhere()


class Body(NamedTuple):
    """The body of a loop or a branch.

    Attributes:
        closed: the jaxpr.
        constants: for each of its first arguments, the constant that takes its place, or None.
    """

    closed: ClosedJaxpr
    constants: Sequence[Constant | None]


def _body(closed: ClosedJaxpr, constants: Sequence[Constant | None]) -> Any:
    """Keeps a body as it is; `Program` asks for this function."""
    return Body(closed, constants), True


class Evaluation:
    """The evaluation of programs by one thread."""

    def __init__(self, thread: Thread, max_places: int, max_local: int = 0) -> None:
        """Begins an evaluation.

        Args:
            thread: the thread.
            max_places: the largest number of places of a slice at an index that is not known,
                within a loop that is not written round by round.
            max_local: the largest number of entries of all local arrays.
        """
        self.thread, self._max_places, self._max_local = thread, max_places, max_local
        # where the results of a loop go, by the number of the value in the outermost program
        self._sinks: dict[int, Stored | _Nowhere] = {}
        self._repeating = False  # within a loop of a known number of rounds
        self._extra = 0  # instructions of loops, beyond their first round
        self._programs: dict[int, tuple[Body, Program]] = {}

    def store(
        self, closed: ClosedJaxpr, args: Sequence[Stored], results: Sequence[Stored], streams: bool
    ) -> None:
        """Evaluates a jaxpr of arrays in memory, and writes its results to memory.

        Args:
            closed: the jaxpr.
            args: its arguments.
            results: where to write its results.
            streams: True if loops may write rows of the results. The memory of results must then
                not be that of arguments.
        """
        program = Program(closed, _body)
        if streams:
            read = program.readers()
            for x in (x for operation in program.operations for x in operation.outputs):
                if x not in read and x not in program.outputs:
                    self._sinks[x] = NOWHERE
            for x, place in zip(program.outputs, results, strict=True):
                if isinstance(x, int) and x not in read and program.outputs.count(x) == 1:
                    self._sinks[x] = place
        pairs = zip(self._run(program, args), results, strict=True)
        # a loop has written the results that are where they belong
        values = [(_read(x), place) for x, place in pairs if x is not place]
        for x, place in values:
            place.write(x)

    def __call__(self, body: Body, args: Sequence[Any]) -> list[Any]:
        """Evaluates the body of a loop or a branch.

        Args:
            body: the body.
            args: object arrays of scalars or arrays in memory, without those that are constants.

        Returns:
            The results, as object arrays.

        Raises:
            UnsupportedError: the thread has no instructions for an operation.
        """
        if id(body) not in self._programs:
            self._programs[id(body)] = body, Program(body.closed, _body, body.constants)
        sinks, self._sinks = self._sinks, {}
        try:
            results = self._run(self._programs[id(body)][1], args)
        finally:
            self._sinks = sinks
        return list(map(_read, results))

    def _run(self, program: Program, args: Sequence[Any]) -> list[Any]:
        """Evaluates a program; its results may be arrays in memory."""
        values: dict[int, Any] = dict(zip(program.inputs, args, strict=True))

        def read(x: Operand) -> Any:
            return entries(x.value) if isinstance(x, Constant) else values[x]

        for operation in program.operations:
            results = self._apply(operation, list(map(read, operation.inputs)))
            values.update(zip(operation.outputs, results, strict=True))
        return list(map(read, program.outputs))

    def _apply(self, operation: Operation, operands: list[Any]) -> Sequence[Any]:
        """Writes an operation; returns its results."""
        name, params = operation.name, operation.params
        if operation.effects:
            raise UnsupportedError(f"{name}, which has side effects")
        if name == "reshape" and isinstance(operands[0], Stored) and params["dimensions"] is None:
            return [operands[0].reshaped(params["new_sizes"])]
        if name == "scan":
            return self._scan(params, operands, [self._sinks.get(x) for x in operation.outputs])
        operands = list(map(_read, operands))
        if name in OTHERS:
            return OTHERS[name](self, params, operands)
        if name in MOVES:
            return [STRUCTURAL[name](params, *operands)]
        if name not in ELEMENTARY:
            raise UnsupportedError(name)
        return [self._each(name, params, operands)]

    def _each(self, name: str, params: Mapping[str, Any], operands: Sequence[Entries]) -> Entries:
        """Writes an elementwise operation on all entries; returns its result."""
        shape = operands[0].shape
        if all(x.size == 1 and x.shape == shape for x in operands):  # most operations of a step
            result = np.empty(shape, object)
            result[...] = self._one(name, params, *(x.item() for x in operands))
            return result
        shape = np.broadcast_shapes(*(x.shape for x in operands))
        given = [x if x.shape == shape else np.broadcast_to(x, shape) for x in operands]
        result = np.empty(math.prod(shape), object)
        for i, numbers in enumerate(zip(*(x.ravel() for x in given), strict=True)):
            result[i] = self._one(name, params, *numbers)
        return result.reshape(shape)

    def _one(self, name: str, params: Mapping[str, Any], *operands: Any) -> Any:
        """Writes an elementwise operation on single entries; returns its result."""
        thread = self.thread
        if name == "select_n":
            if len(operands) != 3 or operands[0].dtype != bool:
                raise UnsupportedError("a selection among more than two cases")
            return thread.select(operands[0], operands[2], operands[1])
        if name == "convert_element_type":
            return thread.convert(operands[0], params["new_dtype"])
        if name == "bitcast_convert_type":
            dtype = np.dtype(params["new_dtype"])
            if dtype.itemsize != operands[0].dtype.itemsize or "b" in dtype.kind:
                raise UnsupportedError("the bits of a number of another size")
            return thread.bits(operands[0], dtype)
        if name == "integer_pow":
            return _power(thread, operands[0], params["y"])
        if name == "round":
            even = params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
            return rounded(thread, operands[0], even)
        if name in FUNCTIONS and any(isinstance(x, Register) for x in operands):
            return FUNCTIONS[name](thread, *operands)
        return thread.apply(name, *operands)

    def _combine(self, name: str, numbers: Iterable[Any]) -> Any:
        """Combines numbers in pairs, then the results, until one is left."""
        left = list(numbers)
        while len(left) > 1:
            pairs = itertools.zip_longest(left[::2], left[1::2])
            left = [a if b is None else self.thread.apply(name, a, b) for a, b in pairs]
        return left[0]

    def _reduce(self, name: str, params: Mapping[str, Any], x: Entries) -> Entries:
        """Writes a reduction."""
        axes = params["axes"]
        others = [a for a in range(x.ndim) if a not in axes]
        shape = tuple(x.shape[a] for a in others)
        rows = np.transpose(x, [*others, *axes]).reshape(*shape, -1)
        if rows.shape[-1] == 0:
            raise UnsupportedError(f"{name} of no entries")
        result = np.empty(shape, object)
        for i in np.ndindex(shape):
            result[i] = self._combine(PAIRS[name], rows[i])
        return result

    def _dot(self, params: Mapping[str, Any], x: Entries, y: Entries) -> Entries:
        """Writes a product of arrays, as `lax.dot_general`."""
        if x.size and y.size and x.flat[0].dtype != y.flat[0].dtype:
            raise UnsupportedError("a product of different dtypes")
        (left, right), (first, second) = params["dimension_numbers"]
        rows, columns = _contracted(x, left, first), _contracted(y, right, second)
        batch, dtype = len(first), params.get("preferred_element_type")
        free = rows.ndim - 1
        result = np.empty((*rows.shape[:-1], *columns.shape[batch:-1]), object)
        for place in np.ndindex(result.shape):
            pairs: Any = zip(rows[place[:free]], columns[place[:batch] + place[free:]], strict=True)
            terms = [self.thread.apply("mul", a, b) for a, b in pairs]
            if not terms:
                raise UnsupportedError("a product of no entries")
            total: Any = self._combine("add", terms)
            result[place] = total if dtype is None else self.thread.convert(total, dtype)
        return result

    def _somewhere(self, flags: Entries) -> Entries:
        """Writes `somewhere`: a thread is a batch of one world, and combines its own flags."""
        return _scalar(self._combine("or", flags.ravel()))

    def _cond(self, params: Mapping[str, Any], operands: list[Entries]) -> list[Entries]:
        """Writes a conditional of two branches."""
        branches: tuple[Body, ...] = params["branches"]
        which: Any = operands[0][()]
        given = operands[1:]
        if isinstance(which, np.generic):
            return self(branches[min(max(int(which), 0), len(branches) - 1)], given)
        if len(branches) != 2:
            raise UnsupportedError("a conditional of more than two branches")
        taken: Any = self.thread.convert(which, bool)
        shapes: list[tuple[int, ...]] = []

        def write(body: Body) -> Callable[[], list[Scalar]]:
            def written() -> list[Scalar]:
                results = self(body, given)
                shapes[:] = [x.shape for x in results]
                return _flat(results)

            return written

        results = self.thread.branch(taken, write(branches[1]), write(branches[0]))
        return _unflattened(results, shapes)

    def _while(self, params: Mapping[str, Any], operands: list[Entries]) -> list[Entries]:
        """Writes a loop with a condition."""
        first = params["cond_nconsts"]
        last = first + params["body_nconsts"]
        outside, inside, start = operands[:first], operands[first:last], operands[last:]
        condition = self._once(params, "cond_jaxpr")
        body: Body = params["body_jaxpr"]
        shapes = [x.shape for x in start]

        flags: Any = None

        def goes_on(carried: Sequence[Scalar]) -> Any:
            nonlocal flags
            (flags,) = self(condition, [*outside, *_unflattened(carried, shapes)])
            return self._combine("or", flags.ravel())

        def run(carried: Sequence[Scalar]) -> list[Scalar]:
            before = _unflattened(carried, shapes)
            after = self(body, [*inside, *before])
            if flags.ndim:  # a batched loop: the rows whose flag is False are done
                pairs = zip(before, after, strict=True)
                after = [self._each("select_n", {}, [_led(flags, x), x, y]) for x, y in pairs]
            return _flat(after)

        return _unflattened(self.thread.loop(goes_on, run, _flat(start)), shapes)

    def _once(self, params: Mapping[str, Any], key: str) -> Body:
        """Returns a jaxpr in the parameters of an operation as a body without constants."""
        value = params[key]
        return value if isinstance(value, Body) else Body(value, ())

    def _scan(
        self, params: Mapping[str, Any], operands: list[Any], sinks: Sequence[Any]
    ) -> list[Any]:
        """Writes a loop of a known number of rounds.

        Args:
            params: the parameters of the scan.
            operands: its operands.
            sinks: where each of its results goes, if it is a result of the whole program.
        """
        constants, carries = _sizes(params)
        length, body = params["length"], self._once(params, "jaxpr")
        used = read_arguments(body.closed.jaxpr)
        fixed, rows = operands[:constants], operands[constants + carries :]
        fixed = list(map(_read, fixed))
        carried = list(map(_read, operands[constants : constants + carries]))
        rows = [
            x if flag else None for x, flag in zip(rows, used[constants + carries :], strict=True)
        ]
        places = sinks[carries:]
        held = [
            math.prod(x.aval.shape)
            for x, place in zip(body.closed.jaxpr.outvars[carries:], places, strict=True)
            if not place
        ]
        backward = params["reverse"]
        in_registers = self._fit(rows) and length * sum(held) <= MAX_HELD and not backward
        chosen = sum(x.size for x in rows if isinstance(x, np.ndarray))
        room = self._max_local - sum(x.entries for x in self.thread.local)
        spills = not in_registers and chosen + length * sum(held) <= room
        repeats = length > 1 and (in_registers or spills)
        if length > MAX_ROUNDS and repeats and not held:
            return self._repeat(body, fixed, carried, rows, places, length, spills, backward)
        if not 0 < length <= MAX_ROUNDS:
            raise UnsupportedError(f"a loop of {length} rounds over the rows of an array")
        same = not any(x is not None for x in rows) and not places and not _counts(body, constants)
        limit = MAX_UNROLLED_HELD if held and not spills else MAX_UNROLLED
        limit = MAX_ITERATED if same else limit
        kinds = [x.aval for x in body.closed.jaxpr.invars[constants + carries :]]
        results: list[list[Entries]] = []

        def one(k: int) -> list[Entries]:
            given = [_row(x, k, aval) for x, aval in zip(rows, kinds, strict=True)]
            return self(body, [*fixed, *carried, *given])

        order = range(length)[:: -1 if backward else 1]
        for k in order:
            # indices that count rounds are known numbers if the loop is written round by round
            most = limit // length if repeats and k == order[0] else None
            extra = self._extra
            both = self.thread.tried(lambda k=k: one(k), most)
            if both is None:
                self._extra = extra
                return self._repeat(body, fixed, carried, rows, places, length, spills, backward)
            carried = both[:carries]
            results.append(both[carries:])
        if backward:
            results.reverse()
        return [*carried, *(np.stack(x) for x in zip(*results, strict=True))]

    def _repeat(
        self,
        body: Body,
        fixed: list[Entries],
        start: list[Entries],
        rows: Sequence[Stored | Entries | None],
        places: Sequence[Any],
        length: int,
        spills: bool,
        backward: bool,
    ) -> list[Any]:
        """Writes a loop that runs a body `length` times on carried values.

        Args:
            body: the body.
            fixed: its first arguments, the same in all rounds.
            start: the carried values at the start.
            rows: arrays of which each round reads a row; None if the body does not read it.
            places: arrays of which each round writes a row; None for rows that are held in
                registers, or in local arrays.
            length: the number of rounds.
            spills: True if rows that are not in memory are moved to local arrays.
            backward: True if rounds go from the last row to the first one.
        """
        kinds = [x.aval for x in body.closed.jaxpr.invars[len(fixed) + len(start) :]]
        written = [x.aval for x in body.closed.jaxpr.outvars[len(start) :]]
        if spills:
            rows = [
                self._spilled(x, aval.dtype) if isinstance(x, np.ndarray) else x
                for x, aval in zip(rows, kinds, strict=True)
            ]
            places = [
                place or self._local((length, *x.shape), x.dtype)
                for x, place in zip(written, places, strict=True)
            ]
        before = self.thread.length + self._extra
        held = [
            entries(np.zeros((length, *x.shape), x.dtype))
            for x, place in zip(written, places, strict=True)
            if not place
        ]
        carried = [*start, *held]
        shapes = [x.shape for x in carried]
        # a register that counts the rounds, if one of them reads or writes a row of registers
        counts = bool(held) or any(isinstance(x, np.ndarray) for x in rows)
        count = [np.int32(0)] if counts else []

        def run(counter: Counter, carried: Sequence[Scalar]) -> list[Scalar]:
            index, numbers = carried[: len(count)], carried[len(count) :]
            given = [
                self._chosen(x, index[0])
                if isinstance(x, np.ndarray)
                else _row(x, counter, aval, backward)
                for x, aval in zip(rows, kinds, strict=True)
            ]
            arrays = _unflattened(numbers, shapes)
            results = self(body, [*fixed, *arrays[: len(start)], *given])
            kept = iter(arrays[len(start) :])
            following = results[: len(start)]
            for x, place in zip(results[len(start) :], places, strict=True):
                if place:
                    place.row(counter, backward).write(x)
                else:
                    following.append(self._with_row(next(kept), x, index[0]))
            return [*(self.thread.apply("add", x, np.int32(1)) for x in index), *_flat(following)]

        outside, self._repeating = self._repeating, True
        try:
            final = self.thread.repeat(length, run, [*count, *_flat(carried)])[len(count) :]
        finally:
            self._repeating = outside
        self._extra += (self.thread.length + self._extra - before) * (length - 1)
        if self._extra > MAX_WORK:
            raise UnsupportedError(f"a loop of {length} rounds, which would take too long")
        arrays = _unflattened(final, shapes)
        kept = iter(arrays[len(start) :])
        return [*arrays[: len(start)], *(place or next(kept) for place in places)]

    def _local(self, shape: tuple[int, ...], dtype: Any) -> Stored:
        """Returns a new local array."""
        first = self.thread.allocate(math.prod(shape), dtype)
        return Stored(self.thread, first, shape, dtype, local=True)

    def _spilled(self, x: Entries, dtype: Any) -> Stored:
        """Writes an array to a new local array, and returns that."""
        result = self._local(x.shape, dtype)
        result.write(x)
        return result

    def _with_row(self, rows: Entries, x: Entries, index: Any) -> Entries:
        """Writes the replacement of the row at an index by x."""
        result = rows.copy()
        new: Any = x
        for k in range(len(rows)):
            here = self.thread.apply("eq", index, np.int32(k))
            for i in np.ndindex(x.shape):
                result[(k, *i)] = self.thread.select(here, new[i], result[(k, *i)])
        return result

    def _fit(self, rows: Sequence[Any]) -> bool:
        """Returns whether each round of a loop can read its rows of these arrays."""
        chosen = [x for x in rows if isinstance(x, np.ndarray)]
        few = sum(x.size for x in chosen) <= MAX_CHOSEN
        return few and all(len(x) <= self._max_places for x in chosen)

    def _chosen(self, x: Entries, index: Any) -> Entries:
        """Writes the choice of a row of an array at an index."""
        starts = [index, *[np.int32(0)] * (x.ndim - 1)]
        return self._slice(x, starts, (1, *x.shape[1:]), None).squeeze(0)

    def _index(
        self, starts: Sequence[Any], sizes: Sequence[int], shape: tuple[int, ...], clamps: bool
    ) -> Any:
        """Returns, for a slice that starts at given indices, each possible start and its flag.

        Args:
            starts: the indices of the first entry.
            sizes: the shape of the slice.
            shape: the shape of the array.
            clamps: True to move a slice beyond the array to the nearest place within. Otherwise it
                has no place.

        Returns:
            Pairs of a start and a flag, which is `np.True_` if the place is certain. One flag
            holds if `clamps` is True, otherwise one at most.

        Raises:
            UnsupportedError: there are too many places.
        """
        limits = [n - size for n, size in zip(shape, sizes, strict=True)]
        axes: list[list[tuple[int, Any]]] = []
        for index, most in zip(starts, limits, strict=True):
            if isinstance(index, np.generic) or (clamps and not most):
                known = int(index) if isinstance(index, np.generic) else 0
                inside = min(max(known, 0), most)
                axes.append([(inside, np.True_)] if clamps or inside == known else [])
                continue
            self._check_places(most + 1)
            pairs = []
            for k in range(most + 1):
                # a start beyond the array moves to the nearest one within
                name = "eq" if not clamps else "le" if k == 0 else "ge" if k == most else "eq"
                pairs.append((k, self.thread.apply(name, index, index.dtype.type(k))))
            axes.append(pairs)
        count = math.prod(map(len, axes))
        if count > 1:
            self._check_places(count * (1 if self._repeating else math.prod(sizes)))
        places = []
        for each in itertools.product(*axes):
            flags = [flag for _, flag in each if isinstance(flag, Register)]
            flag = self._combine("and", flags) if flags else np.True_
            places.append((tuple(k for k, _ in each), flag))
        return places

    def _check_places(self, count: int) -> None:
        """Raises an UnsupportedError if a slice at a traced index has too many places."""
        if count > (self._max_places if self._repeating else MAX_LOADS):
            raise UnsupportedError(f"a slice at one of {count} places")

    def _slice(
        self, x: Entries, starts: Sequence[Any], sizes: Sequence[int], other: np.generic | None
    ) -> Entries:
        """Writes a slice, as selections among all possible ones if an index is traced.

        Args:
            x: the array.
            starts: the indices of the first entry of the slice.
            sizes: the shape of the slice.
            other: the number that a slice beyond the array has instead. With None it is moved to
                the nearest place within.
        """
        result: Any = None if other is None else entries(np.full(sizes, other))
        for start, flag in self._index(starts, sizes, x.shape, clamps=other is None):
            part = x[_window(start, sizes)]
            result = (
                part
                if result is None
                else self._each("select_n", {}, [_scalar(flag), result, part])
            )
        return result

    def _update(
        self, x: Entries, starts: Sequence[Any], sizes: Sequence[int], clamps: bool, new: Any
    ) -> None:
        """Writes a change of a slice in place.

        Args:
            x: the array.
            starts: the indices of the first entry of the slice.
            sizes: the shape of the slice.
            clamps: see `_index`.
            new: function of the slice → the new slice.
        """
        changed = x.copy()
        for start, flag in self._index(starts, sizes, x.shape, clamps):
            place = _window(start, sizes)
            pair = [changed[place], new(x[place])]
            changed[place] = self._each("select_n", {}, [_scalar(flag), *pair])
        x[...] = changed

    def _dynamic_slice(self, params: Mapping[str, Any], operands: list[Entries]) -> list[Entries]:
        """Writes a slice from a traced index, as selections among all possible slices."""
        x, starts = operands[0], [y[()] for y in operands[1:]]
        return [self._slice(x, starts, params["slice_sizes"], None)]

    def _dynamic_update_slice(
        self, params: Mapping[str, Any], operands: list[Entries]
    ) -> list[Entries]:
        """Writes the replacement of a slice from a traced index."""
        x, new, starts = operands[0].copy(), operands[1], [y[()] for y in operands[2:]]
        self._update(x, starts, new.shape, True, lambda _: new)
        return [x]

    def _gather(self, params: Mapping[str, Any], operands: list[Entries]) -> list[Entries]:
        """Writes `lax.gather`: one slice for each row of indices."""
        x, indices = operands
        numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
        if numbers.operand_batching_dims:
            raise UnsupportedError("a gather with batch axes")
        other = _filling(params, x.flat[0].dtype) if x.size else None
        outer, dropped = indices.shape[:-1], tuple(numbers.collapsed_slice_dims)
        inner = [n for a, n in enumerate(sizes) if a not in dropped]
        slices = np.empty((*outer, *inner), object)
        for place in np.ndindex(outer):
            starts = _starts(numbers.start_index_map, indices[place], x.ndim)
            slices[(*place, ...)] = self._slice(x, starts, sizes, other).squeeze(dropped)
        rank, offsets = slices.ndim, list(numbers.offset_dims)
        order = [*(a for a in range(rank) if a not in offsets), *offsets]
        return [np.transpose(slices, np.argsort(order))]

    def _scatter(
        self, params: Mapping[str, Any], operands: list[Entries], operation: str | None
    ) -> Entries:
        """Writes `lax.scatter` or one like `lax.scatter_add`, slice by slice.

        Args:
            params: the parameters of the scatter.
            operands: the array, the indices of its slices, and their updates.
            operation: the operation that combines old and new numbers, such as "add"; None to
                replace the old ones.
        """
        x, indices, updates = operands[0].copy(), *operands[1:]
        numbers = params["dimension_numbers"]
        if numbers.operand_batching_dims:
            raise UnsupportedError("a scatter with batch axes")
        inner = list(numbers.update_window_dims)
        outer = [a for a in range(updates.ndim) if a not in inner]
        moved = np.transpose(updates, [*outer, *inner])
        clamps = params["mode"] == jax.lax.GatherScatterMode.CLIP
        for place in np.ndindex(moved.shape[: len(outer)]):
            new = np.expand_dims(moved[(*place, ...)], tuple(numbers.inserted_window_dims))
            starts = _starts(numbers.scatter_dims_to_operand_dims, indices[place], x.ndim)
            change = (
                (lambda _, new=new: new)
                if operation is None
                else (lambda old, new=new: self._each(operation, {}, [old, new]))
            )
            self._update(x, starts, new.shape, clamps, change)
        return x

    def _extreme_index(self, name: str, params: Mapping[str, Any], x: Entries) -> Entries:
        """Writes argmax or argmin: the first index of the extreme; of NaN, if there is one."""
        (axis,) = params["axes"]
        rows = np.moveaxis(x, axis, -1)
        result = np.empty(rows.shape[:-1], object)
        dtype, thread = np.dtype(params["index_dtype"]), self.thread
        for i in np.ndindex(result.shape):
            best, index = rows[i][0], dtype.type(0)
            for k, y in enumerate(rows[i][1:], 1):
                beats = thread.apply("gt" if name == "argmax" else "lt", y, best)
                nan = thread.apply("ne", y, y), thread.apply("eq", best, best)
                beats = thread.apply("or", beats, thread.apply("and", *nan))
                best, index = (
                    thread.select(beats, y, best),
                    thread.select(beats, dtype.type(k), index),
                )
            result[i] = index
        return result

    def _largest(self, params: Mapping[str, Any], x: Entries) -> list[Entries]:
        """Writes `top_k`: the largest entries and their indices; equal ones in their order.

        NaN of either sign counts as larger than all numbers, and zeros of both signs as equal.
        """
        count, axis = params["k"], params.get("axis", x.ndim - 1)
        rows = np.moveaxis(x, axis, -1)
        if count * rows.size > MAX_LOADS:
            raise UnsupportedError(f"the {count} largest of {rows.shape[-1]} entries")
        values = np.empty((*rows.shape[:-1], count), object)
        indices = np.empty(values.shape, object)
        apply, select = self.thread.apply, self.thread.select
        for place in np.ndindex(rows.shape[:-1]):
            left: list[Any] = [np.True_] * rows.shape[-1]
            for k in range(count):
                best, index, found = rows[place][0], np.int32(0), left[0]
                for i, (y, is_left) in enumerate(zip(rows[place][1:], left[1:], strict=True), 1):
                    nan = apply("and", apply("ne", y, y), apply("eq", best, best))
                    beats = apply("or", apply("gt", y, best), nan)
                    beats = apply("and", is_left, apply("or", beats, apply("not", found)))
                    best, index = select(beats, y, best), select(beats, np.int32(i), index)
                    found = apply("or", found, is_left)
                values[(*place, k)], indices[(*place, k)] = best, index
                left = [
                    apply("and", flag, apply("ne", index, np.int32(i)))
                    for i, flag in enumerate(left)
                ]
        return [np.moveaxis(y, -1, axis) for y in (values, indices)]

    def _sort(self, params: Mapping[str, Any], operands: list[Entries]) -> list[Entries]:
        """Writes `lax.sort` by one key: swaps neighbors, which keeps the order of equal keys.

        NaN counts as larger than all numbers, and zeros of both signs as equal.
        """
        axis, apply, select = params["dimension"], self.thread.apply, self.thread.select
        rows = [np.moveaxis(x, axis, -1).copy() for x in operands]
        count = rows[0].shape[-1]
        if params["num_keys"] != 1 or count > MAX_SORTED:
            raise UnsupportedError(f"a sort of {count} entries by {params['num_keys']} keys")
        for place in np.ndindex(rows[0].shape[:-1]):
            lines = [x[place] for x in rows]
            for i, j in [(i, i + 1) for end in range(count, 1, -1) for i in range(end - 1)]:
                x, y = lines[0][i], lines[0][j]
                nan = apply("and", apply("ne", x, x), apply("eq", y, y))
                swaps = apply("or", apply("gt", x, y), nan)
                for line in lines:
                    x, y = line[i], line[j]
                    line[i], line[j] = select(swaps, y, x), select(swaps, x, y)
        return [np.moveaxis(x, -1, axis) for x in rows]

    def _cumulative(self, params: Mapping[str, Any], x: Entries) -> Entries:
        """Writes a cumulative sum."""
        rows = np.moveaxis(x, params["axis"], 0)
        rows = rows[::-1] if params["reverse"] else rows
        sums = [rows[0]]
        for row in rows[1:]:
            sums.append(self._each("add", {}, [sums[-1], row]))
        whole = np.stack(sums[::-1] if params["reverse"] else sums)
        return np.moveaxis(whole, 0, params["axis"])


def _read(x: Any) -> Any:
    """Returns an array with its entries in registers."""
    return x.entries if isinstance(x, Stored) else x


def _row(x: Any, index: int | Counter, aval: Any, backward: bool = False) -> Any:
    """Returns the slice of an array at an index of its first axis; zeros if it is not needed."""
    if x is None:
        return entries(np.zeros(aval.shape, np.int32))
    if isinstance(x, Stored):
        return x.row(index, backward)
    return np.take(x, [index], 0).squeeze(0)


def entries(x: Any) -> Entries:
    """Returns a known array as an object array of NumPy numbers."""
    if not isinstance(x, np.ndarray | np.generic | int | float | bool) and not hasattr(x, "dtype"):
        raise UnsupportedError(f"a constant of type {type(x).__name__}")
    try:
        array = np.asarray(x)
    except (TypeError, RuntimeError) as error:  # a random key, or numbers of another process
        raise UnsupportedError("a constant that is no array of numbers here") from error
    result = np.empty(array.shape, object)
    for i in np.ndindex(array.shape):
        result[i] = array[i]
    return result


def _zeros(params: Mapping[str, Any]) -> Entries:
    """Returns zeros in place of an array whose entries may be anything."""
    return entries(np.zeros(params.get("shape", ()), params["dtype"]))


def _scalar(x: Scalar) -> Entries:
    """Returns a scalar as an object array, ()."""
    result = np.empty((), object)
    result[()] = x
    return result


def _led(flags: Entries, like: Entries) -> Entries:
    """Adds axes of size 1 to flags, so that they stand for the first axes of another array."""
    return flags.reshape(flags.shape + (1,) * (like.ndim - flags.ndim))


def _flat(arrays: Sequence[Entries]) -> list[Scalar]:
    """Returns the entries of arrays, one after the other."""
    return [x for array in arrays for x in array.ravel()]


def _unflattened(flat: Sequence[Scalar], shapes: Sequence[tuple[int, ...]]) -> list[Entries]:
    """Returns arrays of these shapes with the given entries; reverses `_flat`."""
    given = iter(flat)
    arrays = []
    for shape in shapes:
        array = np.empty(shape, object)
        for i in np.ndindex(shape):
            array[i] = next(given)
        arrays.append(array)
    return arrays


def _contracted(x: Entries, summed: Sequence[int], batch: Sequence[int]) -> Entries:
    """Moves batch axes of an array first and those that are summed last, as one axis."""
    free = [a for a in range(x.ndim) if a not in (*summed, *batch)]
    moved = np.transpose(x, [*batch, *free, *summed])
    return moved.reshape(*moved.shape[: len(batch) + len(free)], -1)


def _counts(body: Body, constants: int) -> bool:
    """Returns whether a loop carries an integer to which each round adds something.

    Args:
        body: the body of the loop.
        constants: the number of its arguments before the carried values.
    """
    jaxpr = body.closed.jaxpr
    sums = {eqn.outvars[0]: eqn.invars for eqn in jaxpr.eqns if eqn.primitive.name == "add"}
    carried = zip(jaxpr.invars[constants:], jaxpr.outvars, strict=False)
    return any(
        isinstance(after, Var) and after in sums and before in sums[after]
        for before, after in carried
        if not before.aval.shape and jnp.issubdtype(before.aval.dtype, jnp.integer)
    )


def _sizes(params: Mapping[str, Any]) -> tuple[int, int]:
    """Returns the numbers of constants and of carried values of a scan.

    From JAX 0.11 on, a tree of the arguments takes the place of these numbers.
    """
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    constants, carried, _ = (len(group) for group in params["ft_in"].unpack())
    return constants, carried


def _power(thread: Thread, x: Scalar, exponent: int) -> Scalar:
    """Writes xⁿ by repeated squaring."""
    result, square, left = None, x, abs(exponent)
    while left:
        if left & 1:
            result = square if result is None else thread.apply("mul", result, square)
        left >>= 1
        square = thread.apply("mul", square, square) if left else square
    one = x.dtype.type(1)
    if result is None:
        return one
    return thread.apply("div", one, result) if exponent < 0 else result


def _pad(params: Mapping[str, Any], x: Entries, value: Entries) -> Entries:
    """Pads an array with a value, also between entries, or cuts its ends off."""
    config = params["padding_config"]
    inner = [
        n + max(n - 1, 0) * between for n, (_, _, between) in zip(x.shape, config, strict=True)
    ]
    spread = np.empty(inner, object)
    spread[...] = value[()]
    spread[tuple(slice(None, None, between + 1) for _, _, between in config)] = x
    ends = [(max(low, 0), max(high, 0)) for low, high, _ in config]
    padded = np.empty([n + a + b for n, (a, b) in zip(inner, ends, strict=True)], object)
    padded[...] = value[()]
    padded[tuple(slice(a, a + n) for n, (a, _) in zip(inner, ends, strict=True))] = spread
    cut = [
        slice(max(-low, 0), n - max(-high, 0))
        for n, (low, high, _) in zip(padded.shape, config, strict=True)
    ]
    return padded[tuple(cut)]


def _window(start: Sequence[int], sizes: Sequence[int]) -> tuple[Any, ...]:
    """Returns the slices of each axis that begin at `start`; an array has no other axes."""
    # with an ellipsis, NumPy returns an array of rank 0 as an array
    return (*(slice(a, a + n) for a, n in zip(start, sizes, strict=True)), ...)


def _starts(axes: Sequence[int], indices: Entries, rank: int) -> list[Any]:
    """Returns the indices of the first entry of a slice, of which those of some axes are given."""
    starts: list[Any] = [np.int32(0)] * rank
    for axis, index in zip(axes, indices, strict=True):
        starts[axis] = index
    return starts


def _filling(params: Mapping[str, Any], dtype: np.dtype) -> np.generic | None:
    """Returns the number that a gather has in place of slices beyond the array; None if none."""
    if params["mode"] != jax.lax.GatherScatterMode.FILL_OR_DROP:
        return None
    value = params.get("fill_value")
    if value is None and dtype.kind == "b":
        value = True
    elif value is None and np.issubdtype(dtype, np.integer):
        limits = np.iinfo(dtype)
        value = limits.min if np.issubdtype(dtype, np.signedinteger) else limits.max
    return dtype.type(np.nan if value is None else value)


def _other_platform(params: Mapping[str, Any]) -> np.int32:
    """Returns which of the cases of `lax.platform_dependent` is for unnamed platforms.

    Raises:
        UnsupportedError: another case may be for the platform of the kernel.
    """
    platforms = params["platforms"]
    if any(name in ("cpu", "cuda", "gpu") for names in platforms for name in names or ()):
        raise UnsupportedError("a case of this platform")
    return np.int32(platforms.index(None))


def _rows(x: Entries, axis: int) -> list[Entries]:
    """Returns the slices of an array at each index along an axis, without this axis."""
    return [np.take(x, [k], axis).squeeze(axis) for k in range(x.shape[axis])]


Other = Callable[[Evaluation, Mapping[str, Any], list[Entries]], Sequence[Entries]]

OTHERS: dict[str, Other] = {
    "argmax": lambda run, params, x: [run._extreme_index("argmax", params, *x)],
    "argmin": lambda run, params, x: [run._extreme_index("argmin", params, *x)],
    "cholesky": lambda run, params, x: matrices.cholesky(run.thread, params, *x),
    "cond": Evaluation._cond,
    "cumsum": lambda run, params, x: [run._cumulative(params, *x)],
    "dot_general": lambda run, params, x: [run._dot(params, *x)],
    "dynamic_slice": Evaluation._dynamic_slice,
    "dynamic_update_slice": Evaluation._dynamic_update_slice,
    "empty": lambda run, params, x: [_zeros(params)],
    "empty2": lambda run, params, x: [_zeros(params)],
    "expand_dims": lambda run, params, x: [np.expand_dims(x[0], params["dimensions"])],
    "gather": Evaluation._gather,
    "iota": lambda run, params, x: [entries(STRUCTURAL["iota"](params))],
    "lu": lambda run, params, x: matrices.lu(run.thread, params, *x),
    "lu_pivots_to_permutation": lambda run, params, x: matrices.permutation(run.thread, params, *x),
    "pad": lambda run, params, x: [_pad(params, *x)],
    "platform_index": lambda run, params, x: [entries(_other_platform(params))],
    "rev": lambda run, params, x: [np.flip(x[0], params["dimensions"])],
    "scatter": lambda run, params, x: [run._scatter(params, x, None)],
    "somewhere": lambda run, params, x: [run._somewhere(*x)],
    "sort": Evaluation._sort,
    "stack": lambda run, params, x: [np.stack(x, params["axis"])],
    "top_k": lambda run, params, x: run._largest(params, *x),
    "triangular_solve": lambda run, params, x: matrices.triangular_solve(run.thread, params, *x),
    "unstack": lambda run, params, x: _rows(x[0], params["axis"]),
    "while": Evaluation._while,
}
"""Operations that are neither elementwise nor in `MOVES`."""
OTHERS |= {name: lambda run, params, x: x for name in PLACINGS}
OTHERS |= {
    f"scatter{hyphen}{name}": (
        lambda run, params, x, name=name: [run._scatter(params, x, name)]  # type: ignore[misc]
    )
    for name in ("add", "mul", "min", "max")
    for hyphen in "-_"  # older and newer versions of JAX
}
OTHERS |= {
    name: lambda run, params, x, name=name: [run._reduce(name, params, *x)]  # type: ignore[misc]
    for name in PAIRS
}
