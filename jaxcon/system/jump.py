"""Jumps of velocity by impacts, which an integrator adds at the end of a step."""

from __future__ import annotations

from jaxcon.core import numerics
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.linear.saddle import Solution


@pytree
class Jump:
    """The change of velocity and displacement by impacts, at the end of a step.

    Attributes:
        velocity: Δv + (a⁺ − a⁻) r, (n_v,), with the impulses' velocity change Δv, accelerations a
            before and after the impact, and the time r from the impact to the end of the step.
        travel: the change of the displacement of the step, (n_v,) [m, rad].
    """

    velocity: Array
    travel: Array


def with_jump(solution: Solution, jump: Jump | None, dt: Array) -> Solution:
    """Adds the velocity change of a jump, divided by dt, to the acceleration of a solution."""
    if jump is None:
        return solution
    a = solution.acceleration + numerics.safe_divide(jump.velocity, dt[None])
    return solution._replace(acceleration=a)
