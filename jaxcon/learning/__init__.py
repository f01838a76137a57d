"""Tuning and identification of parameters by gradients.

Tuning: tune, Tuned.
Identification: identify, Identified.
Loss functions: losses.
"""

from jaxcon.learning import losses
from jaxcon.learning.identification import Identified, identify
from jaxcon.learning.tuned import Tuned
from jaxcon.learning.tuning import tune


def __dir__() -> list[str]:
    """Lists the public names of this namespace."""
    return [*__all__]


__all__ = [
    "tune",
    "Tuned",
    "identify",
    "Identified",
    "losses",
]
