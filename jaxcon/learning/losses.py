"""What may be made small: functions of what a rollout recorded, to be added as they are.

    def record(s, i):
        return jc.position(system, s, "foot"), i.violation, jc.energy(system, s)

    final, (foot, off, energy) = jc.rollout(system, method, state, None, dt, steps, record=record)
    loss = losses.tracking(foot, wanted) + 0.1 * losses.energy_drift(energy)

`tracking` and `mean_violation` are means, over worlds too where a batch was recorded.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Violation
from jaxcon.core import checks, numerics
from jaxcon.core.status import failed
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import Energy, State


def tracking(path: PyTree, reference: PyTree, scale: PyTree = 1.0) -> Array:
    """The mean over quantities of ((x − x_ref) / scale)², averaged over time, ().

    Args:
        path: arrays of chosen quantities.
        reference: the same as they should be; NaN or masked where nobody knows.
        scale: of each quantity: a number, or numbers in the structure of the path, or of its first
            levels, that broadcast with it.

    Raises:
        ValueError: path and reference differ in structure or shape, the scale has more numbers, or
            the reference is NaN throughout or of no real numbers.
    """
    reference = _known(reference)
    known = [x for x in jax.tree.leaves(reference) if jnp.size(x)]
    if known and checks.is_concrete(known) and all(np.all(np.isnan(x)) for x in known):
        raise ValueError("tracking: the reference is NaN throughout: there is nothing to track.")
    off = jax.tree.leaves(misfit(path, reference, scale))
    means = [
        jnp.sum(x * x) / jnp.maximum(jnp.sum(~jnp.isnan(wanted), dtype=x.dtype), 1)
        for x, wanted in zip(off, jax.tree.leaves(reference), strict=True)
    ]
    return jnp.mean(jnp.stack(means))


def misfit(path: PyTree, reference: PyTree, scale: PyTree = 1.0) -> PyTree:
    """(x − x_ref) / scale, and 0 where the reference is NaN.

    Args:
        path: arrays of chosen quantities.
        reference: the same as they should be; NaN or masked where nobody knows.
        scale: of each quantity, as of `tracking`.

    Raises:
        ValueError: path and reference differ in structure or shape, the scale has more numbers, or
            the reference is of no real numbers.
    """
    reference = _known(reference)
    shapes = [jnp.shape(x) for x in jax.tree.leaves(path)]
    given = [jnp.shape(x) for x in jax.tree.leaves(reference)]
    if jax.tree.structure(path) != jax.tree.structure(reference) or shapes != given:
        raise ValueError(
            f"what is simulated, {checks.described(path)}, must have the structure and shapes of"
            f" what it is compared with, {checks.described(reference)}."
        )
    try:
        widths = jax.tree.broadcast(scale, path)
    except ValueError as error:
        raise ValueError(
            f"a scale must have the structure of what it scales, {checks.described(path)}, or of"
            f" its first levels, got {checks.described(scale)}."
        ) from error

    def off(x: Any, wanted: Any, width: Any) -> Array:
        shape, own = jnp.shape(x), jnp.shape(width)
        if not checks.fits(own, shape):
            raise ValueError(
                f"a scale of shape {own} does not broadcast to what it scales, {shape}."
            )
        wanted = jnp.asarray(wanted, x.dtype)
        width = jnp.broadcast_to(jnp.asarray(width, x.dtype), shape)
        seen = ~jnp.isnan(wanted)
        return jnp.where(seen, (x - jnp.where(seen, wanted, 0)) / width, 0)

    return jax.tree.map(off, path, reference, widths)


def _known(reference: PyTree) -> PyTree:
    """A reference of real numbers, NaN where it is masked."""
    return jax.tree.map(lambda x: checks.recorded("losses", "a reference", x), reference)


def violation(off: Violation, dt: Any) -> Array:
    """log₁₀ of the root mean square of (φ, h φ̇) over rows and time, () [m].

    For what should be as small as can be: no weight makes it matter less as it falls. Beside a
    task, `mean_violation` does.

    Args:
        off: `info.violation` of each step.
        dt: h, () [s].

    Raises:
        ValueError: the scene has no rows.
    """
    square = mean_violation(off, dt)
    return jnp.log10(jnp.maximum(square, jnp.finfo(square.dtype).tiny)) / 2


def mean_violation(off: Violation, dt: Any) -> Array:
    """The mean square of (φ, h φ̇) over rows and time, () [m²].

    φ is the error now, h φ̇ the one that it is about to grow by.

    Args:
        off: `info.violation` of each step.
        dt: h, () [s].

    Raises:
        ValueError: the scene has no rows.
        TypeError: it is no `Violation`.
    """
    _check("mean_violation", "off", off, Violation, "info.violation of the recorded steps")
    if not off.position.size:
        raise ValueError("losses: the scene has no constraints that could be violated.")
    h = checks.real("mean_violation", "dt", dt, off.velocity.dtype)
    return jnp.mean(off.position**2) + jnp.mean((h * off.velocity) ** 2)


def energy_drift(energy: Energy, scale: Any = None) -> Array:
    """The root mean square over time of (E − E₀) / scale, ().

    Args:
        energy: of each recorded state, its first axis time.
        scale: [J]; the largest kinetic energy unless given: give one where nothing may move.

    Raises:
        TypeError: it is no `Energy`.
    """
    _check("energy_drift", "energy", energy, Energy, "jc.energy(system, state) of recorded states")
    checks.check("energy_drift", "scale", scale, above=0, optional=True)
    scale = jnp.max(energy.kinetic) if scale is None else scale
    change = (energy.total - energy.total[:1]) / scale
    return numerics.safe_sqrt(jnp.mean(change**2))


def weighted(terms: Mapping[str, Array], weights: Mapping[str, Any]) -> tuple[Any, Any]:
    """Σ weight · term, and the terms themselves, as `tune` takes a loss and what goes beside it.

    Args:
        terms: numbers by name, () each.
        weights: numbers by the same names.

    Raises:
        ValueError: terms and weights have other names, or a term is no single number.
        TypeError: they have none.
    """
    if not (isinstance(terms, Mapping) and isinstance(weights, Mapping)):
        raise TypeError(
            f"weighted: terms and weights must be numbers by name, as {{'task': 1.0}}, got a"
            f" {type(terms).__name__} and a {type(weights).__name__}."
        )
    if set(terms) != set(weights):
        raise ValueError(f"weights {sorted(weights)} must be named as terms {sorted(terms)}.")
    for name, x in terms.items():
        if jnp.shape(x):
            raise ValueError(
                f"weighted: term '{name}' must be one number, got shape {jnp.shape(x)}; take a mean"
                " or a sum of it."
            )
    return sum((weights[name] * x for name, x in terms.items()), start=0.0), dict(terms)


def unless_failed(x: PyTree, state: Any) -> PyTree:
    """x, and NaN in its place where a world has failed, so that no search goes there.

    A world that failed keeps its last finite state, and what follows from that looks like any
    number.

    Args:
        x: a loss, or predictions. Of a batch, what has its axes first is NaN for the worlds that
            failed; what does not, such as a mean over worlds, is NaN if one of them has.
        state: the final one, of a world or a batch.

    Raises:
        TypeError: it is no `State`.
    """
    _check("unless_failed", "state", state, State, "the state in which a rollout ended")
    bad = failed(state.status)

    def one(y: Any) -> Array:
        own = jnp.shape(y)[: bad.ndim] == bad.shape
        axes = (*bad.shape, *(1,) * (jnp.ndim(y) - bad.ndim))
        lost = jnp.reshape(bad, axes) if own else jnp.any(bad)
        return jnp.where(lost, jnp.nan, y)

    return jax.tree.map(one, x)


def _check(owner: str, what: str, x: Any, kind: type, meant: str) -> None:
    """Checks that an argument is what a rollout gave.

    Raises:
        TypeError: it is of another type.
    """
    if not isinstance(x, kind):
        raise TypeError(f"losses.{owner}: {what} must be {meant}, got {type(x).__name__}.")
