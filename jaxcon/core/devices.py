"""Distribution of batches of worlds over the devices of a mesh."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxcon.core import checks
from jaxcon.core.typing import PyTree, T, Tree

SHARED, APART = PartitionSpec(), PartitionSpec("worlds")


def shard(batch: Tree, mesh: Mesh | None = None) -> Tree:
    """Splits a batch along its first axis (worlds) into equal parts, one for each device.

    `jit(vmap(f))` then runs without communication: results stay on their device, and loops and
    branches of a method depend only on the worlds of the device. For gradients with respect to
    parameters that all worlds share, which are sums over worlds, use `over_devices`.

    If several processes are joined by `jax.distributed.initialize`, all must pass the same batch;
    each process keeps its part. For a large batch, shard random keys or initial values, and compute
    the batch from them in `jit`.

    Args:
        batch: a pytree of arrays (n, …).
        mesh: a mesh of any shape; None for all devices of all processes.

    Returns:
        The batch, with arrays split along their first axes.

    Raises:
        ValueError: an array has no first axis, the arrays differ in n, or n is not a multiple of
            the number of devices.
        TypeError: `mesh` is no mesh.
    """
    mesh = _line(mesh)
    _check("shard", batch, mesh.size)
    return jax.device_put(batch, NamedSharding(mesh, APART))


def over_devices(function: Callable[..., Any], mesh: Mesh | None = None) -> Callable[..., Any]:
    """Maps function(shared, batch) over devices; each device evaluates its part of the batch.

    Devices do not wait for each other, even in iterative solvers. The result can be jitted and
    differentiated. The gradient with respect to `shared` is summed on each device over the whole
    motion, and over devices once at the end. With `jit(grad(vmap(f)))` of a batch from `shard`,
    devices may exchange the gradient in every step.

        settled = jc.devices.over_devices(jax.vmap(settle, in_axes=(None, 0)))
        slope = jax.jit(jax.grad(lambda p, worlds: jnp.mean(settled(p, worlds))))

    Args:
        function: (shared, batch) → a pytree of arrays, each with the worlds along its first axis.
            Worlds must not depend on each other.
        mesh: see `shard`.

    Returns:
        A function (shared, batch) → the result. The batch need not be sharded before the call. A
        call raises a ValueError if the batch cannot be split over the devices; see `shard`.

    Raises:
        TypeError: `function` does not accept two arguments, or `mesh` is no mesh.
    """
    checks.takes("over_devices", "function", function, ("shared", "batch"))
    line = _line(mesh)
    # without this check, values need no annotation of whether devices share them
    parts = {"in_specs": (SHARED, APART), "out_specs": APART, "check_vma": False}
    mapped = jax.shard_map(function, mesh=line, **parts)

    def call(shared: PyTree, batch: PyTree) -> Any:
        _check("over_devices", batch, line.size)
        return mapped(shared, batch)

    return call


def gathered(tree: T, mesh: Mesh) -> T:
    """Replicates a tree on every device of a mesh; for use inside `jit`."""
    return jax.lax.with_sharding_constraint(tree, NamedSharding(_line(mesh), SHARED))


def _line(mesh: Mesh | None) -> Mesh:
    """Returns a one-dimensional mesh, with the axis "worlds", of the devices of `mesh`.

    If `mesh` is None, the result contains all devices.

    Raises:
        TypeError: `mesh` is no mesh.
    """
    if not isinstance(mesh, Mesh | None):
        raise TypeError(
            "a mesh must be one of JAX, such as jax.make_mesh((2,), ('worlds',)), got"
            f" {type(mesh).__name__}."
        )
    devices = np.asarray(jax.devices()) if mesh is None else mesh.devices
    return Mesh(devices.ravel(), ("worlds",))


def _check(owner: str, batch: PyTree, devices: int) -> None:
    """Checks that a batch can be split into equal parts, one for each device.

    Raises:
        ValueError: the batch cannot be split; see `shard`.
    """
    leaves = jax.tree_util.tree_leaves_with_path(batch)
    sizes = {jax.tree_util.keystr(path) or "the array": np.shape(x)[:1] for path, x in leaves}
    single = [name for name, size in sizes.items() if not size]
    if single:
        raise ValueError(
            f"{owner}: {single[0]} of the batch has no first axis of worlds; give what jax.vmap"
            " would take."
        )
    if len(set(sizes.values())) > 1:
        counts = {name: size[0] for name, size in sizes.items()}
        raise ValueError(f"{owner}: all of a batch must have as many worlds, got {counts}.")
    for (n,) in set(sizes.values()):
        if n % devices:
            raise ValueError(
                f"{owner}: a batch of {n} worlds does not divide over {devices} devices; take"
                f" {devices * -(-n // devices)} worlds, or a mesh of fewer devices."
            )
