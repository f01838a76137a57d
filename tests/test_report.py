"""Reports: degrees of freedom, rank and redundant rows of textbook mechanisms, and costs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.analysis.work import work


def add_link(scene, name, start, end):
    """A slender body between two points, in the plane or in space."""
    inertia = 0.3 if scene.dim == 2 else (0.1, 0.3, 0.3)
    middle = (np.asarray(start) + np.asarray(end)) / 2
    scene.add_body(name, mass=1.0, inertia=inertia, position=middle)


def four_bar(dim):
    """World – crank – coupler – rocker – world, hinged about the normal of the plane."""
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [2.0, 1.5], [2.5, 0.0]])
    axis = None
    if dim == 3:
        corners = np.column_stack([corners[:, 0], np.zeros(4), corners[:, 1]])
        axis = (0.0, 1.0, 0.0)
    scene = jc.Scene(dim=dim)
    names = ("crank", "coupler", "rocker")
    for i, name in enumerate(names):
        add_link(scene, name, corners[i], corners[i + 1])
    pairs = ((jc.WORLD, "crank"), ("crank", "coupler"), ("coupler", "rocker"), ("rocker", jc.WORLD))
    for i, ((a, b), corner) in enumerate(zip(pairs, corners, strict=True)):
        scene.add(jc.Revolute(f"hinge{i}", a, b, point=corner, axis=axis))
    return scene.build()


def test_planar_four_bar():
    report = jc.report(*four_bar(2))
    assert (report.velocities, report.rows, report.rank) == (9, 8, 8)
    assert report.degrees_of_freedom == 1
    assert report.redundant == ()


def test_spatial_four_bar_of_four_revolutes():
    """The linkage moves although 18 − 20 < 0: three rows of the last hinge are redundant."""
    report = jc.report(*four_bar(3))
    assert (report.velocities, report.rows, report.rank) == (18, 20, 17)
    assert report.degrees_of_freedom == 1
    assert len(report.redundant) == 3
    assert {name for name, _ in report.redundant} == {"hinge3"}
    assert "redundant rows" in str(report)
    assert "hinge3" in str(report)


def test_a_door_on_two_hinges():
    """One of the hinges is redundant: the report names its five rows."""
    scene = jc.Scene()
    scene.add_body("door", mass=20.0, inertia=(2.0, 3.0, 1.0), position=(0.5, 0.0, 1.0))
    for name, height in (("lower", 0.3), ("upper", 1.7)):
        point = (0.0, 0.0, height)
        scene.add(jc.Revolute(name, jc.WORLD, "door", point=point, axis=(0.0, 0.0, 1.0)))
    report = jc.report(*scene.build())
    assert (report.rows, report.rank, report.degrees_of_freedom) == (10, 5, 1)
    assert len(set(report.redundant)) == 5
    assert {name for name, _ in report.redundant} <= {"lower", "upper"}
    assert "upper[4]" in str(report)


def test_the_same_constraint_twice_is_named():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    scene.add(jc.Distance("again", jc.WORLD, "bob"))
    system, state = scene.build()
    assert jc.report(system, state).redundant == (("again", 0),)


def test_condition_does_not_depend_on_units_of_rows():
    """Two orthogonal rods have condition 1; rods at an angle θ have (1 + c)/(1 − c), c = cos θ."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=3.0)
    c = np.cos(0.5)
    scene.add(jc.Distance("a", jc.WORLD, "bob", point_a=(1.0, 0.0)))
    scene.add(jc.Distance("b", jc.WORLD, "bob", point_a=(50 * c, 50 * np.sin(0.5))))
    report = jc.report(*scene.build())
    assert report.condition == pytest.approx((1 + c) / (1 - c))


def test_violation_is_listed_by_constraint():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(3.0, 4.0), velocity=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=4.5))
    report = jc.report(*scene.build())
    np.testing.assert_allclose(report.violation["rod"], (0.5, 0.6))
    assert "rod: violation 5.00e-01, rate 6.00e-01" in str(report)


def test_a_rod_too_short_to_reach_is_sent_to_assemble():
    """The rows are independent at the start, so that the rank does not show the contradiction."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(0.6, 0.8))
    scene.add(jc.Distance("left", jc.WORLD, "bob", length=1.0))
    scene.add(jc.Distance("right", jc.WORLD, "bob", length=1.9, point_a=(3.0, 0.0)))
    system, state = scene.build()
    assert "jc.assemble(system, state)" in str(jc.report(system, state))
    assert "'right'" in str(jc.assemble(system, state))
    near = dataclasses.replace(state, q=jnp.array([1.0, 0.0]))
    system = system.with_params({"right": {"length": 2.0}})
    assert "assemble" not in str(jc.report(system, near))


def test_a_skate_that_slips_is_where_it_may_be():
    """The row constrains a velocity, ψ = 0.5 m/s.

    There is no position error for assembly to correct.
    """
    scene = jc.Scene(dim=2)
    scene.add_body("skate", mass=60.0, inertia=2.0, velocity=(3.0, 0.5))
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0)))
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=1.0))
    system, state = scene.build()
    report = jc.report(system, state)
    np.testing.assert_allclose(report.violation["blade"], (0.5, 0.5))
    assert report.off == ()
    assert "assemble" not in str(report)
    report = jc.report(system.with_params({"rod": {"length": 1.1}}), state)
    assert report.off == ("rod",)
    assert "off rod: print(jc.assemble(system, state))" in str(report)


def test_what_a_report_cannot_take_is_named():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    with pytest.raises(TypeError, match=r"jc.Method\(jc.RK4\(\)\), got RungeKutta"):
        jc.report(system, state, jc.RK4(), 1e-3)
    for wrong in (-1e-3, "1 ms"):
        with pytest.raises(ValueError, match="report: dt"):
            jc.report(system, state, jc.Method(), wrong)
    scene.add(jc.Distance("stub", jc.WORLD, "bob", point_a=(1.0, 0.0)))
    with pytest.raises(ValueError, match="'stub': the distance of its points, as no length is"):
        scene.build()


def test_without_constraints():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0)
    report = jc.report(*scene.build())
    assert (report.rows, report.degrees_of_freedom, report.condition) == (0, 2, 1.0)


def test_float32_has_its_own_tolerance():
    scene = jc.Scene(dtype=jnp.float32)
    scene.add_body("door", mass=20.0, inertia=(2.0, 3.0, 1.0), position=(0.5, 0.1, 1.0))
    for name, height in (("lower", 0.3), ("upper", 1.7)):
        point = (0.0, 0.0, height)
        scene.add(jc.Revolute(name, jc.WORLD, "door", point=point, axis=(0.1, 0.2, 1.0)))
    # parallel axes through points that are not on one axis: the door cannot move
    assert jc.report(*scene.build()).degrees_of_freedom == 0


def test_generalized_coordinates_have_a_report():
    import scenes

    built = scenes.build("polar")
    report = jc.report(built.system, built.state)
    assert (report.coordinates, report.rows, report.degrees_of_freedom) == (2, 1, 1)


def crawler(count):
    """A chain of links on the floor with a stop in each hinge: 3 count − 1 inequality rows."""
    scene = jc.Scene(dim=2)
    for i in range(count):
        scene.add_body(f"link{i}", mass=1.0, inertia=0.1, position=(i, 0.0))
        scene.add(jc.PlaneContact(f"floor{i}", jc.WORLD, f"link{i}", friction=0.3))
        if i:
            scene.add(jc.Revolute(f"hinge{i}", f"link{i - 1}", f"link{i}", point=(i - 0.5, 0.0)))
            scene.add(jc.Limit(f"stop{i}", f"hinge{i}", -1.0, 1.0))
    return scene.build()


def test_a_report_compiles_nothing_of_the_scene(caplog):
    """Without `measure` neither the rows nor a step are compiled."""
    system, state = crawler(12)
    exact = jc.Method(contact_solver=jc.solvers.InteriorPoint())
    with jax.log_compiles(), caplog.at_level("WARNING"):
        report = jc.report(system, state, exact, 1e-3)
        compiled = [x.getMessage() for x in caplog.records if "Compiling" in x.getMessage()]
        assert not [x for x in compiled if "linearize" in x or "step" in x or "_run" in x]
        assert len(compiled) < 20  # single operations, as for default gains
    assert report.memory is report.work is report.probe is report.seconds is None
    assert report.degrees_of_freedom == 36 - 22
    assert "35 inequality rows" in report.warnings["dense"]
    assert "Leave out contact_solver=, which then is Newton()" in report.warnings["dense"]


@pytest.mark.parametrize(
    "solver", [jc.solvers.Sparse(), jc.solvers.Schur(), jc.solvers.Dense()], ids=str
)
def test_the_cost_by_structure_is_near_that_of_the_trace(solver):
    """The estimate has leading terms only and is right within a factor of 2.5."""
    system, state = crawler(12)
    method = jc.Method(solver=solver, contact_solver=jc.solvers.GaussSeidel())
    found = jc.report(system, state, method).cost
    assert found.contact_solver == "GaussSeidel()"
    counted = work(system, method, state).operations
    assert counted / 2.5 < found.operations < 2.5 * counted
    assert found.operations == found.rows + found.solver + found.contact
    for part in ("for the rows", "for the inequality constraints by GaussSeidel()", "(estimated)"):
        assert part in str(found)


def test_the_cost_of_few_rows_of_many():
    """There are n = 35 rows of contacts and stops, of which 2 · 8 + 4 are solved at a time."""
    system, state = crawler(12)
    nearest = jc.solvers.ActiveSet(jc.solvers.GaussSeidel(10), contacts=8, stops=4)
    found = jc.report(system, state, jc.Method(contact_solver=nearest)).cost
    assert found.contact == 10 * (2 * 20**2 + 6 * 20)
    default = jc.report(system, state, jc.Method()).cost
    assert default.contact_solver == "Newton()"
    assert default.contact == 8 * 35 * 30
    few = jc.report(system, state, jc.Method(contact_solver=jc.solvers.Newton(iterations=3))).cost
    assert few.contact == 3 * 35 * 30
    slow = jc.report(system, state, jc.Method(contact_solver=jc.solvers.InteriorPoint())).cost
    assert slow.contact == 15 * (2 * 35**3 + 6 * 35**2)


def test_a_cost_that_is_not_known_is_not_made_up():
    found = jc.report(*four_bar(2), jc.Method(solver=jc.solvers.Priority({"hinge0": 1}))).cost
    assert found.solver is None
    assert "no estimate for the solver" in str(found)
