"""Residuals of each solver on the saddle-point systems of the benchmark scenes.

    python -m benchmarks.residuals [--scenes chain-10 …] [--dtypes float64,float32]
        [--solvers Dense,Sparse,…] [--times 0,0.25] [--json FILE]

A system is assembled once and passed to each solver as arrays. Its data are mass matrix M, Jacobian
J, force f, right-hand side b and compliance C. The residuals of a solution (a, λ) are evaluated in
double precision:

    r₁ = M a − f − Jᵀ λ,    r₂ = J a + C λ − b.

Rows of r₁ are divided by √M_ii and rows of r₂ by √A_ii, A = J M⁻¹ Jᵀ. All rows then have the unit
√kg m/s². Each block is related to the norms ‖·‖ of its terms:

    ρ₁ = ‖r₁‖ / (‖M a‖ + ‖f‖ + ‖Jᵀ λ‖),    ρ₂ = ‖r₂‖ / (‖|J| |a|‖ + ‖C λ‖ + ‖b‖).

Both are backward errors: the solution is exact for data with a relative error of about ρ. ρ₂ has
absolute values because J a is a difference between the bodies of a joint. For a linkage at rest J a
= b = 0. The ratio of ‖r₂‖ to ‖J a‖ + ‖C λ‖ + ‖b‖ is then 1 for any rounding error. That ratio is
printed as `bare`, without a bound.

Scenes in `targets.TIKHONOV` are evaluated as regularized systems with C = ε diag A. A solver that
regularizes by itself gets ε and no C; any other solver gets C. The last columns are a relative
distance and its bound. The distance is that of (a √M_ii, λ √A_ii) from the solution of `Dense` in
float64. The bound allows for rounding: ten times the machine epsilon times the condition number of
[[M, −Jᵀ], [J, C]] in the scaled variables, in the 2-norm.
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
from jaxcon.constraints.rows import linearize, saddle
from jaxcon.linear.saddle import Saddle, Solution
from jaxcon.staging.batch_last import Native


def converged(**options: Any) -> jc.solvers.ConjugateGradients:
    """Returns the conjugate-gradient solver with settings that converge to rounding."""
    precision = float(jnp.finfo(jnp.result_type(float)).eps)
    return jc.solvers.ConjugateGradients(tolerance=10 * precision, iterations=1000, **options)


SOLVERS: dict[str, Callable[..., Any]] = {
    "Dense": jc.solvers.Dense,
    "Schur": jc.solvers.Schur,
    "Sparse": jc.solvers.Sparse,
    "ConjugateGradients": converged,
}

LIMIT = {"float64": 1e-12, "float32": 1e-5}
"""Bound on ρ₁ and ρ₂."""
FACTOR = 10.0
"""Bound on the distance from the reference, divided by eps times the condition number."""


@dataclass(frozen=True)
class Residual:
    """Residuals of one solver at one state.

    Attributes:
        scene: name of the scene.
        dtype: precision.
        solver: name of the solver.
        time: time of the state [s].
        motion: ρ₁, the backward error of the equation of motion.
        constraint: ρ₂, the backward error of the constraints.
        bare: ρ₂ with ‖J a‖ in place of ‖|J| |a|‖.
        distance: relative distance from the reference.
        reach: bound on `distance` by rounding.
        status: status of the solver.
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
        """The verdict on the residuals: "passes", or the failed checks."""
        limit = LIMIT[self.dtype]
        bounds = {
            "motion": self.motion <= limit,
            "constraint": self.constraint <= limit,
            "distance": self.distance <= self.reach,
            self.status: self.status == jc.Status.OK.name,
        }
        failed = [name for name, good in bounds.items() if not good]
        return f"fails: {', '.join(failed)}" if failed else "passes"

    def __str__(self) -> str:
        """Formats the residuals as a table row."""
        numbers = (self.motion, self.constraint, self.bare, self.distance, self.reach)
        cells = " | ".join(f"{x:.1e}" for x in numbers)
        head = f"{self.scene} | {self.dtype} | {self.solver} | {self.time:g} s"
        return f"| {head} | {cells} | {self.verdict} |"


HEAD = """
| scene | dtype | solver | at | motion | constraint | bare | distance | 10 eps cond | verdict |
|---|---|---|---|---|---|---|---|---|---|"""


class Numbers:
    """A saddle-point system in double precision: its matrices and row scales."""

    def __init__(self, system: Saddle) -> None:
        dense = (system.mass.dense(), system.jacobian.dense(), system.force, system.target)
        self.m, self.j, self.f, self.b = (np.asarray(x, np.float64) for x in dense)
        diagonal = np.einsum("ri,ri->r", self.j, np.linalg.solve(self.m, self.j.T).T)
        self.scale_m, self.scale_a = np.sqrt(np.diag(self.m)), np.sqrt(diagonal)
        c = system.compliance
        self.c = np.zeros_like(self.b) if c is None else np.asarray(c, np.float64)

    def motion(self, a: np.ndarray, x: np.ndarray) -> float:
        """Returns the relative residual ρ₁ of the equation of motion."""
        terms = [self.m @ a, -self.f, -self.j.T @ x]
        return _share(sum(terms), terms, self.scale_m)

    def constraint(self, a: np.ndarray, x: np.ndarray, bare: bool = False) -> float:
        """Returns the relative residual ρ₂ of the constraints.

        If `bare`, it is relative to ‖J a‖ in place of ‖|J| |a|‖.
        """
        acceleration = self.j @ a
        sizes = [acceleration if bare else np.abs(self.j) @ np.abs(a), self.c * x, self.b]
        return _share(acceleration + self.c * x - self.b, sizes, self.scale_a)

    def scaled(self, a: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Returns the scaled solution (a √M_ii, λ √A_ii), (n_v + n_c,)."""
        return np.concatenate([a * self.scale_m, x * self.scale_a])

    def condition(self) -> float:
        """Returns the condition number of the matrix in the scaled variables."""
        scale = 1 / np.concatenate([self.scale_m, self.scale_a])
        matrix = np.block([[self.m, -self.j.T], [self.j, np.diag(self.c)]])
        return float(np.linalg.cond(matrix * scale * scale[:, None]))


def _share(residual: Any, terms: list[np.ndarray], scale: np.ndarray) -> float:
    """Returns the norm of a residual divided by the sum of the norms of its terms, ‖r‖ / Σ ‖term‖.

    Each row is divided by its scale.
    """
    sizes = sum(np.linalg.norm(x / scale) for x in terms)
    return float(np.linalg.norm(residual / scale) / sizes)


def measure(name: str, dtype: str, solvers: list[str], times: list[float]) -> Iterator[Residual]:
    """Yields residuals of every solver at states of one scene."""
    share = targets.TIKHONOV.get(name)
    for time, plain in zip(times, systems(name, dtype, times), strict=True):
        with jax.enable_x64(True):
            full = plain if share is None else regularized(plain, share)
            numbers, exact = Numbers(full), on_arrays(jc.solvers.Dense().solve, doubled(full))
        condition = numbers.condition()
        for solver in solvers:
            with jax.enable_x64(dtype == "float64"):
                solution = solve(SOLVERS[solver], plain, full, share)
            labels = (name, dtype, solver, time)
            yield judged(numbers, solution, exact, condition, labels)


def judged(
    numbers: Numbers,
    solution: Solution,
    exact: Solution,
    condition: float,
    labels: tuple[str, str, str, float],
) -> Residual:
    """Evaluates the residuals of a solution and its distance from the reference."""
    a, x = (np.asarray(y, np.float64) for y in solution[:2])
    reference = numbers.scaled(*(np.asarray(y) for y in exact[:2]))
    return Residual(
        *labels,
        numbers.motion(a, x),
        numbers.constraint(a, x),
        numbers.constraint(a, x, bare=True),
        float(np.linalg.norm(numbers.scaled(a, x) - reference) / np.linalg.norm(reference)),
        FACTOR * float(np.finfo(labels[1]).eps) * condition,
        jc.Status(int(solution.status)).name,
    )


def solve(solver: Any, plain: Saddle, full: Saddle, share: float | None) -> Solution:
    """Solves a system by one solver.

    A solver that regularizes by itself gets the plain system. Any other solver gets the regularized
    system.
    """
    if share is None or not hasattr(solver(), "tikhonov"):
        return on_arrays(solver().solve, full)
    regularizing = solver(tikhonov=jnp.asarray(share, plain.force.dtype))
    return on_arrays(lambda pair: pair[0].solve(pair[1]), (regularizing, plain))


def systems(name: str, dtype: str, times: list[float]) -> list[Saddle]:
    """Returns saddle-point systems of a scene at given times, with feedback of the step."""
    method = method_of(name, "Sparse")
    with jax.enable_x64(dtype == "float64"):
        system, start = mechanisms.find(name).build(np.dtype(dtype))

        def run(state: jc.State, steps: int) -> jc.State:
            return jc.rollout(system, method, state, None, DT, steps, record=lambda s, i: None)[0]

        def assemble(inputs: Any) -> Saddle:
            # The system is an argument so that its parameters get the batch axis too.
            system, state, dt = inputs
            rows = linearize(system, state.q, state.v, state.time)
            feedback = method.stabilizer_for(dt)
            equations = feedback.constraint_equations(rows, state.memory, dt)
            force = system.force(state.q, state.v, state.time)
            return saddle(system, state.q, rows, force, equations.right_hand_side)

        compiled = jax.jit(run, static_argnums=1)
        states = [compiled(start, round(time / DT)) for time in times]
        for state in states:
            jc.raise_for_status(state)
        dt = jnp.asarray(DT, np.dtype(dtype))
        return [on_arrays(assemble, (system, state, dt)) for state in states]


def regularized(system: Saddle, share: float) -> Saddle:
    """Returns the system with the compliance C = ε diag(J M⁻¹ Jᵀ), with ε = `share`."""
    compliance = jnp.asarray(share * Numbers(system).scale_a ** 2, system.force.dtype)
    return dataclasses.replace(system, compliance=compliance)


def doubled(system: Saddle) -> Saddle:
    """Returns the system with all arrays in float64."""
    return jax.tree.map(lambda x: x.astype(np.float64) if is_array(x) else x, system)


def is_array(x: Any) -> bool:
    """Returns True for array data, and False for a Python number, which is static."""
    return isinstance(x, jax.Array)


def on_arrays(function: Callable[[Any], Any], tree: Any) -> Any:
    """Returns function(tree), compiled for the arrays of the tree. Python numbers are static."""
    leaves, structure = jax.tree.flatten(tree)
    results: list[Any] = []

    def run(*arrays: jax.Array) -> list[jax.Array]:
        traced = iter(arrays)
        merged = [next(traced) if is_array(x) else x for x in leaves]
        results[:] = jax.tree.flatten(function(jax.tree.unflatten(structure, merged)))
        return [x for x in results[0] if is_array(x)]

    computed = iter(Native(run).compiled(*(x for x in leaves if is_array(x))))
    output = [next(computed) if is_array(x) else x for x in results[0]]
    return jax.tree.unflatten(results[1], output)


def main() -> None:
    """Prints the table of residuals and writes the file of `--json`."""
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
    """Splits a comma-separated list."""
    return text.split(",")


if __name__ == "__main__":
    main()
