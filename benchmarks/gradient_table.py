"""Derivatives of rollouts, over everything that can be combined.

    python -m benchmarks.gradient_table [--scenes particle four-bar …] [--worlds 100000]

Every admissible triple of a stabiliser, an integrator and a solver, in both precisions: forward and
reverse mode by positions, velocities, masses and the numbers of joints, each against central
differences in float64 that are extrapolated to a step of zero. Then the derivatives in very many
random states in float32, none of which may be NaN.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks.stabilisation import INTEGRATORS, cast, chain, spatial_loop
from jaxcon.analysis.differences import ridders
from jaxcon.scenes import four_bar

DT, STEPS = 1e-2, 3
LONG = 2e-2
"""Step of generalized-α [s], whose multipliers are told by positions: it multiplies their rounding
by 1/h²."""
STABILIZERS = {
    "none": jc.Unstabilized(),
    "Baumgarte": jc.Baumgarte(),
    "PID": jc.PID(400.0, 40.0, 100.0),
    "adaptive": jc.AdaptiveBaumgarte(20.0, 20.0),
    "sliding window": jc.SlidingWindowBaumgarte(20.0),
    "penalty": jc.Penalty.from_time(0.1),
    "multipliers": jc.AugmentedLagrangian(),
    "hybrid": jc.Hybrid(jc.Penalty.from_time(0.1), soft_below=1e-3),
    "projection": jc.Projection(),
}
SOLVERS = {
    "rank-safe": jc.RankSafe(),
    "sparse": jc.Sparse(),
    "Schur": jc.Schur(),
    "dense": jc.Dense(),
    "conjugate gradients": jc.ConjugateGradients(),
    "priority": jc.Priority({"*": 1}),
}
DTYPES = ("float64", "float32")
BOUNDS = {"float64": 1e-6, "float32": 1e-3}
"""Relative to the largest derivative by each of the numbers."""
LEVELS = 7
STEP = 1e-3
"""The largest of the differences, halved so often."""


@dataclass(frozen=True)
class Choice:
    """One row of the table, by names."""

    integrator: str
    stabilizer: str
    solver: str
    dtype: str

    def method(self) -> jc.Method:
        """The method, its numbers in float64."""
        parts = INTEGRATORS[self.integrator], STABILIZERS[self.stabilizer], SOLVERS[self.solver]
        return jc.Method(*parts)

    def __str__(self) -> str:
        return "+".join(self.parts).replace(" ", "-")

    @property
    def parts(self) -> tuple[str, ...]:
        """All of it."""
        return self.integrator, self.stabilizer, self.solver, self.dtype


def choices() -> list[Choice]:
    """All that the integrators admit."""
    every = (Choice(*x) for x in itertools.product(INTEGRATORS, STABILIZERS, SOLVERS, DTYPES))
    return [x for x in every if not x.method().integrator.refuses(None, x.method().stabilizer)]


def pairs(choice: Choice) -> set[tuple[str, str]]:
    """Of parts."""
    return set(itertools.combinations(choice.parts, 2))


def covering(every: Iterable[Choice], wanted: Callable[[Choice], set[Any]] = pairs) -> list[Choice]:
    """Few of them in which everything wanted occurs that occurs in all of them."""
    left = list(every)
    still = {one for x in left for one in wanted(x)}
    found = []
    while still:
        best = max(left, key=lambda x: len(still & wanted(x)))
        still -= wanted(best)
        found.append(best)
    return found


@dataclass(frozen=True)
class Subject:
    """A scene, and what it is differentiated by.

    Attributes:
        system, state: in float64.
        parameters: pairs of element and field.
    """

    system: Any
    state: jc.State
    parameters: tuple[tuple[str, str], ...]

    def numbers(self) -> dict[str, Any]:
        """Moves of the position, the velocity, and the parameters."""
        params = self.system.params
        own = {f"{name}.{field}": params[name][field] for name, field in self.parameters}
        return {"position": jnp.zeros_like(self.state.v), "velocity": self.state.v} | own

    def outcome(self, method: jc.Method, x: dict[str, Any]) -> jax.Array:
        """A number that every coordinate of the final state enters."""
        return self.weighed(self.final(method, x))

    def final(self, method: jc.Method, x: dict[str, Any]) -> jc.State:
        """The state after some steps."""
        changes: dict[str, Any] = {}
        for name, field in self.parameters:
            changes.setdefault(name, {})[field] = x[f"{name}.{field}"]
        system = self.system.with_params(changes) if changes else self.system
        q = system.retract(self.state.q, x["position"])
        start = jc.init(system, method, q, x["velocity"], self.state.time)
        long = isinstance(method.integrator, jc.GeneralizedAlpha)
        dt = jnp.asarray(LONG if long else DT, q.dtype)
        return jc.rollout(system, method, start, None, dt, STEPS, record=lambda s, i: None)[0]

    def weighed(self, final: jc.State) -> jax.Array:
        """A sum of all coordinates and velocities."""
        random = np.random.default_rng(0)
        weights = [jnp.asarray(random.normal(size=y.shape), y.dtype) for y in (final.q, final.v)]
        return final.q @ weights[0] + final.v @ weights[1]


def directions(x: dict[str, Any]) -> dict[str, Any]:
    """One for each of the numbers, the others at rest; (n, …) in each leaf."""
    random, names = np.random.default_rng(1), list(x)

    def row(i: int, leaf: jax.Array) -> jax.Array:
        way = jnp.asarray(random.normal(size=leaf.shape), leaf.dtype)
        return jnp.stack([way if i == k else jnp.zeros_like(leaf) for k in range(len(names))])

    return {
        name: jax.tree.map(lambda leaf, i=i: row(i, leaf), x[name]) for i, name in enumerate(names)
    }


@dataclass(frozen=True)
class Row:
    """Relative errors of both modes, the worst of all numbers, and which that is."""

    choice: Choice
    scene: str
    forward: float
    reverse: float
    worst: str

    @property
    def holds(self) -> bool:
        """Whether both are within the bound."""
        return max(self.forward, self.reverse) <= BOUNDS[self.choice.dtype]


def measure(choice: Choice, scene: str, subject: Subject, compiled: Any = jax.jit) -> Row:
    """One row of the table."""
    method, own = choice.method(), subject
    x, ways = subject.numbers(), directions(subject.numbers())
    exact = slopes(lambda x: subject.outcome(method, x), x, ways, compiled)
    if choice.dtype == "float32":
        own, method, x, ways = (single(y) for y in (subject, method, x, ways))
    both = compiled(lambda x, ways: _modes(lambda x: own.outcome(method, x), x, ways))
    forward, reverse = (np.asarray(y, np.float64) for y in both(x, ways))
    scale = np.maximum(np.abs(exact), 1e-2 * np.max(np.abs(exact)))
    errors = np.abs(np.stack([forward, reverse]) - exact) / scale
    worst = list(x)[int(np.argmax(np.max(errors, axis=0)))]
    return Row(choice, scene, float(np.max(errors[0])), float(np.max(errors[1])), worst)


def single(tree: Any) -> Any:
    """The same in float32; of a subject, its scene."""
    if isinstance(tree, Subject):
        own = {"system": single(tree.system), "state": single(tree.state)}
        return dataclasses.replace(tree, **own)
    return jax.tree.map(lambda x: cast(x, jnp.float32) if hasattr(x, "dtype") else x, tree)


def _modes(value: Callable[[Any], jax.Array], x: Any, ways: Any) -> tuple[jax.Array, jax.Array]:
    """Derivatives along directions, forward and reverse; one after the other compiles sooner."""
    tangent = jax.linearize(value, x)[1]
    forward = jax.lax.map(tangent, ways)
    (gradient,) = jax.linear_transpose(tangent, x)(jnp.ones_like(forward[0]))
    dots = jax.tree.map(lambda g, w: w.reshape(len(w), -1) @ g.reshape(-1), gradient, ways)
    return forward, sum(jax.tree.leaves(dots), jnp.zeros_like(forward))


def slopes(value: Any, x: Any, ways: Any, compiled: Any) -> np.ndarray:
    """Differences along directions, extrapolated."""
    steps = STEP * 0.5 ** np.arange(LEVELS)
    signed = jnp.asarray([*steps, *-steps])

    def at(way: Any) -> jax.Array:
        def along(step: jax.Array) -> jax.Array:
            return value(jax.tree.map(lambda a, d: a + step * d, x, way))

        return jax.lax.map(along, signed)

    every = compiled(lambda ways: jax.lax.map(at, ways))
    ahead, behind = np.split(np.asarray(every(ways)), 2, axis=1)
    return ridders((ahead - behind) / (2 * steps))[0]


SCENES: dict[str, Callable[[], tuple[Any, jc.State, Any]]] = {
    "particles": lambda: (*chain(2), (("bob1", "mass"), ("rod1", "length"))),
    "four-bar": lambda: (*four_bar(), (("rocker", "mass"), ("crank_coupler", "anchor_b"))),
    "spatial loop": lambda: (*spatial_loop(), (("second", "mass"), ("ball1", "anchor_b"))),
}


def broken(subject: Subject, method: jc.Method, worlds: int, seed: int = 0) -> int:
    """In how many of so many random states in float32 a derivative of some steps is not finite.

    States are off the constraints by a tenth, and their velocities are of the order of one.
    """
    random, one = np.random.default_rng(seed), single(subject)
    n, method, x = len(one.state.v), single(method), single(subject.numbers())

    def finite(position: jax.Array, velocity: jax.Array) -> jax.Array:
        moved = x | {"position": position, "velocity": velocity}
        slopes = jax.tree.leaves(jax.grad(lambda x: one.outcome(method, x))(moved))
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in slopes]))

    run, good, block = jax.jit(jax.vmap(finite)), 0, min(worlds, 1000)
    for _ in range(worlds // block):
        position, velocity = random.normal(size=(2, block, n)).astype(np.float32)
        good += int(np.sum(run(jnp.asarray(0.1 * position), jnp.asarray(velocity))))
    return worlds // block * block - good


def main() -> None:
    """The whole product, by scene, and the random states."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--worlds", type=int, default=100_000)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for scene in given.scenes:
        subject = Subject(*SCENES[scene]())
        held = collections.Counter[bool]()
        for choice in choices():
            row = measure(choice, scene, subject)
            held[row.holds] += 1
            errors = f"forward {row.forward:.1e} | reverse {row.reverse:.1e} | {row.worst}"
            print(f"| {scene} | {choice} | {errors} |{'' if row.holds else ' beyond'}", flush=True)
        print(f"{scene}: {held[True]} of {held.total()} within {BOUNDS}", flush=True)
        lost = broken(subject, jc.Method(), given.worlds)
        print(f"{scene}: {lost} of {given.worlds} random states in float32 are not finite")


if __name__ == "__main__":
    main()
