"""The delayed import of matplotlib, which only pictures need."""

from typing import Any

MISSING = "Pictures need matplotlib: pip install 'jaxcon[plot]'."


def pyplot() -> Any:
    """Imports and returns `matplotlib.pyplot`.

    Raises:
        ImportError: matplotlib is missing; the message names the extra to install.
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError(MISSING) from error
    return plt
