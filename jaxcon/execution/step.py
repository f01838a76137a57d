"""`jc.step` and `jc.forward_dynamics`, which check their input and then call `shell`."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Violation
from jaxcon.contact.newton import Newton
from jaxcon.contact.rows import Reactions
from jaxcon.core import checks
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.execution.shell import masked_step, solve_at
from jaxcon.execution.validation import check_step
from jaxcon.linear.saddle import Solution
from jaxcon.methods.method import Method
from jaxcon.methods.stability import warn_if_unstable
from jaxcon.protocols import System
from jaxcon.staging import batch_last
from jaxcon.step import Origin, StepInfo, without_memory
from jaxcon.system.state import MethodMemory, State

Info = TypeVar("Info", bound="StepInfo | SolutionAt")


def _contact_multipliers(state: State) -> Array | None:
    """Returns the multipliers of limits and contacts in a state's memory; None without them."""
    memory = MethodMemory(*state.memory)
    return memory.contact_multipliers if memory.has_contact_multipliers else None


def _start(args: tuple[System, Method, State, PyTree, Array]) -> Array | None:
    """Returns the multipliers from which a step iterates until the laws are met; None otherwise."""
    system, method, state, *_ = args
    start = _contact_multipliers(state)
    if start is None or not system.bounds or method.events is not None:
        return None
    solver = method.contact_solver_for(system, state)
    return start if isinstance(solver, Newton) and solver.warm else None


GUESS = (_start, lambda result: _contact_multipliers(result[0]))
"""A step starts its contact solver from the multipliers of the last step; its derivative starts
from those of the step."""


def step(
    system: System, method: Method, state: State, control: PyTree, dt: Scalar
) -> tuple[State, StepInfo]:
    """Advances a state by one step. A pure function for jit, vmap, grad, jvp and scan.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabilizer and solvers.
        state: from `Scene.build` or `init`.
        control: control input u, (n_u,), with the channels of `system.layout.controls`; for
            generalized coordinates, the pytree that the user's force takes. None if no motor needs
            a control.
        dt: step size h, () [s]; not negative.

    Shapes and dtypes are always checked. Values are checked if they are Python or NumPy numbers.
    JAX arrays are not checked, since a device may still be computing them; a bad value in one stops
    the world with a status.

    Returns:
        The new state, and the `StepInfo` of the step. A world that fails keeps its last finite
        state, has the reason in `status`, and has zero gradient. Other worlds are not affected.

    Raises:
        ValueError: shapes or dtypes disagree (at trace time), or a motor has no control.
        TypeError: an argument has another type, such as a class in place of a method.
    """
    given = _checked("step", system, method, state, control, dt)
    with checks.without_waiting():  # dt as given, since an array made of it is traced under jit
        warn_if_unstable(method, dt, system, state)
    return _reported(batch_last.call(masked_step, *given, guess=GUESS), system, state, given[3])


def step_quietly(
    system: System, method: Method, state: State, control: PyTree, dt: Scalar, owner: str = "step"
) -> tuple[State, StepInfo]:
    """Steps without a warning about unstable gains; errors name `owner`, a public function."""
    given = _checked(owner, system, method, state, control, dt)
    return _reported(batch_last.call(masked_step, *given, guess=GUESS), system, state, given[3])


def _checked(
    owner: str, system: System, method: Method, state: State, control: PyTree, dt: Scalar
) -> tuple[System, Method, State, PyTree, Array]:
    """Checks the arguments of a step; returns the arguments of `masked_step`, as arrays."""
    control = check_step(system, method, state, control, owner)
    h = _step_size(owner, state, dt)
    with checks.without_waiting():
        method = method.known_at(dt, state.q.dtype)
    return system, method, state, control, h


def _step_size(owner: str, state: State, dt: Scalar) -> Array:
    """Returns h as an array; NaN, which ends the world, for a negative array, which is not read."""
    with checks.without_waiting():
        h = checks.real(owner, "dt", dt, state.q.dtype, least=0)
    return jnp.where(h >= 0, h, jnp.full_like(h, jnp.nan)) if isinstance(dt, jax.Array) else h


def _reported(
    result: tuple[State, StepInfo], system: System, state: State, control: PyTree
) -> tuple[State, StepInfo]:
    """Adds state, control and system to the info of a step. Returns the new state and the info.

    This happens outside of the compiled step, so that a rollout carries state, control and system
    only if it records them.
    """
    new, info = result
    where = without_memory(state) if info.state is None else info.state
    return new, with_origin(dataclasses.replace(info, state=where, control=control), system)


def with_origin(info: Info, system: System) -> Info:
    """Returns a copy of an info, with the system as its `origin`."""
    info = copy.copy(info)
    object.__setattr__(info, "origin", Origin(system))
    return info


def undo(system: System, method: Method, state: State, control: PyTree, dt: Scalar) -> State:
    """Undoes a step of h: steps back by −h from `state`, with a symmetric integrator.

    The `turns` of the result are extrapolated back from the end of the step, so they differ from
    the original ones. Both are within half a turn of the true angles, so the same whole turns are
    counted.
    """
    control = check_step(system, method, state, control, "rollout")
    with checks.without_waiting():
        h = checks.real("rollout", "dt", dt, state.q.dtype)
    return batch_last.call(masked_step, system, method, state, control, -h)[0]


@jax.tree_util.register_pytree_node_class
class SolutionAt(Solution):
    """A `Solution` with the state at which it was computed; unpacks as `a, λ, status`.

    Attributes:
        state: the state, without the memory of a method.
        violation: φ and φ̇ by constraint.
        reactions: forces of limits, friction and contact; None in a scene without them.
        control: control u.
        origin: the system, for `jc.wrench`; see `StepInfo.origin`.
    """

    state: Any = None
    violation: Any = None
    reactions: Any = None
    control: Any = None
    origin: Any = None

    def __new__(
        cls,
        acceleration: Array,
        multipliers: Array,
        status: Array,
        state: State | None = None,
        violation: Violation | None = None,
        reactions: Reactions | None = None,
        control: PyTree = None,
    ) -> SolutionAt:
        """Makes a solution from its fields; `origin` is None at first."""
        solution = super().__new__(cls, acceleration, multipliers, status)
        solution.state, solution.violation = state, violation
        solution.reactions, solution.control = reactions, control
        return solution

    def _replace(self, **changes: Any) -> SolutionAt:  # type: ignore[override]
        """Returns a solution with other a, λ or status, at the same state."""
        solution = type(self)(*super()._replace(**changes), *self._place())
        solution.origin = self.origin
        return solution

    def _place(self) -> tuple[Any, ...]:
        return self.state, self.violation, self.reactions, self.control

    def tree_flatten(self) -> Any:
        """Returns (children, None), since there is no static data.

        The children are a, λ, status, and the fields from `state` to `control`.
        """
        return (*self, *self._place()), None

    @classmethod
    def tree_unflatten(cls, _: None, children: tuple[Any, ...]) -> SolutionAt:
        """Rebuilds the solution from its children, without `origin`."""
        return cls(*children)


def forward_dynamics(
    system: System, state: State, control: PyTree, method: Method, dt: Scalar
) -> SolutionAt:
    """Returns a and λ at a state, with the method's feedback of φ and φ̇ at this state.

    With inequality constraints, a is the mean acceleration over a step of size h, which includes
    the impulses of impacts divided by h.

    To read the forces at a state, use `Unstabilized()`. Feedback adds forces. It also reacts to
    φ̇ = ½hγ, which semi-implicit Euler leaves in every step.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: the state at which to solve.
        control: control input u, as in `jc.step`.
        method: the method, whose stabilizer and solvers are used.
        dt: step size h, () [s], on which default gains and inequality constraints depend.

    Returns:
        A `Solution` that unpacks as `a, λ, status`: acceleration (n_v,) [m/s², rad/s²], multipliers
        (n_c,) [N, N m] and status (). It also has the fields `state`, `control`, `violation` and
        `reactions`.

    A world whose solution fails has zero gradient.

    Raises:
        ValueError: shapes or dtypes disagree (at trace time), or a motor has no control.
        TypeError: an argument has another type, such as a class in place of a method.
    """
    return forward_dynamics_for("forward_dynamics", system, state, control, method, dt)


def forward_dynamics_for(
    owner: str, system: System, state: State, control: PyTree, method: Method, dt: Scalar
) -> SolutionAt:
    """Implements `forward_dynamics`; errors name `owner`, the public function that was called."""
    control = check_step(system, method, state, control, owner)
    given = (system, method, state, control, _step_size(owner, state, dt))
    (a, λ, status), violation, reactions = batch_last.call(solve_at, *given)
    where = without_memory(state)
    return with_origin(SolutionAt(a, λ, status, where, violation, reactions, control), system)
