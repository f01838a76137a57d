"""The linearized bicycle model, obtained by differentiating the nonlinear model."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import Polynomial

import jaxcon as jc
from jaxcon.constraints.rows import linearize
from jaxcon.scenes import BICYCLE, bicycle
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error, relative

IDEAL = jc.Method(stabilizer=jc.stabilizers.Unstabilized(), solver=jc.solvers.Dense())


def rates(system: BodySystem, q: jax.Array, v: jax.Array) -> jax.Array:
    """Returns lean rate, steer rate and spin of the rear wheel, (3,) [rad/s], at velocities v.

    All three are linear in v with constant coefficients. The lean rate is the angular velocity of
    the frame about its own x axis. This neglects the pitch, which is of second order. The steer
    rate is the difference between the angular velocities of fork and frame along the steering axis,
    which has equal components in both body frames.
    """
    frame, fork, wheel = (
        system.motion(name, q, v).angular_velocity for name in ("frame", "fork", "rear_wheel")
    )
    tilt = BICYCLE["tilt"]
    axis = jnp.array([np.sin(tilt), 0.0, np.cos(tilt)], q.dtype)
    return jnp.stack([frame[0], axis @ (fork - frame), wheel[1]])


def velocities(system: BodySystem, q: jax.Array, u: jax.Array) -> jax.Array:
    """Returns the velocities v that satisfy the constraints and have the given rates.

    Solves J v = 0 and S v = u. J is the constraint Jacobian, S the matrix of `rates`, and u holds
    lean rate, steer rate and wheel spin.
    """
    zero = jnp.zeros(system.n_v, q.dtype)
    jacobian = linearize(system, q, zero, jnp.zeros((), q.dtype)).jacobian.dense()
    select = jax.jacfwd(lambda v: rates(system, q, v))(zero)
    right = jnp.concatenate([jnp.zeros(len(jacobian), q.dtype), u])
    return jnp.linalg.solve(jnp.vstack([jacobian, select]), right)


def tangents(system: BodySystem, state: jc.State) -> np.ndarray:
    """Returns displacements for a unit lean and a unit steer, as columns, (n_v, 2).

    They satisfy the linearized holonomic constraints. This leaves position, heading and wheel
    angles of the bicycle free, so the displacements of least norm are returned.
    """
    rows = linearize(system, state.q, state.v, state.instant)
    held = np.asarray(rows.jacobian.dense())[rows.layout.holonomic]
    select = np.asarray(jax.jacfwd(lambda v: rates(system, state.q, v))(state.v))[:2]
    right = np.vstack([np.zeros((len(held), 2)), np.eye(2)])
    return np.linalg.lstsq(np.vstack([held, select]), right, rcond=None)[0]


@jax.jit
def linearized(
    system: BodySystem, state: jc.State, along: jax.Array, speed: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Linearizes the nonlinear bicycle about upright motion at constant speed.

    For y = (lean, steer) and its rate ẏ, the bicycle is placed at q(y). Its velocities satisfy the
    constraints and have the given forward speed. The accelerations ÿ(y, ẏ) of lean and steer are
    then differentiated at y = ẏ = 0.

    Args:
        system: the bicycle.
        state: its upright state.
        along: displacements for a unit lean and a unit steer, from `tangents`, (n_v, 2).
        speed: the forward speed, () [m/s].

    Returns:
        The mass matrix M, ∂ÿ/∂y and ∂ÿ/∂ẏ, (2, 2) each. M is Bᵀ M_v B, with the mass matrix M_v of
        the bodies. The columns of B are the velocities for unit rates of lean and steer.
    """

    def accelerations(y: jax.Array, ẏ: jax.Array) -> jax.Array:
        q = system.retract(state.q, along @ y)
        spin = -speed / BICYCLE["rear_wheel"]["radius"]
        moved = dataclasses.replace(state, q=q, v=velocities(system, q, jnp.append(ẏ, spin)))
        a = jc.forward_dynamics(system, moved, None, IDEAL, 1e-3).acceleration
        return rates(system, q, a)[:2]

    zero = jnp.zeros(2)
    basis = jax.vmap(lambda u: velocities(system, state.q, u))(jnp.eye(3)[:2])
    mass = basis @ jax.vmap(system.mass(state.q).apply)(basis).T
    return mass, *jax.jacfwd(accelerations, (0, 1))(zero, zero)


def bicycle_linear() -> list[Check]:
    """Checks M q̈ + v C₁ q̇ + (g K₀ + v² K₂) q = 0 for q = (lean, steer) of a bicycle.

    Here v is the forward speed and g the gravitational acceleration. M, C₁, K₀ and K₂ are the
    matrices of mass, damping and stiffness.

    References:
        Meijaard, Papadopoulos, Ruina, Schwab, Linearized dynamics equations for the balance and
        steer of a bicycle, Proc. R. Soc. A 463 (2007), equation 5.4.
    """
    case, data = "bicycle_linear", references.load("bicycle_linear")
    g = data["parameters"]["g"]
    system, state = bicycle(gravity=g)
    along = jnp.asarray(tangents(system, state))
    speeds = [row["v"] for row in data["eigenvalues"]]
    results = [linearized(system, state, along, jnp.asarray(float(v))) for v in speeds]
    mass = np.asarray(results[0][0])
    stiffness, damping = ([-mass @ np.asarray(f[i]) for f in results] for i in (1, 2))
    weight = stiffness[0] / g
    matrices = {"M": mass, "C1": damping[1], "K0": weight, "K2": stiffness[1] - stiffness[0]}
    checks = [
        Check(
            case,
            f"{name}, relative to its largest entry",
            error(matrix, data[name]) / float(np.max(np.abs(data[name]))),
            1e-8,
        )
        for name, matrix in matrices.items()
    ]
    worst = 0.0
    for (_, by_place, by_rate), row in zip(results, data["eigenvalues"], strict=True):
        matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [by_place, by_rate]])
        eigenvalues = np.sort_complex(np.linalg.eigvals(matrix))
        expected = np.sort_complex(np.array(row["eig"]) @ [1, 1j])
        worst = max(worst, float(np.max(np.abs(eigenvalues - expected) / np.abs(expected))))
    checks.append(Check(case, "eigenvalues from 0 to 10 m/s, relative", worst, 1e-8))
    speeds = stability_speeds(matrices, g)
    expected = [data["weave_speed"], data["capsize_speed"]]
    return [
        *checks,
        Check(case, "weave and capsize speed, relative", relative(speeds, expected), 1e-8),
    ]


def stability_speeds(p: dict[str, np.ndarray], g: float) -> list[float]:
    """Returns the weave and capsize speeds [m/s].

    Between these forward speeds v, all eigenvalues have negative real parts. The characteristic
    polynomial a₄ s⁴ + a₃ s³ + a₂ s² + a₁ s + a₀ has coefficients that are polynomials in v. Weave
    starts where b a₁ = a₀ a₃² with b = a₂ a₃ − a₄ a₁ (Hurwitz). Capsize starts where a₀ = 0.
    """
    v = Polynomial([0, 1])

    def entry(i: int, j: int) -> list[Polynomial]:
        """Returns the coefficients of s⁰, s¹, s² in an entry of M s² + v C₁ s + g K₀ + v² K₂."""
        constant = Polynomial([p["M"][i, j]])
        return [g * p["K0"][i, j] + v**2 * p["K2"][i, j], v * p["C1"][i, j], constant]

    def product(x: list[Polynomial], y: list[Polynomial]) -> list[Polynomial]:
        """Returns the coefficients of the product of two quadratic polynomials in s."""
        terms = ([x[k] * y[n - k] for k in range(3) if 0 <= n - k < 3] for n in range(5))
        return [sum(products, Polynomial([0])) for products in terms]

    diagonal, across = product(entry(0, 0), entry(1, 1)), product(entry(0, 1), entry(1, 0))
    a0, a1, a2, a3, a4 = (x - y for x, y in zip(diagonal, across, strict=True))
    weave = (a2 * a3 - a4 * a1) * a1 - a0 * a3**2
    capsize = max(_positive_roots(a0))
    candidates = _positive_roots(weave)
    return [max(candidates[candidates < capsize]), capsize]


def _positive_roots(polynomial: Polynomial) -> np.ndarray:
    """Returns the positive real roots of a polynomial."""
    # a leading coefficient of rounding size would add a spurious large root
    roots = polynomial.trim(1e-12 * np.max(np.abs(polynomial.coef))).roots()
    return roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-6)].real
