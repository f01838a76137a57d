"""A recording in one stretch or in several: residuals, gaps and their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxcon.core.typing import Array, PyTree
from jaxcon.learning.leaves import Space
from jaxcon.learning.losses import misfit


@dataclass(frozen=True)
class Stretches:
    """A recording in one stretch, or in several that begin at nodes."""

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

    def widths(self, residual: np.ndarray, continuity: float) -> list[float]:
        """By how much ends may miss nodes, from what they do at the start, by decades.

        A search that had to keep them together from the start would creep along a narrow valley.
        """
        gaps = residual[residual.size - self.gaps :]
        missed = np.sqrt(np.sum(gaps**2) / max(self.gaps, 1))
        decades = np.ceil(np.log10(max(missed / continuity, 1)))
        return [continuity * 10.0**k for k in np.arange(decades, -1, -1)]

    @property
    def gaps(self) -> int:
        """How many of the residuals, the last ones, are gaps between stretches."""
        stretches, n = self.nodes.shape
        return (stretches - 1) * n

    def linearize(self, continuity: float) -> Callable[[np.ndarray], Any]:
        """unknowns → residuals with the gaps between stretches, and their Jacobian."""
        p, (stretches, n) = self.scale.size, self.nodes.shape
        data = (
            self.data
            if self.given is not None
            else jax.tree.map(lambda x: np.asarray(x)[None], self.data)
        )
        shapes = [np.shape(x) for x in jax.tree.leaves(data)]
        if any(shape[:1] != (stretches,) for shape in shapes):
            raise ValueError(
                f"identify: with {stretches} nodes the data must have a first axis of as many"
                f" stretches, got shapes {shapes}."
            )

        def rows(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            x = np.concatenate([np.tile(z[:p], (stretches, 1)), z[p:].reshape(stretches, n)], 1)
            found = _derivatives(
                self.simulate,
                self.space,
                self.scale,
                self.noise,
                self.given,
                data,
                jnp.asarray(x, self.scale.dtype),
            )
            (r, end), (by_r, by_end) = jax.tree.map(lambda x: np.asarray(x, float), found)
            gap, J = (end[:-1] - x[1:, p:]) / continuity, _placed(by_r, by_end[:-1] / continuity, p)
            J[r.size :, p + n :] -= np.eye(gap.size) / continuity
            return np.append(r, gap), J

        return rows


@partial(jax.jit, static_argnames=("simulate",))
def _derivatives(
    simulate: Any, space: Space, scale: Array, noise: Any, nodes: Any, data: Any, x: Array
) -> Any:
    """(residuals, end) of every stretch, and both by (parameters, node), in forward mode."""
    p = scale.size

    def stretch(x: Array, data: PyTree) -> tuple[Array, Array]:
        params, end = space.decode(space.split(x[:p] * scale)), ()
        if nodes is None:
            predicted = simulate(params)
        else:
            first = jax.tree.map(lambda node: node[0], nodes)
            predicted, end = simulate(params, ravel_pytree(first)[1](x[p:]))
        return ravel_pytree(misfit(predicted, data, noise))[0], ravel_pytree(end)[0]

    def along(x: Array, data: PyTree) -> Any:
        def push(tangent: Array) -> Any:
            return jax.jvp(lambda x: stretch(x, data), (x,), (tangent,))

        return jax.vmap(push, out_axes=(None, -1))(jnp.eye(x.size, dtype=x.dtype))

    return jax.vmap(along)(x, data)


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
