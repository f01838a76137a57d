"""Environments for reinforcement learning: pure functions, and interfaces to Gymnasium and Brax.

    environment = jc.environments.make("CartPole")
    episode = environment.reset(key)
    episode, outcome = environment.step(episode, action)

If Gymnasium is installed (`pip install 'jaxcon[rl]'`), importing this module registers the tasks
for `gymnasium.make("jaxcon/CartPole-v0")` and `gymnasium.make_vec`.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from jaxcon.environments.copies import Copies, advance, begin, restart
from jaxcon.environments.curricula import (
    by_performance,
    decay,
    jitter,
    vary,
    warm_up,
    with_stiffness,
)
from jaxcon.environments.environment import Channel, Environment, Episode, Outcome, near
from jaxcon.environments.exploration import feasible_action
from jaxcon.environments.layers import Layered
from jaxcon.environments.registry import TASKS, make
from jaxcon.environments.returns import returns
from jaxcon.environments.tasks.cart_pole import CartPole
from jaxcon.environments.tasks.cat import CatRighting
from jaxcon.environments.tasks.cheetah import HalfCheetah
from jaxcon.environments.tasks.four_bar import FourBarTracking
from jaxcon.environments.tasks.hopper import FiveBarHopper
from jaxcon.environments.tasks.parking import Parking
from jaxcon.environments.tasks.rope_swing import RopeSwing
from jaxcon.environments.tasks.stewart import StewartBalancing

__all__ = [
    "TASKS",
    "CartPole",
    "CatRighting",
    "Channel",
    "Copies",
    "Environment",
    "Episode",
    "FiveBarHopper",
    "FourBarTracking",
    "HalfCheetah",
    "Layered",
    "Outcome",
    "Parking",
    "RopeSwing",
    "StewartBalancing",
    "advance",
    "begin",
    "by_performance",
    "decay",
    "feasible_action",
    "jitter",
    "make",
    "near",
    "restart",
    "returns",
    "vary",
    "warm_up",
    "with_stiffness",
]

ADAPTERS = {
    "BraxEnv": "brax",
    "FunctionalEnv": "functional",
    "GymnasiumEnv": "gym",
    "GymnasiumVectorEnv": "vector",
}
"""Classes that need Gymnasium or Brax, with their modules."""


def __getattr__(name: str) -> Any:
    """Imports a class that needs Gymnasium or Brax at its first use."""
    if name in ADAPTERS:
        return getattr(import_module(f"jaxcon.environments.{ADAPTERS[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Returns the public names, with the adapters whose library is installed."""
    needs = {name: "brax" if name == "BraxEnv" else "gymnasium" for name in ADAPTERS}
    return [*__all__, *(name for name, library in needs.items() if find_spec(library) is not None)]


if find_spec("gymnasium") is not None:
    from jaxcon.environments import gym

    gym.register()
