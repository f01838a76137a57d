"""The builder: a scene in the user's words, checked and laid out."""

from __future__ import annotations

import dataclasses
import difflib
import inspect
from collections.abc import Callable
from typing import Any, Never

import jax
import jax.numpy as jnp

from jaxcon.constraints.contact_default import first_multipliers
from jaxcon.constraints.curves import Curves
from jaxcon.constraints.custom import Custom, check_function
from jaxcon.core import checks
from jaxcon.core.pytree import unshared
from jaxcon.core.status import Status
from jaxcon.dynamics import grouping
from jaxcon.dynamics.along import no_turns
from jaxcon.dynamics.inputs import BodyInput, resolve
from jaxcon.geometry.pose import Pose, WorldPose
from jaxcon.model.elements import side_by_side
from jaxcon.model.layout import WORLD
from jaxcon.model.state import MethodMemory, State
from jaxcon.model.system import BodySystem

ORIENTATIONS = ("angle", "quaternion", "orientation", "rotation", "attitude", "quat")
"""Names of arguments by which someone may mean how a body is turned."""


def _dtype(given: Any) -> Any:
    """The dtype of a scene.

    Raises:
        ValueError: it is neither float32 nor float64.
    """
    try:
        dtype = jnp.dtype(jnp.result_type(float) if given is None else given)
    except (TypeError, ValueError):
        dtype = None
    if dtype not in (jnp.float32, jnp.float64) or given is float:
        got = checks.shortened(given) if dtype is None else dtype
        raise ValueError(f"Scene: dtype must be float32 or float64, got {got}.")
    return dtype


class Scene:
    """Bodies, constraints and forces by name; `build` checks them and makes a system.

    Args:
        dim: 2 or 3.
        gravity: (dim,) [m/s²]; 9.81 downwards (along the last axis) unless given.
        dtype: of every number; JAX's default float unless given.

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
        self._elements: dict[str, Any] = {}

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

        Args:
            name: unique in the scene.
            mass: () [kg].
            inertia: about the centre of mass [kg m²]: () in the plane; in space principal moments
                (3,) or a full tensor (3, 3); or an `Inertia`, which also brings mass and centre.
            position: of the body's frame, world, (dim,) [m]. The frame lies at the centre of mass
                unless an `Inertia` says otherwise. Poses and velocities are zero unless given.
            quaternion: body to world, wxyz, (4,); in space.
            angle: () [rad]; in the plane. `build` warns of more than a turn: degrees, most likely.
            velocity: of the body's frame, world, (dim,) [m/s].
            angular_velocity: () in the plane, (3,) in the body frame in space [rad/s].
            fixed: whether it is part of the world; it then needs no mass and has no coordinates.
            unknown: anything else is refused by name.

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
        """Lets the angle of a body in the plane count whole turns: `build` does not warn of it.

        Args:
            name: of a body that was added.
        """
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
            name: unique in the scene.
            mass: () [kg].
            position: world, (dim,) [m].
            velocity: world, (dim,) [m/s].
            unknown: anything else is refused by name.

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
            element: such as `Revolute`, `Spring` or `Limit`; their bodies may come later.

        Raises:
            ValueError: its name is taken.
            TypeError: it is neither a constraint nor a force.
        """
        roles = ("attach", "function", "motion", "rows", "forces", "joint")
        if not hasattr(element, "name") or not any(hasattr(element, role) for role in roles):
            raise TypeError(f"Scene.add takes a joint, constraint or force, got {element!r}.")
        self._take_name(element.name)
        self._elements[element.name] = element

    def build(self) -> tuple[BodySystem, State]:
        """Checks the scene, lays it out, and attaches every element where its bodies now are.

        Returns:
            The system, and the state at assembly. Where the default method warm-starts its solver
            of inequality constraints, the state has the multipliers for it.

        Raises:
            ValueError: an unknown name, a joint between a body and itself, a wrong shape or dtype,
                a value out of range; the message names the culprit.
        """
        bodies = {name: resolve(b, self.dim, self.dtype) for name, b in self._bodies.items()}
        layout, inertia = grouping.lay_out(self.dim, bodies, self._elements.values())
        world = jnp.zeros(self.dim, self.dtype)
        upright = jnp.zeros((), self.dtype) if self.dim == 2 else jnp.eye(4, dtype=self.dtype)[0]
        fixed = {n: b.motion.pose for n, b in bodies.items() if b.kind is None}
        fixed[WORLD] = Pose(world, upright)
        poses = {n: b.motion.pose for n, b in bodies.items()}
        poses |= {n: WorldPose(pose.position, upright) for n, pose in fixed.items()}
        offsets = {n: b.offset for n, b in bodies.items() if b.offset is not None}
        gather = grouping.Gather(self.dim, self.dtype, layout, poses, offsets | fixed)
        elements = self._elements.values()
        along = gather.along(elements)
        constraints = gather.constraints(elements, along)
        turns = no_turns(along.counted, self.dtype)
        system = BodySystem(
            gravity=self.gravity,
            inertia=inertia,
            constraints=tuple(constraints),
            forces=tuple(gather.forces(elements, along)),
            offsets=offsets,
            fixed=fixed,
            turns=turns,
            layout=layout,
            counted=along.counted,
            bounds=tuple(gather.bounds(elements, along)),
        )
        more = {"turns": turns, "angle_remainder": system.no_remainder(self.dtype)}
        state = dataclasses.replace(self._state(layout, bodies), **more)
        for group in (*constraints, *system.bounds):
            if isinstance(group, Custom):
                check_function(group, system.snapshot(state.q, state.v, state.instant))
            if isinstance(group, Curves):
                group.check(system.snapshot(state.q, state.v, state.instant))
        multipliers = first_multipliers(system, state.q, state.v)
        if jax.tree.leaves(multipliers):
            state = dataclasses.replace(state, memory=MethodMemory(bounded=multipliers))
        return system, unshared(state, system)

    def _state(self, layout: Any, bodies: Any) -> State:
        q, v = [], []
        for group in layout.groups:
            pairs = [group.kind.coordinates(bodies[name].motion) for name in group.names]
            q.append(side_by_side([x for x, _ in pairs]).ravel())
            v.append(side_by_side([y for _, y in pairs]).ravel())
        if not q:
            raise ValueError("Scene: there is no body that moves; add one with add_body.")
        status = jnp.asarray(Status.OK, jnp.int32)
        return State(jnp.concatenate(q), jnp.concatenate(v), jnp.zeros((), self.dtype), status)

    def _refuse(
        self, owner: str, method: Callable[..., None], unknown: dict[str, Any], turned: str
    ) -> None:
        """Refuses keyword arguments that a method does not have.

        Args:
            owner: what is added, for the error.
            method: that adds it.
            unknown: the arguments by name.
            turned: what to say of an argument that means an orientation.

        Raises:
            TypeError: there are some; the message lists the names that the method takes.
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
