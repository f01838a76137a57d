"""The scenes of the comparison with MuJoCo and MJX, and the speedup targets."""

from __future__ import annotations

from typing import NamedTuple


class Target(NamedTuple):
    """Throughput relative to MuJoCo in C on all cores.

    Attributes:
        least: the required ratio.
        aim: the desired ratio.
    """

    least: float
    aim: float


SCENES = {
    "pendulum": Target(12, 25),
    "chain-5": Target(4, 8),
    "chain-10": Target(2.5, 5),
    "chain-50": Target(2, 5),
    "planar-chain-10": Target(8, 16),
    "four-bar": Target(8, 20),
    "n-four-bar-10": Target(3, 8),
    "stewart": Target(2, 6),
    "rope-100": Target(5, 10),
}
TIKHONOV = {"n-four-bar-10": 1e-5, "chain-50": 1e-6}
"""Tikhonov regularization of scenes whose rows become dependent, or nearly so in float32."""
MJX = 6.0
"""Required throughput relative to MJX at its best batch, on every scene."""
VIOLATION = 1e-3
"""Bound on the violation over one second, in link lengths, for a rate to count."""
ERROR = 2.0
"""Bound on the error after one second, relative to MuJoCo's Euler, for a rate to count."""
