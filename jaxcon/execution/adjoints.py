"""Adjoints: memory of the reverse pass of a rollout, and truncation of its gradient.

The reverse pass needs the state before each step. An adjoint decides how to get it: keep all
states, keep some and recompute the others forward, or step back from the end (`reversible`). The
rollout itself is the same under every adjoint. Only `Truncated` and `Discounted` change its
derivative. In forward mode no states are kept.
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
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.execution.segments import bytes_of, equal_levels, kept, nested, split, whole_levels
from jaxcon.protocols import Adjoint
from jaxcon.staging.meshes import together
from jaxcon.step import StepInfo
from jaxcon.system.state import State

Inputs = tuple[Array, PyTree]
"""The index of a step and its control input."""
Carry = tuple[State, StepInfo]
"""A state, and the info of the step that led to it."""


@dataclass(frozen=True)
class Path:
    """The functions and inputs of a rollout, which `Adjoint.scan` runs.

    Attributes:
        step: function (state, (step index, control)) → (new state, info).
        record: function (state, info of the step to it) → the recorded values.
        start: the initial state.
        inputs: (step indices, controls), with a first axis of length `steps`.
        steps, every: the number of steps, and the number of steps from one record to the next.
        back: function (state, inputs of the step to it) → the state before that step. If steps
            cannot be undone, a text with the reason, for an error message.
    """

    step: Callable[[State, Inputs], tuple[State, StepInfo]]
    record: Callable[[State, StepInfo], PyTree]
    start: State
    inputs: PyTree
    steps: int
    every: int
    back: Callable[[State, Inputs], State] | str

    def scan(self, sizes: Sequence[int] = ()) -> tuple[State, Any]:
        """Runs the rollout with nested checkpoints. Returns the final state and the record.

        The reverse pass keeps the states at segment starts. It recomputes one innermost segment at
        a time and keeps all states of that segment.

        Args:
            sizes: segment lengths [steps], from the outermost level to the innermost.
        """
        within = [size for size in sizes if size < self.every]
        beyond = [size // self.every for size in sizes if size >= self.every]
        first = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), self.inputs)
        seen = jax.eval_shape(lambda s, x: self.step(s, x)[1], self.start, first)
        empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), seen)
        empty, _ = together((empty, self.start))  # on the same devices as the states

        def one(carry: Carry, inputs: Inputs) -> tuple[Carry, None]:
            return self.step(carry[0], inputs), None

        def without_info(carry: Carry) -> Carry:
            return carry[0], empty  # a segment keeps only the state at its start

        def several(state: State, inputs: Inputs) -> tuple[State, Any]:
            carry = state, empty
            (state, info), _ = nested(one, carry, inputs, self.every, within, without_info)
            return state, self.record(state, info)

        strides = split(self.inputs, self.steps // self.every, self.every)
        return nested(several, self.start, strides, self.steps // self.every, beyond)


@pytree
class EveryStep(Adjoint):
    """Keeps the state before each step, and no intermediate values of a step.

    The reverse pass recomputes each step before it differentiates it. Keeping the intermediate
    values of all steps would need ten times the memory. It would also be slower, since memory
    bandwidth is the bottleneck.
    """

    def scan(self, path: Path) -> tuple[State, Any]:
        """Runs a rollout. Returns its final state and its record."""
        return path.scan()

    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """Returns (steps,): a single level of checkpoints, which keeps one state for each step."""
        return (steps,)


@pytree
class Checkpoints(Adjoint):
    """Nested checkpoints: with L levels, the reverse pass keeps about L T^(1/L) of T states.

    The default, L = 2, keeps about 2 √T states. Each level beyond the first costs one more forward
    pass.

    Attributes:
        levels: the number of levels L, 2 by default; 1 is `EveryStep()`.
        segments: alternative to `levels`: the number of steps between checkpoints. A tuple gives
            one number per level, each a divisor of the number before it.
        budget: alternative to `levels`: memory for the kept states of one world [B]. The smallest L
            that meets the budget is chosen. The budget does not cover the derivative of one step,
            the record and the controls.

    References:
        Griewank, Walther, Algorithm 799: revolve, ACM Trans. Math. Softw. 26 (2000).
    """

    levels: int | None = static(default=None)
    segments: int | tuple[int, ...] | None = static(default=None)
    budget: float | None = static(default=None)

    def scan(self, path: Path) -> tuple[State, Any]:
        """Runs a rollout. Returns its final state and its record."""
        return path.scan(self.sizes(path.steps, path.start))

    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """Returns the number of states that each level of checkpoints keeps, outermost first.

        The last level keeps one state for each step of its segment.
        """
        return kept(steps, self.sizes(steps, state))

    def sizes(self, steps: int, state: State) -> tuple[int, ...]:
        """Returns the segment lengths [steps], from the outermost level to the innermost.

        Raises:
            ValueError: a field is out of range, more than one field is set, or no number of levels
                meets the budget.
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
            # more levels than halvings of the steps save nothing
            return whole_levels(steps, min(levels, steps.bit_length() + 1))
        checks.check("Checkpoints", "budget", self.budget, (), above=0)
        size = bytes_of(state)
        levels = range(1, steps.bit_length() + 2)
        choices = [f(steps, n) for n in levels for f in (whole_levels, equal_levels)]
        for sizes in choices:
            if sum(kept(steps, sizes)) * size <= self.budget:
                return sizes
        least = min(sum(kept(steps, sizes)) for sizes in choices) * size
        raise ValueError(
            f"Checkpoints: budget={self.budget} bytes do not hold the states that a rollout of"
            f" {steps} steps must keep; {least} bytes are the least for this state of {size} bytes."
        )


@pytree
class Truncated(Adjoint):
    """Truncates backpropagation: no gradient passes back through the start of every k-th step.

    Steps are thus grouped into segments of k steps. The gradient of a record reaches only the
    states and controls of the same segment. Gradients by parameters are sums over segments. Use it
    for chaotic scenes, whose exact gradient grows without bound.

    Attributes:
        steps: the segment length k [steps].
        within: the adjoint that determines the memory.
    """

    steps: int = static()
    within: Adjoint = EveryStep()

    def scan(self, path: Path) -> tuple[State, Any]:
        """Runs a rollout. Returns its final state and its record."""
        checks.count("Truncated", "steps", self.steps)

        def step(state: State, inputs: Inputs) -> tuple[State, StepInfo]:
            cut = (inputs[0] % self.steps == 0) & (inputs[0] > 0)
            return path.step(faded(state, ~cut), inputs)

        return self.within.scan(dataclasses.replace(path, step=step))

    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """Returns the number of states that the adjoint `within` keeps, by level."""
        return self.within.kept(steps, state)


@pytree
class Discounted(Adjoint):
    """Discounts the gradient: a contribution that passes back through n steps is multiplied by γⁿ.

    Attributes:
        factor: the discount factor γ per step, from 0 to 1, ().
        within: the adjoint that determines the memory.
    """

    factor: Any
    within: Adjoint = EveryStep()

    def scan(self, path: Path) -> tuple[State, Any]:
        """Runs a rollout. Returns its final state and its record."""
        if checks.check("Discounted", "factor", self.factor, least=0, most=1).shape:
            raise ValueError(
                f"Discounted: factor must be one number, got shape {jnp.shape(self.factor)}; map"
                " over several with jax.vmap."
            )

        def step(state: State, inputs: Inputs) -> tuple[State, StepInfo]:
            return path.step(faded(state, self.factor), inputs)

        return self.within.scan(dataclasses.replace(path, step=step))

    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """Returns the number of states that the adjoint `within` keeps, by level."""
        return self.within.kept(steps, state)


EVERY_STEP = EveryStep()


def check_adjoint(adjoint: Adjoint) -> None:
    """Checks that an adjoint is an instance of a class that derives from `jc.extend.Adjoint`.

    Calls its method `check`, too.

    Raises:
        TypeError: `adjoint` is a class, or does not derive from `jc.extend.Adjoint`.
        ValueError: `check` of a user's adjoint raises it.
    """
    if isinstance(adjoint, type) or not hasattr(adjoint, "scan"):
        raise TypeError(
            "rollout: adjoint must be a value such as jc.adjoints.EveryStep() or"
            f" jc.adjoints.Checkpoints(), got {adjoint!r}."
        )
    checks.derives("rollout", "adjoint", adjoint, Adjoint)
    adjoint.check()
    if isinstance(adjoint, Truncated | Discounted):
        check_adjoint(adjoint.within)


def _given(segments: int | tuple[int, ...]) -> tuple[int, ...]:
    """Checks the user's segment lengths and returns them as a tuple."""
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


def faded(state: State, factor: Scalar) -> State:
    """Returns the state unchanged, but multiplies its tangents and cotangents by a factor."""

    def fade(x: Array) -> Array:
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        return _fade(x, jnp.asarray(factor, x.dtype))

    return jax.tree.map(fade, state)


@jax.custom_jvp
def _fade(x: Array, factor: Array) -> Array:
    return x


@_fade.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    x, factor = primals
    return x, jnp.where(factor == 0, 0, factor * tangents[0])
