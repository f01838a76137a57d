"""Which feedback gains are stable at a step, by the exact law of each integrator."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxcon.core import checks

MARGIN = 1e-9
"""Growth per step that counts as marginal, not as unstable."""


def largest_stable_rate(integrator: Any, dt: float, damping_ratio: float = 1.0) -> float:
    """The largest rate [1/s] at which feedback with α = ζ·rate, β = rate is stable at step dt.

    Args:
        integrator: with `growth`.
        dt: h [s].
        damping_ratio: ζ.

    Returns:
        The limit, to ten digits; 0 where no rate is stable.
    """

    def stable(x: float) -> bool:
        return integrator.growth(damping_ratio * x, x, 1.0) <= 1 + 1e-12

    grid = np.geomspace(1e-3, 1e3, 600)
    unstable = [x for x in grid if not stable(x)]
    if not unstable or unstable[0] == grid[0]:
        return np.inf if not unstable else 0.0
    high = unstable[0]
    low = grid[np.searchsorted(grid, high) - 1]
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if stable(middle) else (low, middle)
    return float(low / dt)


def warn_if_unstable(method: Any, dt: Any) -> None:
    """Warns where gains are unstable at the step, if neither is traced."""
    stabilizer = method.stabilizer
    alpha, beta = getattr(stabilizer, "alpha", None), getattr(stabilizer, "beta", None)
    if alpha is None or beta is None or not checks.is_concrete((alpha, beta, dt)):
        return
    try:
        h = float(dt)
    except (TypeError, ValueError):  # the step itself says what is wrong with it
        return
    for name, a, b in _pairs(alpha, beta):
        if method.integrator.growth(a, b, h) > 1 + MARGIN:
            ratio = a / b if b else 1.0
            limit = largest_stable_rate(method.integrator, h, ratio)
            warnings.warn(
                f"Baumgarte gains alpha={a:.6g}, beta={b:.6g}{name} are unstable at dt={h:.6g} with"
                f" {type(method.integrator).__name__}: errors grow. At this damping ratio"
                f" ({ratio:.3g}) the largest stable rate is {limit:.6g} 1/s.",
                stacklevel=3,
            )
            return


def _pairs(alpha: Any, beta: Any) -> list[tuple[str, float, float]]:
    """Name, α and β of every gain that was given."""
    if isinstance(alpha, Mapping) and isinstance(beta, Mapping):
        names = [name for name in alpha if name in beta]
        return [(f" of '{n}'", float(alpha[n]), float(beta[n])) for n in names]
    if isinstance(alpha, Mapping) or isinstance(beta, Mapping):
        return []
    a, b = np.broadcast_arrays(*(np.asarray(jax.device_get(x), float) for x in (alpha, beta)))
    found = sorted(set(zip(a.ravel().tolist(), b.ravel().tolist(), strict=True)))
    return [("", x, y) for x, y in found]
