"""Choice of the default solver of a scene's inequality constraints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import linearize
from jaxcon.contact.body_space import tree_below
from jaxcon.contact.gauss_seidel import GaussSeidel
from jaxcon.contact.interior_point import InteriorPoint
from jaxcon.contact.newton import Newton
from jaxcon.contact.rows import linearize_at_rest
from jaxcon.core.typing import Array, PyTree
from jaxcon.linear.jacobian import Jacobian

if TYPE_CHECKING:
    from jaxcon.protocols import ContactSolver, System

EXACT_UP_TO = 24
"""The largest number of inequality rows for which `InteriorPoint` is always the default."""

Body = tuple[int, int]
"""A body: the first column of its group in J, and its index in the group."""


def default_contact_solver(system: System, q: Array, v: Array) -> ContactSolver:
    """Returns the fastest contact solver that suits the structure of a scene.

    `InteriorPoint` is exact, but inverts an n×n matrix in each of its 10 to 20 iterations, which is
    O(n³). A sweep of `GaussSeidel` is O(n²). Sweeps converge slowly if contacts transmit loads from
    body to body, as in a stack with a heavy top. In a robot, joints transmit the loads, and joints
    are solved exactly. An iteration of `Newton` is O(n), but it needs a tree of bodies. For more
    than 24 rows, unless bodies are `stacked`, the default is therefore `Newton`, or `GaussSeidel`
    if there is no such tree.

    The table shows models of Gymnasium, dropped for 2 s at h = 2 ms in float32. Each entry has the
    CPU time of a step of one world, the largest penetration of the floor, and the largest violation
    of a joint limit. All satisfy the joints equally well.

        ==============  ============================  =============================
        model, rows     InteriorPoint                 GaussSeidel
        ==============  ============================  =============================
        hopper, 30      164 µs, 2e-4 mm, 3e-7 rad     31 µs, 1e-4 mm, 5e-7 rad
        walker, 48      304 µs, 7e-4 mm, 4e-7 rad     53 µs, 1e-2 mm, 4e-6 rad
        ant, 83         1835 µs, 5e-4 mm, 5e-7 rad    117 µs, 1e-2 mm, 3e-7 rad
        humanoid, 213   15323 µs, 1e-2 mm, 1e-4 rad   508 µs, 2e-2 mm, 6e-3 rad
        ==============  ============================  =============================

    `Newton` penetrates the floor by 3e-4 mm (hopper), 6e-4 mm (walker), 8e-4 mm (ant) and 9e-3 mm
    (humanoid). In batches it is 1.9 times (hopper) to 11 times (humanoid) as fast as `GaussSeidel`.

    Args:
        system: any system; its numbers are not used and may be traced.
        q: positions, (n_q, …), with worlds along trailing axes.
        v: velocities, (n_v, …).
    """
    if not system.bounds:
        return InteriorPoint()
    rows = jax.eval_shape(linearize_at_rest, system, q, v)
    if rows.kinds.size <= EXACT_UP_TO:
        return InteriorPoint()
    constraints = jax.eval_shape(linearize, system, q, v, jnp.zeros((1,) * (q.ndim - 1), q.dtype))
    if stacked(constraints.jacobian, rows.jacobian):
        return InteriorPoint()
    tree = tree_below(system, constraints.jacobian, constraints.layout, rows)
    return GaussSeidel() if tree is None else Newton()


def first_multipliers(
    system: System, q: Array, v: Array, solver: ContactSolver | None = None
) -> PyTree:
    """Returns the initial multipliers λ of a warm-started solver, zeros (n,).

    The result is () if the solver has no warm start, or the system no inequality constraints.

    Args:
        system: any system.
        q: positions, (n_q,).
        v: velocities, (n_v,).
        solver: contact solver; None for the default.
    """
    if not system.bounds:
        return ()
    chosen = default_contact_solver(system, q, v) if solver is None else solver
    if not chosen.warm:
        return ()
    return jnp.zeros(jax.eval_shape(linearize_at_rest, system, q, v).kinds.size, q.dtype)


def stacked(constraints: Jacobian, inequalities: Jacobian) -> bool:
    """Returns True if an inequality acts between two bodies that no chain of joints connects.

    Args:
        constraints: Jacobian of the equality constraints; only its structure is used.
        inequalities: Jacobian of the inequality constraints; only its structure is used.
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
    """Returns the bodies on which each element of a Jacobian acts."""
    elements: dict[tuple[int, int], list[Body]] = {}
    for block in jacobian.blocks:
        for i, body in enumerate(block.columns.indices):
            elements.setdefault((block.start, i), []).append((block.columns.start, body))
    return list(elements.values())
