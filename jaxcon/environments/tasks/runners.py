"""Gymnasium's robots that run in a plane, from the model files that come with Gymnasium."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Channel, Environment, Episode, spread
from jaxcon.io.compiled import Compiled
from jaxcon.io.maps import Tree

MOST = 1e6
"""Bound of what is seen, in its unit, which no run comes near: Gymnasium wants one."""
SWEEPS = 30
"""Over the rows of stops and contacts in a step."""
HINGE = 3
"""Of MuJoCo's enumeration of joints."""


class Capsule(NamedTuple):
    """What a picture shows of a body: its name, the ends of an axis in its frame, and a radius."""

    body: str
    ends: tuple[tuple[float, ...], ...]
    radius: float


@pytree
class Runner(Environment):
    """A robot of Gymnasium's; its coordinates qpos and qvel are MuJoCo's.

    The file is read where Gymnasium is installed: `pip install 'jaxcon[rl,mujoco]'`. Masses,
    joints, springs, dampers, rotors, motors, stops and contacts are those of the file, but stops
    and contacts are hard here and soft in MuJoCo, so that the same actions lead to other motions.

    Attributes:
        tree: the map between qpos and the bodies.
        joints: names of the entries of qpos and qvel.
        turning: whether each is an angle.
        motors: names of the joints that they turn.
        capsules: for pictures.
    """

    FILE: ClassVar[str]
    SKIP: ClassVar[int]
    """Steps of the file's h that Gymnasium holds an action for."""
    NOISE: ClassVar[float]
    """How much the starts of episodes are scattered."""

    tree: Tree
    joints: tuple[str, ...] = static()
    turning: tuple[bool, ...] = static()
    motors: tuple[str, ...] = static()
    capsules: tuple[Capsule, ...] = static()

    @classmethod
    def read(
        cls,
        dt: Any,
        skip: int | None,
        horizon: int | None,
        method: jc.Method | None,
        dtype: Any,
    ) -> Self:
        """The environment from the file.

        Args:
            dt: h [s], or None for the file's.
            skip: steps of h an action is held for, or None for what Gymnasium's time takes.
            horizon: actions until an episode is truncated, or None.
            method: of the simulation, or None.
            dtype: of every number.

        Raises:
            ImportError: Gymnasium, its file or MuJoCo is missing; names the extras.
        """
        compiled = Compiled(model_file(cls.FILE))
        model, own = compiled.model, jc.from_mjcf(compiled.model, count_turns=True, dtype=dtype)
        h = model.opt.timestep if dt is None else dt
        if skip is None:
            skip = round(float(model.opt.timestep * cls.SKIP / h))
        if method is None:
            method = jc.Method(solver=jc.Sparse(), bounded=jc.GaussSeidel(SWEEPS))
        return cls(
            own.system,
            method,
            jnp.asarray(h, own.start.q.dtype),
            skip,
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
        return *places, *(self.rate(name, f"{unit}/s") for name, unit in each)

    def rate(self, name: str, unit: str) -> Channel:
        """Of an entry of qvel."""
        return Channel(f"rate of {name}", unit, -MOST, MOST)

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

    def place(self, qpos: Array, qvel: Array) -> jc.State:
        """The state at MuJoCo's coordinates.

        Args:
            qpos: (nq,) [m] and [rad].
            qvel: (nv,) [m/s] and [rad/s].
        """
        q, v = self.tree.flat(self.system, qpos, qvel)
        return jc.init(self.system, self.method, q, v, turns=self.tree.turns_of(self.system, qpos))

    def coordinates(self, episode: Episode) -> tuple[Array, Array]:
        """Qpos (nq,) and qvel (nv,); angles count whole turns."""
        return self.tree.read(self.system, episode.state)

    def speed(self, before: Episode, after: Episode) -> Array:
        """The mean over an action, () [m/s]."""
        came, went = (self.coordinates(episode)[0][0] for episode in (before, after))
        return (went - came) / (self.dt * self.skip)

    def observation(self, episode: Episode) -> Array:
        """Qpos without the first entry, and qvel."""
        qpos, qvel = self.coordinates(episode)
        return jnp.concatenate([qpos[1:], qvel])

    def marks(self, axes: Any, episode: Episode) -> None:
        """The ground with a mark each metre, and the capsules."""
        ends, x = _drawn(self, episode)
        metres = np.arange(np.floor(x) - 3, np.floor(x) + 4)
        axes.plot(metres, 0 * metres, "-|", color="k", lw=1)
        wide = self.frame[0][1] - self.frame[0][0]
        for i, (capsule, points) in enumerate(zip(self.capsules, np.asarray(ends), strict=True)):
            # 4.8 inches show the whole width
            lw = 2 * capsule.radius * 72 * 4.8 / wide
            axes.plot(points[:, 0], points[:, 2], color=f"C{i}", lw=lw, solid_capstyle="round")


@pytree
class HalfCheetah(Runner):
    """Gymnasium's HalfCheetah-v5: a planar cheetah with six motors is to run.

    Action: torques of back thigh, shin, foot and front thigh, shin, foot, −1 to 1 of the motors'
    largest. Observation: qpos without the first entry (8,): the height of the torso over that of
    the file [m], its pitch and six joint angles [rad]; and qvel (9,): the torso's velocity forward
    and up [m/s], its rate of pitch and those of the joints [rad/s]. They are Gymnasium's numbers.

    Reward: v − 0.1 Σ aᵢ² with the mean speed v of the torso over the action [m/s] and the action a;
    not from 0 to 1. An episode starts with every entry of qpos within 0.1 of the file's, evenly,
    and every entry of qvel drawn from a normal distribution of width 0.1; it never terminates, and
    is truncated after 1,000 actions of 50 ms, or where it diverges.

    References:
        Gymnasium 1.4, `gymnasium/envs/mujoco/half_cheetah_v5.py`. Wawrzyński, A cat-like robot
        real-time learning to run, ICANNGA (2009).
    """

    FILE, SKIP, NOISE = "half_cheetah.xml", 5, 0.1

    @classmethod
    def build(
        cls,
        *,
        dt: Any = None,
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
        return cls.read(dt, skip, horizon, method, dtype)

    def start(self, key: Array) -> tuple[jc.State, Any]:
        """Near the file's pose, in the air, moving a little."""
        own, other = jax.random.split(key)
        reference = self.tree.reference
        qpos = reference + spread(own, self.NOISE, reference.shape, self.dtype)
        qvel = self.NOISE * jax.random.normal(other, (self.tree.size,), self.dtype)
        return self.place(qpos, qvel), ()

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Speed, less the squares of the action."""
        return self.speed(before, after) - 0.1 * jnp.sum(action**2)


@pytree
class Hopper(Runner):
    """Gymnasium's Hopper-v5: a planar leg with three motors is to hop forward and not to fall.

    Action: torques of thigh, leg and foot, −1 to 1 of the motors' largest. Observation: qpos
    without the first entry (5,): the height of the torso [m], its pitch and three joint angles
    [rad]; and qvel (6,), clipped to ±10: the torso's velocity forward and up [m/s], its rate of
    pitch and those of the joints [rad/s]. They are Gymnasium's numbers.

    Reward: v + 1 − 0.001 Σ aᵢ² with the mean speed v of the torso over the action [m/s] and the
    action a, without the 1 where the task is over; not from 0 to 1. An episode starts with every
    entry of qpos and qvel within 0.005 of the file's, evenly; it is over when the torso is not
    higher than 0.7 m or leans by 0.2 rad, or another number reaches 100. It is truncated after
    1,000 actions of 8 ms, or where it diverges.

    References:
        Gymnasium 1.4, `gymnasium/envs/mujoco/hopper_v5.py`. Erez, Tassa, Todorov, Infinite-horizon
        model predictive control for periodic tasks with contacts, RSS (2011).
    """

    FILE, SKIP, NOISE = "hopper.xml", 4, 5e-3

    @classmethod
    def build(
        cls,
        *,
        dt: Any = None,
        skip: int | None = None,
        horizon: int | None = 1000,
        method: jc.Method | None = None,
        dtype: Any = None,
    ) -> Hopper:
        """The environment, from Gymnasium's file.

        Args:
            dt: h [s]; the file's 2 ms unless given.
            skip: steps of h an action is held for; as many as make 8 ms unless given.
            horizon: actions until an episode is truncated, or None.
            method: of the simulation; `Sparse()` with sweeps over the contacts unless given.
            dtype: of every number.

        Raises:
            ImportError: Gymnasium, its file or MuJoCo is missing; names the extras.
        """
        return cls.read(dt, skip, horizon, method, dtype)

    def rate(self, name: str, unit: str) -> Channel:
        """Of an entry of qvel."""
        return Channel(f"rate of {name}", unit, -10.0, 10.0)

    def start(self, key: Array) -> tuple[jc.State, Any]:
        """Upright, all but still."""
        reference = self.tree.reference
        noise = spread(key, self.NOISE, (2, len(reference)), self.dtype)
        return self.place(reference + noise[0], noise[1]), ()

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Speed, and 1 while it stands, less the squares of the action."""
        stands = (~self.terminal(after)).astype(self.dtype)
        return self.speed(before, after) + stands - 1e-3 * jnp.sum(action**2)

    def terminal(self, episode: Episode) -> Array:
        """Whether it has fallen, or numbers are beyond bounds."""
        qpos, qvel = self.coordinates(episode)
        stands = (qpos[1] > 0.7) & (jnp.abs(qpos[2]) < 0.2)
        return ~(stands & jnp.all(jnp.abs(qpos[2:]) < 100) & jnp.all(jnp.abs(qvel) < 100))


@jax.jit
def _drawn(robot: Runner, episode: Episode) -> tuple[Array, Array]:
    """The ends of the capsules (capsules, 2, 3), and how far it has come () [m]."""
    system, state = robot.system, episode.state
    ends = [
        jnp.stack([jc.position(system, state, capsule.body, end) for end in capsule.ends])
        for capsule in robot.capsules
    ]
    return jnp.stack(ends), robot.coordinates(episode)[0][0]


def model_file(name: str) -> Path:
    """Where Gymnasium keeps the file of a robot.

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
    """Those of bodies that move, at whose frames a point (3,) of their axes is fixed."""
    model, data, found = compiled.model, compiled.data, []
    for geom in np.flatnonzero(model.geom_bodyid):
        body, (radius, half) = model.geom_bodyid[geom], model.geom_size[geom, :2]
        turn, own = (x.reshape(3, 3) for x in (data.xmat[body], data.geom_xmat[geom]))
        middle = data.geom_xpos[geom] - data.xpos[body]
        points = [turn.T @ (middle + side * half * own[:, 2]) for side in (-1, 1)]
        ends = tuple(tuple(map(float, point)) for point in points)
        found.append(Capsule(compiled.name("body", int(body)), ends, float(radius)))
    return tuple(found)
