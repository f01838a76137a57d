"""Limits of each method (chapters 3.3 to 3.5, 3.11): masses, steps, gains, springs, spins, lengths.

    python -m benchmarks.extremes [--families tip …] [--dtypes float64 float32] [--peer]

Each family is one conservative mechanism with one parameter that varies from harmless to extreme.
All values run in one batch. A world that fails must stop with a status, and must not affect the
other worlds.

A method withstands a value if three conditions hold at the end: the world is healthy, |φ| stays
below a hundredth of the mechanism's size, and the energy error below a tenth of its scale. The
table shows up to which value each method holds, and how it fails beyond. `--peer` runs the same
mechanisms in MuJoCo in C. MuJoCo models trees in reduced coordinates and therefore has no φ.
"""

from __future__ import annotations

import argparse
import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import mjcf
from benchmarks.stabilisation import cast

G = 9.81
FRAMES = 100
"""Number of times at which φ and the energy are recorded."""
OFF = 1e-2
"""Largest accepted |φ|, relative to the mechanism's size."""
CHANGE = 0.1
"""Largest accepted energy error, relative to the energy scale."""

METHODS = {
    "semi-implicit Euler": jc.Method(),
    "semi-implicit Euler, projected": jc.Method(jc.SemiImplicitEuler(), jc.Projection()),
    "RK4": jc.Method(jc.RK4()),
    "RK4, projected": jc.Method(jc.RK4(), jc.Projection()),
    "RATTLE": jc.Method(jc.integrators.RATTLE()),
    "generalized-α": jc.Method(jc.integrators.GeneralizedAlpha()),
}


@dataclass(frozen=True)
class World:
    """A mechanism with one value of the family's varied parameter.

    Attributes:
        system: the mechanism.
        state: its initial state.
        size: length by which φ is divided [m].
        energy: energy by which energy errors are divided [J].
        dt: step size h [s].
        number: argument of the family's `adapt`.
        text: MJCF of the same mechanism, None if MuJoCo has no such mechanism.
        rates: initial joint velocities in MuJoCo.
    """

    system: Any
    state: jc.State
    size: float
    energy: float
    dt: float = 1e-3
    number: float = 0.0
    text: str | None = None
    rates: tuple[float, ...] = ()


@dataclass(frozen=True)
class Family:
    """A mechanism with one parameter that varies to extremes.

    Attributes:
        what: name of the parameter, with its unit.
        values: values of the parameter.
        build: (value) → mechanism.
        steps: number of steps.
        adapt: (method, number) → method of a world, None if the parameter does not apply to the
            method.
        alone: True if each value changes the structure and is compiled on its own.
    """

    what: str
    values: tuple[float, ...]
    build: Callable[[float], World]
    steps: int = 2000
    adapt: Callable[[jc.Method, Any], jc.Method | None] = lambda method, number: method
    alone: bool = False


def chain(masses: Sequence[float], length: float, dt: float = 1e-3) -> World:
    """Builds rods of equal length on hinges in the plane, released from the horizontal."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    before, inside = jc.WORLD, ""
    for i, mass in enumerate(masses):
        inertia, place = mass * length**2 / 12, ((i + 0.5) * length, 0.0)
        scene.add_body(f"link{i}", mass=mass, inertia=inertia, position=place)
        scene.add(jc.Revolute(f"hinge{i}", before, f"link{i}", point=(i * length, 0.0)))
        before = f"link{i}"
    for i, mass in reversed(list(enumerate(masses))):
        hinge = mjcf.joint("hinge", axis=mjcf.OUT_OF_PLANE, pos=(-length / 2, 0.0, 0.0))
        place = mjcf.in_space((length if i else length / 2, 0.0))
        moments = (1e-3 * mass * length**2, *(mass * length**2 / 12,) * 2)
        inside = mjcf.body(f"link{i}", place, mass, moments, hinge + inside)
    n = np.arange(len(masses)) + 0.5
    scale = G * length * float(np.asarray(masses) @ n)
    built = scene.build()
    return World(*built, size=length * len(masses), energy=scale, dt=dt, text=mjcf.model(inside))


def tip(ratio: float) -> World:
    """Builds ten links of 1 m and 1 kg, except that the last link has the mass `ratio` [kg]."""
    return chain([1.0] * 9 + [ratio], 1.0)


def links(n: float) -> World:
    """Builds a chain of `n` links, 1 m long in total."""
    return chain([1.0 / n] * round(n), 1.0 / n)


def step(dt: float) -> World:
    """Builds a double pendulum of 2 m with step size `dt`."""
    return chain([1.0, 1.0], 1.0, dt)


def rods(length: float) -> World:
    """Builds a double pendulum with rods of a length [m]; the step size scales with its period."""
    return chain([1.0, 1.0], length, 1e-3 * float(np.sqrt(length)))


def gains(multiple: float) -> World:
    """Builds a double pendulum. `multiple` is the feedback rate over the largest stable rate."""
    pendulum = chain([1.0, 1.0], 1.0)
    return World(pendulum.system, pendulum.state, 2.0, pendulum.energy, number=multiple)


def feeds_back(method: jc.Method) -> bool:
    """Returns True if feedback enforces the constraints, not the integrator or a projection."""
    integrator_enforces = isinstance(
        method.integrator, jc.integrators.RATTLE | jc.integrators.GeneralizedAlpha
    )
    return type(method.stabilizer) is jc.Baumgarte and not integrator_enforces


def feedback(method: jc.Method, multiple: Any) -> jc.Method | None:
    """Returns the method with its feedback rate set to `multiple` times the largest stable rate.

    It is None if the method has no feedback.
    """
    if not feeds_back(method):
        return None
    rate = multiple * jc.stabilizers.largest_stable_rate(method.integrator, 1e-3)
    return jc.Method(method.integrator, jc.Baumgarte(rate, rate))


def bob(stiffness: float) -> World:
    """Builds a particle of 1 kg on a spring of 1 m, and a particle of 1 kg on a rod."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    scene.add_particle("elastic", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Spring("spring", jc.WORLD, "elastic", stiffness=stiffness, rest_length=1.0))
    scene.add_particle("stiff", mass=1.0, position=(0.0, 1.0), velocity=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "stiff", length=1.0))
    along = f'<joint type="slide" axis="1 0 0" stiffness="{stiffness!r}"/>'
    hinge = mjcf.joint("hinge", axis=mjcf.OUT_OF_PLANE, pos=(-1.0, 0.0, 0.0))
    text = mjcf.body("elastic", (1.0, 0.0, 0.0), 1.0, (1e-9,) * 3, hinge + along)
    return World(*scene.build(), size=1.0, energy=G, text=mjcf.model(text))


def spring(stiffness: float) -> World:
    """Builds a pendulum whose rod is enforced by a penalty of the given stiffness."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return World(*scene.build(), size=1.0, energy=G, number=stiffness)


def penalty(method: jc.Method, stiffness: Any) -> jc.Method | None:
    """Returns the method with a penalty as its stabilizer.

    It is None if the method has no feedback that the penalty could replace.
    """
    if not feeds_back(method):
        return None
    return jc.Method(method.integrator, jc.stabilizers.Penalty(stiffness, 0.0))


def spin(rate: float) -> World:
    """Builds a top of 1 kg on its point, spinning about an axis inclined by 45°."""
    height, inertia = 0.1, (1e-3, 1e-3, 2e-3)
    lean = np.pi / 4
    q = np.array([np.cos(lean / 2), 0.0, np.sin(lean / 2), 0.0])
    axis = np.array([np.sin(lean), 0.0, np.cos(lean)])
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -G))
    spinning = {"angular_velocity": (0.0, 0.0, rate)}
    scene.add_body(
        "top", mass=1.0, inertia=inertia, position=height * axis, quaternion=q, **spinning
    )
    scene.add(jc.Spherical("point", jc.WORLD, "top", point=(0.0, 0.0, 0.0)))
    ball = mjcf.joint("ball", pos=(0.0, 0.0, -height))
    text = mjcf.body("top", height * axis, 1.0, inertia, ball, q)
    kinetic = 0.5 * inertia[2] * rate**2
    rates = (0.0, 0.0, rate)
    energy = max(kinetic, G * height)
    return World(*scene.build(), size=height, energy=energy, text=mjcf.model(text), rates=rates)


def flat(angle: float) -> World:
    """Builds a moving parallelogram at an angle [rad] from its flat position.

    In the flat position, two branches of its motion meet.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    up, rate = np.array([np.cos(angle), np.sin(angle)]), 2.0
    across = rate * np.array([-up[1], up[0]])
    ends = np.array([[0.0, 0.0], [1.0, 0.0]])
    for name, end in zip(("left", "right"), ends, strict=True):
        scene.add_body(
            name, mass=1.0, inertia=1 / 12, position=end + up / 2, angle=angle,
            velocity=across / 2, angular_velocity=rate,
        )  # fmt: skip
        scene.add(jc.Revolute(f"{name} foot", jc.WORLD, name, point=end))
    middle = ends.mean(0) + up
    scene.add_body("bar", mass=1.0, inertia=1 / 12, position=middle, velocity=across)
    scene.add(jc.Revolute("left head", "left", "bar", point=ends[0] + up))
    scene.add(jc.Revolute("right head", "right", "bar", point=ends[1] + up))
    return World(*scene.build(), size=1.0, energy=2 * G)


def decades(low: int, high: int) -> tuple[float, ...]:
    """Returns the powers of ten from 10ˡ to 10ʰ, where l is `low` and h is `high`."""
    return tuple(float(f"1e{i}") for i in range(low, high + 1))


FAMILIES = {
    "tip": Family("mass of the last of ten links over the others'", decades(-6, 6), tip),
    "links": Family("links", (2, 10, 50, 100, 300, 1000), links, steps=1000, alone=True),
    "step": Family("h [s], double pendulum", (1e-5, 1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1), step),
    "gains": Family(
        "feedback over the largest stable", (0.0, 0.01, 0.1, 0.5, 0.99, 1.1, 2.0, 10.0, 100.0),
        gains, adapt=feedback,
    ),
    "spring": Family("stiffness of a spring [N/m]", (0.0, *decades(0, 12)), bob),
    "penalty": Family("stiffness of a penalty [N/m]", decades(2, 12), spring, adapt=penalty),
    "spin": Family("spin of a top [rad/s]", (1.0, 10.0, 100.0, 300.0, 1e3, 3e3, 1e4), spin),
    "length": Family("length of two rods [m], h ∝ √l", decades(-6, 6), rods),
    "flat": Family("angle from a singular start [rad]", (0.0, 1e-12, 1e-6, 1e-3, 0.1), flat),
    "long": Family("steps of a double pendulum", (1e6,), lambda n: step(1e-3), steps=1_000_000),
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """The result of one world.

    Attributes:
        value: value of the family's varied parameter.
        status: name of the status, or "NaN" for a non-finite final state, which must never occur.
        time: time reached [s].
        violation: largest recorded |φ|, relative to the mechanism's size.
        energy: largest recorded energy error, relative to its scale.
    """

    value: float
    status: str
    time: float
    violation: float
    energy: float

    @property
    def held(self) -> bool:
        """True if the world is healthy with a small violation and a small energy error."""
        return self.status == "OK" and self.violation <= OFF and self.energy <= CHANGE

    @property
    def end(self) -> str:
        """The kind of failure: a status, "φ" or "energy"."""
        if self.status != "OK":
            return self.status
        return "φ" if self.violation > OFF else "energy"


def run(family: Family, method: jc.Method, dtype: DTypeLike) -> list[Outcome] | str:
    """Runs all values of a family in batches.

    Returns:
        The outcome of each value, or the reason why the method does not apply.
    """
    worlds = [family.build(value) for value in family.values]
    if family.adapt(method, 1.0) is None:
        return "—"
    groups = [[w] for w in worlds] if family.alone else [worlds]
    try:
        outcomes = [_side_by_side(family, group, method, np.dtype(dtype)) for group in groups]
    except ValueError as error:
        return f"refused: {error}"
    results = [x for group in outcomes for x in group]
    return [Outcome(value, *x) for value, x in zip(family.values, results, strict=True)]


def _side_by_side(
    family: Family, worlds: list[World], method: jc.Method, dtype: np.dtype
) -> list[tuple[str, float, float, float]]:
    def stacked(trees: list[Any]) -> Any:
        return jax.tree.map(lambda *x: cast(jnp.stack(x), dtype), *trees)

    systems, states = stacked([w.system for w in worlds]), stacked([w.state for w in worlds])
    numbers = (jnp.asarray([getattr(w, x) for w in worlds], dtype) for x in ("dt", "number"))
    every = max(family.steps // FRAMES, 1)

    def run_world(system: Any, state: jc.State, dt: Any, number: Any) -> Any:
        adapted = family.adapt(method, number)
        assert adapted is not None
        start = jc.init(system, adapted, state.q, state.v)

        def record(state: jc.State, info: Any) -> tuple[Any, Any]:
            return jc.violation(system, state).worst, jc.energy(system, state).total

        final, (violation, energy) = jc.rollout(
            system, adapted, start, None, dt, family.steps, record=record, every=every
        )
        change = jnp.max(jnp.abs(energy - jc.energy(system, start).total))
        finite = jnp.all(jnp.isfinite(final.q)) & jnp.all(jnp.isfinite(final.v))
        return jnp.where(finite, final.status, -1), final.time, jnp.max(violation), change

    results = jax.device_get(jax.jit(jax.vmap(run_world))(systems, states, *numbers))
    names = ["NaN" if code < 0 else jc.Status(int(code)).name for code in results[0]]
    sizes = zip(worlds, *results[1:], strict=True)
    return [
        (name, float(t), float(violation / w.size), float(change / w.energy))
        for name, (w, t, violation, change) in zip(names, sizes, strict=True)
    ]


def peer(family: Family, integrator: str) -> list[Outcome] | str:
    """Runs all values of a family in MuJoCo with one of its integrators."""
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)  # the default handler writes a log file
    results = []
    for value in family.values:
        world = family.build(value)
        if world.text is None:
            return "—"
        model = mujoco.MjModel.from_xml_string(world.text)
        model.opt.timestep = world.dt
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
        model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        data = mujoco.MjData(model)
        if world.rates:
            data.qvel[:] = world.rates
        mujoco.mj_forward(model, data)
        start, largest, status = float(np.sum(data.energy)), 0.0, "OK"
        for _ in range(FRAMES):
            mujoco.mj_step(model, data, family.steps // FRAMES)
            mujoco.mj_forward(model, data)
            change = abs(float(np.sum(data.energy)) - start) / world.energy
            if not np.isfinite(change) or any(w.number for w in data.warning):
                status = "NON_FINITE"
                break
            largest = max(largest, change)
        results.append(Outcome(value, status, float(data.time), 0.0, largest))
    return results


def summary(outcomes: list[Outcome] | str) -> str:
    """Formats which values a method withstands, and how it fails at other values."""
    if isinstance(outcomes, str):
        return outcomes.split(";")[0][:60]
    runs: list[tuple[str, list[float]]] = []
    for x in outcomes:
        word = "held" if x.held else x.end
        if runs and runs[-1][0] == word:
            runs[-1][1].append(x.value)
        else:
            runs.append((word, [x.value]))
    spans = ((word, f"{v[0]:g}" + (f" … {v[-1]:g}" if len(v) > 1 else "")) for word, v in runs)
    return ", ".join(f"{word} {span}" for word, span in spans)


def main() -> None:
    """Prints the table of each family, with a row per method and precision."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), choices=list(FAMILIES))
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--dtypes", nargs="+", default=["float64", "float32"])
    parser.add_argument("--peer", action="store_true", help="also run MuJoCo in C")
    parser.add_argument("--json")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows: list[dict[str, Any]] = []
    for name in options.families:
        family = FAMILIES[name]
        print(f"\n{family.what}, {family.steps} steps\n")
        print("| method | precision | outcome |\n|---|---|---|")
        trials: list[tuple[str, str, Callable[[], Any]]] = [
            (label, dtype, functools.partial(run, family, METHODS[label], dtype))
            for dtype in options.dtypes
            for label in options.methods
        ]
        if options.peer:
            for integrator in ("EULER", "IMPLICITFAST", "RK4"):
                job = functools.partial(peer, family, integrator)
                trials.append((f"MuJoCo, {integrator}", "float64", job))
        for label, dtype, job in trials:
            result = job()
            print(f"| {label} | {dtype} | {summary(result)} |", flush=True)
            numbers = result if isinstance(result, str) else [asdict(x) for x in result]
            rows.append({"family": name, "method": label, "dtype": dtype, "found": numbers})
    if options.json:
        with open(options.json, "w") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
