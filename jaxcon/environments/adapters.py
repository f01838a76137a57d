"""Helpers that the Gymnasium interfaces of an environment share."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import Array, PyTree
from jaxcon.environments.environment import Environment

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.experimental.functional import FuncEnv
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("Gymnasium's interfaces need gymnasium: pip install 'jaxcon[rl]'.") from error

__all__ = ["AutoresetMode", "FuncEnv", "VectorEnv", "batch_space", "gymnasium"]
"""Gymnasium names. Other modules import them from here, where a missing Gymnasium is reported."""

RGB_ARRAY = "rgb_array"


def observation_space(environment: Environment) -> spaces.Box:
    """Returns the Gymnasium space of observations, bounded by the observation channels."""
    least = np.array([channel.least for channel in environment.observed], environment.dtype)
    most = np.array([channel.most for channel in environment.observed], environment.dtype)
    return spaces.Box(least, most, dtype=environment.dtype.type)


def action_space(environment: Environment) -> spaces.Box:
    """Returns the Gymnasium space of actions: −1 to 1 for each component."""
    return spaces.Box(-1.0, 1.0, (len(environment.actions),), environment.dtype.type)


def describe(environment: Environment) -> dict[str, Any]:
    """Returns Gymnasium's metadata: render modes and frames per second."""
    rate = max(round(1 / (float(environment.dt) * environment.skip)), 1)
    return {"render_modes": [RGB_ARRAY], "render_fps": rate}


def check_render_mode(mode: str | None) -> str | None:
    """Returns the render mode if it is supported.

    Raises:
        ValueError: the mode is not supported.
    """
    if mode not in (None, RGB_ARRAY):
        raise ValueError(f"render_mode must be None or '{RGB_ARRAY}', got {mode!r}.")
    return mode


def check_options(options: dict[str, Any] | None, known: tuple[str, ...]) -> None:
    """Checks that all options of a reset are known.

    Raises:
        ValueError: an option is unknown.
    """
    if unknown := sorted(set(options or {}) - set(known)):
        hint = f"known are {list(known)}" if known else "there are none"
        raise ValueError(f"reset: unknown options {unknown}; {hint}.")


def check_no_horizon(options: dict[str, Any]) -> None:
    """Refuses the option `horizon`.

    Gymnasium's own `max_episode_steps` would silently override it.

    Raises:
        ValueError: `horizon` is among the options.
    """
    if "horizon" in options:
        raise ValueError(
            "Gymnasium's time limit is max_episode_steps=, of gymnasium.make and make_vec; got"
            f" horizon={options['horizon']}."
        )


def time_limit(steps: int | None, default: int | None) -> int | None:
    """Converts Gymnasium's `max_episode_steps` to the horizon of an environment.

    Args:
        steps: the value of `max_episode_steps`: None for the default, −1 for no limit.
        default: the horizon of the task.

    Returns:
        The number of actions after which an episode is truncated; None for no limit.

    Raises:
        ValueError: `steps` is neither None nor −1 nor a whole number from 1.
    """
    if steps is None:
        return default
    if steps == -1:
        return None
    checks.count("VectorEnv", "max_episode_steps", steps)
    return steps


def check_saved(saved: PyTree, like: PyTree) -> None:
    """Checks that a saved pytree has the expected shapes and dtypes.

    Args:
        saved: a pytree of arrays.
        like: a pytree of the expected shapes and dtypes.

    Raises:
        ValueError: the leaves, shapes or dtypes differ.
    """

    def arrays(tree: PyTree) -> dict[str, str]:
        leaves = jax.tree_util.tree_leaves_with_path(tree)
        return {jax.tree_util.keystr(path): f"{x.dtype}{x.shape}" for path, x in leaves}

    given, expected = arrays(saved), arrays(like)
    for name in [*expected, *given]:
        if given.get(name) != expected.get(name):
            raise ValueError(
                "restore: the save is from another task, precision or number of copies: it has"
                f" {name} as {given.get(name)}, and {expected.get(name)} is expected."
            )


def key_from(random: np.random.Generator) -> Array:
    """Draws a JAX key from Gymnasium's generator, as an array that can be saved."""
    return jax.random.PRNGKey(random.integers(2**32, dtype=np.uint32))


def warn_of_no_mode() -> None:
    """Warns, as Gymnasium does, that `render` was called without a render mode."""
    gymnasium.logger.warn(
        f"render was called without a mode; make the environment with render_mode='{RGB_ARRAY}'."
    )
