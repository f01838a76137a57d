"""Rows of any constraint function by automatic differentiation, exact to second order.

Along a motion q̇ = N(q) v,

    φ̇(q, v, t) = ∂φ/∂q N(q) v + ∂φ/∂t,    J = ∂φ̇/∂v,    γ = d/dt φ̇ at constant v,

where d/dt follows the motion as a whole (q̇ = N v, ṫ = 1): the mixed terms 2 (∂J/∂t) v that a
formula by parts would drop are all there. A velocity-level ψ(q, v, t) takes the place of φ̇.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.typing import Array, PyTree

Kinematics = Callable[[PyTree, PyTree], PyTree]


def holonomic_rate(residual: Callable[[Any, Any], Array], kinematics: Kinematics) -> Any:
    """φ̇(q, v, t) of a residual φ(q, t)."""

    def rate(q: PyTree, v: PyTree, t: Any) -> Array:
        return jax.jvp(residual, (q, t), (kinematics(q, v), jnp.ones_like(t)))[1]

    return rate


def rows(
    rate: Callable[[Any, Any, Any], Array], kinematics: Kinematics, q: PyTree, v: PyTree, t: Any
) -> tuple[Array, PyTree, Array]:
    """φ̇ (m,), J = ∂φ̇/∂v as a pytree like v with (m, …) leaves, and γ (m,)."""
    along = (kinematics(q, v), jnp.ones_like(t))
    value, bias = jax.jvp(lambda q, t: rate(q, v, t), (q, t), along)
    return value, jax.jacfwd(rate, argnums=1)(q, v, t), bias
