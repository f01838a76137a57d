"""The text of MuJoCo models: bodies with explicit inertia, joints, equality constraints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

OUT_OF_PLANE = (0.0, -1.0, 0.0)
"""The axis about which (x, y) of the plane turns positively when it is drawn as (x, 0, z)."""
SOFTNESS = 'solref="0.004 1" solimp="0.9999 0.9999 0.001 0.5 2"'
"""The stiffest equality that MuJoCo allows at 2 ms: a time constant of two steps."""
DT = 2e-3


def in_space(point: Any) -> np.ndarray:
    """(x, y) → (x, 0, y)."""
    return np.array([point[0], 0.0, point[1]])


def numbers(values: Any) -> str:
    """With every digit."""
    return " ".join(repr(float(x)) for x in np.ravel(values))


def body(
    name: str,
    position: Any,
    mass: float,
    moments: Any,
    inside: str = "",
    quaternion: Any = (1.0, 0.0, 0.0, 0.0),
) -> str:
    """A body whose frame lies at its centre of mass along its principal axes."""
    return (
        f'<body name="{name}" pos="{numbers(position)}" quat="{numbers(quaternion)}">'
        f'<inertial pos="0 0 0" mass="{mass!r}" diaginertia="{numbers(moments)}"/>'
        f"{inside}</body>\n"
    )


def joint(kind: str, **attributes: Any) -> str:
    """A joint; its attributes are numbers."""
    given = " ".join(f'{key}="{numbers(value)}"' for key, value in attributes.items())
    return f'<joint type="{kind}" {given}/>'


def connect(first: str, second: str, anchor: Any) -> str:
    """Two bodies share a point, given in the frame of the first."""
    return f'<connect body1="{first}" body2="{second}" anchor="{numbers(anchor)}" {SOFTNESS}/>\n'


def model(bodies: str, equalities: Sequence[str] = ()) -> str:
    """A model with what makes MuJoCo fast: Euler, no contacts or islands, no constraints in a tree.

    Damping is explicit, as in the scenes it is compared with, which also saves a factorization.
    """
    flags = 'contact="disable" eulerdamp="disable"'
    flags += ' island="disable"' if equalities else ' constraint="disable"'
    return (
        f'<mujoco><option timestep="{DT}" integrator="Euler" solver="Newton" gravity="0 0 -9.81">'
        f"<flag {flags}/></option>\n"
        f"<worldbody>\n{bodies}</worldbody>\n"
        f"<equality>\n{''.join(equalities)}</equality></mujoco>"
    )
