"""Status codes, one for each world, that work under jit and vmap, and their meanings."""

from enum import IntEnum

import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import Array, PyTree


class Status(IntEnum):
    """The status codes of a world.

    Codes from 1 to below `CONFLICT` are failures: the world stops. Codes from `CONFLICT` on are
    notes: the world continues.

    Attributes:
        OK: no failure and no note.
        NON_FINITE: a state, force or parameter is NaN or infinite, or velocities are beyond 1e10.
        SINGULAR: constraint rows are dependent, or the mass matrix is not positive definite.
        NOT_CONVERGED: an iteration did not reach its tolerance.
        VIOLATED: constraint errors stayed above the limit of a `Recovery`.
        LOST_TURNS: a joint turned too far in a step to count its whole turns.
        LOST_IMPACTS: a joint rebounds through its whole range within a step.
        CONFLICT: constraints contradict each other; the least-squares solution was used.
        ROLLED_BACK: a `Recovery` restored the state before the step.
        PROJECTED: a `Recovery` projected the state before the step onto the constraints.
        RELAXED: a `Recovery` took the step with weaker feedback.
    """

    OK = 0
    NON_FINITE = 1
    SINGULAR = 2
    NOT_CONVERGED = 3
    VIOLATED = 4
    LOST_TURNS = 5
    LOST_IMPACTS = 6
    CONFLICT = 16
    ROLLED_BACK = 17
    PROJECTED = 18
    RELAXED = 19


_CONFLICT, _RELAXED = int(Status.CONFLICT), int(Status.RELAXED)
"""Codes as plain integers: outside jit, JAX promotes an array and a `Status` to int64."""

REPAIRS = (Status.ROLLED_BACK, Status.PROJECTED, Status.RELAXED)
"""The codes of steps that a `Recovery` repaired."""


MEANING = {
    Status.NON_FINITE: "a state, its time, a force or a parameter is NaN or infinite, velocities"
    " are beyond 1e10, h is negative, a quaternion is zero, or a mass matrix is not symmetric;"
    " likely (a) a step too large for the fastest motion, (b) a NaN in the control or parameters,"
    " (c) an unstable gain, (d) a start far off the constraints under gains that are not gentle",
    Status.SINGULAR: "the constraint rows are dependent, or the mass matrix is not positive"
    " definite; `report` names redundant rows; likely (a) a closed spatial loop of revolute joints,"
    " (b) the same constraint twice, (c) a singular position of the mechanism, (d) a motion that"
    " had grown without bound before, as under unstable gains; rows that agree are solved by"
    " `RankSafe()`, the solver of a `Method` that names none",
    Status.NOT_CONVERGED: "an iteration did not reach its tolerance; likely (a) too few iterations,"
    " (b) a tolerance below what rounding allows, (c) a start too far off the constraints,"
    " (d) redundant rows that contradict each other, (e) a step too large for the fastest motion",
    Status.CONFLICT: "constraints contradict each other; the world goes on by least squares;"
    " `report` names them",
    Status.VIOLATED: "constraints are off by more than the limit of the method's Recovery, which"
    " tried again as often as it may; likely (a) a step too large, (b) an unstable gain,"
    " (c) constraints that contradict each other",
    Status.LOST_TURNS: "a joint turned further in a step than its count of whole turns can tell, so"
    " that servos, springs, limits and couplings on its angle would be off by turns; likely (a) a"
    " step too large for the speed or the acceleration of the joint, (b) a servo or spring too"
    " stiff for the inertia behind it, (c) a velocity in the wrong unit",
    Status.LOST_IMPACTS: "a joint rebounds from a stop so fast that it would pass the other one in"
    " the same step, which sees one impact of a stop; likely (a) a step too large for the speed of"
    " the joint, (b) a range too small, (c) a velocity in the wrong unit",
    Status.ROLLED_BACK: "a step failed: the world went back to the state before it",
    Status.PROJECTED: "steps failed: the world went back to the valid configuration nearest to the"
    " state before them",
    Status.RELAXED: "a step was taken with weaker feedback, after one that failed",
}


class SimulationError(RuntimeError):
    """The error of a failed simulation; the message names the world and the reason."""


def failed(code: Array) -> Array:
    """Returns a mask of the failed worlds, given the status code of each world.

    Failed worlds stop and keep their last finite state. Codes that `Status` does not have count as
    failures, too.
    """
    return (code != 0) & ((code < _CONFLICT) | (code > _RELAXED))


def failures(code: Array) -> Array:
    """Returns the status codes of failed worlds, and OK for all other worlds."""
    return jnp.where(failed(code), code, Status.OK).astype(code.dtype)


def first(earlier: Array, later: Array) -> Array:
    """Returns the more severe of two status codes; of equally severe codes, the earlier one.

    A failure is more severe than a conflict, and a conflict more severe than a repair.
    """
    conflict = (later == _CONFLICT) & (earlier > _CONFLICT)
    graver = failed(later) & ~failed(earlier) | conflict
    return jnp.where((earlier == 0) | graver, later, earlier)


def raise_for_status(result: PyTree) -> None:
    """Raises an error if any world failed or has contradictory constraints; call it outside jit.

    Args:
        result: a State, StepInfo or Solution, of one world or a batch.

    Raises:
        TypeError: the result has no status.
        SimulationError: a status is neither OK nor a repair; the message names world, code and
            likely causes.
    """
    try:
        status = np.asarray(getattr(result, "status", result))
    except (TypeError, ValueError):
        status = np.asarray(None)
    if status.dtype.kind not in "iu":
        raise TypeError(
            "raise_for_status: result must have a status, as a State, StepInfo or Solution, got"
            f" {type(result).__name__}."
        )
    bad = np.argwhere(~np.isin(np.atleast_1d(status), (Status.OK, *REPAIRS)))
    if bad.size:
        number = int(np.atleast_1d(status)[tuple(bad[0])])
        named = number in Status.__members__.values()
        name = Status(number).name if named else f"status {number}"
        meaning = MEANING[Status(number)] if named else "no Status has this code"
        where = "" if status.ndim == 0 else f" in {len(bad)} of {status.size} worlds"
        index = "" if status.ndim == 0 else f", first in world {tuple(map(int, bad[0]))}"
        times = getattr(result, "time", None)
        when = "" if times is None else f", at t = {float(np.atleast_1d(times)[tuple(bad[0])]):g} s"
        raise SimulationError(f"{name}{where}{index}{when}: {meaning}.")
