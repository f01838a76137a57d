"""Conversion of the static data of pytrees to JSON and back, for files of `jax.export`.

Files contain names and numbers only. Reading a file builds dataclasses from their fields, and looks
up classes and functions by name. It runs no code from the file.
"""

import dataclasses
import importlib
import json
import sys
from enum import Enum
from typing import Any


def encoded(data: Any) -> bytes:
    """Converts the static data of a pytree to JSON text.

    Raises:
        TypeError: the data contain an object without an importable name, such as a lambda.
    """
    return json.dumps(_written(data)).encode()


def decoded(text: bytes) -> Any:
    """Converts the JSON text of `encoded` back to static data.

    Raises:
        ValueError: a class or function in the data does not exist.
    """
    return _read(json.loads(text.decode()))


def _written(x: Any) -> Any:
    """Converts static data to JSON values.

    Numbers and strings are unchanged; other objects become dicts such as {"name": "module:name"}.
    """
    if x is None or type(x) in (bool, int, float, str):
        return x
    if isinstance(x, Enum):
        return {"enum": _name(type(x)), "member": x.name}
    if isinstance(x, tuple | list):
        items = [_written(y) for y in x]
        kind = type(x).__name__ if type(x) in (tuple, list) else _name(type(x))
        return {"sequence": kind, "items": items}
    if isinstance(x, dict):
        return {"dict": [[_written(key), _written(value)] for key, value in x.items()]}
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        fields = {f.name: _written(getattr(x, f.name)) for f in dataclasses.fields(x)}
        return {"dataclass": _name(type(x)), "fields": fields}
    return {"name": _name(x)}


def _read(x: Any) -> Any:
    """Converts JSON values back to static data; inverts `_written`."""
    if not isinstance(x, dict):
        return x
    if "enum" in x:
        return _found(x["enum"])[x["member"]]
    if "sequence" in x:
        items = [_read(y) for y in x["items"]]
        if x["sequence"] in ("tuple", "list"):
            return tuple(items) if x["sequence"] == "tuple" else items
        return _found(x["sequence"])._make(items)
    if "dict" in x:
        return {_read(key): _read(value) for key, value in x["dict"]}
    if "dataclass" in x:
        cls = _found(x["dataclass"])
        if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
            raise ValueError(f"{x['dataclass']} is no dataclass, but the file has fields of one.")
        return cls(**{name: _read(value) for name, value in x["fields"].items()})
    return _found(x["name"])


def _name(x: Any) -> str:
    """Returns the name "module:name" of a class or function.

    Raises:
        TypeError: the object is no class or function, or cannot be looked up by this name.
    """
    name = f"{getattr(x, '__module__', None)}:{getattr(x, '__qualname__', None)}"
    try:
        target = _found(name)
    except ValueError:
        target = None
    if target is not x:
        raise TypeError(
            f"{x!r} is part of the structure of a system or method and cannot be written to a file:"
            " it must be a class or function at the top of a module. Define it there, or export a"
            " function of the state alone that closes over the system."
        )
    return name


def _found(name: str) -> Any:
    """Looks up a class or function by its name "module:name".

    Modules of the library are imported if needed. Any other module must already be imported,
    because importing a module runs its code.

    Raises:
        ValueError: no class or function has this name.
    """
    module, _, path = name.partition(":")
    try:
        if module.partition(".")[0] == "jaxcon":
            importlib.import_module(module)
        target = sys.modules[module]
        for part in path.split("."):
            target = getattr(target, part)
    except (ImportError, KeyError, AttributeError) as error:
        raise ValueError(
            f"there is no {name}, which the file needs; import its module {module!r} first, in the"
            " version with which it was written."
        ) from error
    return target
