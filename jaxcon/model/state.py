"""The state of a world between two steps."""

from __future__ import annotations

from typing import Any

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree


@pytree
class State:
    """Everything that a step changes.

    Attributes:
        q: positions, (n_q,); `system.layout` maps names to indices.
        v: velocities, (n_v,); not q̇ where bodies turn in space.
        time: () [s].
        status: `Status` code of this world, (); the first failure sticks.
        memory: of the method (integrals, histories); `jc.init` makes it.
    """

    q: Array
    v: Array
    time: Array
    status: Array
    memory: PyTree = ()


@pytree
class Energy:
    """Mechanical energy [J]."""

    kinetic: Any
    potential: Any

    @property
    def total(self) -> Any:
        """Kinetic and potential together."""
        return self.kinetic + self.potential
