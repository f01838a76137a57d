"""Pictures of an episode as arrays, drawn without a window."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcon import view
from jaxcon.environments.environment import Environment, Episode

WIDTH, DPI = 4.8, 100
"""The size of a picture [inch], and its dots per inch."""


def canvas(environment: Environment) -> Any:
    """A canvas in the shape of what the environment shows.

    Raises:
        ImportError: matplotlib is not installed; names the extra that brings it.
    """
    (left, right), (low, high) = environment.frame
    return view.canvas(WIDTH, WIDTH * (high - low) / (right - left), DPI)


def image(environment: Environment, episode: Episode, onto: Any) -> np.ndarray:
    """The picture of an episode, (height, width, 3), of bytes.

    Args:
        environment: whose bodies and marks are drawn.
        episode: where it stands.
        onto: from `canvas`; what was drawn on it before is wiped.
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
