"""RATTLE: a second-order variational integrator for constrained systems (chapter 3.7.2)."""

from __future__ import annotations

from functools import partial
from typing import ClassVar

import jax.numpy as jnp

from jaxcon.constraints.rows import linearize, saddle
from jaxcon.core import checks, numerics, status
from jaxcon.core.dependence import depends
from jaxcon.core.pytree import pytree, static
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree
from jaxcon.linear import roots
from jaxcon.linear.roots import Operator
from jaxcon.linear.saddle import Solution
from jaxcon.methods.baumgarte import asks_nothing
from jaxcon.protocols import Integrator, Stabilizer, System
from jaxcon.step import Advanced, Dynamics
from jaxcon.system.state import State


@pytree
class RATTLE(checks.Checked, Integrator):
    """RATTLE: a half kick by the forces, a drift on the constraints, and another half kick.

    V is the velocity during the drift, and F the applied force. The momenta at the start and end of
    the drift are p± = (dexp⁻¹_{±hV})ᵀ M V:

        p₊(V) = M v + (h/2) (F + Jᵀλ),   q⁺ = q ⊕ h V,   φ(q⁺, t + h) = 0,
        M v⁺ = p₋(V) + (h/2) (F⁺ + J⁺ᵀλ⁺),   J⁺ v⁺ + ∂φ⁺/∂t = 0.

    For bodies that turn in space, (dexp⁻¹_{hΩ})ᵀ IΩ = IΩ + (h/2) Ω × IΩ + c h² Ω × (Ω × IΩ), where
    c depends on h|Ω| only. For all other bodies p± = M V. The map from (q, v) to (q⁺, v⁺) derives
    from a discrete Lagrangian. It is therefore symplectic, reversible and of second order, and the
    energy error stays bounded. Momenta that belong to symmetries are conserved, and φ and φ̇ are
    zero, up to rounding. A body must turn by less than one whole turn a step.

    Quasi-Newton iterations find V and λ, with one factorization of [M, −Jᵀ; J, 0] at q. Each
    iteration multiplies the error by about half of the angle by which bodies turn in a step.
    Iterations end when the error is at rounding level. About five suffice for steps of 0.01 rad; a
    step of 1 rad needs all. If forces depend on velocities, fixed-point rounds find F⁺ = F(q⁺, v⁺).
    Each round multiplies the error by a factor proportional to h ∂F/∂v. A world in which iterations
    or rounds do not converge gets the status NOT_CONVERGED. Derivatives are those of the equations,
    by implicit differentiation.

    Both kicks solve for changes of velocity, so that rounding errors have no preferred sign. In
    float32 the energy of a four-bar linkage or a double pendulum fluctuates by at most 1e-4 of its
    scale over 100,000 steps of 1 ms. It does not drift with the number of steps.

    The reported λ belongs to the kick at the start, and the reported a is (v⁺ − v)/h.

    Attributes:
        iterations: the largest number of iterations for V and λ.
        rounds: the largest number of rounds for F⁺; none are needed if no force depends on
            velocities.

    References:
        Andersen, Rattle: a velocity version of the Shake algorithm, J. Comput. Phys. 52 (1983).
        Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), section VII.1.4.
        Marsden, West, Discrete mechanics and variational integrators, Acta Numerica 10 (2001).
    """

    iterations: int = static(default=40)
    rounds: int = static(default=20)
    supports_inequalities: ClassVar[bool] = False
    symmetric: ClassVar[bool] = True
    """True since both ends of a step enter its equations symmetrically."""

    def check(self) -> None:
        """Checks the numbers of iterations and rounds.

        Raises:
            ValueError: a number is not a positive integer.
        """
        checks.count("RATTLE", "iterations", self.iterations)
        checks.count("RATTLE", "rounds", self.rounds)

    def refuses(self, system: System, stabilizer: Stabilizer) -> str | None:
        """Returns why a stabilizer does not work with RATTLE; None if it has no gains."""
        if asks_nothing(stabilizer):
            return None
        return (
            "it keeps positions and velocities on the constraints itself, and a stabilizer would"
            f" undo what it conserves, so that {type(stabilizer).__name__} has no place beside it;"
            " leave the stabilizer out, or take RK4() with it"
        )

    def advance(self, dynamics: Dynamics, state: State, memory: PyTree, dt: Array) -> Advanced:
        """Advances a state by one step of dt [s].

        Raises:
            ValueError: a constraint has velocity-level rows or is a rotor, or the mass depends on
                q.
        """
        system, q, v, h, time = dynamics.system, state.q, state.v, dt[None], state.instant + dt
        rows = linearize(system, q, v, state.instant)
        layout, n = rows.layout, len(v)
        free = [x for x in layout.names if not layout.holonomic[layout.rows(x)].all()]
        if free:
            raise ValueError(
                f"RATTLE: {free} hold velocities and no positions, for which there is no discrete"
                " Lagrangian; take RK4() with Projection(), or SemiImplicitEuler()."
            )
        if layout.inertial:
            raise ValueError(
                f"RATTLE: the rotors {list(layout.inertial)} are inertia in rows, which the drift"
                " does not know; take RK4() with Projection(), or add the inertia to a body."
            )
        if depends(system.mass, q):
            raise ValueError(
                "RATTLE: the mass matrix depends on q, and the kinetic energy must not; take RK4()"
                " with Projection(), or coordinates in which the mass is constant."
            )

        # p₊(V) − M v − Jᵀ Λ = (h/2) F and φ(q ⊕ h V, t + h)/h = 0 for z = (V, Λ), Λ = (h/2) λ
        kick = h / 2 * system.applied(q, v, state.instant, dynamics.control)
        per_step = numerics.safe_divide(jnp.ones_like(h), h)  # before the root: `roots.implicit`
        solve = dynamics.solver.factor(saddle(system, q, rows, kick, rows.rate))
        stopped = status.failed(state.status)
        # the rounding error of φ/h in each world, from that of q; h < 0 in reversed steps
        size = 64 * float(jnp.finfo(q.dtype).eps) * (1 + jnp.max(jnp.abs(q), axis=0))
        rounding = numerics.safe_divide(size, jnp.abs(dt))

        def residual(z: Array) -> Array:
            """Returns the residual of the kick and of φ = 0, (n_v + n_c,); z = (V, Λ), Λ = hλ/2."""
            middle, mass = z[:n], system.mass(q)
            momentum = mass.apply(middle)
            turned = system.carry(q, h * middle, momentum) - momentum
            end = system.retract(q, h * middle)
            φ = linearize(system, end, jnp.zeros_like(middle), time).residual
            # not M V − M v, whose rounding errors add up over many steps
            gain = mass.apply(middle - v) + turned
            balance = gain - rows.jacobian.transpose(z[n:]) - kick
            return jnp.concatenate([balance, φ * per_step])

        def inverse(y: Array) -> Array:
            """Solves K x = y with the quasi-Newton matrix K = [M, −Jᵀ; J, 0]."""
            return jnp.concatenate(solve(y[:n], y[n:])[:2])

        def transposed(y: Array) -> Array:
            """Solves Kᵀ x = y for K = [M, −Jᵀ; J, 0], by Kᵀ = D K D with D = diag(I, −I)."""
            x, multipliers, _ = solve(y[:n], -y[n:])
            return jnp.concatenate([x, -multipliers])

        def iterate(function: Operator, z: Array) -> tuple[Array, Array]:
            """Runs quasi-Newton iterations from z = (V, Λ); returns z and the last change of V."""
            z, change = roots.refine(
                lambda z: inverse(function(z)), z, self.iterations, rounding / 64, n, stopped
            )
            return z, change[:n]

        start = jnp.concatenate([v, jnp.zeros_like(rows.rate)])
        z, change = roots.implicit(
            residual, start, iterate, self.iterations, inverse, transposed, leading=n
        )
        middle = z[:n]
        end, code = self._arrive(dynamics, state, middle, dt)
        code = status.first(solve(jnp.zeros_like(v), jnp.zeros_like(rows.rate)).status, code)
        code = status.first(status.failures(code), _late(change, middle, rounding))
        acceleration = numerics.safe_divide(end - v, h)
        solution = Solution(acceleration, numerics.safe_divide(2 * z[n:], h), code)
        return Advanced((system.retract(q, h * middle), end, time), solution, rows)

    def _arrive(
        self, dynamics: Dynamics, state: State, middle: Array, dt: Array
    ) -> tuple[Array, Array]:
        """Returns the velocity v⁺ at the end of a step, and a status.

        The status is NOT_CONVERGED if φ is not zero there.

        Args:
            dynamics: equations of motion of the step.
            state: state at the start of the step.
            middle: velocity V during the drift, (n_v,).
            dt: step size h, () [s].
        """
        system, h, time = dynamics.system, dt[None], state.instant + dt
        q = system.retract(state.q, h * middle)
        momentum = system.mass(q).apply(middle)
        turned = system.carry(q, -h * middle, momentum) - momentum
        rows = linearize(system, q, middle, time)
        # solve for v⁺ − V: M⁻¹ (M V) has the same rounding error in each step, which adds up
        solve = dynamics.solver.factor(saddle(system, q, rows, turned, -rows.rate))

        def force(v: Array) -> Array:
            return h / 2 * system.applied(q, v, time, dynamics.control)

        def kicked(v: Array) -> Solution:
            change = solve(turned + force(v), -rows.rate)
            return change._replace(acceleration=middle + change.acceleration)

        first = kicked(middle)
        off = jnp.max(jnp.abs(rows.residual), axis=0, initial=0) > numerics.negligible(q)
        late = jnp.where(off, Status.NOT_CONVERGED, Status.OK).astype(jnp.int32)
        code = status.first(status.failures(first.status), late)
        if not depends(force, middle):
            return first.acceleration, code
        v, change = roots.implicit(
            lambda v: v - kicked(v).acceleration,
            first.acceleration,
            partial(roots.refine, rounds=self.rounds, stopped=status.failed(state.status)),
            self.rounds,
        )
        return v, status.first(code, _late(change, v, jnp.zeros_like(change[0])))

    def default_gains(self, dt: Array) -> tuple[Array, Array]:
        """Returns α = β = 0, since the integrator uses no feedback."""
        return 0.0 * dt, 0.0 * dt

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """Returns 0, since the integrator uses no feedback that could be unstable."""
        return 0.0


def _late(change: Array, v: Array, rounding: Array) -> Array:
    """Returns NOT_CONVERGED if the last change of v exceeds a rounding error, else OK.

    Args:
        change: change of v in the last iteration, (n_v,).
        v: velocity, (n_v,).
        rounding: bound on the rounding error of v from other sources than its floating-point
            spacing, ().
    """
    late = jnp.max(jnp.abs(change), axis=0) > numerics.negligible(v) + rounding
    return jnp.where(late, Status.NOT_CONVERGED, Status.OK).astype(jnp.int32)
