"""Growth of derivatives along a rollout, and the time after which they are useless. Host code."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import linearize
from jaxcon.core import checks
from jaxcon.core.status import Status, failed
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.execution.rollout import rollout
from jaxcon.methods.method import Method
from jaxcon.protocols import System
from jaxcon.system.state import State, checked_system

FULL = 16
"""The largest number of perturbation directions of (q, v).

If there are more independent directions, this many random combinations of them are used.
"""


POLYNOMIAL = 4.0
"""The threshold on exponent times time up to which growth may be polynomial, not exponential.

For growth ∝ t², the fitted exponent times the time is 2.8.
"""


@dataclass(frozen=True)
class GradientGrowth:
    """Growth of the derivatives ‖∂x_t/∂x_0‖ along a rollout, with x = (q, v); `print` it.

    Attributes:
        time: time since the start, (n,) [s].
        growth: root mean square size of perturbations at each time, relative to their initial size,
            (n,). The mean is over perturbations that satisfy the constraints.
        exponent: growth rate λ [1/s] of e^(λ t), fitted to the second half of the rollout.
        spacing: machine epsilon ε of the state's dtype.
    """

    time: np.ndarray
    growth: np.ndarray
    exponent: float
    spacing: float

    def horizon(self, error: float | None = None) -> float:
        """Returns the time after which derivatives with respect to the start are meaningless [s].

        The initial state has a relative error δ, at least the rounding error. When growth · δ = 1,
        this error has grown to the size of the state itself. The simulated motion, and hence its
        derivative, then differs completely from the intended one.

        Args:
            error: relative error δ, for example of a measured initial state or of the
                discretization; ε by default.

        Returns:
            The time since the start. Beyond the end of the rollout it is extrapolated with
            `exponent`. It is infinite if the growth so far is not faster than polynomial; a longer
            rollout may show exponential growth.
        """
        limit = 1 / (self.spacing if error is None else error)
        late = np.flatnonzero(~(self.growth < limit))
        if late.size:
            return float(self.time[late[0]])
        # a pendulum's phase error grows in proportion to t, which is not exponential
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
    system: System,
    method: Method,
    state: State,
    controls: PyTree | Callable[[State], PyTree],
    dt: Scalar,
    steps: int,
    seed: int = 0,
) -> GradientGrowth:
    """Computes the growth of the derivatives ‖∂x_t/∂x_0‖ along a rollout, with x = (q, v).

    The derivatives are computed by forward mode.

    Only initial perturbations that keep φ and φ̇ unchanged are used, since feedback would quickly
    remove all others. With n independent perturbations, the growth is ‖∂x_t/∂x_0‖_F/√n in SI units.
    If n > 16, 16 random combinations of the perturbations are used.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        method: integrator, stabilizer and solver.
        state: the initial state.
        controls: control inputs, as in `jc.rollout`.
        dt: step size h, () [s].
        steps: number of steps.
        seed: seed of random perturbations.

    Returns:
        A `jc.analysis.GradientGrowth` at 100 to 200 times, or at more times if the number of steps
        has no suitable divisor.

    Raises:
        ValueError: the constraints leave no degree of freedom, the rollout fails, or `jc.rollout`
            refuses an argument.
    """
    checks.count("gradient_growth", "steps", steps, 4)
    checks.count("gradient_growth", "seed", seed, 0)
    checks.check("gradient_growth", "dt", dt, (), above=0)
    moves = _allowed(checked_system(system, state), state)
    n = moves.shape[1]
    if n == 0:
        raise ValueError("gradient_growth: the constraints leave no freedom in which to move.")
    if n > FULL:
        moves = moves @ np.linalg.qr(np.random.default_rng(seed).normal(size=(n, FULL)))[0]
    every = next(k for k in range(max(steps // 100, 1), 0, -1) if steps % k == 0)

    def path(move: Array) -> tuple[Array, Array]:
        q = system.retract(state.q, move[: len(state.v)])
        start = dataclasses.replace(state, q=q, v=state.v + move[len(state.v) :])
        final, recorded = rollout(
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
        return jnp.concatenate([first[None], recorded]), final.status

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
    """Fits the exponential growth rate to the second half of the finite, positive values [1/s]."""
    positive = np.isfinite(growth) & (growth > 0)
    time, size = time[positive], np.log(growth[positive])
    half = len(time) // 2
    return float(np.polyfit(time[half:], size[half:], 1)[0])


def _allowed(system: System, state: State) -> np.ndarray:
    """Returns an orthonormal basis of the perturbations (δq, δv) that leave φ and φ̇ unchanged.

    The basis vectors are the columns of the result, (2 n_v, n).
    """
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
