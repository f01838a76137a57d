"""The benchmarks of the suite: each a study of this folder, small or whole, as metrics."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms, targets
from benchmarks.accuracy import has_mujoco
from benchmarks.suite import HIGHER, LOWER, Entry, Found, Metric, count, error, rate, seconds

ENTRIES: dict[str, Entry] = {}
GYMNASIUM, MUJOCO = "gymnasium", "mujoco"
SMALL = ("pendulum", "four-bar")
"""The scenes of a quick run."""
WORLDS = 512
"""In a batch whose rate is measured."""


def entry(name: str, *needs: str) -> Callable[[Callable[[bool], Any]], Callable[[bool], Any]]:
    """Enters a function from quick to metrics, or to `Found`; its docstring says what it does."""

    def enters(run: Callable[[bool], Any]) -> Callable[[bool], Any]:
        def found(quick: bool) -> Found:
            result = run(quick)
            return result if isinstance(result, Found) else Found(tuple(result))

        about = (run.__doc__ or "").strip().splitlines()[0]
        ENTRIES[name] = Entry(name, about, found, needs)
        return run

    return enters


def scenes(quick: bool) -> list[str]:
    """Of the comparison with other simulators."""
    return list(SMALL if quick else targets.SCENES)


@entry("throughput")
def throughput(quick: bool) -> list[Metric]:
    """World-steps a second, over the peak of the machine and over MuJoCo in C on all cores."""
    from benchmarks import peers, roofline
    from benchmarks.throughput import method_of, run_batch

    found = []
    for name in scenes(quick):
        steps = run_batch(name, method_of(name, "Sparse"), np.float32, WORLDS, repeats=3)[0].median
        share = steps / (roofline.peak() / 1e6)
        found.append(rate(f"{name}, world-steps", steps))
        found.append(Metric(f"{name}, over the peak", share, "steps/Mop"))
        if has_mujoco():
            other = peers.mujoco_rate(name, seconds=0.2).median
            found.append(Metric(f"{name}, over MuJoCo C", steps / other))
    return found


@entry("equal_error")
def equal_error(quick: bool) -> Found:
    """Cost at equal error beside MuJoCo in C and MJX, for errors from 1e-2 to 1e-8."""
    from benchmarks import equal_error as study
    from benchmarks import motions

    names = ("pendulum",) if quick else tuple(motions.MOTIONS)
    record, codes = study.Record.of(None, False), study.CODES if has_mujoco() else ("jaxcon",)
    found = []
    for name in names:
        motion = motions.MOTIONS[name]()
        if quick:
            study.glance(record, motion)
        else:
            study.measure(record, motion, codes)
        points = record.points(name)
        for level in study.LEVELS[::2]:
            price = study.best(points, "jaxcon", level)
            found += [seconds(f"{name}, {level:.0e} {motion.unit}", price.cost)] if price else []
            for code in codes[1:]:
                times = study.ratio(points, code, level)
                title = f"{name}, {level:.0e} {motion.unit}, {code} over jaxcon"
                found += [Metric(title, times, tolerance=2.0)] if times else []
    drawn = {name: record.points(name) for name in names}
    return Found(tuple(found), lambda path: study.draw(drawn, path))


@entry("compile_time")
def compile_time(quick: bool) -> list[Metric]:
    """How long programs take to compile, also over what a fixed program of plain JAX takes."""
    from benchmarks import compile_time as study
    from benchmarks import timing

    found, yard = [], timing.yardstick()
    given = argparse.Namespace(solver="Sparse", limit=100.0, one_device=False)
    for name in scenes(quick):
        for program in ("step",) if quick else ("step", "rollout"):
            if quick:
                spent: Any = study.seconds_here(name, program, study.BATCHES[0], "Sparse")
            else:
                spent = study.seconds(name, program, study.BATCHES[0], given)
            spent = float("nan") if isinstance(spent, str) else spent
            found.append(seconds(f"{name}, {program}", spent))
            title = f"{name}, {program}, over a fixed program"
            found.append(Metric(title, spent / yard, "", LOWER, 2.0))
    return found


@entry("memory")
def memory(quick: bool) -> list[Metric]:
    """Temporary memory that XLA plans for gradients, by how steps are kept."""
    from benchmarks import gradients as study

    found = []
    for name in ("four-bar",) if quick else ("chain-10", "four-bar"):
        for label, adjoint in study.ADJOINTS.items():
            for steps in (100,) if quick else study.LENGTHS:
                size = study.planned(name, adjoint, 256, steps)
                found.append(count(f"{name}, {label}, {steps} steps", size / 1e6, "MB", 1.2))
    return found


@entry("operations")
def operations(quick: bool) -> list[Metric]:
    """Arithmetic operations of a step, and the peak of the machine."""
    from benchmarks import roofline

    method = jc.Method(solver=jc.Sparse())
    found = [rate("peak, float32 operations", roofline.peak())]
    for name in scenes(quick):
        work = roofline.work(name, method, np.float32).operations
        found.append(count(name, work, "operations", 1.05))
    return found


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


@entry("gradients")
def gradients(quick: bool) -> list[Metric]:
    """Value and gradient of a rollout, in rollouts, and their error against differences."""
    from benchmarks import gradients as study

    found = []
    for name in ("four-bar",) if quick else ("chain-10", "four-bar"):
        for label, adjoint in list(study.ADJOINTS.items())[: 1 if quick else None]:
            loss, worlds = study.ours(name, adjoint, 256)
            cost = study.measure(loss, worlds, 100 if quick else 1000, study.SHORT)
            title = f"{name}, {label}"
            found += [
                Metric(f"{title}, rollouts", cost.ratio, "", LOWER),
                seconds(f"{title}, compile", cost.gradient_compile),
                Metric(
                    f"{title}, compile over that of the rollout",
                    cost.gradient_compile / cost.forward_compile,
                    "",
                    LOWER,
                    2.0,
                ),
                error(f"{title}, error", cost.error),
                count(f"{title}, not finite", float(not cost.finite)),
            ]
    return found


@entry("environments", GYMNASIUM)
def environments(quick: bool) -> list[Metric]:
    """Actions a second of Gymnasium's vector interface, and their share of bare steps."""
    from benchmarks import environments as study
    from jaxcon.environments import TASKS

    found = []
    for task in ("CartPole",) if quick else TASKS:
        row = study.measure(task, 1024 if quick else 4096, 20 if quick else 100, 5)
        found.append(rate(f"{task}, actions", row.interface))
        found.append(Metric(f"{task}, share of bare steps", row.share))
    return found


@entry("devices")
def devices(quick: bool) -> list[Metric]:
    """What more devices bring, and how often they exchange something."""
    from benchmarks import devices as study

    found = []
    given = argparse.Namespace(batch=256 if quick else 1024, work=20_000 if quick else 200_000)
    for name in ("four-bar",) if quick else ("four-bar", "planar-chain-10"):
        rows = [study.elsewhere(name, n, given) for n in ((2,) if quick else (1, 2))]
        last = rows[-1]
        if isinstance(last, str):
            raise RuntimeError(f"{name} {last}")
        for what, own in zip(("rollout", "gradient"), last.exchanges, strict=True):
            found.append(count(f"{name}, exchanges of the {what}", sum(own.values())))
        if not quick and not isinstance(rows[0], str):
            gain = last.rollout.median / rows[0].rollout.median
            found.append(Metric(f"{name}, two devices over one", gain))
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


@entry("legged", MUJOCO, GYMNASIUM)
def legged(quick: bool) -> list[Metric]:
    """Legged robots dropped on the floor: depth and speed at the end, and rates over MuJoCo C."""
    from benchmarks import legged as study

    found = []
    with jax.enable_x64(True):
        for name in ("hopper",) if quick else ("hopper", "half_cheetah", "walker2d"):
            model = study.load(name)
            read = jc.from_mjcf(model, dtype=jnp.dtype("float32"))
            batches = [1] if quick else [1, 64]
            drop = study.dropped(read, model, study.BOUNDED["GaussSeidel"], batches)
            found.append(error(f"{name}, depth in the floor", drop.depth.floor, "m", 1e-6))
            found.append(error(f"{name}, depth in limbs", drop.depth.limbs, "m", 1e-6))
            found.append(count(f"{name}, failed", float(not drop.healthy)))
            found.append(seconds(f"{name}, compile", drop.compile[1]))
            if not quick:
                times = drop.rates[64] / study.mujoco_rate(name, 64).median
                found.append(Metric(f"{name}, over MuJoCo C", times))
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


@entry("native_share")
def native_share(quick: bool) -> list[Metric]:
    """What of the native speed plain jit(vmap(rollout)) reaches."""
    from benchmarks import native_share as study

    rows = [study.measure(x, 512, np.float32) for x in (SMALL[1:] if quick else scenes(quick))]
    return [Metric(row.scene, row.ratios[1], "", HIGHER, 1.2) for row in rows]


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
    seeds, limit = ([0], 3.0) if quick else ([0, 1, 2, 3, 4], 900.0)
    rows = [study.measure(a, task, seeds, limit) for a, task in known[: 1 if quick else None]]
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
    rows = study.study("apg", arms, seeds, updates)
    hard = study.TITLES.index("hard hinges")
    found = [
        Metric(f"{label}, share of the return", float(np.mean(arm["trials"], 0)[hard]))
        for label, arm in rows.items()
    ]
    return Found(tuple(found), lambda path: study.draw({"apg": rows}, str(path)))
