"""Batches in which one number of one world is NaN or infinite: who is told, and who else notices.

    python -m benchmarks.poisoned [--quick] [--names TEXT] [--list]

Each element of `gradient_elements` joins a scene of its dimension on two bodies of its own. Every
number is poisoned in turn: those of `system.params`, control, start, step size and the method. All
cases run as worlds of one batch beside healthy worlds, so that a scene is compiled once. Checked:

    status     the poisoned world fails after the first step, unless infinity means "no limit"
    neighbors  healthy worlds are those of a healthy batch, bit for bit
    gradient   the gradient by shared numbers is that of the healthy worlds alone, in both modes

Prints counts by scene and method, and the cases that go wrong.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import sys
from collections.abc import Iterator
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
HEALTHY = 2
"""Healthy worlds at the front of each batch."""
BATCH = 256
"""Worlds of a batch; what is left over is healthy, too."""
STEPS, DT = 3, 0.01

NO_LIMIT = {("lower", -np.inf), ("upper", np.inf), ("dt", 0.0)}
"""Infinite fields that are none: a joint without a stop on that side. A step of 0 may stand still."""


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

    fields = (f.name for f in dataclasses.fields(element))
    return dataclasses.replace(element, **{name: renamed(getattr(element, name)) for name in fields})


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
        """Whether infinity there is documented to mean "no limit"."""
        return (self.path.rsplit("/", 1)[-1], self.poison) in NO_LIMIT

    def __str__(self) -> str:
        return f"{self.path}{list(self.index) or ''} = {self.poison}"


@dataclass(frozen=True)
class Counts:
    """What became of the cases of a study.

    Attributes:
        tried: cases.
        told: worlds that failed in the first step, or after the retries of a `Recovery`.
        free: worlds that went on, where infinity means "no limit".
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
        """Whether nothing went wrong."""
        return not (self.accepted or self.neighbors or self.gradients)


@dataclass(frozen=True)
class Seen:
    """What a batch did.

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
                for poison in (*POISONS, 0.0) if path == "dt" else POISONS:
                    yield Case(path, leaf, index, poison)

    def batch(self, cases: list[Case | None]) -> list[np.ndarray]:
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
        """Whether it is a number of a stop, contact, friction or motor."""
        names = {name for group in self.system.bounds for name in group.names}
        return case.path.split("/")[1:2] != [] and case.path.split("/")[1] in names

    def seen(self, cases: list[Case | None], failures_count: bool = False) -> Seen:
        """What a batch of these cases does."""
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
        """What becomes of the cases."""
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
    """Whether arrays agree bit for bit."""
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def _near(a: Any, b: Any) -> bool:
    """Whether gradients agree to rounding, relative to the largest."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.allclose(x, y, rtol=1e-9, atol=1e-9 * np.max(np.abs(y))) for x, y in pairs)
