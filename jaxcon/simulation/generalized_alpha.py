"""Generalized-α: implicit, second order, for stiff forces and extreme ratios of masses.

With unknowns v̇⁺ and λ⁺ a step of length h solves, at its end,

    M v̇⁺ = f(q⁺, v⁺, t⁺) + Jᵀλ⁺,    φ(q⁺, t⁺) = 0,    ψ(q⁺, v⁺, t⁺) = 0,    J v̇⁺ + C λ⁺ = b,

of which the last is for rows with compliance, such as rotors. Accelerations are averaged,

    (1 − α_m) a⁺ + α_m a = (1 − α_f) v̇⁺ + α_f v̇,
    q⁺ = q ⊕ h (v + h ((½ − β) a + β a⁺)),    v⁺ = v + h ((1 − γ) a + γ a⁺),

with a⁺ = κ v̇⁺ + …, κ = (1 − α_f)/(1 − α_m). Divided by κβh² and κγh, what φ and ψ demand is an
acceleration, and Newton's matrix is that of a saddle system whatever h,

    [ M − κγh ∂f/∂v − κβh² ∂(f + Jᵀλ)/∂q   −Jᵀ ]
    [ J                                      C ],

the geometric stiffness of the constraint forces included.

References:
    Arnold, Brüls, Convergence of the generalized-α scheme for constrained mechanical systems,
    Multibody System Dynamics 18 (2007).
    Brüls, Cardona, Arnold, Lie group generalized-α time integration of constrained flexible
    multibody systems, Mechanism and Machine Theory 48 (2012).
    Bottasso, Dopico, Trainelli, On the optimal scaling of index three DAEs in multibody dynamics,
    Multibody System Dynamics 19 (2008).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Rows, layout_of, linearize
from jaxcon.core import checks, native, status
from jaxcon.core.pytree import pytree, static
from jaxcon.core.status import Status
from jaxcon.core.typing import Array
from jaxcon.dynamics.forward import Dynamics, saddle
from jaxcon.dynamics.vakonomic import Vakonomic
from jaxcon.model.state import State
from jaxcon.simulation.integrators import Advanced
from jaxcon.simulation.recovery import keep
from jaxcon.solvers import lu
from jaxcon.solvers.proximal import scaled
from jaxcon.solvers.saddle import judge
from jaxcon.stabilization.baumgarte import Baumgarte, Law


@pytree
class History:
    """What a step leaves to the next one; nothing yet before the first.

    Attributes:
        acceleration: v̇, (n_v,).
        average: a, which is v̇ a little later or earlier, to second order, (n_v,).
        multipliers: λ, (n_c,), from which the next ones are sought.
        started: whether these were found, ().
    """

    acceleration: Array
    average: Array
    multipliers: Array
    started: Array


class Scheme(NamedTuple):
    """The coefficients of a step of length h, numbers with an axis in front, (1, …)."""

    alpha_m: Any
    alpha_f: Any
    beta: Any
    gamma: Any
    dt: Any

    @classmethod
    def of(cls, rho: Any, dt: Any) -> Scheme:
        """Those for which the highest frequencies are damped by ρ a step, and low ones least.

        References:
            Chung, Hulbert, A time integration algorithm for structural dynamics with improved
            numerical dissipation: the generalized-α method, J. Applied Mechanics 60 (1993).
        """
        alpha_m, alpha_f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
        gamma = 0.5 + alpha_f - alpha_m
        return cls(alpha_m, alpha_f, 0.25 * (gamma + 0.5) ** 2, gamma, dt)

    @property
    def share(self) -> Any:
        """κ = ∂a⁺/∂v̇⁺."""
        return (1 - self.alpha_f) / (1 - self.alpha_m)

    @property
    def reach(self) -> Any:
        """∂(q⁺ − q)/∂v̇⁺ = κβh² [s²]."""
        return self.share * self.beta * self.dt**2

    @property
    def push(self) -> Any:
        """∂v⁺/∂v̇⁺ = κγh [s]."""
        return self.share * self.gamma * self.dt


@pytree
class GeneralizedAlpha:
    """Implicit, second order: holds φ = 0 and φ̇ = 0 at the end of each step, whatever its length.

    For scenes that are stiff in their springs or in the ratios of their masses, where an explicit
    method needs steps as short as the fastest vibration: here such a vibration is damped. There is
    no feedback: `Baumgarte()` without gains means nothing, as `Unstabilized()` does.

    The equations above leave φ̇ of order h². It is brought to zero by the smallest change of v in
    the metric of M, as without it light links between heavy ends start to shake where ρ > 0.7. Then
    the λ of the equations is of first order only, and `info` has a and λ as they are at the end of
    the step, by `solver` from q and v there.

    Where rows may depend on each other, as those of closed loops do, each gives way by its λ times
    ε W κβh², W the diagonal of J M⁻¹ Jᵀ, which is below rounding: λ is then unique. The derivative
    of a step is that of its solution, exact to every order. Newton's matrix is dense: for up to
    some hundreds of rows. A state that is changed by hand starts anew, by `init`.

    Attributes:
        rho: ρ∞, from 1 (no dissipation) to 0 (the highest frequencies are gone after a step).
        tolerance: by how much the last correction may move q, in proportion to 1 + max |q|, or the
            world is NOT_CONVERGED; if None, ε^⅔, ε the spacing of floating numbers.
        tikhonov: ε; if None, the third root of the spacing of floating numbers where the scene has
            loops, and 0 elsewhere.
        iterations: of Newton's method, each with a new matrix.
        projects: whether φ̇ is brought to zero.
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
        gains = (getattr(stabilizer, name, None) for name in ("alpha", "beta"))
        if isinstance(stabilizer, Baumgarte) and any(gain is not None for gain in gains):
            return (
                "it solves φ = 0 itself and leaves nothing to feedback, but Baumgarte got gains;"
                " use Baumgarte() without them, or Unstabilized()"
            )
        return None

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: ρ is not in [0, 1], or there are no iterations.
        """
        rho = np.asarray(self.rho) if checks.is_concrete(self.rho) else np.ones(())
        if not np.all((rho >= 0) & (rho <= 1)):
            raise ValueError(f"GeneralizedAlpha: rho must be from 0 to 1, got {self.rho}.")
        if self.iterations < 1:
            raise ValueError(
                f"GeneralizedAlpha: iterations must be 1 or more, got {self.iterations}."
            )

    def default_gains(self, dt: Any) -> tuple[Any, Any]:
        """None: α = β = 0."""
        return jnp.zeros_like(dt), jnp.zeros_like(dt)

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """0: an error of φ is gone after one step, whatever the gains."""
        return 0.0

    def advance(self, dynamics: Dynamics, state: State, memory: History, dt: Any) -> Advanced:
        """One step."""
        known, began = _begun(dynamics, state, memory)
        rows = linearize(dynamics.system, state.q, state.v, state.time)
        scheme = Scheme.of(jnp.asarray(self.rho, state.q.dtype)[None], dt[None])
        equations = Equations(dynamics, state, known, scheme, self._softness(dynamics, state, rows))
        allowed = self._tolerance(q := state.q) * (1 + jnp.max(jnp.abs(q), axis=0, initial=0))
        x, moved, singular = root(equations, self.iterations)
        acceleration, multipliers = equations.split(x)
        average, q, v = equations.end(acceleration)
        t = state.time + dt
        v, nearest = projected(dynamics, q, v, t) if self.projects else (v, jnp.zeros_like(began))
        late = jnp.where(moved <= allowed, Status.OK, Status.NOT_CONVERGED).astype(jnp.int32)
        code = functools.reduce(status.first, (began, judge(x, singular), late, nearest))
        kept = History(acceleration, average, multipliers, jnp.ones_like(memory.started))
        solution, _ = dynamics(q, v, t)  # compiled only where it is read
        return Advanced((q, v, t), solution._replace(status=code), rows, kept)

    def _softness(self, dynamics: Dynamics, state: State, rows: Rows) -> Array | None:
        """ε W, (n_c,); None where there is none."""
        if self.tikhonov is None and not rows.layout.loops:
            return None
        dtype = rows.bias.dtype
        eps = float(jnp.finfo(dtype).eps)
        share = eps ** (1 / 3) if self.tikhonov is None else jnp.asarray(self.tikhonov, dtype)[None]
        problem = saddle(dynamics.system, state.q, rows, state.v, rows.bias)
        return share * scaled(problem, 1e-6)

    def _tolerance(self, q: Array) -> Any:
        if self.tolerance is None:
            return float(jnp.finfo(q.dtype).eps) ** (2 / 3)
        return jnp.asarray(self.tolerance, q.dtype)


def _begun(dynamics: Dynamics, state: State, memory: History) -> tuple[History, Array]:
    """The history, that of the saddle system in worlds that have none, and its status."""
    healthy = jnp.zeros_like(state.status)

    def look() -> tuple[History, Array]:
        (a, multipliers, code), _ = dynamics(state.q, state.v, state.time)
        fresh = History(a, a, multipliers, memory.started)
        return keep(memory.started, (memory, healthy), (fresh, code))

    return jax.lax.cond(jnp.all(memory.started), lambda: (memory, healthy), look)


class Equations:
    """r(x) = 0 of one step, x = (v̇⁺, λ⁺), each row an acceleration or a force.

    Attributes:
        guess: where x is sought: what it was a step ago.
        scheme: the coefficients.
        inertia: the diagonal of M at the start, (n_v,).
    """

    def __init__(
        self, dynamics: Dynamics, state: State, known: History, scheme: Scheme, soft: Array | None
    ) -> None:
        self.dynamics, self.state, self.known = dynamics, state, known
        self.scheme, self.soft = scheme, soft
        self.guess = jnp.concatenate([known.acceleration, known.multipliers])
        self.inertia = dynamics.system.mass(state.q).diagonal

    def split(self, x: Array) -> tuple[Array, Array]:
        """v̇⁺ and λ⁺."""
        n = self.state.v.shape[0]
        return x[:n], x[n:]

    def end(self, acceleration: Array) -> tuple[Array, Array, Array]:
        """a⁺, q⁺ and v⁺."""
        s, known, state = self.scheme, self.known, self.state
        lag = s.alpha_f * known.acceleration - s.alpha_m * known.average
        a = s.share * acceleration + lag / (1 - s.alpha_m)
        step = s.dt * (state.v + s.dt * ((0.5 - s.beta) * known.average + s.beta * a))
        v = state.v + s.dt * ((1 - s.gamma) * known.average + s.gamma * a)
        return a, self.dynamics.system.retract(state.q, step), v

    def __call__(self, x: Array) -> Array:
        """r(x), (n_v + n_c,)."""
        own, (acceleration, multipliers) = self.dynamics, self.split(x)
        _, q, v = self.end(acceleration)
        t = self.state.time + own.dt
        rows = linearize(own.system, q, v, t)
        law = own.stabilizer.impose(rows, own.memory, own.dt)
        force = own.system.force(q, v, t, own.control)
        force = force if law.force is None else force + law.force
        pull = law.rows.jacobian.transpose(multipliers)
        balance = own.system.mass(q).apply(acceleration) - force - pull
        return jnp.concatenate([balance, self.closed(rows, law, acceleration, multipliers)])

    def closed(self, rows: Rows, law: Law, acceleration: Array, multipliers: Array) -> Array:
        """φ/κβh², ψ/κγh, or J v̇⁺ + C λ⁺ − b where there is compliance, (n_c,)."""
        holonomic = rows.layout.holonomic.reshape(-1, *(1,) * (multipliers.ndim - 1))
        scaled = rows.residual / self.scheme.reach, rows.rate / self.scheme.push
        hard = jnp.where(holonomic, *scaled)
        hard = hard if self.soft is None else hard + self.soft * multipliers
        if law.rows.compliance is None:
            return hard
        compliance = law.rows.compliance
        soft = law.rows.jacobian.apply(acceleration) + compliance * multipliers - law.target
        return jnp.where(compliance > 0, soft, hard)


def root(equations: Equations, iterations: int) -> tuple[Array, Array, Array]:
    """x with r(x) = 0 by Newton's method; the derivative is that of the root.

    Returns:
        x (n_v + n_c,), by how much the last correction moved q, (), and whether a matrix was
        singular, ().
    """
    inertia = jax.lax.stop_gradient(equations.inertia)

    def solve(linear: Any, right: Array) -> tuple[Array, Array]:
        columns = matrix(linear, right)
        return native.per_world(_solve, right.ndim - 1)(columns, right, inertia)

    def newton(residual: Any, guess: Array) -> tuple[Array, tuple[Array, Array]]:
        def improve(known: Any, _: None) -> tuple[Any, None]:
            x, _, singular = known
            value, linear = jax.linearize(residual, x)
            correction, dependent = solve(linear, value)
            return (x - correction, correction, singular | dependent), None

        start = guess, jnp.zeros_like(guess), jnp.zeros(guess.shape[1:], bool)
        (x, last, singular), _ = jax.lax.scan(improve, start, length=iterations)
        moved = jnp.abs(equations.split(last)[0]) * equations.scheme.reach
        # the derivative of a root passes on real numbers only
        return x, (jnp.max(moved, axis=0, initial=0), singular.astype(x.dtype))

    x, (moved, singular) = jax.lax.custom_root(
        equations, equations.guess, newton, lambda g, y: solve(g, y)[0], has_aux=True
    )
    return x, moved, singular > 0


def projected(dynamics: Dynamics, q: Array, v: Array, t: Any) -> tuple[Array, Array]:
    """v with φ̇ = 0, nearest in the metric of M, and the status of the solution.

    M w = Jᵀ Λ, J w + C Λ = −φ̇: what is compliant gets its share of the impulse. Dependent rows
    seem to contradict each other where φ̇ is but rounding; only failures count.
    """
    rows = linearize(dynamics.system, q, v, t)
    law = dynamics.stabilizer.impose(rows, dynamics.memory, dynamics.dt)
    compliance = law.rows.compliance
    target = -rows.rate if compliance is None else jnp.where(compliance > 0, 0, -rows.rate)
    problem = saddle(dynamics.system, q, law.rows, jnp.zeros_like(v), target)
    change, _, code = dynamics.solver.solve(problem)
    return v + change, jnp.where(status.failed(code), code, Status.OK).astype(jnp.int32)


def matrix(linear: Any, like: Array) -> Array:
    """A linear map of arrays (n, …) by its columns, (column, row, …)."""
    n = like.shape[0]
    directions = jnp.eye(n, dtype=like.dtype).reshape(n, n, *(1,) * (like.ndim - 1))
    return jax.vmap(lambda e: linear(jnp.broadcast_to(e, like.shape)))(directions)


def _solve(columns: Array, right: Array, inertia: Array) -> tuple[Array, Array]:
    """K⁻¹ r, and whether K is singular, of one world.

    Rows of velocities are scaled by 1/√K_ii, rows of constraints by their length so measured.
    """
    n = len(inertia)
    own = jnp.maximum(jnp.abs(jnp.diagonal(columns)[:n]), inertia)
    weight = (1 / own) @ columns[:n, n:] ** 2 + jnp.abs(jnp.diagonal(columns)[n:])
    size = jnp.concatenate([own, jnp.where(weight > 0, weight, 1)])
    known = lu.factor(columns.T, 1 / jnp.sqrt(size))
    return known.solve(right), known.singular
