"""Messages for first-time users have units, names and short numbers."""

import jax
import numpy as np
import pytest

import jaxcon as jc
from jaxcon import demo, view
from jaxcon.analysis.front import COORDINATES, Run, Tradeoff
from jaxcon.core import checks


def bar(*hinges, velocity=(0.0, 0.0)):
    scene = jc.Scene(dim=2, dtype="float32")
    scene.add_body("bar", mass=1.0, inertia=0.1, position=(1.0, 0.0), velocity=velocity)
    for name in hinges:
        scene.add(jc.Revolute(name, jc.WORLD, "bar", point=(0.0, 0.0)))
    return scene.build()


@pytest.mark.parametrize(("unit", "shown"), [("m", "0.01 m,"), (COORDINATES, "0.01 of q,")])
def test_a_recommendation_has_units(unit, shown):
    known = ("Euler", "float32", 1e-3, "ok", 1e-2, True, 0.0, 2e-6, 3e-4, 1e-3)
    run = Run(*known, cost=2e-5, unit=unit)
    result = Tradeoff((run,), (), (), 1.0, 1.0, 1e-3, (), 8, 1.0)
    text = str(result.recommend(error=0.1))
    assert f"error {shown}" in text
    assert "violation 2e-06 m or rad, energy off by 0.0003 J" in text
    assert "2e-05 s of computing per simulated second" in text
    with pytest.raises(ValueError, match=f"at most 0.005 {unit}; the least is 0.01 {unit}"):
        result.recommend(error=5e-3)
    with pytest.raises(ValueError, match="at most 1e-09 s/s; the least is 2e-05 s/s"):
        result.recommend(cost=1e-9)


@pytest.mark.parametrize(
    ("dim", "unknown", "words"),
    [
        (2, {"orientation": (1.0, 0.0)}, r"orientation=\(1.0, 0.0\).*The orientation is angle="),
        (3, {"orientation": None}, "orientation=None.*The orientation is quaternion=, wxyz"),
        (3, {"velocty": 1.0}, "takes mass=, inertia=, .*Did you mean velocity="),
    ],
)
def test_an_unknown_argument_of_a_body_is_named_with_those_it_has(dim, unknown, words):
    with pytest.raises(TypeError, match=f"body 'arm': add_body has no argument .*{words}"):
        jc.Scene(dim=dim).add_body("arm", mass=1.0, **unknown)


def test_a_particle_has_no_orientation_and_says_so():
    with pytest.raises(TypeError, match="particle 'bob': .*A particle has no orientation"):
        jc.Scene().add_particle("bob", mass=1.0, quaternion=(1.0, 0.0, 0.0, 0.0))


def test_a_violation_is_printed_by_constraint_with_units():
    system, state = bar("pin", velocity=(0.0, 1e-3))
    assert repr(jc.violation(system, state)) == "pin: 0 m or rad, rate 0.001 m/s or rad/s"
    shown = []
    jax.vmap(lambda s: shown.append(repr(jc.violation(system, s))))(
        jax.tree.map(lambda x: x[None], state)
    )
    assert shown == ["Violation(position (2,), velocity (2,) of pin)"]


def test_messages_show_single_precision_without_its_noise():
    scene = jc.Scene(dim=2, dtype="float32")
    scene.add_body("bar", mass=-0.1, inertia=1.0)
    with pytest.raises(ValueError, match=r"mass must be positive and finite, got -0\.1\.$"):
        scene.build()
    single = np.array([[0.1, 1.0], [16.1, np.inf]], np.float32)
    assert checks.numerals(single) == "[[0.1, 1.0], [16.1, inf]]"
    assert checks.numerals(single.astype(float)) == "[[0.1, 1.0], [16.1, inf]]"


def test_redundant_rows_are_named_once():
    system, state = bar("pin", "again")
    text = str(jc.report(system, state, jc.Method(), 1e-3))
    assert text.count("again[0") == 1
    assert "redundant rows" not in text
    assert "redundant rows" in str(jc.report(system, state))


def test_each_error_in_the_picture_says_on_which_linkages():
    """Legends name the linkages, because the errors on both sets may round to the same number."""
    plt = pytest.importorskip("matplotlib.pyplot")
    figure, axes = plt.subplots(1, 2)
    history = np.array([3e-7, 2e-7, 1e-7])
    view._draw_loss(axes[0], demo.Tuning({}, {}, history, 4.72e-7, 64))
    rms = np.full((2, 5, 8), 4.72e-7)
    view._draw_errors(axes[1], demo.Validation(np.arange(5.0), rms, np.ones(2)))
    legends = [[x.get_text() for x in a.get_legend().get_texts()] for a in axes]
    plt.close(figure)
    assert "default gains on these 64: 472 nm" in legends[0]
    assert "tried, from default + integral: 300 nm" in legends[0]
    assert "default gains on these 8: 472 nm" in legends[1]


@pytest.mark.parametrize("angle", [0.0, 0.5 * np.pi, np.pi])
@pytest.mark.parametrize("kind", ["particle", "body"])
def test_a_report_says_how_far_a_pendulum_swings_in_a_step(kind, angle):
    """The report gives h √(g/l) = 3.13, whether the pendulum hangs, is released level or stands."""
    scene = jc.Scene(dim=2)
    place = (np.sin(angle), -np.cos(angle))
    if kind == "particle":
        scene.add_particle("bob", mass=1.0, position=place)
        scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    else:
        scene.add_body("bob", mass=1.0, inertia=1e-4, position=place)
        scene.add(jc.Revolute("pin", jc.WORLD, "bob", point=(0.0, 0.0)))
    report = jc.report(*scene.build(), jc.Method(), 1.0)
    assert report.angle.swing == pytest.approx(np.sqrt(9.81), rel=1e-3)
    assert report.angle.turn == 0
    said = report.warnings["step"]
    assert "'bob' at 3.13 rad/s, h ω = 3.1, where oscillations are stable" in said
    assert "SemiImplicitEuler below 2" in said
    assert "Take dt of 0.064 s or less" in said
    assert "status OK" in said


def test_a_rotor_slows_what_it_turns_with():
    """The frequency follows ω² = m g l / (m l² + I)."""
    scene = jc.Scene(dim=2)
    scene.add_body("bob", mass=1.0, inertia=1e-9, position=(0.0, -1.0))
    scene.add(jc.Revolute("pin", jc.WORLD, "bob", point=(0.0, 0.0)))
    scene.add(jc.joints.Armature("rotor", "pin", inertia=3.0))
    report = jc.report(*scene.build(), jc.Method(), 0.1)
    assert report.angle.swing == pytest.approx(0.1 * np.sqrt(9.81 / 4.0), rel=1e-3)


def test_a_report_knows_the_frequencies_of_springs():
    """Two masses between springs have ω² = k/m and 3 k/m if all are equal."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    for name, x in (("a", 1.0), ("b", 2.0)):
        scene.add_particle(name, mass=2.0, position=(x, 0.0))
        scene.add(jc.joints.PointOnLine(f"{name} line", jc.WORLD, name, axis=(1.0, 0.0)))
    scene.add(jc.Spring("left", jc.WORLD, "a", stiffness=8.0, point_a=(0.0, 0.0)))
    scene.add(jc.Spring("middle", "a", "b", stiffness=8.0))
    scene.add(jc.Spring("right", "b", jc.WORLD, stiffness=8.0, point_b=(3.0, 0.0)))
    report = jc.report(*scene.build(), jc.Method(), 0.1)
    assert report.angle.swing == pytest.approx(0.1 * np.sqrt(12.0), rel=1e-5)
    assert "step" not in report.warnings
    assert "h ω = 0.35 by gravity and springs" in str(report)
    assert jc.report(*scene.build(), jc.Method()).angle is None


def test_a_drive_near_its_turning_point_is_no_turn():
    """A cart on a rail accelerates slowly from rest, which must not be read as a rotation."""
    scene = jc.Scene(dim=2)
    scene.add_body("c", mass=1.0, inertia=0.1, position=(0.0, 0.0), velocity=(1e-6, 0.0))
    rail = jc.Prismatic("rail", jc.WORLD, "c", point=(0.0, 0.0), axis=(1.0, 0.0))
    scene.add(rail)
    scene.add(jc.joints.Drive("drive", "rail", lambda t, _: 0.5 * t**2 + 1e-6 * t))
    system, state = scene.build()
    angle = jc.report(system, state, jc.Method(), 1e-3).angle
    assert angle.turning.value < 1e-6
