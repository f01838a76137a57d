"""Identification: estimates the parameters of a model, with uncertainty, from recorded motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checkpoint as files
from jaxcon.core import checks
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.learning.attempts import (
    Attempt,
    End,
    remaining,
    remembered,
    searched,
    unexplained,
)
from jaxcon.learning.information import deviations, singular_directions
from jaxcon.learning.least_squares import CONVERGED
from jaxcon.learning.leaves import Bounds, Space, is_searched, space_of
from jaxcon.learning.starts import check_key, scattered
from jaxcon.learning.stretches import Stretches

VAGUE = 1.0
"""A direction is undetermined if its standard deviation, in relative change, is at least this."""

ALIKE = 1e-2
"""The relative difference of costs below which two starts count as equally good."""


@dataclass(frozen=True)
class Identified:
    """The parameters estimated by `identify`, with their uncertainty; `print` it for a summary.

    A direction is a combination of relative changes of parameters. The relative change of a
    positive parameter x is the change of log x. For another parameter, the change is divided by its
    initial or final magnitude, whichever is larger. This divisor is at least 1 for a parameter that
    starts within √ε of 0.

    The singular values s are those of the Jacobian ∂(residuals / noise)/∂(relative changes). Hence
    1/s is the standard deviation of the estimate along the direction (the Cramér–Rao bound).

    Attributes:
        params: the parameters, in the structure of the start.
        errors: standard deviations of the parameters, in the same structure and units. Infinite for
            parameters that the data do not determine. NaN for constant leaves, for parameters on a
            bound, and if the noise is unknown. The values of parameters on a bound are taken as
            exact.
        nodes: the estimated initial states of the segments, in the structure of `nodes=`; None
            without nodes.
        noise: root mean square residual per degree of freedom. It is relative to the given noise,
            so that 1 is expected. If no noise was given, it is in units of the data. NaN without
            degrees of freedom.
        observed: number of data that are not NaN.
        names: names of the n estimated numbers, such as "mass[2]".
        bounded: names of the numbers on a bound.
        singular_values: singular values, largest first, (k,), for the k numbers that are not on a
            bound.
        directions: the unit vectors of the singular values, as rows, (k, n).
        costs: ½ ‖r‖² at the start and after each step of the last fit, which uses all data and the
            final continuity.
        ends: final ½ ‖r‖² from each start, (restarts,). Residuals r are divided by the given noise,
            or in units of the data. Infinite for starts with non-finite residuals.
        stopped: the reason why the search ended, as text. "converged" means a minimum whose
            residuals are at most twice the noise. The noise is the given one, or is estimated from
            differences between neighboring residuals. For any other minimum, the text warns that
            it is local or that the model is incomplete. Residuals below √ε of the data count as
            noise.
    """

    params: Any
    errors: Any
    nodes: Any
    noise: float
    observed: int
    names: tuple[str, ...]
    bounded: tuple[str, ...]
    singular_values: np.ndarray
    directions: np.ndarray
    costs: np.ndarray
    ends: np.ndarray
    stopped: str

    @property
    def table(self) -> dict[str, tuple[float, float]]:
        """Each estimated number with its standard deviation, by name."""
        leaves = zip(jax.tree.leaves(self.params), jax.tree.leaves(self.errors), strict=True)
        searched = [(np.ravel(x), np.ravel(e)) for x, e in leaves if is_searched(x)]
        values, errors = (np.concatenate(x) for x in zip(*searched, strict=True))
        rows = zip(self.names, values, errors, strict=True)
        return {name: (float(x), float(e)) for name, x, e in rows}

    @property
    def converged(self) -> bool:
        """True if the search ended at a minimum and noise explains the residuals; see `stopped`."""
        return self.stopped == CONVERGED

    @property
    def condition(self) -> float:
        """The condition number of JᵀJ, (s₁/sₖ)²; NaN if every parameter is on a bound."""
        s = self.singular_values
        with np.errstate(divide="ignore", invalid="ignore"):
            return float((s[0] / s[-1]) ** 2) if s.size else np.nan

    @property
    def untold(self) -> list[dict[str, float]]:
        """The directions that the data do not determine, each as {parameter name: component}.

        Components of at most 0.05 are left out.
        """
        rows = self.directions[self.singular_values <= 1 / VAGUE]
        return [
            {name: float(x) for name, x in zip(self.names, row, strict=True) if abs(x) > 0.05}
            for row in rows
        ]

    def __str__(self) -> str:
        count = len(self.names)
        head = f"{count} parameter{'s' * (count > 1)} from {self.observed} numbers,"
        lines = [f"{head} {len(self.costs) - 1} steps: {self.stopped}"]
        for name, (x, e) in self.table.items():
            error = ", on its bound" if name in self.bounded else f" ± {e:.2g}"
            lines.append(f"  {name or 'the parameter'} = {x:.6g}{error}")
        if self.ends.size > 1:
            close = np.sum(self.ends <= (1 + ALIKE) * np.min(self.ends))
            lines.append(f"the best of {self.ends.size} starts, {close} of which ended alike")
        if np.isnan(self.noise):
            lines.append("no degree of freedom is left to tell the noise")
        else:
            lines.append(f"noise {self.noise:.3g}, cond(JᵀJ) = {self.condition:.1e}")
        for row in self.untold:
            change = " ".join(f"{x:+.2f} {name or 'of it'}" for name, x in row.items())
            lines.append(f"the data do not tell the relative change {change}")
        if not self.untold and not np.isnan(self.noise):
            off = " that is off its bounds" if self.bounded else ""
            lines.append(f"the data tell every parameter{off}")
        return "\n".join(lines)


def identify(
    simulate: Callable[..., PyTree],
    params: PyTree,
    data: PyTree,
    *,
    noise: PyTree = None,
    positive: PyTree = (),
    bounds: Bounds = None,
    nodes: PyTree = None,
    continuity: float = 1e-3,
    steps: int = 50,
    restarts: int = 1,
    spread: Scalar | Mapping[str, Scalar] = 0.0,
    key: Array | None = None,
    checkpoint: str | Path | None = None,
    progress: bool | None = None,
) -> Identified:
    """Fits the parameters of a simulation to recorded data, by damped Gauss–Newton steps.

    Minimizes Σ ((simulate(params) − data) / noise)², with derivatives by forward mode. It is
    suitable for up to some tens of parameters. For more, use `jc.tune` with
    `jc.learning.losses.tracking`.

    The fit of a long oscillation has local minima. If the residuals exceed the noise, a second fit
    begins at the same start and covers longer and longer parts of the recording. The better fit is
    returned. The longest axis of each leaf of the data is taken as time.

    For long or chaotic recordings, use multiple shooting: cut the recording into segments, called
    stretches. The initial state of each stretch, called its node, is estimated too. The end of each
    stretch must match the next node.

    A keyboard interrupt or a machine error stops the search, and the best result so far is
    returned.

    Args:
        simulate: function from params to predictions of the data. With nodes, a function from
            (params, node) to the predictions for one stretch and its end state, in the structure of
            a node. Predictions should be NaN after a failure; see
            `jc.learning.losses.unless_failed`.
        params: the initial parameters; leaves as in `jc.tune`.
        data: the recorded data, in the structure of the predictions; NaN or masked where missing.
            With nodes, all leaves have a first axis of stretches.
        noise: standard deviation of the data: a number, or a pytree whose leaves broadcast to those
            of the data. By default it is estimated from the residuals.
        positive: parameters that must stay positive; see `jc.tune`.
        bounds: bounds of the parameters; see `jc.tune`.
        nodes: initial guesses of the nodes, with a first axis of stretches. Use minimal coordinates
            such as angles and rates, so that any values are a valid state.
        continuity: allowed standard deviation between the end of a stretch and the next node, in
            units of the node.
        steps: maximum number of steps of each fit. With nodes, there is one fit for each factor of
            ten by which the gaps between stretches shrink. Without nodes, there is one fit for each
            part of the recording.
        restarts: number of starts, run in one batch. The first start is `params`. All starts have
            the same nodes.
        spread: standard deviation of the random starts around `params`; see `jc.tune`.
        key: random key for the random starts.
        checkpoint: path of a file that is written after each step. If it exists, the search resumes
            from it and gives the same numbers as an uninterrupted search. Without nodes, `steps`
            may be increased.
        progress: True shows a progress bar, False none; None shows one in terminals and notebooks.

    Returns:
        An `Identified`, from the start with the smallest sum of squares.

    Raises:
        ValueError: predictions, data and noise do not fit each other; a name is unknown; the
            initial parameters are out of bounds; the residuals are finite at no start; or the
            checkpoint belongs to another search or cannot be written.
        TypeError: `simulate` is not a function, or has a wrong signature.

    References:
        Bock, Recent advances in parameter identification techniques for ODE (1983). Nocedal,
        Wright, Numerical Optimization (2006), section 10.3.
    """
    checks.count("identify", "steps", steps)
    checks.count("identify", "restarts", restarts)
    checks.check("identify", "continuity", continuity, (), above=0)
    check_key(key, restarts > 1, "identify")
    file = None if checkpoint is None else files.path(checkpoint, "identify")
    for x in jax.tree.leaves(noise):
        checks.check("identify", "noise", x, above=0)
    if progress is not None:
        checks.flag("identify", "progress", progress)
    _check_nodes(nodes)
    if isinstance(simulate, type):
        raise TypeError(f"identify: simulate must be a function, got the class {simulate!r}.")
    given = ("params",) if nodes is None else ("params", "node")
    checks.takes("identify", "simulate", simulate, given, " with nodes" * (nodes is not None))
    if not jax.tree.leaves(data):
        raise ValueError(f"identify: data hold no array, got {data!r}.")
    data = jax.tree.map(lambda x: checks.recorded("identify", "data", x), data)
    space = space_of(params, positive, bounds, "identify")
    start = space.encode(params)
    batch = scattered(space, start, restarts, spread, key, "identify")
    problem = Stretches(simulate, space, _scale(space, space.flatten(start)), data, noise, nodes)
    if not problem.observed:
        raise ValueError("identify: the data are NaN throughout: no number was seen.")
    starts = np.asarray(jax.vmap(space.flatten)(batch) / problem.scale[None])
    searches = [Attempt(problem, x, continuity, steps) for x in starts]
    save = remembered(problem, searches, file) if file is not None else lambda: None
    ends = searched(problem, searches, save, progress)
    costs = np.array([np.inf if end is None else end.cost for end in ends])
    best = ends[int(np.argmin(costs))]
    assert best is not None
    return _report(problem, best, continuity, costs)


def _check_nodes(nodes: PyTree) -> None:
    """Checks the initial guesses of the nodes.

    Raises:
        ValueError: the nodes are not arrays of finite real numbers with a common first axis.
    """
    leaves = [jnp.asarray(checks.check("identify", "nodes", x)) for x in jax.tree.leaves(nodes)]
    if nodes is not None and not leaves:
        raise ValueError(f"identify: nodes={nodes!r} hold no array; leave them out to have none.")
    real = all(x.ndim and jnp.issubdtype(x.dtype, jnp.floating) for x in leaves)
    if not real or len({x.shape[:1] for x in leaves}) > 1:
        given = [f"{x.dtype} {x.shape}" for x in leaves]
        raise ValueError(
            "identify: nodes must be arrays of floating numbers with one first axis of stretches,"
            f" got {', '.join(given)}."
        )


def _scale(space: Space, y: Array) -> Array:
    """Returns the divisors of search coordinates y: 1 for logarithms and near 0, otherwise |y|."""
    near_zero = jnp.abs(y) <= float(jnp.finfo(y.dtype).eps) ** 0.5
    return jnp.where(space.logarithms | near_zero, 1, jnp.abs(y))


def _report(problem: Stretches, end: End, continuity: float, ends: np.ndarray) -> Identified:
    """Converts the best fit to an `Identified`.

    The standard deviations of the parameters include the uncertainty of the nodes.

    Args:
        problem: the least-squares problem of the recording.
        end: the final fit of the best start.
        continuity: allowed standard deviation of the gaps, as in `identify`.
        ends: final costs of all starts, as in `Identified`.
    """
    fit, noise = end
    space, scale, p = problem.space, np.asarray(problem.scale), problem.scale.size
    precision, free = problem.data_precision(noise), fit.free[:p]
    J = problem.condensed(fit.jacobian, continuity)
    left = remaining(problem, fit, J, noise)
    unit = np.where(space.logarithms, 1, np.maximum(np.abs(fit.z[:p]), 1))
    s, V = singular_directions(J[:, :p][:, free], J[:, p:], unit[free], precision)
    if problem.noise is None:
        # even data that are fitted exactly have rounding errors
        left = float(np.maximum(left, problem.rounding / noise))
        with np.errstate(divide="ignore"):
            s = np.where(s > 0, s / left, 0)
    y = space.split(jnp.asarray(fit.z[:p] * scale, problem.scale.dtype))
    deviation = np.full(p, np.nan)
    deviation[free] = deviations(s, V, precision.tolerance) * (unit * scale)[free]
    names, directions = _scalars(space), np.zeros((len(s), p))
    directions[:, free] = V
    return Identified(
        params=space.decode(y),
        errors=_errors(space, y, deviation),
        nodes=problem.restore(fit.z[p:]),
        noise=left * (noise if problem.noise is None else 1.0),
        observed=problem.observed,
        names=names,
        bounded=tuple(name for name, off in zip(names, free, strict=True) if not off),
        singular_values=s,
        directions=directions,
        costs=fit.costs,
        ends=ends,
        stopped=_stopped(problem, end),
    )


def _stopped(problem: Stretches, end: End) -> str:
    """Returns why the search ended, with a warning if noise cannot explain the residuals."""
    fit, noise = end
    if fit.broken or not unexplained(problem, end):
        return fit.stopped
    share, excess = problem.share(fit.residual, noise), problem.excess(fit.residual)
    reason = "at a minimum" if fit.stopped == CONVERGED else fit.stopped
    what = "the noise given" if problem.noise is not None else "the noise seen between neighbors"
    return (
        f"{reason}, but the residuals, {share:.2g} of the data, are {excess:.2g} times {what}: this"
        " is a local minimum, or the model lacks something. Try other starts (restarts=, spread=)"
        f" or {'other' if problem.gaps else 'shorter stretches by'} nodes="
    )


def _errors(space: Space, y: tuple[Array, ...], deviations: np.ndarray) -> PyTree:
    """Returns standard deviations in the structure of the parameters.

    The search coordinate of a positive parameter x is log x, so its deviation is multiplied by x.

    Args:
        space: map between parameters and search coordinates.
        y: the final search coordinates.
        deviations: standard deviations of y, (n,).
    """
    leaves = space.split(jnp.asarray(deviations, y[0].dtype))
    factors = [jnp.exp(z) if p else 1.0 for z, p in zip(y, space.positive, strict=True)]
    unknown = [None if x is None else np.full(np.shape(x), np.nan) for x in space.fixed]
    errors = [jnp.where(jnp.isinf(d), d, d * f) for d, f in zip(leaves, factors, strict=True)]
    return dataclasses.replace(space, fixed=tuple(unknown)).fill(errors)


def _scalars(space: Space) -> tuple[str, ...]:
    """Returns the name of each searched number, such as "mass[2]"."""
    names = []
    for name, low in zip(space.names, space.low, strict=True):
        for index in np.ndindex(low.shape):
            names.append(name + (str(list(index)) if index else ""))
    return tuple(names)
