"""Diagnosis: the first failure, the sources of constraint violation, and contradictory rows."""

import dataclasses
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc

DT = 1e-3


def blow_up(body, t, control, params):
    """Returns a force on a body that becomes NaN after the time `until`."""
    return jnp.stack([0 * t, jnp.sqrt(params["until"] - t)])


def fading(a, t, params):
    """Returns φ of a line whose gradient vanishes after the time `until`."""
    left = jnp.maximum(params["until"] - t, 0)
    return jnp.stack([left * (a.position[0] - 0.5)])


def rooted(a, t, params):
    """Returns φ of a line that becomes NaN after the time `until`."""
    return jnp.stack([jnp.sqrt(params["until"] - t) * (a.position[1] - 0.25)])


@pytest.fixture(scope="module")
def scene():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add_particle("bead", mass=2.0, position=(0.5, 0.25))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    late = {"until": jnp.asarray(100.0)}
    scene.add(jc.joints.Holonomic(fading, ("bead",), name="rail", params=late))
    scene.add(jc.joints.Holonomic(rooted, ("bead",), name="guide", params=late))
    scene.add(jc.Spring("spring", "bob", "bead", stiffness=10.0))
    scene.add(jc.forces.CustomForce("wind", ("bob",), blow_up, params=late))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    return scene.build()


EARLY = {"params": {"until": jnp.asarray(2.75 * DT)}}
STEPS, FAILING = 8, 3
CASES = {  # change of the system, failing step, failing term, name of the element
    "control": ({}, 0, "control", "push"),
    "parameter": ({"bob": jnp.nan}, 0, "parameter", "bob.mass"),
    "mass": ({"bob": -1.0}, 0, "mass", "bob"),
    "force": ({"wind": EARLY}, FAILING, "force", "wind"),
    "row": ({"rail": EARLY}, FAILING, "rows", "rail"),
    "constraint": ({"guide": EARLY}, FAILING, "residual", "guide"),
}
SCHUR = jc.Method(solver=jc.solvers.Schur())


def changed(system, changes):
    """Returns the system with other numbers, including some that `with_params` refuses."""
    for name, value in changes.items():
        if name == "bob":
            group = system.inertia[0]
            group = dataclasses.replace(group, mass=group.mass.at[0].set(value))
            system = dataclasses.replace(system, inertia=(group,))
        else:
            system = system.with_params({name: value})
    return system


@pytest.mark.parametrize("what", CASES)
def test_the_first_failure_is_named(scene, what):
    changes, step, term, name = CASES[what]
    system, state = changed(scene[0], changes), scene[1]
    controls = np.zeros((STEPS, 2))
    controls[0, 1] = np.inf if what == "control" else 0
    found = jc.analysis.find_first_failure(system, SCHUR, state, controls, DT, STEPS)
    assert (found.step, found.world, found.stage) == (step, None, 0)
    assert (found.term, found.name) == (term, name)
    assert str(found).startswith(f"step {step}, from t = {step * DT:g} s: {found.status.name}: ")
    assert f"{term} of '{name}'" in str(found)
    # the rollout stops at that step, and its final state gives the same diagnosis
    final, _ = jc.rollout(system, SCHUR, state, controls, DT, STEPS)
    assert (final.status, final.time) == (found.status, pytest.approx(step * DT))
    again = jc.analysis.find_first_failure(system, SCHUR, final, controls, DT, STEPS)
    assert (again.step, again.term, again.name) == (0, term, name)


def test_later_stages_worlds_and_repairs_are_looked_at(scene):
    """The force becomes NaN at the last stage of step 2, in the last two of three worlds."""
    system, state = changed(scene[0], {"wind": EARLY}), scene[1]
    times = jnp.array([-1.0, 0.0, 0.0])
    batch = jax.vmap(lambda t: dataclasses.replace(state, time=t))(times)
    found = jc.analysis.find_first_failure(system, jc.Method(jc.RK4()), batch, None, DT, STEPS)
    assert (found.step, found.world, found.stage, found.name) == (2, 1, 3, "wind")
    assert "step 2 of world 1, from t = 0.002 s: NON_FINITE at stage 3: " in str(found)

    repaired = dataclasses.replace(SCHUR, recovery=jc.stabilizers.Recovery())
    start = jc.init(system, repaired, state.q, state.v)
    found = jc.analysis.find_first_failure(system, repaired, start, None, DT, STEPS)
    assert (found.step, found.term, found.name) == (FAILING, "force", "wind")


def test_a_velocity_that_overflows_is_named_and_a_limit_that_is_passed():
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("still", mass=1.0, position=(5.0, 0.0))
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "still"))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    system, state = scene.build()

    def push(s):
        return jnp.stack([jnp.where(s.time > 50, 1e308, 0.0), 0 * s.time])

    found = jc.analysis.find_first_failure(system, SCHUR, state, push, 40.0, 4)
    assert (found.step, found.term, found.name) == (2, "velocity", "bob")
    assert "velocity of 'bob' is [inf, 0.0]" in str(found)

    limited = jc.Method(
        stabilizer=jc.stabilizers.Unstabilized(), recovery=jc.stabilizers.Recovery(limit=0.1)
    )
    state = jc.init(system, limited, state.q.at[system.layout.q("still")].add(0.5), state.v)
    found = jc.analysis.find_first_failure(system, limited, state, None, DT, 2)
    assert (found.status, found.step) == (jc.Status.VIOLATED, 0)
    assert (found.term, found.name) == ("violation", "rod")


@pytest.mark.parametrize(
    ("upper", "term", "name"), [(2.0, "force", "wind"), (jnp.nan, "parameter", "stop.upper")]
)
def test_a_missing_stop_is_not_a_cause(upper, term, name):
    """The missing lower stop is −inf; a stop at NaN is wrong."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("cart", mass=1.0, inertia=1.0)
    scene.add(jc.Prismatic("rail", jc.WORLD, "cart", axis=(1.0, 0.0)))
    scene.add(jc.Limit("stop", "rail", upper=2.0))
    scene.add(jc.forces.CustomForce("wind", ("cart",), gust, params=jnp.asarray(1.5 * DT)))
    system, state = scene.build()
    system = jax.jit(lambda upper: system.with_params({"stop": {"upper": upper}}))(upper)
    found = jc.analysis.find_first_failure(system, jc.Method(), state, None, DT, 4)
    assert (found.term, found.name) == (term, name)


def gust(body, t, control, until):
    """Returns a force and torque that become NaN after the time `until`."""
    return jnp.stack([jnp.sqrt(until - t), 0 * t, 0 * t])


def test_nothing_is_found_where_nothing_fails(scene):
    assert jc.analysis.find_first_failure(*scene[:1], SCHUR, scene[1], None, DT, STEPS) is None


def pendulum(length=1.0, dtype=None):
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=2.0, position=(0.6, 0.8), velocity=(0.8, -0.6))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=length))
    return scene.build()


SLOW = jc.Method(stabilizer=jc.Baumgarte.critical(rate=1.0))


def test_violation_is_told_apart_by_its_source():
    system, state = pendulum()
    found = jc.analysis.diagnose(system, SLOW, state, None, 1e-2, 50)
    assert found.main_source == "integration"
    assert found.sources["integration"] > 1e-3
    assert found.sources["initial"] < 1e-12
    assert 1e-17 < found.sources["round-off"] < 1e-15
    assert found.sources["conflict"] == found.sources["rank"] == 0
    assert found.energy[0] == pytest.approx(1.0 + 2 * 9.81 * 0.8)
    np.testing.assert_allclose(found.momentum[0][0], [1.6, -1.2])
    assert found.gains == pytest.approx((50.0, 100.0))
    assert found.stable_rate == pytest.approx((2 * np.sqrt(2) - 2) / 1e-2)
    assert "most of it from: integration" in str(found)

    off = jc.analysis.diagnose(*(lambda s: (s[0], SLOW, s[1]))(pendulum(1.2)), None, 1e-4, 50)
    assert off.main_source == "initial"
    assert off.sources["initial"] == pytest.approx(0.2, rel=1e-12)

    none = np.zeros((20, 0))  # a NumPy array, which does not force float64
    coarse = jc.analysis.diagnose(
        *(lambda s: (s[0], jc.Method(), s[1]))(pendulum(dtype=jnp.float32)), none, 1e-4, 20
    )
    assert 1e-8 < coarse.sources["round-off"] < 1e-6


@pytest.mark.parametrize(
    ("stabilizer", "gains"),
    [
        (jc.stabilizers.Hybrid(jc.stabilizers.Penalty(1e3)), (50.0, 50.0)),
        (jc.stabilizers.Penalty({}, others=jc.stabilizers.PID()), (500.0, 1000.0)),
        (jc.Projection(), (500.0, 1000.0)),
    ],
)
def test_default_gains_are_those_that_the_stabilizer_takes(stabilizer, gains):
    system, state = pendulum()
    method = jc.Method(stabilizer=stabilizer)
    state = jc.init(system, method, state.q, state.v)
    found = jc.analysis.diagnose(system, method, state, None, 1e-3, 1)
    assert found.gains == pytest.approx(gains)


def test_gains_beyond_their_limit_and_worlds_that_end_are_named():
    system, state = pendulum()
    wild = jc.Method(stabilizer=jc.Baumgarte.critical(rate=5e3))
    found = str(jc.analysis.diagnose(system, wild, state, None, 1e-3, 300))
    assert "NON_FINITE at" in found
    assert "are unstable at dt=0.001" in found
    assert not jc.analysis.diagnose(system, SLOW, state, None, 1e-3, 5).trouble


def test_what_hardly_any_motion_changes_is_a_matter_of_rank():
    """Two nearly parallel rods require distances 5 cm apart, so that each misses half of that."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=1.0))
    scene.add(jc.Distance("near", jc.WORLD, "bob", length=1.05, point_a=(0.0, 1e-3)))
    system, state = scene.build()
    method = jc.Method(stabilizer=jc.stabilizers.Unstabilized())
    found = jc.analysis.diagnose(system, method, state, None, 1e-6, 2)
    assert found.sources["rank"] == pytest.approx(0.025, rel=1e-3)
    assert found.sources["conflict"] == 0


def test_contradicting_constraints_are_named_with_what_is_left():
    """Two rods of lengths 1 and 1.2 end at one point: a residual of 0.1 each, by symmetry."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.1, 0.0), velocity=(0.0, 1.0))
    scene.add_particle("free", mass=1.0, position=(0.0, 2.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=1.0))
    scene.add(jc.Distance("longer", jc.WORLD, "bob", length=1.2))
    scene.add(jc.Distance("other", jc.WORLD, "free", length=2.5))
    system, state = scene.build()
    report = jc.report(system, state)
    assert set(report.conflicts) == {"rod", "longer"}
    for left in report.conflicts.values():
        np.testing.assert_allclose(left, [0.1, 0.0, 0.0], atol=1e-12)
    assert "contradicting constraints" in str(report)
    assert "rod: 1.00e-01 of φ" in str(report)
    found = jc.analysis.diagnose(system, jc.Method(), state, None, 1e-3, 5)
    assert found.sources["conflict"] == pytest.approx(0.1, rel=1e-3)


def test_rows_that_move_apart_contradict_each_other_in_their_rates():
    """One of two equal rows moves with ∂φ/∂t = −3 and would pull the particle off the other."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("bob", mass=1.0, position=(0.0, 1.0))
    scene.add(jc.joints.Holonomic(height, ("bob",), name="still", params=jnp.asarray(0.0)))
    scene.add(jc.joints.Holonomic(height, ("bob",), name="moving", params=jnp.asarray(3.0)))
    report = jc.report(*scene.build())
    for name in ("still", "moving"):
        np.testing.assert_allclose(report.conflicts[name], [0, 1.5, 0], atol=1e-12)


def height(a, t, rate):
    return jnp.stack([a.position[1] - 1 - rate * t])


def test_rows_that_agree_are_redundant_and_no_conflict():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.1, 0.0))
    for name in ("rod", "again"):
        scene.add(jc.Distance(name, jc.WORLD, "bob", length=1.0))
    report = jc.report(*scene.build())
    assert report.redundant == (("again", 0),)
    assert report.conflicts == {}


def test_controls_of_numpy_get_the_precision_of_the_scene(monkeypatch):
    """The analysis functions convert controls as `rollout` does."""
    scene = jc.Scene(dim=2, dtype=jnp.float32)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    system, state = scene.build()

    def traced(step, args, worlds):
        return len(jax.eval_shape(step, *args))

    module = importlib.import_module("jaxcon.analysis.memory")
    monkeypatch.setattr(module, "_planned", traced)
    row = np.array([0.0, 0.1])
    for controls in (np.tile(row, (STEPS, 1)), lambda state: row):
        assert jc.analysis.find_first_failure(system, SCHUR, state, controls, DT, STEPS) is None
        jc.analysis.gradient_memory(system, SCHUR, state, controls if callable(controls) else row)
