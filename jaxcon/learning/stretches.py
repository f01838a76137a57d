"""Residuals of a recording in one or several segments (stretches), and their derivatives."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.stages import Wrapped

from jaxcon.core import checks, functions
from jaxcon.core.cores import compiler_options
from jaxcon.core.typing import Array, PyTree
from jaxcon.learning.least_squares import Precision, Values
from jaxcon.learning.leaves import Space
from jaxcon.learning.losses import misfit

FARTHEST = float(np.log(10.0))
"""The largest change of a parameter's logarithm in one step of the fit."""
NEIGHBORS = 16
"""The least number of differences between neighboring data from which noise is estimated."""

Pair: TypeAlias = tuple[Array, Array]
"""The data residuals and the end state of a segment of the recording, or their derivatives."""
Point: TypeAlias = tuple[np.ndarray, float, float]
"""The unknowns, the standard deviation of the gaps, and the factor on the noise of the data."""


@dataclass(frozen=True)
class Stretches:
    """The least-squares problem of a recording; with nodes, for multiple shooting.

    The recording is cut into segments, called stretches. Each stretch begins at a node, an unknown
    initial state. The difference between the end of a stretch and the next node, called gap, is a
    residual. Without nodes there is one stretch and no gap.

    The unknowns are the search coordinates of the parameters, divided by `scale`, followed by all
    nodes.

    Attributes:
        simulate: the user's simulation; see `identify`.
        space: map between parameters and search coordinates.
        scale: divisors of the search coordinates, (p,).
        data: the recorded data; see `identify`.
        noise: standard deviation of the data, or None if it was not given; see `identify`.
        given: initial guesses of the nodes, with a first axis of stretches; None without nodes.
    """

    simulate: Callable[..., PyTree]
    space: Space
    scale: Array
    data: PyTree
    noise: PyTree
    given: PyTree

    @property
    def nodes(self) -> np.ndarray:
        """Guesses of the segments' initial states, (segments, n); (1, 0) without nodes."""
        if self.given is None:
            return np.zeros((1, 0))
        return np.asarray(jax.vmap(lambda x: ravel_pytree(x)[0])(self.given))

    def restore(self, nodes: np.ndarray) -> PyTree:
        """Converts nodes (segments · n,) to the user's structure; None without nodes."""
        if self.given is None:
            return None
        back = ravel_pytree(jax.tree.map(lambda x: x[0], self.given))[1]
        return jax.vmap(back)(jnp.asarray(nodes.reshape(self.nodes.shape), self.scale.dtype))

    @cached_property
    def seen(self) -> tuple[PyTree, PyTree]:
        """The data and the standard deviation of each datum, with a first axis of segments.

        Raises:
            ValueError: the data lack this axis or are infinite, or the noise does not broadcast
                with them.
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
        """The norm ‖data / noise‖ over all data that are not NaN."""
        pairs = zip(*map(jax.tree.leaves, self.seen), strict=True)
        parts = [np.where(np.isfinite(x), x / w, 0).astype(float) for x, w in pairs]
        return float(np.sqrt(sum(np.sum(x * x) for x in parts)))

    @property
    def observed(self) -> int:
        """The number of data that are not missing (NaN)."""
        return sum(int(np.sum(np.isfinite(x))) for x in jax.tree.leaves(self.data))

    @property
    def gaps(self) -> int:
        """The number of gap residuals: differences between a segment's end and the next start.

        In r, the gap residuals follow the data residuals.
        """
        stretches, n = self.nodes.shape
        return (stretches - 1) * n

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the unknowns; infinite for initial states of segments."""
        low, high = (np.asarray(self.space.flatten(x) / self.scale) for x in self.space.limits)
        none = np.full(self.nodes.size, np.inf)
        return np.append(low, -none), np.append(high, none)

    @property
    def reach(self) -> np.ndarray:
        """The largest allowed change of each unknown in one step of the fit."""
        none = np.full(self.nodes.size, np.inf)
        return np.append(np.where(self.space.logarithms, FARTHEST, np.inf), none)

    @property
    def rounding(self) -> float:
        """The typical rounding error of data / noise: ε times the root mean square."""
        spacing = float(jnp.finfo(self.scale.dtype).eps)
        return spacing * self.size / max(self.observed, 1) ** 0.5

    @property
    def least(self) -> float:
        """The least noise factor that an estimate may give: `rounding`, or 1 if all data are 0."""
        return self.rounding or 1.0

    def typical(self, residual: np.ndarray) -> float:
        """Returns the root mean square data residual, but at least the rounding error `least`."""
        r = residual[: residual.size - self.gaps]
        return max(float(np.linalg.norm(r)) / max(self.observed, 1) ** 0.5, self.least)

    @cached_property
    def times(self) -> np.ndarray:
        """The time of each data residual, as a share of the duration of its segment, (m,).

        The longest axis of a leaf is taken as time, since the data do not mark the time axis.
        """
        shares = []
        for x in jax.tree.leaves(self.seen[0]):
            shape = x.shape[1:] or (1,)
            axis = int(np.argmax(shape))
            share = np.arange(1, shape[axis] + 1) / max(shape[axis], 1)
            share = np.expand_dims(share, [i for i in range(len(shape)) if i != axis])
            shares.append(np.broadcast_to(share, shape).ravel())
        return np.tile(np.concatenate(shares), len(self.nodes))

    def observed_until(self, horizon: float) -> int:
        """Returns the number of data up to a time, given as a share of each segment's duration."""
        data = jax.tree.map(lambda x: np.reshape(x, (len(self.nodes), -1)), self.seen[0])
        flat = np.concatenate(jax.tree.leaves(data), axis=1).ravel()
        return int(np.sum(np.isfinite(flat) & (self.times <= horizon)))

    def until(self, horizon: float, r: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns r and J with zero rows for data after `horizon`, a share of the duration."""
        later = np.append(self.times > horizon, np.zeros(self.gaps, bool))
        return np.where(later, 0, r), np.where(later[:, None], 0, J)

    def share(self, residual: np.ndarray, noise: float) -> float:
        """Returns ‖data residuals‖ / ‖data‖; 0 if this ratio is below √ε.

        Args:
            residual: all residuals r.
            noise: the factor by which r is divided.
        """
        size = noise * float(np.linalg.norm(residual[: residual.size - self.gaps]))
        return size / self.size if size > self.precision(np.inf).tolerance * self.size else 0.0

    def excess(self, residual: np.ndarray) -> float:
        """Returns the root mean square data residual, divided by the noise in the residuals.

        The noise is the standard deviation that `scatter` returns. The result is NaN if the noise
        is unknown.
        """
        r = residual[: residual.size - self.gaps]
        return float(np.linalg.norm(r)) / max(self.observed, 1) ** 0.5 / self.scatter(residual)

    def scatter(self, residual: np.ndarray) -> float:
        """Returns the standard deviation of the noise in the data residuals.

        It is 1 if the noise was given. Otherwise it is the root mean square difference between
        neighboring residuals, divided by √2. This separates noise, which is rough, from errors of
        the motion, which are smooth. NaN if there are too few neighbors.

        References:
            Durbin, Watson, Testing for serial correlation in least squares regression (1950).
        """
        if self.noise is not None:
            return 1.0
        rows = residual[: residual.size - self.gaps].reshape(len(self.nodes), -1)
        data = [np.asarray(x) for x in jax.tree.leaves(self.seen[0])]
        ends = np.cumsum([x[0].size for x in data])[:-1]
        leaves = zip(np.split(rows, ends, axis=1), data, strict=True)
        seen = [np.where(np.isfinite(x), r.reshape(x.shape), np.nan) for r, x in leaves]
        return min(_scatters(seen), default=np.nan)

    def precision(self, continuity: float, noise: float = 1.0) -> Precision:
        """Returns the floating-point precision of all residuals, in the dtype of the computation.

        Args:
            continuity: standard deviation of the gaps.
            noise: factor by which the noise of the data is multiplied.
        """
        ends = float(np.linalg.norm(self.nodes)) / continuity
        tolerance = float(jnp.finfo(self.scale.dtype).eps) ** 0.5
        return Precision(tolerance, float(np.hypot(self.size / noise, ends)))

    def data_precision(self, noise: float) -> Precision:
        """Returns the floating-point precision of the data residuals alone, without the gaps.

        It applies to a Jacobian that was transformed by `condensed`.

        Args:
            noise: factor by which the noise of the data is multiplied.
        """
        return dataclasses.replace(self.precision(np.inf), size=self.size / noise)

    def condensed(self, J: np.ndarray, continuity: float) -> np.ndarray:
        """Transforms the Jacobian so that gaps g are unknowns, in place of all nodes but the first.

        A node is the initial state of a segment. A gap is the difference between a segment's end
        and the next node.

        Substitutes x_{k+1} = e_k(p, x_k) − g_k for node k + 1, with the end e_k of stretch k. The
        columns of the parameters p and the first node x₀ then tell how one motion without gaps
        depends on p and x₀. In the original J, gaps have large weights, so this dependence is lost
        in rounding errors. If the motion is too unstable to be predicted to √ε, J is returned
        unchanged.

        Args:
            J: Jacobian of residuals with respect to parameters and nodes, (m, p + stretches · n).
            continuity: standard deviation by which the gaps in J are divided.
        """
        p, (stretches, n) = self.scale.size, self.nodes.shape
        data, gaps = np.split(J, [len(J) - self.gaps])
        rows = continuity * gaps.reshape(stretches - 1, n, J.shape[1])
        T = np.eye(J.shape[1])
        for k in range(stretches - 1):
            node, after = (slice(p + i * n, p + (i + 1) * n) for i in (k, k + 1))
            T[after] = rows[k][:, :p] @ T[:p] + rows[k][:, node] @ T[node] + T[after]
        if not np.max(np.abs(T), initial=1) * self.precision(np.inf).tolerance < 1:
            return J
        alone = np.zeros_like(gaps)
        alone[:, p + n :] = -np.eye(self.gaps) / continuity
        return np.concatenate([data @ T, alone])

    def widths(self, residual: np.ndarray, continuity: float) -> list[float]:
        """Returns the allowed standard deviation of the gaps in each fit of the sequence.

        The first value is near the size of the gaps at the start. Each further value is a tenth of
        the previous one. If small gaps were required from the start, the search would creep along a
        narrow valley.

        Args:
            residual: all residuals r at the start, with gaps that are not divided by a standard
                deviation.
            continuity: the final standard deviation.
        """
        gaps = residual[residual.size - self.gaps :]
        missed = np.sqrt(np.sum(gaps**2) / max(self.gaps, 1))
        decades = np.ceil(np.log10(max(missed / continuity, 1)))
        return [continuity * 10.0**k for k in np.arange(decades, -1, -1)]

    def evaluate(self, points: Sequence[Point]) -> list[Values]:
        """Returns residuals r (data, then gaps) and their Jacobian J at each of several points."""
        p, n = self.scale.size, self.nodes.shape[1]
        starts = np.stack([self._begins(z) for z, *_ in points])
        batch = self._derivatives(jnp.asarray(starts, self.scale.dtype), *self.seen)
        (r, end), (by_r, by_end) = jax.tree.map(lambda y: np.asarray(y, float), batch)
        values = []
        for i, (_, continuity, noise) in enumerate(points):
            gap = (end[i, :-1] - starts[i, 1:, p:]) / continuity
            J = _placed(by_r[i] / noise, by_end[i, :-1] / continuity, p)
            J[r[i].size :, p + n :] -= np.eye(gap.size) / continuity
            values.append((np.append(r[i] / noise, gap), J))
        return values

    def program(self, starts: int) -> str:
        """Returns the text of the lowered program that evaluates `starts` points."""
        x = jnp.zeros((starts, *self._begins(self.start).shape), self.scale.dtype)
        return self._derivatives.lower(x, *self.seen).as_text()

    @property
    def start(self) -> np.ndarray:
        """The unknowns: zeros for the parameters, then the given initial states of the segments."""
        return np.append(np.zeros(self.scale.size), self.nodes)

    def _begins(self, z: np.ndarray) -> np.ndarray:
        """Returns the parameters and the initial state of each segment, (segments, p + n).

        Args:
            z: unknowns, (p + segments · n,).
        """
        p, (stretches, n) = self.scale.size, self.nodes.shape
        return np.concatenate([np.tile(z[:p], (stretches, 1)), z[p:].reshape(stretches, n)], 1)

    @cached_property
    def _derivatives(self) -> Wrapped:
        """The jitted function (x, data, noise) → ((r, end), their Jacobians), by forward mode.

        x holds the parameters and the node of each stretch, (points, stretches, p + n). r holds
        the data residuals of each stretch, and end its final state.
        """

        # compiled for each problem, since variables that `simulate` closes over may have changed
        def linearize(x: Array, data: PyTree, noise: PyTree) -> tuple[Pair, Pair]:
            """Returns (data residuals, end state) of one segment, and their Jacobians ∂/∂x."""

            def push(tangent: Array) -> tuple[Pair, Pair]:
                """Returns data residuals and end state, and their derivatives along a tangent."""
                return jax.jvp(lambda x: self._stretch(x, data, noise), (x,), (tangent,))

            return jax.vmap(push, out_axes=(None, -1))(jnp.eye(x.size, dtype=x.dtype))

        many = jax.vmap(jax.vmap(linearize), (0, None, None))
        return jax.jit(many, compiler_options=dict(compiler_options))

    def _stretch(self, x: Array, data: PyTree, noise: PyTree) -> Pair:
        """Simulates one segment. Returns its data residuals and its end state, as arrays.

        Args:
            x: the parameters and the initial state of the segment, (p + n,).
            data: the data of the segment.
            noise: the standard deviations of the data.
        """
        p = self.scale.size
        params, end = self.space.decode(self.space.split(x[:p] * self.scale)), ()
        if self.given is None:
            predicted = self._simulated(params)
        else:
            predicted, end = self._onward(params, x[p:])
        return ravel_pytree(misfit(predicted, data, noise))[0], ravel_pytree(end)[0]

    def _simulated(self, *args: PyTree) -> Any:
        """Calls the user's `simulate`.

        Raises:
            ValueError: the function returns numbers that are not real.
            TypeError: the function returns no arrays, or needs the value of a traced number.
        """
        result = functions.call("identify", "simulate", self.simulate, *args)
        if not jax.tree.leaves(functions.tree("identify", "simulate", result)):
            raise TypeError(
                "identify: simulate must return predictions of the data,"
                f" {checks.described(self.data)}, got {result!r}; is a return missing?"
            )
        for x in jax.tree.leaves(result):
            checks.numbers("identify", "what simulate returns", x)
        return result

    def _onward(self, params: PyTree, node: Array) -> tuple[PyTree, PyTree]:
        """Simulates one segment from its initial state. Returns the predictions and the end state.

        Raises:
            ValueError: `simulate` does not return an end state in the structure of a node.
        """
        first = jax.tree.map(lambda x: x[0], self.given)
        result = self._simulated(params, ravel_pytree(first)[1](node))
        both = isinstance(result, tuple | list) and len(result) == 2
        predicted, end = result if both else (result, ())
        wanted, got = checks.described(first), checks.described(end)
        if got != wanted:
            raise ValueError(
                "identify: with nodes simulate must return predictions and an end like a node,"
                f" {wanted}; the end that it returns is {got}."
            )
        return predicted, end


def _scatters(residuals: list[np.ndarray]) -> list[float]:
    """Estimates noise from differences of neighboring residuals, along each axis but the first.

    Axes with fewer than `NEIGHBORS` differences are left out.

    Args:
        residuals: residuals by leaf of the data, with a first axis of stretches; NaN where missing.

    Returns:
        One standard deviation per axis.
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
    """Assembles the Jacobian of all data residuals and end states from Jacobians of stretches.

    Its rows are data residuals, then end states. Its columns are parameters, then nodes.

    Args:
        by_r: ∂r/∂(parameters, node) of each stretch, (stretches, m, p + n).
        by_end: ∂end/∂(parameters, node) of each stretch but the last, (stretches − 1, n, p + n).
        p: number of parameters.
    """
    blocks = []
    for rows in (by_r, by_end):
        count, height, width = rows.shape
        block = np.zeros((count, height, p + len(by_r) * (width - p)))
        block[:, :, :p] = rows[:, :, :p]
        for k in range(count):
            node = p + k * (width - p)
            block[k, :, node : node + width - p] = rows[k, :, p:]
        blocks.append(block.reshape(count * height, block.shape[2]))
    return np.concatenate(blocks)
