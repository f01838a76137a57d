"""What the reverse pass of a rollout keeps, and how far back it goes.

The reverse pass needs the state before each step. It can keep all of them, or some, between which
it steps forward once more, or step back (`reversible`). An adjoint is a value that says which; it
changes neither the rollout nor, but for `Truncated` and `Discounted`, its derivative. Forward mode
keeps nothing.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.meshes import together
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import State
from jaxcon.simulation.segments import bytes_of, equal_levels, kept, nested, split, whole_levels


@dataclass(frozen=True)
class Path:
    """What a rollout does.

    Attributes:
        step: (state, (number of the step, control)) → (new state, what the step saw).
        record: (state, what the last step saw) → what to keep of every so many steps.
        start: the first state.
        inputs: of all steps, by first axis.
        steps, every: how many, and the stride of the record.
        back: (state, what the step that led there was given) → the state before; or why there is
            no such function.
    """

    step: Callable[[State, Any], tuple[State, Any]]
    record: Callable[[State, Any], PyTree]
    start: State
    inputs: PyTree
    steps: int
    every: int
    back: Callable[[State, Any], State] | str

    def scan(self, sizes: Sequence[int] = ()) -> tuple[State, PyTree]:
        """The final state and the record, with segments of so many steps, each in the one before.

        The reverse pass keeps the states at which segments start, and, of one innermost segment at
        a time, those of all its steps.
        """
        within = [size for size in sizes if size < self.every]
        beyond = [size // self.every for size in sizes if size >= self.every]
        first = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), self.inputs)
        seen = jax.eval_shape(lambda s, x: self.step(s, x)[1], self.start, first)
        empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), seen)
        empty, _ = together((empty, self.start))  # as what the steps see

        def one(known: tuple[State, Any], given: Any) -> tuple[tuple[State, Any], None]:
            return self.step(known[0], given), None

        def unseen(known: tuple[State, Any]) -> tuple[State, Any]:
            return known[0], empty  # a segment keeps no more than the state at its start

        def several(state: State, given: Any) -> tuple[State, PyTree]:
            known = state, empty
            (state, seen), _ = nested(one, known, given, self.every, within, unseen)
            return state, self.record(state, seen)

        strides = split(self.inputs, self.steps // self.every, self.every)
        return nested(several, self.start, strides, self.steps // self.every, beyond)


@pytree
class EveryStep:
    """Each step is a checkpoint: T states are kept, and nothing from inside a step.

    The reverse pass evaluates each step once more, as part of its derivative. Keeping what lies
    inside the steps, too, takes ten times the memory, and more time, since memory is what is slow.
    """

    def scan(self, path: Path) -> tuple[State, PyTree]:
        """The final state and the record of a path."""
        return path.scan()

    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """How many states are kept, by level: those of all steps."""
        return (steps,)


@pytree
class Checkpoints:
    """Nested checkpoints: L levels keep about L T^(1/L) states, 2 √T unless told otherwise.

    Each level beyond the first costs one more forward pass.

    Attributes:
        levels: L, 2 unless given; 1 is `EveryStep()`.
        segments: in place of L, how many steps there are from a checkpoint to the next; or several
            such numbers, each a divisor of the one before, a segment of one level being cut into
            those of the next.
        budget: in place of L, how many bytes the states kept of one world may take; what the
            derivative of one step needs, the record and the controls come on top. The fewest levels
            are chosen that are enough.

    References:
        Griewank, Walther, Algorithm 799: revolve, ACM Trans. Math. Softw. 26 (2000).
    """

    levels: int | None = static(default=None)
    segments: int | tuple[int, ...] | None = static(default=None)
    budget: float | None = static(default=None)

    def scan(self, path: Path) -> tuple[State, PyTree]:
        """The final state and the record of a path."""
        return path.scan(self.sizes(path.steps, path.start))

    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """How many states are kept, by level; the last are those of single steps."""
        return kept(steps, self.sizes(steps, state))

    def sizes(self, steps: int, state: State) -> tuple[int, ...]:
        """The lengths of the segments by level [steps].

        Raises:
            ValueError: numbers out of range, or a budget that no number of levels meets.
        """
        if sum(x is not None for x in (self.levels, self.segments, self.budget)) > 1:
            raise ValueError(
                "Checkpoints: levels, segments and budget exclude each other; give one."
            )
        if self.segments is not None:
            return _given(self.segments)
        if self.budget is None:
            levels = 2 if self.levels is None else self.levels
            checks.count("Checkpoints", "levels", levels, most=64)
            # more levels than halvings of the steps keep nothing less
            return whole_levels(steps, min(levels, steps.bit_length() + 1))
        checks.check("Checkpoints", "budget", self.budget, (), above=0)
        own = bytes_of(state)
        levels = range(1, steps.bit_length() + 2)
        choices = [f(steps, n) for n in levels for f in (whole_levels, equal_levels)]
        for sizes in choices:
            if sum(kept(steps, sizes)) * own <= self.budget:
                return sizes
        least = min(sum(kept(steps, sizes)) for sizes in choices) * own
        raise ValueError(
            f"Checkpoints: budget={self.budget} bytes do not hold the states that a rollout of"
            f" {steps} steps must keep; {least} bytes are the least for this state of {own} bytes."
        )


@pytree
class Truncated:
    """The gradient is cut every k steps: step i does not pass it back where i is a multiple of k.

    What is recorded has the gradient by the states and controls of its own piece of k steps, and
    by parameters the sum over pieces. For chaotic scenes, whose true gradient grows without bound.

    Attributes:
        steps: k.
        within: the adjoint of the memory.
    """

    steps: int = static()
    within: Any = EveryStep()

    def scan(self, path: Path) -> tuple[State, PyTree]:
        """The final state and the record of a path."""
        checks.count("Truncated", "steps", self.steps)

        def step(state: State, given: Any) -> tuple[State, Any]:
            cut = (given[0] % self.steps == 0) & (given[0] > 0)
            return path.step(faded(state, ~cut), given)

        return self.within.scan(dataclasses.replace(path, step=step))

    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """How many states the adjoint within keeps."""
        return self.within.kept(steps, state)


@pytree
class Discounted:
    """The gradient shrinks on its way back: what passes n steps counts γⁿ.

    Attributes:
        factor: γ, from 0 to 1, ().
        within: the adjoint of the memory.
    """

    factor: Any
    within: Any = EveryStep()

    def scan(self, path: Path) -> tuple[State, PyTree]:
        """The final state and the record of a path."""
        if checks.check("Discounted", "factor", self.factor, least=0, most=1).shape:
            raise ValueError(
                f"Discounted: factor must be one number, got shape {jnp.shape(self.factor)}; map"
                " over several with jax.vmap."
            )

        def step(state: State, given: Any) -> tuple[State, Any]:
            return path.step(faded(state, self.factor), given)

        return self.within.scan(dataclasses.replace(path, step=step))

    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """How many states the adjoint within keeps."""
        return self.within.kept(steps, state)


EVERY_STEP = EveryStep()


def check_adjoint(adjoint: Any) -> None:
    """Checks that it is a value such as `Checkpoints()`.

    Raises:
        TypeError: it is a class, a name, or something else.
    """
    if isinstance(adjoint, type) or not hasattr(adjoint, "scan"):
        raise TypeError(
            "rollout: adjoint must be a value such as jc.EveryStep() or jc.Checkpoints(),"
            f" got {adjoint!r}."
        )
    if hasattr(adjoint, "within"):
        check_adjoint(adjoint.within)


def _given(segments: int | tuple[int, ...]) -> tuple[int, ...]:
    """The lengths of segments as the user gave them, checked."""
    if isinstance(segments, list) or (isinstance(segments, tuple) and not segments):
        raise ValueError(
            f"Checkpoints: give segments as a tuple of one number or more, got {segments}."
        )
    sizes = segments if isinstance(segments, tuple) else (segments,)
    for size in sizes:
        checks.count("Checkpoints", "segments", size)
    if any(a % b for a, b in itertools.pairwise(sizes)):
        raise ValueError(
            f"Checkpoints: segments={segments}: each must be a divisor of the one before."
        )
    return sizes


def faded(state: State, factor: Any) -> State:
    """Returns the state with its tangents and cotangents multiplied by a factor."""

    def one(x: Array) -> Array:
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        return _fade(x, jnp.asarray(factor, x.dtype))

    return jax.tree.map(one, state)


@jax.custom_jvp
def _fade(x: Array, factor: Array) -> Array:
    return x


@_fade.defjvp
def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
    x, factor = primals
    return x, jnp.where(factor == 0, 0, factor * tangents[0])
