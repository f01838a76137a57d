"""Curvature of a loss from the gradients along a search: limited-memory BFGS."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array

PAIRS = 10
"""The number of secant pairs that are kept."""


@pytree
class Secants:
    """Pairs (s, y) with H s = y for a mean Hessian H of the loss, the newest last.

    Attributes:
        steps: s = x₁ − x₀ between two points of the search, (m, n); 0 where there is none yet.
        changes: y = g₁ − g₀ of the gradient between them, (m, n).
    """

    steps: Array
    changes: Array

    @classmethod
    def none(cls, x: Array) -> Secants:
        """No pairs, for coordinates x (n,)."""
        empty = jnp.zeros((PAIRS, *x.shape), x.dtype)
        return cls(empty, empty)

    def add(self, step: Array, change: Array, slope: Array) -> Secants:
        """The pairs with one more, if the loss is convex along it and the change is no rounding.

        Args:
            step: s (n,).
            change: y (n,).
            slope: gradient g₁ at the end of the step, (n,).
        """
        eps = jnp.finfo(step.dtype).eps
        sizes = jnp.max(jnp.abs(step), initial=0), jnp.max(jnp.abs(change), initial=0)
        told = sizes[1] > eps**0.5 * jnp.max(jnp.abs(slope), initial=0)
        # s and y of like size: their squares then neither overflow nor vanish in float32
        scale = jnp.where(told & (sizes[0] > 0), jnp.sqrt(sizes[0]) * jnp.sqrt(sizes[1]), 1)
        s, y = step / scale, change / scale
        told &= s @ y > eps * jnp.sqrt((s @ s) * (y @ y))
        pairs = ((self.steps, s), (self.changes, y))
        added = (jnp.where(told, jnp.append(old[1:], x[None], 0), old) for old, x in pairs)
        return Secants(*added)

    def newton_step(self, slope: Array, free: Array) -> Array:
        """−H⁻¹ g within the free coordinates, by the two-loop recursion, (n,); NaN without pairs.

        The recursion begins from a diagonal, Σ |s y| / Σ y² by coordinate. Unlike a multiple of
        the identity it does not depend on the units of the coordinates.

        Args:
            slope: g (n,).
            free: whether a coordinate may move, (n,).

        References:
            Nocedal, Wright, Numerical Optimization (2006), algorithm 7.4.
        """
        s, y = (jnp.where(free[None], x, 0) for x in (self.steps, self.changes))
        curved = jnp.sum(s * y, axis=1)
        valid = curved > 0
        rho = jnp.where(valid, 1 / jnp.where(valid, curved, 1), 0)
        pairs = (s, y, rho)

        def backward(d: Array, pair: tuple[Array, ...]) -> tuple[Array, Array]:
            s, y, rho = pair
            weight = rho * (s @ d)
            return d - weight * y, weight

        def forward(d: Array, pair: tuple[Array, ...]) -> tuple[Array, None]:
            s, y, rho, weight = pair
            return d + (weight - rho * (y @ d)) * s, None

        # loops, not unrolled: they compile in a tenth of a second
        d, weights = jax.lax.scan(backward, jnp.where(free, slope, 0), pairs, reverse=True)
        d = self._diagonal(s, y, valid) * d
        d, _ = jax.lax.scan(forward, d, (*pairs, weights))
        return jnp.where(jnp.any(valid), -d, jnp.nan)

    @staticmethod
    def _diagonal(s: Array, y: Array, valid: Array) -> Array:
        """An inverse Hessian by coordinate, (n,); the mean one where nothing is known."""
        s, y = (jnp.where(valid[:, None], x, 0) for x in (s, y))
        products, squares = jnp.abs(s * y), y * y
        top, bottom = jnp.sum(products), jnp.sum(squares)
        mean = top / jnp.where(bottom > 0, bottom, 1)
        own = jnp.sum(squares, axis=0)
        return jnp.where(own > 0, jnp.sum(products, axis=0) / jnp.where(own > 0, own, 1), mean)
