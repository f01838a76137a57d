"""Blades: a point of a body moves over a plane along an edge and not across it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints import primitives
from jaxcon.constraints.joints import PERPENDICULAR, unit
from jaxcon.constraints.primitives import Row
from jaxcon.constraints.surfaces import Plane, normal, surface
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label, own_point


@dataclass(frozen=True)
class KnifeEdge:
    """A blade moves along its edge and not sideways: 1 row in the plane, 2 in space.

    In the plane of a scene, which is that of the ice, ψ = m·(ċ − v_a(c)) with m the direction to
    the left of the edge e. In space the point c of the blade stays on the plane, φ = n·(c − p), and
    m = n × e / ‖n × e‖: the blade may lean and pitch. λ of ψ is the side force [N].

    Attributes:
        name: unique in the scene.
        body_a: of the ice, or `WORLD`.
        body_b: the skate, sleigh or vehicle.
        edge: e, world frame at assembly, (dim,), any length but zero.
        normal: of the ice, towards the blade, world frame at assembly, (3,); z unless given; only
            in space.
        center: c, where the blade touches the ice, world frame at assembly, (dim,) [m]; the second
            body's centre of mass unless given.
    """

    name: str
    body_a: str
    body_b: str
    edge: Any
    normal: Any = None
    center: Any = None
    oriented = True
    in_b = ("edge",)

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The plane in a, the point and the edge in b."""
        e, center = unit(self, "edge", b), own_point(self, "center", self.center, b)
        if a.position.shape == (3,):
            n = normal(self, a)
            if checks.is_concrete((e, n)) and float(numerics.norm(jnp.cross(e, n))) < PERPENDICULAR:
                raise ValueError(
                    f"{label(self)}: its edge {checks.numerals(e)} must not be the normal of the"
                    f" ice {checks.numerals(n)}, across which a blade points nowhere."
                )
            axes = surface(n, a)
        elif self.normal is None:
            axes = {
                "first_a": jnp.eye(2, dtype=e.dtype)[0],
                "second_a": jnp.eye(2, dtype=e.dtype)[1],
            }
        else:
            raise ValueError(f"{label(self)}: in the plane the ice is the scene; give no normal.")
        anchors = {"anchor_a": a.local_point(center), "anchor_b": b.local_point(center)}
        return axes | anchors | {"edge": b.local_direction(e)}

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """In space n·(c − p) = 0; ψ = 0.

        With e₁, e₂ the components of e along the tangents, brought to length one, and V₁, V₂ the
        rates of t·(c − p): ψ = e₁ V₂ − e₂ V₁, and ė₁ = −e₂ χ, ė₂ = e₁ χ at the turning rate χ of
        the edge in the plane.
        """
        plane, center = Plane(p, a), b.point(p["anchor_b"])
        first, second = plane.tangents
        x, y = (primitives.angle_between(t, b.direction(p["edge"])) for t in (first, second))
        weight = numerics.safe_divide(1.0, numerics.norm(Vector(x.value, y.value)))
        e1, e2 = x.value * weight, y.value * weight
        χ = (e1 * y.rate - e2 * x.rate) * weight
        u, w = plane.along(first, center), plane.along(second, center)
        slip = Row(
            0.0,
            e1 * w.rate - e2 * u.rate,
            e1 * w.bias - e2 * u.bias - χ * (e1 * u.rate + e2 * w.rate),
            (w.pulls[0] * e1 - u.pulls[0] * e2, w.pulls[1] * e1 - u.pulls[1] * e2),
            holonomic=False,
        )
        return [slip] if "normal" not in p else [plane.height(center), slip]
