"""Linear and angular momentum of bodies, as lanes.

P = Σ m ẋ, L = Σ m (x − c) × ẋ + R I ω about the center of mass c = Σ m x / Σ m,

with position x, rotation R, body-frame angular velocity ω, mass m and inertia I of each body.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector, times, total
from jaxcon.core.typing import Array, Lane
from jaxcon.system.layout import Place

if TYPE_CHECKING:
    from jaxcon.system.body_system import Snapshot


class BodiesOfKind(NamedTuple):
    """Some bodies of one kind.

    Attributes:
        place: the bodies.
        frame: the `BodyFrame` of these bodies.
        mass, moments: mass [kg] and moments of inertia [kg m²], (body,); see `MassProperties`.
    """

    place: Place
    frame: Any
    mass: Array
    moments: Array | Vector | None

    @property
    def spin(self) -> Lane | Vector:
        """The angular momentum R I ω of each body about its own center of mass, world frame.

        A lane in the plane, a Vector in space, and 0.0 for particles [kg m²/s].
        """
        if self.moments is None:
            return 0.0
        if not isinstance(self.moments, Vector):
            return self.moments * self.frame.omega
        pairs = zip(self.moments, self.frame.omega, strict=True)
        return self.frame.rotation @ Vector(*(i * w for i, w in pairs))


class Momentum(NamedTuple):
    """The momentum of some bodies together; lanes of one element.

    Attributes:
        position, velocity: position [m] and velocity [m/s] of the center of mass, world frame.
        linear: linear momentum P [kg m/s].
        angular: angular momentum L about the center of mass [kg m²/s]; a lane in the plane.
    """

    position: Vector
    velocity: Vector
    linear: Vector
    angular: Array | Vector


def parts_of(snapshot: Snapshot, places: Iterable[Place]) -> list[BodiesOfKind]:
    """Collects the bodies that some places name, grouped by kind; each place has one body."""
    chosen: dict[int, list[int]] = {}
    for place in places:
        assert place.group is not None
        chosen.setdefault(place.group, []).extend(place.indices)
    parts = []
    for group, indices in chosen.items():
        place = Place(group, tuple(indices))
        properties = jax.tree.map(place.take, snapshot.system.inertia[group])
        parts.append(
            BodiesOfKind(place, snapshot.frame(place), properties.mass, properties.moments)
        )
    return parts


def momentum_of(snapshot: Snapshot, places: Iterable[Place]) -> Momentum:
    """Returns the total momentum of the bodies that some places name."""
    parts = parts_of(snapshot, places)
    mass = total(_sum(p.mass) for p in parts)
    linear = _total(parts, lambda p: p.frame.velocity * p.mass)
    center = _total(parts, lambda p: p.frame.position * p.mass) * (1 / mass)
    orbits = [(p.frame.position - center).cross(p.frame.velocity * p.mass) for p in parts]
    spins = [p.spin for p in parts]
    if isinstance(orbits[0], Vector):
        terms = [x for x in (*orbits, *spins) if isinstance(x, Vector)]
        angular = Vector(*(total(map(_sum, lanes)) for lanes in zip(*terms, strict=True)))
    else:
        angular = total(_sum(x) for x in (*orbits, *spins) if isinstance(x, jax.Array))
    return Momentum(center, linear * (1 / mass), linear, angular)


def torque_pulls(part: BodiesOfKind, center: Vector) -> list[Vector]:
    """Returns ∂L/∂v on each body, one Vector for each component of the angular momentum L.

    The Vector for a world axis n is (m n × (x − c), I Rᵀ n), with the center of mass c. The
    velocity of c drops out of the sum over bodies, since Σ m (x − c) = 0.
    """
    arm = part.frame.position - center
    if len(arm) == 2:
        swing = Vector(times(-1, arm[1]), arm[0]) * part.mass
        return [swing if part.moments is None else Vector(*swing, part.moments)]
    rows = []
    for n in range(3):
        axis = Vector(*(1.0 if i == n else 0.0 for i in range(3)))
        swing = axis.cross(arm) * part.mass
        if part.moments is not None:
            turn = part.frame.rotation[n]  # Rᵀ n
            swing = Vector(*swing, *(i * x for i, x in zip(part.moments, turn, strict=True)))
        rows.append(swing)
    return rows


def torque_bias(part: BodiesOfKind) -> Vector | None:
    """Returns R (ω × I ω), the L̇ of each body at zero acceleration; None in 2-D, where L̇ = 0."""
    if not isinstance(part.moments, Vector):
        return None
    omega = part.frame.omega
    spin = Vector(*(i * w for i, w in zip(part.moments, omega, strict=True)))
    return part.frame.rotation @ omega.cross(spin)


def _total(parts: Sequence[BodiesOfKind], vector: Callable[[BodiesOfKind], Vector]) -> Vector:
    """Evaluates `vector` for each group of bodies; returns the sum over all bodies."""
    terms = [vector(part) for part in parts]
    return Vector(*(total(map(_sum, lanes)) for lanes in zip(*terms, strict=True)))


def _sum(x: Lane) -> Array:
    """Sums a lane over bodies; returns a lane of one element."""
    return jnp.sum(x, axis=0, keepdims=True)
