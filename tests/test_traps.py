"""Each trap of the guide's chapter is reported in scenes that have it, and in no others."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from test_auto import rope
from test_report import four_bar

import jaxcon as jc
from jaxcon.analysis.probe import Probe
from jaxcon.analysis.setup import Setup
from jaxcon.analysis.traps import TRAPS, listed, warnings_of

DT = 1e-3


def bob(*elements, position=(1.0, 0.0), velocity=(0.0, 0.0), dtype=None):
    """A particle in the plane under constraints."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0, position=position, velocity=velocity)
    for element in elements:
        scene.add(element)
    return scene.build()


def rod(name="rod", point=(0.0, 0.0), length=None):
    """A rod from a point of the world to the bob."""
    return jc.Distance(name, jc.WORLD, "bob", length=length, point_a=point)


def arm(lower, **stop):
    """A body on a hinge with limits, at angle 0."""
    scene = jc.Scene(dim=2)
    scene.add_body("arm", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)))
    scene.add(jc.Limit("stop", "hinge", lower, 1.0, **stop))
    return scene.build()


def disc(height, **contact):
    """Builds a disc of radius 0.1 m at a height above a floor."""
    scene = jc.Scene(dim=2)
    scene.add_body("disc", mass=1.0, inertia=0.005, position=(0.0, height))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "disc", radius=0.1, **contact))
    return scene.build()


def flat():
    """A parallelogram of rods, all in line: there its three rows have rank 2."""
    scene = jc.Scene(dim=2)
    scene.add_particle("a", mass=1.0, position=(1.0, 0.0))
    scene.add_particle("b", mass=1.0, position=(2.0, 0.0))
    scene.add(jc.Distance("left", jc.WORLD, "a", point_a=(0.0, 0.0)))
    scene.add(jc.Distance("top", "a", "b"))
    scene.add(jc.Distance("right", jc.WORLD, "b", point_a=(1.0, 0.0)))
    return scene.build()


def straight():
    """Three cranks, a coupler of two rods, and a third rod along both: one row is redundant."""
    scene = jc.Scene(dim=2)
    for i, name in enumerate("abc"):
        scene.add_particle(name, mass=1.0, position=(i, 1.0))
        scene.add(jc.Distance(f"crank {name}", jc.WORLD, name, point_a=(float(i), 0.0)))
    for pair in ("ab", "bc", "ac"):
        scene.add(jc.Distance(pair, *pair))
    return scene.build()


def hung(load=100.0):
    """A load hung on ropes by light beads: sweeps converge slowly for a heavy load."""
    scene = jc.Scene(dim=2)
    for i in range(3):
        scene.add_particle(f"p{i}", mass=load if i == 2 else 0.1, position=(0.0, -i - 1.0))
        first = {"point_a": (0.0, 0.0)} if i == 0 else {}
        above = f"p{i - 1}" if i else jc.WORLD
        scene.add(jc.contacts.Rope(f"rope{i}", above, f"p{i}", length=1.0, **first))
    return scene.build()


def crowd():
    """Particles that lie on a rough floor: two inequality rows each."""
    scene = jc.Scene(dim=2)
    for i in range(24):
        scene.add_particle(f"p{i}", mass=1.0, position=(float(i), 0.0))
        scene.add(jc.PlaneContact(f"floor{i}", jc.WORLD, f"p{i}", friction=0.3))
    scene.add(jc.Distance("rod", "p0", "p1"))
    return scene.build()


def skate():
    """A blade with initial slip."""
    scene = jc.Scene(dim=2)
    scene.add_body("skate", mass=60.0, inertia=2.0, velocity=(3.0, 0.5))
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0)))
    return scene.build()


def weight():
    """Ten tonnes hang on a gram: both rods act on the gram."""
    scene = jc.Scene(dim=2)
    scene.add_particle("light", mass=1e-3, position=(0.0, -1.0))
    scene.add_particle("heavy", mass=1e4, position=(0.0, -2.0))
    scene.add(jc.Distance("upper", jc.WORLD, "light"))
    scene.add(jc.Distance("lower", "light", "heavy"))
    return scene.build()


def far():
    """Two rods that meet at (½, √¾), with the bob near the line between their other ends."""
    return bob(rod(length=1.0), rod("other", (1.0, 0.0), 1.0), position=(0.5, 0.1))


def with_(**parts):
    """Returns a method with these parts."""
    return jc.Method(**parts)


GENTLE = jc.Baumgarte.critical(rate=50.0)
SWEEPS = jc.solvers.GaussSeidel(sweeps=2)
SPARSE = {"solver": jc.solvers.Sparse()}
CASES = {  # scene, method, expected traps, and a word of the message
    "pendulum": (lambda: bob(rod()), with_(), (), ""),
    "four-bar": (lambda: four_bar(2), with_(), (), ""),
    "rope": (lambda: rope(14), with_(), (), ""),
    "too fast": (lambda: bob(rod(), velocity=(0.0, 2e3)), with_(), ("step",), "turns by 2 rad"),
    "gains": (
        lambda: bob(rod()),
        with_(stabilizer=jc.Baumgarte.critical(rate=5e3)),
        ("gains",),
        "unstable at dt=0.001",
    ),
    "nearly": (
        lambda: bob(rod(), rod("near", (0.0, 1e-3))),
        with_(),
        ("singular",),
        "Move away from this position",
    ),
    "masses": (weight, with_(), ("step", "singular"), "not by their position but by the masses"),
    "masses damped": (
        weight,
        with_(integrator=jc.integrators.GeneralizedAlpha()),
        ("singular",),
        "masses",
    ),
    "passes": (flat, with_(), ("singular",), "RankSafe takes them"),
    "stops": (flat, with_(**SPARSE), ("singular",), "refuses them as SINGULAR"),
    "sweeps": (hung, with_(contact_solver=SWEEPS), ("order",), "2 sweeps leave"),
    "at once": (hung, with_(), (), ""),
    "twice": (lambda: bob(rod(), rod("again")), with_(), ("over-constrained",), "again"),
    "straight": (straight, with_(), ("over-constrained",), "1 row of"),
    "stops there": (straight, with_(**SPARSE), ("over-constrained",), "refuses them"),
    "contrary": (
        lambda: bob(rod(length=1.0), rod("again", length=1.1), position=(1.05, 0.0)),
        with_(stabilizer=GENTLE),
        ("over-constrained", "start"),
        "contradict",
    ),
    "open": (lambda: bob(rod(length=1.05)), with_(), ("start",), "not closed"),
    "torn": (lambda: bob(rod(), velocity=(0.5, 1.0)), with_(), ("start",), "velocities tear"),
    "slips": (skate, with_(), ("start",), "slip at the start"),
    "curved": (far, with_(), ("start", "nonlinear"), "one linear correction"),
    "once": (
        far,
        with_(stabilizer=jc.Projection(iterations=1)),
        ("start", "nonlinear"),
        "one linear correction",
    ),
    "iterated": (far, with_(stabilizer=jc.Projection()), ("start",), "jc.assemble"),
    "gentle": (far, with_(stabilizer=GENTLE), ("start",), "jc.assemble"),
    "dense": (
        lambda: rope(14),
        with_(solver=jc.solvers.Dense()),
        ("dense",),
        "fewer operations: Sparse()",
    ),
    "many contacts": (
        crowd,
        with_(contact_solver=jc.solvers.InteriorPoint()),
        ("dense",),
        "a matrix of 48 inequality rows in each iteration, about 3.5e+06 operations a step",
    ),
    "nearest contacts": (
        crowd,
        with_(contact_solver=jc.solvers.ActiveSet(jc.solvers.InteriorPoint(), contacts=4)),
        ("impacts",),
        "have the time of the first",
    ),
    "many by default": (crowd, with_(), (), ""),
    "many swept": (crowd, with_(contact_solver=jc.solvers.GaussSeidel()), (), ""),
    "few rows": (lambda: rope(3), with_(solver=jc.solvers.Dense()), (), ""),
    "swept": (
        lambda: bob(rod()),
        with_(solver=jc.solvers.ConjugateGradients()),
        ("iterations",),
        "100 iterations for 1 row,",
    ),
    "swept rope": (
        lambda: rope(14),
        with_(solver=jc.solvers.ConjugateGradients(iterations=30)),
        ("iterations",),
        "times the operations",
    ),
    "sweeps on": (
        lambda: hung(0.1),
        with_(contact_solver=jc.solvers.GaussSeidel(sweeps=5000)),
        ("iterations",),
        "sweeps=5000",
    ),
    "below a limit": (lambda: arm(0.4), with_(), ("range",), "stop (0.4 rad below lower)"),
    "within limits": (lambda: arm(-0.1), with_(), (), ""),
    "in the floor": (lambda: disc(0.05), with_(), ("overlap",), "floor (0.05 m)"),
    "on the floor": (lambda: disc(0.1), with_(), (), ""),
    "in a soft floor": (lambda: disc(0.05, stiffness=1e3), with_(), (), ""),
    "below a soft limit": (lambda: arm(0.4, stiffness=10.0), with_(), (), ""),
}


@pytest.mark.parametrize("name", CASES)
def test_a_trap_is_seen_where_it_is(name):
    scene, method, expected, words = CASES[name]
    known = Setup.of(*scene(), method, DT)
    said = warnings_of(known)
    assert set(said) == set(expected), said
    assert words in " ".join(said.values())


def test_each_trap_of_the_chapter_is_there():
    assert set(TRAPS) == {name for _, _, names, _ in CASES.values() for name in names}
    assert len(TRAPS) == 12  # eight of the guide, long steps, impacts, joint limits, overlaps


def test_a_method_that_remembers_needs_no_state_of_its_own():
    system, state = bob(rod())
    forgets = with_(stabilizer=jc.stabilizers.SlidingWindowBaumgarte())
    report = jc.report(system, state, forgets, DT, measure=True)
    assert report.probe.status == jc.Status.OK
    assert "gains" not in str(dataclasses.replace(report, gains=(0.0, 0.0, np.inf), choice=None))


def test_a_start_in_a_contact_is_told_without_a_method():
    """The report gives the recovery speed, which equals the speed after a step."""
    system, state = disc(0.05, recovery=0.3)
    assert set(jc.report(system, state).warnings) == {"overlap"}
    text = str(jc.report(system, state))
    assert "contacts start in overlap: floor (0.05 m). They part at 0.3 m/s at most" in text
    after, _ = jc.step(system, jc.Method(), state, None, DT)
    np.testing.assert_allclose(after.v[1], 0.3, rtol=1e-6)


def test_a_start_outside_joint_limits_is_told_without_a_method():
    """The report gives the recovery rate: 0.3 rad/s, or a fifth of the violation a step."""
    system, state = arm(0.4, recovery=0.3)
    assert set(jc.report(system, state).warnings) == {"range"}
    text = str(jc.report(system, state))
    assert "stop (0.4 rad below lower). They return at 0.3 rad/s at most" in text
    after, _ = jc.step(system, jc.Method(), state, None, DT)
    np.testing.assert_allclose(jc.coordinate_rate(system, after, "hinge"), 0.3, rtol=1e-6)
    inside = dataclasses.replace(state, q=after.q * 0 + jnp.asarray([0.0, 0.5, np.pi / 2]))
    text = str(jc.report(system, inside))
    assert "stop (0.57 rad above upper)" in text


def test_many_names_are_cut():
    assert listed(("a", "b", "c")) == "a, b, c"
    assert listed(("a", "b", "c", "d")) == "a, b, c and 1 other"
    assert listed(("a", "b", "c", "d", "e")) == "a, b, c and 2 others"


def test_float32_is_no_trap():
    known = Setup.of(*bob(rod(), dtype=jnp.float32), jc.Method(), DT)
    assert warnings_of(known) == {}
    assert np.isfinite(known.probe.violation)


def test_without_a_step_nothing_is_said_of_it():
    wild = with_(stabilizer=jc.Baumgarte.critical(rate=5e3))
    known = Setup.of(*bob(rod()), wild)
    assert known.probe is None
    assert "gains" not in warnings_of(known)


def test_a_report_is_a_checklist():
    system, state = bob(rod())
    wild = with_(stabilizer=jc.Baumgarte.critical(rate=1e3), solver=jc.solvers.Dense())
    report = jc.report(system, state, wild, DT, measure=True, timed=True)
    assert report.gains[:2] == (1e3, 1e3)
    assert report.gains[2] == pytest.approx((2 * np.sqrt(2) - 2) / DT)
    assert set(report.warnings) == {"gains"}
    assert report.seconds > 0
    text = str(report)
    for words in (
        "1 degree of freedom",
        "operations a step",
        "memory of a world",
        "µs a step of one world",
        "gains α = 1000, β = 1000 1/s; at this ratio β is stable up to 828.4 1/s",
        "expected violation: ",
        "jc.Method.auto takes Sparse(): constraints, 1 row, close no loop",
        "warning, gains too large for the step: Baumgarte gains",
    ):
        assert words in text
    fails = dataclasses.replace(report, probe=Probe(32, 0.0, 0.0, jc.Status.SINGULAR))
    assert "32 steps from here fail, SINGULAR: the constraint rows are dependent" in str(fails)
    assert "expected violation" not in str(fails)
    α, β, most = jc.report(system, state, with_(), DT).gains  # x² + 2x = 4 for x = hβ and α = β/2
    assert α / β == pytest.approx(0.5)
    assert β < most == pytest.approx((np.sqrt(5) - 1) / DT)
    calm = jc.report(system, state)
    assert calm.warnings == {}
    assert calm.work is calm.gains is calm.probe is calm.seconds is None
