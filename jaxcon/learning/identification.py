"""Numbers of a model from recordings of its motion, and what the recordings do not tell."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import Array, PyTree
from jaxcon.learning.least_squares import Fit, least_squares
from jaxcon.learning.leaves import Space, space_of
from jaxcon.learning.stretches import Stretches

VAGUE = 1.0
"""Standard deviation of a relative change from which on the data do not tell it: a factor of e."""


@dataclass(frozen=True)
class Identified:
    """Parameters with what is known of them; `print` it.

    A direction is a combination of relative changes: of log x for positive parameters, of x by its
    size at the start for others. Singular values are those of the residuals by noise, σ = 1, along
    them, so that 1/s is the standard deviation of the estimate there (Cramér and Rao's bound).

    Attributes:
        params: like those given.
        errors: their standard deviations, in the same structure and units; infinite where the data
            tell nothing, NaN where a leaf was not searched.
        nodes: the states at the nodes, as they were given; None without.
        noise: what remains, its root mean square by degree of freedom: in units of the noise that
            was given, so that 1 is as expected, or in those of the data where none was.
        observed: how many numbers were seen.
        names: of the parameters, one by one.
        singular_values: largest first, (n,).
        directions: of unit length, (n, n), a row for each singular value.
        costs: ½ ‖r‖² by step; with nodes, of the last search, at the continuity asked for.
        stopped: why it went no further, in words.
    """

    params: PyTree
    errors: PyTree
    nodes: PyTree
    noise: float
    observed: int
    names: tuple[str, ...]
    singular_values: np.ndarray
    directions: np.ndarray
    costs: np.ndarray
    stopped: str

    @property
    def table(self) -> dict[str, tuple[float, float]]:
        """Each number that was searched with its standard deviation, by name."""
        errors = np.concatenate([np.ravel(x) for x in jax.tree.leaves(self.errors)])
        values = [np.ravel(x) for x in jax.tree.leaves(self.params)]
        searched = ~np.isnan(errors)
        pairs = zip(np.concatenate(values)[searched], errors[searched], strict=True)
        return {name: (float(x), float(e)) for name, (x, e) in zip(self.names, pairs, strict=True)}

    @property
    def condition(self) -> float:
        """cond(JᵀJ) = (s₁/sₙ)²."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return float((self.singular_values[0] / self.singular_values[-1]) ** 2)

    @property
    def untold(self) -> list[dict[str, float]]:
        """Directions that the data do not tell, each by the share of each parameter."""
        rows = self.directions[self.singular_values <= 1 / VAGUE]
        return [
            {name: float(x) for name, x in zip(self.names, row, strict=True) if abs(x) > 0.05}
            for row in rows
        ]

    def __str__(self) -> str:
        head = f"{len(self.names)} parameters from {self.observed} numbers,"
        lines = [f"{head} {len(self.costs) - 1} steps: {self.stopped}"]
        for name, (x, e) in self.table.items():
            lines.append(f"  {name or 'the parameter'} = {x:.6g} ± {e:.2g}")
        lines.append(f"noise {self.noise:.3g}, cond(JᵀJ) = {self.condition:.1e}")
        for row in self.untold:
            change = " ".join(f"{x:+.2f} {name}" for name, x in row.items())
            lines.append(f"the data do not tell the relative change {change}")
        if not self.untold:
            lines.append("the data tell every parameter")
        return "\n".join(lines)


def identify(
    simulate: Callable[..., Any],
    params: PyTree,
    data: PyTree,
    *,
    noise: PyTree = None,
    positive: Any = (),
    bounds: Any = None,
    nodes: PyTree = None,
    continuity: float = 1e-3,
    steps: int = 50,
) -> Identified:
    """The parameters whose simulation is nearest to a recording, by damped Gauss–Newton steps.

    argmin Σ ((simulate(params) − data) / noise)², with derivatives in forward mode: for up to some
    tens of parameters. For more, `tune` a loss by `losses.tracking`.

    Recordings longer than the motion can be foreseen, or so long that the least of the sum is hard
    to reach, are cut into stretches (multiple shooting). Their first states, the nodes, are unknown
    too, and the end of each stretch must meet the next node.

    Args:
        simulate: params → predictions; with nodes (params, node) → predictions of one stretch and
            its end, in the structure of a node. Trouble on the way should show as NaN
            (`losses.unless_failed`).
        params: the start. Leaves that are no floating numbers are kept, and traced.
        data: what was recorded, in the structure of the predictions, NaN where nothing was seen;
            with nodes an axis of stretches comes first.
        noise: standard deviation of the data, a number or a pytree whose leaves broadcast with
            those of the data; estimated from what remains unless given.
        positive: as of `tune`.
        bounds: as of `tune`.
        nodes: first guesses of the states at the nodes, with a first axis of stretches. Minimal
            coordinates, such as angles and rates, so that every value is a state.
        continuity: standard deviation by which an end may miss the next node, in its units.
        steps: at most so many; with nodes, for each decade by which ends come closer to them.

    Returns:
        An `Identified`.

    Raises:
        ValueError: predictions and data do not fit, unknown names, a start out of its bounds or at
            which the residuals are not finite.

    References:
        Bock, Recent advances in parameter identification techniques for ODE (1983).
        Nocedal, Wright, Numerical Optimization (2006), section 10.3.
    """
    checks.count("identify", "steps", steps)
    checks.positive("identify", "continuity", continuity)
    for x in jax.tree.leaves(noise):
        checks.positive("identify", "noise", x)
    space = space_of(params, positive, bounds, "identify")
    y = space.flatten(space.encode(params))
    logs = [jnp.full(x.shape, p) for x, p in zip(space.low, space.positive, strict=True)]
    scale = jnp.where(space.flatten(logs) | (y == 0), 1, jnp.abs(y))
    problem = Stretches(simulate, space, scale, data, 1.0 if noise is None else noise, nodes)
    start = np.append(y / scale, problem.nodes)
    low, high = (np.full(start.shape, x) for x in (-np.inf, np.inf))
    low[: y.size], high[: y.size] = (space.flatten(x) / scale for x in space.limits)
    tolerance = float(jnp.finfo(y.dtype).eps) ** 0.5
    residual, _ = problem.linearize(1.0)(start)
    if not np.all(np.isfinite(residual)):
        raise ValueError(
            "identify: the residuals are not finite at the start; simulate must be finite there."
        )
    first, *rest = problem.widths(residual, continuity)
    fit = least_squares(problem.linearize(first), start, low, high, steps, tolerance)
    for width in () if fit.interrupted else rest:
        fit = least_squares(problem.linearize(width), fit.z, low, high, steps, tolerance)
    return _report(problem, fit, noise is not None, tolerance)


def _report(problem: Stretches, fit: Fit, known: bool, tolerance: float) -> Identified:
    """What a fit says of the parameters, whatever the nodes are."""
    space, p = problem.space, problem.scale.size
    observed = sum(int(np.sum(np.isfinite(x))) for x in jax.tree.leaves(problem.data))
    left = fit.residual[: fit.residual.size - problem.gaps]
    unknown = p + problem.nodes.shape[1]  # the first node; others follow from it
    noise = float(np.sqrt(left @ left / max(observed - unknown, 1)))
    s, V = _told(fit.jacobian[:, :p], fit.jacobian[:, p:], tolerance)
    s = s / (1 if known else max(noise, np.finfo(float).tiny))
    y = space.split(jnp.asarray(fit.z[:p], problem.scale.dtype) * problem.scale)
    return Identified(
        params=space.decode(y),
        errors=_errors(space, y, _deviations(s, V, tolerance) * np.asarray(problem.scale)),
        nodes=problem.restore(fit.z[p:]),
        noise=noise,
        observed=observed,
        names=_scalars(space),
        singular_values=s,
        directions=V,
        costs=fit.costs,
        stopped=fit.stopped,
    )


def _told(own: np.ndarray, others: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Singular values and directions of what residuals say of some unknowns whatever the others."""
    Q, _ = np.linalg.qr(others)
    own = own - Q @ (Q.T @ own)
    full = np.concatenate([own, np.zeros((own.shape[1], own.shape[1]))])  # never fewer rows
    _, s, V = np.linalg.svd(full, full_matrices=False)
    largest = np.take_along_axis(V, np.abs(V).argmax(axis=1)[:, None], axis=1)
    V = V * np.sign(largest)
    return np.where(s > tolerance * s[0], s, 0), V


def _deviations(s: np.ndarray, V: np.ndarray, tolerance: float) -> np.ndarray:
    """(Σ (v / s)²)^½ of each unknown; infinite where it has a share in what is not told."""
    shares = np.abs(V) > tolerance
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(np.sum(np.where(shares, V / s[:, None], 0) ** 2, axis=0))


def _errors(space: Space, y: tuple[Array, ...], deviations: np.ndarray) -> PyTree:
    """Standard deviations like the parameters; d x = x d log x for positive ones."""
    own = space.split(jnp.asarray(deviations, y[0].dtype))
    factors = [jnp.exp(z) if p else 1.0 for z, p in zip(y, space.positive, strict=True)]
    nothing = [None if x is None else jnp.nan for x in space.fixed]
    return dataclasses.replace(space, fixed=tuple(nothing)).fill(
        [d * f for d, f in zip(own, factors, strict=True)]
    )


def _scalars(space: Space) -> tuple[str, ...]:
    """A name for each number."""
    names = []
    for name, low in zip(space.names, space.low, strict=True):
        for index in np.ndindex(low.shape):
            names.append(name + (str(list(index)) if index else ""))
    return tuple(names)
