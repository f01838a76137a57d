"""The state of a world between two steps."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxcon.core.pytree import exportable, pytree
from jaxcon.core.typing import Array, PyTree


@exportable
class MethodMemory(NamedTuple):
    """The memory of a method between steps, by part of the method; () where a part has none.

    Attributes:
        integrator: accelerations of the last step, for integrators that use them.
        stabilizer: integrals or histories of the feedback.
        recovery: counters of repaired steps.
        bounded: multipliers of the inequality constraints in the last step, (n,), from which
            iterative solvers start.
    """

    integrator: PyTree = ()
    stabilizer: PyTree = ()
    recovery: PyTree = ()
    bounded: PyTree = ()


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


def is_finite(state: State) -> Array:
    """Whether all positions and velocities of a world are finite, ()."""
    return jnp.all(jnp.isfinite(state.q), axis=0) & jnp.all(jnp.isfinite(state.v), axis=0)


def at(system: Any, state: Any, call: str = "f(system, s)") -> Any:
    """The system as one of its worlds remembers it, checked: see `recall`.

    Args:
        system: of the state.
        state: of one world.
        call: what was called, of a state s, for errors.

    Raises:
        TypeError: they are something else, such as a Scene that was not built.
        ValueError: the state has another shape, such as that of a batch or trajectory.
    """
    if not hasattr(system, "snapshot") or not isinstance(state, State):
        raise TypeError(
            f"expected a system and a State, got {type(system).__name__} and"
            f" {type(state).__name__}; `system, state = scene.build()` makes them."
        )
    sizes = system.sizes(state.q.shape[-1] if state.q.ndim else 0)
    for what, got, size in zip("qv", (state.q.shape, state.v.shape), sizes, strict=True):
        if got != (size,):
            raise ValueError(
                f"state.{what} must have shape ({size},), got {got}; for batches and trajectories"
                f" use jax.vmap: jax.vmap(lambda s: {call})(states)."
            )
    return recall(system, state.turns)


def recall(system: Any, turns: PyTree) -> Any:
    """The system with the angles a step ago of the joints whose turns it counts.

    Raises:
        ValueError: there are not as many as it counts.
    """
    expected, got = (np.shape(x)[:1] for x in (system.turns, turns))
    if expected != got and sum(expected + got):
        raise ValueError(
            f"state.turns must have shape {expected}, got {got}: this system counts the whole turns"
            f" of {sum(expected)} joints; go on from a state that counts them, with"
            " dataclasses.replace, or start with jc.init."
        )
    return system.remember(turns) if sum(got) else system


@pytree
class Energy:
    """Mechanical energy [J].

    Attributes:
        kinetic: ½ vᵀMv, and that of rotors, () [J].
        potential: of gravity and springs, () [J]; forces of one's own have none.
    """

    kinetic: Any
    potential: Any

    @property
    def total(self) -> Any:
        """Kinetic and potential together."""
        return self.kinetic + self.potential
