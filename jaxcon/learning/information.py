"""Identifiability of parameters while other unknowns are free, and noise estimates. Host code."""

from __future__ import annotations

import numpy as np

from jaxcon.learning.least_squares import Fit, Precision


def noise_left(fit: Fit, rows: int, observed: int, precision: Precision) -> float:
    """Returns the root mean square residual per degree of freedom; NaN if no freedom is left.

    The number of degrees of freedom is the number of data minus Σ Pᵢᵢ over the data rows i. P is
    the projection onto the columns of J, without the columns of unknowns on a bound.

    Args:
        fit: a fit whose residuals are data rows, followed by continuity rows.
        rows: the number of data rows.
        observed: the number of data rows that are not NaN.
        precision: floating-point precision of the residuals.
    """
    U, *_ = precision.reached(fit.jacobian[:, fit.free])
    freedom = observed - np.sum(U[:rows] ** 2)
    return float(np.linalg.norm(fit.residual[:rows]) / freedom**0.5) if freedom > 0.5 else np.nan


def singular_directions(
    J: np.ndarray, others: np.ndarray, unit: np.ndarray, precision: Precision
) -> tuple[np.ndarray, np.ndarray]:
    """Computes how well residuals r determine unknowns x, while other unknowns y are free.

    The result is a singular value decomposition of ∂r/∂x · unit, after the columns of ∂r/∂y have
    been projected out of ∂r/∂x.

    Args:
        J: the Jacobian ∂r/∂x, (m, n).
        others: the Jacobian ∂r/∂y, (m, k).
        unit: the unit of each x, (n,).
        precision: floating-point precision of r.

    Returns:
        The singular values, (n,), 0 for directions that r does not determine; and the directions
        in x / unit, as rows of length 1, (n, n).
    """
    n, D = J.shape[1], precision.scale(J)
    U, *_ = precision.reached(others)
    # columns of equal length: the rank then does not depend on the units
    scaled = J / D
    _, s, V = np.linalg.svd(_padded(scaled - U @ (U.T @ scaled)), full_matrices=False)
    rank = int(np.sum(s > precision.tolerance))
    null, _ = np.linalg.qr((V[rank:] / np.where(np.isinf(D), 1, D) / unit).T)
    J = np.where(np.isinf(D), 0, J - U @ (U.T @ J)) * unit
    _, s, V = np.linalg.svd(_padded(J - (J @ null) @ null.T), full_matrices=False)
    signs = [np.sign(row[np.abs(row).argmax()]) for row in V]
    return np.where(np.arange(n) < rank, s, 0), V * np.reshape(signs, (n, 1))


def _padded(J: np.ndarray) -> np.ndarray:
    """Appends n rows of zeros, so that J (m, n) has at least as many rows as columns."""
    return np.concatenate([J, np.zeros((J.shape[1], J.shape[1]))])


def deviations(s: np.ndarray, V: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns the standard deviation (Σ (v / s)²)^½ of each unknown, (n,).

    The sum is over directions v with singular values s. The standard deviation is infinite if the
    unknown takes part in a direction with s = 0.

    Args:
        s: singular values, (k,).
        V: directions v as rows, (k, n).
        tolerance: an unknown takes part in a direction if its component |v| is larger than this.
    """
    shares = (s[:, None] != 0) | (np.abs(V) > tolerance)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(np.sum(np.where(shares, V / s[:, None], 0) ** 2, axis=0))
