"""Import of MJCF and URDF models, which are read by MuJoCo's own compiler."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.builders.scene import Scene
from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.summary import listed, span, table
from jaxcon.core.typing import Array, DType, Scalar
from jaxcon.execution.step import SolutionAt
from jaxcon.io import maps
from jaxcon.io.activations import Activations, activations, warn
from jaxcon.io.actuators import Transmission, actuators
from jaxcon.io.compiled import Compiled, Names, Source
from jaxcon.io.contacts import contacts
from jaxcon.io.equalities import equalities
from jaxcon.io.joints import Coordinate, Ends, join
from jaxcon.io.links import Link, find_links, offset, solid
from jaxcon.io.maps import Node, Tree
from jaxcon.io.measuring import Reading
from jaxcon.io.passive import fluid_drag, gravity_compensation, passive
from jaxcon.io.refusals import left_out, refuse
from jaxcon.io.sensor_import import Importer
from jaxcon.io.sensors import Sensors
from jaxcon.io.tendons import passive_tendons, tendons
from jaxcon.methods.method import Method
from jaxcon.step import StepInfo
from jaxcon.system.body_system import BodySystem
from jaxcon.system.coordinates import TurnCounter
from jaxcon.system.inertial import restate
from jaxcon.system.state import State


@pytree
class Keyframe:
    """A keyframe of a model: a state and controls.

    Attributes:
        state: the state of the system.
        control: MuJoCo's ctrl, (nu,).
        activation: MuJoCo's act, (na,).
    """

    state: State
    control: Array
    activation: Array


@pytree
class MujocoModel:
    """An imported MuJoCo model: a system, and conversions to and from MuJoCo's coordinates.

    `system, state = model` unpacks the system and its initial state, as `jc.Scene.build` returns
    them. `model.method()` is a suitable `jc.Method`. The control array is MuJoCo's ctrl, with the
    activations of filters, integrators and muscles in place of their controls; see `activate`.

    Attributes:
        system: the system. Links, joints and actuators have MuJoCo's names. If an object of another
            kind already has the name, the kind is appended.
        start: the state in MuJoCo's reference pose, at rest.
        timestep: the step size in the model's options, () [s].
        tree: the kinematic tree in MuJoCo's coordinates.
        keys: time, qpos, qvel, ctrl and act of each keyframe.
        readings: the sensors; `sensors` reads them.
        activations: the dynamics of the activations; `activate` advances them.
        joints: for each hinge and slide, its name in MuJoCo, and its coordinate in the system.
        keyframes: the names of the keyframes; "key 0" and so on for keyframes without a name.
    """

    system: BodySystem
    start: State
    timestep: Array
    tree: Tree
    keys: tuple[dict[str, Array], ...]
    readings: Sensors
    activations: Activations
    joints: tuple[tuple[str, Coordinate], ...] = static()
    keyframes: tuple[str, ...] = static()

    def __repr__(self) -> str:
        """Describes the step size, the keyframes, the activations and the system."""
        pairs = zip(self.activations.names, self.activations.kinds, strict=True)
        acts = listed([f"{name} ({kind})" for name, kind in pairs])
        rows = [
            ("timestep", span(self.timestep, "s")),
            ("keyframes", listed(self.keyframes)),
            ("activations", acts and f"{acts}: call activate in each step"),
        ]
        return f"{table('MujocoModel', rows)}\n{self.system!r}"

    def __iter__(self) -> Iterator[Any]:
        return iter((self.system, self.start))

    def with_params(self, changes: Mapping[str, Any]) -> MujocoModel:
        """Returns the model with changed parameters; the poses of all links at `start` are kept.

        Args:
            changes: new values by name; see `with_params` of the system. The values refer to the
                frames of MuJoCo's bodies.

        Raises:
            ValueError: a name or field is unknown, a shape is wrong, or a value is out of range.
        """
        system = self.system.with_params(changes)
        start = restate(self.start, self.system, system)
        return dataclasses.replace(self, system=system, start=start)

    def state(
        self,
        qpos: Scalar | Sequence[float],
        qvel: Scalar | Sequence[float] | None = None,
        time: Scalar = 0.0,
    ) -> State:
        """Converts MuJoCo's coordinates to a state; works under jit, vmap and grad.

        Args:
            qpos: MuJoCo's positions, (nq,). Quaternions may have any nonzero length, and angles may
                include whole turns. If a body has three hinges, the angle of the middle hinge must
                stay short of gimbal lock. Traced values are not checked for this; beyond gimbal
                lock, the method `qpos` returns other angles of the same pose.
            qvel: MuJoCo's velocities, (nv,); zero by default.
            time: the time, () [s].

        Raises:
            ValueError: a shape or dtype is wrong, or a middle hinge is beyond gimbal lock.
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
        """Returns a suitable method for the model, by `jc.Method.auto` at `start`.

        `jc.Method.auto` chooses the linear solver. The contact solver is the default of
        `jc.Method`: for robots with stops and contact, `Newton` where it can be used and
        `GaussSeidel` elsewhere. If you pass other parts, initialize the state with
        `jc.init(system, method, state.q, state.v)`.

        Args:
            parts: parts of the method that replace the defaults, such as `integrator=jc.RK4()`, and
                the arguments `batch` and `platform` of `jc.Method.auto`.
        """
        return Method.auto(self.system, self.start, **parts)

    def qpos(self, state: State) -> Array:
        """Returns MuJoCo's positions qpos of a state, (nq,).

        Angles lie within half a turn of the reference pose, unless whole turns are counted. Turns
        are counted for joints with a spring, servo or coupling, and for all hinges after
        `from_mjcf(…, count_turns=True)`.

        Args:
            state: the state of one world.
        """
        return self.tree.read(self.system, state)[0]

    def qvel(self, state: State) -> Array:
        """Returns MuJoCo's velocities qvel of a state, (nv,).

        Args:
            state: the state of one world.
        """
        return self.tree.read(self.system, state)[1]

    def qacc(self, state: State, acceleration: Array) -> Array:
        """Returns MuJoCo's accelerations, (nv,): the rate of qvel for given body accelerations.

        Args:
            state: the state of one world.
            acceleration: the accelerations a of the system, (n_v,).
        """

        def qvel(q: Array, v: Array) -> Array:
            """Returns MuJoCo's qvel at positions q and velocities v of the system."""
            return self.qvel(dataclasses.replace(state, q=q, v=v))

        slopes = self.system.kinematics(state.q, state.v), acceleration
        return jax.jvp(qvel, (state.q, state.v), slopes)[1]

    @property
    def activation(self) -> Array:
        """MuJoCo's act at the start, (na,): zeros."""
        return jnp.zeros(len(self.activations.kinds), self.start.q.dtype)

    def activate(
        self, activation: Array, control: Array, dt: Scalar | None = None
    ) -> tuple[Array, Array]:
        """Advances the activations of filters, integrators and muscles by a step.

        The control of the system has the activations in place of the controls of these actuators.
        A step of a model with activations is

            act, control = model.activate(act, ctrl, dt)
            state, info = jc.step(model.system, method, state, control, dt)

        as in MuJoCo's Euler integrator. Begin with act = `model.activation`.

        Args:
            activation: MuJoCo's act, (na,).
            control: MuJoCo's ctrl, (nu,).
            dt: the step size h, () [s]; `timestep` by default.

        Returns:
            The activations after the step, (na,), and the control of the system, (nu,).
        """
        dtype, count = self.start.q.dtype, len(self.activations.kinds)
        act = checks.real("activate", "activation", activation, dtype, (count,))
        n_u = self.system.layout.n_u
        ctrl = checks.real("activate", "control", control, dtype, (n_u,))
        h = self.timestep if dt is None else checks.real("activate", "dt", dt, dtype)
        return self.activations.advance(act, ctrl, h)

    @property
    def sensor_slices(self) -> dict[str, slice]:
        """The slice of each sensor in MuJoCo's sensordata, by name."""
        return {x.name: slice(x.start, x.start + x.size) for x in self.readings.entries}

    def sensors(
        self,
        state: State,
        info: StepInfo | SolutionAt | None = None,
        control: Array | None = None,
        names: Sequence[str] | None = None,
    ) -> Array:
        """Reads the sensors, (nsensordata,), as MuJoCo's sensordata; a pure function.

        Accelerometers and sensors of force, torque and touch read the `info`, at its state, which
        is the start of the step. All other sensors read `state`. For readings of one instant, as in
        MuJoCo, pass the state before the step, or `jc.forward_dynamics` of the state. Cutoffs are
        applied; noise is not added.

        Args:
            state: the state of one world.
            info: the info of a step, or the result of `jc.forward_dynamics`. Models without these
                sensors need none.
            control: the control of the system, (nu,); by default the control of the info.
            names: the sensors to read, in the order of the result; by default all. Sensors without
                a name are called "sensor 0" and so on, or "sensor 0 (unnamed)" if another sensor
                has this name. `readings.supported` are the names of all supported sensors.

        Raises:
            ValueError: a name is unknown, `names` is a str, or a sensor needs an info or the
                control.
            NotImplementedError: a sensor is not supported; the message names it.
        """
        chosen = self.readings.chosen(names)
        control = info.control if control is None and info is not None else control
        self.readings.check(chosen, info, control, self.system.layout.n_u)
        if control is not None:
            given = state.q.dtype, (self.system.layout.n_u,)
            control = checks.real("sensors", "control", control, *given)
        model = self.system, self.tree, self.readings.parts
        here = Reading(*model, state, None, control)
        start = here if info is None else Reading(*model, info.state, info, control)
        return self.readings.read(here, start, chosen)

    def keyframe(self, name: str) -> Keyframe:
        """Returns the state and controls of a keyframe.

        Args:
            name: one of the names in `keyframes`.

        Raises:
            ValueError: the name is unknown.
        """
        if name not in self.keyframes:
            raise ValueError(f"keyframe '{name}' is unknown; known are {list(self.keyframes)}.")
        key = self.keys[self.keyframes.index(name)]
        state = self.state(key["qpos"], key["qvel"], key["time"])
        return Keyframe(state, key["ctrl"], key["act"])


def from_mjcf(
    source: Source,
    ignore: tuple[str, ...] = (),
    count_turns: bool = False,
    dtype: DType | None = None,
) -> MujocoModel:
    """Imports an MJCF or URDF model. Needs MuJoCo: `pip install 'jaxcon[mujoco]'`.

    Bodies without a joint are merged into their parent. Several joints of one body become one
    `jc.joints.Compound`. Springs, dampers, armature, actuators and keyframes are imported. Equality
    constraints are rigid, like joints; `solref` and `solimp` are not used. The integrator and the
    step size are not imported; `timestep` is the step size in the model.

    The attribute gravcomp becomes a constant `jc.forces.Force`. It does not follow later changes of
    mass or gravity. Density and viscosity become a `jc.forces.FluidDrag` on the inertia box of each
    body. The model of ellipsoids (fluidshape) is not supported.

    The method `sensors` of the model reads its sensors. Features without effect on the motion, such
    as cameras, are dropped. Unsupported features with an effect raise an error that names them.

    Actuators act on joints and tendons, or at sites: without a reference site as a
    `jc.joints.Thrust`, which adds a force and a torque that turn with the site. Muscles become a
    `jc.forces.Muscle`. The method `activate` of the model advances the activations of filters,
    integrators and muscles.

    Tendons become a `jc.joints.Tendon`: over joints, or over a `jc.joints.Span` for each segment
    between sites. Segments that wrap around spheres and cylinders are a `jc.joints.WrappedSpan`,
    which takes the shorter way; sidesite is not supported.

    Ranges of hinges and slides become `jc.contacts.Limit`. Ranges of ball joints limit a
    `jc.joints.RotationAngle`. The attribute frictionloss becomes `jc.contacts.JointFriction`.

    Pairs of geoms become contacts: shapes on planes, boxes with each other, and spheres and
    capsules with each other, with boxes and with cylinders; see `jc.contacts.ShapeContact`. A
    capsule touches a plane at its ends, and a box at its corners. A mesh touches a plane at up to
    16 vertices of its convex hull; a warning names meshes that have more. Contacts of other pairs
    are refused, or left out by `ignore=("shape",)`.

    Limits and contacts are hard and inelastic; `solref` and `solimp` are not used. They act at the
    distance `margin`, where MuJoCo's soft limits and contacts begin to act. Friction is Coulomb
    friction with the sliding coefficient. Torsional and rolling friction (condim 4 and 6) become
    `spinning` and `rolling` of the contact. Sliding, spinning and rolling have one bound each; in
    MuJoCo they share one cone.

    Read reactions as `info.reactions["knee limit"]`, `["knee friction"]` or `["floor and foot"]`.
    If a pair has several contact points, their names are numbered.

    Every pair of geoms adds rows to every step, whether it touches or not. In many models, most
    pairs are between the robot's own limbs; `ignore=("self_contact",)` keeps only contacts with the
    ground.

    Args:
        source: the path of a file, its text, or a `mujoco.MjModel`.
        ignore: names of features to leave out although they affect the motion:
            "contact": all contacts,
            "self_contact": contacts between two moving bodies,
            "shape": contacts between unsupported shapes,
            "mocap": motions of mocap bodies, which are held at their pose in the model,
            not at mpos and mquat of keyframes,
            "torsion": torsional and rolling friction (condim 4 or 6),
            "limit": all limits of joints and tendons,
            "ball_limit": limits of ball joints,
            "friction": dry friction of joints and tendons,
            "tendon": springs, dampers, rotors, friction and ranges of tendons,
            "fluid": density and viscosity,
            "gravcomp": gravity compensation.
        count_turns: True to count the whole turns of every hinge, so that `qpos` includes them.
        dtype: the floating dtype of the model; by default JAX's default float.

    Returns:
        The model. `system, state = jc.from_mjcf(path)` is enough to simulate it if no actuator has
        an activation. Filters, integrators and muscles have one: call `activate` of the model in
        each step. A warning names these actuators, and the `repr` of the model lists them.

    Raises:
        ImportError: MuJoCo is not installed.
        FileNotFoundError: the file does not exist.
        ValueError: MuJoCo cannot compile the model, or nothing in it moves.
        NotImplementedError: the model has an unsupported feature, which the message names.
    """
    checks.flag("from_mjcf", "count_turns", count_turns)
    compiled = Compiled(source, left_out(ignore))
    refuse(compiled)
    names = Names()
    links = find_links(compiled, names)
    gravity = compiled.model.opt.gravity * (not compiled.disabled("gravity"))
    scene = Scene(gravity=gravity, dtype=dtype)
    for link in links:
        frame = compiled.data.xpos[link.body], compiled.data.xquat[link.body]
        body = solid(compiled, link, scene.dtype)
        scene.add_body(link.name, inertia=body, position=frame[0], quaternion=frame[1])
    coordinates, transmissions = _add_elements(scene, compiled, links, names, count_turns)
    system, state = scene.build()
    sensors = Importer(compiled, links, names, transmissions, system).sensors()
    m = compiled.model

    def cast(x: np.ndarray) -> Array:
        """Converts numbers of the model to a JAX array in the dtype of the scene."""
        return jnp.asarray(x, scene.dtype)

    keys = [
        {x: getattr(m, f"key_{x}")[i] for x in ("time", "qpos", "qvel", "ctrl", "act")}
        for i in range(m.nkey)
    ]
    dynamics = activations(compiled, scene.dtype)
    warn(dynamics.names)
    timestep = checks.check("from_mjcf", "timestep of the option", m.opt.timestep, (), above=0)
    return MujocoModel(
        system,
        state,
        cast(timestep),
        _tree(compiled, links, coordinates, cast),
        jax.tree.map(cast, tuple(keys)),
        sensors,
        dynamics,
        tuple((compiled.name("joint", i), at) for i, at in sorted(coordinates.items())),
        tuple(compiled.name("key", i) for i in range(m.nkey)),
    )


def _add_elements(
    scene: Scene, compiled: Compiled, links: tuple[Link, ...], names: Names, count: bool
) -> tuple[dict[int, Coordinate], list[Transmission]]:
    """Adds joints, tendons, equalities, actuators, passive elements and contacts to a scene.

    Returns:
        The scene coordinate of each hinge and slide, by MuJoCo's joint id; and the transmissions of
        the actuators.
    """
    coordinates: dict[int, Coordinate] = {}
    for link in links:
        joined = join(compiled, link, names)
        coordinates |= joined.coordinates
        for element in joined.elements:
            scene.add(element)
    strung = tendons(compiled, links, coordinates, names)
    for element in (*strung.elements, *passive_tendons(compiled, strung.coordinates, names)):
        scene.add(element)
    ends = Ends(coordinates, strung.coordinates)
    for element in equalities(compiled, links, ends, names):
        scene.add(element)
    acting = actuators(compiled, links, ends, names)
    for element in acting.elements:
        scene.add(element)
    for link in links:
        for joint in link.joints:
            at = coordinates.get(joint.id)
            for element in passive(compiled, link, joint, at, names):
                scene.add(element)
            if count and at is not None and joint.kind == "hinge":
                label = compiled.name("joint", joint.id)
                scene.add(TurnCounter(names.take(f"{label} turns", "turns"), *at))
    for on_bodies in (gravity_compensation, fluid_drag):
        for element in on_bodies(compiled, links, names):
            scene.add(element)
    for element in contacts(compiled, links, names):
        scene.add(element)
    return coordinates, acting.transmissions


def _tree(
    compiled: Compiled,
    links: tuple[Link, ...],
    coordinates: dict[int, Coordinate],
    cast: Callable[[np.ndarray], Array],
) -> Tree:
    """Returns the kinematic tree of the links; `cast` converts NumPy arrays to JAX arrays."""
    m = compiled.model
    offsets = [offset(compiled, links, link) for link in links]
    joints = {joint.id: joint for link in links for joint in link.joints}
    scalars = [maps.Scalar(joints[i].q, joints[i].v, at) for i, at in sorted(coordinates.items())]
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
