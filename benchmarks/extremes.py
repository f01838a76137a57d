"""Where each method ends (chapter 3.3 to 3.5, 3.11): masses, steps, gains, springs, spins, lengths.

    python -m benchmarks.extremes [--families tip …] [--dtypes float64 float32] [--peer]

Each family is one mechanism that loses no energy, with one number taken from the harmless to the
absurd. All values run side by side in one batch, as a user's worlds would: one that fails must stop
with a status, and no other may notice. A value is held where the world ends healthy, φ stayed below
a hundredth of the mechanism's size and the energy within a tenth of its scale. The table says up to
where each method holds, and how it ends beyond. `--peer` runs MuJoCo in C on the same mechanisms,
which sees their trees in reduced coordinates and therefore has no φ.
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

import jaxcon as jc
from benchmarks import mjcf
from benchmarks.stabilisation import cast

G = 9.81
FRAMES = 100
"""Times at which φ and the energy are looked at."""
OFF = 1e-2
"""Of the mechanism's size, what φ may be."""
CHANGE = 0.1
"""Of the scale of its energy, by how much that may change."""

METHODS = {
    "semi-implicit Euler": jc.Method(),
    "the same, projected": jc.Method(jc.SemiImplicitEuler(), jc.Projection()),
    "RK4": jc.Method(jc.RK4()),
    "RK4, projected": jc.Method(jc.RK4(), jc.Projection()),
    "RATTLE": jc.Method(jc.RATTLE()),
    "generalized-α": jc.Method(jc.GeneralizedAlpha()),
}


@dataclass(frozen=True)
class World:
    """One mechanism.

    Attributes:
        system: the mechanism.
        state: its start.
        size: a length by which φ is measured [m].
        energy: the scale of its energy [J].
        dt: h [s].
        number: what the family's `adapt` is given.
        text: the same mechanism for MuJoCo; None where it has none.
        rates: its joint velocities at the start.
    """

    system: Any
    state: Any
    size: float
    energy: float
    dt: float = 1e-3
    number: float = 0.0
    text: str | None = None
    rates: tuple[float, ...] = ()


@dataclass(frozen=True)
class Family:
    """A mechanism with a number to be taken far.

    Attributes:
        what: it is, with its unit.
        values: of the number.
        build: the mechanism with a value.
        steps: how many.
        adapt: (method, number) → the method of a world; None where it has no part in it.
        alone: whether each value is a structure of its own, and compiled by itself.
    """

    what: str
    values: tuple[float, ...]
    build: Callable[[float], World]
    steps: int = 2000
    adapt: Callable[[jc.Method, Any], jc.Method | None] = lambda method, number: method
    alone: bool = False


def chain(masses: Sequence[float], length: float, dt: float = 1e-3) -> World:
    """Rods of equal length on hinges in the plane, released level."""
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
    """Ten links of a metre, the last so many times heavier."""
    return chain([1.0] * 9 + [ratio], 1.0)


def links(n: float) -> World:
    """So many links, one metre together."""
    return chain([1.0 / n] * round(n), 1.0 / n)


def step(dt: float) -> World:
    """A double pendulum of two metres."""
    return chain([1.0, 1.0], 1.0, dt)


def rods(length: float) -> World:
    """A double pendulum of so long rods, whose step keeps with its period."""
    return chain([1.0, 1.0], length, 1e-3 * float(np.sqrt(length)))


def gains(multiple: float) -> World:
    """A double pendulum under feedback of so many times the largest stable rate."""
    pendulum = chain([1.0, 1.0], 1.0)
    return World(pendulum.system, pendulum.state, 2.0, pendulum.energy, number=multiple)


def feeds_back(method: jc.Method) -> bool:
    """Whether it is feedback that keeps constraints, and not the integrator or a projection."""
    own = isinstance(method.integrator, jc.RATTLE | jc.GeneralizedAlpha)
    return type(method.stabilizer) is jc.Baumgarte and not own


def feedback(method: jc.Method, multiple: Any) -> jc.Method | None:
    """The method with that feedback, where it has any."""
    if not feeds_back(method):
        return None
    rate = multiple * jc.largest_stable_rate(method.integrator, 1e-3)
    return jc.Method(method.integrator, jc.Baumgarte(rate, rate))


def bob(stiffness: float) -> World:
    """A kilogram on a spring a metre long, beside another on a rod."""
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
    """A pendulum whose rod is held by a penalty."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return World(*scene.build(), size=1.0, energy=G, number=stiffness)


def penalty(method: jc.Method, stiffness: Any) -> jc.Method | None:
    """The method with the penalty, where it stands beside one."""
    if not feeds_back(method):
        return None
    return jc.Method(method.integrator, jc.Penalty(stiffness, 0.0))


def spin(rate: float) -> World:
    """A top of a kilogram on its point, turning about its axis, which leans by 45°."""
    height, inertia = 0.1, (1e-3, 1e-3, 2e-3)
    lean = np.pi / 4
    q = np.array([np.cos(lean / 2), 0.0, np.sin(lean / 2), 0.0])
    axis = np.array([np.sin(lean), 0.0, np.cos(lean)])
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -G))
    moving = {"angular_velocity": (0.0, 0.0, rate)}
    scene.add_body("top", mass=1.0, inertia=inertia, position=height * axis, quaternion=q, **moving)
    scene.add(jc.Spherical("point", jc.WORLD, "top", point=(0.0, 0.0, 0.0)))
    ball = mjcf.joint("ball", pos=(0.0, 0.0, -height))
    text = mjcf.body("top", height * axis, 1.0, inertia, ball, q)
    kinetic = 0.5 * inertia[2] * rate**2
    rates = (0.0, 0.0, rate)
    energy = max(kinetic, G * height)
    return World(*scene.build(), size=height, energy=energy, text=mjcf.model(text), rates=rates)


def flat(angle: float) -> World:
    """A parallelogram of rods so far from lying flat, where its two motions meet, under way."""
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
    """10ˡ to 10ʰ."""
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
    """What became of one world.

    Attributes:
        value: of the family's number.
        status: its name, or "NaN" where the state itself is not finite, which must never be.
        time: reached [s].
        violation: the largest max |φ| seen, over the mechanism's size.
        energy: the largest change of it seen, over its scale.
    """

    value: float
    status: str
    time: float
    violation: float
    energy: float

    @property
    def held(self) -> bool:
        """Whether the world is healthy and close to what it should be."""
        return self.status == "OK" and self.violation <= OFF and self.energy <= CHANGE

    @property
    def end(self) -> str:
        """How it ended, in a word."""
        if self.status != "OK":
            return self.status
        return "φ" if self.violation > OFF else "energy"


def run(family: Family, method: jc.Method, dtype: Any) -> list[Outcome] | str:
    """All values side by side, or why the method has no part in it."""
    worlds = [family.build(value) for value in family.values]
    if family.adapt(method, 1.0) is None:
        return "—"
    groups = [[w] for w in worlds] if family.alone else [worlds]
    try:
        outcomes = [_side_by_side(family, group, method, np.dtype(dtype)) for group in groups]
    except ValueError as error:
        return f"refused: {error}"
    found = [x for group in outcomes for x in group]
    return [Outcome(value, *x) for value, x in zip(family.values, found, strict=True)]


def _side_by_side(
    family: Family, worlds: list[World], method: jc.Method, dtype: np.dtype
) -> list[tuple[str, float, float, float]]:
    def stacked(trees: list[Any]) -> Any:
        return jax.tree.map(lambda *x: cast(jnp.stack(x), dtype), *trees)

    systems, states = stacked([w.system for w in worlds]), stacked([w.state for w in worlds])
    numbers = (jnp.asarray([getattr(w, x) for w in worlds], dtype) for x in ("dt", "number"))
    every = max(family.steps // FRAMES, 1)

    def one(system: Any, state: Any, dt: Any, number: Any) -> Any:
        own = family.adapt(method, number)
        assert own is not None
        start = jc.init(system, own, state.q, state.v)

        def seen(state: jc.State, info: Any) -> tuple[Any, Any]:
            return jc.violation(system, state).worst, jc.energy(system, state).total

        final, (off, energy) = jc.rollout(
            system, own, start, None, dt, family.steps, record=seen, every=every
        )
        change = jnp.max(jnp.abs(energy - jc.energy(system, start).total))
        finite = jnp.all(jnp.isfinite(final.q)) & jnp.all(jnp.isfinite(final.v))
        return jnp.where(finite, final.status, -1), final.time, jnp.max(off), change

    found = jax.device_get(jax.jit(jax.vmap(one))(systems, states, *numbers))
    names = ["NaN" if code < 0 else jc.Status(int(code)).name for code in found[0]]
    sizes = zip(worlds, *found[1:], strict=True)
    return [
        (name, float(t), float(off / w.size), float(change / w.energy))
        for name, (w, t, off, change) in zip(names, sizes, strict=True)
    ]


def peer(family: Family, integrator: str) -> list[Outcome] | str:
    """The same in MuJoCo, with one of its integrators."""
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)  # or it writes a file
    found = []
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
        start, most, status = float(np.sum(data.energy)), 0.0, "OK"
        for _ in range(FRAMES):
            mujoco.mj_step(model, data, family.steps // FRAMES)
            mujoco.mj_forward(model, data)
            change = abs(float(np.sum(data.energy)) - start) / world.energy
            if not np.isfinite(change) or any(w.number for w in data.warning):
                status = "NON_FINITE"
                break
            most = max(most, change)
        found.append(Outcome(value, status, float(data.time), 0.0, most))
    return found


def summary(found: list[Outcome] | str) -> str:
    """Which values are held, and how the others end."""
    if isinstance(found, str):
        return found.split(";")[0][:60]
    runs: list[tuple[str, list[float]]] = []
    for x in found:
        word = "held" if x.held else x.end
        if runs and runs[-1][0] == word:
            runs[-1][1].append(x.value)
        else:
            runs.append((word, [x.value]))
    spans = ((word, f"{v[0]:g}" + (f" … {v[-1]:g}" if len(v) > 1 else "")) for word, v in runs)
    return ", ".join(f"{word} {span}" for word, span in spans)


def main() -> None:
    """Prints the table as it grows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), choices=list(FAMILIES))
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--dtypes", nargs="+", default=["float64", "float32"])
    parser.add_argument("--peer", action="store_true", help="run MuJoCo in C, too")
    parser.add_argument("--json")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows: list[dict[str, Any]] = []
    for name in asked.families:
        family = FAMILIES[name]
        print(f"\n{family.what}, {family.steps} steps\n")
        print("| method | precision | outcome |\n|---|---|---|")
        trials: list[tuple[str, str, Callable[[], Any]]] = [
            (label, dtype, functools.partial(run, family, METHODS[label], dtype))
            for dtype in asked.dtypes
            for label in asked.methods
        ]
        if asked.peer:
            for integrator in ("EULER", "IMPLICITFAST", "RK4"):
                job = functools.partial(peer, family, integrator)
                trials.append((f"MuJoCo, {integrator}", "float64", job))
        for label, dtype, job in trials:
            found = job()
            print(f"| {label} | {dtype} | {summary(found)} |", flush=True)
            numbers = found if isinstance(found, str) else [asdict(x) for x in found]
            rows.append({"family": name, "method": label, "dtype": dtype, "found": numbers})
    if asked.json:
        with open(asked.json, "w") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
