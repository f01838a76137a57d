"""Whether jaxcon and MuJoCo simulate the same mechanism: same M, same accelerations at the start.

    python -m benchmarks.equivalence

The mass matrix is compared in the velocities of MuJoCo's joints: with B the map from those to the
velocities of the bodies, Bᵀ M B must be MuJoCo's. The accelerations are those of the bodies'
centres of mass. MuJoCo's closed loops are soft, so their accelerations agree only as far as that.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms
from benchmarks.mechanisms import Mechanism, lift

TREE, SOFT = 1e-6, 1e-3
"""Relative differences of the first accelerations: trees, and loops that MuJoCo closes softly."""
IDEAL = jc.Method(stabilizer=jc.Unstabilized(), solver=jc.Dense())


@dataclass(frozen=True)
class Difference:
    """Relative differences between the two models of a mechanism, and violation of the start.

    Attributes:
        place, mass, acceleration: of the markers, M and the markers' accelerations, each by the
            largest entry.
        violation: of φ and φ̇ by the start in jaxcon.
        bound: of the acceleration.
    """

    place: float
    mass: float
    acceleration: float
    violation: float
    bound: float

    @property
    def same(self) -> bool:
        """Whether all is as it should be."""
        exact = max(self.place, self.mass, self.violation) <= TREE
        return exact and self.acceleration <= self.bound


def model_of(mechanism: Mechanism) -> tuple[Any, Any]:
    """MuJoCo's model and data of the mechanism at its start."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(mechanism.mjcf())
    data = mujoco.MjData(model)
    data.qvel[:] = mechanism.rates
    mujoco.mj_forward(model, data)
    return model, data


def compare(mechanism: Mechanism) -> Difference:
    """The two models of a mechanism side by side, in float64."""
    with jax.enable_x64(True):
        system, state = mechanism.build(np.float64)
        places = lift(mechanism.markers(system, state))
        accelerations = lift(
            jax.jit(marker_accelerations, static_argnums=0)(mechanism, system, state)
        )
        violation = jc.violation(system, state)
        mass = np.asarray(system.mass(state.q).dense())
        off = float(max(violation.worst, violation.worst_rate))
    model, data = model_of(mechanism)
    ids = [model.body(name).id for name in mechanism.bodies]
    columns = bodies_from_joints(mechanism, system, model, data)
    return Difference(
        place=relative(data.xpos[ids], places),
        mass=relative(full_mass(model, data), columns.T @ mass @ columns),
        acceleration=relative(mujoco_accelerations(model, data, ids), accelerations),
        violation=off,
        bound=SOFT if mechanism.loops else TREE,
    )


def relative(x: np.ndarray, y: np.ndarray) -> float:
    """The largest difference over the largest entry."""
    return float(np.max(np.abs(x - y)) / np.max(np.abs(y)))


def marker_accelerations(mechanism: Mechanism, system: Any, state: jc.State) -> jax.Array:
    """Of the centres of mass, without feedback, (bodies, dim) [m/s²]."""
    a = jc.forward_dynamics(system, state, None, IDEAL, 1e-3).acceleration

    def speeds(q: Any, v: Any) -> jax.Array:
        moving = jc.State(q, v, state.time, state.status)
        return jax.numpy.stack([jc.velocity(system, moving, name) for name in mechanism.bodies])

    rates = system.kinematics(state.q, state.v), a
    return jax.jvp(speeds, (state.q, state.v), rates)[1]


def mujoco_accelerations(model: Any, data: Any, ids: list[int]) -> np.ndarray:
    """J q̈ + J̇ q̇ of the centres of mass, (bodies, 3) [m/s²]."""
    import mujoco

    found = []
    for i in ids:
        jacobian, rate = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, data.xpos[i], i)
        mujoco.mj_jacDot(model, data, rate, None, data.xpos[i], i)
        found.append(jacobian @ data.qacc + rate @ data.qvel)
    return np.array(found)


def full_mass(model: Any, data: Any) -> np.ndarray:
    """MuJoCo's mass matrix, dense."""
    import mujoco

    mass = np.zeros((model.nv, model.nv))
    for column, unit in zip(mass, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return mass


def bodies_from_joints(mechanism: Mechanism, system: Any, model: Any, data: Any) -> np.ndarray:
    """B: jaxcon's velocities from those of MuJoCo's joints, (n_v, joints)."""
    import mujoco

    columns = np.zeros((system.layout.n_v, model.nv))
    for name in mechanism.bodies:
        linear, turning = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        body = model.body(name).id
        mujoco.mj_jacBody(model, data, linear, turning, body)
        turning = data.xmat[body].reshape(3, 3).T @ turning
        if system.layout.dim == 2:
            linear, turning = linear[[0, 2]], -turning[1:2]
        rows = np.concatenate([linear, turning])
        places = system.layout.v(name)
        columns[places] = rows[: len(places)]
    return columns


def main() -> None:
    """Prints the differences of the mechanisms of the table."""
    from benchmarks.targets import SCENES

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    print(f"{'scene':18s} {'places':>8s} {'M':>8s} {'a':>8s} {'start':>8s}")
    for name in parser.parse_args().scenes:
        d = compare(mechanisms.find(name))
        verdict = "same" if d.same else "NOT THE SAME"
        print(
            f"{name:18s} {d.place:8.1e} {d.mass:8.1e} {d.acceleration:8.1e} {d.violation:8.1e}"
            f"  {verdict}"
        )


if __name__ == "__main__":
    main()
