"""Laws of ideal constraints: power, energy and momentum.

Motions in the plane and in space agree.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import IDENTITY

import jaxcon as jc
from jaxcon.constraints.rows import linearize

IDEAL = jc.Method(integrator=jc.RK4(), stabilizer=jc.stabilizers.Unstabilized())
both = pytest.mark.parametrize("dim", [2, 3])


@functools.cache
def ideal_scene(dim, topology):
    """Returns names and a scene of all joints that do not depend on time."""
    kinds = ("coincident", "spherical", "distance", "revolute", "prismatic", "universal", "fixed")
    kinds = tuple(kind for kind in kinds if dim in scenes.JOINTS[kind].dims)
    return kinds, scenes.joints_scene(kinds, dim, topology, jnp.dtype("float64"))


@pytest.mark.parametrize("name", scenes.SELECTED)
def test_virtual_power(name):
    """v · (M a − f) = λ · (J v), and both are zero if no constraint depends on time."""
    built = scenes.build(name)
    s = built.off

    @jax.jit
    def solve(s):
        a, multipliers, _ = jc.forward_dynamics(built.system, s, None, jc.Method(), 1e-3)
        jacobian = linearize(built.system, s.q, s.v, s.time).jacobian.dense()
        reaction = built.system.mass(s.q).apply(a) - built.system.force(s.q, s.v, s.time)
        return multipliers, jacobian, reaction

    multipliers, jacobian, reaction = (np.asarray(x) for x in solve(s))
    got, expected = s.v @ reaction, multipliers @ (jacobian @ s.v)
    scale = np.linalg.norm(s.v) * np.linalg.norm(reaction)
    assert abs(got - expected) < 1e-12 * scale


@both
def test_ideal_constraints_do_no_work(dim):
    _, built = ideal_scene(dim, "loop")
    s = built.state

    @jax.jit
    def reaction(s):
        multipliers = jc.forward_dynamics(built.system, s, None, IDEAL, 1e-3).multipliers
        return multipliers, linearize(built.system, s.q, s.v, s.time).jacobian.apply(s.v)

    multipliers, rates = reaction(s)
    power = multipliers @ rates
    assert abs(power) < IDENTITY * (1 + np.linalg.norm(multipliers))


@functools.cache
def marching(dim, topology):
    """Returns a function (system, state, dt) → state after 20 steps without feedback."""
    return jax.jit(lambda system, state, dt: jc.rollout(system, IDEAL, state, None, dt, 20)[0])


@both
def test_energy_drifts_with_the_fourth_power_of_the_step(dim):
    """With a method of fourth order, half the step gives a sixteenth of the energy error."""
    _, built = ideal_scene(dim, "loop")
    system, start = built.system, built.state
    run = functools.partial(marching(dim, "loop"), system)
    coarse = run(start, 2e-3)
    fine = run(run(start, 1e-3), 1e-3)
    before = jc.energy(system, start).total
    drift = [float(abs(jc.energy(system, s).total - before)) for s in (coarse, fine)]
    assert drift[0] < 1e-4
    assert drift[1] < max(drift[0] / 12, 1e-11)


def momentum(system, state, names):
    """Returns linear momentum, and angular momentum about the common center of mass."""
    dim, mass, parts = system.layout.dim, 0.0, []
    for name in names:
        p, motion = system.params[name], system.principal_motion(name, state.q, state.v)
        omega = np.asarray(motion.angular_velocity)
        spin = np.asarray(p["inertia"]) * omega
        spin = spin if dim == 2 else np.asarray(motion.rotation) @ spin
        parts.append(
            (float(p["mass"]), np.asarray(motion.position), np.asarray(motion.velocity), spin)
        )
        mass += float(p["mass"])
    center = sum(m * x for m, x, _, _ in parts) / mass
    linear = sum(m * v for m, _, v, _ in parts)
    angular = sum(_cross(x - center, m * v) + spin for m, x, v, spin in parts)
    return linear, angular


def _cross(x, y):
    return x[0] * y[1] - x[1] * y[0] if len(x) == 2 else np.cross(x, y)


@both
@pytest.mark.parametrize("falling", [False, True])
def test_momentum_of_free_multibodies(dim, falling):
    """Linear momentum is exact to rounding, angular momentum to the accuracy of RK4."""
    kinds, built = ideal_scene(dim, "between")
    gravity = jnp.asarray((0.3, 1.0, -9.81)[-dim:]) * float(falling)
    system = built.system.with_params({"gravity": gravity})
    final = marching(dim, "between")(system, built.state, 1e-3)
    for kind in kinds:
        names = (f"first_{kind}", f"second_{kind}")
        before, after = (momentum(system, s, names) for s in (built.state, final))
        mass = sum(float(system.params[name]["mass"]) for name in names)
        expected = before[0] + 0.02 * mass * np.asarray(gravity)
        np.testing.assert_allclose(after[0], expected, rtol=1e-12, atol=1e-12, err_msg=kind)
        np.testing.assert_allclose(after[1], before[1], rtol=1e-8, atol=1e-8, err_msg=kind)


def lift(x):
    """Maps a point of the plane to the plane y = 0 of space."""
    return np.array([x[0], 0.0, x[1]])


def mechanism(dim, rail):
    """A planar mechanism of crank, link and slider or tie, with a spring, a particle and a push."""
    scene = jc.Scene(dim=dim)
    to = lift if dim == 3 else np.asarray
    normal = {"axis": (0.0, -1.0, 0.0)} if dim == 3 else {}

    def add_body(name, place, angle, speed):
        if dim == 2:
            turn = {"angle": angle, "angular_velocity": speed, "inertia": 0.4}
        else:
            half = angle / 2
            turn = {
                "quaternion": (np.cos(half), 0.0, -np.sin(half), 0.0),
                "inertia": (0.3, 0.4, 0.5),
            }
            turn["angular_velocity"] = (0.0, -speed, 0.0)
        velocity = to(speed * np.array([-place[1], place[0]]))
        scene.add_body(name, mass=1.2, position=to(np.array(place)), velocity=velocity, **turn)

    add_body("crank", (0.4, 0.3), 0.3, 2.0)
    add_body("link", (1.3, 0.7), -0.4, 2.0)
    scene.add_particle("bob", mass=0.6, position=to(np.array([2.0, -0.5])))
    scene.add(jc.Revolute("a", jc.WORLD, "crank", point=to(np.zeros(2)), **normal))
    if rail:
        scene.add(jc.Prismatic("b", "crank", "link", axis=to(np.array([1.0, 0.5]))))
    else:
        scene.add(jc.Revolute("b", "crank", "link", point=to(np.array([0.8, 0.6])), **normal))
    scene.add(jc.Distance("c", "link", "bob", point_a=to(np.array([1.8, 0.2]))))
    scene.add(jc.Spring("s", jc.WORLD, "link", 20.0, 0.5, 0.3))
    scene.add(jc.forces.JointSpring("j", "b", 3.0, 0.2, 0.1))
    return scene.build()


@pytest.mark.parametrize("rail", [False, True], ids=["hinge", "slider"])
@pytest.mark.parametrize("integrator", [jc.SemiImplicitEuler(), jc.RK4()], ids=["euler", "rk4"])
def test_plane_and_space_agree(rail, integrator):
    method = jc.Method(integrator=integrator)
    found = {}
    for dim in (2, 3):
        system, state = mechanism(dim, rail)
        run = jax.jit(lambda s, system=system: jc.rollout(system, method, s, None, 2e-3, 50)[0])
        final = run(state)
        assert final.status == jc.Status.OK
        found[dim] = (system, final)
    for name in ("crank", "link", "bob"):
        flat, spatial = (jc.position(*found[dim], name) for dim in (2, 3))
        np.testing.assert_allclose(spatial, lift(flat), atol=1e-10)
    for question in ("total", "kinetic"):
        flat, spatial = (getattr(jc.energy(*found[dim]), question) for dim in (2, 3))
        np.testing.assert_allclose(spatial, flat, rtol=1e-10)


@both
def test_a_damper_takes_what_the_energy_loses(dim):
    """dE/dt = −c ṙ² for a damper between two centers of mass, for any joint."""
    scene, random = jc.Scene(dim=dim), np.random.default_rng(4)
    for body in ("first", "second"):
        scenes.add_random_body(scene, body, random)
    scene.add(jc.joints.Coincident("joint", "first", "second", point=random.normal(size=dim)))
    scene.add(jc.Spring("damper", "first", "second", stiffness=0.0, damping=0.7, rest_length=0.0))
    system, state = scene.build()
    state = dataclasses.replace(state, v=scenes.allowed(system, state, state.v))
    a = jc.forward_dynamics(system, state, None, IDEAL, 1e-3).acceleration

    def energy(step):
        q = system.retract(state.q, step * state.v)
        return system.energy(q, state.v + step * a, state.time).total

    one, two = (system.principal_motion(n, state.q, state.v) for n in ("first", "second"))
    gap, speed = two.position - one.position, two.velocity - one.velocity
    stretching = gap @ speed / np.linalg.norm(gap)
    rate = jax.jit(jax.grad(energy))(0.0)
    np.testing.assert_allclose(rate, -0.7 * stretching**2, rtol=1e-9)
