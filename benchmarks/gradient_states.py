"""Derivatives over very many states, some of them exactly at singular configurations.

    python -m benchmarks.gradient_states [--states 100000] [--scenes distance spring …] [--product]

Scenes have each kind of joint, coupling, force, joint limit and contact between two bodies, in the
plane and in space. Other scenes are straight and folded mechanisms. The stabilizers take turns over
the scenes; with `--product`, each scene runs with all of them. Both precisions are used.

The result of three steps is differentiated with respect to positions, velocities, masses and the
parameters of the element, in forward and reverse mode. The study counts non-finite derivatives and
compares both modes. In float64, some states are compared with central differences extrapolated to
zero step.

States are of four kinds:

- random, 1e-6 to 1 m and rad from assembly, with 1e-6 to 10 m/s and rad/s,
- at assembly, at rest or moving: bodies unrotated, chains straight, constraints exact,
- all bodies at one point, so that lengths are zero, at rest or moving,
- all bodies 1e-12 to 1e-2 m from one point.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks.gradient_elements import ENDS
from benchmarks.gradient_scenes import SCENES, build
from benchmarks.gradient_table import DTYPES, STABILIZERS, STEP, Subject, single
from jaxcon.analysis.differences import ridders
from jaxcon.core.status import failed

KINDS = {
    "random": 0.6,
    "at rest": 0.08,
    "moving": 0.08,
    "in one place, at rest": 0.08,
    "in one place, moving": 0.08,
    "almost in one place": 0.08,
}
"""Kinds of states with their shares."""
SMOOTH = ("random", "at rest", "moving")
"""Kinds of states at which a length is differentiable."""
OFF_ENDS = ("random",)
"""Kinds of states at which contacts and joint limits (`ENDS`) are differentiable.

At assembly, their one-sided derivatives differ.
"""
APART = {"float64": 1e-8, "float32": 1e-2}
"""Bound on the difference of both modes, relative to the largest part of the derivative."""
OFF = 1e-6
"""Bound on the difference from finite differences, relative to that largest part."""
LEVELS = 8
METHODS = {name: jc.Method(stabilizer=x) for name, x in STABILIZERS.items()} | {
    "RATTLE": jc.Method(jc.integrators.RATTLE()),
    "generalized-α": jc.Method(jc.integrators.GeneralizedAlpha(), jc.stabilizers.Unstabilized()),
}
IN_ROUNDS = ("multipliers", "hybrid")
"""Methods that solve several times per step; they do not support inequality constraints."""


@dataclass(frozen=True)
class States:
    """Initial states, one per row.

    Attributes:
        q: positions, (n, n_q).
        v: velocities, (n, n_v).
        kinds: indices into `KINDS`, (n,).
    """

    q: np.ndarray
    v: np.ndarray
    kinds: np.ndarray


def drawn(subject: Subject, n: int, seed: int = 0) -> States:
    """Draws `n` states of all kinds."""
    random, state = np.random.default_rng(seed), subject.state
    kinds = random.choice(len(KINDS), size=n, p=list(KINDS.values()))
    names = np.array(list(KINDS))[kinds]
    place = 10.0 ** random.uniform(-6, 0, (n, 1)) * random.normal(size=(n, len(state.v)))
    speed = 10.0 ** random.uniform(-6, 1, (n, 1)) * random.normal(size=(n, len(state.v)))
    near = 10.0 ** random.uniform(-12, -2, (n, 1)) * random.normal(size=(n, len(state.v)))
    coincident = np.char.find(names, "one place") >= 0
    move = np.where((names == "random")[:, None], place, 0)
    move = np.where((names == "almost in one place")[:, None], near, move)
    start = np.where(coincident[:, None], together(subject), np.asarray(state.q))
    q = jax.jit(jax.vmap(subject.system.retract))(jnp.asarray(start), jnp.asarray(move))
    rest = np.char.endswith(names, "at rest")
    return States(np.asarray(q), np.where(rest[:, None], 0, speed), kinds)


def together(subject: Subject) -> np.ndarray:
    """Returns positions with all bodies at the position of the first body, unrotated."""
    layout, q = subject.system.layout, np.array(subject.state.q)
    first = q[layout.q(layout.bodies[0])[: layout.dim]].copy()
    for name in layout.bodies:
        q[layout.q(name)[: layout.dim]] = first
    return q


def subject_of(name: str, dim: int) -> Subject:
    """Builds a scene, to be differentiated by one body's mass and all real element parameters."""
    system, state = build(name, dim)
    parameters = [(body, "mass") for body in system.layout.bodies[-1:]]
    for element, fields in system.params.items():
        if element == "gravity" or element in system.layout.bodies:
            continue
        parameters += [(element, field) for field, x in fields.items() if searched(x)]
    return Subject(system, state, tuple(parameters))


def searched(x: Any) -> bool:
    """Returns True if all entries of a parameter are finite real numbers."""
    leaves = jax.tree.leaves(x)
    real = all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves)
    return bool(leaves) and real and all(np.all(np.isfinite(leaf)) for leaf in leaves)


def direction(subject: Subject, seed: int = 1) -> dict[str, Any]:
    """Draws a random direction for all variables, scaled with the size of each.

    Zeros, such as no friction, stay zero.
    """
    random = np.random.default_rng(seed)

    def random_move(x: jax.Array) -> jax.Array:
        size = jnp.max(jnp.abs(x), initial=0)
        return size * jnp.asarray(random.normal(size=x.shape), x.dtype)

    x = subject.numbers()
    moves = {name: jnp.ones_like(subject.state.v) for name in ("position", "velocity")}
    return jax.tree.map(random_move, x | moves)


def started(subject: Subject, q: jax.Array, v: jax.Array) -> tuple[Subject, dict[str, Any]]:
    """Returns the subject with another initial state, and its variables at that state."""
    moved = dataclasses.replace(subject, state=dataclasses.replace(subject.state, q=q, v=v))
    return moved, moved.numbers()


def both(subject: Subject, method: jc.Method, q: jax.Array, v: jax.Array, way: Any) -> Any:
    """Returns the derivative at one state in forward and in reverse mode.

    Returns:
        The directional derivative in forward mode and in reverse mode, its size, True if the
        gradient is finite, and the status. The size is the largest contribution of one leaf.
    """
    subject_at, x = started(subject, q, v)

    def value(x: Any) -> tuple[jax.Array, jax.Array]:
        final = subject_at.final(method, x)
        return subject_at.weighed(final), final.status

    outcome, tangent, status = jax.linearize(value, x, has_aux=True)
    forward = tangent(way)
    (gradient,) = jax.linear_transpose(tangent, x)(jnp.ones_like(outcome))
    parts = jnp.stack(jax.tree.leaves(jax.tree.map(lambda g, w: jnp.sum(g * w), gradient, way)))
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradient)]
    return forward, jnp.sum(parts), jnp.max(jnp.abs(parts)), jnp.all(jnp.stack(finite)), status


def slopes(subject: Subject, method: jc.Method, q: Any, v: Any, way: Any) -> Any:
    """Returns central differences at a batch of states, with halved steps, (n, levels)."""
    steps = STEP * 0.5 ** np.arange(LEVELS)

    def differences(q: jax.Array, v: jax.Array) -> jax.Array:
        subject_at, x = started(subject, q, v)

        def value_at(step: jax.Array) -> jax.Array:
            moved = jax.tree.map(lambda a, d: a + step * d, x, way)
            return subject_at.outcome(method, moved)

        return jax.lax.map(value_at, jnp.asarray([*steps, *-steps]))

    ahead, behind = np.split(np.asarray(jax.jit(jax.vmap(differences))(q, v)), 2, axis=1)
    return (ahead - behind) / (2 * steps)


@dataclass(frozen=True)
class Row:
    """Result of one scene under one method.

    Attributes:
        scene: name of the scene.
        dim: its dimension.
        method: name of the method.
        dtype: precision.
        states: number of states.
        failed: number of worlds that fail; these have no derivative.
        forward: number of non-finite derivatives in forward mode, by kind of state.
        reverse: number of non-finite derivatives in reverse mode, by kind of state.
        beyond: number of states at which the modes differ by more than `APART`.
        apart: the largest difference of the modes.
        compared: number of states compared with finite differences.
        undecided: number of compared states with inaccurate finite differences.
        off: number of compared states with an error above `OFF`.
        error: the largest error of the compared states.
    """

    scene: str
    dim: int
    method: str
    dtype: str
    states: int
    failed: int
    forward: dict[str, int]
    reverse: dict[str, int]
    beyond: int
    apart: float
    compared: int = 0
    undecided: int = 0
    off: int = 0
    error: float = 0.0

    @property
    def broken(self) -> int:
        """The number of non-finite derivatives."""
        return sum(self.forward.values()) + sum(self.reverse.values())

    def __str__(self) -> str:
        head = f"| {self.scene} | {self.dim} | {self.method} | {self.dtype} | {self.states} |"
        modes = f" {self.failed} | {self.broken} | {self.apart:.1e} | {self.beyond} |"
        decided = f" {self.compared - self.undecided} of {self.compared} | {self.error:.1e} |"
        where = {k: n for d in (self.forward, self.reverse) for k, n in d.items() if n}
        return head + modes + decided + f" {self.off} |" + (f" {where}" if where else "")


def measure(name: str, dim: int, method: str, dtype: str, n: int, compared: int = 8) -> Row:
    """Measures one scene under one method.

    Raises:
        ValueError: the method refuses the scene.
    """
    subject, chosen = subject_of(name, dim), METHODS[method]
    chosen.check_system(subject.system)
    states, way, cast_subject, cast_method = drawn(subject, n), direction(subject), subject, chosen
    if dtype == "float32":
        cast_subject, cast_method, way = single(subject), single(chosen), single(way)
    q, v = (jnp.asarray(x, dtype) for x in (states.q, states.v))
    run = jax.jit(jax.vmap(lambda q, v: both(cast_subject, cast_method, q, v, way)))
    forward, reverse, size, finite, status = map(np.asarray, run(q, v))
    failures = np.asarray(failed(jnp.asarray(status)))
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = np.abs(forward - reverse) / np.where(size > 0, size, 1)
    good = np.isfinite(forward) & finite
    row = Row(
        name,
        dim,
        method,
        dtype,
        n,
        int(np.sum(failures)),
        counted(states.kinds[~np.isfinite(forward)]),
        counted(states.kinds[~finite]),
        int(np.sum(apart[good] > APART[dtype])),
        float(np.max(apart[good], initial=0)),
    )
    if dtype == "float32" or not compared:
        return row
    kinds = OFF_ENDS if name in ENDS else SMOOTH
    smooth = np.isin(np.array(list(KINDS))[states.kinds], kinds) & ~failures & good
    picked = np.flatnonzero(smooth)[:compared]
    if not picked.size:
        return row
    exact, uncertainty = ridders(slopes(subject, chosen, q[picked], v[picked], way))
    scale = np.where(size[picked] > 0, size[picked], 1)
    decided = uncertainty / scale <= OFF
    error = np.abs(exact - reverse[picked])[decided] / scale[decided]
    return dataclasses.replace(
        row,
        compared=len(picked),
        undecided=int(np.sum(~decided)),
        off=int(np.sum(error > OFF)),
        error=float(np.max(error, initial=0)),
    )


def counted(kinds: np.ndarray) -> dict[str, int]:
    """Counts the states of each kind."""
    return {name: int(np.sum(kinds == i)) for i, name in enumerate(KINDS)}


def admitted(name: str, dim: int, methods: list[str]) -> list[str]:
    """Returns the names of the methods that accept a scene."""
    system, _ = build(name, dim)
    accepted = []
    for method in methods:
        try:
            METHODS[method].check_system(system)
        except ValueError:
            continue
        if name not in ENDS or method not in IN_ROUNDS:
            accepted.append(method)
    return accepted


def choices(scenes: Any, product: bool) -> Iterator[tuple[str, int, list[str], str]]:
    """Yields scene, dimension, methods and precision.

    The caller uses the first of the methods that accepts the scene, because some methods refuse a
    scene only when a step is traced. The first method of the list changes in turn. With `product`,
    each method is yielded on its own.
    """
    turn = itertools.count()
    for name, dim in scenes:
        methods = admitted(name, dim, list(METHODS))
        for dtype in DTYPES:
            first = next(turn) % len(methods)
            in_turn = [methods[first:] + methods[:first]]
            yield from (
                (name, dim, x, dtype) for x in ([[y] for y in methods] if product else in_turn)
            )


def of_first(
    name: str, dim: int, methods: list[str], dtype: str, n: int, compared: int
) -> Row | None:
    """Returns the result of the first method that accepts the scene, or None if all refuse it."""
    for method in methods:
        try:
            return measure(name, dim, method, dtype, n, compared)
        except ValueError as reason:
            print(f"{name}, {dim}, {method}: {reason}", flush=True)
    return None


def main() -> None:
    """Prints a row of counts per scene and method, and their totals."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--states", type=int, default=100_000)
    parser.add_argument("--scenes", nargs="*")
    parser.add_argument("--compared", type=int, default=8)
    parser.add_argument("--product", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    scenes = [x for x in SCENES if options.scenes is None or x[0] in options.scenes]
    every = list(choices(scenes, options.product))
    each = -(-options.states // len(every))
    total = collections.Counter[str]()
    print(
        "| scene | | method | precision | states | failed | not finite | mode difference | beyond",
        end="",
    )
    print(" | compared | error | beyond |")
    for choice in every:
        row = of_first(*choice, each, options.compared)
        if row is None:
            continue
        print(row, flush=True)
        whole = ("states", "failed", "broken", "beyond", "compared", "undecided", "off")
        total.update({what: getattr(row, what) for what in whole})
        jax.clear_caches()
    print(dict(total))


if __name__ == "__main__":
    main()
