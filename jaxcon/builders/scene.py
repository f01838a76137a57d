"""The builder of systems of bodies: `Scene` collects bodies and elements, and checks them."""

from __future__ import annotations

import copy
import dataclasses
import difflib
import functools
import inspect
from collections.abc import Callable
from typing import Any, Never

import jax
import jax.numpy as jnp

from jaxcon.builders import grouping
from jaxcon.builders.inputs import BodyInput, resolve
from jaxcon.constraints.base import Joint
from jaxcon.constraints.curves import Curves
from jaxcon.constraints.custom import Custom, check_function
from jaxcon.contact.contact_default import first_multipliers
from jaxcon.core import checks
from jaxcon.core.pytree import unshared
from jaxcon.core.status import Status
from jaxcon.core.summary import by_class, listed, table
from jaxcon.geometry.pose import Pose, WorldPose
from jaxcon.system.body_system import BodySystem
from jaxcon.system.elements import Element, side_by_side
from jaxcon.system.forces import ForceElement
from jaxcon.system.layout import WORLD
from jaxcon.system.state import MethodMemory, State

ORIENTATIONS = ("angle", "quaternion", "orientation", "rotation", "attitude", "quat")
"""Names of arguments by which a user may try to give the orientation of a body."""


def _dtype(given: Any) -> Any:
    """Checks the dtype of a scene, and returns it; None gives JAX's default floating dtype.

    Raises:
        ValueError: the dtype is neither float32 nor float64.
    """
    try:
        dtype = jnp.dtype(jnp.result_type(float) if given is None else given)
    except (TypeError, ValueError):
        dtype = None
    if dtype not in (jnp.float32, jnp.float64) or given is float:
        got = checks.shortened(given) if dtype is None else dtype
        raise ValueError(f"Scene: dtype must be float32 or float64, got {got}.")
    return dtype


@functools.cache
def _with_options(cls: type, base: type[Element]) -> type:
    """Returns a class that derives from a user's class and from `base`.

    It inherits the default options of elements from `base`.
    """
    return type(cls.__name__, (cls, base), {"__module__": cls.__module__, "__doc__": cls.__doc__})


def completed(element: Any) -> Element:
    """Copies a user's element; the class of the copy also derives from `Joint` or `ForceElement`.

    The copy thus has the default options of elements, even if the user's class does not derive from
    `Element`. The copy is a `Joint` if the element has a method `rows`, and a `ForceElement` if it
    has a method `forces`.

    Raises:
        TypeError: the element is neither a joint nor a force.
    """
    bases = {"rows": Joint, "forces": ForceElement}
    roles = [role for role in bases if hasattr(element, "name") and hasattr(element, role)]
    if not roles:
        raise TypeError(f"Scene.add takes a joint, constraint or force, got {element!r}.")
    result = copy.copy(element)
    object.__setattr__(result, "__class__", _with_options(type(element), bases[roles[0]]))
    return result


class Scene:
    """Bodies, constraints and forces by name; `build` checks them and makes a system.

    Args:
        dim: 2 or 3.
        gravity: gravitational acceleration, (dim,) [m/s²]; 9.81 downwards (along the last axis)
            unless given.
        dtype: dtype of every number; JAX's default float unless given.

    Numbers may be traced, so that a scene can be built under `jit`, `vmap` and `grad`; names and
    structure may not.
    """

    def __init__(self, dim: int = 3, gravity: Any = None, dtype: Any = None) -> None:
        if type(dim) is not int or dim not in (2, 3):
            raise ValueError(f"Scene: dim must be 2 or 3, got {checks.shortened(dim)}.")
        self.dim = dim
        self.dtype = _dtype(dtype)
        if self.dtype == jnp.float64 and not jax.config.read("jax_enable_x64"):
            raise ValueError(
                "Scene: float64 needs jax.config.update('jax_enable_x64', True) at the start."
            )
        default = (0.0,) * (dim - 1) + (-9.81,)
        gravity = default if gravity is None else gravity
        self.gravity = checks.real("Scene", "gravity", gravity, self.dtype, (dim,))
        self._bodies: dict[str, BodyInput] = {}
        self._elements: dict[str, Element] = {}

    def __repr__(self) -> str:
        """Describes the scene by the names of bodies and elements."""
        bodies = list(self._bodies)
        elements = ((type(element), name) for name, element in self._elements.items())
        title = f"Scene {'in the plane' if self.dim == 2 else 'in space'}, {self.dtype}"
        return table(title, [("bodies", listed(bodies)), *by_class(elements)])

    def add_body(
        self,
        name: str,
        *,
        mass: Any = None,
        inertia: Any = None,
        position: Any = None,
        quaternion: Any = None,
        angle: Any = None,
        velocity: Any = None,
        angular_velocity: Any = None,
        fixed: bool = False,
        **unknown: Never,
    ) -> None:
        """Adds a rigid body.

        Positions, orientations and velocities are zero unless given.

        Args:
            name: name of the body, unique in the scene.
            mass: () [kg].
            inertia: inertia about the center of mass [kg m²]: () in the plane; in space principal
                moments (3,) or a full tensor (3, 3); or an `Inertia`, which also has the mass and
                the center of mass. In the plane, an `Inertia` with three moments gives the moment
                about z.
            position: origin of the body's frame, world frame, (dim,) [m]. The origin is the center
                of mass unless an `Inertia` has another `center`.
            quaternion: orientation, body to world, wxyz, (4,); in space.
            angle: orientation, () [rad]; in the plane. `build` warns if the angle exceeds a turn,
                because it was then probably given in degrees.
            velocity: velocity of the origin, world frame, (dim,) [m/s].
            angular_velocity: () in the plane, (3,) in the body frame in space [rad/s].
            fixed: True if the body is part of the world; it then needs no mass and has no
                coordinates.
            unknown: any other argument, refused by name.

        Raises:
            ValueError: the name is taken, or `quaternion` in the plane or `angle` in space.
            TypeError: an argument of another name, such as `orientation`.
        """
        right = "angle=, () [rad]" if self.dim == 2 else "quaternion=, wxyz (4,), body to world"
        hint = f"The orientation is {right}."
        self._refuse(f"body '{name}'", self.add_body, unknown, hint)
        if (quaternion if self.dim == 2 else angle) is not None:
            wrong, right = ("quaternion", "angle") if self.dim == 2 else ("angle", "quaternion")
            raise ValueError(
                f"body '{name}': in {self.dim} dimensions give {right}=, not {wrong}=."
            )
        checks.flag(f"body '{name}'", "fixed", fixed)
        orientation = angle if self.dim == 2 else quaternion
        self._take_name(name)
        self._bodies[name] = BodyInput(
            name, mass, inertia, position, orientation, velocity, angular_velocity, True, fixed
        )

    def allow_turns(self, name: str) -> None:
        """Lets the angle of a body in the plane exceed a turn without a warning from `build`.

        Args:
            name: name of a body in the plane that was added.

        Raises:
            ValueError: the body is unknown, a particle, or in space.
        """
        if self.dim == 3:
            raise ValueError(
                "Scene.allow_turns: bodies in space have quaternions, which need no such"
                f" permission, got {checks.shortened(name)}."
            )
        known = [body for body, given in self._bodies.items() if given.rigid]
        if name not in known:
            raise ValueError(
                "Scene.allow_turns takes the name of a body with an angle, got"
                f" {checks.shortened(name)}; known are {known}."
            )
        self._bodies[name] = dataclasses.replace(self._bodies[name], winds=True)

    def add_particle(
        self,
        name: str,
        *,
        mass: Any,
        position: Any = None,
        velocity: Any = None,
        **unknown: Never,
    ) -> None:
        """Adds a point mass: `dim` coordinates, no orientation.

        Args:
            name: name of the particle, unique in the scene.
            mass: () [kg].
            position: position, world frame, (dim,) [m]; zero unless given.
            velocity: velocity, world frame, (dim,) [m/s]; zero unless given.
            unknown: any other argument, refused by name.

        Raises:
            ValueError: the name is taken.
            TypeError: an argument of another name, such as `inertia`.
        """
        hint = "A particle has no orientation; add_body adds a body that turns."
        self._refuse(f"particle '{name}'", self.add_particle, unknown, hint)
        self._take_name(name)
        self._bodies[name] = BodyInput(
            name, mass, None, position, None, velocity, None, False, False
        )

    def add(self, element: Any) -> None:
        """Adds a joint, constraint or force element.

        Args:
            element: an element such as `Revolute`, `Spring` or `Limit`; its bodies may be added
                later.

        Raises:
            ValueError: the element's name is taken.
            TypeError: the element is neither a constraint nor a force.
        """
        if not isinstance(element, Element):
            element = completed(element)
        self._take_name(element.name)
        self._elements[element.name] = element

    def build(self) -> tuple[BodySystem, State]:
        """Checks the scene, and makes the system, with elements attached at the given poses.

        Returns:
            The system, and the state at assembly. If the default method warm starts its solver of
            inequality constraints, the memory of the state has initial multipliers of zero for it.

        Raises:
            ValueError: an unknown name, a joint between a body and itself, a wrong shape or dtype,
                or a value out of range; the message names the cause.
        """
        bodies = {name: resolve(b, self.dim, self.dtype) for name, b in self._bodies.items()}
        layout, inertia = grouping.lay_out(self.dim, bodies, self._elements.values())
        q, v = [], []
        for group in layout.groups:
            pairs = (group.kind.coordinates(bodies[name].motion) for name in group.names)
            for rows, values in zip((q, v), zip(*pairs, strict=True), strict=True):
                rows.append(side_by_side(values).ravel())
        world = jnp.zeros(self.dim, self.dtype)
        upright = jnp.zeros((), self.dtype) if self.dim == 2 else jnp.eye(4, dtype=self.dtype)[0]
        fixed = {n: b.motion.pose for n, b in bodies.items() if b.kind is None}
        fixed[WORLD] = Pose(world, upright)
        poses = {n: b.motion.pose for n, b in bodies.items()}
        poses |= {n: WorldPose(pose.position, upright) for n, pose in fixed.items()}
        offsets = {n: b.offset for n, b in bodies.items() if b.offset is not None}
        elements = self._elements.values()
        gather = grouping.Gather(self.dim, self.dtype, layout, poses, offsets | fixed, elements)
        constraints, n = gather.constraints(), gather.on_coordinates.turns
        turns = jnp.zeros(n, self.dtype) if n else ()  # every angle is zero at assembly
        system = BodySystem(
            gravity=self.gravity,
            inertia=inertia,
            constraints=tuple(constraints),
            forces=tuple(gather.forces()),
            offsets=offsets,
            fixed=fixed,
            turns=turns,
            layout=layout,
            counted=gather.on_coordinates.counted,
            bounds=tuple(gather.bounds()),
        )
        if not q:
            raise ValueError("Scene: there is no body that moves; add one with add_body.")
        state = State(
            jnp.concatenate(q),
            jnp.concatenate(v),
            jnp.zeros((), self.dtype),
            jnp.asarray(Status.OK, jnp.int32),
            turns=turns,
            angle_remainder=system.no_remainder(self.dtype),
        )
        for group in (*constraints, *system.bounds):
            if isinstance(group, Custom):
                check_function(group, system.snapshot(state.q, state.v, state.instant))
            if isinstance(group, Curves):
                group.check(system.snapshot(state.q, state.v, state.instant))
        multipliers = first_multipliers(system, state.q, state.v)
        if jax.tree.leaves(multipliers):
            state = dataclasses.replace(state, memory=MethodMemory(contact_multipliers=multipliers))
        return system, unshared(state, system)

    def _refuse(
        self, owner: str, method: Callable[..., None], unknown: dict[str, Any], turned: str
    ) -> None:
        """Raises an error if a method was called with keyword arguments that it does not have.

        Args:
            owner: the body to be added, for error messages.
            method: the method that adds it.
            unknown: the arguments by name.
            turned: the hint for an unknown argument that seems to mean an orientation.

        Raises:
            TypeError: `unknown` is not empty; the message lists the names that the method takes.
        """
        for name, value in unknown.items():
            known = list(inspect.signature(method).parameters)[1:-1]
            close = difflib.get_close_matches(name, known, 1)
            hint = f" Did you mean {close[0]}=?" if close else ""
            if name in ORIENTATIONS:
                hint = f" {turned}"
            raise TypeError(
                f"{owner}: {method.__name__} has no argument {name}=, got"
                f" {name}={checks.shortened(value)}; it takes"
                f" {', '.join(f'{x}=' for x in known)}.{hint}"
            )

    def _take_name(self, name: str) -> None:
        if not isinstance(name, str) or not name:
            raise ValueError(f"Scene: a name must be a non-empty string, got {name!r}.")
        if name in (WORLD, "gravity"):
            raise ValueError(f"Scene: the name '{name}' is reserved.")
        if name in self._bodies or name in self._elements:
            raise ValueError(f"Scene: the name '{name}' is taken; every name must be unique.")
