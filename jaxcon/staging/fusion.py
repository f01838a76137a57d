"""Cuts a function into stages, so that XLA computes each shared value once.

On CPUs, XLA fuses elementwise operations into kernels with one result each. A value that several
kernels need is computed again in each of them, with everything it depends on. A step is a long
chain of shared values: frames, Jacobians, factors, solutions. Its kernels would repeat the same
work a thousand times over. Without staging, a chain of 5 links runs at 0.054 million steps a second
(two cores, a batch in the hundreds). With staging it runs at 2.9 million.

Optimization barriers do not help, because XLA removes them before it forms kernels. Calls that XLA
must not inline do help. `run_staged` therefore cuts a function into stages, and each stage is such
a call. A stage computes values that do not depend on each other, and later stages read them from
cache. All stages together are one kernel on one thread, so that no time is lost on launching
kernels and passing them between threads.

The attributes of these calls are hints to XLA's call inliner and CPU emitter, as of jaxlib 0.10. A
compiler that does not know them gives the same results more slowly. The environment variable
JAXCON_STAGES=off turns staging off.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
from collections.abc import Callable, Container, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata

from jaxcon.core.typing import Array
from jaxcon.staging.operations import instructions, primitives
from jaxcon.staging.program import (
    ClosedJaxpr,
    Constant,
    Operation,
    Program,
    evaluated,
    is_known,
    traced,
)

if TYPE_CHECKING:
    from jaxcon.staging.batch_last import Native

WORTH = 3
"""The smallest number of operations to compute a shared value for which storing it pays off."""

OFTEN = 4
"""The number of reads from which on storing pays off for one operation on two whole arrays."""

KERNEL = {"inlineable": "false", "xla_cpu_small_call": "true"}
"""The attributes of calls that XLA must not inline."""


def _names(text: str) -> frozenset[str]:
    """Returns the set of the words of a text, such as names of primitives."""
    return frozenset(text.split())


MOVES = _names(
    "reshape squeeze expand_dims slice rev transpose broadcast_in_dim convert_element_type iota"
    " dynamic_slice"
)
"""Primitives that only move data; kernels read their operands directly."""

MOVED = _names("slice rev transpose broadcast_in_dim dynamic_slice")
"""Primitives whose result has the entries of its operand at other positions."""

ARITHMETIC = _names(
    "add sub mul neg abs sign square integer_pow max min and or not xor eq ne lt le gt ge"
    " is_finite floor ceil round select_n add_any clamp nextafter"
)
"""Cheap elementwise primitives."""

COSTLY = _names(
    "div sqrt rsqrt pow exp log log1p expm1 sin cos tan tanh atan2 asin acos atan rem cbrt erf"
    " logistic exp2 sinh cosh asinh acosh atanh"
)
"""Costly elementwise primitives: a shared result is always worth storing."""

OTHERS = _names(
    "concatenate dynamic_update_slice pad gather scan cond somewhere split stack unstack"
)
"""Other primitives that may be part of a kernel; each is a step of its own, between stages."""


LIGHT = 1.5e5
"""The estimated cost below which a call counts as light; see `Stages.is_light` and `uninlined`.

XLA splits a computation among threads if it estimates a cost of 2e5 or more: ten for each byte read
or written, one for each operation on a number, and two for each transcendental operation.
"""

MOST = 130
"""The largest number of steps in a kernel, since compile time grows faster than its size."""

FEW_PARTS = 8
"""Branches with loops stay out of kernels only if the program then has at most this many parts.

XLA runs a sequence of more than eight launches on several threads, which costs microseconds. A
rollout adds two or three launches of its own. With its branches outside of kernels, the Stewart
platform has seven parts, and still runs faster.
"""

PER_OPERAND = 20
"""The number of instructions per operand above which branches with loops stay out of kernels.

An untaken branch makes the kernel that holds it slower, by up to a quarter, and longer to compile.
Outside of kernels, a branch costs launches, its operands are stored, and it runs slower when it is
taken. Chains of links or particles have 15 to 17 instructions per operand, take their branch often,
and run faster with the branch in the kernel. A four-bar and a Stewart platform have 45, and run
faster with the branch outside. The mean over all branches with loops of a program decides for all
of them.
"""

Step = Operation | list[int]
"""A step of a program: a single operation, or the numbers of the values that a stage computes."""


def run_staged(
    function: Native, args: Sequence[Array], last: Callable[..., list[Array]] | None = None
) -> list[Array]:
    """Calls a native function in stages; returns its results.

    Args:
        function: the native function.
        args: its arguments.
        last: a function of the results that runs as one more stage, and whose results are returned
            instead; None for none.
    """
    if not staged():
        return function(*args) if last is None else last(*function(*args))
    return Stages(traced(function, args), apart=True)(*args, last=last)


def staged() -> bool:
    """Returns True unless the environment variable JAXCON_STAGES turns staging off."""
    return os.environ.get("JAXCON_STAGES") != "off"


class Stages:
    """A program, cut into stages and single operations, and grouped into kernels.

    Attributes:
        parts: the parts of the program, in order; a part is a kernel, or one step outside of
            kernels. Each entry has the steps of the part, and the numbers of the values to keep,
            which later parts or the results need. A step is a single operation, or the numbers of
            the values that a stage computes.
    """

    def __init__(
        self,
        closed: ClosedJaxpr,
        apart: bool = False,
        constants: Sequence[Constant | None] = (),
    ) -> None:
        """Cuts a closed jaxpr into stages.

        Args:
            closed: the jaxpr.
            apart: True if branches with loops may stay out of kernels; False within a kernel.
            constants: for each of the first arguments, the constant that takes its place, or None.
        """
        self.program = Program(closed, _settled_body, constants)
        steps = _in_stages(self.program, worth_storing(self.program))
        if apart:
            _set_apart(steps)
        self.parts = _with_results(self.program, _in_parts(steps))

    def __call__(self, *args: Array, last: Callable[..., list[Array]] | None = None) -> list[Array]:
        """Runs all parts; returns the results of the program, or of `last` if it is given."""
        values: dict[int, Any] = dict(zip(self.program.inputs, args, strict=True))
        for i, (steps, wanted) in enumerate(self.parts, 1):
            if not all(map(_fits, steps)):
                self._run(steps, values, wanted)
            elif last is None or i < len(self.parts):
                self._store(values, wanted, functools.partial(self._run, steps), _kernel)
            else:
                return self._run_last(steps, values, last)
        results = self._results(values)
        return results if last is None else uninlined(last, results)

    def _results(self, values: dict[int, Any]) -> list[Array]:
        """Returns the results of the program, given the values of its parts."""
        return [self.program.evaluate(values, x) for x in self.program.outputs]

    def _run_last(
        self, steps: list[Step], values: dict[int, Any], last: Callable[..., list[Array]]
    ) -> list[Array]:
        """Runs the last part, and a function of the program's results, as one kernel.

        Args:
            steps: the steps of the last part.
            values: the values computed so far, by number.
            last: the function, which becomes a stage.
        """
        outputs = [x for x in self.program.outputs if not isinstance(x, Constant)]
        leaves, _ = self.program.between(values, outputs)

        def ended(*given: Array) -> list[Array]:
            local: dict[int, Any] = dict(zip(leaves, given, strict=True))
            self._run(steps, local, [])
            return uninlined(last, self._results(local))

        return _kernel(ended, [values[x] for x in leaves])

    def _run(self, steps: list[Step], values: dict[int, Any], wanted: Sequence[int]) -> None:
        """Runs the steps of a part in order, and adds their results to `values`.

        Args:
            steps: the steps.
            values: the values computed so far, by number.
            wanted: not used, since all results of the steps are added; `_store` passes it.
        """
        for step in steps:
            if isinstance(step, Operation) and step.name == "cond":
                self._branch(step, values)
            elif isinstance(step, Operation):
                operands = [self.program.evaluate(values, x) for x in step.inputs]
                values.update(zip(step.outputs, step(operands), strict=True))
            else:
                self._store_stage(values, step)

    def _store_stage(self, values: dict[int, Any], wanted: list[int]) -> None:
        """Computes the values of a stage in calls that XLA does not inline.

        Each value that is light to compute gets its own call, and all others share one call. A call
        with several results fills a table of their addresses, which costs more than another call.

        Args:
            values: the values computed so far, by number; the new values are added.
            wanted: the numbers of the values of the stage.
        """
        light = [
            x for x in wanted if self.is_light(values, [x]) and not self._may_overwrite(values, [x])
        ]
        others = [x for x in wanted if x not in light]
        for x in light:
            self._store(values, [x], self._evaluate, functools.partial(_stage, light=True))
        if others:
            call = _stage_with_arguments if self._may_overwrite(values, others) else _stage
            self._store(values, others, self._evaluate, call)

    def _branch(self, step: Operation, values: dict[int, Any]) -> None:
        """Computes the results of a conditional, and adds them to `values`.

        Operands that are not computed so far are computed inside of the branches.

        Args:
            step: the conditional.
            values: the values computed so far, by number.
        """
        index, *operands = step.inputs
        read = [x for x in operands if not isinstance(x, Constant)]
        leaves, _ = self.program.between(values, read)

        def within(branch: ClosedJaxpr) -> Any:
            def function(*given: Array) -> list[Array]:
                local: dict[int, Any] = dict(zip(leaves, given, strict=True))
                args = [self.program.evaluate(local, x) for x in operands]
                return evaluated(branch, args)

            return jax.make_jaxpr(function)(*(values[x] for x in leaves))

        branches = tuple(map(within, step.params["branches"]))
        given = [self.program.evaluate(values, index), *(values[x] for x in leaves)]
        results = step.primitive.bind(*given, **step.params | {"branches": branches})
        values.update(zip(step.outputs, results, strict=True))

    def _evaluate(self, values: dict[int, Any], wanted: Sequence[int]) -> None:
        """Computes the wanted values and all values they depend on, and adds them to `values`."""
        for x in wanted:
            self.program.evaluate(values, x)

    def _store(
        self,
        values: dict[int, Any],
        wanted: list[int],
        how: Callable[..., None],
        call: Callable[..., list[Array]],
    ) -> None:
        """Computes values in one call that XLA does not inline, and adds them to `values`.

        Args:
            values: the values computed so far, by number.
            wanted: the numbers of the values to compute.
            how: the function (values, wanted) that computes them inside of the call.
            call: calls a function of arrays without inlining, such as `_stage` or `_kernel`.
        """
        leaves, _ = self.program.between(values, wanted)

        def compute(*given: Array) -> list[Array]:
            local: dict[int, Any] = dict(zip(leaves, given, strict=True))
            how(local, wanted)
            return [local[x] for x in wanted]

        results = call(compute, [values[x] for x in leaves])
        values.update(zip(wanted, results, strict=True))

    def is_light(self, known: Container[int], wanted: list[int]) -> bool:
        """Returns True if a computation is too cheap for XLA to split it among threads.

        Args:
            known: the numbers of the values computed so far.
            wanted: the numbers of the values to compute from them.
        """
        leaves, operations = self.program.between(known, wanted)
        sizes = self.program.sizes
        if not is_known([sizes[x] for x in (*leaves, *wanted)]):
            return False
        cost = 10 * sum(self.program.bytes[x] for x in (*leaves, *wanted))
        for op in operations:
            cost += work(op.name) * sum(sizes[x] for x in op.outputs)
        return cost < LIGHT

    def _may_overwrite(self, known: Container[int], wanted: list[int]) -> bool:
        """Returns True if XLA might overwrite an operand of a stage that is still needed.

        XLA may write a result of the stage in place of the operand. This does harm if the stage
        moves the data of the operand, and both have the same size; see `_stage_with_arguments`.

        Args:
            known: the numbers of the values computed so far.
            wanted: the numbers of the results of the stage.
        """
        sizes = {self.program.sizes[x] for x in wanted}
        operations = self.program.between(known, wanted)[1]
        moved = (x for op in operations if op.name in MOVED for x in op.inputs)
        return any(self.program.sizes[x] in sizes for x in moved if not isinstance(x, Constant))


def work(name: str) -> int:
    """Returns a bound on the number of operations that XLA needs for each entry of a result.

    Args:
        name: the name of the primitive.
    """
    return 32 if name in COSTLY or name in ("integer_pow", "nextafter") else 4


def worth_storing(program: Program) -> set[int]:
    """Returns the values that stages compute and store: shared values that are costly to compute.

    A sweep backward over the operations selects values that several later kernels need, or that an
    operation outside of kernels reads. A sweep forward drops values that are cheap to compute from
    the other stored values. An operation on two whole arrays does not count as cheap if its result
    is read often. Neither does a row of an array that a loop changes in place: if a kernel read it
    after the change, the compiler would have to copy the array.
    """
    stored, ends = _needed_twice(program)
    read = _read_sizes(program)
    work: dict[int, frozenset[int]] = {}
    for op in filter(_elementwise, program.operations):
        (name,) = op.outputs
        unstored = (x for x in op.inputs if not isinstance(x, Constant) and x not in stored)
        parts = (work.get(x, frozenset()) for x in unstored)
        steps = frozenset().union(*parts)
        if op.name == "dynamic_slice":
            steps |= {*range(-WORTH, 0)}
        elif op.name not in MOVES:
            steps |= {name}
        cheap = len(steps) < WORTH and op.name not in COSTLY
        cheap = cheap and not _is_read_often(program, op, read[name])
        if name in stored and name not in ends and cheap:
            stored.discard(name)
        work[name] = steps if cheap else frozenset(list(steps)[:WORTH])  # WORTH is enough
    return stored


def _is_read_often(program: Program, op: Operation, read: int) -> bool:
    """Returns True if an operation combines arrays of its size, and its result is read often.

    Args:
        program: the program.
        op: an operation with one result.
        read: the number of entries of the result that are read; see `_read_sizes`.
    """
    size = program.sizes[op.outputs[0]]
    if not is_known([read, size]) or read < OFTEN * size:
        return False
    operands = [x for x in op.inputs if not isinstance(x, Constant)]
    return sum(program.sizes[x] == size for x in operands) > 1


def _read_sizes(program: Program) -> dict[int, int]:
    """Returns the number of entries of each value that elementwise operations read."""
    readers = program.readers()
    sizes: dict[int, int] = {}
    for op in reversed(program.operations):
        for x in op.outputs:
            sizes[x] = sum(
                sizes[reader.outputs[0]]
                if reader.name in MOVES
                else program.sizes[reader.outputs[0]]
                for reader in readers.get(x, [])
                if _elementwise(reader)
            )
    return sizes


def _needed_twice(program: Program) -> tuple[set[int], set[int]]:
    """Finds the values to store because of where they are read.

    Returns:
        The values that several kernels need, or at which a kernel ends; without the results of
        operations that only move data.
        The values at which a kernel ends: the results of the program, and the values that an
        operation outside of kernels reads. If the only reader is a conditional whose branches can
        compute a value, the value does not count.
    """
    readers = program.readers()
    results = {x for x in program.outputs if not isinstance(x, Constant)}
    stored: set[int] = set()
    ends: set[int] = set()
    kernels: dict[int, set[int]] = {}
    for op in filter(_elementwise, reversed(program.operations)):
        (name,) = op.outputs
        needed: set[int] = {name} if name in results else set()
        consumers = readers.get(name, [])
        for reader in consumers:
            if _elementwise(reader):
                needed |= kernels[reader.outputs[0]]
            elif len(consumers) > 1 or not _computes(reader, name):
                needed.add(name)
        if name in needed:
            ends.add(name)
        moves = op.name in MOVES and op.name != "dynamic_slice"
        # the index of a branch is a converted flag: outside of kernels it would be one more launch
        moves = moves and not any(x.name == "cond" and x.inputs[0] == name for x in consumers)
        if not moves and (len(needed) > 1 or name in needed):
            stored.add(name)
            needed = {name}
        kernels[name] = set(sorted(needed)[:2])  # two show that it is shared
    return stored, ends


def _in_stages(program: Program, stored: set[int]) -> list[Step]:
    """Orders the operations and stages of a program as steps.

    A value to store joins the last stage, unless it depends on that stage or on a later step.

    Args:
        program: the program.
        stored: the values that stages compute; see `worth_storing`.
    """
    steps: list[Any] = []
    last = -1  # the position of the last stage in `steps`
    made: dict[int, int] = {}
    for op in program.operations:
        after = max((made.get(x, -1) for x in op.inputs if not isinstance(x, Constant)), default=-1)
        if not _elementwise(op):
            steps.append(op)
            after = len(steps) - 1
        elif op.outputs[0] in stored:
            if after < last:
                steps[last].append(op.outputs[0])
            else:
                steps.append([op.outputs[0]])
                last = len(steps) - 1
            after = last
        made.update(dict.fromkeys(op.outputs, after))
    return steps


def _in_parts(steps: list[Step]) -> list[list[Step]]:
    """Groups successive steps into parts: kernels of similar size, and single steps between them.

    A step that no kernel may contain is a part of its own.
    """
    # the size of kernels is chosen as if every step fitted into a kernel
    count = max(1, math.ceil(len(steps) / MOST))
    most = math.ceil(len(steps) / count)
    parts: list[list[Step]] = []
    for step in steps:
        if parts and _fits(step) and _fits(parts[-1][-1]) and len(parts[-1]) < most:
            parts[-1].append(step)
        else:
            parts.append([step])
    return parts


def _set_apart(steps: list[Step]) -> None:
    """Keeps branches with loops out of kernels, if they are large on average.

    See `PER_OPERAND`. Nothing changes if the program would then have more than `FEW_PARTS` parts.
    """
    ops = [x for x in steps if isinstance(x, Operation) and _fits(x) and _has_loop(x)]
    inside = sum(instructions(x.jaxpr) for op in ops for x in op.params["branches"])
    if inside <= PER_OPERAND * sum(len(op.inputs) for op in ops):
        return
    for op in ops:
        op.plain = False
    if len(_in_parts(steps)) > FEW_PARTS:
        for op in ops:
            op.plain = True


def _has_loop(op: Operation) -> bool:
    """Returns True if an operation is a conditional with a loop in one of its branches."""
    branches = op.params["branches"] if op.name == "cond" else ()
    return any(not primitives(x.jaxpr).isdisjoint({"scan", "while"}) for x in branches)


def _with_results(program: Program, parts: list[list[Step]]) -> list[tuple[list[Step], list[int]]]:
    """Finds the values of each part that later parts, or the results of the program, need.

    Returns:
        Pairs (steps of a part, numbers of these values). Parts that have neither such values nor
        side effects are left out.
    """
    made = [[x for step in part for x in _values(step)] for part in parts]
    known = {*program.inputs, *(x for part in made for x in part)}
    outputs = [x for x in program.outputs if not isinstance(x, Constant)]
    needed = set(program.between(known, outputs)[0])
    results: list[tuple[list[Step], list[int]]] = []
    for part, computed in reversed(list(zip(parts, made, strict=True))):
        results.append((part, [x for x in computed if x in needed]))
        operands = (x for step in part for op in _operations(program, step) for x in op.inputs)
        read = [x for x in operands if not isinstance(x, Constant)]
        needed |= set(program.between(known, read)[0])
    return [(part, wanted) for part, wanted in reversed(results) if wanted or _acts(part)]


def _operations(program: Program, step: Step) -> list[Operation]:
    """Returns the operations that compute the values of a step."""
    return [step] if isinstance(step, Operation) else [program.makers[x] for x in step]


def _acts(part: list[Step]) -> bool:
    """Returns True if a part has side effects, such as printing."""
    return any(isinstance(step, Operation) and step.effects for step in part)


def _values(step: Step) -> list[int]:
    """Returns the numbers of the values that a step computes."""
    return step.outputs if isinstance(step, Operation) else step


def _fits(step: Step) -> bool:
    """Returns True if a kernel may contain the step."""
    return not isinstance(step, Operation) or (step.name in OTHERS and step.plain)


def _computes(op: Operation, name: int) -> bool:
    """Returns True if an operation is a conditional whose branches can compute an operand.

    They cannot compute the index of the branch, which must be known before.

    Args:
        op: the operation.
        name: the number of the operand.
    """
    return op.name == "cond" and op.inputs[0] != name


def _elementwise(op: Operation) -> bool:
    """Returns True if XLA fuses an operation into the kernels that read its result."""
    return op.plain and (op.name in ARITHMETIC or op.name in MOVES or op.name in COSTLY)


def _kernel(function: Callable[..., list[Array]], args: list[Array]) -> list[Array]:
    """Calls a function that becomes one kernel; returns its results.

    XLA finds the buffers of a kernel by the operands of its instructions. It fails if an argument
    of the kernel is no operand, because it is a constant or no result depends on it. Therefore a
    barrier hides constants, and an inner call that only returns its arguments makes all of them
    operands.
    """

    def kernel(*args: Array) -> list[Array]:
        return function(*uninlined(arguments, args))

    def arguments(*args: Array) -> list[Array]:
        return list(args)

    return uninlined(kernel, jax.lax.optimization_barrier(args))


def _stage(
    function: Callable[..., list[Array]], args: list[Array], light: bool = False
) -> list[Array]:
    """Calls a function that becomes a stage of a kernel; returns its results.

    Args:
        function: a function of arrays.
        args: its arguments.
        light: True if the stage is too cheap for XLA to split it among threads.
    """

    def stage(*args: Array) -> list[Array]:
        return function(*args)

    return uninlined(stage, args, light)


def _stage_with_arguments(function: Callable[..., list[Array]], args: list[Array]) -> list[Array]:
    """Calls a function as a stage, so that XLA does not overwrite its arguments.

    XLA merges two equal arguments to one array. If the first is read entry by entry, XLA may write
    a result in its place. The second may be read at moved positions, and is then overwritten too
    early. The stage therefore also returns its arguments, which are then dropped.
    """
    results = _stage(lambda *args: [*function(*args), *args], args)
    return results[: len(results) - len(args)]


def uninlined(
    function: Callable[..., list[Array]], args: Sequence[Array], light: bool = False
) -> list[Array]:
    """Calls a function of arrays that XLA does not inline; returns its results.

    XLA would split a costly call with a single result among threads, which is not possible inside a
    kernel. Such a call therefore returns its result twice, and a barrier keeps both. Light calls
    return it once, because the kernel looks up the address of each result at each run.

    Args:
        function: a function of arrays.
        args: the arguments of the function.
        light: True if the call is too cheap for XLA to split it among threads.
    """

    @functools.wraps(function)
    def call(*args: Array) -> tuple[list[Array], list[Array]]:
        results = function(*args)
        if not results:
            return results, [jnp.zeros((), bool)]
        return results, results if len(results) < 2 and not light else []

    results, beside = jax.jit(call)(*args)
    first, *others = *results, *beside
    # metadata that are set on a result of a call apply to the call
    barred = jax.lax.optimization_barrier([set_xla_metadata(first, **KERNEL), *others])
    return barred[: len(results)]


def _settled_body(
    closed: ClosedJaxpr, constants: Sequence[Constant | None]
) -> tuple[ClosedJaxpr, bool]:
    """Cuts the body of a loop or a branch into stages.

    Args:
        closed: the body.
        constants: for each of the first arguments, the constant that takes its place, or None.

    Returns:
        The closed jaxpr of the body in stages, and True if one kernel may contain all of it.
    """
    stages = Stages(closed, constants=constants)
    pairs = itertools.zip_longest(closed.jaxpr.invars, constants)
    avals: list[Any] = [x.aval for x, known in pairs if known is None]
    inputs = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in avals]
    plain = all(_fits(step) for steps, _ in stages.parts for step in steps)
    return jax.make_jaxpr(stages)(*inputs), plain
