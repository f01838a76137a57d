"""By how much a step misses each law of bounded rows, at random states.

`python -m benchmarks.bounded --laws` prints it, for the states of that study. The laws are judged
by what the step did, J v⁺ and λ, and not by the solver's own measure.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks.bounded import SCENES, STEP
from jaxcon.constraints.bounds import BoundRows, linearize_bounds
from jaxcon.constraints.rows import linearize
from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree
from jaxcon.core.status import failed
from jaxcon.dynamics.impacts import landing


class Laws(NamedTuple):
    """By how much a step misses each law of its bounded rows, at worst, in proportion.

    What a contact wants of the step in which it lands is that of `impacts.landing`: both solvers
    are judged on steps that are one problem, not on impacts.
    Velocities are related to the largest at the start, V, and so are multipliers, as the velocities
    that they give to their own rows, λ̂ = h g λ/V with g as of `moved`. With û = (J v⁺ − u*)/V, û_t
    the slip, and r̂ = μ λ̂_n or the bound of a joint's friction:

    Attributes:
        complementarity: |min(λ̂, û)|, and |min(r̂ − ‖λ̂_t‖, ‖û_t‖)|: what is left of the bound lets
            nothing slip.
        cone: ‖λ̂_t‖ − r̂, where positive.
        separation: û, where positive, of contacts that bear, λ_n > 0, whether they slide or not.
        direction: ‖λ̂_t/r̂ + û_t/‖û_t‖‖ where r̂ and ‖û_t‖ are more than `SLIDES`: the sine of a small
            angle between friction and −u_t; 2 if friction drives.
        energy: h λ·(u₀ + u)/2, u₀ and u without and with λ, where positive, in kinetic energies of
            the start. As u − u₀ = G λ it is not more than h λ·u, which is what recovery from an
            overlap does, h Σ λ u* with u* > 0; that part is taken off.
    """

    complementarity: Any
    cone: Any
    separation: Any
    direction: Any
    energy: Any


SLIDES = 1e-3
"""The slip, and the friction, from which on they have a direction."""
ALLOWED = {"float64": 1e-8, "float32": 1e-5}
"""Of every law; of a direction as much more as what has it is small."""


@pytree
class OneProblem(jc.InteriorPoint):
    """The interior point in steps that share a landing with the next one, as beside sweeps."""

    exact = False


JUDGED = {"GaussSeidel(30)": jc.GaussSeidel(), "InteriorPoint(30)": OneProblem()}
"""Both solvers with their numbers by default; a landing is shared with the next step."""
BLOCK = 1000
"""How many worlds are stepped at once."""


def judged(rows: BoundRows, forces: Any, ends: tuple[Any, Any], size: tuple[Any, ...]) -> Laws:
    """The laws of one step.

    Args:
        rows: at its start.
        forces: λ, (n,).
        ends: v at its end without and with them, (n_v,) each.
        size: V, () [m/s], h g, (n,) [s/kg], and the kinetic energy of the start, () [J].
    """
    speed, gain, energy = size
    before, after = (rows.jacobian.apply(v) for v in ends)
    x = rows.kinds.split(forces * gain / speed)
    u = rows.kinds.split((after - rows.target) / speed)
    push, away = (jnp.concatenate([y.single, y.normal]) for y in (x, u))
    rub, slip = (_rubbing(y) for y in (x, u))
    most = rows.upper * rows.kinds.split(gain).box / speed
    radius = jnp.concatenate([most, rows.friction * x.normal])
    held, slipped = numerics.norm(rub), numerics.norm(slip)
    across = rub * numerics.safe_divide(1.0, radius) + slip * numerics.safe_divide(1.0, slipped)
    slides = jnp.minimum(slipped, radius) > SLIDES
    work = jnp.sum(forces * ((before + after) / 2 - jnp.maximum(rows.target, 0)))
    missed = (
        jnp.abs(jnp.concatenate([jnp.minimum(push, away), jnp.minimum(radius - held, slipped)])),
        held - radius,
        jnp.where(x.normal > 0, u.normal, 0),
        jnp.where(slides, numerics.norm(across), 0),
        (STEP * work / energy)[None],
    )
    return Laws(*(jnp.max(y, initial=0) for y in missed))


def _rubbing(parts: Any) -> Vector:
    """What rubs, in joints and, with as many tangents as they have, in contacts."""
    slip = parts.discs[0] or Vector(parts.normal)
    rest = [0 * parts.box for _ in slip[1:]]
    own = zip([parts.box, *rest], slip, strict=True)
    return Vector(*(jnp.concatenate(pair) for pair in own))


def moved(system: Any, state: Any, rows: BoundRows) -> jax.Array:
    """g, (n,): how a unit of a multiplier accelerates its own row, the joints holding.

    It is the diagonal of J M⁻¹ Jᵀ − B A⁻¹ Bᵀ, A of the joints' rows and B between both; of the rows
    of a contact, the largest.
    """
    j = rows.jacobian.dense()
    joints = linearize(system, state.q, state.v, state.time).jacobian.dense()
    light = 1 / system.mass(state.q).diagonal[None]
    own = jnp.sum(j * j * light, axis=1)
    if len(joints):
        between = (joints * light) @ j.T
        own -= jnp.sum(between * jnp.linalg.solve((joints * light) @ joints.T, between), axis=0)
    return rows.kinds.largest(own)


def measure(name: str, dtype: Any, solver: Any, worlds: int) -> Laws:
    """By how much the laws are missed at random states, (worlds,) each; ∞ where a step failed."""
    build, drawn = SCENES[name]
    system, state = build(dtype)
    bare = dataclasses.replace(system, bounds=())
    method, h = jc.Method(bounded=solver), jnp.asarray(STEP, dtype)
    given = jc.init(system, method, state.q, state.v), jc.init(bare, method, state.q, state.v)

    def one(key: jax.Array) -> Laws:
        start, alone = (drawn(key, system, x) for x in given)
        rows = linearize_bounds(system, start.q, start.v, start.time, None, h)
        new, info = jc.step(system, method, start, None, h)
        free, _ = jc.step(bare, method, alone, None, h)
        rows = landing(rows, rows.jacobian.apply(free.v - start.v), h)
        speed, energy = jnp.max(jnp.abs(start.v)), jc.energy(system, start).kinetic
        size = speed, h * moved(system, start, rows), energy
        found = judged(rows, info.reactions.multipliers, (free.v, new.v), size)
        return jax.tree.map(lambda x: jnp.where(failed(new.status), jnp.inf, x), found)

    run = jax.jit(jax.vmap(one))
    keys = jax.random.split(jax.random.PRNGKey(0), worlds)
    found = [run(keys[i : i + BLOCK]) for i in range(0, worlds, BLOCK)]
    return Laws(*(np.concatenate(x) for x in zip(*found, strict=True)))


def beyond(found: Laws, dtype: Any) -> Laws:
    """How many worlds miss each law by more than is allowed."""
    most = Laws(*[ALLOWED[jnp.dtype(dtype).name]] * len(Laws._fields))
    most = most._replace(direction=most.direction / SLIDES)
    return Laws(*(int(np.sum(~(x <= y))) for x, y in zip(found, most, strict=True)))


def table(scenes: list[str], dtypes: list[str], worlds: int) -> None:
    """Prints a table of all laws."""
    print(f"{worlds} states; median / 99 % / worst (states beyond {ALLOWED})")
    print(f"| scene | | | {' | '.join(Laws._fields)} |\n{'|---' * (3 + len(Laws._fields))}|")
    for name in scenes:
        for dtype in dtypes:
            for label, solver in JUDGED.items():
                found = measure(name, jnp.dtype(dtype), solver, worlds)
                cells = []
                for x, over in zip(found, beyond(found, dtype), strict=True):
                    shown = (np.median(x), np.quantile(x, 0.99), np.max(x))
                    cells.append(f"{' / '.join(f'{y:.0e}' for y in shown)} ({over})")
                print(f"| {name} | {dtype} | {label} | {' | '.join(cells)} |", flush=True)
