"""Images of an episode as arrays, rendered off screen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxcon import view
from jaxcon.environments.environment import Environment, Episode

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

WIDTH, DPI = 4.8, 100
"""The width of an image [inch], and its dots per inch."""


def canvas(environment: Environment) -> FigureCanvasAgg:
    """Creates a canvas with the aspect ratio of the environment's view.

    Raises:
        ImportError: matplotlib is not installed; the message names the extra to install.
    """
    (left, right), (low, high) = environment.frame
    return view.canvas(WIDTH, WIDTH * (high - low) / (right - left), DPI)


def image(environment: Environment, episode: Episode, onto: FigureCanvasAgg) -> np.ndarray:
    """Renders an episode to an image, (height, width, 3), of bytes.

    Args:
        environment: the environment, whose bodies and marks are drawn.
        episode: the episode to draw.
        onto: a canvas from `canvas`; its previous content is erased.
    """
    figure = onto.figure
    figure.clear()
    across, up = environment.window(episode)
    axes = figure.add_axes((0, 0, 1, 1), xlim=across, ylim=up)
    view.draw(environment.system, episode.state.q, axes, label=None)
    environment.marks(axes, episode)
    axes.set(xlim=across, ylim=up)
    axes.axis("off")
    onto.draw()
    return np.asarray(onto.buffer_rgba())[..., :3].copy()
