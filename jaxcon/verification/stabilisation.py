"""Baumgarte feedback: the exact decay of constraint errors, and the largest stable gains."""

from __future__ import annotations

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.protocols import Integrator
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error, relative
from jaxcon.verification.references import column
from jaxcon.verification.sampling import run

INTEGRATORS = {
    "explicit_euler": jc.integrators.ExplicitEuler,
    "semi_implicit_euler": jc.SemiImplicitEuler,
    "rk4": jc.RK4,
}
NORMAL = np.array([2.0, -1.0, 2.0]) / 3.0
STEP = 0.01


def feedback_in_time() -> list[Check]:
    """Checks that constraint errors φ decay by φ̈ + 2α φ̇ + β² φ = 0.

    α and β are the gains. The scene is a pendulum that starts off its circle.

    References:
        Baumgarte, Stabilization of constraints and integrals of motion in dynamical systems (1972).
    """
    data = references.load("an_baumgarte_decay")
    value, rate = data["initial"]["C"], data["initial"]["Cdot"]
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81))
    scene.add_particle("bob", mass=1.0, position=(1.0 + value, 0.0), velocity=(rate, 1.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=1.0))
    system, state = scene.build()

    def decay(alpha: jax.Array, beta: jax.Array) -> tuple[jax.Array, jax.Array]:
        method = jc.Method(integrator=jc.RK4(), stabilizer=jc.Baumgarte(alpha, beta))
        states = run(system, method, state, 5e-4, 200, 10)
        violation = jax.vmap(lambda s: jc.violation(system, s))(states)
        return violation.position[:, 0], violation.velocity[:, 0]

    rows = data["continuous"]
    gains = (jnp.asarray(column(rows, key)) for key in ("alpha", "beta"))
    index = np.rint(column(rows, "t") / 0.1).astype(int)
    phi, phi_rate = (np.asarray(x)[np.arange(len(rows)), index] for x in jax.vmap(decay)(*gains))
    return [
        Check("feedback_in_time", "φ to 1 s", error(phi, column(rows, "C")), 1e-9),
        Check("feedback_in_time", "φ̇ to 1 s", error(phi_rate, column(rows, "Cdot")), 1e-9),
    ]


def plane(particle: jc.extend.Pose, t: jax.Array, normal: jax.Array) -> jax.Array:
    """Returns n · x, the distance of a particle at x from a plane with normal n, (1,) [m]."""
    return jnp.dot(normal, particle.position)[None]


def particle_off_plane() -> tuple[BodySystem, jc.State]:
    """Builds a particle under gravity and a constraint that holds it on an inclined plane."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -9.81))
    scene.add_particle("particle", mass=1.7)
    scene.add(jc.joints.Holonomic(plane, ("particle",), "plane", jnp.asarray(NORMAL)))
    return scene.build()


class Decay:
    """Steps a particle that starts off its plane, and returns its constraint error (φ, φ̇)."""

    def __init__(self, integrator: Integrator) -> None:
        self.integrator = integrator
        self.system, self.start = particle_off_plane()
        self.many = jax.jit(jax.vmap(self.after, (None, 0, 0, 0, None)))

    def after(
        self,
        start: jax.Array,
        alpha: jax.Array,
        beta: jax.Array,
        h: jax.Array,
        steps: int | jax.Array,
    ) -> jax.Array:
        """Returns (φ, φ̇) after a number of steps, which may be traced."""
        return jax.lax.fori_loop(0, steps, lambda _, x: self.once(x, alpha, beta, h), start)

    def once(self, start: jax.Array, alpha: jax.Array, beta: jax.Array, h: jax.Array) -> jax.Array:
        """Returns (φ, φ̇) after one step from the given (φ, φ̇).

        The particle also has a velocity along the plane.
        """
        method = jc.Method(self.integrator, jc.Baumgarte(alpha, beta))
        across = jnp.array([0.5, 1.0, 0.0])
        state = dataclasses.replace(self.start, q=start[0] * NORMAL, v=start[1] * NORMAL + across)
        state, _ = jc.step(self.system, method, state, None, h)
        return jnp.stack([jnp.dot(NORMAL, state.q), jnp.dot(NORMAL, state.v)])

    def matrices(self, *gains: jax.Array) -> np.ndarray:
        """Returns the matrix A of a step (φ, φ̇)⁺ = A (φ, φ̇) for each set of gains, (gains, 2, 2).

        `gains` are α, β and the step size h, (gains,) each.
        """
        columns = [np.asarray(self.many(start, *gains, 1)) for start in jnp.eye(2)]
        return np.stack(columns, axis=-1)


def feedback_in_steps() -> list[Check]:
    """Checks that a step multiplies (φ, φ̇) of a linear constraint by a constant matrix.

    The spectral radius of the matrix is the contraction of the error per step.
    """
    case, data = "feedback_in_steps", references.load("an_baumgarte_decay")
    start = jnp.array([data["initial"]["C"], data["initial"]["Cdot"]])
    checks = []
    for name, integrator in INTEGRATORS.items():
        rows = [row for row in data["discrete"] if row["method"] == name]
        gains = [jnp.asarray(column(rows, key)) for key in ("alpha", "beta", "h")]
        decay = Decay(integrator())
        ends = decay.many(start, *gains, rows[0]["n_steps"])
        expected = np.stack([column(rows, "C"), column(rows, "Cdot")], -1)
        radii = [spectral_radius(m) for m in decay.matrices(*gains)]
        shrink = relative(radii, column(rows, "spectral_radius"))
        checks += [
            Check(case, f"{name}: φ and φ̇ after 100 steps", error(ends, expected), 1e-12),
            Check(case, f"{name}: contraction a step, relative", shrink, 1e-9),
        ]
    return checks


def spectral_radius(m: np.ndarray) -> float:
    """Returns the spectral radius of a (2, 2) matrix m: max |μ| with μ² − (tr m) μ + det m = 0.

    At critical damping the roots coincide. A rounding error ε in the coefficients would separate
    them by √ε, so a discriminant of the size of rounding errors counts as zero.
    """
    half, product = np.trace(m) / 2, np.linalg.det(m)
    apart = half**2 - product
    if abs(apart) < 1e-15:
        return float(abs(half))
    return float(np.sqrt(product) if apart < 0 else abs(half) + np.sqrt(apart))


def critical_limit() -> float:
    """Returns the largest x with |R(−x)| ≤ 1 for the stability polynomial R of `jc.RK4`.

    R(−x) = 1 − x + x²/2 − x³/6 + x⁴/24 = 1 at the real root of 1 = x/2 − x²/6 + x³/24.
    """
    roots = np.roots([1 / 24, -1 / 6, 1 / 2, -1.0])
    return float(roots[np.argmin(np.abs(roots.imag))].real)


def feedback_limits() -> list[Check]:
    """Checks the largest stable rate of critically damped feedback for three integrators.

    For a step size h, the limits of h·rate are 2 for explicit Euler, 2√2 − 2 for semi-implicit
    Euler and 2.7853 for RK4. Errors decay just below a limit and grow just above it. The library
    must warn just above a limit and not just below it.
    """
    case, checks = "feedback_limits", []
    limits = (2.0, 2 * np.sqrt(2) - 2, critical_limit())
    for (name, integrator), limit in zip(INTEGRATORS.items(), limits, strict=True):
        rate = jc.stabilizers.largest_stable_rate(integrator(), STEP) * STEP
        checks.append(Check(case, f"{name}: limit of h·rate", abs(rate - limit), 1e-9))
        rates = jnp.array([0.999, 1.001]) * (limit / STEP)
        start, step = jnp.array([1e-3, 0.0]), jnp.full(2, STEP)
        below, above = Decay(integrator()).many(start, rates, rates, step, 10000)
        fall = float(np.abs(below[0])) / 1e-3
        growth = 1e-3 / float(np.abs(above[0]))
        checks += [
            Check(case, f"{name}: φ/φ₀ just below the limit", fall, 0.1),
            Check(case, f"{name}: φ₀/φ just above the limit", growth, 0.1),
        ]
        missed = [warns(integrator(), limit * x / STEP) - (x > 1) for x in (1 - 1e-6, 1 + 1e-6)]
        figure = f"{name}: wrong warnings a millionth to each side"
        checks.append(Check(case, figure, float(np.sum(np.abs(missed))), 0.0))
    printed = abs(jc.stabilizers.largest_stable_rate(jc.RK4(), STEP) * STEP - 2.785)
    return [*checks, Check(case, "rk4: limit as printed, 2.785", printed, 5e-4)]


def warns(integrator: Integrator, rate: float) -> bool:
    """Returns True if a step with critical damping at this rate warns of instability."""
    system, state = particle_off_plane()
    method = jc.Method(integrator, jc.Baumgarte.critical(rate))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        jax.eval_shape(lambda s: jc.step(system, method, s, None, STEP), state)
    return any("unstable" in str(warning.message) for warning in caught)
