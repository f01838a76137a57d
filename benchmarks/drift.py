"""Constraint drift without and with feedback (chapters 3.3.1, 3.3.2).

    python -m benchmarks.drift

Without feedback a perturbation grows linearly, φ = φ₀ + φ̇₀ t, and faster if every step adds its
own truncation error. With feedback the error stays at the truncation error of one step.
"""

import argparse

import jax
import numpy as np

import jaxcon as jc

STABILIZERS = {
    "none": jc.stabilizers.Unstabilized(),
    "critical, 10 /s": jc.Baumgarte.critical(10.0),
    "default": jc.Baumgarte(),
}
INTEGRATORS = {"semi-implicit Euler": jc.SemiImplicitEuler(), "RK4": jc.RK4()}


def pendulum(perturbation: float = 0.0) -> tuple:
    """Builds a pendulum released from the horizontal, with a velocity error along the rod [m/s]."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0), velocity=(perturbation, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


def violation(method: jc.Method, perturbation: float, dt: float, seconds: float) -> np.ndarray:
    """Simulates the pendulum and returns |φ| at ten evenly spaced times, (10,) [m]."""
    system, state = pendulum(perturbation)
    steps = round(seconds / dt / 10) * 10

    def record(state: jc.State, info: jc.extend.StepInfo) -> jax.Array:
        return jc.violation(system, state).worst

    run = jax.jit(
        lambda s: jc.rollout(system, method, s, None, dt, steps, record=record, every=steps // 10)
    )
    return np.asarray(run(state)[1])


def growth(errors: np.ndarray) -> float:
    """Returns the exponent p of the growth |φ| ~ tᵖ, fitted to the last half of the times."""
    times = np.arange(1, len(errors) + 1)
    half = len(errors) // 2
    return float(np.polyfit(np.log(times[half:]), np.log(np.maximum(errors[half:], 1e-300)), 1)[0])


def table(dt: float = 1e-3, seconds: float = 20.0) -> list[tuple[str, str, float, float, float]]:
    """Returns a row for each integrator and stabilizer.

    A row has integrator, stabilizer, final |φ| with and without perturbation [m], and growth
    exponent.
    """
    rows = []
    for name, integrator in INTEGRATORS.items():
        for feedback, stabilizer in STABILIZERS.items():
            method = jc.Method(integrator=integrator, stabilizer=stabilizer)
            perturbed = violation(method, 1e-3, dt, seconds)
            clean = violation(method, 0.0, dt, seconds)
            rows.append((name, feedback, perturbed[-1], clean[-1], growth(clean)))
    return rows


def main() -> None:
    """Prints the table of constraint drift."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dt", type=float, default=1e-3)
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"pendulum, h = {options.dt:g} s, after {options.seconds:g} s, float64")
    heads = "integrator", "feedback", "perturbed", "consistent", "growth"
    print("{:21s} {:17s} {:>11s} {:>11s} {:>7s}".format(*heads))
    for name, feedback, perturbed, clean, exponent in table(options.dt, options.seconds):
        print(f"{name:21s} {feedback:17s} {perturbed:11.2e} {clean:11.2e} {exponent:7.2f}")


if __name__ == "__main__":
    main()
