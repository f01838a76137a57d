"""How a system is simulated: integrator, stabiliser and solver as one value."""

from __future__ import annotations

from typing import Any

from jaxcon.core.pytree import pytree
from jaxcon.simulation.integrators import SemiImplicitEuler
from jaxcon.solvers.sparse import Sparse
from jaxcon.stabilization.baumgarte import Baumgarte


@pytree
class Method:
    """Integrator, stabiliser and solver; the defaults suit a scene that nobody has tuned.

    Attributes:
        integrator: `SemiImplicitEuler()`, `Heun()`, `RK4()`, or any `RungeKutta(a, b)`.
        stabilizer: `Baumgarte(…)` or `Unstabilized()`.
        solver: `Sparse()`, `Schur()`, `Dense()` or `ConjugateGradients()`.
    """

    integrator: Any = SemiImplicitEuler()
    stabilizer: Any = Baumgarte()
    solver: Any = Sparse()

    def feedback(self, dt: Any) -> Any:
        """The stabiliser, its missing gains chosen for the integrator at this step."""
        return self.stabilizer.resolve(self.integrator.default_gains(dt))

    def check(self) -> None:
        """Checks that each part is a value of its kind.

        Raises:
            TypeError: a part is a class or a name, not a value like `RK4()`.
        """
        if hasattr(self.integrator, "check") and not isinstance(self.integrator, type):
            self.integrator.check()
        parts = {"integrator": "advance", "stabilizer": "target", "solver": "solve"}
        for part, verb in parts.items():
            value = getattr(self, part)
            if isinstance(value, type) or not hasattr(value, verb):
                raise TypeError(
                    f"Method: {part} must be a value such as"
                    f" {type(getattr(Method(), part)).__name__}(), got {value!r}."
                )


def check_method(method: Any) -> None:
    """Checks a method and its parts.

    Raises:
        TypeError: it is something else, or one of its parts is.
    """
    if not isinstance(method, Method):
        got = method.__name__ if isinstance(method, type) else type(method).__name__
        raise TypeError(
            f"the method must be a value such as jc.Method(jc.RK4()), got {got}; the arguments of"
            " step and rollout are (system, method, state, …)."
        )
    method.check()
