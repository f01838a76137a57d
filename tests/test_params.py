"""Every number of a system can be read, changed and differentiated by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

import jaxcon as jc

LINK = {"mass": 1.5, "inertia": 0.4}


def scene_with_everything():
    scene = jc.Scene(dim=2)
    scene.add_body("link", **LINK, position=(1.0, 0.0), angle=0.3)
    scene.add_particle("bob", mass=0.5, position=(2.0, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "link", point=(0.0, 0.0)))
    scene.add(jc.Distance("rod", "link", "bob"))
    scene.add(jc.Spring("spring", jc.WORLD, "bob", stiffness=20.0, damping=0.1))
    scene.add(jc.forces.JointSpring("coil", "hinge", stiffness=2.0, damping=0.3, rest=0.1))
    scene.add(jc.forces.Force("wind", "bob", force=(1.0, 2.0)))
    return scene.build()


@pytest.mark.parametrize("name", ["mixed-3d", "driven_revolute-3d-loop", "holonomic-2d-between"])
def test_the_same_numbers_give_the_same_system(name):
    system = scenes.build(name).system
    again = system.with_params(system.params)
    assert jax.tree.structure(again) == jax.tree.structure(system)
    for got, expected in zip(jax.tree.leaves(again), jax.tree.leaves(system), strict=True):
        np.testing.assert_array_equal(got, expected)


def test_every_field_is_read_as_it_was_given():
    system, _ = scene_with_everything()
    params = system.params
    assert {k: x for k, x in params["link"].items() if k != "center"} == LINK
    np.testing.assert_array_equal(params["link"]["center"], (0, 0))
    assert params["bob"] == {"mass": 0.5}
    assert params["rod"]["length"] == 1.0
    assert params["spring"]["rest_length"] == 2.0
    assert params["coil"] == {"stiffness": 2.0, "damping": 0.3, "rest": 0.1}
    np.testing.assert_array_equal(params["wind"]["force"], (1, 2))
    np.testing.assert_array_equal(params["gravity"], (0, -9.81))


CHANGES = [
    ("gravity", None, (1.0, 2.0)),
    ("link", "mass", 3.0),
    ("link", "inertia", 0.9),
    ("bob", "mass", 0.7),
    ("rod", "length", 1.4),
    ("hinge", "anchor_b", (0.3, 0.2)),
    ("spring", "stiffness", 30.0),
    ("coil", "rest", 0.7),
    ("wind", "force", (3.0, 4.0)),
]


@pytest.mark.parametrize(("name", "field", "value"), CHANGES)
def test_one_number_changes_and_no_other(name, field, value):
    system, _ = scene_with_everything()
    value = jnp.asarray(value)
    changed = system.with_params({name: value if field is None else {field: value}}).params
    new = changed[name] if field is None else changed[name][field]
    np.testing.assert_array_equal(new, value)
    before, after = system.params, changed
    for params in (before, after):
        if field is None:
            params.pop(name)
        else:
            params[name].pop(field)
    jax.tree.map(np.testing.assert_array_equal, before, after)


def after(system, state, steps=10):
    final, _ = jc.rollout(system, jc.Method(), state, None, 0.01, steps)
    return jnp.sum(final.q**2)


def test_gradient_by_every_number_against_differences():
    """Differentiates along one random direction in the space of all numbers."""
    system, state = scene_with_everything()
    params = system.params
    random = np.random.default_rng(0)
    direction = jax.tree.map(lambda x: jnp.asarray(random.normal(size=x.shape)), params)
    value = jax.jit(lambda p: after(system.with_params(p), state))

    def at(h):
        return value(jax.tree.map(lambda x, d: x + h * d, params, direction))

    gradient = jax.jit(jax.grad(lambda p: after(system.with_params(p), state)))(params)
    slope = sum(jax.tree.leaves(jax.tree.map(lambda g, d: jnp.sum(g * d), gradient, direction)))
    np.testing.assert_allclose(slope, (at(1e-6) - at(-1e-6)) / 2e-6, rtol=1e-6)
    for path, leaf in jax.tree.leaves_with_path(gradient):
        assert jnp.all(jnp.isfinite(leaf)), path


def test_changes_do_not_retrace():
    system, state = scene_with_everything()
    traces = []

    @jax.jit
    def run(system):
        traces.append(1)
        return jc.step(system, jc.Method(), state, None, 0.01)[0].q

    for mass in (1.0, 2.0, 3.0):
        run(system.with_params({"link": {"mass": mass}}))
    assert len(traces) == 1


def test_a_batch_of_systems():
    system, state = scene_with_everything()
    masses = jnp.asarray([1.0, 2.0, 4.0])

    def one(mass):
        return after(system.with_params({"link": {"mass": mass}}), state)

    batch = jax.jit(jax.vmap(one))(masses)
    alone = jax.jit(one)
    np.testing.assert_allclose(batch, [alone(m) for m in masses], rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lonk": {"mass": 1.0}}, ["'lonk' is unknown", "'link'"]),
        ({"link": {"weight": 1.0}}, ["'link' has no", "weight", "mass"]),
        ({"link": {"mass": (1.0, 2.0)}}, ["'link': mass", r"\(\)", r"\(2,\)"]),
        ({"wind": {"force": (1.0, 2.0, 3.0)}}, ["wind.force", r"\(2,\)", r"\(3,\)"]),
        ({"gravity": 9.81}, ["gravity", r"\(2,\)", r"\(\)"]),
        ({"link": {"mass": jnp.asarray(1.0, jnp.float32)}}, ["'link': mass", "float32", "float64"]),
        ({"link": {"mass": "heavy"}}, ["'link': mass", "heavy"]),
        ({"hinge": {"anchor_b": (jnp.nan, 0.0)}}, ["hinge.anchor_b", "finite", "nan"]),
        ({"coil": {"rest": jnp.inf}}, ["coil.rest", "finite", "inf"]),
        ({"gravity": (0.0, jnp.inf)}, ["gravity", "finite", "inf"]),
        ("link", ["with_params: give a mapping", "'link'"]),
    ],
)
def test_changes_that_do_not_fit(changes, words):
    system, _ = scene_with_everything()
    with pytest.raises(ValueError, match=".*".join(words)):
        system.with_params(changes)


OUT_OF_RANGE = [
    ("link", "mass", 0.0),
    ("link", "inertia", 0.0),
    ("bob", "mass", -1.0),
    ("rod", "length", 0.0),
    ("spring", "stiffness", -1.0),
]


@pytest.mark.parametrize(("name", "field", "value"), OUT_OF_RANGE)
def test_what_build_refuses_is_refused(name, field, value):
    system, _ = scene_with_everything()
    with pytest.raises(ValueError, match=f"{name}.*{field}.*{value}"):
        system.with_params({name: {field: value}})


@pytest.mark.parametrize("field", ["mass", "inertia"])
def test_a_traced_number_out_of_range_stops_the_world(field):
    system, state = scene_with_everything()

    @jax.jit
    def code(value):
        changed = system.with_params({"link": {field: value}})
        return jc.step(changed, jc.Method(), state, None, 0.01)[1].status

    assert code(1.0) == jc.Status.OK
    assert code(0.0) != jc.Status.OK


def test_parameters_of_generalized_coordinates():
    built = scenes.build("polar")
    heavier = built.system.with_params(built.system.params | {"mass": jnp.asarray(3.0)})
    np.testing.assert_allclose(heavier.mass(built.state.q).values, 3.0 * np.array([1, 1.2**2]))


def test_some_of_the_parameters_of_generalized_coordinates_are_changed_by_name():
    theta = {"m": jnp.asarray(1.0), "spring": {"k": jnp.asarray(2.0), "rest": jnp.asarray(0.5)}}
    system = jc.GeneralizedSystem(
        mass=lambda q, p: p["m"] * jnp.eye(1), force=lambda q, v, t, u, p: -q, params=theta
    )
    changed = system.with_params({"spring": {"k": jnp.asarray(3.0)}})
    assert changed.params == theta | {"spring": theta["spring"] | {"k": 3.0}}
    for unknown in ({"n": 1.0}, {"spring": {"c": 1.0}}):
        with pytest.raises(ValueError, match="is unknown; known are"):
            system.with_params(unknown)
    assert system.with_params(jnp.ones(2)).params.shape == (2,)  # replaces all of θ
