"""Batches in which a number of one world is NaN or infinite: who is told, and who else notices.

    python -m benchmarks.poisoned [NAMES …] [--quick] [--list]

Each element of `gradient_elements` joins a scene of its dimension on two bodies of its own. Every
number is poisoned in turn: those of `system.params`, control, start, step size and the method. All
cases run as worlds of a batch beside healthy worlds, so that a scene is compiled once. Checked:

    status     the poisoned world fails after the first step, unless infinity means "no limit"
    neighbors  healthy worlds are those of a healthy batch, bit for bit
    gradient   the gradient by shared numbers is that of the healthy worlds alone, in both modes

Prints counts by scene and method, and the cases that go wrong; ends with 1 where there are any.
`--quick` takes the small scenes of the tests, and the first entry of each array. The long version
takes every element in the plane and in space under several methods, some hours on one core.
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
"""Numbers by which a world may fail or go on; others must not notice either."""
HEALTHY = 2
"""Healthy worlds at the front of each batch."""
BATCH = 256
"""Worlds of a batch; what is left over is healthy, too."""
STEPS, DT = 3, 0.01

NO_LIMIT = {("lower", -np.inf), ("upper", np.inf)}
"""Fields that may be infinite, and on which side: a joint without a stop there."""


def stage(dim: int, tables: dict[str, Any]) -> Any:
    """A scene with all elements of the tables, each on two bodies of its own.

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
    """The element with a suffix to its name, and to those of the bodies and joints it names."""

    def renamed(x: Any) -> Any:
        if isinstance(x, tuple):
            return tuple(renamed(y) for y in x)
        return x + suffix if isinstance(x, str) and x in known else x

    names = [field.name for field in dataclasses.fields(element)]
    return dataclasses.replace(element, **{x: renamed(getattr(element, x)) for x in names})


@dataclass(frozen=True)
class Case:
    """One number and what it is replaced by.

    Attributes:
        path: of the leaf, such as "params/law1/friction".
        leaf: its place among the leaves.
        index: of the number in the leaf.
        poison: NaN, inf or −inf.
    """

    path: str
    leaf: int
    index: tuple[int, ...]
    poison: float

    @property
    def allowed(self) -> bool:
        """Returns True where the world may go on: its number means "no limit", or is no poison."""
        finite = bool(np.isfinite(self.poison))
        return finite or (self.path.rsplit("/", 1)[-1], self.poison) in NO_LIMIT

    def __str__(self) -> str:
        return f"{self.path}{list(self.index) or ''} = {self.poison}"


@dataclass(frozen=True)
class Counts:
    """The counts of a study.

    Attributes:
        tried: cases.
        told: worlds that failed in the first step, or after the retries of a `Recovery`.
        free: worlds that went on and may, see `Case.allowed`.
        idle: worlds that went on as without the poison, whose number takes no part in the motion,
            as the time where nothing depends on it. Numbers of inequalities are never idle.
        accepted: cases in which the world went on otherwise.
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
        """Both together."""
        names = [field.name for field in dataclasses.fields(self)]
        return Counts(*(getattr(self, name) + getattr(other, name) for name in names))

    @property
    def clean(self) -> bool:
        """True where no case went wrong."""
        return not (self.accepted or self.neighbors or self.gradients)


@dataclass(frozen=True)
class Seen:
    """The results of a batch.

    Attributes:
        failed: by case and step, whether its world had failed.
        healthy: final states of the healthy worlds, and tangents of their losses.
        cases: the same of the others.
        gradient: of the sum of the losses that count.
    """

    failed: np.ndarray
    healthy: tuple[np.ndarray, ...]
    cases: tuple[np.ndarray, ...]
    gradient: Any


class Study:
    """One scene under one method.

    Args:
        system, state: as built.
        method: its floating leaves are poisoned as well.
        thorough: whether every entry of an array is poisoned, or the first alone.
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
        """Every number with every poison."""
        for leaf, (path, x) in enumerate(zip(self.paths, self.numbers, strict=True)):
            indices = list(itertools.product(*map(range, x.shape)))
            for index in indices if self.thorough else indices[:1]:
                for poison in (*POISONS, *LIMITS):
                    yield Case(path, leaf, index, poison)

    def batch(self, cases: Sequence[Case | None]) -> list[np.ndarray]:
        """The numbers of all worlds: healthy ones, and one for each case."""
        numbers = [np.repeat(x[None], BATCH, axis=0) for x in self.numbers]
        velocity = numbers[self.paths.index("v")]
        velocity[:HEALTHY] += 0.01 * np.arange(HEALTHY)[:, None]
        for world, case in enumerate(cases, start=HEALTHY):
            if case is not None:
                numbers[case.leaf][(world, *case.index)] = case.poison
        return numbers

    def rollout(self, shared: Any, numbers: list[Any]) -> Any:
        """The final state of one world and its status after each step."""
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
        """A number of one world that reads all of its final state."""
        final, codes = self.rollout(shared, numbers)
        weights = jnp.cos(jnp.arange(final.q.size + final.v.size, dtype=final.q.dtype))
        return jnp.sum(weights * jnp.concatenate([final.q, final.v])), (final, codes)

    @cached_property
    def shared(self) -> dict[str, Any]:
        """Numbers that all worlds share: offsets of gravity, a mass and h."""
        dtype = self.state.q.dtype
        none = jnp.zeros(self.system.layout.dim, dtype)
        return {"gravity": none, "mass": jnp.zeros((), dtype), "h": jnp.zeros((), dtype)}

    @cached_property
    def compiled(self) -> Any:
        """(numbers, which losses count) → statuses, and what healthy worlds must not notice."""

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

        # compiled once and run a few times: what the program computes matters, not its speed
        return jax.jit(run, compiler_options={"xla_backend_optimization_level": 0})

    def of_inequality(self, case: Case) -> bool:
        """True for a number of a stop, contact, friction or motor."""
        names = {name for group in self.system.bounds for name in group.names}
        return case.path.split("/")[1:2] != [] and case.path.split("/")[1] in names

    def seen(self, cases: Sequence[Case | None], failures_count: bool = False) -> Seen:
        """Runs the cases as a batch."""
        numbers = self.batch(cases)
        counts = np.arange(BATCH) < HEALTHY
        codes, worlds, gradient = self.compiled(numbers, counts)
        codes = np.asarray(codes)[HEALTHY : HEALTHY + len(cases)]
        failed = (codes > 0) & (codes < int(jc.Status.CONFLICT))
        if failures_count:  # their losses must not add to the gradient
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
        """Counts how the cases end."""
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
    """The cases that alone make a batch bad, by halves; all where only several together do."""
    if not cases or not bad(cases):
        return ()
    if len(cases) == 1:
        return tuple(cases)
    half = len(cases) // 2
    found = culprits(bad, cases[:half]) + culprits(bad, cases[half:])
    return found or tuple(cases)


def _same(a: Any, b: Any) -> bool:
    """Returns True where arrays agree bit for bit."""
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def _near(a: Any, b: Any) -> bool:
    """Returns True where gradients agree to rounding, relative to the largest."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.allclose(x, y, rtol=1e-9, atol=1e-9 * np.max(np.abs(y))) for x, y in pairs)


QUICK: dict[str, tuple[tuple[str, ...], int, Any]] = {
    "contact": (("ball that rolls with resistance",), 2, jc.Method()),
    "sweeps": (("soft stops", "dry friction"), 2, jc.Method(bounded=jc.GaussSeidel(sweeps=4))),
    "generalized-α": (("force",), 2, jc.Method(jc.GeneralizedAlpha())),
    "PID": (("distance",), 2, jc.Method(stabilizer=jc.PID(100.0, 20.0, 10.0, limit=5.0))),
    "adaptive": (("distance",), 2, jc.Method(stabilizer=jc.AdaptiveBaumgarte(10.0, 10.0))),
    "window": (("distance",), 2, jc.Method(stabilizer=jc.SlidingWindowBaumgarte())),
    "springs": (("distance",), 2, jc.Method(stabilizer=jc.Penalty(100.0, 1.0))),
    "rounds": (("distance",), 2, jc.Method(stabilizer=jc.AugmentedLagrangian())),
    "recovery": (("distance",), 2, jc.Method(recovery=jc.Recovery(limit=0.5, retries=1))),
}
"""Elements, dimension and method of the small studies, by name."""

SETS = {
    "plain": ({**JOINTS, **FORCES, **ENDS}, jc.Method()),
    "RK4": ({**JOINTS, **FORCES, **ENDS}, jc.Method(jc.RK4())),
    "RATTLE": ({**JOINTS, **FORCES}, jc.Method(jc.RATTLE())),
    "generalized-α": ({**JOINTS, **FORCES}, jc.Method(jc.GeneralizedAlpha())),
    "sweeps": (ENDS, jc.Method(bounded=jc.GaussSeidel(sweeps=8))),
    "nearest": (ENDS, jc.Method(bounded=jc.Nearest(stops=1))),
    "events": (ENDS, jc.Method(events=jc.Events())),
    "recovery": (ENDS, jc.Method(recovery=jc.Recovery(retries=1))),
}
"""Elements and methods of the long studies."""

TOGETHER = 3
"""Elements of a scene of the long studies: compiling takes ten seconds each."""


def studies(quick: bool) -> dict[str, tuple[tuple[str, ...], int, Any]]:
    """Elements, dimension and method of every study, by name."""
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


def measure(name: str, quick: bool) -> Counts:
    """The counts of one study."""
    elements, dim, method = studies(quick=False)[name]
    every = {**JOINTS, **FORCES, **ENDS}
    system, state = stage(dim, {element: every[element] for element in elements})
    return Study(system, state, method, thorough=not quick).run()


def words(name: str, counts: Counts) -> str:
    """A line of the table, and what went wrong below it."""
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
    """Prints the table."""
    text = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("benchmarks.poisoned", None, __doc__, formatter_class=text)
    parser.add_argument("names", nargs="*", help="parts of the names of studies")
    parser.add_argument("--quick", action="store_true", help="the small studies of the tests")
    parser.add_argument("--list", action="store_true", help="the names alone")
    options = parser.parse_args(given)
    jax.config.update("jax_enable_x64", True)
    names = [
        name
        for name in studies(options.quick)
        if not options.names or any(part in name for part in options.names)
    ]
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
    warnings.simplefilter("ignore")  # gains are poisoned, and some steps have none
    sys.exit(main())
