"""Import of MuJoCo's sensors."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.contact.contact import Contacts
from jaxcon.core.typing import Array
from jaxcon.io import pairs, zones
from jaxcon.io.actuators import Transmission
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.links import Link
from jaxcon.io.measuring import Objects, Parts
from jaxcon.io.sensors import (
    AT_SITES,
    FRAMES,
    OF_ACTUATORS,
    OF_JOINTS,
    OF_LIMITS,
    OF_SUBTREES,
    OF_TENDONS,
    SUPPORTED,
    Entry,
    External,
    SensorGroup,
    Sensors,
)
from jaxcon.io.tendons import unsupported
from jaxcon.system.actuators import Motor
from jaxcon.system.body_system import BodySystem
from jaxcon.system.layout import WORLD


class Importer:
    """Imports the sensors of a model.

    Args:
        compiled: the model.
        links: the links of the model.
        names: the names of elements in the scene.
        transmissions: the transmission of each actuator, in MuJoCo's order.
        system: the system, in whose dtype the numbers are stored.
    """

    def __init__(
        self,
        compiled: Compiled,
        links: tuple[Link, ...],
        names: Names,
        transmissions: Sequence[Transmission],
        system: BodySystem,
    ) -> None:
        self.compiled, self.links, self.names = compiled, links, names
        self.transmissions, self.system = transmissions, system
        # bodies by link: those of links with several bodies, and those fixed to the world
        self.merged = [(link, b) for link in links if len(link.members) > 1 for b in link.members]
        moving = {b for link in links for b in link.members}
        self.merged += [(None, b) for b in range(1, compiled.model.nbody) if b not in moving]

    def cast(self, x: np.ndarray) -> Array:
        """Converts numbers to a JAX array in the dtype of the system."""
        return jnp.asarray(x, self.system.gravity.dtype)

    def sensors(self) -> Sensors:
        """Returns all sensors of the model, in groups of one kind."""
        m, groups = self.compiled.model, {}
        entries = [self._entry(i) for i in range(m.nsensor)]
        for i, entry in enumerate(entries):
            if not entry.why:
                key = entry.kind, int(m.sensor_refid[i]) >= 0
                groups.setdefault(key, []).append(i)
        made = [self._group(kind, numbers, entries) for (kind, _), numbers in groups.items()]
        return Sensors(tuple(made), self._parts(), self.cast(m.opt.magnetic), tuple(entries))

    def _entry(self, i: int) -> Entry:
        """Returns sensor i, with the reason why it is not supported, if it is not."""
        m, c = self.compiled.model, self.compiled
        kind = c.choice("mjtSensor", m.sensor_type[i])
        name, why = c.name("sensor", i), ""
        objects = [self._object(m.sensor_objtype[i], m.sensor_objid[i])]
        if m.sensor_refid[i] >= 0:
            objects.append(self._object(m.sensor_reftype[i], m.sensor_refid[i]))
        if kind not in SUPPORTED:
            why = "is not supported"
        elif any(
            np.any(getattr(m, f"sensor_{x}", (0,) * m.nsensor)[i]) for x in ("delay", "interval")
        ):
            why = "has a delay or an interval, which are not supported"
        elif kind in FRAMES and None in objects:
            why = "is at a camera that follows bodies, which is not supported"
        elif kind in ("force", "torque", "touch") and objects[0] and objects[0][0] == WORLD:
            why = "is on a body that does not move, which is not supported"
        elif kind == "jointactfrc" and m.jnt_actgravcomp.any():
            why = "is in a model with actuatorgravcomp, which is not supported"
        elif kind == "actuatorfrc" and self._limits_joint(int(m.sensor_objid[i])):
            # the force range of the element includes the range of the joint
            why = (
                "is of an actuator on a joint with an actuatorfrcrange, which is not supported;"
                " use a sensor jointactuatorfrc"
            )
        elif kind.startswith("tendon") and (why := self._missing(int(m.sensor_objid[i]))):
            pass
        elif kind in OF_LIMITS and self._ignored_limit(kind, int(m.sensor_objid[i])):
            why = "is of a limit that is left out by `ignore`"
        elif kind == "touch" and int(m.site_bodyid[m.sensor_objid[i]]) in self._untouched:
            why = "is on a body with contacts that are left out by `ignore`"
        elif kind == "touch" and self._zone(int(m.sensor_objid[i])) not in zones.SHAPES:
            why = f"has a zone that is not one of {list(zones.SHAPES)}"
        return Entry(name, kind, int(m.sensor_adr[i]), int(m.sensor_dim[i]), why)

    def _missing(self, tendon: int) -> str:
        """Returns why a tendon was not imported; empty if it was."""
        found = self.names.given.get((self.compiled.name("tendon", tendon), "tendon"))
        why = unsupported(self.compiled, self.links, tendon)
        return "" if found else f"is of a tendon that {why}"

    def _limits_joint(self, actuator: int) -> bool:
        """Returns True if an actuator acts on a joint that limits the forces of its actuators."""
        m = self.compiled.model
        on_joint = self.compiled.choice("mjtTrn", m.actuator_trntype[actuator]).startswith("joint")
        return on_joint and bool(m.jnt_actfrclimited[m.actuator_trnid[actuator, 0]])

    def _limit(self, kind: str, i: int) -> str:
        """Returns the name of the element that limits a joint or tendon; empty without one."""
        what = "joint" if kind.startswith("joint") else "tendon"
        key = f"{self.compiled.name(what, i)} limit", f"{what} limit"
        return self.names.given.get(key, "")

    def _ignored_limit(self, kind: str, i: int) -> bool:
        """Returns True if the user left out the limit of a joint or tendon."""
        m, features = self.compiled.model, {"limit"}
        if kind.startswith("joint"):
            limited = m.jnt_limited[i]
            ball = self.compiled.choice("mjtJoint", m.jnt_type[i]) == "ball"
            features |= {"ball_limit"} if ball else set()
        else:
            limited = m.tendon_limited[i]
            features |= {"tendon"}
        missing = bool(limited) and not self._limit(kind, i)
        return missing and not features.isdisjoint(self.compiled.ignored)

    @cached_property
    def _untouched(self) -> set[int]:
        """MuJoCo's ids of the bodies with contacts that the user left out."""
        c, everything = self.compiled, copy.copy(self.compiled)
        everything.ignored = frozenset()
        kept = {pair[:2] for pair in pairs.pairs(c) if pairs.supported(c, pair)}
        missing = {pair[:2] for pair in pairs.pairs(everything)} - kept
        return {int(c.model.geom_bodyid[geom]) for pair in missing for geom in pair}

    def _zone(self, site: int) -> str:
        """Returns the shape of a site, such as "sphere"."""
        return self.compiled.choice("mjtGeom", self.compiled.model.site_type[site])

    def _object(self, kind: int, i: int) -> tuple[str, np.ndarray, np.ndarray] | None:
        """Returns link, position and orientation in the link of a body, geom, site or camera.

        None for cameras that follow bodies, and for other objects.
        """
        m, data, mujoco = self.compiled.model, self.compiled.data, self.compiled.mujoco
        what = self.compiled.choice("mjtObj", kind)
        if what not in ("body", "xbody", "geom", "site", "camera"):
            return None
        field = {"camera": "cam"}.get(what, what)
        if what == "camera" and self.compiled.choice("mjtCamLight", m.cam_mode[i]) != "fixed":
            return None
        body = i if what in ("body", "xbody") else int(getattr(m, f"{field}_bodyid")[i])
        local = {
            "body": (m.body_ipos[body], m.body_iquat[body]),
            "xbody": (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])),
        }.get(what)
        local = local or tuple(getattr(m, f"{field}_{x}")[i] for x in ("pos", "quat"))
        position, turn = np.zeros(3), np.zeros(4)
        mujoco.mju_mulPose(position, turn, data.xpos[body], data.xquat[body], *local)
        link = next((x for x in self.links if body in x.members), None)
        if link is None:
            return WORLD, position, turn
        back, still = np.zeros(4), np.zeros(3)
        mujoco.mju_negPose(still, back, data.xpos[link.body], data.xquat[link.body])
        here, turned = np.zeros(3), np.zeros(4)
        mujoco.mju_mulPose(here, turned, still, back, position, turn)
        return link.name, here, turned

    def _group(self, kind: str, numbers: list[int], entries: list[Entry]) -> SensorGroup:
        """Returns sensors of one kind, with the numbers that their reader needs."""
        m, names = self.compiled.model, self.names
        ids = [int(m.sensor_objid[i]) for i in numbers]
        own: dict[str, Any] = {"cutoff": m.sensor_cutoff[numbers]}
        more: dict[str, Any] = {}
        if kind in FRAMES or kind in AT_SITES:
            more["objects"] = self._objects(m.sensor_objtype[numbers], ids)
            if m.sensor_refid[numbers[0]] >= 0:
                more["references"] = self._objects(
                    m.sensor_reftype[numbers], list(map(int, m.sensor_refid[numbers]))
                )
        if kind in OF_JOINTS:
            starts = m.jnt_qposadr if kind in ("jointpos", "ballquat") else m.jnt_dofadr
            more["indices"] = tuple(int(starts[j]) for j in ids)
        if kind in OF_ACTUATORS:
            chosen = [self.transmissions[i] for i in ids]
            labels = [self.compiled.name("actuator", i) for i in ids]
            more["elements"] = tuple(names.given[label, "actuator"] for label in labels)
            for field in ("gear", "reference", "measured"):
                own[field] = np.array([float(getattr(x, field)) for x in chosen])
            own["gain"] = np.array([self._gain(i) for i in ids])
        if kind in OF_TENDONS:
            own["reference"] = m.tendon_length0[ids]
            labels = [self.compiled.name("tendon", i) for i in ids]
            more["elements"] = tuple(names.given[label, "tendon"] for label in labels)
        if kind == "tendonactfrc":
            targets = [self.compiled.choice("mjtTrn", x) for x in m.actuator_trntype]
            acting = [i for i, x in enumerate(targets) if x == "tendon"]
            labels = [self.compiled.name("actuator", i) for i in acting]
            more["elements"] = tuple(names.given[label, "actuator"] for label in labels)
            own["acting"] = np.array(
                [[self._gain(i) * (m.actuator_trnid[i, 0] == t) for i in acting] for t in ids]
            ).reshape(len(ids), len(acting))
        if kind in OF_LIMITS:
            more["elements"] = tuple(self._limit(kind, j) for j in ids)
        if kind in OF_SUBTREES:
            own["bodies"] = np.array([self._below(body) for body in ids])
            own["first"] = np.array([self._first(body) for body in ids])
        if kind in ("force", "torque"):
            bodies = [int(m.site_bodyid[i]) for i in ids]
            own["bodies"] = np.array([self._below(body) for body in bodies])
            more["externals"], masks = self._externals(bodies)
            own |= {f"external {k}": mask for k, mask in enumerate(masks)}
        if kind == "touch":
            own["size"] = m.site_size[ids]
            more["shapes"] = tuple(self._zone(i) for i in ids)
            own |= self._touched([int(m.site_bodyid[i]) for i in ids])
        types = [self.compiled.choice("mjtDataType", m.sensor_datatype[i]) for i in numbers]
        more.setdefault("objects", None)
        more.setdefault("references", None)
        return SensorGroup(
            {field: self.cast(x) for field, x in own.items()},
            kind=kind,
            positive=tuple(x == "positive" for x in types),
            entries=tuple(entries[i] for i in numbers),
            **more,
        )

    def _gain(self, i: int) -> float:
        """Returns the factor from the force of the element of actuator i to MuJoCo's force.

        A `Motor` has the product of gear and gain as its gear; the factor is then the gain.
        """
        name = self.names.given[self.compiled.name("actuator", i), "actuator"]
        motor = any(name in group.names and group.law is Motor for group in self.system.forces)
        return float(self.compiled.model.actuator_gainprm[i, 0]) if motor else 1.0

    def _objects(self, kinds: Sequence[int], ids: list[int]) -> Objects:
        """Returns frames as `Objects`."""
        found = [self._object(kind, i) for kind, i in zip(kinds, ids, strict=True)]
        links, positions, turns = zip(*(x for x in found if x is not None), strict=True)
        return Objects(self.cast(np.array(positions)), self.cast(np.array(turns)), tuple(links))

    def _parts(self) -> Parts:
        """Returns the bodies of links with several bodies, and the bodies that do not move."""
        m, data = self.compiled.model, self.compiled.data
        centers, tensors = np.zeros((len(self.merged), 3)), np.zeros((len(self.merged), 3, 3))
        for i, (link, body) in enumerate(self.merged):
            body_of_link = 0 if link is None else link.body  # MuJoCo's body 0 is the world
            frame = data.xmat[body_of_link].reshape(3, 3)
            axes = frame.T @ data.ximat[body].reshape(3, 3)
            centers[i] = frame.T @ (data.xipos[body] - data.xpos[body_of_link])
            tensors[i] = axes @ np.diag(m.body_inertia[body]) @ axes.T
        masses = m.body_mass[[body for _, body in self.merged]]
        numbers = map(self.cast, (masses, centers, tensors))
        names = tuple(WORLD if link is None else link.name for link, _ in self.merged)
        return Parts(*numbers, links=names)

    def _subtree(self, body: int) -> set[int]:
        """Returns MuJoCo's ids of a body and of all bodies below it."""
        parents, found = self.compiled.model.body_parentid, {body}
        for b in range(body + 1, len(parents)):  # parents come before children
            found |= {b} if int(parents[b]) in found else set()
        return found

    def _below(self, body: int) -> np.ndarray:
        """Returns a mask of the links and parts that form the subtree of a body, (links + parts,).

        A link counts as a whole if all its bodies are in the subtree.
        """
        below, order = self._subtree(body), self.system.layout.groups[0].names
        by_name = {link.name: link for link in self.links}
        whole = [below.issuperset(by_name[name].members) for name in order]
        parts = [
            b in below and (link is None or not below.issuperset(link.members))
            for link, b in self.merged
        ]
        return np.array([*whole, *parts], float)

    def _first(self, body: int) -> np.ndarray:
        """Returns a mask of the part that is a body, (links + parts,); zeros for a whole link."""
        links = len(self.system.layout.groups[0].names)
        return np.array([0.0] * links + [float(b == body) for _, b in self.merged])

    def _owners(self) -> dict[str, tuple[int, int]]:
        """Returns MuJoCo's bodies on both sides of each contact, connect and weld, by element."""
        m, owners = self.compiled.model, dict(self.names.touching)
        for i in range(m.neq):
            name = self.names.given.get((self.compiled.name("equality", i), "equality"))
            if self.compiled.choice("mjtEq", m.eq_type[i]) in ("connect", "weld") and name:
                ends = int(m.eq_obj1id[i]), int(m.eq_obj2id[i])
                if m.eq_objtype[i] == int(self.compiled.mujoco.mjtObj.mjOBJ_SITE):
                    ends = int(m.site_bodyid[ends[0]]), int(m.site_bodyid[ends[1]])
                owners[name] = ends
        return owners

    def _sides(self) -> Iterator[tuple[External, list[int]]]:
        """Yields each side of contacts and equalities that can move, with MuJoCo's bodies on it."""
        owners = self._owners()
        for kind in ("bounds", "constraints"):
            for index, group in enumerate(getattr(self.system, kind)):
                if not set(group.names) <= set(owners):
                    continue
                for side, place in enumerate(group.places):
                    if place.group is not None:
                        bodies = [owners[name][side] for name in group.names]
                        yield External(kind, index, side), bodies

    def _externals(self, bodies: list[int]) -> tuple[tuple[External, ...], list[np.ndarray]]:
        """Returns the elements that act on the subtrees of bodies, and masks (n, element)."""
        below = [self._subtree(body) for body in bodies]
        found, masks = [], []
        for external, acting in self._sides():
            mask = np.array([[float(b in subtree) for b in acting] for subtree in below])
            if mask.any():
                found.append(external)
                masks.append(mask)
        return tuple(found), masks

    def _touched(self, bodies: list[int]) -> dict[str, np.ndarray]:
        """Returns masks of the contacts on bodies, (n, element), by group and side."""
        owners, masks, k = self._owners(), {}, 0
        for group in self.system.bounds:
            if not isinstance(group, Contacts):
                continue
            for side in range(2):
                acting = [owners.get(name, (-1, -1))[side] for name in group.names]
                masks[f"touch {k} {side}"] = np.array(
                    [[float(b == body) for b in acting] for body in bodies]
                )
            k += 1
        return masks
