"""Which values a compiled function stores, and which it computes again where they are needed.

XLA's compiler for CPUs merges elementwise operations into kernels of one result each. A value that
several kernels need is computed in every one of them, with all that it was made of: a long chain of
shared values, as from frames to Jacobians to factors to solutions, grows into kernels that repeat
each other's work a thousand times over. Barriers do not stop it; they are removed before kernels
are formed. What does is a call that may not be inlined. `settled` therefore cuts a function into
stages, each a call that computes values which do not depend on each other, and which the stages
after it read from cache. All of it together is one kernel of one thread, so that nothing is spent
on launching kernels and passing them between threads.

The attributes by which a call says so are hints of XLA's call inliner and CPU emitter, as in jaxlib
0.10: a compiler that does not know them gives the same results, more slowly. The environment
variable JAXCON_STAGES=off leaves all of it to the compiler.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata

from jaxcon.core.operations import instructions, primitives
from jaxcon.core.program import Constant, Operation, Program, evaluated, is_known, traced
from jaxcon.core.typing import Array

WORTH = 3
"""Operations from which it pays to store a value that several kernels need."""

KERNEL = {"inlineable": "false", "xla_cpu_small_call": "true"}


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


MOVES = _names(
    "reshape squeeze expand_dims slice rev transpose broadcast_in_dim convert_element_type iota"
    " dynamic_slice"
)
"""Operations that compute nothing: kernels read through them."""

MOVED = _names("slice rev transpose broadcast_in_dim dynamic_slice")
"""The primitives whose result has entries from other places of the operand."""

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
"""The cost, as `Stages.is_light` counts it, from which a call of one result gets a second one.

XLA divides among threads what it takes to cost 2e5 or more: ten for each byte read or written, one
for each operation on a number and two for each transcendental one.
"""

MOST = 130
"""Steps in one kernel: compiling a kernel takes longer than in proportion to its size."""

FEW_PARTS = 8
"""Branches with loops stay out of kernels only if the program then has at most this many parts.

XLA runs a sequence of more than eight launches on several threads, which costs microseconds. A
rollout adds two or three launches of its own. The Stewart platform has seven parts then, and still
runs faster.
"""

PER_OPERAND = 20
"""Instructions of branches with loops for each operand, above which they stay out of kernels.

An untaken branch makes the kernel that holds it slower, by up to a quarter, and longer to compile.
Outside, it costs launches, its operands are stored, and it runs slower where it is taken. Chains of
links or particles have 15 to 17 instructions for each operand, take their branch often, and run
faster with it in the kernel. Closed kinematic chains have 23 to 44, and run faster with it outside.
All branches with loops of a program go together, by their mean.
"""

Step = Operation | list[int]
"""An operation by itself, or the values of a stage."""


def settled(
    function: Any, args: Sequence[Array], last: Callable[..., list[Array]] | None = None
) -> list[Array]:
    """The results of a native function, cut into stages.

    Args:
        function: with `traced`, its closed jaxpr for arguments of some shapes.
        args: its arguments.
        last: a stage of its own at the end, where there is one: last(*results).
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
    """Returns True where functions are cut into stages, and not left to the compiler whole."""
    return os.environ.get("JAXCON_STAGES") != "off"


class Stages:
    """A program as a sequence of stages and of operations that no kernel of a stage contains.

    Attributes:
        parts: steps of one kernel each, and which of their values are needed later; a step is an
            operation, or the values that a stage computes.
    """

    def __init__(self, closed: Any, apart: bool = False) -> None:
        """Cuts a closed jaxpr into stages.

        Args:
            closed: the jaxpr.
            apart: whether branches with loops may stay out of kernels; False within a kernel.
        """
        self.program = Program(closed, _settled_body)
        steps = _in_stages(self.program, worth_storing(self.program))
        if apart:
            _set_apart(steps)
        self.parts = _with_results(self.program, _in_parts(steps))

    def __call__(self, *args: Array) -> list[Array]:
        """The results."""
        values: dict[int, Any] = dict(zip(self.program.inputs, args, strict=True))
        for steps, wanted in self.parts:
            if all(map(_fits, steps)):
                self._store(values, wanted, functools.partial(self._run, steps), _kernel)
            else:
                self._run(steps, values, wanted)
        return [self.program.evaluate(values, x) for x in self.program.outputs]

    @property
    def are_one_kernel(self) -> bool:
        """True where one kernel may contain all of it."""
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
        """Computes the values of a stage: light ones each in a call of its own.

        A call of several results fills a table of their places, which costs more than the call.
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
        """Computes the results of a condition; what it alone reads is computed in its branches."""
        index, *operands = step.inputs
        read = [x for x in operands if not isinstance(x, Constant)]
        leaves, _ = self.program.between(values, read)

        def within(branch: Any) -> Any:
            def function(*given: Array) -> list[Array]:
                own: dict[int, Any] = dict(zip(leaves, given, strict=True))
                args = [self.program.evaluate(own, x) for x in operands]
                return evaluated(branch, args)

            return jax.make_jaxpr(function)(*(values[x] for x in leaves))

        branches = tuple(map(within, step.params["branches"]))
        given = [self.program.evaluate(values, index), *(values[x] for x in leaves)]
        results = step.primitive.bind(*given, **step.params | {"branches": branches})
        values.update(zip(step.outputs, results, strict=True))

    def _evaluate(self, values: dict[int, Any], wanted: Sequence[int]) -> None:
        for x in wanted:
            self.program.evaluate(values, x)

    def _store(
        self,
        values: dict[int, Any],
        wanted: list[int],
        how: Callable[..., None],
        call: Callable[..., list[Array]],
    ) -> None:
        """Computes values from known ones in a call of their own."""
        leaves, _ = self.program.between(values, wanted)

        def compute(*given: Array) -> list[Array]:
            own: dict[int, Any] = dict(zip(leaves, given, strict=True))
            how(own, wanted)
            return [own[x] for x in wanted]

        results = call(compute, [values[x] for x in leaves])
        values.update(zip(wanted, results, strict=True))

    def is_light(self, known: Any, wanted: list[int]) -> bool:
        """Returns True where XLA does not divide the computation of these values among threads."""
        leaves, operations = self.program.between(known, wanted)
        sizes = self.program.sizes
        if not is_known([sizes[x] for x in (*leaves, *wanted)]):
            return False
        cost = 10 * sum(self.program.bytes[x] for x in (*leaves, *wanted))
        for op in operations:
            cost += work(op.name) * sum(sizes[x] for x in op.outputs)
        return cost < LIGHT

    def _may_overwrite(self, known: Any, wanted: list[int]) -> bool:
        """Returns True where something is moved in whose place a result of a stage would fit."""
        sizes = {self.program.sizes[x] for x in wanted}
        operations = self.program.between(known, wanted)[1]
        moved = (x for op in operations if op.name in MOVED for x in op.inputs)
        return any(self.program.sizes[x] in sizes for x in moved if not isinstance(x, Constant))


def work(name: str) -> int:
    """No fewer than the operations that XLA makes of a primitive for a number."""
    return 32 if name in COSTLY or name in ("integer_pow", "nextafter") else 4


def worth_storing(program: Program) -> set[int]:
    """The values that more than one kernel needs and that cost some work to make.

    Backwards, a value becomes the result of a kernel where it is needed by two kernels after it, or
    by an operation that is no part of one. Forwards, those that turn out cheap, given what else is
    stored, are taken back. A row of an array that a loop changes in place is not cheap: a kernel
    that read it after the change would make the compiler copy the array.
    """
    stored, ends = _needed_twice(program)
    work: dict[int, frozenset[int]] = {}
    for op in filter(_elementwise, program.operations):
        (name,) = op.outputs
        unstored = (x for x in op.inputs if not isinstance(x, Constant) and x not in stored)
        parts = (work.get(x, frozenset()) for x in unstored)
        own = frozenset().union(*parts)
        if op.name == "dynamic_slice":
            own |= {*range(-WORTH, 0)}
        elif op.name not in MOVES:
            own |= {name}
        cheap = len(own) < WORTH and op.name not in COSTLY
        if name in stored and name not in ends and cheap:
            stored.discard(name)
        work[name] = own if cheap else frozenset(list(own)[:WORTH])  # enough to be worth it
    return stored


def _needed_twice(program: Program) -> tuple[set[int], set[int]]:
    """Values that several kernels need, and those among them that end one in any case."""
    readers = program.readers()
    results = {x for x in program.outputs if not isinstance(x, Constant)}
    stored: set[int] = set()
    ends: set[int] = set()
    kernels: dict[int, set[int]] = {}
    for op in filter(_elementwise, reversed(program.operations)):
        (name,) = op.outputs
        needed: set[int] = {name} if name in results else set()
        own = readers.get(name, [])
        for reader in own:
            if _elementwise(reader):
                needed |= kernels[reader.outputs[0]]
            elif len(own) > 1 or not _computes(reader, name):
                needed.add(name)
        if name in needed:
            ends.add(name)
        moves = op.name in MOVES and op.name != "dynamic_slice"
        if not moves and (len(needed) > 1 or name in needed):
            stored.add(name)
            needed = {name}
        kernels[name] = set(sorted(needed)[:2])  # more than one is all that matters
    return stored, ends


def _in_stages(program: Program, stored: set[int]) -> list[Step]:
    """Operations and stages in order: a value joins the last stage unless it depends on it."""
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
    """Consecutive steps, cut evenly: those of one kernel, or one that no kernel can contain."""
    # as many kernels as there would be without steps that none can contain
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
    """The parts, each with those of its values that parts after it or the results need."""
    made = [[x for step in part for x in _values(step)] for part in parts]
    known = {*program.inputs, *(x for part in made for x in part)}
    outputs = [x for x in program.outputs if not isinstance(x, Constant)]
    needed = set(program.between(known, outputs)[0])
    results: list[tuple[list[Step], list[int]]] = []
    for part, own in reversed(list(zip(parts, made, strict=True))):
        results.append((part, [x for x in own if x in needed]))
        operands = (x for step in part for op in _operations(program, step) for x in op.inputs)
        read = [x for x in operands if not isinstance(x, Constant)]
        needed |= set(program.between(known, read)[0])
    return [(part, wanted) for part, wanted in reversed(results) if wanted or _acts(part)]


def _operations(program: Program, step: Step) -> list[Operation]:
    """The operations that make what a step computes."""
    return [step] if isinstance(step, Operation) else [program.makers[x] for x in step]


def _acts(part: list[Step]) -> bool:
    """Returns True where it does something besides computing, such as printing."""
    return any(isinstance(step, Operation) and step.effects for step in part)


def _values(step: Step) -> list[int]:
    """What a step computes."""
    return step.outputs if isinstance(step, Operation) else step


def _fits(step: Step) -> bool:
    """Returns True where a kernel may contain it."""
    return not isinstance(step, Operation) or (step.name in OTHERS and step.plain)


def _computes(op: Operation, name: int) -> bool:
    """Returns True for an operand of a condition, whose branches compute what nobody else reads."""
    return op.name == "cond" and op.inputs[0] != name


def _elementwise(op: Operation) -> bool:
    """Returns True where it becomes a part of the kernels that read it."""
    return op.plain and (op.name in ARITHMETIC or op.name in MOVES or op.name in COSTLY)


def _kernel(function: Callable[..., list[Array]], args: list[Array]) -> list[Array]:
    """Calls a function as one kernel.

    XLA knows the buffers of a kernel by the operands of its instructions, and fails at an argument
    that is none, because it is a constant or because what was made of it turned out not to matter.
    The barrier hides constants, and all arguments go through a call that does nothing.
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
    """Calls a function as a stage that writes no result over an argument, as it returns them.

    Two arguments that XLA finds to be equal are one array to it. It takes a result to fit in the
    place of the one where it is read entry by entry, and forgets that the other is moved.
    """
    results = _stage(lambda *args: [*function(*args), *args], args)
    return results[: len(results) - len(args)]


def uninlined(
    function: Callable[..., list[Array]], args: Sequence[Array], light: bool = False
) -> list[Array]:
    """The results of a call that XLA does not inline.

    A single result is given a second one beside it, which the barrier keeps although nobody needs
    it: a call that ends in one array that costs much would be split among threads, which a call
    inside a kernel cannot be. Each result is a buffer, whose address every call of the kernel looks
    up, and two of them are three: a light call goes without.

    Args:
        function: of arrays.
        args: its arguments.
        light: whether it costs less than what XLA splits.
    """

    @functools.wraps(function)
    def call(*args: Array) -> tuple[list[Array], list[Array]]:
        results = function(*args)
        return results, [jnp.zeros((), bool)] if len(results) < 2 and not light else []

    results, beside = jax.jit(call)(*args)
    first, *others = *results, *beside
    # what is said of a result of a call is said of the call
    kept = jax.lax.optimization_barrier([set_xla_metadata(first, **KERNEL), *others])
    return kept[: len(results)]


def _settled_body(closed: Any) -> tuple[Any, bool]:
    """The body of a loop in stages, and whether all of it fits a kernel."""
    inputs = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in closed.jaxpr.invars]
    stages = Stages(closed)
    plain = all(_fits(step) for steps, _ in stages.parts for step in steps)
    return jax.make_jaxpr(stages)(*inputs), plain
