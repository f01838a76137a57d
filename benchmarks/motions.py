"""Motions with known final states, in jaxcon and in MuJoCo, for comparisons at equal error.

Errors are the largest distance of a center of mass [m]. For Andrews' mechanism, the error is the
largest of its seven angles [rad].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import mjcf, rods
from benchmarks.rods import Linkage, Solid
from jaxcon.verification import andrews, linkage, references

DRAKE = ("crank", "coupler", "rocker")
ANGLES = ("crank", "rod", "triangle", "upper", "upper_arm", "lower", "lower_arm")
"""Bodies whose hinges have the angles (β, Θ, γ, δ, Φ, ε, Ω), in the order of MuJoCo's joints."""
ORDER = (0, 1, 2, 4, 3, 6, 5)
"""Indices into `ANGLES` of the components of q = (β, Θ, γ, Φ, δ, Ω, ε)."""


@dataclass(frozen=True)
class Form:
    """A model of a motion in jaxcon.

    Attributes:
        name: name of the form, empty if the motion has only one.
        build: (dtype) → system and initial state.
        places: (system, q) → compared quantities.
        solver: a suitable solver.
        control: constant control, None without control.
    """

    name: str
    build: Callable[[Any], tuple[Any, jc.State]]
    places: Callable[[Any, np.ndarray], np.ndarray]
    solver: Any
    control: float | None = None


@dataclass(frozen=True)
class Motion:
    """A motion with a known final state.

    Attributes:
        name: name of the motion.
        seconds: duration [s].
        unit: unit of errors.
        first: number of steps of the coarsest run.
        forms: models in jaxcon.
        mjcf: () → MJCF of the model.
        rates: MuJoCo's initial joint velocities, in its order.
        seen: MuJoCo's (model, data) after kinematics → compared quantities.
        end: reference value of the compared quantities.
        gravity: False if there is no gravity.
        loops: True if MuJoCo needs soft equality constraints.
    """

    name: str
    seconds: float
    unit: str
    first: int
    forms: tuple[Form, ...]
    mjcf: Callable[[], str]
    rates: tuple[float, ...]
    seen: Callable[[Any, Any], np.ndarray]
    end: np.ndarray
    gravity: bool = True
    loops: bool = False

    def error(self, places: np.ndarray) -> float:
        """Returns the error of the final quantities, infinite if one of them is not finite."""
        if not np.all(np.isfinite(places)):
            return float("inf")
        difference = places - self.end
        errors = np.abs(difference) if self.unit == "rad" else np.linalg.norm(difference, axis=-1)
        return float(np.max(errors))


def bobs(names: tuple[str, ...]) -> Form:
    """Returns a pendulum of particles of 1 kg on rods of 1 m, released from the horizontal."""
    moving = rods.collinear(len(names), length=1.0, at_end=True)
    still = Linkage(tuple(replace(rod, rate=0.0) for rod in moving.rods))

    def places(system: Any, q: np.ndarray) -> np.ndarray:
        return np.stack([q[system.layout.q(name)] for name in names])

    return Form("", lambda dtype: rods.particles_scene(still, dtype), places, jc.solvers.Sparse())


def swinging(name: str, seconds: float, first: int, end: Any) -> Motion:
    """Returns the motion of a multiple pendulum with the final positions `end`, (bobs, 2) [m]."""
    end = np.array(end)
    names = tuple(f"link{i}" for i in range(len(end)))
    text = rods.to_mjcf(rods.collinear(len(end), length=1.0, at_end=True))
    still = (0.0,) * len(end)
    return Motion(name, seconds, "m", first, (bobs(names),), lambda: text, still, xz(names), end)


def xz(names: tuple[str, ...]) -> Callable[[Any, Any], np.ndarray]:
    """Returns a function that reads MuJoCo's centers of mass in the plane, (bodies, 2) [m]."""

    def seen(model: Any, data: Any) -> np.ndarray:
        return data.xpos[[model.body(name).id for name in names]][:, [0, 2]].copy()

    return seen


def pendulum() -> Motion:
    """Returns IFToMM's problem A01, whose state after 10 s follows from elliptic functions."""
    rows = references.load("iftomm_A01_pendulum")["reference"]
    row = next(row for row in rows if row["t"] == 10)
    return swinging("pendulum", 10.0, 40, [[row["x"], row["y"]]])


def double_pendulum() -> Motion:
    """Returns a pendulum of two point masses, with reference after 3 s by 80-bit extrapolation."""
    rows = references.load("an_double_pendulum")["rows"]
    row = next(row for row in rows if row["t"] == 3)
    return swinging("double pendulum", 3.0, 15, [row["p1"], row["p2"]])


def four_bar() -> Motion:
    """Returns Drake's four-bar linkage with its state after 2 s.

    The error of the reference is about 3e-10.
    """
    rows = references.load("drake_four_bar")["reference"]
    row = next(row for row in rows if row["t"] == 2)
    bar = linkage.hanging_trapezoid(-rows[0]["qA_rate"])
    starts, ends = bar.starts, bar.starts + 2 * bar.halves
    parents = (jc.WORLD, "crank", jc.WORLD)
    rates = [float(x) for x in (bar.rates[0], bar.rates[1] - bar.rates[0], bar.rates[2])]
    bodies = tuple(
        Solid(
            name,
            parents[i],
            starts[i],
            ends[i],
            float(bar.masses[i]),
            rates[i],
            heavy_at=starts[i] + bar.halves[i],
            turns_with=float(bar.inertias[i]),
        )
        for i, name in enumerate(DRAKE)
    )
    loop = Linkage(bodies, (("coupler", "rocker", ends[1]),))
    angles = [-row[key] for key in ("qA", "coupler_abs", "qC")]
    halves = 2.0 * np.stack([np.cos(angles), np.sin(angles)], -1)
    end = halves + np.array([[0.0, 0.0], 2 * halves[0], [bar.base, 0.0]])

    def places(system: Any, q: np.ndarray) -> np.ndarray:
        return np.stack([q[system.layout.q(name)][:2] for name in DRAKE])

    form = Form("", lambda dtype: rods.planar_scene(loop, dtype), places, jc.solvers.Sparse())
    text = rods.to_mjcf(loop)
    return Motion(
        "four-bar", 2.0, "m", 10, (form,), lambda: text, tuple(rates), xz(DRAKE), end, loops=True
    )


@dataclass(frozen=True)
class Squeezer:
    """Andrews' mechanism in the plane at assembly. Its angles are those of `verification.andrews`.

    Attributes:
        p: parameters of the test set in SI units.
        q: initial angles (β, Θ, γ, Φ, δ, Ω, ε), (7,) [rad].
    """

    p: dict[str, float]
    q: np.ndarray

    @classmethod
    def published(cls) -> Squeezer:
        """Returns the mechanism with the parameters of the published test set."""
        data = references.load("ivp_andrews")
        return cls(data["parameters"], np.array(data["initial"]["q"]))

    @property
    def linkage(self) -> Linkage:
        """Seven bodies on seven hinges, and three hinges where four bodies meet.

        The last three hinges close the loops. There is no gravity. The direction from a fixed pivot
        to the center of mass of its body therefore does not matter. Only the distance does, as part
        of the moment of inertia about the pivot.
        """
        p, (beta, theta, gamma, phi, delta, omega, epsilon) = self.p, self.q
        a, b = np.array([p["xa"], p["ya"]]), np.array([p["xb"], p["yb"]])
        crank, rod = along(beta), -along(beta + theta)
        triangle, upper, lower = -turned(gamma), along(delta), -turned(epsilon)
        arms = -turned(phi + delta), along(omega + epsilon)
        knee, ankle = a + p["zt"] * upper, a + p["u"] * lower
        tip, origin = p["rr"] * crank, np.zeros(2)
        meet = tip + p["d"] * rod
        reach = {x: np.hypot(p[f"{x}a"], p[f"{x}b"]) for x in "stu"}
        at_knee, at_ankle = p["e"] - p["ea"], p["zf"] - p["fa"]
        bodies = (
            ("crank", jc.WORLD, origin, tip, p["ra"] * crank, "1"),
            ("rod", "crank", tip, meet, p["da"] * rod, "2"),
            ("triangle", jc.WORLD, b, meet, reach["s"] * triangle, "3"),
            ("upper", jc.WORLD, a, knee, reach["t"] * upper, "5"),
            ("upper_arm", "upper", knee, meet, at_knee * arms[0], "4"),
            ("lower", jc.WORLD, a, ankle, reach["u"] * lower, "7"),
            ("lower_arm", "lower", ankle, meet, at_ankle * arms[1], "6"),
        )
        solids = tuple(
            Solid(name, parent, start, end, p["m" + i], 0.0, False, start + out, p["i" + i])
            for name, parent, start, end, out, i in bodies
        )
        ends = ("triangle", "upper_arm", "lower_arm")
        return Linkage(solids, tuple(("rod", other, meet) for other in ends))

    @property
    def spring(self) -> tuple[np.ndarray, np.ndarray]:
        """The ends of the spring on the ground and on the triangle, (2,) each [m]."""
        p, gamma = self.p, self.q[2]
        on = np.array([p["xb"], p["yb"]]) + p["sd"] * along(gamma) - p["sc"] * turned(gamma)
        return np.array([p["xc"], p["yc"]]), on

    def scene(self, dtype: DTypeLike) -> tuple[Any, jc.State]:
        """Builds seven bodies in the plane, with 21 velocities and 20 constraint rows."""
        scene = rods.hinged(jc.Scene(dim=2, gravity=(0.0, 0.0), dtype=dtype), self.linkage)
        ground, on = self.spring
        stiff = {"stiffness": self.p["c0"], "rest_length": self.p["l0"]}
        scene.add(jc.Spring("spring", jc.WORLD, "triangle", **stiff, point_a=ground, point_b=on))
        scene.add(jc.Motor("motor", "crank_hinge", gear=self.p["mom"]))
        return scene.build()

    def angles(self, system: Any, q: np.ndarray) -> np.ndarray:
        """Returns the angles (β, Θ, γ, Φ, δ, Ω, ε) from the poses of the bodies, (7,) [rad]."""
        turns = {name: q[system.layout.q(name)][2] for name in ANGLES} | {jc.WORLD: 0.0}
        parents = {rod.name: rod.parent for rod in self.linkage.rods}
        relative = np.array([turns[name] - turns[parents[name]] for name in ANGLES])
        return self.q + relative[list(ORDER)]

    def mjcf(self) -> str:
        """Returns the MJCF of the mechanism.

        It has four trees of hinges, three `connect` equalities, a spring tendon and a constant
        torque.
        """
        ground, on = (mjcf.in_space(x) for x in self.spring)
        triangle = next(rod for rod in self.linkage.rods if rod.name == "triangle")
        site = '<site name="{}" pos="{}"/>'
        inside = {
            jc.WORLD: site.format("ground", mjcf.numbers(ground)),
            "triangle": site.format("on", mjcf.numbers(on - mjcf.in_space(triangle.center))),
        }
        text = rods.to_mjcf(self.linkage, inside)
        text = text.replace('<joint type="hinge"', '<joint name="motor" type="hinge"', 1)
        spring = f'stiffness="{self.p["c0"]!r}" springlength="{self.p["l0"]!r}"'
        ends = '<site site="ground"/><site site="on"/>'
        torque = f'biastype="affine" biasprm="{self.p["mom"]!r} 0 0"'
        return text.replace(
            "</mujoco>",
            f"<tendon><spatial {spring}>{ends}</spatial></tendon>"
            f'<actuator><general joint="motor" {torque}/></actuator></mujoco>',
        )

    def seen(self, model: Any, data: Any) -> np.ndarray:
        """Returns the angles (β, Θ, γ, Φ, δ, Ω, ε) in MuJoCo, (7,) [rad]."""
        joints = [model.jnt_qposadr[model.body(name).jntadr[0]] for name in ANGLES]
        return self.q + data.qpos[joints][list(ORDER)]


def along(angle: Any) -> np.ndarray:
    """Returns the unit vector at an angle, (2,)."""
    return np.array([np.cos(angle), np.sin(angle)])


def turned(angle: Any) -> np.ndarray:
    """Returns the unit vector at an angle plus π/2, (2,)."""
    return rods.across(along(angle))


def squeezer() -> Motion:
    """Returns the motion of Andrews' mechanism for 30 ms.

    The reference is by extrapolation in 80-bit arithmetic.
    """
    rows = references.load("ivp_andrews")["corrected_reference"]["rows"]
    mechanism = Squeezer.published()
    angles = Form(
        "angles", lambda dtype: andrews.andrews(), lambda system, q: q, jc.solvers.Schur()
    )
    bodies = Form("bodies", mechanism.scene, mechanism.angles, jc.solvers.Sparse(), control=1.0)
    return Motion(
        "Andrews", rows[-1]["t"], "rad", 50, (bodies, angles), mechanism.mjcf, (0.0,) * 7,
        mechanism.seen, np.array(rows[-1]["q"]), gravity=False, loops=True,
    )  # fmt: skip


MOTIONS: dict[str, Callable[[], Motion]] = {
    "pendulum": pendulum,
    "double pendulum": double_pendulum,
    "four-bar": four_bar,
    "Andrews": squeezer,
}
