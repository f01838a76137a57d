"""How a system is simulated: integrator, stabiliser and solver as one value."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import PyTree
from jaxcon.simulation.integrators import SemiImplicitEuler
from jaxcon.simulation.stability import stable_rate
from jaxcon.solvers.proximal import RankSafe
from jaxcon.stabilization.baumgarte import Baumgarte

PARTS = (
    ("integrator", "default_gains", "SemiImplicitEuler()"),
    ("stabilizer", "target", "Baumgarte()"),
    ("solver", "solve", "RankSafe()"),
    ("recovery", "repair", "Recovery()"),
)
"""What a method consists of: the field, what its value can do, and an example."""


class Memory(NamedTuple):
    """What a state remembers for its method, by part; each () where there is nothing."""

    integrator: PyTree = ()
    stabilizer: PyTree = ()
    recovery: PyTree = ()


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
    """

    integrator: Any = SemiImplicitEuler()
    stabilizer: Any = Baumgarte()
    solver: Any = RankSafe()
    recovery: Any = None

    def init(self, system: Any, q: Any, v: Any) -> PyTree:
        """What a state remembers for the method: a `Memory`, or () where there is nothing."""
        repairs = () if self.recovery is None else self.recovery.init(system, q, v)
        own = self.integrator.init(system, q, v), self.stabilizer.init(system, q, v)
        memory = Memory(*own, repairs)
        return memory if jax.tree.leaves(memory) else ()

    def feedback(self, dt: Any) -> Any:
        """The stabiliser, its missing gains chosen for the integrator at this step."""
        stabilizer = self.stabilizer.resolve(self.integrator.default_gains(dt))
        return stabilizer.bounded(functools.partial(stable_rate, self.integrator, dt))

    def check_system(self, system: Any) -> None:
        """Checks that the integrator works with the stabiliser and the system.

        Raises:
            ValueError: it does not; the message says why.
        """
        reason = self.integrator.refuses(system, self.stabilizer)
        if reason:
            raise ValueError(f"{type(self.integrator).__name__}: {reason}.")

    def check(self) -> None:
        """Checks that each part is a value of its kind.

        Raises:
            TypeError: a part is a class or a name, not a value like `RK4()`.
        """
        if hasattr(self.integrator, "check") and not isinstance(self.integrator, type):
            self.integrator.check()
        if hasattr(self.recovery, "check") and not isinstance(self.recovery, type):
            self.recovery.check()
        for part, verb, example in PARTS:
            value = getattr(self, part)
            absent = part == "recovery" and value is None
            if not absent and (isinstance(value, type) or not hasattr(value, verb)):
                raise TypeError(f"Method: {part} must be a value such as {example}, got {value!r}.")
        for part in (self.stabilizer, self.solver):
            if hasattr(part, "check"):
                part.check()


def check_method(method: Any) -> None:
    """Checks a method and its parts.

    Raises:
        TypeError: it is something else, or one of its parts is.
    """
    if not isinstance(method, Method):
        got = method.__name__ if isinstance(method, type) else type(method).__name__
        raise TypeError(
            f"the method must be a value such as jc.Method(jc.RK4()), got {got}; the arguments of"
            " step and rollout are (system, method, state, …), of init (system, method, q, v)."
        )
    method.check()
