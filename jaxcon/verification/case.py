"""`Check`, which compares a computed value with its bound, and measures of error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Check:
    """A computed value and the bound that it must not exceed.

    Attributes:
        case: the name of the case, as in `CASES`.
        figure: a description of the value.
        value: the computed value: an error, unless `figure` says otherwise.
        bound: the largest value that passes; infinite if the value is only reported.
    """

    case: str
    figure: str
    value: float
    bound: float

    @property
    def passed(self) -> bool:
        """True if value ≤ bound; NaN never passes."""
        return self.value <= self.bound


def error(actual: ArrayLike, expected: ArrayLike) -> float:
    """Returns the largest absolute error, max |x − x*|, for references x*."""
    return float(np.max(np.abs(_difference(actual, expected))))


def relative(actual: ArrayLike, expected: ArrayLike) -> float:
    """Returns the largest componentwise relative error, max |x − x*| / |x*|, for references x*."""
    return float(np.max(np.abs(_difference(actual, expected) / np.asarray(expected))))


def scaled(actual: ArrayLike, expected: ArrayLike) -> float:
    """Returns the largest error relative to the largest component of its row.

    For a row x and its reference x*, this is max |x − x*| / max |x*|. Use it for vectors with
    components that vanish.
    """
    size = np.max(np.abs(np.asarray(expected)), axis=-1, keepdims=True)
    return float(np.max(np.abs(_difference(actual, expected)) / size))


def up_to_sign(actual: ArrayLike, expected: ArrayLike) -> float:
    """Returns the largest error over rows of quaternions q, max min(|q − q*|, |q + q*|).

    A quaternion and its negative are the same orientation. q* is the reference.
    """
    q, reference = np.asarray(actual), np.asarray(expected)
    both = [np.max(np.abs(_difference(s * q, reference)), axis=-1) for s in (1, -1)]
    return float(np.max(np.minimum(*both)))


def turned(actual: ArrayLike, expected: ArrayLike) -> float:
    """Returns the largest error of angles modulo 2π, max |θ − θ*| [rad], for references θ*."""
    difference = _difference(actual, expected)
    return float(np.max(np.abs(np.angle(np.exp(1j * difference)))))


def _difference(actual: ArrayLike, expected: ArrayLike) -> np.ndarray:
    """Returns x − x*, the values minus their reference.

    Raises:
        ValueError: the shapes differ.
    """
    x, reference = np.asarray(actual, float), np.asarray(expected, float)
    if x.shape != reference.shape:
        raise ValueError(f"compared with a reference of {reference.shape}, got {x.shape}.")
    return x - reference
