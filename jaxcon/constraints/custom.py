"""Constraints from a user's function, on generalized coordinates or on named bodies."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints import autodiff
from jaxcon.constraints.base import RowSet
from jaxcon.core import checks, functions
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import per_world
from jaxcon.model.generalized import WHOLE
from jaxcon.model.layout import Place


@dataclass(frozen=True)
class Holonomic:
    """φ(q, t) = 0 from a user's function; J and γ by automatic differentiation.

    On generalized coordinates the function is `function(q, t, params)` with the system's params; on
    bodies it is `function(*poses, t, params)` with the `Pose` of each named body. It returns φ,
    (m,).

    Attributes:
        function: pure and hashable; define it once, since every new function object is a new trace.
        bodies: names; empty for generalized coordinates.
        name: unique in the system.
        params: any pytree of arrays, leaves of the system; on bodies only.
    """

    function: Callable[..., Array]
    bodies: tuple[str, ...] = ()
    name: str = "holonomic"
    params: PyTree = None

    def rate(self, call: Callable[..., Array], kinematics: autodiff.Kinematics) -> Any:
        """φ̇(q, v, t)."""
        return autodiff.holonomic_rate(lambda q, t: call(q, None, t), kinematics)

    def value(self, call: Callable[..., Array], q: PyTree, t: Any) -> Array | None:
        """φ(q, t)."""
        return call(q, None, t)


@dataclass(frozen=True)
class VelocityLevel:
    """ψ(q, v, t) = 0, affine in v, from a user's function: A(q, t) v + b(q, t) = 0.

    On generalized coordinates the function is `function(q, v, t, params)`; on bodies it is
    `function(*motions, t, params)` with the `Motion` of each named body. It returns ψ, (m,). Under
    feedback ψ decays as ψ̇ = −2α ψ; it is never part of a position projection.

    Attributes:
        function: pure and hashable; define it once, since every new function object is a new trace.
        bodies: names; empty for generalized coordinates.
        name: unique in the system.
        params: any pytree of arrays, leaves of the system; on bodies only.
    """

    function: Callable[..., Array]
    bodies: tuple[str, ...] = ()
    name: str = "velocity_level"
    params: PyTree = None

    def rate(self, call: Callable[..., Array], kinematics: autodiff.Kinematics) -> Any:
        """ψ(q, v, t), which takes the place of φ̇."""
        return call

    def value(self, call: Callable[..., Array], q: PyTree, t: Any) -> Array | None:
        """None: there is no φ."""
        return None


@pytree
class Custom:
    """A user's constraint in a system; the subclasses say on which coordinates.

    Attributes:
        params: the user's own.
        law: `Holonomic` or `VelocityLevel`, without its params.
        places: of the bodies with coordinates.
    """

    params: PyTree
    law: Any = static()
    places: tuple[Place, ...] = static(default=(WHOLE,))

    @property
    def names(self) -> tuple[str, ...]:
        """The name of the constraint, alone in a tuple."""
        return (self.law.name,)

    @property
    def owner(self) -> str:
        """The first words of errors."""
        return f"{type(self.law).__name__} '{self.law.name}'"

    def get(self, i: int) -> dict[str, Any]:
        """The user's parameters."""
        return {"params": self.params}

    def set(self, changes: Any) -> Any:
        """With other parameters."""
        new = changes.get(self.law.name, {}).get("params", self.params)
        return dataclasses.replace(self, params=new)

    def anchor(self, snapshot: Any, i: int) -> Array | None:
        """None: a user's constraint has no anchor but the body itself."""
        return None

    def rows(self, snapshot: Any) -> RowSet:
        """φ, φ̇, J and γ at one instant."""
        value, rate, bias, jacobian = self.linearized(snapshot)
        blocks = [
            (snapshot.system.columns(place), tuple(_lanes(row) for row in block))
            for place, block in zip(self.places, jacobian, strict=True)
        ]
        value, rate, bias = (tuple(_lanes(x)) for x in (value, rate, bias))
        holonomic = (isinstance(self.law, Holonomic),) * len(rate)
        return RowSet(value, rate, bias, tuple(blocks), holonomic)

    def linearized(self, snapshot: Any) -> tuple[Array, Array, Array, tuple[Array, ...]]:
        """φ, φ̇, γ (m,) and ∂φ̇/∂v by bodies (m, d), batches behind."""
        given = (snapshot.system, self, snapshot.q, snapshot.v, snapshot.t)
        return per_world(_numbers, snapshot.q.ndim - 1)(*given)

    def problem(self, snapshot: Any) -> tuple[Any, Any, Any, Any]:
        """q and v as lists, q̇ = N(q) v, and the function as call(q, v, t)."""
        raise NotImplementedError


@pytree
class CustomOnCoordinates(Custom):
    """On generalized coordinates; the parameters are the system's."""

    def problem(self, snapshot: Any) -> tuple[Any, Any, Any, Any]:
        """q and v as lists, q̇ = v, and the function as call(q, v, t)."""
        params = snapshot.system.params

        def call(q: Any, v: Any, t: Any) -> Array:
            args = (*q, t, params) if v is None else (*q, *v, t, params)
            return functions.call(self.owner, "function", self.law.function, *args)

        return [snapshot.q], [snapshot.v], lambda q, v: v, call


@pytree
class CustomOnBodies(Custom):
    """On the poses or motions of named bodies, those fixed to the world included."""

    def problem(self, snapshot: Any) -> tuple[Any, Any, Any, Any]:
        """q and v of the bodies that move, q̇ = N(q) v, and the function as call(q, v, t)."""
        layout = snapshot.system.layout
        moving = [name for name in self.law.bodies if name in layout.places]
        kinds = [layout.groups[layout.locate(name)[0]].kind for name in moving]

        def kinematics(q: Any, v: Any) -> Any:
            pairs = zip(kinds, q, v, strict=True)
            return [k.kinematics(Vector.of(x), Vector.of(y)).stack() for k, x, y in pairs]

        def call(q: Any, v: Any, t: Any) -> Array:
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


def _numbers(system: Any, group: Custom, q: Array, v: Array, t: Any) -> Any:
    """φ, φ̇, γ (m,) and J by bodies (m, d), in one world."""
    q, v, kinematics, call = group.problem(system.snapshot(q, v, t))
    value = group.law.value(call, q, t)
    rate, jacobian, bias = autodiff.rows(group.law.rate(call, kinematics), kinematics, q, v, t)
    return jnp.zeros_like(rate) if value is None else value, rate, bias, jacobian


def check_function(group: Custom, snapshot: Any) -> None:
    """Checks what a user's function returns, and that ψ is affine in v.

    Affinity is tested with numbers, since a program does not show it: ψ(v + w) − ψ(v) − ψ(w) + ψ(0)
    must vanish for two random velocities. Values that are still traced are replaced by random ones,
    because the property must hold for all.

    Raises:
        ValueError: not of shape (m,), not floating, or not affine in v.
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


def _affine(group: Custom, snapshot: Any) -> bool:
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
    """The components of one row or of a column of rows, each a lane of one element."""
    return Vector(*(x[None] for x in row))
