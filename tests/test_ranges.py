"""Numbers of bounded elements that are changed later are held to the ranges of the first ones."""

import jax
import jax.numpy as jnp
import pytest

import jaxcon as jc


@pytest.fixture(scope="module")
def system():
    scene = jc.Scene(dim=2)
    scene.add_body("slide", mass=2.0, inertia=1.0, position=(0.0, 0.1))
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, 0.0)))
    touch = {"radius": 0.1, "friction": 0.3, "restitution": 0.5, "rolling": 0.01}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "slide", **touch))
    scene.add(jc.BoxContact("box", jc.WORLD, "slide", size=(0.1, 0.2)))
    scene.add(jc.Limit("ends", "rail", -1.0, 1.0, restitution=0.5))
    scene.add(jc.Limit("soft", "rail", upper=1.0, stiffness=10.0))
    scene.add(jc.JointFriction("rub", "rail", most=1.0))
    scene.add(jc.RateLimit("slow", "rail", rate=1.0))
    scene.add(jc.Inequality(lambda p, t, x: p.position[:1], ("slide",), "wall", restitution=0.5))
    return scene.build()[0]


@pytest.mark.parametrize(
    ("name", "change", "match"),
    [
        ("floor", {"friction": -0.1}, "floor: friction must be zero or more"),
        ("floor", {"restitution": 1.5}, "floor: restitution must lie in 0 to 1, got 1.5"),
        ("floor", {"restitution": -0.5}, "floor: restitution must be zero or more"),
        ("floor", {"rolling": -0.1}, "floor: rolling must be zero or more"),
        ("floor", {"radius": -0.1}, "floor: radius must be zero or more"),
        ("floor", {"recovery": 0.0}, "floor: recovery must be positive"),
        ("box", {"size": (0.1, 0.0)}, "box: size must be positive"),
        ("ends", {"lower": 1.0}, "ends: lower must be below upper, got 1.0 and 1.0"),
        ("ends", {"lower": 2.0, "upper": 1.5}, "ends: lower must be below upper, got 2.0 and 1.5"),
        ("soft", {"stiffness": 0.0}, "soft: stiffness must be positive"),
        ("rub", {"most": -1.0}, "rub: most must be zero or more"),
        ("slow", {"rate": -1.0}, "slow: rate must be zero or more"),
        ("wall", {"restitution": 2.0}, "wall: restitution must lie in 0 to 1"),
    ],
)
def test_what_is_out_of_range_is_refused(system, name, change, match):
    with pytest.raises(ValueError, match=match):
        system.with_params({name: change})


def test_what_is_in_range_is_taken(system):
    """Both stops beyond where they were, and numbers that are traced, which have no value."""
    changed = system.with_params({"ends": {"lower": 2.0, "upper": 3.0}, "rub": {"most": 0.0}})
    assert changed.params["ends"]["lower"] == 2.0
    changed = lambda x: system.with_params({"floor": {"friction": x}})  # noqa: E731
    slope = jax.grad(lambda x: changed(x).params["floor"]["friction"])
    assert slope(0.4) == 1.0


def test_a_known_number_is_checked_within_a_traced_function(system):
    with pytest.raises(ValueError, match="friction must be zero or more"):
        jax.eval_shape(lambda: system.with_params({"floor": {"friction": -0.1}}).gravity)


def test_a_negative_friction_that_is_traced_is_none():
    """It would push along the slip, and so would what resists rolling."""
    scene = jc.Scene(dim=2)
    scene.add_body("disc", mass=1.0, inertia=0.01, position=(0.0, 0.1), velocity=(1.0, 0.0))
    touch = {"radius": 0.1, "friction": 0.4, "rolling": 0.01}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "disc", **touch))
    system, state = scene.build()
    method = jc.Method(bounded=jc.GaussSeidel(5, warm=False))

    def end(friction, rolling):
        changed = system.with_params({"floor": {"friction": friction, "rolling": rolling}})
        return jc.rollout(changed, method, state, None, 2e-3, 20)[0].v

    v = jax.jit(jax.vmap(end))(jnp.asarray([-0.4, 0.4]), jnp.asarray([-0.01, -0.01]))
    sliding = 1 - 0.4 * 9.81 * 0.04
    assert jnp.allclose(v, jnp.asarray([[1.0, 0.0, 0.0], [sliding, 0.0, -10 * (1 - sliding)]]))
