"""The regularized law: u + C λ in place of u, with C as a share of the inverse mass of a row."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE

import jaxcon as jc
from benchmarks import laws as study
from jaxcon.contact.limits import AT_ONCE, RECOVERED

H = 2e-3
NEARLY_RIGID = 1 / (4 * np.pi**2)
SOLVERS = {
    "Newton": lambda share: jc.solvers.Newton(tolerance=1e-11, regularization=share),
    "InteriorPoint": lambda share: study.OneProblem(regularization=share),
    "GaussSeidel": lambda share: jc.solvers.GaussSeidel(sweeps=400, regularization=share),
}
solvers = pytest.mark.parametrize("name", SOLVERS)


@solvers
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_pushed_particle_sinks_and_creeps(name, dim, dtype):
    """Its normal force m G and friction f give the velocities ρ h G and 0.04 ρ h f/m.

    The former balances the speed at which the penetration closes: in one step if it is as small
    as rounding, otherwise by a fifth in a step.
    """
    up, side = ((0.0, 1.0), (1.0, 0.0)) if dim == 2 else ((0.0, 0.0, 1.0), (0.6, 0.8, 0.0))
    mass, push, share = 2.0, 4.0, 0.02
    scene = jc.Scene(dim=dim, dtype=dtype, gravity=tuple(-9.81 * x for x in up))
    scene.add_particle("puck", mass=mass)
    scene.add(jc.PlaneContact("floor", jc.WORLD, "puck", friction=0.5))
    scene.add(jc.forces.Force("push", "puck", force=tuple(push * x for x in side)))
    system, state = scene.build()
    method = jc.Method(contact_solver=SOLVERS[name](share))
    start = jc.init(system, method, state.q, state.v)
    final, _ = jax.jit(lambda s: jc.rollout(system, method, s, None, H, 500))(start)
    assert final.status == 0
    close = 1e-3 if dtype == jnp.float32 else 1e-6
    q, v = np.asarray(final.q), np.asarray(final.v)
    speed = share * H * 9.81
    closing = speed if speed < AT_ONCE[jnp.finfo(dtype).bits] else speed / RECOVERED
    np.testing.assert_allclose(q @ up, -H * closing, rtol=close)
    np.testing.assert_allclose(v @ side, 0.04 * share * H * push / mass, rtol=close)


def leg(friction):
    """A trunk of 50 kg on a rail, on a shank of 0.5 kg whose foot stands on a floor."""
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81))
    scene.add_body("trunk", mass=50.0, inertia=1.0, position=(0.0, 0.75))
    rail = {"point": (0.0, 0.75), "axis": (0.0, 1.0)}
    scene.add(jc.Prismatic("rail", jc.WORLD, "trunk", **rail))
    scene.add_body("shank", mass=0.5, inertia=0.01, position=(0.0, 0.25))
    scene.add(jc.Revolute("knee", "trunk", "shank", point=(0.0, 0.5)))
    foot = {"center": (0.0, 0.0), "friction": friction}
    scene.add(jc.PlaneContact("foot", jc.WORLD, "shank", **foot))
    return scene.build()


@solvers
@pytest.mark.parametrize("friction", [0.0, 0.8])
def test_a_leg_carries_a_trunk(name, friction):
    """Normal rows have their own inverse mass, not the larger one of the foot sideways."""
    system, state = leg(friction)
    method = jc.Method(contact_solver=SOLVERS[name](NEARLY_RIGID))
    start = jc.init(system, method, state.q, state.v)
    final, _ = jax.jit(lambda s: jc.rollout(system, method, s, None, H, 500))(start)
    assert final.status == 0
    # a penetration closes by a fifth in a step
    expected = NEARLY_RIGID * H * 9.81 * H / RECOVERED
    sunk = 0.75 - jc.position(system, final, "trunk")[1]
    np.testing.assert_allclose(sunk, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("solver", "bounce"),
    [
        (jc.solvers.Newton, 1.0),
        (jc.solvers.GaussSeidel, 1.0),
        (jc.solvers.InteriorPoint, 1.0),
        (jc.solvers.InteriorPoint, 0.0),
    ],
)
def test_impacts_obey_the_exact_laws(solver, bounce):
    """A particle rebounds as fast as it comes, and one that lands stops if landings are impacts."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    scene.add_particle("puck", mass=2.0, position=(0.0, 0.0, 0.0315), velocity=(0.0, 0.0, -10.0))
    elastic = {"restitution": bounce} if bounce else {}
    scene.add(jc.PlaneContact("floor", jc.WORLD, "puck", **elastic))
    system, state = scene.build()
    method = jc.Method(contact_solver=solver(regularization=NEARLY_RIGID))
    start = jc.init(system, method, state.q, state.v)
    final, _ = jax.jit(lambda s: jc.rollout(system, method, s, None, H, 10))(start)
    np.testing.assert_allclose(final.v[2], 10 * bounce, atol=1e-9)


@solvers
def test_a_world_with_a_bad_regularization_stops_alone(name):
    system, state = leg(0.8)

    def run(share):
        solver = dataclasses.replace(SOLVERS[name](0.0), regularization=share)
        method = jc.Method(contact_solver=solver)
        start = jc.init(system, method, state.q, state.v)
        return jc.rollout(system, method, start, None, H, 5)[0]

    shares = jnp.asarray([0.02, jnp.nan, jnp.inf, -0.1, 0.0])
    status = jax.jit(jax.vmap(run))(shares).status
    np.testing.assert_array_equal(status, [0, *[jc.Status.NON_FINITE] * 3, 0])


def test_friction_in_a_joint_creeps_as_friction_of_contacts_does():
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81))
    scene.add_body("arm", mass=1.0, inertia=0.05, position=(0.5, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)))
    scene.add(jc.contacts.JointFriction("rub", "hinge", max_force=10.0))
    system, state = scene.build()
    method = jc.Method(contact_solver=SOLVERS["Newton"](0.02))
    start = jc.init(system, method, state.q, state.v)
    final, _ = jax.jit(lambda s: jc.rollout(system, method, s, None, H, 100))(start)
    creep = 0.04 * 0.02 * H * (9.81 * 0.5) / 0.3
    np.testing.assert_allclose(-final.v[2], creep, rtol=1e-3)


def stepped(name, scene, share):
    return study.step_of(scene, jnp.float64, SOLVERS[name](share), worlds=50, seed=3)


@pytest.mark.parametrize("scene", ["box", "chain", "column"])
def test_all_solvers_solve_the_same_laws(scene):
    """Also sweeps, which do not hold the column by the exact laws."""
    expected, missed = stepped("InteriorPoint", scene, NEARLY_RIGID)
    assert np.max(missed) < 1e-10
    for name in ("Newton", "GaussSeidel"):
        found, missed = stepped(name, scene, NEARLY_RIGID)
        settled = np.asarray(missed) < 1e-7
        assert np.mean(settled) > (0.95 if name == "Newton" else 0.75)
        np.testing.assert_allclose(found[settled], expected[settled], atol=1e-5)


def test_the_motion_tends_to_that_of_the_exact_laws():
    exact, _ = stepped("InteriorPoint", "chain", None)
    shares = (1e-2, 1e-4, 1e-6)
    off = [np.median(np.abs(stepped("Newton", "chain", x)[0] - exact).max(1)) for x in shares]
    assert off[0] > 1e-4
    np.testing.assert_allclose(np.divide(off[1:], off[:-1]), 1e-2, rtol=0.5)


@pytest.mark.parametrize("name", ["Newton", "InteriorPoint"])
@pytest.mark.parametrize("slides", [True, False])
def test_gradients_are_differences(name, slides):
    """A rollout of a puck is differentiated by its speed, its friction and the regularization.

    The puck slides or creeps. The inverse mass of its rows is constant.
    """
    scene = jc.Scene(dim=3)
    scene.add_particle("puck", mass=2.0, position=(0.0, 0.0, -1e-5))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "puck", friction=0.4))
    scene.add(jc.forces.Force("push", "puck", force=(3.0, 1.0, 0.0)))
    system, state = scene.build()

    def loss(x):
        here = system.with_params({"floor": {"friction": x[1]}})
        method = jc.Method(contact_solver=SOLVERS[name](x[2]))
        start = jc.init(here, method, state.q, state.v)
        start = dataclasses.replace(start, v=start.v.at[0].set(x[0]))
        final, _ = jc.rollout(here, method, start, None, H, 30, record=lambda s, i: None)
        return 10 * final.q[0] ** 2 + final.q[1] + 10 * final.q[2]

    point = jnp.asarray([0.7 if slides else 0.0, 0.4, 0.02])
    value, gradient = jax.jit(loss), jax.jit(jax.grad(loss))(point)
    for i in range(3):
        change = jnp.zeros(3).at[i].set(1e-6)
        difference = (value(point + change) - value(point - change)) / 2e-6
        np.testing.assert_allclose(gradient[i], difference, rtol=DIFFERENCE, atol=1e-10)
    assert (abs(gradient[1]) > 1e-3) == slides
    assert abs(gradient[2]) > 1e-5


@pytest.mark.parametrize("part", ["Newton", "InteriorPoint", "GaussSeidel"])
def test_a_negative_regularization_is_refused(part):
    with pytest.raises(ValueError, match=rf"{part}.*regularization"):
        getattr(jc.solvers, part)(regularization=-0.1)
