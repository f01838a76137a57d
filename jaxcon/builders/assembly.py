"""Assembly: finds the nearest configuration that satisfies every constraint."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.builders import nearest
from jaxcon.constraints.custom import Custom, check_function
from jaxcon.constraints.rows import Violation, linearize
from jaxcon.core import checks, numerics
from jaxcon.core.pytree import pytree, unshared
from jaxcon.core.status import SimulationError, Status
from jaxcon.core.typing import Array, Scalar
from jaxcon.system.state import State, with_turns

if TYPE_CHECKING:
    from jaxcon.core.doubled import Doubled
    from jaxcon.protocols import System

SHARE = 1e-3
"""The smallest violation that `Assembly.unmet` reports, as a share of the largest violation."""


@pytree
class Assembly:
    """The result of `assemble`; `print` it, and get the state by `check()`.

    Attributes:
        state: the nearest state. If a constraint could not be met, its status is NOT_CONVERGED, a
            failure: steps from this state leave it unchanged.
        violation: the remaining φ and φ̇ by constraint.
        distance: (dᵀ M d)^½ of the displacement d from the given configuration, ().
        tolerance: the largest |φ| and |φ̇| allowed, (2,).
        stuck: a mask of the rows that no free coordinate changes, (n_c,).
    """

    state: State
    violation: Violation
    distance: Array
    tolerance: Array
    stuck: Array

    @property
    def q(self) -> Array:
        """The assembled positions, (n_q,)."""
        return self.state.q

    @property
    def v(self) -> Array:
        """The assembled velocities, (n_v,)."""
        return self.state.v

    @property
    def status(self) -> Array:
        """The `Status` code of the assembled state, ()."""
        return self.state.status

    @property
    def converged(self) -> Array:
        """True if every constraint is met, ()."""
        return self.status == Status.OK

    @property
    def unmet(self) -> dict[str, tuple[float, float]]:
        """The violations (‖φ‖, ‖φ̇‖) by name, of the constraints that could not be met.

        For one world, outside jit.
        """
        allowed = np.asarray(self.tolerance)
        position, velocity = np.abs(self.violation.position), np.abs(self.violation.velocity)
        # a violation far below the largest one comes from rounding, or is a consequence of it
        bounds = [
            max(a, SHARE * np.max(x, initial=0))
            for a, x in zip(allowed, (position, velocity), strict=True)
        ]
        off = ~((position <= bounds[0]) & (velocity <= bounds[1]))
        layout = self.violation.layout
        return {
            name: (float(self.violation[name]), float(self.violation.rate(name)))
            for name in layout.names
            if np.any(off[layout.rows(name)])
        }

    def check(self) -> State:
        """Returns the state if every constraint is met. For use outside jit.

        Raises:
            SimulationError: a constraint could not be met; the message names each and its
                violation.
        """
        failed = np.argwhere(np.atleast_1d(self.status) != Status.OK)
        if failed.size:
            world = tuple(map(int, failed[0]))[: self.status.ndim]
            where = f"world {world}: " if world else ""
            raise SimulationError(f"assemble: {where}{jax.tree.map(lambda x: x[world], self)}")
        return self.state

    def __str__(self) -> str:
        if self.status.ndim:
            met = int(np.sum(np.asarray(self.converged)))
            return f"{met} of {self.status.size} worlds assembled"
        moved = f"moved by {float(self.distance):.3g} kg^½ m"
        if self.converged:
            worst, rate = float(self.violation.worst), float(self.violation.worst_rate)
            return f"assembled: {moved}, violation {worst:.1e}, rate {rate:.1e}"
        layout, stuck = self.violation.layout, np.asarray(self.stuck)
        lines = ["not assembled; at the nearest approach these constraints are left open:"]
        for name, (value, rate) in self.unmet.items():
            line = f"  '{name}': |φ| = {value:.3g}, |φ̇| = {rate:.3g}"
            if np.any(stuck[layout.rows(name)]):
                line += "; nothing free can change it: its bodies are held"
            lines.append(line)
        return "\n".join(
            [
                *lines,
                "likely (a) lengths with which a loop cannot close, (b) too much is held, (c) two"
                " constraints contradict each other, (d) a start too far away",
            ]
        )


def assemble(
    system: System,
    q: State | Array | np.ndarray | Sequence[float],
    v: Array | np.ndarray | Sequence[float] | None = None,
    *,
    hold: str | Sequence[Any] | np.ndarray | Array = (),
    time: Scalar | None = None,
    tolerance: Scalar | None = None,
) -> Assembly:
    """Finds the nearest configuration and velocity that satisfy every constraint.

    The positions q = q₀ ⊕ d minimize ½ dᵀ M d subject to the position constraints φ(q, t) = 0. The
    sum ⊕ turns bodies by the exponential map. The velocities v minimize ½ (v − v₀)ᵀ M (v − v₀)
    subject to J v + ∂φ/∂t = 0 and the velocity constraints ψ = 0. Held bodies keep their q and v.
    The search is local: it closes a loop in the way nearest to the start.

    The function is pure: jit and vmap it. The derivative with respect to q₀, v₀, t and every number
    of the system is that of the solution, not of the iterations. So
    `assemble(system.with_params(…), state)` closes a mechanism of other lengths differentiably. If
    a constraint could not be met, there is no derivative. Matrices are dense, for mechanisms of up
    to some hundreds of velocities.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        q: rough positions, (n_q,); or a `State`, whose velocity, time and memory are kept.
        v: rough velocities, (n_v,); the state's velocities, or zero, unless given.
        hold: the bodies or velocities that do not move: names of bodies, indices in v
            (`system.layout.v(name)`), or a mask (n_v,).
        time: t, () [s]; the state's time, or 0, unless given.
        tolerance: the largest |φ| and |φ̇| that count as zero; (1 + max |q|) ε^⅔ and
            (1 + max |v|) ε^⅔ unless given, with ε the spacing of floating-point numbers.

    Returns:
        The `Assembly`. `assemble(…).check()` returns the state, or raises if it did not converge.

    Raises:
        ValueError: wrong shapes, mixed dtypes, or an unknown name or index in `hold`.
    """
    start = _start(system, q, v, time)
    held = _held(system, hold, start.v.shape[0])
    if tolerance is not None:
        tolerance = checks.real("assemble", "tolerance", tolerance, start.q.dtype, above=0)
    return _assemble(system, start, tolerance, held=held)


@partial(jax.jit, static_argnames="held")
def _assemble(
    system: System, start: State, tolerance: Array | None, *, held: tuple[int, ...]
) -> Assembly:
    """Computes the result of `assemble`, for arguments that are already checked.

    Args:
        system: the system.
        start: the state from which the search starts.
        tolerance: the largest |φ| and |φ̇| that count as zero, (); None for the default.
        held: the indices in v of velocities that do not move.
    """
    free = np.setdiff1d(np.arange(start.v.shape[0]), held)
    allowed = jnp.stack(
        [numerics.negligible(x) if tolerance is None else tolerance for x in (start.q, start.v)]
    )
    system = with_turns(system, start.turns)
    constant = jax.lax.stop_gradient((system, start))
    problem = _Problem(*constant, free)
    y, met = jnp.zeros(len(free), start.q.dtype), jnp.ones((), bool)
    if problem.rows:
        limit = problem.scale * jax.lax.stop_gradient(allowed[0])
        y, met = nearest.restore(problem.surface, y, limit)
        best = nearest.polish(problem.surface, y, limit)
        better = met & jnp.all(jnp.abs(problem.surface(best)) <= limit)
        y = jnp.where(better, best, y)
    # in a failed world, derivatives may be infinite: its system and start become constants
    system, start = jax.tree.map(lambda x, y: jnp.where(met, x, y), (system, start), constant)
    problem = _Problem(system, start, free)
    y = nearest.implicit(problem.surface, y) if problem.rows else y
    q = problem.displaced(y)
    v, stuck = _nearest_velocity(system, q, start.v, start.instant, free)
    left = linearize(system, q, v, start.instant).violation
    met = (left.worst <= allowed[0]) & (left.worst_rate <= allowed[1])
    status = jnp.where(met, Status.OK, Status.NOT_CONVERGED).astype(jnp.int32)
    turns = system.count(q, v, start.instant)
    state = dataclasses.replace(start, q=q, v=v, status=status, turns=turns)
    return Assembly(state, left, numerics.norm(y), allowed, stuck)


class _Problem:
    """The constraint equations φ(y) = 0 in scaled displacements y of the free coordinates.

    With the displacement d and the mass matrix M = L Lᵀ, y = Lᵀ d, so that ‖y‖² = dᵀ M d.

    Attributes:
        rows: the number of rows.
        scale: the factor of each row that gives it length one at the start.
    """

    def __init__(self, system: System, start: State, free: np.ndarray) -> None:
        self.system, self.start, self.free = system, start, free
        self.factor = jnp.linalg.cholesky(system.mass(start.q).dense()[np.ix_(free, free)])
        rows = linearize(system, start.q, jnp.zeros_like(start.v), start.instant)
        self.rows = rows.layout.size
        length = numerics.norm(_weighted(rows.jacobian.dense()[:, free], self.factor).T)
        self.scale = jax.lax.stop_gradient(1 / jnp.where(length > 0, length, 1))

    def displaced(self, y: Array) -> Array:
        """Returns the positions q = q₀ ⊕ L⁻ᵀ y for scaled displacements y."""
        step = jnp.zeros_like(self.start.v).at[self.free].set(_unweighted(y, self.factor))
        return self.system.retract(self.start.q, step)

    def surface(self, y: Array) -> Array:
        """Returns φ(y), each row multiplied by its `scale`, at scaled displacements y."""
        q, rest = self.displaced(y), jnp.zeros_like(self.start.v)
        return self.scale * linearize(self.system, q, rest, self.start.instant).residual


def _nearest_velocity(
    system: System, q: Array, v: Array, t: Doubled | Scalar, free: np.ndarray
) -> tuple[Array, Array]:
    """Finds the velocities nearest to v, in the metric of M, that satisfy φ̇ = 0.

    Returns the velocities, (n_v,), and a mask of the stuck rows, (n_c,). A row is stuck if no free
    velocity changes it.

    Args:
        system: the system.
        q: positions, (n_q,).
        v: rough velocities, (n_v,).
        t: time, () [s].
        free: indices of the velocities that may change.
    """
    rows = linearize(system, q, v, t)
    if not rows.layout.size:
        return v, jnp.zeros(0, bool)
    holding = rows.layout.holding
    factor = jnp.linalg.cholesky(system.mass(q).dense()[np.ix_(free, free)])
    jacobian = _weighted(rows.jacobian.dense()[np.ix_(holding, free)], factor)
    length = jax.lax.stop_gradient(numerics.norm(jacobian.T))
    scale = 1 / jnp.where(length > 0, length, 1)
    y = nearest.pseudoinverse(jacobian * scale[:, None]) @ (scale * rows.rate[holding])
    stuck = jnp.zeros(rows.layout.size, bool).at[holding].set(length == 0)
    return v.at[free].add(-_unweighted(y, factor)), stuck


def _weighted(jacobian: Array, factor: Array) -> Array:
    """Returns J L⁻ᵀ, the Jacobian with respect to scaled displacements y = Lᵀ d.

    Args:
        jacobian: J, (n_c, n).
        factor: the Cholesky factor L of M, (n, n).
    """
    return jax.scipy.linalg.solve_triangular(factor, jacobian.T, lower=True).T


def _unweighted(y: Array, factor: Array) -> Array:
    """Returns the displacement or velocity d = L⁻ᵀ y, which undoes the scaling y = Lᵀ d.

    Args:
        y: the scaled displacement or velocity, (n,).
        factor: the Cholesky factor L of M, (n, n).
    """
    return jax.scipy.linalg.solve_triangular(factor, y, trans=1, lower=True)


def _start(
    system: System,
    q: State | Array | np.ndarray | Sequence[float],
    v: Array | np.ndarray | Sequence[float] | None,
    time: Scalar | None,
) -> State:
    """Checks the arguments of `assemble`; returns the state from which the search starts."""
    if not hasattr(system, "snapshot"):
        raise TypeError(
            f"assemble: expected a system, got {type(system).__name__};"
            " `system, state = scene.build()` makes one."
        )
    memory, turns = (), system.turns
    if isinstance(q, State):
        v = q.v if v is None else v
        time = q.time if time is None else time
        q, memory, turns = q.q, q.memory, q.turns
    dtype = checks.chosen_dtype(system, q, v)
    layout = system.layout
    n_q = np.shape(q) if layout is None else (layout.n_q,)
    if len(n_q) != 1:
        raise ValueError(f"assemble: q must have shape (n_q,), got {n_q}; batches by jax.vmap.")
    n_v = n_q if layout is None else (layout.n_v,)
    q = system.normalize(checks.real("assemble", "q", q, dtype, n_q))
    v = checks.real("assemble", "v", np.zeros(n_v) if v is None else v, dtype, n_v)
    t = checks.real("assemble", "time", 0.0 if time is None else time, dtype)
    snapshot = system.snapshot(q, v, t)
    for group in (*snapshot.system.constraints, *snapshot.system.bounds):
        if isinstance(group, Custom):
            check_function(group, snapshot)
    status = jnp.asarray(Status.OK, jnp.int32)
    start = State(q, v, t, status, memory, turns)
    start = dataclasses.replace(start, angle_remainder=system.no_remainder(dtype))
    return unshared(start, system)


def _held(
    system: System, hold: str | Sequence[Any] | np.ndarray | Array, n_v: int
) -> tuple[int, ...]:
    """Returns the indices in v of the velocities that do not move, in ascending order.

    Args:
        system: the system.
        hold: the argument of `assemble`: names of bodies, indices in v, or a mask.
        n_v: the number of velocities.

    Raises:
        ValueError: `hold` is traced, has an unknown name or index, or holds all velocities.
    """
    if not checks.is_concrete(hold):
        raise ValueError("assemble: what is held is structure and cannot be traced.")
    is_key = jnp.issubdtype(getattr(hold, "dtype", float), jax.dtypes.extended)
    if not isinstance(hold, Iterable) or isinstance(hold, Mapping) or is_key:
        raise ValueError(
            f"assemble: hold takes names of bodies, indices in v from 0 to {n_v - 1}, or a mask"
            f" ({n_v},), got {checks.shortened(hold)}."
        )
    parts = [hold] if isinstance(hold, str) else hold
    if isinstance(parts, np.ndarray | jax.Array):
        parts = np.asarray(parts)
        if parts.dtype == bool and parts.shape != (n_v,):
            raise ValueError(
                f"assemble: the mask hold must have shape ({n_v},), got {parts.shape}."
            )
        parts = np.flatnonzero(parts) if parts.dtype == bool else parts.ravel()
    held: set[int] = set()
    layout = system.layout
    for part in parts:
        if isinstance(part, str) and layout is None:
            raise ValueError(
                f"assemble: hold={part!r} names a body, but generalized coordinates have none;"
                " give indices or a mask."
            )
        indices = (
            layout.v(part) if isinstance(part, str) and layout is not None else np.atleast_1d(part)
        )
        is_index = np.issubdtype(indices.dtype, np.integer)
        if not is_index or np.any((indices < 0) | (indices >= n_v)):
            raise ValueError(
                f"assemble: hold takes names of bodies, indices in v from 0 to {n_v - 1}, or a mask"
                f" ({n_v},), got {part!r}."
            )
        held.update(map(int, indices))
    if len(held) == n_v:
        raise ValueError("assemble: everything is held, so that nothing can be assembled.")
    return tuple(sorted(held))
