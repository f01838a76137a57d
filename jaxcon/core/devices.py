"""Batches of worlds over the devices of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxcon.core.typing import PyTree

SHARED, APART = PartitionSpec(), PartitionSpec("worlds")


def shard(batch: PyTree, mesh: Mesh | None = None) -> PyTree:
    """Returns the batch with equal parts of its worlds, the first axis, on each device.

    What `jit(vmap(f))` makes of it stays there, and nothing is exchanged: loops and branches of a
    method ask on each device of its own worlds alone. Gradients by numbers that worlds share are
    sums over all of them; take `over_devices` for these.

    Several processes, joined by `jax.distributed.initialize`, all give the same batch and keep
    their parts of it. Where it is large, give keys or starts, and make the batch of them in `jit`.

    Args:
        batch: a pytree of arrays (n, …).
        mesh: of any shape; all devices of all processes unless given.

    Returns:
        The batch, its arrays split along their first axes.

    Raises:
        ValueError: an array has no first axis, or another n; or n does not divide.
        TypeError: the mesh is none.
    """
    mesh = _line(mesh)
    _check("shard", batch, mesh.size)
    return jax.device_put(batch, NamedSharding(mesh, APART))


def over_devices(function: Callable[..., Any], mesh: Mesh | None = None) -> Callable[..., Any]:
    """function(shared, batch), where each device works on its own part of the batch.

    No device waits for another, also where methods iterate until their worlds are done. It is good
    to jit and to differentiate. The derivative by what is shared is summed on each device over the
    whole motion, and over devices once, at the end: under `jit(grad(vmap(f)))` of a batch from
    `shard` devices would meet in every step.

        settled = jc.over_devices(jax.vmap(settle, in_axes=(None, 0)))
        slope = jax.jit(jax.grad(lambda p, worlds: jnp.mean(settled(p, worlds))))

    Args:
        function: (shared, batch) → a pytree of arrays, each with a first axis of the worlds of the
            batch, which do not act on each other.
        mesh: as of `shard`.

    Returns:
        (shared, batch) → the same as the function. The batch need not lie over the devices before.

    Raises:
        ValueError: as of `shard`, when it is called.
        TypeError: the mesh is none.
    """
    line = _line(mesh)
    # what is shared stays so without being told apart from what is not in every operation
    parts = {"in_specs": (SHARED, APART), "out_specs": APART, "check_vma": False}
    mapped = jax.shard_map(function, mesh=line, **parts)

    def call(shared: PyTree, batch: PyTree) -> PyTree:
        _check("over_devices", batch, line.size)
        return mapped(shared, batch)

    return call


def gathered(tree: PyTree, mesh: Mesh) -> PyTree:
    """Returns the tree with all of it on every device, inside `jit`."""
    return jax.lax.with_sharding_constraint(tree, NamedSharding(_line(mesh), SHARED))


def _line(mesh: Mesh | None) -> Mesh:
    """The devices of a mesh along one axis, of worlds; where arrays lie is left to the compiler.

    Raises:
        TypeError: it is no mesh.
    """
    if not isinstance(mesh, Mesh | None):
        raise TypeError(
            "a mesh must be one of JAX, such as jax.make_mesh((2,), ('worlds',)), got"
            f" {type(mesh).__name__}."
        )
    devices = np.asarray(jax.devices()) if mesh is None else mesh.devices
    return Mesh(devices.ravel(), ("worlds",))


def _check(owner: str, batch: PyTree, devices: int) -> None:
    """Checks that a batch divides over so many devices.

    Raises:
        ValueError: as of `shard`.
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
        found = {name: size[0] for name, size in sizes.items()}
        raise ValueError(f"{owner}: all of a batch must have as many worlds, got {found}.")
    for (n,) in set(sizes.values()):
        if n % devices:
            raise ValueError(
                f"{owner}: a batch of {n} worlds does not divide over {devices} devices; take"
                f" {devices * -(-n // devices)} worlds, or a mesh of fewer devices."
            )
