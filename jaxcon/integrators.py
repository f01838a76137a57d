"""Integrators, and the split of steps at impacts.

Order 1: SemiImplicitEuler, ExplicitEuler.
Runge-Kutta: Heun, RK4, Dopri5, Dopri8, RungeKutta.
Implicit in the constraints: RATTLE, GeneralizedAlpha.
Steps split at impacts: Events, Impacts.
"""

from jaxcon.methods.events import Events, Impacts
from jaxcon.methods.generalized_alpha import GeneralizedAlpha
from jaxcon.methods.integrators import (
    RK4,
    Dopri5,
    Dopri8,
    ExplicitEuler,
    Heun,
    RungeKutta,
    SemiImplicitEuler,
)
from jaxcon.methods.rattle import RATTLE


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "SemiImplicitEuler",
    "ExplicitEuler",
    "Heun",
    "RK4",
    "Dopri5",
    "Dopri8",
    "RungeKutta",
    "RATTLE",
    "GeneralizedAlpha",
    "Events",
    "Impacts",
]
