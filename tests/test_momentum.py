"""Momentum: compared with its definition, and as a constraint in rows, solvers and motions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc
from jaxcon.constraints.rows import linearize


def cloud(dim, *elements):
    """Four moving bodies, one with its frame off its principal axes, and a particle."""
    scene, random = jc.Scene(dim=dim), np.random.default_rng(dim)
    places = random.normal(size=(5, dim))
    for i, place in enumerate(places[:4]):
        motion = {"position": place, "velocity": random.normal(size=dim)}
        motion["angular_velocity"] = random.normal(size=() if dim == 2 else 3)
        motion["angle" if dim == 2 else "quaternion"] = random.normal(size=() if dim == 2 else 4)
        solid = 1.3 if dim == 2 else (1.0, 1.2, 1.5)
        if i == 1:
            solid = jc.inertia.Inertia(None, solid, center=(0.3, -0.2, 0.1)[:dim])
            solid = dataclasses.replace(solid, mass=2.0)
            scene.add_body("b1", inertia=solid, **motion)
        else:
            scene.add_body(f"b{i}", mass=1.0 + i, inertia=solid, **motion)
    scene.add_particle("bob", mass=0.7, position=places[4], velocity=random.normal(size=dim))
    for i in range(3):
        scene.add(jc.joints.Coincident(f"pin{i}", f"b{i}", f"b{i + 1}", point=places[i]))
    scene.add(jc.Distance("rod", "b3", "bob"))
    for element in elements:
        scene.add(element)
    return scene.build()


def cross(x, y):
    return x[0] * y[1] - x[1] * y[0] if len(x) == 2 else np.cross(x, y)


def by_hand(system, state, names):
    """Returns m, x, ẋ and R I ω of each body."""
    result = []
    for name in names:
        motion = system.principal_motion(name, state.q, state.v)
        p = system.params[name]
        spin = 0.0
        if motion.orientation is not None:
            spin = p["inertia"] * motion.angular_velocity
            spin = spin if system.layout.dim == 2 else motion.rotation @ spin
        result.append((float(p["mass"]), motion.position, motion.velocity, spin))
    return result


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("names", [None, ("b1", "bob"), ("b2",)])
def test_momentum_is_the_sum_over_bodies(dim, names):
    system, state = cloud(dim)
    parts = by_hand(system, state, names or system.layout.bodies)
    mass = sum(m for m, *_ in parts)
    center = sum(m * x for m, x, *_ in parts) / mass
    linear = sum(m * v for m, _, v, _ in parts)
    about = np.arange(1.0, dim + 1)
    for point in (None, about):
        c = center if point is None else point
        expected = sum(m * cross(x - c, v) + s for m, x, v, s in parts)
        found = jc.angular_momentum(system, state, names, about=point)
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(jc.momentum(system, state, names), linear, rtol=1e-12)
    position, velocity = jc.center_of_mass(system, state, names)
    np.testing.assert_allclose(position, center, rtol=1e-12)
    np.testing.assert_allclose(velocity, linear / mass, rtol=1e-12)


def prescribed(dim):
    value = 0.3 if dim == 2 else (0.1, 0.2, 0.3)
    total = jc.joints.AngularMomentum("L", value=value)
    return cloud(dim, total, jc.joints.LinearMomentum("P", ("b0", "b2", "bob")))


@pytest.mark.parametrize("dim", [2, 3])
def test_rows_are_the_derivatives_of_the_momentum(dim):
    system, state = prescribed(dim)
    rows = jax.jit(linearize)(system, state.q, state.v, state.time)

    def amounts(q, v):
        s = dataclasses.replace(state, q=q, v=v)
        angular = jnp.atleast_1d(jc.angular_momentum(system, s))
        return jnp.concatenate([angular, jc.momentum(system, s, ("b0", "b2", "bob"))])

    own = np.concatenate([rows.layout.rows("L"), rows.layout.rows("P")])
    wanted = np.zeros(len(own))
    wanted[: len(own) - dim] = 0.3 if dim == 2 else (0.1, 0.2, 0.3)
    np.testing.assert_allclose(rows.rate[own], amounts(state.q, state.v) - wanted, atol=IDENTITY)
    jacobian = jax.jacfwd(amounts, argnums=1)(state.q, state.v)
    np.testing.assert_allclose(rows.jacobian.dense()[own], jacobian, atol=IDENTITY)
    along = (system.kinematics(state.q, state.v),)
    bias = jax.jvp(lambda q: amounts(q, state.v), (state.q,), along)[1]
    np.testing.assert_allclose(rows.bias[own], bias, atol=IDENTITY)


@pytest.mark.parametrize("dim", [2, 3])
def test_every_solver_meets_rows_that_touch_all_bodies(dim):
    system, state = prescribed(dim)
    solvers = (
        jc.solvers.Dense(),
        jc.solvers.Sparse(run=2),
        jc.solvers.Sparse(order="levels"),
        jc.solvers.Schur(),
    )

    def accelerations(s):
        methods = [jc.Method(stabilizer=jc.stabilizers.Unstabilized(), solver=x) for x in solvers]
        return [jc.forward_dynamics(system, s, None, m, 1e-3) for m in methods]

    reference, *others = jax.jit(accelerations)(state)
    for other in others:
        assert int(other.status) == 0
        np.testing.assert_allclose(other.acceleration, reference.acceleration, atol=1e-9)
        np.testing.assert_allclose(other.multipliers, reference.multipliers, atol=1e-9)


def test_it_holds_against_an_outer_torque():
    """A torque would spin the rod; with L = 0 prescribed, λ balances the torque."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("rod", mass=1.0, inertia=0.5)
    scene.add(jc.forces.ExternalWrench("push", "rod"))
    scene.add(jc.joints.AngularMomentum("still", ("rod",)))
    system, state = scene.build()
    control = jnp.asarray([0.0, 0.0, 3.0])
    info = jc.forward_dynamics(system, state, control, jc.Method(), 1e-3)
    np.testing.assert_allclose(info.acceleration, 0, atol=IDENTITY)
    np.testing.assert_allclose(jc.wrench(info, "still")[2], -3.0, rtol=IDENTITY)
    other = system.with_params({"still": {"value": 0.25}})
    found = jc.assemble(other, state)
    np.testing.assert_allclose(found.v, (0, 0, 0.5), atol=IDENTITY)


MISTAKES = {
    "unknown": (jc.joints.AngularMomentum("L", ("b9",)), "'b9' is unknown"),
    "world": (jc.joints.AngularMomentum("L", ("b0", jc.WORLD)), "'world' is fixed to the world"),
    "no tuple": (jc.joints.LinearMomentum("P", "b0"), "bodies must be a tuple"),
    "shape": (jc.joints.AngularMomentum("L", ("b0",), (1.0, 2.0)), r"value must have shape \(\)"),
    "nan": (jc.joints.LinearMomentum("P", ("b0",), (np.nan, 0.0)), "value must be finite"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named(mistake):
    element, words = MISTAKES[mistake]
    with pytest.raises(ValueError, match=words):
        cloud(2, element)


def test_readers_name_what_they_do_not_know():
    system, state = cloud(2)
    with pytest.raises(ValueError, match="'bib' is unknown"):
        jc.momentum(system, state, ("bib",))
    with pytest.raises(ValueError, match="different names"):
        jc.angular_momentum(system, state, ("b0", "b0"))
    with pytest.raises(ValueError, match=r"about must have shape \(2,\)"):
        jc.angular_momentum(system, state, about=(0.0, 0.0, 0.0))
