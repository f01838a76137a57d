"""The builder of systems on the user's own coordinates."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from jaxcon.constraints.custom import CustomOnCoordinates, Holonomic, VelocityLevel
from jaxcon.contact.limits import Inequality, InequalityOnCoordinates, numbers_of
from jaxcon.core import checks
from jaxcon.core.typing import Array, PyTree
from jaxcon.system.generalized import GeneralizedCoordinates


def GeneralizedSystem(  # noqa: N802
    *,
    mass: Callable[[Array, Any], Array],
    force: Callable[..., Array],
    constraints: Sequence[Holonomic | VelocityLevel | Inequality] = (),
    params: PyTree = None,
    potential: Callable[[Array, Any, Any], Array] | None = None,
) -> GeneralizedCoordinates:
    """Makes a system M(q, θ) a = f(q, v, t, u, θ) + Jᵀλ on coordinates with q̇ = v.

    Args:
        mass: `mass(q, params)` → M (n, n), symmetric positive definite, or its diagonal (n,).
        force: `force(q, v, t, control, params)` → f (n,), Coriolis and gravity forces included.
        constraints: `Holonomic` and `Inequality` with `function(q, t, params)`, `VelocityLevel`
            with `function(q, v, t, params)`.
        params: θ, any pytree of arrays: leaves of the system.
        potential: `potential(q, t, params)` → () [J], which `energy` adds; optional.

    Returns:
        The system; `jc.init(system, method, q, v)` checks it and makes a state.

    Raises:
        ValueError: two constraints have the same name, or a constraint names bodies or has params,
            or a parameter is NaN, or is no real number, boolean, integer or random key.
        TypeError: a constraint is not a `Holonomic`, `VelocityLevel` or `Inequality`, or `mass`,
            `force` or `potential` is no function of these arguments.
    """
    owner = "GeneralizedSystem"
    checks.takes(owner, "mass", mass, ("q", "params"))
    checks.takes(owner, "force", force, ("q", "v", "t", "control", "params"))
    if potential is not None:
        checks.takes(owner, "potential", potential, ("q", "t", "params"))
    checks.parameters(owner, params, finite=False)
    names: set[str] = set()
    groups: list[Any] = []
    bounds: list[Any] = []
    for constraint in constraints:
        if not isinstance(constraint, Holonomic | VelocityLevel | Inequality):
            raise TypeError(
                "GeneralizedSystem takes Holonomic, VelocityLevel and Inequality, got"
                f" {constraint!r}."
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
        if isinstance(constraint, Inequality):
            numbers = numbers_of(constraint, checks.chosen_dtype(params))
            bounds.append(InequalityOnCoordinates(None, constraint.bare, numbers=numbers))
        else:
            groups.append(CustomOnCoordinates(None, dataclasses.replace(constraint)))
    return GeneralizedCoordinates(
        tuple(groups), params, mass, force, potential, bounds=tuple(bounds)
    )
