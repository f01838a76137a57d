"""What Gymnasium's interfaces to an environment have in common."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import Array
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
"""The names of Gymnasium, whose absence only this module explains."""

PICTURES = "rgb_array"


def observation_space(environment: Environment) -> spaces.Box:
    """The bounds of its channels."""
    least, most = (
        np.array([getattr(channel, side) for channel in environment.observed], environment.dtype)
        for side in ("least", "most")
    )
    return spaces.Box(least, most, dtype=environment.dtype.type)


def action_space(environment: Environment) -> spaces.Box:
    """From −1 to 1 for each number of an action."""
    return spaces.Box(-1.0, 1.0, (len(environment.actions),), environment.dtype.type)


def describe(environment: Environment) -> dict[str, Any]:
    """Gymnasium's metadata: the pictures, and how many of them make a second."""
    rate = max(round(1 / (float(environment.dt) * environment.skip)), 1)
    return {"render_modes": [PICTURES], "render_fps": rate}


def check_render_mode(mode: str | None) -> str | None:
    """The mode.

    Raises:
        ValueError: it is another one.
    """
    if mode not in (None, PICTURES):
        raise ValueError(f"render_mode must be None or '{PICTURES}', got {mode!r}.")
    return mode


def check_options(options: dict[str, Any] | None, known: tuple[str, ...]) -> None:
    """Checks the options of a reset.

    Raises:
        ValueError: some are unknown.
    """
    if unknown := sorted(set(options or {}) - set(known)):
        there = f"known are {list(known)}" if known else "there are none"
        raise ValueError(f"reset: unknown options {unknown}; {there}.")


def check_no_horizon(options: dict[str, Any]) -> None:
    """Checks that a time limit comes as Gymnasium's, whose own would go before it unseen.

    Raises:
        ValueError: it is an option of the task.
    """
    if "horizon" in options:
        raise ValueError(
            "Gymnasium's time limit is max_episode_steps=, of gymnasium.make and make_vec; got"
            f" horizon={options['horizon']}."
        )


def time_limit(steps: int | None, own: int | None) -> int | None:
    """The horizon of `max_episode_steps`, which is None for that of the task and −1 for none.

    Raises:
        ValueError: it is another number, and no count.
    """
    if steps is None:
        return own
    if steps == -1:
        return None
    checks.count("VectorEnv", "max_episode_steps", steps)
    return steps


def check_saved(saved: Any, like: Any) -> None:
    """Checks that what is to be restored has the arrays that are expected.

    Args:
        saved: a pytree of arrays.
        like: the shapes and dtypes of such a tree.

    Raises:
        ValueError: it has others.
    """

    def arrays(tree: Any) -> dict[str, str]:
        leaves = jax.tree_util.tree_leaves_with_path(tree)
        return {jax.tree_util.keystr(path): f"{x.dtype}{x.shape}" for path, x in leaves}

    found, wanted = arrays(saved), arrays(like)
    for name in [*wanted, *found]:
        if found.get(name) != wanted.get(name):
            raise ValueError(
                "restore: what was saved is of another task, precision or number of copies: it has"
                f" {name} as {found.get(name)}, and {wanted.get(name)} is expected."
            )


def key_from(random: np.random.Generator) -> Array:
    """A key of JAX drawn from Gymnasium's generator, as an array that can be saved."""
    return jax.random.PRNGKey(random.integers(2**32, dtype=np.uint32))


def warn_of_no_mode() -> None:
    """As Gymnasium warns of pictures that nobody asked for."""
    gymnasium.logger.warn(
        f"render was called without a mode; make the environment with render_mode='{PICTURES}'."
    )
