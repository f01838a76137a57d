"""The trees of rigid bodies that joints span, and when their equations are solved along the joints.

Elimination along the joints (`tree_equations`) works on the motions that a joint allows, block
elimination (`Sparse`) on its rows. For hinges and slides in space, that is one number instead of
five.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp

from jaxcon.constraints.armature import Armatures
from jaxcon.constraints.base import Joints
from jaxcon.core.typing import Array
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.proximal import RankSafe
from jaxcon.linear.saddle import Diagonal, Saddle
from jaxcon.linear.sparse import Sparse
from jaxcon.linear.tree_equations import TreeEquations, joint_places
from jaxcon.linear.trees import Tree, structure, tree_of
from jaxcon.system.bodies import PlanarRigid, SpatialRigid
from jaxcon.system.frames import SpatialFrame

if TYPE_CHECKING:
    from jaxcon.constraints.rows import RowLayout
    from jaxcon.protocols import Solver, Stabilizer, System

DEPTH = 12
"""The largest depth of a tree whose joints are eliminated along the tree in single precision.

With arms from the root, rounding errors grow with the square of the depth.
"""


def tree_of_joints(system: System, joints: Jacobian, layout: RowLayout) -> Tree | None:
    """Returns the tree of a system's bodies.

    Args:
        system: the system.
        joints: the Jacobian of the equality rows.
        layout: the layout of the equality rows.

    Returns:
        The tree; None if there are particles, closed loops, or constraints other than rotors and
        joints whose rows depend on relative motion only.
    """
    if system.layout is None or len(system.layout.groups) != 1 or layout.loops:
        return None
    others = (x for x in system.constraints if not isinstance(x, Armatures))
    if not all(isinstance(x, Joints) and x.relative for x in others):
        return None
    (group,) = system.layout.groups
    if not isinstance(group.kind, SpatialRigid | PlanarRigid):
        return None
    soft = frozenset(
        start
        for start, own in joints.by_rows()
        if not layout.holds[start : start + own[0].shape[0] * own[0].shape[1]].all()
    )
    tree = tree_of(structure(joints), soft, len(group.names), group.kind.n_v)
    if tree is None:
        return None
    rotors = [own for start, own in joints.by_rows() if start in soft]
    if any(len(own) > 2 or joint_places(tree, own) is None for own in rotors):
        return None
    return tree


def tree_equations(system: System, q: Array, v: Array, tree: Tree, saddle: Saddle) -> TreeEquations:
    """Returns the factored equations of motion of the trees of a system.

    Args:
        system: the system, of which `tree_of_joints` is the tree.
        q: positions, (n_q,).
        v: velocities, (n_v,).
        tree: the tree.
        saddle: the saddle system at q.
    """
    assert system.layout is not None
    (group,) = system.layout.groups
    frame = group.kind.frame(*group.unpack(q, v))
    rotation = frame.rotation if isinstance(frame, SpatialFrame) else None
    assert group.v == 0
    return TreeEquations.of(tree, frame.position, rotation, saddle)


def follows_tree(solver: Solver, stabilizer: Stabilizer, tree: Tree, saddle: Saddle) -> bool:
    """Returns True if a saddle system may be solved by elimination along the joints of a tree.

    It is if the solver has no options that change the solution, and if the stabilizer keeps the
    joints together, as drift is an error of this elimination.

    Args:
        solver: the solver of the method.
        stabilizer: the stabilizer of the method.
        tree: the tree of the bodies.
        saddle: the saddle system.
    """
    if not saddle.target.size or not stabilizer.reduces_errors:
        return False
    deep = tree.depth > DEPTH and jnp.finfo(saddle.force.dtype).bits <= 32
    return not deep and _is_plain(solver)


def tree_without_contact(
    system: System, solver: Solver, stabilizer: Stabilizer, saddle: Saddle
) -> Tree | None:
    """Returns the tree along whose joints a saddle system is solved in a scene without contact.

    Args:
        system: the system.
        solver: the solver of the method.
        stabilizer: the stabilizer of the method.
        saddle: the saddle system, with hard joints.

    Returns:
        The tree; None if the solver of the method solves the system.
    """
    if not _is_plain(solver) or not isinstance(saddle.mass, Diagonal) or saddle.layout is None:
        return None
    tree = tree_of_joints(system, saddle.jacobian, saddle.layout)
    if tree is None or not follows_tree(solver, stabilizer, tree, saddle):
        return None
    assert system.layout is not None  # it has a tree
    in_space = isinstance(system.layout.groups[0].kind, SpatialRigid)
    return tree if in_space and _is_faster(tree, not saddle.layout.holds.all()) else None


def _is_faster(tree: Tree, rotors: bool) -> bool:
    """Returns True if elimination along joints in space is faster than block elimination.

    Measured in single precision with 128 worlds, for robots of MuJoCo without stops and contact:
    1.5 to 2.5 (ant), 1.3 to 1.9 (hopper), 1.1 to 1.3 (half-cheetah) and 1.03 to 1.2 times as fast
    (humanoid); without rotors, the ant 1.2 and the hopper 0.9 times, and a chain of five hinges
    0.55 times.

    Args:
        tree: the tree of the bodies.
        rotors: True if there are rotors, each of which is one more row for block elimination.
    """
    branches = [b for b in tree.branches if b.row is not None]
    jointed = sum(len(b.bodies) for b in branches)
    # block elimination skips bodies without joints, and joints of many freedoms have few rows
    if len(tree.bodies) > 2 * jointed or any(b.freedom > 3 for b in branches):
        return False
    return rotors or jointed >= 2 * len(branches)


def _is_plain(solver: Solver) -> bool:
    """Returns True if a solver has no options that change the solution of a tree of joints."""
    if type(solver) is RankSafe:
        return not solver.always and _is_plain(solver.solver)
    return type(solver) is Sparse and solver.tikhonov is None
