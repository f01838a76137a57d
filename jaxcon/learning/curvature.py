"""Estimates the curvature of a loss from gradients during a search, by limited-memory BFGS."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array

PAIRS = 10
"""The number of secant pairs that L-BFGS stores."""
VANISHED = 1e-3
"""The share of the gradient at the start below which a gradient has almost vanished."""


@pytree
class Secants:
    """Secant pairs (s, y) of steps and gradient changes, for limited-memory BFGS; newest last.

    They satisfy H s = y, with the Hessian H of the loss averaged over the step.

    Attributes:
        steps: steps s = x₁ − x₀ between points of the search, (m, n); zero for unused pairs.
        changes: changes y = g₁ − g₀ of the gradient over these steps, (m, n).
    """

    steps: Array
    changes: Array

    @classmethod
    def none(cls, x: Array) -> Secants:
        """Returns an empty set of pairs, for search coordinates x (n,)."""
        empty = jnp.zeros((PAIRS, *x.shape), x.dtype)
        return cls(empty, empty)

    def add(self, step: Array, change: Array, slope: Array) -> Secants:
        """Returns the pairs with the pair (s, y) of a step added, if it is reliable.

        It is unreliable if the loss is not convex along s, or if y may be a mere rounding error.

        Args:
            step: the step s, (n,).
            change: the change y of the gradient over the step, (n,).
            slope: the gradient g₁ at the end of the step, (n,).
        """
        eps = jnp.finfo(step.dtype).eps
        sizes = jnp.max(jnp.abs(step), initial=0), jnp.max(jnp.abs(change), initial=0)
        valid = sizes[1] > eps**0.5 * jnp.max(jnp.abs(slope), initial=0)
        # scales s and y to equal size, so that their squares do not over- or underflow in float32
        scale = jnp.where(valid & (sizes[0] > 0), jnp.sqrt(sizes[0]) * jnp.sqrt(sizes[1]), 1)
        s, y = step / scale, change / scale
        valid &= s @ y > eps * jnp.sqrt((s @ s) * (y @ y))
        pairs = ((self.steps, s), (self.changes, y))
        added = (jnp.where(valid, jnp.append(old[1:], x[None], 0), old) for old, x in pairs)
        return Secants(*added)

    def newton_step(self, slope: Array, free: Array) -> Array:
        """Returns the quasi-Newton step −H⁻¹ g in the free coordinates, (n,); NaN without pairs.

        H is the Hessian of the loss, approximated by secant pairs. g is the gradient of the loss.

        Uses the two-loop recursion of L-BFGS. The initial inverse Hessian is diagonal, with entries
        Σ |s y| / Σ y² over all pairs. Unlike a multiple of the identity, this matrix adapts to the
        units of each coordinate.

        Args:
            slope: the gradient g, (n,).
            free: mask of the coordinates that may move, (n,).

        References:
            Nocedal, Wright, Numerical Optimization (2006), algorithm 7.4.
        """
        s, y = (jnp.where(free[None], x, 0) for x in (self.steps, self.changes))
        curved = jnp.sum(s * y, axis=1)
        valid = curved > 0
        rho = jnp.where(valid, 1 / jnp.where(valid, curved, 1), 0)
        pairs = (s, y, rho)

        def backward(d: Array, pair: tuple[Array, ...]) -> tuple[Array, Array]:
            """First loop of the L-BFGS recursion: subtracts ρ (sᵀd) y from d, with ρ = 1 / (sᵀy).

            Args:
                d: the vector that the recursion updates, (n,).
                pair: (s, y, ρ).

            Returns:
                The new d, and the weight ρ sᵀd.
            """
            s, y, rho = pair
            weight = rho * (s @ d)
            return d - weight * y, weight

        def forward(d: Array, pair: tuple[Array, ...]) -> tuple[Array, None]:
            """Second loop of the L-BFGS recursion: adds (w − ρ yᵀd) s to d, with ρ = 1 / (sᵀy).

            Args:
                d: the vector that the recursion updates, (n,).
                pair: (s, y, ρ, w), with the weight w from the first loop.
            """
            s, y, rho, weight = pair
            return d + (weight - rho * (y @ d)) * s, None

        # scans instead of unrolled loops, since they compile fast
        d, weights = jax.lax.scan(backward, jnp.where(free, slope, 0), pairs, reverse=True)
        d = self._diagonal(s, y, valid) * d
        d, _ = jax.lax.scan(forward, d, (*pairs, weights))
        return jnp.where(jnp.any(valid), -d, jnp.nan)

    @staticmethod
    def _diagonal(s: Array, y: Array, valid: Array) -> Array:
        """Returns the initial diagonal Σ |s y| / Σ y² of the inverse Hessian H⁻¹, (n,).

        The sums are over the valid pairs. Coordinates whose gradient did not change get the ratio
        of the sums over all coordinates.
        """
        s, y = (jnp.where(valid[:, None], x, 0) for x in (s, y))
        products, squares = jnp.abs(s * y), y * y
        top, bottom = jnp.sum(products), jnp.sum(squares)
        mean = top / jnp.where(bottom > 0, bottom, 1)
        sums = jnp.sum(squares, axis=0)
        return jnp.where(sums > 0, jnp.sum(products, axis=0) / jnp.where(sums > 0, sums, 1), mean)

    def cautious_step(self, slope: np.ndarray, first: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Returns a bound on the Newton step where the pairs leave the curvature open, (n,).

        L-BFGS assumes a large curvature along directions in which the search has hardly moved. Adam
        may leap across a narrow valley and hardly move along it: the bottom then seems near. This
        function instead fits the symmetric Hessian H to all pairs, Y ≈ S H, by least squares. An
        eigenvalue of H is uncertain by δ = ‖Y − S H‖ / σ, with the smallest singular value σ of S.
        The bound takes the smallest curvature that the pairs allow, λ − δ, along each eigenvector.
        If that is not positive, the bound is infinite, unless the gradient along the eigenvector
        has almost vanished since the start of the search: near a minimum, where pairs are mere
        rounding errors, the bound is then zero. Each coordinate is in units of its largest step
        among the scaled pairs.

        Args:
            slope: the gradient g at the best point, (n,).
            first: the gradient at the start of the search, (n,).
            free: mask of the coordinates that may move, (n,).
        """
        bound = np.zeros(len(slope))
        if not np.any(free):
            return bound
        given = (self.steps, self.changes, slope, first)
        s, y, g, g0 = (np.asarray(x, float)[..., free] for x in given)
        valid = np.any(s != 0, axis=1)
        unit = np.max(np.abs(s), axis=0, initial=0)
        if np.sum(valid) < len(unit) or not np.all(unit > 0) or not np.all(np.isfinite(y)):
            bound[free] = np.where(np.abs(g) <= VANISHED * np.abs(g0), 0, np.inf)
            return bound
        s, y, g, g0 = s[valid] / unit, y[valid] * unit, g * unit, g0 * unit
        hessian = np.linalg.lstsq(s, y, rcond=None)[0]
        hessian = (hessian + hessian.T) / 2
        smallest = np.linalg.svd(s, compute_uv=False)[-1]
        misfit = np.linalg.norm(y - s @ hessian)
        curvature, axes = np.linalg.eigh(hessian)
        least = curvature - np.divide(misfit, smallest, out=np.array(np.inf), where=smallest > 0)
        along, at_first = np.abs(axes.T @ g), np.abs(axes.T @ g0)
        open_ends = np.where(along <= VANISHED * at_first, 0, np.inf)
        far = np.divide(along, least, out=open_ends, where=least > 0)
        # an infinite distance counts along each coordinate of which its eigenvector has a part
        parts = np.abs(axes) * (far > 0)
        bound[free] = unit * np.sum(np.where(parts > 0, parts * far, 0), axis=1)
        return bound
