"""How much of a disturbance a stabilised constraint lets through, by frequency (chapter 3.3.3)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.typing import Array


def frequency_response(
    frequency: Any,
    alpha: Any,
    beta: Any,
    integral: Any = 0.0,
    *,
    integrator: Any = None,
    dt: Any = None,
) -> Array:
    """φ(iω) under an acceleration disturbance w: φ̈ + 2α φ̇ + β² φ + K_i ∫φ = w.

    In continuous time φ/w = P/(1 + K_i P/s) with P = 1/(s² + 2α s + β²) at s = iω. With an
    integrator at step h the disturbance is sampled at the start of each step and held over it;
    (φ, φ̇)⁺ = E (φ, φ̇) + G w, so that P is the first component of (z − E)⁻¹ G at z = e^{iωh}, and
    s is (z − 1)/h, since the integral advances by h φ. It is exact for constraints linear in q, and
    repeats beyond ω = π/h. Its modulus is the amplification and its angle the phase. α = K_d/2 and
    β = √K_p are those of a `PID`.

    Args:
        frequency: ω, an array [rad/s].
        alpha: α [1/s].
        beta: β [1/s].
        integral: K_i [1/s³].
        integrator: with `error_map`; continuous time unless given.
        dt: h [s].

    Returns:
        φ/w as complex numbers, in the shape to which the arguments broadcast [s²]; the steady
        response, which is never reached where the feedback is unstable; `largest_stable_rate` says
        up to where it is not.

    Raises:
        ValueError: an argument is no finite number, one of integrator and step is given without
            the other, or the integrator keeps constraints by itself and has no feedback.

    References:
        Åström and Wittenmark, Computer-Controlled Systems (1997), section 3.3.
    """
    owner = "frequency_response"
    numbers = {"frequency": frequency, "alpha": alpha, "beta": beta, "integral": integral}
    for what, x in numbers.items():
        checks.check(owner, what, x)
    checks.check(owner, "dt", dt, above=0, optional=True)
    if (integrator is None) != (dt is None):
        raise ValueError("frequency_response: integrator and dt go together; give both or neither.")
    if integrator is not None and not hasattr(integrator, "error_map"):
        raise ValueError(
            f"frequency_response: integrator={type(integrator).__name__} keeps constraints itself"
            " and has no feedback; give SemiImplicitEuler() or a Runge-Kutta method such as RK4()."
        )
    ω, α, β, k = (jnp.asarray(x, jnp.result_type(float)) for x in numbers.values())
    if integrator is None:
        s = jax.lax.complex(jnp.zeros_like(ω), ω)
        plant = 1 / (s * s + _complex(2 * α) * s + _complex(β * β))
    else:
        h = jnp.asarray(dt, ω.dtype)
        z = jax.lax.complex(jnp.cos(h * ω), jnp.sin(h * ω))
        plant = _discrete(z, *integrator.error_map(α, β, h))
        s = (z - 1) / _complex(h)
    gain = _complex(k)
    at_rest = s == 0  # where an integral, if there is one, lets nothing through
    shut = jnp.where(gain == 0, plant, 0)
    return jnp.where(at_rest, shut, s * plant / (jnp.where(at_rest, 1, s) + gain * plant))


def _discrete(z: Array, first: Any, second: Any, held: Any) -> Array:
    """The first component of (z − E)⁻¹ G, by Cramer's rule, E by its columns."""
    (a, c), (b, d), (g, f) = (tuple(map(_complex, pair)) for pair in (first, second, held))
    return ((z - d) * g + b * f) / ((z - a) * (z - d) - b * c)


def _complex(x: Any) -> Array:
    x = jnp.asarray(x)
    return jax.lax.complex(x, jnp.zeros_like(x))
