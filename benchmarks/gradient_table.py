"""Derivatives of rollouts for all combinations of method parts.

    python -m benchmarks.gradient_table [--scenes particle four-bar …] [--worlds 100000]

All admissible combinations of stabilizer, integrator and solver are tested in both precisions.
Rollouts are differentiated with respect to positions, velocities, masses and joint parameters, in
forward and reverse mode. The derivatives are compared with central differences in float64,
extrapolated to zero step. Derivatives are then taken in very many random states in float32, none of
which may be NaN.
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
"""Step size of generalized-α [s].

Its multipliers follow from positions, which amplifies rounding by 1/h².
"""
STABILIZERS = {
    "none": jc.stabilizers.Unstabilized(),
    "Baumgarte": jc.Baumgarte(),
    "PID": jc.stabilizers.PID(400.0, 40.0, 100.0),
    "adaptive": jc.stabilizers.AdaptiveBaumgarte(20.0, 20.0),
    "sliding window": jc.stabilizers.SlidingWindowBaumgarte(20.0),
    "penalty": jc.stabilizers.Penalty.from_time(0.1),
    "multipliers": jc.stabilizers.AugmentedLagrangian(),
    "hybrid": jc.stabilizers.Hybrid(jc.stabilizers.Penalty.from_time(0.1), soft_below=1e-3),
    "projection": jc.Projection(),
}
SOLVERS = {
    "rank-safe": jc.solvers.RankSafe(),
    "sparse": jc.solvers.Sparse(),
    "Schur": jc.solvers.Schur(),
    "dense": jc.solvers.Dense(),
    "conjugate gradients": jc.solvers.ConjugateGradients(),
    "priority": jc.solvers.Priority({"*": 1}),
}
DTYPES = ("float64", "float32")
BOUNDS = {"float64": 1e-6, "float32": 1e-3}
"""Bounds on relative errors of derivatives, by precision."""
LEVELS = 7
STEP = 1e-3
"""The largest step of the central differences, halved `LEVELS` − 1 times."""


@dataclass(frozen=True)
class Choice:
    """A combination of integrator, stabilizer, solver and precision, by names."""

    integrator: str
    stabilizer: str
    solver: str
    dtype: str

    def method(self) -> jc.Method:
        """Returns the method, with its parameters in float64."""
        parts = INTEGRATORS[self.integrator], STABILIZERS[self.stabilizer], SOLVERS[self.solver]
        return jc.Method(*parts)

    def __str__(self) -> str:
        return "+".join(self.parts).replace(" ", "-")

    @property
    def parts(self) -> tuple[str, ...]:
        """The names of integrator, stabilizer, solver and precision."""
        return self.integrator, self.stabilizer, self.solver, self.dtype


def choices() -> list[Choice]:
    """Returns all combinations that the integrators accept."""
    every = (Choice(*x) for x in itertools.product(INTEGRATORS, STABILIZERS, SOLVERS, DTYPES))
    return [x for x in every if not x.method().integrator.refuses(None, x.method().stabilizer)]


def pairs(choice: Choice) -> set[tuple[str, str]]:
    """Returns all pairs of names in a combination."""
    return set(itertools.combinations(choice.parts, 2))


def covering(
    candidates: Iterable[Choice], wanted: Callable[[Choice], set[Any]] = pairs
) -> list[Choice]:
    """Returns few combinations that together have every feature of all candidates (greedy cover).

    By default, features are pairs of names.
    """
    remaining = list(candidates)
    uncovered = {feature for x in remaining for feature in wanted(x)}
    cover = []
    while uncovered:
        best = max(remaining, key=lambda x: len(uncovered & wanted(x)))
        uncovered -= wanted(best)
        cover.append(best)
    return cover


@dataclass(frozen=True)
class Subject:
    """A scene, and the variables with respect to which it is differentiated.

    Attributes:
        system: the system in float64.
        state: its initial state in float64.
        parameters: pairs of element and field.
    """

    system: Any
    state: jc.State
    parameters: tuple[tuple[str, str], ...]

    def numbers(self) -> dict[str, Any]:
        """Returns the variables: displacement of the position, velocity, and parameters."""
        params = self.system.params
        values = {f"{name}.{field}": params[name][field] for name, field in self.parameters}
        return {"position": jnp.zeros_like(self.state.v), "velocity": self.state.v} | values

    def outcome(self, method: jc.Method, x: dict[str, Any]) -> jax.Array:
        """Returns a scalar that depends on every coordinate of the final state."""
        return self.weighed(self.final(method, x))

    def final(self, method: jc.Method, x: dict[str, Any]) -> jc.State:
        """Returns the state after `STEPS` steps."""
        changes: dict[str, Any] = {}
        for name, field in self.parameters:
            changes.setdefault(name, {})[field] = x[f"{name}.{field}"]
        system = self.system.with_params(changes) if changes else self.system
        q = system.retract(self.state.q, x["position"])
        start = jc.init(system, method, q, x["velocity"], self.state.time)
        long = isinstance(method.integrator, jc.integrators.GeneralizedAlpha)
        dt = jnp.asarray(LONG if long else DT, q.dtype)
        return jc.rollout(system, method, start, None, dt, STEPS, record=lambda s, i: None)[0]

    def weighed(self, final: jc.State) -> jax.Array:
        """Returns a weighted sum of all coordinates and velocities."""
        random = np.random.default_rng(0)
        weights = [jnp.asarray(random.normal(size=y.shape), y.dtype) for y in (final.q, final.v)]
        return final.q @ weights[0] + final.v @ weights[1]


def directions(x: dict[str, Any]) -> dict[str, Any]:
    """Returns one direction per variable, in which all other variables are fixed.

    Each leaf is (n, …) for n variables.
    """
    random, names = np.random.default_rng(1), list(x)

    def row(i: int, leaf: jax.Array) -> jax.Array:
        way = jnp.asarray(random.normal(size=leaf.shape), leaf.dtype)
        return jnp.stack([way if i == k else jnp.zeros_like(leaf) for k in range(len(names))])

    return {
        name: jax.tree.map(lambda leaf, i=i: row(i, leaf), x[name]) for i, name in enumerate(names)
    }


@dataclass(frozen=True)
class Row:
    """Relative errors of one combination on one scene.

    Attributes:
        choice: the combination.
        scene: name of the scene.
        forward: error in forward mode, the largest over the variables.
        reverse: error in reverse mode, the largest over the variables.
        worst: the variable with the largest error.
    """

    choice: Choice
    scene: str
    forward: float
    reverse: float
    worst: str

    @property
    def holds(self) -> bool:
        """True if the errors in both modes are within the bound."""
        return max(self.forward, self.reverse) <= BOUNDS[self.choice.dtype]


def measure(choice: Choice, scene: str, subject: Subject, compiled: Any = jax.jit) -> Row:
    """Measures one combination on one scene."""
    method, cast_subject = choice.method(), subject
    x, ways = subject.numbers(), directions(subject.numbers())
    exact = slopes(lambda x: subject.outcome(method, x), x, ways, compiled)
    if choice.dtype == "float32":
        cast_subject, method, x, ways = (single(y) for y in (subject, method, x, ways))
    both_modes = compiled(
        lambda x, ways: _modes(lambda x: cast_subject.outcome(method, x), x, ways)
    )
    forward, reverse = (np.asarray(y, np.float64) for y in both_modes(x, ways))
    scale = np.maximum(np.abs(exact), 1e-2 * np.max(np.abs(exact)))
    errors = np.abs(np.stack([forward, reverse]) - exact) / scale
    worst = list(x)[int(np.argmax(np.max(errors, axis=0)))]
    return Row(choice, scene, float(np.max(errors[0])), float(np.max(errors[1])), worst)


def single(tree: Any) -> Any:
    """Casts a pytree to float32. For a `Subject`, casts its system and state."""
    if isinstance(tree, Subject):
        return dataclasses.replace(tree, system=single(tree.system), state=single(tree.state))
    return jax.tree.map(lambda x: cast(x, jnp.float32) if hasattr(x, "dtype") else x, tree)


def _modes(value: Callable[[Any], jax.Array], x: Any, ways: Any) -> tuple[jax.Array, jax.Array]:
    """Returns directional derivatives in forward and in reverse mode, (directions,) each.

    Directions are mapped in sequence, which compiles faster than a batch.
    """
    tangent = jax.linearize(value, x)[1]
    forward = jax.lax.map(tangent, ways)
    (gradient,) = jax.linear_transpose(tangent, x)(jnp.ones_like(forward[0]))
    dots = jax.tree.map(lambda g, w: w.reshape(len(w), -1) @ g.reshape(-1), gradient, ways)
    return forward, sum(jax.tree.leaves(dots), jnp.zeros_like(forward))


def slopes(value: Any, x: Any, ways: Any, compiled: Any) -> np.ndarray:
    """Returns central differences along directions, extrapolated to zero step."""
    steps = STEP * 0.5 ** np.arange(LEVELS)
    signed = jnp.asarray([*steps, *-steps])

    def differences(way: Any) -> jax.Array:
        def value_at(step: jax.Array) -> jax.Array:
            return value(jax.tree.map(lambda a, d: a + step * d, x, way))

        return jax.lax.map(value_at, signed)

    run = compiled(lambda ways: jax.lax.map(differences, ways))
    ahead, behind = np.split(np.asarray(run(ways)), 2, axis=1)
    return ridders((ahead - behind) / (2 * steps))[0]


SCENES: dict[str, Callable[[], tuple[Any, jc.State, Any]]] = {
    "particles": lambda: (*chain(2), (("bob1", "mass"), ("rod1", "length"))),
    "four-bar": lambda: (*four_bar(), (("rocker", "mass"), ("crank_coupler", "anchor_b"))),
    "spatial loop": lambda: (*spatial_loop(), (("second", "mass"), ("ball1", "anchor_b"))),
}


def broken(subject: Subject, method: jc.Method, worlds: int, seed: int = 0) -> int:
    """Counts random states in float32 at which a derivative is not finite.

    States violate the constraints by about 0.1 and have velocities of about 1.
    """
    random, cast_subject = np.random.default_rng(seed), single(subject)
    n, method, x = len(cast_subject.state.v), single(method), single(subject.numbers())

    def finite(position: jax.Array, velocity: jax.Array) -> jax.Array:
        moved = x | {"position": position, "velocity": velocity}
        leaves = jax.tree.leaves(jax.grad(lambda x: cast_subject.outcome(method, x))(moved))
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))

    run, good, block = jax.jit(jax.vmap(finite)), 0, min(worlds, 1000)
    for _ in range(worlds // block):
        position, velocity = random.normal(size=(2, block, n)).astype(np.float32)
        good += int(np.sum(run(jnp.asarray(0.1 * position), jnp.asarray(velocity))))
    return worlds // block * block - good


def main() -> None:
    """Prints errors of all combinations by scene, then the counts for random states."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--worlds", type=int, default=100_000)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for scene in options.scenes:
        subject = Subject(*SCENES[scene]())
        held = collections.Counter[bool]()
        for choice in choices():
            row = measure(choice, scene, subject)
            held[row.holds] += 1
            errors = f"forward {row.forward:.1e} | reverse {row.reverse:.1e} | {row.worst}"
            print(f"| {scene} | {choice} | {errors} |{'' if row.holds else ' beyond'}", flush=True)
        print(f"{scene}: {held[True]} of {held.total()} within {BOUNDS}", flush=True)
        nonfinite = broken(subject, jc.Method(), options.worlds)
        print(f"{scene}: {nonfinite} of {options.worlds} random states in float32 are not finite")


if __name__ == "__main__":
    main()
