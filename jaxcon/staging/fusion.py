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
"""The smallest number of operations for which storing a shared value pays off."""

KERNEL = {"inlineable": "false", "xla_cpu_small_call": "true"}
"""The attributes of calls that XLA must not inline."""


def _names(text: str) -> frozenset[str]:
    """Returns the words of a text."""
    return frozenset(text.split())


MOVES = _names(
    "reshape squeeze expand_dims slice rev transpose broadcast_in_dim convert_element_type iota"
    " dynamic_slice"
)
"""Operations that only move data: kernels read their operands directly."""

MOVED = _names("slice rev transpose broadcast_in_dim dynamic_slice")
"""Primitives whose result has the entries of the operand at other positions."""

ARITHMETIC = _names(
    "add sub mul neg abs sign square integer_pow max min and or not xor eq ne lt le gt ge"
    " is_finite floor ceil round select_n add_any clamp nextafter"
)
"""Elementwise operations."""

COSTLY = _names(
    "div sqrt rsqrt pow exp log log1p expm1 sin cos tan tanh atan2 asin acos atan rem cbrt erf"
    " logistic exp2 sinh cosh asinh acosh atanh"
)
"""Elementwise operations that are always worth storing."""

OTHERS = _names(
    "concatenate dynamic_update_slice pad gather scan cond somewhere split stack unstack"
)
"""Operations that end a stage and may be part of a kernel."""


LIGHT = 1.5e5
"""The estimated cost below which a call is light; see `Stages.is_light` and `uninlined`.

XLA splits a computation among threads if it estimates a cost of 2e5 or more: ten for each byte read
or written, one for each operation on a number, and two for each transcendental operation.
"""

MOST = 130
"""The largest number of steps in one kernel; compile time grows faster than a kernel's size."""

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
and run faster with the branch in the kernel. Closed kinematic chains have 23 to 44, and run faster
with the branch outside. The mean over all branches with loops of a program decides for all of them.
"""

Step = Operation | list[int]
"""A single operation, or the values of a stage."""


def run_staged(
    function: Native, args: Sequence[Array], last: Callable[..., list[Array]] | None = None
) -> list[Array]:
    """Runs a native function in stages.

    Args:
        function: the native function.
        args: its arguments.
        last: a further stage at the end, last(*results); None for none.
    """
    if not staged():
        return function(*args) if last is None else last(*function(*args))
    stages = Stages(traced(function, args), apart=True)
    if last is None:
        return stages(*args)

    def ended(*args: Array) -> list[Array]:
        return uninlined(last, stages(*args))

    return _kernel(ended, list(args)) if stages.are_one_kernel else ended(*args)


def staged() -> bool:
    """Returns True unless the environment turns staging off."""
    return os.environ.get("JAXCON_STAGES") != "off"


class Stages:
    """A program as a sequence of stages and of operations outside of stages.

    Attributes:
        parts: for each part, its steps, and those of their values that later parts need. A part is
            a kernel, or one step outside of kernels. A step is an operation, or the values that a
            stage computes.
    """

    def __init__(self, closed: ClosedJaxpr, apart: bool = False) -> None:
        """Cuts a closed jaxpr into stages.

        Args:
            closed: the jaxpr.
            apart: True if branches with loops may stay out of kernels; False within a kernel.
        """
        self.program = Program(closed, _settled_body)
        steps = _in_stages(self.program, worth_storing(self.program))
        if apart:
            _set_apart(steps)
        self.parts = _with_results(self.program, _in_parts(steps))

    def __call__(self, *args: Array) -> list[Array]:
        """Computes the results."""
        values: dict[int, Any] = dict(zip(self.program.inputs, args, strict=True))
        for steps, wanted in self.parts:
            if all(map(_fits, steps)):
                self._store(values, wanted, functools.partial(self._run, steps), _kernel)
            else:
                self._run(steps, values, wanted)
        return [self.program.evaluate(values, x) for x in self.program.outputs]

    @property
    def are_one_kernel(self) -> bool:
        """True if one kernel can contain the whole program."""
        return len(self.parts) == 1 and all(map(_fits, self.parts[0][0]))

    def _run(self, steps: list[Step], values: dict[int, Any], wanted: Sequence[int]) -> None:
        """Computes values, stage by stage."""
        for step in steps:
            if isinstance(step, Operation) and step.name == "cond":
                self._branch(step, values)
            elif isinstance(step, Operation):
                operands = [self.program.evaluate(values, x) for x in step.inputs]
                values.update(zip(step.outputs, step(operands), strict=True))
            else:
                self._store_stage(values, step)

    def _store_stage(self, values: dict[int, Any], wanted: list[int]) -> None:
        """Computes the values of a stage; each value that is light to compute gets its own call.

        A call with several results fills a table of their addresses, which costs more than a call.
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
        """Computes the results of a condition; its branches compute operands not yet computed."""
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
        """Computes values and stores them in `values`."""
        for x in wanted:
            self.program.evaluate(values, x)

    def _store(
        self,
        values: dict[int, Any],
        wanted: list[int],
        how: Callable[..., None],
        call: Callable[..., list[Array]],
    ) -> None:
        """Computes the wanted values from known values, in one separate call."""
        leaves, _ = self.program.between(values, wanted)

        def compute(*given: Array) -> list[Array]:
            local: dict[int, Any] = dict(zip(leaves, given, strict=True))
            how(local, wanted)
            return [local[x] for x in wanted]

        results = call(compute, [values[x] for x in leaves])
        values.update(zip(wanted, results, strict=True))

    def is_light(self, known: Container[int], wanted: list[int]) -> bool:
        """Returns True if XLA does not split the computation of these values among threads."""
        leaves, operations = self.program.between(known, wanted)
        sizes = self.program.sizes
        if not is_known([sizes[x] for x in (*leaves, *wanted)]):
            return False
        cost = 10 * sum(self.program.bytes[x] for x in (*leaves, *wanted))
        for op in operations:
            cost += work(op.name) * sum(sizes[x] for x in op.outputs)
        return cost < LIGHT

    def _may_overwrite(self, known: Container[int], wanted: list[int]) -> bool:
        """Returns True if a result of a stage has the size of an operand whose data it moves.

        XLA might then write the result in place of the operand; see `_stage_with_arguments`.
        """
        sizes = {self.program.sizes[x] for x in wanted}
        operations = self.program.between(known, wanted)[1]
        moved = (x for op in operations if op.name in MOVED for x in op.inputs)
        return any(self.program.sizes[x] in sizes for x in moved if not isinstance(x, Constant))


def work(name: str) -> int:
    """Returns an upper bound on the number of XLA operations of a primitive for each entry."""
    return 32 if name in COSTLY or name in ("integer_pow", "nextafter") else 4


def worth_storing(program: Program) -> set[int]:
    """Returns the values to store: those that several kernels need and that are costly to compute.

    A sweep backward over the operations selects values that two later kernels need, or that an
    operation outside of kernels reads. A sweep forward drops values that are cheap to compute from
    the other stored values. A row of an array that a loop changes in place is not cheap: a kernel
    that reads it after the change would make the compiler copy the array.
    """
    stored, ends = _needed_twice(program)
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
        if name in stored and name not in ends and cheap:
            stored.discard(name)
        work[name] = steps if cheap else frozenset(list(steps)[:WORTH])  # more is not counted
    return stored


def _needed_twice(program: Program) -> tuple[set[int], set[int]]:
    """Returns the values that several kernels need, and the values that end a kernel.

    A kernel ends at results of the program, and at values that an operation outside of kernels
    reads, unless this operation is a condition whose branches can compute them.
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
        if not moves and (len(needed) > 1 or name in needed):
            stored.add(name)
            needed = {name}
        kernels[name] = set(sorted(needed)[:2])  # only more than one matters
    return stored, ends


def _in_stages(program: Program, stored: set[int]) -> list[Step]:
    """Returns the operations and stages in order.

    A stored value joins the last stage, unless it depends on that stage or on a later operation.
    """
    steps: list[Any] = []
    last = -1  # stage
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
    """Groups steps into kernels of even size; a step that fits no kernel is a part of its own."""
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
    """Keeps large branches with loops out of kernels, unless too many parts result."""
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
    """Returns True for a condition with a loop in a branch."""
    branches = op.params["branches"] if op.name == "cond" else ()
    return any(not primitives(x.jaxpr).isdisjoint({"scan", "while"}) for x in branches)


def _with_results(program: Program, parts: list[list[Step]]) -> list[tuple[list[Step], list[int]]]:
    """Returns each part with those of its values that later parts or the results need.

    Parts without such values or side effects are left out.
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
    """Returns True for a part with side effects, such as printing."""
    return any(isinstance(step, Operation) and step.effects for step in part)


def _values(step: Step) -> list[int]:
    """Returns the values that a step computes."""
    return step.outputs if isinstance(step, Operation) else step


def _fits(step: Step) -> bool:
    """Returns True if a kernel may contain the step."""
    return not isinstance(step, Operation) or (step.name in OTHERS and step.plain)


def _computes(op: Operation, name: int) -> bool:
    """Returns True if the value is an operand that the branches of a condition can compute.

    The index of the branch must be computed before.
    """
    return op.name == "cond" and op.inputs[0] != name


def _elementwise(op: Operation) -> bool:
    """Returns True if an operation is fused into the kernels that read its result."""
    return op.plain and (op.name in ARITHMETIC or op.name in MOVES or op.name in COSTLY)


def _kernel(function: Callable[..., list[Array]], args: list[Array]) -> list[Array]:
    """Calls a function as one kernel.

    XLA finds the buffers of a kernel by the operands of its instructions. It fails if an argument
    is no operand: a constant, or an argument that no result depends on. The barrier hides
    constants, and a call that does nothing makes all arguments operands.
    """

    def kernel(*args: Array) -> list[Array]:
        return function(*uninlined(arguments, args))

    def arguments(*args: Array) -> list[Array]:
        return list(args)

    return uninlined(kernel, jax.lax.optimization_barrier(args))


def _stage(
    function: Callable[..., list[Array]], args: list[Array], light: bool = False
) -> list[Array]:
    """Calls a function as a stage of a kernel."""

    def stage(*args: Array) -> list[Array]:
        return function(*args)

    return uninlined(stage, args, light)


def _stage_with_arguments(function: Callable[..., list[Array]], args: list[Array]) -> list[Array]:
    """Calls a function as a stage that also returns its arguments, so that none is overwritten.

    XLA merges two equal arguments to one array. If one is read entry by entry, XLA writes a result
    in its place, although the other is read at moved positions.
    """
    results = _stage(lambda *args: [*function(*args), *args], args)
    return results[: len(results) - len(args)]


def uninlined(
    function: Callable[..., list[Array]], args: Sequence[Array], light: bool = False
) -> list[Array]:
    """Calls a function without inlining by XLA.

    A call with a single result gets a second, unused result, which the barrier keeps. Otherwise XLA
    would split a costly call among threads, which is not possible inside a kernel. Each result is a
    buffer whose address every call of the kernel looks up, so light calls get no second result.

    Args:
        function: a function of arrays.
        args: the arguments of the function.
        light: True if the call is too cheap for XLA to split.
    """

    @functools.wraps(function)
    def call(*args: Array) -> tuple[list[Array], list[Array]]:
        results = function(*args)
        return results, [jnp.zeros((), bool)] if len(results) < 2 and not light else []

    results, beside = jax.jit(call)(*args)
    first, *others = *results, *beside
    # metadata of a result of a call apply to the call
    barred = jax.lax.optimization_barrier([set_xla_metadata(first, **KERNEL), *others])
    return barred[: len(results)]


def _settled_body(closed: ClosedJaxpr) -> tuple[ClosedJaxpr, bool]:
    """Returns the body of a loop or branch in stages, and True if all of it fits into a kernel."""
    inputs = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in closed.jaxpr.invars]
    stages = Stages(closed)
    plain = all(_fits(step) for steps, _ in stages.parts for step in steps)
    return jax.make_jaxpr(stages)(*inputs), plain
