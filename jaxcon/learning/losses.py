"""Loss terms: functions of the quantities that a rollout records. Their sum is a loss.

    def record(s, i):
        return jc.position(system, s, "foot"), i.violation, jc.energy(system, s)

    final, (foot, off, energy) = jc.rollout(system, method, state, None, dt, steps, record=record)
    loss = losses.tracking(foot, wanted) + 0.1 * losses.energy_drift(energy)

`tracking` and `mean_violation` are means. For a batch they also average over worlds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Violation
from jaxcon.core import checks, numerics
from jaxcon.core.status import failed
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.system.state import Energy, State

_T = TypeVar("_T")

__all__ = [
    "tracking",
    "misfit",
    "violation",
    "mean_violation",
    "energy_drift",
    "weighted",
    "unless_failed",
]


def __dir__() -> list[str]:
    """Lists the public names of this namespace."""
    return [*__all__]


def tracking(path: PyTree, reference: PyTree, scale: PyTree = 1.0) -> Array:
    """Returns the mean square tracking error (x − x_ref) / scale over quantities and times, ().

    Args:
        path: the recorded quantities x, a pytree of arrays.
        reference: the target values x_ref, in the same structure; NaN or masked where unknown.
        scale: divisor of each quantity: a number, or a pytree whose structure is that of `path` or
            a prefix of it. Its leaves must broadcast to those of `path`.

    Raises:
        ValueError: path and reference differ in structure or shape, one of them is not real, the
            reference is all NaN, or the scale is not positive or does not broadcast.
    """
    reference = _known(reference)
    targets = [x for x in jax.tree.leaves(reference) if jnp.size(x)]
    if targets and checks.is_concrete(targets) and all(np.all(np.isnan(x)) for x in targets):
        raise ValueError("tracking: the reference is NaN throughout: there is nothing to track.")
    off = jax.tree.leaves(misfit(path, reference, scale))
    means = [
        jnp.sum(x * x) / jnp.maximum(jnp.sum(~jnp.isnan(wanted), dtype=x.dtype), 1)
        for x, wanted in zip(off, jax.tree.leaves(reference), strict=True)
    ]
    return jnp.mean(jnp.stack(means))


def misfit(path: PyTree, reference: PyTree, scale: PyTree = 1.0) -> PyTree:
    """Returns the scaled errors (x − x_ref) / scale by quantity and time; 0 where x_ref is NaN.

    Args:
        path: the recorded quantities x, a pytree of arrays.
        reference: the target values x_ref, in the same structure; NaN or masked where unknown.
        scale: divisor of each quantity; see `tracking`.

    Raises:
        ValueError: path and reference differ in structure or shape, one of them is not real, or
            the scale is not positive or does not broadcast.
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

    def leaf_misfit(x: Array, target: Scalar, width: Scalar) -> Array:
        """Returns (x − target) / width of one leaf; 0 where the target is NaN."""
        checks.numbers("losses", "what is simulated", x)
        checks.check("losses", "a scale", width, above=0, finite=False)
        shape, given = jnp.shape(x), jnp.shape(width)
        if not checks.fits(given, shape):
            raise ValueError(
                f"a scale of shape {given} does not broadcast to what it scales, {shape}."
            )
        target = jnp.asarray(target, x.dtype)
        width = jnp.broadcast_to(jnp.asarray(width, x.dtype), shape)
        known = ~jnp.isnan(target)
        return jnp.where(known, (x - jnp.where(known, target, 0)) / width, 0)

    return jax.tree.map(leaf_misfit, path, reference, widths)


def _known(reference: PyTree) -> PyTree:
    """Checks that a reference has real numbers, and replaces masked values by NaN."""
    return jax.tree.map(lambda x: checks.recorded("losses", "a reference", x), reference)


def violation(off: Violation, dt: Scalar) -> Array:
    """Returns log₁₀ of the root mean square constraint violation (φ, h φ̇), ().

    The mean is over rows and time; φ is in m, φ̇ in m/s.

    Use it as the only term of a loss: the logarithm weights small and large violations equally. In
    a loss with several terms, use `jc.learning.losses.mean_violation` instead.

    Args:
        off: the recorded `info.violation` of all steps.
        dt: step size h, () [s].

    Raises:
        ValueError: the scene has no constraints, or dt is not positive.
    """
    square = mean_violation(off, dt)
    return jnp.log10(jnp.maximum(square, jnp.finfo(square.dtype).tiny)) / 2


def mean_violation(off: Violation, dt: Scalar) -> Array:
    """Returns the mean square of φ plus the mean square of h φ̇, over rows and time, () [m²].

    φ is the current violation, and h φ̇ its predicted change in the next step.

    Args:
        off: the recorded `info.violation` of all steps.
        dt: step size h, () [s].

    Raises:
        ValueError: the scene has no constraints, or dt is not positive.
        TypeError: `off` is not a `Violation`.
    """
    checks.instance(
        "losses.mean_violation", "off", off, Violation, "info.violation of the recorded steps"
    )
    if not off.position.size:
        raise ValueError("losses: the scene has no constraints that could be violated.")
    h = checks.real("mean_violation", "dt", dt, off.velocity.dtype, above=0)
    return jnp.mean(off.position**2) + jnp.mean((h * off.velocity) ** 2)


def energy_drift(energy: Energy, scale: Scalar | None = None) -> Array:
    """Returns the root mean square energy change (E − E₀) / scale over time, ().

    E is the total energy, and E₀ its first recorded value.

    Args:
        energy: `jc.energy` of the recorded states; its first axis is time.
        scale: energy scale [J]; by default the largest kinetic energy. Pass a scale if the system
            may be at rest.

    Raises:
        TypeError: `energy` is not an `Energy`.
    """
    checks.instance(
        "losses.energy_drift",
        "energy",
        energy,
        Energy,
        "jc.energy(system, state) of recorded states",
    )
    checks.check("energy_drift", "scale", scale, above=0, optional=True)
    scale = jnp.max(energy.kinetic) if scale is None else scale
    change = (energy.total - energy.total[:1]) / scale
    return numerics.safe_sqrt(jnp.mean(change**2))


def weighted(
    terms: Mapping[str, Array], weights: Mapping[str, Array | float]
) -> tuple[Array, dict[str, Array]]:
    """Returns the weighted sum of loss terms, and the terms: the (loss, aux) that `tune` expects.

    Args:
        terms: loss terms by name, () each.
        weights: weights by the same names.

    Raises:
        ValueError: terms and weights have different names, or one is not a single real number.
        TypeError: `terms` or `weights` is not a mapping.
    """
    if not (isinstance(terms, Mapping) and isinstance(weights, Mapping)):
        raise TypeError(
            f"weighted: terms and weights must be numbers by name, as {{'task': 1.0}}, got a"
            f" {type(terms).__name__} and a {type(weights).__name__}."
        )
    if set(terms) != set(weights):
        raise ValueError(f"weights {sorted(weights)} must be named as terms {sorted(terms)}.")
    for name, x in terms.items():
        checks.numbers("weighted", f"term '{name}'", x, "a real number")
        checks.check("weighted", f"the weight of '{name}'", weights[name], ())
        if jnp.shape(x):
            raise ValueError(
                f"weighted: term '{name}' must be one number, got shape {jnp.shape(x)}; take a mean"
                " or a sum of it."
            )
    total: Any = sum((weights[name] * x for name, x in terms.items()), start=0.0)
    return total, dict(terms)


def unless_failed(x: _T, state: State) -> _T:
    """Replaces a loss by NaN in failed worlds, so that a search avoids their parameters.

    A failed world keeps its last finite state. A loss computed from that state would look valid.

    Args:
        x: a loss, or predictions. For a batch, leaves whose first axes are the batch axes become
            NaN in the failed worlds. Other leaves, such as a mean, become NaN if any world has
            failed.
        state: the final state of a world or a batch.

    Raises:
        TypeError: `state` is not a `State`.
    """
    checks.instance(
        "losses.unless_failed", "state", state, State, "the state in which a rollout ended"
    )
    bad = failed(state.status)

    def masked(y: Array) -> Array:
        """Replaces a leaf by NaN in failed worlds."""
        by_world = jnp.shape(y)[: bad.ndim] == bad.shape
        axes = (*bad.shape, *(1,) * (jnp.ndim(y) - bad.ndim))
        mask = jnp.reshape(bad, axes) if by_world else jnp.any(bad)
        return jnp.where(mask, jnp.nan, y)

    return jax.tree.map(masked, x)
