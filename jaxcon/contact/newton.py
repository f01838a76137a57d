"""Solves inequality rows by Newton's method for the velocities of the bodies.

The end velocity of a step is v = v₀ + N z, where v₀ is the velocity without inequality rows and N z
are the motions that the joints allow. Each row has the law

    Λ = P(Λ̂ − (J v − u*)/R),

where Λ is its impulse, P projects onto the bounds of Λ, and Λ̂ is an estimate of Λ. For fixed Λ̂,
and fixed bounds μ Λ̂_n of friction, Λ is minus the derivative of a convex function ℓ of J v. The
laws and the equations of motion Nᵀ M N z = Nᵀ Jᵀ Λ are then the conditions of a convex problem:

    min ½ zᵀ Nᵀ M N z + ℓ(J v).

Newton's method with a line search solves it. Its matrix is Nᵀ (M + Jᵀ D J) N, with D = −∂Λ/∂(J v).
After a full step the new Λ becomes the estimate Λ̂. A fixed point Λ = Λ̂ satisfies the laws of
`contact.bounded` for every R. A large R decides soon which rows act; once they no longer change, a
smaller R lets Λ̂ converge in fewer steps, also with extreme ratios of masses. With a small R, a
step after which other rows act leaves Λ̂ as it was, and R grows again.

References:
    Castro, Permenter, Han, An Unconstrained Convex Formulation of Compliant Contact, IEEE Trans.
        Robotics (2022), for the convex problem and its line search.
    Carpentier, Le Lidec, Montaut, From Compliant to Rigid Contact Simulation, RSS (2024), for
        iterations of Λ̂.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.contact.body_space import BodySpace
from jaxcon.contact.bordered import Bordered, Directions
from jaxcon.contact.bounded import Bounded, RowCounts, RowsByLaw, probes, regularized
from jaxcon.contact.gauss_seidel import GaussSeidel
from jaxcon.contact.rows import BoundRows
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array, DType, Scalar
from jaxcon.linear.articulated import Articulated, ByBranch
from jaxcon.protocols import ContactSolver

SHARE = 0.3
"""R at the start, as a share of the inverse mass that a row meets."""

EASE = 0.5
"""The factor of R after each full step: a large R decides soon which rows act, a small one then
needs fewer iterations."""

LEAST = 0.1
"""The least product of these factors in the first iterations."""

PATIENCE = 6
"""The number of iterations after which R is chosen by how they converge."""

SLOW = 0.5
"""The change of Λ̂ in a full step, relative to that of the step before, above which R shrinks."""

SHRINK = 0.2
"""The factor of R then. After a step that is not full, or after which other rows act, R returns to
`LEAST` of its first value."""

LEAST_IN_SINGLE, LEAST_IN_DOUBLE = 1e-3, 1e-6
"""The least product of all factors, by precision. A smaller R would be lost in rounding of Λ̂."""

TERMS = 24
"""The largest number of rows between two bodies in Newton's matrix. Its steps are too long for
further rows that act, which converge slowly or not at all; `info.reactions.residual` tells."""


ITERATIONS, ITERATIONS_IN_DOUBLE = 25, 60
"""The default largest numbers of iterations in single and in double precision."""


@pytree
class Newton(checks.Checked, ContactSolver):
    """Newton's method for the velocities of bodies that joints connect to trees.

    A row on one body, or on a joint, changes the inertia of that body or joint only, and one
    elimination along the joints gives an iteration. Its cost is proportional to the number of rows.
    A row between two other bodies, such as a contact between limbs, adds a term of rank one while
    it acts, and costs an elimination more. A fixed point satisfies Signorini's and Coulomb's laws
    without relaxation. The derivative is that of the laws, with the same elimination.

    If `Method.solver` is `RankSafe()` or `Sparse()` without regularization, it is not used: the
    joints, too, are eliminated along the tree (`TreeEquations`). In single precision, accelerations
    then err by the order of the drift φ of the joints, relative to the arms of the bodies, and in
    double precision by φ². This also needs a stabilizer other than `Unstabilized()`, and in single
    precision at most 12 joints between a body and the root of its tree.

    Scenes with closed loops, particles, constraints other than joints and rotors, compliant joints,
    joints of your own (unless `Joint.relative` is True), or user inequalities are solved by
    `GaussSeidel()` instead. So is what an `ActiveSet` around this solver leaves.

    Attributes:
        iterations: the largest number of iterations in a step; None for 25 in single precision and
            60 in double precision.
        tolerance: the violation of the laws at which a world is done [m/s, rad/s]; None for 5e-5 in
            single precision and 1e-8 in double precision. Rounding adds 64 ε |u|, where u is the
            fastest row.
        warm: True to start from the multipliers of the last step.
        smoothing: width of the smoothed corners of the laws, for the derivative only [m/s, rad/s].
        regularization: ρ, for a compliance of each row of at least ρ times its inverse mass, or
            0.04 ρ for friction, rolling and spinning resistance, friction in joints, and motors.
            1/(4 π²) is nearly rigid for steps of any length. Forces are then unique, and continuous
            in the state. The price is that contacts under load lie a little in each other, and that
            contacts that stick creep. Impacts with restitution are not affected. The derivative
            treats inverse masses as constant, and those of rows between two bodies are without the
            joints between them. None for exact laws.

    References:
        Castro, Permenter, Han, An Unconstrained Convex Formulation of Compliant Contact, IEEE
            Trans. Robotics (2022).
        Carpentier, Le Lidec, Montaut, From Compliant to Rigid Contact Simulation, RSS (2024).
    """

    iterations: int | None = static(default=None)
    tolerance: float | None = static(default=None)
    warm: bool = static(default=True)  # type: ignore[override]
    smoothing: Any = None
    regularization: Any = None
    exact = False  # type: ignore[assignment]

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: `iterations` is not a positive integer or None, `warm` is not a bool,
                `tolerance` is not positive, or `smoothing` or `regularization` is negative.
        """
        if self.iterations is not None:
            checks.count("Newton", "iterations", self.iterations)
        checks.flag("Newton", "warm", self.warm)
        checks.check("Newton", "tolerance", self.tolerance, (), above=0, optional=True)
        checks.check("Newton", "smoothing", self.smoothing, (), least=0, optional=True)
        checks.check("Newton", "regularization", self.regularization, (), least=0, optional=True)

    def max_iterations(self, dtype: DType) -> int:
        """Returns the largest number of iterations in a step."""
        if self.iterations is not None:
            return self.iterations
        return ITERATIONS if jnp.finfo(dtype).bits <= 32 else ITERATIONS_IN_DOUBLE

    def reached(self, dtype: DType) -> float:
        """Returns the violation at which a world is done [m/s, rad/s]."""
        if self.tolerance is not None:
            return self.tolerance
        return 5e-5 if jnp.finfo(dtype).bits <= 32 else 1e-8

    def solve(self, problem: Bounded, start: Array) -> Array:
        """Returns the multipliers λ, (n,), of a problem whose bodies form no tree, by sweeps."""
        return GaussSeidel().solve(problem, start)


class Laws(NamedTuple):
    """The laws of the rows, for impulses Λ = h λ.

    Attributes:
        kinds: numbers of rows by law.
        regularization: R, (n,).
        compliance: C/h, (n,).
        lower, upper: bounds of boxes.
        coefficients: μ of each disc.
        acts: mask of the active rows, (n,).
    """

    kinds: RowCounts
    regularization: Array
    compliance: Array
    lower: Array
    upper: Array
    coefficients: tuple[Array, ...]
    acts: Array

    def eased(self, factor: Array) -> Laws:
        """Returns the laws with R multiplied by a factor, (1,)."""
        return self._replace(regularization=factor * self.regularization)

    def ahead(self, center: Array, velocity: Array) -> Array:
        """Returns the multipliers before projection, (n,)."""
        r = self.regularization
        return (r * center - velocity) / (r + self.compliance)

    def project(self, center: Array, velocity: Array) -> Array:
        """Returns λ, (n,)."""
        x, here = self.kinds.split(self.ahead(center, velocity)), self.kinds.split(center)
        pressed = jnp.maximum(here.normal, 0)
        discs = []
        for disc, μ, y in zip(self.kinds.discs, self.coefficients, x.discs, strict=True):
            if not len(y):
                discs.append(y)
                continue
            length = numerics.norm(y)
            radius = μ * disc.of(pressed)
            discs.append(y * jnp.minimum(1, radius / jnp.where(length > 0, length, 1)))
        λ = self.kinds.join(
            RowsByLaw(
                jnp.maximum(x.single, 0),
                jnp.clip(x.box, self.lower, self.upper),
                jnp.maximum(x.normal, 0),
                tuple(discs),
            )
        )
        return jnp.where(self.acts, λ, 0)

    def slope(self, center: Array, velocity: Array) -> tuple[Array, list[tuple[Array, Vector]]]:
        """Returns −∂λ/∂u: its diagonal part a, (n,), and for each disc b and t of −b t tᵀ."""
        stiff = jnp.where(self.acts, 1 / (self.regularization + self.compliance), 0)
        x, here = self.kinds.split(self.ahead(center, velocity)), self.kinds.split(center)
        k = self.kinds.split(stiff)
        pressed = jnp.maximum(here.normal, 0)
        a_discs, others = [], []
        for disc, μ, y, s in zip(
            self.kinds.discs, self.coefficients, x.discs, k.discs, strict=True
        ):
            if not len(y):
                a_discs.append(y)
                others.append((pressed[:0], y))
                continue
            length = numerics.norm(y)
            safe = jnp.where(length > 0, length, 1)
            radius = μ * disc.of(pressed)
            slides = length > radius
            share = jnp.where(slides, radius / safe, 1)
            a = s.map(lambda z, f=share: z * f)
            a_discs.append(a)
            others.append((jnp.where(slides, a[0], 0), y * (1 / safe)))
        diagonal = self.kinds.join(
            RowsByLaw(
                jnp.where(x.single > 0, k.single, 0),
                jnp.where((x.box > self.lower) & (x.box < self.upper), k.box, 0),
                jnp.where(x.normal > 0, k.normal, 0),
                tuple(a_discs),
            )
        )
        return diagonal, others


Momentum = tuple[ByBranch, ByBranch]
"""M N z of the bodies, and that of rotors on joints, by branch."""


def regimes(diagonal: Array, discs: list[tuple[Array, Vector]]) -> Array:
    """Returns flags, from `Laws.slope`: rows inside of their bounds, then discs that slide."""
    return jnp.concatenate([diagonal > 0, *(b > 0 for b, _ in discs)])


class State(NamedTuple):
    """The state of the iteration.

    Attributes:
        iteration: number of iterations so far, ().
        velocity: u = J v − u* of the rows, (n,).
        center: Λ̂, (n,).
        impulses: Λ, (n,).
        momentum: M N z of the bodies, and that of rotors, by branch.
        forces: Jᵀ Λ − M N z, minus the derivative of the objective, on bodies and on joints.
        going: True in worlds that are not done, ().
        ease: the factor of R, (1,).
        moved: the change of Λ by the last full step after the first `PATIENCE` iterations, as the
            largest velocity SHARE g |ΔΛ|, () [m/s, rad/s]; infinite before.
    """

    iteration: Array
    velocity: Array
    center: Array
    impulses: Array
    momentum: Momentum
    forces: tuple[ByBranch, ByBranch]
    going: Array
    ease: Array
    moved: Array


class Problem(NamedTuple):
    """The convex problem of a step.

    Attributes:
        space: the equations of motion and the inequality rows.
        laws: the laws of the rows, with R before it is `eased`.
        reach: the inverse inertia that meets each joint velocity, by branch.
        tolerance: the violation at which a world is done, () [m/s, rad/s].
    """

    space: BodySpace
    laws: Laws
    reach: ByBranch
    tolerance: Array

    def judged(
        self,
        iteration: Array,
        velocity: Array,
        center: Array,
        momentum: Momentum,
        ease: Array,
        moved: Array,
    ) -> State:
        """Returns the state with its impulses; a world goes on while it violates the laws.

        The violation has two parts: R |Λ − Λ̂|, which vanishes at a fixed point, and the velocity
        by which the impulses that the equations of motion lack would change the joints.
        """
        laws = self.laws.eased(ease)
        impulses = laws.project(center, velocity)
        left = jnp.max(laws.regularization * jnp.abs(impulses - center), axis=0)
        bodies, joints = self.space.pull(impulses)
        forces = _less(bodies, momentum[0]), _less(joints, momentum[1])
        lacking = self.space.motions.gradient(*forces)
        for own, inverse in zip(lacking, self.reach, strict=True):
            for g, x in zip(own, inverse, strict=True):
                left = jnp.maximum(left, jnp.max(jnp.abs(g * x), axis=0))
        going = left > self.tolerance  # False for NaN: `ContactProblem.judge` stops such a world
        forces = self.wide(forces[0]), self.wide(forces[1])
        return State(iteration, velocity, center, impulses, momentum, forces, going, ease, moved)

    def iterate(self, state: State) -> State:
        """Returns the state after a step of Newton's method."""
        space, laws, going = self.space, self.laws.eased(state.ease), state.going
        diagonal, discs = laws.slope(state.center, state.velocity)
        factors: Articulated | Bordered
        factors = Articulated(space.motions, *space.stiffened(diagonal, laws.kinds, discs))
        if space.on_pairs and space.motions.freedom:
            between = space.between(diagonal)
            directions = Directions.of(between, laws.kinds, diagonal, discs)
            factors = Bordered(space, factors, directions, min(TERMS, space.pair_rows))
        bodies, joints = state.forces
        dz, dy = factors.solve(bodies, joints)
        change = space.rows_of(dy, dz, state.velocity)
        change = jnp.where(laws.acts, change, 0)
        momentum = space.momentum(dy, dz)
        first = -_work(bodies + joints, dy + dz, change)
        square = _work(momentum[0] + momentum[1], dy + dz, change)

        def slope(α: Array) -> Array:
            new = laws.project(state.center, state.velocity + α[None] * change)
            return first + α * square - jnp.sum((new - state.impulses) * change, axis=0)

        α, is_whole = line_search(slope, first, going)
        α = jnp.where(going, α, 0)[None]
        velocity = state.velocity + α * change
        momentum = jax.tree.map(
            lambda p, d: p + α * d, state.momentum, tuple(map(self.wide, momentum))
        )
        new = laws.project(state.center, velocity)

        def early() -> tuple[Array, Array, Array]:
            shrunk = jnp.maximum(EASE * state.ease, LEAST)
            return is_whole, jnp.where(is_whole, shrunk, state.ease), state.moved

        def late() -> tuple[Array, Array, Array]:
            before, after = regimes(diagonal, discs), regimes(*laws.slope(state.center, velocity))
            settled = is_whole & jnp.all(before == after, axis=0)
            moved = jnp.max(self.laws.regularization * jnp.abs(new - state.center), axis=0)
            # where the same rows act as before, only Λ̂ is left to converge, faster with small R
            slow = settled & (moved > SLOW * state.moved)
            single = jnp.finfo(velocity.dtype).bits <= 32
            least = LEAST_IN_SINGLE if single else LEAST_IN_DOUBLE
            shrunk = jnp.maximum(SHRINK * state.ease, least)
            kept = jnp.where(settled, state.ease, jnp.maximum(state.ease, LEAST))
            accepted = settled | (is_whole & (state.ease[0] >= LEAST))
            return accepted, jnp.where(slow, shrunk, kept), jnp.where(is_whole, moved, state.moved)

        accepted, ease, moved = jax.lax.cond(state.iteration >= PATIENCE, late, early)
        center = jnp.where((going & accepted)[None], new, state.center)
        after = self.judged(state.iteration + 1, velocity, center, momentum, ease, moved)
        # a world that is done keeps its impulses
        return after._replace(
            impulses=jnp.where(going[None], after.impulses, state.impulses),
            going=after.going & going,
        )

    def wide(self, by_branch: ByBranch) -> ByBranch:
        """Broadcasts lanes to all bodies of their branches and all worlds."""
        motions, dtype = self.space.motions, self.laws.regularization.dtype
        return [
            [jnp.broadcast_to(jnp.asarray(x, dtype), (n, *motions.shape)) for x in lanes]
            for n, lanes in zip(motions.tree.sizes, by_branch, strict=True)
        ]


class Found(NamedTuple):
    """The solution of a step.

    Attributes:
        multipliers: λ, (n,).
        mass: inverse mass g of each row, (n,). Rows of a contact have their largest; 1 if none of
            them can move.
        movable: mask of the rows that act and can move, (n,).
        own: inverse mass of each row by itself, (n,); 0 if it does not act or cannot move.
    """

    multipliers: Array
    mass: Array
    movable: Array
    own: Array


def multipliers(
    space: BodySpace,
    rows: BoundRows,
    offset: Array,
    start: Array,
    acts: Array | None,
    bare: Array,
    dt: Array,
    solver: Newton,
    share: Scalar | None = None,
) -> Found:
    """Solves the inequality rows of a step.

    Args:
        space: the equations of motion.
        rows: the inequality rows.
        offset: velocities of the rows without multipliers, minus their targets, (n,).
        start: the estimate of λ, (n,).
        acts: mask of the active rows, (n,); None for all.
        bare: diagonal of J M⁻¹ Jᵀ, (n,).
        dt: step size h, () [s].
        solver: the solver.
        share: the regularization ρ; None for exact laws.
    """
    kinds, order, h = rows.kinds, space.order, dt[None]
    friction, resistance, compliance = rows.friction, rows.resistance, rows.compliance
    if sorts := bool((order != np.arange(len(order))).any()):
        contacts = order[kinds.normal : kinds.normal + kinds.contacts] - kinds.normal
        friction = friction[contacts]
        resistance = tuple(
            x[contacts[disc.first : disc.first + disc.count] - disc.first]
            for x, disc in zip(resistance, kinds.turning, strict=True)
        )
        offset, start, bare, compliance = (x[order] for x in (offset, start, bare, compliance))
        acts = None if acts is None else acts[order]
    free = space.equations.factors
    mass, of_joints = space.mobility(free, offset)
    # the joints may make a row immovable, up to rounding
    rounding = 64 * float(jnp.finfo(offset.dtype).eps)
    movable = mass > rounding * bare
    if space.on_pairs:
        # `mobility` has only a bound for rows between two bodies
        length = jnp.sqrt(bare)

        def moved(z: Array) -> Array:
            change, bodies = free.solve(*space.pull(z))
            return jnp.abs(space.rows_of(bodies, change, z))

        tests = jnp.stack([numerics.safe_divide(z, length) for z in probes(length)])
        moves = jnp.max(jax.vmap(moved)(tests), axis=0) > rounding * len(length) ** 0.5 * length
        movable = movable & (moves | ~space.between(offset))
    movable = movable if acts is None else movable & acts
    movable = kinds.under_normals(kinds.split(movable))
    own = jnp.where(movable, mass, 0)
    largest = kinds.largest(own)
    mass = jnp.where(largest > 0, largest, 1)
    soft = numerics.safe_divide(compliance, h)
    soft = regularized(soft, kinds, own, share)
    laws = Laws(
        kinds,
        SHARE * mass,
        jnp.where(movable, soft, 0),
        h * rows.lower,
        h * rows.upper,
        (friction, *resistance),
        movable,
    )
    reach = [[block[r][r] for r in range(len(block))] for block in of_joints]
    fastest = jnp.max(jnp.abs(rows.rate), axis=0)
    reached = solver.reached(offset.dtype) + rounding * fastest
    problem = Problem(space, laws, reach, reached)
    center = jnp.where(movable, h * start, 0)
    z, y = free.solve(*space.pull(center))
    velocity = jnp.where(movable, offset + space.rows_of(y, z, offset), 0)
    bodies, joints = space.momentum(y, z)
    momentum = problem.wide(bodies), problem.wide(joints)
    iteration, ones = jnp.zeros((), jnp.int32), jnp.ones_like(offset[:1])
    most = solver.max_iterations(offset.dtype)

    def goes(state: State) -> Array:
        return (state.iteration < most) & somewhere(state.going)

    first = problem.judged(iteration, velocity, center, momentum, ones, jnp.inf * ones[0])
    last = jax.lax.while_loop(goes, problem.iterate, first)
    # with a small R, impulses are large until the step is whole
    unsettled = last.going & (last.ease[0] < LEAST)
    impulses = jnp.where(unsettled[None], last.center, last.impulses)
    found = Found(numerics.safe_divide(impulses, h), mass, movable, own)
    return Found(*(x[np.argsort(order)] for x in found)) if sorts else found


def _less(x: ByBranch, y: ByBranch) -> ByBranch:
    """Returns x − y."""
    return [[a - b for a, b in zip(p, q, strict=True)] for p, q in zip(x, y, strict=True)]


def _work(forces: ByBranch, velocities: ByBranch, like: Array) -> Array:
    """Returns Σ f·v over all lanes, (); Python numbers among them are zeros."""
    works = [
        jnp.sum(x * y, axis=0)
        for own, v in zip(forces, velocities, strict=True)
        for x, y in zip(own, v, strict=True)
        if isinstance(x, jax.Array) and isinstance(y, jax.Array)
    ]
    return functools.reduce(operator.add, works, jnp.zeros(like.shape[1:], like.dtype))


FLAT = 0.01
"""The largest slope at the end of a full step, as a share of the slope at its start."""

TRIES = 4
"""The number of shorter steps that are tried if the slope is larger."""


def line_search(slope: Callable[[Array], Array], first: Array, going: Array) -> tuple[Array, Array]:
    """Returns the step length α in (0, 1] at which a convex function is smallest, nearly, ().

    Args:
        slope: its derivative by α.
        first: the derivative at 0, negative.
        going: worlds that need a step.

    Returns:
        α, and True where it is 1.
    """
    one = jnp.ones_like(first)
    end = slope(one)
    steep = going & (end > FLAT * jnp.abs(first))

    def cond(s: Any) -> Array:
        return (s[0] < TRIES) & somewhere(s[-1])

    def body(s: Any) -> Any:
        count, α, low, high, at_low, at_high, bad = s
        guess = low - at_low * (high - low) / jnp.where(at_high > at_low, at_high - at_low, 1)
        guess = jnp.clip(guess, low + 0.1 * (high - low), low + 0.9 * (high - low))
        here = slope(guess)
        up, down = bad & (here > 0), bad & (here <= 0)
        return (
            count + 1,
            jnp.where(bad, guess, α),
            jnp.where(down, guess, low),
            jnp.where(up, guess, high),
            jnp.where(down, here, at_low),
            jnp.where(up, here, at_high),
            bad & (jnp.abs(here) > 0.1 * jnp.abs(first)),
        )

    start = (jnp.zeros((), jnp.int32), one, 0 * one, one, first, end, steep)
    α = jax.lax.while_loop(cond, body, start)[1]
    return α, ~steep
