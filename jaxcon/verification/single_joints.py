"""One body on one joint, against trajectories of ADAMS and an independent computation of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.verification import references
from jaxcon.verification.case import Check, error, up_to_sign
from jaxcon.verification.references import column
from jaxcon.verification.sampling import RK4, sample

CASE = "single_joints"
WORDS = {"acc": "acceleration [m/s²]", "Rforce": "force of the joint [N]"}
G = 9.80665
STEPS = {"RevSpherical_Case01": 5e-5}
"""Finer ones than 0.5 ms: its rod is jerked round within some hundredths of a second."""


def single_joints() -> list[Check]:
    """Bodies that fall on hinges, balls, sleeves, sliders, rods, crosses and springs for 5 s.

    Motions are compared with an independent computation of ten digits; accelerations and reactions
    with those of ADAMS, within 1.2 times the difference that the independent computation has from
    them, or the digits that are printed. The reaction is that on the ground, its torque about the
    joint's place there, relative to the largest; as in ADAMS it has the torque of a spring about
    the hinge in it.

    References:
        Project Chrono, unit tests of joints and force elements, with trajectories of MSC ADAMS.
    """
    cases = references.load("chrono_joints")["cases"]
    alone = [{name} for name in STEPS]
    checks = []
    for names in (set(cases) - set(STEPS), *alone):
        chosen = {name: case for name, case in cases.items() if name in names}
        step = STEPS.get(min(names), 5e-4)
        found = simulate(chosen, step)
        checks += [c for name, case in chosen.items() for c in compare(name, case, found[name])]
    return checks


def compare(name: str, case: dict[str, Any], got: dict[str, np.ndarray]) -> Iterable[Check]:
    """The checks of one case, from its motion and reactions at the times of the rows."""
    later = [i for i, row in enumerate(case["rows"]) if row["t"] in (1.0, 3.0, 5.0)]
    off = [
        (up_to_sign if key == "quat" else error)(got[key][later], column(case["hp_reference"], key))
        for key in ("pos", "vel", "quat", "omega")
    ]
    yield Check(CASE, f"{name}: position, velocity, quaternion, ω", max(off), 1e-7)
    for key, allowed in case["max_abs_diff_independent_vs_adams"].items():
        expected = column(case["rows"], key)
        bound = max(1.2 * allowed, half_a_digit(expected))
        yield Check(CASE, f"{name}: {WORDS[key]}", error(got[key], expected), bound)
    if "Rtorque" in got:
        expected = column(case["rows"], "Rtorque")
        off = error(got["Rtorque"], expected) / max(1.0, np.max(np.abs(expected)))
        yield Check(CASE, f"{name}: torque of the joint, relative", off, 1e-4)


def half_a_digit(x: np.ndarray) -> float:
    """Half a unit of the sixth digit of the largest number, which is how ADAMS printed them."""
    return 0.5 * 10.0 ** (np.floor(np.log10(np.max(np.abs(x), initial=1e-3))) - 5)


def simulate(cases: dict[str, Any], step: float) -> dict[str, dict[str, np.ndarray]]:
    """Motions and reactions of the cases, side by side in one scene, at the times of the rows."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -G))
    for name, case in cases.items():
        put(scene, name, case)
    system, state = scene.build()
    times = [row["t"] for row in next(iter(cases.values()))["rows"]]
    states = sample(system, state, times, step)
    jointed = [name for name, case in cases.items() if case["joint"] != "free"]

    def read(s: jc.State) -> Any:
        solution = jc.forward_dynamics(system, s, None, RK4, step)
        found = {name: motion(system, s, solution, name) for name in cases}
        for name in jointed:
            found[name] |= reaction(system, s, solution, name, cases[name])
        return found

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(read))(states))


def motion(system: Any, state: jc.State, solution: Any, name: str) -> dict[str, jax.Array]:
    """Position, velocity, orientation, angular velocity and acceleration, world frame."""
    turn = jc.orientation(system, state, name)
    return {
        "pos": jc.position(system, state, name),
        "vel": jc.velocity(system, state, name),
        "quat": turn,
        "omega": jc.quaternion.rotate(turn, jc.angular_velocity(system, state, name)),
        "acc": solution.acceleration[system.layout.v(name)][:3],
    }


def reaction(
    system: Any, state: jc.State, solution: Any, name: str, case: dict[str, Any]
) -> dict[str, jax.Array]:
    """Force and torque on the ground, the torque about the joint's place there."""
    joint = f"{name} joint"
    wrench = jc.wrench(system, state, solution, joint, jc.WORLD)
    anchor = jc.position(system, state, name, system.params[joint]["anchor_b"])
    arm = anchor - jnp.asarray(case["ground_point"], anchor.dtype)
    torque = wrench[3:] + jnp.cross(arm, wrench[:3])
    if "torque" in case:
        angle, rate = (f(system, state, joint) for f in (jc.coordinate, jc.coordinate_rate))
        stiffness = 50 + 10 * jnp.abs(angle) if "theta|" in case["torque"] else 200.0
        hinge = jnp.asarray(turned(*case["turn_degrees"]), angle.dtype)
        axis = jc.quaternion.rotate(hinge, jnp.eye(3, dtype=angle.dtype)[2])
        torque = torque + (stiffness * angle + 10 * rate) * axis
    return {"Rforce": wrench[:3], "Rtorque": torque}


def put(scene: jc.Scene, name: str, case: dict[str, Any]) -> None:
    """The body of a case, its joint to the ground and its spring."""
    turn = turned(*case["turn_degrees"])
    frame = np.asarray(jc.quaternion.matrix(jnp.asarray(turn)))
    ground = np.array(case["ground_point"], float)
    center = case.get("com")
    center = ground + frame @ np.array(case["com_in_joint_frame"]) if center is None else center
    scene.add_body(name, mass=1.0, inertia=case["I_body"], position=center, quaternion=turn)
    for element in hold(name, case, ground, frame, center):
        scene.add(element)


def turned(axis: str, degrees: float) -> np.ndarray:
    """The quaternion of a turn about a world axis, (4,)."""
    half = np.radians(degrees) / 2
    return np.cos(half) * np.eye(4)[0] + np.sin(half) * np.eye(4)[1 + "xyz".index(axis)]


def hold(name: str, case: dict[str, Any], ground: Any, frame: Any, center: Any) -> Iterable[Any]:
    """The joint of a case, and its spring if it has one."""
    x, y, z = frame.T
    pair = (f"{name} joint", jc.WORLD, name)
    end = case.get("body_point")
    match case["joint"]:
        case "revolute":
            yield jc.Revolute(*pair, point=ground, axis=z)
        case "spherical":
            yield jc.Spherical(*pair, point=ground)
        case "cylindrical":
            yield jc.Cylindrical(*pair, point=ground, axis=z)
        case "prismatic":
            yield jc.Prismatic(*pair, point=ground, axis=z)
        case "universal":
            yield jc.Universal(*pair, point=ground, axis_a=x, axis_b=y)
        case "distance":
            yield jc.Distance(*pair, point_a=ground, point_b=end)
        case "revolute_spherical":
            yield jc.RevoluteSpherical(*pair, hinge=ground, ball=end, axis=case["axis"])
        case "free":
            local = frame.T @ (np.array(end) - center)
            rest = np.linalg.norm(np.array(end) - ground)
            params = {"local": local, "ground": ground, "rest": rest}
            yield jc.CustomForce(f"{name} spring", (name,), hardening_spring, params)
    if "torque" in case and "theta|" in case["torque"]:
        params = {"first": x, "second": y, "axis": z}
        yield jc.CustomForce(f"{name} spring", (name,), hardening_torsion, params)
    elif "torque" in case:
        yield jc.JointSpring(f"{name} spring", pair[0], stiffness=200.0, damping=10.0)


def hardening_spring(body: jc.Motion, t: Any, control: Any, p: Any) -> jax.Array:
    """A tension 50 s + 10 |s| s + 5 ṡ of the stretch s from a point of the ground."""
    end = body.point(p["local"])
    rod = end - p["ground"]
    length = jnp.sqrt(rod @ rod)
    along = rod / length
    s, rate = length - p["rest"], along @ body.point_velocity(p["local"])
    force = -(50 * s + 10 * jnp.abs(s) * s + 5 * rate) * along
    return jnp.concatenate([force, jnp.cross(end - body.position, force)])


def hardening_torsion(body: jc.Motion, t: Any, control: Any, p: Any) -> jax.Array:
    """A torque −(50 + 10 |θ|) θ − 10 θ̇ about the axis of the hinge, which is z of the body."""
    pointer = body.direction(jnp.array([1.0, 0.0, 0.0]))
    angle = jnp.arctan2(p["second"] @ pointer, p["first"] @ pointer)
    torque = -(50 + 10 * jnp.abs(angle)) * angle - 10 * body.angular_velocity[2]
    return jnp.concatenate([jnp.zeros(3), torque * p["axis"]])
