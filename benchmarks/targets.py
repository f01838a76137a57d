"""The scenes of the comparison with MuJoCo and MJX, and by what factor each is to be faster."""

from __future__ import annotations

from typing import NamedTuple


class Target(NamedTuple):
    """Throughput relative to MuJoCo in C on all cores: at least this, at best that."""

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
"""Regularisation of the scenes whose rows become dependent on the way, or nearly so in float32."""
MJX = 6.0
"""And relative to MJX at its best batch, on every scene."""
VIOLATION = 1e-3
"""A rate counts only if constraints hold to this, in link lengths, over one second …"""
ERROR = 2.0
"""… and if the error after one second is at most so many times that of MuJoCo's Euler."""
