"""`tune` minimizes a loss over a pytree by gradients. Host code around a jitted scan."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, SupportsIndex, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh
from jax.stages import Wrapped

from jaxcon.core import checkpoint as files
from jaxcon.core import checks
from jaxcon.core.cores import compiler_options
from jaxcon.core.devices import gathered, over_devices
from jaxcon.core.interrupts import STOP_EXCEPTIONS, describe_error, progress_bar
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.learning.descent import Descent, Search, Stop
from jaxcon.learning.leaves import Bounds, Space, space_of
from jaxcon.learning.optimizer import adam, adam_then_newton
from jaxcon.learning.starts import check_key, scattered
from jaxcon.learning.tuned import Tuned, result

NEVER = np.iinfo(np.int32).max
SCHEDULE = "the number of steps, along which the rate of the default optimizer falls"
PROGRAM = "the loss, its data, the bounds, the optimizer, another option, or the version of jax"
"""Possible causes of a changed program, for the error message of a checkpoint."""

Course: TypeAlias = tuple[Search, np.ndarray]
"""The states of all searches, and their losses by step, (restarts, steps)."""


def tune(
    loss: Callable[..., Any],
    params: PyTree,
    *,
    steps: int = 200,
    optimizer: optax.GradientTransformation | None = None,
    positive: PyTree = (),
    bounds: Bounds = None,
    samples: int = 0,
    restarts: int = 1,
    spread: Scalar | Mapping[str, Scalar] = 0.0,
    key: Array | None = None,
    patience: int | None = None,
    tolerance: float = 0.0,
    checkpoint: str | Path | None = None,
    chunk: int = 10,
    forward: bool = False,
    mesh: Mesh | None = None,
    progress: bool | None = None,
) -> Tuned:
    """Minimizes loss(params), or the mean of loss(params, key) over keys, by gradients.

    Leaves of params are named by their path, such as "stabilizer/alpha". The first part of a path
    stands for all leaves below it, and patterns such as "*/mass" work. For positive leaves, the
    logarithm is the search coordinate. Steps are clipped to the bounds: the loss is never evaluated
    out of bounds, and the optimum may lie on a bound.

    The result is the best evaluated point, never worse than the start. A step is rejected if the
    loss or its gradient is not finite after it. A step is also rejected if the loss grows a
    thousandfold, or far above all losses so far. With samples, growth of the loss is checked only
    at the end of each chunk. A rejected step is repeated with half its length. The search ends if
    20 repetitions in a row are rejected.

    A keyboard interrupt, or a machine error after the first chunk, stops the search. The best
    result so far is returned.

    The search has converged only if every parameter is within 0.1 % of a minimum. The distance is
    estimated from the curvature of the loss along the last steps. Slow progress through a narrow
    valley therefore does not count as convergence.

    Args:
        loss: function from params to a scalar loss, or to (loss, auxiliary output). With `samples`,
            a function of (params, key).
        params: the initial parameters. Bools and integer arrays of JAX stay constant; Python and
            NumPy integers are refused. Let the loss close over other constants.
        steps: maximum number of steps of each search. A step first evaluates the loss, then moves.
            Hence the first step evaluates the start, and the point after the last step is not
            evaluated.
        optimizer: a transformation of optax; line searches work too. By default, the first half of
            the steps uses Adam, with a rate that decays from 0.2 along a cosine. In a search of n
            steps, Adam changes a leaf by at most n / 20. It changes a positive leaf by at most the
            factor exp(n / 20). The second half uses limited-memory quasi-Newton steps within a
            trust region, which follow narrow valleys. With samples, the default is Adam alone.
        positive: leaves that must stay positive: True for all, names of leaves, or a pytree of
            bools.
        bounds: a pair (low, high) for all leaves, or a mapping from names to pairs. None in place
            of `low` or `high` means no bound.
        samples: number of random keys per step over which the loss is averaged; 0 for a loss
            without key. Each step uses new keys. The best point is chosen among the start and the
            ends of chunks, with the same keys for all. Keys with a non-finite loss are excluded
            from the mean if they are fewer than half. A point with more such keys never counts as
            better.
        restarts: number of starts, run in one batch. The first start is `params`.
        spread: standard deviation of the other starts around `params`: a number, or a mapping from
            names to numbers. It is relative for positive leaves.
        key: random key for samples and random starts.
        patience: number of steps without progress after which a search ends; None for no limit.
        tolerance: the decrease of the loss that counts as progress.
        checkpoint: path of a file that is written after each chunk. If it exists, the search
            resumes from it and gives the same numbers as an uninterrupted search. `steps` may be
            increased if `optimizer` is given. The rate of the default optimizer depends on `steps`.
        chunk: number of steps per call of the compiled scan. After each chunk, the checkpoint is
            written, and `tune` returns if all searches have ended.
        forward: True computes gradients by forward mode, with one pass per parameter. Use it for
            few parameters, long rollouts, or loops without reverse mode. Line searches still use
            reverse mode.
        mesh: devices among which the samples, or without samples the starts, are divided equally.
            Not needed if the loss itself uses `jc.devices.over_devices`.
        progress: True shows a progress bar, False none; None shows one in terminals and notebooks.

    Returns:
        A `Tuned`.

    Raises:
        ValueError: a name is unknown; the initial parameters are out of bounds; the loss is finite
            at no start; or the checkpoint belongs to another search or cannot be written.
        TypeError: the loss is not a floating-point scalar, or the optimizer is not a transformation
            of optax.
    """
    counts = _counts(steps=steps, samples=samples, restarts=restarts, chunk=chunk)
    steps, samples, restarts, chunk = counts
    checks.check("tune", "tolerance", tolerance, (), least=0)
    if tolerance and patience is None:
        raise ValueError(
            f"tune: tolerance={tolerance} is what progress is within so many steps: give patience=."
        )
    if progress is not None:
        checks.flag("tune", "progress", progress)
    if not isinstance(forward, bool):
        raise TypeError(f"tune: forward must be True or False, got {forward!r}.")
    patience = NEVER if patience is None else _counts(patience=patience)[0]
    _check(loss, optimizer, key, samples, restarts)
    _check_mesh(mesh, samples, restarts)
    file = None if checkpoint is None else files.path(checkpoint, "tune")
    if checkpoint is None:  # a checkpoint may be resumed with more steps, but needs the same chunk
        chunk = min(chunk, steps)
    space = space_of(params, positive, bounds, "tune")
    default = optimizer is None
    if default and not samples:
        stepper = adam_then_newton(space, steps)
    else:
        stepper = optax.with_extra_args_support(adam(steps) if optimizer is None else optimizer)
    descent = Descent(loss, space, stepper, samples, patience, float(tolerance), forward, mesh)
    for_starts, for_samples = (None, None) if key is None else jax.random.split(key)
    starts = scattered(space, space.encode(params), restarts, spread, for_starts, "tune")
    search = jax.vmap(lambda y: descent.start(y, for_samples))(starts)

    limit = jnp.asarray(steps, jnp.int32)
    lowered = _scan(descent, chunk).lower(search, limit, for_samples)
    course: Course = search, np.zeros((restarts, 0), search.mark.dtype)
    save = None
    if file is not None:
        about = _about(space, starts, key, chunk, steps if default else None)
        about[PROGRAM] = files.digest(lowered.as_text())
        course = files.read(file, course, about, "tune") if file.exists() else course
        save = functools.partial(files.write, file, about)
    compiled = lowered.compile(dict(compiler_options))

    def advance(search: Search) -> tuple[Search, Array]:
        """Runs one chunk of steps, or the rest of an interrupted chunk."""
        # a resumed search must end its chunks at the same steps as an uninterrupted one
        ahead = (int(jnp.max(search.step)) // chunk + 1) * chunk
        return compiled(search, jnp.asarray(min(ahead, steps), jnp.int32), for_samples)

    course, broken = _loop(advance, course, steps, save, progress, bool(samples))
    return result(space, starts, *course, broken)


def _scan(descent: Descent, chunk: int) -> Wrapped:
    """Returns a jitted function (search, limit, key) → (search, losses) that runs a chunk."""
    mesh = descent.mesh

    def run_starts(shared: tuple[Array, Array | None], search: Search) -> tuple[Search, Array]:
        """Runs a chunk of steps of the searches on one device."""
        limit, key = shared
        return jax.vmap(lambda s: descent.run(s, limit, key, chunk))(search)

    @jax.jit
    def run(search: Search, limit: Array, key: Array | None) -> tuple[Search, Array]:
        """Runs a chunk of all searches, on the devices of the mesh if there is one."""
        if mesh is None:
            return run_starts((limit, key), search)
        divided = run_starts if descent.samples else over_devices(run_starts, mesh)
        return gathered(divided((limit, key), gathered(search, mesh)), mesh)

    return run


def _loop(
    advance: Callable[[Search], tuple[Search, Array]],
    course: Course,
    steps: int,
    save: Callable[[Course], None] | None,
    progress: bool | None,
    fresh: bool,
) -> tuple[Course, str]:
    """Runs chunks until all searches have ended.

    Args:
        advance: function that runs one chunk.
        course: states and losses from which to start or resume.
        steps: maximum number of steps.
        save: function that writes a checkpoint; None for no checkpoint.
        progress: see `tune`.
        fresh: True if every step draws new samples, so that a repeated step may succeed.

    Returns:
        The final states and losses; and a description of the interrupt or machine error that
        stopped the search, or an empty text.
    """
    done = course[1].shape[1]
    try:
        with progress_bar(progress, total=steps, initial=done, desc="tuning") as shown:
            while np.any(_running(course[0], steps)):
                search, losses = jax.block_until_ready(advance(course[0]))
                taken = int(jnp.max(search.step)) - course[1].shape[1]
                history = np.append(course[1], np.asarray(losses)[:, :taken], axis=1)
                course = search, history  # one assignment: an interrupt sees both or neither
                if save is not None:
                    save(course)
                shown.update(taken)
                shown.set_postfix(best=f"{float(jnp.min(search.best.loss)):.4g}", refresh=False)
                if not (fresh or np.any(np.isfinite(history))):
                    break  # no start has a finite loss, and repeating a step would give none
    except STOP_EXCEPTIONS as error:
        if not course[1].size:
            raise  # no earlier result would be lost
        return course, describe_error(error)
    return course, ""


def _running(search: Search, steps: int) -> np.ndarray:
    """Returns the mask of searches that have not ended, (restarts,)."""
    return (np.asarray(search.stop) == Stop.RUNNING) & (np.asarray(search.step) < steps)


def _about(
    space: Space, starts: tuple[Array, ...], key: Array | None, chunk: int, rate: int | None
) -> dict[str, object]:
    """Returns {description: value} for the settings that a search and its checkpoint must share.

    The compiled program must be equal, too, but is not included.

    Args:
        space: map between parameters and search coordinates.
        starts: search coordinates of all starts, with a first axis of starts.
        key: random key.
        chunk: number of steps of a chunk.
        rate: number of steps over which the default optimizer's rate decays; None if the user gave
            an optimizer.
    """
    shapes = [list(x.shape[1:]) for x in starts]
    return {
        "the leaves or their shapes": [list(space.names), shapes],
        "the number of restarts": int(starts[0].shape[0]),
        "the chunk": chunk,
        SCHEDULE: rate,
        "the start, the spread or the key": files.digest(*starts, *([] if key is None else [key])),
    }


def _counts(**given: SupportsIndex) -> list[int]:
    """Checks counts, and converts them to Python integers.

    Raises:
        ValueError: a count is not an integer, or is out of range.
    """
    for what, x in given.items():
        checks.count("tune", what, x, 0 if what == "samples" else 1)
    return [operator.index(x) for x in given.values()]


def _check(
    loss: Callable[..., Any],
    optimizer: optax.GradientTransformation | None,
    key: Array | None,
    samples: int,
    restarts: int,
) -> None:
    """Checks the loss, the optimizer and the key before anything is traced.

    Raises:
        ValueError: a key is needed, but none is given.
        TypeError: the key is not a random key, the optimizer is not a transformation of optax, or
            the loss has a wrong signature.
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
    """Checks that samples or starts can be divided equally among the devices of a mesh.

    Raises:
        ValueError: the number of samples or starts is not a multiple of the number of devices.
        TypeError: `mesh` is not a mesh.
    """
    if mesh is not None and not isinstance(mesh, Mesh):
        raise TypeError(f"tune: mesh must be one of jax.sharding.Mesh, got {mesh!r}.")
    what, count = ("samples", samples) if samples else ("restarts", restarts)
    if mesh is not None and count % mesh.size:
        raise ValueError(
            f"tune: {what}={count} does not divide over the {mesh.size} devices of the mesh."
        )
