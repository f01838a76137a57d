"""Tests whether velocity constraints are integrable, by Lie brackets (chapter 3.8.1). Host code."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rank import dependent_rows
from jaxcon.constraints.rows import layout_of, linearize
from jaxcon.core import checks
from jaxcon.core.typing import Array
from jaxcon.protocols import System
from jaxcon.system.state import State, checked_system

Fields = Callable[[Array], Array]
"""A function that evaluates several vector fields at x = (q, t).

It maps x, (n_q + 1,), to the values, (fields, n_q + 1).
"""


@dataclass(frozen=True)
class Integrability:
    """The velocities that a set of constraints allows, and their Lie brackets; `print` it.

    Attributes:
        names: names of the constraints.
        velocities: n_v, the number of velocities.
        held: number of independent rows of position constraints, which have a φ.
        growth: dimensions n₁ < n₂ < … of nested spaces of velocities. n₁ is the dimension of the
            allowed velocities. Each further level adds the brackets of allowed fields with fields
            of the level before. The last level is the one after which brackets add no dimension.
        directions: velocities that span the last level, (n_last, n_v). The allowed velocities come
            first, with unit length in the metric of M. The brackets that added a dimension follow,
            level by level.
        around: growth at a nearby, generic configuration. It differs from `growth` only if brackets
            happen to vanish at the given configuration. `integrable` and `hidden` follow from it.
    """

    names: tuple[str, ...]
    velocities: int
    held: int
    growth: tuple[int, ...]
    directions: np.ndarray
    around: tuple[int, ...]

    @property
    def integrable(self) -> bool:
        """True if brackets of allowed motions are allowed motions too (Frobenius' theorem)."""
        return len(self.around) == 1

    @property
    def hidden(self) -> int:
        """The number of relations between positions implied by the velocity constraints."""
        return self.velocities - self.held - self.around[-1]

    def __str__(self) -> str:
        level = self.velocities - self.held - self.growth[0]
        steps = " → ".join(map(str, self.growth)) + " dimensions"
        if self.around != self.growth:
            steps += f" here, {' → '.join(map(str, self.around))} around"
        verdict = "not integrable: the rows of velocities hide no relation between positions"
        if self.hidden:
            verdict = f"not integrable, but {self.hidden} relations between positions follow"
        if self.integrable:
            verdict = f"integrable: they amount to {self.hidden} relations between positions"
        return (
            f"{', '.join(self.names)}: {self.held} independent rows of positions and {level} of"
            f" velocities leave {self.growth[0]} of {self.velocities} velocities\n"
            f"allowed motions and their brackets: {steps}\n{verdict}"
        )


def integrability(
    system: System, state: State, names: Sequence[str] | None = None
) -> Integrability:
    """Computes how the space of allowed velocities grows under Lie brackets, at one configuration.

    Constraint rows have the form A(q, t) v + b(q, t) = 0, and q̇ = N(q) v. On the space of (q, t),
    they allow the vector fields (N v, 0) with A v = 0, and (N v, 1) with A v = −b. If the brackets
    [X, Y] = DY X − DX Y of allowed fields add no direction, the rows derive from relations between
    q and t, and conversely. Each level brackets the allowed fields with the fields added last.
    Brackets are computed in the coordinates q, so no structure constants are needed.

    If the brackets do not span all velocities, the growth is also computed at a nearby
    configuration, since brackets may vanish at exceptional configurations. Derivatives are nested
    once per level. This is feasible for some tens of velocities.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        state: state whose position satisfies the constraints. Its velocity is not used.
        names: names of the constraints; all by default.

    Returns:
        A `jc.analysis.Integrability`.

    Raises:
        ValueError: a name is unknown, or there are no rows.

    References:
        Bloch, Nonholonomic Mechanics and Control (2003), sections 2.8 and 4.3.
    """
    system = checked_system(system, state, "jc.analysis.integrability(system, s)")
    layout = layout_of(system, state.q, state.v, state.time)
    holding = tuple(name for name in layout.names if name not in layout.inertial)
    chosen = holding if names is None else checks.names("integrability", "names", names)
    if not chosen:
        raise ValueError("integrability: there is no constraint whose rows could be looked at.")
    rows = np.concatenate([layout.rows(name) for name in chosen])
    rows = rows[np.argsort(~layout.holonomic[rows], kind="stable")]  # rows with a φ first
    held, growth, directions = _growth(system, state, rows, layout.holonomic[rows])
    around = growth
    if growth[-1] < state.v.shape[0] - held:
        _, nearby, _ = _growth(system, _nearby(system, state), rows, layout.holonomic[rows])
        around = max(growth, nearby, key=lambda levels: levels[-1])
    return Integrability(chosen, state.v.shape[0], held, growth, directions, around)


def _nearby(system: System, state: State) -> State:
    """Returns a state with a random small change of q, 0.1 s later; it may violate constraints."""
    step = 0.1 * np.random.default_rng(0).normal(size=state.v.shape)
    q = system.retract(state.q, jnp.asarray(step, state.q.dtype))
    return dataclasses.replace(state, q=q, time=state.time + 0.1)


def _growth(
    system: System, state: State, rows: np.ndarray, holonomic: np.ndarray
) -> tuple[int, tuple[int, ...], np.ndarray]:
    """Computes how the space of allowed velocities grows under Lie brackets, at a configuration.

    Args:
        system: the system.
        state: the configuration and time.
        rows: indices of the rows, position constraints first.
        holonomic: mask of the rows of position constraints, (rows,).

    Returns:
        The number of independent rows of position constraints; the dimension of each level; the
        velocities that span the last level.
    """
    metric = _Metric(system, state)
    jacobian = np.asarray(_rows(system, state.q, state.time, rows)[0]) @ metric.out
    tolerance = 1e-9 if state.q.dtype == np.float64 else 1e-4
    unit = jacobian / np.maximum(np.linalg.norm(jacobian, axis=1, keepdims=True), 1e-300)
    dependent = dependent_rows(unit, tolerance)
    independent = np.delete(np.arange(len(rows)), dependent)
    held = int(np.sum(holonomic[independent]))
    allowed = np.linalg.svd(unit[independent])[2][len(independent) :]
    fields = _allowed(system, metric, rows[independent], jnp.asarray(allowed, state.q.dtype))
    x, room = jnp.append(state.q, state.time), state.v.shape[0] - held
    return held, *_grow(fields, metric, x, allowed, room, tolerance)


class _Metric:
    """Velocity coordinates w in which M at one configuration is a multiple of the identity.

    Attributes:
        out: matrix of v = out @ w, (n_v, n_v): L⁻ᵀ, where L Lᵀ is M divided by its mean diagonal.
        inward: matrix of w = inward @ q̇, (n_v, n_q).
    """

    def __init__(self, system: System, state: State) -> None:
        mass = np.asarray(system.mass(state.q).dense(), np.float64)
        factor = np.linalg.cholesky(mass / np.mean(np.diag(mass)))
        self.out = np.linalg.inv(factor.T)
        N = jax.vmap(lambda v: system.kinematics(state.q, v))(
            jnp.eye(len(mass), dtype=state.q.dtype)
        )
        self.inward = factor.T @ np.linalg.pinv(np.asarray(N, np.float64).T)

    def of(self, fields: Array) -> np.ndarray:
        """Converts the values of vector fields at the configuration to velocity coordinates w.

        Args:
            fields: rates of (q, t), (fields, n_q + 1).

        Returns:
            The coordinates w, (fields, n_v). The rate of t is dropped.
        """
        return np.asarray(fields, np.float64)[:, :-1] @ self.inward.T


def _rows(system: System, q: Array, t: Array, rows: np.ndarray) -> tuple[Array, Array]:
    """Returns the coefficients A (rows, n_v) and b (rows,) of constraint rows A v + b = 0."""
    n = system.sizes(q.shape[0])[1]
    all_rows = linearize(system, q, jnp.zeros(n, q.dtype), t)
    return all_rows.jacobian.dense()[rows], all_rows.rate[rows]


def _allowed(system: System, metric: _Metric, rows: np.ndarray, basis: Array) -> Fields:
    """Returns a function that evaluates the allowed vector fields at x = (q, t).

    Constraint rows have the form A v + b = 0. The first fields have the velocities of `basis`,
    projected onto the velocities with A v = 0; t does not change along them. The last field has the
    shortest velocity with A v = −b; along this field, t changes at rate 1.

    Args:
        system: the system.
        metric: coordinates w in which M is a multiple of the identity.
        rows: indices of independent rows.
        basis: velocities before the projection, in the coordinates w, (fields, n_v).
    """

    def fields(x: Array) -> Array:
        out = jnp.asarray(metric.out, x.dtype)
        jacobian, offset = _rows(system, x[:-1], x[-1], rows)
        a = jacobian @ out

        def shortest(y: Array) -> Array:
            """Returns the vector w of least norm with a @ w = y."""
            return a.T @ jnp.linalg.solve(a @ a.T, y)

        w = jnp.vstack([basis - shortest(a @ basis.T).T, -shortest(offset[:, None]).T])
        rates = jax.vmap(lambda v: system.kinematics(x[:-1], v))(w @ out.T)
        time = jnp.zeros(len(w), x.dtype).at[-1].set(1)
        return jnp.hstack([rates, time[:, None]])

    return fields


def _grow(
    fields: Fields, metric: _Metric, x: Array, allowed: np.ndarray, room: int, tolerance: float
) -> tuple[tuple[int, ...], np.ndarray]:
    """Extends the space of allowed velocities by Lie brackets, level by level.

    Args:
        fields: the allowed vector fields.
        metric: coordinates w in which M is a multiple of the identity.
        x: configuration and time (q, t), (n_q + 1,).
        allowed: an orthonormal basis of the allowed velocities, in the coordinates w, (n₁, n_v).
        room: the largest possible dimension.
        tolerance: relative length below which a bracket adds no dimension.

    Returns:
        The dimension of each level; and the velocities that span the last level, (n_last, n_v).
    """
    span = list(allowed)
    growth, last = [len(span)], fields
    while len(span) < room:
        brackets = _brackets(fields, last)
        first, second = (metric.of(part) for part in jax.jit(brackets)(x))
        size = 1 + np.linalg.norm(first, axis=1) + np.linalg.norm(second, axis=1)
        new = []
        for i, w in enumerate(first - second):
            basis = np.linalg.qr(np.array(span).T)[0] if span else np.zeros((len(w), 0))
            rest = w - basis @ (basis.T @ w)
            if np.linalg.norm(rest) > tolerance * size[i]:
                span.append(w)
                new.append(i)
        if not new:
            break
        growth.append(len(span))
        last = _chosen(brackets, np.array(new))
    return tuple(growth), np.array(span).reshape(-1, len(metric.out)) @ metric.out.T


def _brackets(fields: Fields, others: Fields) -> Callable[[Array], tuple[Array, Array]]:
    """Returns a function that computes both terms of the Lie brackets of all pairs of fields.

    A pair has a field X of `fields` and a field Y of `others`. Their bracket is
    [X, Y] = DY X − DX Y. The function maps x to two arrays, all DY X and all DX Y,
    (pairs, n_q + 1) each.
    """

    def terms(x: Array) -> tuple[Array, Array]:
        X, DX = jax.linearize(fields, x)
        Y, DY = jax.linearize(others, x)
        first = jax.vmap(DY)(X)
        second = jnp.swapaxes(jax.vmap(DX)(Y), 0, 1)
        return first.reshape(-1, len(x)), second.reshape(-1, len(x))

    return terms


def _chosen(brackets: Callable[[Array], tuple[Array, Array]], indices: np.ndarray) -> Fields:
    """Returns a function that evaluates selected Lie brackets at x, as vector fields.

    Args:
        brackets: function that computes both terms of all brackets, as `_brackets` returns it.
        indices: indices of the selected brackets.
    """

    def fields(x: Array) -> Array:
        first, second = brackets(x)
        return (first - second)[indices]

    return fields
