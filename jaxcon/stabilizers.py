"""Stabilizers, which keep constraint errors small.

Feedback: Baumgarte, AdaptiveBaumgarte, SlidingWindowBaumgarte, PID.
Projection: Projection, Tolerance.
Penalties: Penalty, AugmentedLagrangian, Hybrid.
None: Unstabilized.
Repair of failed steps: Recovery.
Design of gains: largest_stable_rate, frequency_response.
"""

from jaxcon.methods.adaptive import AdaptiveBaumgarte, SlidingWindowBaumgarte
from jaxcon.methods.baumgarte import Baumgarte, Unstabilized
from jaxcon.methods.hybrid import Hybrid
from jaxcon.methods.multipliers import AugmentedLagrangian
from jaxcon.methods.penalty import Penalty
from jaxcon.methods.pid import PID
from jaxcon.methods.projection import Projection, Tolerance
from jaxcon.methods.recovery import Recovery
from jaxcon.methods.stability import frequency_response, largest_stable_rate


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "Baumgarte",
    "AdaptiveBaumgarte",
    "SlidingWindowBaumgarte",
    "PID",
    "Projection",
    "Tolerance",
    "Penalty",
    "AugmentedLagrangian",
    "Hybrid",
    "Unstabilized",
    "Recovery",
    "largest_stable_rate",
    "frequency_response",
]
