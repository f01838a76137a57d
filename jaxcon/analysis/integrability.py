"""Integrability: rows of velocities that amount to relations between positions (chapter 3.8.1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import layout_of, linearize
from jaxcon.core.typing import Array
from jaxcon.dynamics.rank import dependent_rows
from jaxcon.model.state import State, at

Fields = Callable[[Array], Array]
"""Vector fields on (q, t), of shape (fields, n_q + 1)."""


@dataclass(frozen=True)
class Integrability:
    """What motions a set of rows allows, and what these reach together; `print` it.

    Attributes:
        names: of the constraints.
        velocities: n_v.
        held: number of independent rows that have a φ.
        growth: n₁ < n₂ < …: the dimension of the allowed velocities, then of these with their
            brackets, with the brackets of those, and so on until nothing is added.
        directions: velocities (n_last, n_v): the allowed ones, of unit length in the metric of M,
            then the brackets that added one, in the order of growth.
        around: the growth at a configuration nearby, where that at this one is not all there is. A
            bracket may vanish at single configurations and lead further around them; relations
            between positions are those that are left there.
    """

    names: tuple[str, ...]
    velocities: int
    held: int
    growth: tuple[int, ...]
    directions: np.ndarray
    around: tuple[int, ...]

    @property
    def integrable(self) -> bool:
        """Returns True where brackets of allowed motions are allowed motions (Frobenius)."""
        return len(self.around) == 1

    @property
    def hidden(self) -> int:
        """How many relations between positions follow from the rows that have no φ."""
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


def integrability(system: Any, state: State, names: Sequence[str] | None = None) -> Integrability:
    """Growth of the allowed velocities under Lie brackets, at the configuration of a state.

    The rows A(q, t) v + b(q, t) = 0 leave the fields (N v, 0) with A v = 0 and (N v, 1) with
    A v = −b on (q, t). They come from relations between q and t exactly where brackets
    [X, Y] = DY X − DX Y lead to no new direction. Each level takes the brackets of the allowed
    fields with what the last one added. Brackets are taken on q itself, where q̇ = N(q) v, so that
    no structure constants are needed. Where they do not fill all there is, growth is looked at
    nearby as well, since at exceptional configurations it may be slower than around them. For
    mechanisms of up to some tens of velocities: derivatives are nested as deep as growth goes.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: where, in position and time; on the constraints. Its velocity does not matter.
        names: of the constraints that are meant; all of the system unless given.

    Returns:
        An `Integrability`.

    Raises:
        ValueError: an unknown name, or no row at all.

    References:
        Bloch, Nonholonomic Mechanics and Control (2003), sections 2.8 and 4.3.
    """
    system = at(system, state, "jc.integrability(system, s)")
    layout = layout_of(system, state.q, state.v, state.time)
    holding = tuple(name for name in layout.names if name not in layout.inertial)
    chosen = holding if names is None else (names,) if isinstance(names, str) else tuple(names)
    if not chosen:
        raise ValueError("integrability: there is no constraint whose rows could be looked at.")
    rows = np.concatenate([layout.rows(name) for name in chosen])
    rows = rows[np.argsort(~layout.holonomic[rows], kind="stable")]  # those with a φ first
    held, growth, directions = _growth(system, state, rows, layout.holonomic[rows])
    around = growth
    if growth[-1] < state.v.shape[0] - held:
        _, found, _ = _growth(system, _nearby(system, state), rows, layout.holonomic[rows])
        around = max(growth, found, key=lambda levels: levels[-1])
    return Integrability(chosen, state.v.shape[0], held, growth, directions, around)


def _nearby(system: Any, state: State) -> State:
    """A generic configuration in the neighbourhood, and time; off the constraints."""
    step = 0.1 * np.random.default_rng(0).normal(size=state.v.shape)
    q = system.retract(state.q, jnp.asarray(step, state.q.dtype))
    return dataclasses.replace(state, q=q, time=state.time + 0.1)


def _growth(
    system: Any, state: State, rows: np.ndarray, holonomic: np.ndarray
) -> tuple[int, tuple[int, ...], np.ndarray]:
    """Independent rows that have a φ, growth, and the velocities that span its last level."""
    metric = _Metric(system, state)
    jacobian = np.asarray(_rows(system, state.q, state.time, rows)[0]) @ metric.out
    tolerance = 1e-9 if state.q.dtype == np.float64 else 1e-4
    unit = jacobian / np.maximum(np.linalg.norm(jacobian, axis=1, keepdims=True), 1e-300)
    dependent = dependent_rows(unit, tolerance)
    known = np.delete(np.arange(len(rows)), dependent)
    held = int(np.sum(holonomic[known]))
    allowed = np.linalg.svd(unit[known])[2][len(known) :]
    fields = _allowed(system, metric, rows[known], jnp.asarray(allowed, state.q.dtype))
    x, room = jnp.append(state.q, state.time), state.v.shape[0] - held
    return held, *_grow(fields, metric, x, allowed, room, tolerance)


class _Metric:
    """Velocities in coordinates in which M at a configuration is the identity, v = out @ w."""

    def __init__(self, system: Any, state: State) -> None:
        mass = np.asarray(system.mass(state.q).dense(), np.float64)
        factor = np.linalg.cholesky(mass / np.mean(np.diag(mass)))
        self.out = np.linalg.inv(factor.T)
        turn = jax.vmap(lambda v: system.kinematics(state.q, v))(
            jnp.eye(len(mass), dtype=state.q.dtype)
        )
        self.inward = factor.T @ np.linalg.pinv(np.asarray(turn, np.float64).T)

    def of(self, fields: Array) -> np.ndarray:
        """w of fields (fields, n_q + 1) at the configuration."""
        return np.asarray(fields, np.float64)[:, :-1] @ self.inward.T


def _rows(system: Any, q: Array, t: Any, rows: np.ndarray) -> tuple[Array, Array]:
    """A and b."""
    n = system.sizes(q.shape[0])[1]
    found = linearize(system, q, jnp.zeros(n, q.dtype), t)
    return found.jacobian.dense()[rows], found.rate[rows]


def _allowed(system: Any, metric: _Metric, rows: np.ndarray, basis: Array) -> Fields:
    """The allowed fields: constant velocities projected on the rows, and the drift of time."""

    def fields(x: Array) -> Array:
        out = jnp.asarray(metric.out, x.dtype)
        jacobian, offset = _rows(system, x[:-1], x[-1], rows)
        a = jacobian @ out

        def fall(y: Array) -> Array:
            """The shortest w with A w = y."""
            return a.T @ jnp.linalg.solve(a @ a.T, y)

        w = jnp.vstack([basis - fall(a @ basis.T).T, -fall(offset[:, None]).T])
        rates = jax.vmap(lambda v: system.kinematics(x[:-1], v))(w @ out.T)
        time = jnp.zeros(len(w), x.dtype).at[-1].set(1)
        return jnp.hstack([rates, time[:, None]])

    return fields


def _grow(
    fields: Fields, metric: _Metric, x: Array, allowed: np.ndarray, room: int, tolerance: float
) -> tuple[tuple[int, ...], np.ndarray]:
    """Dimensions of the levels, and the velocities that span the last; at most `room` of them."""
    found = list(allowed)
    growth, last = [len(found)], fields
    while len(found) < room:
        brackets = _brackets(fields, last)
        first, second = (metric.of(part) for part in jax.jit(brackets)(x))
        size = 1 + np.linalg.norm(first, axis=1) + np.linalg.norm(second, axis=1)
        new = []
        for i, w in enumerate(first - second):
            basis = np.linalg.qr(np.array(found).T)[0] if found else np.zeros((len(w), 0))
            rest = w - basis @ (basis.T @ w)
            if np.linalg.norm(rest) > tolerance * size[i]:
                found.append(w)
                new.append(i)
        if not new:
            break
        growth.append(len(found))
        last = _chosen(brackets, np.array(new))
    return tuple(growth), np.array(found).reshape(-1, len(metric.out)) @ metric.out.T


def _brackets(fields: Fields, others: Fields) -> Callable[[Array], tuple[Array, Array]]:
    """[X, Y] = DY X − DX Y of all pairs, as its two terms (pairs, n_q + 1)."""

    def terms(x: Array) -> tuple[Array, Array]:
        own, along_own = jax.linearize(fields, x)
        other, along_other = jax.linearize(others, x)
        first = jax.vmap(along_other)(own)
        second = jnp.swapaxes(jax.vmap(along_own)(other), 0, 1)
        return first.reshape(-1, len(x)), second.reshape(-1, len(x))

    return terms


def _chosen(brackets: Callable[[Array], tuple[Array, Array]], indices: np.ndarray) -> Fields:
    """Some of the brackets as fields."""

    def fields(x: Array) -> Array:
        first, second = brackets(x)
        return (first - second)[indices]

    return fields
