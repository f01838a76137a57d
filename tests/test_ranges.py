"""Changed numbers of inequality elements must lie in the ranges required at the build."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.core import checks


@pytest.fixture(scope="module")
def system():
    scene = jc.Scene(dim=2)
    scene.add_body("slide", mass=2.0, inertia=1.0, position=(0.0, 0.1))
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, 0.0)))
    touch = {"radius": 0.1, "friction": 0.3, "restitution": 0.5, "rolling": 0.01}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "slide", **touch))
    scene.add(jc.contacts.BoxContact("box", jc.WORLD, "slide", size=(0.1, 0.2)))
    scene.add(jc.Limit("ends", "rail", -1.0, 1.0, restitution=0.5))
    scene.add(jc.Limit("soft", "rail", upper=1.0, stiffness=10.0))
    scene.add(jc.contacts.JointFriction("rub", "rail", max_force=1.0))
    scene.add(jc.contacts.RateLimit("slow", "rail", rate=1.0))
    scene.add(
        jc.contacts.Inequality(lambda p, t, x: p.position[:1], ("slide",), "wall", restitution=0.5)
    )
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
        ("rub", {"max_force": -1.0}, "rub: max_force must be zero or more"),
        ("slow", {"rate": -1.0}, "slow: rate must be zero or more"),
        ("wall", {"restitution": 2.0}, "wall: restitution must lie in 0 to 1"),
    ],
)
def test_what_is_out_of_range_is_refused(system, name, change, match):
    with pytest.raises(ValueError, match=match):
        system.with_params({name: change})


@pytest.fixture(scope="module")
def mechanism():
    scene = jc.Scene(dim=3)
    solid = {"mass": 1.0, "inertia": (1.0, 1.0, 1.0)}
    scene.add_body("ball", **solid, position=(0.0, 0.0, 0.1))
    scene.add(jc.joints.RollingSphere("roll", jc.WORLD, "ball", radius=0.1))
    for i, name in enumerate(("nut", "wheel", "pinion")):
        scene.add_body(name, **solid, position=(1.0 + i, 0.0, 0.0))
    axis = (0.0, 0.0, 1.0)
    scene.add(jc.joints.Screw("thread", jc.WORLD, "nut", axis=axis, lead=0.01))
    for name, body in (("first", "wheel"), ("second", "pinion")):
        at = (2.0 if name == "first" else 3.0, 0.0, 0.0)
        scene.add(jc.Revolute(name, jc.WORLD, body, point=at, axis=axis))
    scene.add(jc.joints.Gear("gear", "first", "second", ratio=-2.0))
    scene.add(jc.joints.Armature("rotor", "first", inertia=0.1))
    scene.add(jc.contacts.Rope("rope", "ball", "nut", length=3.0))
    scene.add(jc.Distance("rod", "ball", "wheel"))
    scene.add(jc.Motor("motor", "first", control_range=(-1.0, 1.0)))
    scene.add(jc.forces.JointSpring("coil", "first", stiffness=1.0))
    scene.add(jc.forces.Flexure("flexure", "wheel", "pinion", bending=1.0, twisting=1.0))
    scene.add(jc.Spring("spring", "ball", "nut", stiffness=1.0))
    return scene.build()[0]


@pytest.mark.parametrize(
    ("name", "field", "value", "match"),
    [
        ("roll", "radius", -0.1, "roll: radius must be positive"),
        ("thread", "lead", 0.0, "thread: lead must be finite and not zero"),
        ("gear", "ratio", 0.0, "gear: ratio must be finite and not zero"),
        ("rotor", "inertia", 0.0, "rotor: inertia must be positive"),
        ("rope", "length", 0.0, "rope: length must be positive"),
        ("rod", "length", -1.0, "rod: length must be positive"),
        ("motor", "control_range", (2.0, 1.0), "motor: control_range must be .lowest, highest."),
        ("coil", "damping", -1.0, "coil: damping must be zero or more"),
        ("flexure", "twisting", 2.5, "flexure: twisting must be at most twice bending"),
        ("flexure", "bending", 0.4, "flexure: twisting must be at most twice bending"),
        ("spring", "rest_length", -1.0, "spring: rest_length must be zero or more"),
    ],
)
def test_what_a_joint_is_not_built_with_is_refused(mechanism, name, field, value, match):
    """Traced values, and arrays that must not be waited for, have no value to check."""
    with pytest.raises(ValueError, match=match):
        mechanism.with_params({name: {field: value}})
    numbers = mechanism.params[name] | {field: value}
    with pytest.raises(ValueError, match=match):
        jax.eval_shape(lambda: mechanism.with_params({name: numbers}).gravity)
    jax.eval_shape(lambda x: mechanism.with_params({name: {field: x}}), jnp.asarray(value))
    with checks.without_waiting():
        mechanism.with_params({name: {field: jnp.asarray(value)}})


def test_what_is_in_range_is_taken(system):
    """Both stops may move beyond their old places; traced numbers have no value to check."""
    changed = system.with_params({"ends": {"lower": 2.0, "upper": 3.0}, "rub": {"max_force": 0.0}})
    assert changed.params["ends"]["lower"] == 2.0
    changed = lambda x: system.with_params({"floor": {"friction": x}})  # noqa: E731
    slope = jax.grad(lambda x: changed(x).params["floor"]["friction"])
    assert slope(0.4) == 1.0


def test_a_known_number_is_checked_within_a_traced_function(system):
    with pytest.raises(ValueError, match="friction must be zero or more"):
        jax.eval_shape(lambda: system.with_params({"floor": {"friction": -0.1}}).gravity)


def test_a_negative_friction_that_is_traced_is_none():
    """Negative friction would push along the slip.

    Negative rolling resistance would drive the disc.
    """
    scene = jc.Scene(dim=2)
    scene.add_body("disc", mass=1.0, inertia=0.01, position=(0.0, 0.1), velocity=(1.0, 0.0))
    touch = {"radius": 0.1, "friction": 0.4, "rolling": 0.01}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "disc", **touch))
    system, state = scene.build()
    method = jc.Method(contact_solver=jc.solvers.GaussSeidel(5, warm=False))

    def end(friction, rolling):
        changed = system.with_params({"floor": {"friction": friction, "rolling": rolling}})
        return jc.rollout(changed, method, state, None, 2e-3, 20)[0].v

    v = jax.jit(jax.vmap(end))(jnp.asarray([-0.4, 0.4]), jnp.asarray([-0.01, -0.01]))
    sliding = 1 - 0.4 * 9.81 * 0.04
    assert jnp.allclose(v, jnp.asarray([[1.0, 0.0, 0.0], [sliding, 0.0, -10 * (1 - sliding)]]))


def slid(element, changes, controls=None):
    """Returns φ and φ̇ of 2 kg on a rail, from 1 m/s over three seconds; the numbers are traced."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("slide", mass=2.0, inertia=1.0, velocity=(1.0, 0.0))
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, 0.0)))
    scene.add(element)
    system, state = scene.build()

    @jax.jit
    def run(changes):
        changed = system.with_params({"it": changes})
        last, path = jc.rollout(changed, jc.Method(), state, controls, 2e-3, 1500)
        return path.q[:, 0], path.v[:, 0], last.status

    x, v, status = run(jax.tree.map(jnp.asarray, changes))
    assert status == jc.Status.OK
    return x, v


@pytest.mark.parametrize(
    ("element", "changes", "speed"),
    [
        (jc.contacts.JointFriction("it", "rail", 1.0), {"max_force": -1.0}, 1.0),
        (jc.contacts.RateMotor("it", "rail", 1.0), {"max_force": -1.0}, 1.0),
        (jc.contacts.RateLimit("it", "rail", 0.5), {"rate": -0.5}, 0.0),
    ],
    ids=["friction", "motor", "rate"],
)
def test_negative_traced_bounds_are_zero(element, changes, speed):
    """A friction of −1 N would push, and a rate limit of −0.5 m/s would reverse the motion."""
    controls = jnp.zeros((1500, 1)) if isinstance(element, jc.contacts.RateMotor) else None
    v = slid(element, changes, controls)[1]
    assert jnp.allclose(v, speed, atol=1e-12)


def test_negative_traced_damping_is_none():
    """Negative damping would add energy without limit."""
    v = slid(jc.Limit("it", "rail", upper=0.1, stiffness=100.0, damping=1.0), {"damping": -5.0})[1]
    none = jc.Limit("it", "rail", upper=0.1, stiffness=100.0)
    assert jnp.allclose(v, slid(none, {"stiffness": 100.0})[1], atol=1e-12)
    assert jnp.max(jnp.abs(v)) < 1 + 1e-12


def test_a_traced_restitution_above_one_adds_no_energy():
    v = slid(jc.Limit("it", "rail", -0.1, 0.1, restitution=0.5), {"restitution": 2.0})[1]
    assert jnp.allclose(jnp.abs(v), 1.0, atol=1e-12)


@pytest.mark.parametrize("changes", [{"lower": 0.2}, {"lower": 0.2, "upper": -0.2}])
def test_traced_stops_that_have_crossed_hold_what_is_between_them(changes):
    """The body stays in the middle of the crossed stops and returns there at the recovery speed."""
    x, v = slid(jc.Limit("it", "rail", -0.1, 0.1, recovery=0.3), changes)
    middle = (changes["lower"] + changes.get("upper", 0.1)) / 2
    assert jnp.max(jnp.abs(v)) <= 1.0 + 1e-12
    assert jnp.max(jnp.abs(x[750:] - middle)) < 0.3 * 2e-3 + 1e-12  # the travel of a step
    assert jnp.max(jnp.abs(v[750:])) < 0.3 + 1e-12


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_a_soft_stop_without_stiffness_and_damping_is_none(dtype):
    """The body passes the stop; values of zero, below zero, or nearly zero have derivatives."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0), dtype=dtype)
    scene.add_body("slide", mass=2.0, inertia=1.0, position=(0.1, 0.0), velocity=(1.0, 0.0))
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, 0.0), point=(0.0, 0.0)))
    scene.add(jc.Limit("it", "rail", upper=-0.05, stiffness=100.0, damping=1.0))
    system, state = scene.build()

    def speed(numbers):
        changed = system.with_params({"it": {"stiffness": numbers[0], "damping": numbers[1]}})
        return jc.step(changed, jc.Method(), state, None, jnp.asarray(2e-3, dtype))[0].v[0]

    numbers = [[-100.0, -1.0], [-100.0, 0.0], [0.0, 0.0], [1e-30, 0.0]]
    found = jax.jit(jax.vmap(jax.value_and_grad(speed)))(jnp.asarray(numbers, dtype))
    assert jnp.allclose(found[0], 1.0, atol=1e-7)
    assert jnp.all(jnp.isfinite(found[1]))


@pytest.mark.parametrize(
    ("upper", "changes"), [(0.1001, {"restitution": -0.5}), (-0.05, {"recovery": -0.1})]
)
def test_a_negative_traced_restitution_or_recovery_lets_nothing_in(upper, changes):
    stop = jc.Limit("it", "rail", upper=upper, restitution=0.5)
    x, v = slid(stop, {"restitution": 0.0} | changes)
    assert jnp.max(x) < max(upper, 0) + 1e-12
    assert jnp.allclose(v[-1], 0.0, atol=1e-12)


def test_numbers_are_compared_as_the_scene_holds_them():
    """In float32, 1e-50 is zero, and stored stiffnesses of 0.1 and 0.2 are in range together."""
    scene = jc.Scene(dtype="float32")
    for name in ("a", "b"):
        scene.add_body(name, mass=1.0, inertia=(0.1, 0.1, 0.1))
    scene.add(jc.forces.Flexure("flexure", "a", "b", bending=0.1, twisting=0.2))
    scene.add(jc.forces.Flexure("other", "a", "b", bending=jnp.float32(0.7), twisting=1.4))
    scene.add(jc.Distance("rod", "a", "b", point_a=(1.0, 0.0, 0.0)))
    system, _ = scene.build()
    system.with_params({"flexure": {"bending": 0.1}})
    with pytest.raises(ValueError, match="rod: length must be positive"):
        system.with_params({"rod": {"length": 1e-50}})
    scene.add(jc.PlaneContact("floor", jc.WORLD, "a", radius=0.1, stiffness=10.0))
    with pytest.raises(ValueError, match="floor: stiffness must be positive"):
        scene.build()[0].with_params({"floor": {"stiffness": 1e-50}})
    scene.add(jc.joints.RollingSphere("roll", "a", "b", normal=(0.0, 0.0, 1.0), radius=1e-50))
    with pytest.raises(ValueError, match="radius must be positive"):
        scene.build()


@pytest.mark.parametrize(
    ("axis", "match"),
    [
        ((0.0, 0.0, 1e-25), "axis must have a length, got"),
        ((8e-20, 8e-20, 8e-20), "axis must have a length, got"),
        ((0.0, 0.0, 1e20), "axis must have a length whose square is in the range of float32"),
        ((0.0, 0.0, np.inf), "axis must be finite"),
    ],
)
def test_an_axis_that_cannot_be_divided_by_its_length_is_refused(axis, match):
    """In float32, squares of 1e-25 and 1e20 are zero and infinite; 1e10 and 1e-10 are in range."""
    for good in (1e10, 1e-10):
        scene = jc.Scene(dtype="float32")
        scene.add_body("a", mass=1.0, inertia=(1.0, 1.0, 1.0))
        scene.add(jc.Revolute("hinge", jc.WORLD, "a", (0.0, 0.0, 0.0), axis=(0.0, 0.0, good)))
        scene.build()
    scene.add(jc.Revolute("other", jc.WORLD, "a", (0.0, 0.0, 0.0), axis=axis))
    with pytest.raises(ValueError, match=match):
        scene.build()


def test_a_restitution_of_one_plus_a_rounding_error_is_one_in_float32():
    scene = jc.Scene(dim=2, dtype="float32")
    scene.add_particle("ball", mass=1.0, position=(0.0, 1.0))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=0.1, restitution=0.5))
    changed = scene.build()[0].with_params({"floor": {"restitution": 1.0000000000000002}})
    assert changed.params["floor"]["restitution"] == 1.0
