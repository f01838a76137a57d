"""Steps of an optimizer that survive losses which are not finite: pure, for one jitted scan."""

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
from jax.sharding import Mesh

from jaxcon.core import checks, functions, numerics
from jaxcon.core.devices import over_devices
from jaxcon.core.pytree import pytree
from jaxcon.core.status import Status, failed
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import keep
from jaxcon.learning.curvature import Secants
from jaxcon.learning.leaves import Space, flat
from jaxcon.learning.optimizer import SearchAware
from jaxcon.simulation.recovery import contain

RETRIES = 20
"""Steps from one point, each half as long as the one before, after which a start is given up."""
RECOVERY = 1.2
"""Factor by which the share of the optimizer's step grows with every good step, up to 1."""
WORSE = 1000.0
"""Factor by which a step must multiply the loss to be taken back."""


class Stop(IntEnum):
    """The reason why a start takes no more steps."""

    RUNNING = 0
    STALLED = 1
    NO_STEP = 2
    LED_NOWHERE = 3


@pytree
class Best:
    """The point of the least loss so far.

    A point at which more samples are not finite is never better: those may be the worst ones.

    Attributes:
        y: the point.
        slope: gradient of the loss there; zero where the loss takes samples.
        loss: there.
        aux: what the loss returned beside it.
        lost: how many samples were not finite.
        step: how many steps led there.
    """

    y: tuple[Array, ...]
    slope: tuple[Array, ...]
    loss: Array
    aux: PyTree
    lost: Array
    step: Array


@pytree
class Origin:
    """The last accepted point, from which a step that fails is tried again.

    Attributes:
        y: the point.
        slope: gradient of the loss there.
        loss: there.
        update: step of the optimizer from there.
        memory: of the optimizer after that step.
    """

    y: tuple[Array, ...]
    slope: tuple[Array, ...]
    loss: Array
    update: PyTree
    memory: PyTree


@pytree
class Search:
    """One start on its way.

    Attributes:
        y: the point that is looked at next.
        origin: the accepted point from which a step led there.
        best: so far.
        first: the loss at the first accepted point, NaN before.
        highest: the largest loss of an accepted point.
        mark: the loss that must be undercut by the tolerance.
        since: the step of the mark.
        share: of the optimizer's step that is taken; halved where a step is taken back.
        tries: steps in a row that were taken back.
        step: how many were taken.
        refused: how many of these were taken back.
        stop: a `Stop`.
        secants: pairs of steps and changes of the gradient; None where the loss takes samples.
        ahead: the quasi-Newton step from the best point, (n,); NaN where nothing tells it.
    """

    y: tuple[Array, ...]
    origin: Origin
    best: Best
    first: Array
    highest: Array
    mark: Array
    since: Array
    share: Array
    tries: Array
    step: Array
    refused: Array
    stop: Array
    secants: Secants | None
    ahead: Array

    @property
    def accepted(self) -> Array:
        """True where some point was accepted."""
        return ~jnp.isnan(self.first)


@dataclass(frozen=True)
class Descent:
    """The descent of a loss: what is fixed during a search.

    Attributes:
        loss: params → loss or (loss, aux); (params, key) → the same where there are samples.
        space: of the parameters.
        optimizer: of optax, or the default one.
        samples: over how many keys the loss is averaged; 0 for a loss that takes none.
        patience: steps without progress after which a start stops.
        tolerance: a fall of the loss that counts as progress.
        forward: whether gradients are taken in forward mode, number by number.
        mesh: over whose devices the samples lie; None for one.
    """

    loss: Callable[..., Any]
    space: Space
    optimizer: optax.GradientTransformationExtraArgs | SearchAware
    samples: int
    patience: int
    tolerance: float
    forward: bool = False
    mesh: Mesh | None = None

    def start(self, y: tuple[Array, ...], key: Any) -> Search:
        """A search that begins at y."""
        value, (aux, lost) = jax.eval_shape(self.evaluate, y, key)
        none, zeros = jnp.zeros((), jnp.int32), jax.tree.map(jnp.zeros_like, y)
        infinite = jnp.full((), jnp.inf, value.dtype)
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux)
        all_lost = jnp.full((), max(self.samples, 1), lost.dtype)
        x = flat(y)[0]
        return Search(
            y=y,
            origin=Origin(y, zeros, infinite, zeros, self.optimizer.init(y)),
            best=Best(y, zeros, infinite, nothing, all_lost, none),
            first=jnp.full_like(infinite, jnp.nan),
            highest=-infinite,
            mark=infinite,
            since=none,
            share=jnp.ones((), value.dtype),
            tries=none,
            step=none,
            refused=none,
            stop=none,
            secants=None if self.samples else Secants.none(x),
            ahead=jnp.full_like(x, jnp.nan),
        )

    def _loss(self, *args: Any) -> tuple[Array, PyTree]:
        """(loss, aux) of the user's function."""
        return split(functions.call("tune", "loss", self.loss, *args))

    def evaluate(self, y: Any, key: Any) -> tuple[Array, PyTree]:
        """Loss at y, aux there, and how many samples are not finite.

        Where there are samples the loss is the mean over those that are finite, if most are. The
        others have no gradient.
        """
        if not self.samples:
            value, aux = self._loss(self.space.decode(y))
            return value, (aux, jnp.zeros((), jnp.int32))

        def one(y: Any, key: Any) -> Any:
            value, aux = self._loss(self.space.decode(y), key)
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
        if new.secants is None:
            return keep(new.step > search.step, self.compare(search, new, key), new), losses
        best = new.best
        ahead = new.secants.newton_step(flat(best.slope)[0], self.space.free(best.y, best.slope))
        return dataclasses.replace(new, ahead=ahead), losses

    def compare(self, before: Search, after: Search, key: Any) -> Search:
        """The search after both ends of a chunk were judged by the same keys: no lucky draw wins.

        An end that is not finite, or has run away, is taken back to the beginning of the chunk.
        """
        fixed = jax.random.fold_in(key, 0)
        y = jax.tree.map(lambda *x: jnp.stack(x), before.y, after.y)
        losses, seen = jax.vmap(lambda y: self.evaluate(y, fixed))(y)
        seen = [jax.tree.map(lambda x, i=i: x[i], seen) for i in range(2)]
        search, failed = after, jnp.asarray(False)
        for i, at in enumerate((before, after)):
            aux, lost = seen[i]
            point = Best(at.y, search.best.slope, losses[i], aux, lost, at.step)
            failed = ~jnp.isfinite(losses[i]) | self.runs_away(search, losses[i], losses[0])
            search = self.judge(self.accept(search, losses[i], ~failed), point)
        half = after.share / 2
        back = dataclasses.replace(search, y=before.y, origin=before.origin, share=half)
        return keep(failed & jnp.isfinite(losses[0]), back, search)

    def step(self, search: Search, key: Any) -> tuple[Search, Array]:
        """One step, and the loss before it; where that fails, a shorter one from the origin."""
        (loss, (aux, lost)), slope = self.slope(search.y, key)
        good = jnp.isfinite(loss) & numerics.all_finite(slope)
        point = Best(search.y, slope, loss, aux, lost, search.step)
        search = dataclasses.replace(search, step=search.step + 1)
        if search.secants is not None:
            good &= ~self.runs_away(search, loss, search.origin.loss)
            learned = self.learned(search, search.secants, slope)
            secants = keep(good & search.accepted, learned, search.secants)
            search = dataclasses.replace(search, secants=secants)
            search = self.judge(self.accept(search, loss, good), point)
        origin = keep(good, self.leave(search, loss, slope, key), search.origin)
        share = jnp.where(good, jnp.minimum(1, RECOVERY * search.share), search.share / 2)
        ahead = jax.tree.map(
            lambda y, u: y + share.astype(y.dtype) * u.astype(y.dtype), origin.y, origin.update
        )
        moved = self.space.clip(ahead)
        led = numerics.all_finite(moved)
        tries = jnp.where(good, 0, search.tries + 1)
        stop = jnp.where(tries > RETRIES, Stop.NO_STEP, search.stop)
        stop = jnp.where(good & ~led, Stop.LED_NOWHERE, stop)
        new = dataclasses.replace(
            search,
            y=keep(led, moved, origin.y),
            origin=origin,
            share=share,
            tries=tries,
            refused=search.refused + (~good).astype(search.refused.dtype),
            stop=stop.astype(search.stop.dtype),
        )
        return new, loss

    def leave(self, search: Search, loss: Array, slope: tuple[Array, ...], key: Any) -> Origin:
        """The point from which the optimizer steps after it saw this one, and its step."""
        memory = search.origin.memory
        # optax counts on promotion, whatever the rest of a program is held to
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            if isinstance(self.optimizer, SearchAware):
                moved, memory = self.optimizer.update(slope, memory, search.y, loss, search)
                point, update = moved
                return Origin(point.y, point.slope, point.loss, update, memory)
            update, memory = self.optimizer.update(
                slope,
                memory,
                search.y,
                value=loss,
                grad=slope,
                value_fn=lambda y: self.evaluate(self.space.clip(y), key)[0],
            )
        return Origin(search.y, slope, loss, update, memory)

    def runs_away(self, search: Search, loss: Array, before: Array) -> Array:
        """Returns True where a step makes the loss so much worse that it is taken back.

        It is a thousand times that before the step; or above all accepted ones by ten times their
        range, or by the range and the size of the first one. The latter holds for losses of any
        sign, logarithms too. A rise by a hundredth of the first one is never judged, nor is
        rounding around a loss of zero.
        """
        size, span = jnp.abs(search.first), search.highest - search.best.loss
        rounding = jnp.finfo(loss.dtype).eps * size
        thousandfold = (search.best.loss >= 0) & (loss > WORSE * jnp.maximum(before, rounding))
        rise = jnp.minimum(jnp.maximum(size, span), jnp.maximum(size / 100, 10 * span))
        return search.accepted & (thousandfold | (loss > search.highest + rise))

    @staticmethod
    def accept(search: Search, loss: Array, good: Array) -> Search:
        """The search after a loss was found good, or not."""
        first = jnp.where(good & ~search.accepted, loss, search.first)
        highest = jnp.where(good, jnp.maximum(loss, search.highest), search.highest)
        return dataclasses.replace(search, first=first, highest=highest)

    @staticmethod
    def learned(search: Search, secants: Secants, slope: tuple[Array, ...]) -> Secants:
        """The secant pairs with that of the step from the origin to a point of this slope."""
        origin, g = search.origin, flat(slope)[0]
        step = flat(search.y)[0] - flat(origin.y)[0]
        return secants.add(step, g - flat(origin.slope)[0], g)

    def slope(self, y: Any, key: Any) -> Any:
        """(loss, (aux, lost)) and the gradient."""
        if not self.forward:
            return jax.value_and_grad(self.evaluate, has_aux=True)(y, key)
        x, back = flat(y)

        def push(tangent: Array) -> Any:
            return jax.jvp(lambda y: self.evaluate(back(y), key), (x,), (tangent,), has_aux=True)

        value, slope, seen = jax.vmap(push, out_axes=(None, 0, None))(
            jnp.eye(x.size, dtype=x.dtype)
        )
        return (value, seen), back(slope)

    def judge(self, search: Search, point: Best) -> Search:
        """The search after a point was looked at."""
        fewer = point.lost < search.best.lost
        less = (point.lost == search.best.lost) & (point.loss < search.best.loss)
        best = keep(jnp.isfinite(point.loss) & (fewer | less), point, search.best)
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
            f" {checks.shortened(value)}."
        )
    aux = functions.tree("tune", "loss", aux)
    return jnp.asarray(value), jax.tree.map(jnp.asarray, aux)
