"""Joints that keep a point on a curve that the user describes by a function.

The curve is the zero set of functions g, not a parametric curve. A row must follow from q and v at
one instant. A curve parameter would be an unknown without mass, or the result of an iteration in
every row. Implicit functions need neither, and closed curves need no special treatment.

With x the position of the point in the frame of body a, and G = ∂g/∂x,

    φ = g(x),   φ̇ = G ẋ,   J = G ∂ẋ/∂v,   γ = G ẍ₀ + ẋᵀ (∂²g/∂x²) ẋ,

where ẍ₀ is the part of ẍ without accelerations a. `primitives.travel` along the axes of body a
gives x, ẋ, ẍ₀ and ∂ẋ/∂v in closed form. Derivatives of g are automatic, in at most three variables.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints import primitives
from jaxcon.constraints.base import Joint, Joints
from jaxcon.constraints.joints import anchors
from jaxcon.constraints.pairs import check_oriented
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks, functions
from jaxcon.core.lanes import Vector, plus, times, total
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree
from jaxcon.geometry.pose import Pose
from jaxcon.staging.worlds import per_world
from jaxcon.system.elements import label

if TYPE_CHECKING:
    from jaxcon.system.body_system import Snapshot

AXES = ("axis_x", "axis_y", "axis_z")


@dataclass(frozen=True)
class PointOnCurve(Joint):
    """A point of b stays on a curve of a, where g(x) = 0: 1 row in the plane, 2 in space.

    x is the position of the point in the user's frame of a, or in world coordinates if a is
    `WORLD`. The unit of λ is N divided by the unit of ∂g/∂x; `wrench` returns the force in newtons.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies a and b, or `WORLD`; a has an orientation, b may be a
            particle.
        curve: the function `curve(x, params)` → g, (1,) in the plane and (2,) in space, with
            linearly independent gradients on the curve. It must be pure and hashable. Define it
            once, since each new function object is traced again.
        point: the point of b, world frame at assembly, (dim,) [m]; b's center of mass unless given.
        params: any pytree of arrays.
    """

    curve: Callable[..., Array]
    point: Any = None
    params: PyTree = None
    relative = True

    def attach(  # type: ignore[override]
        self, a: Pose, b: Pose, user_frame: Pose
    ) -> dict[str, Array]:
        """Returns the point in the frame of b, and the origin and axes of a's user frame.

        Args:
            a: pose of the first body at assembly, world frame.
            b: pose of the second body at assembly, world frame.
            user_frame: pose of a's user frame relative to `a`.
        """
        check_oriented(self, a)
        axes = zip(AXES, user_frame.rotation.T, strict=False)
        return {
            "anchor_a": user_frame.position,
            "anchor_b": anchors(self, a, b)["anchor_b"],
        } | dict(axes)


@pytree
class Curves(Joints):
    """A `PointOnCurve` joint in a system; each forms a group by itself.

    Attributes:
        given: the user's params.
    """

    given: PyTree = None

    def get(self, i: int) -> dict[str, Any]:
        """Returns the numbers of the joint by field, with the user's parameters as "params"."""
        return super().get(i) | {"params": self.given}

    def set(self, changes: Mapping[str, Any]) -> Curves:
        """Returns the joint with changed numbers; `changes` is {name: {field: value}}."""
        fields = dict(changes.get(self.law.name, {}))
        given = fields.pop("params", self.given)
        return dataclasses.replace(super().set({self.law.name: fields}), given=given)

    def rows(self, snapshot: Snapshot) -> list[Row]:
        """Returns a row for each component of g at one instant: φ, φ̇, γ and ∂φ̇/∂v by body."""
        along = self.place(snapshot)
        x, ẋ = (Vector(*(getattr(r, f) for r in along)).stack()[:, 0] for f in ("value", "rate"))
        derivatives = per_world(self._derivatives, snapshot.q.ndim - 1)
        components = zip(*derivatives(x, ẋ, self.given), strict=True)
        return [chain(g, ġ, bend, gradient, along) for g, ġ, bend, gradient in components]

    def place(self, snapshot: Snapshot) -> list[Row]:
        """Returns the position x of the point in the user's frame of a, one row for each axis."""
        a, b = self.frames(snapshot)
        points = a.point(self.params["anchor_a"]), b.point(self.params["anchor_b"])
        axes = (a.direction(self.params[name]) for name in AXES if name in self.params)
        return [primitives.travel(axis, *points) for axis in axes]

    def _derivatives(self, x: Array, ẋ: Array, given: PyTree) -> tuple[Array, ...]:
        """Returns g, G ẋ and ẋᵀ (∂²g/∂x²) ẋ, each (m,), and G = ∂g/∂x, (m, dim), in one world."""

        def g(x: Array) -> Array:
            return functions.call(label(self.law), "curve", self.law.curve, x, given)

        def along(x: Array) -> tuple[Array, Array]:
            return jax.jvp(g, (x,), (ẋ,))

        (value, rate), (_, bend) = jax.jvp(along, (x,), (ẋ,))
        return value, rate, bend, jax.jacfwd(g)(x)

    def check(self, snapshot: Snapshot) -> None:
        """Checks the user's function by a call at assembly.

        Raises:
            ValueError: the call fails, the result has a wrong shape, or the gradients ∂g/∂x at
                assembly vanish or are linearly dependent.
        """
        owner = label(self.law)
        x = jnp.stack([jnp.reshape(row.value, ()) for row in self.place(snapshot)])
        try:
            out = jax.eval_shape(
                functools.partial(functions.call, owner, "curve", self.law.curve), x, self.given
            )
        except TypeError as error:
            if str(error).startswith(owner):
                raise
            raise ValueError(f"{owner}: curve(x, params) cannot be called: {error}.") from error
        shape, expected = getattr(out, "shape", None), (len(x) - 1,)
        if shape != expected or out.dtype != x.dtype:
            got = type(out).__name__ if shape is None else f"{out.dtype}{list(shape)}"
            raise ValueError(
                f"{owner}: its curve must return {expected} of {x.dtype} in {len(x)} dimensions,"
                f" got {got}."
            )
        if not checks.is_concrete((x, self.given)):
            return
        g, _, _, gradient = self._derivatives(x, jnp.zeros_like(x), self.given)
        rank = np.linalg.matrix_rank(np.asarray(gradient, float))
        if rank < len(g):
            raise ValueError(
                f"{label(self.law)}: the gradients ∂g/∂x at the point,"
                f" {checks.numerals(gradient)}, have"
                f" rank {rank}, but {len(g)} is needed: the zeros of g must be crossed there, not"
                " touched."
            )


def chain(g: Array, rate: Array, bend: Array, gradient: Array, along: list[Row]) -> Row:
    """Returns the row of one component of g by the chain rule.

    Args:
        g: the component, ().
        rate: its rate G ẋ, ().
        bend: ẋᵀ (∂²g/∂x²) ẋ, ().
        gradient: its gradient ∂g/∂x, (dim,).
        along: the rows of x, one for each axis.
    """
    slope = [gradient[k][None] for k in range(len(along))]
    bias = total(times(s, row.bias) for s, row in zip(slope, along, strict=True))

    def pull(side: int) -> Vector:
        terms = (row.pulls[side] * s for s, row in zip(slope, along, strict=True))
        return functools.reduce(operator.add, terms)

    return Row(g[None], rate[None], plus(bias, bend[None]), (pull(0), pull(1)))
