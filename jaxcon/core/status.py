"""What became of a world: codes that survive jit and vmap, and their meaning in words."""

from enum import IntEnum

import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import Array


class Status(IntEnum):
    """The first failure of a world; 0 is healthy."""

    OK = 0
    NON_FINITE = 1
    SINGULAR = 2
    NOT_CONVERGED = 3


MEANING = {
    Status.NON_FINITE: "a state, force or parameter is NaN or infinite; likely (a) a step too large"
    " for the fastest motion, (b) a NaN in the control or parameters, (c) an unstable gain",
    Status.SINGULAR: "the constraint rows are dependent, or the mass matrix is not positive"
    " definite; `report` names redundant rows; likely (a) a closed spatial loop of revolute joints,"
    " (b) the same constraint twice, (c) a singular position of the mechanism; rows that agree are"
    " solved by `Sparse(tikhonov=…)`",
    Status.NOT_CONVERGED: "an iterative solver did not reach its tolerance; likely (a) too few"
    " iterations, (b) a tolerance below what rounding allows, (c) redundant rows that contradict"
    " each other, to which `tikhonov` gives a solution",
}


class SimulationError(RuntimeError):
    """A world failed; the message names which and why."""


def first(earlier: Array, later: Array) -> Array:
    """The earlier code unless it is OK: the first failure sticks."""
    return jnp.where(earlier == Status.OK, later, earlier)


def raise_for_status(result: object) -> None:
    """Raises where a world failed. For use outside jit.

    Args:
        result: a State, StepInfo or Solution, of one world or a batch.

    Raises:
        SimulationError: some `status` is not OK; the message names world, code and likely causes.
    """
    status = np.asarray(getattr(result, "status", result))
    failed = np.argwhere(np.atleast_1d(status) != Status.OK)
    if failed.size:
        code = Status(int(np.atleast_1d(status)[tuple(failed[0])]))
        where = "" if status.ndim == 0 else f" in {len(failed)} of {status.size} worlds"
        index = "" if status.ndim == 0 else f", first in world {tuple(map(int, failed[0]))}"
        times = getattr(result, "time", None)
        when = (
            "" if times is None else f", at t = {float(np.atleast_1d(times)[tuple(failed[0])]):g} s"
        )
        raise SimulationError(f"{code.name}{where}{index}{when}: {MEANING[code]}.")
