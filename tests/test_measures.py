"""Coordinates of joints without rows: angles of rotation, thrusters and tendons.

Their rates and biases are compared with automatic differentiation of their values and rates.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DERIVATIVE

import jaxcon as jc
from jaxcon.constraints.base import blocks_of
from jaxcon.linear.jacobian import Jacobian
from jaxcon.system import coordinates

DT = 1e-3


def bodies(dtype=None, **gravity):
    """Three bodies in space without joints."""
    scene = jc.Scene(dim=3, dtype=dtype, **gravity)
    for i, name in enumerate("abc"):
        turn = jc.quaternion.exp(jnp.array([0.3, -0.2 * i, 0.1], scene.dtype))
        scene.add_body(
            name,
            mass=1.0 + i,
            inertia=(0.3, 0.4, 0.5 + 0.1 * i),
            position=(0.4 * i, 0.1, -0.2),
            quaternion=turn,
        )
    return scene


ENDS = {"point_a": (0.3, 0.3, -0.4), "point_b": (1.3, 0, -0.3)}
WRAPS = {"sphere": {}, "cylinder": {"axis": (0.2, 1, 0)}}
ELEMENTS = {
    "angle": [jc.joints.RotationAngle("x", "a", "b")],
    "angle in the world": [jc.joints.RotationAngle("x", jc.WORLD, "b")],
    "thrust": [jc.joints.Thrust("x", "a", "b", (0.2, 0.3, 0), (1, 2, 0), (0.3, 0, 1))],
    "thrust in the world": [jc.joints.Thrust("x", jc.WORLD, "b", (0.2, 0.3, 0), (1, 2, 0))],
    "tendon": [
        jc.joints.Span("there", "a", "b", (0, 0, 0), (0.5, 0.2, 0.3)),
        jc.joints.Span("on", "b", "c", (0.5, 0.2, 0.3), (1, 0.1, 0.4)),
        jc.joints.RotationAngle("turn", jc.WORLD, "c"),
        jc.joints.Tendon("x", ("there", "on", "turn"), (1.0, 0.5, -0.3)),
    ],
    **{
        f"wrapped {name}": [
            jc.joints.WrappedSpan("span", "a", "b", "c", 0.3, **ENDS, **given),
            jc.joints.Tendon("x", ("span",)),
        ]
        for name, given in WRAPS.items()
    },
}


def row(system, q, v, joint="x"):
    """Returns value, rate, bias and Jacobian (n_v,) of the only coordinate of a joint."""
    snapshot = system.snapshot(q, v, 0.0)
    where = coordinates.directory(system.constraints)
    end = coordinates.find(system.constraints, where, "test", joint, None)
    found = coordinates.at(coordinates.numbered(system.counted), [end]).read(snapshot)
    places = system.constraints[end[0]].select((end[1],)).places
    jacobian = Jacobian(tuple(blocks_of(system, places, [found], 0)), (1, v.shape[0]))
    return found.value[0], found.rate[0], jnp.broadcast_to(found.bias, (1,))[0], jacobian.dense()[0]


@pytest.mark.parametrize("name", ELEMENTS)
def test_rates_and_biases_are_derivatives(name):
    scene = bodies()
    for element in ELEMENTS[name]:
        scene.add(element)
    system, state = scene.build()

    def compare(key):
        """Returns pairs of numbers that must be equal, at a random state."""
        keys = jax.random.split(key)
        q = system.retract(state.q, jax.random.uniform(keys[0], state.v.shape, minval=-0.7))
        v = jax.random.normal(keys[1], state.v.shape)
        slopes = system.kinematics(q, v), jnp.zeros_like(v)
        found, change = jax.jvp(lambda *x: row(system, *x)[:2], (q, v), slopes)
        value, rate, bias, jacobian = row(system, q, v)
        along = rate if "thrust" in name else change[0]  # the value of a thrust is zero
        return (rate, bias, jacobian @ v), (along, change[1], found[1])

    keys = jax.random.split(jax.random.key(0), 100)
    got, expected = jax.jit(jax.vmap(compare))(keys)
    for x, y in zip(got, expected, strict=True):
        np.testing.assert_allclose(x, y, atol=DERIVATIVE)


def test_a_rotation_angle_and_its_force_at_assembly_are_zero():
    scene = bodies()
    scene.add(jc.joints.RotationAngle("x", "a", "b"))
    system, state = scene.build()
    v = jnp.ones_like(state.v)
    slopes = jax.jacrev(lambda q: row(system, q, v)[:3])(state.q)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slopes))
    np.testing.assert_array_equal(row(system, state.q, v)[3], 0)


def test_a_ball_joint_stops_at_its_largest_angle():
    """A pendulum on a ball joint falls and stops at 0.5 rad, in float32 and in batches."""
    scene = jc.Scene(dim=3, dtype=jnp.float32)
    scene.add_body("rod", mass=1.0, inertia=(0.1, 0.1, 0.01), position=(0.3, 0.2, 0.5))
    scene.add(jc.Spherical("ball", jc.WORLD, "rod", point=(0, 0, 0)))
    scene.add(jc.joints.RotationAngle("turn", jc.WORLD, "rod", (0, 0, 0)))
    scene.add(jc.Limit("cone", "turn", upper=0.5))
    system, state = scene.build()

    def fall(speed):
        start = state.replace(v=state.v.at[5].set(speed))
        end, _ = jc.rollout(system, jc.Method(), start, None, 5e-3, 200)
        return jc.coordinate(system, end, "turn"), end.status

    angles, status = jax.jit(jax.vmap(fall))(jnp.array([0.0, 1.0, -1.0], jnp.float32))
    assert not np.any(status)
    np.testing.assert_allclose(angles, 0.5, atol=1e-4)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_thruster_accelerates_a_body(dtype):
    """The force acts along the body's axis; its gradient by the control is the acceleration."""
    scene = bodies(dtype, gravity=(0, 0, 0))
    scene.add(jc.joints.Thrust("jet", jc.WORLD, "a", force=(0, 0, 2), torque=(0, 0.5, 0)))
    scene.add(jc.Motor("engine", "jet", gear=3.0))
    system, state = scene.build()

    def lifted(u):
        info = jc.forward_dynamics(system, state, u[None], jc.Method(), DT)
        return info.acceleration[system.layout.v("a")][:3]

    u = jnp.asarray(0.7, dtype)
    np.testing.assert_allclose(jax.jit(lifted)(u), [0, 0, 6 * u], atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(lifted))(u), [0, 0, 6], atol=1e-6)


def arm(dtype, *elements, dim=3):
    """A double pendulum in the x-y plane."""
    scene = jc.Scene(dim=dim, gravity=(0, -9.81, 0)[:dim], dtype=dtype)
    axis = (0, 0, 1) if dim == 3 else None
    for i, above in enumerate((jc.WORLD, "link 0")):
        at = (0.5 + i, 0, 0) if dim == 3 else (0.5 + i, 0)
        inertia = (0.01, 0.1, 0.1) if dim == 3 else 0.1
        scene.add_body(f"link {i}", mass=1.0, inertia=inertia, position=at)
        hinge = (float(i), 0, 0) if dim == 3 else (float(i), 0)
        scene.add(jc.Revolute(f"hinge {i}", above, f"link {i}", point=hinge, axis=axis))
    for element in elements:
        scene.add(element)
    return scene.build()


TENDON = jc.joints.Tendon("tendon", ("hinge 0", "hinge 1"), (0.3, -0.2))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_elements_act_on_tendons(dim, dtype):
    """Motor, spring and damper act by their moment arms; the gradient by an arm is exact."""
    elements = (
        jc.Motor("motor", "tendon", gear=2.0),
        jc.forces.DeadBandSpring("spring", "tendon", 30.0, 0.05, 0.1, damping=0.4),
    )
    system, state = arm(dtype, TENDON, *elements, dim=dim)
    plain, _ = arm(dtype, *(jc.Motor(f"motor {i}", f"hinge {i}") for i in (0, 1)), dim=dim)
    v = state.v.at[-1].set(0.3)
    q = system.retract(state.q, state.v.at[-1].set(-0.7))
    state = state.replace(q=q, v=v)

    def accelerations(arms, u):
        changed = system.with_params({"tendon": {"coefficients": arms}})
        found = jc.forward_dynamics(changed, state, u[None], jc.Method(), DT)
        length = jc.coordinate(changed, state, "tendon")
        rate = jc.coordinate_rate(changed, state, "tendon")
        spring = -30 * (length - jnp.clip(length, 0.05, 0.1)) - 0.4 * rate
        plainly = state.replace(turns=())
        given = plain, plainly, arms * (2 * u + spring), jc.Method(), DT
        return found.acceleration, jc.forward_dynamics(*given).acceleration

    given = jnp.array([0.3, -0.2], dtype), jnp.asarray(1.5, dtype)
    both = jax.jit(lambda *x: (accelerations(*x), jax.jacfwd(accelerations)(*x)))
    (got, expected), slopes = both(*given)
    tolerance = 1e-9 if dtype == jnp.float64 else 2e-4
    np.testing.assert_allclose(got, expected, atol=tolerance * 50)
    np.testing.assert_allclose(*slopes, atol=tolerance * 500)
    energy = jc.energy(system, state).potential
    energy -= jc.energy(plain, state.replace(turns=())).potential
    length = jc.coordinate(system, state, "tendon")
    np.testing.assert_allclose(energy, 15 * max(length - 0.1, 0) ** 2, rtol=1e-4)


@pytest.mark.parametrize("solver", [None, jc.solvers.GaussSeidel(), jc.solvers.InteriorPoint()])
def test_a_tendon_ends_rubs_and_couples(solver):
    """A falling arm is held by a limit and dry friction of tendons, for all contact solvers."""
    other = jc.joints.Tendon("other", ("hinge 0", "hinge 1"), (1.0, 0.5))
    elements = (
        jc.Limit("end", "tendon", lower=-0.2, upper=0.1),
        jc.contacts.JointFriction("rub", "other", 0.5),
    )
    system, state = arm(None, TENDON, other, *elements)
    method = jc.Method(contact_solver=solver)
    run = jax.jit(jax.vmap(lambda s: jc.rollout(system, method, s, None, 2e-3, 150)[0]))
    state = jc.init(system, method, state.q, state.v)
    end = run(jax.tree.map(lambda x: jnp.stack([x, x]), state))
    assert not np.any(end.status)
    length = jc.coordinate(system, end[0], "tendon")
    np.testing.assert_allclose(length, -0.2, atol=1e-3)


def test_a_coupling_of_tendons_holds():
    other = jc.joints.Tendon("other", ("hinge 0",), (0.5,))
    gear = jc.joints.Gear("gear", "tendon", "other", ratio=2.0)
    system, state = arm(None, TENDON, other, gear)
    end, info = jc.rollout(system, jc.Method(), state, None, 2e-3, 150)
    first, second = (jc.coordinate(system, end, x) for x in ("tendon", "other"))
    assert abs(first) > 0.01
    np.testing.assert_allclose(second, 2 * first, atol=1e-5)


def test_tendons_of_one_kind_share_their_code():
    tendons = [jc.joints.Tendon(f"t{i}", ("hinge 0", "hinge 1"), (1, i)) for i in range(5)]
    springs = [jc.forces.JointSpring(f"s{i}", f"t{i}", 1.0) for i in range(5)]
    system, state = arm(None, *tendons, *springs)
    assert [group.names for group in system.forces] == [("s0", "s1", "s2", "s3", "s4")]
    assert len(system.constraints) == 3
    assert jnp.shape(jc.coordinate(system, state, "t3")) == ()


@pytest.mark.parametrize(
    ("tendon", "match"),
    [
        (jc.joints.Tendon("t", ()), "joints must be a tuple with at least one name, got \\(\\)"),
        (jc.joints.Tendon("t", ("nothing",)), "joint 'nothing' is unknown"),
        (jc.joints.Tendon("t", ("hinge 0",), (1, 2)), "coefficients must have shape \\(1,\\)"),
        (jc.joints.Tendon("t", ("hinge 0",), (1,), ("a", "b")), "coordinate_names must be 1 names"),
        (jc.joints.Tendon("t", ("hinge 0",) * 2), "couples a coordinate with itself"),
    ],
)
def test_wrong_tendons_are_named(tendon, match):
    with pytest.raises(ValueError, match=match):
        arm(None, tendon)


def test_a_dead_band_is_not_reversed():
    with pytest.raises(ValueError, match="lower must not be above upper, got 0.2 and 0.1"):
        arm(None, TENDON, jc.forces.DeadBandSpring("s", "tendon", 1.0, 0.2, 0.1))


def test_a_span_wraps_around_a_cylinder():
    """A screw line between two straight lines, by hand; a straight line where it misses."""
    scene = bodies()
    given = jc.WORLD, jc.WORLD, "a", 0.3, (0, 0, 0), (0, 0, 1)
    ends = {"point_a": (0.5, 0.1, 0.0), "point_b": (-0.5, 0.1, 0.4)}
    scene.add(jc.joints.WrappedSpan("near", *given, **ends))
    ends = {"point_a": (0.5, 0.4, 0.0), "point_b": (-0.5, 0.4, 0.4)}
    scene.add(jc.joints.WrappedSpan("far", *given, **ends))
    params = scene.build()[0].params
    r = np.hypot(0.5, 0.1)
    angle = np.pi - 2 * np.arctan(0.2) - 2 * np.arccos(0.3 / r)
    flat = 2 * np.sqrt(r**2 - 0.09) + 0.3 * angle
    np.testing.assert_allclose(params["near"]["length"], np.hypot(flat, 0.4), rtol=1e-12)
    np.testing.assert_allclose(params["far"]["length"], np.hypot(1, 0.4), rtol=1e-12)
    scene.add(jc.forces.JointSpring("spring", "near", 1.0))
    with pytest.raises(ValueError, match="'near' has several points on one body; add a Tendon"):
        scene.build()


def test_a_wrapped_span_keeps_its_place_on_a_body_whose_center_moves():
    """The length of a span is that of the same points in new principal frames."""
    scene = bodies()
    scene.add(jc.joints.WrappedSpan("span", "a", "b", "c", 0.3, **ENDS))
    scene.add(jc.joints.Tendon("x", ("span",)))
    system, state = scene.build()
    changed = system.with_params({"c": {"center": jnp.array([0.1, 0.2, 0.3])}})
    moved = jc.systems.restate(state, system, changed)
    np.testing.assert_allclose(jc.coordinate(changed, moved, "x"), 0, atol=1e-12)
