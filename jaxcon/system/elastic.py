"""Force elements of slender bodies: bending of a chain of points, bending and twist of links."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector, axes, times, total
from jaxcon.core.typing import Array, DType, Lane
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import own_point
from jaxcon.system.forces import ForceElement
from jaxcon.system.frames import BodyFrame, Direction, Point


@dataclass(frozen=True)
class Bending(ForceElement):
    """Bending of an inextensible chain at a point between two others: E = ½ (B/s) ‖t₂ − t₁‖².

    The tangents are t₁ = (r_b − r_a)/s₁ and t₂ = (r_c − r_b)/s₂, with the points r_a, r_b, r_c. s₁
    and s₂ are the distances at assembly, and s is their mean. The sum over a chain tends to ½ ∫ B
    κ² ds with curvature κ. The forces are linear in positions.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b, body_c: names of the bodies, or `WORLD`; the chain runs from a through b to
            c.
        stiffness: bending stiffness B = E I [N m²].
        point_a, point_b, point_c: world points at assembly, (dim,) [m]; the centers of mass unless
            given.
    """

    name: str
    body_a: str
    body_b: str
    body_c: str
    stiffness: Any
    point_a: Any = None
    point_b: Any = None
    point_c: Any = None
    ranges = MappingProxyType(
        {
            "stiffness": checks.NumberRange(least=0),
            "before": checks.NumberRange(above=0),
            "after": checks.NumberRange(above=0),
        }
    )

    @property
    def bodies(self) -> tuple[str, ...]:
        """The names of the bodies on which the element acts."""
        return (self.body_a, self.body_b, self.body_c)

    def attach(self, a: Pose, b: Pose, c: Pose) -> dict[str, Array]:
        """Returns the points in body frames, the distances between them, and the stiffness."""
        owner = f"Bending '{self.name}'"
        first, middle, last = (
            own_point(self, what, getattr(self, what), pose)
            for what, pose in (("point_a", a), ("point_b", b), ("point_c", c))
        )
        checks.nonzero(owner, "point_b − point_a", middle - first)
        checks.nonzero(owner, "point_c − point_b", last - middle)
        stiffness = checks.real(owner, "stiffness", self.stiffness, a.position.dtype)
        return {
            "anchor_a": a.local_point(first),
            "anchor_b": b.local_point(middle),
            "anchor_c": c.local_point(last),
            "before": numerics.norm(middle - first),
            "after": numerics.norm(last - middle),
            "stiffness": stiffness,
        }

    @staticmethod
    def forces(p: dict[str, Any], a: BodyFrame, b: BodyFrame, c: BodyFrame) -> tuple[Vector, ...]:
        """Returns the generalized forces on the bodies of the points a, b and c.

        The forces are −g/s₁ at a, g (1/s₁ + 1/s₂) at b and −g/s₂ at c, with g = (B/s)(t₂ − t₁).
        """
        points, bend = _bend(p, a, b, c)
        g = bend * (2 * _stiffness_by_length(p))
        on_a, on_c = g * (-1 / p["before"]), g * (-1 / p["after"])
        on_b = -(on_a + on_c)
        return tuple(x.pull(f) for x, f in zip(points, (on_a, on_b, on_c), strict=True))

    @staticmethod
    def potential(p: dict[str, Any], a: BodyFrame, b: BodyFrame, c: BodyFrame) -> Lane:
        """Returns the bending energy ½ (B/s) ‖t₂ − t₁‖² [J], with the tangents t₁ and t₂."""
        bend = _bend(p, a, b, c)[1]
        return _stiffness_by_length(p) * bend.dot(bend)


def _stiffness_by_length(p: dict[str, Any]) -> Lane:
    """Returns B / (s₁ + s₂), the bending stiffness divided by the length of both links.

    The result is NaN for an infinite length, which would otherwise give a zero force unnoticed.
    """
    return p["stiffness"] / numerics.finite_or_nan(p["before"] + p["after"])


def _bend(
    p: dict[str, Any], a: BodyFrame, b: BodyFrame, c: BodyFrame
) -> tuple[tuple[Point, Point, Point], Vector]:
    """Returns the three points a, b, c, and the difference t₂ − t₁ of the tangents between them."""
    points = a.point(p["anchor_a"]), b.point(p["anchor_b"]), c.point(p["anchor_c"])
    first, middle, last = (x.position for x in points)
    return points, (last - middle) * (1 / p["after"]) - (middle - first) * (1 / p["before"])


@dataclass(frozen=True)
class Flexure(ForceElement):
    """A joint that resists bending and twist between rigid bodies: E = Σ κᵢ (1 − aᵢ·bᵢ).

    aᵢ are the principal axes of the first body, x along its length. bᵢ are the directions of the
    second body that coincide with them when the joint is relaxed. With κ_x = k_b − k_t/2 and κ_y =
    κ_z = k_t/2, E is ½ k_t θ_x² + ½ k_b (θ_y² + θ_z²) for small turns θ about these axes, and
    smooth for all turns. In the plane E = k_b (1 − cos θ).

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of bodies, or `WORLD`.
        bending: bending stiffness k_b [N m/rad]; B/s for links of length s with B = E I.
        twisting: torsional stiffness k_t ≤ 2 k_b, in space [N m/rad].
        straight: True if the joint is relaxed when the principal axes of both bodies coincide;
            False if it is relaxed as assembled.
    """

    name: str
    body_a: str
    body_b: str
    bending: Any
    twisting: Any = 0.0
    straight: bool = False
    by_principal_axes = True
    ranges = MappingProxyType(dict.fromkeys(("bending", "twisting"), checks.NumberRange(least=0)))

    @property
    def bodies(self) -> tuple[str, ...]:
        """The names of the bodies on which the element acts."""
        return (self.body_a, self.body_b)

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the stiffnesses and, if not `straight`, the directions bᵢ of the second body.

        At assembly, bᵢ coincide with the principal axes of the first body.

        Raises:
            ValueError: a body is a particle.
        """
        owner, dtype = f"Flexure '{self.name}'", a.position.dtype
        for name, pose in zip(self.bodies, (a, b), strict=True):
            if pose.orientation is None:
                raise ValueError(f"{owner}: '{name}' is a particle: it has no orientation.")
        checks.flag(owner, "straight", self.straight)
        bending = checks.real(owner, "bending", self.bending, dtype)
        twisting = checks.real(owner, "twisting", self.twisting, dtype)
        dim = a.position.shape[0]
        params = {"bending": bending}
        if dim == 3:
            params["twisting"] = twisting
        if not self.straight:
            directions = jnp.eye(dim, dtype=dtype)[: 1 if dim == 2 else 3]
            params |= {
                f"relaxed_{i}": b.local_direction(a.direction(x)) for i, x in enumerate(directions)
            }
        return params

    @classmethod
    def check_numbers(cls, owner: str, numbers: Mapping[str, Any], dtype: DType) -> None:
        """Checks that both stiffnesses are not negative, and that k_t ≤ 2 k_b.

        Args:
            owner: first words of errors.
            numbers: the numbers by field; in the plane there is no twisting.
            dtype: dtype of the scene.

        Raises:
            ValueError: a stiffness is out of range.
        """
        super().check_numbers(owner, numbers, dtype)
        bending, twisting = numbers["bending"], numbers.get("twisting", 0.0)
        if not checks.is_concrete((bending, twisting)):
            return
        bending, twisting = (np.asarray(x, dtype) for x in (bending, twisting))
        if twisting > 2 * bending:
            raise ValueError(
                f"{owner}: twisting must be at most twice bending, got {twisting:g} and"
                f" {bending:g}: beyond that the straight joint is unstable at large turns."
            )

    @staticmethod
    def forces(p: dict[str, Any], a: BodyFrame, b: BodyFrame) -> tuple[Vector, Vector]:
        """Returns the generalized forces on both bodies, the negative gradient of the energy.

        With E = Σ κᵢ (1 − aᵢ·bᵢ), they are sums over the axes i: κᵢ times the gradient of aᵢ·bᵢ.
        """
        pulls = [
            (u.pull(w.position) * k, w.pull(u.position) * k) for u, w, k in _directors(p, a, b)
        ]
        first, second = (_sum(side) for side in zip(*pulls, strict=True))
        return first, second

    @staticmethod
    def potential(p: dict[str, Any], a: BodyFrame, b: BodyFrame) -> Lane:
        """Returns the energy Σ κᵢ (1 − aᵢ·bᵢ) [J], with stiffnesses κᵢ and directions aᵢ, bᵢ."""
        return total(k * (1 - u.position.dot(w.position)) for u, w, k in _directors(p, a, b))


def _sum(vectors: tuple[Vector, ...]) -> Vector:
    """Returns the sum of vectors."""
    return Vector(*(total(lanes) for lanes in zip(*vectors, strict=True)))


def _directors(
    p: dict[str, Any], a: BodyFrame, b: BodyFrame
) -> list[tuple[Direction, Direction, Lane]]:
    """Returns, for each axis, the directions aᵢ and bᵢ of both bodies and the stiffness κᵢ."""
    if "twisting" not in p:
        shares, directions = [p["bending"]], axes(2)[:1]
    else:
        half = times(0.5, p["twisting"])
        shares, directions = [p["bending"] - half, half, half], axes(3)
    return [
        (a.direction(e), b.direction(p.get(f"relaxed_{i}", e)), k)
        for i, (e, k) in enumerate(zip(directions, shares, strict=True))
    ]
