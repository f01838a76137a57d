"""Small vectors and matrices by components, each component a lane.

A lane is an array whose axes all enumerate bodies or worlds, never components. Every operation is
then one elementwise instruction over long contiguous memory, which XLA vectorises, where a small
`einsum` would be a loop of short ones. A component that is known when tracing (the 0s and 1s of a
coordinate axis) stays a Python number, and products with it are never emitted.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.pytree import exportable
from jaxcon.core.typing import Array, Lane


def _is(x: Lane, number: int) -> bool:
    return isinstance(x, int | float) and x == number


def times(x: Lane, y: Lane) -> Lane:
    """x y, without an instruction where a factor is the Python number 0, 1 or −1."""
    for a, b in ((x, y), (y, x)):
        if _is(a, 0):
            return 0.0
        if _is(a, 1):
            return b
        if _is(a, -1):
            return -b
    return x * y


def plus(x: Lane, y: Lane) -> Lane:
    """x + y, without an instruction where a term is the Python number 0."""
    if _is(x, 0):
        return y
    return x if _is(y, 0) else x + y


def minus(x: Lane, y: Lane) -> Lane:
    """x − y, without an instruction for the Python number 0."""
    if _is(x, 0):
        return times(-1, y)
    return x if _is(y, 0) else x - y


def total(terms: Any) -> Lane:
    """The sum of lanes."""
    return functools.reduce(plus, terms, 0.0)


@exportable
@jax.tree_util.register_pytree_node_class
class Vector:
    """A vector whose components are lanes; `Vector(x, y, z)`."""

    __slots__ = ("components",)

    def __init__(self, *components: Any) -> None:
        self.components = components

    @classmethod
    def of(cls, x: Any) -> Vector:
        """From an array whose first axis enumerates components, from a sequence, or as it is."""
        if isinstance(x, Vector):
            return x
        if isinstance(x, jax.Array):
            return cls(*(jnp.squeeze(row, 0) for row in jax.lax.split(x, (1,) * x.shape[0])))
        return cls(*x)

    @classmethod
    def of_rows(cls, x: Array, start: int, components: int, elements: int) -> Vector:
        """From rows of an array: those of all elements for each component, from `start` on.

        They are split at once, since the transpose of that is one concatenation, and that of slices
        as many padded arrays and their sum.
        """
        rest = len(x) - start - components * elements
        return cls(*jax.lax.split(x, (start, *(elements,) * components, rest))[1:-1])

    def stack(self) -> Array:
        """The array with the components along the first axis."""
        shape = jnp.broadcast_shapes(*(jnp.shape(c) for c in self))
        return jnp.stack([jnp.broadcast_to(c, shape) for c in _common(self.components)])

    def map(self, function: Callable[[Lane], Lane]) -> Vector:
        """The function of each component."""
        return Vector(*map(function, self))

    def dot(self, other: Vector) -> Lane:
        """Σ xᵢ yᵢ."""
        return total(times(x, y) for x, y in zip(self, other, strict=True))

    def cross(self, other: Vector) -> Any:
        """x × y: a vector in space, and in the plane its one component along the normal."""
        if len(self) == 2:
            (a, b), (c, d) = self, other
            return minus(times(a, d), times(b, c))
        (a, b, c), (x, y, z) = self, other
        return Vector(
            minus(times(b, z), times(c, y)),
            minus(times(c, x), times(a, z)),
            minus(times(a, y), times(b, x)),
        )

    def tree_flatten(self) -> tuple[tuple[Any, ...], None]:
        """Components are children."""
        return self.components, None

    @classmethod
    def tree_unflatten(cls, _: None, children: Any) -> Vector:
        """From children."""
        return cls(*children)

    def __iter__(self) -> Iterator[Lane]:
        return iter(self.components)

    def __len__(self) -> int:
        return len(self.components)

    def __getitem__(self, index: Any) -> Any:
        return self.components[index]

    def __add__(self, other: Vector) -> Vector:
        return Vector(*(plus(x, y) for x, y in zip(self, other, strict=True)))

    def __sub__(self, other: Vector) -> Vector:
        return Vector(*(minus(x, y) for x, y in zip(self, other, strict=True)))

    def __neg__(self) -> Vector:
        return self.map(lambda x: times(-1, x))

    def __mul__(self, scale: Lane) -> Vector:
        return self.map(lambda x: times(x, scale))

    __rmul__ = __mul__

    def __repr__(self) -> str:
        return f"Vector{self.components}"


class Matrix(Vector):
    """A matrix of lanes as a vector of row vectors."""

    __slots__ = ()

    def __matmul__(self, x: Vector) -> Vector:
        return Vector(*(row.dot(x) for row in self))

    def stack(self) -> Array:
        """The array with rows along the first axis and columns along the second."""
        return jnp.stack([row.stack() for row in self])

    @property
    def T(self) -> Matrix:
        """The transpose."""
        return Matrix(*(Vector(*column) for column in zip(*self, strict=True)))


exportable(jax.tree_util.register_pytree_node_class(Matrix))


def zeros(n: int) -> Vector:
    """The zero vector of n components, known when tracing."""
    return Vector(*(0.0,) * n)


def axes(n: int) -> tuple[Vector, ...]:
    """The n coordinate axes, known when tracing."""
    return tuple(Vector(*(1.0 if i == j else 0.0 for j in range(n))) for i in range(n))


def perpendicular(x: Vector) -> Vector:
    """x turned by +90° in the plane."""
    return Vector(times(-1, x[1]), x[0])


GATHERED = 16
"""Rows from which picking them is one gather instead of as many copies."""


def take(x: Lane, indices: tuple[int, ...]) -> Lane:
    """x[indices] along the first axis: nothing, a slice, copies or a gather, as needed.

    A number is the same for every index.
    """
    if not isinstance(x, jax.Array) or not x.ndim:
        return x
    first, n = indices[0], len(indices)
    stride = indices[1] - first if n > 1 else 1
    last = first + stride * (n - 1)
    if stride and indices == tuple(range(first, last + (1 if stride > 0 else -1), stride)):
        if n == x.shape[0] and stride == 1:
            return x
        low, high = min(first, last), max(first, last) + 1
        rows = jax.lax.slice_in_dim(x, low, high, abs(stride))
        return rows if stride > 0 else jax.lax.rev(rows, (0,))
    if n < GATHERED:
        return jnp.concatenate([jax.lax.slice_in_dim(x, i, i + 1) for i in indices])
    return x[np.asarray(indices)]


def side_by_side(rows: list[tuple[Lane, int]]) -> Lane:
    """Rows of lanes (element, …) as one lane; a row of a number is that number."""
    parts: list[tuple[Lane, int]] = []
    for _, members in itertools.groupby(rows, key=lambda row: id(row[0])):
        lanes, places = zip(*members, strict=True)
        parts.append((take(lanes[0], places), len(places)))
    if len(parts) == 1:
        return parts[0][0]
    arrays = [x for x, _ in parts if isinstance(x, jax.Array)]
    if not arrays:
        (number,) = {x for x, _ in parts}
        return number
    shape = jnp.broadcast_shapes(*(x.shape[1:] for x in arrays))
    whole = [jnp.broadcast_to(jnp.asarray(x, arrays[0].dtype), (n, *shape)) for x, n in parts]
    return jnp.concatenate(whole)


PIECES = 8
"""Runs of bodies from which a sum over bodies gathers its terms instead of slicing them."""


def collect(terms: list[tuple[tuple[int, ...], Lane]], bodies: int) -> Lane:
    """Σ of lanes (element, …) over the bodies on which their elements act, as a lane (body, …).

    Args:
        terms: the body of each element, and the lane.
        bodies: how many bodies there are.
    """
    arrays = [(indices, x) for indices, x in terms if not _is(x, 0)]
    if not arrays:
        return 0.0
    if all(indices == tuple(range(bodies)) for indices, _ in arrays):
        return total(x for _, x in arrays)
    shape = jnp.broadcast_shapes(*(x.shape[1:] for _, x in arrays))
    own: list[list[tuple[int, int]]] = [[] for _ in range(bodies)]
    for t, (indices, _) in enumerate(arrays):
        for element, body in enumerate(indices):
            own[body].append((t, element))
    starts = [i for i in range(bodies) if not i or own[i] != [(t, e + 1) for t, e in own[i - 1]]]
    if len(starts) > PIECES:
        return _gathered([x for _, x in arrays], own, shape)
    pieces = []
    for first, end in zip(starts, [*starts[1:], bodies], strict=True):
        rows = (jax.lax.slice_in_dim(arrays[t][1], e, e + end - first) for t, e in own[first])
        piece = total(rows) if own[first] else jnp.zeros((), arrays[0][1].dtype)
        pieces.append(jnp.broadcast_to(piece, (end - first, *shape)))
    return pieces[0] if len(pieces) == 1 else jnp.concatenate(pieces)


def _gathered(lanes: list[Array], own: list[list[tuple[int, int]]], shape: Any) -> Array:
    """Sums lanes by as many gathers as needed from one array of all terms and a row of zeros."""
    rows = [jnp.broadcast_to(x, (x.shape[0], *shape)) for x in lanes]
    every = jnp.concatenate([*rows, jnp.zeros((1, *shape), rows[0].dtype)])
    first = np.cumsum([0, *(len(x) for x in rows)])
    places = np.full((max(map(len, own)), len(own)), first[-1])
    for body, terms in enumerate(own):
        for k, (t, element) in enumerate(terms):
            places[k, body] = first[t] + element
    return total(every[index] for index in places)


def _common(components: tuple[Any, ...]) -> list[Any]:
    """Components of one dtype: that of the arrays among them, the default where there are none."""
    dtypes = [c.dtype for c in components if isinstance(c, jax.Array)]
    dtype = dtypes[0] if dtypes else jnp.result_type(float)
    return [c if isinstance(c, jax.Array) else jnp.asarray(c, dtype) for c in components]


def componentwise(function: Callable[..., Any]) -> Callable[..., Any]:
    """Lets a function of vectors also take arrays whose first axis enumerates components.

    The result is an array where every vector argument was one, and a Vector otherwise.
    """

    @functools.wraps(function)
    def wrapped(*args: Any) -> Any:
        if any(isinstance(x, Vector) for x in args):
            return function(*args)
        arrays = [jnp.asarray(x) for x in args]
        result = function(*(Vector.of(x) if x.ndim else x for x in arrays))
        return result.stack() if isinstance(result, Vector) else result

    return wrapped


def widened(tree: Any, worlds: int) -> Any:
    """Lanes with an axis of size 1 before those of worlds, for many right sides at once.

    Args:
        tree: lanes, and numbers of each world.
        worlds: how many trailing axes enumerate worlds.
    """

    def one(x: Any) -> Any:
        return jnp.expand_dims(x, jnp.ndim(x) - worlds) if jnp.ndim(x) else x

    return jax.tree.map(one, tree)
