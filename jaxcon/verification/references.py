"""Loads reference values from JSON files. Each file names its source and how to compare."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib import resources
from typing import Any, TypeAlias

import numpy as np


def load(name: str) -> dict[str, Any]:
    """Loads a file of reference values. Numbers written as text become floats.

    Args:
        name: the name of a file in `jaxcon/verification/data`, without its extension.

    Returns:
        The contents of the file. Text that is not a number, such as a formula, stays text.
    """
    text = (
        resources.files("jaxcon.verification").joinpath("data", f"{name}.json").read_text("utf-8")
    )
    return _numbers(json.loads(text))


def column(rows: Sequence[dict[str, Any]], key: str) -> np.ndarray:
    """Returns one quantity of all rows as an array, (rows, …)."""
    return np.array([row[key] for row in rows], float)


JSON: TypeAlias = "dict[str, JSON] | list[JSON] | str | float | bool | None"


def _numbers(x: JSON) -> Any:
    """Returns the tree with numbers written as text converted to floats."""
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
