"""Inertial parameters changed after the build give the body that is built with them.

Points and axes of elements stay fixed to the body: at the same motion every φ and φ̇ is unchanged,
and forces do the same work. Accelerations equal closed forms, those of MuJoCo, and those of a scene
that was built with the new parameters.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import DERIVATIVE, DIFFERENCE, ROUND_OFF

import jaxcon as jc
from jaxcon.constraints.couplings import Couplings
from jaxcon.constraints.rows import linearize
from jaxcon.core.lanes import Vector
from jaxcon.geometry import inertia
from jaxcon.system.elements import Elements, Grid
from jaxcon.system.forces import CustomForces
from jaxcon.system.inertial import DIRECTIONS, POINTS


def random_solid(random, dim, dtype="float64"):
    """Returns mass, center of mass and inertia of a physically possible body."""
    center = jnp.asarray(0.3 * random.normal(size=dim), dtype)
    mass = jnp.asarray(random.uniform(0.5, 2.0), dtype)
    if dim == 2:
        return {"mass": mass, "inertia": jnp.asarray(random.uniform(0.5, 1.0), dtype)} | {
            "center": center
        }
    spread = random.normal(size=(3, 3))
    second = spread @ spread.T
    tensor = jnp.asarray(np.trace(second) * np.eye(3) - second, dtype)
    return {"mass": mass, "inertia": tensor, "center": center}


def with_random_solids(system, seed=0):
    """Returns the system with random inertial parameters of every rigid body."""
    random = np.random.default_rng(seed)
    dim, dtype = system.layout.dim, system.gravity.dtype
    rigid = [name for name in system.layout.bodies if "center" in system.params[name]]
    return system.with_params({name: random_solid(random, dim, dtype) for name in rigid})


def user_motions(system, state):
    """Returns pose and motion of every body's own frame."""
    return [system.motion(name, state.q, state.v) for name in system.layout.bodies]


def close(got, expected, tolerance=DERIVATIVE):
    scale = 1 + max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(expected))
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, atol=tolerance * scale, rtol=0)


PLACES = [name for dim in (2, 3) for name in scenes.parts(dim, "loop")]


@pytest.mark.parametrize("name", [*PLACES, "mixed-2d", "mixed-3d"])
def test_what_is_fixed_to_a_body_stays_where_it_is_on_it(name):
    built = scenes.build(name)
    changed = with_random_solids(built.system)
    state = jc.systems.restate(built.off, built.system, changed)
    assert float(jnp.max(jnp.abs(state.q - built.off.q))) > 0.01
    close(user_motions(changed, state), user_motions(built.system, built.off))
    before, after = norms(built.system, built.off), norms(changed, state)
    close(after, before)


def norms(system, state):
    """Returns ‖φ‖ and ‖φ̇‖ of every constraint except momenta, and all joint coordinates and rates.

    Momenta depend on the inertial parameters.
    """
    rows, read = jax.jit(lambda: (linearize(system, *place(state)), coordinates(system, state)))()
    found = {
        name: [jnp.linalg.norm(x[rows.layout.rows(name)]) for x in (rows.residual, rows.rate)]
        for name in rows.layout.names
        if "momentum" not in name
    }
    return found | read


def place(state):
    return state.q, state.v, state.time


def coordinates(system, state):
    """Returns the coordinates of every joint that has some, by joint and name."""
    pairs = [
        (name, coordinate)
        for group in system.constraints
        if not isinstance(group, Couplings)
        for name in group.names
        for coordinate in getattr(group.law, "coordinates", ())
        if system.layout.dim == 3 or coordinate != "y"  # y of a point on a line in the plane
    ]
    return {
        f"{name}.{key}": [f(system, state, name, key) for f in (jc.coordinate, jc.coordinate_rate)]
        for name, key in pairs
    }


def elements():
    """Yields all groups of joints of the table, contacts and forces between bodies."""
    for dim in (2, 3):
        scene = jc.Scene(dim=dim)
        for kind in [kind for kind, joint in scenes.JOINTS.items() if dim in joint.dims]:
            scenes.add_joint(scene, kind, "between", "_" + kind, scenes.seeded(kind, dim))
        yield from scene.build()[0].constraints
    for system in (contacts_scene()[0], pushed_scene()[0], twisted()[0]):
        yield from (*system.constraints, *system.forces, *system.bounds)


PLAIN = {"force", "value", "size", "heights", "coefficients", "parts", "relaxed"}
"""First words of the names of array fields that are not points or directions of a body."""


def test_every_field_of_several_numbers_is_known_by_its_name():
    seen = set()
    for group in elements():
        if isinstance(group, Elements) and not isinstance(group, CustomForces):
            for field, x in group.params.items():
                if isinstance(x, Vector | Grid):
                    seen.add(field.partition("_")[0])
    assert seen <= POINTS | DIRECTIONS | PLAIN | {"orientation"}
    assert seen >= POINTS | DIRECTIONS


def twisted():
    """A twist, which has no rows, and a spring on it."""
    scene = jc.Scene()
    random = np.random.default_rng(8)
    for name in ("first", "second"):
        scenes.add_random_body(scene, name, random)
    scene.add(jc.joints.Twist("twist", "first", "second", axis=(1.0, 2.0, 0.5)))
    scene.add(jc.forces.JointSpring("coil", "twist", stiffness=2.0))
    return scene.build()


def test_a_twist_reads_what_it_did():
    system, state = twisted()
    changed = with_random_solids(system)
    after = jc.systems.restate(state, system, changed)
    close(coordinates(changed, after), coordinates(system, state))
    assert len(coordinates(system, state)) == 1


def contacts_scene():
    """Every kind of inequality element between bodies, with points off their frames."""
    random = np.random.default_rng(1)
    scene = jc.Scene(dim=3)
    for name in ("first", "second", "third"):
        scenes.add_random_body(scene, name, random)
    points = random.normal(size=(6, 3))
    field = {"heights": random.normal(size=(5, 4)), "size": (4.0, 3.0), "center": points[:4]}
    box = {"size": (0.3, 0.4, 0.5), "point": points[0], "normal": (0.2, 0.1, 1.0)}
    ends = {"segment_a": points[:2], "segment_b": points[2:4], "radius_a": 0.1, "radius_b": 0.2}
    scene.add(jc.PlaneContact("ball", "first", "second", center=points[1], point=points[2]))
    scene.add(jc.PlaneContact("points", "second", "first", center=points, friction=0.3))
    scene.add(jc.contacts.BoxContact("box", "second", "third", friction=0.2, **box))
    scene.add(jc.contacts.HeightFieldContact("ground", "third", "first", **field))
    scene.add(jc.contacts.CapsuleContact("capsules", "first", "third", **ends))
    place = {"position": points[4], "orientation": (0.9, 0.1, -0.2, 0.3)}
    can, hull = jc.shapes.Cylinder(0.3, 0.8, **place), jc.shapes.Hull(points)
    brick = jc.shapes.Box((0.3, 0.4, 0.5), points[5])
    plane = jc.shapes.Plane((0.2, 0.1, 1.0), points[0])
    pin = jc.shapes.Capsule(0.1, 0.4, points[3])
    for i, shapes in enumerate(((can, pin), (plane, hull), (brick, plane))):
        scene.add(jc.contacts.ShapeContact(f"shapes {i}", "first", "third", *shapes))
    scene.add(
        jc.contacts.Rope(
            "rope", "first", "second", point_a=points[4], point_b=points[5], length=0.5
        )
    )
    return scene.build()


def gaps(system, state):
    """Returns φ and φ̇ of every inequality row."""
    snapshot = system.snapshot(state.q, state.v, state.time)
    sets = [group.bounds(snapshot, None, jnp.asarray(1e-3)) for group in system.bounds]
    return [(row.value, row.rate) for rows in sets for row in rows.rows[:1]]


def test_what_touches_stays_where_it_is_on_its_body():
    system, state = contacts_scene()
    changed = with_random_solids(system)
    got, expected = gaps(changed, jc.systems.restate(state, system, changed)), gaps(system, state)
    close(got, expected, 1e-8)  # the search of a height field is iterative


def pushed_scene():
    """Forces between bodies, at points off their frames."""
    random = np.random.default_rng(2)
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    for name in ("first", "second", "third"):
        scenes.add_random_body(scene, name, random)
    p = random.normal(size=(7, 3))
    scene.add(jc.Spring("spring", "first", "second", 3.0, 0.2, 0.5, point_a=p[0], point_b=p[1]))
    ends = {"point_a": p[2], "point_b": p[3], "point_c": p[4]}
    scene.add(jc.forces.Bending("strip", "first", "second", "third", 2.0, **ends))
    scene.add(jc.forces.Force("wind", "third", force=(1.0, 2.0, 3.0), point=p[5]))
    scene.add(jc.forces.ExternalWrench("push", "second", point=p[6]))
    return scene.build()


def test_forces_do_the_same_work():
    """Compares the power f·v of springs, bending, a point force and a wrench, without gravity."""
    system, state = pushed_scene()
    changed = with_random_solids(system)
    control = jnp.asarray(np.random.default_rng(3).normal(size=6))
    after = jc.systems.restate(state, system, changed)
    power = system.applied(state.q, state.v, state.time, control) @ state.v
    same = changed.applied(after.q, after.v, after.time, control) @ after.v
    np.testing.assert_allclose(same, power, rtol=DERIVATIVE)
    close(jc.energy(changed, after).potential, jc.energy(system, state).potential)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_body_pinned_off_its_centre_swings_as_the_closed_form_says(dtype):
    """θ̈ = −m g d cos θ / (I + m d²) for a level bar with its center of mass at distance d."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    scene.add(jc.Revolute("pin", jc.WORLD, "bar", point=(0.0, 0.0)))
    system, level = scene.build()

    @jax.jit
    def turning(mass, moment, center):
        changed = system.with_params(
            {"bar": {"mass": mass, "inertia": moment, "center": jnp.stack([center, 0 * center])}}
        )
        state = jc.systems.restate(level, system, changed)
        found = jc.forward_dynamics(changed, state, None, jc.Method(), 1e-3)
        return found.acceleration[2]

    def closed(mass, moment, center):
        d = 0.5 + center
        return -mass * 9.81 * d / (moment + mass * d**2)

    given = tuple(jnp.asarray(x, dtype) for x in (1.3, 0.2, 0.25))
    tolerance = ROUND_OFF[np.dtype(dtype)]
    np.testing.assert_allclose(turning(*given), closed(*given), rtol=10 * tolerance)
    slopes, expected = (jax.grad(f, argnums=(0, 1, 2))(*given) for f in (turning, closed))
    np.testing.assert_allclose(slopes, expected, rtol=100 * tolerance)
    at_zero = (*given[:2], jnp.zeros((), dtype))
    np.testing.assert_allclose(
        jax.grad(turning, argnums=2)(*at_zero), jax.grad(closed, argnums=2)(*at_zero), rtol=1e-4
    )


def spinning():
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    scene.add_body("stone", mass=1.0, inertia=(1.0, 1.0, 1.0), angular_velocity=(0.3, -0.5, 0.8))
    return scene.build()


def turned(system, state, params):
    """Returns ω̇ of a free body in its own frame."""
    changed = system.with_params({"stone": params})
    after = jc.systems.restate(state, system, changed)
    a = jc.forward_dynamics(changed, after, None, jc.Method(), 1e-3).acceleration
    return jc.quaternion.rotate(changed.params["stone"]["axes"], a[3:])


def euler(tensor, ω):
    """Returns ω̇ of Euler's equation I ω̇ = −ω × I ω."""
    return jnp.linalg.solve(tensor, -jnp.cross(ω, tensor @ ω))


def test_a_free_body_turns_as_eulers_equation_says():
    system, state = spinning()
    tensor = random_solid(np.random.default_rng(3), 3)["inertia"]
    ω = state.v[3:]
    got = jax.jit(lambda x: turned(system, state, {"inertia": x}))
    np.testing.assert_allclose(got(tensor), euler(tensor, ω), rtol=DERIVATIVE)
    close(jax.jacfwd(got)(tensor), symmetric(jax.jacfwd(euler)(tensor, ω)), 1e-8)


def symmetric(slope):
    """Returns the symmetric part of a derivative by a matrix."""
    return (slope + slope.swapaxes(-1, -2)) / 2


@pytest.mark.parametrize("by", ["axes", "inertia", "center", "mass"])
def test_derivatives_of_a_ball_are_finite_and_right(by):
    """All axes of a ball are principal, so the choice of axes has no effect."""
    system, state = spinning()
    known = system.params["stone"]["axes" if by == "axes" else by]
    slope = jax.jit(jax.jacrev(lambda x: turned(system, state, {by: x})))(known)
    assert jnp.all(jnp.isfinite(slope))
    if by != "inertia":
        np.testing.assert_allclose(slope, jnp.zeros_like(slope), atol=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_it_is_the_body_that_a_scene_is_built_with(dim):
    """Sets all four parameters at once by an `Inertia`, and compares with a scene built with it."""
    given = random_solid(np.random.default_rng(4), dim)
    moments, axes = given["inertia"], None
    if dim == 3:
        solid = inertia.from_tensor(given["mass"], given["inertia"])
        moments, axes = solid.moments, solid.axes
    solid = inertia.Inertia(given["mass"], moments, given["center"], axes)

    def build(**body):
        scene = jc.Scene(dim=dim)
        scene.add_body("link", position=jnp.arange(1.0, dim + 1), **body)
        axis = None if dim == 2 else (0.0, 1.0, 1.0)
        scene.add(jc.Revolute("hinge", jc.WORLD, "link", point=jnp.ones(dim), axis=axis))
        return scene.build()

    plain, state = build(mass=1.0, inertia=1.0 if dim == 2 else (1.0, 1.5, 2.0))
    wanted, begin = build(inertia=solid)
    got = plain.with_params({"link": {"inertia": solid}})
    assert jax.tree.structure(got) == jax.tree.structure(wanted)
    close(jax.tree.leaves(got), jax.tree.leaves(wanted))
    close(jc.systems.restate(state, plain, got), begin)
    back = got.with_params({"link": plain.params["link"]})
    close(back.constraints[0].params, plain.constraints[0].params)


def test_a_loop_closes_again_and_the_way_is_differentiable():
    """The derivative of the potential energy by the coupler's center of mass is m g upwards."""
    from jaxcon.scenes import four_bar

    system, state = four_bar()

    def potential(center):
        changed = system.with_params({"coupler": {"center": center}})
        moved = jc.systems.restate(state, system, changed)
        closed = jc.assemble(changed, moved, hold="crank").state
        return jc.energy(changed, closed).potential

    center = jnp.asarray([0.1, -0.2])
    slope = jax.jit(jax.grad(potential))(center)
    turn = jc.orientation(system, state, "coupler")
    mass = system.params["coupler"]["mass"]
    expected = mass * 9.81 * jnp.stack([jnp.sin(turn), jnp.cos(turn)])
    np.testing.assert_allclose(slope, expected, rtol=DIFFERENCE)


def test_links_of_a_model_of_mujoco_move_as_there():
    """Compares with MuJoCo's links after a change of mass, center, axes and moments."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(ARM)
    read = jc.from_mjcf(model)
    random, changes = np.random.default_rng(5), {}
    for i in range(1, model.nbody):
        given = random_solid(random, 3)
        changes[model.body(i).name] = given
        moments, axes = np.linalg.eigh(given["inertia"])
        axes[:, 2] *= np.linalg.det(axes)
        model.body_mass[i], model.body_ipos[i] = given["mass"], given["center"]
        model.body_inertia[i] = moments
        mujoco.mju_mat2Quat(model.body_iquat[i], axes.ravel())
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    data.qpos[:] = random.normal(size=model.nq)
    data.qpos[1:5] /= np.linalg.norm(data.qpos[1:5])
    data.qvel[:] = random.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    changed = read.with_params(changes)
    state = changed.state(jnp.asarray(data.qpos), jnp.asarray(data.qvel))
    close(changed.qpos(state), data.qpos)
    method = jc.Method(jc.RK4(), jc.stabilizers.Unstabilized(), jc.solvers.Dense())
    a = jc.forward_dynamics(changed.system, state, jnp.zeros(0), method, 1e-3).acceleration
    close(changed.qacc(state, a), data.qacc, 1e-8)
    close(changed.qpos(changed.start), read.qpos(read.start))


ARM = """<mujoco><worldbody>
  <body name="upper" pos="0 0 1"><joint type="hinge" axis="0 1 0.2"/>
    <geom type="box" size=".1 .05 .3" contype="0" conaffinity="0"/>
    <body name="middle" pos="0.1 0 0.5"><joint type="ball"/>
      <geom type="box" size=".1 .05 .2" pos="0 0 .1" contype="0" conaffinity="0"/>
      <body name="hand" pos="0 0.2 0.3"><joint type="slide" axis="1 0 1"/>
        <geom type="sphere" size=".1" contype="0" conaffinity="0"/>
      </body></body></body>
</worldbody></mujoco>"""


def test_every_choice_of_ten_numbers_is_a_body():
    random = np.random.default_rng(6)
    for scale in (0.1, 1.0, 3.0):
        theta = jnp.asarray(scale * random.normal(size=10))
        body = inertia.from_log_cholesky(theta)
        first, second, third = np.sort(body.moments)
        assert float(body.mass) > 0
        assert first > 0
        assert first + second > third * (1 - 1e-12)
        np.testing.assert_allclose(inertia.log_cholesky(body), theta, rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match=r"\(10,\)"):
        inertia.from_log_cholesky(jnp.zeros(9))


def test_a_box_has_the_ten_numbers_of_its_integrals():
    """The second moment Σ of a box is diagonal, m b²/12 along each edge b."""
    edges = np.array([0.3, 0.5, 0.9])
    theta = inertia.log_cholesky(inertia.box(2.5, tuple(edges)))
    expected = [np.log(2.5) / 2, *np.log(edges**2 / 12) / 2, 0, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(theta, expected, atol=1e-12)


def test_a_state_without_other_frames_stays_what_it_is():
    built = scenes.build("mixed-3d")
    heavier = built.system.with_params({"first": {"mass": 3.0}})
    close(jc.systems.restate(built.state, built.system, heavier), built.state, 1e-15)


def rod_scene():
    scene = jc.Scene(dim=3)
    jc.chains.rod(scene, "rod", np.linspace((0, 0, 0), (1, 0, 0), 3), 1.0, radius=0.01, bending=1.0)
    return scene.build()


BAD = [
    ({"inertia": inertia.sphere(1.0, 0.1), "mass": 2.0}, "give it alone, without \\['mass'\\]"),
    ({"inertia": np.eye(3), "axes": (1.0, 0.0, 0.0, 0.0)}, "a tensor has axes of its own"),
    ({"inertia": np.diag([1.0, 1.0, 3.0])}, "body 'first': principal moments .* triangle"),
    ({"inertia": np.eye(3) + np.eye(3, k=1)}, "body 'first': the tensor must be symmetric"),
    ({"inertia": "thin"}, "body 'first': inertia must be numbers or an Inertia, got 'thin'"),
    ({"inertia": (1.0, 1.0, 3.0)}, "body 'first'.*triangle"),
    ({"inertia": (1.0, 1.0)}, "body 'first': inertia must have shape"),
    ({"center": (1.0, 1.0)}, "body 'first': center must have shape"),
    ({"center": (1.0, np.nan, 1.0)}, "body 'first': center must be finite"),
    ({"axes": (0.0, 0.0, 0.0, 0.0)}, "body 'first': axes must have a length"),
    ({"mass": -1.0}, "body 'first': mass must be positive"),
]


@pytest.mark.parametrize(("fields", "words"), BAD)
def test_a_body_that_cannot_be_is_refused(fields, words):
    built = scenes.build("mixed-3d")
    with pytest.raises(ValueError, match=words):
        built.system.with_params({"first": fields})


def test_a_particle_has_a_mass_alone():
    built = scenes.build("mixed-3d")
    with pytest.raises(ValueError, match="'bob' has no \\['center'\\], it has \\['mass'\\]"):
        built.system.with_params({"bob": {"center": (0.0, 0.0, 0.0)}})
    with pytest.raises(ValueError, match="particle 'bob': mass must be positive"):
        built.system.with_params({"bob": {"mass": 0.0}})


def test_what_goes_by_principal_axes_says_so():
    system, _ = rod_scene()
    name = next(n for n in system.layout.bodies if "center" in system.params[n])
    with pytest.raises(ValueError, match=f"'{name}' has no .*axes"):
        system.with_params({name: {"axes": (1.0, 1.0, 0.0, 0.0)}})
    with pytest.raises(ValueError, match="principal axes of their bodies, which must not turn"):
        system.with_params({name: {"inertia": jnp.diag(jnp.asarray([3.0, 1.0, 2.5]))}})
    same = jax.jit(system.with_params)(system.params)  # traced parameters
    close(same.forces[0].params, system.forces[0].params)


def shape(tree):
    return jax.tree.structure(tree)


@pytest.mark.parametrize("build", [rod_scene, lambda: (scenes.build("mixed-3d").system, None)])
def test_a_traced_mass_leaves_frames_and_structure_alone(build):
    """Under jit no number is known, yet parameters that are not given stay the same."""
    system, _ = build()
    name = next(n for n in system.layout.bodies if "center" in system.params[n])

    def heavier(system, mass):
        return system.with_params({name: {"mass": mass}})

    inside, outside = jax.jit(lambda m: heavier(system, m))(2.0), heavier(system, 2.0)
    given = jax.jit(heavier)(system, 2.0)
    assert shape(inside) == shape(given) == shape(outside) == shape(system)
    jax.tree.map(np.testing.assert_array_equal, inside.constraints, system.constraints)
    jax.tree.map(np.testing.assert_array_equal, given.forces, system.forces)
    last, _ = jax.lax.scan(lambda s, m: (heavier(s, m), None), system, jnp.arange(1.0, 4.0))
    assert last.params[name]["mass"] == 3.0


def test_a_known_tensor_beside_a_traced_mass():
    system, _ = spinning()
    tensor = random_solid(np.random.default_rng(9), 3)["inertia"]
    got = jax.jit(lambda m: system.with_params({"stone": {"mass": m, "inertia": 1.0 * tensor}}))
    close(got(2.0).params, system.with_params({"stone": {"mass": 2.0, "inertia": tensor}}).params)


def test_an_inertia_without_a_centre_in_single_precision():
    scene = jc.Scene(dtype="float32")
    scene.add_body("stone", inertia=inertia.Inertia(1.0, (1.0, 1.0, 1.0), (0.1, 0.2, 0.3)))
    system, _ = scene.build()
    round_one = system.with_params({"stone": {"inertia": inertia.sphere(2.0, 0.5)}})
    np.testing.assert_array_equal(round_one.params["stone"]["center"], (0, 0, 0))
    np.testing.assert_array_equal(round_one.params["stone"]["axes"], (1, 0, 0, 0))


def test_what_a_method_remembers_is_not_of_the_new_frames():
    system, state = spinning()
    method = jc.Method(jc.integrators.GeneralizedAlpha(), jc.stabilizers.Unstabilized())
    state = jc.init(system, method, state.q, state.v)
    turned = system.with_params({"stone": {"axes": (1.0, 1.0, 0.0, 0.0)}})
    after = jc.systems.restate(state, system, turned)
    with pytest.raises((TypeError, ValueError), match="init"):
        jc.step(turned, method, after, None, 1e-3)
    assert (
        jc.systems.restate(state, system, system.with_params({"stone": {"mass": 2.0}})).memory != ()
    )


@pytest.fixture(scope="module")
def remembering():
    """A body with an offset, and a state with the integrals of a PID."""
    scene = jc.Scene(dim=2)
    scene.add_body("bar", inertia=inertia.Inertia(1.0, 0.1, (0.2, 0.1)))
    scene.add(jc.Revolute("pin", jc.WORLD, "bar", point=(-0.3, 0.0)))
    system, state = scene.build()
    method = jc.Method(
        stabilizer=jc.stabilizers.PID(proportional=9.0, derivative=6.0, integral=1.0)
    )
    return system, jc.init(system, method, state.q, state.v)


def test_equal_frames_keep_what_a_method_remembers(remembering):
    """A system returned by `jit` has new arrays of the same frames."""
    system, state = remembering
    assert jax.tree.leaves(state.memory)
    heavier = jax.jit(lambda m: system.with_params({"bar": {"mass": m}}))(2.0)
    restate = jc.systems.restate
    inside = jax.jit(lambda s: restate(s, system, heavier))
    one = jax.jit(lambda s, x: restate(s, x, x.with_params({"bar": {"mass": 2.0}})))
    for after in (restate(state, system, heavier), inside(state), one(state, system)):
        assert shape(after) == shape(state)
        close(after, state, 1e-15)


def test_frames_that_are_unknown_or_changed_drop_what_a_method_remembers(remembering):
    system, state = remembering
    both = jax.jit(jc.systems.restate)(state, system, system)
    assert both.memory == ()
    close((both.q, both.v), (state.q, state.v))
    moved = system.with_params({"bar": {"center": (0.0, 0.1)}})
    assert jc.systems.restate(state, system, moved).memory == ()


def test_systems_of_other_bodies_have_other_states():
    one, other = scenes.build("mixed-3d"), scenes.build("mixed-2d")
    with pytest.raises(ValueError, match="the same bodies in the same order"):
        jc.systems.restate(one.state, one.system, other.system)


def test_a_recording_under_known_forces_tells_all_ten():
    """A body is thrown and pushed at a point of its frame; θ lies within its errors."""
    scene = jc.Scene(dim=3)
    scene.add_body("stone", mass=1.0, inertia=(0.1, 0.1, 0.1), angular_velocity=(1.0, 2.0, -1.0))
    scene.add(jc.forces.ExternalWrench("push", "stone", point=(0.0, 0.0, 0.0)))
    system, state = scene.build()
    random = np.random.default_rng(7)
    pushes = jnp.asarray(random.normal(size=(80, 6)) * np.repeat([3.0, 0.5], 3))
    method = jc.Method(integrator=jc.RK4())

    def seen(theta):
        body = system.with_params({"stone": {"inertia": inertia.from_log_cholesky(theta)}})
        start = jc.systems.restate(state, system, body)

        def look(s, info):
            motion = body.motion("stone", s.q, s.v)
            return jnp.concatenate([motion.position, motion.rotation[0], motion.rotation[1]])

        return jc.rollout(body, method, start, pushes, 0.02, 80, record=look)[1]

    solid = inertia.from_tensor(
        1.5, jnp.asarray(random_tensor(random)), jnp.array([0.1, -0.05, 0.2])
    )
    truth = inertia.log_cholesky(solid)
    data = np.asarray(jax.jit(seen)(truth)) + 1e-3 * random.normal(size=(80, 9))
    guess = inertia.log_cholesky(inertia.box(1.0, (0.9, 1.0, 1.1)))
    found = jc.identify(seen, guess, data, noise=1e-3)
    assert found.untold == []
    assert abs(found.noise - 1) < 0.1
    assert np.all(np.abs(found.params - truth) < 4 * found.errors)


def random_tensor(random):
    """Returns the inertia of a body of about one meter."""
    axes, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return axes @ np.diag([0.12, 0.2, 0.25]) @ axes.T
