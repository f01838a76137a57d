"""Violation of each contact law by a step, at random states.

`python -m benchmarks.bounded --laws` prints a table of these violations. The laws are evaluated on
the result of the step: row velocities J v⁺ at its end, and multipliers λ. The residual of the
solver is not used.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks.bounded import SCENES, STEP
from jaxcon.constraints.rows import linearize
from jaxcon.contact.impacts import landing
from jaxcon.contact.rows import BoundRows, linearize_bounds
from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree
from jaxcon.core.status import failed


class Laws(NamedTuple):
    """The largest relative violation of each contact law by one step.

    The target velocities u* of contacts that land during the step are those of `impacts.landing`.
    The solvers are thus compared on steps that solve one problem, not on impacts.

    Velocities are divided by V, the largest initial velocity. Multipliers are expressed by the
    velocity that they cause in their own row: λ̂ = h g λ/V, with g from `moved`. Let û = (J v⁺ −
    u*)/V, û_t its tangential part (slip), and r̂ = μ λ̂_n, or the bound of a joint's friction.

    Attributes:
        complementarity: |min(λ̂, û)| for normals, and |min(r̂ − ‖λ̂_t‖, ‖û_t‖)| for friction: below
            its bound, friction allows no slip.
        cone: excess of friction over the cone, ‖λ̂_t‖ − r̂ if positive.
        separation: separating velocity û if positive, for contacts with λ_n > 0, sliding or not.
        direction: ‖λ̂_t/r̂ + û_t/‖û_t‖‖ if r̂ and ‖û_t‖ exceed `SLIDES`. For small values it is the
            angle between friction and −û_t; it is 2 if friction acts along the slip.
        energy: energy gain h λ·(u₀ + u)/2 if positive, divided by the initial kinetic energy.
            u₀ and u are the row velocities without and with λ. Recovery from penetration does the
            work h Σ λ u* with u* > 0, which is subtracted.
    """

    complementarity: Any
    cone: Any
    separation: Any
    direction: Any
    energy: Any


SLIDES = 1e-3
"""Threshold on slip and friction above which the direction law is evaluated."""
ALLOWED = {"float64": 1e-8, "float32": 1e-5}
"""Bound on every violation. For `direction` it is divided by `SLIDES`."""


@pytree
class OneProblem(jc.solvers.InteriorPoint):
    """The interior-point solver with landings shared between two steps, as by Gauss–Seidel."""

    exact = False


JUDGED = {
    "Newton": jc.solvers.Newton(),
    "GaussSeidel(30)": jc.solvers.GaussSeidel(),
    "InteriorPoint(30)": OneProblem(),
}
"""The solvers with default parameters. A landing is shared with the next step."""
BLOCK = 1000
"""Number of worlds in a batch."""


def judged(
    rows: BoundRows, multipliers: Any, velocities: tuple[Any, Any], scales: tuple[Any, ...]
) -> Laws:
    """Evaluates the violations of the contact laws by one step.

    Args:
        rows: inequality rows at the start of the step.
        multipliers: λ, (n,).
        velocities: v at the end of the step without and with λ, (n_v,) each.
        scales: V, () [m/s]; h g, (n,) [s/kg]; initial kinetic energy, () [J].
    """
    speed, gain, energy = scales
    before, after = (rows.jacobian.apply(v) for v in velocities)
    x = rows.kinds.split(multipliers * gain / speed)
    u = rows.kinds.split((after - rows.target) / speed)
    push, separation = (jnp.concatenate([y.single, y.normal]) for y in (x, u))
    friction, slip = (_rubbing(y) for y in (x, u))
    box_bound = rows.upper * rows.kinds.split(gain).box / speed
    radius = jnp.concatenate([box_bound, rows.friction * x.normal])
    friction_size, slip_size = numerics.norm(friction), numerics.norm(slip)
    direction = friction * numerics.safe_divide(1.0, radius)
    direction += slip * numerics.safe_divide(1.0, slip_size)
    defined = jnp.minimum(slip_size, radius) > SLIDES
    work = jnp.sum(multipliers * ((before + after) / 2 - jnp.maximum(rows.target, 0)))
    violations = (
        jnp.abs(
            jnp.concatenate(
                [jnp.minimum(push, separation), jnp.minimum(radius - friction_size, slip_size)]
            )
        ),
        friction_size - radius,
        jnp.where(x.normal > 0, u.normal, 0),
        jnp.where(defined, numerics.norm(direction), 0),
        (STEP * work / energy)[None],
    )
    return Laws(*(jnp.max(y, initial=0) for y in violations))


def _rubbing(parts: Any) -> Vector:
    """Stacks the friction rows of joints and contacts as tangential vectors.

    Joint friction has one direction; its second tangential component is zero.
    """
    slip = parts.discs[0] or Vector(parts.normal)
    zeros = [0 * parts.box for _ in slip[1:]]
    pairs = zip([parts.box, *zeros], slip, strict=True)
    return Vector(*(jnp.concatenate(pair) for pair in pairs))


def moved(system: jc.extend.System, state: jc.State, rows: BoundRows) -> jax.Array:
    """Returns the acceleration g of each row per unit of its multiplier, (n,) [1/kg].

    The joints are enforced. g is the diagonal of J M⁻¹ Jᵀ − Bᵀ A⁻¹ B, with A = G M⁻¹ Gᵀ, B = G M⁻¹
    Jᵀ and the Jacobian G of the joints. The rows of a contact share their largest value.
    """
    j = rows.jacobian.dense()
    joints = linearize(system, state.q, state.v, state.time).jacobian.dense()
    inverse_mass = 1 / system.mass(state.q).diagonal[None]
    response = jnp.sum(j * j * inverse_mass, axis=1)
    if len(joints):
        coupling = (joints * inverse_mass) @ j.T
        response -= jnp.sum(
            coupling * jnp.linalg.solve((joints * inverse_mass) @ joints.T, coupling), axis=0
        )
    return rows.kinds.largest(response)


def measure(name: str, dtype: DTypeLike, solver: Any, worlds: int) -> Laws:
    """Measures law violations by one step at random states, (worlds,) each.

    Violations are infinite if the step failed.
    """
    build, draw = SCENES[name]
    system, state = build(dtype)
    without_rows = dataclasses.replace(system, bounds=())
    method, h = jc.Method(contact_solver=solver), jnp.asarray(STEP, dtype)
    initial = (
        jc.init(system, method, state.q, state.v),
        jc.init(without_rows, method, state.q, state.v),
    )

    def laws_of_step(key: jax.Array) -> Laws:
        start, start_free = (draw(key, system, x) for x in initial)
        rows = linearize_bounds(system, start.q, start.v, start.time, None, h)
        new, info = jc.step(system, method, start, None, h)
        free, _ = jc.step(without_rows, method, start_free, None, h)
        rows = landing(rows, rows.jacobian.apply(free.v - start.v), h)
        speed, energy = jnp.max(jnp.abs(start.v)), jc.energy(system, start).kinetic
        size = speed, h * moved(system, start, rows), energy
        violations = judged(rows, info.reactions.multipliers, (free.v, new.v), size)
        return jax.tree.map(lambda x: jnp.where(failed(new.status), jnp.inf, x), violations)

    return Laws(*in_blocks(laws_of_step, worlds))


def in_blocks(
    function: Callable[[jax.Array], tuple[Any, ...]], worlds: int, seed: int = 0
) -> list[np.ndarray]:
    """Returns the results of a function of random keys, (worlds, …) each, in blocks of worlds."""
    run = jax.jit(jax.vmap(function))
    keys = jax.random.split(jax.random.PRNGKey(seed), worlds)
    blocks = [run(keys[i : i + BLOCK]) for i in range(0, worlds, BLOCK)]
    return [np.concatenate(x) for x in zip(*blocks, strict=True)]


def beyond(violations: Laws, dtype: DTypeLike) -> Laws:
    """Counts the worlds that violate each law beyond its bound."""
    bounds = Laws(*[ALLOWED[jnp.dtype(dtype).name]] * len(Laws._fields))
    bounds = bounds._replace(direction=bounds.direction / SLIDES)
    return Laws(*(int(np.sum(~(x <= y))) for x, y in zip(violations, bounds, strict=True)))


REGULARIZED = {
    "Newton": jc.solvers.Newton,
    "GaussSeidel(30)": jc.solvers.GaussSeidel,
    "InteriorPoint(30)": OneProblem,
}
"""The solvers of `regularized_table`."""


def step_of(
    name: str, dtype: DTypeLike, solver: Any, worlds: int, seed: int = 0
) -> tuple[Any, Any]:
    """Returns v after a step from random states, (worlds, n_v), and the residual, (worlds,).

    Both are divided by the largest initial velocity.
    """
    build, draw = SCENES[name]
    system, state = build(dtype)
    method, h = jc.Method(contact_solver=solver), jnp.asarray(STEP, dtype)
    initial = jc.init(system, method, state.q, state.v)

    def one(key: jax.Array) -> tuple[Any, Any]:
        start = draw(key, system, initial)
        new, info = jc.step(system, method, start, None, h)
        speed = jnp.max(jnp.abs(start.v))
        return new.v / speed, info.reactions.residual / speed

    v, residual = in_blocks(one, worlds, seed)
    return v, residual


def regularized_table(scenes: list[str], dtypes: list[str], worlds: int, share: float) -> None:
    """Prints how far regularized steps miss their laws, and their distance from exact ones."""
    print(f"{worlds} states, regularization {share:.3g}; median / 99 % / worst")
    print("| scene | | | laws of its own | distance from the exact laws |\n|---|---|---|---|---|")
    for name in scenes:
        for dtype in dtypes:
            exact, _ = step_of(name, jnp.dtype(dtype), OneProblem(), worlds)
            for label, solver in REGULARIZED.items():
                v, residual = step_of(name, jnp.dtype(dtype), solver(regularization=share), worlds)
                numbers = residual, np.max(np.abs(v - exact), axis=1)
                shown = (np.quantile(x, [0.5, 0.99, 1.0]) for x in numbers)
                cells = " | ".join(" / ".join(f"{y:.0e}" for y in x) for x in shown)
                print(f"| {name} | {dtype} | {label} | {cells} |", flush=True)


def table(scenes: list[str], dtypes: list[str], worlds: int) -> None:
    """Prints a table of law violations by scene, precision and solver."""
    print(f"{worlds} states; median / 99 % / worst (states beyond {ALLOWED})")
    print(f"| scene | | | {' | '.join(Laws._fields)} |\n{'|---' * (3 + len(Laws._fields))}|")
    for name in scenes:
        for dtype in dtypes:
            for label, solver in JUDGED.items():
                violations = measure(name, jnp.dtype(dtype), solver, worlds)
                cells = []
                for x, count in zip(violations, beyond(violations, dtype), strict=True):
                    numbers = (np.median(x), np.quantile(x, 0.99), np.max(x))
                    cells.append(f"{' / '.join(f'{y:.0e}' for y in numbers)} ({count})")
                print(f"| {name} | {dtype} | {label} | {' | '.join(cells)} |", flush=True)
