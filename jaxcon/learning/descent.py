"""Optimizer steps that recover from non-finite losses. Pure functions, for a jitted scan."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, TypeAlias

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
from jaxcon.learning.curvature import Secants
from jaxcon.learning.leaves import Space, flat
from jaxcon.learning.optimizer import OptimizerMemory, SearchAware
from jaxcon.staging.failure import mask_failed_gradients
from jaxcon.staging.worlds import where_tree

RETRIES = 20
"""The number of times that a rejected step is halved and repeated before a search ends."""
RECOVERY = 1.2
"""The factor by which the step fraction grows after each accepted step, up to 1."""
WORSE = 1000.0
"""A step is rejected if it multiplies a nonnegative loss by more than this factor."""

Value: TypeAlias = tuple[Array, tuple[PyTree, Array]]
"""The loss, (), with its auxiliary output and the number of non-finite samples."""


class Stop(IntEnum):
    """The reason why the search from one start ended."""

    RUNNING = 0
    STALLED = 1
    NO_STEP = 2
    LED_NOWHERE = 3


@pytree
class Best:
    """The point with the smallest loss so far.

    A point with more non-finite samples never counts as better, since these samples may have the
    largest losses.

    Attributes:
        y: search coordinates of the point.
        slope: gradient of the loss at y; zero if the loss is averaged over samples.
        loss: loss at y, ().
        aux: auxiliary output of the loss at y.
        lost: number of non-finite samples at y, ().
        step: number of steps taken before y, ().
    """

    y: tuple[Array, ...]
    slope: tuple[Array, ...]
    loss: Array
    aux: PyTree
    lost: Array
    step: Array


@pytree
class AcceptedPoint:
    """The last accepted point, from which a rejected step is repeated at half its length.

    Attributes:
        y: search coordinates of the point.
        slope: gradient of the loss at y.
        loss: loss at y, ().
        update: the optimizer's full step from y.
        memory: state of the optimizer after that step.
    """

    y: tuple[Array, ...]
    slope: tuple[Array, ...]
    loss: Array
    update: tuple[Array, ...]
    memory: optax.OptState | OptimizerMemory


@pytree
class Search:
    """The state of the search from one start.

    Attributes:
        y: the next point to evaluate.
        origin: the accepted point from which the step to y was taken.
        best: the best point so far.
        first: loss at the first accepted point; NaN before there is one.
        first_slope: gradient of the loss at this point; zero before there is one.
        highest: the largest loss of an accepted point.
        mark: the loss to beat: a loss that is lower by more than the tolerance counts as progress.
        since: the step at which `mark` was set.
        share: step fraction, the fraction of the optimizer's step that is taken; halved after a
            rejection.
        tries: number of rejected steps in a row.
        step: number of steps taken.
        refused: number of rejected steps.
        stop: the reason why the search ended, a `Stop`.
        secants: secant pairs for quasi-Newton steps; None if the loss is averaged over samples.
        ahead: the quasi-Newton step from the best point, (n,); NaN if unknown.
    """

    y: tuple[Array, ...]
    origin: AcceptedPoint
    best: Best
    first: Array
    first_slope: tuple[Array, ...]
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
        """True once the search has accepted a point."""
        return ~jnp.isnan(self.first)


@dataclass(frozen=True)
class Descent:
    """The minimization problem, with all settings that are constant during a search.

    Attributes:
        loss: function from params, or (params, key) with samples, to a loss or (loss, aux).
        space: map between parameters and search coordinates.
        optimizer: a transformation of optax, or the default optimizer.
        samples: number of keys over which the loss is averaged; 0 for a loss without key.
        patience: number of steps without progress after which a search ends.
        tolerance: the decrease of the loss that counts as progress.
        forward: True for gradients in forward mode, one pass per parameter.
        mesh: devices among which the samples are divided; None for a single device.
    """

    loss: Callable[..., Any]
    space: Space
    optimizer: optax.GradientTransformationExtraArgs | SearchAware
    samples: int
    patience: int
    tolerance: float
    forward: bool = False
    mesh: Mesh | None = None

    def start(self, y: tuple[Array, ...], key: Array | None) -> Search:
        """Returns the initial state of a search that begins at y."""
        value, (aux, lost) = jax.eval_shape(self.evaluate, y, key)
        none, zeros = jnp.zeros((), jnp.int32), jax.tree.map(jnp.zeros_like, y)
        infinite = jnp.full((), jnp.inf, value.dtype)
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux)
        all_lost = jnp.full((), max(self.samples, 1), lost.dtype)
        x = flat(y)[0]
        return Search(
            y=y,
            origin=AcceptedPoint(y, zeros, infinite, zeros, self.optimizer.init(y)),
            best=Best(y, zeros, infinite, nothing, all_lost, none),
            first=jnp.full_like(infinite, jnp.nan),
            first_slope=zeros,
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

    def _loss(self, *args: PyTree) -> tuple[Array, PyTree]:
        """Calls the user's loss. Returns (loss, aux)."""
        return split(functions.call("tune", "loss", self.loss, *args))

    def evaluate(self, y: tuple[Array, ...], key: Array | None) -> Value:
        """Returns (loss, (auxiliary output, number of non-finite samples)) at y.

        With samples, the loss is the mean over the finite samples. It is NaN unless more than half
        of the samples are finite. Non-finite samples have zero gradient.
        """
        if not self.samples:
            value, aux = self._loss(self.space.decode(y))
            return value, (aux, jnp.zeros((), jnp.int32))

        def sample(y: tuple[Array, ...], key: Array) -> tuple[tuple[Array, PyTree], Array]:
            """Returns (loss, aux) of one sample, and a status: OK if the loss is finite."""
            value, aux = self._loss(self.space.decode(y), key)
            good = jnp.isfinite(value)
            return (value, aux), jnp.where(good, Status.OK, Status.NON_FINITE).astype(jnp.int32)

        assert key is not None
        keys = jax.random.split(key, self.samples)
        batch = jax.vmap(lambda y, k: mask_failed_gradients(sample, (y, k)), in_axes=(None, 0))
        batch = batch if self.mesh is None else over_devices(batch, self.mesh)
        (values, aux), status = batch(y, keys)
        lost = jnp.sum(failed(status), dtype=jnp.int32)
        count = jnp.maximum(self.samples - lost, 1).astype(values.dtype)
        mean = jnp.sum(jnp.where(failed(status), 0, values)) / count
        return jnp.where(2 * lost < self.samples, mean, jnp.nan), (aux, lost)

    def run(
        self, search: Search, limit: Array, key: Array | None, length: int
    ) -> tuple[Search, Array]:
        """Takes a number of steps, called a chunk.

        Args:
            search: the state before the chunk.
            limit: maximum number of steps of the whole search, ().
            key: random key for the samples; None without samples.
            length: number of steps of the chunk.

        Returns:
            The state after the chunk; and the loss by step, (length,), NaN for steps not taken.
        """

        def advance(search: Search, _: None) -> tuple[Search, Array]:
            """Takes one step; does nothing if the search has ended."""
            active = (search.stop == Stop.RUNNING) & (search.step < limit)
            fresh = None
            if self.samples and key is not None:
                fresh = jax.random.fold_in(key, search.step + 1)
            new, loss = self.step(search, fresh)
            return where_tree(active, new, search), jnp.where(active, loss, jnp.nan)

        new, losses = jax.lax.scan(advance, search, None, length)
        if new.secants is None:
            return where_tree(new.step > search.step, self.compare(search, new, key), new), losses
        best = new.best
        ahead = new.secants.newton_step(flat(best.slope)[0], self.space.free(best.y, best.slope))
        return dataclasses.replace(new, ahead=ahead), losses

    def compare(self, before: Search, after: Search, key: Array | None) -> Search:
        """Updates the best point by comparing the points before and after a chunk.

        Both losses use the same random keys, so that a lucky draw of samples does not decide. If
        the loss after the chunk is not finite or far too large, the search returns to the point
        before the chunk.
        """
        assert key is not None
        fixed = jax.random.fold_in(key, 0)
        y = jax.tree.map(lambda *x: jnp.stack(x), before.y, after.y)
        losses, extras = jax.vmap(lambda y: self.evaluate(y, fixed))(y)
        search, failed = after, jnp.asarray(False)
        for i, end in enumerate((before, after)):
            aux, lost = jax.tree.map(lambda x, i=i: x[i], extras)
            point = Best(end.y, search.best.slope, losses[i], aux, lost, end.step)
            failed = ~jnp.isfinite(losses[i]) | self.runs_away(search, losses[i], losses[0])
            search = self.judge(self.accept(search, losses[i], ~failed), point)
        half = after.share / 2
        back = dataclasses.replace(search, y=before.y, origin=before.origin, share=half)
        return where_tree(failed & jnp.isfinite(losses[0]), back, search)

    def step(self, search: Search, key: Array | None) -> tuple[Search, Array]:
        """Evaluates the current point and takes one step from it.

        If the loss at the current point is unacceptable, the step to that point is repeated with
        half its length.

        Returns:
            The new state, and the loss at the current point.
        """
        (loss, (aux, lost)), slope = self.slope(search.y, key)
        good = jnp.isfinite(loss) & numerics.all_finite(slope)
        point = Best(search.y, slope, loss, aux, lost, search.step)
        search = dataclasses.replace(search, step=search.step + 1)
        if search.secants is not None:
            good &= ~self.runs_away(search, loss, search.origin.loss)
            learned = self.learned(search, search.secants, slope)
            secants = where_tree(good & search.accepted, learned, search.secants)
            first_slope = where_tree(good & ~search.accepted, slope, search.first_slope)
            search = dataclasses.replace(search, secants=secants, first_slope=first_slope)
            search = self.judge(self.accept(search, loss, good), point)
        origin = where_tree(good, self.leave(search, loss, slope, key), search.origin)
        share = jnp.where(good, jnp.minimum(1, RECOVERY * search.share), search.share / 2)
        ahead = jax.tree.map(
            lambda y, u: y + share.astype(y.dtype) * u.astype(y.dtype), origin.y, origin.update
        )
        moved = self.space.clip(ahead)
        finite = numerics.all_finite(moved)
        tries = jnp.where(good, 0, search.tries + 1)
        stop = jnp.where(tries > RETRIES, Stop.NO_STEP, search.stop)
        stop = jnp.where(good & ~finite, Stop.LED_NOWHERE, stop)
        new = dataclasses.replace(
            search,
            y=where_tree(finite, moved, origin.y),
            origin=origin,
            share=share,
            tries=tries,
            refused=search.refused + (~good).astype(search.refused.dtype),
            stop=stop.astype(search.stop.dtype),
        )
        return new, loss

    def leave(
        self, search: Search, loss: Array, slope: tuple[Array, ...], key: Array | None
    ) -> AcceptedPoint:
        """Calls the optimizer for the next step.

        A transformation of optax steps from the current point. The default optimizer may step from
        the best point.

        Returns:
            The point from which the optimizer steps, with the step.
        """
        update: Any  # optax has its own types
        memory: Any = search.origin.memory
        # optax relies on dtype and rank promotion, which the user may have forbidden
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            if isinstance(self.optimizer, SearchAware):
                moved, memory = self.optimizer.update(slope, memory, search.y, loss, search)
                point, update = moved
                return AcceptedPoint(point.y, point.slope, point.loss, update, memory)
            update, memory = self.optimizer.update(
                slope,
                memory,
                search.y,
                value=loss,
                grad=slope,
                value_fn=lambda y: self.evaluate(self.space.clip(y), key)[0],
            )
        return AcceptedPoint(search.y, slope, loss, update, memory)

    def runs_away(self, search: Search, loss: Array, before: Array) -> Array:
        """Returns True if a step increases the loss so much that it must be rejected.

        If all accepted losses are nonnegative, a step may multiply the loss by at most 1000.

        A loss of any sign, such as a logarithm, may exceed the highest accepted loss by at most
        min(max(|f|, d), max(|f| / 100, 10 d)). Here f is the first accepted loss, and d the
        difference between the highest accepted loss and the lowest loss.
        Rounding errors near a loss of zero are ignored.

        Args:
            search: the state of the search.
            loss: the loss after the step, ().
            before: the loss before the step, ().
        """
        size, span = jnp.abs(search.first), search.highest - search.best.loss
        rounding = jnp.finfo(loss.dtype).eps * size
        thousandfold = (search.best.loss >= 0) & (loss > WORSE * jnp.maximum(before, rounding))
        rise = jnp.minimum(jnp.maximum(size, span), jnp.maximum(size / 100, 10 * span))
        return search.accepted & (thousandfold | (loss > search.highest + rise))

    @staticmethod
    def accept(search: Search, loss: Array, good: Array) -> Search:
        """Updates the first and the highest accepted loss with `loss`, if `good` is True."""
        first = jnp.where(good & ~search.accepted, loss, search.first)
        highest = jnp.where(good, jnp.maximum(loss, search.highest), search.highest)
        return dataclasses.replace(search, first=first, highest=highest)

    @staticmethod
    def learned(search: Search, secants: Secants, slope: tuple[Array, ...]) -> Secants:
        """Adds the secant pair of the step from the last accepted point to the current point.

        Args:
            search: the state of the search, with the accepted point `origin` and the current y.
            secants: the secant pairs so far.
            slope: gradient of the loss at the current point.
        """
        origin, g = search.origin, flat(slope)[0]
        step = flat(search.y)[0] - flat(origin.y)[0]
        return secants.add(step, g - flat(origin.slope)[0], g)

    def slope(self, y: tuple[Array, ...], key: Array | None) -> tuple[Value, tuple[Array, ...]]:
        """Returns the loss at y with its extras, and the gradient of the loss at y.

        The extras are the auxiliary output and the number of non-finite samples; see `evaluate`.
        """
        if not self.forward:
            return jax.value_and_grad(self.evaluate, has_aux=True)(y, key)
        x, back = flat(y)

        def push(tangent: Array) -> tuple[Array, Array, tuple[PyTree, Array]]:
            """Returns the loss, its derivative along `tangent`, and the extras of the loss.

            The extras are the auxiliary output and the number of non-finite samples.
            """
            return jax.jvp(lambda y: self.evaluate(back(y), key), (x,), (tangent,), has_aux=True)

        value, slope, extras = jax.vmap(push, out_axes=(None, 0, None))(
            jnp.eye(x.size, dtype=x.dtype)
        )
        return (value, extras), back(slope)

    def judge(self, search: Search, point: Best) -> Search:
        """Updates the best point with a new point, and stops a search without progress.

        Progress means fewer non-finite samples at the best point, or a loss that is lower than
        `mark` by more than the tolerance. The lower loss is then the new `mark`.
        """
        fewer = point.lost < search.best.lost
        less = (point.lost == search.best.lost) & (point.loss < search.best.loss)
        best = where_tree(jnp.isfinite(point.loss) & (fewer | less), point, search.best)
        progress = (best.lost < search.best.lost) | (best.loss < search.mark - self.tolerance)
        since = jnp.where(progress, search.step, search.since)
        stalled = (search.stop == Stop.RUNNING) & (search.step - since >= self.patience)
        stop = jnp.where(stalled, Stop.STALLED, search.stop).astype(search.stop.dtype)
        mark = jnp.where(progress, best.loss, search.mark)
        return dataclasses.replace(search, best=best, mark=mark, since=since, stop=stop)


def split(result: PyTree) -> tuple[Array, PyTree]:
    """Splits the return value of a user's loss into (loss, aux).

    aux is () if the loss returns no auxiliary output.

    Raises:
        TypeError: the loss is not a floating scalar.
    """
    value, aux = result if isinstance(result, tuple) and len(result) == 2 else (result, ())
    number = isinstance(value, float | np.ndarray | np.generic | jax.Array)
    if not number or jnp.shape(value) or not jnp.issubdtype(jnp.result_type(value), jnp.floating):
        raise TypeError(
            "tune: the loss must return a floating scalar, or a pair of one and anything else; got"
            f" {checks.shortened(value)}."
        )
    aux = functions.tree("tune", "loss", aux)
    return jnp.asarray(value), jax.tree.map(jnp.asarray, aux)
