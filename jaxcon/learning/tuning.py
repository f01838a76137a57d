"""The least of a loss over any pytree, by gradients. Host code around one jitted scan."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from jaxcon.core import checkpoint as files
from jaxcon.core import checks
from jaxcon.core.devices import gathered, over_devices
from jaxcon.core.ends import ENDS, bar, words
from jaxcon.core.typing import PyTree
from jaxcon.learning.descent import Descent, Search, Stop
from jaxcon.learning.leaves import Space, space_of
from jaxcon.learning.optimizer import adam, adam_then_newton
from jaxcon.learning.starts import check_key, scattered
from jaxcon.learning.tuned import Tuned, result

NEVER = np.iinfo(np.int32).max
SCHEDULE = "the number of steps, along which the rate of the default optimizer falls"
PROGRAM = "the loss, its data, the bounds, the optimizer, another option, or the version of jax"
"""Causes of a different compiled program, for the error message."""


def tune(
    loss: Callable[..., Any],
    params: PyTree,
    *,
    steps: int = 200,
    optimizer: optax.GradientTransformation | None = None,
    positive: Any = (),
    bounds: Any = None,
    samples: int = 0,
    restarts: int = 1,
    spread: Any = 0.0,
    key: Any = None,
    patience: int | None = None,
    tolerance: float = 0.0,
    checkpoint: str | Path | None = None,
    chunk: int = 10,
    forward: bool = False,
    mesh: Mesh | None = None,
    progress: bool | None = None,
) -> Tuned:
    """argmin of a loss over a pytree, or of its expectation E[loss(params, key)].

    Leaves are named by their path, "stabilizer/alpha"; the first part of a path names all below it,
    and patterns such as "*/mass" work. Positive leaves are searched by their logarithm. Bounds are
    kept by putting each step back to the nearest point within them, so that a loss never sees
    parameters beyond them and an optimum may lie on one.

    The best parameters seen come back, never worse ones than the start. A step is taken back, and
    tried again with half its length, where the loss or its gradient is not finite, where the loss
    is a thousand times that before it, or where it rises far above all losses so far. With samples
    the last two are judged at the ends of chunks. A start is given up after 20 such tries in a row.
    An interrupt from the keyboard ends the search with what was found. So does an error of the
    machine after the first chunk.

    The result says "converged" only where the curvature of the loss along the last steps puts the
    least within 0.1 % of every parameter. A slow slide through a valley is not taken for it.

    Args:
        loss: params → a scalar, or a scalar and anything else; (params, key) → the same where
            `samples` is given.
        params: the start. Bools and whole numbers that JAX holds are kept; those of Python and
            numpy are refused. What else shall stay is closed over by the loss.
        steps: at most so many for each start. Each looks at the loss before it moves, so that the
            first judges the start, and where the last one leads is not seen.
        optimizer: a transformation of optax, line searches included. By default Adam for the first
            half of the steps, its rate falling from 0.2 along a cosine: it moves a leaf by n / 20
            at most, a positive one by the factor exp(n / 20). Then limited-memory quasi-Newton
            steps within a trust region, which follow narrow valleys. With samples, Adam alone.
        positive: True, names of leaves, or a pytree of bools like the parameters.
        bounds: (low, high) for all leaves, or a mapping from names to such pairs; None is no bound.
        samples: over how many fresh keys each step takes the mean of the loss; the best is then
            judged at the start and the ends of chunks, by keys that stay the same. Where the loss
            is finite at most keys, the mean is that over these; but a point at which more are lost
            is never better. 0 where the loss takes none.
        restarts: how many starts are searched in one batch; the first is the one given.
        spread: standard deviation of the others from it, relative for positive leaves; a number, or
            a mapping from names.
        key: for samples and starts.
        patience: a start stops where so many steps brought no progress.
        tolerance: by how much the loss must fall to make progress.
        checkpoint: a file that is written after each chunk. Where it exists the search goes on from
            it, with the very numbers of a search that was not interrupted. More steps may be asked
            of it with an optimizer of one's own; the rate of the default depends on their number.
        chunk: steps between two looks at the search: one call of a compiled scan.
        forward: takes gradients in forward mode, number by number: for few numbers, long rollouts
            and loops without a reverse mode. A line search still takes its own in reverse.
        mesh: over whose devices the samples lie in equal parts, or the starts where there are no
            samples. A loss that takes `jc.over_devices` itself needs none.
        progress: whether a bar is shown; None is in terminals and notebooks.

    Returns:
        A `Tuned`.

    Raises:
        ValueError: unknown names, a start out of its bounds, a loss that is finite at no start, or
            a checkpoint of another search, or where none can be written.
        TypeError: the loss is no floating scalar, or the optimizer none of optax.
    """
    counts = _counts(steps=steps, samples=samples, restarts=restarts, chunk=chunk)
    steps, samples, restarts, chunk = counts
    checks.check("tune", "tolerance", tolerance, (), least=0)
    if tolerance and patience is None:
        raise ValueError(
            f"tune: tolerance={tolerance} is what progress is within so many steps: give patience=."
        )
    if not isinstance(forward, bool):
        raise TypeError(f"tune: forward must be True or False, got {forward!r}.")
    patience = NEVER if patience is None else _counts(patience=patience)[0]
    _check(loss, optimizer, key, samples, restarts)
    _check_mesh(mesh, samples, restarts)
    file = None if checkpoint is None else files.path(checkpoint, "tune")
    if checkpoint is None:  # whose chunk stays when it is resumed with more steps
        chunk = min(chunk, steps)
    space = space_of(params, positive, bounds, "tune")
    default = optimizer is None
    if default and not samples:
        own = adam_then_newton(space, steps)
    else:
        own = optax.with_extra_args_support(adam(steps) if optimizer is None else optimizer)
    descent = Descent(loss, space, own, samples, patience, float(tolerance), forward, mesh)
    for_starts, for_samples = (None, None) if key is None else jax.random.split(key)
    starts = scattered(space, space.encode(params), restarts, spread, for_starts, "tune")
    search = jax.vmap(lambda y: descent.start(y, for_samples))(starts)

    limit = jnp.asarray(steps, jnp.int32)
    lowered = _scan(descent, chunk).lower(search, limit, for_samples)
    found = search, np.zeros((restarts, 0), search.mark.dtype)
    save = _ignore
    if file is not None:
        about = _about(space, starts, key, chunk, steps if default else None)
        about[PROGRAM] = files.digest(lowered.as_text())
        found = files.read(file, found, about, "tune") if file.exists() else found
        save = functools.partial(files.write, file, about)
    compiled = lowered.compile()

    def advance(search: Search) -> Any:
        # chunks, at whose ends samples are judged, end where they would have without a break
        ahead = (int(jnp.max(search.step)) // chunk + 1) * chunk
        return compiled(search, jnp.asarray(min(ahead, steps), jnp.int32), for_samples)

    found, broken = _loop(advance, found, steps, save, progress, bool(samples))
    return result(space, starts, found[0], found[1], broken)


def _scan(descent: Descent, chunk: int) -> Any:
    """A chunk of steps of every start, jitted: (search, limit, key) → (search, losses)."""
    mesh = descent.mesh

    def each(shared: Any, search: Search) -> Any:
        limit, key = shared
        return jax.vmap(lambda s: descent.run(s, limit, key, chunk))(search)

    @jax.jit
    def run(search: Search, limit: Any, key: Any) -> Any:
        if mesh is None:
            return each((limit, key), search)
        apart = each if descent.samples else over_devices(each, mesh)
        return gathered(apart((limit, key), gathered(search, mesh)), mesh)

    return run


def _loop(
    advance: Callable[..., Any],
    found: Any,
    steps: int,
    save: Callable[..., None],
    progress: bool | None,
    fresh: bool,
) -> Any:
    """Chunks until no start runs: (search, losses), and what ended it before, in words.

    With samples every step has fresh keys, so that one after a step taken back may go on.
    """
    done = found[1].shape[1]
    try:
        with bar(progress, total=steps, initial=done, desc="tuning") as seen:
            while np.any(_running(found[0], steps)):
                search, losses = jax.block_until_ready(advance(found[0]))
                taken = int(jnp.max(search.step)) - found[1].shape[1]
                losses = np.append(found[1], np.asarray(losses)[:, :taken], axis=1)
                found = search, losses  # at once: an interrupt finds both or neither
                save(found)
                seen.update(taken)
                seen.set_postfix(best=f"{float(jnp.min(search.best.loss)):.4g}", refresh=False)
                if not (fresh or np.any(np.isfinite(losses))):
                    break  # each goes back to where it was, which is no better
    except ENDS as error:
        if not found[1].size:
            raise  # there is nothing to be lost
        return found, words(error)
    return found, ""


def _running(search: Search, steps: int) -> np.ndarray:
    """Which starts still take steps."""
    return (np.asarray(search.stop) == Stop.RUNNING) & (np.asarray(search.step) < steps)


def _about(space: Space, starts: Any, key: Any, chunk: int, rate: int | None) -> dict[str, Any]:
    """The properties of a search that must match those in a checkpoint, beside the program.

    `rate` is the length of the default schedule of rates, None for an optimizer of the user.
    """
    shapes = [list(x.shape[1:]) for x in starts]
    return {
        "the leaves or their shapes": [list(space.names), shapes],
        "the number of restarts": int(starts[0].shape[0]),
        "the chunk": chunk,
        SCHEDULE: rate,
        "the start, the spread or the key": files.digest(*starts, *([] if key is None else [key])),
    }


def _ignore(found: Any) -> None:
    """A search that nobody wants on disk."""


def _counts(**given: Any) -> list[int]:
    """Whole numbers of Python.

    Raises:
        ValueError: one is none, or out of range.
    """
    for what, x in given.items():
        checks.count("tune", what, x, 0 if what == "samples" else 1)
    return [operator.index(x) for x in given.values()]


def _check(loss: Any, optimizer: Any, key: Any, samples: int, restarts: int) -> None:
    """Checks what can be checked before anything is traced.

    Raises:
        ValueError: no key where one is needed.
        TypeError: no key of random numbers, no optimizer, or a loss of other arguments.
    """
    called = hasattr(optimizer, "init") and hasattr(optimizer, "update")
    if optimizer is not None and not called:
        raise TypeError(
            "tune: optimizer must be a transformation of optax such as optax.adam(0.1), got"
            f" {optimizer!r}."
        )
    check_key(key, bool(samples) or restarts > 1, "tune")
    given = ("params", "key")[: 1 + bool(samples)]
    checks.takes("tune", "loss", loss, given, f" with samples={samples}")


def _check_mesh(mesh: Mesh | None, samples: int, restarts: int) -> None:
    """Checks that the devices of a mesh get equal parts.

    Raises:
        ValueError: they do not.
        TypeError: it is no mesh.
    """
    if mesh is not None and not isinstance(mesh, Mesh):
        raise TypeError(f"tune: mesh must be one of jax.sharding.Mesh, got {mesh!r}.")
    what, count = ("samples", samples) if samples else ("restarts", restarts)
    if mesh is not None and count % mesh.size:
        raise ValueError(
            f"tune: {what}={count} does not divide over the {mesh.size} devices of the mesh."
        )
