"""Checkpoint files of long searches, such as tuning.

A file is replaced atomically. Reading fails if the checkpoint belongs to a different search.
"""

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
from jaxcon.core.typing import Array, PyTree, Scalar, T

PART = ".part"
"""The suffix of a checkpoint file that is still being written."""


def path(file: str | Path, owner: str) -> Path:
    """Returns the path of a checkpoint, after checking that a file can be written there.

    Args:
        file: the path that the user gave.
        owner: the name of the function that takes the path, for error messages.

    Raises:
        ValueError: no file can be written there.
        TypeError: `file` is no path.
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
    except (OSError, ValueError) as error:  # the name is too long, or has a zero byte
        raise ValueError(
            f"{owner}: checkpoint {checks.shortened(str(file))} is no path: {error.args[-1]}."
        ) from error
    return file


def write(file: Path, about: Mapping[str, Any], contents: PyTree) -> None:
    """Writes a checkpoint atomically.

    If the process crashes meanwhile, the file has either all of the old or all of the new contents.

    Args:
        file: the path of the checkpoint.
        about: a description of the search, which `read` compares with its own.
        contents: the pytree whose leaves are written.
    """
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


def read(file: Path, like: T, about: Mapping[str, Any], owner: str) -> T:
    """Reads a checkpoint into the tree structure of `like`.

    Args:
        file: the path of the checkpoint.
        like: a pytree with the structure and dtypes of the result; NumPy arrays in it may have
            another length than the stored arrays.
        about: the description of the search, which must equal the stored one.
        owner: the name of the function that reads the file, for error messages.

    Raises:
        ValueError: the file is no checkpoint, or belongs to another search; the message then names
            the differences.
    """
    try:
        with np.load(file, allow_pickle=False) as stored:
            written = dict(json.loads(str(stored["about"])))
            arrays = [stored[f"leaf_{i}"] for i in range(len(stored.files) - 1)]
    except Exception as error:  # a damaged file, or a file of another format, may raise anything
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


def digest(*parts: str | Scalar) -> str:
    """Returns a SHA-256 digest of strings and arrays, to compare the inputs of searches."""
    raw = (x.encode() if isinstance(x, str) else numbers(x).tobytes() for x in parts)
    return hashlib.sha256(b"".join(raw)).hexdigest()


def numbers(x: Scalar) -> np.ndarray:
    """Converts a leaf to a NumPy array; random keys are converted to their key data."""
    return np.asarray(jax.random.key_data(x) if _is_key(x) else x)


def _restored(stored: np.ndarray, like: np.ndarray | Array) -> np.ndarray | Array:
    """Converts a stored array to a NumPy array, JAX array or random key, of the type of `like`."""
    if isinstance(like, np.ndarray):
        return stored
    if _is_key(like):
        return jax.random.wrap_key_data(jnp.asarray(stored), impl=jax.random.key_impl(like))
    # NumPy stores dtypes that it does not know, such as bfloat16, as raw bytes
    return jnp.asarray(stored.view(like.dtype))


def _is_key(x: Scalar) -> bool:
    """Returns True if x is an array of random keys."""
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
