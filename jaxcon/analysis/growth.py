"""How fast derivatives grow along a rollout, and when they say nothing any more. Host code."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import linearize
from jaxcon.core import checks
from jaxcon.core.status import Status, failed
from jaxcon.core.typing import Array
from jaxcon.model.state import State, at
from jaxcon.simulation.method import Method
from jaxcon.simulation.rollout import rollout

FULL = 16
"""Up to so many independent moves of (q, v) all are taken; beyond, as many random ones."""


POLYNOMIAL = 4.0
"""exponent · time up to which growth may be that of a power: t² is fitted to 2.8 there."""


@dataclass(frozen=True)
class GradientGrowth:
    """‖∂x_t/∂x_0‖ along a rollout, x = (q, v); `print` it.

    Attributes:
        time: since the start, (n,) [s].
        growth: what moves of the start that the constraints allow have become, the root of the
            mean square over them, relative to what they were, (n,).
        exponent: of growth ∝ e^(exponent t), fitted to the second half of the rollout [1/s].
        spacing: ε, of floating numbers, relative.
    """

    time: np.ndarray
    growth: np.ndarray
    exponent: float
    spacing: float

    def horizon(self, error: float | None = None) -> float:
        """The time beyond which a derivative says nothing about the motion [s].

        The state at the start is known to a relative error δ, at the least by its rounding. At the
        time where growth · δ = 1 this has become as large as the state itself, and the derivative
        is that of another motion than the one that was meant.

        Args:
            error: δ, such as that of a measured start or of the discretization; ε unless given.

        Returns:
            The time; beyond the rollout by the exponent, and infinite where so far nothing grows
            faster than a power of time might: a longer rollout may tell.
        """
        limit = 1 / (self.spacing if error is None else error)
        late = np.flatnonzero(~(self.growth < limit))
        if late.size:
            return float(self.time[late[0]])
        # the phase of any pendulum moves away in proportion to t, which is no exponent
        if self.exponent * self.time[-1] <= POLYNOMIAL:
            return math.inf
        return float(self.time[-1] + math.log(limit / self.growth[-1]) / self.exponent)

    def __str__(self) -> str:
        head = f"a move of the start grows by {self.growth[-1]:.3g} in {self.time[-1]:.3g} s"
        rate = f"exponent {self.exponent:.3g} /s"
        if math.isinf(self.horizon(1e-3)):
            return (
                f"{head}; {rate}, no more than a power of time might: derivatives reach as far as"
                " this run, and a longer one tells more"
            )
        horizons = f"useless beyond {self.horizon():.3g} s by rounding"
        return f"{head}; {rate}; {horizons}, {self.horizon(1e-3):.3g} s by a start known to 1e-3"


def gradient_growth(
    system: Any, method: Method, state: State, controls: Any, dt: Any, steps: int, seed: int = 0
) -> GradientGrowth:
    """How ‖∂x_t/∂x_0‖ grows along a rollout, by forward mode.

    Moves of the start are those that keep φ = 0 and φ̇ = 0; others would be taken back by feedback
    at once. The growth is ‖∂x_t/∂x_0‖_F/√n over n such moves, in SI units: all that there are, or
    16 random ones where there are more.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: the start.
        controls: as of `rollout`.
        dt: h, () [s].
        steps: how many.
        seed: of random moves.

    Returns:
        The `GradientGrowth`, with a hundred times or two where the number of steps has a divisor
        for that, or more.

    Raises:
        ValueError: the constraints leave no freedom, the rollout fails, or what `rollout` refuses.
    """
    checks.count("gradient_growth", "steps", steps, 4)
    checks.count("gradient_growth", "seed", seed, 0)
    checks.check("gradient_growth", "dt", dt, (), above=0)
    moves = _allowed(at(system, state), state)
    n = moves.shape[1]
    if n == 0:
        raise ValueError("gradient_growth: the constraints leave no freedom in which to move.")
    if n > FULL:
        moves = moves @ np.linalg.qr(np.random.default_rng(seed).normal(size=(n, FULL)))[0]
    every = next(k for k in range(max(steps // 100, 1), 0, -1) if steps % k == 0)

    def path(move: Array) -> tuple[Array, Array]:
        q = system.retract(state.q, move[: len(state.v)])
        start = dataclasses.replace(state, q=q, v=state.v + move[len(state.v) :])
        final, kept = rollout(
            system,
            method,
            start,
            controls,
            dt,
            steps,
            record=lambda s, i: jnp.concatenate([s.q, s.v]),
            every=every,
        )
        first = jnp.concatenate([start.q, start.v])
        return jnp.concatenate([first[None], kept]), final.status

    def along(move: Array) -> tuple[Array, Array]:
        _, moved, code = jax.jvp(path, (jnp.zeros_like(move),), (move,), has_aux=True)
        return moved, code

    tangents = jnp.asarray(moves.T, state.q.dtype)
    moved, codes = jax.jit(jax.vmap(along))(tangents)
    if failed(code := codes[0]):
        raise ValueError(
            f"gradient_growth: the rollout fails, {Status(int(code)).name}, and derivatives end"
            " there; `find_first_failure` names the step and the term."
        )
    squares = np.sum(np.asarray(moved, np.float64) ** 2, axis=(0, 2))
    growth = np.sqrt(squares / squares[0])
    time = float(dt) * every * np.arange(len(growth))
    return GradientGrowth(
        time, growth, _exponent(time, growth), float(jnp.finfo(state.q.dtype).eps)
    )


def _exponent(time: np.ndarray, growth: np.ndarray) -> float:
    """Returns the rate of growth over the second half of the positive numbers [1/s]."""
    told = np.isfinite(growth) & (growth > 0)
    time, size = time[told], np.log(growth[told])
    half = len(time) // 2
    return float(np.polyfit(time[half:], size[half:], 1)[0])


def _allowed(system: Any, state: State) -> np.ndarray:
    """An orthonormal basis of the moves (δq, δv) that keep φ and φ̇, (2 n_v, n)."""
    n = len(state.v)

    def both(move: Array) -> tuple[Array, Array]:
        q = system.retract(state.q, move[:n])
        rows = linearize(system, q, state.v + move[n:], state.instant)
        return rows.residual, rows.rate

    layout = linearize(system, state.q, state.v, state.instant).layout
    by_φ, by_rate = jax.jit(jax.jacfwd(both))(jnp.zeros(2 * n, state.v.dtype))
    held, holding = layout.holonomic & layout.holds, layout.holding
    rows = np.concatenate([np.asarray(by_φ)[held], np.asarray(by_rate)[holding]])
    _, sizes, directions = np.linalg.svd(np.asarray(rows, np.float64), full_matrices=True)
    small = float(jnp.finfo(state.v.dtype).eps) ** 0.5 * np.max(sizes, initial=1.0)
    return directions[int(np.sum(sizes > small)) :].T
