"""Conversion of the mass and inertia arguments of users to an `Inertia`."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import Array, DType, PyTree, Scalar
from jaxcon.geometry import quaternion
from jaxcon.geometry.inertia import Inertia, check_triangle, from_tensor


def resolve_inertia(
    owner: str,
    mass: PyTree,
    given: Inertia | Scalar | Sequence[Scalar] | None,
    dim: int,
    dtype: DType,
) -> Inertia:
    """Converts the mass and inertia arguments of a body to an `Inertia` of arrays.

    Args:
        owner: the first words of errors, such as "body 'rod'".
        mass: () [kg]; None if `given` is an `Inertia`, which contains the mass.
        given: an `Inertia`; or a moment of inertia () in the plane; or principal moments (3,) or a
            tensor (3, 3) in space [kg m²]. If an `Inertia` has three moments, its moment about z
            is used in the plane.
        dim: the dimension of space, 2 or 3.
        dtype: the dtype of the scene.

    Raises:
        ValueError: a shape or dtype is wrong, a value is out of range, or the mass is given twice
            or not at all.
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
        shape = np.shape(checks.check(owner, "inertia", given, finite=False))
        if dim == 2 and shape:
            raise ValueError(
                f"{owner}: inertia must have shape () in the plane, about the normal through the"
                f" center of mass, got {shape}; of principal moments give the third."
            )
        given = Inertia(mass, given)
    moments, axes = given.moments, given.axes
    if dim == 2 and np.shape(checks.check(owner, "inertia", moments, finite=False)) == (3,):
        moments = _about_z(checks.real(owner, "inertia", moments, dtype, (3,)), axes)
        axes = None
    moments = checks.real(owner, "inertia", moments, dtype, () if dim == 2 else (3,), above=0)
    if dim == 3:
        check_triangle(owner, moments)
    return Inertia(resolve_mass(owner, given.mass, dtype), moments, given.center, axes)


def _about_z(moments: Array, axes: Array | None) -> Array:
    """Returns the moment of inertia about the z axis of the body's own frame, () [kg m²].

    With principal moments I and principal axes A, this moment is (A diag(I) Aᵀ)_zz.

    Args:
        moments: I, (3,) [kg m²].
        axes: A as a quaternion, (4,); None if the principal frame is the body's own frame.
    """
    if axes is None:
        return moments[2]
    z = quaternion.matrix(quaternion.normalize(jnp.asarray(axes, moments.dtype)))[2]
    return jnp.sum(z * z * moments)


def resolve_mass(owner: str, mass: PyTree, dtype: DType) -> Array:
    """Converts the mass argument of a body to an array, () [kg].

    Args:
        owner: the first words of errors, such as "body 'rod'".
        mass: the user's value, () [kg].
        dtype: the dtype of the scene.

    Raises:
        ValueError: the mass is None or not positive.
    """
    if mass is None:
        raise ValueError(
            f"{owner}: a mass is needed; mass=, or of a body an inertia that brings it, such as"
            " jc.inertia.box(mass, size)."
        )
    return checks.real(owner, "mass", mass, dtype, above=0)
