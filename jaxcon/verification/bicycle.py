"""The linearized bicycle, by derivatives of the nonlinear one."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.constraints.rows import linearize
from jaxcon.scenes import BICYCLE, bicycle
from jaxcon.verification import references
from jaxcon.verification.case import Check, error, relative

IDEAL = jc.Method(stabilizer=jc.Unstabilized(), solver=jc.Dense())


def rates(system: Any, q: jax.Array, v: jax.Array) -> jax.Array:
    """(lean rate, steer rate, spin of the rear wheel): linear in v, its coefficients constant.

    The lean rate is that of the frame about its own x axis: the pitch that it leaves out is of
    second order. The steering axis has the same components in frame and fork.
    """
    frame, fork, wheel = (
        system.motion(name, q, v).angular_velocity for name in ("frame", "fork", "rear_wheel")
    )
    tilt = BICYCLE["tilt"]
    axis = jnp.array([np.sin(tilt), 0.0, np.cos(tilt)], q.dtype)
    return jnp.stack([frame[0], axis @ (fork - frame), wheel[1]])


def velocities(system: Any, q: jax.Array, u: jax.Array) -> jax.Array:
    """The v that the rows allow and whose rates are u: J v = 0, S v = u."""
    none = jnp.zeros(system.n_v, q.dtype)
    jacobian = linearize(system, q, none, jnp.zeros((), q.dtype)).jacobian.dense()
    select = jax.jacfwd(lambda v: rates(system, q, v))(none)
    right = jnp.concatenate([jnp.zeros(len(jacobian), q.dtype), u])
    return jnp.linalg.solve(jnp.vstack([jacobian, select]), right)


def tangents(system: Any, state: jc.State) -> np.ndarray:
    """Displacements (n_v, 2) by a unit of lean and of steer that keep the joints and the contacts.

    Where the bicycle stands, how it heads and how its wheels are turned does not matter.
    """
    rows = linearize(system, state.q, state.v, state.instant)
    held = np.asarray(rows.jacobian.dense())[rows.layout.holonomic]
    select = np.asarray(jax.jacfwd(lambda v: rates(system, state.q, v))(state.v))[:2]
    right = np.vstack([np.zeros((len(held), 2)), np.eye(2)])
    return np.linalg.lstsq(np.vstack([held, select]), right, rcond=None)[0]


@jax.jit
def linearized(system: Any, state: jc.State, along: jax.Array, speed: jax.Array) -> Any:
    """M, and the derivatives of (lean, steer)¨ by lean and steer and by their rates, at a speed.

    M = BᵀM B, B the velocities of unit rates of lean and steer. The nonlinear bicycle is put at
    q(y), y lean and steer, with the velocities that its rows allow there, and its accelerations are
    differentiated.
    """

    def accelerations(y: jax.Array, ẏ: jax.Array) -> jax.Array:
        q = system.retract(state.q, along @ y)
        spin = -speed / BICYCLE["rear_wheel"]["radius"]
        moved = dataclasses.replace(state, q=q, v=velocities(system, q, jnp.append(ẏ, spin)))
        a = jc.forward_dynamics(system, moved, None, IDEAL, 1e-3).acceleration
        return rates(system, q, a)[:2]

    none = jnp.zeros(2)
    basis = jax.vmap(lambda u: velocities(system, state.q, u))(jnp.eye(3)[:2])
    mass = basis @ jax.vmap(system.mass(state.q).apply)(basis).T
    return mass, *jax.jacfwd(accelerations, (0, 1))(none, none)


def bicycle_linear() -> list[Check]:
    """M q¨ + v C₁ q̇ + (g K₀ + v² K₂) q = 0 for the lean and steer q of a bicycle.

    References:
        Meijaard, Papadopoulos, Ruina, Schwab, Linearized dynamics equations for the balance and
        steer of a bicycle, Proc. R. Soc. A 463 (2007), equation 5.4.
    """
    case, data = "bicycle_linear", references.load("bicycle_linear")
    g = data["parameters"]["g"]
    system, state = bicycle(gravity=g)
    along = jnp.asarray(tangents(system, state))
    speeds = [row["v"] for row in data["eigenvalues"]]
    found = [linearized(system, state, along, jnp.asarray(float(v))) for v in speeds]
    mass = np.asarray(found[0][0])
    stiffness, damping = ([-mass @ np.asarray(f[i]) for f in found] for i in (1, 2))
    weight = stiffness[0] / g
    matrices = {"M": mass, "C1": damping[1], "K0": weight, "K2": stiffness[1] - stiffness[0]}
    checks = [
        Check(case, f"{name}, relative to its largest entry", _scaled(got, data[name]), 1e-8)
        for name, got in matrices.items()
    ]
    worst = 0.0
    for (_, by_place, by_rate), row in zip(found, data["eigenvalues"], strict=True):
        matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [by_place, by_rate]])
        got = np.sort_complex(np.linalg.eigvals(matrix))
        expected = np.sort_complex(np.array(row["eig"]) @ [1, 1j])
        worst = max(worst, float(np.max(np.abs(got - expected) / np.abs(expected))))
    checks.append(Check(case, "eigenvalues from 0 to 10 m/s, relative", worst, 1e-8))
    got = stability_speeds(matrices, g)
    expected = [data["weave_speed"], data["capsize_speed"]]
    return [
        *checks,
        Check(case, "weave and capsize speed, relative", relative(got, expected), 1e-8),
    ]


def _scaled(got: np.ndarray, expected: Any) -> float:
    return error(got, expected) / float(np.max(np.abs(expected)))


def stability_speeds(p: dict[str, np.ndarray], g: float) -> list[float]:
    """Between which speeds all eigenvalues have negative real parts [m/s].

    The characteristic polynomial a₄ s⁴ + a₃ s³ + a₂ s² + a₁ s + a₀ has coefficients that are
    polynomials of v. Weave: b a₁ = a₀ a₃² with b = a₂ a₃ − a₄ a₁ (Hurwitz); capsize: a₀ = 0.
    """
    v = np.polynomial.Polynomial([0, 1])

    def entry(i: int, j: int) -> list[Any]:
        """M s² + v C₁ s + g K₀ + v² K₂, by powers of s."""
        return [g * p["K0"][i, j] + v**2 * p["K2"][i, j], v * p["C1"][i, j], p["M"][i, j]]

    def product(x: list[Any], y: list[Any]) -> list[Any]:
        return [sum(x[k] * y[n - k] for k in range(3) if 0 <= n - k < 3) for n in range(5)]

    diagonal, across = product(entry(0, 0), entry(1, 1)), product(entry(0, 1), entry(1, 0))
    a0, a1, a2, a3, a4 = (x - y for x, y in zip(diagonal, across, strict=True))
    weave = (a2 * a3 - a4 * a1) * a1 - a0 * a3**2
    return [max(_real(weave)[_real(weave) < max(_real(a0))]), max(_real(a0))]


def _real(polynomial: Any) -> np.ndarray:
    """The positive real roots; a highest coefficient that is rounding would make one far away."""
    roots = polynomial.trim(1e-12 * np.max(np.abs(polynomial.coef))).roots()
    return roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-6)].real
