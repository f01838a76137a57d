"""The solver of inequality constraints that a scene gets unless one is chosen."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.bounds import linearize_at_rest
from jaxcon.constraints.rows import linearize
from jaxcon.core.typing import Array, PyTree
from jaxcon.solvers.gauss_seidel import GaussSeidel
from jaxcon.solvers.interior_point import InteriorPoint
from jaxcon.solvers.jacobian import Jacobian

EXACT_UP_TO = 24
"""The largest number of inequality rows that `InteriorPoint` solves by default in every scene."""

Body = tuple[int, int]
"""The first column of a group of bodies, and the number of a body in it."""


def default_contact_solver(system: Any, q: Array, v: Array) -> Any:
    """Returns the fastest solver of inequality constraints that holds a scene, by its structure.

    `InteriorPoint` is exact, but inverts an n×n matrix in each of its 10 to 20 iterations, O(n³). A
    sweep of `GaussSeidel` is O(n²). Sweeps converge slowly where loads pass through contacts from
    body to body, as in a stack with a heavy top. In a robot they pass through joints, which are
    solved exactly. So `GaussSeidel` is taken beyond 24 rows where nothing is `stacked`.

    One of Gymnasium's models dropped for 2 s at 2 ms in float32: CPU time of a step, how deep it is
    in the floor and how far beyond a stop at worst. No joint opens further by sweeps.

        ==============  ============================  =============================
        model, rows     InteriorPoint                 GaussSeidel
        ==============  ============================  =============================
        hopper, 30      164 µs, 2e-4 mm, 3e-7 rad     31 µs, 1e-4 mm, 5e-7 rad
        walker, 48      304 µs, 7e-4 mm, 4e-7 rad     53 µs, 1e-2 mm, 4e-6 rad
        ant, 83         1835 µs, 5e-4 mm, 5e-7 rad    117 µs, 1e-2 mm, 3e-7 rad
        humanoid, 213   15323 µs, 1e-2 mm, 1e-4 rad   508 µs, 2e-2 mm, 6e-3 rad
        ==============  ============================  =============================

    Args:
        system: any system; its numbers do not matter and may be traced.
        q: positions, (n_q, …), worlds along trailing axes.
        v: velocities, (n_v, …).
    """
    if not system.bounds:
        return InteriorPoint()
    rows = jax.eval_shape(linearize_at_rest, system, q, v)
    if rows.kinds.size <= EXACT_UP_TO:
        return InteriorPoint()
    constraints = jax.eval_shape(linearize, system, q, v, jnp.zeros((1,) * (q.ndim - 1), q.dtype))
    return InteriorPoint() if stacked(constraints.jacobian, rows.jacobian) else GaussSeidel()


def first_multipliers(system: Any, q: Array, v: Array, solver: Any = None) -> PyTree:
    """Returns zeros (n,), from which a warm-started solver begins; () where it has no warm start.

    Args:
        system: any system.
        q: positions, (n_q,).
        v: velocities, (n_v,).
        solver: of the inequality constraints; None for the default one.
    """
    if not system.bounds:
        return ()
    solver = default_contact_solver(system, q, v) if solver is None else solver
    if not solver.warm:
        return ()
    return jnp.zeros(jax.eval_shape(linearize_at_rest, system, q, v).kinds.size, q.dtype)


def stacked(constraints: Jacobian, inequalities: Jacobian) -> bool:
    """Returns True where an inequality acts between two bodies that no chain of joints connects.

    Args:
        constraints: J of the constraints, of which shapes are enough.
        inequalities: J of the inequality constraints, likewise.
    """
    parent: dict[Body, Body] = {}

    def mechanism(body: Body) -> Body:
        while body in parent:
            body = parent[body]
        return body

    for bodies in _bodies(constraints):
        first = mechanism(bodies[0])
        for body in bodies[1:]:
            if (other := mechanism(body)) != first:
                parent[other] = first
    return any(len({mechanism(body) for body in own}) > 1 for own in _bodies(inequalities))


def _bodies(jacobian: Jacobian) -> list[list[Body]]:
    """The bodies on which each element with rows in a Jacobian acts."""
    elements: dict[tuple[int, int], list[Body]] = {}
    for block in jacobian.blocks:
        for i, body in enumerate(block.columns.indices):
            elements.setdefault((block.start, i), []).append((block.columns.start, body))
    return list(elements.values())
