"""Steps of an optimiser that survive losses which are not finite: pure, for one jitted scan."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxcon.core.native import keep
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree
from jaxcon.learning.leaves import Space

SMALLEST = 2.0**-20
"""Of the share of its step that an optimiser may take, below which a start is given up."""
RECOVERY = 1.05
"""By which that share grows with every good step, up to 1."""


class Stop(IntEnum):
    """Why a start takes no more steps."""

    RUNNING = 0
    STALLED = 1
    NOT_FINITE = 2


@pytree
class Best:
    """The least loss so far, where it was, and what the loss returned beside it."""

    y: tuple[Array, ...]
    loss: Array
    aux: PyTree


@pytree
class Search:
    """One start on its way.

    Attributes:
        y: where it is.
        memory: of the optimiser.
        last: (y, memory) at the last evaluation that was finite.
        best: so far.
        mark: the loss that must be undercut by the tolerance.
        since: the step of the mark.
        share: of the optimiser's step that is taken; halved where the loss is not finite.
        step: how many were taken.
        stop: a `Stop`.
    """

    y: tuple[Array, ...]
    memory: PyTree
    last: PyTree
    best: Best
    mark: Array
    since: Array
    share: Array
    step: Array
    stop: Array


@dataclass(frozen=True)
class Descent:
    """How a loss is descended.

    Attributes:
        loss: params → loss or (loss, aux); (params, key) → the same where there are samples.
        space: of the parameters.
        optimizer: of optax.
        samples: over how many keys the loss is averaged; 0 for a loss that takes none.
        patience: steps without progress after which a start stops.
        tolerance: a fall of the loss that counts as progress.
    """

    loss: Callable[..., Any]
    space: Space
    optimizer: optax.GradientTransformationExtraArgs
    samples: int
    patience: int
    tolerance: float

    def start(self, y: tuple[Array, ...], key: Any) -> Search:
        """A search that begins at y."""
        value, aux = jax.eval_shape(self.evaluate, y, key)
        memory = self.optimizer.init(y)
        zero = jnp.zeros((), jnp.int32)
        none = jnp.full((), jnp.inf, value.dtype)
        best = Best(y, none, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux))
        share = jnp.ones((), value.dtype)
        return Search(y, memory, (y, memory), best, none, zero, share, zero, zero)

    def evaluate(self, y: Any, key: Any) -> tuple[Array, PyTree]:
        """Loss and aux at y; the mean over keys and all aux where there are samples."""
        params = self.space.decode(y)
        if not self.samples:
            return split(self.loss(params))
        keys = jax.random.split(key, self.samples)
        values, aux = jax.vmap(lambda k: split(self.loss(params, k)))(keys)
        return jnp.mean(values), aux

    def run(self, search: Search, limit: Array, key: Any, length: int) -> tuple[Search, Array]:
        """So many steps, or as many as are left up to the limit, and their losses, (length,)."""

        def one(search: Search, _: None) -> tuple[Search, Array]:
            active = (search.stop == Stop.RUNNING) & (search.step < limit)
            own = jax.random.fold_in(key, search.step + 1) if self.samples else None
            new, loss = self.step(search, own)
            return keep(active, new, search), jnp.where(active, loss, jnp.nan)

        new, losses = jax.lax.scan(one, search, None, length)
        if self.samples:  # always the same keys, so that a lucky draw does not win
            judged = self.judge(new, new.y, *self.evaluate(new.y, jax.random.fold_in(key, 0)))
            new = keep(new.step > search.step, judged, new)
        return new, losses

    def step(self, search: Search, key: Any) -> tuple[Search, Array]:
        """One step, and the loss before it; where that is not finite, back to where it was."""
        (loss, aux), slope = jax.value_and_grad(self.evaluate, has_aux=True)(search.y, key)
        good = jnp.isfinite(loss)
        for x in jax.tree.leaves(slope):
            good &= jnp.all(jnp.isfinite(x))
        # optax counts on promotion, whatever the rest of a program is held to
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            update, memory = self.optimizer.update(
                slope,
                search.memory,
                search.y,
                value=loss,
                grad=slope,
                value_fn=lambda y: self.evaluate(self.space.clip(y), key)[0],
            )
        share = jnp.where(good, jnp.minimum(1, RECOVERY * search.share), search.share / 2)
        ahead = jax.tree.map(
            lambda y, u: y + share.astype(y.dtype) * u.astype(y.dtype), search.y, update
        )
        moved = self.space.clip(ahead)
        stop = jnp.where(share < SMALLEST, Stop.NOT_FINITE, Stop.RUNNING)
        y, memory = keep(good, (moved, memory), search.last)
        new = dataclasses.replace(
            search,
            y=y,
            memory=memory,
            last=keep(good, (search.y, search.memory), search.last),
            share=share,
            step=search.step + 1,
            stop=stop.astype(search.stop.dtype),
        )
        return (new if self.samples else self.judge(new, search.y, loss, aux)), loss

    def judge(self, search: Search, y: Any, loss: Array, aux: PyTree) -> Search:
        """The search after y was found to have this loss."""
        better = jnp.isfinite(loss) & (loss < search.best.loss)
        best = keep(better, Best(y, loss, aux), search.best)
        progress = best.loss < search.mark - self.tolerance
        since = jnp.where(progress, search.step, search.since)
        stalled = (search.stop == Stop.RUNNING) & (search.step - since >= self.patience)
        stop = jnp.where(stalled, Stop.STALLED, search.stop).astype(search.stop.dtype)
        mark = jnp.where(progress, best.loss, search.mark)
        return dataclasses.replace(search, best=best, mark=mark, since=since, stop=stop)


def split(result: Any) -> tuple[Array, PyTree]:
    """(loss, aux) of what a user's loss returned.

    Raises:
        TypeError: the loss is no floating scalar.
    """
    value: Any
    value, aux = result if isinstance(result, tuple) and len(result) == 2 else (result, ())
    if jnp.shape(value) != () or not jnp.issubdtype(jnp.result_type(value), jnp.floating):
        raise TypeError(
            "tune: the loss must return a floating scalar, or a pair of one and anything else; got"
            f" {value!r}."
        )
    return jnp.asarray(value), jax.tree.map(jnp.asarray, aux)
