"""Activations of MuJoCo's actuators: filters, integrators and muscles.

An activation a is a state of an actuator, between its control u and its force. In a step of h,

    integrator:   a⁺ = a + h u
    filter:       a⁺ = a + h (u − a)/τ
    filterexact:  a⁺ = a + (1 − exp(−h/τ)) (u − a)
    muscle:       a⁺ = a + h (clip(u, 0, 1) − a)/τ(u, a)

as in MuJoCo. The actuators of the scene get activations in place of controls.
"""

from __future__ import annotations

import warnings

import jax.numpy as jnp
import numpy as np

from jaxcon.core.pytree import pytree, static
from jaxcon.core.summary import listed
from jaxcon.core.typing import Array, DType
from jaxcon.io.compiled import Compiled

DYNAMIC = ("integrator", "filter", "filterexact", "muscle")
"""MuJoCo's types of dynamics that have an activation."""
SHORTEST = 1e-15
"""The shortest time constant [s], MuJoCo's mjMINVAL."""


@pytree
class Activations:
    """The dynamics of the activations of a model, n of nu actuators.

    Attributes:
        times: time constants τ, (n, 3) [s]: of filters, or of muscles to be activated and
            deactivated, followed by the width of the smooth change between them.
        control_range: the range to which each control is clipped, (nu, 2).
        range: the range of each activation, (n, 2).
        kinds: the type of each activation, one of `DYNAMIC`.
        actuators: the index of the actuator of each activation.
        names: MuJoCo's name of each of these actuators.
        early: True for actuators whose force uses the activation at the end of the step.
    """

    times: Array
    control_range: Array
    range: Array
    kinds: tuple[str, ...] = static()
    actuators: tuple[int, ...] = static()
    names: tuple[str, ...] = static()
    early: tuple[bool, ...] = static()

    def advance(self, activation: Array, control: Array, dt: Array) -> tuple[Array, Array]:
        """Returns the activations after a step, (n,), and the inputs of all actuators, (nu,).

        Args:
            activation: the activations before the step, (n,).
            control: MuJoCo's ctrl, (nu,).
            dt: h, () [s].
        """
        if not self.kinds:
            return activation, control
        indices = np.array(self.actuators)
        u = jnp.clip(control, *self.control_range.T)[indices]
        kinds = np.array(self.kinds)
        tau = jnp.maximum(self.times[:, 0], SHORTEST)
        change = {
            "integrator": dt * u,
            "filter": dt * (u - activation) / tau,
            "filterexact": -jnp.expm1(-dt / tau) * (u - activation),
            "muscle": dt * self._muscle(activation, u),
        }
        chosen = [change[kind][i] for i, kind in enumerate(kinds)]
        after = jnp.clip(activation + jnp.stack(chosen), *self.range.T)
        acting = jnp.where(np.array(self.early), after, activation)
        return after, control.at[indices].set(acting)

    def _muscle(self, activation: Array, u: Array) -> Array:
        """Returns the rates of the activations of muscles, (n,)."""
        rising, falling, width = self.times.T
        effort = 0.5 + 1.5 * jnp.clip(activation, 0, 1)
        gap = jnp.clip(u, 0, 1) - activation
        smooth = width >= SHORTEST
        x = jnp.clip(gap / jnp.where(smooth, width, 1) + 0.5, 0, 1)
        share = x**3 * (3 * x * (2 * x - 5) + 10)
        share = jnp.where(smooth, share, (gap > 0).astype(x.dtype))
        slow, fast = falling / effort, rising * effort
        return gap / jnp.maximum(slow + (fast - slow) * share, SHORTEST)


def warn(names: tuple[str, ...]) -> None:
    """Warns that the actuators with these names have activations; gives none without names."""
    if names:
        warnings.warn(
            f"from_mjcf: {listed(names)} {'have' if len(names) > 1 else 'has'} an activation, which"
            " a step does not advance. Call model.activate in each step, and pass jc.step the"
            " control that it returns; see MujocoModel.activate.",
            stacklevel=3,
        )


def activations(compiled: Compiled, dtype: DType) -> Activations:
    """Returns the dynamics of the activations of a model."""
    m = compiled.model
    kinds = [compiled.choice("mjtDyn", kind) for kind in m.actuator_dyntype]
    found = [i for i, kind in enumerate(kinds) if kind != "none"]
    limitless = np.array([-np.inf, np.inf])
    clamps = not compiled.disabled("clampctrl")
    ranges = [
        m.actuator_ctrlrange[i] if clamps and m.actuator_ctrllimited[i] else limitless
        for i in range(len(kinds))
    ]
    within = [m.actuator_actrange[i] if m.actuator_actlimited[i] else limitless for i in found]
    return Activations(
        jnp.asarray(m.actuator_dynprm[found, :3], dtype),
        jnp.asarray(np.reshape(ranges, (-1, 2)), dtype),
        jnp.asarray(np.reshape(within, (-1, 2)), dtype),
        tuple(kinds[i] for i in found),
        tuple(found),
        tuple(compiled.name("actuator", i) for i in found),
        tuple(bool(m.actuator_actearly[i]) for i in found),
    )
