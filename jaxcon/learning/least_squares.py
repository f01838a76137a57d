"""Levenberg–Marquardt on the host: few unknowns, residuals and Jacobian from one jitted call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

INTERRUPTED = "interrupted from the keyboard"
START = 1e-3
"""μ at the start."""


@dataclass(frozen=True)
class Fit:
    """Where ½ ‖r‖² is least.

    Attributes:
        z: unknowns, (n,).
        residual: r there, (m,).
        jacobian: ∂r/∂z there, (m, n).
        costs: ½ ‖r‖² at the start and after each step.
        stopped: why it went no further, in words.
    """

    z: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    costs: np.ndarray
    stopped: str

    @property
    def interrupted(self) -> bool:
        """Whether somebody wants it to end."""
        return self.stopped == INTERRUPTED


def least_squares(
    linearize: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    z: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    steps: int,
    tolerance: float,
) -> Fit:
    """argmin ½ ‖r(z)‖² within low ≤ z ≤ high, by steps −(JᵀJ + μ s₁²)⁻¹ Jᵀr.

    Directions whose singular value is below `tolerance` of the largest are not moved along: the
    data say nothing of them. Unknowns that press against a bound stay there for a step.

    Args:
        linearize: z → (r, J).
        z: the start, (n,); r must be finite there.
        low: (n,).
        high: (n,).
        steps: at most so many.
        tolerance: √ε of the residuals' own precision: relative steps below it end the search.
    """
    (r, J), damping = linearize(z), START
    costs = [_cost(r, J)]
    stopped = "every step was taken"
    try:
        for _ in tqdm(range(steps), desc="identifying", unit="step", disable=None):
            move = _steps(z, r, J, low, high, tolerance)
            while True:
                ahead = np.clip(z + move(damping), low, high)
                small = bool(np.all(np.abs(ahead - z) <= tolerance * (1 + np.abs(z))))
                found = linearize(ahead)
                better = _cost(*found) < costs[-1]
                if better or small:
                    break
                damping *= 10
            if better:
                z, (r, J) = ahead, found
                damping = max(damping / 10, tolerance**2)
                costs.append(_cost(r, J))
            if small:
                stopped = "converged"
                break
    except KeyboardInterrupt:
        stopped = INTERRUPTED
    return Fit(z, r, J, np.array(costs), stopped)


def _cost(r: np.ndarray, J: np.ndarray) -> float:
    """½ ‖r‖², infinite where it or its derivative is not finite."""
    return float(r @ r / 2) if np.all(np.isfinite(r)) and np.all(np.isfinite(J)) else np.inf


def _steps(
    z: np.ndarray, r: np.ndarray, J: np.ndarray, low: np.ndarray, high: np.ndarray, tolerance: float
) -> Callable[[float], np.ndarray]:
    """Damping → step, (n,)."""
    slope = J.T @ r
    free = ~((z <= low) & (slope > 0) | (z >= high) & (slope < 0))
    U, s, V = np.linalg.svd(J[:, free], full_matrices=False)
    told = s > tolerance * np.max(s, initial=0)
    s, V, along = s[told], V[told], U.T[told] @ r

    def step(damping: float) -> np.ndarray:
        move = np.zeros_like(z)
        move[free] = -(along * s / (s * s + damping * np.max(s, initial=0) ** 2)) @ V
        return move

    return step
