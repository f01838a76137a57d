"""Random mechanisms under the default method: none may fail, gain energy or drift off its joints.

    python -m benchmarks.random_scenes [--scenes N] [--seed K]

Each scene has two to five bodies, joined as a random tree by random joints, with springs, dampers,
joint limits or a closing rod now and then. Some are free to float, without gravity. Each runs from
random starts at several step sizes, side by side in one batch. Checked, by world:

    status      OK to the end
    energy      never above that at the start by more than a tenth of the largest kinetic energy
    joints      φ below a hundredth of the size of the mechanism
    momentum    of what floats: linear to rounding, angular within (h ω)² of its scale
    batch       the first world alone moves as it does in the batch
    derivative  forward and reverse mode agree, and are finite

Prints a count of each and the scenes that go wrong; ends with 1 where there are any. A scene that
goes wrong is counted apart where a body whips around, by more than half a radian in the longest
step: RATTLE, generalized-α and RK4 with projection then end NOT_CONVERGED.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.constraints.rows import RowLayout, Rows, linearize
from jaxcon.solvers.jacobian import Jacobian

STEPS = 600
"""The number of steps of a motion."""
SIZES = (1e-3, 5e-3, 1 / 60)
"""Step sizes [s]."""
FAST = 0.5
"""Turn of a body in a step [rad] from which no method resolves the motion."""
CHECKS = ("status", "energy", "joints", "momentum", "batch", "derivative")


@dataclass(frozen=True)
class Found:
    """The failed checks of a scene.

    Attributes:
        name: by which it is made again.
        wrong: the checks that it failed, with the worst number of each.
        fast: whether, where it failed some, bodies turn too fast for the longest step.
    """

    name: str
    wrong: dict[str, float]
    fast: bool = False


def build(dim: int, seed: int) -> tuple[Any, jc.State, bool]:
    """A random mechanism, and whether it floats."""
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
    """A random joint halfway between two bodies, or at a place in the world near the body."""
    dim = scene.dim
    other = places[before] if before != jc.WORLD else places[body] + _direction(random, dim)
    point = (other + places[body]) / 2
    kind = random.choice(["hinge", "hinge", "slide", "rod"] + ["ball"] * (dim == 3))
    axis = {} if dim == 2 else {"axis": _direction(random, 3)}
    if kind == "hinge":
        scene.add(jc.Revolute(name, before, body, point=point, **axis))
        if random.random() < 0.3:
            scene.add(jc.JointDamper(f"{name} damper", name, random.uniform(0.01, 0.2)))
        if random.random() < 0.2:
            scene.add(jc.Limit(f"{name} stop", name, -0.5, 0.7))
    elif kind == "slide":
        scene.add(jc.Prismatic(name, before, body, point=point, axis=_direction(random, dim)))
        scene.add(jc.JointSpring(f"{name} spring", name, random.uniform(5, 50)))
    elif kind == "ball":
        scene.add(jc.Spherical(name, before, body, point=point))
    elif before == jc.WORLD:
        scene.add(jc.Distance(name, before, body, point_a=point))
    else:
        scene.add(jc.Distance(name, before, body))


def starts(system: Any, state: jc.State, count: int, seed: int) -> jax.Array:
    """Random velocities, projected in the metric M onto those that joints allow, (count, n_v)."""
    random = np.random.default_rng((seed, 1))
    rows = linearize(system, state.q, state.v, state.time)
    j, mass = np.asarray(rows.jacobian.dense()), np.asarray(system.mass(state.q).dense())
    inverse = np.linalg.inv(mass)
    allowed = np.eye(len(mass)) - inverse @ j.T @ np.linalg.pinv(j @ inverse @ j.T, 1e-10) @ j
    return jnp.asarray(random.normal(size=(count, len(mass))) @ allowed.T)


def check(dim: int, seed: int, derivatives: bool = True, method: jc.Method | None = None) -> Found:
    """Runs a scene, by the default method where none is given, and says what of it is wrong."""
    system, state, floats = build(dim, seed)
    method = jc.Method() if method is None else method
    speeds = starts(system, state, 2, seed)
    worlds = [(v, h) for v in speeds for h in SIZES]
    v, h = (jnp.stack([jnp.asarray(w[i], state.q.dtype) for w in worlds]) for i in range(2))

    def run(v: jax.Array, h: jax.Array) -> Any:
        start = dataclasses.replace(state, v=v)

        def seen(state: jc.State, _: Any) -> Any:
            energy = jc.energy(system, _at_its_place(system, method, state, h))
            moving = jc.momentum(system, state), jc.angular_momentum(system, state)
            return energy.total, energy.kinetic, jc.violation(system, state).worst, moving

        final, path = jc.rollout(system, method, start, None, h, STEPS, record=seen, every=20)
        return final, path, jc.energy(system, start).total, seen(start, None)[3]

    found = jax.tree.map(np.asarray, jax.jit(jax.vmap(run))(v, h))
    final, (total, kinetic, off, moving), first, moved = found
    scale = np.max(kinetic, axis=1)
    gain = (np.max(total, axis=1) - first) / scale
    size = 1.0 + float(system.extent(state.q))
    numbers = {
        "status": (float(np.max(final.status)), 0.5),
        "energy": (float(np.max(gain)), 0.1),
        "joints": (float(np.max(off)) / size, 1e-2),
    }
    if floats:
        numbers["momentum"] = (_drift(system, moving[0], moved[0], scale), 1e-9)
    alone = jax.jit(run)(v[0], h[0])[0]
    numbers["batch"] = (float(np.max(np.abs(alone.q - final.q[0]))), 1e-6)
    if derivatives:
        numbers["derivative"] = (_modes_differ(system, method, state, v[0]), 1e-8)
    wrong = {name: x for name, (x, most) in numbers.items() if not x <= most}
    fast = bool(wrong) and any(_turn(system, state, v) > FAST for v in speeds)
    return Found(f"{dim}D, seed {seed}", wrong, fast)


def _at_its_place(system: Any, method: jc.Method, state: jc.State, h: jax.Array) -> jc.State:
    """The state with the v of its q: that of semi-implicit Euler is half a step behind."""
    if not isinstance(method.integrator, jc.SemiImplicitEuler):
        return state
    a = jc.forward_dynamics(system, state, None, method, h).acceleration
    return dataclasses.replace(state, v=state.v + h / 2 * a)


def _turn(system: Any, state: jc.State, v: jax.Array) -> float:
    """The largest turn of a body in the longest step [rad], of an accurate motion."""
    method, h = jc.Method(jc.RK4(), jc.Projection()), 1e-3
    start = dataclasses.replace(state, v=jnp.asarray(v, state.v.dtype))
    steps = round(STEPS * SIZES[-1] / h)

    def seen(state: jc.State, _: Any) -> jax.Array:
        zero, none = jnp.zeros(0), Jacobian((), (0, state.v.size))
        rows = Rows(zero, zero, none, zero, RowLayout(()))
        return system.squared_turn(state.q, state.v, state.v, rows, jnp.full(1, SIZES[-1]))

    squares = jax.jit(lambda s: jc.rollout(system, method, s, None, h, steps, record=seen)[1])
    return float(np.sqrt(np.max(squares(start))))


def _drift(system: Any, momentum: np.ndarray, start: np.ndarray, kinetic: np.ndarray) -> float:
    """The change of linear momentum, over √(2 m T)."""
    mass = float(np.sum(np.asarray([p.mass.sum() for p in system.inertia])))
    change = np.linalg.norm(momentum - start[:, None], axis=-1).max(axis=1)
    return float(np.max(change / np.sqrt(2 * mass * kinetic)))


def _modes_differ(system: Any, method: jc.Method, state: jc.State, v: jax.Array) -> float:
    """The relative difference of forward and reverse mode on a rollout; inf if not finite."""

    def loss(v: jax.Array) -> jax.Array:
        start = dataclasses.replace(state, v=v)
        return jnp.sum(jc.rollout(system, method, start, None, 5e-3, 20)[0].q ** 2)

    along = jnp.ones_like(v)
    forward = jax.jit(lambda v: jax.jvp(loss, (v,), (along,))[1])(v)
    reverse = jax.jit(jax.grad(loss))(v)
    if not np.all(np.isfinite(reverse)):
        return np.inf
    return float(abs(forward - reverse @ along) / (1e-12 + np.abs(reverse).sum()))


def study(scenes: int, seed: int = 0) -> Iterator[Found]:
    """Checks a number of scenes in each dimension; derivatives of every fourth."""
    for i in range(scenes):
        for dim in (2, 3):
            yield check(dim, seed + i, i % 4 == 0)


def main() -> int:
    """Prints the counts and what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=40, help="in the plane and in space each")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    counts: Counter[str] = Counter()
    for found in study(options.scenes, options.seed):
        counts.update(["too fast"] if found.fast else found.wrong)
        if found.wrong:
            print(found.name, found.wrong, "too fast" * found.fast, flush=True)
    motions = 4 * options.scenes * len(SIZES)
    tried = f"tried: {2 * options.scenes} scenes, {motions} motions; wrong: "
    print(tried + ", ".join(f"{name} {counts[name]}" for name in CHECKS))
    print(f"scenes with bodies that turn by more than {FAST} rad in a step: {counts['too fast']}")
    return 1 if any(counts[name] for name in CHECKS) else 0


if __name__ == "__main__":
    sys.exit(main())
