"""Models that are already written down: MJCF and URDF, read by MuJoCo's own compiler."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.dynamics.scene import Scene
from jaxcon.io.actuators import actuators
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.contacts import contacts
from jaxcon.io.equalities import equalities
from jaxcon.io.joints import Coordinate, join
from jaxcon.io.links import Link, find_links, offset, solid
from jaxcon.io.maps import Node, Scalar, Tree
from jaxcon.io.passive import passive
from jaxcon.io.refusals import left_out, refuse
from jaxcon.model.coordinates import TurnCounter
from jaxcon.model.inertial import restate
from jaxcon.model.state import State
from jaxcon.model.system import BodySystem
from jaxcon.simulation.method import Method


@pytree
class Keyframe:
    """A state that a model names, and the controls that go with it.

    Attributes:
        state: the state, as `MujocoModel.state` makes it.
        control: MuJoCo's ctrl, (nu,).
    """

    state: State
    control: Array


@pytree
class MujocoModel:
    """A model of MuJoCo as a system, with maps to and from MuJoCo's coordinates.

    `system, state = model` unpacks what a `Scene` builds, and `model.method()` is the `Method` that
    suits it. The control array is MuJoCo's ctrl.

    Attributes:
        system: its links are named as the bodies, its joints and actuators as MuJoCo's, with their
            kind after the name where a body or joint has it already.
        start: the state at MuJoCo's reference pose, at rest.
        timestep: of the model's options, () [s].
        tree: the links and their joints.
        keys: time, qpos, qvel and ctrl of each keyframe.
        joints: by MuJoCo's name of each hinge and slide, the joint and coordinate of the system.
        keyframes: names of the keyframes; "key 0" and so on where they have none.
    """

    system: BodySystem
    start: State
    timestep: Array
    tree: Tree
    keys: tuple[dict[str, Array], ...]
    joints: tuple[tuple[str, Coordinate], ...] = static()
    keyframes: tuple[str, ...] = static()

    def __iter__(self) -> Iterator[Any]:
        return iter((self.system, self.start))

    def with_params(self, changes: Mapping[str, Any]) -> MujocoModel:
        """Returns the model with other numbers of its system, and its start restated.

        Args:
            changes: as of `BodySystem.with_params`; links lie as MuJoCo's bodies do.

        Raises:
            ValueError: an unknown name or field, a wrong shape, or a value out of range.
        """
        system = self.system.with_params(changes)
        start = restate(self.start, self.system, system)
        return dataclasses.replace(self, system=system, start=start)

    def state(self, qpos: Any, qvel: Any = None, time: Any = 0.0) -> State:
        """The state at MuJoCo's coordinates; pure: jit, vmap and differentiate it.

        Args:
            qpos: (nq,), quaternions of any length but zero; angles may hold whole turns. Of three
                hinges of one body the middle one must stay between gimbal locks; where qpos is
                traced, that is not checked, and other angles of the same pose are read back.
            qvel: (nv,); zero unless given.
            time: () [s].

        Raises:
            ValueError: a wrong shape or dtype, or a middle hinge beyond gimbal lock.
        """
        dtype = self.start.q.dtype
        qpos = checks.real("state", "qpos", qpos, dtype, self.tree.reference.shape)
        still = jnp.zeros(self.tree.size, dtype)
        qvel = still if qvel is None else checks.real("state", "qvel", qvel, dtype, still.shape)
        self.tree.check(qpos)
        q, v = self.tree.flat(self.system, qpos, qvel)
        turns = self.tree.turns_of(self.system, qpos)
        time = checks.real("state", "time", time, dtype)
        return dataclasses.replace(self.start, q=q, v=v, time=time, turns=turns)

    def method(self, **parts: Any) -> Method:
        """Returns the method that suits the model by its structure: `Method.auto` at the start.

        `Method.auto` chooses the solver of the joints. That of stops, friction and contacts is left
        to `Method`, which takes sweeps where they have many rows. The start of a method with other
        parts is `jc.init(system, method, state.q, state.v)`.

        Args:
            parts: other parts, such as `integrator=jc.RK4()`, and the arguments `batch` and
                `platform` of `Method.auto`.
        """
        return Method.auto(self.system, self.start, **parts)

    def qpos(self, state: State) -> Array:
        """MuJoCo's positions of a state, (nq,).

        An angle lies within half a turn of its reference unless whole turns are counted: by a
        spring, servo or coupling, or everywhere by `from_mjcf(…, count_turns=True)`.

        Args:
            state: of one world.
        """
        return self.tree.read(self.system, state)[0]

    def qvel(self, state: State) -> Array:
        """MuJoCo's velocities of a state, (nv,).

        Args:
            state: of one world.
        """
        return self.tree.read(self.system, state)[1]

    def qacc(self, state: State, acceleration: Array) -> Array:
        """MuJoCo's accelerations, (nv,): the rate of qvel where the bodies have this a (n_v,).

        Args:
            state: of one world.
            acceleration: a, (n_v,).
        """

        def qvel(q: Array, v: Array) -> Array:
            return self.qvel(dataclasses.replace(state, q=q, v=v))

        slopes = self.system.kinematics(state.q, state.v), acceleration
        return jax.jvp(qvel, (state.q, state.v), slopes)[1]

    def keyframe(self, name: str) -> Keyframe:
        """A keyframe by name.

        Args:
            name: as the model has it.

        Raises:
            ValueError: there is none of this name.
        """
        if name not in self.keyframes:
            raise ValueError(f"keyframe '{name}' is unknown; known are {list(self.keyframes)}.")
        key = self.keys[self.keyframes.index(name)]
        return Keyframe(self.state(key["qpos"], key["qvel"], key["time"]), key["ctrl"])


def from_mjcf(
    source: Any, ignore: tuple[str, ...] = (), count_turns: bool = False, dtype: Any = None
) -> MujocoModel:
    """A system from an MJCF or URDF model, compiled by MuJoCo: `pip install 'jaxcon[mujoco]'`.

    Bodies without a joint become part of their parent. Several joints of one body become one
    `Compound`. Springs, dampers, rotors (armature), actuators and keyframes are those of the model;
    equality constraints hold as joints do, not softly by `solref` and `solimp`. Integrator and
    step are the user's, `timestep` is the model's. What has no effect on the motion (sites,
    cameras, sensors) is left out; what has one and is not supported is refused by name.

    Ranges of hinges and slides are `Limit`s, frictionloss is `JointFriction`, and pairs of geoms
    that may touch are contacts: spheres, capsules by the balls at their ends, and boxes by their
    corners on planes, and spheres and capsules on each other. Stops and contacts are hard and
    without rebound, not soft by `solref` and `solimp`; they act where MuJoCo's soft ones begin to,
    at `margin` from the stop or surface. Friction is Coulomb's, by the sliding coefficient alone.
    `info.reactions["knee limit"]`, `["knee friction"]` and `["floor and foot"]`, numbered where a
    shape touches at several points, read what they do.

    Every pair is rows in every step, whether it touches or not. Where a model lets its own limbs
    touch, many pairs are between them; `ignore=("self_contact",)` keeps the ground alone.

    Args:
        source: path of a file, its text, or a `mujoco.MjModel`.
        ignore: what to leave out although it has an effect, out of
            "contact": all contacts,
            "self_contact": those between two bodies that move,
            "shape": those of shapes for which there is none here,
            "torsion": torsional and rolling friction, by condim 4 or 6,
            "limit": all limits of joints,
            "ball_limit": those of ball joints,
            "friction": dry friction of joints,
            "tendon": tendons with all that they do, "fluid", and "gravcomp".
        count_turns: whether every hinge counts its whole turns, so that `qpos` gives them.
        dtype: of every number; JAX's default float unless given.

    Returns:
        The model; `system, state = jc.from_mjcf(path)` is enough to simulate it.

    Raises:
        ImportError: MuJoCo is not installed.
        FileNotFoundError: there is no such file.
        ValueError: MuJoCo cannot compile it, or nothing in it moves.
        NotImplementedError: it has what is not supported; the message names it.
    """
    checks.flag("from_mjcf", "count_turns", count_turns)
    compiled = Compiled(source, left_out(ignore))
    refuse(compiled)
    names = Names()
    links = find_links(compiled, names)
    scene = Scene(gravity=_gravity(compiled), dtype=dtype)
    for link in links:
        frame = compiled.data.xpos[link.body], compiled.data.xquat[link.body]
        body = solid(compiled, link, scene.dtype)
        scene.add_body(link.name, inertia=body, position=frame[0], quaternion=frame[1])
    found = _add_elements(scene, compiled, links, names, count_turns)
    system, state = scene.build()
    m, cast = compiled.model, lambda x: jnp.asarray(x, scene.dtype)
    keys = [
        {"time": m.key_time[i], "qpos": m.key_qpos[i], "qvel": m.key_qvel[i], "ctrl": m.key_ctrl[i]}
        for i in range(m.nkey)
    ]
    return MujocoModel(
        system,
        state,
        cast(m.opt.timestep),
        _tree(compiled, links, found, cast),
        jax.tree.map(cast, tuple(keys)),
        tuple((compiled.name("joint", i), at) for i, at in sorted(found.items())),
        tuple(compiled.name("key", i) for i in range(m.nkey)),
    )


def _gravity(compiled: Compiled) -> np.ndarray:
    """Returns the gravity of the options [m/s²]."""
    return compiled.model.opt.gravity * (not compiled.disabled("gravity"))


def _add_elements(
    scene: Scene, compiled: Compiled, links: tuple[Link, ...], names: Names, count: bool
) -> dict[int, Coordinate]:
    """Adds everything between the links; returns the coordinate of each hinge and slide."""
    found: dict[int, Coordinate] = {}
    for link in links:
        joined = join(compiled, link, names)
        found |= joined.coordinates
        for element in joined.elements:
            scene.add(element)
    for element in equalities(compiled, links, found, names):
        scene.add(element)
    for element in actuators(compiled, links, found, names):
        scene.add(element)
    for link in links:
        for joint in link.joints:
            at = found.get(joint.id)
            for element in passive(compiled, link, joint, at, names):
                scene.add(element)
            if count and at is not None and joint.kind == "hinge":
                own = compiled.name("joint", joint.id)
                scene.add(TurnCounter(names.take(f"{own} turns", "turns"), *at))
    for element in contacts(compiled, links, names):
        scene.add(element)
    return found


def _tree(
    compiled: Compiled, links: tuple[Link, ...], found: dict[int, Coordinate], cast: Any
) -> Tree:
    """The links and joints as what maps coordinates."""
    m = compiled.model
    offsets = [offset(compiled, links, link) for link in links]
    joints = {joint.id: joint for link in links for joint in link.joints}
    scalars = [Scalar(joints[i].q, joints[i].v, at) for i, at in sorted(found.items())]
    return Tree(
        cast(np.array([x for x, _ in offsets])),
        cast(np.array([turn for _, turn in offsets])),
        cast(m.jnt_pos),
        cast(m.jnt_axis),
        cast(m.qpos0),
        nodes=tuple(Node(link.name, link.parent, link.joints) for link in links),
        scalars=tuple(scalars),
        size=m.nv,
    )
