"""The tasks by name."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from jaxcon.core import checks
from jaxcon.environments.environment import Environment
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
"""What builds each; Gymnasium knows them as "jaxcon/CartPole-v0" and so on."""


def make(task: str | Environment, **options: Any) -> Environment:
    """The environment of a task, as pure functions.

    Args:
        task: its name, or an environment, which is taken as it is.
        options: numbers and choices of the task's `build`.

    Raises:
        ValueError: an unknown task, options for an environment that is already built, or a skip or
            a horizon that is no whole number from 1.
        TypeError: an option that the task does not have.
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
    try:
        inspect.signature(TASKS[task]).bind(**options)
    except TypeError as error:
        known = list(inspect.signature(TASKS[task]).parameters)
        raise TypeError(f"task {task}: {error}; its options are {', '.join(known)}.") from error
    _check_numbers(task, options)
    built = TASKS[task](**options)
    checks.count(task, "skip", built.skip)
    if built.horizon is not None:
        checks.count(task, "horizon", built.horizon)
    return built


def _check_numbers(task: str, options: Mapping[str, Any]) -> None:
    """Checks the options whose usual values are numbers: sizes, masses, forces and the step.

    Raises:
        ValueError: one is negative or no number, or a choice that is no value of its kind.
    """
    known = inspect.signature(TASKS[task]).parameters
    for name, x in options.items():
        usual = known[name].default if name in known else None
        if isinstance(usual, float | tuple):
            limit: dict[str, Any] = {"above": 0} if name == "dt" else {"least": 0}
            checks.check(task, name, x, **limit)
        elif type(usual) is int:
            checks.count(task, name, x)


def horizon(task: str) -> int:
    """Actions until an episode of a task is truncated, unless told otherwise."""
    return inspect.signature(TASKS[task]).parameters["horizon"].default
