"""An overview of what `from_mjcf` reads from a model, for the command line."""

from __future__ import annotations

import collections
import warnings
from collections.abc import Iterable
from dataclasses import dataclass

from jaxcon.core.summary import listed, table
from jaxcon.io import pairs, refusals
from jaxcon.io.compiled import Compiled, Names, Source
from jaxcon.io.links import find_links
from jaxcon.io.mjcf import MujocoModel, from_mjcf


@dataclass(frozen=True)
class Overview:
    """The contents of a model, and why it is refused if it is.

    Attributes:
        title: the name of the model.
        rows: pairs of a subject and a description; see `summary.table`.
        refused: the reasons why the model cannot be read; empty if it was read.
        model: the model; None if it is refused.
    """

    title: str
    rows: tuple[tuple[str, str], ...]
    refused: tuple[str, ...] = ()
    model: MujocoModel | None = None

    def __str__(self) -> str:
        """Formats the overview as a table, with the reasons of a refusal below."""
        return "\n".join([table(self.title, self.rows), *(f"refused: {x}" for x in self.refused)])


def overview(source: Source, ignore: tuple[str, ...] = ()) -> Overview:
    """Reads a model and describes it; a refused model is described with all reasons.

    Args:
        source: the path of a file, its text, or a `mujoco.MjModel`.
        ignore: names of features to leave out; see `from_mjcf`.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: MuJoCo cannot compile the model, or nothing in it moves.
    """
    compiled = Compiled(source, refusals.left_out(ignore))
    rows, refused, model = _parts(compiled), tuple(refusals.reasons(compiled)), None
    title = compiled.model.names[:].split(b"\0")[0].decode() or "model"
    if not refused:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                model = from_mjcf(compiled.model, ignore)
            except NotImplementedError as error:  # found only when the feature is read
                refused = (str(error),)
        rows += [("warning", str(x.message)) for x in caught if issubclass(x.category, UserWarning)]
    return Overview(title, tuple(rows), refused, model)


def _parts(compiled: Compiled) -> list[tuple[str, str]]:
    """Returns rows about bodies, joints, equality constraints, actuators, sensors and contacts."""
    m = compiled.model
    links = find_links(compiled, Names())
    merged = m.nbody - 1 - len(links)
    closures = [compiled.choice("mjtEq", x) for x in m.eq_type[m.eq_active0.astype(bool)]]
    tendons = [compiled.name("tendon", i) for i in range(m.ntendon)]
    limits = int(m.jnt_limited.sum() + m.tendon_limited.sum())
    sensors = [compiled.choice("mjtSensor", x) for x in m.sensor_type]
    return [
        ("bodies", listed([link.name for link in links])),
        ("merged bodies", f"{merged} without a joint" if merged else ""),
        ("coordinates", f"{m.nq} positions and {m.nv} velocities in MuJoCo"),
        ("mass", f"{m.body_mass.sum():.4g} kg"),
        ("joints", _counted(joint.kind for link in links for joint in link.joints)),
        ("limits", f"{limits} of joints and tendons" if limits else ""),
        ("equalities", _counted(closures)),
        ("actuators", _counted(_actuator(compiled, i) for i in range(m.nu))),
        ("tendons", listed(tendons)),
        ("sensors", _counted(sensors)),
        ("contacts", _contacts(compiled)),
        ("time step", f"{m.opt.timestep:g} s"),
    ]


def _actuator(compiled: Compiled, i: int) -> str:
    """Returns the transmission and the dynamics of an actuator, such as "joint (muscle)"."""
    where = compiled.choice("mjtTrn", compiled.model.actuator_trntype[i])
    dynamics = compiled.choice("mjtDyn", compiled.model.actuator_dyntype[i])
    return where + f" ({dynamics})" * (dynamics != "none")


def _contacts(compiled: Compiled) -> str:
    """Returns the number of pairs of geoms by their shapes, and of those without contact."""
    every = pairs.pairs(compiled)
    kept = [pair for pair in every if pairs.supported(compiled, pair)]
    parts = [_counted(" and ".join(pairs.shapes(compiled, pair)) for pair in kept)]
    missing = len(every) - len(kept)
    parts += [f"{missing} of shapes without contact"] * bool(missing)
    return ", ".join(part for part in parts if part)


def _counted(names: Iterable[str]) -> str:
    """Returns each name once with its number, such as "8 hinge, 1 free"."""
    counts = collections.Counter(names)
    return ", ".join(f"{count} {name}" for name, count in counts.most_common())
