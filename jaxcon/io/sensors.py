"""The sensors of a MuJoCo model, and their readings in the order of MuJoCo's sensordata."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import numerics
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion
from jaxcon.io import zones
from jaxcon.io.measuring import Objects, Parts, Reading
from jaxcon.system.forces import Force

AXES = ("framexaxis", "frameyaxis", "framezaxis")
FRAMES = (
    "framepos",
    "framequat",
    *AXES,
    "framelinvel",
    "frameangvel",
    "framelinacc",
    "frameangacc",
)
AT_SITES = ("velocimeter", "gyro", "accelerometer", "magnetometer", "force", "torque", "touch")
OF_JOINTS = ("jointpos", "jointvel", "ballquat", "ballangvel", "jointactfrc")
OF_ACTUATORS = ("actuatorpos", "actuatorvel", "actuatorfrc")
OF_TENDONS = ("tendonpos", "tendonvel", "tendonactfrc")
OF_LIMITS = ("jointlimitpos", "jointlimitvel", "jointlimitfrc")
OF_LIMITS += ("tendonlimitpos", "tendonlimitvel", "tendonlimitfrc")
OF_SUBTREES = ("subtreecom", "subtreelinvel", "subtreeangmom")
OF_WORLDS = ("clock", "e_potential", "e_kinetic")
SUPPORTED = (*FRAMES, *AT_SITES, *OF_JOINTS, *OF_ACTUATORS, *OF_TENDONS, *OF_LIMITS)
SUPPORTED += (*OF_SUBTREES, *OF_WORLDS)
"""The supported kinds of sensors, by what they measure."""
OF_CONTROL = ("actuatorfrc", "jointactfrc", "tendonactfrc")
OF_INFO = ("framelinacc", "frameangacc", "accelerometer", "force", "torque", "touch")
OF_INFO += ("jointlimitfrc", "tendonlimitfrc")
"""The kinds that need the control inputs, and the kinds that need accelerations and reactions."""


class External(NamedTuple):
    """Contacts or equalities whose forces act on bodies below a sensor of force.

    Attributes:
        kind: "bounds" or "constraints", the field of the system with the group of elements.
        group: the index of the group in the field.
        side: 0 for the first bodies, 1 for the second bodies.
    """

    kind: str
    group: int
    side: int


class Entry(NamedTuple):
    """A sensor of the model.

    Attributes:
        name: the name of the sensor.
        kind: MuJoCo's type, such as "framepos".
        start: the first index in sensordata.
        size: the number of entries.
        why: the reason why it is not supported; empty if it is.
    """

    name: str
    kind: str
    start: int
    size: int
    why: str = ""


@pytree
class SensorGroup:
    """Sensors of one kind, n of them.

    Attributes:
        numbers: arrays by name, with one row for each sensor: `cutoff` [unit of the sensor], and
            for some kinds the terms of a sum over bodies or elements, or numbers of actuators.
        objects: the frames in which the sensors measure; None for other kinds.
        references: the frames relative to which the sensors measure; None for the world.
        kind: the kind, such as "framepos".
        indices: indices in qpos, in qvel, or among MuJoCo's actuators.
        elements: the names of elements of the scene that the sensors read.
        externals: the groups of elements whose forces sensors of force subtract.
        shapes: the shapes of the zones of touch sensors.
        positive: True for each sensor that is cut off at one side only.
        entries: the sensors.
    """

    numbers: dict[str, Array]
    objects: Objects | None
    references: Objects | None
    kind: str = static()
    indices: tuple[int, ...] = static(default=())
    elements: tuple[str, ...] = static(default=())
    externals: tuple[External, ...] = static(default=())
    shapes: tuple[str, ...] = static(default=())
    positive: tuple[bool, ...] = static(default=())
    entries: tuple[Entry, ...] = static(default=())


@pytree
class Sensors:
    """The sensors of a model.

    Attributes:
        groups: the supported sensors by kind.
        parts: the bodies of links with several bodies, and the bodies that do not move.
        magnetic: the magnetic flux, (3,) [T].
        entries: all sensors, in MuJoCo's order.
    """

    groups: tuple[SensorGroup, ...]
    parts: Parts
    magnetic: Array
    entries: tuple[Entry, ...] = static()

    @property
    def supported(self) -> tuple[str, ...]:
        """The names of the supported sensors."""
        return tuple(entry.name for entry in self.entries if not entry.why)

    def chosen(self, names: Sequence[str] | None) -> tuple[Entry, ...]:
        """Returns the sensors of these names, or all sensors.

        Raises:
            ValueError: a name is unknown, or `names` is a str.
        """
        if names is None:
            return self.entries
        if isinstance(names, str):
            raise ValueError(
                f"sensors: names must be a sequence of names, got the str '{names}'; pass"
                f" names=('{names}',)."
            )
        known = {entry.name: entry for entry in self.entries}
        for name in names:
            if name not in known:
                raise ValueError(f"sensors: '{name}' is unknown; known are {list(known)}.")
        return tuple(known[name] for name in names)

    def check(self, chosen: tuple[Entry, ...], info: Any, control: Any, n_u: int) -> None:
        """Checks that sensors are supported, and that the arguments suffice to read them.

        Raises:
            NotImplementedError: a sensor is not supported.
            ValueError: a sensor needs an info or the control.
        """
        for entry in chosen:
            if entry.why:
                raise NotImplementedError(
                    f"sensors: '{entry.name}' of type {entry.kind} {entry.why}; read other sensors"
                    f" with names=(…). {_offer(self.supported)}"
                )
        for entry in chosen:
            owner = f"sensors: '{entry.name}' of type {entry.kind}"
            if entry.kind in OF_INFO and info is None:
                raise ValueError(
                    f"{owner} needs accelerations and reactions; give info=, the info of jc.step or"
                    " the result of jc.forward_dynamics."
                )
            if entry.kind in OF_CONTROL and control is None and n_u:
                raise ValueError(f"{owner} needs the control inputs; give control= or info=.")

    def read(self, here: Reading, start: Reading, chosen: tuple[Entry, ...]) -> Array:
        """Returns the readings of sensors, one after the other, (n,).

        Args:
            here: the model at the state.
            start: the model at the state of the info, for the kinds `OF_INFO`.
            chosen: the sensors.
        """
        values: dict[Entry, Array] = {}
        for group in self.groups:
            if not set(group.entries) & set(chosen):
                continue
            found = READERS[group.kind](self, start if group.kind in OF_INFO else here, group)
            cut = group.numbers["cutoff"][:, None]
            lowest = jnp.where(np.array(group.positive)[:, None], -jnp.inf, -cut)
            found = jnp.where(cut > 0, jnp.clip(found, lowest, cut), found)
            values |= dict(zip(group.entries, found, strict=True))
        dtype = here.state.q.dtype
        return jnp.concatenate([jnp.zeros(0, dtype), *(values[x] for x in chosen)])


def _offer(names: tuple[str, ...]) -> str:
    """Returns a sentence of an error message that names the supported sensors."""
    if not names:
        return "No sensor of the model is supported."
    some = ", ".join(f"'{name}'" for name in names[:6])
    more = ", …" if len(names) > 6 else ""
    return f"Supported are model.readings.supported: {some}{more}."


Reader = Callable[[Sensors, Reading, SensorGroup], Array]
"""A function of the sensors, an instant and a group, which returns its readings (n, size)."""


def of_frames(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads poses and velocities of frames, in the world or in reference frames."""
    assert group.objects is not None
    here = reading.frames(group.objects)
    if group.kind == "framequat":
        if group.references is None:
            return here.orientation
        back = jax.vmap(quaternion.conjugate)(reading.frames(group.references).orientation)
        return jax.vmap(quaternion.multiply)(back, here.orientation)
    axis = here.rotation[:, :, AXES.index(group.kind)] if group.kind in AXES else None
    if group.references is None:
        vectors = {
            "framepos": here.position,
            "framelinvel": here.velocity,
            "frameangvel": here.spin,
        }
        return vectors[group.kind] if axis is None else axis
    there = reading.frames(group.references)
    apart = here.position - there.position
    if axis is None:
        axis = {
            "framepos": apart,
            "framelinvel": here.velocity - there.velocity - jnp.cross(there.spin, apart),
            "frameangvel": here.spin - there.spin,
        }[group.kind]
    return turned_back(there.rotation, axis)


def turned_back(rotation: Array, x: Array) -> Array:
    """Returns Rᵀ x for matrices R (n, 3, 3) and vectors x (n, 3)."""
    return jnp.sum(rotation * x[:, :, None], axis=1)


def of_accelerated_frames(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads accelerations of frames, in the world; linear ones are less gravity, as in MuJoCo."""
    assert group.objects is not None
    return reading.acceleration(group.objects)[group.kind == "frameangacc"]


def at_sites(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads velocities, accelerations and the magnetic flux along the axes of sites."""
    assert group.objects is not None
    here = reading.frames(group.objects)
    if group.kind == "accelerometer":
        x = reading.acceleration(group.objects)[0]
    elif group.kind == "magnetometer":
        x = jnp.broadcast_to(sensors.magnetic, here.position.shape)
    else:
        x = here.velocity if group.kind == "velocimeter" else here.spin
    return turned_back(here.rotation, x)


def of_loads(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads forces and torques between bodies and their parents, along the axes of sites.

    They are the loads of all bodies below the parent less the forces of contacts and equalities.
    """
    assert group.objects is not None
    here = reading.frames(group.objects)
    which = int(group.kind == "torque")
    load = reading.loads.about(here.position)[which]
    result = jnp.sum(group.numbers["bodies"][..., None] * load, axis=1)
    for k, external in enumerate(group.externals):
        acting = reading.external(*external).about(here.position)[which]
        result = result - jnp.sum(group.numbers[f"external {k}"][..., None] * acting, axis=1)
    return turned_back(here.rotation, result)


def of_touch(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads the sums of the normal forces whose lines of action meet the zones of touch sensors.

    A line starts at the contact point and leaves the body of the sensor.
    """
    assert group.objects is not None
    here = reading.frames(group.objects)
    sums = [jnp.zeros_like(reading.state.time)] * len(group.entries)
    for k, (elements, place, sides, force) in enumerate(reading.contacts()):
        points = len(force) // len(elements.names)
        for side, direction in enumerate(sides):
            mask = group.numbers[f"touch {k} {side}"]
            for i, shape in enumerate(group.shapes):
                rotation = here.rotation[i]
                start, ray = (place - here.position[i][None]) @ rotation, -direction @ rotation
                met = zones.meets(shape, group.numbers["size"][i], start, ray)
                acts = jnp.repeat(mask[i], points) * met.astype(force.dtype)
                sums[i] = sums[i] + jnp.sum(acts * force)
    return jnp.stack(sums)[:, None]


def of_joints(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads positions, velocities and actuator forces of joints."""
    if group.kind == "jointactfrc":
        x = reading.actuator_force
    else:
        x = reading.coordinates[0 if group.kind in ("jointpos", "ballquat") else 1]
    size = group.entries[0].size
    return x[np.array(group.indices)[:, None] + np.arange(size)]


def of_actuators(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads lengths, velocities and forces of actuators."""
    found = [reading.actuators[name] for name in group.elements]
    value, rate, force, gear = (jnp.stack(x) for x in zip(*found, strict=True))
    # the gear of a Motor is MuJoCo's gear times the gain
    gain = group.numbers["gain"]
    gear = jnp.where(gain == 0, group.numbers["gear"], numerics.safe_divide(gear, gain))
    x = {
        "actuatorpos": group.numbers["measured"] * gear * (value + group.numbers["reference"]),
        "actuatorvel": gear * rate,
        "actuatorfrc": gain * force,
    }
    return x[group.kind][:, None]


def of_tendons(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads lengths and rates of tendons, and the sums of the forces of actuators on them."""
    if group.kind == "tendonactfrc":
        zero = jnp.zeros((1,), reading.state.q.dtype)
        forces = [zero, *(reading.actuators[name][2][None] for name in group.elements)]
        return group.numbers["acting"] @ jnp.concatenate(forces)[1:, None]
    found = [reading.tendons[name] for name in group.elements]
    value, rate = (jnp.stack(x) for x in zip(*found, strict=True))
    return (value + group.numbers["reference"] if group.kind == "tendonpos" else rate)[:, None]


def of_limits(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads penetrations, their rates and the forces of limits; zero where no limit acts."""
    zero = jnp.zeros_like(reading.state.time)
    found = [reading.limits.get(name, (zero,) * 3) for name in group.elements]
    gap, rate, force = (jnp.stack(x) for x in zip(*found, strict=True))
    if group.kind.endswith("frc"):
        return force[:, None]
    return jnp.where(gap < 0, gap if group.kind.endswith("pos") else rate, 0)[:, None]


def of_subtrees(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads centers of mass, their velocities and angular momenta about them, of subtrees."""
    mass, position, velocity, momentum = reading.solids
    terms = group.numbers["bodies"] * mass[None]
    total = jnp.sum(terms, axis=1, keepdims=True)
    share = numerics.safe_divide(terms, total)
    # MuJoCo's center of a subtree without mass is that of its first body; its velocity is zero
    center = jnp.where(total > 0, share, group.numbers["first"]) @ position
    speed = share @ velocity
    if group.kind != "subtreeangmom":
        return center if group.kind == "subtreecom" else speed
    arm, relative = position[None] - center[:, None], velocity[None] - speed[:, None]
    orbital = terms[..., None] * jnp.cross(arm, relative)
    return jnp.sum(orbital + group.numbers["bodies"][..., None] * momentum[None], axis=1)


def of_the_world(sensors: Sensors, reading: Reading, group: SensorGroup) -> Array:
    """Reads the clock and the energy; the potential is that of gravity and springs."""
    state, system = reading.state, reading.system
    if group.kind == "clock":
        x = state.time
    elif group.kind == "e_kinetic":
        x = system.energy(state.q, state.v, state.instant).kinetic
    else:
        springs = tuple(x for x in system.forces if x.law is not Force)
        system = dataclasses.replace(system, forces=springs)
        x = system.energy(state.q, state.v, state.instant).potential
        x = x - reading.fixed_moment @ system.gravity
    return jnp.broadcast_to(x, (len(group.entries), 1))


READERS: dict[str, Reader] = {
    **dict.fromkeys(FRAMES, of_frames),
    **dict.fromkeys(("framelinacc", "frameangacc"), of_accelerated_frames),
    **dict.fromkeys(AT_SITES, at_sites),
    **dict.fromkeys(("force", "torque"), of_loads),
    "touch": of_touch,
    **dict.fromkeys(OF_JOINTS, of_joints),
    **dict.fromkeys(OF_ACTUATORS, of_actuators),
    **dict.fromkeys(OF_TENDONS, of_tendons),
    **dict.fromkeys(OF_LIMITS, of_limits),
    **dict.fromkeys(OF_SUBTREES, of_subtrees),
    **dict.fromkeys(OF_WORLDS, of_the_world),
}
"""The reader of each kind of sensor."""
