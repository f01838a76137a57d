"""The state of a world between two steps."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

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
        turns: the angles a step ago of joints whose whole turns are counted, (n,) [rad]; empty
            where there are none.
    """

    q: Array
    v: Array
    time: Array
    status: Array
    memory: PyTree = ()
    turns: PyTree = ()


def at(system: Any, state: Any) -> Any:
    """The system as one of its worlds remembers it, checked: see `recall`.

    Raises:
        TypeError: they are something else, such as a Scene that was not built.
        ValueError: the state has another shape, such as that of a batch or trajectory.
    """
    if not hasattr(system, "snapshot") or not isinstance(state, State):
        raise TypeError(
            f"expected a system and a State, got {type(system).__name__} and"
            f" {type(state).__name__}; `system, state = scene.build()` makes them."
        )
    layout = getattr(system, "layout", None)
    expected = state.v.shape if layout is None else (layout.n_v,)
    for what, got in (("q", state.q.shape), ("v", state.v.shape)):
        shape = (layout.n_q,) if layout is not None and what == "q" else expected
        if got != shape or len(got) != 1:
            raise ValueError(
                f"state.{what} must have shape {shape}, got {got}; for batches and trajectories use"
                " jax.vmap: jax.vmap(lambda s: jc.position(system, s, name))(trajectory)."
            )
    return recall(system, state.turns)


def recall(system: Any, turns: PyTree) -> Any:
    """The system with the angles a step ago of the joints whose turns it counts.

    Raises:
        ValueError: there are not as many as it counts.
    """
    expected, got = (np.shape(x)[:1] for x in (getattr(system, "turns", ()), turns))
    if expected != got and sum(expected + got):
        raise ValueError(
            f"state.turns must have shape {expected}, got {got}: this system counts the whole turns"
            f" of {sum(expected)} joints; start from the state of Scene.build or from jc.init."
        )
    return dataclasses.replace(system, turns=turns) if sum(got) else system


@pytree
class Energy:
    """Mechanical energy [J]."""

    kinetic: Any
    potential: Any

    @property
    def total(self) -> Any:
        """Kinetic and potential together."""
        return self.kinetic + self.potential
