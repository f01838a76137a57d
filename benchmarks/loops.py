"""Mechanisms with closed loops in MJCF: trees of joints, closed by `connect` equalities."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

TIKHONOV = 1e-10
"""Regularizes the redundant rows that a planar loop has in space."""


def rod(name: str, start: np.ndarray, end: np.ndarray, joints: str, inside: str = "") -> str:
    """Returns the MJCF of a uniform rod between two points, given in the frame of the parent.

    The origin of the body is at the first point.
    """
    tip = numbers(end - start)
    return (
        f'<body name="{name}" pos="{numbers(start)}">{joints}'
        f'<geom type="capsule" fromto="0 0 0 {tip}" size="0.02"/>{inside}</body>'
    )


def numbers(x: np.ndarray) -> str:
    """Formats numbers with full precision."""
    return " ".join(repr(float(value)) for value in np.ravel(x))


def document(bodies: str, equalities: str, actuators: str = "") -> str:
    """Returns the MJCF text of a model."""
    return (
        '<mujoco><compiler angle="radian"/><option><flag contact="disable"/></option>'
        f"<worldbody>{bodies}</worldbody><equality>{equalities}</equality>"
        f"<actuator>{actuators}</actuator></mujoco>"
    )


def connect(first: str, second: str, anchor: np.ndarray) -> str:
    """Returns a `connect` equality that keeps a point of the first body on the second.

    The point is given in the frame of the first body.
    """
    return f'<connect body1="{first}" body2="{second}" anchor="{numbers(anchor)}"/>'


def four_bar() -> str:
    """Returns the MJCF of a four-bar linkage: crank, coupler and rocker on hinges about y."""
    a, b, c, d = np.array([[0, 0, 0], [0, 0, 0.3], [0.8, 0, 0.7], [1, 0, 0]], float)
    hinge = '<joint name="{}" axis="0 1 0" damping="0.01"/>'
    coupler = rod("coupler", b - a, c - a, hinge.format("knee"))
    crank = rod("crank", a, b, hinge.format("shaft"), coupler)
    rocker = rod("rocker", d, c, hinge.format("pivot"))
    closing = connect("coupler", "rocker", c - b)
    return document(crank + rocker, closing, '<motor joint="shaft" gear="2"/>')


def five_bar_leg() -> str:
    """Returns the MJCF of a hip that slides and pitches, with a five-bar leg.

    The leg has two thighs with shins that are joined at the foot.
    """
    hinge = '<joint name="{}" axis="0 1 0" armature="0.01"/>'
    foot = np.array([0.0, 0, -0.6])
    legs = ""
    for side, x in (("left", -0.1), ("right", 0.1)):
        hip, knee = np.array([x, 0, 0]), np.array([2.5 * x, 0, -0.3])
        shin = rod(f"{side}_shin", knee - hip, foot - hip, hinge.format(f"{side}_knee"))
        legs += rod(f"{side}_thigh", hip, knee, hinge.format(f"{side}_hip"), shin)
    root = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    root += '<joint axis="0 1 0"/><geom type="box" size="0.2 0.1 0.05"/>'
    closing = connect("left_shin", "right_shin", foot - np.array([-0.25, 0, -0.3]))
    motors = "".join(f'<motor joint="{side}_hip" gear="3"/>' for side in ("left", "right"))
    return document(f'<body name="hips" pos="0 0 1">{root}{legs}</body>', closing, motors)


CROSS = '<joint name="{}_x" axis="1 0 0"/><joint name="{}_y" axis="0 1 0"/>'
"""MJCF of two hinges of one body, which form a universal joint."""


def stewart() -> str:
    """Returns the MJCF of a platform on six telescoping legs with universal joints at the base."""
    bodies, closing, motors = "", "", ""
    platform = np.array([0, 0, 0.8])
    for i in range(6):
        low, high = (2 * np.pi * (i // 2) / 3 + s * (-1) ** i for s in (0.15, 0.9))
        base = 0.6 * np.array([np.cos(low), np.sin(low), 0])
        top = platform + 0.35 * np.array([np.cos(high), np.sin(high), 0])
        along, name = top - base, f"leg{i}"
        slide = f'<joint name="stroke{i}" type="slide" axis="{numbers(along)}" damping="5"/>'
        upper = rod(f"rod{i}", along / 2, along, slide)
        bodies += rod(name, base, base + along / 2, CROSS.format(name, name), upper)
        closing += connect("platform", f"rod{i}", top - platform)
        motors += f'<motor joint="stroke{i}" gear="10"/>'
    free = '<freejoint/><geom type="cylinder" size="0.35 0.02"/>'
    return document(
        bodies + f'<body name="platform" pos="{numbers(platform)}">{free}</body>', closing, motors
    )


def delta() -> str:
    """Returns the MJCF of a delta robot.

    It has three arms, each with two parallel rods to a platform that cannot rotate.
    """
    bodies, closing, motors = "", "", ""
    platform = np.array([0, 0, -0.7])
    for i, angle in enumerate(2 * np.pi * np.arange(3) / 3):
        radial, tangential = np.array(
            [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0]]
        )
        shoulder, elbow, wrist = (
            0.2 * radial,
            0.5 * radial - np.array([0, 0, 0.1]),
            platform + 0.08 * radial,
        )
        rods = ""
        for side in (-1, 1):
            name, shift = f"rod{i}{'ab'[side > 0]}", 0.06 * side * tangential
            start, end = elbow - shoulder + shift, wrist - shoulder + shift
            rods += rod(name, start, end, CROSS.format(name, name))
            closing += connect("platform", name, wrist - platform + shift)
        axis = f'<joint name="arm{i}" axis="{numbers(tangential)}" armature="0.02"/>'
        bodies += rod(f"arm{i}", shoulder, elbow, axis, rods)
        motors += f'<position joint="arm{i}" kp="60" kv="0.3"/>'
    free = '<freejoint/><geom type="cylinder" size="0.1 0.01"/>'
    return document(
        bodies + f'<body name="platform" pos="{numbers(platform)}">{free}</body>', closing, motors
    )


LOOPS: dict[str, Callable[[], str]] = {
    "four_bar": four_bar,
    "five_bar_leg": five_bar_leg,
    "stewart": stewart,
    "delta": delta,
}
REDUNDANT = ("four_bar", "five_bar_leg")
"""Planar loops, which have redundant rows."""
CONTROL = {
    "four_bar": [0.3],
    "five_bar_leg": [0.2, -0.3],
    "stewart": [0.5, 0.2, 0.6, 0.1, 0.4, 0.3],
    "delta": [0.3, -0.2, 0.4],
}
"""Constant controls of the motors and servos."""
