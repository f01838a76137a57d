"""Lie brackets of allowed motions: growth vectors from textbooks, on bodies and coordinates."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc


def growth(scene, names=None):
    found = jc.analysis.integrability(*scene.build(), names)
    return found.growth, found.held, found.hidden


def sleigh():
    scene = jc.Scene(dim=2)
    scene.add_body("skate", mass=60.0, inertia=2.0, position=(1.0, 2.0), angle=0.4)
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.5)))
    return scene


def ball(*more):
    scene = jc.Scene()
    turn = (0.9, 0.1, -0.3, 0.2)
    scene.add_body("ball", mass=1.0, inertia=(0.1, 0.2, 0.25), quaternion=turn)
    scene.add(jc.joints.RollingSphere("roll", jc.WORLD, "ball", radius=0.5))
    for element in more:
        scene.add(element)
    return scene


def no_pivot(body, t, p):
    return (body.direction(body.angular_velocity))[2:]


def railed():
    """A skate whose blade lies along its rail and adds no constraint."""
    scene = jc.Scene(dim=2)
    scene.add_body("skate", mass=60.0, inertia=2.0)
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.5)))
    scene.add(jc.Prismatic("rail", jc.WORLD, "skate", axis=(1.0, 0.5)))
    return scene


def rolling(kind, **given):
    scene = jc.Scene(dim=2 if kind == "wheel" else 3)
    inertia = 0.3 if kind == "wheel" else (0.1, 0.2, 0.25)
    scene.add_body("body", mass=1.0, inertia=inertia)
    cls = jc.joints.RollingCylinder if kind == "cylinder" else jc.joints.RollingDisc
    scene.add(cls("roll", jc.WORLD, "body", radius=0.5, **given))
    return scene


EXAMPLES = {
    "skate": (sleigh, ((2, 3), 0, 0)),
    "skate on a rail": (railed, ((1,), 2, 0)),
    "ball": (ball, ((3, 5), 1, 0)),
    "ball that does not pivot": (
        lambda: ball(jc.joints.VelocityLevel(no_pivot, ("ball",), name="pivot")),
        ((2, 3, 5), 1, 0),
    ),
    "leaning disc": (lambda: rolling("disc", axis=(0.0, 0.8, 0.6)), ((3, 4, 5), 1, 0)),
    "wheel in the plane": (lambda: rolling("wheel"), ((1,), 1, 1)),
    "cylinder": (lambda: rolling("cylinder", axis=(1.0, 1.0, 0.0)), ((1,), 2, 3)),
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_growth_on_bodies(name):
    make, expected = EXAMPLES[name]
    assert growth(make()) == expected


def generalized(function, q, t=0.0):
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.ones_like(q),
        force=lambda q, v, t, u, p: jnp.zeros_like(q),
        constraints=(jc.joints.VelocityLevel(function, name="row"),),
    )
    state = jc.init(system, jc.Method(), jnp.asarray(q), jnp.zeros(len(q)), t)
    return jc.analysis.integrability(system, state)


def contact_form(q, v, t, p):
    return (v[2] - q[1] * v[0])[None]


def disguised(q, v, t, p):
    """Returns (q·q̇) times a positive function: not a time derivative, but integrable."""
    return jnp.exp(q[0])[None] * (q @ v)


def car(q, v, t, p):
    """Returns ψ of both wheels of a car at (x, y, θ, steering angle), one unit apart."""
    x, y, heading, steer = v[0], v[1], q[2], q[2] + q[3]
    front = x * jnp.sin(steer) - y * jnp.cos(steer) - v[2] * jnp.cos(q[3])
    return jnp.stack([x * jnp.sin(heading) - y * jnp.cos(heading), front])


def drifting(q, v, t, p):
    """Returns ψ of ẋ = y: the coefficients of v are constant, the drift depends on q."""
    return (v[0] - q[1])[None]


def prescribed(q, v, t, p):
    """Returns ψ of ẋ = sin t."""
    return (v[0] - jnp.sin(t))[None]


@pytest.mark.parametrize(
    ("function", "q", "expected"),
    [
        (contact_form, (0.3, 0.2, 0.1), (2, 3)),
        (disguised, (0.3, 0.2, 0.1), (2,)),
        (car, (0.3, 0.2, 0.1, 0.4), (2, 3, 4)),
        (drifting, (0.3, 0.2), (1, 2)),
        (prescribed, (0.3, 0.2), (1,)),
    ],
)
def test_growth_on_coordinates(function, q, expected):
    found = generalized(function, q, 0.7)
    assert found.growth == expected
    assert found.integrable == (len(expected) == 1)
    assert found.hidden == len(q) - expected[-1]


def test_the_bracket_of_driving_and_turning_is_sideways():
    system, state = sleigh().build()
    found = jc.analysis.integrability(system, state)
    sideways = found.directions[2]
    edge = np.array([1.0, 0.5]) / np.linalg.norm([1.0, 0.5])
    np.testing.assert_allclose(sideways[:2] @ edge, 0, atol=1e-9)
    assert np.linalg.norm(sideways[:2]) > 0.1
    np.testing.assert_allclose(sideways[2], 0, atol=1e-9)


def test_rows_can_be_chosen_by_name_and_the_answer_reads_well():
    scene = ball(jc.joints.VelocityLevel(no_pivot, ("ball",), name="pivot"))
    system, state = scene.build()
    found = jc.analysis.integrability(system, state, ["roll"])
    assert (found.names, found.growth) == (("roll",), (3, 5))
    text = str(found)
    assert "3 → 5" in text
    assert "not integrable" in text
    cylinder = jc.analysis.integrability(*rolling("cylinder", axis=(1.0, 0.0, 0.0)).build())
    assert "integrable: they amount to 3 relations" in str(cylinder)
    with pytest.raises(ValueError, match="'rol' is unknown"):
        jc.analysis.integrability(system, state, ["rol"])
    with pytest.raises(ValueError, match="no constraint"):
        jc.analysis.integrability(system, state, [])


def test_float32():
    scene = jc.Scene(dim=2, dtype=jnp.float32)
    scene.add_body("skate", mass=60.0, inertia=2.0)
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.5)))
    assert growth(scene) == ((2, 3), 0, 0)


def martinet(q, v, t, p):
    return (v[2] - q[0] ** 2 * v[1])[None]


def test_brackets_that_vanish_at_one_configuration_lead_further_around_it():
    """Martinet's form: [X, Y] = 2x ∂z vanishes at x = 0, and [X, [X, Y]] = 2 ∂z does not."""
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.ones(3),
        force=lambda q, v, t, u, p: jnp.zeros(3),
        constraints=(jc.joints.VelocityLevel(martinet, name="martinet"),),
    )
    found = jc.analysis.integrability(
        system, jc.init(system, jc.Method(), jnp.zeros(3), jnp.zeros(3))
    )
    assert (found.growth, found.around) == ((2,), (2, 3))
    assert not found.integrable
    assert found.hidden == 0
    assert "2 dimensions here, 2 → 3 around" in str(found)
