"""Small vectors and matrices whose components are lanes.

A lane is an array whose axes enumerate bodies or worlds, never components. Every operation is then
one elementwise instruction over long contiguous memory, which XLA vectorizes. A small `einsum`
would be a loop of short instructions. Components known at trace time (the 0s and 1s of a coordinate
axis) stay Python numbers, and products with them are left out of the program.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.pytree import exportable
from jaxcon.core.selection import select_rows, sum_rows
from jaxcon.core.typing import Array, Lane, Scalar, T


def _is(x: Lane, number: int) -> bool:
    """Returns True if x is a Python number with the value `number`, and not an array."""
    return isinstance(x, int | float) and x == number


def _combined(
    x: Lane, y: Lane, operation: Callable[..., Array], general: Callable[..., Lane]
) -> Lane:
    """Returns the result of an operation of `jax.lax`, or of the general one if types differ.

    JAX traces operations of `jax.lax`, on arrays of one shape and dtype, in a third of the time.
    """
    if not (isinstance(x, jax.Array) and isinstance(y, jax.Array)):
        return general(x, y)
    alike = x.shape == y.shape and x.dtype == y.dtype
    return operation(x, y) if alike else general(x, y)


def times(x: Lane, y: Lane) -> Lane:
    """Returns x y; no operation is traced if a factor is the Python number 0, 1 or −1."""
    for a, b in ((x, y), (y, x)):
        if _is(a, 0):
            return 0.0
        if _is(a, 1):
            return b
        if _is(a, -1):
            return -b
    return _combined(x, y, jax.lax.mul, operator.mul)


def plus(x: Lane, y: Lane) -> Lane:
    """Returns x + y; no operation is traced if a term is the Python number 0."""
    if _is(x, 0):
        return y
    return x if _is(y, 0) else _combined(x, y, jax.lax.add, operator.add)


def minus(x: Lane, y: Lane) -> Lane:
    """Returns x − y; no operation is traced if a term is the Python number 0."""
    if _is(x, 0):
        return times(-1, y)
    return x if _is(y, 0) else _combined(x, y, jax.lax.sub, operator.sub)


@overload
def total(terms: Iterable[Array]) -> Array: ...


@overload
def total(terms: Iterable[Lane]) -> Lane: ...


def total(terms: Iterable[Lane]) -> Lane:
    """Returns the sum of lanes; 0.0 if there are none."""
    return functools.reduce(plus, terms, 0.0)


@exportable
@jax.tree_util.register_pytree_node_class
class Vector:
    """A vector such as `Vector(x, y, z)`, whose components are lanes.

    A lane is an array over bodies or worlds, or a number known when tracing.
    """

    __slots__ = ("components",)

    def __init__(self, *components: Lane | Vector) -> None:
        self.components: tuple[Any, ...] = components

    @classmethod
    def of(cls, x: Vector | Array | Sequence[Lane]) -> Vector:
        """Converts an array (component, …) or a sequence of components to a vector."""
        if isinstance(x, Vector):
            return x
        if isinstance(x, jax.Array):
            return cls(*(jnp.squeeze(row, 0) for row in jax.lax.split(x, (1,) * x.shape[0])))
        return cls(*x)

    @classmethod
    def of_rows(cls, x: Array, start: int, components: int, elements: int) -> Vector:
        """Returns a vector whose components are consecutive slices of an array, (element, …) each.

        Args:
            x: the array, (row, …).
            start: the first row of the first component; the other components follow.
            components: the number of components.
            elements: the number of rows of each component.
        """
        # one split, since its transpose is one concatenation; slices give a sum of padded arrays
        rest = len(x) - start - components * elements
        return cls(*jax.lax.split(x, (start, *(elements,) * components, rest))[1:-1])

    def stack(self) -> Array:
        """Returns an array with the components along the first axis."""
        dtypes = [c.dtype for c in self if isinstance(c, jax.Array)] or [jnp.result_type(float)]
        shape = jnp.broadcast_shapes(*(jnp.shape(c) for c in self))
        arrays = (c if isinstance(c, jax.Array) else jnp.asarray(c, dtypes[0]) for c in self)
        return jnp.stack([jnp.broadcast_to(c, shape) for c in arrays])

    def map(self, function: Callable[[Any], Any]) -> Vector:
        """Applies a function to each component; returns the vector of the results."""
        return Vector(*map(function, self))

    def dot(self, other: Vector) -> Lane:
        """Returns the scalar product Σ xᵢ yᵢ."""
        return total(times(x, y) for x, y in zip(self, other, strict=True))

    def cross(self, other: Vector) -> Any:
        """Returns x × y: a Vector in space; in the plane, only the component along the normal."""
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
        """Returns the components as children."""
        return self.components, None

    @classmethod
    def tree_unflatten(cls, _: None, children: Iterable[Any]) -> Vector:
        """Rebuilds the vector from its children."""
        return cls(*children)

    def __iter__(self) -> Iterator[Any]:  # yields lanes, or the rows of a Matrix
        return iter(self.components)

    def __len__(self) -> int:
        return len(self.components)

    def __getitem__(self, index: int | slice) -> Any:
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
    """A matrix of lanes: a vector of row vectors."""

    __slots__ = ()

    def __matmul__(self, x: Vector) -> Vector:
        return Vector(*(row.dot(x) for row in self))

    def stack(self) -> Array:
        """Returns an array with rows along the first axis and columns along the second."""
        return jnp.stack([row.stack() for row in self])

    @property
    def T(self) -> Matrix:
        """The transposed matrix."""
        return Matrix(*(Vector(*column) for column in zip(*self, strict=True)))


exportable(jax.tree_util.register_pytree_node_class(Matrix))


def zeros(n: int) -> Vector:
    """Returns the zero vector with n components, as Python numbers."""
    return Vector(*(0.0,) * n)


def axes(n: int) -> tuple[Vector, ...]:
    """Returns the n coordinate axes, as vectors of Python numbers."""
    return tuple(Vector(*(1.0 if i == j else 0.0 for j in range(n))) for i in range(n))


def perpendicular(x: Vector) -> Vector:
    """Returns the planar vector x rotated by +90°."""
    return Vector(times(-1, x[1]), x[0])


def take(x: Lane, indices: tuple[int, ...]) -> Lane:
    """Returns x[indices], along the first axis; a Python number is returned unchanged."""
    if isinstance(x, np.ndarray):
        x = jnp.asarray(x)
    if not isinstance(x, jax.Array) or not x.ndim:
        return x
    return select_rows(x, indices)


def side_by_side(rows: Sequence[tuple[Lane, int]]) -> Lane:
    """Concatenates chosen rows of one or more lanes (element, …) into one lane.

    Args:
        rows: for each row of the result, a pair: a lane, and the index of the row in that lane. A
            Python number in place of a lane fills the row with this number.
    """
    parts: list[tuple[Lane, int]] = []
    for _, members in itertools.groupby(rows, key=lambda row: id(row[0])):
        lanes, places = zip(*members, strict=True)
        parts.append((take(lanes[0], places), len(places)))
    if len(parts) == 1:
        return parts[0][0]
    arrays = [x for x, _ in parts if isinstance(x, jax.Array)]
    if not arrays:
        (number,) = {x for x, _ in parts if not isinstance(x, jax.Array)}
        return number
    shape = jnp.broadcast_shapes(*(x.shape[1:] for x in arrays))
    whole = [jnp.broadcast_to(jnp.asarray(x, arrays[0].dtype), (n, *shape)) for x, n in parts]
    return jnp.concatenate(whole)


PIECES = 8
"""The largest number of runs for which `collect` adds slices.

A run is a sequence of consecutive bodies whose contributions are consecutive, too.
"""

Terms = Sequence[tuple[tuple[int, ...], Lane]]
"""Pairs (number of the body of each element, contributions (element, …)); see `collect`."""


def collect(terms: Terms, bodies: int) -> Lane:
    """Sums contributions of elements, such as joints, to the bodies on which they act.

    Args:
        terms: pairs (number of the body of each element, contributions (element, …)).
        bodies: the number of bodies.

    Returns:
        The sums, a lane (body, …).
    """
    return collect_each([terms], bodies)[0]


def collect_each(sums: Sequence[Terms], bodies: int) -> list[Lane]:
    """Sums the contributions of elements to bodies, for each component; see `collect`.

    Components whose contributions come in many pieces are summed together.
    """
    arrays = [[(i, _array(x, len(i))) for i, x in t if not _is(x, 0)] for t in sums]
    results = [_in_pieces(terms, bodies) for terms in arrays]
    others = [terms for terms, x in zip(arrays, results, strict=True) if x is None]
    lanes = iter(_in_pairs(others, bodies))
    return [next(lanes) if x is None else x for x in results]


def _array(x: Lane, elements: int) -> Array:
    """Returns a lane as an array of JAX, (element, …)."""
    return jnp.asarray(x) if np.ndim(x) else jnp.full(elements, x)


def _in_pieces(terms: Sequence[tuple[tuple[int, ...], Array]], bodies: int) -> Lane | None:
    """Returns the sums of `collect`, added in at most `PIECES` pieces; None if there are more."""
    if not terms:
        return 0.0
    if all(indices == tuple(range(bodies)) for indices, _ in terms):
        return total(x for _, x in terms)
    sources: list[list[tuple[int, int]]] = [[] for _ in range(bodies)]
    for t, (indices, _) in enumerate(terms):
        for element, body in enumerate(indices):
            sources[body].append((t, element))
    starts = [
        i for i in range(bodies) if not i or sources[i] != [(t, e + 1) for t, e in sources[i - 1]]
    ]
    if len(starts) > PIECES:
        return None
    shape = jnp.broadcast_shapes(*(x.shape[1:] for _, x in terms))
    sizes = [b - a for a, b in itertools.pairwise((*starts, bodies))]
    # one split of each term, since its transpose is one concatenation
    parts: dict[tuple[int, int], Array] = {}
    for t, (_, x) in enumerate(terms):
        runs = [(e, n) for i, n in zip(starts, sizes, strict=True) for s, e in sources[i] if s == t]
        runs.sort()
        split = jax.lax.split(x, [n for _, n in runs])
        parts |= {(t, e): part for (e, _), part in zip(runs, split, strict=True)}
    pieces = []
    for i, n in zip(starts, sizes, strict=True):
        piece = (
            total(parts[x] for x in sources[i]) if sources[i] else jnp.zeros((), terms[0][1].dtype)
        )
        pieces.append(jnp.broadcast_to(piece, (n, *shape)))
    return pieces[0] if len(pieces) == 1 else jnp.concatenate(pieces)


def _in_pairs(
    sums: Sequence[Sequence[tuple[tuple[int, ...], Array]]], bodies: int
) -> Sequence[Array]:
    """Returns the sums of `collect` for each component, added in pairs of single rows."""
    if not sums:
        return []
    flat = [(c, indices, x) for c, terms in enumerate(sums) for indices, x in terms]
    shape = jnp.broadcast_shapes(*(x.shape[1:] for _, _, x in flat))
    sources: list[list[int]] = [[] for _ in range(len(sums) * bodies)]
    row = 0
    for c, indices, _ in flat:
        for body in indices:
            sources[c * bodies + body].append(row)
            row += 1
    rows = jnp.concatenate([jnp.broadcast_to(x, (len(x), *shape)) for _, _, x in flat])
    return jax.lax.split(sum_rows(rows, sources), [bodies] * len(sums))


def componentwise(function: Callable[..., Any]) -> Callable[..., Any]:
    """Lets a function of Vectors also take arrays whose first axis enumerates components.

    A result that is a Vector becomes an array, too, if all arguments are arrays.
    """

    @functools.wraps(function)
    def wrapped(*args: Vector | Scalar) -> Any:
        if any(isinstance(x, Vector) for x in args):
            return function(*args)
        arrays = [jnp.asarray(x) for x in args]
        result = function(*(Vector.of(x) if x.ndim else x for x in arrays))
        return result.stack() if isinstance(result, Vector) else result

    return wrapped


def add_rhs_axis(tree: T, worlds: int) -> T:
    """Inserts an axis of size 1 before the batch axes, to broadcast over many right-hand sides.

    Args:
        tree: a tree of arrays with trailing batch axes; scalars are unchanged.
        worlds: the number of trailing batch axes.
    """
    return jax.tree.map(
        lambda x: jnp.expand_dims(x, jnp.ndim(x) - worlds) if jnp.ndim(x) else x, tree
    )
