"""Bodies of a model of MuJoCo: those welded to each other are one link, joined to its parent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.geometry import inertia
from jaxcon.io.compiled import Compiled, Names
from jaxcon.model.layout import WORLD


@dataclass(frozen=True)
class LinkJoint:
    """One of MuJoCo's joints.

    Attributes:
        id: in the model.
        kind: "free", "ball", "slide" or "hinge".
        q, v: where its coordinates begin in qpos and qvel.
    """

    id: int
    kind: str
    q: int
    v: int


@dataclass(frozen=True)
class Link:
    """Bodies without joints between them.

    Attributes:
        name: in the scene; that of the first body.
        body: id of the first body, which carries the joints.
        members: ids of all bodies.
        parent: index among the links; −1 for the world.
        above: name of the parent in the scene.
        joints: between it and its parent, in order.
    """

    name: str
    body: int
    members: tuple[int, ...]
    parent: int
    above: str
    joints: tuple[LinkJoint, ...]


def find_links(compiled: Compiled, names: Names) -> tuple[Link, ...]:
    """The links that move, each after its parent."""
    m = compiled.model
    links: list[Link] = []
    index = {0: -1}
    for body in range(1, m.nbody):
        if m.body_weldid[body] != body:
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
        parent = index[int(m.body_weldid[m.body_parentid[body]])]
        index[body] = len(links)
        name = names.take(compiled.name("body", body), "body")
        above = WORLD if parent < 0 else links[parent].name
        links.append(Link(name, body, members, parent, above, joints))
    return tuple(links)


def scene_body(compiled: Compiled, links: tuple[Link, ...], body: int) -> str:
    """The name in the scene of the link that a body of MuJoCo belongs to."""
    return next((link.name for link in links if body in link.members), WORLD)


def solid(compiled: Compiled, link: Link, dtype: Any) -> inertia.Inertia:
    """Mass, centre and principal axes of a link in the frame of its first body.

    Σ mᵢ, Σ mᵢ cᵢ / m, and the parallel axis theorem: Σ Iᵢ + mᵢ (‖d‖² − d dᵀ) with d = cᵢ − c.
    """
    m, data, ids = compiled.model, compiled.data, list(link.members)
    if len(ids) == 1:
        (b,) = ids
        axes = jnp.asarray(m.body_iquat[b], dtype)
        return inertia.Inertia(m.body_mass[b], m.body_inertia[b], m.body_ipos[b], axes)
    masses, centers = m.body_mass[ids], data.xipos[ids]
    center = masses @ centers / masses.sum()
    tensor = np.zeros((3, 3))
    for b, mass, place in zip(ids, masses, centers, strict=True):
        axes, d = data.ximat[b].reshape(3, 3), place - center
        tensor += axes @ np.diag(m.body_inertia[b]) @ axes.T
        tensor += mass * (d @ d * np.eye(3) - np.outer(d, d))
    frame = data.xmat[link.body].reshape(3, 3)
    tensor, center = frame.T @ tensor @ frame, frame.T @ (center - data.xpos[link.body])
    symmetric = jnp.asarray((tensor + tensor.T) / 2, dtype)
    return inertia.from_tensor(masses.sum(), symmetric, center)


def offset(
    compiled: Compiled, links: tuple[Link, ...], link: Link
) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and orientation (4,) of a link before its joints, in its parent's frame."""
    m = compiled.model
    top = 0 if link.parent < 0 else links[link.parent].body
    position, turn = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    body = link.body
    while body != top:
        moved, turned = np.zeros(3), np.zeros(4)
        own = m.body_pos[body], m.body_quat[body]
        compiled.mujoco.mju_mulPose(moved, turned, *own, position, turn)
        position, turn, body = moved, turned, int(m.body_parentid[body])
    return position, turn
