"""The entries of the suite that say what something costs: time, compilation, memory, operations."""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks.accuracy import has_mujoco
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
    rate,
    scenes,
    seconds,
)

WORLDS = 512
"""In a batch whose rate is measured."""


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
    found, drawn = [], []
    for name in names:
        motion = motions.MOTIONS[name]()
        if quick:
            study.glance(record, motion)
        else:
            study.measure(record, motion, codes)
        points = record.points(name)
        drawn.append((motion, points))
        for level in study.LEVELS[::2]:
            price = study.best(points, "jaxcon", level)
            found += [seconds(f"{name}, {level:.0e} {motion.unit}", price.cost)] if price else []
            for code in codes[1:]:
                times = study.ratio(points, code, level)
                title = f"{name}, {level:.0e} {motion.unit}, {code} over jaxcon"
                found += [Metric(title, times, tolerance=2.0)] if times else []
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
        for label, adjoint in list(study.ADJOINTS.items())[: 1 if quick else None]:
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


@entry("native_share")
def native_share(quick: bool) -> list[Metric]:
    """What of the native speed plain jit(vmap(rollout)) reaches."""
    from benchmarks import native_share as study

    rows = [study.measure(x, 512, np.float32) for x in (SMALL[1:] if quick else scenes(quick))]
    return [Metric(row.scene, row.ratios[1], "", HIGHER, 1.2) for row in rows]


@entry("legged", MUJOCO, GYMNASIUM)
def legged(quick: bool) -> list[Metric]:
    """Legged robots dropped on the floor: depth and speed at the end, and rates over MuJoCo C."""
    from benchmarks import legged as study

    found = []
    with jax.enable_x64(True):
        for name in ("hopper",) if quick else ("hopper", "half_cheetah", "walker2d"):
            model = study.load(name)
            ignored = ("self_contact",) if quick else ()
            read = jc.from_mjcf(model, ignored, dtype=jnp.dtype("float32"))
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


@entry("needed")
def needed(quick: bool) -> list[Metric]:
    """Operations and instructions of a step, from a particle to a humanoid."""
    from benchmarks import needed as study

    found = []
    for name in ("particle", "rod") if quick else study.SCENES:
        need = study.measure(name, None)
        found.append(count(f"{name}, of a step", need.operations, "operations", 1.05))
        found.append(count(f"{name}, of its program", need.instructions, "instructions", 1.1))
    return found


@entry("size")
def size(quick: bool) -> Found:
    """Cost of a step against size for every solver: exponents of time and of operations."""
    from benchmarks import size as study

    names = ("Sparse", "Schur") if quick else tuple(study.SOLVERS)
    given = {"families": ["rope"] if quick else list(study.FAMILIES), "solvers": names}
    everything: dict[str, Any] = {}
    if quick:
        sizes = (10, 20, 40)
        own = {x: list(study.series("rope", x, 0, 60.0, sizes)) for x in names}
        everything = {"rope": own}
    else:
        everything = study.measure(argparse.Namespace(**given, batch=16, seconds=450.0))
    found = []
    for family, solvers in everything.items():
        for name, rows in solvers.items():
            for what in ("operations", "step"):
                power = study.exponent(rows, what)
                if power is not None:
                    title = f"{family}, {name}, exponent of {what}"
                    found.append(Metric(title, power, "", LOWER, 1.2, 0.5))
    what = "operations" if quick else "step"
    return Found(tuple(found), lambda path: study.picture(everything, str(path), what))


@entry("environment_peers", GYMNASIUM)
def environment_peers(quick: bool) -> list[Metric]:
    """Actions a second of many copies, over the best of Gymnasium's and Brax's."""
    from benchmarks import environment_peers as study

    cases = study.cases()
    if quick:
        case = cases[0]._replace(copies=256)
        return [rate(f"{case.task}, {case.who}", study.measure(case, 0.1, 2).rate.median)]
    best: dict[tuple[str, bool], float] = {}
    for case in cases:
        row = study.in_process(case if case.copies else case._replace(copies=4096), 100.0)
        if not isinstance(row, str):
            key = case.task, case.who == "jaxcon"
            best[key] = max(best.get(key, 0.0), row.rate.median)
    found = [rate(f"{task}, jaxcon", best[task, True]) for task, own in best if own]
    for task, own in best:
        if not own and (task, True) in best:
            times = best[task, True] / best[task, False]
            found.append(Metric(f"{task}, over the best other", times))
    return found
