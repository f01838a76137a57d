"""Joint limits, dry friction, rate motors and rate limits, compared with hand calculations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE

import jaxcon as jc

both = pytest.mark.parametrize("dim", [2, 3])
solvers = pytest.mark.parametrize(
    "solver", [jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel()], ids=lambda x: type(x).__name__
)
H = 1e-3


def slider(dim, *elements, dtype=None, gravity=0.0, velocity=0.0):
    """A slider of 2 kg on a rail along the first axis, with gravity along the rail."""
    rest = (0.0,) * (dim - 1)
    scene = jc.Scene(dim=dim, gravity=(gravity, *rest), dtype=dtype)
    inertia = 1.0 if dim == 2 else (1.0, 1.0, 1.0)
    scene.add_body("slide", mass=2.0, inertia=inertia, velocity=(velocity, *rest))
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, *rest)))
    for element in elements:
        scene.add(element)
    return scene.build()


def run(system, state, steps, control=None, method=None, h=H):
    """Returns position, velocity, reactions and status of each step."""
    method = jc.Method() if method is None else method
    state = jc.init(system, method, state.q, state.v)
    h = jnp.asarray(h, state.q.dtype)
    controls = None if control is None else jnp.tile(control, (steps, 1))

    def record(s, i):
        return s.q[0], s.v[0], i.reactions, s.status

    rolled = jax.jit(lambda s: jc.rollout(system, method, s, controls, h, steps, record=record)[1])
    return rolled(state)


@both
@solvers
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_a_slider_stops_at_its_end(dim, solver, dtype):
    """The slider falls by 4.905 t², reaches 0.1 m and stays, held by the force m g."""
    stop = jc.Limit("end", "rail", upper=0.1)
    system, state = slider(dim, stop, dtype=dtype, gravity=9.81)
    x, v, reactions, status = run(system, state, 300, method=jc.Method(contact_solver=solver))
    tight = 1e-12 if dtype == jnp.float64 else 1e-6
    assert np.all(status == 0)
    assert float(x.max()) < 0.1 + tight
    np.testing.assert_allclose(x[-1], 0.1, atol=tight)
    np.testing.assert_allclose(v[-1], 0.0, atol=100 * tight)
    np.testing.assert_allclose(reactions["end"][-1], [2 * 9.81], rtol=1e3 * tight)


@both
def test_between_its_ends_nothing_acts(dim):
    system, state = slider(dim, jc.Limit("ends", "rail", -1.0, 1.0), velocity=0.5)
    x, _, reactions, _ = run(system, state, 100)
    np.testing.assert_allclose(x[-1], 0.05, rtol=1e-12)
    np.testing.assert_allclose(reactions["ends"], 0.0, atol=1e-12)


@both
@pytest.mark.parametrize("e", [0.0, 0.5, 1.0])
def test_restitution(dim, e):
    """The slider hits the stop at 0.1 m after 0.2 s, and comes back with speed e v."""
    system, state = slider(dim, jc.Limit("end", "rail", upper=0.1, restitution=e), velocity=0.5)
    x, v, _, _ = run(system, state, 350)
    np.testing.assert_allclose(v[-1], -0.5 * e, atol=1e-12)
    np.testing.assert_allclose(x[-1], 0.1 - 0.5 * e * 0.15, atol=1e-9)


@both
def test_a_soft_end_is_a_spring_and_a_damper(dim):
    """At rest the slider is m g/k beyond the stop."""
    stop = jc.Limit("end", "rail", upper=0.1, stiffness=1e4, damping=100.0)
    system, state = slider(dim, stop, gravity=9.81)
    x, _, reactions, _ = run(system, state, 3000)
    np.testing.assert_allclose(x[-1], 0.1 + 2 * 9.81 / 1e4, rtol=1e-6)
    np.testing.assert_allclose(reactions["end"][-1], [2 * 9.81], rtol=1e-4)


@both
@solvers
def test_dry_friction_brakes_and_holds(dim, solver):
    """Braked by τ/m, the slider stops after v m/τ; a push of less than τ does not move it."""
    system, state = slider(
        dim, jc.contacts.JointFriction("rub", "rail", max_force=3.0), velocity=0.3
    )
    _, v, _, _ = run(system, state, 300, method=jc.Method(contact_solver=solver))
    np.testing.assert_allclose(v[99], 0.3 - 1.5 * 0.1, rtol=1e-9)
    np.testing.assert_allclose(v[-1], 0.0, atol=1e-12)
    system, state = slider(
        dim, jc.contacts.JointFriction("rub", "rail", max_force=3.0), gravity=1.0
    )
    _, v, reactions, _ = run(system, state, 50, method=jc.Method(contact_solver=solver))
    np.testing.assert_allclose(v[-1], 0.0, atol=1e-12)
    np.testing.assert_allclose(reactions["rub"][-1], [-2.0], rtol=1e-9)


@both
def test_a_rate_motor_saturates(dim):
    """The motor accelerates the slider by τ/m up to the target rate, and no further."""
    system, state = slider(dim, jc.contacts.RateMotor("motor", "rail", max_force=4.0))
    _, v, reactions, _ = run(system, state, 400, control=jnp.asarray([0.5]))
    np.testing.assert_allclose(v[99], 0.2, rtol=1e-9)
    np.testing.assert_allclose(v[-1], 0.5, rtol=1e-9)
    np.testing.assert_allclose(reactions["motor"][0], [4.0], rtol=1e-9)


@both
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_rate_limit(dim, sign):
    system, state = slider(
        dim, jc.contacts.RateLimit("slow", "rail", rate=0.2), gravity=9.81 * sign
    )
    _, v, _, _ = run(system, state, 100)
    np.testing.assert_allclose(v[-1], 0.2 * sign, rtol=1e-9)
    assert np.abs(v).max() < 0.2 + 1e-12


@pytest.mark.parametrize("integrator", [jc.integrators.Heun(), jc.RK4()], ids=["Heun", "RK4"])
def test_runge_kutta_beside_a_stop(integrator):
    """The step is split at the impact; a force over the whole step would pass the stop."""
    for h in (2e-3, 1e-3):
        system, state = slider(2, jc.Limit("end", "rail", upper=0.1), gravity=9.81)
        x, _, _, _ = run(system, state, 400, method=jc.Method(integrator=integrator), h=h)
        assert float(x.max()) - 0.1 < 1e-9
        np.testing.assert_allclose(x[-1], 0.1, atol=1e-5)


def test_what_has_passed_comes_back_slowly():
    """A slider 0.5 m beyond the stop comes back at the recovery speed and leaves no faster."""
    system, state = slider(3, jc.Limit("end", "rail", upper=-0.5, recovery=0.2))
    x, v, _, status = run(system, state, 4000)
    assert np.all(status == 0)
    assert np.abs(v).max() < 0.2 + 1e-9
    np.testing.assert_allclose(x[999], -0.2, rtol=1e-6)
    assert x[-1] < -0.5 + 1e-9


def swinging(dim):
    """A chain that swings into its stops: two links in the plane, one in space."""
    scene = jc.Scene(dim=dim)
    inertia = 0.08 if dim == 2 else (0.01, 0.08, 0.08)
    rest = (0.0,) * (dim - 1)
    for i in range(4 - dim):
        before = jc.WORLD if i == 0 else f"{i - 1}"
        scene.add_body(f"{i}", mass=1.0, inertia=inertia, position=(0.5 + i, *rest))
        axis = {} if dim == 2 else {"axis": (0.0, -1.0, 0.0)}
        scene.add(jc.Revolute(f"hinge {i}", before, f"{i}", point=(float(i), *rest), **axis))
        scene.add(jc.Limit(f"stop {i}", f"hinge {i}", -0.3, 0.3, stiffness=3e3, damping=30.0))
    return scene.build()


@both
@solvers
def test_gradients_by_the_place_of_a_stop(dim, solver):
    """Compares reverse mode, forward mode along one direction, and differences."""
    system, state = swinging(dim)
    method = jc.Method(contact_solver=solver)
    state = jc.init(system, method, state.q, state.v)

    def loss(x):
        changes = {"stop 0": {"lower": -x[0], "stiffness": 1e3 * x[2]}, "0": {"mass": x[1]}}
        changed = system.with_params(changes)
        return jnp.sum((jc.rollout(changed, method, state, None, 4e-3, 90)[0].q + 0.3) ** 2)

    at, along = jnp.asarray([0.3, 1.1, 3.0]), jnp.asarray([0.6, -0.7, 0.3])
    start, found = jax.jit(jax.value_and_grad(loss))(at)
    moved = jax.jit(lambda s: jax.jvp(loss, (at + s * along,), (along,)))
    value, forward = moved(0.0)
    step = 1e-5
    difference = (moved(step)[0] - moved(-step)[0]) / (2 * step)
    assert np.abs(found).min() > 1e-5
    np.testing.assert_allclose(value, start, rtol=1e-12)
    np.testing.assert_allclose(forward, difference, rtol=10 * DIFFERENCE)
    np.testing.assert_allclose(found @ along, forward, rtol=1e-9)


def test_smoothing_lets_a_stop_be_felt_before_it_is_reached():
    """The derivative by an unreached stop is zero without smoothing, and positive with it."""

    system, state = slider(2, jc.Limit("end", "rail", upper=0.1), velocity=0.5)

    @jax.jit
    def slope(smoothing):
        method = jc.Method(contact_solver=jc.solvers.InteriorPoint(smoothing=smoothing))

        def end(upper):
            changed = system.with_params({"end": {"upper": upper}})
            return jc.rollout(changed, method, state, None, H, 100)[0].q[0]

        return jax.value_and_grad(end)(jnp.asarray(0.06))

    (sharp_end, sharp), (end, little), (_, much) = slope(None), slope(0.3), slope(3.0)
    assert sharp == 0.0
    assert 0.0 < little < much
    assert sharp_end == end


def test_worlds_are_apart():
    """A batch equals single runs, a failed world affects no other, and float32 is enough."""
    stop = jc.Limit("end", "rail", upper=0.1, restitution=0.3)
    system, state = slider(
        3, stop, jc.contacts.JointFriction("rub", "rail", 1.0), dtype=jnp.float32
    )
    method = jc.Method()

    def end(speed):
        start = dataclasses.replace(state, v=state.v.at[0].set(speed))
        final, _ = jc.rollout(system, method, start, None, jnp.float32(H), 400)
        return final.q[0], final.status

    speeds = jnp.asarray([0.5, 1.0, jnp.nan, 2.0], jnp.float32)
    x, status = jax.jit(jax.vmap(end))(speeds)
    alone = [jax.jit(end)(v)[0] for v in speeds[:2]]
    np.testing.assert_allclose(x[:2], alone, rtol=1e-5)
    np.testing.assert_array_equal(np.asarray(status) != 0, [False, False, True, False])


@pytest.mark.parametrize(
    ("element", "match"),
    [
        (jc.Limit("s", "rail"), "Limit 's': give lower, upper or both"),
        (jc.Limit("s", "rail", 1.0, -1.0), "lower must be below upper"),
        (jc.Limit("s", "rail", 0.0, 1.0, restitution=1.5), "restitution must lie in 0 to 1"),
        (jc.Limit("s", "rail", 0.0, 1.0, restitution=-0.5), "restitution"),
        (jc.Limit("s", "rail", 0.0, 1.0, stiffness=-1.0), "stiffness"),
        (
            jc.Limit("s", "rail", 0.0, 1.0, restitution=0.5, stiffness=10.0),
            "give one or the other",
        ),
        (jc.Limit("s", "rail", 0.0, 1.0, damping=1.0), "damping is of a soft stop"),
        (jc.Limit("s", "rail", 0.0, 0.0), "lower must be below upper, got 0.0 and 0.0"),
        (jc.Limit("s", "door", 0.0, 1.0), "joint 'door' is unknown"),
        (jc.contacts.JointFriction("f", "rail", -1.0), "max_force"),
        (jc.contacts.RateLimit("r", "rail", -1.0), "rate"),
        (jc.contacts.RateMotor("m", "rail", -1.0), "max_force"),
    ],
)
def test_bad_numbers_are_refused(element, match):
    with pytest.raises(ValueError, match=match):
        slider(2, element)


def test_parameters_go_back_into_a_system_with_one_stop():
    """A missing stop has an infinite limit, which `with_params` accepts."""
    system, _ = slider(2, jc.Limit("end", "rail", upper=0.1))
    again = system.with_params(system.params)
    assert again.params["end"]["lower"] == -jnp.inf
    with pytest.raises(ValueError, match=r"end\.lower"):
        system.with_params({"end": {"lower": float("nan")}})
    with pytest.raises(ValueError, match="finite"):
        system.with_params({"end": {"recovery": float("inf")}})


@both
def test_a_soft_end_acts_behind_the_gap(dim):
    """Before the stop is reached neither its spring nor its strong damper acts."""
    stop = jc.Limit("end", "rail", upper=0.1, stiffness=1e2, damping=200.0)
    system, state = slider(dim, stop, velocity=1.0)
    x, v, reactions, _ = run(system, state, 99)
    np.testing.assert_allclose(reactions["end"], 0.0, atol=1e-12)
    np.testing.assert_allclose(x[-1], 0.099, rtol=1e-9)


def test_a_step_of_no_length_has_a_derivative():
    system, state = slider(2, jc.Limit("end", "rail", upper=0.1, restitution=0.5), velocity=1.0)

    def end(upper):
        changed = system.with_params({"end": {"upper": upper}})
        return jnp.sum(jc.step(changed, jc.Method(), state, None, 0.0)[0].q)

    assert jax.jit(jax.grad(end))(0.1) == 0.0


@solvers
def test_a_stop_may_be_moved_out_of_reach(solver):
    """A stop at infinity works in one batch with a stop that is reached, and has derivatives."""
    system, state = slider(2, jc.Limit("end", "rail", upper=0.1), velocity=1.0)
    method = jc.Method(contact_solver=solver)
    state = jc.init(system, method, state.q, state.v)

    def motion(upper, h):
        changed = system.with_params({"end": {"upper": upper}})
        new, info = jc.step(changed, method, state, None, h)
        both = jnp.stack([new.q[0], new.v[0]])
        return both, (both, info.reactions["end"][0], new.status)

    uppers = jnp.asarray([jnp.inf, 1e-3])
    slopes = jax.jacrev(motion, (0, 1), has_aux=True)
    found = jax.jit(jax.vmap(slopes, in_axes=(0, None)))(uppers, 2e-3)
    slopes, (motions, forces, status) = found
    np.testing.assert_array_equal(status, 0)
    # sweeps spread the landing over two steps
    swept = isinstance(solver, jc.solvers.GaussSeidel)
    speed, by_upper, by_step = (0.5, 500.0, -250.0) if swept else (0.0, 0.0, 0.0)
    np.testing.assert_allclose(motions, [[2e-3, 1.0], [1e-3, speed]], atol=1e-9)
    np.testing.assert_allclose(forces, [0.0, 1000.0 * (1 - speed)], rtol=1e-9)
    np.testing.assert_allclose(slopes[0], [[0.0, 0.0], [1.0, by_upper]], atol=1e-6)
    np.testing.assert_allclose(slopes[1], [[1.0, 0.0], [0.0, by_step]], atol=1e-6)


def between(start, speed, time, half=0.1):
    """Returns the position of a point that bounces between ±half without loss."""
    way = np.mod(start + half + speed * time, 4 * half)
    return np.where(way <= 2 * half, way, 4 * half - way) - half


FAST = {
    "euler": jc.Method(),
    "rk4": jc.Method(jc.RK4()),
    "events": jc.Method(jc.RK4(), events=jc.integrators.Events()),
}


@both
@pytest.mark.parametrize("name", FAST)
def test_a_rebound_through_the_whole_range_is_a_status(dim, name):
    """The slider stays within the range until a step would leave it; other worlds go on."""
    system, state = slider(dim, jc.Limit("ends", "rail", -0.1, 0.1, restitution=1.0))
    method = FAST[name]
    start = jc.init(system, method, state.q, state.v)

    def rolled(speed):
        began = dataclasses.replace(start, v=start.v.at[0].set(speed))
        record = lambda s, i: (s.q[0], s.status)  # noqa: E731
        end, seen = jc.rollout(system, method, began, None, H, 50, record=record)
        return end, *seen

    speeds = np.asarray([3.0, 199.0, 500.0, -1000.0])
    end, x, status = jax.jit(jax.vmap(rolled))(speeds)
    expected = between(0.0, speeds[:, None], H * np.arange(1, 51))
    expected = np.where(status == 0, expected, 0.0)
    np.testing.assert_allclose(x, expected, atol=1e-9)
    np.testing.assert_array_equal(end.status, [0, 0, *[jc.Status.LOST_IMPACTS] * 2])
    with pytest.raises(jc.SimulationError, match=r"LOST_IMPACTS in 2 of 4 worlds.*rebounds"):
        jc.raise_for_status(end)


@both
@pytest.mark.parametrize(("e", "lost"), [(0.0, False), (0.5, True), (0.1, False)])
def test_slow_rebounds_stay_between_the_stops(dim, e, lost):
    """From 1000 m/s, rebounds at 0 and 100 m/s end within the range; one at 500 m/s would not."""
    stop = jc.Limit("ends", "rail", -0.1, 0.1, restitution=e)
    system, state = slider(dim, stop, velocity=1000.0)
    x, _, _, status = run(system, state, 50)
    assert np.all(np.abs(x) < 0.1 + 1e-9)
    assert np.all(status == (jc.Status.LOST_IMPACTS if lost else 0))


def test_events_follow_as_many_impacts_as_they_may():
    """At 500 m/s a step has at most three impacts."""
    stop = jc.Limit("ends", "rail", -0.1, 0.1, restitution=1.0)
    system, state = slider(2, stop, velocity=500.0)
    method = jc.Method(jc.RK4(), events=jc.integrators.Events(splits=4))
    x, _, _, status = run(system, state, 50, method=method)
    assert np.all(status == 0)
    np.testing.assert_allclose(x, between(0.0, 500.0, H * np.arange(1, 51)), atol=1e-9)
