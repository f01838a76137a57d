"""The least of a loss over any pytree, by gradients. Host code around one jitted scan."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

from jaxcon.core import checks
from jaxcon.core.typing import PyTree
from jaxcon.learning import checkpoint as files
from jaxcon.learning.descent import Descent, Search, Stop
from jaxcon.learning.least_squares import INTERRUPTED
from jaxcon.learning.leaves import Space, by_name, space_of

RATE = 0.05
"""Of the optimiser unless one is given: a step of 5 % of a positive leaf."""
NEVER = np.iinfo(np.int32).max
PROGRAM = "the loss, its data, the optimizer, another option, or the version of jax"
"""What the compiled program tells apart."""
REASONS = {
    Stop.RUNNING: "every step was taken",
    Stop.STALLED: "the loss fell no more",
    Stop.NOT_FINITE: "the loss or its gradient is not finite around the last point, however short"
    " the step",
}


@dataclass(frozen=True)
class Tuned:
    """The best parameters that were found; `print` it.

    Attributes:
        params: like those given.
        loss: there; the mean over keys that were held fixed where the loss takes keys.
        aux: what the loss returned beside it there, with a first axis of keys where it takes some.
        history: losses by step of the start that led there, (steps,).
        histories: of every start, (restarts, steps), NaN after its end.
        steps: how many that start took.
        stopped: why it took no more, in words.
    """

    params: PyTree
    loss: float
    aux: PyTree
    history: np.ndarray
    histories: np.ndarray
    steps: int
    stopped: str

    def __str__(self) -> str:
        finite = self.history[np.isfinite(self.history)]
        first = f", from {finite[0]:.4g}" if finite.size else ""
        lines = [f"loss {self.loss:.4g}{first}, after {self.steps} steps: {self.stopped}"]
        if len(self.histories) > 1:
            lines.append(f"the best of {len(self.histories)} starts")
        if lost := np.sum(~np.isfinite(self.history)):
            lines.append(f"{lost} steps were taken back: the loss was not finite")
        return "\n".join(lines)


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
) -> Tuned:
    """argmin of a loss over a pytree, or of its expectation E[loss(params, key)].

    Leaves are named by their path, "stabilizer/alpha"; the first part of a path names all below it,
    and patterns such as "*/mass" work. Positive leaves are searched by their logarithm. Bounds are
    kept by putting each step back to the nearest point within them, so that a loss never sees
    parameters beyond them and an optimum may lie on one.

    The best parameters so far are never lost. Where the loss or its gradient is not finite, the
    start goes back to where it was and takes shorter steps; an interrupt from the keyboard ends the
    search with what was found.

    Args:
        loss: params → a scalar, or a scalar and anything else; (params, key) → the same where
            `samples` is given.
        params: the start. Leaves that are no floating numbers are kept; what else shall stay is
            closed over by the loss.
        steps: at most so many for each start.
        optimizer: a transformation of optax, line searches included; Adam unless given, its rate
            falling from 0.05 along a cosine.
        positive: True, names of leaves, or a pytree of bools like the parameters.
        bounds: (low, high) for all leaves, or a mapping from names to such pairs; None is no bound.
        samples: over how many fresh keys each step takes the mean of the loss; the best is then
            judged at the ends of chunks, by keys that stay the same. 0 where the loss takes none.
        restarts: how many starts are searched in one batch; the first is the one given.
        spread: standard deviation of the others from it, relative for positive leaves; a number, or
            a mapping from names.
        key: for samples and starts.
        patience: a start stops where so many steps brought no progress.
        tolerance: by how much the loss must fall to make progress.
        checkpoint: a file that is written after each chunk. Where it exists the search goes on from
            it, with the very numbers of a search that was not interrupted.
        chunk: steps between two looks at the search: one call of a compiled scan.

    Returns:
        A `Tuned`.

    Raises:
        ValueError: unknown names, a start out of its bounds, or a checkpoint of another search.
        TypeError: the loss is no floating scalar.
    """
    _check(steps, samples, restarts, chunk, key)
    chunk = min(chunk, steps)
    space = space_of(params, positive, bounds, "tune")
    if optimizer is None:
        optimizer = optax.adam(optax.cosine_decay_schedule(RATE, steps))
    own = optax.with_extra_args_support(optimizer)
    patience = NEVER if patience is None else patience
    descent = Descent(loss, space, own, samples, patience, tolerance)
    for_starts, for_samples = (None, None) if key is None else jax.random.split(key)
    starts = _starts(space, space.encode(params), restarts, spread, for_starts)
    search = jax.vmap(lambda y: descent.start(y, for_samples))(starts)

    @jax.jit
    def run(search: Search, limit: Any, key: Any) -> Any:
        return jax.vmap(lambda s: descent.run(s, limit, key, chunk))(search)

    limit = jnp.asarray(steps, jnp.int32)
    lowered = run.lower(search, limit, for_samples)
    found = search, np.zeros((restarts, 0), search.mark.dtype)
    save = _ignore
    if checkpoint is not None:
        file, program = Path(checkpoint), _digest(lowered.as_text().encode())
        about = _about(space, starts, key, chunk) | {PROGRAM: program}
        found = files.read(file, found, about) if file.exists() else found
        save = functools.partial(files.write, file, about)
    compiled = lowered.compile()
    found, broken = _loop(lambda s: compiled(s, limit, for_samples), found, steps, save)
    return _result(space, found[0], found[1], broken)


def _loop(advance: Callable[..., Any], found: Any, steps: int, save: Callable[..., None]) -> Any:
    """Chunks until no start runs: (search, losses), and what ended it before, in words."""
    bar = tqdm(total=steps, initial=found[1].shape[1], desc="tuning", unit="step", disable=None)
    try:
        with bar:
            while np.any(_running(found[0], steps)):
                search, losses = jax.block_until_ready(advance(found[0]))
                taken = int(jnp.max(search.step)) - found[1].shape[1]
                losses = np.append(found[1], np.asarray(losses)[:, :taken], axis=1)
                found = search, losses  # at once: an interrupt finds both or neither
                save(found)
                bar.update(taken)
                bar.set_postfix(best=f"{float(jnp.min(search.best.loss)):.4g}", refresh=False)
    except (KeyboardInterrupt, OSError, jax.errors.JaxRuntimeError) as error:
        if not found[1].size:
            raise  # there is nothing to be lost
        keyboard = isinstance(error, KeyboardInterrupt)
        return found, INTERRUPTED if keyboard else f"{type(error).__name__}: {error}"
    return found, ""


def _running(search: Search, steps: int) -> np.ndarray:
    """Which starts still take steps."""
    return (np.asarray(search.stop) == Stop.RUNNING) & (np.asarray(search.step) < steps)


def _result(space: Space, search: Search, losses: np.ndarray, broken: str) -> Tuned:
    """What the best start found."""
    index = int(np.argmin(search.best.loss))
    one = jax.tree.map(lambda x: x[index], search)
    taken, stop = int(one.step), Stop(int(one.stop))
    stopped = broken if broken and stop == Stop.RUNNING else REASONS[stop]
    params, loss = space.decode(one.best.y), float(one.best.loss)
    return Tuned(params, loss, one.best.aux, losses[index, :taken], losses, taken, stopped)


def _starts(space: Space, y: Any, restarts: int, spread: Any, key: Any) -> Any:
    """The start and others around it, with a first axis of starts."""
    values = spread if isinstance(spread, Mapping) else {"*": spread}
    widths = by_name(values, space.names, 0.0, "tune: spread")
    batch = [jnp.broadcast_to(x, (restarts, *x.shape)) for x in y]
    if restarts == 1:
        return tuple(batch)
    if not any(np.any(np.asarray(w)) for w in widths):
        raise ValueError("tune: restarts from one place find one thing: give spread=, such as 0.5.")
    keys = jax.random.split(key, len(batch))
    noise = [
        jax.random.normal(k, x.shape, x.dtype).at[0].set(0) * jnp.asarray(w, x.dtype)
        for k, x, w in zip(keys, batch, widths, strict=True)
    ]
    return jax.vmap(space.clip)(tuple(map(jnp.add, batch, noise)))


def _about(space: Space, starts: Any, key: Any, chunk: int) -> dict[str, Any]:
    """What a checkpoint belongs to, beside the program."""
    numbers = [files.numbers(x) for x in (*starts, *([] if key is None else [key]))]
    shapes = [list(x.shape[1:]) for x in starts]
    return {
        "the leaves or their shapes": [list(space.names), shapes],
        "the number of restarts": int(starts[0].shape[0]),
        "the chunk": chunk,
        "the start, the spread or the key": _digest(*(x.tobytes() for x in numbers)),
    }


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"".join(parts)).hexdigest()


def _ignore(found: Any) -> None:
    """A search that nobody wants on disk."""


def _check(steps: int, samples: int, restarts: int, chunk: int, key: Any) -> None:
    """Checks what can be checked before anything is traced.

    Raises:
        ValueError: a count out of range, or no key where one is needed.
    """
    for what, x, least in (
        ("steps", steps, 1),
        ("samples", samples, 0),
        ("restarts", restarts, 1),
        ("chunk", chunk, 1),
    ):
        checks.count("tune", what, x, least)
    if key is None and (samples or restarts > 1):
        raise ValueError(
            "tune: samples and restarts draw random numbers: give key=jax.random.key(0)."
        )
