"""Which feedback gains are stable at a step, by the exact law of each integrator."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxcon.constraints.rows import linearize
from jaxcon.core import checks
from jaxcon.model.state import recall
from jaxcon.stabilization.penalty import Penalty, felt
from jaxcon.stabilization.pid import PID

MARGIN = 1e-9
"""Growth per step that counts as marginal, not as unstable."""

SLOW = 1e-3
"""Growth per step of springs that counts as marginal: many explicit methods amplify slowly."""


def largest_stable_rate(integrator: Any, dt: float, damping_ratio: float = 1.0) -> float:
    """The largest rate [1/s] at which feedback with α = ζ·rate, β = rate is stable at step dt.

    Args:
        integrator: with `growth`.
        dt: h [s].
        damping_ratio: ζ.

    Returns:
        The limit, to ten digits; 0 where no rate is stable.

    Raises:
        TypeError: the integrator is none.
        ValueError: h is not positive, or ζ negative.
    """
    owner = "largest_stable_rate"
    if isinstance(integrator, type) or not hasattr(integrator, "growth"):
        raise TypeError(
            f"{owner}: integrator must be a value such as RK4(), got"
            f" {checks.shortened(integrator)}."
        )
    checks.check(owner, "dt", dt, (), above=0)
    checks.check(owner, "damping_ratio", damping_ratio, (), least=0)

    def stable(x: float) -> bool:
        return integrator.growth(damping_ratio * x, x, 1.0) <= 1 + 1e-12

    grid = np.geomspace(1e-3, 1e3, 600)
    first = next((i for i, x in enumerate(grid) if not stable(x)), None)
    if not first:
        return np.inf if first is None else 0.0
    low, high = grid[first - 1], grid[first]
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if stable(middle) else (low, middle)
    return float(low / dt)


def stable_rate(integrator: Any, dt: Any, least_ratio: float) -> Any:
    """The largest β [1/s] at which every α from least_ratio·β to β is stable; h may be traced."""
    ratios = np.linspace(least_ratio, 1.0, 5)
    return min(largest_stable_rate(integrator, 1.0, ratio) for ratio in ratios) / dt


def growth(integrator: Any, alpha: float, beta: float, integral: float, dt: float) -> float:
    """The spectral radius of a step on (φ, φ̇, ∫φ) under φ̈ + 2α φ̇ + β² φ + K_i ∫φ = 0.

    The integral is held over a step and advances by h φ after it.
    """
    if not integral or not hasattr(integrator, "error_map"):
        return integrator.growth(alpha, beta, dt)
    first, second, held = integrator.error_map(alpha, beta, dt)
    sum_ = [-integral * x for x in held]
    matrix = np.array([[*first, dt], [*second, 0.0], [*sum_, 1.0]], float).T
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))


def warn_if_unstable(method: Any, dt: Any, system: Any = None, state: Any = None) -> None:
    """Warns where gains or springs are unstable at the step, as far as they are not traced.

    Args:
        method: whose stabiliser has them.
        dt: h [s].
        system: on which explicit springs act.
        state: where it starts.
    """
    if not checks.is_concrete((method.stabilizer, method.integrator, dt)):
        return
    try:
        h = float(dt)
    except (TypeError, ValueError, OverflowError):  # the step itself says what is wrong with it
        return
    message = instability(method, h, system, state)
    if message:
        warnings.warn(message, stacklevel=3)


def instability(method: Any, h: float, system: Any = None, state: Any = None) -> str | None:
    """What is wrong with the first gains or springs that are unstable; None where none are."""
    with jax.ensure_compile_time_eval():  # gains may be arrays, inside a trace that is not theirs
        return _first_unstable(method, h, system, state)


def _first_unstable(method: Any, h: float, system: Any, state: Any) -> str | None:
    for part in parts(method.stabilizer):
        message = unstable_gains(method.integrator, part, h)
        if isinstance(part, Penalty) and not part.implicit and checks.is_concrete((system, state)):
            message = message or unstable_spring(method.integrator, part, h, system, state)
        if message:
            return message
    return None


def default_gains(method: Any, dt: Any) -> tuple[Any, Any]:
    """(α, β) of the first feedback in the stabiliser, or of the integrator where there is none.

    Args:
        method: whose stabiliser takes them where none are given.
        dt: h, () [s].
    """
    for part in parts(method.feedback(dt)):
        fallback = getattr(part, "fallback", None)
        if fallback is not None:
            return fallback
    return method.integrator.default_gains(dt)


def parts(stabilizer: Any) -> list[Any]:
    """A stabiliser and those that it consists of."""
    nested = (getattr(stabilizer, name, None) for name in ("others", "feedback", "small", "middle"))
    return [stabilizer, *(part for whole in nested if whole is not None for part in parts(whole))]


def unstable_gains(integrator: Any, stabilizer: Any, h: float) -> str | None:
    """What is wrong with the feedback gains, None where nothing is."""
    if h == 0:
        return None
    gains = [getattr(stabilizer, name, None) for name in ("alpha", "beta", "integral")]
    if isinstance(stabilizer, PID):
        default = [float(x) for x in integrator.default_gains(h)]
        gains = [
            own if own is not None else x for own, x in zip(gains, (*default, 0.0), strict=True)
        ]
    alpha, beta, integral = gains
    if alpha is None or beta is None:
        return None
    for name, a, b, k in _sets(alpha, beta, 0.0 if integral is None else integral):
        if growth(integrator, a, b, k, h) > 1 + MARGIN:
            return _words(integrator, stabilizer, (name, a, b, k), h)
    return None


def _words(
    integrator: Any, stabilizer: Any, gains: tuple[str, float, float, float], h: float
) -> str:
    name, a, b, k = gains
    what = f"alpha={a:.6g}, beta={b:.6g}"
    if isinstance(stabilizer, PID):
        what = f"proportional={b * b:.6g}, derivative={2 * a:.6g}, integral={k:.6g}"
    kind = "PID" if isinstance(stabilizer, PID) else "Baumgarte"
    text = (
        f"{kind} gains {what}{name} are unstable at dt={h:.6g} with"
        f" {type(integrator).__name__}: errors grow."
    )
    if integrator.growth(a, b, h) <= 1 + MARGIN:
        return f"{text} They are stable without the integral: lower it below 2·alpha·beta²."
    ratio = a / b if b else 1.0
    limit = largest_stable_rate(integrator, h, ratio)
    ratio_of = f"At this damping ratio ({ratio:.3g}) the largest stable rate"
    return f"{text} {ratio_of} is {limit:.6g} 1/s: take no more, or a smaller dt."


def unstable_spring(
    integrator: Any, penalty: Penalty, h: float, system: Any, state: Any
) -> str | None:
    """What is wrong with explicit springs; each row alone, which others can only make worse.

    A spring k and damper d on the mass m = 1/A_ii obey φ̈ + (d/m) φ̇ + (k/m) φ = 0.
    """
    here = recall(system, state.turns, state.angle_remainder)
    rows = linearize(here, state.q, state.v, state.instant)
    rows = dataclasses.replace(rows, mass=system.mass(state.q))
    soft = penalty.soft(rows.layout)
    numbers = (felt(rows), *penalty.constants(rows))
    own, k, d = (np.broadcast_to(np.asarray(x), soft.shape) for x in numbers)
    if not soft.any():
        return None
    worst = int(np.argmax(np.where(soft, k * own + (d * own / 2) ** 2, -1.0)))
    m, stiffness, damping = 1 / own[worst], k[worst], d[worst]
    rate = float(np.sqrt(stiffness / m))
    if integrator.growth(float(damping / m / 2), rate, h) <= 1 + SLOW:
        return None
    name = next(n for n in rows.layout.names if worst in rows.layout.rows(n))
    return (
        f"Penalty: the explicit spring of '{name}', {stiffness:.6g} N/m on {m:.6g} kg, is unstable"
        f" at dt={h:.6g} with {type(integrator).__name__}; semi-implicit Euler without damping is"
        f" stable below 4 m/h² = {4 * m / h**2:.6g}. Take implicit=True, or a smaller step."
    )


def _sets(alpha: Any, beta: Any, integral: Any) -> list[tuple[str, float, float, float]]:
    """Name, α, β and K_i of every gain that was given."""
    gains = (alpha, beta, integral)
    named = [set(x) for x in gains if isinstance(x, Mapping)]
    if named:
        if any(np.ndim(x) for x in gains if not isinstance(x, Mapping)):
            return []
        values = [x if isinstance(x, Mapping) else dict.fromkeys(named[0], x) for x in gains]
        names = sorted(set.intersection(*map(set, values)))
        return [(f" of '{n}'", *(float(x[n]) for x in values)) for n in names]  # type: ignore[misc]
    a, b, k = np.broadcast_arrays(*(np.asarray(jax.device_get(x), float) for x in gains))
    found = sorted(
        set(zip(a.ravel().tolist(), b.ravel().tolist(), k.ravel().tolist(), strict=True))
    )
    return [("", x, y, z) for x, y, z in found]
