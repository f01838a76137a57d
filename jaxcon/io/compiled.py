"""A model compiled by MuJoCo, with the frames of its bodies in the reference pose qpos0."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np

from jaxcon.core.checks import shortened


class MjModel(Protocol):
    """The type of `mujoco.MjModel`, for annotations, because MuJoCo has no type stubs."""

    nq: int
    """The number of entries of qpos."""
    nv: int
    """The number of entries of qvel."""


Source: TypeAlias = str | os.PathLike[str] | MjModel
"""The path of an MJCF or URDF file, the text of such a file, or a `mujoco.MjModel`."""


class Compiled:
    """A compiled MuJoCo model, with its `MjData` in the reference pose `qpos0`.

    Args:
        source: the path of an MJCF or URDF file, its text, or a `mujoco.MjModel`.
        ignored: the features that the user chose to ignore; see `jc.io.from_mjcf`.

    Raises:
        ImportError: MuJoCo is not installed.
        FileNotFoundError: the file does not exist.
        ValueError: MuJoCo cannot compile the model, or a number in it is NaN.
        TypeError: the source has another type.
    """

    def __init__(self, source: Source, ignored: frozenset[str] = frozenset()) -> None:
        try:
            import mujoco
        except ImportError as error:
            raise ImportError(
                "from_mjcf needs MuJoCo's compiler: pip install 'jaxcon[mujoco]'."
            ) from error
        self.mujoco: Any = mujoco
        self.ignored = ignored
        self.model = self._compile(source)
        self._refuse_nan_numbers()
        self.data = self.mujoco.MjData(self.model)
        self.mujoco.mj_kinematics(self.model, self.data)

    def _compile(self, source: Source) -> Any:
        """Compiles the source to an `MjModel`; raises the errors that `Compiled` lists."""
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
        """Checks all numbers of the model for NaN.

        Raises:
            ValueError: an array or option contains NaN.
        """
        for holder in (self.model, self.model.opt):
            for field in dir(holder):
                x = None if field.startswith("_") else getattr(holder, field)
                if not isinstance(x, float | np.ndarray):
                    continue
                x = np.asarray(x)
                if x.dtype.kind == "f" and np.any(np.isnan(x)):
                    raise ValueError(f"from_mjcf: the model's {field} must be numbers, got NaN.")

    def name(self, kind: str, i: int) -> str:
        """Returns the name of object i of a kind such as "joint"; "joint 3" if it has no name.

        If another object of the kind is named "joint 3", the result is "joint 3 (unnamed)".
        """
        code = getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        if name := self.mujoco.mj_id2name(self.model, code, i):
            return name
        name = f"{kind} {i}"
        while self.mujoco.mj_name2id(self.model, code, name) >= 0:
            name += " (unnamed)"
        return name

    def choice(self, enum: str, value: int | np.integer) -> str:
        """Returns the name of a value of a MuJoCo enumeration, such as "hinge" for mjtJoint 3."""
        return getattr(self.mujoco, enum)(int(value)).name.split("_", 1)[1].lower()

    def root(self, body: int) -> int:
        """Returns MuJoCo's id of the first body of the link with a body; 0 if it does not move.

        Mocap bodies are held at their pose in the model.
        """
        weld = int(self.model.body_weldid[body])
        return 0 if self.model.body_mocapid[weld] >= 0 else weld

    def disabled(self, *features: str) -> bool:
        """Returns True if `ignored` or a flag of the model disables any of these features."""
        if self.ignored.intersection(features):
            return True
        flags = self.mujoco.mjtDisableBit.__members__
        bits = [flags[f"mjDSBL_{f.upper()}"] for f in features if f"mjDSBL_{f.upper()}" in flags]
        return any(self.model.opt.disableflags & int(bit) for bit in bits)


class Names:
    """The names used in a scene, which must be unique.

    In MuJoCo, objects of different kinds may have equal names.

    Attributes:
        taken: the names in the scene.
        given: the name in the scene by the wanted name and the kind of the object.
        touching: MuJoCo's ids of the bodies on both sides of each contact, by the name in the
            scene.
    """

    def __init__(self) -> None:
        self.taken = {"world", "gravity"}
        self.given: dict[tuple[str, str], str] = {}
        self.touching: dict[str, tuple[int, int]] = {}

    def take(self, name: str, kind: str, key: str | None = None) -> str:
        """Reserves a unique name and returns it.

        If the wanted name is taken, the kind is appended, and then a number if necessary.

        Args:
            name: the wanted name.
            kind: the kind of the object, such as "joint".
            key: the kind in `given`, if objects of one kind may want the same name.
        """
        free, n = name, 1
        while free in self.taken:
            free, n = f"{name} {kind}" + f" {n}" * (n > 1), n + 1
        self.taken.add(free)
        self.given.setdefault((name, key or kind), free)
        return free


def _refuse_nan(text: str) -> None:
    """Checks the XML attributes of a model for NaN, which MuJoCo would replace by defaults.

    Raises:
        ValueError: an attribute is NaN.
    """
    attributes = re.findall(r"""([\w:]+)\s*=\s*["']([^"']*)["']""", text)
    names = {value for key, value in attributes if key == "name"}
    for key, value in attributes:
        if key != "name" and value not in names and "nan" in value.lower().split():
            raise ValueError(f'from_mjcf: {key}="{value}" must be numbers, got NaN.')
