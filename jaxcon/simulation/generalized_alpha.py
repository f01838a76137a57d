"""Generalized-α: implicit, second order, for stiff forces and extreme ratios of masses."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Rows, layout_of, linearize
from jaxcon.core import checks, status
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import everywhere
from jaxcon.core.status import Status
from jaxcon.core.typing import Array
from jaxcon.core.worlds import keep
from jaxcon.dynamics.forward import Dynamics, saddle
from jaxcon.dynamics.vakonomic import Vakonomic
from jaxcon.model.state import State
from jaxcon.simulation.implicit import Equations, History, Scheme, root
from jaxcon.simulation.integrators import Advanced
from jaxcon.solvers.proximal import scaled
from jaxcon.solvers.saddle import Solution, judge
from jaxcon.stabilization.baumgarte import asks_nothing
from jaxcon.stabilization.projection import Projection


@pytree
class GeneralizedAlpha(checks.Checked):
    """Implicit, second order: holds φ = 0 and φ̇ = 0 at the end of each step, whatever its length.

    For scenes that are stiff in their springs or in the ratios of their masses, where an explicit
    method needs steps as short as the fastest vibration: here such a vibration is damped. There is
    no feedback: `Baumgarte()` without gains means nothing, as `Unstabilized()` does.

    With unknowns v̇⁺ and λ⁺ a step of length h solves, at its end,

        M v̇⁺ = f(q⁺, v⁺, t⁺) + Jᵀλ⁺,    φ(q⁺, t⁺) = 0,    ψ(q⁺, v⁺, t⁺) = 0,    J v̇⁺ + C λ⁺ = b,

    of which the last is for rows with compliance, such as rotors. Accelerations are averaged,

        (1 − α_m) a⁺ + α_m a = (1 − α_f) v̇⁺ + α_f v̇,
        q⁺ = q ⊕ h (v + h ((½ − β) a + β a⁺)),    v⁺ = v + h ((1 − γ) a + γ a⁺).

    These equations leave φ̇ of order h². It is brought to zero by the smallest change of v in
    the metric of M, as without it light links between heavy ends start to shake where ρ > 0.7. Then
    the λ of the equations is of first order only, and `info` has a and λ as they are at the end of
    the step, by `solver` from q and v there.

    Where rows may depend on each other, as those of closed loops do, Newton's matrix has ε W added,
    W the diagonal of J M⁻¹ Jᵀ, and proximal rounds take out again what that does: φ is zero to
    rounding, and λ the least of those that fit. The derivative of a step is that of its solution,
    exact to every order. Newton's matrix is dense: for up to some hundreds of rows. A state that is
    changed by hand starts anew, by `init`. The equations divide by h: a world with h = 0 ends in
    NON_FINITE.

    Attributes:
        rho: ρ∞, from 1 (no dissipation) to 0 (the highest frequencies are gone after a step).
        tolerance: by how much the last correction may move q, in proportion to 1 + max |q|, or the
            world is NOT_CONVERGED; if None, ε^⅔, ε the spacing of floating numbers.
        tikhonov: ε, on which the solution does not depend, but how fast it is found and how far
            rounding is kept out of λ; if None, the square root of the spacing of floating numbers
            where the scene has loops, and 0 elsewhere.
        iterations: of Newton's method, each with a new matrix.
        projects: whether φ̇ is brought to zero.

    References:
        Arnold, Brüls, Convergence of the generalized-α scheme for constrained mechanical systems,
            Multibody System Dynamics 18 (2007).
        Brüls, Cardona, Arnold, Lie group generalized-α time integration of constrained flexible
            multibody systems, Mechanism and Machine Theory 48 (2012).
    """

    rho: Any = 0.9
    tolerance: Any = None
    tikhonov: Any = None
    iterations: int = static(default=6)
    projects: bool = static(default=True)

    def init(self, system: Any, q: Array, v: Array) -> History:
        """Not started."""
        rows = layout_of(system, q, v, jnp.zeros((), v.dtype)).size
        none = jnp.zeros_like(v)
        return History(none, none, jnp.zeros(rows, v.dtype), jnp.zeros((), bool))

    def refuses(self, system: Any, stabilizer: Any) -> str | None:
        """Why it does not work with a system or stabiliser; None where it does."""
        if isinstance(system, Vakonomic):
            return (
                "it solves M v̇ = f + Jᵀλ, which variational equations are not;"
                " use an explicit integrator such as RK4()"
            )
        if asks_nothing(stabilizer) or isinstance(stabilizer, Projection):
            return None
        return (
            f"it solves φ = 0 itself and leaves nothing to {type(stabilizer).__name__}; use"
            " Baumgarte() without gains, Unstabilized() or Projection()"
        )

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: ρ is not in [0, 1], there are no iterations, or a number is negative.
        """
        checks.check("GeneralizedAlpha", "rho", self.rho, (), least=0, most=1)
        checks.flag("GeneralizedAlpha", "projects", self.projects)
        for what in ("tolerance", "tikhonov"):
            x = getattr(self, what)
            checks.check("GeneralizedAlpha", what, x, (), least=0, optional=True)
        checks.count("GeneralizedAlpha", "iterations", self.iterations)

    def default_gains(self, dt: Any) -> tuple[Any, Any]:
        """None: α = β = 0."""
        return jnp.zeros_like(dt), jnp.zeros_like(dt)

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """0: an error of φ is gone after one step, whatever the gains."""
        return 0.0

    def advance(self, dynamics: Dynamics, state: State, memory: History, dt: Any) -> Advanced:
        """One step."""
        known, began = _begun(dynamics, state, memory)
        rows = linearize(dynamics.system, state.q, state.v, state.instant)
        scheme = Scheme.of(jnp.asarray(self.rho, state.q.dtype)[None], dt[None])
        equations = Equations(dynamics, state, known, scheme, self._softness(dynamics, state, rows))
        allowed = self._tolerance(q := state.q) * (1 + jnp.max(jnp.abs(q), axis=0, initial=0))
        x, moved, singular = root(equations, self.iterations)
        acceleration, multipliers = equations.split(x)
        average, q, v = equations.end(acceleration)
        t = state.instant + dt
        v, nearest = projected(dynamics, q, v, t) if self.projects else (v, jnp.zeros_like(began))
        late = jnp.where(moved <= allowed, Status.OK, Status.NOT_CONVERGED).astype(jnp.int32)
        codes = (began, judge(x, singular), judge(equations.weights[0]), late, nearest)
        code = functools.reduce(status.first, codes)
        kept = History(acceleration, average, multipliers, jnp.ones_like(memory.started))
        solution, ends = dynamics(q, v, t)  # compiled only where it is read
        if equations.soft is not None:
            code = status.first(code, self._contradicted(equations, solution, ends, allowed))
        return Advanced((q, v, t), solution._replace(status=code), rows, kept, ends=True)

    def _contradicted(
        self, equations: Equations, solution: Solution, ends: Rows, allowed: Array
    ) -> Array:
        """CONFLICT where φ is left beyond what a regularization by ε W would do under the least λ.

        Proximal rounds take out of that what independent rows lack, most slowly near a singular
        position, and nothing of what rows that contradict each other do.
        """
        gives = equations.scheme.reach * equations.soft * jnp.abs(solution.multipliers)
        most = allowed + 10 * jnp.max(gives, axis=0)
        bad = jnp.max(jnp.abs(ends.residual), axis=0) > most
        return jnp.where(bad, Status.CONFLICT, Status.OK).astype(jnp.int32)

    def _softness(self, dynamics: Dynamics, state: State, rows: Rows) -> Array | None:
        """ε W, (n_c,), zero where a row has compliance; None where there is none."""
        if self.tikhonov is None and not rows.layout.loops:
            return None
        dtype = rows.bias.dtype
        eps = float(jnp.finfo(dtype).eps)
        # what a proximal round leaves, ε, and the rounding that it lets into λ, eps/ε, are alike
        share = eps**0.5 if self.tikhonov is None else jnp.asarray(self.tikhonov, dtype)[None]
        problem = saddle(dynamics.system, state.q, rows, state.v, rows.bias)
        soft = share * scaled(problem, 1e-6)
        return soft if rows.compliance is None else jnp.where(rows.compliance > 0, 0, soft)

    def _tolerance(self, q: Array) -> Any:
        if self.tolerance is None:
            return float(jnp.finfo(q.dtype).eps) ** (2 / 3)
        return jnp.asarray(self.tolerance, q.dtype)


def _begun(dynamics: Dynamics, state: State, memory: History) -> tuple[History, Array]:
    """The history, that of the saddle system in worlds that have none, and its status."""
    healthy = jnp.zeros_like(state.status)

    def look() -> tuple[History, Array]:
        (a, multipliers, code), _ = dynamics(state.q, state.v, state.instant)
        fresh = History(a, a, multipliers, memory.started)
        return keep(memory.started, (memory, healthy), (fresh, code))

    return jax.lax.cond(everywhere(memory.started), lambda: (memory, healthy), look)


def projected(dynamics: Dynamics, q: Array, v: Array, t: Any) -> tuple[Array, Array]:
    """v with φ̇ = 0, nearest in the metric of M, and the status of the solution.

    M w = Jᵀ Λ, J w + C Λ = −φ̇: what is compliant gets its share of the impulse. Dependent rows
    seem to contradict each other where φ̇ is but rounding; only failures count.
    """
    rows = linearize(dynamics.system, q, v, t)
    held = -rows.rate
    target = held if rows.compliance is None else jnp.where(rows.compliance > 0, 0, held)
    problem = saddle(dynamics.system, q, rows, jnp.zeros_like(v), target)
    change, _, code = dynamics.solver.solve(problem)
    return v + change, status.failures(code)
