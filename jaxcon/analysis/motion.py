"""How far a scene turns or swings in a step, from its structure and one state. Host code."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import linearize
from jaxcon.core import host
from jaxcon.core.typing import Array, PyTree
from jaxcon.dynamics.rank import UnitRows, linearized
from jaxcon.model.state import State
from jaxcon.simulation.stability import largest_stable_rate

if TYPE_CHECKING:
    from jaxcon.analysis.known import Known

MOST_VELOCITIES = 150
"""The largest n_v for which natural frequencies are computed; they cost O(n_v³)."""
LEAST = 1e-12
"""A length in the metric of M below which a direction is none."""


class Rate(NamedTuple):
    """An angular speed.

    Attributes:
        value: [rad/s].
        name: of the body or coordinate that has it.
    """

    value: float
    name: str


@dataclasses.dataclass(frozen=True)
class StepAngle:
    """Angles of the fastest motions in one step.

    Attributes:
        turning: with the velocities of the state.
        swinging: with the velocities that gravity and springs can give from rest: the largest of
            natural frequencies at this position, of √|α| of the bodies' angular accelerations, and
            of √(κ |a|) along the curved way that constraints leave.
        dt: h [s].
        limit: h ω below which an undamped oscillation is stable with the integrator; 2 for
            semi-implicit Euler, 0 where no step is, infinite where every step is; natural
            frequencies are then left out of `swinging`.
    """

    turning: Rate
    swinging: Rate
    dt: float
    limit: float

    @property
    def turn(self) -> float:
        """h |ω| of the fastest body at the velocities of the state [rad]."""
        return self.dt * self.turning.value

    @property
    def swing(self) -> float:
        """h ω of gravity and springs [rad]."""
        return self.dt * self.swinging.value

    def __str__(self) -> str:
        parts = [f"h|ω| = {self.turn:.2g} rad by the velocities of the state"]
        parts[0] += f" ({self.turning.name})" if self.turning.value else ""
        if self.swinging.value:
            parts.append(
                f"h ω = {self.swing:.2g} by gravity and springs ({self.swinging.name})"
                + (f", stable below {self.limit:.3g}" if 0 < self.limit < np.inf else "")
            )
        return f"fastest motion in a step: {'; '.join(parts)}"


def step_angle(known: Known) -> StepAngle | None:
    """The angles of the fastest motions in a step; None where no step is known."""
    if known.dt is None:
        return None
    system, state, dtype = known.system, known.state, known.state.q.dtype
    v = np.asarray(state.v, np.float64)
    force = np.asarray(host.evaluate(_force, system, state, known.control), np.float64)
    held, factor = _with_rotors(known)
    # in the metric of M, forces from rest are split into those along the motion and reactions
    pull = np.linalg.solve(factor, force)
    inverse = np.linalg.pinv(held.values, rcond=held.tolerance) if len(held.values) else None
    reaction = np.zeros(0) if inverse is None else -(pull @ inverse)
    along = pull if inverse is None else pull + held.values.T @ reaction
    a = np.linalg.solve(factor.T, along)
    at_rest = dataclasses.replace(state, v=np.zeros(len(v), dtype))
    driven = np.asarray(linearized(system, at_rest)[0].bias, np.float64)
    bends = np.asarray(known.rows.bias, np.float64) - driven
    turning = max(_spin(system, v), _curved(known, (held, factor), bends, v, inverse), key=_value)
    falling = _spin(system, a)
    swinging = [Rate(float(np.sqrt(falling.value)), falling.name)]
    at_a = dataclasses.replace(state, v=np.asarray(a, dtype))
    bends = np.asarray(linearized(system, at_a)[0].bias, np.float64) - driven
    swinging.append(_root(_curved(known, (held, factor), bends, a, inverse)))
    limit = largest_stable_rate(known.method.integrator, 1.0, 0.0)
    # what is stable at every step damps stiff springs and light masses, and is taken for that
    if len(v) <= MOST_VELOCITIES and np.isfinite(limit):
        λ = np.zeros(known.rows.layout.size)
        λ[held.numbers] = reaction / held.length
        swinging.append(_natural(known, held, factor, λ))
    return StepAngle(turning, max(swinging, key=_value), known.dt, limit)


def _with_rotors(known: Known) -> tuple[UnitRows, np.ndarray]:
    """The rows at unit length and L of M = L Lᵀ, with the inertia of rotors in M."""
    mass, layout = np.asarray(known.mass, np.float64), known.rows.layout
    if not layout.inertial:
        return known.unit, np.linalg.cholesky(mass)
    rotors = np.concatenate([layout.rows(name) for name in layout.inertial])
    j = np.asarray(known.jacobian, np.float64)[rotors]
    inertia = 1 / np.asarray(known.rows.compliance, np.float64)[rotors]
    mass = mass + j.T @ (inertia[:, None] * j)
    return UnitRows(layout, known.jacobian, mass), np.linalg.cholesky(mass)


def _value(rate: Rate) -> float:
    return rate.value


def _root(rate: Rate) -> Rate:
    """The rate that a curvature κ and an acceleration a give, √(κ |a|)."""
    return Rate(float(np.sqrt(rate.value)), rate.name)


def _spin(system: Any, v: np.ndarray) -> Rate:
    """The fastest angular part of an array (n_v,) among bodies; 0 without any."""
    layout = getattr(system, "layout", None)
    if layout is None:
        return Rate(0.0, "")
    rates = [
        Rate(float(np.linalg.norm(v[layout.v(name)[layout.dim :]])), name) for name in layout.bodies
    ]
    return max(rates, key=_value, default=Rate(0.0, ""))


def _curved(
    known: Known,
    metric: tuple[UnitRows, np.ndarray],
    bends: np.ndarray,
    v: np.ndarray,
    inverse: np.ndarray | None,
) -> Rate:
    """|Jᵀλ(γ)| / |v| in the metric of M: how fast constraints turn the direction of v.

    Args:
        known: the scene.
        metric: the rows at unit length, and L of M = L Lᵀ.
        bends: γ(v) − γ(0), (n_c,): without a drive's own acceleration, which turns nothing.
        v: velocities, (n_v,).
        inverse: the pseudoinverse of the rows; None without any.
    """
    if inverse is None:
        return Rate(0.0, "")
    held, factor = metric
    bend = inverse @ -(bends[held.numbers] / held.length)
    speed = float(np.linalg.norm(factor.T @ v))
    if speed < LEAST:
        return Rate(0.0, "")
    return Rate(float(np.linalg.norm(bend)) / speed, _owner(known.system, bend))


def _natural(known: Known, held: UnitRows, factor: np.ndarray, λ: np.ndarray) -> Rate:
    """√|κ| of the largest eigenvalue of the stiffness that the constraints leave free.

    K = −∂(f + Jᵀλ)/∂q at the reactions λ of the scene at rest, projected onto the null space of J.
    """
    _, singular, vt = held.svd if len(held.values) else (0, (), np.eye(len(factor)))
    rank = int(np.sum(np.asarray(singular) > held.tolerance))
    free = vt[rank:]
    if not len(free):
        return Rate(0.0, "")
    dtype = known.state.q.dtype
    moves = np.linalg.solve(factor.T, free.T).T  # of unit length in the metric of M
    change = host.evaluate(
        _stiffness, known.system, known.state, known.control, λ.astype(dtype), moves.astype(dtype)
    )
    k = -np.asarray(change, np.float64) @ moves.T
    if not np.all(np.isfinite(k)):
        return Rate(0.0, "")
    values, vectors = np.linalg.eigh((k + k.T) / 2)
    worst = int(np.argmax(np.abs(values)))
    shape = vectors[:, worst] @ free
    return Rate(float(np.sqrt(np.abs(values[worst]))), _owner(known.system, shape))


def _owner(system: Any, x: np.ndarray) -> str:
    """The body, or coordinate, with the largest share of an array (n_v,)."""
    layout = getattr(system, "layout", None)
    if layout is None:
        return f"coordinate {int(np.argmax(np.abs(x)))}"
    return max(layout.bodies, key=lambda name: float(np.linalg.norm(x[layout.v(name)])))


@jax.jit  # so that a scene is traced once, however many of its states are looked at
def _force(system: Any, state: State, control: PyTree) -> Array:
    """f of the scene at rest, (n_v,)."""
    return system.force(state.q, jnp.zeros_like(state.v), state.instant, control)


@jax.jit
def _stiffness(system: Any, state: State, control: PyTree, λ: Array, moves: Array) -> Array:
    """The change of f + Jᵀλ along displacements (n, n_v), with λ held, (n, n_v)."""
    rest = jnp.zeros_like(state.v)

    def pull(step: Array) -> Array:
        q = system.retract(state.q, step)
        force = system.force(q, rest, state.instant, control)
        if not λ.size:
            return force
        rows = linearize(system, q, rest, state.instant)
        return force + λ @ rows.jacobian.dense()

    def along(move: Array) -> Array:
        return jax.jvp(pull, (rest,), (move,))[1]

    return jax.vmap(along)(moves)
