"""Steps of an optimiser that survive losses which are not finite: pure, for one jitted scan."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from jaxcon.core import numerics
from jaxcon.core.devices import over_devices
from jaxcon.core.pytree import pytree
from jaxcon.core.status import Status, failed
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import keep
from jaxcon.learning.leaves import Space
from jaxcon.simulation.recovery import contain

SMALLEST = 2.0**-20
"""Of the share of its step that an optimiser may take, below which a start is given up."""
RECOVERY = 1.05
"""By which that share grows with every good step, up to 1."""


class Stop(IntEnum):
    """Why a start takes no more steps."""

    RUNNING = 0
    STALLED = 1
    NOT_FINITE = 2
    LED_NOWHERE = 3


@pytree
class Best:
    """The least loss so far, where it was, what the loss returned beside it, and samples lost.

    A point at which more samples are not finite is never better: those may be the worst ones.
    """

    y: tuple[Array, ...]
    loss: Array
    aux: PyTree
    lost: Array


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
        refused: how many of these were taken back.
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
    refused: Array
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
        forward: whether gradients are taken in forward mode, number by number.
        mesh: over whose devices the samples lie; None for one.
    """

    loss: Callable[..., Any]
    space: Space
    optimizer: optax.GradientTransformationExtraArgs
    samples: int
    patience: int
    tolerance: float
    forward: bool = False
    mesh: Mesh | None = None

    def start(self, y: tuple[Array, ...], key: Any) -> Search:
        """A search that begins at y."""
        value, (aux, lost) = jax.eval_shape(self.evaluate, y, key)
        memory = self.optimizer.init(y)
        zero = jnp.zeros((), jnp.int32)
        none = jnp.full((), jnp.inf, value.dtype)
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux)
        best = Best(y, none, nothing, jnp.full((), max(self.samples, 1), lost.dtype))
        share = jnp.ones((), value.dtype)
        return Search(y, memory, (y, memory), best, none, zero, share, zero, zero, zero)

    def evaluate(self, y: Any, key: Any) -> tuple[Array, PyTree]:
        """Loss at y, aux there, and how many samples are not finite.

        Where there are samples the loss is the mean over those that are finite, if most are. The
        others have no gradient.
        """
        if not self.samples:
            value, aux = split(self.loss(self.space.decode(y)))
            return value, (aux, jnp.zeros((), jnp.int32))

        def one(y: Any, key: Any) -> Any:
            value, aux = split(self.loss(self.space.decode(y), key))
            good = jnp.isfinite(value)
            return (value, aux), jnp.where(good, Status.OK, Status.NON_FINITE).astype(jnp.int32)

        keys = jax.random.split(key, self.samples)
        every = jax.vmap(lambda y, k: contain(one, (y, k)), in_axes=(None, 0))
        every = every if self.mesh is None else over_devices(every, self.mesh)
        (values, aux), status = every(y, keys)
        lost = jnp.sum(failed(status), dtype=jnp.int32)
        count = jnp.maximum(self.samples - lost, 1).astype(values.dtype)
        mean = jnp.sum(jnp.where(failed(status), 0, values)) / count
        return jnp.where(2 * lost < self.samples, mean, jnp.nan), (aux, lost)

    def run(self, search: Search, limit: Array, key: Any, length: int) -> tuple[Search, Array]:
        """So many steps, or as many as are left up to the limit, and their losses, (length,)."""

        def one(search: Search, _: None) -> tuple[Search, Array]:
            active = (search.stop == Stop.RUNNING) & (search.step < limit)
            own = jax.random.fold_in(key, search.step + 1) if self.samples else None
            new, loss = self.step(search, own)
            return keep(active, new, search), jnp.where(active, loss, jnp.nan)

        new, losses = jax.lax.scan(one, search, None, length)
        if self.samples:
            new = keep(new.step > search.step, self.compare(new, (search.y, new.y), key), new)
        return new, losses

    def compare(self, search: Search, points: Any, key: Any) -> Search:
        """The search after points were judged by keys that stay the same: no lucky draw wins."""
        fixed = jax.random.fold_in(key, 0)
        y = jax.tree.map(lambda *x: jnp.stack(x), *points)
        found = jax.vmap(lambda y: self.evaluate(y, fixed))(y)
        for i in range(len(points)):
            search = self.judge(search, points[i], *jax.tree.map(lambda x, i=i: x[i], found))
        return search

    def step(self, search: Search, key: Any) -> tuple[Search, Array]:
        """One step, and the loss before it; where that is not finite, back to where it was."""
        (loss, seen), slope = self.slope(search.y, key)
        good = jnp.isfinite(loss) & numerics.all_finite(slope)
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
        led = numerics.all_finite(moved)
        stop = jnp.where(share < SMALLEST, Stop.NOT_FINITE, Stop.RUNNING)
        stop = jnp.where(good & ~led, Stop.LED_NOWHERE, stop)
        here = search.y, search.memory
        y, memory = keep(good, keep(led, (moved, memory), here), search.last)
        new = dataclasses.replace(
            search,
            y=y,
            memory=memory,
            last=keep(good, here, search.last),
            share=share,
            step=search.step + 1,
            refused=search.refused + (~good).astype(search.refused.dtype),
            stop=stop.astype(search.stop.dtype),
        )
        return (new if self.samples else self.judge(new, search.y, loss, seen)), loss

    def slope(self, y: Any, key: Any) -> Any:
        """(loss, (aux, lost)) and the gradient."""
        if not self.forward:
            return jax.value_and_grad(self.evaluate, has_aux=True)(y, key)
        with jax.numpy_dtype_promotion("standard"):  # leaves may have several precisions
            flat, back = ravel_pytree(y)

        def push(tangent: Array) -> Any:
            return jax.jvp(lambda y: self.evaluate(back(y), key), (flat,), (tangent,), has_aux=True)

        value, slope, seen = jax.vmap(push, out_axes=(None, 0, None))(
            jnp.eye(flat.size, dtype=flat.dtype)
        )
        return (value, seen), back(slope)

    def judge(self, search: Search, y: Any, loss: Array, seen: tuple[PyTree, Array]) -> Search:
        """The search after y was found to have this loss, aux and number of lost samples."""
        aux, lost = seen
        fewer = lost < search.best.lost
        less = (lost == search.best.lost) & (loss < search.best.loss)
        best = keep(jnp.isfinite(loss) & (fewer | less), Best(y, loss, aux, lost), search.best)
        progress = (best.lost < search.best.lost) | (best.loss < search.mark - self.tolerance)
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
    number = isinstance(value, float | np.ndarray | np.generic | jax.Array)
    if not number or jnp.shape(value) or not jnp.issubdtype(jnp.result_type(value), jnp.floating):
        raise TypeError(
            "tune: the loss must return a floating scalar, or a pair of one and anything else; got"
            f" {value!r}."
        )
    return jnp.asarray(value), jax.tree.map(jnp.asarray, aux)
