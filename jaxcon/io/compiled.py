"""A model that MuJoCo has compiled, and where everything lies in its reference pose."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxcon.core.checks import shortened


class Compiled:
    """MuJoCo's model, with its data at the reference pose `qpos0`.

    Args:
        source: path of an MJCF or URDF file, its text, or an `mujoco.MjModel`.
        ignored: what the user leaves out.

    Raises:
        ImportError: MuJoCo is not installed.
        FileNotFoundError: there is no such file.
        ValueError: MuJoCo cannot compile it, or a number of it is NaN.
        TypeError: it is none of these.
    """

    def __init__(self, source: Any, ignored: frozenset[str] = frozenset()) -> None:
        self.mujoco, self.ignored = _mujoco(), ignored
        self.model = self._compile(source)
        self._refuse_nan_numbers()
        self.data = self.mujoco.MjData(self.model)
        self.mujoco.mj_kinematics(self.model, self.data)

    def _compile(self, source: Any) -> Any:
        model = self.mujoco.MjModel
        if isinstance(source, model):
            return source
        if not isinstance(source, str | os.PathLike):
            raise TypeError(
                "from_mjcf takes the path of a file, its text or a mujoco.MjModel, got"
                f" {type(source).__name__}."
            )
        text = isinstance(source, str) and "<" in source
        if not text and not os.path.isfile(source):
            raise FileNotFoundError(
                f"from_mjcf: there is no file {shortened(str(source))}; text of a model begins"
                " with '<'."
            )
        _refuse_nan(str(source) if text else Path(source).read_text(errors="replace"))
        try:
            return model.from_xml_string(source) if text else model.from_xml_path(str(source))
        except ValueError as error:
            what = "this text" if text else f"'{source}'"
            raise ValueError(f"from_mjcf: MuJoCo cannot compile {what}: {error}") from error

    def _refuse_nan_numbers(self) -> None:
        """Checks the model's arrays.

        Raises:
            ValueError: one has NaN in it.
        """
        for holder in (self.model, self.model.opt):
            for field in dir(holder):
                x = None if field.startswith("_") else getattr(holder, field)
                if isinstance(x, float | np.ndarray) and np.any(np.isnan(_floats(x))):
                    raise ValueError(f"from_mjcf: the model's {field} must be numbers, got NaN.")

    def name(self, kind: str, i: int) -> str:
        """Returns the name of a "body", "joint", …; kind and number where it has none."""
        code = getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        return self.mujoco.mj_id2name(self.model, code, i) or f"{kind} {i}"

    def choice(self, enum: str, value: Any) -> str:
        """The name of a value of one of MuJoCo's enumerations: "hinge" of mjtJoint 3."""
        return getattr(self.mujoco, enum)(int(value)).name.split("_", 1)[1].lower()

    def disabled(self, *features: str) -> bool:
        """Returns True where a flag of the options, or the user, disables one of these features."""
        if self.ignored.intersection(features):
            return True
        known = self.mujoco.mjtDisableBit.__members__
        bits = [known[f"mjDSBL_{f.upper()}"] for f in features if f"mjDSBL_{f.upper()}" in known]
        return any(self.model.opt.disableflags & int(bit) for bit in bits)


class Names:
    """Names that are unique in a scene, where MuJoCo's need be so only among their kind."""

    def __init__(self) -> None:
        self.taken = {"world", "gravity"}

    def take(self, name: str, kind: str) -> str:
        """The name itself if it is free, or with its kind after it, and a number if need be."""
        wanted = [name, f"{name} {kind}"]
        free = next((x for x in wanted if x not in self.taken), None)
        n = 2
        while free is None:
            numbered = f"{name} {kind} {n}"
            free, n = (None if numbered in self.taken else numbered), n + 1
        self.taken.add(free)
        return free


def _floats(x: Any) -> np.ndarray:
    """Floating numbers as they are, and none of anything else."""
    x = np.asarray(x)
    return x if x.dtype.kind == "f" else np.zeros(0)


def _refuse_nan(text: str) -> None:
    """Checks the attributes of a model's text: MuJoCo takes NaN for what is left out.

    Raises:
        ValueError: one is NaN.
    """
    attributes = re.findall(r"""([\w:]+)\s*=\s*["']([^"']*)["']""", text)
    names = {value for key, value in attributes if key == "name"}
    for key, value in attributes:
        if key != "name" and value not in names and "nan" in value.lower().split():
            raise ValueError(f'from_mjcf: {key}="{value}" must be numbers, got NaN.')


def _mujoco() -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise ImportError(
            "from_mjcf needs MuJoCo's compiler: pip install 'jaxcon[mujoco]'."
        ) from error
    return mujoco
