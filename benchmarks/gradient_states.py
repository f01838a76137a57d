"""Derivatives in very many states, a part of them exactly at singular spots.

    python -m benchmarks.gradient_states [--states 100000] [--scenes distance spring …] [--product]

Each kind of joint, coupling, force, stop and contact between two bodies, in the plane and in space,
and straight and folded mechanisms, under stabilisers in turn (under all of them with `--product`),
in both precisions: the derivative of three steps by positions, velocities, masses and the numbers
of the element, forward and reverse. Counted are derivatives that are not finite; compared are
forward with reverse mode, and in float64 some states with central differences extrapolated to a
step of zero.

States are random by 1e-6 to 1 m and rad from assembly and 1e-6 to 10 m/s and rad/s; at assembly,
where bodies are unturned, chains straight and constraints exactly met, at rest or moving; with all
bodies in one place, where what has a length has none, at rest or moving; and near to that, by
1e-12 to 1e-2 m, not nearer.
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
"""Shares of the states."""
SMOOTH = ("random", "at rest", "moving")
"""States at which a length has a derivative."""
OFF_ENDS = ("random",)
"""Those of what has an end, at which assembly leaves it: the sides of that have two derivatives."""
APART = {"float64": 1e-8, "float32": 1e-2}
"""By what the modes may differ, relative to the largest part of the derivative."""
OFF = 1e-6
"""By what differences may."""
LEVELS = 8
METHODS = {name: jc.Method(stabilizer=x) for name, x in STABILIZERS.items()} | {
    "RATTLE": jc.Method(jc.RATTLE()),
    "generalized-α": jc.Method(jc.GeneralizedAlpha(), jc.Unstabilized()),
}
IN_ROUNDS = ("multipliers", "hybrid")
"""Methods that solve several times a step, for which bounded rows have no place."""


@dataclass(frozen=True)
class States:
    """Starts, a row for each.

    Attributes:
        q, v: positions and velocities, (n, n_q) and (n, n_v).
        kinds: indices into `KINDS`, (n,).
    """

    q: np.ndarray
    v: np.ndarray
    kinds: np.ndarray


def drawn(subject: Subject, n: int, seed: int = 0) -> States:
    """So many states of all kinds."""
    random, state = np.random.default_rng(seed), subject.state
    kinds = random.choice(len(KINDS), size=n, p=list(KINDS.values()))
    names = np.array(list(KINDS))[kinds]
    place = 10.0 ** random.uniform(-6, 0, (n, 1)) * random.normal(size=(n, len(state.v)))
    speed = 10.0 ** random.uniform(-6, 1, (n, 1)) * random.normal(size=(n, len(state.v)))
    near = 10.0 ** random.uniform(-12, -2, (n, 1)) * random.normal(size=(n, len(state.v)))
    one = np.char.find(names, "one place") >= 0
    move = np.where((names == "random")[:, None], place, 0)
    move = np.where((names == "almost in one place")[:, None], near, move)
    start = np.where(one[:, None], together(subject), np.asarray(state.q))
    q = jax.jit(jax.vmap(subject.system.retract))(jnp.asarray(start), jnp.asarray(move))
    rest = np.char.endswith(names, "at rest")
    return States(np.asarray(q), np.where(rest[:, None], 0, speed), kinds)


def together(subject: Subject) -> np.ndarray:
    """Positions with all bodies in the place of the first, unturned."""
    layout, q = subject.system.layout, np.array(subject.state.q)
    first = q[layout.q(layout.bodies[0])[: layout.dim]].copy()
    for name in layout.bodies:
        q[layout.q(name)[: layout.dim]] = first
    return q


def subject_of(name: str, dim: int) -> Subject:
    """A scene, differentiated by the mass of a body and all real numbers of its elements."""
    system, state = build(name, dim)
    parameters = [(body, "mass") for body in system.layout.bodies[-1:]]
    for element, fields in system.params.items():
        if element == "gravity" or element in system.layout.bodies:
            continue
        parameters += [(element, field) for field, x in fields.items() if searched(x)]
    return Subject(system, state, tuple(parameters))


def searched(x: Any) -> bool:
    """Whether all of a field are finite real numbers."""
    leaves = jax.tree.leaves(x)
    real = all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves)
    return bool(leaves) and real and all(np.all(np.isfinite(leaf)) for leaf in leaves)


def direction(subject: Subject, seed: int = 1) -> dict[str, Any]:
    """A way along which everything moves by about its size; what is zero stays, as friction may."""
    random = np.random.default_rng(seed)

    def one(x: jax.Array) -> jax.Array:
        size = jnp.max(jnp.abs(x), initial=0)
        return size * jnp.asarray(random.normal(size=x.shape), x.dtype)

    x = subject.numbers()
    moves = {name: jnp.ones_like(subject.state.v) for name in ("position", "velocity")}
    return jax.tree.map(one, x | moves)


def started(subject: Subject, q: jax.Array, v: jax.Array) -> tuple[Subject, dict[str, Any]]:
    """The subject in another state, and its numbers there."""
    moved = dataclasses.replace(subject, state=dataclasses.replace(subject.state, q=q, v=v))
    return moved, moved.numbers()


def both(subject: Subject, method: jc.Method, q: jax.Array, v: jax.Array, way: Any) -> Any:
    """Of one state: the derivative along a way by both modes, its size, what is finite, status.

    The size is the largest part that one leaf has in the derivative.
    """
    own, x = started(subject, q, v)

    def value(x: Any) -> tuple[jax.Array, jax.Array]:
        final = own.final(method, x)
        return own.weighed(final), final.status

    found, tangent, status = jax.linearize(value, x, has_aux=True)
    forward = tangent(way)
    (gradient,) = jax.linear_transpose(tangent, x)(jnp.ones_like(found))
    parts = jnp.stack(jax.tree.leaves(jax.tree.map(lambda g, w: jnp.sum(g * w), gradient, way)))
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradient)]
    return forward, jnp.sum(parts), jnp.max(jnp.abs(parts)), jnp.all(jnp.stack(finite)), status


def slopes(subject: Subject, method: jc.Method, q: Any, v: Any, way: Any) -> Any:
    """Central differences of several states, halving steps, (n, levels)."""
    steps = STEP * 0.5 ** np.arange(LEVELS)

    def one(q: jax.Array, v: jax.Array) -> jax.Array:
        own, x = started(subject, q, v)

        def along(step: jax.Array) -> jax.Array:
            moved = jax.tree.map(lambda a, d: a + step * d, x, way)
            return own.outcome(method, moved)

        return jax.lax.map(along, jnp.asarray([*steps, *-steps]))

    ahead, behind = np.split(np.asarray(jax.jit(jax.vmap(one))(q, v)), 2, axis=1)
    return (ahead - behind) / (2 * steps)


@dataclass(frozen=True)
class Row:
    """What was found of one scene under one method.

    Attributes:
        states, failed: how many, and in how many the world fails and has no derivative.
        forward, reverse: by kind, how many derivatives are not finite.
        beyond: in how many the modes differ by more than `APART`.
        apart: by how much at most.
        compared, undecided, off: of the states compared with differences how many, in how many
            these do not tell, and how many are beyond `OFF`.
        error: the largest of those compared.
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
        """Derivatives that are not finite."""
        return sum(self.forward.values()) + sum(self.reverse.values())

    def __str__(self) -> str:
        head = f"| {self.scene} | {self.dim} | {self.method} | {self.dtype} | {self.states} |"
        modes = f" {self.failed} | {self.broken} | {self.apart:.1e} | {self.beyond} |"
        told = f" {self.compared - self.undecided} of {self.compared} | {self.error:.1e} |"
        where = {k: n for d in (self.forward, self.reverse) for k, n in d.items() if n}
        return head + modes + told + f" {self.off} |" + (f" {where}" if where else "")


def measure(name: str, dim: int, method: str, dtype: str, n: int, compared: int = 8) -> Row:
    """One row.

    Raises:
        ValueError: the method refuses the scene.
    """
    subject, chosen = subject_of(name, dim), METHODS[method]
    chosen.check_system(subject.system)
    states, way, own, given = drawn(subject, n), direction(subject), subject, chosen
    if dtype == "float32":
        own, given, way = single(subject), single(chosen), single(way)
    q, v = (jnp.asarray(x, dtype) for x in (states.q, states.v))
    run = jax.jit(jax.vmap(lambda q, v: both(own, given, q, v, way)))
    forward, reverse, size, finite, status = map(np.asarray, run(q, v))
    lost = np.asarray(failed(jnp.asarray(status)))
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = np.abs(forward - reverse) / np.where(size > 0, size, 1)
    good = np.isfinite(forward) & finite
    row = Row(
        name,
        dim,
        method,
        dtype,
        n,
        int(np.sum(lost)),
        counted(states.kinds[~np.isfinite(forward)]),
        counted(states.kinds[~finite]),
        int(np.sum(apart[good] > APART[dtype])),
        float(np.max(apart[good], initial=0)),
    )
    if dtype == "float32" or not compared:
        return row
    kinds = OFF_ENDS if name in ENDS else SMOOTH
    smooth = np.isin(np.array(list(KINDS))[states.kinds], kinds) & ~lost & good
    some = np.flatnonzero(smooth)[:compared]
    if not some.size:
        return row
    exact, doubt = ridders(slopes(subject, chosen, q[some], v[some], way))
    scale = np.where(size[some] > 0, size[some], 1)
    told = doubt / scale <= OFF
    error = np.abs(exact - reverse[some])[told] / scale[told]
    return dataclasses.replace(
        row,
        compared=len(some),
        undecided=int(np.sum(~told)),
        off=int(np.sum(error > OFF)),
        error=float(np.max(error, initial=0)),
    )


def counted(kinds: np.ndarray) -> dict[str, int]:
    """How many there are of each kind."""
    return {name: int(np.sum(kinds == i)) for i, name in enumerate(KINDS)}


def admitted(name: str, dim: int, methods: list[str]) -> list[str]:
    """Those of the methods that take a scene."""
    system, _ = build(name, dim)
    found = []
    for method in methods:
        try:
            METHODS[method].check_system(system)
        except ValueError:
            continue
        if name not in ENDS or method not in IN_ROUNDS:
            found.append(method)
    return found


def choices(scenes: Any, product: bool) -> Iterator[tuple[str, int, list[str], str]]:
    """Scene, dimension, methods of which the first that takes it is meant, and precision.

    Methods come in turn, or each by itself. Some refuse a scene only when a step is traced.
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
    """The row of the first method that does not refuse the scene; None where all do."""
    for method in methods:
        try:
            return measure(name, dim, method, dtype, n, compared)
        except ValueError as reason:
            print(f"{name}, {dim}, {method}: {reason}", flush=True)
    return None


def main() -> None:
    """The table, and sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--states", type=int, default=100_000)
    parser.add_argument("--scenes", nargs="*")
    parser.add_argument("--compared", type=int, default=8)
    parser.add_argument("--product", action="store_true")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    scenes = [x for x in SCENES if given.scenes is None or x[0] in given.scenes]
    every = list(choices(scenes, given.product))
    each = -(-given.states // len(every))
    total = collections.Counter[str]()
    print("| scene | | method | precision | states | failed | not finite | modes apart | beyond |")
    for choice in every:
        row = of_first(*choice, each, given.compared)
        if row is None:
            continue
        print(row, flush=True)
        whole = ("states", "failed", "broken", "beyond", "compared", "undecided", "off")
        total.update({what: getattr(row, what) for what in whole})
        jax.clear_caches()
    print(dict(total))


if __name__ == "__main__":
    main()
