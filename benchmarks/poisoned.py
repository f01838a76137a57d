"""Tests of batches in which one world has a value of NaN or infinity.

    python -m benchmarks.poisoned [NAMES …] [--quick] [--list]

Each element of `gradient_elements` is added to a scene, on two bodies of its own. Every value is
replaced in turn: those of `system.params`, control, start, step size and the method. A case is one
replaced value. All cases run as worlds of a batch beside healthy worlds, so that a scene is
compiled once. Three properties are checked:

    status     the poisoned world fails in the first step, unless infinity means "no limit"
    neighbors  healthy worlds are equal to those of a healthy batch, bit for bit
    gradient   the gradient with respect to shared values is that of the healthy worlds alone

The study prints counts by scene and method, and the cases that fail a check. The exit status is 1
if there are any. `--quick` runs the small scenes of the tests, and poisons the first entry of each
array. The full version runs every element in the plane and in space under several methods. It takes
some hours on one core.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks.gradient_elements import ENDS, FORCES, JOINTS, PAIR
from benchmarks.gradient_scenes import add, along

POISONS = (np.nan, np.inf, -np.inf)
LIMITS = (0.0, -1.0)
"""Replacements by which a world may fail or go on. Other worlds must not change either way."""
HEALTHY = 2
"""Number of healthy worlds at the front of each batch."""
BATCH = 256
"""Number of worlds in a batch. Worlds without a case are healthy, too."""
STEPS, DT = 3, 0.01

NO_LIMIT = {("lower", -np.inf), ("upper", np.inf)}
"""Fields that may be infinite, with the sign: the joint then has no limit on this side."""


def stage(dim: int, tables: dict[str, Any]) -> Any:
    """Builds a scene with all elements of the tables, each on two bodies of its own.

    Args:
        dim: 2 or 3.
        tables: name → (dimensions, dim → elements), as in `gradient_elements`.
    """
    scene = jc.Scene(dim=dim)
    for place, (dims, make) in enumerate(tables.values()):
        if dim not in dims:
            continue
        for i, name in enumerate(PAIR):
            add(scene, f"{name}{place}", i * along(dim, 0))
        elements = make(dim)
        known = {*PAIR, *(element.name for element in elements)}
        for element in elements:
            scene.add(_renamed(element, known, str(place)))
    return scene.build()


def _renamed(element: Any, known: set[str], suffix: str) -> Any:
    """Returns the element with a suffix on its name and on the names that it refers to.

    These are the names of its bodies and joints.
    """

    def renamed(x: Any) -> Any:
        if isinstance(x, tuple):
            return tuple(renamed(y) for y in x)
        return x + suffix if isinstance(x, str) and x in known else x

    names = [field.name for field in dataclasses.fields(element)]
    return dataclasses.replace(element, **{x: renamed(getattr(element, x)) for x in names})


@dataclass(frozen=True)
class Case:
    """One value of a world and its replacement.

    Attributes:
        path: path of the leaf, such as "params/law1/friction".
        leaf: index of the leaf among all leaves.
        index: index of the value in the leaf.
        poison: the replacement: NaN, inf, −inf, or a value of `LIMITS`.
    """

    path: str
    leaf: int
    index: tuple[int, ...]
    poison: float

    @property
    def allowed(self) -> bool:
        """True if the world may go on: the replacement is finite, or infinity means "no limit"."""
        finite = bool(np.isfinite(self.poison))
        return finite or (self.path.rsplit("/", 1)[-1], self.poison) in NO_LIMIT

    def __str__(self) -> str:
        return f"{self.path}{list(self.index) or ''} = {self.poison}"


@dataclass(frozen=True)
class Counts:
    """The counts of a study.

    Attributes:
        tried: number of cases.
        told: number of worlds that failed in the first step, or after the retries of a `Recovery`.
        free: number of worlds that went on and may go on, see `Case.allowed`.
        idle: number of worlds that moved as without the replacement, because the value has no
            influence. An example is the time, if nothing depends on it. Of the values of
            inequalities, only terrain heights away from a ball may be idle.
        accepted: cases in which the world wrongly went on.
        neighbors: cases in which a healthy world changed.
        gradients: cases in which the gradient of the healthy worlds changed, in either mode.
    """

    tried: int = 0
    told: int = 0
    free: int = 0
    idle: int = 0
    accepted: tuple[Case, ...] = ()
    neighbors: tuple[Case, ...] = ()
    gradients: tuple[Case, ...] = ()

    def __add__(self, other: Counts) -> Counts:
        """Adds the counts of two studies."""
        names = [field.name for field in dataclasses.fields(self)]
        return Counts(*(getattr(self, name) + getattr(other, name) for name in names))

    @property
    def clean(self) -> bool:
        """True if no case went wrong."""
        return not (self.accepted or self.neighbors or self.gradients)


@dataclass(frozen=True)
class Seen:
    """The results of a batch.

    Attributes:
        failed: True if the world of a case has failed, by case and step.
        healthy: final q and v of the healthy worlds, and tangents of their losses.
        cases: final q and v of the worlds of the cases, and tangents of their losses.
        gradient: gradient of the sum of the losses that count.
    """

    failed: np.ndarray
    healthy: tuple[np.ndarray, ...]
    cases: tuple[np.ndarray, ...]
    gradient: Any


class Study:
    """Runs the cases of one scene under one method.

    Args:
        system, state: the scene as built.
        method: its floating-point leaves are poisoned as well.
        thorough: True to poison every entry of an array, False for the first entry only.
    """

    def __init__(self, system: Any, state: Any, method: Any, thorough: bool = False) -> None:
        self.system, self.state, self.thorough = system, state, thorough
        self.patience = 0 if method.recovery is None else method.recovery.retries
        leaves, self.structure = jax.tree.flatten(method)
        self.gains = [isinstance(x, float) for x in leaves]
        self.others = leaves
        dtype = state.q.dtype
        numbers = {
            "params": system.params,
            "control": jnp.full(system.layout.n_u, 0.1, dtype),
            "q": state.q,
            "v": state.v + 0.01 * jnp.cos(jnp.arange(len(state.v), dtype=dtype)),
            "time": state.time,
            "dt": jnp.asarray(DT, dtype),
            "method": [x for x, flag in zip(leaves, self.gains, strict=True) if flag],
        }
        known, self.tree = jax.tree_util.tree_flatten_with_path(numbers)
        self.paths = [jax.tree_util.keystr(p, simple=True, separator="/") for p, _ in known]
        self.numbers = [np.asarray(x, dtype) for _, x in known]

    def cases(self) -> Iterator[Case]:
        """Yields every value with every replacement."""
        for leaf, (path, x) in enumerate(zip(self.paths, self.numbers, strict=True)):
            indices = list(itertools.product(*map(range, x.shape)))
            for index in indices if self.thorough else indices[:1]:
                for poison in (*POISONS, *LIMITS):
                    yield Case(path, leaf, index, poison)

    def batch(self, cases: Sequence[Case | None]) -> list[np.ndarray]:
        """Returns the values of all worlds: healthy worlds first, then one world for each case."""
        numbers = [np.repeat(x[None], BATCH, axis=0) for x in self.numbers]
        velocity = numbers[self.paths.index("v")]
        velocity[:HEALTHY] += 0.01 * np.arange(HEALTHY)[:, None]
        for world, case in enumerate(cases, start=HEALTHY):
            if case is not None:
                numbers[case.leaf][(world, *case.index)] = case.poison
        return numbers

    def rollout(self, shared: Any, numbers: list[Any]) -> Any:
        """Returns the final state of one world and its status after each step."""
        x = jax.tree.unflatten(self.tree, numbers)
        own = iter(x["method"])
        leaves = [next(own) if g else y for g, y in zip(self.gains, self.others, strict=True)]
        method = jax.tree.unflatten(self.structure, leaves)
        params = x["params"] | {"gravity": x["params"]["gravity"] + shared["gravity"]}
        body = next(iter(self.system.layout.bodies))
        params[body] = params[body] | {"mass": params[body]["mass"] + shared["mass"]}
        system = self.system.with_params(params)
        start = jc.init(system, method, x["q"], x["v"], time=x["time"])
        final, codes = jc.rollout(
            system,
            method,
            start,
            jnp.broadcast_to(x["control"], (STEPS, self.system.layout.n_u)),
            x["dt"] + shared["h"],
            STEPS,
            record=lambda state, info: info.status,
        )
        return final, codes

    def loss(self, shared: Any, numbers: list[Any]) -> Any:
        """Returns a scalar that depends on all of one world's final state, and the run.

        The run is the final state and the status after each step.
        """
        final, codes = self.rollout(shared, numbers)
        weights = jnp.cos(jnp.arange(final.q.size + final.v.size, dtype=final.q.dtype))
        return jnp.sum(weights * jnp.concatenate([final.q, final.v])), (final, codes)

    @cached_property
    def shared(self) -> dict[str, Any]:
        """Values that all worlds share: offsets of gravity, of a mass and of the step size."""
        dtype = self.state.q.dtype
        none = jnp.zeros(self.system.layout.dim, dtype)
        return {"gravity": none, "mass": jnp.zeros((), dtype), "h": jnp.zeros((), dtype)}

    @cached_property
    def compiled(self) -> Any:
        """The compiled program (values, losses that count) → results.

        The results are statuses, final q, v and tangents of all worlds, and the gradient.
        """

        def each(shared: Any, numbers: list[Any]) -> Any:
            return jax.vmap(self.loss, (None, 0))(shared, numbers)

        def run(numbers: list[Any], counts: Any) -> tuple[Any, Any, Any]:
            def losses(shared: Any) -> Any:
                return each(shared, numbers)

            _, push, (final, codes) = jax.linearize(losses, self.shared, has_aux=True)
            tangents = push(jax.tree.map(jnp.ones_like, self.shared))
            pull = jax.linear_transpose(push, self.shared)
            (gradient,) = pull(counts.astype(tangents.dtype))
            return codes, (final.q, final.v, tangents), gradient

        # compiled once and run a few times, so fast compilation matters more than fast code
        return jax.jit(run, compiler_options={"xla_backend_optimization_level": 0})

    def of_inequality(self, case: Case) -> bool:
        """Returns True for a value of a joint limit, contact, friction or motor.

        Heights of a terrain are an exception: a step reads only the heights near the ball.
        """
        names = {name for group in self.system.bounds for name in group.names}
        _, *element = case.path.split("/")
        return bool(element) and element[0] in names and element[-1] != "heights"

    def seen(self, cases: Sequence[Case | None], failures_count: bool = False) -> Seen:
        """Runs the cases as a batch.

        With `failures_count`, the losses of failed worlds are part of the gradient; they must not
        change it.
        """
        numbers = self.batch(cases)
        counts = np.arange(BATCH) < HEALTHY
        codes, worlds, gradient = self.compiled(numbers, counts)
        codes = np.asarray(codes)[HEALTHY : HEALTHY + len(cases)]
        failed = (codes > 0) & (codes < int(jc.Status.CONFLICT))
        if failures_count:  # the losses of failed worlds must not add to the gradient
            counts[HEALTHY : HEALTHY + len(cases)] = failed[:, self.patience]
            gradient = self.compiled(numbers, counts)[2]
        worlds = tuple(np.asarray(x) for x in worlds)
        return Seen(
            failed,
            tuple(x[:HEALTHY] for x in worlds),
            tuple(x[HEALTHY : HEALTHY + len(cases)] for x in worlds),
            jax.tree.map(np.asarray, gradient),
        )

    def run(self, cases: list[Case] | None = None) -> Counts:
        """Runs all cases in batches and counts how they end."""
        cases = list(self.cases()) if cases is None else cases
        total = Counts()
        for start in range(0, len(cases), BATCH - HEALTHY):
            total += self._lot(cases[start : start + BATCH - HEALTHY])
        return total

    def _lot(self, cases: list[Case]) -> Counts:
        good, seen = self.seen([]), self.seen(cases, failures_count=True)
        unpoisoned = self.seen([None] * len(cases)).cases
        told = seen.failed[:, self.patience]

        def noticed(some: list[Case]) -> bool:
            return not _same(self.seen(some).healthy, good.healthy)

        def changed(some: list[Case]) -> bool:
            return not _near(self.seen(some, failures_count=True).gradient, good.gradient)

        ends = zip(cases, told, seen.cases[-1], strict=True)
        moving = [c for c, t, x in ends if (x != 0 if t else not np.isfinite(x))]
        free, idle, accepted = [], [], []
        for i, case in enumerate(cases):
            if not told[i]:
                asleep = _same([x[i] for x in seen.cases], [x[i] for x in unpoisoned])
                asleep &= not self.of_inequality(case)
                (free if case.allowed else idle if asleep else accepted).append(case)
        return Counts(
            len(cases),
            int(np.sum(told)),
            len(free),
            len(idle),
            tuple(accepted),
            culprits(noticed, cases),
            (*moving, *culprits(changed, cases)),
        )


def culprits(bad: Any, cases: list[Case]) -> tuple[Case, ...]:
    """Returns the cases that make a batch bad on their own, by bisection.

    If cases make the batch bad only together, all of them are returned.
    """
    if not cases or not bad(cases):
        return ()
    if len(cases) == 1:
        return tuple(cases)
    half = len(cases) // 2
    found = culprits(bad, cases[:half]) + culprits(bad, cases[half:])
    return found or tuple(cases)


def _same(a: Any, b: Any) -> bool:
    """Returns True if arrays agree bit for bit."""
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def _near(a: Any, b: Any) -> bool:
    """Returns True if gradients agree to rounding, relative to the largest entry."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.allclose(x, y, rtol=1e-9, atol=1e-9 * np.max(np.abs(y))) for x, y in pairs)


QUICK: dict[str, tuple[tuple[str, ...], int, Any]] = {
    "contact": (("ball that rolls with resistance",), 2, jc.Method()),
    "sweeps": (
        ("soft stops", "dry friction"),
        2,
        jc.Method(contact_solver=jc.solvers.GaussSeidel(sweeps=4)),
    ),
    "generalized-α": (("force",), 2, jc.Method(jc.integrators.GeneralizedAlpha())),
    "PID": (
        ("distance",),
        2,
        jc.Method(stabilizer=jc.stabilizers.PID(100.0, 20.0, 10.0, limit=5.0)),
    ),
    "adaptive": (
        ("distance",),
        2,
        jc.Method(stabilizer=jc.stabilizers.AdaptiveBaumgarte(10.0, 10.0)),
    ),
    "window": (("distance",), 2, jc.Method(stabilizer=jc.stabilizers.SlidingWindowBaumgarte())),
    "springs": (("distance",), 2, jc.Method(stabilizer=jc.stabilizers.Penalty(100.0, 1.0))),
    "rounds": (("distance",), 2, jc.Method(stabilizer=jc.stabilizers.AugmentedLagrangian())),
    "recovery": (
        ("distance",),
        2,
        jc.Method(recovery=jc.stabilizers.Recovery(limit=0.5, retries=1)),
    ),
}
"""Elements, dimension and method of the small studies, by name."""

REFUSED = ("rolling", "knife edge", "momentum", "velocity level", "rotor")
"""Words in the names of joints that `RATTLE` refuses: rows of velocities only, and rotors."""

HOLONOMIC = {
    name: element
    for name, element in {**JOINTS, **FORCES}.items()
    if not any(word in name for word in REFUSED)
}

SETS = {
    "plain": ({**JOINTS, **FORCES, **ENDS}, jc.Method()),
    "RK4": ({**JOINTS, **FORCES, **ENDS}, jc.Method(jc.RK4())),
    "RATTLE": (HOLONOMIC, jc.Method(jc.integrators.RATTLE())),
    "generalized-α": ({**JOINTS, **FORCES}, jc.Method(jc.integrators.GeneralizedAlpha())),
    "sweeps": (ENDS, jc.Method(contact_solver=jc.solvers.GaussSeidel(sweeps=8))),
    "nearest": (ENDS, jc.Method(contact_solver=jc.solvers.ActiveSet(stops=1))),
    "events": (ENDS, jc.Method(events=jc.integrators.Events())),
    "recovery": (ENDS, jc.Method(recovery=jc.stabilizers.Recovery(retries=1))),
}
"""Elements and methods of the long studies."""

TOGETHER = 3
"""Number of elements in a scene of the long studies. Compiling takes ten seconds each."""


def studies(quick: bool) -> dict[str, tuple[tuple[str, ...], int, Any]]:
    """Returns elements, dimension and method of every study, by name."""
    if quick:
        return QUICK
    found = dict(QUICK)
    for name, (tables, method) in SETS.items():
        for dim in (2, 3):
            fits = [element for element, (dims, _) in tables.items() if dim in dims]
            for start in range(0, len(fits), TOGETHER):
                lot = tuple(fits[start : start + TOGETHER])
                found[f"{name}, {dim}D, {', '.join(lot)}"] = lot, dim, method
    return found


def composed(name: str) -> tuple[tuple[str, ...], int, Any] | None:
    """Returns elements, dimension and method of a study named like "nearest, 3D, slack rope".

    The result is None for other names.
    """
    method, _, rest = name.partition(", ")
    dim, _, listed = rest.partition(", ")
    elements, (known, chosen) = listed.split(", "), SETS.get(method, ({}, None))
    if dim not in ("2D", "3D") or not known or set(elements) - set(known):
        return None
    return tuple(elements), int(dim[0]), chosen


def measure(name: str, quick: bool) -> Counts:
    """Runs one study and returns its counts."""
    study = studies(quick=False).get(name) or composed(name)
    if study is None:
        raise KeyError(f"there is no study named {name!r}")
    elements, dim, method = study
    every = {**JOINTS, **FORCES, **ENDS}
    system, state = stage(dim, {element: every[element] for element in elements})
    return Study(system, state, method, thorough=not quick).run()


def words(name: str, counts: Counts) -> str:
    """Formats a row of counts, with the cases that went wrong below it."""
    wrong = {
        "accepted wrongly": counts.accepted,
        "neighbors changed": counts.neighbors,
        "gradients of others changed": counts.gradients,
    }
    line = f"{name}: tried {counts.tried}, told by status {counts.told}, may go on {counts.free},"
    line += f" take no part {counts.idle}, "
    line += ", ".join(f"{what} {len(cases)}" for what, cases in wrong.items())
    below = [f"    {what}: {case}" for what, cases in wrong.items() for case in cases]
    return "\n".join([line, *below])


def main(given: list[str] | None = None) -> int:
    """Prints the counts of the studies. The exit status is 1 if a case went wrong."""
    text = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("benchmarks.poisoned", None, __doc__, formatter_class=text)
    parser.add_argument(
        "names",
        nargs="*",
        help="parts of the names of studies, or whole names as in --list, of any elements",
    )
    parser.add_argument("--quick", action="store_true", help="the small studies of the tests")
    parser.add_argument("--list", action="store_true", help="the names alone")
    options = parser.parse_args(given)
    jax.config.update("jax_enable_x64", True)
    whole = [name for name in options.names if composed(name)]
    parts = [name for name in options.names if name not in whole]
    every = studies(options.quick)
    names = whole + [x for x in every if not options.names or any(part in x for part in parts)]
    total = Counts()
    for name in names:
        if options.list:
            print(name)
            continue
        counts = measure(name, options.quick)
        print(words(name, counts), flush=True)
        total += counts
    if not options.list:
        print(words("all", dataclasses.replace(total)).splitlines()[0])
    return 0 if total.clean else 1


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # replaced gains and step sizes cause warnings
    sys.exit(main())
