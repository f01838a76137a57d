"""Checks derivatives by reverse and forward mode against finite differences. Host code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import KeyEntry

from jaxcon.analysis import encounters
from jaxcon.analysis.differences import differences, steps, unseen
from jaxcon.core import checks, functions, notices
from jaxcon.core.typing import Array, PyTree

NO_DERIVATIVE = "there plain steps have no derivative that differences could confirm"
"""The end of a note about impacts in a function whose gradient is wrong."""


@dataclass(frozen=True)
class LeafGradient:
    """Directional derivatives of f with respect to one leaf of x, computed in three ways.

    The ways are reverse mode, forward mode and finite differences. Each direction is as long as the
    leaf itself. The derivative is thus the change of f per relative change of the leaf.

    Attributes:
        name: name of the leaf in x.
        reverse, forward, difference: derivatives by direction, (n,).
        uncertainty: estimated uncertainty of the differences, (n,).
        scale: values by which errors are divided to make them relative, (n,).
        tolerance: the largest allowed relative error.
    """

    name: str
    reverse: np.ndarray
    forward: np.ndarray
    difference: np.ndarray
    uncertainty: np.ndarray
    scale: np.ndarray
    tolerance: float

    @property
    def modes_apart(self) -> float:
        """The largest relative difference between forward-mode and reverse-mode derivatives."""
        return self._largest(self.forward - self.reverse)

    @property
    def error(self) -> float:
        """The largest relative distance of reverse or forward mode from the finite differences.

        The uncertainty of the differences is subtracted.
        """
        return self._beyond(self.forward, self.reverse)

    @property
    def undecided(self) -> bool:
        """True if the finite differences are too uncertain to judge the derivatives."""
        return not self._largest(self.uncertainty) <= self.tolerance

    @property
    def agrees(self) -> bool:
        """True if both modes and the differences agree; False if a derivative is NaN."""
        return self.modes_apart <= self.tolerance and self.error <= self.tolerance

    @property
    def ok(self) -> bool:
        """True if the derivatives agree and the differences are accurate enough."""
        return self.agrees and not self.undecided

    def _beyond(self, *modes: np.ndarray) -> float:
        """Returns the largest relative distance of given derivatives from the finite differences.

        The uncertainty of the differences is subtracted.

        Args:
            modes: for each mode, the derivatives by direction, (n,).
        """
        apart = np.maximum.reduce([np.abs(x - self.difference) for x in modes])
        return self._largest(np.maximum(apart - self.uncertainty, 0.0))

    def _largest(self, x: np.ndarray) -> float:
        """Returns the largest absolute value of x, relative to `scale`."""
        return float(np.max(np.abs(x) / self.scale))

    def __str__(self) -> str:
        head = f"{self.name}: the modes differ by {self.modes_apart:.1e},"
        return f"{head} differences by {self.error:.1e}{self._verdict()}"

    def _verdict(self) -> str:
        """Explains why the derivatives are undecided or wrong; empty if they are right."""
        if self.ok:
            return ""
        if self.agrees:
            return (
                f"; UNDECIDED: differences tell no more than {self._largest(self.uncertainty):.1e}"
            )
        apart = np.maximum(*(np.abs(x - self.difference) for x in (self.reverse, self.forward)))
        i = int(np.argmax(apart / self.scale))  # argmax returns the first NaN, if there is one
        return (
            f"; DISAGREES, {self._culprit()}: reverse {self.reverse[i]:.9g},"
            f" forward {self.forward[i]:.9g}, differences {self.difference[i]:.9g}"
        )

    def _culprit(self) -> str:
        """Says which modes (reverse, forward) disagree with the finite differences, as text."""
        modes = self.reverse, self.forward
        reverse, forward = (not self._beyond(mode) <= self.tolerance for mode in modes)
        if reverse and forward:
            return "both modes are off"
        if reverse or forward:
            return f"{'reverse' if reverse else 'forward'} mode is off"
        return "the modes are apart"


@dataclass(frozen=True)
class GradientCheck:
    """The result of a gradient check, by leaf of x; `print` it.

    Attributes:
        leaves: one `LeafGradient` for each leaf with floating-point numbers.
        tolerance: the largest allowed relative error.
        notes: jaxcon's warnings that derivatives of f through some impacts may be wrong with the
            method in use. If a leaf is wrong or undecided, also the simultaneous, grazing or
            accumulating impacts of f at x.
    """

    leaves: tuple[LeafGradient, ...]
    tolerance: float
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """True if all leaves are `ok`: their derivatives agree with accurate differences."""
        return all(leaf.ok for leaf in self.leaves)

    @property
    def error(self) -> float:
        """The largest relative error of all leaves, including differences between the modes."""
        return float(np.max([[leaf.error, leaf.modes_apart] for leaf in self.leaves]))

    @property
    def wrong(self) -> tuple[str, ...]:
        """Names of the leaves whose derivatives disagree or are undecided."""
        return tuple(leaf.name for leaf in self.leaves if not leaf.ok)

    def __str__(self) -> str:
        wrong = [leaf.name for leaf in self.leaves if not leaf.agrees]
        undecided = [leaf.name for leaf in self.leaves if leaf.agrees and leaf.undecided]
        groups = {"wrong for": wrong, "undecided for": undecided}
        verdict = ", ".join(f"{label} {names}" for label, names in groups.items() if names)
        verdict = verdict or "right"
        head = f"gradients to {self.tolerance:.1e}: {verdict}"
        notes = (f"  note, {note}" for note in self.notes)
        return "\n".join([head, *(f"  {leaf}" for leaf in self.leaves), *notes])


def check_gradients(
    f: Callable[[Any], PyTree],
    x: PyTree,
    *,
    tolerance: float | None = None,
    directions: int = 3,
    seed: int = 0,
) -> GradientCheck:
    """Compares derivatives of f at x by reverse mode, forward mode and central differences.

    Each leaf of x is checked separately. In a leaf of up to `directions` numbers, each number is
    varied alone. A larger leaf is varied along `directions` random directions. Central differences
    use ten step sizes: the largest is ε^⅛ times the leaf's size, and each further one is half the
    previous one. Ridders' method extrapolates the differences to step size zero and estimates their
    uncertainty, so no step size needs to be chosen. If f returns several numbers, a random linear
    combination of them is checked.

    Args:
        f: function from x to a number or a pytree of numbers, such as a rollout.
        x: pytree of arguments. Leaves without floating-point numbers, and empty leaves, stay fixed.
        tolerance: the largest allowed relative error, by default ε^⅓ of the coarsest dtype in x and
            f: 6e-6 in float64, 5e-3 in float32. Errors are relative to the derivative itself if a
            single number is varied, else to the largest derivative over all random directions. The
            allowed error is never below the smallest derivative that the differences resolve.
        directions: number of directions per leaf.
        seed: seed of random directions.

    Returns:
        A `jc.analysis.GradientCheck`.

    Raises:
        ValueError: x or f has no floating-point numbers, or has numbers that are not finite.
        TypeError: f is not a function of x alone.

    References:
        Ridders, Accurate computation of F'(x) and F'(x)F''(x), Adv. Eng. Softw. 4 (1982).
    """
    checks.takes("check_gradients", "f", f, ("x",))
    checks.count("check_gradients", "directions", directions)
    checks.count("check_gradients", "seed", seed, 0)
    checks.check("check_gradients", "tolerance", tolerance, (), above=0, optional=True)
    random = np.random.default_rng(seed)
    named = [(_name(path), leaf) for path, leaf in jax.tree.leaves_with_path(x)]
    floating = [i for i, (_, leaf) in enumerate(named) if _is_floating(leaf)]
    if not floating:
        raise ValueError("check_gradients: x has no leaf of floating numbers to differentiate by.")
    structure, all_leaves = jax.tree.structure(x), [leaf for _, leaf in named]

    def at(moved: list[Array]) -> PyTree:
        replaced = dict(zip(floating, moved, strict=True))
        result = functions.call(
            "check_gradients",
            "f",
            f,
            structure.unflatten([replaced.get(i, leaf) for i, leaf in enumerate(all_leaves)]),
        )
        return functions.tree("check_gradients", "f", result)

    here = [jnp.asarray(all_leaves[i]) for i in floating]
    for i, leaf in zip(floating, here, strict=True):
        checks.check("check_gradients", f"x.{named[i][0]}" if named[i][0] != "x" else "x", leaf)
    results = [y for y in jax.tree.leaves(jax.eval_shape(at, here)) if _is_floating(y)]
    if not results:
        raise ValueError("check_gradients: f returns no floating number to differentiate.")
    eps = max(float(jnp.finfo(y.dtype).eps) for y in [*here, *results])
    ways = [_directions(leaf, directions, random) for leaf in here]
    with notices.collected() as notes:
        derivatives, size = _three_ways(_weighted(at, results, random), here, ways, eps)
    allowed = eps ** (1 / 3) if tolerance is None else tolerance
    # rounding of f hides smaller derivatives, so this is a lower bound of the scale
    hidden = unseen(eps) * size / allowed
    leaves = []
    for i, leaf, result in zip(floating, here, derivatives, strict=True):
        scale = _scale(result, hidden, leaf.size <= directions)
        leaves += [LeafGradient(named[i][0], *result, scale=scale, tolerance=allowed)]
    doubtful = [i for i, leaf in enumerate(leaves) if not leaf.ok]
    if doubtful:
        moves = [_alone(here, i, way, eps) for i in doubtful for way in ways[i]]
        notes += [f"{case}; {NO_DERIVATIVE}" for case in encounters.cases(at, here, moves)]
    return GradientCheck(tuple(leaves), allowed, tuple(notes))


def _alone(at: list[Array], place: int, way: Array, eps: float) -> list[Array]:
    """Returns the perturbations of all leaves in the central difference with the largest step.

    Only one leaf is perturbed, along one direction. The perturbations of all other leaves are zero.

    Args:
        at: the leaves.
        place: index of the perturbed leaf.
        way: the direction, with the shape of the leaf.
        eps: ε of the coarsest dtype in the computation.
    """
    step = steps(eps)[0]
    return [x.dtype.type(step) * way if i == place else 0 * x for i, x in enumerate(at)]


def _scale(result: tuple[np.ndarray, ...], hidden: float, alone: bool) -> np.ndarray:
    """Returns the values by which errors are divided to make them relative, (n,).

    If each direction varies a single number, errors are divided by the derivative along the
    direction. Otherwise they are divided by the largest derivative over all directions.

    Args:
        result: four arrays (n,): derivatives by reverse mode, forward mode and differences, and
            uncertainties.
        hidden: lower bound of the result: the smallest derivative that the differences resolve,
            divided by the tolerance.
        alone: True if each direction varies a single number.
    """
    largest = np.fmax.reduce(np.abs(result[:3]), axis=0)
    largest = largest if alone else np.full_like(largest, np.fmax.reduce(largest, initial=0.0))
    largest = np.fmax(largest, hidden)
    return np.where(largest > 0, largest, 1.0)


def _name(path: tuple[KeyEntry, ...]) -> str:
    """Converts the path of a leaf to its name, such as "params.rod.length"."""
    return jax.tree_util.keystr(path, simple=True, separator=".") or "x"


def _weighted(
    f: Callable[[list[Array]], PyTree],
    results: list[jax.ShapeDtypeStruct],
    random: np.random.Generator,
) -> Callable[[list[Array]], tuple[Array, Array]]:
    """Returns a function that reduces f(x) to a single number to differentiate.

    If f returns a single number, the function returns it. Otherwise it returns a random linear
    combination of all numbers in f(x). A second result of the function is the sum of the absolute
    values of the terms of this combination.

    Args:
        f: function from a list of arrays to a pytree.
        results: shapes and dtypes of the floating-point leaves of f(x).
        random: generator of the weights.
    """
    alone = len(results) == 1 and results[0].size == 1
    weights = [np.ones(y.shape) if alone else random.normal(size=y.shape) for y in results]
    widest = max((y.dtype for y in results), key=lambda dtype: dtype.itemsize)

    def value(x: list[Array]) -> tuple[Array, Array]:
        floating = [y for y in jax.tree.leaves(f(x)) if _is_floating(y)]
        pairs = zip(weights, floating, strict=True)
        terms = jnp.concatenate(
            [jnp.ravel(jnp.asarray(w, widest) * jnp.asarray(y, widest)) for w, y in pairs]
        )
        return jnp.sum(terms), jnp.sum(jnp.abs(terms))

    return value


def _is_floating(x: Any) -> bool:
    """Returns True for a nonempty array of real floating-point numbers."""
    return bool(checks.is_floating(x) and np.prod(np.shape(x)) > 0)


def _directions(leaf: Array, count: int, random: np.random.Generator) -> Array:
    """Returns the directions in which a leaf is varied, (n, …).

    A leaf of up to `count` numbers has one direction for each number. A larger leaf has `count`
    random directions. The maximum norm of each direction is that of the leaf, or 1 if the leaf is
    zero.
    """
    size = float(jnp.max(jnp.abs(leaf), initial=0)) or 1.0
    if leaf.size <= count:
        ways = np.eye(leaf.size)
    else:
        ways = random.normal(size=(count, leaf.size))
        ways /= np.max(np.abs(ways), axis=1, keepdims=True)
    return jnp.asarray(size * ways, leaf.dtype).reshape((len(ways), *leaf.shape))


def _three_ways(
    f: Callable[[list[Array]], tuple[Array, Array]],
    at: list[Array],
    ways: list[Array],
    eps: float,
) -> tuple[list[tuple[np.ndarray, ...]], float]:
    """Differentiates f by reverse mode, forward mode and central differences.

    Args:
        f: function from a list of arrays to a number and the sum of its absolute terms.
        at: the arrays at which f is differentiated.
        ways: n directions for each array, (n, …).
        eps: ε of the coarsest dtype in the computation.

    Returns:
        For each array a tuple (reverse, forward, difference, uncertainty) of arrays (n,) by
        direction; and the sum of the absolute terms of f.

    Raises:
        ValueError: f is not finite.
    """
    counts = [len(way) for way in ways]
    total, ends = sum(counts), np.cumsum(counts)
    # one vmap over all directions: each moves one leaf by a nonzero amount
    moves = [
        jnp.zeros((total, *x.shape), x.dtype).at[end - len(way) : end].set(way)
        for x, way, end in zip(at, ways, ends, strict=True)
    ]

    def value(x: list[Array]) -> Array:
        return f(x)[0]

    gradient, size = jax.jit(jax.grad(f, has_aux=True))(at)
    if not np.isfinite(size):
        raise ValueError("check_gradients: f is not finite at x: it has no derivative there.")
    forward = jax.jit(jax.vmap(lambda move: jax.jvp(value, (at,), (move,))[1]))(moves)
    pairs = zip(ways, gradient, strict=True)
    reverse = [np.asarray(w.reshape(len(w), -1), np.float64) @ np.ravel(g) for w, g in pairs]
    columns = (
        np.concatenate(reverse),
        np.asarray(forward, np.float64),
        *differences(value, at, moves, eps),
    )
    by_leaf = [
        tuple(x[end - n : end] for x in columns) for n, end in zip(counts, ends, strict=True)
    ]
    return by_leaf, float(size)
