"""Scenes of one body on one joint, compared with ADAMS and with an independent computation."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.execution.step import SolutionAt
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error, up_to_sign
from jaxcon.verification.references import column
from jaxcon.verification.sampling import RK4, sample

CASE = "single_joints"
WORDS = {"acc": "acceleration [m/s²]", "Rforce": "force of the joint [N]"}
G = 9.80665
STEPS = {"RevSpherical_Case01": 5e-5}
"""Step sizes of cases that need less than 0.5 ms [s].

The rod of this case makes a turn within a few hundredths of a second.
"""


def single_joints() -> list[Check]:
    """Checks bodies that fall for 5 s on joints and springs of many kinds.

    Motions are compared with an independent computation to ten digits. Accelerations and reactions
    are compared with ADAMS. Their bound is 1.2 times the difference between the independent
    computation and ADAMS, or half of the last printed digit if that is larger.

    The reaction acts on the ground. Its torque is about the anchor of the joint on the ground.
    Errors of the torque are relative to the largest torque. As in ADAMS, the torque of the reaction
    includes the torque of a spring about the hinge.

    References:
        Project Chrono, unit tests of joints and force elements, with trajectories of MSC ADAMS.
    """
    cases = references.load("chrono_joints")["cases"]
    alone = [{name} for name in STEPS]
    checks = []
    for names in (set(cases) - set(STEPS), *alone):
        chosen = {name: case for name, case in cases.items() if name in names}
        step = STEPS.get(min(names), 5e-4)
        results = simulate(chosen, step)
        checks += [c for name, case in chosen.items() for c in compare(name, case, results[name])]
    return checks


def compare(name: str, case: dict[str, Any], result: dict[str, np.ndarray]) -> Iterable[Check]:
    """Yields the checks of one case, from its motion and reactions at the reference times."""
    later = [i for i, row in enumerate(case["rows"]) if row["t"] in (1.0, 3.0, 5.0)]
    errors = [
        (up_to_sign if key == "quat" else error)(
            result[key][later], column(case["hp_reference"], key)
        )
        for key in ("pos", "vel", "quat", "omega")
    ]
    yield Check(CASE, f"{name}: position, velocity, quaternion, ω", max(errors), 1e-7)
    for key, allowed in case["max_abs_diff_independent_vs_adams"].items():
        expected = column(case["rows"], key)
        bound = max(1.2 * allowed, half_a_digit(expected))
        yield Check(CASE, f"{name}: {WORDS[key]}", error(result[key], expected), bound)
    if "Rtorque" in result:
        expected = column(case["rows"], "Rtorque")
        deviation = error(result["Rtorque"], expected) / max(1.0, np.max(np.abs(expected)))
        yield Check(CASE, f"{name}: torque of the joint, relative", deviation, 1e-4)


def half_a_digit(x: np.ndarray) -> float:
    """Returns half a unit in the sixth digit of the largest value, the print accuracy of ADAMS."""
    return 0.5 * 10.0 ** (np.floor(np.log10(np.max(np.abs(x), initial=1e-3))) - 5)


def simulate(cases: dict[str, Any], step: float) -> dict[str, dict[str, np.ndarray]]:
    """Returns motions and reactions of all cases at the reference times, simulated in one scene."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -G))
    for name, case in cases.items():
        put(scene, name, case)
    system, state = scene.build()
    times = [row["t"] for row in next(iter(cases.values()))["rows"]]
    states = sample(system, state, times, step)
    jointed = [name for name, case in cases.items() if case["joint"] != "free"]

    def read(s: jc.State) -> dict[str, dict[str, jax.Array]]:
        solution = jc.forward_dynamics(system, s, None, RK4, step)
        results = {name: motion(system, s, solution, name) for name in cases}
        for name in jointed:
            results[name] |= reaction(system, s, solution, name, cases[name])
        return results

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(read))(states))


def motion(
    system: BodySystem, state: jc.State, solution: SolutionAt, name: str
) -> dict[str, jax.Array]:
    """Returns position, velocity, orientation, angular velocity and acceleration of a body.

    All are in the world frame.
    """
    turn = jc.orientation(system, state, name)
    return {
        "pos": jc.position(system, state, name),
        "vel": jc.velocity(system, state, name),
        "quat": turn,
        "omega": jc.quaternion.rotate(turn, jc.angular_velocity(system, state, name)),
        "acc": solution.acceleration[system.layout.v(name)][:3],
    }


def reaction(
    system: BodySystem, state: jc.State, solution: SolutionAt, name: str, case: dict[str, Any]
) -> dict[str, jax.Array]:
    """Returns the force and the torque of a joint on the ground, about the anchor on the ground."""
    joint = f"{name} joint"
    wrench = jc.wrench(solution, joint, jc.WORLD, system=system)
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
    """Adds the body of a case, its joint to the ground and its spring to a scene."""
    turn = turned(*case["turn_degrees"])
    frame = np.asarray(jc.quaternion.matrix(jnp.asarray(turn)))
    ground = np.array(case["ground_point"], float)
    center = case.get("com")
    center = ground + frame @ np.array(case["com_in_joint_frame"]) if center is None else center
    scene.add_body(name, mass=1.0, inertia=case["I_body"], position=center, quaternion=turn)
    for element in hold(name, case, ground, frame, center):
        scene.add(element)


def turned(axis: str, degrees: float) -> np.ndarray:
    """Returns the quaternion of a rotation about a world axis, (4,)."""
    half = np.radians(degrees) / 2
    return np.cos(half) * np.eye(4)[0] + np.sin(half) * np.eye(4)[1 + "xyz".index(axis)]


def hold(
    name: str, case: dict[str, Any], ground: np.ndarray, frame: np.ndarray, center: np.ndarray
) -> Iterable[Any]:
    """Yields the joint of a case, and its spring if it has one.

    Args:
        name: the name of the body.
        case: the data of the case.
        ground: the anchor of the joint on the ground, (3,) [m].
        frame: the axes of the body, and of most joints, as columns, (3, 3).
        center: the center of mass of the body, (3,) [m].
    """
    x, y, z = frame.T
    pair = (f"{name} joint", jc.WORLD, name)
    end = case.get("body_point")
    match case["joint"]:
        case "revolute":
            yield jc.Revolute(*pair, point=ground, axis=z)
        case "spherical":
            yield jc.Spherical(*pair, point=ground)
        case "cylindrical":
            yield jc.joints.Cylindrical(*pair, point=ground, axis=z)
        case "prismatic":
            yield jc.Prismatic(*pair, point=ground, axis=z)
        case "universal":
            yield jc.joints.Universal(*pair, point=ground, axis_a=x, axis_b=y)
        case "distance":
            yield jc.Distance(*pair, point_a=ground, point_b=end)
        case "revolute_spherical":
            yield jc.joints.RevoluteSpherical(*pair, hinge=ground, ball=end, axis=case["axis"])
        case "free":
            local = frame.T @ (np.array(end) - center)
            rest = np.linalg.norm(np.array(end) - ground)
            params = {"local": local, "ground": ground, "rest": rest}
            yield jc.forces.CustomForce(f"{name} spring", (name,), hardening_spring, params)
    if "torque" in case and "theta|" in case["torque"]:
        params = {"first": x, "second": y, "axis": z}
        yield jc.forces.CustomForce(f"{name} spring", (name,), hardening_torsion, params)
    elif "torque" in case:
        yield jc.forces.JointSpring(f"{name} spring", pair[0], stiffness=200.0, damping=10.0)


def hardening_spring(
    body: jc.extend.Motion, t: jax.Array, control: None, p: dict[str, jax.Array]
) -> jax.Array:
    """Returns the force and torque of a spring with tension 50 s + 10 |s| s + 5 ṡ, (6,).

    s is the extension [m] of the spring, which connects the body to a point on the ground.
    """
    end = body.point(p["local"])
    rod = end - p["ground"]
    length = jnp.sqrt(rod @ rod)
    along = rod / length
    s, rate = length - p["rest"], along @ body.point_velocity(p["local"])
    force = -(50 * s + 10 * jnp.abs(s) * s + 5 * rate) * along
    return jnp.concatenate([force, jnp.cross(end - body.position, force)])


def hardening_torsion(
    body: jc.extend.Motion, t: jax.Array, control: None, p: dict[str, jax.Array]
) -> jax.Array:
    """Returns the torque −(50 + 10 |θ|) θ − 10 θ̇ of a torsion spring as a wrench, (6,).

    θ is the angle about the hinge axis, which is z of the body [rad].
    """
    pointer = body.direction(jnp.array([1.0, 0.0, 0.0]))
    angle = jnp.arctan2(p["second"] @ pointer, p["first"] @ pointer)
    torque = -(50 + 10 * jnp.abs(angle)) * angle - 10 * body.angular_velocity[2]
    return jnp.concatenate([jnp.zeros(3), torque * p["axis"]])
