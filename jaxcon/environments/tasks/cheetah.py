"""Gymnasium's half-cheetah, from the model file that comes with Gymnasium."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, DType
from jaxcon.environments.environment import Channel, Environment, Episode, spread
from jaxcon.io.compiled import Compiled
from jaxcon.io.maps import Tree

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FILE = "half_cheetah.xml"
ACTION = 0.05
"""The duration of an action [s]."""
NOISE, EFFORT = 0.1, 0.1
"""The size of the noise on initial states, and the factor of squared actions in the reward."""
MOST = 1e6
"""The bound of observations in their units. Gymnasium requires a bound; no episode reaches it."""
HINGE = 3
"""The value of a hinge in MuJoCo's enumeration of joint types."""


class Capsule(NamedTuple):
    """The shape of a body in images: body name, end points of its axis in body frame, radius."""

    body: str
    ends: tuple[tuple[float, ...], ...]
    radius: float


@pytree
class HalfCheetah(Environment):
    """Gymnasium's HalfCheetah-v5: a planar cheetah with six motors must run.

    The model file is read from the installed Gymnasium: `pip install 'jaxcon[rl,mujoco]'`. Masses,
    joints, springs, dampers, rotor inertias, motors, joint limits and contacts are from the file.
    Limits and contacts are hard here and soft in MuJoCo, so equal actions lead to different
    motions.

    Action: the torques of back thigh, shin, foot and front thigh, shin, foot. ±1 is the largest
    torque of a motor.

    Observation: MuJoCo's qpos without its first entry (8,): height of the torso above its position
    in the model file [m], its pitch and the six joint angles [rad]. Then qvel (9,): forward and
    upward velocity of the torso [m/s], its pitch rate and the rates of the joints [rad/s].

    Reward: v − 0.1 Σ aᵢ², with the mean velocity v of the torso during the action a [m/s]. It is
    not limited to 0 to 1.

    An episode starts near the qpos of the model file, with uniform noise within ±0.1 on each entry.
    Each entry of qvel is drawn from a normal distribution with standard deviation 0.1. An episode
    never terminates. It is truncated after 1,000 actions of 50 ms, or if the simulation diverges.

    Attributes:
        tree: the map between MuJoCo's coordinates and the bodies.
        joints: the names of the entries of qpos and qvel.
        turning: True for each entry of qpos and qvel that belongs to a hinge.
        motors: the names of the joints that have motors.
        capsules: the shapes of the bodies in images.

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
        dtype: DType | None = None,
    ) -> HalfCheetah:
        """Builds the environment from Gymnasium's model file.

        Args:
            dt: the step size h [s]; by default 10 ms, from the file.
            skip: the number of steps for which an action is held; by default an action takes 50 ms.
            horizon: the number of actions after which an episode is truncated; None for no limit.
            method: integrator, stabilizer and solvers; by default `jc.solvers.Sparse()`, with
                `jc.solvers.Newton` for limits and contacts.
            dtype: the floating dtype of the scene.

        Raises:
            ImportError: Gymnasium, its model file or MuJoCo is missing; the message names the
                extras to install.
        """
        compiled = Compiled(model_file(FILE))
        model = compiled.model
        imported = jc.from_mjcf(model, count_turns=True, dtype=dtype)
        h = float(model.opt.timestep if dt is None else dt)
        if method is None:
            method = jc.Method(solver=jc.solvers.Sparse(), contact_solver=jc.solvers.Newton())
        return cls(
            imported.system,
            method,
            jnp.asarray(h, imported.start.q.dtype),
            round(ACTION / h) if skip is None else skip,
            horizon,
            imported.tree,
            tuple(compiled.name("joint", i) for i in range(model.njnt)),
            tuple(bool(kind == HINGE) for kind in model.jnt_type),
            tuple(compiled.name("joint", i) for i in model.actuator_trnid[:, 0]),
            capsules(compiled),
        )

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The observation channels: qpos without its first entry (the distance run), then qvel."""
        units = ["rad" if turns else "m" for turns in self.turning]
        each = list(zip(self.joints, units, strict=True))
        places = [Channel(name, unit, -MOST, MOST) for name, unit in each[1:]]
        return *places, *(Channel(f"rate of {n}", f"{unit}/s", -MOST, MOST) for n, unit in each)

    @property
    def actions(self) -> tuple[str, ...]:
        """The components of an action: the torque of each motor."""
        return tuple(f"torque at {name}, of the largest" for name in self.motors)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The view of images, (left, right) and (bottom, top) [m].

        It shows the surroundings of the initial position.
        """
        return (-2.0, 2.0), (-0.3, 1.7)

    def window(self, episode: Episode) -> tuple[tuple[float, float], tuple[float, float]]:
        """Returns the view of an image: `frame`, shifted by the distance run so far."""
        (left, right), height = self.frame
        x = float(_drawn(self, episode)[1])
        return (x + left, x + right), height

    def start(self, key: Array) -> tuple[jc.State, tuple[()]]:
        """Draws a state near the pose of the model file, in the air, with small velocities."""
        qpos_key, qvel_key = jax.random.split(key)
        reference = self.tree.reference
        qpos = reference + spread(qpos_key, NOISE, reference.shape, self.dtype)
        qvel = NOISE * jax.random.normal(qvel_key, (self.tree.size,), self.dtype)
        return self.place(qpos, qvel), ()

    def place(self, qpos: Array, qvel: Array) -> jc.State:
        """Returns the state at given coordinates of MuJoCo.

        Args:
            qpos: (9,) [m] and [rad].
            qvel: (9,) [m/s] and [rad/s].
        """
        q, v = self.tree.flat(self.system, qpos, qvel)
        return jc.init(self.system, self.method, q, v, turns=self.tree.turns_of(self.system, qpos))

    def coordinates(self, episode: Episode) -> tuple[Array, Array]:
        """Returns MuJoCo's qpos and qvel, (9,) each; angles include whole turns.

        Args:
            episode: the current episode.
        """
        return self.tree.read(self.system, episode.state)

    def observation(self, episode: Episode) -> Array:
        """Returns MuJoCo's qpos without its first entry, and qvel."""
        qpos, qvel = self.coordinates(episode)
        return jnp.concatenate([qpos[1:], qvel])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Returns the mean forward velocity minus the cost of the action."""
        x_before, x_after = (self.coordinates(episode)[0][0] for episode in (before, after))
        return (x_after - x_before) / (self.dt * self.skip) - EFFORT * jnp.sum(action**2)

    def marks(self, axes: Axes, episode: Episode) -> None:
        """Draws the ground with a tick per meter, and the capsules of the bodies."""
        ends, x = _drawn(self, episode)
        meters = np.arange(np.floor(x) - 3, np.floor(x) + 4)
        axes.plot(meters, 0 * meters, "-|", color="k", lw=1)
        points = 72 * 4.8 / (self.frame[0][1] - self.frame[0][0])  # line width of one meter
        for i, capsule in enumerate(self.capsules):
            style = {"lw": 2 * capsule.radius * points, "solid_capstyle": "round"}
            axes.plot(*np.asarray(ends[i]).T[[0, 2]], color=f"C{i}", **style)


@jax.jit
def _drawn(cheetah: HalfCheetah, episode: Episode) -> tuple[Array, Array]:
    """Returns the end points of the capsules, (capsules, 2, 3), and the distance run, () [m]."""
    system, state = cheetah.system, episode.state
    ends = [
        jnp.stack([jc.position(system, state, capsule.body, end) for end in capsule.ends])
        for capsule in cheetah.capsules
    ]
    return jnp.stack(ends), cheetah.coordinates(episode)[0][0]


def model_file(name: str) -> Path:
    """Returns the path of a model file in the installed Gymnasium.

    Raises:
        ImportError: Gymnasium is not installed or has no such file.
    """
    package = find_spec("gymnasium")
    for folder in (package and package.submodule_search_locations) or ():
        path = Path(folder) / "envs" / "mujoco" / "assets" / name
        if path.is_file():
            return path
    raise ImportError(
        f"the model file {name} comes with Gymnasium, and MuJoCo compiles it: pip install"
        " 'jaxcon[rl,mujoco]'."
    )


def capsules(compiled: Compiled) -> tuple[Capsule, ...]:
    """Returns the capsules of moving bodies, with the end points of their axes in body frames."""
    model, data, result = compiled.model, compiled.data, []
    for geom in np.flatnonzero(model.geom_bodyid):
        body, (radius, half) = int(model.geom_bodyid[geom]), model.geom_size[geom, :2]
        body_frame, geom_frame = data.xmat[body].reshape(3, 3), data.geom_xmat[geom].reshape(3, 3)
        middle = data.geom_xpos[geom] - data.xpos[body]
        axis = half * geom_frame[:, 2]
        points = [body_frame.T @ (middle + side * axis) for side in (-1, 1)]
        ends = tuple(tuple(map(float, point)) for point in points)
        result.append(Capsule(compiled.name("body", body), ends, float(radius)))
    return tuple(result)
