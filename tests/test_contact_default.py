"""The default solver of inequality constraints."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.contact.contact_default import EXACT_UP_TO, default_contact_solver
from jaxcon.contact.rows import count_bounds
from jaxcon.system.state import MethodMemory

DT = 2e-3


def grains(count, dtype=None):
    """Particles on a rough floor: two rows each, and no load passes between particles."""
    scene = jc.Scene(dim=2, dtype=dtype)
    for i in range(count):
        scene.add_particle(f"p{i}", mass=1.0 + i, position=(i, 1e-3 * i), velocity=(0.5, 0.0))
        scene.add(jc.PlaneContact(f"floor{i}", jc.WORLD, f"p{i}", friction=0.3))
    return scene.build()


def tower(top):
    """Four stacked boxes in the plane, 32 rows."""
    scene = jc.Scene(dim=2)
    for i in range(4):
        mass, below = (top if i == 3 else 1.0), f"box{i - 1}" if i else jc.WORLD
        middle, edge = (0.0, 0.1 + 0.2 * i), (0.0, 0.2 * i)
        scene.add_body(f"box{i}", mass=mass, inertia=mass * 0.04 / 6, position=middle)
        scene.add(
            jc.contacts.BoxContact(
                f"on{i}", below, f"box{i}", size=(0.2, 0.2), point=edge, friction=0.5
            )
        )
    return scene.build()


def walker(joined, limbs=True):
    """Fourteen feet on the floor, and a contact between two bodies, with or without a hinge.

    A contact within one mechanism is not a stack, because its joints carry the load.
    """
    scene = jc.Scene(dim=2)
    scene.add_body("body", mass=1.0, inertia=0.1, position=(0.0, 1.0))
    scene.add_body("leg", mass=1.0, inertia=0.1, position=(0.0, 0.5))
    if joined:
        scene.add(jc.Revolute("hip", "body", "leg", point=(0.0, 0.75)))
    if limbs:
        radii = {"radius_a": 0.1, "radius_b": 0.1}
        scene.add(jc.contacts.CapsuleContact("limbs", "body", "leg", **radii, friction=0.3))
    for i in range(14):
        foot = (0.1 * i, 0.1)
        scene.add(jc.PlaneContact(f"foot{i}", jc.WORLD, "leg", radius=0.1, center=foot, friction=1))
    return scene.build()


SCENES = {
    "few": (lambda: grains(EXACT_UP_TO // 2), jc.solvers.InteriorPoint),
    "many": (lambda: grains(EXACT_UP_TO // 2 + 1), jc.solvers.GaussSeidel),
    "tower": (lambda: tower(1.0), jc.solvers.InteriorPoint),
    "walker": (lambda: walker(True), jc.solvers.Newton),
    "feet": (lambda: walker(True, limbs=False), jc.solvers.Newton),
    "apart": (lambda: walker(False), jc.solvers.InteriorPoint),
}


@pytest.mark.parametrize("name", SCENES)
def test_the_default_is_chosen_by_structure(name):
    build, kind = SCENES[name]
    system, state = build()
    assert type(default_contact_solver(system, state.q, state.v)) is kind
    assert type(jc.Method().resolve(system, state).contact_solver) is kind
    assert jc.Method().resolve(system, state).contact_solver.smoothing is None
    warm = jax.tree.leaves(state.memory)
    assert [x.shape for x in warm] == ([(count_bounds(system, state.q, state.v),)] * len(warm))
    assert bool(warm) == (kind is not jc.solvers.InteriorPoint)
    chosen = jc.Method(contact_solver=jc.solvers.GaussSeidel(7))
    assert chosen.resolve(system, state) is chosen


def test_the_choice_is_made_while_tracing():
    system, state = grains(14)
    kinds = []

    def traced(system, state):
        kinds.append(type(jc.Method().resolve(system, state).contact_solver))
        return jc.step(system, jc.Method(), state, None, DT)[0].q

    jax.jit(traced)(system, state)
    assert set(kinds) == {jc.solvers.GaussSeidel}


def program(method, system, state):
    """Returns the text of the traced step."""
    return str(jax.make_jaxpr(lambda s: jc.step(system, method, s, None, DT))(state))


def test_few_rows_and_none_leave_the_step_what_it_was():
    for system, state in (grains(3), tower(1.0)):
        exact = jc.Method(contact_solver=jc.solvers.InteriorPoint())
        assert program(jc.Method(), system, state) == program(exact, system, state)
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    swept = jc.Method(contact_solver=jc.solvers.GaussSeidel())
    assert state.memory == ()
    assert program(jc.Method(), system, state) == program(swept, system, state)


def slid(system, method, state, steps=40):
    """Returns the final state of a `lax.scan` over `step`."""

    def one(state, _):
        return jc.step(system, method, state, None, DT)[0], None

    return jax.jit(lambda s: jax.lax.scan(one, s, None, steps)[0])(state)


def test_states_go_from_one_solver_to_another():
    """States come from `build`, from `init`, and from versions without a default solver."""
    system, state = grains(14)
    auto, exact, swept = (
        jc.Method(contact_solver=x)
        for x in (None, jc.solvers.InteriorPoint(), jc.solvers.GaussSeidel())
    )
    ends = [slid(system, method, state) for method in (auto, exact, swept)]
    for end in ends:
        assert int(end.status) == 0
        assert jax.tree.structure(end) == jax.tree.structure(state)
        np.testing.assert_allclose(end.q, ends[0].q, atol=1e-9)
        # no load passes between grains: λ_n = m g
        weight = 9.81 * (1.0 + np.arange(14))
        np.testing.assert_allclose(end.memory.contact_multipliers[:14], weight, rtol=1e-6)
    old = dataclasses.replace(state, memory=())
    for method in (auto, exact):
        end = slid(system, method, old)
        assert end.memory == ()
        np.testing.assert_allclose(end.q, ends[0].q, atol=1e-9)
    with pytest.raises(ValueError, match="does not have the memory"):
        jc.step(system, swept, old, None, DT)
    for method in (auto, swept):
        memory = jc.init(system, method, state.q, state.v).memory
        assert jax.tree.structure(memory) == jax.tree.structure(state.memory)
    assert jc.init(system, exact, state.q, state.v).memory == ()


def test_other_memory_is_still_asked_for():
    system, state = grains(14)
    pid = jc.Method(stabilizer=jc.stabilizers.PID(), recovery=jc.stabilizers.Recovery())
    with pytest.raises(ValueError, match="does not have the memory"):
        jc.step(system, pid, state, None, DT)
    begun = jc.init(system, pid, state.q, state.v)
    assert begun.memory.contact_multipliers.shape == (28,)
    assert int(slid(system, pid, begun, 3).status) == 0


def test_a_warm_start_is_used_where_there_is_one():
    system, state = walker(True)
    warm = dataclasses.replace(
        state, memory=MethodMemory(contact_multipliers=state.memory.contact_multipliers + 1.0)
    )
    method = jc.Method(contact_solver=jc.solvers.GaussSeidel(1))
    rates = [jc.step(system, method, s, None, DT)[0].v for s in (state, warm)]
    assert np.max(np.abs(rates[0] - rates[1])) > 1e-6


def test_a_heavy_top_stands_by_default():
    """With sweeps the heavy box would sink into the boxes below."""
    system, state = tower(100.0)
    end = slid(system, jc.Method(), state, 200)
    assert int(end.status) == 0
    assert np.max(np.abs(end.q - state.q)) < 1e-6


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_default_is_batched_and_differentiated(dtype):
    """A sliding grain comes to rest after v²/(2 μ g), whose derivative by v is v/(μ g)."""
    system, state = grains(14, dtype)

    def place(speed):
        start = dataclasses.replace(state, v=state.v.at[system.layout.v("p0")[0]].set(speed))
        return slid(system, jc.Method(), start, 100).q[system.layout.q("p0")[0]]

    speeds = jnp.asarray([0.3, 0.5], dtype)
    ends, slopes = jax.vmap(lambda v: jax.jvp(place, (v,), (jnp.ones_like(v),)))(speeds)
    assert ends.dtype == dtype
    wanted = np.asarray(speeds) / (0.3 * 9.81)
    np.testing.assert_allclose(slopes, wanted, rtol=0.03)
    np.testing.assert_allclose(jax.vmap(jax.grad(place))(speeds), slopes, rtol=1e-4)


def test_what_looks_into_a_step_takes_the_default_too():
    system, state = grains(14)
    found = jc.forward_dynamics(system, state, None, jc.Method(), DT)
    exact = jc.forward_dynamics(
        system, state, None, jc.Method(contact_solver=jc.solvers.InteriorPoint()), DT
    )
    np.testing.assert_allclose(found.acceleration, exact.acceleration, atol=1e-8)
    assert jc.analysis.find_first_failure(system, jc.Method(), state, None, DT, 3) is None
    broken = dataclasses.replace(state, v=state.v.at[0].set(jnp.inf))
    assert jc.analysis.find_first_failure(system, jc.Method(), broken, None, DT, 3).step == 0


def test_multipliers_stay_where_a_body_is_restated():
    system, state = walker(True)
    moved = system.with_params({"leg": {"center": (0.0, 0.01)}})
    state = dataclasses.replace(
        state, memory=MethodMemory(contact_multipliers=state.memory.contact_multipliers + 2.0)
    )
    after = jc.systems.restate(state, system, moved)
    np.testing.assert_array_equal(after.memory.contact_multipliers, 2.0)
    assert int(jc.step(moved, jc.Method(), after, None, DT)[0].status) == 0


def test_worlds_along_trailing_axes_have_the_structure_of_one():
    for name, (build, kind) in SCENES.items():
        system, state = build()
        shared, worlds = (
            jax.tree.map(lambda x, n=n: x[..., None].repeat(n, -1), tree)
            for tree, n in ((system, 1), (state, 3))
        )
        assert type(default_contact_solver(shared, worlds.q, worlds.v)) is kind, name
