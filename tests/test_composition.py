"""JAX features applied to steps and systems: meshes, export, donation, hashing, equality."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from jax import export

import jaxcon as jc
from jaxcon.core.static_data import decoded, encoded

ROOT = Path(__file__).parents[1]


def pull(q, v, t, u, p):
    return -p["k"] * q


def weight(q, p):
    return jnp.eye(2) * p["m"]


def stop():
    return jc.Limit("stop", "hinge", -1e-3, 0.1)


SCENES = {
    "plane": scenes.arm,
    "stop": lambda: scenes.arm(stop()),
    "turns": lambda: scenes.arm(jc.forces.JointSpring("spring", "hinge", 2.0), dim=3),
    "motor": lambda: scenes.arm(
        jc.Motor("motor", "hinge"), jc.forces.PositionServo("servo", "hinge", 2.0)
    ),
}
METHODS = {
    "default": jc.Method(),
    "stages": jc.Method(
        jc.RK4(), stabilizer=jc.stabilizers.PID(100.0, 20.0, 1.0), solver=jc.solvers.Sparse()
    ),
    "window": jc.Method(stabilizer=jc.stabilizers.SlidingWindowBaumgarte()),
    "implicit": jc.Method(jc.integrators.GeneralizedAlpha()),
    "recovery": jc.Method(recovery=jc.stabilizers.Recovery(), events=jc.integrators.Events()),
    "multipliers": jc.Method(stabilizer=jc.stabilizers.AugmentedLagrangian()),
}


def stepped(system, method):
    """Returns the function from a state to the result of `step`."""
    u = jnp.zeros(system.layout.n_u) if system.layout.n_u else None
    return lambda state: jc.step(system, method, state, u, 1e-2)


def same(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["turns", "stop"])
def test_worlds_on_meshes_with_all_checks_of_types(name):
    """Runs `shard_map` with `check_vma`, and explicit axes, in a process with two devices."""
    own = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    kept = {k: v for k, v in os.environ.items() if k.startswith("JAX_COMPILATION_CACHE")}
    own |= kept | {
        "JAX_ENABLE_X64": "1",
        "JAX_PLATFORMS": "cpu",
        "JAX_NUM_CPU_DEVICES": "2",
        "XLA_FLAGS": os.environ["XLA_FLAGS"],
    }
    own["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), own.get("PYTHONPATH")]))
    command = [sys.executable, str(ROOT / "tests" / "mesh_program.py"), name]
    done = subprocess.run(command, env=own, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# export


@pytest.mark.parametrize("name", ["stop", "turns"])
def test_a_batch_of_any_size_is_exported(name):
    system, state = SCENES[name]()
    state = jc.init(system, jc.Method(), state.q, state.v)
    run = jax.jit(jax.vmap(stepped(system, jc.Method())))
    (worlds,) = export.symbolic_shape("worlds")
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct((worlds, *x.shape), x.dtype), state)
    exported = export.export(run)(shapes)
    for n in (1, 3):
        batch = jax.tree.map(lambda x, n=n: jnp.stack([x] * n), state)
        same(exported.call(batch), run(batch))


def test_gradients_of_a_batch_of_any_size_are_exported():
    system, state = scenes.arm()
    step = stepped(system, jc.Method())
    slopes = jax.jit(
        jax.vmap(
            jax.grad(lambda q: jnp.sum(step(jc.init(system, jc.Method(), q, state.v))[0].q ** 2))
        )
    )
    (worlds,) = export.symbolic_shape("worlds")
    exported = export.export(slopes)(jax.ShapeDtypeStruct((worlds, 3), state.q.dtype))
    batch = jnp.stack([state.q, state.q + 0.1, state.q])
    np.testing.assert_allclose(exported.call(batch), slopes(batch), rtol=1e-12)


def test_system_state_and_info_are_written_to_a_file_and_read():
    pytest.importorskip("flatbuffers")
    method = METHODS["recovery"]
    system, state = scenes.arm(stop(), jc.forces.JointSpring("spring", "hinge", 2.0))
    state = jc.init(system, method, state.q, state.v)

    def step(system, state):
        return jc.step(system, method, state, None, 1e-2)

    run = jax.jit(step)
    text = export.export(run)(system, state).serialize()
    read = export.deserialize(text)
    same(read.call(system, state), run(system, state))
    with pytest.raises(ValueError, match="args"):  # refuses a system of another structure
        read.call(*scenes.arm())


def nodes(structure):
    """Yields the class and the static data of each node of a tree."""
    if structure.node_data() is not None:
        yield structure.node_data()
    for child in structure.children():
        yield from nodes(child)


def writable(tree):
    """Returns the classes of a tree's nodes.

    Checks that their static data survive being written and read.
    """
    known = (tuple, list, dict, type(None))
    found = set()
    for cls, data in nodes(jax.tree.structure(tree)):
        if cls in known:
            continue
        if not issubclass(cls, tuple):
            again = decoded(encoded(data))
            assert tuple(again or ()) == tuple(data or ()), cls
        found.add(cls)
    return found


def registered(cls):
    """Checks that JAX knows a class: registering it a second time must fail."""
    named = issubclass(cls, tuple)
    how = {} if named else {"serialize_auxdata": encoded, "deserialize_auxdata": decoded}
    register = getattr(export, f"register_{'namedtuple' if named else 'pytree_node'}_serialization")
    with pytest.raises(ValueError, match="Duplicate serialization registration for type"):
        register(cls, serialized_name="another", **how)
    return True


KEPT_FROM_STOPS = ("implicit", "multipliers")
"""Methods that have no place for inequalities."""


@pytest.mark.parametrize("name", METHODS)
def test_whatever_a_step_takes_and_returns_can_be_written(name):
    method = METHODS[name]
    for scene, make in SCENES.items():
        if scene == "stop" and name in KEPT_FROM_STOPS:
            continue
        system, state = make()
        state = jax.eval_shape(lambda q, v, s=system: jc.init(s, method, q, v), state.q, state.v)
        seen = jax.eval_shape(stepped(system, method), state)
        assert all(map(registered, writable((system, method, state, seen))))


@pytest.mark.parametrize("name", ["part0-2d-tree", "mixed-3d", "polar"])
def test_systems_of_all_elements_can_be_written(name):
    system = scenes.build(name).system
    assert all(map(registered, writable(system)))


def test_what_has_no_name_is_not_written():
    system = jc.GeneralizedSystem(
        mass=weight, force=lambda q, v, t, u, p: -q, constraints=(), params={"m": 1.0}
    )
    with pytest.raises(TypeError, match="lambda.*at the top of a module"):
        writable(system)
    named = jc.GeneralizedSystem(mass=weight, force=pull, params={"m": 1.0, "k": 1.0})
    assert all(map(registered, writable(named)))


def test_a_file_runs_no_code():
    name = b'{"name": "antigravity:fly"}'
    with pytest.raises(ValueError, match="import its module 'antigravity' first"):
        decoded(name)
    assert "antigravity" not in sys.modules
    with pytest.raises(ValueError, match="is no dataclass"):
        decoded(b'{"dataclass": "os:system", "fields": {"command": "true"}}')


# donation


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("method", METHODS)
def test_a_fresh_state_can_be_donated(name, method):
    """No array occurs twice in a state, or in both the state and the system."""
    method = METHODS[method]
    system, built = SCENES[name]()
    given = jnp.zeros_like(built.v)
    starts = [built, jc.init(system, method, built.q + 0, built.v + 0)]
    if built.q.shape == built.v.shape:
        starts.append(jc.init(system, method, given, given))
    kept = [np.array(x) for x in jax.tree.leaves(system)]
    for start in starts:
        jax.jit(lambda s: jax.tree.map(lambda x: x + x, s), donate_argnums=0)(start)
    for x, y in zip(jax.tree.leaves(system), kept, strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_step_takes_a_donated_state_that_counts_turns():
    system, state = SCENES["turns"]()
    assert state.turns.size
    step = jax.jit(stepped(system, jc.Method()), donate_argnums=0)
    for _ in range(2):
        state, _ = step(state)
    assert state.q.is_deleted() is False
    again = SCENES["turns"]()[1]
    jc.assemble(system, again.q + 0)
    assert np.isfinite(jc.energy(system, again).total)


# equality


def test_equal_methods_are_equal_and_hash_alike():
    assert jc.Method() == jc.Method()
    assert hash(jc.Method()) == hash(jc.Method())
    gains = [
        jc.Method(stabilizer=jc.Baumgarte(*x)) for x in ((5.0, 25.0), (5.0, 25.0), (5.0, 26.0))
    ]
    assert gains[0] == gains[1]
    assert hash(gains[0]) == hash(gains[1])
    assert gains[0] != gains[2]
    assert len({*gains, jc.Method()}) == 3
    assert jc.Method(jc.RK4()) != jc.Method()
    assert jc.Method() != jc.Method
    assert jc.solvers.RankSafe() == jc.solvers.RankSafe()
    assert jc.solvers.RankSafe() != jc.solvers.RankSafe(always=True)


def gains(alpha):
    """Returns a method with any leaf in place of α, built by `tree.unflatten` as JAX does."""
    leaves, structure = jax.tree.flatten(alpha)
    known = jax.tree.unflatten(structure, [1.0] * len(leaves))
    method = jc.Method(stabilizer=jc.Baumgarte(known, 25.0))
    return jax.tree.unflatten(jax.tree.structure(method), [*leaves, 25.0])


@pytest.mark.parametrize(
    ("x", "y", "equal"),
    [
        (5.0, 5.0, True),
        (5.0, 5, False),  # another dtype compiles another program
        (1, True, False),
        (0.0, -0.0, False),
        (float("nan"), float("nan"), True),
        (5.0, np.float64(5.0), False),
        (np.ones(3), np.ones(3), True),
        (np.ones(3), np.zeros(3), False),
        (np.ones(3), np.ones(3, np.float32), False),
        (jnp.ones(3), jnp.ones(3), True),
        (jnp.ones(3), jnp.zeros(3), False),
        (jnp.ones(3), np.ones(3), False),
        (jnp.ones(3), jnp.ones((3, 1)), False),
        ({"hinge": 5.0}, {"hinge": 5.0}, True),
        ({"hinge": 5.0}, {"rod": 5.0}, False),
        (None, None, True),
    ],
)
def test_numbers_are_equal_where_programs_are(x, y, equal):
    a, b = gains(x), gains(y)
    assert (a == b) is equal
    assert (b == a) is equal
    if equal:
        assert hash(a) == hash(b)


def test_traced_numbers_are_themselves_alone():
    def f(x, y):
        assert gains(x) == gains(x)
        assert hash(gains(x)) == hash(gains(x))
        assert gains(x) != gains(y)
        return x

    jax.jit(f)(1.0, 1.0)


def test_a_hash_waits_for_no_array():
    """Hashing a method must not read its arrays: here one of them is deleted."""
    gone = jnp.ones(3)
    method = gains(gone)
    gone.delete()
    assert hash(method) == hash(gains(jnp.zeros(3)))


def test_a_method_is_a_static_argument_that_is_traced_once():
    system, state = scenes.arm()
    traces = []

    def step(method, state):
        traces.append(method)
        return jc.step(system, method, state, None, 1e-3)[0]

    run = jax.jit(step, static_argnums=0)
    found = [run(jc.Method(solver=jc.solvers.Sparse()), state) for _ in range(3)]
    assert len(traces) == 1
    same(found[0], found[2])
    run(jc.Method(solver=jc.solvers.Schur()), state)
    assert len(traces) == 2


def test_states_and_systems_compare_by_their_numbers():
    one, other = scenes.arm(), scenes.arm()
    assert one[0] == other[0]
    assert one[1] == other[1]
    assert one[1] != jc.init(one[0], jc.Method(), one[1].q + 1, one[1].v)
    assert one[0] != one[1]
