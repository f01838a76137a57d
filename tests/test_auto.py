"""`Method.auto` chooses a solver that can solve the rows, among the cheapest by operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from test_report import four_bar

import jaxcon as jc
from jaxcon.constraints.rows import linearize, saddle
from jaxcon.core.status import Status
from jaxcon.linear.jacobian import Columns
from jaxcon.methods import choice
from jaxcon.methods.choice import Facts, choose, words
from jaxcon.staging.operations import count

DEARER = 1.5
"""Bound on the operations of the chosen solver, relative to the cheapest direct solver.

For conjugate gradients, which may stop early, the bound is `choice.SURE`.
"""
INDEPENDENT = (
    jc.solvers.Sparse(),
    jc.solvers.Schur(),
    jc.solvers.Dense(),
    jc.solvers.ConjugateGradients(),
)
DEPENDENT = (
    jc.solvers.RankSafe(),
    jc.solvers.RankSafe(jc.solvers.Schur()),
    jc.solvers.ConjugateGradients(),
)


def operations(system, state, solver):
    """Counts the operations of one solution in the trace, with all rows taken as independent."""

    def problem(s):
        rows = linearize(system, s.q, s.v, s.time)
        return saddle(system, s.q, rows, system.force(s.q, s.v, s.time), -rows.bias)

    shapes = jax.eval_shape(problem, state)
    return count(jax.make_jaxpr(solver.solve)(shapes).jaxpr, min)


def ring(n):
    """Particles on rods around one body."""
    scene = jc.Scene(dim=2)
    scene.add_body("hub", mass=10.0, inertia=5.0)
    for i in range(n):
        ray = np.array([np.cos(i), np.sin(i)])
        scene.add_particle(f"p{i}", mass=0.1, position=2 * ray)
        scene.add(jc.Distance(f"rod{i}", "hub", f"p{i}", point_a=ray))
    return scene.build()


def rope(n):
    """Particles in a row, joined by rods."""
    scene = jc.Scene(dim=2)
    for i in range(n):
        scene.add_particle(f"p{i}", mass=0.1, position=(i + 1.0, 0.0))
        first = {"point_a": (0.0, 0.0)} if i == 0 else {}
        scene.add(jc.Distance(f"rod{i}", f"p{i - 1}" if i else jc.WORLD, f"p{i}", **first))
    return scene.build()


def polar():
    """A pendulum in polar coordinates."""
    built = scenes.build("polar")
    return built.system, built.state


SCENES = {
    "rope": lambda: (*rope(12), INDEPENDENT),
    "ring": lambda: (*ring(12), INDEPENDENT),
    "wide ring": lambda: (*ring(50), INDEPENDENT[1:]),  # the program of Sparse is too long
    "four-bar": lambda: (*four_bar(2), DEPENDENT),
    "spatial four-bar": lambda: (*four_bar(3), DEPENDENT),
    "polar": lambda: (*polar(), (jc.solvers.Schur(), jc.solvers.Dense())),
}


@pytest.mark.parametrize("name", SCENES)
def test_it_is_among_the_cheapest(name):
    system, state, solvers = SCENES[name]()
    taken = jc.Method.auto(system, state).solver
    if name == "wide ring":
        assert "more than" in str(choose(system, state))
    own = operations(system, state, taken)
    for solver in solvers:
        swept = isinstance(solver, jc.solvers.ConjugateGradients)
        assert own <= (choice.SURE if swept else DEARER) * operations(system, state, solver)


def test_loops_are_safe_from_dependent_rows():
    """Three rows of the last hinge of a spatial four-bar are redundant.

    So is the second of two rods.
    """
    assert words(jc.Method.auto(*four_bar(3)).solver) == "RankSafe()"
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    scene.add(jc.Distance("again", jc.WORLD, "bob"))
    system, state = scene.build()
    for method, status in (
        (jc.Method.auto(system, state), Status.OK),
        (jc.Method(solver=jc.solvers.Sparse()), Status.SINGULAR),
    ):
        assert int(jc.step(system, method, state, None, 1e-3)[0].status) == status


def flat(q, t, p):
    """Returns a row whose gradient vanishes at q = 0."""
    return jnp.stack([q[0] ** 2])


def two(q, t, p):
    """Returns two rows that may be dependent."""
    return jnp.stack([q[0] - q[1], q[0] + q[1]])


def general(function):
    """A system in generalized coordinates under a constraint."""
    system = jc.GeneralizedSystem(
        mass=lambda q, p: p["m"] * jnp.eye(2),
        force=lambda q, v, t, u, p: jnp.stack([0.0 * q[0], -9.81 * p["m"]]),
        constraints=(jc.joints.Holonomic(function, name="rows"),),
        params={"m": jnp.asarray(1.0)},
    )
    return system, jc.init(system, jc.Method(), jnp.zeros(2), jnp.zeros(2))


def test_rows_that_depend_by_their_numbers_alone():
    assert words(jc.Method.auto(*general(two)).solver) == "RankSafe(Schur())"
    assert words(jc.Method.auto(*general(flat)).solver) == "RankSafe(Schur(), always=True)"


def test_nothing_to_solve():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0)
    found = choose(*scene.build())
    assert words(found.solver) == "RankSafe()"
    assert "no rows" in str(found)


def test_bounded_rows_take_a_substitution_each():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.5))
    scene.add_particle("bead", mass=1.0, position=(2.0, 0.5))
    scene.add(jc.Distance("rod", "bob", "bead"))
    bare = choose(*scene.build())
    scene.add(jc.contacts.Rope("rope", jc.WORLD, "bob", length=2.0, point_a=(0.0, 0.0)))
    system, state = scene.build()
    assert choice.look(system, state).bounded == 1
    found = choose(system, state)
    assert words(found.solver) == "Sparse()"
    assert found.efforts["Sparse"].operations > bare.efforts["Sparse"].operations
    _, info = jc.step(system, jc.Method.auto(system, state), state, None, 1e-3)
    assert int(info.status) == Status.OK


def test_the_variational_equations_have_the_same_rows():
    scene = jc.Scene(dim=2)
    scene.add_body("skate", mass=60.0, inertia=2.0, velocity=(3.0, 0.0))
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0)))
    system, state = scene.build()
    twin, start = jc.systems.vakonomic(system, state, {"blade": 0.1})
    assert words(jc.Method.auto(twin, start).solver) == "Sparse()"
    new, _ = jc.step(twin, jc.Method.auto(twin, start), start, None, 1e-3)
    assert int(new.status) == Status.OK


def facts(rows, bodies, loops=False):
    """Facts about distances of particles in the plane.

    With few `bodies` many rows share a particle.
    """
    ends = tuple(i % bodies for i in range(rows)), tuple(bodies + i for i in range(rows))
    blocks = tuple((0, 1, Columns(0, 2, bodies + rows, own)) for own in ends)
    return Facts(rows, 2 * (bodies + rows), loops, 0, True, blocks, 0)


def decided(known, width=8):
    """Returns the name of the solver that is chosen for the facts."""
    inner, _ = choice._inner(known, choice.weigh(known, "runs"), width, None, "cpu")
    return words(choice._safe(known, inner)[0])


def test_rules_are_of_structure_and_size():
    assert decided(facts(40, 40)) == "Sparse()"
    assert decided(facts(40, 40, loops=True)) == "RankSafe()"
    assert decided(facts(60, 1)) == "Schur()"  # the program of `Sparse` would be too long
    assert decided(facts(60, 1, loops=True)) == "RankSafe(Schur())"
    assert decided(facts(2000, 1)) == "ConjugateGradients()"  # far fewer operations
    assert decided(facts(60, 1), width=8_000_000) == "ConjugateGradients()"  # too little memory
    assert words(choose(*rope(3), platform="gpu").solver) == "Sparse(order='levels')"


def test_other_parts_are_taken_as_they_are():
    system, state = four_bar(2)
    method = jc.Method.auto(system, state, integrator=jc.RK4(), stabilizer=jc.Projection())
    assert isinstance(method.integrator, jc.integrators.RungeKutta)
    assert isinstance(method.stabilizer, jc.Projection)
    assert words(jc.Method.auto(system, state, solver=jc.solvers.Dense()).solver) == "Dense()"
    again = jc.Method.auto(system, state, integrator=jc.RK4(), stabilizer=jc.Projection())
    assert jax.tree.structure(again) == jax.tree.structure(method)


def test_what_it_cannot_look_at_is_refused():
    system, state = rope(2)
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(lambda s: jc.Method.auto(system, s).solver)(state)
    with pytest.raises(ValueError, match="state.q must have shape"):
        jc.Method.auto(system, rope(3)[1])
    with pytest.raises(ValueError, match="batch must be a whole number"):
        jc.Method.auto(system, state, batch=0)
    with pytest.raises(TypeError, match="unexpected keyword"):
        jc.Method.auto(system, state, stabiliser=jc.Projection())
