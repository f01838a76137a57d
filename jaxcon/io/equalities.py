"""Equality constraints of MuJoCo's: points that meet, bodies that are welded, coupled joints.

MuJoCo pulls them together softly, by `solref` and `solimp`; here they hold as joints do.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.couplings import PolynomialCoupling
from jaxcon.constraints.drive import Drive
from jaxcon.constraints.joints import Coincident, Fixed, anchors, relative_orientation
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Pose
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.joints import Coordinate
from jaxcon.io.links import Link, scene_body
from jaxcon.model.elements import own_point


@dataclass(frozen=True)
class Connected(Coincident):
    """Two points meet that need not do so at assembly; `point` is that of the first body."""

    point_b: Any = None

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Each point in its own frame."""
        end = own_point(self, "point_b", self.point_b, b)
        return anchors(self, a, b) | {"anchor_b": b.local_point(end)}


@dataclass(frozen=True)
class Welded(Fixed):
    """Two frames meet that need not do so at assembly; `point` is that of the first body.

    Attributes:
        point_b: of the second body, world frame at assembly [m].
        turn: by which the second body must turn in the world to be as it is to be, (4,).
    """

    point_b: Any = None
    turn: Any = None

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Each point in its own frame, and the orientation of b in a that is to be."""
        end = own_point(self, "point_b", self.point_b, b)
        turn = jnp.asarray(self.turn, b.position.dtype)
        turned = Pose(b.position, quaternion.multiply(turn, b.orientation))
        params = anchors(self, a, b) | {"anchor_b": b.local_point(end)}
        return params | {"orientation": relative_orientation(a, turned)}


def equalities(
    compiled: Compiled,
    links: tuple[Link, ...],
    coordinates: dict[int, Coordinate],
    names: Names,
) -> Iterator[Any]:
    """The elements of all equality constraints that are active.

    Raises:
        NotImplementedError: one of them is of a kind that is not supported.
    """
    m = compiled.model
    if compiled.disabled("equality", "constraint"):
        return
    for i in range(m.neq):
        if not m.eq_active0[i]:
            continue
        own = compiled.name("equality", i)
        kind = compiled.choice("mjtEq", m.eq_type[i])
        if kind not in ("connect", "weld", "joint"):
            raise NotImplementedError(
                f"from_mjcf: equality '{own}' is of type '{kind}'; supported are connect, weld and"
                " joint."
            )
        name = names.take(own, "equality")
        if kind == "joint":
            yield _coupling(compiled, i, name, coordinates)
        else:
            yield _closure(compiled, i, kind, name, links)


def _coupling(compiled: Compiled, i: int, name: str, coordinates: dict[int, Coordinate]) -> Any:
    """y − y₀ = Σ cₖ (x − x₀)ᵏ, and y − y₀ = c₀ where there is no x."""
    m = compiled.model
    first, second, coefficients = int(m.eq_obj1id[i]), int(m.eq_obj2id[i]), m.eq_data[i, :5]
    y = coordinates[first]
    if second < 0:
        return Drive(name, y.joint, held, {"value": float(coefficients[0])}, y.name)
    x = coordinates[second]
    return PolynomialCoupling(name, x.joint, y.joint, coefficients, x.name, y.name)


def held(t: Any, params: Any) -> Any:
    """A motion that stands still."""
    return params["value"] + 0.0 * t


def _closure(
    compiled: Compiled, i: int, kind: str, name: str, links: tuple[Link, ...]
) -> Connected | Welded:
    """Two bodies that share a point or a frame, which are those of two sites, or of the bodies."""
    m, data, mujoco = compiled.model, compiled.data, compiled.mujoco
    objects = int(m.eq_obj1id[i]), int(m.eq_obj2id[i])
    by_site = m.eq_objtype[i] == int(mujoco.mjtObj.mjOBJ_SITE)
    ids = [int(m.site_bodyid[s]) for s in objects] if by_site else list(objects)
    bodies = [scene_body(compiled, links, b) for b in ids]
    if bodies[0] == bodies[1]:
        raise NotImplementedError(
            f"from_mjcf: equality '{name}' is between bodies that cannot move in each other."
        )
    if by_site:
        points = [data.site_xpos[s] for s in objects]
        turns = [_quaternion(mujoco, data.site_xmat[s]) for s in objects]
    else:
        local = (m.eq_data[i, :3], m.eq_data[i, 3:6])
        local = local if kind == "connect" else local[::-1]
        frames = zip(ids, local, strict=True)
        points = [data.xpos[b] + data.xmat[b].reshape(3, 3) @ x for b, x in frames]
        turns = [data.xquat[b] for b in ids]
        if kind == "weld":
            turns[0] = np.asarray(_product(mujoco, turns[0], m.eq_data[i, 6:10]))
    if kind == "connect":
        return Connected(name, *bodies, point=points[0], point_b=points[1])
    back = turns[1] * [1.0, -1.0, -1.0, -1.0]
    turn = _product(mujoco, turns[0], back)
    return Welded(name, *bodies, point=points[0], point_b=points[1], turn=turn)


def _product(mujoco: Any, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    result = np.zeros(4)
    mujoco.mju_mulQuat(result, p, q)
    return result


def _quaternion(mujoco: Any, matrix: np.ndarray) -> np.ndarray:
    result = np.zeros(4)
    mujoco.mju_mat2Quat(result, matrix)
    return result
