"""Dependent rows: the motion equals that of independent rows, and λ has least norm."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.constraints.rows import linearize, saddle
from jaxcon.core.status import Status, first
from jaxcon.geometry import quaternion
from jaxcon.verification import singular
from tests.tolerances import DIFFERENCE

GENTLE = jc.Method(stabilizer=jc.Baumgarte.critical(10.0))
ACCURACY = {jnp.float64: 1e-9, jnp.float32: 1e-4}
"""Tolerance of accelerations, relative to the largest one."""
SHARED = 1e-5
"""Tolerance of multipliers of dependent rows."""


def cast(built, dtype):
    return jax.tree.map(lambda x: x.astype(dtype) if x.dtype == jnp.float64 else x, built)


def door(hinges):
    scene = jc.Scene(dim=3)
    solid = jc.inertia.box(20.0, (0.8, 0.04, 2.0))
    scene.add_body(
        "door",
        inertia=solid,
        position=(0.4, 0.0, 1.0),
        velocity=(0.0, 0.4, 0.0),
        angular_velocity=(0.0, 0.0, 1.0),
    )
    for i in range(hinges):
        point = (0.0, 0.0, 0.2 + 0.8 * i)
        scene.add(jc.Revolute(f"hinge{i}", jc.WORLD, "door", point=point, axis=(0.0, 0.0, 1.0)))
    scene.add(jc.forces.JointSpring("closer", "hinge0", stiffness=30.0, damping=1.0))
    return scene.build()


OBLIQUE = (0.5, -0.3, 0.8)


def doubled_hinges(links, turn, dtype):
    """A chain of links of 0.5 m, each on two parallel hinges; returns also their common axis.

    The chain is level and then rotated by a rotation vector.
    """
    scene = jc.Scene(dim=3, dtype=dtype)
    turned = np.asarray(quaternion.matrix(quaternion.exp(jnp.asarray(turn))))
    attitude = np.asarray(quaternion.from_matrix(jnp.asarray(turned)))
    solid, before = jc.inertia.box(1.0, (0.5, 0.2, 0.05)), jc.WORLD
    for i in range(links):
        link, middle = f"link{i}", turned @ (0.5 * i + 0.25, 0.0, 0.0)
        scene.add_body(link, inertia=solid, position=middle, quaternion=attitude)
        for side in (-0.1, 0.1):
            name, point = f"hinge{i}{side:+}", turned @ (0.5 * i, side, 0.0)
            scene.add(jc.Revolute(name, before, link, point=point, axis=turned[:, 1]))
        before = link
    return *scene.build(), turned[:, 1]


def table(legs):
    scene = jc.Scene(dim=3)
    scene.add_body("table", inertia=jc.inertia.box(30.0, (1.2, 0.8, 0.05)), position=(0, 0, 0.7))
    for i, (x, y) in enumerate([(0.5, 0.3), (-0.5, 0.3), (0.5, -0.3), (-0.5, -0.3)][:legs]):
        foot = (x, y, 0.0)
        scene.add(
            jc.joints.PointOnPlane(f"leg{i}", jc.WORLD, "table", axis=(0.0, 0.0, 1.0), point=foot)
        )
    scene.add(jc.forces.Force("push", "table", force=(7.0, 3.0, 0.0), point=(0.3, 0.1, 0.7)))
    return scene.build()


def parallelogram(bars):
    """A coupler on two or three parallel bars, not in a singular position."""
    scene = jc.Scene(dim=2)
    angle = 1.1
    half = 0.5 * np.array([np.cos(angle), np.sin(angle)])
    spin = 2.0
    turn = spin * np.array([-half[1], half[0]])
    solid = {"mass": 1.0, "inertia": 0.1}
    middle = (1.0 + 2 * half[0], 2 * half[1])
    scene.add_body("coupler", **solid, position=middle, velocity=2 * turn)
    for i in range(bars):
        foot = np.array([float(i), 0.0]) if i < 2 else np.array([2.0, 0.0])
        scene.add_body(
            f"bar{i}",
            **solid,
            position=foot + half,
            angle=angle,
            velocity=turn,
            angular_velocity=spin,
        )
        scene.add(jc.Revolute(f"foot{i}", jc.WORLD, f"bar{i}", point=foot))
        scene.add(jc.Revolute(f"head{i}", f"bar{i}", "coupler", point=foot + 2 * half))
    return scene.build()


def repeated(times):
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=2.0, position=(0.6, -0.8), velocity=(0.8, 0.6))
    for i in range(times):
        scene.add(jc.Distance(f"rod{i}", jc.WORLD, "bob"))
    return scene.build()


@pytest.mark.parametrize("dtype", list(ACCURACY), ids=["float64", "float32"])
@pytest.mark.parametrize(
    ("plain", "redundant"),
    [(door(1), door(2)), (door(1), door(3)), (table(3), table(4)), (repeated(1), repeated(5))],
    ids=["two hinges", "three hinges", "four legs", "five times"],
)
def test_accelerations_are_those_of_the_independent_rows(plain, redundant, dtype):
    dynamics = jax.jit(lambda system, state: jc.forward_dynamics(system, state, None, GENTLE, 1e-3))
    expected = dynamics(*cast(plain, dtype))
    system, state = cast(redundant, dtype)
    got = dynamics(system, state)
    bound = ACCURACY[dtype] * np.max(np.abs(expected.acceleration))
    np.testing.assert_allclose(got.acceleration, expected.acceleration, rtol=0, atol=bound)
    assert got.status == Status.OK
    assert jc.forward_dynamics(system, state, None, GENTLE, 1e-3).acceleration.dtype == dtype
    strict = dataclasses.replace(GENTLE, solver=jc.solvers.Sparse())
    assert jc.forward_dynamics(system, state, None, strict, 1e-3).status == Status.SINGULAR


@pytest.mark.parametrize("dtype", list(ACCURACY), ids=["float64", "float32"])
def test_a_redundant_link_leaves_the_motion_of_a_parallelogram(dtype):
    """The third bar has mass of its own, so the reference uses minimal coordinates.

    With all bars at the angle θ, E = ½ I θ̇² + W sin θ with I = n (¼ + i) m + M and
    W = (n/2 m + M) g; all lengths are 1.
    """
    system, state = cast(parallelogram(3), dtype)
    a = jc.forward_dynamics(system, state, None, GENTLE, 1e-3).acceleration
    inertia, weight = 3 * (0.25 + 0.1) + 1.0, (1.5 + 1.0) * 9.81
    expected = -weight * np.cos(1.1) / inertia
    got = a[system.layout.v("bar1")][2]
    np.testing.assert_allclose(got, expected, rtol=ACCURACY[dtype])


DENSE, SCHUR = jc.solvers.RankSafe(jc.solvers.Dense()), jc.solvers.RankSafe(jc.solvers.Schur())
CREEPING = {
    "default": (jc.Method(), 2, OBLIQUE, 10_000),
    "Schur": (jc.Method(solver=SCHUR), 4, OBLIQUE, 10_000),
    "Dense": (jc.Method(solver=DENSE), 4, OBLIQUE, 1000),
    "RK4": (jc.Method(jc.RK4(), solver=SCHUR), 4, OBLIQUE, 1000),
    "RATTLE": (jc.Method(jc.integrators.RATTLE(), solver=SCHUR), 4, OBLIQUE, 1000),
    "alpha": (jc.Method(jc.integrators.GeneralizedAlpha(), solver=SCHUR), 4, OBLIQUE, 1000),
    "projection": (jc.Method(stabilizer=jc.Projection(), solver=SCHUR), 4, OBLIQUE, 1000),
    "PID": (
        jc.Method(stabilizer=jc.stabilizers.PID(4e4, 400.0, 1e4), solver=SCHUR),
        4,
        OBLIQUE,
        1000,
    ),
    "gradients": (jc.Method(solver=jc.solvers.ConjugateGradients()), 4, OBLIQUE, 1000),
    "priority": (jc.Method(solver=jc.solvers.Priority({"hinge*": 0})), 4, OBLIQUE, 1000),
}
"""Cases by name: method, number of links, rotation of the chain, number of steps of 1 ms."""


@pytest.mark.parametrize("dtype", list(ACCURACY), ids=["float64", "float32"])
@pytest.mark.parametrize("name", CREEPING)
def test_doubled_hinges_do_not_creep_along_their_axis(name, dtype):
    """At most 1 nm in 10 s in float64, and rounding in float32; the displacement does not grow.

    A row compares places of up to 2 m. Its rounding error of 4 spacings adds up over the hinges.
    """
    method, links, turn, steps = CREEPING[name]
    system, state, axis = doubled_hinges(links, turn, dtype)
    axis = jnp.asarray(axis, dtype)

    def along(state, _=None):
        return jnp.stack([axis @ jc.position(system, state, f"link{i}") for i in range(links)])

    @jax.jit
    def run(state):
        return jc.rollout(system, method, state, None, 1e-3, steps, record=along, every=steps // 20)

    final, path = run(jc.init(system, method, state.q, state.v))
    assert final.status == Status.OK
    assert np.max(np.abs(final.q - state.q)) > 0.1
    off = np.abs(np.float64(path) - np.float64(along(state)))
    rounding = 4 * float(jnp.finfo(dtype).eps) * 0.5 * links * links
    assert np.max(off) < (1e-9 if dtype == jnp.float64 else rounding)
    half = len(off) // 2
    assert np.max(off[half:]) < 2 * np.max(off[:half]) + rounding / 4


def test_multipliers_are_of_least_norm_in_the_scaled_rows():
    """λ = D^−½ (D^−½ A D^−½)⁺ D^−½ r, computed by singular values.

    The distribution among dependent rows is accurate to rounding over the iteration's ε = 1e-9.
    """
    for system, state in (door(2), repeated(5), table(4)):
        rows = linearize(system, state.q, state.v, state.time)
        force = system.force(state.q, state.v, state.time)
        j, weights = rows.jacobian.dense(), 1 / system.mass(state.q).diagonal
        a = (j * weights[None]) @ j.T
        scale = 1 / np.sqrt(np.diagonal(a))
        right = -rows.bias - j @ (weights * force)
        inverse = np.linalg.pinv(scale[:, None] * a * scale[None], rcond=1e-10, hermitian=True)
        expected = scale * (inverse @ (scale * right))
        problem = saddle(system, state.q, rows, force, -rows.bias)
        for solver in (
            jc.solvers.RankSafe(),
            jc.solvers.RankSafe(jc.solvers.Schur()),
            jc.solvers.RankSafe(jc.solvers.Dense()),
        ):
            got = solver.solve(problem).multipliers
            np.testing.assert_allclose(got, expected, atol=SHARED * np.max(np.abs(expected)))


def test_independent_rows_feel_nothing():
    system, state = parallelogram(2)
    solvers = (
        jc.solvers.Dense(),
        jc.solvers.RankSafe(),
        jc.solvers.RankSafe(jc.solvers.Schur(), always=True),
    )
    methods = [dataclasses.replace(GENTLE, solver=solver) for solver in solvers]
    exact, *others = (jc.forward_dynamics(system, state, None, m, 1e-3) for m in methods)
    for got in others:
        np.testing.assert_allclose(got.acceleration, exact.acceleration, rtol=0, atol=1e-10)
        np.testing.assert_allclose(got.multipliers, exact.multipliers, rtol=0, atol=1e-10)


def test_a_tree_is_solved_directly():
    system, state = door(1)

    def step(solver):
        method = dataclasses.replace(GENTLE, solver=solver)
        return str(jax.make_jaxpr(lambda s: jc.step(system, method, s, None, 1e-3))(state))

    count = {name: step(solver).count("\n") for name, solver in SOLVERS.items()}
    assert count["default"] == count["strict"]


SOLVERS = {"default": jc.solvers.RankSafe(), "strict": jc.solvers.Sparse()}


def test_rest_is_no_conflict():
    """The target of the rows is zero; its rounding errors must not count as a contradiction."""
    system, state = table(4)
    still = dataclasses.replace(state, v=jnp.zeros_like(state.v))
    for s in (system, system.with_params({"gravity": (0.0, 0.0, 0.0)})):
        for method in (jc.Method(), GENTLE):
            assert jc.forward_dynamics(s, still, None, method, 1e-3).status == Status.OK


def torso_on_legs(turn, sides, dtype):
    """A floating torso on legs with four-bar knees: each shank hangs on two parallel bars.

    Args:
        turn: rotation vector of the scene about the origin.
        sides: by leg, its name and its offset from the middle [m].
        dtype: dtype of the scene.

    Returns:
        The scene, and the rotation matrix.
    """
    scene = jc.Scene(dim=3, dtype=dtype)
    turned = np.asarray(quaternion.matrix(quaternion.exp(jnp.asarray(turn))))
    attitude = np.asarray(quaternion.from_matrix(jnp.asarray(turned)))

    def add(name, mass, size, place):
        solid = jc.inertia.box(mass, size)
        scene.add_body(name, inertia=solid, position=turned @ place, quaternion=attitude)

    add("torso", 10.0, (0.2, 0.4, 0.3), (0.0, 0.0, 1.15))
    axis = turned @ (0.0, 1.0, 0.0)
    for side, y in sides.items():
        shank = f"{side}_shank"
        add(shank, 2.0, (0.3, 0.15, 0.8), (0.0, y, 0.4))
        for way, x in (("front", 0.04), ("back", -0.04)):
            bar, size = f"{side}_{way}", (0.04, 0.04, 0.2)
            add(bar, 0.3, size, (x, y, 0.9))
            upper, lower = turned @ (x, y, 1.0), turned @ (0.8 * x, y, 0.8)
            scene.add(jc.Revolute(f"{bar}_hip", "torso", bar, point=upper, axis=axis))
            scene.add(jc.Revolute(f"{bar}_knee", bar, shank, point=lower, axis=axis))
    return scene, turned


@pytest.mark.parametrize("stabilizer", [jc.Projection(), jc.stabilizers.AugmentedLagrangian()])
@pytest.mark.parametrize("dtype", list(ACCURACY), ids=["float64", "float32"])
def test_a_free_fall_is_no_conflict(dtype, stabilizer):
    """In free fall the right-hand side is zero, except for rounding where gravity terms cancel."""
    method = jc.Method(stabilizer=stabilizer)
    solve = jax.jit(lambda system, state: jc.forward_dynamics(system, state, None, method, 1e-3))
    for turn in np.random.default_rng(1).normal(size=(10, 3)):
        system, state = torso_on_legs(turn, {"only": 0.0}, dtype)[0].build()
        state = jc.init(system, method, state.q, state.v)
        assert solve(system, state).status == Status.OK


@pytest.mark.parametrize("dtype", list(ACCURACY), ids=["float64", "float32"])
def test_a_biped_with_four_bar_knees_stands(dtype):
    """Stands for a second on four points under each foot; springs hold the knees slightly bent."""
    legs = {"left": 0.15, "right": -0.15}
    scene, turned = torso_on_legs((0.0, 0.0, 0.7), legs, dtype)
    for side, y in legs.items():
        spring = {"stiffness": 400.0, "damping": 20.0, "rest": 0.02}
        scene.add(jc.forces.JointSpring(f"{side}_spring", f"{side}_front_hip", **spring))
        sole = [turned @ (x, y + z, 0.0) for x in (-0.15, 0.15) for z in (-0.06, 0.06)]
        foot = f"{side}_shank"
        scene.add(jc.PlaneContact(f"{side}_sole", jc.WORLD, foot, center=sole, friction=0.8))
    system, state = scene.build()
    method = jc.Method(stabilizer=jc.Projection(), solver=SCHUR)

    def seen(state, info):
        return info.status, jc.position(system, state, "torso"), info.violation.worst

    @jax.jit
    def run(state):
        return jc.rollout(system, method, state, None, 1e-3, 1000, record=seen)

    final, (codes, places, off) = run(jc.init(system, method, state.q, state.v))
    assert final.status == Status.OK
    np.testing.assert_array_equal(codes, Status.OK)
    np.testing.assert_allclose(places[:, 2], 1.15, rtol=0, atol=1e-3)
    travel = np.linalg.norm(places[-1, :2])
    assert 1e-4 < travel < 0.02
    assert np.max(off) < 16 * float(jnp.finfo(dtype).eps)


def two_lengths(short, long):
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=((short + long) / 2, 0.0))
    scene.add(jc.Distance("short", jc.WORLD, "bob", length=short))
    scene.add(jc.Distance("long", jc.WORLD, "bob", length=long))
    return scene.build()


@pytest.mark.parametrize("dtype", list(ACCURACY), ids=["float64", "float32"])
def test_contradicting_rows_are_met_by_least_squares(dtype):
    """The bob swings on the mean of the two lengths, and the status reports the contradiction."""
    system, state = cast(two_lengths(1.0, 1.1), dtype)
    method = jc.Method(stabilizer=jc.Baumgarte.critical(50.0))
    run = jax.jit(lambda s: jc.rollout(system, method, s, None, jnp.asarray(1e-3, dtype), 500))
    final, path = run(state)
    assert final.status == Status.CONFLICT
    length = np.linalg.norm(path.q, axis=1)
    np.testing.assert_allclose(length, 1.05, rtol=0, atol=2e-3)
    with pytest.raises(jc.SimulationError, match="contradict"):
        jc.raise_for_status(final)
    agreeing, start = cast(two_lengths(1.05, 1.05), dtype)
    assert jc.step(agreeing, method, start, None, jnp.asarray(1e-3, dtype))[1].status == Status.OK


def test_a_singular_world_leaves_the_others_as_they_are():
    """One of three parallelograms has its rods in line."""
    system, state = singular.bars(2)
    angles = jnp.array([0.9, 0.0, 2.5])
    method = jc.Method(jc.SemiImplicitEuler(), jc.Baumgarte.critical(20.0))

    def turned(angle):
        q = state.q
        for i in range(3):
            place = system.layout.q(f"rod{i}")
            x = jnp.stack([i + 0.5 * jnp.cos(angle), 0.5 * jnp.sin(angle), angle])
            q = q.at[place].set(x)
        for i in range(2):
            x = jnp.stack([i + 0.5 + jnp.cos(angle), jnp.sin(angle), 0.0 * angle])
            q = q.at[system.layout.q(f"bar{i}")].set(x)
        return dataclasses.replace(state, q=q, v=jnp.zeros_like(state.v))

    def accelerate(angle):
        return jc.forward_dynamics(system, turned(angle), None, method, 1e-3)

    together = jax.jit(jax.vmap(accelerate))(angles)
    assert np.all(np.asarray(together.status) == Status.OK)
    inertia, weight = 3 * (0.25 + 1 / 12) + 2.0, (1.5 + 2.0) * 9.81
    rods = np.stack([np.asarray(a)[system.layout.v("rod1")] for a in together.acceleration])
    expected = -weight * np.cos(np.asarray(angles)) / inertia
    np.testing.assert_allclose(rods[[0, 2], 2], expected[[0, 2]], rtol=1e-9)
    alone = jax.jit(accelerate)(angles[0])
    np.testing.assert_allclose(together.acceleration[0], alone.acceleration, rtol=1e-10, atol=1e-10)


def test_the_derivative_is_that_of_the_independent_rows():
    """Differentiates rollouts of a door on one and on two hinges by the stiffness of its closer."""

    def angle(stiffness, built):
        system, state = built
        system = system.with_params({"closer": {"stiffness": stiffness}})
        final, _ = jc.rollout(system, GENTLE, state, None, 1e-3, 200, record=lambda s, i: None)
        return jc.coordinate(system, final, "hinge0")

    for built in (door(1), door(2)):
        value = jax.jit(lambda k, b=built: angle(k, b))
        slopes = [jax.jit(d(lambda k, b=built: angle(k, b)))(30.0) for d in (jax.grad, jax.jacfwd)]
        difference = (value(30.01) - value(29.99)) / 0.02
        np.testing.assert_allclose(slopes, [difference] * 2, rtol=DIFFERENCE)


def test_rows_of_generalized_coordinates():
    def twice(q, t, p):
        return jnp.stack([q @ q - 1.0, 3.0 * (q @ q - 1.0)])

    def once(q, t, p):
        return jnp.stack([q @ q - 1.0])

    found = []
    for function in (once, twice):
        system = jc.GeneralizedSystem(
            mass=lambda q, p: jnp.eye(2) * 2.0,
            force=lambda q, v, t, u, p: jnp.stack([0.0 * q[0], -9.81 * 2.0]),
            constraints=(jc.joints.Holonomic(function),),
        )
        state = jc.init(system, GENTLE, jnp.array([0.6, -0.8]), jnp.array([0.8, 0.6]))
        found.append(jc.forward_dynamics(system, state, None, GENTLE, 1e-3))
    assert all(x.status == Status.OK for x in found)
    np.testing.assert_allclose(found[1].acceleration, found[0].acceleration, rtol=1e-9)
    lengths = np.array([1.0, 3.0])
    weights = found[1].multipliers @ lengths
    np.testing.assert_allclose(weights, found[0].multipliers[0], rtol=1e-8)


CONFLICT, LATE = Status.CONFLICT, Status.NOT_CONVERGED
TOLD = {
    "feedback": (jc.Method(), CONFLICT),
    "multipliers": (jc.Method(stabilizer=jc.stabilizers.AugmentedLagrangian()), CONFLICT),
    "implicit": (jc.Method(jc.integrators.GeneralizedAlpha()), CONFLICT),
    "RATTLE": (jc.Method(jc.integrators.RATTLE()), LATE),
    "projection": (jc.Method(jc.RK4(), jc.Projection()), LATE),
}


@pytest.mark.parametrize("name", list(TOLD))
def test_every_method_tells_a_contradiction(name):
    """The status is CONFLICT with least squares, or a failure if positions must be satisfied."""
    method, expected = TOLD[name]

    @jax.jit
    def statuses(system, state):
        state = jc.init(system, method, state.q, state.v)
        record = rolled_status
        return jc.rollout(system, method, state, None, 1e-3, 20, record=record)[1]

    assert np.all(statuses(*two_lengths(1.0, 1.0)) == Status.OK)
    for off in (0.1, 1e-3):
        assert np.all(statuses(*two_lengths(1.0, 1.0 + off)) == expected)


def rolled_status(state, info):
    return info.status


def test_a_conflict_is_seen_through_the_note_of_a_repair():
    codes = jnp.asarray([Status.ROLLED_BACK, Status.CONFLICT, Status.SINGULAR, Status.OK])
    graver = first(codes[:, None], codes[None, :])
    expected = np.array([[17, 16, 2, 17], [16, 16, 2, 16], [2, 2, 2, 2], [17, 16, 2, 0]])
    np.testing.assert_array_equal(graver, expected)


def test_two_drives_that_agree():
    scene = jc.Scene(dim=2)
    scene.add_body("arm", mass=1.0, inertia=0.1, position=(0.5, 0.0), angular_velocity=0.3)
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)))
    for name in ("first", "second"):
        scene.add(jc.joints.Drive(name, "hinge", slowly))
    system, state = scene.build()
    solution = jc.forward_dynamics(system, state, None, GENTLE, 1e-3)
    assert solution.status == Status.OK
    np.testing.assert_allclose(solution.acceleration[2], 0.0, atol=1e-7)


def slowly(t, params):
    return 0.3 * t


def problem_of(built):
    """Returns the saddle system of a start under its own forces."""
    system, state = built
    rows = linearize(system, state.q, state.v, state.time)
    force = system.force(state.q, state.v, state.time)
    return saddle(system, state.q, rows, force, -rows.bias)


def beside(problem, factors):
    """Returns a batch (last axis) whose numbers are those of one problem times a factor."""

    def spread(x):
        if not isinstance(x, jax.Array) or not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        return jnp.stack([x * factor for factor in factors], -1)

    return jax.tree.map(spread, problem)


def test_a_world_that_is_not_finite_does_not_make_the_others_iterate(monkeypatch):
    iterate, rounds = jc.solvers.RankSafe._iterated, []

    def seen(self, system):
        solve = iterate(self, system)

        def told(force, target):
            jax.debug.callback(lambda: rounds.append(None))
            return solve(force, target)

        return told

    monkeypatch.setattr(jc.solvers.RankSafe, "_iterated", seen)
    for times in (1, 2):
        worlds = beside(problem_of(repeated(times)), (1.0, jnp.nan))
        found = jax.jit(lambda x=worlds: jc.solvers.RankSafe(always=True).solve(x))()
        jax.effects_barrier()
        assert len(rounds) == times - 1
        np.testing.assert_array_equal(found.status, [Status.OK, Status.NON_FINITE])
