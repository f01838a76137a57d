"""Contacts without friction, and contact elements with several points."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE

import jaxcon as jc
from jaxcon.contact.contact import nearest
from jaxcon.contact.rows import linearize_bounds
from jaxcon.core.lanes import Vector

H = 1e-3


def bounded(system, state):
    """Returns the inequality rows at a state."""
    return linearize_bounds(system, state.q, state.v, state.time, None, jnp.asarray(H))


def particles(dim, **frictions):
    """Particles that slide over one floor at 1 m/s, each with its own friction coefficient."""
    scene = jc.Scene(dim=dim)
    rest = (0.0,) * (dim - 1)
    for i, (name, friction) in enumerate(frictions.items()):
        place = (float(i), *rest)
        scene.add_particle(name, mass=1.0, position=place, velocity=(1.0, *rest))
        scene.add(jc.PlaneContact(f"{name} floor", jc.WORLD, name, friction=friction))
    return scene.build()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(
    "solver", [jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel()], ids=["point", "sweeps"]
)
def test_contacts_with_and_without_friction_share_a_scene(dim, solver):
    """Without friction particles slide on and have one row; with it they are braked by μ g."""
    system, state = particles(dim, ice=0.0, road=0.4, glass=0)
    kinds = bounded(system, state).kinds
    assert (kinds.single, kinds.contacts, kinds.tangents) == (2, 1, dim - 1)
    method = jc.Method(contact_solver=solver)
    state = jc.init(system, method, state.q, state.v)
    final, forces = jax.jit(
        lambda s: jc.rollout(system, method, s, None, H, 50, record=lambda _, i: i.reactions)
    )(state)
    np.testing.assert_allclose(jc.velocity(system, final, "ice")[0], 1.0, rtol=1e-9)
    np.testing.assert_allclose(jc.velocity(system, final, "glass")[0], 1.0, rtol=1e-9)
    np.testing.assert_allclose(
        jc.velocity(system, final, "road")[0], 1 - 0.4 * 9.81 * 0.05, rtol=1e-9
    )
    np.testing.assert_allclose(forces["ice floor"][-1], [9.81], rtol=1e-9)
    sideways = [0.0] * (dim - 2)
    want = [9.81, *sideways, 0.4 * 9.81]
    np.testing.assert_allclose(np.sort(np.abs(forces["road floor"][-1])), np.sort(want), atol=1e-9)


def test_a_friction_that_was_left_out_is_missed_by_name():
    system, _ = particles(2, ice=0.0, road=0.4)
    assert "friction" not in system.params["ice floor"]
    with pytest.raises(ValueError, match=r"no \['friction'\].*friction=jnp.zeros"):
        system.with_params({"ice floor": {"friction": 0.3}})
    with pytest.raises(ValueError, match=r"no \['restitution'\].*restitution=jnp.zeros"):
        system.with_params({"road floor": {"restitution": 0.3}})
    with pytest.raises(ValueError, match=r"no \['grip'\], it has \[.*\]\.$"):
        system.with_params({"ice floor": {"grip": 0.3}})
    system, _ = particles(2, ice=jnp.zeros(()))
    changed = system.with_params({"ice floor": {"friction": 0.3}})
    np.testing.assert_allclose(changed.params["ice floor"]["friction"], 0.3)


CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
SIZE = (0.4, 0.3, 0.1)
SLOPE = 0.4
TILT = (0.9, 0.1, -0.2, 0.3)


def crate(contacts, velocity=(0.3, -0.1, 0.0)):
    """A crate of 2 kg that slides; the slope tilts gravity, not the floor."""
    scene = jc.Scene(gravity=(9.81 * np.sin(SLOPE), 0.0, -9.81 * np.cos(SLOPE)))
    inertia = jc.inertia.box(2.0, SIZE)
    scene.add_body("crate", inertia=inertia, position=(0, 0, 0.05), velocity=velocity)
    for contact in contacts:
        scene.add(contact)
    return scene.build()


def on_floor(name, **given):
    return jc.PlaneContact(name, jc.WORLD, "crate", friction=0.3, **given)


def slid(system, state, steps=30):
    """Returns the final state and the reactions of each step."""
    method = jc.Method(contact_solver=jc.solvers.GaussSeidel(sweeps=60))
    state = jc.init(system, method, state.q, state.v)
    final, forces = jax.jit(
        lambda s: jc.rollout(system, method, s, None, H, steps, record=lambda _, i: i.reactions)
    )(state)
    return final, forces


def test_points_in_one_element_are_those_in_many():
    """Each point of one element has the reactions of its separate contact."""
    corners = [(x * SIZE[0] / 2, y * SIZE[1] / 2, 0.0) for x, y in CORNERS]
    apart, forces_apart = slid(*crate(on_floor(f"{k}", center=x) for k, x in enumerate(corners)))
    final, forces = slid(*crate([on_floor("floor", center=corners)]))
    np.testing.assert_allclose(final.q, apart.q, atol=1e-13)
    assert forces["floor"].shape == (30, 4, 3)
    every = jnp.stack([forces_apart[f"{k}"] for k in range(4)], axis=1)
    np.testing.assert_allclose(forces["floor"], every, atol=1e-9)


def test_a_box_slides_on_its_corners():
    """The box accelerates like a block, and its corners share its weight."""
    box = jc.contacts.BoxContact("floor", jc.WORLD, "crate", size=SIZE, friction=0.3)
    final, forces = slid(*crate([box], velocity=(0.3, 0.0, 0.0)))
    assert forces["floor"].shape == (30, 8, 3)
    total = jnp.sum(forces["floor"][-1], axis=0)
    np.testing.assert_allclose(total[0], 2 * 9.81 * np.cos(SLOPE), rtol=1e-6)
    np.testing.assert_allclose(jnp.linalg.norm(total[1:]), 0.3 * total[0], rtol=1e-6)
    speed = 0.3 + 30 * H * 9.81 * (np.sin(SLOPE) - 0.3 * np.cos(SLOPE))
    np.testing.assert_allclose(final.v[:3], [speed, 0.0, 0.0], atol=1e-6)


def gaps(element, dim=3, **body):
    """Returns φ of the contact points of a body on a floor."""
    scene = jc.Scene(dim=dim)
    scene.add_body("crate", **body)
    scene.add(element)
    system, state = scene.build()
    found = bounded(system, state)
    return np.asarray(found.gap[found.layout.rows(element.name)[:, 0]])


def test_the_corners_of_a_box_lie_where_the_body_was_given():
    """The corners follow the body's frame, not its principal axes, in space and in the plane."""
    turn, place = np.array(TILT) / np.linalg.norm(TILT), (0.1, 0.2, 1.0)
    tensor = jnp.asarray([[2.0, 0.3, 0.1], [0.3, 3.0, -0.2], [0.1, -0.2, 2.5]])
    off = jc.inertia.from_tensor(2.0, tensor, center=jnp.asarray([0.1, -0.2, 0.3]))
    body = {"inertia": off, "position": place, "quaternion": turn}
    box = jc.contacts.BoxContact("box", jc.WORLD, "crate", size=SIZE)
    want = jc.contacts.box_corners(SIZE, place, turn)
    np.testing.assert_allclose(gaps(box, **body), want[:, 2], atol=1e-12)
    given = {"position": (0.4, 0.3, 0.7), "orientation": TILT}
    box = jc.contacts.BoxContact("box", jc.WORLD, "crate", size=SIZE, **given)
    body = {"inertia": jc.inertia.box(2.0, SIZE), "position": place}
    want = jc.contacts.box_corners(SIZE, given["position"], turn)
    np.testing.assert_allclose(gaps(box, **body), want[:, 2], atol=1e-12)
    assert np.ptp(want[:, 2]) > 0.1
    body = {"mass": 1.0, "inertia": 1.0, "position": (0.3, 1.0), "angle": 0.4}
    box = jc.contacts.BoxContact("box", jc.WORLD, "crate", size=SIZE[:2])
    found = gaps(box, 2, **body)
    np.testing.assert_allclose(
        found, jc.contacts.box_corners(SIZE[:2], (0.3, 1.0), 0.4)[:, 1], atol=1e-12
    )
    np.testing.assert_allclose(found.min(), 1 - 0.2 * np.sin(0.4) - 0.15 * np.cos(0.4), rtol=1e-9)


def test_gradients_by_the_size_of_a_box():
    """A planar box lands on a corner; a batch of worlds gives the central differences."""
    scene = jc.Scene(dim=2)
    scene.add_body("crate", mass=2.0, inertia=0.03, position=(0, 0.18), angle=0.1)
    scene.add(jc.contacts.BoxContact("box", jc.WORLD, "crate", size=SIZE[:2], friction=0.3))
    system, state = scene.build()
    method = jc.Method(contact_solver=jc.solvers.GaussSeidel(sweeps=200))
    state = jc.init(system, method, state.q, state.v)

    def end(x):
        changed = system.with_params({"box": {"size": x[:2], "friction": x[2]}})
        return jnp.sum(jc.rollout(changed, method, state, None, 2e-3, 40)[0].q ** 2)

    at, step = jnp.asarray([*SIZE[:2], 0.3]), 1e-6 * jnp.eye(3)
    worlds = jnp.concatenate([at[None], at[None] + step, at[None] - step])
    ends, slopes = jax.jit(jax.vmap(jax.value_and_grad(end)))(worlds)
    assert np.abs(slopes[0]).min() > 1e-4
    np.testing.assert_allclose(slopes[0], (ends[1:4] - ends[4:]) / 2e-6, rtol=DIFFERENCE)


@pytest.mark.parametrize(
    ("element", "match"),
    [
        (
            jc.contacts.BoxContact("b", jc.WORLD, "crate", size=(1.0, 1.0)),
            r"'b': size must have shape \(3,",
        ),
        (
            jc.contacts.BoxContact("b", jc.WORLD, "crate", size=(1.0, 1.0, 0.0)),
            "size must be positive",
        ),
        (jc.contacts.BoxContact("b", jc.WORLD, "crate", size=SIZE, friction=-1.0), "friction"),
        (
            jc.contacts.BoxContact("b", jc.WORLD, "crate", size=SIZE, restitution=1.5),
            "lie in 0 to 1",
        ),
        (
            jc.contacts.BoxContact("b", jc.WORLD, "crate", size=SIZE, orientation=(1, 0)),
            "orientation must",
        ),
        (jc.contacts.BoxContact("b", jc.WORLD, "dot", size=SIZE), "'dot' is a particle"),
        (jc.PlaneContact("b", jc.WORLD, "crate", damping=1.0), "'b': damping is of a soft stop"),
        (jc.PlaneContact("b", jc.WORLD, "dot", center=np.zeros((2, 3))), "a particle is one"),
        (jc.PlaneContact("b", "dot", "crate"), "'b': it needs an orientation, but 'dot'"),
        (jc.PlaneContact("b", jc.WORLD, "crate", center=np.zeros((2, 2))), r"shape \(2, 3\)"),
        (jc.PlaneContact("b", jc.WORLD, "crate", center=np.zeros((0, 3))), r"\(k, 3\)"),
        (jc.PlaneContact("b", jc.WORLD, "crate", center=np.zeros((1, 3))), r"\(k, 3\)"),
    ],
)
def test_bad_numbers_are_refused(element, match):
    scene = jc.Scene()
    scene.add_body("crate", inertia=jc.inertia.box(1.0, SIZE))
    scene.add_particle("dot", mass=1.0)
    scene.add(element)
    with pytest.raises(ValueError, match=match):
        scene.build()


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"size": (1.0,)}, r"size must have shape \(2,\) or \(3,\)"),
        ({"position": (0.1,)}, r"position must have shape \(3,\), got \(1,\)"),
        ({"orientation": 0.3}, r"orientation must have shape \(4,\)"),
        ({"orientation": (0.0, 0.0, 0.0, 0.0)}, "orientation must have a length"),
        ({"size": SIZE[:2], "orientation": (1.0, 0.0, 0.0, 0.0)}, r"shape \(\), got \(4,\)"),
        ({"size": SIZE[:2], "orientation": np.nan}, "orientation must be finite"),
    ],
)
def test_bad_corners_are_refused(given, match):
    with pytest.raises(ValueError, match=match):
        jc.contacts.box_corners(**({"size": SIZE} | given))


def test_corners_take_a_quaternion_of_any_length():
    """The quaternion is normalized, as in elements; else the box would change its size."""
    once, twice = (jc.contacts.box_corners(SIZE, None, k * np.array(TILT)) for k in (1.0, 2.0))
    np.testing.assert_allclose(twice, once, atol=1e-15)
    lengths = np.linalg.norm(once - np.mean(once, axis=0)[None], axis=1)
    np.testing.assert_allclose(lengths, np.linalg.norm(SIZE) / 2, rtol=1e-14)


def test_a_capsule_lies_on_both_ends():
    """The normal forces of both ends follow from the moments about an off-center center of mass.

    From a gap φ both ends leave with u* = −φ/h. From a penetration, u* is a fifth of that and at
    most 0.1 m/s. Then N₁ + N₂ = N = m (g + u*/h). With a lever of r + φ/2, sliding friction loads
    the front end: 2 l N₂ = N (l + d) + μ N (r + φ/2).
    """
    mass, half, radius, off, μ = 2.0, 0.5, 0.1, 0.2, 0.3
    scene = jc.Scene(dim=2)
    scene.add_body("capsule", mass=mass, inertia=0.2, position=(off, radius))
    ends = ((-half, radius), (half, radius))
    floor = jc.PlaneContact("floor", jc.WORLD, "capsule", radius, ends, friction=μ)
    scene.add(floor)
    system, state = scene.build()
    gap = np.array([2e-6, 0.0, -1e-4, -1e-2, -1e-4])
    wanted = np.array([-2e-3, 0.0, 0.02, 0.1, 0.02])
    speed = np.array([0.0, 0.0, 0.0, 0.0, 1.0])

    def step(gap, speed):
        start = dataclasses.replace(state, q=state.q.at[1].add(gap), v=state.v.at[0].set(speed))
        new, info = jc.step(system, jc.Method(), start, None, H)
        return new.v, info.reactions["floor"], info.reactions.gap

    v, forces, gaps = jax.jit(jax.vmap(step))(gap, speed)
    both = mass * (9.81 + wanted / H)
    rub = μ * both * (speed > 0)
    front = (both * (half + off) + rub * (radius + gap / 2)) / (2 * half)
    np.testing.assert_allclose(gaps[:, :2], gap[:, None] + np.zeros(2), atol=1e-15)
    np.testing.assert_allclose(forces[..., 0], np.stack([both - front, front], 1), rtol=1e-9)
    np.testing.assert_allclose(np.abs(forces[..., 1].sum(axis=1)), rub, atol=1e-7)
    after = np.stack([speed - H * rub / mass, wanted, 0 * gap], 1)
    np.testing.assert_allclose(v, after, atol=1e-11)


@pytest.mark.parametrize("order", [1, -1], ids=["capsule first", "ball first"])
def test_a_ball_hits_a_capsule_in_the_plane(order):
    """A ball hits the side or either end of a capsule: gap, contact point, impulse and friction.

    The contact point x is in the middle of the gap; K is the mobility of the two bodies there. The
    force is F = λ (n − μ t) for a slip along t. Sweeps close the gap within the step before the
    impact: n·K F h = −φ/h − n·u.
    """
    m, μ, radii = np.array([3.0, 0.5]), 0.2, np.array([0.1, 0.15])
    inertia, apart = np.array([0.4, 0.006]), 1e-4
    along = np.array([np.cos(0.4), np.sin(0.4)])
    across = np.array([-along[1], along[0]])
    middle = np.array([0.3, -0.2])
    ends = middle + np.array([-0.4, 0.6])[:, None] * along
    beyond = (along + across) / np.sqrt(2)
    feet = np.stack([middle + 0.25 * along, ends[1], ends[0]])
    normals = np.stack([across, beyond, -along])
    balls = feet + (radii.sum() + apart) * normals
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("capsule", mass=m[0], inertia=inertia[0], position=middle)
    scene.add_body("ball", mass=m[1], inertia=inertia[1], position=balls[0])
    shapes = [("capsule", radii[0], ends), ("ball", radii[1], None)][::order]
    named = zip("ab", shapes, strict=True)
    given = {f"{k}_{s}": x for s, own in named for k, x in zip(FIELDS, own, strict=True)}
    scene.add(jc.contacts.CapsuleContact("touch", **given, friction=μ))
    system, state = scene.build()
    places = {name: np.array(range(6))[system.layout.q(name)] for name in ("capsule", "ball")}
    before = {"capsule": np.array([0.1, -0.2, 0.5]), "ball": np.array([0.0, 0.0, 9.0])}

    def step(ball, speed):
        q = state.q.at[places["ball"][:2]].set(ball)
        v = state.v.at[places["capsule"]].set(before["capsule"])
        v = v.at[places["ball"]].set(speed)
        start = dataclasses.replace(state, q=q, v=v)
        new, info = jc.step(
            system,
            jc.Method(contact_solver=jc.solvers.GaussSeidel(100, warm=False)),
            start,
            None,
            H,
        )
        return new.v, info.reactions["touch"], info.reactions.gap[0]

    speeds = np.concatenate([-2 * normals, np.full((3, 1), before["ball"][2])], axis=1)
    found, forces, gaps = jax.jit(jax.vmap(step))(balls, speeds)
    np.testing.assert_allclose(gaps, apart, atol=1e-14)
    for i, n in enumerate(normals):
        place = feet[i] + (radii[0] + apart / 2) * n
        arms = [place - middle, place - balls[i]]
        turns = [np.array([-arm[1], arm[0]]) for arm in arms]
        motions = [before["capsule"], speeds[i]]
        slip = np.diff(
            [v[:2] + v[2] * turn for v, turn in zip(motions, turns, strict=True)], axis=0
        )[0]
        t = slip - n * (n @ slip)
        pull = n - μ * t / np.linalg.norm(t)
        moved = sum(pull / m[k] + turns[k] * (turns[k] @ pull) / inertia[k] for k in (0, 1))
        impulse = (-apart / H - n @ slip) / (n @ moved)
        assert abs(t @ slip) > impulse * abs(t @ moved)  # it slides until the impact ends
        np.testing.assert_allclose(H * forces[i, 0], impulse, rtol=1e-9)
        np.testing.assert_allclose(H * abs(forces[i, 1]), μ * impulse, rtol=1e-9)
        for k, (name, sign) in enumerate((("capsule", -1), ("ball", 1))):
            change = sign * impulse * np.array([*pull / m[k], turns[k] @ pull / inertia[k]])
            np.testing.assert_allclose(found[i, places[name]], motions[k] + change, atol=1e-11)


FIELDS = ("body", "radius", "segment")


def test_parallel_capsules_touch_in_the_middle_of_what_faces():
    """Contact at an end of the overlap would let a capsule rock on the other one.

    Without overlap the two nearest ends touch.
    """
    starts, ends = np.array([8.0, -1.0, 3.0, 11.0]), np.array([9.0, 1.0, 2.0, 12.0])
    lanes = (0.0 * starts, 10.0 + 0.0 * starts, starts, ends)
    corners = [Vector(jnp.asarray(x), jnp.full(4, float(i > 1))) for i, x in enumerate(lanes)]
    x, y, skew, crossing = nearest(*corners)
    assert not np.any(skew)
    assert not np.any(crossing)
    np.testing.assert_allclose(x[0], [8.5, 0.5, 2.5, 10.0], atol=1e-15)
    np.testing.assert_allclose(y[0], [8.5, 0.5, 2.5, 11.0], atol=1e-15)


@pytest.mark.parametrize(
    "solver", [jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel(60)], ids=str
)
def test_a_box_rests_on_a_slope_in_single_precision(solver):
    """Inactive corners 0.1 m above the floor do not disturb the forces of resting corners."""
    down = 9.81 * np.array([np.sin(0.3), 0.0, -np.cos(0.3)])
    scene = jc.Scene(dim=3, gravity=tuple(down), dtype=jnp.float32)
    scene.add_body("box", inertia=jc.inertia.box(1.0, (0.2, 0.2, 0.1)), position=(0.0, 0.0, 0.05))
    holding = 1.001 * np.tan(0.3)
    floor = jc.contacts.BoxContact("floor", jc.WORLD, "box", size=(0.2, 0.2, 0.1), friction=holding)
    scene.add(floor)
    system, state = scene.build()
    method = jc.Method(contact_solver=solver)
    state = jc.init(system, method, state.q, state.v)
    go = jax.jit(lambda s: jc.rollout(system, method, s, None, 2e-3, 500)[0])
    crept = np.abs(np.asarray(go(state).q - state.q)).max()
    assert crept < 5e-5
