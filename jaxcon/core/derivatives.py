"""Whether derivatives are taken of what is being traced.

A step is traced once for its values, and anew from its Python code for each derivative
(`staging.batch_last`). In the first trace, rules of derivatives would be traced for nothing.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_TAKEN = ContextVar("derivatives are taken", default=True)


def are_taken() -> bool:
    """Returns False if no derivative is taken of the trace in progress."""
    return _TAKEN.get()


@contextmanager
def taken(flag: bool) -> Iterator[None]:
    """Says, for the duration of a `with` block, whether derivatives are taken of what is traced."""
    before = _TAKEN.set(flag)
    try:
        yield
    finally:
        _TAKEN.reset(before)
