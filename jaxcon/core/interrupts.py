"""Exceptions that stop a search but keep its results so far, and the progress bar."""

import warnings
from typing import Any

import jax
from tqdm import TqdmWarning

STOP_EXCEPTIONS = (KeyboardInterrupt, OSError, jax.errors.JaxRuntimeError)


def describe_error(error: BaseException) -> str:
    """Describes the exception that stopped a search, for messages."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted from the keyboard"
    return f"{type(error).__name__}: {error}"


def progress_bar(show: bool | None, unit: str = "step", **options: Any) -> Any:
    """Returns a tqdm progress bar.

    Args:
        show: True to show the bar, False to hide it, None to show it in terminals and notebooks.
        unit: the name of one iteration, such as "step".
        options: further arguments of `tqdm`.
    """
    with warnings.catch_warnings():  # without ipywidgets, tqdm warns and shows a text bar
        warnings.simplefilter("ignore", TqdmWarning)
        from tqdm.auto import tqdm
    return tqdm(unit=unit, disable=None if show is None else not show, **options)
