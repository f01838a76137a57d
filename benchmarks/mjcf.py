"""MJCF text of MuJoCo models: bodies with explicit inertia, joints, equality constraints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

OUT_OF_PLANE = (0.0, -1.0, 0.0)
"""Axis of positive rotation for a plane (x, y) drawn as (x, 0, z)."""
SOFTNESS = 'solref="0.004 1" solimp="0.9999 0.9999 0.001 0.5 2"'
"""The stiffest equality that MuJoCo allows at 2 ms: a time constant of two steps."""
DT = 2e-3
"""Step size of the benchmarks [s]."""


def in_space(point: Any) -> np.ndarray:
    """Maps a planar point (x, y) to (x, 0, y)."""
    return np.array([point[0], 0.0, point[1]])


def numbers(values: Any) -> str:
    """Formats numbers with full precision."""
    return " ".join(repr(float(x)) for x in np.ravel(values))


def body(
    name: str,
    position: Any,
    mass: float,
    moments: Any,
    inside: str = "",
    quaternion: Any = (1.0, 0.0, 0.0, 0.0),
) -> str:
    """Returns the MJCF of a body with its frame at the center of mass along the principal axes."""
    return (
        f'<body name="{name}" pos="{numbers(position)}" quat="{numbers(quaternion)}">'
        f'<inertial pos="0 0 0" mass="{mass!r}" diaginertia="{numbers(moments)}"/>'
        f"{inside}</body>\n"
    )


def joint(kind: str, **attributes: Any) -> str:
    """Returns the MJCF of a joint with numeric attributes."""
    text = " ".join(f'{key}="{numbers(value)}"' for key, value in attributes.items())
    return f'<joint type="{kind}" {text}/>'


def connect(first: str, second: str, anchor: Any) -> str:
    """Returns a `connect` equality that keeps a point of the first body on the second.

    The point is given in the frame of the first body.
    """
    return f'<connect body1="{first}" body2="{second}" anchor="{numbers(anchor)}" {SOFTNESS}/>\n'


def model(bodies: str, equalities: Sequence[str] = ()) -> str:
    """Returns the MJCF of a model with MuJoCo's fast options.

    These are the Euler integrator, no contacts, no islands, and no constraints in trees. Damping is
    explicit, as in the scenes of jaxcon. This also saves a factorization.
    """
    flags = 'contact="disable" eulerdamp="disable"'
    flags += ' island="disable"' if equalities else ' constraint="disable"'
    return (
        f'<mujoco><option timestep="{DT}" integrator="Euler" solver="Newton" gravity="0 0 -9.81">'
        f"<flag {flags}/></option>\n"
        f"<worldbody>\n{bodies}</worldbody>\n"
        f"<equality>\n{''.join(equalities)}</equality></mujoco>"
    )
