"""Penalty springs, augmented multipliers and mixtures in place of hard rows."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from derivatives import assert_smooth_and_batched
from tolerances import IDENTITY, ROUND_OFF

import jaxcon as jc
from jaxcon.constraints.rows import linearize
from jaxcon.core.pytree import pytree
from jaxcon.geometry import quaternion
from jaxcon.scenes import four_bar

H = 0.01
MASS = 2.0


def along_x(p, t, _):
    return p.position[:1]


def oscillator():
    """A particle whose constraint x = 0 becomes a spring; no force acts along y."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("a", mass=MASS, position=(0.1, 0.0))
    scene.add(jc.joints.Holonomic(along_x, ("a",), name="spring"))
    return scene.build()


def pendulum(dtype="float64", rod=True):
    """A link on a hinge, with a bob on a rod at its end."""
    scene = jc.Scene(dim=2, dtype=dtype)
    inertia, place = 1 / 12, (0.5, 0.0)
    scene.add_body("arm", mass=1.0, inertia=inertia, position=place, angular_velocity=0.4)
    scene.add_particle("bob", mass=0.5, position=(2.0, 0.0), velocity=(0.0, 0.2))
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)))
    if rod:
        scene.add(jc.Distance("rod", "arm", "bob", point_a=(1.0, 0.0)))
    return scene.build()


def rolled(built, method, steps, dt=H):
    """Returns the last state, and x in every state."""
    system, state = built
    start = jc.init(system, method, state.q, state.v)
    return jc.rollout(system, method, start, None, dt, steps, record=lambda s, _: s.q[0])


def test_a_penalty_has_the_frequency_of_a_spring():
    """The frequency is √(k/m), and λ is the force of the spring (exercise 4)."""
    k = 50.0
    ω = np.sqrt(k / MASS)
    dt = 2 * np.pi / ω / 200
    method = jc.Method(jc.RK4(), jc.stabilizers.Penalty(k, implicit=False))
    built = oscillator()
    _, path = jax.jit(lambda: rolled(built, method, 600, dt))()
    expected = 0.1 * np.cos(ω * dt * np.arange(1, 601))
    np.testing.assert_allclose(path, expected, atol=0.1 * 600 * (ω * dt) ** 5 / 120)
    solution = jc.forward_dynamics(*built, None, method, dt)
    np.testing.assert_allclose(solution.multipliers, [-0.1 * k], rtol=IDENTITY)
    np.testing.assert_allclose(solution.acceleration, [-0.1 * k / MASS, 0.0], rtol=IDENTITY)


def test_an_explicit_spring_is_stable_below_four_masses_by_the_square_of_the_step():
    limit = 4 * MASS / H**2

    @jax.jit
    @jax.vmap
    def largest(share):
        method = jc.Method(stabilizer=jc.stabilizers.Penalty(share * limit, implicit=False))
        return jnp.max(jnp.abs(rolled(oscillator(), method, 3000)[1]))

    below, above = largest(jnp.asarray([0.999, 1.001]))
    assert below < 4.0  # 0.1 at first; here the orbit is a long ellipse
    assert above > 1e7  # it grows until its velocity makes the step fail


@pytest.mark.parametrize(("share", "warned"), [(0.999, False), (1.001, True)])
def test_beyond_it_a_warning_says_so(share, warned, recwarn):
    system, state = oscillator()
    method = jc.Method(
        stabilizer=jc.stabilizers.Penalty({"spr*": share * 4 * MASS / H**2}, implicit=False)
    )
    jax.jit(lambda: jc.rollout(system, method, state, None, H, 1)).trace()
    text = [str(warning.message) for warning in recwarn]
    assert len(text) == warned
    assert all("explicit spring of 'spring'" in x and "80000" in x for x in text)


@pytest.fixture(scope="module")
def implicit():
    """Returns final states by (stiffness, damping), in a batch, and that of hard rows."""
    built = pendulum()

    @jax.jit
    @jax.vmap
    def soft(k, d):
        return rolled(built, jc.Method(stabilizer=jc.stabilizers.Penalty(k, d)), 300)

    hard = jax.jit(lambda: rolled(built, jc.Method(), 300))()
    return soft, hard


def test_an_implicit_spring_of_any_stiffness_is_stable_and_in_the_limit_hard(implicit):
    soft, (hard, _) = implicit
    k = 10.0 ** np.arange(0, 13, 2)
    final, path = soft(jnp.asarray(k), jnp.zeros(len(k)))
    assert np.all(np.asarray(final.status) == jc.Status.OK)
    assert np.max(np.abs(path)) < 30  # with the weakest spring the bob falls ½ g t² = 44 m
    gap = np.max(np.abs(np.asarray(final.q) - np.asarray(hard.q)), axis=-1)
    assert gap[-1] < 1e-8
    np.testing.assert_allclose(gap[4] / gap[5], 100, rtol=0.01)  # 1e8, 1e10: order one in 1/k


def test_no_stiffness_is_no_constraint(implicit):
    soft, _ = implicit
    zero = jnp.zeros(1)
    final, _ = soft(zero, zero)
    # no force acts between the bodies: y⁺ = y + h v⁺ with v⁺ = v − h g
    fall = -9.81 * H**2 * 300 * 301 / 2
    arm, bob = (np.asarray(final.q[0])[pendulum()[0].layout.v(name)] for name in ("arm", "bob"))
    np.testing.assert_allclose(arm, [0.5, fall, 0.4 * 3.0], atol=1e-9)
    np.testing.assert_allclose(bob, [2.0, fall + 0.2 * 3.0], atol=1e-9)


@pytest.mark.parametrize("which", [0, 1])
def test_the_gradient_where_there_is_no_spring_is_that_of_the_spring(which):
    built = pendulum()

    def value(k, d):
        final, _ = rolled(built, jc.Method(stabilizer=jc.stabilizers.Penalty(k, d)), 20)
        return jnp.sum(final.q * jnp.arange(1.0, 6.0))

    zero = jnp.zeros(())
    slope = jax.jit(jax.grad(value, which))(zero, zero)
    run = jax.jit(value)
    step = 1e-2  # one-sided differences, as negative stiffness is refused
    args = [[(i * step if j == which else 0.0) for j in (0, 1)] for i in range(5)]
    at = [float(run(*map(jnp.asarray, x))) for x in args]
    expected = np.dot([-25, 48, -36, 16, -3], at) / (12 * step)
    assert abs(expected) > 1e-3
    assert float(slope) == pytest.approx(expected, rel=1e-6)


def test_a_time_and_a_damping_ratio_stand_for_the_mass_of_the_row():
    built = oscillator()
    for implicit in (True, False):
        by_time = jc.stabilizers.Penalty.from_time({"spring": 0.2}, 0.3, implicit=implicit)
        k, d = MASS / 0.2**2, 2 * 0.3 * MASS / 0.2
        known = jc.stabilizers.Penalty({"spring": k}, {"spring": d}, implicit=implicit)
        ends = [
            jax.jit(lambda x=x: rolled(built, jc.Method(stabilizer=x), 50))()
            for x in (by_time, known)
        ]
        np.testing.assert_allclose(ends[0][1], ends[1][1], rtol=1e-12)


@pytest.mark.parametrize("implicit", [True, False])
def test_what_is_not_named_stays_hard(implicit):
    system, state = built = pendulum()
    soft = jc.stabilizers.Penalty(
        {"r*": 1e3}, {"rod": 5.0}, implicit=implicit, others=jc.stabilizers.PID(integral=10.0)
    )
    method = jc.Method(stabilizer=soft)
    final, _ = jax.jit(lambda: rolled(built, method, 200))()
    violation = jc.violation(system, final)
    assert violation["hinge"] < 2e-3
    assert violation["rod"] > 2e-3
    solution = jc.forward_dynamics(system, final, None, method, H)
    rows = linearize(system, final.q, final.v, final.time)
    own = rows.layout.rows("rod")
    if not implicit:
        expected = -1e3 * rows.residual - 5.0 * rows.rate
        np.testing.assert_allclose(solution.multipliers[own], expected[own], rtol=1e-9)
    # the reported forces cause the motion
    force = system.force(final.q, final.v, final.time, None)
    force = force + rows.jacobian.transpose(solution.multipliers)
    np.testing.assert_allclose(system.mass(final.q).apply(solution.acceleration), force, atol=1e-9)
    assert state.memory == ()


def test_rotors_and_rows_of_velocities():
    scene = jc.Scene(dim=2)
    scene.add_body("arm", mass=1.0, inertia=1 / 12, position=(0.5, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)))
    scene.add(jc.joints.Armature("rotor", "hinge", 0.3))
    scene.add(jc.joints.KnifeEdge("edge", jc.WORLD, "arm", edge=(1.0, 0.0), center=(0.5, 0.0)))
    system, state = scene.build()
    rows = linearize(system, state.q, state.v, state.time)
    penalty = jc.stabilizers.Penalty(1e4)
    soft = penalty.soft(rows.layout)
    assert not soft[rows.layout.rows("rotor")].any()
    assert soft[rows.layout.rows("hinge")].all()
    stiffness, _ = penalty.constants(rows)
    np.testing.assert_array_equal(stiffness != 0, rows.layout.holonomic)
    for law in (
        penalty,
        jc.stabilizers.Penalty(1e4, 1.0, implicit=False),
        jc.stabilizers.AugmentedLagrangian(),
    ):
        method = jc.Method(stabilizer=law)
        start = jc.init(system, method, state.q, state.v)
        a, λ, _ = jc.forward_dynamics(system, start, None, method, H)
        turning = rows.jacobian.apply(a)[rows.layout.rows("rotor")]
        np.testing.assert_allclose(λ[rows.layout.rows("rotor")], -0.3 * turning, rtol=1e-9)


def test_multipliers_come_nearer_by_the_stiffness_in_each_round():
    """With one row, the error of λ after k rounds from 0 is (1 + stiffness)⁻ᵏ of the hard λ."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.5, position=(0.6, -0.8), velocity=(0.8, 0.6))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    hard = jc.forward_dynamics(system, state, None, jc.Method(), H).multipliers
    for rounds in (1, 3):
        method = jc.Method(stabilizer=jc.stabilizers.AugmentedLagrangian(9.0, iterations=rounds))
        start = jc.init(system, method, state.q, state.v)
        λ = jc.forward_dynamics(system, start, None, method, H).multipliers
        np.testing.assert_allclose(λ, hard * (1 - 10.0**-rounds), rtol=1e-12)
        new, info = jc.step(system, method, start, None, H)
        np.testing.assert_allclose(new.memory.stabilizer.multipliers, info.multipliers)


def test_multipliers_hold_a_closed_loop():
    built = four_bar()
    ends = []
    for law in (jc.Baumgarte(), jc.stabilizers.AugmentedLagrangian(100.0, iterations=2)):
        final, _ = jax.jit(lambda law=law: rolled(built, jc.Method(stabilizer=law), 400, 1e-3))()
        assert final.status == jc.Status.OK
        assert jc.violation(built[0], final).worst < 1e-4
        ends.append(final.q)
    np.testing.assert_allclose(*ends, atol=1e-4)


def boxes_on_hinges(links, dtype):
    """A level chain of boxes in space, at rest, with hinges oblique to gravity."""
    turned = np.asarray(quaternion.matrix(quaternion.exp(jnp.asarray((0.5, -0.3, 0.8)))))
    attitude = np.asarray(quaternion.from_matrix(jnp.asarray(turned)))
    scene, before = jc.Scene(dim=3, dtype=dtype), jc.WORLD
    solid = jc.inertia.box(1.0, (0.5, 0.2, 0.05))
    for i in range(links):
        link, middle = f"link{i}", turned @ (0.5 * i + 0.25, 0.0, 0.0)
        scene.add_body(link, inertia=solid, position=middle, quaternion=attitude)
        point = turned @ (0.5 * i, 0.0, 0.0)
        scene.add(jc.Revolute(f"hinge{i}", before, link, point=point, axis=turned[:, 1]))
        before = link
    return scene.build()


def worst_of(built, law, seconds, dt):
    """Returns the largest violation of a motion [m], and its final status."""
    system, state = built
    method = jc.Method(stabilizer=law)
    start = jc.init(system, method, state.q, state.v)

    def violation(state, _):
        return jc.violation(system, state).worst

    steps = round(seconds / dt)
    final, path = jc.rollout(system, method, start, None, dt, steps, record=violation)
    return jnp.max(path), final.status


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize(("dt", "bound"), [(1e-3, 1e-4), (1e-2, 2e-2)])
def test_multipliers_hold_a_chain_with_default_numbers(dt, bound, dtype):
    built = boxes_on_hinges(4, dtype)
    worst, status = jax.jit(
        lambda: worst_of(built, jc.stabilizers.AugmentedLagrangian(), 3.0, dt)
    )()
    assert status == jc.Status.OK
    assert worst < bound


@pytest.mark.parametrize("rounds", [1, 2, 4])
def test_multipliers_hold_a_chain_whatever_the_stiffness(rounds):
    """From soft to hard rows the violation decreases with the stiffness, then levels off."""
    built, dt = boxes_on_hinges(4, jnp.float64), 1e-3

    def worst(stiffness):
        law = jc.stabilizers.AugmentedLagrangian(stiffness, iterations=rounds)
        return worst_of(built, law, 1.0, dt)

    found, status = jax.jit(jax.vmap(worst))(10.0 ** jnp.arange(-1.0, 7.0))
    assert np.all(status == jc.Status.OK)
    assert np.all(found[1:5] < 0.8 * found[:4])
    assert np.all(found[5:] < 1.01 * found[4])


def test_more_rounds_leave_less_of_the_error():
    built, dt = boxes_on_hinges(4, jnp.float64), 1e-3
    laws = [jc.stabilizers.AugmentedLagrangian(1.0, iterations=k) for k in (1, 2, 4, 8, 16)]
    found = [float(jax.jit(lambda law=law: worst_of(built, law, 1.0, dt)[0])()) for law in laws]
    assert all(after < 0.8 * before for before, after in zip(found[:-1], found[1:], strict=True))


@pytree
class Homing(jc.stabilizers.Unstabilized):
    """A stabilizer whose correction puts the particle at the origin, at rest."""

    def correct(self, system, solver, before, state, memory, dt):
        code = jnp.zeros_like(state.status)
        return dataclasses.replace(state, q=0 * state.q, v=0 * state.v), code


def mixture(**changes: Any):
    parts = {"small": jc.stabilizers.Penalty(1e3, 10.0), "middle": jc.Baumgarte(5.0, 6.0)}
    return jc.stabilizers.Hybrid(**parts, soft_below=1e-3, **changes)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_a_rod_without_length_leaves_no_multiplier_to_the_next_step(dtype):
    """The row is zero; a multiplier from W alone would push the bodies apart in the next step."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0), dtype=dtype)
    for name, place in (("a", (0.0, 0.0)), ("b", (1.0, 0.0)), ("c", (0.0, 1.0))):
        scene.add_particle(name, mass=1.0, position=place)
    scene.add(jc.Distance("rod", "a", "b"))
    scene.add(jc.Distance("other", jc.WORLD, "c"))
    system, state = scene.build()
    method = jc.Method(stabilizer=jc.stabilizers.AugmentedLagrangian(jnp.asarray(100.0, dtype)))
    q = state.q.at[system.layout.q("b")].set(state.q[system.layout.q("a")])
    v = state.v.at[system.layout.v("b")].set(jnp.asarray([0.01, 0.02], dtype))

    def along(v):
        start = jc.init(system, method, q, v)
        return jc.rollout(system, method, start, None, jnp.asarray(1e-2, dtype), 3)[1]

    path = jax.jit(along)(v)
    assert np.all(path.status == 0)
    assert np.max(np.abs(path.v)) < 100.0, "one metre in a step of 10 ms"
    assert np.max(np.abs(path.v[1])) > 10.0, "once they are apart the rod is felt"


def test_a_mixture_is_each_of_its_laws_where_the_violation_is_its_own():
    system, state = oscillator()
    own = {
        "small": jc.stabilizers.Penalty(1e3, 10.0),
        "middle": jc.Baumgarte(5.0, 6.0),
        "all": mixture(),
    }

    def acceleration(law, x):
        at = dataclasses.replace(state, q=jnp.stack([x, 0.0 * x]))
        method = jc.Method(stabilizer=law)
        return jc.forward_dynamics(system, at, None, method, H).acceleration[0]

    for x, name, rtol in ((1e-5, "small", 1e-6), (1.0, "middle", 1e-6)):
        both = [acceleration(own[key], jnp.asarray(x)) for key in (name, "all")]
        np.testing.assert_allclose(*both, rtol=rtol)
    # at φ = soft_below both laws have weight ½: (1/m + C/2) λ = ½ b₁ + ½ b₂
    s, x = H * (10.0 + H * 1e3), 1e-3
    λ = -(1e3 * x / s + 36 * x) / 2 / (1 / MASS + 0.5 / s)
    got = acceleration(own["all"], jnp.asarray(x))
    np.testing.assert_allclose(got, λ / MASS, rtol=1e-9)
    slope = jax.jit(jax.vmap(jax.grad(lambda x: acceleration(own["all"], x))))
    ends = jnp.asarray([0.0, 1e-3, 3e-3])
    numbers = [
        (acceleration(own["all"], x + 1e-8) - acceleration(own["all"], x - 1e-8)) / 2e-8
        for x in ends
    ]
    np.testing.assert_allclose(slope(ends), numbers, rtol=1e-5)


def test_a_mixture_projects_by_the_share_of_the_violation():
    system, state = oscillator()
    law = mixture(large=Homing(), project_above=0.05)
    for x, share in ((0.05, 0.5), (5.0, 1.0), (5e-4, 0.0)):
        at = dataclasses.replace(state, q=jnp.asarray([x, 0.3]), v=jnp.asarray([2.0, 1.0]))
        new, _ = law.correct(system, jc.solvers.RankSafe(), at, at, (), jnp.asarray(H))
        np.testing.assert_allclose(new.q, (1 - share) * at.q, atol=1e-7)
        np.testing.assert_allclose(new.v, (1 - share) * at.v, atol=1e-7)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("sharpness", [1, 6, 40])
def test_a_sharp_mixture_is_finite_however_far_it_is_off(sharpness, dtype):
    """w = 1/(1 + x⁻²ⁿ) and dw/dx² = n/(xⁿ⁺¹ + x¹⁻ⁿ)² are finite, from x² = 0 to infinity."""
    weight = jax.value_and_grad(mixture(sharpness=sharpness).beyond)
    largest = float(jnp.finfo(dtype).max)
    for square in (0.0, 0.7, 1.0, 1.3, 1e10, largest, np.inf):
        with np.errstate(divide="ignore", over="ignore"):
            x = np.sqrt(np.float64(square))
            w = 1 / (1 + x ** (-2 * sharpness))
            slope = sharpness / (x ** (1 + sharpness) + x ** (1 - sharpness)) ** 2
        found = weight(jnp.asarray(square, dtype))
        rounding = 1e2 * ROUND_OFF[np.dtype(dtype)]
        np.testing.assert_allclose(found, (w, slope), rtol=rounding, atol=1e-30)


STABILIZERS = {
    "implicit": (jc.stabilizers.Penalty, {"stiffness": 3e3, "damping": 7.0}),
    "explicit": (
        lambda **x: jc.stabilizers.Penalty(**x, implicit=False),
        {"stiffness": 3e3, "damping": 7.0},
    ),
    "time": (jc.stabilizers.Penalty.from_time, {"time": 0.03, "damping_ratio": 0.4}),
    "multipliers": (jc.stabilizers.AugmentedLagrangian, {"stiffness": 20.0}),
    "hybrid": (
        lambda stiffness, beta: jc.stabilizers.Hybrid(
            jc.stabilizers.Penalty(stiffness, 5.0),
            jc.stabilizers.PID(beta**2, 2 * beta),
            Homing(),
            1e-3,
            3.0,
        ),
        {"stiffness": 3e3, "beta": 15.0},
    ),
}


@pytest.mark.parametrize("name", STABILIZERS)
def test_gradients_are_differences_and_worlds_are_a_loop(name):
    kind, numbers = STABILIZERS[name]
    built = pendulum()

    def value(x):
        final, _ = rolled(built, jc.Method(stabilizer=kind(**x)), 30)
        return jnp.sum(final.q**3) + jnp.sum(final.v)

    assert_smooth_and_batched(value, numbers, 1e-3, 1e-10)


@pytest.mark.parametrize("name", ["implicit", "explicit", "time", "multipliers"])
def test_a_float32_world_stays_float32(name):
    kind, numbers = STABILIZERS[name]
    system, state = pendulum("float32")
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), numbers)
    law = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), kind(**single))
    solver = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), jc.solvers.RankSafe())
    method = jc.Method(stabilizer=law, solver=solver)
    start = jc.init(system, method, state.q, state.v)

    def after(s, method, dt):
        return jc.rollout(system, method, s, None, dt, 200)[0]

    args = (start, method, jnp.asarray(H / 2, jnp.float32))
    assert "f64" not in str(jax.make_jaxpr(after)(*args))
    final = jax.jit(after)(*args)
    assert final.status == jc.Status.OK
    assert jc.violation(system, final).worst < 0.1


@pytest.mark.parametrize("name", ["arm", "polar"])
def test_generalized_coordinates(name):
    """Batches of systems with a user's mass matrix, with springs or augmented multipliers."""
    built = scenes.build(name)
    for law in (jc.stabilizers.Penalty.from_time(0.05), jc.stabilizers.AugmentedLagrangian()):
        method = jc.Method(stabilizer=law)
        start = jc.init(built.system, method, built.off.q, built.off.v)

        def step(s, m=method):
            return jc.step(built.system, m, s, None, 1e-3)[0].q

        other = dataclasses.replace(start, v=2 * start.v)
        batch = jax.tree.map(lambda *x: jnp.stack(x), other, start)
        got = jax.jit(jax.vmap(step))(batch)[1]
        np.testing.assert_allclose(got, jax.jit(step)(start), rtol=1e-12)


@pytest.mark.parametrize(
    ("stabilizer", "words"),
    [
        (lambda: jc.stabilizers.Penalty(), ["Penalty", "stiffness", "time"]),
        (lambda: jc.stabilizers.Penalty(-1.0), ["Penalty", "stiffness", "zero or more", "-1"]),
        (lambda: jc.stabilizers.Penalty({"spring": -1.0}), ["stiffness of 'spring'"]),
        (lambda: jc.stabilizers.Penalty(1.0, -2.0), ["damping", "-2"]),
        (lambda: jc.stabilizers.Penalty.from_time(0.0), ["time", "positive"]),
        (lambda: jc.stabilizers.Penalty({"sprong*": 1.0}), ["Penalty", r"sprong\*", "spring"]),
        (lambda: jc.stabilizers.Penalty({"spring": 1.0}, {"sp": 1.0}), ["Penalty", r"\['sp'\]"]),
        (lambda: jc.stabilizers.Penalty(jnp.ones(4)), ["Penalty", r"\(1,\)", r"\(4,\)"]),
        (
            lambda: jc.stabilizers.AugmentedLagrangian(0.0),
            ["AugmentedLagrangian", "stiffness", "positive"],
        ),
        (
            lambda: jc.stabilizers.AugmentedLagrangian(iterations=0),
            ["iterations must be a whole number from 1"],
        ),
        (
            lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1.0, implicit=False)),
            ["Hybrid", "implicit"],
        ),
        (lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(-1.0)), ["Penalty", "stiffness"]),
        (
            lambda: jc.stabilizers.Penalty(1.0, others=jc.Projection()),
            ["others=Projection", "soft constraints"],
        ),
        (
            lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1.0), sharpness=0),
            ["Hybrid", "sharpness"],
        ),
        (
            lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1.0), large=jc.Baumgarte()),
            ["Hybrid", "corrects nothing"],
        ),
        (
            lambda: jc.stabilizers.Hybrid(
                jc.stabilizers.Penalty(1.0), large=jc.stabilizers.Penalty(2.0)
            ),
            ["Hybrid", "corrects nothing"],
        ),
        (
            lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1.0), jc.Projection()),
            ["Hybrid", "corrects after a step"],
        ),
        (
            lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1.0), soft_below=1.0),
            ["Hybrid", "must not exceed"],
        ),
    ],
)
def test_bad_numbers_are_refused(stabilizer, words):
    system, state = oscillator()

    def move(state):
        return jc.step(system, jc.Method(stabilizer=stabilizer()), state, None, H)

    with pytest.raises(ValueError, match=".*".join(words)):
        jax.eval_shape(move, state)


@pytest.mark.parametrize(
    ("stabilizer", "words"),
    [
        (lambda: jc.stabilizers.Penalty(1.0, others=None), "Penalty: others must be a stabilizer"),
        (
            lambda: jc.stabilizers.AugmentedLagrangian(feedback=None),
            "AugmentedLagrangian: feedback must be",
        ),
        (
            lambda: jc.stabilizers.AugmentedLagrangian(feedback=jc.Baumgarte),
            "AugmentedLagrangian: feedback must be",
        ),
        (lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty), "Hybrid: small must be"),
        (
            lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1.0), middle=None),
            "Hybrid: middle must be",
        ),
        (
            lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1.0), large="Projection"),
            "Hybrid: large must be",
        ),
        (
            lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1.0, others=None)),
            "Penalty: others must be a stabilizer",
        ),
        (
            lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1.0), soft_below={"rod": 1e-3}),
            "soft_below must be one number",
        ),
        (
            lambda: jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1.0), project_above=None),
            "project_above must be one number",
        ),
    ],
)
def test_parts_that_are_none_are_refused(stabilizer, words):
    with pytest.raises(TypeError, match=words):
        stabilizer()


def test_damping_for_what_is_hard_is_refused():
    system, state = pendulum()
    method = jc.Method(stabilizer=jc.stabilizers.Penalty({"rod": 1.0}, {"hinge": 1.0}))
    with pytest.raises(ValueError, match="damping is given for .*hinge.*only .*rod.* soft"):
        jax.eval_shape(lambda s: jc.step(system, method, s, None, H), state)


@pytest.mark.parametrize("integrator", [jc.SemiImplicitEuler(), jc.RK4()], ids=["euler", "rk4"])
def test_a_hybrid_comes_back_from_a_tenth_off(integrator):
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.1, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=1.0))
    system, state = scene.build()
    method = jc.Method(integrator, jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1e3)))
    final, _ = jax.jit(lambda s: jc.rollout(system, method, s, None, 1e-3, 2000))(
        jc.init(system, method, state.q, state.v)
    )
    assert final.status == jc.Status.OK
    assert jc.violation(system, final).worst < 1e-3
    assert jnp.linalg.norm(final.v) < 5.0  # √(2 g l) = 4.4


def turned(turn, kind):
    """Two bodies in a chain that hangs in the world, with the whole scene rotated."""

    def place(x):
        return quaternion.rotate(turn, jnp.asarray(x))

    down = place((0.3, -0.5, -9.81))
    scene = jc.Scene(dim=3, gravity=down)
    solid = {"mass": 1.5, "inertia": (0.15, 0.3, 0.4), "quaternion": turn}
    scene.add_body("a", position=place((0.5, 0.1, 0.0)), **solid)
    scene.add_body("b", position=place((1.4, 0.2, 0.3)), **solid)
    point, axis = place((0.0, 0.0, 0.0)), place((0.0, 0.6, 0.8))
    scene.add(jc.Spherical("first", jc.WORLD, "a", point=point))
    points = {"point": place((1.0, 0.1, 0.1))}
    joints = {
        "revolute": lambda: jc.Revolute("second", "a", "b", axis=axis, **points),
        "prismatic": lambda: jc.Prismatic("second", "a", "b", axis=axis, **points),
        "planar": lambda: jc.joints.Planar("second", "a", "b", axis=axis, **points),
    }
    scene.add(joints[kind]())
    return scene.build()


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "planar"])
def test_a_spring_by_its_time_does_not_see_how_the_world_is_turned(kind):
    """In a world with a random rotation the motion is the rotated motion."""
    method = jc.Method(stabilizer=jc.stabilizers.Penalty.from_time(0.05, 0.2))

    def ends(turn):
        system, state = turned(turn, kind)
        final, _ = rolled((system, state), method, 60, 5e-3)
        places = [jc.position(system, final, name) for name in ("a", "b")]
        back = quaternion.conjugate(turn)
        return jnp.stack([quaternion.rotate(back, x) for x in places]), jc.violation(system, final)

    turns = np.random.default_rng(3).normal(size=(2, 4))
    turns = jnp.asarray(np.concatenate([[[1.0, 0, 0, 0]], turns / norms(turns)]))
    places, left = jax.jit(jax.vmap(ends))(turns)
    assert np.min(left.worst) > 1e-3  # the springs yield
    for other in places[1:]:
        np.testing.assert_allclose(other, places[0], rtol=0, atol=1e-9)


def norms(x):
    return np.linalg.norm(x, axis=-1, keepdims=True)


def test_a_spring_by_its_time_has_one_stiffness_in_all_directions():
    """A point joint uses the mean of A_ii over its axes, and a hinge the mean of both angles.

    The rod of 1.5 kg has its center 0.5 m from the point: A = 1/m + r²/I across it.
    """
    scene = jc.Scene(dim=3)
    moments = (0.15, 0.3, 0.4)
    scene.add_body("rod", mass=1.5, inertia=moments, position=(0.5, 0.0, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "rod", point=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0)))
    system, state = scene.build()
    rows = linearize(system, state.q, state.v, state.time)
    rows = dataclasses.replace(rows, mass=system.mass(state.q))
    k, d = jc.stabilizers.Penalty.from_time(0.1, 0.3).constants(rows)
    lengths = np.mean([1 / 1.5, 1 / 1.5 + 0.25 / 0.4, 1 / 1.5 + 0.25 / 0.3])
    turns = np.mean([1 / 0.3, 1 / 0.4])
    mass = 1 / np.array([lengths] * 3 + [turns] * 2)
    np.testing.assert_allclose(k, mass / 0.1**2, rtol=1e-12)
    np.testing.assert_allclose(d, 2 * 0.3 * mass / 0.1, rtol=1e-12)


@pytest.mark.parametrize(
    ("apart", "conflict", "status"),
    [(0.2, None, "CONFLICT"), (0.2, np.inf, "OK"), (1e-4, None, "OK"), (1e-4, 1e-4, "CONFLICT")],
)
def test_multipliers_judge_contradictions_as_their_solver_is_told(apart, conflict, status):
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(0.0, -1.0))
    scene.add(jc.Distance("short", jc.WORLD, "bob", length=1 - apart))
    scene.add(jc.Distance("long", jc.WORLD, "bob", length=1 + apart))
    system, state = scene.build()
    method = jc.Method(
        stabilizer=jc.stabilizers.AugmentedLagrangian(),
        solver=jc.solvers.RankSafe(conflict=conflict),
    )
    state = jc.init(system, method, state.q, state.v)
    _, info = jc.step(system, method, state, None, 1e-2)
    assert info.status == jc.Status[status]
