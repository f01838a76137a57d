"""The simulation method: integrator, stabilizer, solvers and optional parts in one value."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.contact.contact_default import default_contact_solver, first_multipliers
from jaxcon.contact.parts import StepPart
from jaxcon.contact.response import Response
from jaxcon.core import checks
from jaxcon.core.naming import public_name
from jaxcon.core.pytree import pytree
from jaxcon.core.summary import table
from jaxcon.core.typing import Array, DType, PyTree, Scalar
from jaxcon.linear.proximal import RankSafe
from jaxcon.methods.baumgarte import Baumgarte
from jaxcon.methods.choice import brief, choose
from jaxcon.methods.integrators import SemiImplicitEuler
from jaxcon.methods.stability import stable_rate
from jaxcon.protocols import ContactSolver, Integrator, Solver, Stabilizer, System
from jaxcon.step import Dynamics
from jaxcon.system.state import MethodMemory, State

if TYPE_CHECKING:
    from jaxcon.methods.events import Events
    from jaxcon.methods.recovery import Recovery

PARTS = (
    ("integrator", "default_gains", "SemiImplicitEuler()"),
    ("stabilizer", "constraint_equations", "Baumgarte()"),
    ("solver", "factor", "RankSafe()"),
    ("recovery", "repair", "Recovery()"),
    ("contact_solver", "smoothing", "InteriorPoint()"),
    ("events", "splits", "Events()"),
)
"""The fields of a `Method`: name, an attribute that the field's value must have, and an example."""
PROTOCOLS = {
    "integrator": Integrator,
    "stabilizer": Stabilizer,
    "solver": Solver,
    "contact_solver": ContactSolver,
}
"""The protocol that a user's class for a field derives from."""
OPTIONAL = ("recovery", "contact_solver", "events")
"""The fields of a `Method` that may be None."""


@pytree
class Method:
    """An integrator, a stabilizer and solvers; the defaults are for use without tuning.

    Attributes:
        integrator: `SemiImplicitEuler()`, `Heun()`, `RK4()`, or any `RungeKutta(a, b)`; `RATTLE()`
            and, for stiff scenes, `GeneralizedAlpha()`, which both satisfy the constraints without
            a stabilizer.
        stabilizer: `Baumgarte(…)`, `PID(…)`, `Projection(…)`, `Penalty(…)`, …, `Unstabilized()`.
        solver: solver of the saddle system: `RankSafe()`, or `Sparse()`, `Schur()`, `Dense()` or
            `ConjugateGradients()`, which need independent rows; `Priority(levels)` satisfies rows
            level by level.
        recovery: `Recovery(…)`, which repairs failed steps. If None, a world whose step fails
            stops.
        contact_solver: solver of the inequality constraints (limits, friction, contact).
            `InteriorPoint()` is exact; `Newton(…)`, for trees of bodies, and `GaussSeidel(…)` are
            cheap. `ActiveSet(…)` solves only a few of many rows, those nearest to becoming active.
            If None, the solver is chosen by the structure of the scene when the step is traced.
            Mechanisms with more than 24 rows that do not touch each other, such as robots on the
            floor, take `Newton()`, or `GaussSeidel()` if they have closed loops, particles,
            constraints other than joints and rotors, or user inequalities. Other scenes take
            `InteriorPoint()`. Scenes without inequality constraints compile no contact solver.
        events: `Events(…)`, which splits a step where a stop, rope or contact is hit. If None,
            steps are not split, and impacts are resolved within a step.
    """

    integrator: Integrator = SemiImplicitEuler()
    stabilizer: Stabilizer = Baumgarte()
    solver: Solver = RankSafe()
    recovery: Recovery | None = None
    contact_solver: ContactSolver | None = None
    events: Events | None = None

    def __repr__(self) -> str:
        """Returns a table of the fields, each as Python code without default arguments."""
        parts = ((f.name, getattr(self, f.name)) for f in dataclasses.fields(self))
        return table("Method", [(name, brief(x)) for name, x in parts if x is not None])

    @classmethod
    def auto(
        cls,
        system: System,
        state: State,
        batch: int = 1,
        platform: str | None = None,
        **parts: Any,
    ) -> Method:
        """Returns a method with a solver that suits the system's structure; `report` says why.

        If M is diagonal, the choice is `Sparse()`, elimination along the structure. It is `Schur()`
        (dense matrices) if elimination needs more operations or too long a program. It is
        `ConjugateGradients()` if both elimination and dense matrices need more than twenty times
        the operations of the iterations, or too much memory. If M is not diagonal, the choice is
        `Schur()`. `RankSafe` wraps the solver if constraints close loops or are linearly dependent
        in this state. The choice is deterministic.

        Args:
            system: a `BodySystem`, `GeneralizedSystem` or `Vakonomic`.
            state: the state of one world, not traced.
            batch: the number of worlds stepped together; the matrices of all must fit into memory.
            platform: "cpu", "gpu" or "tpu"; None for JAX's default backend.
            parts: the other fields of the method, by name.

        Raises:
            TypeError: the state is traced, or a part has an unknown name.
            ValueError: the state does not belong to the system, or the batch is not a count.
        """
        if "solver" not in parts:
            parts["solver"] = choose(system, state, batch, platform).solver
        return cls(**parts)

    def init(self, system: System, q: Array, v: Array) -> MethodMemory | tuple[()]:
        """Returns the memory at the start of a simulation: a `MethodMemory`, or () for none."""
        multipliers = first_multipliers(system, q, v, self.contact_solver)
        memory = self._memory_of_parts(system, q, v)._replace(contact_multipliers=multipliers)
        return memory if jax.tree.leaves(memory) else ()

    def _memory_of_parts(self, system: System, q: Array, v: Array) -> MethodMemory:
        """Returns the memory at the start, without the multipliers of inequality constraints."""
        repairs = () if self.recovery is None else self.recovery.init(system, q, v)
        return MethodMemory(
            self.integrator.init(system, q, v), self.stabilizer.init(system, q, v), repairs
        )

    def check_memory(self, system: System, state: State, owner: str = "step") -> None:
        """Checks that a state has the memory that this method needs.

        A state may have inequality multipliers that the contact solver does not use. It may lack
        them if the contact solver is the default: each step then starts its sweeps from λ = 0.

        Raises:
            ValueError: the memory is missing, or belongs to another method.
        """
        expected = self._memory_of_parts(system, state.q, state.v)
        sizes = 0, len(MethodMemory._fields)
        foreign = not isinstance(state.memory, tuple) or len(state.memory) not in sizes
        given = MethodMemory() if foreign else MethodMemory(*state.memory)
        others = given._replace(contact_multipliers=())
        warm = self.contact_solver is not None and self.contact_solver.warm and bool(system.bounds)
        missing = warm and not given.has_contact_multipliers
        if foreign or missing or not _same_arrays(expected, others):
            raise ValueError(
                f"{owner}: the state does not have the memory that this method keeps; start with"
                " state = jc.init(system, method, state.q, state.v)."
            )

    def resolve(self, system: System, state: State) -> Method:
        """Returns the method with a contact solver, if the system has inequality constraints.

        Args:
            system: any system; its leaves may be traced.
            state: the state of one world, or of a batch along trailing axes.
        """
        if self.contact_solver is not None or not system.bounds:
            return self
        return dataclasses.replace(self, contact_solver=self.contact_solver_for(system, state))

    def contact_solver_for(self, system: System, state: State) -> ContactSolver:
        """Returns the contact solver, by default the one that suits the structure of a system.

        Args:
            system: any system; its leaves may be traced.
            state: the state of one world, or of a batch along trailing axes.
        """
        if self.contact_solver is not None:
            return self.contact_solver
        return default_contact_solver(system, state.q, state.v)

    def known_at(self, dt: Scalar, dtype: DType) -> Method:
        """Returns the method with constant default gains if they cannot rise at this step size.

        In float32, default gains may rise in fast motions (`RisingBaumgarte`). They are then
        computed in every step, row by row. Above a certain step size they do not rise. If the step
        size is known outside of traces and large enough, the gains are computed here, once.

        Args:
            dt: step size h as the user gave it, () [s].
            dtype: floating-point type of the scene.
        """
        # a dt that is not a number is rejected elsewhere
        number = type(dt) is float or (type(dt) is int and abs(dt) < 2**53)
        kind = getattr(getattr(dt, "dtype", None), "kind", None)
        number = number or (kind in ("f", "i", "u") and np.shape(dt) == ())
        coarse = jnp.finfo(dtype).bits == 32 and self.integrator.has_rising_gains
        if not coarse or not number or not checks.is_concrete((dt, self.integrator)):
            return self
        gains = _steady_gains(self.integrator, float(dt), np.dtype(dtype))
        if gains is None:
            return self
        return dataclasses.replace(self, stabilizer=self.stabilizer.steady(gains))

    def stabilizer_for(self, dt: Array) -> Stabilizer:
        """Returns the stabilizer with all its gains set for the integrator and this step size.

        In float32, where rounding limits the default gains, they may rise (`RisingBaumgarte`).

        Args:
            dt: step size h, () [s].

        Raises:
            ValueError: dt is not a positive number.
        """
        checks.check("Method.stabilizer_for", "dt", dt, above=0)
        return self._stabilizer_for(dt)

    def _stabilizer_for(self, dt: Array) -> Stabilizer:
        """Returns `stabilizer_for` without a check, because a step may go back or stand still."""
        stabilizer = self.stabilizer
        coarse = jnp.finfo(jnp.result_type(dt)).bits <= 32
        if coarse and (limit := self.integrator.highest_rate(dt)) is not None:
            stabilizer = stabilizer.rising(limit)
        stabilizer = stabilizer.resolve(self.integrator.default_gains(dt))
        return stabilizer.cap_gains(functools.partial(stable_rate, self.integrator, dt))

    def dynamics(
        self, system: System, state: State, control: PyTree, dt: Array, part: StepPart | None = None
    ) -> Dynamics:
        """Returns the equations of motion for a step from a state.

        Args:
            system: system with the whole turns of the state.
            state: state at the start of the step.
            control: control input u.
            dt: step size h, () [s].
            part: the part to advance if the step is split at impacts; None for the whole step.
        """
        stabilizer, memory = self._stabilizer_for(dt), MethodMemory(*state.memory)
        if self.recovery is not None:
            stabilizer = self.recovery.relax(stabilizer, memory.recovery)
        contact = None
        if system.bounds:
            solver = self.contact_solver_for(system, state)
            is_warm = solver.warm and memory.has_contact_multipliers
            contact = Response(solver, memory.contact_multipliers if is_warm else None, part)
        return Dynamics(system, stabilizer, self.solver, control, memory.stabilizer, dt, contact)

    def check_system(self, system: System) -> None:
        """Checks that the integrator works with the stabilizer and the system.

        Raises:
            ValueError: the integrator does not work with them; the message says why.
        """
        reason = self.integrator.refuses(system, self.stabilizer)
        if system.bounds and not self.integrator.supports_inequalities:
            names = [name for group in system.bounds for name in group.names]
            reason = (
                f"it has no place for the inequality rows of {names}, which are solved once a step"
                " beside explicit forces; take SemiImplicitEuler() or a Runge–Kutta method"
            )
        if reason:
            raise ValueError(f"{type(self.integrator).__name__}: {reason}.")

    def irreversible(self) -> str | None:
        """Returns the reason why a step by −h does not undo a step by h; None if it does."""
        if not self.integrator.symmetric:
            return (
                f"{type(self.integrator).__name__} is not symmetric: a step by −h does not undo a"
                " step by h; RATTLE() is"
            )
        if self.recovery is not None:
            return "`Recovery` is not reversible"
        return None

    def __post_init__(self) -> None:
        """Checks that each field has an instance of a suitable class, but not the numbers in it.

        Raises:
            TypeError: a field has a class or a name, not a value like `RK4()`, or its class does
                not derive from its protocol.
        """
        for part, verb, example in PARTS:
            value = getattr(self, part)
            if value is None and part in OPTIONAL:
                continue
            is_part = hasattr(value, verb) and (part in PROTOCOLS or hasattr(value, "check"))
            if isinstance(value, type) or not is_part:
                fits = [other for other, can, _ in PARTS if hasattr(value, can)]
                hint = f"; that is one for {fits[0]}=" if fits and fits[0] != part else ""
                got, name = repr(value), getattr(value, "__name__", "")
                if name and value is not None and value.__module__.startswith("jaxcon."):
                    got = public_name(value)
                    hint = hint or f"; call it: {got}()"
                raise TypeError(
                    f"Method: {part} must be a value such as {example}, got {got}{hint}."
                )
            if part in PROTOCOLS:
                checks.derives("Method", part, value, PROTOCOLS[part])

    def check(self) -> None:
        """Checks the fields and their numbers, including shapes and traced numbers.

        Raises:
            TypeError: a field has a class or a name, not a value like `RK4()`.
            ValueError: a number is out of range.
        """
        self.__post_init__()
        for name, *_ in PARTS:
            if (part := getattr(self, name)) is not None:
                part.check()


def _same_arrays(expected: PyTree, given: PyTree) -> bool:
    """Returns True if two trees have arrays of the same shapes and dtypes at the same places."""
    leaves, structure = jax.tree.flatten(expected)
    others, other_structure = jax.tree.flatten(given)
    if not leaves and not others:
        return True  # a part without memory has () or None
    return structure == other_structure and all(
        (np.shape(a), jnp.result_type(a)) == (np.shape(b), jnp.result_type(b))
        for a, b in zip(leaves, others, strict=True)
    )


def check_method(method: Method, wait: bool = True) -> None:
    """Checks a method and its fields.

    Args:
        method: the argument that the user gave.
        wait: False to skip numbers that a device may still be computing.

    Raises:
        TypeError: the argument is not a method, or a field has a value of another kind.
    """
    if not isinstance(method, Method):
        got = method.__name__ if isinstance(method, type) else type(method).__name__
        raise TypeError(
            f"the method must be a value such as jc.Method(jc.RK4()), got {got}; the arguments of"
            " step and rollout are (system, method, state, …), of init (system, method, q, v)."
        )
    with contextlib.nullcontext() if wait else checks.without_waiting():
        method.check()


@functools.lru_cache(maxsize=64)  # called in every step outside of jit, without waiting for devices
def _steady_gains(
    integrator: Integrator, dt: float, dtype: np.dtype
) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the default gains α and β [1/s] at step size dt [s]; None if they may rise."""
    with jax.ensure_compile_time_eval():
        h = jnp.asarray(dt, dtype)
        alpha, beta = integrator.default_gains(h)
        rises = bool(beta < integrator.highest_rate(h))
        return None if rises else (np.asarray(alpha), np.asarray(beta))
