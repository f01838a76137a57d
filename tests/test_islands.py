"""Islands of equality rows, and the islands in which a stop or contact is active."""

import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.constraints.rows import linearize
from jaxcon.contact.rows import linearize_at_rest, rows_beside_contact
from jaxcon.linear.islands import islands, largest_by_island


def doors(stops=(0, 1)):
    """Two doors, the first with a second leaf; stops, a ball on a floor, and friction."""
    scene = jc.Scene(dim=2)
    for i in range(2):
        scene.add_body(f"door{i}", mass=1.0, inertia=0.1, position=(10.0 * i + 0.5, 0.0))
        scene.add(jc.Revolute(f"post{i}", jc.WORLD, f"door{i}", point=(10.0 * i, 0.0)))
    scene.add_body("leaf", mass=1.0, inertia=0.1, position=(1.5, 0.0))
    scene.add(jc.Revolute("hinge", "door0", "leaf", point=(1.0, 0.0)))
    scene.add_body("loose", mass=1.0, inertia=0.1, position=(50.0, 0.0))
    for i in stops:
        scene.add(jc.Limit(f"stop{i}", f"post{i}", 0.0, 1.0))
    scene.add(jc.contacts.JointFriction("rub", "post0", 1.0))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "loose", friction=0.5))
    system, state = scene.build()
    rows = linearize(system, state.q, state.v, state.time)
    return system, rows, linearize_at_rest(system, state.q, state.v)


def test_joints_connect_bodies_and_the_world_does_not():
    system, rows, _ = doors()
    of_rows, of_velocities = islands(rows.jacobian)
    first, second = (of_rows[rows.layout.rows(name)] for name in ("post0", "post1"))
    assert set(first) == set(of_rows[rows.layout.rows("hinge")]) == {first[0]}
    assert set(second) == {second[0]} != {first[0]}
    for name, island in (("door0", first[0]), ("leaf", first[0]), ("door1", second[0])):
        assert set(of_velocities[system.layout.v(name)]) == {island}
    assert not {first[0], second[0]} & set(of_velocities[system.layout.v("loose")])


def test_the_largest_number_is_that_of_the_island():
    _, rows, _ = doors()
    x = np.zeros((rows.layout.size, 2))
    x[rows.layout.rows("hinge")[0], 1] = 3.0
    found = largest_by_island(rows.jacobian, jnp.asarray(x))
    expected = np.zeros_like(x)
    for name in ("post0", "hinge"):
        expected[rows.layout.rows(name), 1] = 3.0
    np.testing.assert_array_equal(found, expected)


def test_a_stop_that_acts_marks_the_rows_of_its_island_alone():
    """Marks differ by world.

    Joint friction and the contact of a body without joints mark no rows.
    """
    _, rows, bounds = doors()
    own = {name: bounds.layout.rows(name) for name in bounds.layout.names}
    λ = np.zeros((bounds.kinds.size, 5))
    for world, name in enumerate(("stop0", "stop1", "rub", "floor")):
        λ[own[name], world] = 2.0
    found = rows_beside_contact(rows.jacobian, bounds, jnp.asarray(λ))
    expected = np.zeros((rows.layout.size, 5), bool)
    for world, names in enumerate((("post0", "hinge"), ("post1",))):
        for name in names:
            expected[rows.layout.rows(name), world] = True
    np.testing.assert_array_equal(found, expected)
    alone = rows_beside_contact(rows.jacobian, bounds, jnp.asarray(λ[:, 1]))
    np.testing.assert_array_equal(alone, expected[:, 1])


def test_without_stops_on_joints_no_row_can_be_marked():
    _, rows, bounds = doors(stops=())
    assert rows_beside_contact(rows.jacobian, bounds, jnp.ones(bounds.kinds.size)) is None
