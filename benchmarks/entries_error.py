"""Benchmarks of correctness in the suite: errors, violations and failures."""

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
    """Measures violation and error after one second at 2 ms, relative to MuJoCo's Euler."""
    from benchmarks import accuracy as study
    from benchmarks.throughput import method_of

    metrics = []
    for name in SMALL[:1] if quick else scenes(quick):
        row = study.measure(name, method_of(name, "Sparse"), np.float32)
        metrics.append(error(f"{name}, violation over link", row.violation, floor=1e-6))
        metrics.append(error(f"{name}, error", row.error, "m"))
        if row.peer:
            title = f"{name}, error over that of MuJoCo's Euler"
            metrics.append(Metric(title, row.error / row.peer, "", LOWER))
        metrics.append(count(f"{name}, failed", float(not row.healthy)))
    return metrics


@entry("residuals")
def residuals(quick: bool) -> list[Metric]:
    """Measures backward errors of each solver on saddle-point systems of the scenes."""
    from benchmarks import residuals as study

    metrics, names = [], list(study.SOLVERS)
    for dtype in ("float64",) if quick else study.LIMIT:
        for name in SMALL[1:] if quick else scenes(quick):
            rows = list(study.measure(name, dtype, names, [0.0] if quick else [0.0, 0.25]))
            eps, title = float(jnp.finfo(dtype).eps), f"{name}, {dtype}"
            for what in ("motion", "constraint"):
                worst = max(getattr(row, what) for row in rows)
                metrics.append(error(f"{title}, {what}", worst, floor=10 * eps))
            failed = sum(row.verdict != "passes" for row in rows)
            metrics.append(count(f"{title}, failed", failed))
    return metrics


@entry("drift")
def drift(quick: bool) -> list[Metric]:
    """Measures constraint drift with and without feedback."""
    from benchmarks import drift as study

    with jax.enable_x64(True):
        rows = study.table(2e-3, 2.0) if quick else study.table()
    return [error(f"{row[0]}, {row[1]}", float(row[3]), "m", 1e-15) for row in rows]


@entry("energy_drift")
def energy_drift(quick: bool) -> list[Metric]:
    """Measures how much energy double pendulums with random starts gain or lose."""
    from benchmarks import energy_drift as study

    metrics = []
    pendulums = ("plane, 1 kg carries 0.5 kg",) if quick else tuple(study.PENDULUMS)
    seconds, starts = (4.0, 8) if quick else (120.0, 128)
    with jax.enable_x64(True):
        for name in pendulums:
            for label in ("default",) if quick else tuple(study.METHODS):
                pendulum, method = study.PENDULUMS[name], study.METHODS[label]
                row = study.measure(pendulum, method, 0.02, seconds, starts)
                title = f"{name}, {label}"
                metrics.append(error(f"{title}, gain", row.gain, floor=1e-6))
                metrics.append(error(f"{title}, loss", row.loss, floor=1e-6))
                metrics.append(count(f"{title}, failed", float(row.failed)))
    return metrics


@entry("stabilisation")
def stabilisation(quick: bool) -> list[Metric]:
    """Measures the largest φ, φ̇ and energy error, by stabilizer and integrator."""
    from benchmarks import stabilisation as study

    metrics = []
    names = ("Baumgarte", "projection") if quick else tuple(study.STABILIZERS)
    integrators = ("semi-implicit Euler",) if quick else tuple(study.INTEGRATORS)
    with jax.enable_x64(True):
        for scene in ("pendulum",) if quick else ("double_pendulum", "four_bar"):
            for integrator in integrators:
                for name in names:
                    settings = (np.float64, integrator, name, 2000 if quick else 10_000, 1e-3)
                    row = study.measure(scene, *settings)
                    if not row.remark:
                        title = f"{scene}, {integrator}, {name}"
                        metrics.append(error(f"{title}, φ", row.position, floor=1e-14))
                        metrics.append(error(f"{title}, energy", row.energy, floor=1e-12))
    return metrics


@entry("extremes")
def extremes(quick: bool) -> list[Metric]:
    """Counts the extreme values (masses, steps, gains, …) that each method withstands."""
    from benchmarks import extremes as study

    metrics = []
    families = ("gains",) if quick else ("tip", "step", "gains", "spring", "penalty", "flat")
    methods = ("semi-implicit Euler",) if quick else tuple(study.METHODS)
    with jax.enable_x64(True):
        for family in families:
            for label in methods:
                rows = study.run(study.FAMILIES[family], study.METHODS[label], np.float64)
                if not isinstance(rows, str):
                    held = sum(row.held for row in rows)
                    metrics.append(Metric(f"{family}, {label}, held", held, "", HIGHER, 1.0))
    return metrics


@entry("heavy_tip", "scipy")
def heavy_tip(quick: bool) -> list[Metric]:
    """Simulates a chain with a tip up to a million times heavier: errors of tip and energy."""
    from benchmarks import heavy_tip as study

    chain = study.Chain(links=2, ratio=1e3, seconds=0.6) if quick else study.Chain()
    reference, metrics = chain.reference(), []
    with jax.enable_x64(True):
        steps = {"generalized-α": 5e-3} if quick else {"RK4": 1e-4, "generalized-α": 1e-3}
        for name, dt in steps.items():
            result = study.run(chain, study.METHODS[name][0], dt, reference)
            metrics.append(error(f"{name}, tip", result.error, "m"))
            metrics.append(error(f"{name}, energy", result.energy))
    return metrics


@entry("equivalence", MUJOCO)
def equivalence(quick: bool) -> list[Metric]:
    """Compares the mechanisms in jaxcon and MuJoCo: positions, mass matrices and accelerations."""
    from benchmarks import equivalence as study

    metrics = []
    for name in ("planar-chain-3",) if quick else scenes(quick):
        row = study.compare(mechanisms.find(name))
        metrics += [
            error(f"{name}, {what}", getattr(row, what), floor=1e-12)
            for what in ("place", "mass", "acceleration")
        ]
    return metrics


@entry("mjcf_agreement", MUJOCO, GYMNASIUM)
def mjcf_agreement(quick: bool) -> list[Metric]:
    """Compares MJCF models with MuJoCo: accelerations, trajectories, closed loops."""
    from benchmarks import mjcf_agreement as study

    metrics = []
    with jax.enable_x64(True):
        for name in ("inverted_pendulum",) if quick else study.MODELS:
            deviation = study.acceleration_error(study.load(name), 5 if quick else 100)
            metrics.append(error(f"{name}, qacc", deviation, floor=1e-12))
            if not quick:
                trajectory = study.trajectory_error(study.load(name))
                metrics.append(error(f"{name}, qpos", trajectory, "", 1e-11))
        for name in () if quick else study.loops.LOOPS:
            row = study.loop_agreement(name)
            metrics.append(error(f"{name}, qacc continued", row.limit, floor=1e-7))
            metrics.append(error(f"{name}, open", row.closure, "m"))
    return metrics


@entry("collections", MUJOCO, GYMNASIUM)
def collections(quick: bool) -> list[Metric]:
    """Counts the models of Gymnasium that are refused."""
    from benchmarks import collections as study
    from benchmarks import legged

    paths = study.models(legged.ASSETS)
    counts = study.count(paths[:2] if quick else paths)
    return [Metric("tried", counts.tried), count("refused", counts.tried - counts.whole)]


@entry("bounded")
def bounded(quick: bool) -> list[Metric]:
    """Measures the largest residual of contact solvers over random states, and cost of a step."""
    from benchmarks import bounded as study

    metrics = []
    labels = ("GaussSeidel(15)",) if quick else ("GaussSeidel(50)", "InteriorPoint(15)")
    with jax.enable_x64(True):
        for scene in ("chain",) if quick else study.SCENES:
            for label in labels:
                settings = (jnp.dtype("float64"), study.SOLVERS[label], 20 if quick else 256)
                residuals, cost, compile_time = study.measure(scene, *settings)
                title = f"{scene}, {label}"
                metrics.append(error(f"{title}, missed", float(residuals.max()), floor=1e-12))
                metrics.append(seconds(f"{title}, step", cost))
                metrics.append(seconds(f"{title}, compile", compile_time))
    return metrics


@entry("falls", MUJOCO, GYMNASIUM)
def falls(quick: bool) -> list[Metric]:
    """Checks that fallen robots come to rest and that a heavy column stays up."""
    from benchmarks import falls as study

    stood = study.stand("default", "float32", 0.05 if quick else 60)
    metrics = [error("column, moved", stood.moved, "m", 1e-6)]
    for name in ("walker2d",) if quick else ("walker2d", "ant"):
        fallen = study.drop(name, "default", "float32", *((32, 0.2) if quick else (4096, 4.0)))
        metrics.append(count(f"{name}, failed", fallen.failed))
        if name == "walker2d" and not quick:
            metrics.append(error(f"{name}, speed of nine of ten", fallen.speeds[1], "rad/s", 1e-3))
    return metrics


@entry("gradient_table")
def gradient_table(quick: bool) -> list[Metric]:
    """Compares derivatives of rollouts with finite differences, for combinations of methods."""
    from benchmarks import gradient_table as study

    metrics = []
    with jax.enable_x64(True):
        for scene, build in list(study.SCENES.items())[: 1 if quick else None]:
            subject, choices = study.Subject(*build()), study.choices()
            for choice in choices[:1] if quick else study.covering(choices):
                row = study.measure(choice, scene, subject)
                worst, floor = max(row.forward, row.reverse), 1e-9
                floor = floor if choice.dtype == "float64" else 1e-5
                metrics.append(error(f"{scene}, {choice}", worst, floor=floor))
    return metrics


@entry("training")
def training(quick: bool) -> Found:
    """Counts the learning examples that reach their goals."""
    from benchmarks import training as study

    tasks = [(a, name) for a in study.ALGORITHMS for name in a.settings]
    if quick:
        algorithm, task = tasks[0]
        short = {task: algorithm.settings[task]._replace(updates=5)}
        tasks = [(dataclasses.replace(algorithm, settings=short), task)]
    seeds = [0] if quick else [0, 1, 2, 3, 4]
    rows = [study.measure(algorithm, task, seeds, 900.0) for algorithm, task in tasks]
    metrics = []
    for row in rows:
        title, last = f"{row.task}, {row.algorithm}", [curve[-1].earned for curve in row.curves]
        metrics.append(Metric(f"{title}, last return", float(np.mean(last)), "", HIGHER, 2.0))
        if not quick:
            reached = sum(look is not None for look in row.reached)
            metrics.append(Metric(f"{title}, reached the goal", reached, "", HIGHER, 1.0))
    return Found(tuple(metrics), lambda path: study.draw(rows, str(path)))


@entry("curricula")
def curricula(quick: bool) -> Found:
    """Evaluates policies on hard constraints that were trained on soft, noisy and relaxed ones."""
    from benchmarks import curricula as study

    arms = {"hard": study.ARMS["hard"]} if quick else study.ARMS
    seeds, updates = ([0], 3) if quick else ([0, 1, 2, 3, 4], 150)
    algorithm = "ppo" if quick else "apg"  # ppo compiles faster
    rows = study.study(algorithm, arms, seeds, updates)
    hard = study.TITLES.index("hard hinges")
    metrics = [
        Metric(f"{label}, share of the return", float(np.mean(arm["trials"], 0)[hard]))
        for label, arm in rows.items()
    ]
    return Found(tuple(metrics), lambda path: study.draw({algorithm: rows}, str(path)))


@entry("exploration")
def exploration(quick: bool) -> list[Metric]:
    """Measures returns and crashes of learning with feasible exploration and layered control."""
    from benchmarks import exploration as study

    metrics = []
    for name in ["feasible"] if quick else study.ARMS:
        rows = study.measure(name, [0] if quick else [0, 1, 2, 3, 4], 3 if quick else 100)
        _, last, crashes = np.mean(rows, axis=0)
        metrics.append(Metric(f"{name}, return", float(last), "", HIGHER, 2.0))
        metrics.append(Metric(f"{name}, crashes", float(crashes), "", LOWER, 2.0, floor=0.05))
    return metrics


@entry("gradient_states")
def gradient_states(quick: bool) -> list[Metric]:
    """Counts non-finite and wrong derivatives over many states, including singular states."""
    from benchmarks import gradient_states as study

    metrics, n = [], 40 if quick else 250
    scenes = list(study.SCENES)[: 1 if quick else None]
    with jax.enable_x64(True):
        for choice in list(study.choices(scenes, False))[: 1 if quick else None]:
            row = study.of_first(*choice, n, 0 if quick else 8)
            if row is None:
                continue
            title = f"{row.scene}, {row.dim}, {row.method}, {row.dtype}"
            metrics.append(count(f"{title}, not finite", row.broken))
            metrics.append(count(f"{title}, modes apart", row.beyond))
            metrics.append(count(f"{title}, off", row.off))
    return metrics


@entry("poisoned")
def poisoned(quick: bool) -> list[Metric]:
    """Counts wrong results of batches in which one world has a NaN or infinity."""
    from benchmarks import poisoned as study

    total = study.Counts()
    with jax.enable_x64(True):
        for name in ("PID", "recovery") if quick else study.studies(quick=True):
            total += study.measure(name, quick)
    wrong = ("accepted", "neighbors", "gradients")
    metrics = [count(f"{what}, wrong", len(getattr(total, what))) for what in wrong]
    return [Metric("tried", total.tried), *metrics]


@entry("random_scenes")
def random_scenes(quick: bool) -> list[Metric]:
    """Counts failed checks of random mechanisms under the default method."""
    from benchmarks import random_scenes as study

    number, total = 1 if quick else 20, dict.fromkeys(study.CHECKS, 0)
    with jax.enable_x64(True):
        for mechanism in study.study(number):
            for name in mechanism.wrong:
                total[name] += 1
    return [Metric("tried", 2 * number), *(count(f"{k}, wrong", x) for k, x in total.items())]
