"""RATTLE: a variational integrator of second order with constraints (chapter 3.7.2)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from jaxcon.constraints.rows import RowLayout, Rows, linearize
from jaxcon.core import checks, numerics, status
from jaxcon.core.dependence import depends
from jaxcon.core.pytree import pytree, static
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree
from jaxcon.dynamics.forward import Dynamics, saddle
from jaxcon.model.state import State
from jaxcon.simulation.integrators import Advanced
from jaxcon.solvers import roots
from jaxcon.solvers.roots import Operator
from jaxcon.solvers.saddle import Factored, Solution
from jaxcon.stabilization.baumgarte import asks_nothing


@pytree
class RATTLE(checks.Checked):
    """Kicks by half of the forces, a drift on the constraints, and half of the forces there.

    With V the velocity between the two ends, p_φ± = (dexp⁻¹_{±hV})ᵀ M V and F applied forces,

        p₊(V) = M v + (h/2) (F + Jᵀλ),   q⁺ = q ⊕ h V,   φ(q⁺, t + h) = 0,
        M v⁺ = p₋(V) + (h/2) (F⁺ + J⁺ᵀλ⁺),   J⁺ v⁺ + ∂φ⁺/∂t = 0.

    (dexp⁻¹_{hΩ})ᵀ IΩ = IΩ + (h/2) Ω × IΩ + c h² Ω × (Ω × IΩ), and M V for all that does not turn
    in space: the map from (q, v) to (q⁺, v⁺) is that of a discrete Lagrangian. So it is symplectic,
    reversible and of second order, its energy stays bounded, momenta belonging to symmetries are
    kept to rounding, and so are both levels of the constraints. A body may turn by less than one
    whole turn a step.

    V and λ are found together by iterations that share one factorization of [M, −Jᵀ; J, 0] at q;
    each multiplies the error by about half of the angle by which bodies turn in a step, and they
    end where only rounding is left: some five are enough at a hundredth of a radian, all are needed
    at one. Where forces depend on velocities, F⁺ = F(q⁺, v⁺) is found by fixed-point rounds, each
    of which reduces the error in proportion to h ∂F/∂v. Worlds in which either is not done are
    NOT_CONVERGED. Derivatives are those of the equations, whatever was done to solve them.

    Both kicks are solved for changes of velocity, so that rounding has no preferred sign. In
    float32 the energy of a four-bar linkage or a double pendulum wanders by at most 1e-4 of its
    scale in 100,000 steps of 1 ms, and does not drift with the number of steps.

    λ in the solution is that of the kick at the start, and a = (v⁺ − v)/h.

    Attributes:
        iterations: for V and λ, at most.
        rounds: for F⁺, at most; none are spent where no force depends on velocities.

    References:
        Andersen, Rattle: a velocity version of the Shake algorithm, J. Comput. Phys. 52 (1983).
        Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), section VII.1.4.
        Marsden, West, Discrete mechanics and variational integrators, Acta Numerica 10 (2001).
    """

    iterations: int = static(default=40)
    rounds: int = static(default=20)

    @property
    def symmetric(self) -> bool:
        """Returns True where a step by −h undoes one by h: both ends enter the equations alike."""
        return True

    def init(self, system: Any, q: Array, v: Array) -> PyTree:
        """No memory."""
        return ()

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: there are no iterations or rounds.
        """
        checks.count("RATTLE", "iterations", self.iterations)
        checks.count("RATTLE", "rounds", self.rounds)

    def refuses(self, system: Any, stabilizer: Any) -> str | None:
        """Feedback and projection: the step keeps both levels of the constraints itself."""
        if asks_nothing(stabilizer):
            return None
        return (
            "it keeps positions and velocities on the constraints itself, and a stabilizer would"
            f" undo what it conserves, so that {type(stabilizer).__name__} has no place beside it;"
            " leave the stabilizer out, or take RK4() with it"
        )

    def advance(self, dynamics: Dynamics, state: State, memory: PyTree, dt: Any) -> Advanced:
        """One step."""
        system, q, v, h = dynamics.system, state.q, state.v, dt[None]
        rows = linearize(system, q, v, state.instant)
        _check_rows(rows.layout)
        if depends(system.mass, q):
            raise ValueError(
                "RATTLE: the mass matrix depends on q, and the kinetic energy must not; take RK4()"
                " with Projection(), or coordinates in which the mass is constant."
            )
        kick = h / 2 * system.applied(q, v, state.instant, dynamics.control)
        drift = _Drift(dynamics, state, rows, kick, dt)
        start = jnp.concatenate([v, jnp.zeros_like(rows.rate)])
        between, moved = roots.implicit(
            drift.residual,
            start,
            drift.iterate(self.iterations, status.failed(state.status)),
            *drift.inverses(self.iterations),
            leading=len(v),
        )
        middle, pull = between[: len(v)], between[len(v) :]
        end, code = self._arrive(dynamics, state, middle, dt)
        code = status.first(drift.solve(*_no_load(rows, v)).status, code)
        code = status.first(status.failures(code), _late(moved, middle, _rounding(q, dt)))
        q = system.retract(q, h * middle)
        acceleration = numerics.safe_divide(end - v, h)
        solution = Solution(acceleration, numerics.safe_divide(2 * pull, h), code)
        return Advanced((q, end, state.instant + dt), solution, rows)

    def _arrive(
        self, dynamics: Dynamics, state: State, middle: Array, dt: Any
    ) -> tuple[Array, Array]:
        """v⁺ from V, and a status."""
        system, h, time = dynamics.system, dt[None], state.instant + dt
        q = system.retract(state.q, h * middle)
        momentum = system.mass(q).apply(middle)
        turned = system.carry(q, -h * middle, momentum) - momentum
        rows = linearize(system, q, middle, time)
        # for v⁺ − V: in M⁻¹ (M V) the rounding of M⁻¹ would be the same in each step, and add up
        solve = dynamics.solver.factor(saddle(system, q, rows, turned, -rows.rate))

        def force(v: Array) -> Array:
            return h / 2 * system.applied(q, v, time, dynamics.control)

        def kicked(v: Array) -> Solution:
            change = solve(turned + force(v), -rows.rate)
            return change._replace(acceleration=middle + change.acceleration)

        first = kicked(middle)
        code = status.first(status.failures(first.status), _off(rows, q))
        if not depends(force, middle):
            return first.acceleration, code

        def iterate(function: Operator, v: Array) -> tuple[Array, Array]:
            return roots.settle(function, v, self.rounds, stopped=status.failed(state.status))

        def residual(v: Array) -> Array:
            return v - kicked(v).acceleration

        v, moved = roots.implicit(residual, first.acceleration, iterate, self.rounds)
        return v, status.first(code, _late(moved, v, jnp.zeros_like(moved[0])))

    def default_gains(self, dt: Any) -> tuple[Any, Any]:
        """None: there is nothing to feed back."""
        return 0.0 * dt, 0.0 * dt

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """0: there is no feedback that could be unstable."""
        return 0.0


class _Drift:
    """p₊(V) − M v − Jᵀ Λ = (h/2) F and φ(q ⊕ h V, t + h)/h = 0 for z = (V, Λ), Λ = (h/2) λ."""

    def __init__(self, dynamics: Dynamics, state: State, rows: Rows, kick: Array, dt: Any) -> None:
        self.system, self.rows, self.kick = dynamics.system, rows, kick
        self.q, self.v = state.q, state.v
        self.h, self.time = dt[None], state.instant + dt
        # made before the root, see `roots.implicit`
        self.per_step = numerics.safe_divide(jnp.ones_like(self.h), self.h)
        problem = saddle(self.system, self.q, rows, kick, rows.rate)
        self.solve: Factored = dynamics.solver.factor(problem)

    def residual(self, z: Array) -> Array:
        """What both equations leave, (n_v + n_c,)."""
        n = len(self.kick)
        v, pull = z[:n], z[n:]
        step, system = self.h * v, self.system
        mass = system.mass(self.q)
        momentum = mass.apply(v)
        turned = system.carry(self.q, step, momentum) - momentum
        moved = system.retract(self.q, step)
        φ = linearize(system, moved, jnp.zeros_like(v), self.time).residual
        # not M V − M v, whose rounding adds up over many steps
        gain = mass.apply(v - self.v) + turned
        balance = gain - self.rows.jacobian.transpose(pull) - self.kick
        return jnp.concatenate([balance, φ * self.per_step])

    def iterate(self, iterations: int, stopped: Array) -> Any:
        """Quasi-Newton from a start: z, and by how much V changed at last."""
        inverse, n = self.inverses(0)[1], len(self.kick)
        rounding = _rounding(self.q, self.h[0]) / 64

        def iterate(function: Operator, z: Array) -> tuple[Array, Array]:
            z, moved = roots.settle(
                lambda z: inverse(function(z)), z, iterations, rounding, n, stopped
            )
            return z, moved[:n]

        return iterate

    def inverses(self, rounds: int) -> tuple[int, Any, Any]:
        """The rounds, y → K⁻¹ y and y → K⁻ᵀ y with K = [M, −Jᵀ; J, 0] and Kᵀ = D K D, D = ±1."""
        n = len(self.kick)

        def inverse(y: Array) -> Array:
            return jnp.concatenate(self.solve(y[:n], y[n:])[:2])

        def transposed(y: Array) -> Array:
            x, pull, _ = self.solve(y[:n], -y[n:])
            return jnp.concatenate([x, -pull])

        return rounds, inverse, transposed


def _no_load(rows: Rows, v: Array) -> tuple[Array, Array]:
    """f = 0 and b = 0."""
    return jnp.zeros_like(v), jnp.zeros_like(rows.rate)


def _off(rows: Rows, q: Array) -> Array:
    """NOT_CONVERGED where φ does not vanish, as with constraints that contradict each other."""
    off = jnp.max(jnp.abs(rows.residual), axis=0, initial=0) > numerics.negligible(q)
    return jnp.where(off, Status.NOT_CONVERGED, Status.OK).astype(jnp.int32)


def _rounding(q: Array, dt: Any) -> Array:
    """What the rounding of q makes of φ/h, by world; h < 0 on the way back."""
    eps = float(jnp.finfo(q.dtype).eps)
    return numerics.safe_divide(64 * eps * (1 + jnp.max(jnp.abs(q), axis=0)), jnp.abs(dt))


def _late(moved: Array, v: Array, rounding: Array) -> Array:
    """NOT_CONVERGED where v still changed at last by more than rounding makes of it."""
    late = jnp.max(jnp.abs(moved), axis=0) > numerics.negligible(v) + rounding
    return jnp.where(late, Status.NOT_CONVERGED, Status.OK).astype(jnp.int32)


def _check_rows(layout: RowLayout) -> None:
    """Checks that every row is a hard one of positions.

    Raises:
        ValueError: names the constraints of which some rows are not.
    """
    free = [n for n in layout.names if not layout.holonomic[layout.rows(n)].all()]
    if free:
        raise ValueError(
            f"RATTLE: {free} hold velocities and no positions, for which there is no discrete"
            " Lagrangian; take RK4() with Projection(), or SemiImplicitEuler()."
        )
    if layout.inertial:
        raise ValueError(
            f"RATTLE: the rotors {list(layout.inertial)} are inertia in rows, which the drift does"
            " not know; take RK4() with Projection(), or add the inertia to a body."
        )
