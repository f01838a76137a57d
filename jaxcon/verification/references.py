"""Reference numbers, packaged as JSON; each file names its source and how to compare."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np


def load(name: str) -> dict[str, Any]:
    """A reference by the name of its file; numbers printed as text become floats.

    Args:
        name: of the file in `jaxcon/verification/data`, without its ending.

    Returns:
        The contents. Text that is no number, such as a formula, stays text.
    """
    text = (
        resources.files("jaxcon.verification").joinpath("data", f"{name}.json").read_text("utf-8")
    )
    return _numbers(json.loads(text))


def column(rows: Sequence[dict[str, Any]], key: str) -> np.ndarray:
    """One quantity of every row, (rows, …)."""
    return np.array([row[key] for row in rows], float)


def _numbers(x: Any) -> Any:
    if isinstance(x, dict):
        return {key: _numbers(value) for key, value in x.items()}
    if isinstance(x, list):
        return [_numbers(value) for value in x]
    if not isinstance(x, str):
        return x
    try:
        return float(x)
    except ValueError:
        return x
