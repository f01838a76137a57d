"""One step of a constrained system: the algorithm.

    M a = f + Jᵀλ,    J a + C λ = b

M is the mass matrix, f the forces, J = ∂φ̇/∂v the Jacobian of the constraints φ, and λ their
multipliers. A step

    1. linearizes the constraints, φ̈ = J a + γ    `Dynamics.linearize`
    2. asks the stabilizer for b and C             `Stabilizer.constraint_equations`
    3. assembles M, f, J, C, b                     `Dynamics.assemble`
    4. solves for a and λ                          `Solver.factor`
    5. advances q and v                            `Integrator.advance`
    6. updates the stabilizer's memory             `Stabilizer.advance`, `Stabilizer.remember`
    7. corrects q and v                            `Stabilizer.correct`
    8. reports                                     `StepInfo`

`Dynamics.solve` does 2 to 4. An explicit integrator does 1 to 4 at each of its stages, by calling
`Dynamics`; `RATTLE` and `GeneralizedAlpha` solve equations of their own. The memory, such as ∫φ or
the last λ, is the same at all stages of a step. Limits, friction and contact add a force J_bᵀλ_b,
with λ_b from the contact solver, once a step; see `contact.response`.

Arrays belong to one world, or have one more axis at the end for a batch. This module does not check
input, vectorize, mask failed worlds or stage kernels; `execution` does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.joint_trees import tree_equations, tree_without_contact
from jaxcon.constraints.rows import Rows, Violation, keeps_rows, linearize, saddle
from jaxcon.core import status
from jaxcon.core.doubled import Doubled
from jaxcon.core.pytree import pytree
from jaxcon.core.status import Status
from jaxcon.core.summary import Stacked, codes, listed, shape, span, table
from jaxcon.core.typing import Array, PyTree
from jaxcon.linear.saddle import Factored, Saddle, Solution
from jaxcon.protocols import Solver, Stabilizer, System
from jaxcon.staging.worlds import where_tree
from jaxcon.system.jump import with_jump
from jaxcon.system.state import MethodMemory, State, at_instant, is_finite

if TYPE_CHECKING:
    from jaxcon.contact.parts import StepPart
    from jaxcon.contact.response import Response
    from jaxcon.methods.method import Method


@dataclass(frozen=True, eq=False)
class Origin:
    """The system of an info, which `jc.wrench` needs.

    An `Origin` is not a pytree, so JAX transformations drop it. Steps therefore need not carry the
    system for wrenches that are never read.
    """

    system: System

    def __reduce__(self) -> tuple[Callable[[], None], tuple[()]]:
        """Pickles as None, so that a pickled info does not contain the system."""
        return _nothing, ()


def _nothing() -> None:
    """Returns None, in place of a pickled origin."""


@pytree
class StepInfo(Stacked):
    """Accelerations, multipliers and violation at the start of a step; zeros in a failed world.

    Recorded infos have leading axes, as trajectories of states do: `len(infos)`, `infos[10]`.

    Attributes:
        acceleration: a, (n_v,) [m/s², rad/s²].
        multipliers: λ, (n_c,), in units of work per unit of φ [N, N m].
        violation: φ [m, rad] and φ̇ [m/s, rad/s] by constraint, at the start of the step.
        status: status of this step; in a world that has stopped, the reason for the stop, ().
        reactions: forces of limits, friction and contact; None in a scene without them.
        impacts: impacts at which the step was split; None without `Events`, and in a scene that has
            no hard stops, ropes or contacts.
        state: the state to which a and λ belong, without the memory of the method. It is the state
            before the step, or with `GeneralizedAlpha` the end of the step.
        control: control u of the step.
    """

    # not a field: `jit` would return it and scans would carry it, but few wrenches are read;
    # `execution.step.with_origin` sets it on an instance
    origin: ClassVar[Origin | None] = None
    """The system, for `jc.wrench`; None if JAX has rebuilt the info, as `jit` and indexing do."""

    acceleration: Array
    multipliers: Array
    violation: Violation
    status: Array
    reactions: Any = None
    impacts: Any = None
    state: Any = None
    control: Any = None

    def leading(self) -> tuple[int, ...]:
        """Returns the shape of the leading axes; () for one world."""
        return np.shape(self.status)

    def __repr__(self) -> str:
        """Returns a table of time, status, shapes, names of elements with forces, and violation."""
        φ = getattr(self.violation, "position", None)
        has_values = isinstance(φ, jax.Array | np.ndarray)
        names = listed(self.violation.layout.names) if has_values else ""
        reactions = self.reactions if isinstance(self.reactions, Mapping) else None
        rows = [
            ("time", span(self.state.time, "s") if isinstance(self.state, State) else ""),
            ("status", codes(self.status)),
            ("acceleration", shape(self.acceleration)),
            ("multipliers", f"{shape(self.multipliers)} of {names}" if names else ""),
            ("reactions", "" if reactions is None else f"of {listed([*reactions])}"),
            ("violation", f"worst {span(self.violation.worst, 'm or rad')}" if names else ""),
        ]
        return table("StepInfo", rows)

    def of_failed_world(self, state: State) -> StepInfo:
        """Returns the info of a failed world: zeros, no impacts, and the state before the step."""
        blank = jax.tree.map(jnp.zeros_like, self)
        if self.impacts is not None:
            blank = dataclasses.replace(blank, impacts=self.impacts.none())
        if self.state is not None:
            blank = dataclasses.replace(blank, state=without_memory(state))
        return blank


def step(
    system: System,
    method: Method,
    state: State,
    control: PyTree,
    dt: Array,
    part: StepPart | None = None,
) -> tuple[State, StepInfo]:
    """Advances a state by one step.

    Args:
        system: bodies or generalized coordinates, constraints and forces.
        method: integrator, stabilizer and solvers.
        state: the state at the start of the step, with angles reduced by whole turns.
        control: u, as arrays.
        dt: h, () [s].
        part: the part to advance if the step is split at impacts; None for the whole step.

    Returns:
        The new state and the info of the step. `info.status` is the status of this step alone.
    """
    length = dt if part is None else part.length
    memory = MethodMemory(*state.memory)

    # 1 to 5: linearize, constraint equations, assemble, solve, advance
    dynamics = method.dynamics(system, state, control, dt, part)
    advanced = method.integrator.advance(dynamics, state, memory.integrator, length)
    (q, v, time), solution, rows, *_ = advanced
    end = at_instant(dataclasses.replace(state, q=q, v=v), reached(state, time, length))

    # 6: update the memory, once a step and over all of dt. If impacts split the step, each part
    # starts from the memory before the step, and only the memory of the last part is kept.
    stabilizer = dynamics.stabilizer
    integrals = stabilizer.advance(rows, memory.stabilizer, dt)
    remembered = stabilizer.remember(integrals, solution)

    # 7: correct
    new, correction = stabilizer.correct(system, method.solver, state, end, remembered, length)

    # 8: report
    reactions = rows.reactions
    if state.memory:
        contact_λ = memory.contact_multipliers
        if reactions is not None and len(contact_λ) == len(reactions.multipliers):
            hit = reactions.lasting is not None
            contact_λ = reactions.lasting if hit else reactions.multipliers
        parts = MethodMemory(advanced.memory, remembered, memory.recovery, contact_λ)
        new = dataclasses.replace(new, memory=parts)
    finite = jnp.where(is_finite(new), Status.OK, Status.NON_FINITE).astype(jnp.int32)
    code = status.first(status.first(solution.status, finite), correction)
    if jax.tree.leaves(remembered):
        code = status.first(code, judge_memory(remembered, new.status))
    if reactions is not None:
        reactions = reactions.without_jump()
    a, λ, _ = solution
    where = without_memory(end) if advanced.ends else None
    return new, StepInfo(a, λ, rows.violation, code, reactions, state=where)


@pytree
class Dynamics:
    """The equations M a = f + Jᵀλ, J a + C λ = b of a step; `dynamics(q, v, t)` solves them.

    Attributes:
        system: the system, with the whole turns of the state.
        stabilizer: the stabilizer, with all gains set.
        solver: the solver of the saddle system.
        control: u.
        memory: the stabilizer's memory.
        dt: h, () [s].
        contact: the response of limits, friction and contact; None in a scene without them.
        constant_force: a force that is constant during the step, (n_v,); None for none.
    """

    system: System
    stabilizer: Stabilizer
    solver: Solver
    control: PyTree
    memory: PyTree
    dt: Array
    contact: Response | None = None
    constant_force: Array | None = None

    def __call__(self, q: Array, v: Array, t: Doubled | Array) -> tuple[Solution, Rows]:
        """Solves for a and λ at (q, v, t); returns them with the rows.

        With contact, a and λ are means over the step.

        Args:
            q: positions, (n_q,).
            v: velocities, (n_v,).
            t: time, () [s].
        """
        solved = self.solve(self.linearize(q, v, t), q, v, t)
        return with_jump(solved.solution, solved.rows.jump, self.dt), solved.rows

    def linearize(self, q: Array, v: Array, t: Doubled | Array) -> Rows:
        """Returns the rows at one instant: φ, φ̇, J, γ, M, and the inequality rows of the step.

        Args:
            q: positions, (n_q,).
            v: velocities, (n_v,).
            t: time, () [s].
        """
        inequalities = None
        if self.contact is not None:
            inequalities = partial(self.contact.rows, control=self.control, dt=self.dt)
        rows = linearize(self.system, q, v, t, inequalities)
        return dataclasses.replace(rows, mass=self.system.mass(q))

    def assemble(self, rows: Rows, q: Array, v: Array, t: Doubled | Array) -> Saddle:
        """Returns the saddle system M a = f + Jᵀλ, J a + C λ = b.

        Args:
            rows: the rows, with a target b.
            q: positions, (n_q,).
            v: velocities, (n_v,).
            t: time, () [s].
        """
        force = self.system.force(q, v, t, self.control)
        for extra_force in (rows.force, self.constant_force):
            force = force if extra_force is None else force + extra_force
        return saddle(self.system, q, rows, force, rows.right_hand_side, rows.noise)

    def solve(
        self,
        rows: Rows,
        q: Array,
        v: Array,
        t: Doubled | Array,
        rate_delay: Array | None = None,
        every_landing: bool = False,
    ) -> Solved:
        """Solves for a and λ at a linearized point; impacts are not in a, but in `rows.jump`.

        Args:
            rows: from `linearize`.
            q: positions, (n_q,).
            v: velocities, (n_v,).
            t: time, () [s].
            rate_delay: delay τ, () [s]: feedback acts on φ̇ at the time t − τ; None for no delay.
            every_landing: True to resolve landings (impacts without rebound) as impacts, whichever
                contact solver is used.
        """
        observed = rows if rate_delay is None else rows.earlier(rate_delay)
        equations = self.stabilizer.constraint_equations(observed, self.memory, self.dt)
        system = self.assemble(equations, q, v, t)
        if self.contact is not None:
            delayed = rate_delay is not None
            return Solved(
                *self.contact.solve(self, rows, system, (q, v, t), delayed, every_landing)
            )
        solution = self.stabilizer.solve(self.solver, observed, self.memory, self.dt, system)
        if solution is not None:
            return Solved(self.system.complete(solution), rows)
        hard = keeps_rows(system, rows)
        factored = self.factor(system, q, v, hard)
        solution = self.system.complete(factored(system.force, system.target))
        return Solved(solution, rows, lambda b: factored(jnp.zeros_like(system.force), b))

    def factor(self, system: Saddle, q: Array, v: Array, hard: bool) -> Factored:
        """Factors the saddle system: along the joints of a robot, elsewhere by the solver.

        Args:
            system: the saddle system.
            q: positions, (n_q,).
            v: velocities, (n_v,).
            hard: False if the stabilizer has made joints compliant, as `Penalty` does.
        """
        tree = None
        if hard:
            tree = tree_without_contact(self.system, self.solver, self.stabilizer, system)
        if tree is None:
            return self.solver.factor(system)
        return tree_equations(self.system, q, v, tree, system).solver(system)

    def at_step_start(
        self, q: Array, v: Array, t: Doubled | Array
    ) -> tuple[Solution, Rows, Dynamics]:
        """Returns a, λ and the rows at the start of a step, and the dynamics of its other stages.

        Contact is solved once a step; the contact force is constant in the other stages. Impacts
        are not in a, but in `rows.jump`, which the integrator adds at the end of the step.

        Args:
            q: positions, (n_q,).
            v: velocities, (n_v,).
            t: time, () [s].
        """
        rows = self.linearize(q, v, t)
        solution, rows, *_, force = self.solve(rows, q, v, t, every_landing=True)
        if self.contact is None:
            return solution, rows, self
        rest = dataclasses.replace(self, contact=None, constant_force=force)
        return solution, rows, rest


class Solved(NamedTuple):
    """The solution at one point of a step.

    Attributes:
        solution: a and λ.
        rows: the constraints at this point, with the reactions of inequality rows.
        solve_rows: function of b that returns the smallest a, in the metric of M, with J a + C λ =
            b. It uses the factors of the step and does not call `System.complete`. None if the
            stabilizer has its own `solve`.
        one_sided_force: force of limits and contacts, (n_v,), which may leave out their friction;
            None without inequality rows.
        contact_force: force of all inequality rows, (n_v,); None without inequality rows.
    """

    solution: Solution
    rows: Rows
    solve_rows: Callable[[Array], Solution] | None = None
    one_sided_force: Array | None = None
    contact_force: Array | None = None


class Advanced(NamedTuple):
    """The end of a step, and the solution of the equations of motion.

    Attributes:
        point: q (n_q,), v (n_v,) and the time () [s] at the end of the step. The time is
            `state.instant + dt`, which includes the rounding error, or a rounded number.
        solution: a and λ.
        rows: the constraints at the start of the step.
        memory: the integrator's new memory.
        ends: True if a and λ belong to the end of the step, False if they belong to its start.
    """

    point: tuple[Array, Array, Any]
    solution: Solution
    rows: Rows
    memory: PyTree = ()
    ends: bool = False


def reached(state: State, time: Doubled | Array, dt: Array) -> Doubled:
    """Returns the time at the end of a step with its rounding error.

    The rounding error is known if the time is a `Doubled` or equals `state.time + dt`; otherwise it
    is set to zero.

    Args:
        state: the state at the start of the step.
        time: the time in `Advanced.point`, rounded or not, () [s].
        dt: the length of the step, () [s].
    """
    if isinstance(time, Doubled):
        return time
    return where_tree(time == state.time + dt, state.instant + dt, Doubled.of(time))


def without_memory(state: State) -> State:
    """Returns the state without the memory of a method."""
    return dataclasses.replace(state, memory=())


def judge_memory(memory: PyTree, status: Array) -> Array:
    """Returns NON_FINITE where an array of the stabilizer's memory is not finite, else OK, ().

    Without this check, the next step would fail, and the derivative of this step would be NaN.

    Args:
        memory: floating-point arrays, with the batch axes of the status at the end.
        status: status of the world, of which only the shape is used.
    """
    good, axes = jnp.ones_like(status, bool), status.ndim
    for x in jax.tree.leaves(memory):
        good &= jnp.all(jnp.isfinite(x), axis=tuple(range(x.ndim - axes)))
    return jnp.where(good, Status.OK, Status.NON_FINITE).astype(jnp.int32)
