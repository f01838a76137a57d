"""The default optimizer of `tune`: Adam, then quasi-Newton steps within a trust region."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import jax.numpy as jnp
import optax

from jaxcon.core import numerics
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.learning.leaves import Space, flat
from jaxcon.staging.worlds import where_tree

if TYPE_CHECKING:
    from jaxcon.learning.descent import Best, Search

RATE = 0.2
"""The initial learning rate of Adam: it changes a positive leaf by 20 % in a step."""
CUT = 0.99
"""The share of the trust radius above which a step counts as limited by the radius."""

Step: TypeAlias = tuple[tuple["Best", tuple[Array, ...]], "OptimizerMemory"]
"""The point from which to step, with the step; and the optimizer's state after the step."""


@dataclass(frozen=True)
class SearchAware:
    """An optimizer that sees the state of the search and may step from the best point.

    Transformations of optax, in contrast, always step from the current point.

    Attributes:
        init: function from y to the initial memory of the optimizer.
        update: function (slope, memory, y, loss, search) → ((point, step), memory). `point` is a
            `Best`, the point from which the optimizer steps.
    """

    init: Callable[[tuple[Array, ...]], OptimizerMemory]
    update: Callable[[tuple[Array, ...], OptimizerMemory, tuple[Array, ...], Array, Search], Step]


@pytree
class OptimizerMemory:
    """The state of the default optimizer.

    Attributes:
        adam: state of Adam.
        count: number of updates, ().
        radius: trust radius, the largest allowed change of a search coordinate, ().
        length: the largest change of a search coordinate by the last quasi-Newton step, ().
    """

    adam: optax.OptState
    count: Array
    radius: Array
    length: Array


def adam(steps: int) -> optax.GradientTransformation:
    """Returns Adam with a learning rate that decays from `RATE` to 0 along a cosine.

    Args:
        steps: number of steps of the decay.
    """
    return optax.adam(optax.cosine_decay_schedule(RATE, steps))


def adam_then_newton(space: Space, steps: int) -> SearchAware:
    """Returns an optimizer: Adam for the first half of the steps, then quasi-Newton steps.

    Adam crosses hills and copes with a poor start, but is slow in narrow valleys. There the
    quasi-Newton step −H⁻¹ g converges fast; H is the estimated Hessian and g the gradient at the
    best point. If such a step does not lower the loss, it is repeated from the best point with half
    its length. If it lowers the loss and was limited by the trust region, the radius is doubled.

    Args:
        space: search coordinates of the parameters, with their bounds.
        steps: number of steps of the whole search.
    """
    half = steps // 2
    first = adam(max(half, 1))

    def init(y: tuple[Array, ...]) -> OptimizerMemory:
        """Returns the optimizer's state before the first step."""
        x = flat(y)[0]
        zero = jnp.zeros((), x.dtype)
        return OptimizerMemory(first.init(y), jnp.zeros((), jnp.int32), zero + RATE, zero)

    def update(
        slope: tuple[Array, ...],
        memory: OptimizerMemory,
        y: tuple[Array, ...],
        loss: Array,
        search: Search,
    ) -> Step:
        """Returns a step of Adam in the first half of the search, then a quasi-Newton step."""
        assert search.secants is not None
        step: Any
        step, state = first.update(slope, memory.adam, y)
        best = search.best
        here = dataclasses.replace(best, y=y, slope=slope, loss=loss)
        # the minimum may lie at a kink, where the gradient is not finite
        base = where_tree(numerics.all_finite(best.slope), best, here)
        (x, back), (origin, _), (g, _) = flat(y), flat(base.y), flat(base.slope)
        away = jnp.max(jnp.abs(x - origin))
        radius = _radius(memory, away, memory.count > half)
        d = search.secants.newton_step(g, space.free(base.y, base.slope))
        longest = jnp.max(jnp.abs(d))
        d = d * jnp.minimum(1, radius / jnp.where(longest > 0, longest, 1))
        newton = (memory.count >= half) & jnp.all(jnp.isfinite(d))
        length = jnp.where(newton, jnp.max(jnp.abs(d)), 0)
        chosen = where_tree(newton, (base, back(d)), (here, step))
        return chosen, OptimizerMemory(state, memory.count + 1, radius, length)

    return SearchAware(init, update)


def _radius(memory: OptimizerMemory, away: Array, judged: Array) -> Array:
    """Returns the trust radius after a step.

    After a step that did not lower the loss, it is half the length of that step. After a step that
    lowered the loss and was limited by the radius, it is doubled.

    Args:
        memory: the state before the step.
        away: distance from the current point to the best one, (); 0 if the step lowered the loss.
        judged: True if the step was a quasi-Newton step, (); otherwise the radius does not change.
    """
    cut = memory.length > CUT * memory.radius
    wider = jnp.where(cut, 2 * memory.radius, memory.radius)
    return jnp.where(judged, jnp.where(away > 0, away / 2, wider), memory.radius)
