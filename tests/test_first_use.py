"""What the library tells a first-time user: units, names and short numbers in its messages."""

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
    """The same number may stand in both panels, of the linkages tuned on and of others."""
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
