"""Checks random mechanisms under the default method for failure, energy gain and drift.

    python -m benchmarks.random_scenes [--scenes N] [--seed K]

Each scene has two to five bodies in a random tree of random joints. Some have springs, dampers,
joint limits or a closing rod. Some float freely without gravity. Each runs from random velocities
at several step sizes in one batch. Each world is checked for:

    status      OK to the end
    energy      gain below a tenth of the largest kinetic energy
    joints      |φ| below a hundredth of the size of the mechanism
    momentum    constant linear momentum of floating mechanisms, to rounding
    batch       the first world that does not fail moves alone as in the batch
    derivative  forward and reverse mode agree and are finite

The study prints the number of failures of each check and the failing scenes. The exit status is 1
if a check failed. No method resolves a motion in which a body turns by more than half a radian in a
step, or further than the angle to a singular configuration of a closed loop. RATTLE and RK4 with
projection then end with NOT_CONVERGED. A failing world is therefore compared with an accurate
simulation. It counts separately if its own step is too long for the motion.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.constraints.rows import RowLayout, Rows, linearize
from jaxcon.linear.jacobian import Jacobian

STEPS = 600
"""Number of steps of a motion."""
SIZES = (1e-3, 5e-3, 1 / 60)
"""Step sizes [s]."""
FAST = 0.5
"""Rotation of a body per step above which no method resolves the motion [rad]."""
ACCURATE_STEP = 1e-4
"""Step size of the accurate simulation [s]."""
CHECKS = ("status", "energy", "joints", "momentum", "batch", "derivative")


@dataclass(frozen=True)
class Found:
    """The failed checks of a scene.

    Attributes:
        name: dimension and seed, which reproduce the scene.
        wrong: the worst value of each failed check, over the worlds whose step is short enough.
        too_long: the worst value of each failed check in the worlds whose step is too long.
    """

    name: str
    wrong: dict[str, float]
    too_long: dict[str, float] = field(default_factory=dict)


def build(dim: int, seed: int) -> tuple[Any, jc.State, bool]:
    """Builds a random mechanism.

    Returns:
        The system, its state, and True if the mechanism floats freely.
    """
    random = np.random.default_rng((dim, seed))
    floats = random.random() < 0.25
    gravity = (0.0,) * dim if floats else (*(0.0,) * (dim - 1), -9.81)
    scene = jc.Scene(dim=dim, gravity=gravity)
    count = int(random.integers(2, 6))
    places: dict[str, np.ndarray] = {}
    for i in range(count):
        name = f"body{i}"
        near = places[f"body{random.integers(i)}"] if i else np.zeros(dim)
        places[name] = near + _direction(random, dim) * random.uniform(0.5, 1.0)
        _add_body(scene, name, places[name], random)
    for i in range(count):
        if i or not floats:
            before = f"body{random.integers(i)}" if i else jc.WORLD
            _add_joint(scene, f"joint{i}", before, f"body{i}", places, random)
    if random.random() < 0.5:
        a, b = random.choice(count, 2, replace=False)
        spring = {"stiffness": random.uniform(1, 20), "damping": random.uniform(0, 0.5)}
        scene.add(jc.Spring("spring", f"body{a}", f"body{b}", **spring))
    if count > 2 and random.random() < 0.3:
        scene.add(jc.Distance("closing", f"body{count - 1}", "body0"))
    system, state = scene.build()
    return system, state, floats


def _direction(random: np.random.Generator, dim: int) -> np.ndarray:
    x = random.normal(size=dim)
    return x / np.linalg.norm(x)


def _add_body(scene: jc.Scene, name: str, place: np.ndarray, random: np.random.Generator) -> None:
    mass = 10 ** random.uniform(-1, 1)
    if scene.dim == 2:
        inertia = mass * random.uniform(0.01, 0.1)
        scene.add_body(
            name, mass=mass, inertia=inertia, position=place, angle=random.uniform(-3, 3)
        )
        return
    sides = random.uniform(0.1, 0.6, 3)
    turn = _direction(random, 4)
    scene.add_body(name, inertia=jc.inertia.box(mass, sides), position=place, quaternion=turn)


def _add_joint(
    scene: jc.Scene, name: str, before: str, body: str, places: dict[str, Any], random: Any
) -> None:
    """Adds a random joint halfway between two bodies, or between a body and a world point."""
    dim = scene.dim
    anchor = places[before] if before != jc.WORLD else places[body] + _direction(random, dim)
    point = (anchor + places[body]) / 2
    kind = random.choice(["hinge", "hinge", "slide", "rod"] + ["ball"] * (dim == 3))
    axis = {} if dim == 2 else {"axis": _direction(random, 3)}
    if kind == "hinge":
        scene.add(jc.Revolute(name, before, body, point=point, **axis))
        if random.random() < 0.3:
            scene.add(jc.forces.JointDamper(f"{name} damper", name, random.uniform(0.01, 0.2)))
        if random.random() < 0.2:
            scene.add(jc.Limit(f"{name} stop", name, -0.5, 0.7))
    elif kind == "slide":
        scene.add(jc.Prismatic(name, before, body, point=point, axis=_direction(random, dim)))
        scene.add(jc.forces.JointSpring(f"{name} spring", name, random.uniform(5, 50)))
    elif kind == "ball":
        scene.add(jc.Spherical(name, before, body, point=point))
    elif before == jc.WORLD:
        scene.add(jc.Distance(name, before, body, point_a=point))
    else:
        scene.add(jc.Distance(name, before, body))


def starts(system: Any, state: jc.State, count: int, seed: int) -> jax.Array:
    """Draws random velocities (count, n_v), projected in the metric M onto the joint rows."""
    random = np.random.default_rng((seed, 1))
    rows = linearize(system, state.q, state.v, state.time)
    j, mass = np.asarray(rows.jacobian.dense()), np.asarray(system.mass(state.q).dense())
    inverse = np.linalg.inv(mass)
    allowed = np.eye(len(mass)) - inverse @ j.T @ np.linalg.pinv(j @ inverse @ j.T, 1e-10) @ j
    return jnp.asarray(random.normal(size=(count, len(mass))) @ allowed.T)


def check(dim: int, seed: int, derivatives: bool = True, method: jc.Method | None = None) -> Found:
    """Runs a scene and returns its failed checks.

    Args:
        dim: dimension of the scene.
        seed: seed of the scene.
        derivatives: True to check derivatives too.
        method: method of the run, by default `jc.Method()`.
    """
    system, state, floats = build(dim, seed)
    method = jc.Method() if method is None else method
    speeds = starts(system, state, 2, seed)
    worlds = [(v, h) for v in speeds for h in SIZES]
    v, h = (jnp.stack([jnp.asarray(w[i], state.q.dtype) for w in worlds]) for i in range(2))

    def run(v: jax.Array, h: jax.Array) -> Any:
        start = dataclasses.replace(state, v=v)

        def record(state: jc.State, _: Any) -> Any:
            energy = jc.energy(system, _at_its_place(system, method, state, h))
            momentum = jc.momentum(system, state), jc.angular_momentum(system, state)
            return energy.total, energy.kinetic, jc.violation(system, state).worst, momentum

        final, path = jc.rollout(system, method, start, None, h, STEPS, record=record, every=20)
        return final, path, jc.energy(system, start).total, record(start, None)[3]

    results = jax.tree.map(np.asarray, jax.jit(jax.vmap(run))(v, h))
    final, (total, kinetic, violation, momentum), first, initial_momentum = results
    scale = np.max(kinetic, axis=1)
    size = 1.0 + float(system.extent(state.q))
    by_world = {
        "status": (final.status, 0.5),
        "energy": ((np.max(total, axis=1) - first) / scale, 0.1),
        "joints": (np.max(violation, axis=1) / size, 1e-2),
    }
    if floats:
        by_world["momentum"] = (_drift(system, momentum[0], initial_momentum[0], scale), 1e-9)
    failed = ~np.all([x <= bound for x, bound in by_world.values()], axis=0)
    # rounding decides how a failing world ends, so the first one that does not fail is compared
    k = int(np.argmin(failed))
    single = jax.jit(run)(v[k], h[k])[0]
    alone = np.nan_to_num(np.abs(single.q - final.q[k]), nan=np.inf)
    others = {"batch": (0.0 if failed[k] else float(np.max(alone)), 1e-6)}
    if derivatives:
        others["derivative"] = (_modes_differ(system, method, state, v[0]), 1e-8)
    wrong = {name: x for name, (x, bound) in others.items() if not x <= bound}
    too_long = np.zeros(len(worlds), bool)
    for i, v_start in enumerate(speeds):
        of_start = np.arange(len(worlds)) // len(SIZES) == i
        if np.any(failed & of_start):
            longest = _longest_step(system, state, v_start)
            too_long |= failed & of_start & (np.asarray(h) > longest)

    def worst(judged: np.ndarray) -> dict[str, float]:
        return {
            name: float(np.max(x[judged]))
            for name, (x, bound) in by_world.items()
            if not np.all(x[judged] <= bound)
        }

    return Found(f"{dim}D, seed {seed}", worst(~too_long) | wrong, worst(too_long))


def _at_its_place(system: Any, method: jc.Method, state: jc.State, h: jax.Array) -> jc.State:
    """Returns the state with v at the time of q.

    Semi-implicit Euler stores v half a step earlier.
    """
    if not isinstance(method.integrator, jc.SemiImplicitEuler):
        return state
    a = jc.forward_dynamics(system, state, None, method, h).acceleration
    return dataclasses.replace(state, v=state.v + h / 2 * a)


def _longest_step(system: Any, state: jc.State, v: jax.Array) -> float:
    """Returns the longest step that resolves a motion [s].

    In such a step no body turns by more than `FAST`, or by more than √λ. λ is the least eigenvalue
    of J Jᵀ for rows of length 1; it vanishes where the joint rows become dependent. Both are
    measured in an accurate simulation, as far as it gets.
    """
    method, h = jc.Method(jc.RK4(), jc.Projection()), ACCURATE_STEP
    start = dataclasses.replace(state, v=jnp.asarray(v, state.v.dtype))
    steps = round(STEPS * SIZES[-1] / h)

    def record(state: jc.State, _: Any) -> jax.Array:
        empty, no_jacobian = jnp.zeros(0), Jacobian((), (0, state.v.size))
        no_rows = Rows(empty, empty, no_jacobian, empty, RowLayout(()))
        square = system.squared_turn(state.q, state.v, state.v, no_rows, jnp.full(1, h))
        rows = linearize(system, state.q, state.v, state.time)
        j = rows.jacobian.dense()
        j /= jnp.linalg.norm(j, axis=1, keepdims=True)
        least = jnp.linalg.eigvalsh(j @ j.T)[0] if j.shape[0] else 1.0
        allowed = jnp.minimum(FAST, jnp.sqrt(jnp.maximum(least, 0)))
        return h * allowed / jnp.sqrt(square)

    run = jax.jit(lambda s: jc.rollout(system, method, s, None, h, steps, record=record, every=5))
    return float(np.min(run(start)[1]))


def _drift(system: Any, momentum: np.ndarray, start: np.ndarray, kinetic: np.ndarray) -> np.ndarray:
    """Returns the largest change of linear momentum of each world, divided by √(2 m T).

    m is the total mass and T the largest kinetic energy.
    """
    mass = float(np.sum(np.asarray([p.mass.sum() for p in system.inertia])))
    change = np.linalg.norm(momentum - start[:, None], axis=-1).max(axis=1)
    return change / np.sqrt(2 * mass * kinetic)


def _modes_differ(system: Any, method: jc.Method, state: jc.State, v: jax.Array) -> float:
    """Returns the relative difference of forward and reverse mode on a rollout.

    It is infinite if a derivative is not finite.
    """

    def loss(v: jax.Array) -> jax.Array:
        start = dataclasses.replace(state, v=v)
        return jnp.sum(jc.rollout(system, method, start, None, 5e-3, 20)[0].q ** 2)

    direction = jnp.ones_like(v)
    forward = jax.jit(lambda v: jax.jvp(loss, (v,), (direction,))[1])(v)
    reverse = jax.jit(jax.grad(loss))(v)
    if not np.all(np.isfinite(reverse)):
        return np.inf
    return float(abs(forward - reverse @ direction) / (1e-12 + np.abs(reverse).sum()))


def study(scenes: int, seed: int = 0) -> Iterator[Found]:
    """Checks scenes in both dimensions. Derivatives are checked in every fourth scene."""
    for i in range(scenes):
        for dim in (2, 3):
            yield check(dim, seed + i, i % 4 == 0)


def main() -> int:
    """Prints the counts of failed checks, and the failing scenes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=40, help="number of scenes per dimension")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    counts: Counter[str] = Counter()
    for result in study(options.scenes, options.seed):
        counts.update(result.wrong)
        counts.update(["too long"] if result.too_long else [])
        if result.wrong or result.too_long:
            print(result.name, result.wrong, "step too long:", result.too_long, flush=True)
    motions = 4 * options.scenes * len(SIZES)
    head = f"tried: {2 * options.scenes} scenes, {motions} motions; wrong: "
    print(head + ", ".join(f"{name} {counts[name]}" for name in CHECKS))
    print(f"scenes with a step too long for the motion: {counts['too long']}")
    return 1 if any(counts[name] for name in CHECKS) else 0


if __name__ == "__main__":
    sys.exit(main())
