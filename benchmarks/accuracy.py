"""Measures constraint violation and position error of a run of one second.

Errors are distances between centers of mass [m]. The reference is a reduced equation where one
exists. Otherwise it is RK4 at a step so small that its own error is negligible. MuJoCo computes
RK4 if the mechanism is a tree of joints. If it has loops, jaxcon does, with `Schur` in float64.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import mechanisms, targets
from benchmarks.equivalence import model_of
from benchmarks.mechanisms import Mechanism, lift
from benchmarks.mjcf import DT

FINE = 1e-4
"""Step size of the reference simulations [s]."""


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of one run.

    Attributes:
        violation: the largest |φ| over all rows and steps, divided by the link length.
        error: the largest error of a center of mass after the last step [m].
        peer: the error of MuJoCo's Euler integrator at the same step size [m], None without MuJoCo.
        healthy: True if no step failed.
    """

    violation: float
    error: float
    peer: float | None
    healthy: bool

    @property
    def counts(self) -> bool:
        """True if the run is accurate enough for its rate to count."""
        close = self.peer is None or self.error <= targets.ERROR * self.peer
        return bool(self.healthy and self.violation < targets.VIOLATION and close)


def measure(name: str, method: jc.Method, dtype: DTypeLike, seconds: float = 1.0) -> Accuracy:
    """Runs a mechanism at the benchmarks' step size and compares it with its reference."""
    mechanism = mechanisms.find(name)
    exact = reference(name, seconds)
    with jax.enable_x64(np.dtype(dtype) == np.float64):
        places, violation, healthy = run(mechanism, method, dtype, DT, seconds)
    peer = None
    if has_mujoco():
        peer = distance(by_mujoco(mechanism, "Euler", DT, seconds), exact)
    return Accuracy(violation / mechanism.link, distance(places, exact), peer, healthy)


def run(
    mechanism: Mechanism, method: jc.Method, dtype: DTypeLike, dt: float, seconds: float
) -> tuple[np.ndarray, float, bool]:
    """Simulates a mechanism.

    Returns:
        The final marker positions (bodies, 3) [m], the largest |φ|, and True if no step failed.
    """
    system, state = mechanism.build(dtype)
    steps = round(seconds / dt)

    def record(state: jc.State, info: jc.extend.StepInfo) -> jax.Array:
        return jc.violation(system, state).worst

    @jax.jit
    def go(state: jc.State) -> Any:
        final, worst = jc.rollout(system, method, state, None, dt, steps, record=record)
        return mechanism.markers(system, final), worst.max(), final.status

    places, worst, status = go(state)
    return lift(places), float(worst), int(status) == jc.Status.OK


def distance(x: np.ndarray, y: np.ndarray) -> float:
    """Returns the largest distance between corresponding points [m]."""
    return float(np.max(np.linalg.norm(x - y, axis=-1)))


@functools.cache
def reference(name: str, seconds: float) -> np.ndarray:
    """Returns reference positions of the markers after `seconds`, (bodies, 3) [m]."""
    mechanism = mechanisms.find(name)
    if mechanism.exact is not None:
        return lift(mechanism.exact(seconds))
    if has_mujoco() and not mechanism.loops:
        return by_mujoco(mechanism, "RK4", FINE, seconds)
    method = jc.Method(integrator=jc.RK4(), solver=jc.solvers.Schur())
    with jax.enable_x64(True):
        return run(mechanism, method, np.float64, FINE, seconds)[0]


def by_mujoco(mechanism: Mechanism, integrator: str, dt: float, seconds: float) -> np.ndarray:
    """Simulates a mechanism in MuJoCo and returns positions of its markers, (bodies, 3) [m]."""
    import mujoco

    model, data = model_of(mechanism)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    model.opt.timestep = dt
    for _ in range(round(seconds / dt)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return data.xpos[[model.body(name).id for name in mechanism.bodies]].copy()


@functools.cache
def has_mujoco() -> bool:
    """Returns True if MuJoCo can be imported."""
    try:
        import mujoco  # noqa: F401
    except ImportError:
        return False
    return True
