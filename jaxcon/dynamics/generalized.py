"""The builder of systems on the user's own coordinates."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from jaxcon.constraints.custom import CustomOnCoordinates, Holonomic, VelocityLevel
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.generalized import GeneralizedCoordinates


def GeneralizedSystem(  # noqa: N802
    *,
    mass: Callable[[Array, PyTree], Array],
    force: Callable[..., Array],
    constraints: Sequence[Holonomic | VelocityLevel] = (),
    params: PyTree = None,
    potential: Callable[[Array, Any, PyTree], Array] | None = None,
) -> GeneralizedCoordinates:
    """M(q, θ) a = f(q, v, t, u, θ) + Jᵀλ on coordinates with q̇ = v.

    Args:
        mass: `mass(q, params)` → M (n, n), symmetric positive definite, or its diagonal (n,).
        force: `force(q, v, t, control, params)` → f (n,), Coriolis and gravity forces included.
        constraints: `Holonomic` with `function(q, t, params)`, `VelocityLevel` with
            `function(q, v, t, params)`.
        params: θ, any pytree of arrays: leaves of the system.
        potential: `potential(q, t, params)` → () [J], for `energy`; optional.

    Returns:
        The system; `jc.init(system, method, q, v)` checks it and makes a state.

    Raises:
        ValueError: two constraints of one name, or one on named bodies.
        TypeError: something else than `Holonomic` or `VelocityLevel`.
    """
    names: set[str] = set()
    groups = []
    for constraint in constraints:
        if not isinstance(constraint, Holonomic | VelocityLevel):
            raise TypeError(
                f"GeneralizedSystem takes Holonomic and VelocityLevel, got {constraint!r}."
            )
        if constraint.bodies or constraint.params is not None:
            raise ValueError(
                f"constraint '{constraint.name}': on generalized coordinates there are no bodies,"
                " and the parameters are those of the system."
            )
        if constraint.name in names:
            raise ValueError(
                f"GeneralizedSystem: two constraints are called '{constraint.name}'; give name=."
            )
        names.add(constraint.name)
        groups.append(CustomOnCoordinates(None, dataclasses.replace(constraint)))
    return GeneralizedCoordinates(tuple(groups), params, mass, force, potential)
