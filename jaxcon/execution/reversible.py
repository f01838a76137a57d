"""The adjoint `Reversible`: the reverse pass reconstructs states by stepping back from the end."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import CustomVJPPrimal, SymbolicZero

from jaxcon.core import checks, numerics
from jaxcon.core.closures import hoist_closure
from jaxcon.core.pytree import LeafPartition, pytree, static
from jaxcon.core.status import failed
from jaxcon.core.typing import Array, PyTree
from jaxcon.execution.adjoints import Path
from jaxcon.protocols import Adjoint
from jaxcon.staging.worlds import where_tree
from jaxcon.system.state import State


@pytree
class Reversible(Adjoint):
    """Reconstructs states in the reverse pass by stepping back from the final state.

    By default the memory does not grow with the number of steps. The integrator must be symmetric:
    a step by −h undoes a step by h. `RATTLE()` is symmetric, also with forces, dampers, drives and
    arrays of controls. Other methods and policies are refused. Like `Checkpoints()`, it costs one
    more forward pass.

    Reconstructed states differ from the original ones by rounding errors. Stepping back amplifies
    these errors: little for a regular motion, exponentially for a chaotic or damped one. At each
    kept state, the reconstructed values are compared with the stored values and replaced by them.
    If positions or velocities differ by more than ε^⅓ of the largest ones, the gradient of this
    world is NaN. The state after the first step is always kept and compared. Errors between
    kept states are not detected.

    There is no forward-mode derivative. In forward mode, use another adjoint, such as
    `EveryStep()`, which then keeps no states.

    Attributes:
        segments: number of steps from one kept state to the next. By default only the states after
            the first and the last step are kept.

    References:
        Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), sections II.3 and VII.1.4.
    """

    segments: int | None = static(default=None)

    def scan(self, path: Path) -> tuple[State, PyTree]:
        """Runs a rollout. Returns its final state and its record.

        Raises:
            ValueError: the steps of this rollout cannot be undone; the message gives the reason.
        """
        if self.segments is not None:
            checks.count("Reversible", "segments", self.segments)
        if isinstance(path.back, str):
            raise ValueError(
                f"Reversible: {path.back}; take Checkpoints(), which keeps about 2 √T states."
            )
        return _Walk(path, self._size(path.steps)).run() if path.steps else path.scan()

    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """Returns the number of kept states at segment ends, and within a step.

        The second number is 1: the state before the step that the reverse pass differentiates.
        """
        return _count(steps, self._size(steps)), min(steps, 1)

    def _size(self, steps: int) -> int:
        return self.segments or max(steps - 1, 1)


def _count(steps: int, size: int) -> int:
    """Counts kept states: after the first step, after every further `size` steps, at the end."""
    return 1 + -(-(steps - 1) // size) if steps else 0


class _Walk:
    """Runs a rollout forward and, in the reverse pass, backward.

    Step n, counted from 0, belongs to segment ⌈n / size⌉. The state at the end of each segment is
    kept. Segment 0 is the first step alone, since the initial state may violate the constraints.
    """

    def __init__(self, path: Path, size: int) -> None:
        given = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), path.inputs)
        self.path, self.size = path, size
        self.step, of_step, ahead = hoist_closure(path.step, path.start, given)
        self.record, of_record, row = hoist_closure(path.record, *ahead)
        self.back, self.of_back, _ = hoist_closure(path.back, path.start, given)  # type: ignore[arg-type]
        self.numbers = (of_step, of_record), path.start, path.inputs
        self.parts = tuple(map(LeafPartition.of, self.numbers))
        self.results = LeafPartition.of(path.start), LeafPartition.of(row)

    def run(self) -> tuple[State, PyTree]:
        """Runs the rollout. Returns its final state and its record."""
        pairs = [parts.split(x) for parts, x in zip(self.parts, self.numbers, strict=True)]
        real, others = map(list, zip(*pairs, strict=True))
        walk = jax.custom_vjp(lambda *args: self.forwards(*args)[0])
        walk.defvjp(self.begin, self.backwards, symbolic_zeros=True)
        try:
            results = walk(real, (others, jax.lax.stop_gradient(self.of_back)))
        except TypeError as error:
            if "forward-mode" not in str(error):
                raise
            raise TypeError(
                "Reversible: there is no forward-mode derivative through steps that are taken back;"
                " take adjoint=jc.adjoints.EveryStep(), which keeps nothing in forward mode."
            ) from error
        return self._merged(self.results, *results)

    def begin(self, *given: Any) -> tuple[Any, Any]:
        """Forward rule of the custom VJP. Returns the results, and data for `backwards`."""
        real, rest = (jax.tree.map(lambda x: x.value, x, is_leaf=_is_primal) for x in given)
        moved = jax.tree.map(lambda x: x.perturbed, given[0], is_leaf=_is_primal)
        results, kept = self.forwards(real, rest)
        return results, (_Moved(tuple(map(tuple, moved))), real, rest, kept)

    def forwards(self, real: Any, rest: Any) -> tuple[Any, Any]:
        """Runs the rollout. Returns its results and the kept states.

        The results are split in two: the floating leaves and the other leaves, each as a list for
        the final state and a list for the record.

        Args:
            real: the floating leaves of the constants, the initial state and the inputs.
            rest: their other leaves, and the constants of `back`.
        """
        (of_step, of_record), start, inputs = self._merged(self.parts, real, rest[0])
        count = _count(self.path.steps, self.size)
        room = jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), start)

        def step(carry: Any, inputs: Any) -> Any:
            (before, kept), place = carry, self._segment(inputs[0])
            state, info = self.step(of_step, before, inputs)
            put = jax.lax.dynamic_update_index_in_dim
            return (state, jax.tree.map(lambda x, y: put(x, y, place, 0), kept, state)), info

        def record(carry: Any, info: Any) -> PyTree:
            return self.record(of_record, carry[0], info)

        way: Any = {"step": step, "record": record, "start": (start, room), "inputs": inputs}
        (final, kept), rows = dataclasses.replace(self.path, **way).scan()  # type: ignore[misc]
        pairs = [p.split(x) for p, x in zip(self.results, (final, rows), strict=True)]
        return tuple(map(list, zip(*pairs, strict=True))), kept

    def backwards(self, residuals: Any, cotangents: Any) -> tuple[Any, None]:
        """Reverse rule of the custom VJP.

        Returns:
            The cotangents of the floating leaves of the constants, the initial state and the
            inputs; and None for the arguments without a derivative.
        """
        moved, real, rest, kept = residuals
        constants, start, inputs = self._merged(self.parts, real, rest[0])
        of_numbers, _, of_inputs = parts = moved.parts(self.parts)
        (bar, rows_bar), _ = cotangents
        bar = [_zeros(x.aval.shape, x.aval.dtype) if _is_zero(x) else x for x in bar]
        allowed = _allowed(kept, start.time)

        def back(after: State, given: Any) -> tuple[State, Array]:
            """Returns the state before a step, and True where the reconstruction failed."""
            number, place = given[0], self._segment(given[0])
            saved = jax.tree.map(lambda x: _row(x, place), kept)
            ends = number % self.size == 0
            before = self.back(rest[1], where_tree(ends, saved, after), given)
            lost = ends & _far(after, saved, allowed) | (number > 0) & failed(before.status)
            return where_tree(number == 0, start, before), lost

        def pull(carry: Any, inputs: Any) -> Any:
            after, bar, total, lost = carry
            before, missed = back(after, inputs)
            rows = [_row(x, inputs[0] // self.path.every) for x in rows_bar]
            point = constants, before, inputs
            constants_bar, bar, inputs_bar = self._pulled(parts, point, (bar, rows))
            total = jax.tree.map(jnp.add, total, constants_bar)
            return (before, bar, total, lost | missed), inputs_bar

        final = jax.tree.map(lambda x: x[-1], kept)
        total = jax.tree.map(jnp.zeros_like, of_numbers.split(constants)[0])
        begin = final, bar, total, jnp.zeros_like(failed(final.status))
        (_, bar, total, lost), inputs_bar = jax.lax.scan(pull, begin, inputs, reverse=True)
        lost &= ~failed(final.status)  # a failed world has zero gradient anyway
        bars = jax.tree.map(lambda x: jnp.where(lost, jnp.nan, x), (total, bar, inputs_bar))
        return moved.spread(bars), None

    def _pulled(self, parts: Any, at: Any, bars: Any) -> Any:
        """Pulls cotangents back through one step and its record.

        Args:
            parts: partitions of (constants, state, step inputs) into leaves with tangents and
                others.
            at: values of (constants, state, step inputs) before the step.
            bars: cotangents of the state after the step, and of its record.

        Returns:
            Cotangents of the leaves with tangents of (constants, state, step inputs).
        """
        pairs = [p.split(x) for p, x in zip(parts, at, strict=True)]
        real, others = zip(*pairs, strict=True)

        def ahead(*real: Any) -> Any:
            (of_step, of_record), state, given = self._merged(parts, real, others)
            state, seen = self.step(of_step, state, given)
            row = self._recorded(of_record, state, seen, given[0])
            return [p.split(x)[0] for p, x in zip(self.results, (state, row), strict=True)]

        return jax.vjp(ahead, *real)[1](list(bars))

    def _recorded(self, constants: Any, state: State, seen: Any, number: Array) -> PyTree:
        """Returns the recorded values of a step, or zeros after steps that are not recorded."""
        if self.path.every == 1:
            return self.record(constants, state, seen)
        shapes = jax.eval_shape(self.record, constants, state, seen)

        def nothing(*_: Any) -> PyTree:
            return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

        due = (number + 1) % self.path.every == 0
        return jax.lax.cond(due, self.record, nothing, constants, state, seen)

    def _segment(self, number: Array) -> Array:
        return (number + self.size - 1) // self.size

    @staticmethod
    def _merged(parts: Any, real: Any, others: Any) -> Any:
        return tuple(p.merge(x, y) for p, x, y in zip(parts, real, others, strict=True))


@jax.tree_util.register_static
@dataclass(frozen=True)
class _Moved:
    """Marks the floating leaves of (constants, start, inputs) that have tangents.

    Attributes:
        flags: for constants, start and inputs a tuple each, with True for a leaf with a tangent.
    """

    flags: tuple[tuple[bool, ...], ...]

    def parts(self, of: tuple[LeafPartition, ...]) -> tuple[LeafPartition, ...]:
        """Returns the partitions in which only leaves with tangents count as differentiable.

        Every floating leaf of the state counts: after the first step all may have tangents.
        """
        flags = self.flags[0], (True,) * len(self.flags[1]), self.flags[2]
        return tuple(parts.among(chosen) for parts, chosen in zip(of, flags, strict=True))

    def spread(self, found: Any) -> list[list[Any]]:
        """Returns cotangents of all floating leaves, with None for leaves without a tangent."""
        constants, start, inputs = map(iter, found)
        return [
            [next(constants) if flag else None for flag in self.flags[0]],
            list(start),
            [next(inputs) if flag else None for flag in self.flags[2]],
        ]


def _is_primal(x: Any) -> bool:
    return isinstance(x, CustomVJPPrimal)


def _is_zero(x: Any) -> bool:
    return isinstance(x, SymbolicZero)


def _zeros(shape: tuple[int, ...], dtype: Any) -> Array:
    return jnp.zeros(shape, dtype)


def _row(x: Any, place: Array) -> Array:
    """Returns the entry of x at the index `place` of the first axis; zeros for a symbolic zero."""
    if _is_zero(x):
        return _zeros(x.aval.shape[1:], x.aval.dtype)
    return jax.lax.dynamic_index_in_dim(x, place, keepdims=False)


def _allowed(kept: State, began: Array) -> tuple[Array, Array]:
    """Returns the allowed reconstruction errors of q and v: ε^⅓ of the largest kept |q| and |v|.

    In a mechanism at rest, velocities are mere rounding errors. The scale of v therefore also
    includes the largest |q| divided by the duration of the rollout.
    """
    size, speed = (jnp.max(jnp.abs(x), initial=0) for x in (kept.q, kept.v))
    span = jnp.max(jnp.abs(kept.time - began))
    share = float(jnp.finfo(size.dtype).eps) ** (1 / 3)
    return share * size, share * (speed + numerics.safe_divide(size, span))


def _far(found: State, known: State, allowed: tuple[Array, Array]) -> Array:
    """Returns True where a reconstructed state differs too much from the kept one, or is NaN.

    Args:
        found: the reconstructed state.
        known: the kept state.
        allowed: the largest allowed errors of q and v.
    """
    far = jnp.zeros_like(failed(known.status))
    for x, y, most in ((found.q, known.q, allowed[0]), (found.v, known.v, allowed[1])):
        far |= ~(jnp.max(jnp.abs(x - y), initial=0) <= most)
    return far
