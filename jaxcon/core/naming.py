"""Public names of functions and classes, for messages."""

import sys
from types import FunctionType


def public_name(thing: type | FunctionType) -> str:
    """Returns the public name of a function or class, such as "jc.solvers.Dense".

    Namespaces are looked up in `sys.modules`, because this module must not import the package.

    Args:
        thing: a function or class. If no namespace contains it, its `__name__` is returned.
    """
    name, package = thing.__name__, sys.modules["jaxcon"]
    if getattr(package, name, None) is thing:
        return f"jc.{name}"
    for space in package.__all__:
        if getattr(getattr(package, space), name, None) is thing:
            return f"jc.{space}.{name}"
    return name
