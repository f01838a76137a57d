"""Assembly: from a rough configuration to the nearest one that satisfies every constraint."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.custom import Custom, check_function
from jaxcon.constraints.rows import Violation, linearize
from jaxcon.core import checks, numerics
from jaxcon.core.pytree import pytree, unshared
from jaxcon.core.status import SimulationError, Status
from jaxcon.core.typing import Array
from jaxcon.dynamics import nearest
from jaxcon.model.state import State, recall

SHARE = 1e-3
"""The share of the worst constraint from which another one is reported as unmet, too."""


@pytree
class Assembly:
    """What `assemble` found; `print` it, and take the state by `check()`.

    Attributes:
        state: the nearest one; its status is NOT_CONVERGED where a constraint could not be met, so
            that no step goes on from it.
        violation: φ and φ̇ that are left, by constraint.
        distance: (dᵀ M d)^½ of the displacement d from the configuration given, ().
        tolerance: what |φ| and |φ̇| may be, (2,).
        stuck: rows that nothing free can change, (n_c,).
    """

    state: State
    violation: Violation
    distance: Array
    tolerance: Array
    stuck: Array

    @property
    def q(self) -> Array:
        """Positions, (n_q,)."""
        return self.state.q

    @property
    def v(self) -> Array:
        """Velocities, (n_v,)."""
        return self.state.v

    @property
    def status(self) -> Array:
        """`Status` code, ()."""
        return self.state.status

    @property
    def converged(self) -> Array:
        """Returns True where every constraint is met, ()."""
        return self.status == Status.OK

    @property
    def unmet(self) -> dict[str, tuple[float, float]]:
        """‖φ‖ and ‖φ̇‖ of each constraint that could not be met. For one world, outside jit."""
        allowed = np.asarray(self.tolerance)
        position, velocity = np.abs(self.violation.position), np.abs(self.violation.velocity)
        # what is off by little beside the others is off by rounding, or pulled by them
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
        """The state, where every constraint is met. For use outside jit.

        Raises:
            SimulationError: names each constraint that could not be met, and by how much.
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
    system: Any,
    q: Any,
    v: Any = None,
    *,
    hold: Any = (),
    time: Any = None,
    tolerance: Any = None,
) -> Assembly:
    """The nearest configuration and velocity that satisfy every constraint.

    q = q₀ ⊕ d with the least ½ dᵀ M d under φ(q, t) = 0, rotations by their exponential; then v
    with the least ½ (v − v₀)ᵀ M (v − v₀) under J v + ∂φ/∂t = 0 and ψ = 0. What is held keeps its q
    and v. "Nearest" is local: of several ways to close a loop, that to which the start leads.

    Pure: jit and vmap it. The derivative by q₀, v₀, t and every number of the system is that of the
    solution, not of the iterations: `assemble(system.with_params(…), state)` closes a mechanism of
    other lengths again, differentiably. Where a constraint could not be met there is no derivative.
    Dense, for mechanisms of up to some hundreds of velocities.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        q: rough positions, (n_q,); or a `State`, whose velocity, time and memory are kept.
        v: rough velocities, (n_v,); those of the state, or rest, unless given.
        hold: what does not move: names of bodies, indices in v (`system.layout.v(name)`), or a mask
            (n_v,).
        time: t, () [s]; that of the state, or 0, unless given.
        tolerance: up to which |φ| counts as zero; (1 + max |q|) ε^⅔ unless given, with ε the
            spacing of floating numbers. For |φ̇| the same with v.

    Returns:
        The `Assembly`. `assemble(…).check()` is the state, or raises what could not be met.

    Raises:
        ValueError: wrong shapes, mixed dtypes, or something unknown to be held.
    """
    start = _start(system, q, v, time)
    held = _held(system, hold, start.v.shape[0])
    if tolerance is not None:
        tolerance = checks.real("assemble", "tolerance", tolerance, start.q.dtype, above=0)
    return _assemble(system, start, tolerance, held=held)


@partial(jax.jit, static_argnames="held")
def _assemble(system: Any, start: State, tolerance: Any, *, held: tuple[int, ...]) -> Assembly:
    free = np.setdiff1d(np.arange(start.v.shape[0]), held)
    allowed = jnp.stack([_allowed(x, tolerance) for x in (start.q, start.v)])
    system = recall(system, start.turns)
    constant = jax.lax.stop_gradient((system, start))
    y, met = _solve(_Problem(*constant, free), jax.lax.stop_gradient(allowed[0]))
    # where it failed, the derivative is cut before anything that may be infinite
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
    """φ by displacements y = Lᵀ d of what is free, M = L Lᵀ there, so that ‖y‖² = dᵀ M d.

    Attributes:
        rows: how many there are.
        scale: of each row, so that it has length 1 at the start.
    """

    def __init__(self, system: Any, start: State, free: np.ndarray) -> None:
        self.system, self.start, self.free = system, start, free
        self.factor = jnp.linalg.cholesky(system.mass(start.q).dense()[np.ix_(free, free)])
        rows = linearize(system, start.q, jnp.zeros_like(start.v), start.instant)
        self.rows = rows.layout.size
        length = numerics.norm(_weighted(rows.jacobian.dense()[:, free], self.factor).T)
        self.scale = jax.lax.stop_gradient(1 / jnp.where(length > 0, length, 1))

    def displaced(self, y: Array) -> Array:
        """q = q₀ ⊕ L⁻ᵀ y."""
        step = jnp.zeros_like(self.start.v).at[self.free].set(_unweighted(y, self.factor))
        return self.system.retract(self.start.q, step)

    def surface(self, y: Array) -> Array:
        """φ, each row scaled."""
        q, rest = self.displaced(y), jnp.zeros_like(self.start.v)
        return self.scale * linearize(self.system, q, rest, self.start.instant).residual


def _solve(problem: _Problem, allowed: Array) -> tuple[Array, Array]:
    """The least y on the constraints, and whether there is one."""
    y = jnp.zeros(len(problem.free), problem.start.q.dtype)
    if not problem.rows:
        return y, jnp.ones((), bool)
    tolerance = problem.scale * allowed
    y, met = nearest.restore(problem.surface, y, tolerance)
    best = nearest.polish(problem.surface, y, tolerance)
    kept = met & jnp.all(jnp.abs(problem.surface(best)) <= tolerance)
    return jnp.where(kept, best, y), met


def _nearest_velocity(
    system: Any, q: Array, v: Array, t: Any, free: np.ndarray
) -> tuple[Array, Array]:
    """v with the constraints' rates at zero, and which rows nothing free can change."""
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
    """J L⁻ᵀ."""
    return jax.scipy.linalg.solve_triangular(factor, jacobian.T, lower=True).T


def _unweighted(y: Array, factor: Array) -> Array:
    """L⁻ᵀ y."""
    return jax.scipy.linalg.solve_triangular(factor, y, trans=1, lower=True)


def _allowed(x: Array, tolerance: Any) -> Array:
    """Up to which a residual at x counts as zero, ()."""
    if tolerance is not None:
        return tolerance
    return numerics.negligible(x)


def _start(system: Any, q: Any, v: Any, time: Any) -> State:
    """Where to start from, checked."""
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
    layout = getattr(system, "layout", None)
    n_q = jnp.shape(q) if layout is None else (layout.n_q,)
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


def _held(system: Any, hold: Any, n_v: int) -> tuple[int, ...]:
    """Indices in v of what does not move."""
    if not checks.is_concrete(hold):
        raise ValueError("assemble: what is held is structure and cannot be traced.")
    parts = [hold] if isinstance(hold, str) else hold
    if isinstance(parts, np.ndarray | jax.Array):
        parts = np.asarray(parts)
        if parts.dtype == bool and parts.shape != (n_v,):
            raise ValueError(
                f"assemble: the mask hold must have shape ({n_v},), got {parts.shape}."
            )
        parts = np.flatnonzero(parts) if parts.dtype == bool else parts.ravel()
    indices = [i for part in parts for i in _indices(system, part, n_v)]
    if len(set(indices)) == n_v:
        raise ValueError("assemble: everything is held, so that nothing can be assembled.")
    return tuple(sorted(set(indices)))


def _indices(system: Any, part: Any, n_v: int) -> Iterable[int]:
    if isinstance(part, str):
        layout = getattr(system, "layout", None)
        if layout is None:
            raise ValueError(
                f"assemble: hold={part!r} names a body, but generalized coordinates have none;"
                " give indices or a mask."
            )
        return map(int, layout.v(part))
    found = np.atleast_1d(np.asarray(part))
    if not np.issubdtype(found.dtype, np.integer) or np.any((found < 0) | (found >= n_v)):
        raise ValueError(
            f"assemble: hold takes names of bodies, indices in v from 0 to {n_v - 1}, or a mask"
            f" ({n_v},), got {part!r}."
        )
    return map(int, found)
