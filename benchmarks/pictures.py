"""Writes pictures that are small enough for the repository."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from jaxcon import view

COLORS = 48
"""Number of colors of a picture; enough for lines and their antialiased edges."""


def save(figure: Any, path: Path, dpi: float = 100.0) -> None:
    """Writes a figure of lines as a PNG with few colors, and closes it.

    Args:
        figure: figure of matplotlib.
        path: path of the picture.
        dpi: dots per inch.
    """
    from PIL import Image

    with io.BytesIO() as buffer:
        figure.savefig(buffer, format="png", dpi=dpi)
        image = Image.open(buffer).convert("RGB")
    image.quantize(COLORS, dither=Image.Dither.NONE).save(path, format="png", optimize=True)
    view.pyplot().close(figure)
