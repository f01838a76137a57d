"""A recording in one stretch or in several: residuals, gaps and their derivatives."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxcon.core import checks, functions
from jaxcon.core.typing import Array, PyTree
from jaxcon.learning.least_squares import Precision
from jaxcon.learning.leaves import Space
from jaxcon.learning.losses import misfit

FARTHEST = float(np.log(10.0))
"""Largest change of a logarithm in a step."""
NEIGHBORS = 16
"""Least number of differences of neighbors from which their noise is estimated."""


@dataclass(frozen=True)
class Stretches:
    """A recording in one stretch, or in several that begin at nodes.

    Attributes:
        simulate: as of `identify`.
        space: of the parameters.
        scale: of their coordinates, (p,).
        data, noise: as of `identify`.
        given: the first guesses of the nodes, None without.
    """

    simulate: Callable[..., Any]
    space: Space
    scale: Array
    data: PyTree
    noise: PyTree
    given: PyTree

    @property
    def nodes(self) -> np.ndarray:
        """The first guesses, (stretches, n); (1, 0) without nodes."""
        if self.given is None:
            return np.zeros((1, 0))
        return np.asarray(jax.vmap(lambda x: ravel_pytree(x)[0])(self.given))

    def restore(self, nodes: np.ndarray) -> PyTree:
        """Numbers of nodes in the structure in which they were given."""
        if self.given is None:
            return None
        back = ravel_pytree(jax.tree.map(lambda x: x[0], self.given))[1]
        return jax.vmap(back)(jnp.asarray(nodes.reshape(self.nodes.shape), self.scale.dtype))

    @cached_property
    def seen(self) -> tuple[PyTree, PyTree]:
        """Data and the noise of each number, with a first axis of stretches.

        Raises:
            ValueError: the data do not have that axis or are infinite, or the noise does not
                broadcast with them.
        """
        data = jax.tree.map(np.asarray, self.data)
        if any(np.any(np.isinf(x)) for x in jax.tree.leaves(data)):
            raise ValueError("identify: the data have infinite numbers; write NaN for the unseen.")
        shapes = [x.shape for x in jax.tree.leaves(data)]
        stretches = len(self.nodes)
        if self.given is not None and any(shape[:1] != (stretches,) for shape in shapes):
            raise ValueError(
                f"identify: with {stretches} nodes the data must have a first axis of as many"
                f" stretches, got shapes {shapes}."
            )
        noise = 1.0 if self.noise is None else self.noise
        try:
            noise = jax.tree.broadcast(noise, data)
            noise = jax.tree.map(lambda w, x: np.broadcast_to(w, x.shape), noise, data)
        except ValueError as error:
            given = [np.shape(w) for w in jax.tree.leaves(noise)]
            raise ValueError(
                f"identify: noise of shapes {given} must broadcast with the data, {shapes}, in"
                " their structure."
            ) from error
        if self.given is None:
            return jax.tree.map(lambda x: x[None], (data, noise))
        return data, noise

    @cached_property
    def size(self) -> float:
        """‖data / noise‖ of what was seen."""
        pairs = zip(*map(jax.tree.leaves, self.seen), strict=True)
        parts = [np.where(np.isfinite(x), x / w, 0).astype(float) for x, w in pairs]
        return float(np.sqrt(sum(np.sum(x * x) for x in parts)))

    @property
    def observed(self) -> int:
        """The count of numbers in the data that are not NaN."""
        return sum(int(np.sum(np.isfinite(x))) for x in jax.tree.leaves(self.data))

    @property
    def gaps(self) -> int:
        """The count of gaps between stretches; they are the last residuals."""
        stretches, n = self.nodes.shape
        return (stretches - 1) * n

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) of the unknowns; nodes have none."""
        low, high = (np.asarray(self.space.flatten(x) / self.scale) for x in self.space.limits)
        none = np.full(self.nodes.size, np.inf)
        return np.append(low, -none), np.append(high, none)

    @property
    def reach(self) -> np.ndarray:
        """The largest change of each unknown in a step."""
        none = np.full(self.nodes.size, np.inf)
        return np.append(np.where(self.space.logarithms, FARTHEST, np.inf), none)

    @property
    def rounding(self) -> float:
        """The typical rounding error of a number in the data."""
        spacing = float(jnp.finfo(self.scale.dtype).eps)
        return spacing * self.size / max(self.observed, 1) ** 0.5

    @property
    def least(self) -> float:
        """The rounding error of the data, or 1 if all data are 0."""
        return self.rounding or 1.0

    def typical(self, residual: np.ndarray) -> float:
        """The root mean square of residuals of the data, no less than rounding makes them."""
        own = residual[: residual.size - self.gaps]
        return max(float(np.linalg.norm(own)) / max(self.observed, 1) ** 0.5, self.least)

    @cached_property
    def times(self) -> np.ndarray:
        """The time of each residual of the data as a share of its stretch, (m,).

        Time is the longest axis of a leaf: the data have no other mark of it.
        """
        shares = []
        for x in jax.tree.leaves(self.seen[0]):
            shape = x.shape[1:] or (1,)
            axis = int(np.argmax(shape))
            share = np.arange(1, shape[axis] + 1) / max(shape[axis], 1)
            along = np.expand_dims(share, [i for i in range(len(shape)) if i != axis])
            shares.append(np.broadcast_to(along, shape).ravel())
        return np.tile(np.concatenate(shares), len(self.nodes))

    def observed_until(self, horizon: float) -> int:
        """The count of numbers seen up to a horizon, a share of the time."""
        data = jax.tree.map(lambda x: np.reshape(x, (len(self.nodes), -1)), self.seen[0])
        flat = np.concatenate(jax.tree.leaves(data), axis=1).ravel()
        return int(np.sum(np.isfinite(flat) & (self.times <= horizon)))

    def until(self, horizon: float, r: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and Jacobian with zero rows for data after a horizon, a share of the time."""
        later = np.append(self.times > horizon, np.zeros(self.gaps, bool))
        return np.where(later, 0, r), np.where(later[:, None], 0, J)

    def share(self, residual: np.ndarray, noise: float) -> float:
        """‖residuals‖ / ‖data‖ of the data; 0 if it is below √ε.

        Args:
            residual: r.
            noise: by which r was divided.
        """
        own = noise * float(np.linalg.norm(residual[: residual.size - self.gaps]))
        return own / self.size if own > self.precision(np.inf).tolerance * self.size else 0.0

    def excess(self, residual: np.ndarray) -> float:
        """The ratio of the root mean square of residuals to their `scatter`; NaN with that."""
        own = residual[: residual.size - self.gaps]
        return float(np.linalg.norm(own)) / max(self.observed, 1) ** 0.5 / self.scatter(residual)

    def scatter(self, residual: np.ndarray) -> float:
        """The standard deviation of the noise in residuals of the data.

        It is 1 if the noise was given. Else it is the root mean square of differences of neighbors
        over √2: residuals of a wrong motion are smooth, and noise is not. NaN if there are too few.

        References:
            Durbin, Watson, Testing for serial correlation in least squares regression (1950).
        """
        if self.noise is not None:
            return 1.0
        own = residual[: residual.size - self.gaps].reshape(len(self.nodes), -1)
        data = [np.asarray(x) for x in jax.tree.leaves(self.seen[0])]
        ends = np.cumsum([x[0].size for x in data])[:-1]
        leaves = zip(np.split(own, ends, axis=1), data, strict=True)
        seen = [np.where(np.isfinite(x), r.reshape(x.shape), np.nan) for r, x in leaves]
        return min(_scatters(seen), default=np.nan)

    def precision(self, continuity: float, noise: float = 1.0) -> Precision:
        """The precision of residuals in the dtype in which they are computed."""
        ends = float(np.linalg.norm(self.nodes)) / continuity
        tolerance = float(jnp.finfo(self.scale.dtype).eps) ** 0.5
        return Precision(tolerance, float(np.hypot(self.size / noise, ends)))

    def told(self, noise: float) -> Precision:
        """The precision of residuals of the data alone, with gaps as unknowns."""
        return dataclasses.replace(self.precision(np.inf), size=self.size / noise)

    def condensed(self, J: np.ndarray, continuity: float) -> np.ndarray:
        """J by the parameters, the first node and the gaps g, in place of the other nodes.

        Node k + 1 is put as e_k(p, x_k) − g_k. The columns of p and x₀ are then those of one motion
        without gaps, whose weight would hide from a rank what is told of them: of nodes that move
        along together, gaps leave rounding alone. J stays as it is where one motion cannot be
        foreseen to √ε.
        """
        p, (stretches, n) = self.scale.size, self.nodes.shape
        data, gaps = np.split(J, [len(J) - self.gaps])
        rows = continuity * gaps.reshape(stretches - 1, n, J.shape[1])
        T = np.eye(J.shape[1])
        for k in range(stretches - 1):
            own, after = (slice(p + i * n, p + (i + 1) * n) for i in (k, k + 1))
            T[after] = rows[k][:, :p] @ T[:p] + rows[k][:, own] @ T[own] + T[after]
        if not np.max(np.abs(T), initial=1) * self.precision(np.inf).tolerance < 1:
            return J
        alone = np.zeros_like(gaps)
        alone[:, p + n :] = -np.eye(self.gaps) / continuity
        return np.concatenate([data @ T, alone])

    def widths(self, residual: np.ndarray, continuity: float) -> list[float]:
        """Standard deviations of the gaps by decade, from their size at the start downwards.

        A search that had to keep them together from the start would creep along a narrow valley.
        """
        gaps = residual[residual.size - self.gaps :]
        missed = np.sqrt(np.sum(gaps**2) / max(self.gaps, 1))
        decades = np.ceil(np.log10(max(missed / continuity, 1)))
        return [continuity * 10.0**k for k in np.arange(decades, -1, -1)]

    def evaluate(
        self, points: Sequence[tuple[np.ndarray, float, float]]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Residuals with the gaps between stretches, and their Jacobian, at several points.

        Args:
            points: unknowns, the deviation of gaps, and by what the noise of data is multiplied.
        """
        x = np.stack([self._begins(z) for z, *_ in points])
        found = self._derivatives(jnp.asarray(x, self.scale.dtype), *self.seen)
        host = jax.tree.map(lambda y: np.asarray(y, float), found)
        each = (jax.tree.map(lambda y, i=i: y[i], host) for i in range(len(points)))
        return [self._rows(x, own, *p[1:]) for x, own, p in zip(x, each, points, strict=True)]

    def program(self, starts: int) -> str:
        """The lowered program that evaluates this many points, as text."""
        x = jnp.zeros((starts, *self._begins(self.start).shape), self.scale.dtype)
        return self._derivatives.lower(x, *self.seen).as_text()

    @property
    def start(self) -> np.ndarray:
        """Unknowns with zeros for the parameters."""
        return np.append(np.zeros(self.scale.size), self.nodes)

    def _begins(self, z: np.ndarray) -> np.ndarray:
        """Parameters and own node of each stretch, (stretches, p + n)."""
        p, (stretches, n) = self.scale.size, self.nodes.shape
        return np.concatenate([np.tile(z[:p], (stretches, 1)), z[p:].reshape(stretches, n)], 1)

    def _rows(self, x: np.ndarray, found: Any, continuity: float, noise: float) -> Any:
        """Residuals and Jacobian of one point from what its stretches gave."""
        p, n = self.scale.size, self.nodes.shape[1]
        (r, end), (by_r, by_end) = found
        gap = (end[:-1] - x[1:, p:]) / continuity
        J = _placed(by_r / noise, by_end[:-1] / continuity, p)
        J[r.size :, p + n :] -= np.eye(gap.size) / continuity
        return np.append(r / noise, gap), J

    @cached_property
    def _derivatives(self) -> Any:
        """(residuals, end) of every point and stretch, and both by (parameters, node).

        In forward mode. One program for each recording: what a simulation reads from elsewhere may
        change between two of them.
        """

        def along(x: Array, data: PyTree, noise: PyTree) -> Any:
            def push(tangent: Array) -> Any:
                return jax.jvp(lambda x: self._stretch(x, data, noise), (x,), (tangent,))

            return jax.vmap(push, out_axes=(None, -1))(jnp.eye(x.size, dtype=x.dtype))

        return jax.jit(jax.vmap(jax.vmap(along), (0, None, None)))

    def _stretch(self, x: Array, data: PyTree, noise: PyTree) -> tuple[Array, Array]:
        """Residuals and the end of one stretch."""
        p = self.scale.size
        params, end = self.space.decode(self.space.split(x[:p] * self.scale)), ()
        if self.given is None:
            predicted = self._simulated(params)
        else:
            predicted, end = self._onward(params, x[p:])
        return ravel_pytree(misfit(predicted, data, noise))[0], ravel_pytree(end)[0]

    def _simulated(self, *args: Any) -> Any:
        """Calls the user's function.

        Raises:
            TypeError: it returns no arrays, or needs the value of a traced number.
        """
        found = functions.call("identify", "simulate", self.simulate, *args)
        if not jax.tree.leaves(functions.tree("identify", "simulate", found)):
            raise TypeError(
                "identify: simulate must return predictions of the data,"
                f" {checks.described(self.data)}, got {found!r}; is a return missing?"
            )
        return found

    def _onward(self, params: PyTree, node: Array) -> tuple[PyTree, PyTree]:
        """Predictions from a node on, and the end.

        Raises:
            ValueError: there is no end like a node.
        """
        first = jax.tree.map(lambda x: x[0], self.given)
        found = self._simulated(params, ravel_pytree(first)[1](node))
        both = isinstance(found, tuple | list) and len(found) == 2
        predicted, end = found if both else (found, ())
        wanted, got = checks.described(first), checks.described(end)
        if got != wanted:
            raise ValueError(
                "identify: with nodes simulate must return predictions and an end like a node,"
                f" {wanted}; the end that it returns is {got}."
            )
        return predicted, end


def _scatters(residuals: list[np.ndarray]) -> list[float]:
    """The noise estimated along each axis but the first (stretches), over all leaves.

    Axes with fewer than `NEIGHBORS` differences are left out. NaN marks unseen residuals.
    """
    scatters = []
    for axis in range(1, max((r.ndim for r in residuals), default=1)):
        changes = [np.diff(r, axis=axis).ravel() for r in residuals if r.ndim > axis]
        seen = np.concatenate(changes)
        seen = seen[np.isfinite(seen)]
        if seen.size >= NEIGHBORS:
            scatters.append(max(float(np.sqrt(np.mean(seen**2) / 2)), np.finfo(float).tiny))
    return scatters


def _placed(by_r: np.ndarray, by_end: np.ndarray, p: int) -> np.ndarray:
    """The Jacobian of all residuals, then all gaps, by parameters and nodes.

    Args:
        by_r: residuals of each stretch by (parameters, own node), (stretches, m, p + n).
        by_end: gaps likewise, (stretches − 1, n, p + n), without the node that they end at.
        p: number of parameters.
    """
    blocks = []
    for rows in (by_r, by_end):
        count, height, width = rows.shape
        block = np.zeros((count, height, p + len(by_r) * (width - p)))
        block[:, :, :p] = rows[:, :, :p]
        for k in range(count):
            own = p + k * (width - p)
            block[k, :, own : own + width - p] = rows[k, :, p:]
        blocks.append(block.reshape(count * height, block.shape[2]))
    return np.concatenate(blocks)
