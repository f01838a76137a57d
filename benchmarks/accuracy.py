"""How well a run holds its constraints, and how far it is off after one second.

Errors are those of the centres of mass [m], against a reduced equation where there is one, else
against Runge and Kutta of fourth order at a step so small that its own error does not count: by
MuJoCo where the mechanism is a tree of joints there, by jaxcon's `Schur` in float64
where it has loops.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms, targets
from benchmarks.equivalence import model_of
from benchmarks.mechanisms import Mechanism, lift
from benchmarks.mjcf import DT

FINE = 1e-4
"""Step of the references [s]."""


@dataclass(frozen=True)
class Accuracy:
    """Of one run of a second.

    Attributes:
        violation: the worst |φ| of all rows and steps, in link lengths.
        error: of the centre of mass that is furthest off after the last step [m].
        peer: the same of MuJoCo's Euler at the same step, None without MuJoCo [m].
        healthy: whether no step failed.
    """

    violation: float
    error: float
    peer: float | None
    healthy: bool

    @property
    def counts(self) -> bool:
        """Whether the run is accurate enough for its speed to count."""
        close = self.peer is None or self.error <= targets.ERROR * self.peer
        return bool(self.healthy and self.violation < targets.VIOLATION and close)


def measure(name: str, method: jc.Method, dtype: Any, seconds: float = 1.0) -> Accuracy:
    """Runs a mechanism for so long at the step of the benchmarks."""
    mechanism = mechanisms.find(name)
    exact = reference(name, seconds)
    with jax.enable_x64(np.dtype(dtype) == np.float64):
        places, violation, healthy = run(mechanism, method, dtype, DT, seconds)
    peer = None
    if has_mujoco():
        peer = distance(by_mujoco(mechanism, "Euler", DT, seconds), exact)
    return Accuracy(violation / mechanism.link, distance(places, exact), peer, healthy)


def run(
    mechanism: Mechanism, method: jc.Method, dtype: Any, dt: float, seconds: float
) -> tuple[np.ndarray, float, bool]:
    """Where the markers are at the end, the worst violation of all steps, and whether all went."""
    system, state = mechanism.build(dtype)
    steps = round(seconds / dt)

    def record(state: jc.State, info: jc.StepInfo) -> jax.Array:
        return jc.violation(system, state).worst

    @jax.jit
    def go(state: jc.State) -> Any:
        final, worst = jc.rollout(system, method, state, None, dt, steps, record=record)
        return mechanism.markers(system, final), worst.max(), final.status

    places, worst, status = go(state)
    return lift(places), float(worst), int(status) == jc.Status.OK


def distance(x: np.ndarray, y: np.ndarray) -> float:
    """Of the two points that are furthest apart [m]."""
    return float(np.max(np.linalg.norm(x - y, axis=-1)))


@functools.cache
def reference(name: str, seconds: float) -> np.ndarray:
    """Where the markers of a mechanism are after so long, as exactly as is known, (bodies, 3)."""
    mechanism = mechanisms.find(name)
    if mechanism.exact is not None:
        return lift(mechanism.exact(seconds))
    if has_mujoco() and not mechanism.loops:
        return by_mujoco(mechanism, "RK4", FINE, seconds)
    method = jc.Method(integrator=jc.RK4(), solver=jc.Schur())
    with jax.enable_x64(True):
        return run(mechanism, method, np.float64, FINE, seconds)[0]


def by_mujoco(mechanism: Mechanism, integrator: str, dt: float, seconds: float) -> np.ndarray:
    """Where MuJoCo takes the markers, (bodies, 3) [m]."""
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
    """Whether MuJoCo can be imported."""
    try:
        import mujoco  # noqa: F401
    except ImportError:
        return False
    return True
