"""Wrong calls of every public function are refused with a message that names the argument.

`python -m benchmarks.wrong_calls` tries all of them, ten times as many.
"""

import random
from collections import Counter
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from benchmarks import wrong_calls
from benchmarks.wrong_doors import SPECIAL, Door, Takes, hesitant, motor
from jaxcon.core import checks

SHARE = 10
"""One in `SHARE` calls is tried here."""

LONG_COMPILED = ("tradeoff", "identify", "tune", "gradient_growth")
"""Functions that take long with valid arguments: tested by the command only."""

MUJOCO = ("from_mjcf", "MujocoModel", "HalfCheetah")
"""Functions whose models MuJoCo compiles."""


@pytest.mark.parametrize("part", range(8))
def test_a_tenth_of_all_wrong_calls_is_refused(part):
    absent = () if find_spec("mujoco") else MUJOCO
    chosen = [c for c in wrong_calls.calls() if c.label != "as it says"]
    chosen = [c for c in chosen if not c.door.name.startswith((*LONG_COMPILED, *absent))]
    chosen = random.Random(0).sample(chosen, len(chosen) // SHARE)[part::8]
    missed = [
        f"{kind}: {c}: {text}" for c in chosen for kind, text in [c.outcome()] if kind != "refused"
    ]
    assert len(chosen) > 100
    assert missed == []


@pytest.mark.parametrize("name", SPECIAL)
def test_a_wrong_call_is_refused(name):
    if name.startswith("MJCF"):
        pytest.importorskip("mujoco")
    call, words = SPECIAL[name]
    kind, text = wrong_calls.Call(Door(name, call, Takes(), words), name, None).outcome()
    assert kind == "refused", text


def test_the_counts_tell_what_is_accepted_raw_and_hung():
    """Tests the fuzzer itself: it counts calls that pass, fail in Python code, or do not end."""

    def forever(_):
        while True:
            pass

    acts = {"accepted": abs, "raw": lambda x: x.shape, "hung": forever, "refused": jc.Scene}
    calls = [
        wrong_calls.Call(Door(kind, act, Takes(), ("dim",)), "1", 1) for kind, act in acts.items()
    ]
    assert wrong_calls.run(calls, limit=0.1, show=False) == Counter(dict.fromkeys(acts, 1))


@pytest.mark.parametrize(
    ("x", "words"),
    [
        (True, "a real number"),
        (np.timedelta64(1, "s"), "a real number"),
        (1 + 0j, "a real number"),
        (jnp.asarray(1 + 0j), "a real number"),
        ([True, 1.0], "a real number"),
        (None, "a real number"),
        ("1", "a real number"),
        ([[1.0], [1.0, 2.0]], "one shape"),
        (np.nan, "finite"),
        (jnp.asarray(jnp.nan, jnp.float32), "finite"),
        (10**400, "range"),
        (1e300, "range of float32"),
        ([1.0], r"shape \(\)"),
        (np.ma.masked_array(1.0, mask=True), "finite"),
    ],
)
def test_what_is_no_real_number_of_the_scene(x, words):
    with pytest.raises(ValueError, match=rf"^Spring 's': stiffness .*{words}"):
        checks.real("Spring 's'", "stiffness", x, jnp.float32)


@pytest.mark.parametrize("x", [1, 1.0, np.float64(1.0), np.int8(1), jnp.ones(()), 10**30, [1.0][0]])
def test_what_is_a_real_number_of_the_scene(x):
    number = checks.real("Spring 's'", "stiffness", x, jnp.float64)
    assert number.dtype == jnp.float64
    assert number.shape == ()


def test_a_step_reads_no_array_of_jax(monkeypatch):
    """Arrays may still be computed: shape and dtype suffice, the status reports the rest."""
    system, state = motor()
    read = []
    ask = checks.is_concrete

    def spy(x):
        known = ask(x)
        if known:
            read.extend(leaf for leaf in jax.tree.leaves(x) if isinstance(leaf, jax.Array))
        return known

    method = jc.Method(
        stabilizer=jc.Baumgarte(jnp.ones((), jnp.float32), jnp.ones((), jnp.float32)),
        solver=jc.solvers.Sparse(tikhonov=jnp.asarray(1e-6, jnp.float32)),
    )
    monkeypatch.setattr(checks, "is_concrete", spy)
    control, dt = jnp.zeros(1, jnp.float32), jnp.asarray(1e-3, jnp.float32)
    new, _ = jc.step(system, method, state, control, dt)
    assert read == []
    assert int(new.status) == 0
    jc.init(system, method, state.q, state.v)
    assert read != []


NO_INTEGRATOR = r"Method: integrator must be a value such as SemiImplicitEuler\(\), got "


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: jc.solvers.Sparse(tikhonov=-1.0),
            "Sparse: tikhonov must be zero or more and finite, got",
        ),
        (
            lambda: jc.solvers.Sparse(tikhonov=jnp.asarray([1.0, -1.0])),
            "Sparse: tikhonov must be zero or",
        ),
        (
            lambda: jc.solvers.Sparse(tikhonov=[1.0, 1.0]),
            r"Sparse: tikhonov must have shape \(\), got",
        ),
        (
            lambda: jc.solvers.RankSafe(rounds=0),
            "RankSafe: rounds must be a whole number from 1, got 0",
        ),
        (
            lambda: jc.solvers.RankSafe(share=np.nan),
            "RankSafe: share must be zero or more and finite, got",
        ),
        (lambda: jc.Projection(tolerance="1"), "Projection: tolerance must be a real number, got"),
        (lambda: jc.stabilizers.PID(integral=None), "PID: integral must be real numbers, got None"),
        (lambda: jc.Baumgarte({"rod": True}, 1.0), "Baumgarte: alpha of 'rod' must be a real numb"),
        (
            lambda: jc.integrators.GeneralizedAlpha(rho=2.0),
            "GeneralizedAlpha: rho must lie between 0 and 1",
        ),
        (lambda: jc.Method(jc.RK4), NO_INTEGRATOR + r"jc\.RK4; call it: jc\.RK4\(\)\.$"),
        (
            lambda: jc.Method(jc.integrators.RATTLE),
            NO_INTEGRATOR + r"jc\.integrators\.RATTLE; call it: jc\.integrators\.RATTLE\(\)\.$",
        ),
        (
            lambda: jc.Method(jc.integrators.Events),
            NO_INTEGRATOR + r"jc\.integrators\.Events; that is one for events=\.$",
        ),
    ],
)
def test_a_constructor_refuses_what_it_can_see(make, words):
    with pytest.raises((ValueError, TypeError), match=f"^{words}"):
        make()


def test_a_part_is_rebuilt_without_a_check():
    """Trees of gradients, tracers, axes and placeholders have the structure of a method."""
    method = jc.Method(
        stabilizer=jc.stabilizers.PID(4.0, 2.0, 1.0), solver=jc.solvers.Sparse(tikhonov=1.0)
    )
    slope = jax.grad(lambda m: -m.solver.tikhonov - m.stabilizer.integral)(method)
    assert (float(slope.solver.tikhonov), float(slope.stabilizer.integral)) == (-1.0, -1.0)
    leaves, structure = jax.tree.flatten(method)
    held = object()
    for placed in (None, held, jax.ShapeDtypeStruct((), float), "an axis"):
        tree = jax.tree.unflatten(structure, [placed] * len(leaves))
        assert tree.solver.tikhonov is placed
    rates = jnp.asarray([1.0, 2.0])
    made = jax.vmap(lambda x: jc.Method(solver=jc.solvers.Sparse(tikhonov=x)))(rates)
    assert made == jc.Method(solver=jc.solvers.Sparse(tikhonov=rates))  # batched construction
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(made)]
    assert paths == [".solver.tikhonov"]


def test_a_constructor_within_a_step_reads_no_array():
    wrong = jnp.asarray(-1.0)
    with checks.without_waiting():
        assert jc.solvers.Sparse(tikhonov=wrong).tikhonov is wrong


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_quaternions_hand_on_what_is_not_finite(dtype):
    turns = jnp.full((4, 5), jnp.nan, dtype)
    assert jc.quaternion.multiply(turns, turns[:, :1]).dtype == dtype
    assert np.isnan(jc.quaternion.rotate(turns, jnp.ones((3, 5), dtype))).all()
    with pytest.raises(ValueError, match=r"further axes of q \(4, 5\) and x \(3, 2\) do not broad"):
        jc.quaternion.rotate(turns, jnp.ones((3, 2), dtype))
    assert jc.quaternion.from_axis_angle(jnp.ones(3, dtype), 0.1).dtype == dtype


def wrongly(alpha):
    """Constructs a method with traced gains."""
    return jax.jit(lambda x: jc.Method(stabilizer=jc.Baumgarte(x, x)))(alpha)


def test_nan_gains_that_are_not_read_end_in_a_status():
    system, state = motor()
    method = wrongly(jnp.asarray(jnp.nan, jnp.float32))
    new, _ = jc.step(system, method, state, np.zeros(1), 1e-3)
    assert int(new.status) != 0
    with pytest.raises(ValueError, match="Baumgarte: alpha must be zero or more and finite"):
        jc.init(system, method, state.q, state.v)


def test_a_policy_that_asks_for_a_value_is_named_with_its_place():
    system, state = motor()
    with pytest.raises(TypeError, match=r"rollout: controls, 'hesitant' \(.*wrong_doors.py:\d+\)"):
        jc.rollout(system, jc.Method(), state, hesitant, 1e-3, 2)


def limited(angle=0.0, **limit):
    scene = jc.Scene(dim=2)
    scene.add_body("arm", mass=1.0, inertia=1.0, angle=angle)
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)))
    scene.add(jc.Limit("stop", "hinge", **limit))
    return scene.build()


def test_degrees_are_warned_of():
    with pytest.warns(UserWarning, match="body 'arm': angle is 90 rad, more than a turn"):
        limited(angle=90.0, lower=0.0)
    with pytest.warns(UserWarning, match="Limit 'stop': upper is 45 rad"):
        limited(lower=0.0, upper=45.0)
    limited(angle=2 * np.pi, lower=-6.28319, upper=np.inf)  # a full turn, rounded as in models


def test_a_limit_of_travel_is_no_angle():
    scene = jc.Scene(dim=2)
    scene.add_body("cart", mass=1.0, inertia=1.0)
    scene.add(jc.Prismatic("rail", jc.WORLD, "cart", axis=(1.0, 0.0)))
    scene.add(jc.Limit("stop", "rail", lower=-90.0, upper=90.0))
    scene.build()


def test_a_spiral_counts_its_turns():
    s = np.linspace(0, 6 * np.pi, 60)
    points = (1 + s / 10)[:, None] * np.stack([np.cos(s), np.sin(s)], axis=1)
    scene = jc.Scene(dim=2)
    jc.chains.rod(scene, "spring", points, 1.0, bending=1.0)
    _, state = scene.build()
    assert np.max(np.asarray(state.q)) > 2 * np.pi


def test_reactions_are_a_mapping():
    system, state = limited(lower=-1.0, upper=1.0)
    _, info = jc.step(system, jc.Method(), state, None, 1e-3)
    reactions = info.reactions
    assert "stop" in reactions
    assert "hinge" not in reactions
    assert 3 not in reactions
    assert list(reactions) == ["stop"]
    assert len(reactions) == 1
    assert {name: x.shape for name, x in reactions.items()} == {"stop": (1,)}
    assert reactions.get("hinge") is None
    for error in (KeyError, ValueError):
        with pytest.raises(error, match="^element 'hinge' is unknown; known are "):
            reactions["hinge"]
    batch = jax.vmap(lambda s: jc.step(system, jc.Method(), s, None, 1e-3)[1])
    many = batch(jax.tree.map(lambda x: jnp.stack([x, x]), state))
    assert dict(many.reactions)["stop"].shape == (2, 1)
    assert reactions == reactions
    assert isinstance(hash(reactions), int)
