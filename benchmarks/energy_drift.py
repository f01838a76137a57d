"""Energy of double pendulums with random starts, by method, masses and step.

    python -m benchmarks.energy_drift [--starts 128] [--steps 0.02 0.005] [--seconds 120]
        [--methods default RK4 Projection RATTLE]

A body hangs on a hinge and carries another one: on a hinge in the plane, on a ball joint in space.
The second body is lighter than the first or heavier. No force dissipates, so energy is constant. A
change of energy is judged by its mean over windows of 2.4 s, since v of semi-implicit Euler belongs
half a step before q, which adds an oscillation. It is a share of the largest kinetic energy.

Only starts whose bodies turn by less than 0.3 rad in each step count. The table shows how many of
them gain or lose more than 5 %, the largest gain and loss, and how many starts fail.
"""

import argparse
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc

FASTEST = 0.3
"""The largest rotation of a body in a step [rad] of a start that counts."""
SMALL = 0.05
"""The change of energy, as a share of the largest kinetic energy, that is counted as small."""
WINDOWS = 50
"""The number of windows over which energy is averaged."""
METHODS = {
    "default": jc.Method(),
    "RK4": jc.Method(jc.RK4()),
    "Projection": jc.Method(stabilizer=jc.Projection()),
    "RATTLE": jc.Method(jc.integrators.RATTLE()),
}


@dataclass(frozen=True)
class Pendulum:
    """Two boxes, one below the other.

    Attributes:
        dim: 2 or 3.
        masses: of the upper and the lower box [kg].
        sizes: width, depth and height of both boxes [m].
        axis: axis of the upper hinge in space.
    """

    dim: int
    masses: tuple[float, float]
    sizes: tuple[tuple[float, float, float], tuple[float, float, float]]
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def build(self) -> tuple[Any, jc.State]:
        """Builds the scene, hanging at rest."""
        upper, lower = (size[2] for size in self.sizes)
        down = np.array((0.0, 0.0, -1.0) if self.dim == 3 else (0.0, -1.0))
        scene = jc.Scene(dim=self.dim)
        places = {"upper": upper / 2, "lower": upper + lower / 2}
        for (name, depth), mass, size in zip(places.items(), self.masses, self.sizes, strict=True):
            if self.dim == 2:
                moment = mass * (size[0] ** 2 + size[2] ** 2) / 12
                scene.add_body(name, mass=mass, inertia=moment, position=depth * down)
            else:
                solid = jc.inertia.box(mass, size)
                scene.add_body(name, inertia=solid, position=depth * down)
        top, middle = 0.0 * down, upper * down
        if self.dim == 2:
            scene.add(jc.Revolute("top", jc.WORLD, "upper", point=top))
            scene.add(jc.Revolute("middle", "upper", "lower", point=middle))
        else:
            scene.add(jc.Revolute("top", jc.WORLD, "upper", point=top, axis=self.axis))
            scene.add(jc.Spherical("middle", "upper", "lower", point=middle))
        return scene.build()

    def velocities(self, system: Any, count: int, seed: int = 5) -> jax.Array:
        """Draws initial velocities that the joints allow, (count, n_v)."""
        random, rows = np.random.default_rng(seed), []
        upper, lower = (size[2] for size in self.sizes)
        for _ in range(count):
            fast, v = random.uniform(0.3, 6.0), np.zeros(system.n_v)
            first, second = random.uniform(-4.0, 4.0), fast * random.normal(size=3)
            if self.dim == 2:
                end = np.array((upper * first, 0.0))
                v[system.layout.v("upper")] = [*(end / 2), first]
                v[system.layout.v("lower")] = [end[0] + lower / 2 * second[0], 0.0, second[0]]
            else:
                spin = first * np.array(self.axis)
                end = np.cross(spin, (0.0, 0.0, -upper))
                v[system.layout.v("upper")] = [*(end / 2), *spin]
                reach = np.cross(second, (0.0, 0.0, -lower / 2))
                v[system.layout.v("lower")] = [*(end + reach), *second]
            rows.append(v)
        return jnp.asarray(np.array(rows))


BOXES = ((0.1, 0.2, 0.5), (0.1, 0.15, 0.4))
PENDULUMS = {
    "plane, 1 kg carries 0.5 kg": Pendulum(2, (1.0, 0.5), BOXES),
    "plane, 1 kg carries 3 kg": Pendulum(2, (1.0, 3.0), BOXES),
    "space, 1 kg carries 0.5 kg": Pendulum(3, (1.0, 0.5), BOXES),
    "space, 1 kg carries 3 kg": Pendulum(3, (1.0, 3.0), BOXES),
    "space, 0.3 kg carries 2 kg": Pendulum(
        3, (0.3, 2.0), ((0.05, 0.05, 0.3), (0.3, 0.1, 0.6)), (1.0, 0.0, 0.0)
    ),
}


@dataclass(frozen=True)
class Drift:
    """Changes of energy of many starts, as shares of their largest kinetic energy.

    Attributes:
        starts: the number of starts that count.
        failed: the number of starts that end with a status, of all.
        changed: the number of starts that count with a change above `SMALL`.
        gain: the largest gain.
        loss: the largest loss.
    """

    starts: int
    failed: int
    changed: int
    gain: float
    loss: float


def measure(
    pendulum: Pendulum, method: jc.Method, dt: float, seconds: float = 120.0, starts: int = 128
) -> Drift:
    """Simulates random starts of a pendulum and returns their changes of energy."""
    system, state = pendulum.build()
    steps = WINDOWS * max(1, round(seconds / dt / WINDOWS))

    def run(v: jax.Array) -> tuple[jax.Array, ...]:
        start = jc.init(system, method, state.q, v)

        def seen(state: jc.State, _: Any) -> tuple[jax.Array, ...]:
            energy = jc.energy(system, state)
            turns = [
                jnp.linalg.norm(jnp.atleast_1d(jc.angular_velocity(system, state, name)))
                for name in ("upper", "lower")
            ]
            return energy.total, energy.kinetic, dt * jnp.max(jnp.stack(turns))

        final, (total, kinetic, turns) = jc.rollout(
            system, method, start, None, dt, steps, record=seen
        )
        change = jnp.mean((total - jc.energy(system, start).total).reshape(WINDOWS, -1), axis=1)
        share = change / jnp.max(kinetic)
        return final.status, jnp.max(turns), jnp.max(share), -jnp.min(share)

    speeds = pendulum.velocities(system, starts)
    status, turns, gain, loss = map(np.asarray, jax.jit(jax.vmap(run))(speeds))
    counts = (status == jc.Status.OK) & (turns < FASTEST)
    gains, losses = (np.max(x[counts], initial=0.0) for x in (gain, loss))
    changed = np.sum(np.maximum(gain, loss)[counts] > SMALL)
    failed = np.sum(status != jc.Status.OK)
    return Drift(int(np.sum(counts)), int(failed), int(changed), float(gains), float(losses))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=128)
    parser.add_argument("--steps", type=float, nargs="*", default=[0.02, 0.005])
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--methods", nargs="*", default=[*METHODS], choices=[*METHODS])
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print("| pendulum | h | method | starts | fail | change > 5 % | gain | loss |")
    print("|---|---|---|---|---|---|---|---|")
    for name, pendulum in PENDULUMS.items():
        for dt in options.steps:
            for chosen in options.methods:
                x = measure(pendulum, METHODS[chosen], dt, options.seconds, options.starts)
                print(
                    f"| {name} | {1e3 * dt:g} ms | {chosen} | {x.starts} | {x.failed} |"
                    f" {x.changed} | {x.gain:.1%} | {x.loss:.1%} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
