"""Gymnasium's half-cheetah, from the model file that comes with Gymnasium."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Channel, Environment, Episode, spread
from jaxcon.io.compiled import Compiled
from jaxcon.io.maps import Tree

FILE = "half_cheetah.xml"
ACTION = 0.05
"""How long an action lasts [s]."""
NOISE, EFFORT = 0.1, 0.1
"""How much starts are scattered, and what the squares of actions cost."""
MOST = 1e6
"""Bound of what is seen, in its unit, which no run comes near: Gymnasium wants one."""
SWEEPS = 30
"""Over the rows of stops and contacts in a step."""
HINGE = 3
"""The number of a hinge in MuJoCo's enumeration of joints."""


class Capsule(NamedTuple):
    """What a picture shows of a body: its name, the ends of an axis in its frame, and a radius."""

    body: str
    ends: tuple[tuple[float, ...], ...]
    radius: float


@pytree
class HalfCheetah(Environment):
    """Gymnasium's HalfCheetah-v5: a planar cheetah with six motors is to run.

    The file is read where Gymnasium is installed: `pip install 'jaxcon[rl,mujoco]'`. Masses,
    joints, springs, dampers, rotors, motors, stops and contacts are those of the file, but stops
    and contacts are hard here and soft in MuJoCo, so that the same actions lead to other motions.

    Action: torques of back thigh, shin, foot and front thigh, shin, foot, −1 to 1 of the motors'
    largest. Observation: MuJoCo's qpos without the first entry (8,): height of the torso over that
    of the file [m], its pitch and six joint angles [rad]; and qvel (9,): the torso's velocity
    forward and up [m/s], its rate of pitch and those of the joints [rad/s].

    Reward: v − 0.1 Σ aᵢ² with the mean speed v of the torso over the action [m/s] and the action a;
    not from 0 to 1. An episode starts with every entry of qpos within 0.1 of the file's, evenly,
    and every entry of qvel drawn from a normal distribution of width 0.1. It never terminates, and
    is truncated after 1,000 actions of 50 ms, or where it diverges.

    Attributes:
        tree: the map between MuJoCo's coordinates and the bodies.
        joints: names of the entries of qpos and qvel.
        turning: whether each is an angle.
        motors: names of the joints that they turn.
        capsules: for pictures.

    References:
        Gymnasium 1.4, `gymnasium/envs/mujoco/half_cheetah_v5.py`. Wawrzyński, A cat-like robot
        real-time learning to run, ICANNGA (2009).
    """

    at_once: ClassVar[int] = 32
    tree: Tree
    joints: tuple[str, ...] = static()
    turning: tuple[bool, ...] = static()
    motors: tuple[str, ...] = static()
    capsules: tuple[Capsule, ...] = static()

    @classmethod
    def build(
        cls,
        *,
        dt: float | None = None,
        skip: int | None = None,
        horizon: int | None = 1000,
        method: jc.Method | None = None,
        dtype: Any = None,
    ) -> HalfCheetah:
        """The environment, from Gymnasium's file.

        Args:
            dt: h [s]; the file's 10 ms unless given.
            skip: steps of h an action is held for; as many as make 50 ms unless given.
            horizon: actions until an episode is truncated, or None.
            method: of the simulation; `Sparse()` with sweeps over the contacts unless given.
            dtype: of every number.

        Raises:
            ImportError: Gymnasium, its file or MuJoCo is missing; names the extras.
        """
        compiled = Compiled(model_file(FILE))
        model = compiled.model
        own = jc.from_mjcf(model, count_turns=True, dtype=dtype)
        h = float(model.opt.timestep if dt is None else dt)
        if method is None:
            method = jc.Method(solver=jc.Sparse(), bounded=jc.GaussSeidel(SWEEPS))
        return cls(
            own.system,
            method,
            jnp.asarray(h, own.start.q.dtype),
            round(ACTION / h) if skip is None else skip,
            horizon,
            own.tree,
            tuple(compiled.name("joint", i) for i in range(model.njnt)),
            tuple(bool(kind == HINGE) for kind in model.jnt_type),
            tuple(compiled.name("joint", i) for i in model.actuator_trnid[:, 0]),
            capsules(compiled),
        )

    @property
    def observed(self) -> tuple[Channel, ...]:
        """Qpos without the first entry, how far it has come, and qvel."""
        units = ["rad" if turns else "m" for turns in self.turning]
        each = list(zip(self.joints, units, strict=True))
        places = [Channel(name, unit, -MOST, MOST) for name, unit in each[1:]]
        return *places, *(Channel(f"rate of {n}", f"{unit}/s", -MOST, MOST) for n, unit in each)

    @property
    def actions(self) -> tuple[str, ...]:
        """A torque for each motor."""
        return tuple(f"torque at {name}, of the largest" for name in self.motors)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Around where it starts."""
        return (-2.0, 2.0), (-0.3, 1.7)

    def window(self, episode: Episode) -> tuple[tuple[float, float], tuple[float, float]]:
        """Around where it is."""
        (left, right), height = self.frame
        x = float(_drawn(self, episode)[1])
        return (x + left, x + right), height

    def start(self, key: Array) -> tuple[jc.State, Any]:
        """Near the file's pose, in the air, moving a little."""
        own, other = jax.random.split(key)
        reference = self.tree.reference
        qpos = reference + spread(own, NOISE, reference.shape, self.dtype)
        return self.place(qpos, NOISE * jax.random.normal(other, (self.tree.size,), self.dtype)), ()

    def place(self, qpos: Array, qvel: Array) -> jc.State:
        """The state at MuJoCo's coordinates.

        Args:
            qpos: (9,) [m] and [rad].
            qvel: (9,) [m/s] and [rad/s].
        """
        q, v = self.tree.flat(self.system, qpos, qvel)
        return jc.init(self.system, self.method, q, v, turns=self.tree.turns_of(self.system, qpos))

    def coordinates(self, episode: Episode) -> tuple[Array, Array]:
        """Qpos and qvel, (9,) each; angles count whole turns.

        Args:
            episode: where it stands.
        """
        return self.tree.read(self.system, episode.state)

    def observation(self, episode: Episode) -> Array:
        """Qpos without the first entry, and qvel."""
        qpos, qvel = self.coordinates(episode)
        return jnp.concatenate([qpos[1:], qvel])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Speed, less the squares of the action."""
        came, went = (self.coordinates(episode)[0][0] for episode in (before, after))
        return (went - came) / (self.dt * self.skip) - EFFORT * jnp.sum(action**2)

    def marks(self, axes: Any, episode: Episode) -> None:
        """The ground with a mark each metre, and the capsules."""
        ends, x = _drawn(self, episode)
        metres = np.arange(np.floor(x) - 3, np.floor(x) + 4)
        axes.plot(metres, 0 * metres, "-|", color="k", lw=1)
        points = 72 * 4.8 / (self.frame[0][1] - self.frame[0][0])  # of a line, a metre
        for i, capsule in enumerate(self.capsules):
            style = {"lw": 2 * capsule.radius * points, "solid_capstyle": "round"}
            axes.plot(*np.asarray(ends[i]).T[[0, 2]], color=f"C{i}", **style)


@jax.jit
def _drawn(cheetah: HalfCheetah, episode: Episode) -> tuple[Array, Array]:
    """The ends of the capsules (capsules, 2, 3), and how far it has come () [m]."""
    system, state = cheetah.system, episode.state
    ends = [
        jnp.stack([jc.position(system, state, capsule.body, end) for end in capsule.ends])
        for capsule in cheetah.capsules
    ]
    return jnp.stack(ends), cheetah.coordinates(episode)[0][0]


def model_file(name: str) -> Path:
    """Where Gymnasium keeps a model file.

    Raises:
        ImportError: Gymnasium is not installed, or has no such file.
    """
    found = find_spec("gymnasium")
    for place in (found and found.submodule_search_locations) or ():
        path = Path(place) / "envs" / "mujoco" / "assets" / name
        if path.is_file():
            return path
    raise ImportError(
        f"the model file {name} comes with Gymnasium, and MuJoCo compiles it: pip install"
        " 'jaxcon[rl,mujoco]'."
    )


def capsules(compiled: Compiled) -> tuple[Capsule, ...]:
    """Returns the capsules of bodies that move, with the ends of their axes."""
    model, data, found = compiled.model, compiled.data, []
    for geom in np.flatnonzero(model.geom_bodyid):
        body, (radius, half) = int(model.geom_bodyid[geom]), model.geom_size[geom, :2]
        turn, own = data.xmat[body].reshape(3, 3), data.geom_xmat[geom].reshape(3, 3)
        middle = data.geom_xpos[geom] - data.xpos[body]
        points = [turn.T @ (middle + side * half * own[:, 2]) for side in (-1, 1)]
        ends = tuple(tuple(map(float, point)) for point in points)
        found.append(Capsule(compiled.name("body", body), ends, float(radius)))
    return tuple(found)
