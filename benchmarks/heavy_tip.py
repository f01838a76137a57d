"""A chain of light links with a tip a million times heavier, released from the horizontal.

    python -m benchmarks.heavy_tip

Ten rods of 1 kg and 1 m hang from a hinge and carry 10⁶ kg. The tension grows to 3·10⁷ N. Under
this tension the links vibrate at up to 10⁴ rad/s. A vibration of 1 mm shortens the chain by a few
µm. Accelerating the tip over this distance changes the tension by as much as the tension itself.

The reference integrates the angles of the links, which need no constraints, by an explicit method
of order eight with a local error of 10⁻⁹.
"""

import argparse
import time
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from scipy.integrate import solve_ivp

import jaxcon as jc

GRAVITY = 9.81
FRAMES = 60
"""Number of times at which a motion is compared with the reference."""


@dataclass(frozen=True)
class Chain:
    """Uniform rods of 1 kg and 1 m with a heavy particle at the end.

    Attributes:
        links: number of links.
        ratio: mass of the tip over that of a link.
        seconds: simulated time [s].
        dim: 2 or 3.
    """

    links: int = 10
    ratio: float = 1e6
    seconds: float = 3.0
    dim: int = 2

    def build(self) -> tuple[Any, jc.State]:
        """Builds the chain along x, at rest."""
        space = self.dim == 3
        down = (0.0, 0.0, -GRAVITY) if space else (0.0, -GRAVITY)
        scene = jc.Scene(dim=self.dim, gravity=down)
        inertia = (1e-3, 1 / 12, 1 / 12) if space else 1 / 12
        axis = {"axis": (0.0, 1.0, 0.0)} if space else {}
        before = jc.WORLD
        for i in range(self.links):
            name, place = f"link_{i}", np.eye(self.dim)[0]
            scene.add_body(name, mass=1.0, inertia=inertia, position=(i + 0.5) * place)
            scene.add(jc.Revolute(f"hinge_{i}", before, name, point=i * place, **axis))
            before = name
        end = self.links * np.eye(self.dim)[0]
        scene.add_particle("tip", mass=self.ratio, position=end)
        scene.add(jc.joints.Coincident("end", before, "tip", point=end))
        return scene.build()

    def reference(self, rtol: float = 1e-9) -> np.ndarray:
        """Returns horizontal and vertical position of the tip at the frames, (FRAMES, 2) [m].

        Solves Σⱼ cᵢⱼ (cos(θᵢ − θⱼ) θ̈ⱼ + sin(θᵢ − θⱼ) θ̇ⱼ²) = −g wᵢ cos θᵢ. Here wᵢ is the mass
        that link i carries, including half its own, and cᵢⱼ the mass that links i and j both carry.
        """
        n = np.arange(self.links)
        load = self.links - 1 - n + 0.5 + self.ratio
        shared_load = load[np.maximum.outer(n, n)]
        shared_load[n, n] += 1 / 3 - 0.5  # the rod's own inertia about its hinge

        def motion(_: float, y: np.ndarray) -> np.ndarray:
            angle, rate = np.split(y, 2)
            difference = angle[:, None] - angle
            force = -(shared_load * np.sin(difference)) @ rate**2 - GRAVITY * load * np.cos(angle)
            return np.concatenate([rate, np.linalg.solve(shared_load * np.cos(difference), force)])

        times = self.seconds * np.arange(1, FRAMES + 1) / FRAMES
        start, span = np.zeros(2 * self.links), (0.0, self.seconds)
        options = {"method": "DOP853", "rtol": rtol, "atol": rtol / 100, "t_eval": times}
        angles = solve_ivp(motion, span, start, **options).y[: self.links]
        return np.stack([np.cos(angles).sum(0), np.sin(angles).sum(0)], axis=1)


@dataclass(frozen=True)
class Run:
    """The result of a method for a chain.

    Attributes:
        status: final status.
        time: time reached [s].
        violation: largest |φ|, divided by the length of the chain.
        energy: largest energy error |E − E₀|, divided by m g l for tip mass m and chain length l.
        error: largest distance of the tip from the reference [m].
        cost: CPU time per simulated second [s].
    """

    status: jc.Status
    time: float
    violation: float
    energy: float
    error: float
    cost: float


def run(chain: Chain, method: jc.Method, dt: float, reference: np.ndarray) -> Run:
    """Simulates the chain and compares it with the reference.

    The step size must divide the time between two frames.
    """
    system, start = chain.build()
    every = round(chain.seconds / FRAMES / dt)
    begin = jc.init(system, method, start.q, start.v)

    def record(state: jc.State, info: jc.extend.StepInfo) -> tuple:
        tip = jc.position(system, state, "tip")
        return tip, jc.violation(system, state).worst, jc.energy(system, state).total

    program = jax.jit(
        lambda s: jc.rollout(
            system, method, s, None, dt, every * FRAMES, record=record, every=every
        )
    )
    program = program.lower(begin).compile()
    clock = time.process_time()
    final, (tip, violation, energy) = jax.block_until_ready(program(begin))
    cost = time.process_time() - clock
    swing = chain.ratio * GRAVITY * chain.links
    energies = np.asarray(energy) - float(jc.energy(system, start).total)
    distances = np.linalg.norm(np.asarray(tip)[:, [0, -1]] - reference, axis=1)
    return Run(
        jc.Status(int(final.status)),
        float(final.time),
        float(np.max(violation)) / chain.links,
        float(np.max(np.abs(energies))) / swing,
        float(np.max(distances)),
        cost / max(float(final.time), dt),
    )


METHODS = {
    "semi-implicit Euler": (jc.Method(), (1e-3, 1e-4)),
    "RK4": (jc.Method(jc.RK4()), (1e-3, 1e-4, 5e-5)),
    "generalized-α": (
        jc.Method(jc.integrators.GeneralizedAlpha()),
        (5e-3, 2.5e-3, 1e-3, 5e-4, 2.5e-4),
    ),
    "generalized-α, ρ = 0.5": (jc.Method(jc.integrators.GeneralizedAlpha(rho=0.5)), (1e-2, 1e-3)),
    "generalized-α, ρ = 0.9, φ̇ free": (
        jc.Method(jc.integrators.GeneralizedAlpha(projects=False)),
        (1e-3,),
    ),
    "generalized-α, ρ = 0.5, φ̇ free": (
        jc.Method(jc.integrators.GeneralizedAlpha(rho=0.5, projects=False)),
        (1e-3,),
    ),
}


def main() -> None:
    """Prints the table of errors by method and step size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--links", type=int, default=10)
    parser.add_argument("--ratio", type=float, default=1e6)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--space", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    dim = 3 if options.space else 2
    chain = Chain(options.links, options.ratio, options.seconds, dim)
    reference = chain.reference()
    print(f"{chain}, float64\n")
    print("| method | h [s] | status | φ / l | energy | tip [m] | CPU s / s |")
    print("|---|---|---|---|---|---|---|")
    for name, (method, steps) in METHODS.items():
        for dt in steps:
            result = run(chain, method, dt, reference)
            held = result.status == jc.Status.OK
            status = "OK" if held else f"{result.status.name} at {result.time:.3f} s"
            cost = f"{result.cost:.2g}" if held else "-"
            print(
                f"| {name} | {dt:g} | {status} | {result.violation:.1e} | {result.energy:.1e}"
                f" | {result.error:.1e} | {cost} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
