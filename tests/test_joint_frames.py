"""Joints have no preferred frame: rotated scenes move alike, and the length of axes has no effect.

The directions normal to an axis depend on its direction in the world. In a rotated scene they are
therefore other directions of the bodies.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import DERIVATIVE

import jaxcon as jc
from jaxcon.constraints.rows import linearize

LEFT_OUT = ("holonomic", "velocity_level", "driven_planar")
"""Functions of the tests themselves, and the coordinate y, whose direction is conventional."""

TURN = np.array([0.3, -0.7, 0.5, 0.4]) / np.linalg.norm([0.3, -0.7, 0.5, 0.4])
ANGLE = 0.8


def rotation(dim):
    """The rotation of the whole scene."""
    if dim == 3:
        return np.asarray(jc.quaternion.matrix(jnp.asarray(TURN)))
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    return np.array([[c, -s], [s, c]])


@dataclasses.dataclass(frozen=True)
class Variant:
    """The differences of a scene from its reference."""

    turned: bool = False
    stretch: float = 1.0
    """The factor of every axis."""


def turn_of(dim, variant):
    return rotation(dim) if variant.turned else np.eye(dim)


PARTS = [(dim, part) for dim, parts in scenes.PARTS.items() for part in range(parts)]
"""Dimensions and parts of the table.

One scene of all joints would compile several times as long.
"""


def kinds_in(dim, part):
    kinds = [k for k, joint in scenes.JOINTS.items() if dim in joint.dims and k not in LEFT_OUT]
    return kinds[part :: scenes.PARTS[dim]]


def pair(scene, kind, variant):
    """Adds the two bodies of a joint, at random places, and the joint."""
    dim, random = scene.dim, scenes.seeded(kind, scene.dim, "frames")
    r = turn_of(dim, variant)
    for body, near in (("first", (0.1, -0.1)), ("second", (1.5, 0.5))):
        place = {"position": r @ scenes.near(near, random, dim)}
        if dim == 2:
            place["angle"] = random.normal() + ANGLE * variant.turned
        else:
            start = jnp.asarray(random.normal(size=4))
            turned = jc.quaternion.multiply(jnp.asarray(TURN), start)
            place["quaternion"] = turned if variant.turned else start
        inertia = 0.8 if dim == 2 else (0.8, 1.1, 1.5)
        scene.add_body(f"{body}_{kind}", mass=1.3, inertia=inertia, **place)
    point, other = (r @ scenes.near(x, random, dim) for x in ((0.8, 0.4), (1.2, 1.1)))
    axis = r @ random.normal(size=dim)
    site = scenes.Site(f"first_{kind}", f"second_{kind}", dim, point, axis, other, "_" + kind)
    elements = scenes.JOINTS[kind].make(site)
    # for drives and cams the sign of the axis matters
    sense = kind == "cam" or any(isinstance(element, jc.joints.Drive) for element in elements)
    stretch = abs(variant.stretch) if sense else variant.stretch
    for element in elements:
        given = [f for f in ("axis", "axis_a", "axis_b") if getattr(element, f, None) is not None]
        longer = {f: stretch * getattr(element, f) for f in given}
        scene.add(dataclasses.replace(element, **longer))


@functools.cache
def build(dim, part, variant):
    """Builds every joint of a part, each between two bodies of its own."""
    gravity = turn_of(dim, variant) @ np.array((0.3, 1.0, -9.81)[-dim:])
    scene = jc.Scene(dim=dim, gravity=gravity)
    for kind in kinds_in(dim, part):
        pair(scene, kind, variant)
    system, state = scene.build()
    return scenes.start_curves(system, state), state


@jax.jit
def equations(system, q, v, t):
    """Returns φ, φ̇, J, γ, M and f, by one trace for all variants."""
    rows = linearize(system, q, v, t)
    forces = system.mass(q).dense(), system.force(q, v, t)
    return rows.residual, rows.rate, rows.jacobian.dense(), rows.bias, *forces


move = jax.jit(lambda system, q, step: system.retract(q, step))


@functools.cache
def moments(dim, part):
    """Returns two moving states that satisfy the joints: at assembly, and far from it."""
    system, state = build(dim, part, Variant())
    random = scenes.seeded(dim, part, "moments")
    far = move(system, state.q, jnp.asarray(0.3 * random.normal(size=state.v.shape)))
    found = []
    for q, t in ((state.q, 0.0), (far, 0.3)):
        for _ in range(12):  # of Newton's method with the least correction
            residual, _, jacobian, *_ = equations(system, q, state.v, t)
            q = move(system, q, -jnp.linalg.pinv(jacobian) @ residual)
        v = jnp.asarray(random.normal(size=state.v.shape))
        residual, rate, jacobian, *_ = equations(system, q, v, t)
        assert jnp.max(jnp.abs(residual)) < 1e-12
        found.append((q, v - jnp.linalg.pinv(jacobian) @ rate, t))
    return found


def turn(system, q, v):
    """Returns the state of the rotated scene."""
    dim = system.layout.dim
    r = rotation(dim)
    for name in system.layout.bodies:
        i, j = system.layout.q(name), system.layout.v(name)[:dim]
        place, way = q[i[:dim]], q[i[dim:]]
        way = way + ANGLE if dim == 2 else jc.quaternion.multiply(jnp.asarray(TURN), way)
        q = q.at[i].set(jnp.concatenate([r @ place, way]))
        v = v.at[j].set(r @ v[j])
    return q, v


@functools.cache
def solved(dim, part, variant):
    """Returns by joint and state: a and Jᵀλ of both bodies, (2, d), and the joint's own J."""
    system, state = build(dim, part, variant)
    rows = scenes.linearized(system, state.q, state.v, state.time).layout
    result = {}
    for when, (q, v, t) in zip(("at assembly", "elsewhere"), moments(dim, part), strict=True):
        q, v = turn(system, q, v) if variant.turned else (q, v)
        parts = [np.asarray(x) for x in equations(system, q, v, t)]
        residual, rate, jacobian, bias, mass, force = parts
        assert max(np.max(np.abs(residual)), np.max(np.abs(rate))) < 1e-10, when
        saddle = np.block([[mass, -jacobian.T], [jacobian, np.zeros((len(bias),) * 2)]])
        a, multipliers = np.split(np.linalg.solve(saddle, np.append(force, -bias)), [len(force)])
        for kind in kinds_in(dim, part):
            own = [system.layout.v(f"{body}_{kind}") for body in ("first", "second")]
            names = [n for n in (f"joint_{kind}", f"drive_{kind}") if n in rows.names]
            here = np.concatenate([rows.rows(n) for n in names])
            pull = jacobian[here].T @ multipliers[here]
            motion = tuple(np.stack([x[i] for i in own]) for x in (a, pull))
            result[kind, when] = (*motion, jacobian[np.ix_(here, np.concatenate(own))])
    return result


VARIANTS = {
    "turned": Variant(turned=True),
    "stretched": Variant(stretch=2.5),
    "reversed": Variant(stretch=-0.4),
    "both": Variant(turned=True, stretch=-0.4),
}


@pytest.mark.parametrize(("dim", "part"), PARTS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_joints_prefer_no_frame_and_no_axis(dim, part, variant):
    """Accelerations and forces rotate with the scene; components in body frames do not change."""
    r = turn_of(dim, VARIANTS[variant])
    expected, found = (solved(dim, part, v) for v in (Variant(), VARIANTS[variant]))
    for key, (*motion, _) in expected.items():
        for got, want in zip(found[key], motion, strict=False):
            turned = np.concatenate([want[:, :dim] @ r.T, want[:, dim:]], axis=1)
            np.testing.assert_allclose(
                got, turned, rtol=DERIVATIVE, atol=DERIVATIVE, err_msg=str(key)
            )


@pytest.mark.parametrize(("dim", "part"), PARTS)
def test_no_row_of_a_joint_depends_on_the_others(dim, part):
    """Rows have full rank at assembly and far from it, including the row of a drive."""
    for key, (_, _, jacobian) in solved(dim, part, Variant()).items():
        sizes = np.linalg.svd(jacobian, compute_uv=False)
        assert len(sizes) == len(jacobian), key
        assert sizes[-1] > 0.02 * sizes[0], key
