"""How well each solver solves the saddle system at states that the scenes of the benchmarks meet.

    python -m benchmarks.residuals [--scenes chain-10 …] [--dtypes float64,float32]
        [--solvers Dense,Sparse,…] [--times 0,0.25] [--json FILE]

The system is assembled once and handed to each solver as arrays, so that what is judged is the
solution of exactly these numbers M, J, f, b, C, at double precision:

    r₁ = M a − f − Jᵀ λ,    r₂ = J a + C λ − b.

A row of r₁ is divided by √M_ii and one of r₂ by √A_ii, A = J M⁻¹ Jᵀ, which gives all of them one
unit, √kg m/s², and each block is related to the numbers that it adds up, ‖·‖ over its rows:

    ρ₁ = ‖r₁‖ / (‖M a‖ + ‖f‖ + ‖Jᵀ λ‖),    ρ₂ = ‖r₂‖ / (‖|J| |a|‖ + ‖C λ‖ + ‖b‖).

Both are backward errors: the solution is exact for data that are off by about ρ in proportion.
Absolute values stand in ρ₂ because J a is the difference of what a joint's bodies do: of a linkage
at rest J a = b = 0, and ‖r₂‖ over ‖J a‖ + ‖C λ‖ + ‖b‖ is one for any rounding whatever. That ratio
is printed, too, as `bare`, and not judged.

A scene of `targets.TIKHONOV` is judged as the regularised system that is solved, C = ε diag A: a
solver that regularises gets ε and no C, any other gets C. The last columns are the distance of
(a √M_ii, λ √A_ii) from that of `Dense` in float64 for the same numbers, in proportion, and the
distance that rounding explains: ten times eps times the condition of the matrix [[M, −Jᵀ], [J, C]]
in these scaled variables, in the 2-norm.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms, targets, timing
from benchmarks.mjcf import DT
from benchmarks.throughput import method_of
from jaxcon.constraints.rows import linearize
from jaxcon.core.native import Native
from jaxcon.dynamics.forward import saddle
from jaxcon.solvers.saddle import Saddle, Solution


def converged(**options: Any) -> jc.ConjugateGradients:
    """Conjugate gradients down to rounding."""
    precision = float(jnp.finfo(jnp.result_type(float)).eps)
    return jc.ConjugateGradients(tolerance=10 * precision, iterations=1000, **options)


SOLVERS: dict[str, Callable[..., Any]] = {
    "Dense": jc.Dense,
    "Schur": jc.Schur,
    "Sparse": jc.Sparse,
    "ConjugateGradients": converged,
}

LIMIT = {"float64": 1e-12, "float32": 1e-5}
"""Of ρ₁ and ρ₂."""
FACTOR = 10.0
"""Of eps times the condition, which the distance from the reference must not exceed."""


@dataclass(frozen=True)
class Residual:
    """Of one solver at one state.

    Attributes:
        scene, dtype, solver: which.
        time: of the state [s].
        motion, constraint: ρ₁ and ρ₂.
        bare: the second with ‖J a‖ in the place of ‖|J| |a|‖.
        distance: of the solution from the reference, in proportion.
        reach: how far rounding may take it.
        status: of the solver.
    """

    scene: str
    dtype: str
    solver: str
    time: float
    motion: float
    constraint: float
    bare: float
    distance: float
    reach: float
    status: str

    @property
    def verdict(self) -> str:
        """`passes`, or what does not."""
        limit = LIMIT[self.dtype]
        bounds = {
            "motion": self.motion <= limit,
            "constraint": self.constraint <= limit,
            "distance": self.distance <= self.reach,
            self.status: self.status == jc.Status.OK.name,
        }
        failed = [what for what, good in bounds.items() if not good]
        return f"fails: {', '.join(failed)}" if failed else "passes"

    def __str__(self) -> str:
        """A row of the table."""
        numbers = (self.motion, self.constraint, self.bare, self.distance, self.reach)
        shown = " | ".join(f"{x:.1e}" for x in numbers)
        where = f"{self.scene} | {self.dtype} | {self.solver} | {self.time:g} s"
        return f"| {where} | {shown} | {self.verdict} |"


HEAD = """
| scene | dtype | solver | at | motion | constraint | bare | distance | 10 eps cond | verdict |
|---|---|---|---|---|---|---|---|---|---|"""


class Numbers:
    """A saddle system in double precision: its matrices, and the scales of its rows."""

    def __init__(self, system: Saddle) -> None:
        dense = (system.mass.dense(), system.jacobian.dense(), system.force, system.target)
        self.m, self.j, self.f, self.b = (np.asarray(x, np.float64) for x in dense)
        diagonal = np.einsum("ri,ri->r", self.j, np.linalg.solve(self.m, self.j.T).T)
        self.scale_m, self.scale_a = np.sqrt(np.diag(self.m)), np.sqrt(diagonal)
        c = system.compliance
        self.c = np.zeros_like(self.b) if c is None else np.asarray(c, np.float64)

    def motion(self, a: np.ndarray, x: np.ndarray) -> float:
        """ρ₁."""
        terms = [self.m @ a, -self.f, -self.j.T @ x]
        return _share(sum(terms), terms, self.scale_m)

    def constraint(self, a: np.ndarray, x: np.ndarray, bare: bool = False) -> float:
        """ρ₂, or the same without absolute values."""
        moved = self.j @ a
        sizes = [moved if bare else np.abs(self.j) @ np.abs(a), self.c * x, self.b]
        return _share(moved + self.c * x - self.b, sizes, self.scale_a)

    def scaled(self, a: np.ndarray, x: np.ndarray) -> np.ndarray:
        """(a √M_ii, λ √A_ii), (n_v + n_c,)."""
        return np.concatenate([a * self.scale_m, x * self.scale_a])

    def condition(self) -> float:
        """Of the matrix in these variables."""
        scale = 1 / np.concatenate([self.scale_m, self.scale_a])
        matrix = np.block([[self.m, -self.j.T], [self.j, np.diag(self.c)]])
        return float(np.linalg.cond(matrix * scale * scale[:, None]))


def _share(residual: Any, terms: list[np.ndarray], scale: np.ndarray) -> float:
    """‖r‖ / Σ ‖term‖, each row divided by its scale."""
    sizes = sum(np.linalg.norm(x / scale) for x in terms)
    return float(np.linalg.norm(residual / scale) / sizes)


def measure(name: str, dtype: str, solvers: list[str], times: list[float]) -> Iterator[Residual]:
    """Every solver at states of one scene."""
    share = targets.TIKHONOV.get(name)
    for time, plain in zip(times, systems(name, dtype, times), strict=True):
        with jax.enable_x64(True):
            full = plain if share is None else regularized(plain, share)
            numbers, exact = Numbers(full), on_arrays(jc.Dense().solve, doubled(full))
        condition = numbers.condition()
        for solver in solvers:
            with jax.enable_x64(dtype == "float64"):
                found = solve(SOLVERS[solver], plain, full, share)
            which = (name, dtype, solver, time)
            yield judged(numbers, found, exact, condition, which)


def judged(
    numbers: Numbers,
    found: Solution,
    exact: Solution,
    condition: float,
    which: tuple[str, str, str, float],
) -> Residual:
    """A solution of a system beside the reference."""
    a, x = (np.asarray(y, np.float64) for y in found[:2])
    best = numbers.scaled(*(np.asarray(y) for y in exact[:2]))
    return Residual(
        *which,
        numbers.motion(a, x),
        numbers.constraint(a, x),
        numbers.constraint(a, x, bare=True),
        float(np.linalg.norm(numbers.scaled(a, x) - best) / np.linalg.norm(best)),
        FACTOR * float(np.finfo(which[1]).eps) * condition,
        jc.Status(int(found.status)).name,
    )


def solve(solver: Any, plain: Saddle, full: Saddle, share: float | None) -> Solution:
    """By a solver that regularises the plain system, or one that is given the regularised one."""
    if share is None or not hasattr(solver(), "tikhonov"):
        return on_arrays(solver().solve, full)
    given = solver(tikhonov=jnp.asarray(share, plain.force.dtype))
    return on_arrays(lambda pair: pair[0].solve(pair[1]), (given, plain))


def systems(name: str, dtype: str, times: list[float]) -> list[Saddle]:
    """The saddle systems of a scene at times of its run, under the feedback of its step."""
    method = method_of(name, "Sparse")
    with jax.enable_x64(dtype == "float64"):
        system, start = mechanisms.find(name).build(np.dtype(dtype))

        def run(state: jc.State, steps: int) -> jc.State:
            return jc.rollout(system, method, state, None, DT, steps, record=lambda s, i: None)[0]

        def at(given: Any) -> Saddle:
            system, state, dt = given  # numbers of the system, too, get the axes of the batch
            rows = linearize(system, state.q, state.v, state.time)
            target = method.feedback(dt).target(rows, state.memory, dt)
            force = system.force(state.q, state.v, state.time)
            return saddle(system, state.q, rows, force, target)

        go = jax.jit(run, static_argnums=1)
        states = [go(start, round(time / DT)) for time in times]
        for state in states:
            jc.raise_for_status(state)
        dt = jnp.asarray(DT, np.dtype(dtype))
        return [on_arrays(at, (system, state, dt)) for state in states]


def regularized(system: Saddle, share: float) -> Saddle:
    """The same with C = ε diag(J M⁻¹ Jᵀ)."""
    added = jnp.asarray(share * Numbers(system).scale_a ** 2, system.force.dtype)
    return dataclasses.replace(system, compliance=added)


def doubled(system: Saddle) -> Saddle:
    """The same numbers in float64."""
    return jax.tree.map(lambda x: x.astype(np.float64) if is_array(x) else x, system)


def is_array(x: Any) -> bool:
    """Whether a component is data, not a number known when tracing."""
    return isinstance(x, jax.Array)


def on_arrays(function: Callable[[Any], Any], tree: Any) -> Any:
    """function(tree), compiled for the arrays in it; Python numbers stay what they are."""
    leaves, structure = jax.tree.flatten(tree)
    results: list[Any] = []

    def run(*arrays: jax.Array) -> list[jax.Array]:
        given = iter(arrays)
        merged = [next(given) if is_array(x) else x for x in leaves]
        results[:] = jax.tree.flatten(function(jax.tree.unflatten(structure, merged)))
        return [x for x in results[0] if is_array(x)]

    found = iter(Native(run).compiled(*(x for x in leaves if is_array(x))))
    output = [next(found) if is_array(x) else x for x in results[0]]
    return jax.tree.unflatten(results[1], output)


def main() -> None:
    """Prints the table and writes the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(targets.SCENES))
    parser.add_argument("--dtypes", type=listed, default=list(LIMIT))
    parser.add_argument("--solvers", type=listed, default=list(SOLVERS))
    parser.add_argument("--times", type=listed, default=["0", "0.25"])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = []
    print(HEAD)
    for name in options.scenes:
        for dtype in options.dtypes:
            for row in measure(name, dtype, options.solvers, [float(x) for x in options.times]):
                rows.append(timing.plain(row) | {"verdict": row.verdict})
                print(row, flush=True)
    print(f"{sum(row['verdict'] == 'passes' for row in rows)} of {len(rows)} pass")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def listed(text: str) -> list[str]:
    """The parts of a list with commas."""
    return text.split(",")


if __name__ == "__main__":
    main()
