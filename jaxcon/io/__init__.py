"""Import of models from other simulators.

MuJoCo: from_mjcf, MujocoModel, Keyframe.
"""

from jaxcon.io.mjcf import Keyframe, MujocoModel, from_mjcf


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "from_mjcf",
    "MujocoModel",
    "Keyframe",
]
