"""Constraints from a user's function, on generalized coordinates or on named bodies.

Rows follow by automatic differentiation, exact to second order. Along a motion q̇ = N(q) v,

    φ̇(q, v, t) = ∂φ/∂q N(q) v + ∂φ/∂t,    J = ∂φ̇/∂v,    γ = d/dt φ̇ at constant v,

where d/dt differentiates along the motion (q̇ = N v, ṫ = 1). It includes the mixed terms 2 (∂J/∂t)
v. For velocity-level constraints, ψ(q, v, t) takes the place of φ̇.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.primitives import Row
from jaxcon.core import checks, functions
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree
from jaxcon.protocols import Constraint
from jaxcon.staging.worlds import per_world
from jaxcon.system.elements import Element, UserElement

if TYPE_CHECKING:
    from jaxcon.protocols import System
    from jaxcon.system.body_system import Snapshot


@dataclass(frozen=True)
class UserFunction(Element):
    """A constraint on positions from a user's function φ(q, t).

    Attributes:
        function: the user's function.
        bodies: names of the bodies; empty for generalized coordinates.
        name: name of the element, unique in the system.
        params: any pytree of arrays.
    """

    function: Callable[..., Array]
    bodies: tuple[str, ...] = ()
    name: str = ""
    params: PyTree = None

    def rate(self, call: Callable[..., Array], kinematics: Callable[..., Any]) -> Any:
        """Returns the function φ̇(q, v, t), the time derivative of φ along a motion.

        Args:
            call: the function φ, called as call(q, None, t).
            kinematics: the function (q, v) → q̇.
        """

        def rate(q: PyTree, v: PyTree, t: Array) -> Array:
            tangents = (kinematics(q, v), jnp.ones_like(t))
            return jax.jvp(lambda q, t: call(q, None, t), (q, t), tangents)[1]

        return rate

    def value(self, call: Callable[..., Array], q: PyTree, t: Array) -> Array | None:
        """Returns φ(q, t), (m,).

        Args:
            call: the function φ, called as call(q, None, t).
            q: positions.
            t: time, () [s].
        """
        return call(q, None, t)


@dataclass(frozen=True)
class Holonomic(UserFunction):
    """A constraint φ(q, t) = 0 from a user's function; J and γ follow by automatic differentiation.

    On generalized coordinates the function is `function(q, t, params)` with the system's params. On
    bodies it is `function(*poses, t, params)` with the `Pose` of each named body. It returns φ,
    (m,).

    Attributes:
        function: the user's function, pure and hashable; define it once, since each new function
            object is traced again.
        bodies: names of the bodies; empty for generalized coordinates.
        name: name of the element, unique in the system.
        params: any pytree of arrays, leaves of the system; on bodies only.
    """

    name: str = "holonomic"


@dataclass(frozen=True)
class VelocityLevel(UserFunction):
    """A constraint ψ(q, v, t) = 0, affine in v, from a user's function: A(q, t) v + b(q, t) = 0.

    On generalized coordinates the function is `function(q, v, t, params)`. On bodies it is
    `function(*motions, t, params)` with the `Motion` of each named body. It returns ψ, (m,). Under
    feedback ψ decays as ψ̇ = −2α ψ. A position projection does not change ψ.

    Attributes:
        function: the user's function, pure and hashable; define it once, since each new function
            object is traced again.
        bodies: names of the bodies; empty for generalized coordinates.
        name: name of the element, unique in the system.
        params: any pytree of arrays, leaves of the system; on bodies only.
    """

    name: str = "velocity_level"

    def rate(self, call: Callable[..., Array], kinematics: Callable[..., Any]) -> Any:
        """Returns the function ψ(q, v, t), which takes the place of φ̇."""
        return call

    def value(self, call: Callable[..., Array], q: PyTree, t: Array) -> Array | None:
        """Returns None, since a velocity-level constraint has no φ."""
        return None


@pytree
class Custom(UserElement, Constraint):  # type: ignore[override]
    """A user's constraint in a system: the base class for both kinds of coordinates."""

    independent: ClassVar[bool] = False

    @property
    def owner(self) -> str:
        """The class and name of the element, for error messages."""
        return f"{type(self.law).__name__} '{self.law.name}'"

    def rows(self, snapshot: Snapshot) -> list[Row]:
        """Returns a row for each component of the user's function: φ, φ̇, γ and ∂φ̇/∂v by body."""
        value, rate, bias, jacobian = self.linearized(snapshot)
        pulls = zip(*([_lanes(row) for row in block] for block in jacobian), strict=True)
        lanes = zip(*map(_lanes, (value, rate, bias)), pulls, strict=True)
        holonomic = isinstance(self.law, Holonomic)
        return [Row(*row, holonomic=holonomic) for row in lanes]

    def linearized(self, snapshot: Snapshot) -> tuple[Array, Array, Array, tuple[Array, ...]]:
        """Returns φ, φ̇ and γ, each (m,), and ∂φ̇/∂v by body, each (m, d); batch axes come last."""
        given = (snapshot.system, self, snapshot.q, snapshot.v, snapshot.t)
        return per_world(_numbers, snapshot.q.ndim - 1)(*given)

    def problem(self, snapshot: Snapshot) -> tuple[Any, Any, Any, Any]:
        """Returns (q, v, kinematics, call): the arguments and functions that define the rows.

        q and v are lists of arrays, kinematics(q, v) returns q̇ = N(q) v, and call(q, v, t)
        evaluates the user's function; v is None for φ(q, t).
        """
        raise NotImplementedError


@pytree
class CustomOnCoordinates(Custom):
    """A user's constraint on generalized coordinates; its function gets the system's params."""

    def problem(self, snapshot: Snapshot) -> tuple[Any, Any, Any, Any]:
        """Returns (q, v, kinematics, call) for generalized coordinates.

        Returns:
            The lists [q] and [v], the function kinematics(q, v) → v, and the function call(q, v,
            t), which calls the user's function with the system's params; v is None for φ(q, t).
        """
        params = snapshot.system.params

        def call(q: list[Array], v: list[Array] | None, t: Array) -> Array:
            args = (*q, t, params) if v is None else (*q, *v, t, params)
            return functions.call(self.owner, "function", self.law.function, *args)

        return [snapshot.q], [snapshot.v], lambda q, v: v, call


@pytree
class CustomOnBodies(Custom):
    """A user's constraint on the poses or motions of named bodies, which may be fixed."""

    def problem(self, snapshot: Snapshot) -> tuple[Any, Any, Any, Any]:
        """Returns (q, v, kinematics, call) for the named bodies that can move.

        Returns:
            A list with the q of each moving body; a list with the v of each; the function
            kinematics(q, v), which returns a list of q̇ = N(q) v; and the function call(q, v, t).
            The latter calls the user's function with the motions of all named bodies, or with
            their poses if v is None.
        """
        layout = snapshot.system.layout
        moving = [name for name in self.law.bodies if name in layout.places]
        kinds = [layout.groups[layout.locate(name)[0]].kind for name in moving]

        def kinematics(q: list[Array], v: list[Array]) -> list[Array]:
            pairs = zip(kinds, q, v, strict=True)
            return [k.kinematics(Vector.of(x), Vector.of(y)).stack() for k, x, y in pairs]

        def call(q: list[Array], v: list[Array] | None, t: Array) -> Array:
            rates = [jnp.zeros(k.n_v, x.dtype) for k, x in zip(kinds, q, strict=True)]
            states = zip(moving, kinds, q, rates if v is None else v, strict=True)
            offsets = snapshot.system.offsets
            motions = {
                name: kind.motion(x, y).seen_from(offsets.get(name)) for name, kind, x, y in states
            }
            bodies = [motions.get(name) or snapshot.motion(name) for name in self.law.bodies]
            bodies = [b.pose for b in bodies] if v is None else bodies
            return functions.call(
                self.owner, "function", self.law.function, *bodies, t, self.params
            )

        q = [snapshot.q[layout.q(name)] for name in moving]
        v = [snapshot.v[layout.v(name)] for name in moving]
        return q, v, kinematics, call


def _numbers(system: System, group: Custom, q: Array, v: Array, t: Array) -> Any:
    """Returns φ, φ̇ and γ, each (m,), and ∂φ̇/∂v by body, each (m, d), in one world."""
    q, v, kinematics, call = group.problem(system.snapshot(q, v, t))
    value = group.law.value(call, q, t)
    function = group.law.rate(call, kinematics)
    tangents = (kinematics(q, v), jnp.ones_like(t))
    rate, bias = jax.jvp(lambda q, t: function(q, v, t), (q, t), tangents)
    jacobian = jax.jacfwd(function, argnums=1)(q, v, t)
    return jnp.zeros_like(rate) if value is None else value, rate, bias, jacobian


def check_function(group: Custom, snapshot: Snapshot) -> None:
    """Checks the result of a user's function, and that ψ is affine in v.

    The check for affinity is numerical: ψ(v + w) − ψ(v) − ψ(w) + ψ(0) must vanish for two random
    velocities v and w. Traced values are replaced by random numbers; ψ must be affine for all
    values.

    Raises:
        ValueError: the result does not have shape (m,) or the dtype of q, or ψ is not affine in v.
    """
    owner = group.owner
    q, v, _, call = group.problem(snapshot)
    velocities = v if isinstance(group.law, VelocityLevel) else None
    try:
        out = jax.eval_shape(lambda q, v, t: call(q, v, t), q, velocities, snapshot.t)
    except TypeError as error:
        if str(error).startswith(owner):
            raise
        raise ValueError(f"{owner}: its function cannot be called: {error}.") from error
    shape, dtype = getattr(out, "shape", None), getattr(out, "dtype", None)
    if shape is None or len(shape) != 1 or dtype != q[0].dtype:
        raise ValueError(
            f"{owner}: its function must return an array (m,) of {q[0].dtype}, got"
            f" {type(out).__name__ if shape is None else f'{dtype}{list(shape)}'}."
        )
    if velocities is not None and not _affine(group, snapshot):
        raise ValueError(
            f"{owner}: its function must be affine in the velocities, A(q, t) v + b(q, t), but"
            " ψ(v + w) − ψ(v) − ψ(w) + ψ(0) is not zero."
        )


def _affine(group: Custom, snapshot: Snapshot) -> bool:
    """Returns True if ψ is affine in v, by the test that `check_function` describes."""
    random = np.random.default_rng(0)

    def concrete(x: Any) -> Any:
        if checks.is_concrete(x):
            return x
        return np.asarray(random.uniform(0.5, 1.5, jnp.shape(x)), jnp.result_type(x))

    group, snapshot = jax.tree.map(concrete, group), snapshot.map(concrete)
    with jax.ensure_compile_time_eval():
        q, v, _, call = group.problem(snapshot)
        a = [jnp.asarray(random.normal(size=x.shape), x.dtype) for x in v]
        b = [jnp.asarray(random.normal(size=x.shape), x.dtype) for x in v]
        both, none = [x + y for x, y in zip(a, b, strict=True)], [0 * x for x in a]
        psi = [np.asarray(call(q, w, snapshot.t)) for w in (both, a, b, none)]
    defect = np.abs(psi[0] - psi[1] - psi[2] + psi[3])
    size = 1 + sum(np.abs(x) for x in psi)
    return not np.any(defect > 1e3 * np.finfo(defect.dtype).eps * size)


def _lanes(row: Array) -> Vector:
    """Returns a Vector of lanes of one element, one for each entry along the first axis."""
    return Vector(*(x[None] for x in row))
