"""Projection of q and v onto the constraints after a step (chapter 3.4)."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Rows, linearize, saddle
from jaxcon.core import checks, numerics, status
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree
from jaxcon.linear import roots
from jaxcon.linear.saddle import Diagonal, Saddle
from jaxcon.methods.gains import check_numbers, column
from jaxcon.protocols import Bodies, Solver, Stabilizer, System
from jaxcon.staging.worlds import where_tree
from jaxcon.system.state import State

METRICS = ("mass", "euclidean")

SMALL = 1e-3
"""The energy of a velocity correction below which the correction turns with the bodies.

It is given as a fraction of the kinetic energy of the motion.
"""


@pytree
class Tolerance(checks.Checked):
    """An allowed |φ| that grows with speed and force: ε = ε₀ (1 + α ‖v‖ + β ‖F‖).

    ‖·‖ is the Euclidean norm over all entries of v and of the generalized force F without control.

    Attributes:
        base: tolerance ε₀ at rest without forces [unit of φ].
        speed: factor α of the speed; None for no such term.
        force: factor β of the force; None for no such term.
    """

    base: Any
    speed: Any = None
    force: Any = None

    def check(self) -> None:
        """Checks that the three fields are non-negative numbers.

        Raises:
            ValueError: a field is negative or not a number.
        """
        check_numbers(
            self,
            base={"least": 0},
            speed={"least": 0, "optional": True},
            force={"least": 0, "optional": True},
        )

    def at(self, system: System, state: State) -> Array:
        """Returns the tolerance ε of each world, ()."""
        scale, dtype = jnp.ones_like(state.q[0]), state.q.dtype
        if self.speed is not None:
            scale = scale + jnp.asarray(self.speed, dtype) * numerics.norm(state.v)
        if self.force is not None:
            force = system.force(state.q, state.v, state.instant)
            scale = scale + jnp.asarray(self.force, dtype) * numerics.norm(force)
        return jnp.asarray(self.base, dtype) * scale


@pytree
class Projection(checks.Checked, Stabilizer):
    """Projects q and then v onto the constraints after each step; within a step b = −γ.

    q* and v* are the values at the end of the step, and W is the metric. Positions are projected
    first: q = q* ⊕ d with d = W⁻¹ J₀ᵀ μ and φ(q, t) = 0. All iterations use the same J₀, and so one
    factorization of J₀ W⁻¹ J₀ᵀ. The root does not depend on the iterations. Velocities are
    projected next, at the new q: v = v* + W⁻¹ Jᵀ μ with J v + ∂φ/∂t = 0 is the smallest change in
    the metric. The opposite order would leave J v = −J d/h.

    If `coupled`, J₀ is the Jacobian at the start of the step, and d/h is added to v before v is
    projected: W⁻¹ J₀ᵀ μ/h is the missing part of the constraint forces of the step. Semi-implicit
    Euler then becomes the symplectic Euler method for constrained particles and plane bodies, and
    energy stays near its initial value. Without coupling, energy would grow in proportion to h.
    Runge–Kutta methods keep their order either way. If φ is violated before the step, the forces of
    the step are not the cause. Therefore d/h is multiplied by 1/(1 + r²) with r = T(d/h)/T(v*); T
    is the kinetic energy in the metric. The ratio r is O(h²) if the step starts on the constraints,
    and large if it starts far from them.

    If not `coupled`, J₀ is the Jacobian at q*. Then q differs from the nearest point in the metric
    W by O(‖d‖²) along the constraint surface.

    Redundant rows are linearly dependent only if q lies on the constraint surface. Elsewhere J(q*)
    has a larger rank, so the projected point is ambiguous within O(‖d‖), and the solver determines
    it.

    For bodies that turn in space, the torques J₀ᵀ μ are given in the body frames at the start of
    the step and turn with the bodies. With semi-implicit Euler and default options, a top may spin
    by 3 rad a step. The energy of two boxes on a hinge and a ball joint is then conserved as well
    as with `Baumgarte()`. This does not hold with other options, or inside `Hybrid` or
    `AugmentedLagrangian`.

    Velocity-level rows enter the projection of v only. Rotors add inertia to the mass metric. The
    derivative is that of the root, by implicit differentiation.

    Attributes:
        metric: the metric W: "mass" for M with rotors, or "euclidean" for the identity [m, rad],
            with which heavy bodies move as much as light ones. In float32, after many turns of an
            angle in the plane, "euclidean" leaves a smaller error: it moves positions, whose
            floating-point spacing is finer.
        iterations: the largest number of quasi-Newton iterations d ← d − factor · S φ(q* ⊕ d),
            where S b is the smallest step with J₀ d = b. They end when the error is at rounding
            level. Each iteration multiplies the error by about the distance of q* from the
            configuration of J₀, relative to the size of the scene. About six suffice after a step
            of 0.01 rad; a step of 1 rad needs all. One iteration is the linearized projection,
            which leaves an error of O(‖d‖²) and is differentiated as computed.
        tolerance: the allowed max |φ|, a number or a `Tolerance`. Iterations of a world stop at
            this tolerance; the status is NOT_CONVERGED if it is exceeded at the end. If None,
            iterations stop at 2 ε (1 + max |x|) over all positions x, and the status is
            NOT_CONVERGED above ε^⅔ (1 + max |q|), where ε is the spacing of floating-point numbers.
            The linearized projection fails only if its solver fails.
        factor: damping factor of each iteration, in (0, 1].
        every: the number of steps from one projection to the next.
        coupled: True to add d/h to v. Has an effect only if both q and v are projected.
        position: True to project q.
        velocity: True to project v.

    References:
        Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), sections IV.4 and VII.1.3.
        Ascher, Chin, Reich, Stabilization of DAEs and invariant manifolds (1994).
    """

    metric: str = static(default="mass")
    iterations: int = static(default=40)
    tolerance: Any = None
    factor: Any = 1.0
    every: int = static(default=1)
    coupled: bool = static(default=True)
    position: bool = static(default=True)
    velocity: bool = static(default=True)

    def check(self) -> None:
        """Checks the options of the projection.

        Raises:
            ValueError: an option does not exist, or a number is out of range.
        """
        if self.metric not in METRICS:
            raise ValueError(f"Projection: metric must be one of {METRICS}, got {self.metric!r}.")
        checks.count("Projection", "iterations", self.iterations)
        checks.count("Projection", "every", self.every)
        for what in ("coupled", "position", "velocity"):
            checks.flag("Projection", what, getattr(self, what))
        check_numbers(self, factor={"above": 0, "most": 1})
        if isinstance(self.tolerance, Tolerance):
            self.tolerance.check()
        else:
            check_numbers(self, tolerance={"least": 0, "optional": True})

    def constraint_equations(self, rows: Rows, memory: PyTree, dt: Array) -> Rows:
        """Returns the rows with the target b = −γ of J a + C λ = b, where φ̈ = J a + γ."""
        return rows.with_target(-rows.bias)

    def init(self, system: System, q: Array, v: Array) -> Array | tuple[()]:
        """Returns the count of steps since the last projection, 0; () if each step is projected."""
        return () if self.every == 1 else jnp.zeros((), jnp.int32)

    def advance(self, rows: Rows, memory: Array, dt: Array) -> Array:
        """Returns the count of steps after one more step, modulo `every`.

        At 0 a projection is due. There is no count if every step is projected.
        """
        return memory if self.every == 1 else (memory + 1) % self.every

    @property
    def corrects(self) -> tuple[str, ...]:
        """The projected levels: "position", "velocity", both or none."""
        return ("position",) * self.position + ("velocity",) * self.velocity

    @property
    def completes(self) -> bool:
        """True if each step projects q and v, and `coupled` is set.

        The displacement of q, divided by h, is then added to v.
        """
        return self.every == 1 and self.coupled and self.position and self.velocity

    @property
    def remembers(self) -> bool:
        """True if not every step is projected, so that the memory counts steps."""
        return self.every != 1

    def correct(
        self,
        system: System,
        solver: Solver,
        before: State,
        state: State,
        memory: Array,
        dt: Array,
    ) -> tuple[State, Array]:
        """Returns the projected state if a projection is due in this step, and a status."""
        if self.every == 1:
            return self.project(system, solver, before, state, dt)
        due, still = memory == 0, (state.q, state.v, jnp.zeros_like(state.status))

        def projected() -> tuple[Array, Array, Array]:
            new, code = self.project(system, solver, before, state, dt)
            return new.q, new.v, code

        moved = jax.lax.cond(somewhere(due), projected, lambda: still)
        q, v, code = where_tree(due, moved, still)
        return dataclasses.replace(state, q=q, v=v), code

    def project(
        self, system: System, solver: Solver, before: State, state: State, dt: Array
    ) -> tuple[State, Array]:
        """Returns the projected state and a status: a failure of the solver, or NOT_CONVERGED."""
        code = jnp.zeros_like(state.status)
        if self.position:
            start = state
            if self.coupled and self.velocity and before is not state:
                start = dataclasses.replace(before, q=system.normalize(before.q))
            q, v, code = self._positions(system, solver, start, state, dt)
            state = dataclasses.replace(state, q=q, v=v)
        if not self.velocity:
            return state, code
        rows = linearize(system, state.q, state.v, state.instant)
        if not rows.layout.size:
            return state, code
        problem = self._problem(system, state.q, rows, rows.layout.holds)
        change, _, late = solver.factor(problem)(problem.force, -rows.rate)
        code = status.first(code, status.failures(late))
        return dataclasses.replace(state, v=state.v + change), code

    def _positions(
        self, system: System, solver: Solver, start: State, state: State, dt: Array
    ) -> tuple[Array, Array, Array]:
        """Returns q with φ(q, t) = 0, the corrected v, and a status.

        Args:
            system: system of the states.
            solver: solver of the method.
            start: state at which J₀ is evaluated: the start of the step if coupled, else `state`
                itself.
            state: state with q* and v* at the end of the step.
            dt: step size h, () [s].
        """
        q, v, h, still = state.q, state.v, dt[None], jnp.zeros_like(state.v)
        rows = linearize(system, start.q, still, start.instant)
        held = rows.layout.holonomic & rows.layout.holds
        if not held.any():
            return q, v, jnp.zeros_like(state.status)
        problem = self._problem(system, start.q, rows, held)
        mass, coupled = problem.mass, start is not state
        turns = coupled and system.turns_in_space
        bodies = cast(Bodies, system)
        φ = rows.residual
        if coupled:
            φ = linearize(system, q, still, state.instant).residual
        factor = jnp.asarray(self.factor, φ.dtype)[None]
        solve = partial(solver.factor(problem), still)
        stays, fails = self._bounds(system, state)

        # The torques of J₀ᵀ μ are given in the body frames at the start of the step. Bodies turn by
        # h ω in the step, and by half of it until its middle, where W⁻¹ must be evaluated.
        def turned(d: Array, step: Array) -> Array:
            """Returns W⁻¹ J₀ᵀ μ, (n_v,), after the bodies have turned by `step`.

            Args:
                d: W⁻¹ J₀ᵀ μ before the turn, (n_v,).
                step: displacement h v whose rotations turn the bodies, (n_v,).
            """
            return mass.solve(bodies.in_turned_frames(q, step, mass.apply(d)))

        def moved(d: Array) -> Array:
            """Returns the projected positions q* ⊕ d, (n_q,)."""
            if turns:
                d = bodies.in_turned_frames(q, h / 2 * v, turned(d, h / 2 * v))
            return system.retract(q, d)

        def residual(d: Array) -> Array:
            """Returns the constraint errors φ(q* ⊕ d), (n_c,)."""
            return linearize(system, moved(d), jnp.zeros_like(d), state.instant).residual

        def largest(x: Array) -> Array:
            return jnp.max(jnp.abs(x), axis=0, initial=0)

        def goes(left: Array, before: Array) -> Array:
            """Returns True for each world whose iteration must go on, ().

            Its error is above the tolerance `stays`, and it either decreases or is above `fails`.
            """
            off = (left > stays) & ((left < before) | (left > fails))
            return off & ~status.failed(state.status)

        def iterate(function: roots.Operator, d: Array) -> tuple[Array, tuple[Array, Array]]:
            def wanted(carry: tuple[Array, ...]) -> Array:
                count, _, left, before, _ = carry
                going = somewhere(goes(largest(left), before))
                # the first iteration tells if the factorization has failed
                return (count < self.iterations) & (going | (count == 0))

            def once(carry: tuple[Array, ...]) -> tuple[Array, ...]:
                count, d, left, before, code = carry
                most = largest(left)
                solution = solve(left)
                d = jnp.where(goes(most, before)[None], d - factor * solution.acceleration, d)
                # `left` decides if the iterations have converged
                missed = solution.status == Status.NOT_CONVERGED
                found = jnp.where(missed, Status.OK, status.failures(solution.status))
                code = status.first(code, found.astype(code.dtype))
                return count + 1, d, residual(d), most, code

            none = jnp.zeros_like(state.status)
            first = (jnp.zeros((), jnp.int32), d, φ, largest(φ) + jnp.inf, none)
            _, d, left, _, code = jax.lax.while_loop(wanted, once, first)
            # `custom_root` has no derivatives of integers
            return d, (left, code.astype(left.dtype))

        def equation(d: Array) -> Array:
            """Returns the residual d − S (J₀ d − φ(q* ⊕ d)) of a displacement d from q*.

            S b is the smallest d with J₀ d = b. At a root, d lies in the range of S, and
            S φ(q* ⊕ d) = 0. The derivative of the residual is close to the identity.
            """
            linear = jnp.where(column(held, rows), problem.jacobian.apply(d), 0)
            return d - solve(linear - residual(d)).acceleration

        if self.iterations == 1:
            d, _, code = solve(φ)
            d = -factor * d
            # if φ is at rounding level, redundant rows may seem contradictory: not a failure
            there = largest(φ) <= stays
            met = there & (code == Status.NOT_CONVERGED)
            none = jnp.where(met[None], d - jax.lax.stop_gradient(d), 0)  # zero with a derivative
            d = jnp.where((there & status.failed(code))[None], none, d)
            left = φ if self.tolerance is None else residual(d)
            code = jnp.where(met, Status.OK, code)
        else:
            d, (left, code) = roots.implicit(equation, still, iterate, self.iterations)
            code = code.astype(jnp.int32)
        late = jnp.where(largest(left) > fails, Status.NOT_CONVERGED, Status.OK)
        code = status.first(status.failures(code), late.astype(jnp.int32))
        if not coupled:
            return moved(d), v, code

        # the weight of d/h is near 1 only if its kinetic energy is small beside that of v
        gain = numerics.safe_divide(d, h)
        energy, present = (jnp.sum(x * mass.apply(x), axis=0) for x in (gain, v))
        scale = jax.lax.stop_gradient(jnp.maximum(energy, present))
        energy, present = (numerics.safe_divide(x, scale) for x in (energy, present))
        if turns:
            # A larger d/h comes from a start with φ̇ ≠ 0. It must not turn with the bodies, since
            # the free rotation depends on d/h and undoes most of that rotation.
            share = numerics.safe_divide(present**2, present**2 + (energy / SMALL) ** 2)
            end = numerics.safe_divide(turned(d, h * v), h)
            gain = gain + share[None] * (end - gain)
        weight = numerics.safe_divide(present**2, present**2 + energy**2)
        return moved(d), v + gain * weight[None], code

    def _problem(self, system: System, q: Array, rows: Rows, held: np.ndarray) -> Saddle:
        """Returns the saddle system W d = Jᵀ μ, J d = b of the projected rows.

        Args:
            system: system with the mass matrix.
            q: positions, (n_q,).
            rows: constraints linearized at q. Rows of rotors are added if W is the mass metric.
            held: mask of the projected rows, (n_c,).
        """
        still = jnp.zeros((rows.jacobian.shape[1], *q.shape[1:]), q.dtype)
        massive = self.metric == "mass"
        rows = rows.only(held | ~rows.layout.holds if massive else held)
        problem = saddle(system, q, rows, still, jnp.zeros_like(rows.bias))
        return problem if massive else dataclasses.replace(problem, mass=Diagonal(still + 1))

    def _bounds(self, system: System, state: State) -> tuple[Array, Array]:
        """Returns the tolerances on max |φ| for stopping and for failure, () each."""
        state = jax.lax.stop_gradient(state)
        if self.tolerance is not None:
            given = self.tolerance
            given = given if isinstance(given, Tolerance) else Tolerance(given)
            bound = given.at(jax.lax.stop_gradient(system), state)
            return bound, bound
        fails = numerics.negligible(state.q)
        fails = jnp.full_like(fails, jnp.inf) if self.iterations == 1 else fails
        return 2 * float(jnp.finfo(fails.dtype).eps) * (1 + system.extent(state.q)), fails
