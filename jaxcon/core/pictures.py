"""Where matplotlib comes from: imported when it is first needed, so that simulating needs none."""

from __future__ import annotations

from typing import Any

MISSING = "Pictures need matplotlib: pip install 'jaxcon[plot]'."


def pyplot() -> Any:
    """matplotlib's pyplot.

    Raises:
        ImportError: it is not installed; names the extra that brings it.
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError(MISSING) from error
    return plt
