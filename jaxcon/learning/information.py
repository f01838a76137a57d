"""Identifiability of some unknowns with others free, and the noise of residuals. Host code."""

from __future__ import annotations

import numpy as np

from jaxcon.learning.least_squares import Fit, Precision


def noise_left(fit: Fit, rows: int, observed: int, precision: Precision) -> float:
    """The root mean square of residuals by degree of freedom; NaN where none is left.

    What the unknowns take from the numbers that were seen is the trace of the projection onto the
    columns of J, as far as these are independent and off their bounds.

    Args:
        fit: with its residuals; only the first ones count, others are conditions.
        rows: how many count.
        observed: how many of these were seen.
        precision: of residuals.
    """
    U, *_ = precision.reached(fit.jacobian[:, fit.free])
    freedom = observed - np.sum(U[:rows] ** 2)
    return float(np.linalg.norm(fit.residual[:rows]) / freedom**0.5) if freedom > 0.5 else np.nan


def told(
    own: np.ndarray, others: np.ndarray, unit: np.ndarray, precision: Precision
) -> tuple[np.ndarray, np.ndarray]:
    """Singular values and directions of what residuals say of some unknowns whatever the others.

    Rank is judged on columns of equal length, since a unit says nothing of what can be told.

    Args:
        own: ∂r/∂x, (m, n).
        others: by the other unknowns.
        unit: of x, (n,).
        precision: of r.

    Returns:
        Singular values by units, 0 where nothing is told, (n,), and directions of length 1, (n, n).
    """
    n, D = own.shape[1], precision.scale(own)
    U, *_ = precision.reached(others)
    alike = own / D
    _, s, V = np.linalg.svd(_padded(alike - U @ (U.T @ alike)), full_matrices=False)
    k = int(np.sum(s > precision.tolerance))
    null, _ = np.linalg.qr((V[k:] / np.where(np.isinf(D), 1, D) / unit).T)
    own = np.where(np.isinf(D), 0, own - U @ (U.T @ own)) * unit
    _, s, V = np.linalg.svd(_padded(own - (own @ null) @ null.T), full_matrices=False)
    signs = [np.sign(row[np.abs(row).argmax()]) for row in V]
    return np.where(np.arange(n) < k, s, 0), V * np.reshape(signs, (n, 1))


def _padded(J: np.ndarray) -> np.ndarray:
    """With n rows of zeros, so that there are never fewer rows than columns."""
    return np.concatenate([J, np.zeros((J.shape[1], J.shape[1]))])


def deviations(s: np.ndarray, V: np.ndarray, tolerance: float) -> np.ndarray:
    """(Σ (v / s)²)^½ of each unknown; infinite where it has a share in what is not told."""
    shares = (s[:, None] != 0) | (np.abs(V) > tolerance)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(np.sum(np.where(shares, V / s[:, None], 0) ** 2, axis=0))
