"""Decompositions of small matrices and triangular systems, entry by entry.

Matrices are object arrays of scalars, and further matrices may lie along leading axes. The
functions write the instructions of a `Thread`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxcon.staging.thread import Scalar, Thread, UnsupportedError, is_float

MAX_OPERATIONS = 30_000
"""The largest number of operations of a decomposition: 56 rows by Cholesky, 26 by LU."""


def cholesky(thread: Thread, params: Mapping[str, Any], x: Any) -> list[Any]:
    """Writes `lax.linalg.cholesky`: L with A = L Lᵀ; NaN if A is not positive definite.

    References:
        Golub and Van Loan, Matrix Computations (2013), algorithm 4.2.1.
    """
    _check(x, x.size * x.shape[-1] / 6)
    result = x.copy()
    for place in np.ndindex(x.shape[:-2]):
        a = result[place]
        positive: Any = np.True_
        for k in range(len(a)):
            positive = thread.apply("and", positive, thread.apply("gt", a[k, k], _zero(a)))
            a[k, k] = thread.apply("sqrt", a[k, k])
            inverse = thread.apply("div", a.flat[0].dtype.type(1), a[k, k])
            for i in range(k + 1, len(a)):
                a[i, k] = thread.apply("mul", a[i, k], inverse)
            for j in range(k + 1, len(a)):
                for i in range(j, len(a)):
                    a[i, j] = _less(thread, a[i, j], a[i, k], a[j, k])
        for i, j in np.ndindex(a.shape):
            nan = a[i, j].dtype.type(np.nan)
            a[i, j] = thread.select(positive, a[i, j], nan) if i >= j else _zero(a)
    return [result]


def lu(thread: Thread, params: Mapping[str, Any], x: Any) -> list[Any]:
    """Writes `lax.linalg.lu`: P A = L U with row pivots, and the pivots and P as permutations.

    References:
        Golub and Van Loan, Matrix Computations (2013), algorithm 3.4.1.
    """
    rows, columns = x.shape[-2:]
    _check(x, 5 / 3 * x.size * rows)  # a third of them multiply; the others swap
    result = x.copy()
    if rows != columns:
        raise UnsupportedError(f"the decomposition of a matrix of {rows} by {columns} entries")
    pivots = np.empty(x.shape[:-1], object)
    for place in np.ndindex(x.shape[:-2]):
        a = result[place]
        for k in range(rows):
            best, pivot = thread.apply("abs", a[k, k]), np.int32(k)
            for i in range(k + 1, rows):
                size = thread.apply("abs", a[i, k])
                larger = thread.apply("gt", size, best)
                best = thread.select(larger, size, best)
                pivot = thread.select(larger, np.int32(i), pivot)
            pivots[(*place, k)] = pivot
            _swap(thread, a, k, pivot)
            # a column without a pivot is zero, and stays so
            regular = thread.select(
                thread.apply("eq", a[k, k], _zero(a)), a[k, k].dtype.type(1), a[k, k]
            )
            inverse = thread.apply("div", a[k, k].dtype.type(1), regular)
            for i in range(k + 1, rows):
                a[i, k] = thread.apply("mul", a[i, k], inverse)
                for j in range(k + 1, rows):
                    a[i, j] = _less(thread, a[i, j], a[i, k], a[k, j])
    return [result, pivots, *permutation(thread, {"permutation_size": rows}, pivots)]


def permutation(thread: Thread, params: Mapping[str, Any], pivots: Any) -> list[Any]:
    """Writes `lax.linalg.lu_pivots_to_permutation`: the order of rows after all swaps."""
    size = params["permutation_size"]
    result = np.empty((*pivots.shape[:-1], size), object)
    for place in np.ndindex(pivots.shape[:-1]):
        order = np.empty(size, object)
        order[:] = [np.int32(i) for i in range(size)]
        for k, pivot in enumerate(pivots[place]):
            _swap(thread, order, k, pivot)
        result[place] = order
    return [result]


def triangular_solve(thread: Thread, params: Mapping[str, Any], a: Any, b: Any) -> list[Any]:
    """Writes `lax.linalg.triangular_solve`: X with op(A) X = B, or X op(A) = B on the right.

    References:
        Golub and Van Loan, Matrix Computations (2013), algorithms 3.1.1 and 3.1.2.
    """
    _check(a, b.size * a.shape[-1] / 2)
    lower = params["lower"]
    if not params["left_side"]:  # Aᵀ Xᵀ = Bᵀ
        b = np.swapaxes(b, -1, -2)
    if params["transpose_a"] == params["left_side"]:
        a, lower = np.swapaxes(a, -1, -2), not lower
    result = b.copy()
    size = a.shape[-1]
    order = range(size) if lower else range(size - 1, -1, -1)
    for place in np.ndindex(a.shape[:-2]):
        matrix, x = a[place], result[place]
        for k in order:
            if not params["unit_diagonal"]:
                inverse = thread.apply("div", matrix[k, k].dtype.type(1), matrix[k, k])
                for c in range(x.shape[1]):
                    x[k, c] = thread.apply("mul", x[k, c], inverse)
            for i in range(k + 1, size) if lower else range(k):
                for c in range(x.shape[1]):
                    x[i, c] = _less(thread, x[i, c], matrix[i, k], x[k, c])
    return [result if params["left_side"] else np.swapaxes(result, -1, -2)]


def _check(x: Any, operations: float) -> None:
    """Refuses matrices that are empty, not real, or take too many operations.

    Raises:
        UnsupportedError: the matrix is such a one.
    """
    if not x.size or not is_float(x.flat[0]):
        raise UnsupportedError("a decomposition of an empty matrix, or of one that is not real")
    if operations > MAX_OPERATIONS:
        raise UnsupportedError(f"a decomposition of a matrix of {x.shape[-1]} rows")


def _zero(a: Any) -> Scalar:
    """Returns zero in the dtype of a matrix."""
    return a.flat[0].dtype.type(0)


def _less(thread: Thread, x: Scalar, a: Scalar, b: Scalar) -> Scalar:
    """Returns x − a b."""
    return thread.apply("sub", x, thread.apply("mul", a, b))


def _swap(thread: Thread, rows: Any, k: int, pivot: Scalar) -> None:
    """Swaps row k with the row at an index of at least k, in place."""
    first: Any = np.array(rows[k], object)
    for i in range(k + 1, len(rows)):
        here = thread.apply("eq", pivot, np.int32(i))
        for place in np.ndindex(first.shape):
            other = rows[i][place] if first.shape else rows[i]
            moved = thread.select(here, first[place], other)
            rows[(k, *place)] = thread.select(here, other, rows[(k, *place)])
            rows[(i, *place)] = moved
