"""The registry of tasks by name."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from jaxcon.core import checks
from jaxcon.environments.environment import Environment, Option
from jaxcon.environments.tasks.cart_pole import CartPole, double_cart_pole
from jaxcon.environments.tasks.cat import CatRighting
from jaxcon.environments.tasks.cheetah import HalfCheetah
from jaxcon.environments.tasks.four_bar import FourBarTracking
from jaxcon.environments.tasks.hopper import FiveBarHopper
from jaxcon.environments.tasks.parking import Parking
from jaxcon.environments.tasks.rope_swing import RopeSwing
from jaxcon.environments.tasks.stewart import StewartBalancing

TASKS: dict[str, Callable[..., Environment]] = {
    "CartPole": CartPole.build,
    "CatRighting": CatRighting.build,
    "DoubleCartPole": double_cart_pole,
    "FiveBarHopper": FiveBarHopper.build,
    "FourBarTracking": FourBarTracking.build,
    "HalfCheetah": HalfCheetah.build,
    "Parking": Parking.build,
    "RopeSwing": RopeSwing.build,
    "StewartBalancing": StewartBalancing.build,
}
"""The builder of each task by name. In Gymnasium, tasks have names like "jaxcon/CartPole-v0"."""


def make(task: str | Environment, **options: Option) -> Environment:
    """Builds the environment of a task.

    Args:
        task: the name of a task, or an environment, which is returned unchanged.
        options: options of the task's `build`.

    Raises:
        ValueError: the task is unknown, the environment is already built but options are given, a
            number is negative, or `skip` or `horizon` is not a whole number from 1.
        TypeError: an option is not among those of the task.
    """
    if isinstance(task, Environment):
        if options:
            raise ValueError(
                f"{type(task).__name__} is built already: give its options {sorted(options)} to"
                " its build."
            )
        return task
    if not isinstance(task, str) or task not in TASKS:
        raise ValueError(f"task {task!r} is unknown; known are {', '.join(TASKS)}.")
    signature = inspect.signature(TASKS[task])
    try:
        signature.bind(**options)
    except TypeError as error:
        names = ", ".join(signature.parameters)
        raise TypeError(f"task {task}: {error}; its options are {names}.") from error
    # options with a number as default are sizes, masses, forces and steps; tasks check the others
    values: dict[str, Any] = options
    for name, x in values.items():
        default = signature.parameters[name].default if name in signature.parameters else None
        if isinstance(default, float | tuple):
            limit: dict[str, Any] = {"above": 0} if name == "dt" else {"least": 0}
            checks.check(task, name, x, **limit)
        elif type(default) is int:
            checks.count(task, name, x)
    built = TASKS[task](**options)
    checks.count(task, "skip", built.skip)
    if built.horizon is not None:
        checks.count(task, "horizon", built.horizon)
    return built


def horizon(task: str) -> int:
    """Returns the default horizon of a task: the number of actions that truncates an episode."""
    return inspect.signature(TASKS[task]).parameters["horizon"].default
