"""Small versions of the examples of tuning and learning support their claims."""

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc

EXAMPLES = Path(__file__).parents[1] / "examples"


def example(name):
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_gains_reach_the_least_of_a_grid_from_far_away():
    this = example("tune_gains")
    _, plane = this["grid"](24)
    least = np.nanmin(plane)
    default = this["tune"](1.0)
    assert default.loss - least < np.log10(1.05)
    assert this["tune"](0.01).loss - least < np.log10(1.05)
    assert default.history[0] - default.loss > np.log10(1.4)


def test_a_suspension_settles_as_wanted_and_its_neighbours_do_worse():
    this = example("suspension")
    found = this["fit"](60)
    assert 10**found.loss < 5e-4
    near = np.array([[0.95, 1.0], [1.05, 1.0], [1.0, 0.95], [1.0, 1.05]])
    others = {name: found.params[name] * near[:, i] for i, name in enumerate(found.params)}
    assert np.all(jax.jit(jax.vmap(this["loss"]))(others) > found.loss)


def test_a_pole_is_swung_up_within_the_limit_of_its_force():
    this = example("swing_up")
    found = this["find"](200)
    final, _ = jax.jit(this["swing"])(found.params)
    system, height = this["system"], this["LENGTH"] / 2
    assert jc.position(system, final, "pole")[1] > 0.99 * height
    assert abs(jc.angular_velocity(system, final, "pole")) < 0.3
    assert jnp.linalg.norm(jc.velocity(system, final, "cart")) < 0.2
    assert jnp.max(jnp.abs(found.params)) <= this["LIMIT"]


def test_lengths_of_a_linkage_follow_from_the_path_of_its_coupler():
    this = example("coupler_path")
    found = this["find"]()
    for x, y in zip(jax.tree.leaves(found.params), jax.tree.leaves(this["TRUTH"]), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-8)
    assert not found.untold
