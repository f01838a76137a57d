"""A flag for traces of which no derivative is taken; they leave out the rules of derivatives.

A step is traced once for its values, and anew from its Python code for each derivative
(`staging.batch_last`). In the first trace, these rules would be traced for nothing.
"""

from contextlib import AbstractContextManager

import jax

# not a ContextVar: JAX keeps the traces of functions that it has seen, by a key that contains this
_TAKEN = jax.make_user_context(default_value=True)


def may_be_taken() -> bool:
    """Returns False if no derivative is taken of the trace in progress."""
    return _TAKEN.value


def taken(flag: bool) -> AbstractContextManager[None]:
    """Says, for the duration of a `with` block, whether derivatives may be taken."""
    return _TAKEN(flag)
