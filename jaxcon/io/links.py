"""The links of a MuJoCo model. A body without a joint is merged into its parent's link."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import DType
from jaxcon.geometry import inertia
from jaxcon.io.compiled import Compiled, Names
from jaxcon.system.layout import WORLD


@dataclass(frozen=True)
class LinkJoint:
    """One of MuJoCo's joints.

    Attributes:
        id: the index of the joint in the model.
        kind: "free", "ball", "slide" or "hinge".
        q: the first index of the joint in qpos.
        v: the first index of the joint in qvel.
    """

    id: int
    kind: str
    q: int
    v: int


@dataclass(frozen=True)
class Link:
    """A link: a group of MuJoCo bodies that are rigidly connected to each other.

    Attributes:
        name: the name of the link in the scene, which is the name of its first body.
        body: MuJoCo's id of the first body, which has the joints.
        members: MuJoCo's ids of all bodies of the link.
        parent: the index of the parent link; −1 for the world.
        above: the name of the parent link in the scene.
        joints: the joints between the link and its parent, in order.
    """

    name: str
    body: int
    members: tuple[int, ...]
    parent: int
    above: str
    joints: tuple[LinkJoint, ...]


def find_links(compiled: Compiled, names: Names) -> tuple[Link, ...]:
    """Returns all moving links of a model, parents before children."""
    m = compiled.model
    links: list[Link] = []
    index = {0: -1}
    for body in range(1, m.nbody):
        if compiled.root(body) != body:
            continue
        start = int(m.body_jntadr[body])
        joints = tuple(
            LinkJoint(
                j,
                compiled.choice("mjtJoint", m.jnt_type[j]),
                int(m.jnt_qposadr[j]),
                int(m.jnt_dofadr[j]),
            )
            for j in range(start, start + int(m.body_jntnum[body]))
        )
        members = tuple(int(i) for i in np.flatnonzero(m.body_weldid == body))
        parent = index[compiled.root(m.body_parentid[body])]
        index[body] = len(links)
        name = names.take(compiled.name("body", body), "body")
        above = WORLD if parent < 0 else links[parent].name
        links.append(Link(name, body, members, parent, above, joints))
    return tuple(links)


def scene_body(compiled: Compiled, links: tuple[Link, ...], body: int) -> str:
    """Returns the scene name of the link that contains a body; `jc.WORLD` for fixed bodies."""
    return next((link.name for link in links if body in link.members), WORLD)


def solid(compiled: Compiled, link: Link, dtype: DType) -> inertia.Inertia:
    """Returns the inertia of a link in the frame of its first body.

    The masses mᵢ, centers cᵢ and tensors Iᵢ of its bodies are combined by the parallel axis
    theorem: m = Σ mᵢ, c = Σ mᵢ cᵢ / m, and I = Σ Iᵢ + mᵢ (‖d‖² − d dᵀ) with d = cᵢ − c.
    """
    m, data, ids = compiled.model, compiled.data, list(link.members)
    if len(ids) == 1:
        (b,) = ids
        axes = jnp.asarray(m.body_iquat[b], dtype)
        return inertia.Inertia(m.body_mass[b], m.body_inertia[b], m.body_ipos[b], axes)
    masses, centers = m.body_mass[ids], data.xipos[ids]
    center = masses @ centers / masses.sum()
    tensor = np.zeros((3, 3))
    for b, mass, at in zip(ids, masses, centers, strict=True):
        axes, d = data.ximat[b].reshape(3, 3), at - center
        tensor += axes @ np.diag(m.body_inertia[b]) @ axes.T
        tensor += mass * (d @ d * np.eye(3) - np.outer(d, d))
    frame = data.xmat[link.body].reshape(3, 3)
    tensor, center = frame.T @ tensor @ frame, frame.T @ (center - data.xpos[link.body])
    symmetric = jnp.asarray((tensor + tensor.T) / 2, dtype)
    return inertia.from_tensor(masses.sum(), symmetric, center)


def offset(
    compiled: Compiled, links: tuple[Link, ...], link: Link
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pose of a link in the frame of its parent link, with all joints at zero.

    Returns:
        The position, (3,) [m], and the orientation, a quaternion (4,).
    """
    m = compiled.model
    top = 0 if link.parent < 0 else links[link.parent].body
    position, turn = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    body = link.body
    while body != top:
        moved, turned = np.zeros(3), np.zeros(4)
        local = m.body_pos[body], m.body_quat[body]
        compiled.mujoco.mju_mulPose(moved, turned, *local, position, turn)
        position, turn, body = moved, turned, int(m.body_parentid[body])
    return position, turn
