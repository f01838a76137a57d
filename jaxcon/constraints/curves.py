"""A point on a curve that the user describes.

The curve is given by functions that vanish on it, not by a parameter along it: a row must follow
from q and v at one instant. A parameter would be one more unknown, without mass and with a memory
of which branch it is on, or the root of an iteration in every row; functions of the point need
neither, close on themselves and have no ends.

With x the place of the point in the frame of a and G = ∂g/∂x,

    φ = g(x),   φ̇ = G ẋ,   J = G ∂ẋ/∂v,   γ = G ẍ₀ + ẋᵀ (∂²g/∂x²) ẋ,

where ẍ₀ is the part of ẍ without a. x, ẋ, ẍ₀ and ∂ẋ/∂v are those of `primitives.travel` along the
three axes of a, in closed form; derivatives of g are automatic, in no more than three variables.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints import primitives
from jaxcon.constraints.base import Joints, RowSet, gather
from jaxcon.constraints.joints import anchors
from jaxcon.constraints.pairs import check_oriented
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks, functions
from jaxcon.core.lanes import Vector, plus, times, total
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import per_world
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label

AXES = ("axis_x", "axis_y", "axis_z")


@dataclass(frozen=True)
class PointOnCurve:
    """A point of b stays on a curve of a, where g(x) = 0: 1 row in the plane, 2 in space.

    x is the place of the point in the frame of a, as a user gave that frame; of the world it is
    the place itself. λ goes with g: its unit is N divided by that of ∂g/∂x, and the force in
    newtons is read by `wrench`.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`; a has an orientation, b may be a particle.
        curve: `curve(x, params)` → g, (1,) in the plane and (2,) in space, with independent
            gradients on the curve; pure and hashable. Define it once, since every new function
            object is a new trace.
        point: of b, world frame at assembly, (dim,) [m]; its centre of mass unless given.
        params: any pytree of arrays.
    """

    name: str
    body_a: str
    body_b: str
    curve: Callable[..., Array]
    point: Any = None
    params: PyTree = None

    def attach(self, a: Pose, b: Pose, own: Pose) -> dict[str, Array]:
        """The point in b, and the user's frame of a, which is `own` in the frame of `a`."""
        check_oriented(self, a)
        axes = zip(AXES, own.rotation.T, strict=False)
        return {"anchor_a": own.position, "anchor_b": anchors(self, a, b)["anchor_b"]} | dict(axes)


@pytree
class Curves(Joints):
    """One point on a curve; `joint` is its description without numbers.

    Attributes:
        given: the user's params.
    """

    given: PyTree = None

    def get(self, i: int) -> dict[str, Any]:
        """The numbers of the joint, the user's as "params"."""
        return super().get(i) | {"params": self.given}

    def set(self, changes: Any) -> Curves:
        """With other numbers."""
        fields = dict(changes.get(self.joint.name, {}))
        given = fields.pop("params", self.given)
        return dataclasses.replace(super().set({self.joint.name: fields}), given=given)

    def rows(self, snapshot: Any) -> RowSet:
        """φ, φ̇, J and γ at one instant."""
        along = self.place(snapshot)
        x, ẋ = (Vector(*(getattr(r, f) for r in along)).stack()[:, 0] for f in ("value", "rate"))
        derivatives = per_world(self._derivatives, snapshot.q.ndim - 1)
        found = zip(*derivatives(x, ẋ, self.given), strict=True)
        rows = [chain(g, ġ, bend, gradient, along) for g, ġ, bend, gradient in found]
        return gather(snapshot, self.places, rows)

    def place(self, snapshot: Any) -> list[Row]:
        """x by components: the way from the origin of a to the point along each axis of a."""
        a, b = self.frames(snapshot)
        points = a.point(self.params["anchor_a"]), b.point(self.params["anchor_b"])
        axes = (a.direction(self.params[name]) for name in AXES if name in self.params)
        return [primitives.travel(axis, *points) for axis in axes]

    def _derivatives(self, x: Array, ẋ: Array, given: PyTree) -> tuple[Array, ...]:
        """g, G ẋ, ẋᵀ(∂²g/∂x²)ẋ, each (m,), and G (m, dim), in one world."""

        def g(x: Array) -> Array:
            return functions.call(label(self.joint), "curve", self.joint.curve, x, given)

        def along(x: Array) -> tuple[Array, Array]:
            return jax.jvp(g, (x,), (ẋ,))

        (value, rate), (_, bend) = jax.jvp(along, (x,), (ẋ,))
        return value, rate, bend, jax.jacfwd(g)(x)

    def check(self, snapshot: Any) -> None:
        """Calls the curve at assembly.

        Raises:
            ValueError: it cannot be called, returns another shape, or its gradients vanish or
                depend on one another there.
        """
        owner = label(self.joint)
        x = jnp.stack([row.value.reshape(()) for row in self.place(snapshot)])
        try:
            out = jax.eval_shape(
                functools.partial(functions.call, owner, "curve", self.joint.curve), x, self.given
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
        if checks.is_concrete((x, self.given)):
            self._check_gradient(x)

    def _check_gradient(self, x: Array) -> None:
        g, _, _, gradient = self._derivatives(x, jnp.zeros_like(x), self.given)
        rank = np.linalg.matrix_rank(np.asarray(gradient, float))
        if rank < len(g):
            raise ValueError(
                f"{label(self.joint)}: the gradients ∂g/∂x at the point,"
                f" {checks.numerals(gradient)}, have"
                f" rank {rank}, but {len(g)} is needed: the zeros of g must be crossed there, not"
                " touched."
            )


def chain(g: Array, rate: Array, bend: Array, gradient: Array, along: list[Row]) -> Row:
    """One row of g from its derivatives and the rows of x."""
    slope = [gradient[k][None] for k in range(len(along))]
    bias = total(times(s, row.bias) for s, row in zip(slope, along, strict=True))

    def pull(side: int) -> Vector:
        terms = (row.pulls[side] * s for s, row in zip(slope, along, strict=True))
        return functools.reduce(operator.add, terms)

    return Row(g[None], rate[None], plus(bias, bend[None]), (pull(0), pull(1)))
