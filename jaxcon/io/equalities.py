"""Import of MuJoCo's equality constraints: connect, weld, and couplings of joints and tendons.

MuJoCo's constraints are soft, with `solref` and `solimp`. Here they are rigid, like joints.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.couplings import PolynomialCoupling
from jaxcon.constraints.drive import Drive
from jaxcon.constraints.joints import Coincident, Fixed, anchors, relative_orientation
from jaxcon.core.typing import Array, Scalar
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Pose
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.joints import Ends
from jaxcon.io.links import Link, scene_body
from jaxcon.system.elements import own_point


@dataclass(frozen=True)
class Connected(Coincident):
    """A constraint that makes a point of one body coincide with a point of another (connect).

    The points may be apart at assembly. The inherited `point` is the point of the first body.

    Attributes:
        point_b: the point of the second body in the world frame at assembly, (3,) [m].
    """

    point_b: Scalar | None = None

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns both points, each in the frame of its body, for the assembly poses a and b."""
        end = own_point(self, "point_b", self.point_b, b)
        return anchors(self, a, b) | {"anchor_b": b.local_point(end)}


@dataclass(frozen=True)
class Welded(Fixed):
    """A constraint that makes a frame of one body coincide with a frame of another (weld).

    The frames may be apart at assembly. The inherited `point` is the point of the first body.

    Attributes:
        point_b: the point of the second body in the world frame at assembly, (3,) [m].
        turn: the rotation from the assembly orientation of the second body to its constrained
            orientation: a quaternion (4,) in the world frame.
    """

    point_b: Scalar | None = None
    turn: Scalar | None = None

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns both points, each in the frame of its body, and the required orientation.

        The orientation is that of the second body relative to the first.

        Args:
            a: the pose of the first body at assembly.
            b: the pose of the second body at assembly.
        """
        end = own_point(self, "point_b", self.point_b, b)
        turn = jnp.asarray(self.turn, b.position.dtype)
        turned = Pose(b.position, quaternion.multiply(turn, b.orientation))
        params = anchors(self, a, b) | {"anchor_b": b.local_point(end)}
        return params | {"orientation": relative_orientation(a, turned)}


def equalities(
    compiled: Compiled,
    links: tuple[Link, ...],
    ends: Ends,
    names: Names,
) -> Iterator[Connected | Welded | Drive | PolynomialCoupling]:
    """Yields the scene elements of all active equality constraints of a model.

    Args:
        compiled: the model.
        links: the links of the model.
        ends: the scene coordinates of joints and tendons.
        names: the names in the scene.

    Raises:
        NotImplementedError: a constraint is not supported.
    """
    m = compiled.model
    if compiled.disabled("equality", "constraint"):
        return
    for i in range(m.neq):
        if not m.eq_active0[i]:
            continue
        label = compiled.name("equality", i)
        kind = compiled.choice("mjtEq", m.eq_type[i])
        if kind not in ("connect", "weld", "joint", "tendon"):
            raise NotImplementedError(
                f"from_mjcf: equality '{label}' is of type '{kind}'; supported are connect, weld,"
                " joint and tendon."
            )
        name = names.take(label, "equality")
        if kind in ("joint", "tendon"):
            yield _coupling(compiled, i, name, ends)
        else:
            yield _closure(compiled, i, kind, name, links)


def _coupling(compiled: Compiled, i: int, name: str, ends: Ends) -> Drive | PolynomialCoupling:
    """Builds the coupling y − y₀ = Σ cₖ (x − x₀)ᵏ of two coordinates x and y, of joints or tendons.

    x₀ and y₀ are the values in the reference pose. If the constraint names only one object, its
    coordinate y is held at y₀ + c₀.
    """
    m = compiled.model
    first, second, coefficients = int(m.eq_obj1id[i]), int(m.eq_obj2id[i]), m.eq_data[i, :5]
    of_joints = compiled.choice("mjtEq", m.eq_type[i]) == "joint"
    coordinates = ends.joints if of_joints else ends.tendons
    y = coordinates[first]
    if second < 0:
        return Drive(name, y.joint, held, {"value": float(coefficients[0])}, y.name)
    x = coordinates[second]
    return PolynomialCoupling(name, x.joint, y.joint, coefficients, x.name, y.name)


def held(t: Array, params: dict[str, Array]) -> Array:
    """Returns the constant `params["value"]` for all times t, as a prescribed motion of `Drive`."""
    return params["value"] + 0.0 * t


def _closure(
    compiled: Compiled, i: int, kind: str, name: str, links: tuple[Link, ...]
) -> Connected | Welded:
    """Builds a connect or weld constraint between two sites, or between two bodies.

    Raises:
        NotImplementedError: both sites or bodies belong to the same link.
    """
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


def _product(mujoco: ModuleType, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Returns the quaternion product p ⊗ q, (4,)."""
    result = np.zeros(4)
    mujoco.mju_mulQuat(result, p, q)
    return result


def _quaternion(mujoco: ModuleType, matrix: np.ndarray) -> np.ndarray:
    """Returns the quaternion (4,) of a rotation matrix, given as a flat array (9,)."""
    result = np.zeros(4)
    mujoco.mju_mat2Quat(result, matrix)
    return result
