"""Rolling and spinning resistance: closed forms, the law itself, and gradients."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE

import jaxcon as jc
from jaxcon.contact.bounded import Bounded, FrictionDisc, RowCounts
from jaxcon.contact.rows import linearize_bounds

G, R = 9.81, 0.1
POINT, SWEEPS = jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel(sweeps=60)


def ball(dim=3, slope=0.0, dtype=None, velocity=(0.0, 0.0), spin=0.0, **contact):
    """A ball (in the plane a disc) that rolls over a floor.

    The slope tilts gravity, not the floor.
    """
    gravity = (G * np.sin(slope), *(0.0,) * (dim - 2), -G * np.cos(slope))
    scene = jc.Scene(dim=dim, gravity=gravity, dtype=dtype)
    u, w = velocity
    if dim == 2:
        body = {"mass": 2.0, "inertia": 0.5 * 2.0 * R**2}
        motion = {"velocity": (u, 0.0), "angular_velocity": -u / R}
    else:
        body = {"inertia": jc.inertia.sphere(2.0, R)}
        motion = {"velocity": (u, w, 0.0), "angular_velocity": (-w / R, u / R, spin)}
    scene.add_body("ball", position=(*(0.0,) * (dim - 1), R), **body, **motion)
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=R, friction=0.6, **contact))
    return scene.build()


def rolled(system, state, h, steps, solver=SWEEPS):
    """Returns the final state, and the reactions of the floor in each step."""
    method = jc.Method(contact_solver=solver)
    state = jc.init(system, method, state.q, state.v)
    h = jnp.asarray(h, state.q.dtype)
    return jax.jit(
        lambda s: jc.rollout(
            system, method, s, None, h, steps, record=lambda _, i: i.reactions["floor"]
        )
    )(state)


@pytest.mark.parametrize(
    ("dim", "solver", "dtype"),
    [(2, SWEEPS, jnp.float64), (3, SWEEPS, jnp.float32), (3, POINT, jnp.float64)],
    ids=["disc", "float32", "ball"],
)
def test_what_rolls_stops_after_its_distance(dim, solver, dtype):
    """The distance is d = (1 + s) v² r/(2 c g) with s = I/m r², to first order in h.

    It follows from m (1 + s) v̇ = −c m g/r.
    """
    c, share, velocity = 0.02, 0.5 if dim == 2 else 0.4, (0.4, 0.3 * (dim == 3))
    speed = np.hypot(*velocity)
    system, state = ball(dim, velocity=velocity, rolling=c, dtype=dtype)
    want = (1 + share) * speed**2 * R / (2 * c * G)
    time = (1 + share) * speed * R / (c * G)
    off = []
    for h in (4e-3, 2e-3) if dtype == jnp.float64 else (2e-3,):
        final, forces = rolled(system, state, h, int(1.2 * time / h), solver)
        along = np.array(velocity[: dim - 1]) / speed
        off.append(np.asarray(final.q[: dim - 1]) @ along - want)
        tight = 1e-8 if dtype == jnp.float64 else 1e-4
        np.testing.assert_allclose(final.v, 0.0, atol=tight)
        moment = np.linalg.norm(forces[:, dim:], axis=1)
        np.testing.assert_allclose(moment[: int(0.9 * time / h)], c * 2 * G, rtol=100 * tight)
    assert np.abs(off[-1]) < speed * h
    if len(off) > 1:
        np.testing.assert_allclose(off[0] / off[1], 2.0, rtol=0.1)


@pytest.mark.parametrize("share", [0.9, 1.5])
def test_on_a_slope_it_holds_or_rolls(share):
    """The ball stays while tan α < c/r, held by the moment m g r sin α; else it rolls."""
    slope = 0.1
    c = R * np.tan(slope) / share
    system, state = ball(slope=slope, rolling=c)
    final, forces = rolled(system, state, 2e-3, 100)
    weight = 2 * G * np.cos(slope)
    if share < 1:
        np.testing.assert_allclose(final.v, 0.0, atol=1e-7)
        want = weight * np.tan(slope) * R
    else:
        pull = G * (np.sin(slope) - c / R * np.cos(slope)) / 1.4
        np.testing.assert_allclose(final.v[0], 0.2 * pull, rtol=1e-6)
        want = weight * c
    np.testing.assert_allclose(np.linalg.norm(forces[-1, 3:]), want, rtol=1e-6)


def test_what_spins_stops_and_others_in_the_scene_do_not():
    """I ω̇ = −c m g about the normal; contacts of every kind are in one scene."""
    scene = jc.Scene()
    kinds = {"free": {}, "spun": {"spinning": 0.01}, "both": {"rolling": 0.02, "spinning": 0.02},
             "ice": {"friction": 0.0}, "rolled": {"rolling": 0.02}}  # fmt: skip
    for i, (name, given) in enumerate(kinds.items()):
        inertia, place = jc.inertia.sphere(2.0, R), (float(i), 0.0, R)
        scene.add_body(name, inertia=inertia, position=place, angular_velocity=(0.0, 0.0, 5.0))
        contact = {"radius": R, "friction": 0.6} | given
        scene.add(jc.PlaneContact(f"{name} floor", jc.WORLD, name, **contact))
    system, state = scene.build()
    found = linearize_bounds(system, state.q, state.v, state.time, None, jnp.asarray(1e-3))
    assert found.kinds == RowCounts(1, 0, 4, 2, (FrictionDisc(1, 2, 2), FrictionDisc(2, 2, 1)))
    method = jc.Method(contact_solver=SWEEPS)
    state = jc.init(system, method, state.q, state.v)
    final, forces = jax.jit(
        lambda s: jc.rollout(system, method, s, None, 2e-3, 20, record=lambda _, i: i.reactions)
    )(state)
    for name, given in kinds.items():
        c = given.get("spinning", 0.0)
        left = 5.0 - 0.04 * c * G / (0.4 * R**2)
        spin = jc.angular_velocity(system, final, name)
        np.testing.assert_allclose(spin, [0.0, 0.0, left], atol=1e-9)
        force = forces[f"{name} floor"][-1]
        want = {"ice": 1, "free": 3, "spun": 4, "rolled": 5, "both": 6}[name]
        assert force.shape == (want,)
        np.testing.assert_allclose(force[0], 2 * G, rtol=1e-9)
        if c:
            np.testing.assert_allclose(force[-1], -c * 2 * G, rtol=1e-9)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_the_interior_point_solves_random_rows(dtype):
    """Only some contacts have extra friction discs, of one or two rows.

    Stops and boxes are included.
    """
    kinds = RowCounts(1, 1, 3, 2, (FrictionDisc(1, 2, 2), FrictionDisc(2, 1, 1)))
    rng, worlds = np.random.default_rng(3), 500
    jacobian = rng.normal(size=(kinds.size, 20, worlds))
    matrix = np.einsum("irb,jrb->ijb", jacobian, jacobian)
    offset = np.einsum("irb,rb->ib", jacobian, rng.normal(size=(20, worlds)))
    most = np.abs(rng.normal(size=(1, worlds)))
    sizes = (matrix, offset, -most, most, 0.1 * rng.uniform(size=(3, worlds)))
    more = tuple(jnp.asarray(0.1 * rng.uniform(size=(k, worlds)), dtype) for k in (2, 1))
    problem = Bounded(*(jnp.asarray(x, dtype) for x in sizes), kinds, more)
    # without fused multiply-add, one world in a hundred fails at the tip of a cone in float32
    costly = {"xla_backend_optimization_level": 3}
    options = None if dtype == jnp.float64 else costly
    solve = jax.jit(lambda p: POINT.solve(p, jnp.zeros_like(p.offset)), compiler_options=options)
    found = solve(problem)
    terms = jnp.sum(jnp.abs(problem.matrix * found[None]), axis=1) + jnp.abs(problem.offset)
    missed = np.asarray(problem.worst(found) / jnp.max(terms, axis=0))
    assert missed.max() < (1e-8 if dtype == jnp.float64 else 1e-5)
    parts = kinds.split(found)
    assert float(jnp.mean(parts.normal > 0)) > 0.2
    for disc, length, rows in zip(kinds.turning, more, parts.discs[1:], strict=True):
        bound = length * disc.of(parts.normal)
        assert np.all(np.sqrt(rows.dot(rows)) <= bound * (1 + 1e-5) + 1e-6)


def test_gradients_of_where_it_stops():
    """Derivatives by the resistance length, rolling or sliding, in a batch, equal differences."""
    system, state = ball(2, velocity=(0.3, 0.0), rolling=0.02)

    def end(x):
        changed = system.with_params({"floor": {"rolling": x[0], "friction": x[1]}})
        start = dataclasses.replace(state, v=state.v.at[2].set(x[2]))
        final = jc.rollout(changed, jc.Method(), start, None, 2e-3, 40)[0]
        return final.q[0] + 0.1 * final.q[2]

    worlds = []
    for at in (jnp.asarray([0.02, 0.4, -3.0]), jnp.asarray([0.02, 0.1, 4.0])):
        step = 1e-6 * jnp.eye(3)
        worlds.append(jnp.concatenate([at[None], at[None] + step, at[None] - step]))
    ends, slopes = jax.jit(jax.vmap(jax.vmap(jax.value_and_grad(end))))(jnp.stack(worlds))
    assert np.abs(slopes[1, 0]).min() > 1e-4
    differences = (ends[:, 1:4] - ends[:, 4:]) / 2e-6
    np.testing.assert_allclose(slopes[:, 0], differences, rtol=DIFFERENCE, atol=1e-9)


@pytest.mark.parametrize(
    ("dim", "given", "match"),
    [
        (3, {"rolling": -0.1}, "PlaneContact 'floor': rolling must be zero or more"),
        (3, {"spinning": -0.1}, "spinning must be zero or more"),
        (2, {"spinning": 0.1}, "nothing spins about a normal in the plane"),
        (3, {"body_b": "dot", "rolling": 0.1}, "a particle does not turn; give no rolling"),
    ],
)
def test_bad_numbers_are_refused(dim, given, match):
    scene = jc.Scene(dim=dim)
    scene.add_body("ball", mass=1.0, inertia=1.0 if dim == 2 else (1.0, 1.0, 1.0))
    scene.add_particle("dot", mass=1.0)
    usual = {"body_a": jc.WORLD, "body_b": "ball"}
    scene.add(jc.PlaneContact("floor", **(usual | given)))
    with pytest.raises(ValueError, match=match):
        scene.build()


def test_a_length_that_was_left_out_is_missed_by_name():
    system, _ = ball()
    with pytest.raises(ValueError, match=r"no \['rolling'\].*rolling=jnp.zeros"):
        system.with_params({"floor": {"rolling": 0.01}})
