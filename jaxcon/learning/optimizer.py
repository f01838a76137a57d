"""The default optimizer of `tune`: Adam, then quasi-Newton steps within a trust region."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import optax

from jaxcon.core import numerics
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import keep
from jaxcon.learning.leaves import Space, flat

RATE = 0.2
"""Rate of Adam at the start: a step of 20 % of a positive leaf."""
CUT = 0.99
"""Share of the trust radius from which on a step counts as cut off by it."""


@dataclass(frozen=True)
class SearchAware:
    """An optimizer that knows the search so far, and may go back to its best point.

    Transformations of optax always step from the present point.

    Attributes:
        init: y → memory.
        update: (slope, memory, y, loss, search) → ((point, step), memory); the point from which it
            steps is a `Best`.
    """

    init: Callable[[PyTree], Any]
    update: Callable[..., tuple[tuple[Any, PyTree], Any]]


@pytree
class Memory:
    """State of the optimizer.

    Attributes:
        adam: state of Adam.
        count: updates so far.
        radius: of the trust region, the largest change of a coordinate.
        length: of the last quasi-Newton step, its largest change of a coordinate.
    """

    adam: PyTree
    count: Array
    radius: Array
    length: Array


def adam(steps: int) -> optax.GradientTransformation:
    """Adam with a rate that falls from `RATE` to 0 along a cosine."""
    return optax.adam(optax.cosine_decay_schedule(RATE, steps))


def adam_then_newton(space: Space, steps: int) -> SearchAware:
    """Adam for the first half of the steps, then quasi-Newton steps from the best point.

    Adam crosses hills and survives a poor start, but creeps along narrow valleys, where the step
    −H⁻¹ g by the secant pairs of the search converges fast. A step that does not lower the loss is
    repeated from the best point with half its length; one that does, and was cut off by the trust
    region, doubles the radius.

    Args:
        space: of the parameters, for their bounds.
        steps: of the whole search.
    """
    half = steps // 2
    first = adam(max(half, 1))

    def init(y: PyTree) -> Memory:
        x = flat(y)[0]
        zero = jnp.zeros((), x.dtype)
        return Memory(first.init(y), jnp.zeros((), jnp.int32), zero + RATE, zero)

    def update(slope: PyTree, memory: Memory, y: PyTree, loss: Array, search: Any) -> Any:
        step, state = first.update(slope, memory.adam, y)
        best = search.best
        here = dataclasses.replace(best, y=y, slope=slope, loss=loss)
        known = numerics.all_finite(best.slope)  # the loss may have a least where it has a kink
        base = keep(known, best, here)
        (x, back), (origin, _), (g, _) = flat(y), flat(base.y), flat(base.slope)
        radius = _radius(memory, jnp.max(jnp.abs(x - origin)), memory.count > half)
        d = search.secants.newton_step(g, space.free(base.y, base.slope))
        longest = jnp.max(jnp.abs(d))
        d = d * jnp.minimum(1, radius / jnp.where(longest > 0, longest, 1))
        newton = (memory.count >= half) & jnp.all(jnp.isfinite(d))
        length = jnp.where(newton, jnp.max(jnp.abs(d)), 0)
        chosen = keep(newton, (base, back(d)), (here, step))
        return chosen, Memory(state, memory.count + 1, radius, length)

    return SearchAware(init, update)


def _radius(memory: Memory, away: Array, judged: Array) -> Array:
    """The trust radius after a step.

    Args:
        memory: before it.
        away: distance of the point from the best one; 0 where the step lowered the loss.
        judged: whether it was a quasi-Newton step.
    """
    cut = memory.length > CUT * memory.radius
    wider = jnp.where(cut, 2 * memory.radius, memory.radius)
    return jnp.where(judged, jnp.where(away > 0, away / 2, wider), memory.radius)
