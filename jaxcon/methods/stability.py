"""Stability limits of feedback gains, and the response of feedback to disturbances.

Both are computed from the exact linear map by which a step of each integrator transforms a
constraint error.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import linearize
from jaxcon.core import checks
from jaxcon.core.typing import Array, Scalar
from jaxcon.methods.baumgarte import Wrapper
from jaxcon.methods.gains import Gain
from jaxcon.methods.hybrid import Hybrid
from jaxcon.methods.penalty import Penalty, effective_inverse_mass
from jaxcon.methods.pid import PID
from jaxcon.protocols import Integrator, Stabilizer, System
from jaxcon.system.state import State, with_turns

if TYPE_CHECKING:
    from jaxcon.methods.method import Method

MARGIN = 1e-9
"""The largest growth of an error per step that counts as marginal, not as unstable."""

SLOW = 1e-3
"""The largest growth of a spring's motion per step that counts as marginal, not as unstable.

It is larger than `MARGIN`, since many explicit methods amplify vibrations slightly.
"""


def largest_stable_rate(integrator: Integrator, dt: float, damping_ratio: float = 1.0) -> float:
    """Returns the largest rate [1/s] for which feedback with α = ζ·rate and β = rate is stable.

    Args:
        integrator: an integrator with a `growth` method.
        dt: step size h [s].
        damping_ratio: damping ratio ζ.

    Returns:
        The limit, to ten digits; 0 if no rate is stable.

    Raises:
        TypeError: the integrator is not a value such as `RK4()`, or has no `growth`.
        ValueError: h is not positive, or ζ negative.
    """
    owner = "largest_stable_rate"
    _check_integrator(owner, integrator)
    checks.check(owner, "dt", dt, (), above=0)
    checks.check(owner, "damping_ratio", damping_ratio, (), least=0)

    def stable(x: float) -> bool:
        factor = integrator.growth(damping_ratio * x, x, 1.0)
        if factor is None:
            raise TypeError(
                f"{owner}: {type(integrator).__name__} has no `growth`, the factor by which a"
                " constraint error may grow in a step; write one to learn its limit."
            )
        return factor <= 1 + 1e-12

    grid = np.geomspace(1e-3, 1e3, 600)
    first = next((i for i, x in enumerate(grid) if not stable(x)), None)
    if not first:
        return np.inf if first is None else 0.0
    low, high = grid[first - 1], grid[first]
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if stable(middle) else (low, middle)
    return float(low / dt)


def _check_integrator(owner: str, integrator: Integrator) -> None:
    """Checks that an integrator is a value such as `RK4()`.

    Raises:
        TypeError: the argument is a class, or no integrator.
    """
    if isinstance(integrator, type) or not hasattr(integrator, "growth"):
        raise TypeError(
            f"{owner}: integrator must be a value such as RK4(), got"
            f" {checks.shortened(integrator)}."
        )


def stable_rate(integrator: Integrator, dt: Array, least_ratio: float) -> Any:
    """Returns the largest β [1/s] for which each α from least_ratio·β to β is stable.

    The step size h may be traced.
    """
    ratios = np.linspace(least_ratio, 1.0, 5)
    return min(largest_stable_rate(integrator, 1.0, ratio) for ratio in ratios) / dt


def growth(
    integrator: Integrator, alpha: float, beta: float, integral: float, dt: float
) -> float | None:
    """Returns the spectral radius of the map of (φ, φ̇, ∫φ) by one step, for gains α, β and K_i.

    The result is None for an integrator whose `growth` returns None.

    The error obeys φ̈ + 2α φ̇ + β² φ + K_i ∫φ = 0. The integral is constant during a step, and
    advances by h φ after it.
    """
    maps = integrator.error_map(alpha, beta, dt) if integral else None
    if maps is None:
        return integrator.growth(alpha, beta, dt)
    first, second, held = maps
    last = [-integral * x for x in held]
    matrix = np.array([[*first, dt], [*second, 0.0], [*last, 1.0]], float).T
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))


def warn_if_unstable(
    method: Method, dt: Scalar, system: System | None = None, state: State | None = None
) -> None:
    """Warns of feedback gains or springs that are unstable at this step size.

    Args:
        method: method with the integrator and the stabilizer. Traced values are not checked.
        dt: step size h [s].
        system: system on which explicit springs act.
        state: state at the start.
    """
    if not checks.is_concrete((method.stabilizer, method.integrator, dt)):
        return
    try:
        h = float(dt)
    except (TypeError, ValueError, OverflowError):  # the step itself reports a wrong dt
        return
    if message := instability(method, h, system, state):
        warnings.warn(message, stacklevel=3)


def instability(
    method: Method, h: float, system: System | None = None, state: State | None = None
) -> str | None:
    """Returns a description of the first unstable gains or springs; None if all are stable."""
    scene: tuple[Any, Any] = system, state
    with jax.ensure_compile_time_eval():  # concrete gains may be arrays inside an outer trace
        for part in parts(method.stabilizer):
            message = unstable_gains(method.integrator, part, h)
            if isinstance(part, Penalty) and not part.implicit and checks.is_concrete(scene):
                message = message or unstable_spring(method.integrator, part, h, *scene)
            if message:
                return message
    return None


def default_gains(method: Method, dt: Array) -> tuple[Scalar, Scalar]:
    """Returns default gains (α, β) [1/s]: the stabilizer's `fallback`, else the integrator's.

    Args:
        method: method with the integrator and the stabilizer.
        dt: step size h, () [s].
    """
    fallbacks = (getattr(part, "fallback", None) for part in parts(method.stabilizer_for(dt)))
    gains = next((x for x in fallbacks if x is not None), None)
    return method.integrator.default_gains(dt) if gains is None else gains


def parts(stabilizer: Stabilizer) -> list[Stabilizer]:
    """Returns a stabilizer and all stabilizers nested in it that choose b of J a + C λ = b."""
    nested: tuple[Stabilizer, ...] = ()
    if isinstance(stabilizer, Wrapper):
        nested = (stabilizer.inner,)
    elif isinstance(stabilizer, Hybrid):
        nested = stabilizer.small, stabilizer.middle
    return [stabilizer, *(part for inner in nested for part in parts(inner))]


def unstable_gains(integrator: Integrator, stabilizer: Stabilizer, h: float) -> str | None:
    """Returns a description of unstable feedback gains; None if all are stable."""
    is_pid = isinstance(stabilizer, PID)
    # a user's stabilizer may have gains with these names, too
    alpha, beta, integral = (getattr(stabilizer, x, None) for x in ("alpha", "beta", "integral"))
    if is_pid and h:
        default = [float(x) for x in integrator.default_gains(jnp.asarray(h))]
        alpha = default[0] if alpha is None else alpha
        beta = default[1] if beta is None else beta
    if h == 0 or alpha is None or beta is None:
        return None
    for name, a, b, k in _sets(alpha, beta, 0.0 if integral is None else integral):
        factor = growth(integrator, a, b, k, h)
        if factor is None or factor <= 1 + MARGIN:
            continue
        kind, what = "Baumgarte", f"alpha={a:.6g}, beta={b:.6g}"
        if is_pid:
            kind = "PID"
            what = f"proportional={b * b:.6g}, derivative={2 * a:.6g}, integral={k:.6g}"
        text = (
            f"{kind} gains {what}{name} are unstable at dt={h:.6g} with"
            f" {type(integrator).__name__}: errors grow."
        )
        without = integrator.growth(a, b, h)
        if without is None:
            return text
        if without <= 1 + MARGIN:
            return f"{text} They are stable without the integral: lower it below 2·alpha·beta²."
        ratio = a / b if b else 1.0
        limit = largest_stable_rate(integrator, h, ratio)
        ratio_of = f"At this damping ratio ({ratio:.3g}) the largest stable rate"
        return f"{text} {ratio_of} is {limit:.6g} 1/s: take no more, or a smaller dt."
    return None


def unstable_spring(
    integrator: Integrator, penalty: Penalty, h: float, system: System, state: State
) -> str | None:
    """Returns a description of an unstable explicit spring; None if all are stable.

    Each row is tested alone: a spring k and damper d on the effective mass m = 1/A_ii obey φ̈ +
    (d/m) φ̇ + (k/m) φ = 0. Coupled rows can only be less stable.
    """
    here = with_turns(system, state.turns, state.angle_remainder)
    rows = linearize(here, state.q, state.v, state.instant)
    rows = dataclasses.replace(rows, mass=system.mass(state.q))
    soft = penalty.soft(rows.layout)
    if not soft.any():
        return None
    numbers = (effective_inverse_mass(rows), *penalty.constants(rows))
    inverse, k, d = (np.broadcast_to(np.asarray(x), soft.shape) for x in numbers)
    worst = int(np.argmax(np.where(soft, k * inverse + (d * inverse / 2) ** 2, -1.0)))
    m, stiffness, damping = 1 / inverse[worst], k[worst], d[worst]
    factor = integrator.growth(float(damping / m / 2), float(np.sqrt(stiffness / m)), h)
    if factor is None or factor <= 1 + SLOW:
        return None
    name = next(n for n in rows.layout.names if worst in rows.layout.rows(n))
    return (
        f"Penalty: the explicit spring of '{name}', {stiffness:.6g} N/m on {m:.6g} kg, is unstable"
        f" at dt={h:.6g} with {type(integrator).__name__}; semi-implicit Euler without damping is"
        f" stable below 4 m/h² = {4 * m / h**2:.6g}. Take implicit=True, or a smaller step."
    )


def _sets(alpha: Gain, beta: Gain, integral: Gain) -> list[tuple[str, float, float, float]]:
    """Lists all distinct sets of feedback gains.

    Returns:
        For each set a tuple (suffix, α, β, K_i). The suffix names the constraint in messages, as in
        " of 'hinge'". The list is empty if some gains are mappings and others arrays.
    """
    gains = (alpha, beta, integral)
    named = [x for x in gains if isinstance(x, Mapping)]
    if named:
        if any(np.ndim(x) for x in gains if not isinstance(x, Mapping)):
            return []
        values = [x if isinstance(x, Mapping) else dict.fromkeys(named[0], x) for x in gains]
        names = sorted(set.intersection(*map(set, values)))
        return [(f" of '{n}'", *(float(x[n]) for x in values)) for n in names]  # type: ignore[misc]
    arrays = np.broadcast_arrays(*(np.asarray(jax.device_get(x), float) for x in gains))
    table = np.unique(np.stack([x.ravel() for x in arrays], axis=1), axis=0)
    return [("", x, y, z) for x, y, z in table.tolist()]


def frequency_response(
    frequency: Scalar,
    alpha: Scalar,
    beta: Scalar,
    integral: Scalar = 0.0,
    *,
    integrator: Integrator | None = None,
    dt: Scalar | None = None,
) -> Array:
    """Returns the response φ/w of feedback to an acceleration disturbance w (chapter 3.3.3).

    The error obeys φ̈ + 2α φ̇ + β² φ + K_i ∫φ = w. In continuous time φ/w = P/(1 + K_i P/s) with P
    = 1/(s² + 2α s + β²) at s = iω.

    With an integrator at step size h, the disturbance is sampled at the start of each step and
    constant during it: (φ, φ̇)⁺ = E (φ, φ̇) + G w. P is then the first component of (z − E)⁻¹ G at
    z = e^{iωh}, and s is (z − 1)/h, since the integral advances by h φ. This is exact for
    constraints linear in q. The response is periodic in ω and determined by |ω| ≤ π/h.

    The modulus of the result is the amplification, and its angle is the phase. For a `PID`, α =
    K_d/2 and β = √K_p.

    Args:
        frequency: angular frequency ω, an array [rad/s].
        alpha: gain α of the rate [1/s].
        beta: gain β of the error [1/s].
        integral: gain K_i of the integral [1/s³].
        integrator: an integrator with an `error_map`; None for continuous time.
        dt: step size h [s].

    Returns:
        φ/w as complex numbers, in the shape to which the arguments broadcast [s²]. This is the
        steady response, which unstable feedback never reaches; see `largest_stable_rate`.

    Raises:
        TypeError: the integrator is not a value such as `RK4()`.
        ValueError: an argument is not a finite number, the shapes do not broadcast, only one of
            integrator and dt is given, or the integrator satisfies constraints by itself and uses
            no feedback.

    References:
        Åström and Wittenmark, Computer-Controlled Systems (1997), section 3.3.
    """
    owner = "frequency_response"
    numbers = {"frequency": frequency, "alpha": alpha, "beta": beta, "integral": integral}
    for what, x in numbers.items():
        checks.check(owner, what, x)
    checks.check(owner, "dt", dt, above=0, optional=True)
    given = numbers if dt is None else numbers | {"dt": dt}
    checks.components(owner, **{what: (x, ()) for what, x in given.items()})  # shapes broadcast
    if (integrator is None) != (dt is None):
        raise ValueError("frequency_response: integrator and dt go together; give both or neither.")
    ω, α, β, k = (jnp.asarray(x, jnp.result_type(float)) for x in numbers.values())

    def as_complex(x: Array) -> Array:
        return jax.lax.complex(jnp.asarray(x), jnp.zeros_like(x))

    if integrator is None:
        s = jax.lax.complex(jnp.zeros_like(ω), ω)
        plant = 1 / (s * s + as_complex(2 * α) * s + as_complex(β * β))
    else:
        _check_integrator(owner, integrator)
        h = jnp.asarray(dt, ω.dtype)
        maps = integrator.error_map(α, β, h)
        if maps is None:
            raise ValueError(
                f"frequency_response: integrator={type(integrator).__name__} keeps constraints"
                " itself and has no feedback; give SemiImplicitEuler() or a Runge-Kutta method such"
                " as RK4()."
            )
        z = jax.lax.complex(jnp.cos(h * ω), jnp.sin(h * ω))
        # Cramer's rule, where the columns of E are (a, c) and (b, d)
        (a, c), (b, d), (g, f) = (map(as_complex, pair) for pair in maps)
        plant = ((z - d) * g + b * f) / ((z - a) * (z - d) - b * c)
        s = (z - 1) / as_complex(h)
    gain, at_rest = as_complex(k), s == 0
    # at s = 0 an integral suppresses the response completely
    shut = jnp.where(gain == 0, plant, 0)
    return jnp.where(at_rest, shut, s * plant / (jnp.where(at_rest, 1, s) + gain * plant))
