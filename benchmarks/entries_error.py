"""The entries of the suite that say how right something is: errors, violations, failures."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import mechanisms
from benchmarks.suite import (
    GYMNASIUM,
    HIGHER,
    LOWER,
    MUJOCO,
    SMALL,
    Found,
    Metric,
    count,
    entry,
    error,
    scenes,
    seconds,
)


@entry("accuracy")
def accuracy(quick: bool) -> list[Metric]:
    """Violation and error after a second at 2 ms in float32, and MuJoCo's error at that step."""
    from benchmarks import accuracy as study
    from benchmarks.throughput import method_of

    found = []
    for name in SMALL[:1] if quick else scenes(quick):
        row = study.measure(name, method_of(name, "Sparse"), np.float32)
        found.append(error(f"{name}, violation over link", row.violation, floor=1e-6))
        found.append(error(f"{name}, error", row.error, "m"))
        if row.peer:
            title = f"{name}, error over that of MuJoCo's Euler"
            found.append(Metric(title, row.error / row.peer, "", LOWER))
        found.append(count(f"{name}, failed", float(not row.healthy)))
    return found


@entry("residuals")
def residuals(quick: bool) -> list[Metric]:
    """How well each solver solves the saddle system: backward errors, worst of all states."""
    from benchmarks import residuals as study

    found, names = [], list(study.SOLVERS)
    for dtype in ("float64",) if quick else study.LIMIT:
        for name in SMALL[1:] if quick else scenes(quick):
            rows = list(study.measure(name, dtype, names, [0.0] if quick else [0.0, 0.25]))
            eps, title = float(jnp.finfo(dtype).eps), f"{name}, {dtype}"
            for what in ("motion", "constraint"):
                worst = max(getattr(row, what) for row in rows)
                found.append(error(f"{title}, {what}", worst, floor=10 * eps))
            failed = sum(row.verdict != "passes" for row in rows)
            found.append(count(f"{title}, failed", failed))
    return found


@entry("drift")
def drift(quick: bool) -> list[Metric]:
    """How far constraints drift with feedback and without it."""
    from benchmarks import drift as study

    with jax.enable_x64(True):
        rows = study.table(2e-3, 2.0) if quick else study.table()
    return [error(f"{row[0]}, {row[1]}", float(row[3]), "m", 1e-15) for row in rows]


@entry("stabilisation")
def stabilisation(quick: bool) -> list[Metric]:
    """How far φ, φ̇ and the energy get, by stabiliser and integrator."""
    from benchmarks import stabilisation as study

    found = []
    names = ("Baumgarte", "projection") if quick else tuple(study.STABILIZERS)
    integrators = ("semi-implicit Euler",) if quick else tuple(study.INTEGRATORS)
    with jax.enable_x64(True):
        for scene in ("pendulum",) if quick else ("double_pendulum", "four_bar"):
            for integrator in integrators:
                for name in names:
                    given = (np.float64, integrator, name, 2000 if quick else 10_000, 1e-3)
                    row = study.measure(scene, *given)
                    if not row.remark:
                        title = f"{scene}, {integrator}, {name}"
                        found.append(error(f"{title}, φ", row.position, floor=1e-14))
                        found.append(error(f"{title}, energy", row.energy, floor=1e-12))
    return found


@entry("extremes")
def extremes(quick: bool) -> list[Metric]:
    """How many of the absurd values of masses, steps, gains, … each method holds."""
    from benchmarks import extremes as study

    found = []
    families = ("gains",) if quick else ("tip", "step", "gains", "spring", "penalty", "flat")
    methods = ("semi-implicit Euler",) if quick else tuple(study.METHODS)
    with jax.enable_x64(True):
        for family in families:
            for label in methods:
                rows = study.run(study.FAMILIES[family], study.METHODS[label], np.float64)
                if not isinstance(rows, str):
                    held = sum(row.held for row in rows)
                    found.append(Metric(f"{family}, {label}, held", held, "", HIGHER, 1.0))
    return found


@entry("heavy_tip", "scipy")
def heavy_tip(quick: bool) -> list[Metric]:
    """A chain with a tip a million times heavier: error of the tip and energy."""
    from benchmarks import heavy_tip as study

    chain = study.Chain(links=2, ratio=1e3, seconds=0.6) if quick else study.Chain()
    reference, found = chain.reference(), []
    with jax.enable_x64(True):
        steps = {"generalized-α": 5e-3} if quick else {"RK4": 1e-4, "generalized-α": 1e-3}
        for name, dt in steps.items():
            got = study.run(chain, study.METHODS[name][0], dt, reference)
            found.append(error(f"{name}, tip", got.error, "m"))
            found.append(error(f"{name}, energy", got.energy))
    return found


@entry("equivalence", MUJOCO)
def equivalence(quick: bool) -> list[Metric]:
    """Whether jaxcon and MuJoCo have the same mechanisms: places, M and accelerations."""
    from benchmarks import equivalence as study

    found = []
    for name in ("planar-chain-3",) if quick else scenes(quick):
        row = study.compare(mechanisms.find(name))
        found += [
            error(f"{name}, {what}", getattr(row, what), floor=1e-12)
            for what in ("place", "mass", "acceleration")
        ]
    return found


@entry("mjcf_agreement", MUJOCO, GYMNASIUM)
def mjcf_agreement(quick: bool) -> list[Metric]:
    """How far models read from MJCF are from MuJoCo: accelerations, trajectories, closed loops."""
    from benchmarks import mjcf_agreement as study

    found = []
    with jax.enable_x64(True):
        for name in ("inverted_pendulum",) if quick else study.MODELS:
            off = study.acceleration_error(study.load(name), 5 if quick else 100)
            found.append(error(f"{name}, qacc", off, floor=1e-12))
            if not quick:
                path = study.trajectory_error(study.load(name))
                found.append(error(f"{name}, qpos", path, "", 1e-11))
        for name in () if quick else study.loops.LOOPS:
            row = study.loop_agreement(name)
            found.append(error(f"{name}, qacc continued", row.limit, floor=1e-7))
            found.append(error(f"{name}, open", row.closure, "m"))
    return found


@entry("bounded")
def bounded(quick: bool) -> list[Metric]:
    """What solvers of bounded rows miss, the worst of random states, and what a step costs."""
    from benchmarks import bounded as study

    found = []
    labels = ("GaussSeidel(15)",) if quick else ("GaussSeidel(50)", "InteriorPoint(15)")
    with jax.enable_x64(True):
        for scene in ("chain",) if quick else study.SCENES:
            for label in labels:
                given = (jnp.dtype("float64"), study.SOLVERS[label], 20 if quick else 256)
                missed, cost, compiling = study.measure(scene, *given)
                title = f"{scene}, {label}"
                found.append(error(f"{title}, missed", float(missed.max()), floor=1e-12))
                found.append(seconds(f"{title}, step", cost))
                found.append(seconds(f"{title}, compile", compiling))
    return found


@entry("falls", MUJOCO, GYMNASIUM)
def falls(quick: bool) -> list[Metric]:
    """What must come to rest, and what must stay up: walkers, and a heavy column."""
    from benchmarks import falls as study

    stood = study.stand(
        "GaussSeidel" if quick else "InteriorPoint", "float32", 0.05 if quick else 60
    )
    found = [error("column, moved", stood.moved, "m", 1e-6)]
    if not quick:
        fallen = study.drop("GaussSeidel", "float32", 1000, 4.0)
        found.append(count("walkers, failed", fallen.failed))
        found.append(error("walkers, speed of nine of ten", fallen.speeds[1], "rad/s", 1e-4))
    return found


@entry("gradient_table")
def gradient_table(quick: bool) -> list[Metric]:
    """Derivatives of rollouts against differences, for all that can be combined."""
    from benchmarks import gradient_table as study

    found = []
    with jax.enable_x64(True):
        for scene, build in list(study.SCENES.items())[: 1 if quick else None]:
            subject, choices = study.Subject(*build()), study.choices()
            for choice in choices[:1] if quick else study.covering(choices):
                row = study.measure(choice, scene, subject)
                worst, floor = max(row.forward, row.reverse), 1e-9
                floor = floor if choice.dtype == "float64" else 1e-5
                found.append(error(f"{scene}, {choice}", worst, floor=floor))
    return found


@entry("training")
def training(quick: bool) -> Found:
    """Whether the examples of learning reach their goals."""
    from benchmarks import training as study

    known = [(a, task) for a in study.ALGORITHMS for task in a.settings]
    if quick:
        algorithm, task = known[0]
        short = {task: algorithm.settings[task]._replace(updates=5)}
        known = [(dataclasses.replace(algorithm, settings=short), task)]
    seeds = [0] if quick else [0, 1, 2, 3, 4]
    rows = [study.measure(algorithm, task, seeds, 900.0) for algorithm, task in known]
    found = []
    for row in rows:
        title, last = f"{row.task}, {row.algorithm}", [curve[-1].earned for curve in row.curves]
        found.append(Metric(f"{title}, last return", float(np.mean(last)), "", HIGHER, 2.0))
        if not quick:
            reached = sum(look is not None for look in row.reached)
            found.append(Metric(f"{title}, reached the goal", reached, "", HIGHER, 1.0))
    return Found(tuple(found), lambda path: study.draw(rows, str(path)))


@entry("curricula")
def curricula(quick: bool) -> Found:
    """Policies trained on soft, noisy and relaxed constraints, tried on hard ones."""
    from benchmarks import curricula as study

    arms = {"hard": study.ARMS["hard"]} if quick else study.ARMS
    seeds, updates = ([0], 3) if quick else ([0, 1, 2, 3, 4], 150)
    algorithm = "ppo" if quick else "apg"  # of which the first compiles sooner
    rows = study.study(algorithm, arms, seeds, updates)
    hard = study.TITLES.index("hard hinges")
    found = [
        Metric(f"{label}, share of the return", float(np.mean(arm["trials"], 0)[hard]))
        for label, arm in rows.items()
    ]
    return Found(tuple(found), lambda path: study.draw({algorithm: rows}, str(path)))


@entry("exploration")
def exploration(quick: bool) -> list[Metric]:
    """Feasible exploration and layered control in learning by trial: returns and crashes."""
    from benchmarks import exploration as study

    found = []
    for name in ["feasible"] if quick else study.ARMS:
        rows = study.measure(name, [0] if quick else [0, 1, 2, 3, 4], 3 if quick else 100)
        _, last, crashes = np.mean(rows, axis=0)
        found.append(Metric(f"{name}, return", float(last), "", HIGHER, 2.0))
        found.append(Metric(f"{name}, crashes", float(crashes), "", LOWER, 2.0, floor=0.05))
    return found


@entry("gradient_states")
def gradient_states(quick: bool) -> list[Metric]:
    """Derivatives in very many states, also at singular spots: those not finite or not right."""
    from benchmarks import gradient_states as study

    found, n = [], 40 if quick else 250
    scenes = list(study.SCENES)[: 1 if quick else None]
    with jax.enable_x64(True):
        for choice in list(study.choices(scenes, False))[: 1 if quick else None]:
            row = study.of_first(*choice, n, 0 if quick else 8)
            if row is None:
                continue
            title = f"{row.scene}, {row.dim}, {row.method}, {row.dtype}"
            found.append(count(f"{title}, not finite", row.broken))
            found.append(count(f"{title}, modes apart", row.beyond))
            found.append(count(f"{title}, off", row.off))
    return found


@entry("poisoned")
def poisoned(quick: bool) -> list[Metric]:
    """Batches with a number that is NaN or infinite in one world: what goes wrong, of all tried."""
    from benchmarks import poisoned as study

    total = study.Counts()
    with jax.enable_x64(True):
        for name in ("PID", "recovery") if quick else study.studies(quick=True):
            total += study.measure(name, quick)
    wrong = ("accepted", "neighbors", "gradients")
    found = [count(f"{what}, wrong", len(getattr(total, what))) for what in wrong]
    return [Metric("tried", total.tried), *found]


@entry("random_scenes")
def random_scenes(quick: bool) -> list[Metric]:
    """Random mechanisms under the default method: checks that fail, of all tried."""
    from benchmarks import random_scenes as study

    number, total = 1 if quick else 20, dict.fromkeys(study.CHECKS, 0)
    with jax.enable_x64(True):
        for found in study.study(number):
            for name in found.wrong:
                total[name] += 1
    return [Metric("tried", 2 * number), *(count(f"{k}, wrong", x) for k, x in total.items())]
