"""Ropes and rods: shape, bending energy, equilibrium under loads, and scaling with length."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc
from jaxcon.linear import graphs


def circle(links, radius, dim=2):
    """Returns points on half a circle."""
    angles = np.linspace(0, np.pi, links + 1)
    points = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.pad(points, ((0, 0), (0, dim - 2)))


def helix(links):
    s = np.linspace(0, 4, links + 1)
    return np.column_stack([np.cos(s), np.sin(s), 0.3 * s])


def test_a_rope_keeps_its_mass_and_its_lengths():
    scene = jc.Scene(dim=3)
    points = helix(12)
    chain = jc.chains.rope(scene, "rope", points, 2.4, start=None)
    system, state = scene.build()
    assert chain.bodies == tuple(f"rope.{i}" for i in range(13))
    assert len(chain.joints) == 12
    masses = np.array([system.params[name]["mass"] for name in chain.bodies])
    np.testing.assert_allclose(masses.sum(), 2.4, rtol=IDENTITY)
    np.testing.assert_allclose(masses[0], 0.1, rtol=IDENTITY)
    assert jc.violation(system, state).worst < 1e-15
    places = [jc.position(system, state, name) for name in chain.bodies]
    np.testing.assert_allclose(places, points, atol=1e-15)


@pytest.mark.parametrize("dim", [2, 3])
def test_bending_energy_of_an_arc(dim):
    """Each joint has the energy ½ (B/s) (2 sin δ/2)², in ropes and in rods of stiffness B/s."""
    n, radius, stiffness = 20, 1.5, 0.7
    points, δ = circle(n, radius, dim), np.pi / n
    s = 2 * radius * np.sin(δ / 2)
    expected = (n - 1) * stiffness / s * 2 * np.sin(δ / 2) ** 2
    for build, options in (
        (jc.chains.rope, {}),
        (jc.chains.rod, {"radius": 0.02, "twisting": 0.5}),
    ):
        scene = jc.Scene(dim=dim, gravity=np.zeros(dim))
        options = {} if dim == 2 else options
        build(scene, "c", points, 1.0, end=jc.WORLD, bending=stiffness, **options)
        system, state = scene.build()
        np.testing.assert_allclose(jc.energy(system, state).potential, expected, rtol=1e-10)
        assert jc.violation(system, state).worst < 1e-14


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("straight", [True, False])
def test_forces_are_those_of_the_energy(dim, straight):
    scene = jc.Scene(dim=dim, gravity=np.zeros(dim))
    points = helix(4)[:, :dim]
    twist = {} if dim == 2 else {"radius": 0.05, "twisting": 0.8}
    jc.chains.rod(scene, "rod", points, 1.0, bending=1.3, straight=straight, **twist)
    jc.chains.rope(scene, "rope", points + 1.0, 1.0, bending=0.9)
    system, state = scene.build()
    if not straight:
        slack = system.with_params({f"rope.bend{i}": {"stiffness": 0.0} for i in (1, 2, 3)})
        np.testing.assert_allclose(slack.force(state.q, 0 * state.v, 0.0), 0, atol=1e-14)
    step = jnp.asarray(0.3 * np.random.default_rng(0).normal(size=state.v.shape))
    q, rest = system.retract(state.q, step), jnp.zeros_like(state.v)

    def potential(step):
        return system.energy(system.retract(q, step), rest, 0.0).potential

    expected = -jax.jit(jax.grad(potential))(rest)
    np.testing.assert_allclose(system.force(q, rest, 0.0), expected, atol=1e-12)


def test_small_turns_meet_the_stiffnesses():
    """The energy is ½ k_t θ² for a turn about the axis of the rod and ½ k_b θ² across it."""
    scene = jc.Scene(dim=3, gravity=np.zeros(3))
    for name in ("a", "b"):
        scene.add_body(name, mass=1.0, inertia=(1.0, 1.0, 1.0))
    scene.add(jc.forces.Flexure("f", "a", "b", bending=2.0, twisting=3.0))
    system, state = scene.build()
    turns = system.layout.v("b")[3:]

    def potential(θ):
        step = jnp.zeros_like(state.v).at[turns].set(θ)
        return system.energy(system.retract(state.q, step), state.v, 0.0).potential

    np.testing.assert_allclose(
        jax.jit(jax.hessian(potential))(jnp.zeros(3)), np.diag([3.0, 2.0, 2.0]), atol=1e-12
    )


def test_a_hanging_chain_in_space_and_at_unequal_heights_rests():
    start, end, gravity = (0.0, 0.0, 1.0), (1.0, 0.5, 0.7), (0.0, 0.0, -9.81)
    scene = jc.Scene(dim=3, gravity=gravity)
    jc.chains.rope(
        scene, "rope", jc.chains.hanging(start, end, 2.0, 30, gravity), 1.5, end=jc.WORLD
    )
    system, state = scene.build()
    info = jc.forward_dynamics(system, state, None, jc.Method(), 1e-3)
    np.testing.assert_allclose(info.acceleration, 0, atol=1e-8)
    assert np.all(info.multipliers < 0)


def test_the_derivative_by_the_points():
    """The length of each link follows the traced points of the rope."""

    def lengths(points):
        scene = jc.Scene(dim=2)
        jc.chains.rope(scene, "rope", points, 1.0)
        system, _ = scene.build()
        return jnp.stack([system.params[f"rope.link{i}"]["length"] for i in range(3)])

    slope = jax.jacfwd(lengths)(jnp.asarray([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (3.0, 1.0)]))
    np.testing.assert_allclose(slope[2, 3], (1.0, 0.0), atol=IDENTITY)


@pytest.mark.parametrize("build", [jc.chains.rope, jc.chains.rod])
def test_the_derivative_by_the_mass(build):
    """The potential energy is proportional to the mass, which is traced."""
    points = np.array([(0.0, 0.0), (0.5, -1.0), (1.5, -1.0), (2.0, 0.5)])

    def height(mass):
        scene = jc.Scene(dim=2)
        build(scene, "chain", points, mass)
        return jc.energy(*scene.build()).potential

    value, slope = jax.jit(jax.value_and_grad(height))(3.0)
    np.testing.assert_allclose(value, height(3.0), rtol=IDENTITY)
    np.testing.assert_allclose(slope, value / 3.0, rtol=IDENTITY)


def test_the_plan_of_a_long_chain_is_one_run():
    """The traced program does not grow with the chain; planning and naming are not quadratic."""
    sizes = {}
    for n in (50, 2000):
        scene = jc.Scene(dim=2)
        jc.chains.rope(
            scene, "rope", np.column_stack([np.linspace(0, 1, n + 1)] * 2), 1.0, end=jc.WORLD
        )
        system, state = scene.build()
        step = jax.make_jaxpr(lambda s, system=system: jc.step(system, jc.Method(), s, None, 1e-3))
        sizes[n] = str(step(state)).count("\n")
    assert sizes[2000] < 1.2 * sizes[50]


def test_the_heap_finds_what_a_search_finds():
    random = np.random.default_rng(0)
    for n in (1, 7, 30):
        graph = {i: set() for i in range(n)}
        for i, j in random.integers(0, n, (2 * n, 2)):
            if i != j:
                graph[int(i)].add(int(j))
                graph[int(j)].add(int(i))
        distance = {i: int(random.integers(0, 4)) for i in graph}
        assert graphs.minimum_degree(graph, distance)[0] == searched(graph, distance)


def searched(neighbours, distance):
    """Returns the elimination order found by a search of all nodes at each step."""
    graph, order, near = {k: set(v) for k, v in neighbours.items()}, [], set()
    while graph:
        node = min(graph, key=lambda x: (len(graph[x]), x not in near, distance[x], x))
        near = graph.pop(node)
        for other in near:
            graph[other] = (graph[other] | near) - {other, node}
        order.append(node)
    return order


SPAN = np.linspace((0.0, 0.0), (1.0, 0.0), 4)
MISTAKES = {
    "shape": (
        lambda s: jc.chains.rope(s, "r", np.ones((4, 3)), 1.0),
        r"\(links \+ 1, 2\).*\(4, 3\)",
    ),
    "one link": (lambda s: jc.chains.rope(s, "r", SPAN[:2], 1.0), "2 links or more"),
    "twice": (
        lambda s: jc.chains.rod(s, "r", SPAN[[0, 1, 1, 2]], 1.0),
        "points 1 and 2 must be apart",
    ),
    "nan": (lambda s: jc.chains.rope(s, "r", SPAN * np.nan, 1.0), "points must be finite"),
    "mass": (lambda s: jc.chains.rope(s, "r", SPAN, -1.0), "mass must be positive"),
    "unknown end": (lambda s: jc.chains.rope(s, "r", SPAN, 1.0, end="hook"), "'hook' is unknown"),
    "stiffness": (
        lambda s: jc.chains.rope(s, "r", SPAN, 1.0, bending=-1.0),
        "bending must be zero or",
    ),
    "twist": (
        lambda s: s.add(jc.forces.Flexure("f", "p", jc.WORLD, 1.0)),
        "'p' is a particle: it has no orientation",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named(mistake):
    call, words = MISTAKES[mistake]
    scene = jc.Scene(dim=2)
    scene.add_particle("p", mass=1.0, position=(5.0, 0.0))

    def build():
        call(scene)
        return scene.build()

    with pytest.raises(ValueError, match=words):
        build()


def test_a_rod_in_space_needs_a_radius_and_a_bounded_twist():
    scene = jc.Scene(dim=3)
    with pytest.raises(ValueError, match="a radius is needed"):
        jc.chains.rod(scene, "r", helix(3), 1.0)
    jc.chains.rod(scene, "r", helix(3), 1.0, radius=0.1, bending=1.0, twisting=3.0)
    with pytest.raises(ValueError, match="twisting must be at most twice bending"):
        scene.build()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (((0, 0), (1, 0), 0.9, 5), "does not reach over 1 m"),
        (((0, 0), (0, 1), 2.0, 5), "above one another"),
        (((0, 0), (1, 0), 2.0, 1), "links must be a whole number from 2"),
        (((0, 0), (1, 0, 0), 2.0, 5), "must be points"),
    ],
)
def test_a_chain_that_cannot_hang_is_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        jc.chains.hanging(*arguments)


@pytest.mark.parametrize(("end", "links"), [((0.3, 0.5), 2), ((0.2, 0.0), 3)])
def test_links_too_long_for_their_gap_cannot_hang(end, links):
    with pytest.raises(ValueError, match="without a link under pressure.*shorter"):
        jc.chains.hanging((0.0, 0.0), end, 1.2, links)
