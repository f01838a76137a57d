"""Runs in a process of its own, with two devices: worlds inside `shard_map` and on explicit meshes.

What is found there must be what one device finds, with JAX's default checks of types.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import jaxcon as jc
from benchmarks import devices

LAID = PartitionSpec("x")


def arm(*elements, dim=2):
    scene = jc.Scene(dim=dim)
    place = np.eye(dim)[0]
    inertia = 0.1 if dim == 2 else (0.1, 0.2, 0.3)
    axis = {} if dim == 2 else {"axis": (0.0, 1.0, 0.0)}
    scene.add_body("arm", mass=1.0, inertia=inertia, position=0.5 * place)
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=0 * place, **axis))
    for element in elements:
        scene.add(element)
    return scene.build()


SCENES = {
    "spring in space": (lambda: arm(jc.JointSpring("spring", "hinge", 2.0), dim=3), jc.Method()),
    "stop": (lambda: arm(jc.Limit("stop", "hinge", -1e-3, 0.1)), jc.Method(solver=jc.Sparse())),
    "projection": (arm, jc.Method(stabilizer=jc.Projection(), solver=jc.Sparse())),
    "several stages": (arm, jc.Method(jc.RK4(), solver=jc.Sparse())),
}


def same(found, expected):
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12)


def check(name):
    make, method = SCENES[name]
    system, state = make()
    state = jc.init(system, method, state.q, state.v + 1e-3)
    scales = jnp.linspace(1.0, 2.0, 4)
    worlds = jax.vmap(lambda s: jax.tree.map(lambda x: s.astype(x.dtype) * x, state))(scales)

    def final(share, world):
        return jc.rollout(system, method, world, None, 1e-2 * share, 3)[0]

    run = jax.vmap(final, in_axes=(None, 0))

    def loss(share, worlds):
        return jnp.sum(run(share, worlds).q ** 2)

    expected, slope = jax.jit(run)(1.0, worlds), jax.jit(jax.grad(loss))(1.0, worlds)
    assert abs(slope) > 1e-6
    assert np.ptp(np.asarray(expected.q), axis=0).max() > 1e-6

    mesh = jax.make_mesh((2,), ("x",), axis_types=(AxisType.Auto,))
    parts = {"mesh": mesh, "in_specs": (PartitionSpec(), LAID)}
    mapped = jax.shard_map(run, out_specs=LAID, **parts)
    same(jax.jit(mapped)(1.0, worlds), expected)
    outside = jax.jit(jax.grad(lambda share: jnp.sum(mapped(share, worlds).q ** 2)))
    same(outside(1.0), slope)

    def summed(share, worlds):
        return jax.lax.psum(loss(share, worlds), "x")

    inside = jax.jit(jax.shard_map(jax.grad(summed), out_specs=PartitionSpec(), **parts))
    same(inside(1.0, worlds), slope)
    assert devices.exchanges(inside.lower(1.0, worlds).compile().as_text()) == {"all-reduce": 1}

    mesh = jax.make_mesh((2,), ("x",), axis_types=(AxisType.Explicit,))
    with jax.set_mesh(mesh):
        laid = jax.device_put(worlds, NamedSharding(mesh, LAID))
        found = jax.jit(run)(1.0, laid)
        assert jax.typeof(found.q).sharding.spec[0] == "x"
        same(found, expected)
        same(jax.jit(jax.grad(loss))(1.0, laid), slope)
        if name == "several stages":  # no world waits for another
            assert devices.exchanges(jax.jit(run).lower(1.0, laid).compile().as_text()) == {}


for name in sys.argv[1:] or SCENES:
    check(name)
