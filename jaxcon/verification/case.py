"""One comparison with a reference, and the measures of error used in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Check:
    """A number of the library held against a bound.

    Attributes:
        case: name of the case, as in `CASES`.
        figure: what is compared, in words.
        value: what came out, an error unless the figure says otherwise.
        bound: the largest value that passes; infinite where the figure is only reported.
    """

    case: str
    figure: str
    value: float
    bound: float

    @property
    def passed(self) -> bool:
        """value ≤ bound; NaN never passes."""
        return self.value <= self.bound


def error(got: Any, expected: Any) -> float:
    """max |x − x*|."""
    return float(np.max(np.abs(_same_shape(got, expected))))


def relative(got: Any, expected: Any) -> float:
    """max |x − x*| / |x*|, component by component."""
    return float(np.max(np.abs(_same_shape(got, expected) / np.asarray(expected))))


def scaled(got: Any, expected: Any) -> float:
    """max |x − x*| / max |x*| within each row: for vectors some of whose components vanish."""
    size = np.max(np.abs(np.asarray(expected)), axis=-1, keepdims=True)
    return float(np.max(np.abs(_same_shape(got, expected)) / size))


def up_to_sign(got: Any, expected: Any) -> float:
    """max min(|q − q*|, |q + q*|) over rows of quaternions: both signs are one orientation."""
    q, reference = np.asarray(got), np.asarray(expected)
    both = [np.max(np.abs(_same_shape(s * q, reference)), axis=-1) for s in (1, -1)]
    return float(np.max(np.minimum(*both)))


def turned(got: Any, expected: Any) -> float:
    """max |θ − θ*| modulo whole turns [rad]."""
    difference = _same_shape(got, expected)
    return float(np.max(np.abs(np.angle(np.exp(1j * difference)))))


def _same_shape(got: Any, expected: Any) -> np.ndarray:
    x, reference = np.asarray(got, float), np.asarray(expected, float)
    if x.shape != reference.shape:
        raise ValueError(f"compared with a reference of {reference.shape}, got {x.shape}.")
    return x - reference
