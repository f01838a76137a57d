"""Numbers of a model from recordings of its motion, and what the recordings do not tell."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checkpoint as files
from jaxcon.core import checks
from jaxcon.core.typing import Array, PyTree
from jaxcon.learning.attempts import (
    Attempt,
    End,
    remaining,
    remembered,
    searched,
    unexplained,
)
from jaxcon.learning.information import deviations, told
from jaxcon.learning.least_squares import CONVERGED
from jaxcon.learning.leaves import Space, is_searched, space_of
from jaxcon.learning.starts import check_key, scattered
from jaxcon.learning.stretches import Stretches

VAGUE = 1.0
"""Standard deviation of a relative change above which it is not identified: a factor of e."""

ALIKE = 1e-2
"""Relative difference of costs below which two starts ended alike."""


@dataclass(frozen=True)
class Identified:
    """Parameters with what is known of them; `print` it.

    A direction is a combination of relative changes: of log x for positive parameters, of others by
    their size, found or at the start, whichever is larger. A start within √ε of 0 counts as 0, and
    what starts at 0 has the size 1 at least. Singular values are those of the residuals by noise,
    σ = 1, along them, so that 1/s is the standard deviation of the estimate there (Cramér and Rao's
    bound).

    Attributes:
        params: like those given.
        errors: their standard deviations, in the same structure and units; infinite where the data
            tell nothing; NaN where a leaf was not searched, where a parameter lies on its bound,
            and where nothing tells the noise. Those of others hold if it belongs on its bound.
        nodes: the states at the nodes, as they were given; None without.
        noise: what remains, its root mean square by degree of freedom: in units of the noise that
            was given, so that 1 is as expected, or in those of the data where none was. NaN where
            no degree of freedom is left.
        observed: how many numbers were seen.
        names: of the parameters, one by one.
        bounded: the names of those that lie on their bounds.
        singular_values: largest first, (n,), n parameters being off their bounds.
        directions: of unit length by all parameters, a row for each singular value.
        costs: ½ ‖r‖² by step; of the last search, with all data and the continuity asked for.
        ends: ½ ‖r‖² where each start ended, in units of the noise that was given, or of the data;
            infinite where it could not begin, (restarts,).
        stopped: why it went no further, in words. "converged" is a minimum whose residuals are at
            most twice the noise, the one given or else the one seen between neighbors. Any other
            minimum is called local. A residual that is less than √ε of the data counts as noise.
    """

    params: PyTree
    errors: PyTree
    nodes: PyTree
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
        """Each number that was searched with its standard deviation, by name."""
        leaves = zip(jax.tree.leaves(self.params), jax.tree.leaves(self.errors), strict=True)
        found = [(np.ravel(x), np.ravel(e)) for x, e in leaves if is_searched(x)]
        values, errors = (np.concatenate(x) for x in zip(*found, strict=True))
        pairs = zip(values, errors, strict=True)
        return {name: (float(x), float(e)) for name, (x, e) in zip(self.names, pairs, strict=True)}

    @property
    def converged(self) -> bool:
        """True at a minimum whose residuals are no larger than noise, if that can be judged."""
        return self.stopped == CONVERGED

    @property
    def condition(self) -> float:
        """cond(JᵀJ) = (s₁/sₙ)²; NaN where every parameter lies on a bound."""
        s = self.singular_values
        with np.errstate(divide="ignore", invalid="ignore"):
            return float((s[0] / s[-1]) ** 2) if s.size else np.nan

    @property
    def untold(self) -> list[dict[str, float]]:
        """Directions that the data do not tell, each by the share of each parameter."""
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
    restarts: int = 1,
    spread: Any = 0.0,
    key: Any = None,
    checkpoint: str | Path | None = None,
    progress: bool | None = None,
) -> Identified:
    """The parameters whose simulation is nearest to a recording, by damped Gauss–Newton steps.

    argmin Σ ((simulate(params) − data) / noise)², with derivatives in forward mode: for up to some
    tens of parameters. For more, `tune` a loss by `losses.tracking`.

    A fit of a long oscillation has local minima. If the residuals exceed their noise, a second fit
    goes from the start through longer and longer parts of the recording. The better one counts.
    Time is taken to be the longest axis of each leaf of the data.

    Recordings longer than the motion can be foreseen, or so long that the least of the sum is hard
    to reach, are cut into stretches (multiple shooting). Their first states, the nodes, are unknown
    too, and the end of each stretch must meet the next node.

    Args:
        simulate: params → predictions; with nodes (params, node) → predictions of one stretch and
            its end, in the structure of a node. Trouble on the way should show as NaN
            (`losses.unless_failed`).
        params: the start; leaves as of `tune`.
        data: what was recorded, in the structure of the predictions, NaN or masked where nothing
            was seen; with nodes an axis of stretches comes first.
        noise: standard deviation of the data, a number or a pytree whose leaves broadcast to those
            of the data; estimated from what remains unless given.
        positive: as of `tune`.
        bounds: as of `tune`.
        nodes: first guesses of the states at the nodes, with a first axis of stretches. Minimal
            coordinates, such as angles and rates, so that every value is a state.
        continuity: standard deviation by which an end may miss the next node, in its units.
        steps: at most so many for each fit; with nodes there is one for each decade by which ends
            come closer to them, and without one for each part of the recording.
        restarts: how many starts are searched in one batch; the first is the one given, and all
            have the same nodes.
        spread: as of `tune`, of the parameters of other starts.
        key: of random numbers for them.
        checkpoint: a file that is written after each step. Where it exists the search goes on from
            it, with the very numbers of a search that was not interrupted. Without nodes more steps
            may be asked of it.
        progress: whether a bar is shown; None is in terminals and notebooks.

    An interrupt from the keyboard, or an error of the machine, ends the search with what was found.

    Returns:
        An `Identified`, of the start that led to the least.

    Raises:
        ValueError: predictions, data and noise do not fit, unknown names, a start out of its
            bounds, residuals that are finite at no start, or a checkpoint of another search, or
            where none can be written.
        TypeError: `simulate` is no function, or one of other arguments.

    References:
        Bock, Recent advances in parameter identification techniques for ODE (1983).
        Nocedal, Wright, Numerical Optimization (2006), section 10.3.
    """
    checks.count("identify", "steps", steps)
    checks.count("identify", "restarts", restarts)
    checks.check("identify", "continuity", continuity, (), above=0)
    check_key(key, restarts > 1, "identify")
    file = None if checkpoint is None else files.path(checkpoint, "identify")
    for x in jax.tree.leaves(noise):
        checks.check("identify", "noise", x, above=0)
    _check_nodes(nodes)
    if isinstance(simulate, type):
        raise TypeError(f"identify: simulate must be a function, got the class {simulate!r}.")
    given = ("params",) if nodes is None else ("params", "node")
    checks.takes("identify", "simulate", simulate, given, " with nodes" * (nodes is not None))
    if not jax.tree.leaves(data):
        raise ValueError(f"identify: data hold no array, got {data!r}.")
    data = jax.tree.map(lambda x: checks.recorded("identify", "data", x), data)
    space = space_of(params, positive, bounds, "identify")
    own = space.encode(params)
    batch = scattered(space, own, restarts, spread, key, "identify")
    problem = Stretches(simulate, space, _scale(space, space.flatten(own)), data, noise, nodes)
    if not problem.observed:
        raise ValueError("identify: the data are NaN throughout: no number was seen.")
    starts = np.asarray(jax.vmap(space.flatten)(batch) / problem.scale[None])
    searches = [Attempt(problem, x, continuity, steps) for x in starts]
    save = remembered(problem, searches, file) if file is not None else _ignore
    found = searched(problem, searches, save, progress)
    ends = np.array([np.inf if end is None else end.cost for end in found])
    best = found[int(np.argmin(ends))]
    assert best is not None
    return _report(problem, best, continuity, ends)


def _check_nodes(nodes: PyTree) -> None:
    """Checks that there is one first guess for each stretch.

    Raises:
        ValueError: they are no arrays of real and finite numbers with one first axis.
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


def _ignore() -> None:
    """Does nothing: no checkpoint was asked for."""


def _scale(space: Space, y: Array) -> Array:
    """Divisors of coordinates: 1 for logarithms and for starts near 0, else |y|."""
    none = jnp.abs(y) <= float(jnp.finfo(y.dtype).eps) ** 0.5
    return jnp.where(space.logarithms | none, 1, jnp.abs(y))


def _report(problem: Stretches, end: End, continuity: float, ends: np.ndarray) -> Identified:
    """The result of the best fit, with errors of parameters for free nodes.

    Args:
        problem: the recording.
        end: of the best start.
        continuity: as of `identify`.
        ends: as of `Identified`.
    """
    fit, own = end
    space, scale, p = problem.space, np.asarray(problem.scale), problem.scale.size
    precision, free = problem.told(own), fit.free[:p]
    J = problem.condensed(fit.jacobian, continuity)
    left = remaining(problem, fit, J, own)
    unit = np.where(space.logarithms, 1, np.maximum(np.abs(fit.z[:p]), 1))
    s, V = told(J[:, :p][:, free], J[:, p:], unit[free], precision)
    if problem.noise is None:
        left = float(np.maximum(left, problem.rounding / own))  # of data that are met exactly, too
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
        noise=left * (own if problem.noise is None else 1.0),
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
    """The reason for the end, and a warning if noise does not explain the residuals."""
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
    """Standard deviations like the parameters; d x = x d log x for positive ones."""
    own = space.split(jnp.asarray(deviations, y[0].dtype))
    factors = [jnp.exp(z) if p else 1.0 for z, p in zip(y, space.positive, strict=True)]
    nothing = [None if x is None else np.full(np.shape(x), np.nan) for x in space.fixed]
    errors = [jnp.where(jnp.isinf(d), d, d * f) for d, f in zip(own, factors, strict=True)]
    return dataclasses.replace(space, fixed=tuple(nothing)).fill(errors)


def _scalars(space: Space) -> tuple[str, ...]:
    """A name for each number."""
    names = []
    for name, low in zip(space.names, space.low, strict=True):
        for index in np.ndindex(low.shape):
            names.append(name + (str(list(index)) if index else ""))
    return tuple(names)
