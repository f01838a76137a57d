"""Linear and angular momentum of bodies, by lanes.

P = Σ m ẋ,    L = Σ m (x − c) × ẋ + R I ω    about c = Σ m x / Σ m.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector, times, total
from jaxcon.core.typing import Array, Lane
from jaxcon.model.layout import Place


class Part(NamedTuple):
    """Some bodies of one kind.

    Attributes:
        place: which.
        frame: their motion.
        mass, moments: (body,) [kg], [kg m²], as of `MassProperties`.
    """

    place: Place
    frame: Any
    mass: Array
    moments: Any

    @property
    def spin(self) -> Any:
        """R I ω: of a body about its own centre, world frame; one number in the plane."""
        if self.moments is None:
            return 0.0
        if not isinstance(self.moments, Vector):
            return self.moments * self.frame.omega
        pairs = zip(self.moments, self.frame.omega, strict=True)
        return self.frame.rotation @ Vector(*(i * w for i, w in pairs))


class Momentum(NamedTuple):
    """The momentum of some bodies together; lanes of one element.

    Attributes:
        position, velocity: of their centre of mass, world frame [m], [m/s].
        linear: P [kg m/s].
        angular: L about their centre of mass [kg m²/s]; one number in the plane.
    """

    position: Vector
    velocity: Vector
    linear: Vector
    angular: Any


def parts_of(snapshot: Any, places: Iterable[Place]) -> list[Part]:
    """The bodies at some places, of one body each, by kind."""
    chosen: dict[int, list[int]] = {}
    for place in places:
        assert place.group is not None
        chosen.setdefault(place.group, []).extend(place.indices)
    parts = []
    for group, indices in chosen.items():
        place = Place(group, tuple(indices))
        properties = jax.tree.map(place.take, snapshot.system.inertia[group])
        parts.append(Part(place, snapshot.frame(place), properties.mass, properties.moments))
    return parts


def momentum_of(snapshot: Any, places: Iterable[Place]) -> Momentum:
    """The momentum of the bodies at some places."""
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


def torque_pulls(part: Part, center: Vector) -> list[Vector]:
    """∂L/∂v on each body, for each component n of L: (m n × (x − c), I Rᵀ n).

    c does not matter to the sum, since Σ m (x − c) = 0.
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


def torque_bias(part: Part) -> Any:
    """L̇ where no body accelerates: R (ω × I ω); none in the plane."""
    if not isinstance(part.moments, Vector):
        return None
    omega = part.frame.omega
    own = Vector(*(i * w for i, w in zip(part.moments, omega, strict=True)))
    return part.frame.rotation @ omega.cross(own)


def _total(parts: list[Part], vector: Any) -> Vector:
    """The sum over all bodies."""
    terms = [vector(part) for part in parts]
    return Vector(*(total(map(_sum, lanes)) for lanes in zip(*terms, strict=True)))


def _sum(x: Lane) -> Lane:
    """Over bodies, as a lane of one element."""
    return jnp.sum(x, axis=0, keepdims=True)
