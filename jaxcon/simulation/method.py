"""How a system is simulated: integrator, stabiliser and solver as one value."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.contact_default import default_contact_solver, first_multipliers
from jaxcon.core import checks
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import PyTree
from jaxcon.model.state import MethodMemory, State
from jaxcon.simulation.choice import choose
from jaxcon.simulation.integrators import SemiImplicitEuler
from jaxcon.simulation.stability import stable_rate
from jaxcon.solvers.proximal import RankSafe
from jaxcon.stabilization.baumgarte import Baumgarte

PARTS = (
    ("integrator", "default_gains", "SemiImplicitEuler()"),
    ("stabilizer", "target", "Baumgarte()"),
    ("solver", "solve", "RankSafe()"),
    ("recovery", "repair", "Recovery()"),
    ("bounded", "smoothing", "InteriorPoint()"),
    ("events", "splits", "Events()"),
)
"""What a method consists of: the field, what its value can do, and an example."""
OPTIONAL = ("recovery", "bounded", "events")
"""Fields that may be None."""


@pytree
class Method:
    """Integrator, stabiliser and solver; the defaults suit a scene that nobody has tuned.

    Attributes:
        integrator: `SemiImplicitEuler()`, `Heun()`, `RK4()`, or any `RungeKutta(a, b)`; `RATTLE()`
            and, for stiff scenes, `GeneralizedAlpha()`, which keep constraints by themselves.
        stabilizer: `Baumgarte(…)`, `PID(…)`, `Projection(…)`, `Penalty(…)`, …, `Unstabilized()`.
        solver: `RankSafe()`, or `Sparse()`, `Schur()`, `Dense()` or `ConjugateGradients()`, which
            want independent rows; `Priority(levels)` meets them level by level.
        recovery: `Recovery(…)`, which repairs steps that fail; None, and a world that fails stops.
        bounded: solver of the inequality constraints, which are limits, friction and contact:
            `InteriorPoint()`, exact; `GaussSeidel(…)`, cheap; or `Nearest(…)` of either, for few
            rows of many. None chooses by structure when the step is traced: `GaussSeidel()` for
            more than 24 rows that act on mechanisms one by one, such as robots on the floor, and
            `InteriorPoint()` elsewhere. A scene without such rows has no trace of it.
        events: `Events(…)`, which splits a step where a stop, rope or contact is hit; None, and
            impacts are those of plain stepping. A scene without such rows has no trace of it.
    """

    integrator: Any = SemiImplicitEuler()
    stabilizer: Any = Baumgarte()
    solver: Any = RankSafe()
    recovery: Any = None
    bounded: Any = None
    events: Any = None

    @classmethod
    def auto(
        cls,
        system: Any,
        state: State,
        batch: int = 1,
        platform: str | None = None,
        **parts: Any,
    ) -> Method:
        """The method with the solver that suits a system, by its structure; `report` says why.

        Where M is diagonal, elimination along the structure is taken; where rows meet so closely
        that it would be too long a program or takes more than matrices do, these; and iterations
        where both are twenty times dearer, or do not fit into memory. Where M is not diagonal,
        the Schur complement. Around it `RankSafe`, where constraints close loops or depend on each
        other in this state. The same system, state and arguments give the same method.

        Args:
            system: a `BodySystem`, `GeneralizedSystem` or `Vakonomic`.
            state: of one world, with known numbers, not traced.
            batch: worlds that are to be stepped together, whose matrices must fit into memory.
            platform: "cpu", "gpu" or "tpu", where it is to run; None for that of JAX.
            parts: integrator, stabiliser and others, which are taken as they are.

        Returns:
            A plain `Method`.

        Raises:
            TypeError: the state is traced, or a part has an unknown name.
            ValueError: the state does not belong to the system, or the batch is no count.
        """
        if "solver" not in parts:
            parts["solver"] = choose(system, state, batch, platform).solver
        return cls(**parts)

    def init(self, system: Any, q: Any, v: Any) -> PyTree:
        """Returns the first memory of the method: a `MethodMemory`, or () where it keeps none."""
        multipliers = first_multipliers(system, q, v, self.bounded)
        memory = self._memory_of_parts(system, q, v)._replace(bounded=multipliers)
        return memory if jax.tree.leaves(memory) else ()

    def _memory_of_parts(self, system: Any, q: Any, v: Any) -> MethodMemory:
        """The first memory of all parts but the solver of inequality constraints."""
        repairs = () if self.recovery is None else self.recovery.init(system, q, v)
        return MethodMemory(
            self.integrator.init(system, q, v), self.stabilizer.init(system, q, v), repairs
        )

    def check_memory(self, system: Any, state: State) -> None:
        """Checks that a state has the memory of this method.

        A state may carry multipliers that the solver does not use. It may lack them where the
        solver is chosen by default: each step then starts its sweeps from zero.

        Raises:
            ValueError: it has the memory of another method, or none.
        """
        expected = self._memory_of_parts(system, state.q, state.v)
        given = MethodMemory(*state.memory)
        others = given._replace(bounded=())
        wanted = self.bounded is not None and self.bounded.warm and bool(system.bounds)
        missing = wanted and not jax.tree.leaves(given.bounded)
        kept = jax.tree.leaves(expected) or jax.tree.leaves(others)
        if missing or (kept and jax.tree.structure(expected) != jax.tree.structure(others)):
            raise ValueError(
                "step: the state does not have the memory that this method keeps; start with"
                " state = jc.init(system, method, state.q, state.v)."
            )

    def resolve(self, system: Any, state: State) -> Method:
        """Returns the method with a solver of the inequality constraints of the system.

        Args:
            system: whose structure is looked at; its numbers may be traced.
            state: of one world, or of worlds along trailing axes.
        """
        if self.bounded is not None or not system.bounds:
            return self
        return dataclasses.replace(self, bounded=default_contact_solver(system, state.q, state.v))

    def known_at(self, dt: Any, dtype: Any) -> Method:
        """Returns the method with the default gains of a known step where they cannot rise.

        Gains that may rise are computed row by row in every step.

        Args:
            dt: h as it was given, () [s].
            dtype: of the scene.
        """
        coarse = jnp.finfo(dtype).bits == 32 and hasattr(self.integrator, "highest_rate")
        if not coarse or not checks.is_concrete(dt) or not _is_number(dt):
            return self  # a step that is no number is refused where it is used
        gains = _steady_gains(self.integrator, float(dt), np.dtype(dtype))
        if gains is None:
            return self
        return dataclasses.replace(self, stabilizer=self.stabilizer.steady(gains))

    def feedback(self, dt: Any) -> Any:
        """The stabiliser, its missing gains chosen for the integrator at this step."""
        stabilizer, limit = self.stabilizer, _highest_rate(self.integrator, dt)
        if limit is not None:
            stabilizer = stabilizer.rising(limit)
        stabilizer = stabilizer.resolve(self.integrator.default_gains(dt))
        return stabilizer.bounded(functools.partial(stable_rate, self.integrator, dt))

    def check_system(self, system: Any) -> None:
        """Checks that the integrator works with the stabiliser and the system.

        Raises:
            ValueError: it does not; the message says why.
        """
        reason = self.integrator.refuses(system, self.stabilizer)
        if system.bounds and not getattr(self.integrator, "bounded", False):
            names = [name for group in system.bounds for name in group.names]
            reason = (
                f"it has no place for the bounded rows of {names}, which are solved once a step"
                " beside explicit forces; take SemiImplicitEuler() or a Runge–Kutta method"
            )
        if reason:
            raise ValueError(f"{type(self.integrator).__name__}: {reason}.")

    def irreversible(self) -> str | None:
        """Why a step by −h does not undo one by h; None where it does."""
        if not getattr(self.integrator, "symmetric", False):
            return (
                f"a step of {type(self.integrator).__name__} is not undone by one of −h, as one of"
                " RATTLE is"
            )
        if self.recovery is not None:
            return "a Recovery leads on from states to which no step leads back"
        return None

    def __post_init__(self) -> None:
        """Checks that each part is a value of its kind; each has checked its own numbers.

        Raises:
            TypeError: a part is a class or a name, not a value like `RK4()`.
        """
        for part, verb, example in PARTS:
            value = getattr(self, part)
            absent = part in OPTIONAL and value is None
            if not absent and (isinstance(value, type) or not hasattr(value, verb)):
                fits = [other for other, can, _ in PARTS if hasattr(value, can)]
                hint = f"; that is one for {fits[0]}=" if fits and fits[0] != part else ""
                got, name = repr(value), getattr(value, "__name__", "")
                if name and value.__module__.startswith("jaxcon."):
                    got, hint = f"jc.{name}", hint or f"; call it: jc.{name}()"
                raise TypeError(
                    f"Method: {part} must be a value such as {example}, got {got}{hint}."
                )

    def check(self) -> None:
        """Checks the parts and their numbers, traced ones and shapes included.

        Raises:
            TypeError: a part is a class or a name, not a value like `RK4()`.
            ValueError: a number of a part is out of range.
        """
        self.__post_init__()
        for name, *_ in PARTS:
            part = getattr(self, name)
            if hasattr(part, "check"):
                part.check()


def check_method(method: Any, wait: bool = True) -> None:
    """Checks a method and its parts.

    Args:
        method: to be checked.
        wait: whether its numbers are read where a device may still compute them.

    Raises:
        TypeError: it is something else, or one of its parts is.
    """
    if not isinstance(method, Method):
        got = method.__name__ if isinstance(method, type) else type(method).__name__
        raise TypeError(
            f"the method must be a value such as jc.Method(jc.RK4()), got {got}; the arguments of"
            " step and rollout are (system, method, state, …), of init (system, method, q, v)."
        )
    with contextlib.nullcontext() if wait else checks.without_waiting():
        method.check()


def _is_number(x: Any) -> bool:
    """Returns True for one number that can be read; others are refused where they are used."""
    if type(x) is float or (type(x) is int and abs(x) < 2**53):
        return True
    kind = getattr(getattr(x, "dtype", None), "kind", None)
    return kind in ("f", "i", "u") and np.shape(x) == ()


@functools.lru_cache(maxsize=64)  # asked in every step outside of jit, which waits for no device
def _steady_gains(integrator: Any, dt: float, dtype: np.dtype) -> tuple[Any, Any] | None:
    """Default gains α and β [1/s] at a step of dt [s]; None where they may rise."""
    with jax.ensure_compile_time_eval():
        h = jnp.asarray(dt, dtype)
        alpha, beta = integrator.default_gains(h)
        rises = bool(beta < integrator.highest_rate(h))
        return None if rises else (np.asarray(alpha), np.asarray(beta))


def _highest_rate(integrator: Any, dt: Any) -> Any:
    """β [1/s] to which default gains may rise; None where precision does not hold them low."""
    if jnp.finfo(jnp.result_type(dt)).bits > 32:
        return None
    highest = getattr(integrator, "highest_rate", None)  # integrators of users have none
    return None if highest is None else highest(dt)
