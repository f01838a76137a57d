"""Runs on two devices in a separate process: worlds inside `shard_map` and on explicit meshes.

The results must equal those of one device, with JAX's default type checks.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import scenes
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import jaxcon as jc
from benchmarks import devices

SCENES = {
    "turns": (
        lambda: scenes.arm(jc.forces.JointSpring("spring", "hinge", 2.0), dim=3),
        jc.solvers.Sparse(),
    ),
    "stop": (lambda: scenes.arm(jc.Limit("stop", "hinge", -0.1, 0.02)), jc.solvers.RankSafe()),
}


def same(found, expected):
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12)


def kernels(function, worlds):
    """Returns the number of kernels that a program for NVIDIA's GPUs calls."""
    traced = jax.jit(function).trace(1.0, worlds)
    return traced.lower(lowering_platforms=("cuda",)).as_text().count("__gpu$xla.gpu.ptx")


def check(name):
    make, solver = SCENES[name]
    (system, state), method = make(), jc.Method(solver=solver)
    turning = jnp.zeros_like(state.v).at[-2 if system.layout.dim == 3 else -1].set(1.0)
    starts = jnp.linspace(0.2, 2.0, 4)[:, None] * turning
    worlds = jax.vmap(lambda v: jc.init(system, method, state.q, v))(starts)

    def final(share, world):
        return jc.rollout(system, method, world, None, 1e-2 * share, 3)[0]

    run = jax.vmap(final, in_axes=(None, 0))

    def loss(share, worlds):
        q = run(share, worlds).q
        return jnp.sum(q), q

    descent = jax.grad(loss, has_aux=True)
    slope, expected = jax.jit(descent)(1.0, worlds)
    assert abs(slope) > 1e-6, name
    assert np.ptp(np.asarray(expected), axis=0).max() > 1e-6, name

    def summed(share, worlds):
        total, q = loss(share, worlds)
        return jax.lax.psum(total, "x"), q

    mesh = jax.make_mesh((2,), ("x",), axis_types=(AxisType.Auto,))
    laid, whole = PartitionSpec("x"), PartitionSpec()
    parts = {"mesh": mesh, "in_specs": (whole, laid)}
    inside = jax.shard_map(jax.grad(summed, has_aux=True), out_specs=(whole, laid), **parts)
    compiled = jax.jit(inside).lower(1.0, worlds).compile()
    same(compiled(1.0, worlds), (slope, expected))
    # a kernel of a GPU cannot be split over devices by the compiler
    placed = jax.device_put(worlds, NamedSharding(mesh, laid))
    mapped = jax.shard_map(run, out_specs=laid, **parts)
    if name == "turns":
        assert kernels(mapped, placed) == 1
    assert kernels(run, placed) == 0
    if name == "turns":  # the only communication is one sum at the end
        assert devices.exchanges(compiled.as_text()) == {"all-reduce": 1}
        same(jax.jit(jax.grad(lambda x: jnp.sum(mapped(x, worlds).q)))(1.0), slope)

    mesh = jax.make_mesh((2,), ("x",), axis_types=(AxisType.Explicit,))
    with jax.set_mesh(mesh):
        apart = jax.device_put(worlds, NamedSharding(mesh, laid))
        found = jax.jit(descent)(1.0, apart)
        assert jax.typeof(found[1]).sharding.spec[0] == "x"
        same(found, (slope, expected))


for name in sys.argv[1:] or SCENES:
    check(name)
