"""Benchmarks of cost in the suite: time, compilation, memory and operations."""

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
"""Number of worlds in the rate measurements."""


@entry("throughput")
def throughput(quick: bool) -> list[Metric]:
    """Measures world-steps per second, relative to the machine's peak and to MuJoCo in C."""
    from benchmarks import peers, roofline
    from benchmarks.throughput import method_of, run_batch

    metrics = []
    for name in scenes(quick):
        steps = run_batch(name, method_of(name, "Sparse"), np.float32, WORLDS, repeats=3)[0].median
        share = steps / (roofline.peak() / 1e6)
        metrics.append(rate(f"{name}, world-steps", steps))
        metrics.append(Metric(f"{name}, over the peak", share, "steps/Mop"))
        if has_mujoco():
            other = peers.mujoco_rate(name, seconds=0.2).median
            metrics.append(Metric(f"{name}, over MuJoCo C", steps / other))
    return metrics


@entry("equal_error")
def equal_error(quick: bool) -> Found:
    """Compares the cost at equal error with MuJoCo in C and MJX, for errors from 1e-2 to 1e-8."""
    from benchmarks import equal_error as study
    from benchmarks import motions

    names = ("pendulum",) if quick else tuple(motions.MOTIONS)
    record, codes = study.Record.of(None, False), study.CODES if has_mujoco() else ("jaxcon",)
    metrics, drawn = [], []
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
            metrics += [seconds(f"{name}, {level:.0e} {motion.unit}", price.cost)] if price else []
            for code in codes[1:]:
                times = study.ratio(points, code, level)
                title = f"{name}, {level:.0e} {motion.unit}, {code} over jaxcon"
                metrics += [Metric(title, times, tolerance=2.0)] if times else []
    return Found(tuple(metrics), lambda path: study.draw(drawn, path))


@entry("compile_time")
def compile_time(quick: bool) -> list[Metric]:
    """Measures compile times, absolute and relative to a fixed program in plain JAX."""
    from benchmarks import compile_time as study
    from benchmarks import timing

    metrics, unit = [], timing.yardstick()
    options = argparse.Namespace(solver="Sparse", limit=100.0, one_device=False)
    for name in scenes(quick):
        for program in ("step",) if quick else ("step", "rollout"):
            if quick:
                compiling: Any = study.seconds_here(name, program, study.BATCHES[0], "Sparse")
            else:
                compiling = study.seconds(name, program, study.BATCHES[0], options)
            compiling = float("nan") if isinstance(compiling, str) else compiling
            metrics.append(seconds(f"{name}, {program}", compiling))
            title = f"{name}, {program}, over a fixed program"
            metrics.append(Metric(title, compiling / unit, "", LOWER, 2.0))
    return metrics


@entry("programs")
def programs(quick: bool) -> list[Metric]:
    """Counts the equations of rollouts and of their gradients, which compile times follow."""
    from benchmarks import programs as study

    return [
        count(
            f"{name}, {method}, {kind}, equations", _equations(name, method, kind), tolerance=1.02
        )
        for name in (study.SMALL if quick else study.SCENES)
        for method in (["Euler"] if quick else study.METHODS)
        for kind in study.PROGRAMS
    ]


def _equations(name: str, method: str, kind: str) -> int:
    """Counts the equations of a program of a scene; see `programs.program`."""
    from benchmarks import programs as study

    function, states = study.program(name, method, kind, study.BATCH)
    return study.equations(function, states)


@entry("memory")
def memory(quick: bool) -> list[Metric]:
    """Measures the temporary memory that XLA plans for gradients, by adjoint."""
    from benchmarks import gradients as study

    metrics = []
    for name in ("four-bar",) if quick else ("chain-10", "four-bar"):
        for label, adjoint in list(study.ADJOINTS.items())[: 1 if quick else None]:
            for steps in (100,) if quick else study.LENGTHS:
                size = study.planned(name, adjoint, 256, steps)
                metrics.append(count(f"{name}, {label}, {steps} steps", size / 1e6, "MB", 1.2))
    return metrics


@entry("operations")
def operations(quick: bool) -> list[Metric]:
    """Counts arithmetic operations of a step, and measures the peak of the machine."""
    from benchmarks import roofline

    method = jc.Method(solver=jc.solvers.Sparse())
    metrics = [rate("peak, float32 operations", roofline.peak())]
    for name in scenes(quick):
        work = roofline.work(name, method, np.float32).operations
        metrics.append(count(name, work, "operations", 1.05))
    return metrics


@entry("large_batches")
def large_batches(quick: bool) -> list[Metric]:
    """Compares large batches of a plain program with chunks by hand, on the devices at hand."""
    from benchmarks import large_batches as study

    batches, sizes = ((2048,), (512,)) if quick else ((1024, 16384), study.SIZES)
    metrics = []
    for name in ("four-bar",) if quick else study.SCENES:
        for batch in batches:
            found = study.compare(name, batch, sizes=sizes)
            title = f"{name}, {batch} worlds"
            metrics.append(rate(f"{title}, world-steps", found.plain * 1e6))
            metrics.append(Metric(f"{title}, over chunks by hand", found.ratio, tolerance=1.3))
            metrics.append(count(f"{title}, exchanges", float(sum(found.exchanges.values()))))
    return metrics


@entry("gradients")
def gradients(quick: bool) -> list[Metric]:
    """Measures cost of value and gradient relative to a rollout, and error of the gradient."""
    from benchmarks import gradients as study

    metrics = []
    for name in ("four-bar",) if quick else ("chain-10", "four-bar"):
        for label, adjoint in list(study.ADJOINTS.items())[: 1 if quick else None]:
            loss, worlds = study.ours(name, adjoint, 256)
            cost = study.measure(loss, worlds, 100 if quick else 1000, study.SHORT)
            title = f"{name}, {label}"
            metrics += [
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
    return metrics


@entry("environments", GYMNASIUM)
def environments(quick: bool) -> list[Metric]:
    """Measures actions per second of Gymnasium's vector interface, relative to the bare step."""
    from benchmarks import environments as study
    from jaxcon.environments import TASKS

    metrics = []
    for task in ("CartPole",) if quick else TASKS:
        row = study.measure(task, 1024 if quick else 4096, 20 if quick else 100, 5)
        metrics.append(rate(f"{task}, actions", row.interface))
        metrics.append(Metric(f"{task}, share of bare steps", row.share))
    return metrics


@entry("devices")
def devices(quick: bool) -> list[Metric]:
    """Measures the speedup by more devices, and counts the exchanges between devices."""
    from benchmarks import devices as study

    metrics = []
    options = argparse.Namespace(batch=256 if quick else 1024, work=20_000 if quick else 200_000)
    for name in ("four-bar",) if quick else ("four-bar", "planar-chain-10"):
        rows = [study.elsewhere(name, n, options) for n in ((2,) if quick else (1, 2))]
        last = rows[-1]
        if isinstance(last, str):
            raise RuntimeError(f"{name} {last}")
        for program, kinds in zip(("rollout", "gradient"), last.exchanges, strict=True):
            metrics.append(count(f"{name}, exchanges of the {program}", sum(kinds.values())))
        if not quick and not isinstance(rows[0], str):
            gain = last.rollout.median / rows[0].rollout.median
            metrics.append(Metric(f"{name}, two devices over one", gain))
    return metrics


@entry("native_share")
def native_share(quick: bool) -> list[Metric]:
    """Measures the speed of jit(vmap(rollout)) relative to a rollout with the batch axis last."""
    from benchmarks import native_share as study

    rows = [study.measure(x, 512, np.float32) for x in (SMALL[1:] if quick else scenes(quick))]
    return [Metric(row.scene, row.ratios[1], "", HIGHER, 1.2) for row in rows]


@entry("legged", MUJOCO, GYMNASIUM)
def legged(quick: bool) -> list[Metric]:
    """Drops legged robots on the floor: final penetration, and rates relative to MuJoCo C."""
    from benchmarks import legged as study

    metrics = []
    with jax.enable_x64(True):
        for name in ("hopper",) if quick else ("hopper", "half_cheetah", "walker2d"):
            model = study.load(name)
            ignored = ("self_contact",) if quick else ()
            read = jc.from_mjcf(model, ignored, dtype=jnp.dtype("float32"))
            batches = [1] if quick else [1, 64]
            drop = study.dropped(read, model, study.BOUNDED["GaussSeidel"], batches)
            metrics.append(error(f"{name}, depth in the floor", drop.depth.floor, "m", 1e-6))
            metrics.append(error(f"{name}, depth in limbs", drop.depth.limbs, "m", 1e-6))
            metrics.append(count(f"{name}, failed", float(not drop.healthy)))
            metrics.append(seconds(f"{name}, compile", drop.compile[1]))
            if not quick:
                times = drop.rates[64] / study.mujoco_rate(name, 64).median
                metrics.append(Metric(f"{name}, over MuJoCo C", times))
    return metrics


@entry("floor_scenes", MUJOCO)
def floor_scenes(quick: bool) -> list[Metric]:
    """Lets boxes and a leg with a closed loop fall on a floor: rates relative to MuJoCo C."""
    from benchmarks import floor_scenes as study

    metrics, batch = [], 16 if quick else 128
    for name in ("leg",) if quick else study.SCENES:
        found, compiling, failed = study.rate_here(name, batch)
        metrics.append(rate(f"{name}, world-steps", found.median))
        metrics.append(seconds(f"{name}, compile", compiling))
        metrics.append(count(f"{name}, failed", float(failed)))
        if not quick:
            times = found.median / study.rate_of_mujoco(name, batch).median
            metrics.append(Metric(f"{name}, over MuJoCo C", times))
    return metrics


@entry("needed")
def needed(quick: bool) -> list[Metric]:
    """Counts operations and instructions of a step, from a particle to a humanoid."""
    from benchmarks import needed as study

    metrics = []
    for name in ("particle", "rod") if quick else study.SCENES:
        need = study.measure(name, None)
        metrics.append(count(f"{name}, of a step", need.operations, "operations", 1.05))
        metrics.append(count(f"{name}, of its program", need.instructions, "instructions", 1.1))
    return metrics


@entry("size")
def size(quick: bool) -> Found:
    """Measures the cost of a step against size for every solver, with exponents of the growth."""
    from benchmarks import size as study

    names = ("Sparse", "Schur") if quick else tuple(study.SOLVERS)
    options = {"families": ["rope"] if quick else list(study.FAMILIES), "solvers": names}
    everything: dict[str, Any] = {}
    if quick:
        sizes = (10, 20, 40)
        series = {x: list(study.series("rope", x, 0, 60.0, sizes)) for x in names}
        everything = {"rope": series}
    else:
        everything = study.measure(argparse.Namespace(**options, batch=16, seconds=450.0))
    metrics = []
    for family, solvers in everything.items():
        for name, rows in solvers.items():
            for what in ("operations", "step"):
                power = study.exponent(rows, what)
                if power is not None:
                    title = f"{family}, {name}, exponent of {what}"
                    metrics.append(Metric(title, power, "", LOWER, 1.2, 0.5))
    what = "operations" if quick else "step"
    return Found(tuple(metrics), lambda path: study.picture(everything, str(path), what))


@entry("gpu")
def gpu(quick: bool) -> list[Metric]:
    """Counts the instructions of the kernel of a step on a GPU; this needs no GPU."""
    from benchmarks import gpu as study

    metrics = []
    for name in study.SCENES[: 2 if quick else 5]:
        kernels, instructions = study.written(name)
        metrics.append(Metric(f"{name}, kernels a step", kernels, "", LOWER, 1.0))
        metrics.append(Metric(f"{name}, instructions a step", instructions, "", LOWER, 1.2))
    return metrics


@entry("environment_peers", GYMNASIUM)
def environment_peers(quick: bool) -> list[Metric]:
    """Compares actions per second of many copies with the best of Gymnasium and Brax."""
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
    metrics = [rate(f"{task}, jaxcon", best[task, True]) for task, ours in best if ours]
    for task, ours in best:
        if not ours and (task, True) in best:
            times = best[task, True] / best[task, False]
            metrics.append(Metric(f"{task}, over the best other", times))
    return metrics
