"""A search on disk: one file that is replaced as a whole, and refused by another search."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import PyTree

PART = ".part"
"""Ending of a file that is still being written."""


def path(file: str | Path, owner: str) -> Path:
    """Where a checkpoint is or will be, checked before anything is done for it.

    Raises:
        ValueError: nothing can be written there.
        TypeError: it is no path.
    """
    if not isinstance(file, str | os.PathLike):
        raise TypeError(f"{owner}: checkpoint must be the path of a file, got {file!r}.")
    file = Path(file)
    folder = file.parent
    here = os.path.isdir(file)
    if here or not os.path.isdir(folder) or not os.access(folder, os.W_OK):
        what = "is a folder" if here else "lies in no folder that can be written to"
        raise ValueError(f"{owner}: checkpoint {checks.shortened(str(file))} {what}.")
    try:
        os.lstat(file.with_name(file.name + PART))
    except FileNotFoundError:
        return file
    except (OSError, ValueError) as error:  # too long a name, or a zero byte in it
        raise ValueError(
            f"{owner}: checkpoint {checks.shortened(str(file))} is no path: {error.args[-1]}."
        ) from error
    return file


def write(file: Path, about: Mapping[str, Any], contents: PyTree) -> None:
    """Writes leaves and what they belong to; a crash leaves the old file or the new one."""
    arrays: dict[str, Any] = {
        f"leaf_{i}": numbers(x) for i, x in enumerate(jax.tree.leaves(contents))
    }
    arrays["about"] = np.array(json.dumps(about))
    part = file.with_name(file.name + PART)
    with part.open("wb") as stream:
        np.savez(stream, **arrays)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(file)


def read(file: Path, like: PyTree, about: Mapping[str, Any], owner: str) -> PyTree:
    """The leaves in the structure of `like`; arrays of numpy may have grown since.

    Raises:
        ValueError: no checkpoint, or one of another search; names what is not the same.
    """
    try:
        with np.load(file, allow_pickle=False) as stored:
            written = dict(json.loads(str(stored["about"])))
            arrays = [stored[f"leaf_{i}"] for i in range(len(stored.files) - 1)]
    except Exception as error:  # what is damaged or of another kind may raise anything
        raise ValueError(
            f"{owner}: {file} is no checkpoint of {owner}; give another path."
        ) from error
    other = [what for what in about if written.get(what) != about[what]]
    if other:
        raise ValueError(
            f"{owner}: {file} holds another search; not the same: {', '.join(other)}. Call {owner}"
            " as it was called then, delete the file to begin anew, or give another path."
        )
    templates, structure = jax.tree.flatten(like)
    leaves = [_restored(x, y) for x, y in zip(arrays, templates, strict=True)]
    return jax.tree.unflatten(structure, leaves)


def digest(*parts: Any) -> str:
    """Returns a digest of texts and arrays, to tell whether they are equal."""
    raw = (x.encode() if isinstance(x, str) else numbers(x).tobytes() for x in parts)
    return hashlib.sha256(b"".join(raw)).hexdigest()


def numbers(x: Any) -> np.ndarray:
    """A leaf as numbers; keys of random numbers are made of such."""
    return np.asarray(jax.random.key_data(x) if _is_key(x) else x)


def _restored(stored: np.ndarray, like: Any) -> Any:
    if isinstance(like, np.ndarray):
        return stored
    if _is_key(like):
        return jax.random.wrap_key_data(jnp.asarray(stored), impl=jax.random.key_impl(like))
    return jnp.asarray(stored.view(like.dtype))  # numpy does not know every dtype by name


def _is_key(x: Any) -> bool:
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
