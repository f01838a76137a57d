"""The inertia of a body, in whatever form a user gave it."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import Array
from jaxcon.geometry.inertia import Inertia, check_triangle, from_tensor


def resolve_inertia(owner: str, mass: Any, given: Any, dim: int, dtype: Any) -> Inertia:
    """Mass and moments as arrays, whatever form a user gave.

    Args:
        owner: what errors begin with, as "body 'rod'".
        mass: () [kg]; None beside an `Inertia`, which brings it.
        given: a moment () in the plane; in space principal moments (3,) or a tensor (3, 3); or an
            `Inertia`.
        dim: 2 or 3.
        dtype: of the scene.

    Raises:
        ValueError: a wrong shape or dtype, a value that no body has, or mass twice or not at all.
    """
    if isinstance(given, Inertia):
        if mass is not None:
            raise ValueError(f"{owner}: give mass= or an Inertia, not both.")
    elif given is None:
        raise ValueError(f"{owner}: inertia is needed; a body without one is a particle.")
    elif isinstance(given, str):
        raise ValueError(f"{owner}: inertia must be numbers or an Inertia, got {given!r}.")
    elif dim == 3 and checks.check(owner, "inertia", given, finite=False).shape == (3, 3):
        tensor = checks.real(owner, "inertia", given, dtype, (3, 3))
        given = from_tensor(mass, tensor, owner=owner)
    else:
        if dim == 2 and np.ndim(checks.check(owner, "inertia", given, finite=False)):
            raise ValueError(
                f"{owner}: inertia must have shape () in the plane, about the normal through the"
                f" centre of mass, got {np.shape(given)}; of principal moments give the third."
            )
        given = Inertia(mass, given)
    moments = given.moments
    if dim == 2 and np.shape(checks.check(owner, "inertia", moments, finite=False)) == (3,):
        moments = moments[2]
    moments = checks.real(owner, "inertia", moments, dtype, () if dim == 2 else (3,), above=0)
    if dim == 3:
        check_triangle(owner, moments)
    return Inertia(resolve_mass(owner, given.mass, dtype), moments, given.center, given.axes)


def resolve_mass(owner: str, mass: Any, dtype: Any) -> Array:
    """A mass () [kg] as an array.

    Raises:
        ValueError: there is none, or it is not positive.
    """
    if mass is None:
        raise ValueError(
            f"{owner}: a mass is needed; mass=, or of a body an inertia that brings it, such as"
            " jc.inertia.box(mass, size)."
        )
    return checks.real(owner, "mass", mass, dtype, above=0)
