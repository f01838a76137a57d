"""A task of parking a sleigh on a blade, which moves along the blade but not sideways."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

import jaxcon as jc
from jaxcon.core.numerics import safe_sqrt, wrap
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, DType
from jaxcon.environments.environment import Channel, Environment, Episode, Number, near, spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LOT = 6.0
"""The half size of the lot: the largest |x| and |y| of the blade relative to the target [m]."""
AHEAD = 0.2
"""The distance of the center of mass ahead of the blade [m]."""


def drive(sleigh: jc.extend.Motion, t: Array, u: Array, params: dict[str, Array]) -> Array:
    """Returns thrust and torque minus viscous friction as a wrench (F, τ), (3,) [N], [N m]."""
    ahead = sleigh.direction(jnp.asarray((1.0, 0.0), sleigh.position.dtype))
    thrust = params["force"] * u[0] * ahead - params["drag"] * sleigh.velocity
    torque = params["torque"] * u[1] - params["turning_drag"] * sleigh.angular_velocity
    return jnp.append(thrust, torque)


@pytree
class Parking(Environment):
    """A Chaplygin sleigh, 20 kg on a knife edge, must reach a target position and heading.

    The blade is behind the center of mass and never slips sideways. The sleigh can therefore reach
    a position beside it only by driving forward and backward.

    Action: thrust along the blade, and torque. ±1 is the largest thrust or torque (`force` and
    `torque` among the parameters of "drive").

    Observation: the target position relative to the blade, ahead and to the left [m]. Cosine and
    sine of the heading relative to the target heading. Velocity along the blade [m/s] and yaw rate
    [rad/s].

    Reward, 0 to 1: near(d, 0.5 m) · (1 + near(ψ, 0.4 rad))/2 · (1 + near(v, 0.5 m/s))/2, with
    near(x, s) = 1/(1 + (x/s)²). Here d is the distance of the blade from the target position, ψ the
    error of the heading, and v the velocity along the blade.

    An episode starts at rest with any heading, within 2.5 m of the target along x and y. It
    terminates when the blade is more than 6 m from the target along x or y.
    """

    at_once: ClassVar[int] = 512

    @classmethod
    def build(
        cls,
        mass: Number = 20.0,
        inertia: Number = 2.0,
        force: Number = 60.0,
        torque: Number = 10.0,
        drag: Number = 20.0,
        turning_drag: Number = 4.0,
        *,
        dt: Number = 0.01,
        skip: int = 5,
        horizon: int | None = 400,
        method: jc.Method | None = None,
        dtype: DType | None = None,
    ) -> Parking:
        """Builds the environment. Its numeric options may be traced.

        Args:
            mass: the mass of the sleigh [kg].
            inertia: the moment of inertia about the center of mass [kg m²].
            force: the largest thrust [N].
            torque: the largest torque [N m].
            drag: the viscous friction of translation [N s/m].
            turning_drag: the viscous friction of rotation [N m s/rad].
            dt: the step size h [s].
            skip: the number of steps for which an action is held.
            horizon: the number of actions after which an episode is truncated; None for no limit.
            method: integrator, stabilizer and solvers; by default with `jc.solvers.Sparse()`.
            dtype: the floating dtype of the scene.
        """
        scene = jc.Scene(dim=2, gravity=(0.0, 0.0), dtype=dtype)
        scene.add_body("sleigh", mass=mass, inertia=inertia, position=(AHEAD, 0.0))
        blade = jc.joints.KnifeEdge("blade", jc.WORLD, "sleigh", edge=(1.0, 0.0), center=(0.0, 0.0))
        scene.add(blade)
        numbers = {"force": force, "torque": torque, "drag": drag, "turning_drag": turning_drag}
        params = {name: jnp.asarray(x, scene.dtype) for name, x in numbers.items()}
        scene.add(jc.forces.CustomForce("drive", ("sleigh",), drive, params, controls=2))
        system, _ = scene.build()
        method = jc.Method(solver=jc.solvers.Sparse()) if method is None else method
        return cls(system, method, jnp.asarray(dt, scene.dtype), skip, horizon)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The observation channels: target relative to the sleigh, then motion of the sleigh."""
        reach = 2 * LOT
        return (
            Channel("place ahead", "m", -reach, reach),
            Channel("place to the left", "m", -reach, reach),
            Channel("cosine of heading", "1", -1.0, 1.0),
            Channel("sine of heading", "1", -1.0, 1.0),
            Channel("speed", "m/s", -20.0, 20.0),
            Channel("yaw rate", "rad/s", -20.0, 20.0),
        )

    @property
    def actions(self) -> tuple[str, ...]:
        """The components of an action: thrust and torque."""
        return "thrust, of the largest", "torque, of the largest"

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The view of images, (left, right) and (bottom, top) [m]: the whole lot."""
        return (-LOT, LOT), (-LOT, LOT)

    def start(self, key: Array) -> tuple[jc.State, tuple[()]]:
        """Draws an initial state at rest, with a random position and heading."""
        size = jnp.asarray((2.5, 2.5, jnp.pi), self.dtype)
        x, y, heading = spread(key, 1.0, (3,), self.dtype) * size
        ahead = AHEAD * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        q = jnp.append(jnp.stack([x, y]) + ahead, heading)
        return jc.init(self.system, self.method, q, jnp.zeros_like(q)), ()

    def motion(self, episode: Episode) -> tuple[Array, Array, Array, Array]:
        """Returns blade position (2,) [m], heading [rad], speed [m/s] and yaw rate [rad/s].

        The speed is the component of the blade's velocity along the blade.
        """
        sleigh, blade = (self.system, episode.state, "sleigh"), (-AHEAD, 0.0)
        heading = jc.orientation(*sleigh)
        along = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        speed = jc.velocity(*sleigh, blade) @ along
        return jc.position(*sleigh, blade), heading, speed, jc.angular_velocity(*sleigh)

    def observation(self, episode: Episode) -> Array:
        """Returns one vector: the target relative to the sleigh, then the motion of the sleigh."""
        (x, y), heading, speed, yaw = self.motion(episode)
        c, s = jnp.cos(heading), jnp.sin(heading)
        return jnp.stack([-c * x - s * y, s * x - c * y, c, s, speed, yaw])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Returns a reward that is high near the target position and heading at a low speed."""
        place, heading, speed, _ = self.motion(after)
        arrived = near(safe_sqrt(place @ place), 0.5)
        aligned = (1 + near(wrap(heading), 0.4)) / 2
        return arrived * aligned * (1 + near(speed, 0.5)) / 2

    def terminal(self, episode: Episode) -> Array:
        """Returns True if the blade has left the lot."""
        return jnp.max(jnp.abs(self.motion(episode)[0])) > LOT

    def marks(self, axes: Axes, episode: Episode) -> None:
        """Draws the target as a dotted arrow, and the sleigh as an arrow."""
        (x, y), heading, *_ = self.motion(episode)
        axes.annotate("", (0.8, 0.0), (0.0, 0.0), arrowprops={"arrowstyle": "->", "ls": ":"})
        tip = x + 0.8 * jnp.cos(heading), y + 0.8 * jnp.sin(heading)
        style = {"arrowstyle": "-|>", "color": "C0", "lw": 3}
        axes.annotate("", tuple(map(float, tip)), (float(x), float(y)), arrowprops=style)
