"""What may end a search from outside, after which what was found is kept, and how it is seen."""

from __future__ import annotations

import warnings
from typing import Any

import jax
from tqdm import TqdmWarning

ENDS = (KeyboardInterrupt, OSError, jax.errors.JaxRuntimeError)


def words(error: BaseException) -> str:
    """Why a search ended."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted from the keyboard"
    return f"{type(error).__name__}: {error}"


def bar(show: bool | None, unit: str = "step", **options: Any) -> Any:
    """A bar of tqdm: in terminals and notebooks where it is None, always, or never."""
    with warnings.catch_warnings():  # a notebook without ipywidgets has the bar of a terminal
        warnings.simplefilter("ignore", TqdmWarning)
        from tqdm.auto import tqdm
    return tqdm(unit=unit, disable=None if show is None else not show, **options)
