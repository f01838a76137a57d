"""The extension examples in CONTRIBUTING.md run as printed and do what the text says."""

import inspect
import re
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE

import jaxcon as jc
from jaxcon import environments
from jaxcon.extend import pytree
from jaxcon.step import Dynamics

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text()
SECTIONS = dict(re.findall(r"^## Add an? (\w+)$(.*?)(?=^## )", TEXT, re.MULTILINE | re.DOTALL))


def names_of(section):
    """Runs the one program of a section and returns the names that it defines."""
    (code,) = re.findall(r"```python\n(.*?)```", SECTIONS[section], re.DOTALL)
    names = {"__name__": section}
    exec(code, names)  # noqa: S102
    return names


def pendulum(length=1.0, dtype=None):
    """A bob at (1, 0) on a rod, whose length may differ from the bob's distance."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=length))
    return scene.build()


def test_the_way_of_a_step_names_the_line_of_each_call():
    table = re.findall(r"^\| \d \| `(?:jc\.)?(\w+)` \| `([\w/.]+):(\d+)` \|", TEXT, re.MULTILINE)
    assert len(table) == 6
    for name, path, number in table:
        lines = (ROOT / path).read_text().splitlines()
        places = [i for i, line in enumerate(lines, 1) if re.match(rf" *def {name}\(", line)]
        assert int(number) in places, f"{path}: {name} is at {places}, not at {number}"


def test_the_way_of_a_step_is_in_the_order_of_its_calls(monkeypatch):
    """The frames that are on the stack when the first equation is reached.

    Names are static, so a body with a name of its own is traced anew after any other test.
    """
    table = re.findall(r"^\| \d \| `(?:jc\.)?(\w+)` \| `([\w/.]+):(\d+)` \|", TEXT, re.MULTILINE)
    seen, linearize = [], Dynamics.linearize

    def spy(self, *args):
        frames = [(f.function, str(Path(f.filename).resolve())) for f in inspect.stack()]
        seen.append(frames[::-1])
        return linearize(self, *args)

    monkeypatch.setattr(Dynamics, "linearize", spy)
    scene = jc.Scene(dim=2)
    scene.add_particle("bob of the stack", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob of the stack"))
    system, state = scene.build()
    jc.step(system, jc.Method(), state, None, 1e-3)
    places = [seen[0].index((name, str(ROOT / path))) for name, path, _ in table[:-1]]
    assert places == sorted(places)


def test_there_is_one_program_for_each_kind_of_part():
    assert list(SECTIONS) == ["joint", "stabilizer", "integrator", "solver", "environment"]
    assert len(re.findall("```python", TEXT)) == len(SECTIONS) + 1  # and the program of a study


def test_the_study_is_entered_under_its_name_and_finds_its_numbers(monkeypatch):
    from benchmarks import suite

    monkeypatch.setattr(suite, "ENTRIES", {})
    code = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)[-1]
    exec(code, {"__name__": "study"})  # noqa: S102
    (study,) = suite.ENTRIES.values()
    assert study.name == "my_study"
    assert study.about == "What it measures, in a sentence."
    assert [metric.value for metric in study.run(True).metrics] == [0.5, 1e-9]


def test_a_joint_without_a_base_gets_the_default_options():
    @dataclass(frozen=True)
    class Weld:
        name: str
        body_a: str
        body_b: str
        point: tuple[float, ...]

        def attach(self, a, b):
            return jc.Fixed.attach(self, a, b)

        rows = staticmethod(jc.Fixed.rows)

    states = []
    for joint in (Weld, jc.Fixed):
        scene = jc.Scene(dim=2)
        for name, x in (("a", 1.0), ("b", 2.0), ("c", 3.0)):
            scene.add_body(name, mass=1.0, inertia=0.1, position=(x, 0.0))
        scene.add(jc.Revolute("hinge", jc.WORLD, "a", point=(0.0, 0.0)))
        scene.add(joint("first", "a", "b", point=(1.5, 0.0)))
        scene.add(joint("second", "b", "c", point=(2.5, 0.0)))
        system, state = scene.build()
        assert [group.names for group in system.constraints] == [("hinge",), ("first", "second")]
        states.append(jc.step(system, jc.Method(), state, None, 0.01)[0])
    np.testing.assert_array_equal(states[0].v, states[1].v)


def test_the_joint_lets_a_pin_slide_and_turn_in_a_slot():
    """The slot is level: a body hung on the pin swings, and the pin moves along x alone."""
    scene = jc.Scene()
    inertia = jc.inertia.box(1.0, (1.0, 0.4, 0.2))
    scene.add_body("plate", inertia=inertia, velocity=(1.0, 0.0, 0.0))
    slot, pin = (3.0, 0.0, 0.0), (0.0, 2.0, 0.0)
    scene.add(
        names_of("joint")["PinInSlot"](
            "slide", jc.WORLD, "plate", point=(0.5, 0.0, 0.0), axis_a=slot, axis_b=pin
        )
    )
    system, state = scene.build()
    assert jc.report(system, state).degrees_of_freedom == 2
    run = jax.jit(lambda s: jc.rollout(system, jc.Method(jc.RK4()), s, None, 1e-3, 300)[0])
    final = run(state)
    end = jc.position(system, final, "plate", (0.5, 0.0, 0.0))
    assert jnp.max(jnp.abs(end[1:])) < 1e-9
    assert end[0] > 0.5
    assert jnp.abs(jc.velocity(system, final, "plate")[0] - 1.0) < 1e-9  # no force along the slot
    assert jnp.abs(jc.orientation(system, final, "plate")[2]) > 0.1  # it swings


def test_the_joint_stays_in_place_on_a_body_whose_inertia_turns():
    """Numbers that are points or directions follow the new principal frame."""
    joint, mass = names_of("joint")["PinInSlot"], jc.inertia.box(1.0, (1.0, 0.4, 0.2))
    scene = jc.Scene()
    for body, x in (("a", 0.5), ("b", 1.5)):
        scene.add_body(body, inertia=mass, position=(x, 0.0, 0.0))
    axes = {"axis_a": (1.0, 0.0, 0.0), "axis_b": (0.0, 1.0, 0.0)}
    scene.add(joint("first", jc.WORLD, "a", point=(0.0, 0.0, 0.0), **axes))
    scene.add(joint("second", "a", "b", point=(1.0, 0.0, 0.0), **axes))
    system, state = scene.build()
    full = np.array([[0.02, 0.01, 0.0], [0.01, 0.08, 0.005], [0.0, 0.005, 0.09]])
    center = np.array([0.1, -0.05, 0.02])
    changed = system.with_params({"a": {"inertia": full, "center": center}})
    moved = jc.systems.restate(state, system, changed)
    for name in ("first", "second"):
        assert jc.violation(changed, moved)[name] < 1e-12
    info = jc.step(changed, jc.Method(), moved, None, 1e-3)[1]
    assert jnp.all(jnp.isfinite(info.multipliers))
    turned = jc.rollout(changed, jc.Method(jc.RK4()), moved, None, 1e-3, 200)[0]
    assert jc.violation(changed, turned).worst < 1e-4
    place = jc.position(changed, turned, "a", (0.0 - 0.5, 0.0, 0.0))
    assert jnp.max(jnp.abs(place[1:])) < 1e-4  # of the slot of the world, along x


def test_an_integrator_that_tells_no_growth_is_not_warned_of():
    @pytree
    class Plain(jc.SemiImplicitEuler):
        def growth(self, alpha, beta, dt):
            return None

    system, state = pendulum()
    method = jc.Method(Plain(), jc.Baumgarte(1e3, 1e3))
    jc.step(system, method, state, None, 0.1)
    with pytest.raises(TypeError, match="Plain has no `growth`"):
        jc.stabilizers.largest_stable_rate(Plain(), 0.1)


def test_the_stabilizer_pulls_as_baumgarte_does_but_no_more_than_its_bound():
    saturated = names_of("stabilizer")["Saturated"]
    system, state = pendulum(length=0.9)

    def along(stabilizer):
        """Returns φ̈ of the stabilizer: the acceleration with it minus that without."""
        pulled, free = (
            jc.forward_dynamics(system, state, None, jc.Method(stabilizer=s), 1e-3).acceleration[0]
            for s in (stabilizer, jc.stabilizers.Unstabilized())
        )
        return pulled - free

    pull = 20.0**2 * 0.1
    np.testing.assert_allclose(along(saturated(20.0, 20.0, 1e6)), -pull, rtol=1e-8)
    np.testing.assert_allclose(along(saturated(20.0, 20.0, 5.0)), -5 * np.tanh(pull / 5))
    np.testing.assert_allclose(
        along(saturated({"rod": 2.0}, {"rod": 2.0}, 5.0)), -5 * np.tanh(0.08)
    )


def left(stabilizer, dtype, steps=400):
    """Returns φ after steps of 5 ms (two seconds by default), from a rod a tenth too short."""
    system, state = pendulum(0.9, dtype)
    method = jc.Method(jc.RK4(), stabilizer)
    state = jc.init(system, method, state.q, state.v)
    final = jc.rollout(system, method, state, None, 5e-3, steps)[0]
    return jnp.linalg.norm(final.q) - 0.9


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_stabilizer_comes_back_in_batches(dtype):
    saturated = names_of("stabilizer")["Saturated"]
    bounds = jnp.asarray([1.0, 3.0, 100.0], dtype)

    @jax.jit
    def found(most):
        return left(saturated(5.0, 5.0, most), dtype)

    batch = jax.jit(jax.vmap(found))(bounds)
    assert batch.dtype == dtype
    assert np.all(np.abs(batch) < 1e-3)  # φ was 0.1 at the start
    if dtype == "float64":
        np.testing.assert_allclose(batch, [found(most) for most in bounds], atol=1e-10)


def test_the_stabilizer_has_gradients():
    saturated = names_of("stabilizer")["Saturated"]

    @jax.jit
    def found(most):  # after 0.2 s, while the bound still matters
        return left(saturated(5.0, 5.0, most), "float64", 40)

    slope = jax.jit(jax.grad(found))(1.0)
    assert abs(slope) > 1e-3
    difference = (found(1.0 + 1e-5) - found(1.0 - 1e-5)) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=DIFFERENCE)


def swing(integrator, h, turn=0.0):
    """Returns the position of a double pendulum's lower link after half a second."""
    scene = jc.Scene(dim=2)
    for i, name in enumerate(("upper", "lower")):
        scene.add_body(name, mass=1.0, inertia=1 / 12, position=(i + 0.5, 0.0))
    scene.add(jc.Revolute("shoulder", jc.WORLD, "upper", point=(0.0, 0.0)))
    scene.add(jc.Revolute("elbow", "upper", "lower", point=(1.0, 0.0)))
    system, state = scene.build()
    method = jc.Method(integrator, solver=jc.solvers.Schur())
    v = state.v + turn * jc.assemble(system, state.q, jnp.ones(6)).state.v
    start = jc.init(system, method, state.q, v)
    run = jax.jit(lambda s: jc.rollout(system, method, s, None, h, round(0.5 / h))[0])
    return jc.position(system, run(start), "lower")


def test_the_integrator_is_of_second_order():
    adams = names_of("integrator")["AdamsBashforth"]()
    exact = swing(jc.RK4(), 1e-3)
    errors = [jnp.linalg.norm(swing(adams, h) - exact) for h in (4e-3, 2e-3)]
    assert 1.9 < np.log2(errors[0] / errors[1]) < 2.1
    euler = jnp.linalg.norm(swing(jc.integrators.ExplicitEuler(), 2e-3) - exact)
    assert errors[1] < 0.1 * euler


def test_the_integrator_knows_which_gains_are_stable():
    """The real stability interval is [−1, 0]; critical feedback has a double root at −ω h."""
    adams = names_of("integrator")["AdamsBashforth"]()
    np.testing.assert_allclose(jc.stabilizers.largest_stable_rate(adams, 0.1), 1.0 / 0.1, rtol=1e-3)
    system, state = pendulum()
    method = jc.Method(adams, jc.Baumgarte.critical(11.0))
    state = jc.init(system, method, state.q, state.v)
    with pytest.warns(UserWarning, match="unstable"):
        jc.step(system, method, state, None, 0.1)


def test_the_integrator_runs_in_batches_and_backwards():
    adams = names_of("integrator")["AdamsBashforth"]()

    @jax.jit
    def height(turn):
        return swing(adams, 1e-2, turn)[1]

    turns = jnp.array([0.0, 0.3])
    batch = jax.jit(jax.vmap(height))(turns)
    np.testing.assert_allclose(batch, [height(t) for t in turns], atol=1e-10)
    slope = jax.jit(jax.grad(height))(0.1)
    low, high = (height(0.1 + e) for e in (-1e-5, 1e-5))
    np.testing.assert_allclose(slope, (high - low) / 2e-5, rtol=DIFFERENCE)


def door(mass=1.0):
    """A door on two coaxial hinges: ten rows, five of them redundant."""
    scene = jc.Scene()
    scene.add_body("door", mass=mass, inertia=(0.2, 0.3, 0.1), position=(0.5, 0.0, 0.0))
    for name, z in (("low", -0.4), ("high", 0.5)):
        axis = (0.0, 0.3, 1.0)
        scene.add(jc.Revolute(name, jc.WORLD, "door", point=(0.0, 0.3 * z, z), axis=axis))
    return scene.build()


def test_the_solver_finds_the_shortest_multipliers_of_redundant_rows():
    shortest, other = (
        jc.forward_dynamics(*door(), None, jc.Method(solver=solver), 1e-3)
        for solver in (names_of("solver")["LeastNorm"](), jc.solvers.RankSafe())
    )
    assert shortest.status == other.status == jc.Status.OK
    np.testing.assert_allclose(shortest.acceleration, other.acceleration, atol=1e-9)
    more = other.multipliers - shortest.multipliers  # changes no motion: JᵀΔλ = 0
    assert jnp.linalg.norm(more) > 0.1
    assert jnp.abs(more @ shortest.multipliers) < 1e-8  # so the shortest is orthogonal to it


def test_the_solver_runs_in_batches_and_backwards():
    method = jc.Method(solver=names_of("solver")["LeastNorm"]())

    @jax.jit
    def angle(mass):
        system, state = door(mass)
        final = jc.rollout(system, method, state, None, 1e-2, 20)[0]
        return jc.coordinate(system, final, "low")

    masses = jnp.array([1.0, 2.5])
    found = jax.jit(jax.vmap(angle))(masses)
    np.testing.assert_allclose(found, [angle(m) for m in masses], atol=1e-10)
    slope = jax.jit(jax.grad(angle))(1.5)
    np.testing.assert_allclose(slope, (angle(1.5 + 1e-5) - angle(1.5 - 1e-5)) / 2e-5, rtol=1e-5)


def test_the_environment_can_be_solved_and_is_not_solved_by_itself():
    task = names_of("environment")["HoldUpright"].build()

    def brake(x):
        return jnp.stack([-2.0 * x[1] - 0.5 * x[2]])

    def nothing(x):
        return jnp.zeros(1, x.dtype)

    key = jax.random.key(0)
    held, left_alone = (
        jax.jit(lambda k, p=policy: environments.returns(task, p, k, 8))(key)
        for policy in (brake, nothing)
    )
    assert np.all(np.asarray(held) > 0.9 * task.horizon)
    assert np.all(np.asarray(left_alone) < 0.5 * task.horizon)


def test_the_environment_has_numbers_of_its_own_in_each_copy_and_gradients():
    build = names_of("environment")["HoldUpright"].build

    @jax.jit
    def reward(mass, push):
        task = build(mass)
        return task.step(task.reset(jax.random.key(1)), push[None])[1].reward

    masses, push = jnp.array([1.0, 3.0]), jnp.asarray(0.2)
    batch = jax.jit(jax.vmap(reward, (0, None)))(masses, push)
    each = [reward(m, push) for m in masses]
    np.testing.assert_allclose(batch, each, atol=1e-10)
    assert abs(each[0] - each[1]) > 1e-6
    slope = jax.jit(jax.grad(reward, 1))(masses[0], push)
    near = [reward(masses[0], push + e) for e in (-1e-5, 1e-5)]
    np.testing.assert_allclose(slope, (near[1] - near[0]) / 2e-5, rtol=1e-5)
