"""Assembly: closed forms, derivatives, and mechanisms that cannot be closed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import DIFFERENCE, IDENTITY

import jaxcon as jc
from jaxcon.scenes import CRANK_ROCKER, four_bar, four_bar_poses

random = np.random.default_rng(0)


def bead(position, length=1.0):
    scene = jc.Scene(dim=2)
    scene.add_particle("bead", mass=2.0, position=position, velocity=(1.0, 1.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bead", length=length, point_a=(0.0, 0.0)))
    return scene.build()


def two(*elements):
    scene = jc.Scene(dim=2)
    scene.add_particle("light", mass=1.0, position=(0.0, 0.0))
    scene.add_particle("heavy", mass=3.0, position=(2.0, 0.0))
    for element in elements:
        scene.add(element)
    return scene.build()


def spatial_loop(dtype="float64"):
    """A planar four-bar linkage of spatial hinges: 20 rows of rank 17."""
    scene = jc.Scene(dim=3, dtype=dtype)
    points = np.array([(0.0, 0.0, 0.0), (0.2, 0.0, 0.3), (1.0, 0.0, 0.8), (1.2, 0.0, 0.0)])
    names = [jc.WORLD, "crank", "coupler", "rocker", jc.WORLD]
    for i, name in enumerate(names[1:4]):
        middle = points[i : i + 2].mean(0)
        scene.add_body(name, mass=1.0, inertia=(0.02, 0.1, 0.1), position=middle)
    for i, point in enumerate(points):
        axis = (0.0, 1.0, 0.0)
        scene.add(jc.Revolute(f"hinge{i}", *names[i : i + 2], point=point, axis=axis))
    return scene.build()


def door():
    """Two hinges on one axis: ten rows of rank five."""
    scene = jc.Scene()
    scene.add_body("door", mass=2.0, inertia=(0.3, 0.4, 0.2), position=(0.5, 0.0, 0.0))
    for i, height in enumerate((-0.5, 0.5)):
        point, axis = (0.0, 0.0, height), (0.0, 0.0, 1.0)
        scene.add(jc.Revolute(f"hinge{i}", jc.WORLD, "door", point=point, axis=axis))
    return scene.build()


def polar(q, t, p):
    return (q[0] - p["length"] * (1 + 0.1 * q[1]))[None]


def polar_mass(q, p):
    return jnp.stack([jnp.stack([2.0 + 0 * q[0], 0.5 * q[0]]), jnp.stack([0.5 * q[0], q[0] ** 2])])


def no_force(q, v, t, u, p):
    return 0 * q


def generalized(length=1.2):
    return jc.GeneralizedSystem(
        mass=polar_mass,
        force=no_force,
        constraints=(jc.joints.Holonomic(polar, name="rod"),),
        params={"length": jnp.asarray(length)},
    )


@pytest.mark.parametrize("place", [(3.0, 4.0), (0.03, 0.04)])
def test_nearest_point_of_a_circle(place):
    """The result lies on the same radius, however far the start.

    The velocity v loses its component along the rod.
    """
    system, state = bead(place)
    found = jc.assemble(system, state)
    np.testing.assert_allclose(found.q, (0.6, 0.8), atol=IDENTITY)
    np.testing.assert_allclose(found.v, (1 - 1.4 * 0.6, 1 - 1.4 * 0.8), atol=IDENTITY)
    away = abs(np.hypot(*place) - 1)
    np.testing.assert_allclose(found.distance, np.sqrt(2) * away, rtol=IDENTITY)
    assert found.converged


def test_displacements_are_as_the_inverse_masses():
    system, state = two(jc.Distance("rod", "light", "heavy", length=1.0))
    state = dataclasses.replace(state, memory=(jnp.ones(3),), time=jnp.asarray(2.5))
    new = jc.assemble(system, state).check()
    np.testing.assert_allclose(
        [jc.position(system, new, name) for name in ("light", "heavy")],
        [(0.75, 0.0), (1.75, 0.0)],
        atol=IDENTITY,
    )
    np.testing.assert_array_equal(new.memory[0], np.ones(3))
    assert float(new.time) == 2.5
    jc.raise_for_status(new)


@pytest.mark.parametrize("hold", ["light", ["light"], "indices", "mask"])
def test_what_is_held_does_not_move(hold):
    system, state = two(jc.Distance("rod", "light", "heavy", length=1.0))
    index = system.layout.v("light")
    mask = np.isin(np.arange(4), index)
    hold = {"indices": index, "mask": mask}.get(hold, hold) if isinstance(hold, str) else hold
    v = jnp.asarray(random.normal(size=4))
    found = jc.assemble(system, state, v, hold=hold)
    np.testing.assert_array_equal(found.q[index], state.q[index])
    np.testing.assert_array_equal(found.v[index], v[index])
    np.testing.assert_allclose(jc.position(system, found.state, "heavy"), (1, 0), atol=IDENTITY)


def test_four_bar_from_rough_angles():
    """The crank is held; the other bodies take the positions and velocities of the closed form."""
    system, _ = four_bar()
    at = lambda x: four_bar_poses(jnp.asarray(CRANK_ROCKER), x).T.ravel()  # noqa: E731
    for angle in (0.4, 2.0):
        q, v = jax.jvp(at, (angle,), (3.0,))
        crank = system.layout.v("crank")
        free = ~np.isin(np.arange(9), crank)
        rough = jnp.where(free, q + 0.2 * random.normal(size=9), q)
        found = jc.assemble(system, rough, jnp.where(free, 0, v), hold="crank")
        np.testing.assert_allclose(found.q, q, atol=1e-10)
        np.testing.assert_allclose(found.v, v, atol=1e-9)
        assert "assembled" in str(found)


def test_a_linkage_drawn_as_nothing_at_all():
    """Assembly converges even from all bodies at one place, a stationary point by symmetry."""
    system, _ = four_bar()
    found = jc.assemble(system, np.zeros(9))
    assert found.converged
    assert found.violation.worst < 1e-12


def test_it_is_the_nearest():
    """The displacement d is M-orthogonal to the constraints; no neighbor on them is nearer."""
    system, state = four_bar()
    rough = state.q + 0.3 * np.random.default_rng(3).normal(size=9)
    mass = system.mass(state.q).values
    found = jc.assemble(system, rough)
    j = scenes.linearized(system, found.q, found.v, found.state.time).jacobian.dense()
    pull = mass * (found.q - rough)
    left = pull - j.T @ np.linalg.lstsq(j.T, pull, rcond=None)[0]
    np.testing.assert_allclose(left, 0, atol=1e-10)
    near = found.q[None] + 0.05 * np.random.default_rng(4).normal(size=(16, 9))
    others = jax.vmap(lambda q: jc.assemble(system, q).q)(near)
    distances = jnp.sqrt(jnp.sum(mass[None] * (others - rough[None]) ** 2, 1))
    assert np.all(distances > found.distance)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_spatial_loop_with_redundant_rows(dtype):
    system, state = spatial_loop(dtype)
    tolerance = 1e-13 if dtype == "float64" else 1e-6
    for seed in range(3):
        push = jnp.asarray(0.2 * np.random.default_rng(seed).normal(size=18), dtype)
        found = jc.assemble(system, system.retract(state.q, push), push)
        assert found.q.dtype == found.v.dtype == dtype
        assert found.converged
        assert found.violation.worst < tolerance
        assert found.violation.worst_rate < 10 * tolerance


def test_a_consistent_state_stays():
    system, state = four_bar()
    found = jc.assemble(system, state)
    np.testing.assert_allclose(found.q, state.q, atol=1e-14)
    np.testing.assert_allclose(found.v, state.v, atol=1e-12)


def test_generalized_coordinates():
    """The nearest point of a line under a full mass matrix, compared with its closed form."""
    system = generalized()
    q = jnp.asarray([1.0, 0.3])
    found = jc.assemble(system, q, np.array([1.0, 2.0]))
    mass = np.array([[2.0, 0.5], [0.5, 1.0]])
    row = np.array([1.0, -0.12])
    pull = np.linalg.solve(mass, row)
    np.testing.assert_allclose(found.q, q - pull * (1 - 1.2 * 1.03) / (row @ pull), atol=IDENTITY)
    assert abs(found.v @ row) < IDENTITY
    held = jc.assemble(system, q, hold=[1])
    np.testing.assert_allclose(held.q, (1.2 * 1.03, 0.3), atol=IDENTITY)


def test_time_and_velocity_level_rows():
    """A driven joint takes its prescribed position and rate at t, and ψ vanishes."""
    built = scenes.build("driven_revolute-2d-tree")
    wave, time = scenes.WAVE, 0.3
    found = jc.assemble(built.system, built.state, time=time)
    turn = found.q[2] - built.system.params["joint"]["angle"]
    np.testing.assert_allclose(turn, wave["size"] * np.sin(wave["frequency"] * time), atol=1e-12)
    rate = wave["size"] * wave["frequency"] * np.cos(wave["frequency"] * time)
    np.testing.assert_allclose(found.v[2], rate, atol=1e-12)
    skates = scenes.build("velocity_level-2d-tree")
    found = jc.assemble(skates.system, skates.off)
    np.testing.assert_array_equal(found.q, skates.off.q)
    assert found.violation.worst_rate < 1e-13


def test_the_derivative_by_a_length_and_by_the_start():
    system, state = four_bar()
    free = ~np.isin(np.arange(9), system.layout.v("crank"))
    rough = state.q + 0.1 * free * np.random.default_rng(1).normal(size=9)

    @jax.jit
    def closed(x):
        changes = {"crank_coupler": {"anchor_b": x[:2]}, "coupler": {"mass": x[2]}}
        start = dataclasses.replace(state, q=rough.at[1].add(x[3]))
        found = jc.assemble(system.with_params(changes), start, hold="crank")
        return found.q, found.v

    x = jnp.asarray([-0.45, 0.02, 0.9, 0.0])
    steps = 1e-5 * np.eye(4)
    columns = [
        jax.tree.map(lambda a, b: (a - b) / 2e-5, closed(x + s), closed(x - s)) for s in steps
    ]
    expected = [np.stack(column, -1) for column in zip(*columns, strict=True)]
    for found in jax.jit(lambda x: (jax.jacfwd(closed)(x), jax.jacrev(closed)(x)))(x):
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=DIFFERENCE, atol=DIFFERENCE)


def test_the_derivative_beside_redundant_rows():
    system, state = door()
    rough = system.retract(state.q, 0.1 * np.random.default_rng(0).normal(size=6))
    anchors = {name: system.params[name]["anchor_b"] for name in ("hinge0", "hinge1")}

    def closed(x):
        moved = {name: {"anchor_b": anchor.at[0].add(x)} for name, anchor in anchors.items()}
        return jc.assemble(system.with_params(moved), rough, np.ones(6)).state

    run = jax.jit(lambda x: jax.jvp(closed, (x,), (1.0,)))
    (new, _), (old, _), (_, rate) = (run(x) for x in (1e-5, -1e-5, 0.0))
    for name in ("q", "v"):
        expected = (getattr(new, name) - getattr(old, name)) / 2e-5
        np.testing.assert_allclose(getattr(rate, name), expected, rtol=DIFFERENCE, atol=1e-7)


def test_second_derivatives():
    """The nearest point of a circle of radius r is q = r n, hence ∂q/∂q₀ = r (1 − n nᵀ)/‖q₀‖."""
    system, state = bead((3.0, 4.0))
    hessian = jax.jit(jax.jacfwd(jax.jacrev(lambda q: jc.assemble(system, q).q)))(state.q)
    expected = jax.jacfwd(jax.jacrev(lambda q: q / jnp.sqrt(q @ q)))(state.q)
    np.testing.assert_allclose(hessian, expected, atol=1e-10)


def test_a_world_that_cannot_be_assembled_leaves_the_others_alone():
    system, state = two(
        jc.Distance("rod", "light", "heavy", length=1.0),
        jc.Distance("left", jc.WORLD, "light", length=1.0, point_a=(-1.0, 0.0)),
        jc.Distance("right", jc.WORLD, "heavy", length=1.0, point_a=(3.0, 0.0)),
    )

    def total(length):
        found = jc.assemble(system.with_params({"rod": {"length": length}}), state.q + 0.1)
        return jnp.sum(found.q**2), found

    run = jax.jit(jax.vmap(jax.grad(total, has_aux=True)))
    slopes, batch = run(jnp.asarray([3.0, 7.0, 2.5]))  # 7 > 4 + 1 + 1: impossible
    healthy, _ = run(jnp.asarray([3.0, 2.0, 2.5]))
    np.testing.assert_allclose(slopes, jnp.where(batch.converged, healthy, 0), rtol=1e-12)
    assert np.all(healthy != 0)
    np.testing.assert_array_equal(batch.converged, [True, False, True])
    assert str(batch) == "2 of 3 worlds assembled"
    with pytest.raises(jc.SimulationError, match=r"(?s)world \(1,\).*'rod': .φ. = "):
        batch.check()
    stepped, _ = jax.vmap(lambda s: jc.step(system, jc.Method(), s, None, 1e-3))(batch.state)
    np.testing.assert_array_equal(stepped.q[1], batch.q[1])


def test_what_is_open_is_named():
    system, state = four_bar()
    long = {"rocker_ground": {"anchor_b": (4.0, 0.0)}}
    found = jc.assemble(system.with_params(long), state)
    assert not found.converged
    with pytest.raises(
        jc.SimulationError, match=r"(?s)not assembled.*'rocker_ground'.*cannot close"
    ):
        found.check()
    with pytest.raises(jc.SimulationError, match="NOT_CONVERGED"):
        jc.raise_for_status(found)


def test_contradictory_joints_are_named():
    system, state = two(
        jc.Distance("short", "light", "heavy", length=1.0),
        jc.Distance("long", "light", "heavy", length=3.0),
    )
    found = jc.assemble(system, state)
    assert set(found.unmet) == {"short", "long"}
    np.testing.assert_allclose(found.unmet["long"][0], 1.0, atol=1e-6)


def test_a_start_without_direction_takes_one():
    """From the center of a circle all directions are equal; assembly chooses one."""
    system, state = bead((0.0, 0.0))
    found = jc.assemble(system, state).check()
    np.testing.assert_allclose(np.hypot(*found.q), 1.0, rtol=IDENTITY)


def test_too_much_held_is_named():
    system, state = four_bar()
    moved = state.q.at[0].add(1.0)
    with pytest.raises(
        jc.SimulationError, match="(?s)'ground_crank': .*its bodies are held"
    ) as error:
        jc.assemble(system, moved, hold=["crank"]).check()
    assert "coupler_rocker" not in str(error.value)


MISTAKES = {
    "a scene": (lambda s, x: jc.assemble(jc.Scene(), x), "expected a system, got Scene"),
    "a batch": (lambda s, x: jc.assemble(s, np.zeros((3, 4))), r"q must have shape \(4,\)"),
    "another dtype": (lambda s, x: jc.assemble(s, x.q.astype("float32")), "q is float32"),
    "nan": (lambda s, x: jc.assemble(s, x.q * np.nan), "q must be finite"),
    "velocity": (lambda s, x: jc.assemble(s, x, np.zeros(3)), r"v must have shape \(4,\)"),
    "unknown body": (lambda s, x: jc.assemble(s, x, hold="lite"), "'lite' is unknown.*'light'"),
    "the world": (lambda s, x: jc.assemble(s, x, hold=jc.WORLD), "is fixed to the world"),
    "everything": (lambda s, x: jc.assemble(s, x, hold=["light", "heavy"]), "everything is held"),
    "mask": (lambda s, x: jc.assemble(s, x, hold=np.ones(3, bool)), r"mask .* \(4,\), got \(3,\)"),
    "index": (lambda s, x: jc.assemble(s, x, hold=[4]), "from 0 to 3"),
    "no index": (lambda s, x: jc.assemble(s, x, hold=[0.5]), "got 0.5"),
    "tolerance": (lambda s, x: jc.assemble(s, x, tolerance=-1.0), "tolerance must be positive"),
    "names of coordinates": (
        lambda s, x: jc.assemble(generalized(), np.ones(2), hold="light"),
        "generalized coordinates have none",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named(mistake):
    call, words = MISTAKES[mistake]
    system, state = two(jc.Distance("rod", "light", "heavy", length=1.0))
    with pytest.raises((ValueError, TypeError), match=words):
        call(system, state)
