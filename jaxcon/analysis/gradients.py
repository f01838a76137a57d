"""Checks of derivatives: both modes against differences. Host code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis import encounters
from jaxcon.analysis.differences import differences, steps, unseen
from jaxcon.core import checks, functions, notices
from jaxcon.core.typing import Array, PyTree

NO_DERIVATIVE = "there plain steps have no derivative that differences could confirm"
"""The words for impacts that a wrong gradient meets."""


@dataclass(frozen=True)
class LeafGradient:
    """The derivative along directions of one leaf, by three ways.

    Directions are as long as the leaf: what is compared is the change of f by 100 % of it.

    Attributes:
        name: of the leaf in x.
        reverse, forward, difference: by direction, (n,).
        uncertainty: of the differences, as far as these tell, (n,).
        scale: what errors are relative to, (n,).
        tolerance: relative.
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
        """By how much forward and reverse mode differ, relative."""
        return self._largest(self.forward - self.reverse)

    @property
    def error(self) -> float:
        """By how much the differences do beyond their own uncertainty, from the worse mode."""
        return self._beyond(self.forward, self.reverse)

    @property
    def undecided(self) -> bool:
        """Returns True where the differences are too inexact to tell."""
        return not self._largest(self.uncertainty) <= self.tolerance

    @property
    def agrees(self) -> bool:
        """True where all three agree; NaN never agrees."""
        return self.modes_apart <= self.tolerance and self.error <= self.tolerance

    @property
    def ok(self) -> bool:
        """Returns True where they agree and the differences could tell."""
        return self.agrees and not self.undecided

    def _beyond(self, *modes: np.ndarray) -> float:
        """By how much the worst of these differs from the differences beyond their uncertainty."""
        apart = np.maximum.reduce([np.abs(x - self.difference) for x in modes])
        return self._largest(np.maximum(apart - self.uncertainty, 0.0))

    def _largest(self, x: np.ndarray) -> float:
        return float(np.max(np.abs(x) / self.scale))

    def __str__(self) -> str:
        head = f"{self.name}: the modes differ by {self.modes_apart:.1e},"
        return f"{head} differences by {self.error:.1e}{self._verdict()}"

    def _verdict(self) -> str:
        if self.ok:
            return ""
        if self.agrees:
            return (
                f"; UNDECIDED: differences tell no more than {self._largest(self.uncertainty):.1e}"
            )
        apart = np.maximum(*(np.abs(x - self.difference) for x in (self.reverse, self.forward)))
        i = int(np.argmax(apart / self.scale))  # argmax finds NaN first
        return (
            f"; DISAGREES, {self._culprit()}: reverse {self.reverse[i]:.9g},"
            f" forward {self.forward[i]:.9g}, differences {self.difference[i]:.9g}"
        )

    def _culprit(self) -> str:
        """Which modes the differences speak against, in words."""
        modes = self.reverse, self.forward
        reverse, forward = (not self._beyond(mode) <= self.tolerance for mode in modes)
        if reverse and forward:
            return "both modes are off"
        if reverse or forward:
            return f"{'reverse' if reverse else 'forward'} mode is off"
        return "the modes are apart"


@dataclass(frozen=True)
class GradientCheck:
    """The leaves of x, by what their derivatives are; `print` it.

    Attributes:
        leaves: one `LeafGradient` for each leaf of floating numbers.
        tolerance: relative.
        notes: cases in which derivatives of f may be wrong by structure, as of some impacts; and,
            where a leaf is not right, the simultaneous, grazing or accumulating impacts of plain
            steps that f meets at x.
    """

    leaves: tuple[LeafGradient, ...]
    tolerance: float
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Returns True where every leaf is right."""
        return all(leaf.ok for leaf in self.leaves)

    @property
    def error(self) -> float:
        """The largest of the leaves, relative."""
        return float(np.max([[leaf.error, leaf.modes_apart] for leaf in self.leaves]))

    @property
    def wrong(self) -> tuple[str, ...]:
        """Names of leaves that disagree, or of which differences cannot tell."""
        return tuple(leaf.name for leaf in self.leaves if not leaf.ok)

    def __str__(self) -> str:
        off = [leaf.name for leaf in self.leaves if not leaf.agrees]
        open_ = [leaf.name for leaf in self.leaves if leaf.agrees and leaf.undecided]
        found = {"wrong for": off, "undecided for": open_}
        verdict = ", ".join(f"{what} {names}" for what, names in found.items() if names) or "right"
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
    """Compares reverse mode, forward mode and central differences of f at x, leaf by leaf.

    A leaf of up to `directions` numbers is moved along each of them, a larger one along as many
    random directions. Differences are central, at ten steps from ε^⅛ of the leaf's size down by
    halves, and extrapolated to zero by Ridders' method, which also tells how exact they are; no
    step need be chosen. Where f returns more than a number, it is tested by a random combination.

    Args:
        f: x → a number, or a pytree of them; a rollout, say.
        x: pytree; leaves that are no floating numbers, and empty ones, are left as they are.
        tolerance: relative to the derivative by the number, or to the largest along random
            directions; ε^⅓ unless given, which is 6e-6 in float64 and 5e-3 in float32, ε being that
            of the coarsest number in x and f. A derivative that rounding hides from differences is
            held to what they see.
        directions: of a leaf.
        seed: of random directions.

    Returns:
        The `GradientCheck`.

    Raises:
        ValueError: x or f has no floating numbers, or some that are not finite.
        TypeError: f is no function, or one of other arguments.

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
    structure, given = jax.tree.structure(x), [leaf for _, leaf in named]

    def at(moved: list[Array]) -> PyTree:
        chosen = dict(zip(floating, moved, strict=True))
        return functions.call(
            "check_gradients",
            "f",
            f,
            structure.unflatten([chosen.get(i, leaf) for i, leaf in enumerate(given)]),
        )

    here = [jnp.asarray(given[i]) for i in floating]
    for i, leaf in zip(floating, here, strict=True):
        checks.check("check_gradients", f"x.{named[i][0]}" if named[i][0] != "x" else "x", leaf)
    results = [y for y in jax.tree.leaves(jax.eval_shape(at, here)) if _is_floating(y)]
    if not results:
        raise ValueError("check_gradients: f returns no floating number to differentiate.")
    eps = max(float(jnp.finfo(y.dtype).eps) for y in [*here, *results])
    ways = [_directions(leaf, directions, random) for leaf in here]
    with notices.collected() as notes:
        found, size = _three_ways(_weighted(at, results, random), here, ways, eps)
    allowed = eps ** (1 / 3) if tolerance is None else tolerance
    hidden = unseen(eps) * size / allowed
    leaves = []
    for i, leaf, result in zip(floating, here, found, strict=True):
        scale = _scale(result, hidden, leaf.size <= directions)
        leaves += [LeafGradient(named[i][0], *result, scale=scale, tolerance=allowed)]
    doubtful = [i for i, leaf in enumerate(leaves) if not leaf.ok]
    if doubtful:
        moves = [_alone(here, i, way, eps) for i in doubtful for way in ways[i]]
        notes += [f"{case}; {NO_DERIVATIVE}" for case in encounters.cases(at, here, moves)]
    return GradientCheck(tuple(leaves), allowed, tuple(notes))


def _alone(at: list[Array], place: int, way: Array, eps: float) -> list[Array]:
    """The largest move of differences, of one leaf along one of its directions."""
    step = steps(eps)[0]
    return [x.dtype.type(step) * way if i == place else 0 * x for i, x in enumerate(at)]


def _scale(result: tuple[np.ndarray, ...], hidden: float, alone: bool) -> np.ndarray:
    """The derivative by each number, or the largest along random directions; no less than is seen.

    Args:
        result: by three ways, and their uncertainty.
        hidden: what differences see at least.
        alone: whether each direction is one number.
    """
    largest = np.fmax.reduce(np.abs(result[:3]), axis=0)
    largest = largest if alone else np.full_like(largest, np.fmax.reduce(largest, initial=0.0))
    largest = np.fmax(largest, hidden)
    return np.where(largest > 0, largest, 1.0)


def _name(path: Any) -> str:
    """Returns the name of a leaf, such as "params.rod.length"."""
    return jax.tree_util.keystr(path, simple=True, separator=".") or "x"


def _weighted(f: Callable[[Any], PyTree], results: list[Any], random: Any) -> Callable[[Any], Any]:
    """x → f, or a random combination of its results, and the sum of sizes that this adds up."""
    alone = len(results) == 1 and results[0].size == 1
    weights = [np.ones(y.shape) if alone else random.normal(size=y.shape) for y in results]
    widest = max((y.dtype for y in results), key=lambda dtype: dtype.itemsize)

    def value(x: Any) -> tuple[Array, Array]:
        found = [y for y in jax.tree.leaves(f(x)) if _is_floating(y)]
        pairs = zip(weights, found, strict=True)
        every = jnp.concatenate(
            [jnp.ravel(jnp.asarray(w, widest) * jnp.asarray(y, widest)) for w, y in pairs]
        )
        return jnp.sum(every), jnp.sum(jnp.abs(every))

    return value


def _is_floating(x: Any) -> bool:
    """Returns True where it has real numbers, and not none of them."""
    return bool(checks.is_floating(x) and np.prod(np.shape(x)) > 0)


def _directions(leaf: Array, count: int, random: Any) -> Array:
    """Returns random directions (n, …) of a leaf, as long as the leaf, or 1 where it is zero."""
    size = float(jnp.max(jnp.abs(leaf), initial=0)) or 1.0
    if leaf.size <= count:
        ways = np.eye(leaf.size)
    else:
        ways = random.normal(size=(count, leaf.size))
        ways /= np.max(np.abs(ways), axis=1, keepdims=True)
    return jnp.asarray(size * ways, leaf.dtype).reshape((len(ways), *leaf.shape))


def _three_ways(of: Any, at: list[Array], ways: list[Array], eps: float) -> tuple[list[Any], float]:
    """By leaf: reverse, forward, difference, uncertainty, by direction; and the size of f.

    Raises:
        ValueError: that is not finite.
    """
    counts = [len(way) for way in ways]
    total, ends = sum(counts), np.cumsum(counts)
    # every direction moves one leaf and leaves the others
    moves = [
        jnp.zeros((total, *x.shape), x.dtype).at[end - len(way) : end].set(way)
        for x, way, end in zip(at, ways, ends, strict=True)
    ]

    def value(x: list[Array]) -> Array:
        return of(x)[0]

    gradient, size = jax.jit(jax.grad(of, has_aux=True))(at)
    if not np.isfinite(size):
        raise ValueError("check_gradients: f is not finite at x: it has no derivative there.")
    forward = jax.jit(jax.vmap(lambda move: jax.jvp(value, (at,), (move,))[1]))(moves)
    pairs = zip(ways, gradient, strict=True)
    reverse = [np.asarray(w.reshape(len(w), -1), np.float64) @ np.ravel(g) for w, g in pairs]
    apart = differences(value, at, moves, eps)
    known = np.concatenate(reverse), np.asarray(forward, np.float64), *apart
    by_leaf = [tuple(x[end - n : end] for x in known) for n, end in zip(counts, ends, strict=True)]
    return by_leaf, float(size)
