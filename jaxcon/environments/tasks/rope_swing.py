"""A task in which a swinger pumps a rope swing by climbing up and down a little."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core import checks
from jaxcon.core.numerics import safe_sqrt
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, DType
from jaxcon.environments.environment import (
    Channel,
    Environment,
    Episode,
    Number,
    angle_channels,
    near,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GRAVITY = 9.81
"""The gravitational acceleration [m/s²]."""


@pytree
class RopeSwing(Environment):
    """A rope of links hangs from a fixed point. A servo moves a body along its last link.

    The servo pulls with 0.2 to 3 times the weight of the body, so the rope stays taut. Its force
    has no moment about the suspension point. To pump the swing, the body is pulled up at the lowest
    point and let down at the turning points.

    Action: the height of the body on the rope, relative to assembly. ±1 is `stroke`.

    Observation: cosine, sine and rate [rad/s] of the angle of the body about the suspension point.
    Its distance from that point [m] and the rate of the distance [m/s]. Then cosine, sine and rate
    of the angle of each link, from the top down. The desired height [m].

    Reward, 0 to 1: near(h − h*, 0.15 m) · (4 + near(action, 1))/5, with near(x, s) = 1/(1 + (x/s)²)
    and the desired height h*. The swing height is h = r (1 − cos θ) + (r θ̇)²/(2 g), with the angle
    θ of the body and its distance r from the suspension point.

    An episode draws a desired height of 0.4 to 0.8 m. It starts at rest with a straight rope at 0.1
    to 0.2 rad to either side. It terminates when the body is as high as the suspension point.

    Attributes:
        stroke: the largest displacement of the body along the rope, up or down [m].
        length: the length of a link [m].
        hold: the distance from the end of the rope down to the body at assembly [m].

    References:
        Wirkus, Rand, Ruina, How to pump a swing, College Mathematics Journal 29 (1998).
    """

    stroke: Array
    length: Array
    hold: Array

    @classmethod
    def build(
        cls,
        links: int = 4,
        length: Number = 0.5,
        mass: Number = 0.3,
        body: Number = 30.0,
        hold: Number = 0.4,
        stroke: Number = 0.25,
        stiffness: Number = 6e3,
        damping: Number = 800.0,
        friction: Number = 0.05,
        *,
        dt: Number = 5e-3,
        skip: int = 8,
        horizon: int | None = 400,
        method: jc.Method | None = None,
        dtype: DType | None = None,
    ) -> RopeSwing:
        """Builds the environment. Its numeric options may be traced.

        Args:
            links: the number of links.
            length: the length of a link [m].
            mass: the mass of a link [kg].
            body: the mass of the body [kg], a ball with a radius of 0.15 m.
            hold: the distance from the end of the rope down to the body at assembly [m].
            stroke: the largest displacement of the body along the rope, up or down [m].
            stiffness: the stiffness of the servo [N/m].
            damping: the damping of the servo [N s/m].
            friction: the viscous friction of each hinge [N m s/rad].
            dt: the step size h [s].
            skip: the number of steps for which an action is held.
            horizon: the number of actions after which an episode is truncated; None for no limit.
            method: integrator, stabilizer and solvers; by default with `jc.solvers.Sparse()`.
            dtype: the floating dtype of the scene.

        Raises:
            ValueError: `links` is not a whole number from 1.
        """
        scene = jc.Scene(dim=2, gravity=(0.0, -GRAVITY), dtype=dtype)
        checks.count("RopeSwing", "links", links)
        numbers = dt, length, mass, body, hold, stroke
        dt, length, mass, body, hold, stroke = (jnp.asarray(x, scene.dtype) for x in numbers)
        above = jc.WORLD
        for i, name in enumerate(link_names(links)):
            inertia = mass * length**2 / 12
            scene.add_body(name, mass=mass, inertia=inertia, position=below((i + 0.5) * length))
            hinge = f"hinge{i + 1}"
            scene.add(jc.Revolute(hinge, above, name, point=below(i * length)))
            scene.add(jc.forces.JointDamper(f"friction{i + 1}", hinge, friction))
            above = name
        moment = 0.4 * body * 0.15**2
        scene.add_body("body", mass=body, inertia=moment, position=below(links * length + hold))
        scene.add(jc.Prismatic("grip", above, "body", axis=(0.0, 1.0)))
        # a servo that could push would let the rope go slack
        pull = jnp.asarray((0.2 * GRAVITY, 3 * GRAVITY), scene.dtype) * body
        scene.add(jc.forces.PositionServo("climb", "grip", stiffness, damping, force_range=pull))
        system, _ = scene.build()
        method = jc.Method(solver=jc.solvers.Sparse()) if method is None else method
        return cls(system, method, dt, skip, horizon, stroke, length, hold)

    @property
    def links(self) -> list[str]:
        """The names of the links, from the top down."""
        return [name for name in self.system.layout.bodies if name != "body"]

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The observation channels of body, links and goal."""
        distance = Channel("distance", "m", 0.0, 20.0), Channel("climbing", "m/s", -20.0, 20.0)
        links = [channel for name in self.links for channel in angle_channels(name, 50.0)]
        body = *angle_channels("body", 50.0), *distance
        return *body, *links, Channel("wanted height", "m", 0.0, 2.0)

    @property
    def actions(self) -> tuple[str, ...]:
        """The component of an action: the desired position of the body on the rope."""
        return ("climb, of the stroke",)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The view of images, (left, right) and (bottom, top) [m].

        It shows the whole swing below the suspension point.
        """
        reach = 1.1 * float(len(self.links) * self.length + self.hold + self.stroke)
        return (-reach, reach), (-reach, 0.2)

    def start(self, key: Array) -> tuple[jc.State, Array]:
        """Draws an initial state at rest, with the rope tilted to a side, and a desired height."""
        side, angle, goal = jax.random.split(key, 3)
        sign = jnp.where(jax.random.bernoulli(side), 1, -1).astype(self.dtype)
        size = jax.random.uniform(angle, (), self.dtype, 0.1, 0.2)
        q = self.place(sign * size)
        state = jc.init(self.system, self.method, q, jnp.zeros_like(q))
        return state, jax.random.uniform(goal, (), self.dtype, 0.4, 0.8)

    def place(self, angle: Array) -> Array:
        """Returns positions (n_q,) of a straight rope at an angle [rad].

        The body is at `hold` below the end of the rope, where it was at assembly.
        """
        layout, n = self.system.layout, len(self.links)
        along = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
        q = jnp.zeros(layout.n_q, self.dtype)
        for i, name in enumerate(self.links):
            q = q.at[layout.q(name)].set(jnp.append((i + 0.5) * self.length * along, angle))
        end = n * self.length + self.hold
        return q.at[layout.q("body")].set(jnp.append(end * along, angle))

    def polar(self, episode: Episode) -> tuple[Array, Array, Array, Array]:
        """Returns polar coordinates of the body about the suspension point, and their rates.

        Returns:
            Angle from hanging [rad], its rate [rad/s], distance [m], and its rate [m/s].
        """
        body = self.system, episode.state, "body"
        (x, y), (u, w) = jc.position(*body), jc.velocity(*body)
        distance = safe_sqrt(x**2 + y**2)
        rate, pull = (u * -y + w * x) / distance**2, (u * x + w * y) / distance
        return jnp.arctan2(x, -y), rate, distance, pull

    def height(self, episode: Episode) -> Array:
        """Returns the height to which the body would swing from the current state, () [m]."""
        angle, rate, distance, _ = self.polar(episode)
        gravity = -self.system.gravity[1]
        return distance * (1 - jnp.cos(angle)) + (distance * rate) ** 2 / (2 * gravity)

    def observation(self, episode: Episode) -> Array:
        """Returns the states of body and links, and the goal, as one vector."""
        angle, rate, distance, pull = self.polar(episode)
        numbers = [jnp.cos(angle), jnp.sin(angle), rate, distance, pull]
        for name in self.links:
            link = self.system, episode.state, name
            turn = jc.orientation(*link)
            numbers += [jnp.cos(turn), jnp.sin(turn), jc.angular_velocity(*link)]
        return jnp.stack([*numbers, episode.goal])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Returns a reward for the desired swing height with little climbing."""
        effort = (4 + near(action[0], 1.0)) / 5
        return near(self.height(after) - after.goal, 0.15) * effort

    def control(self, episode: Episode, action: Array) -> Array:
        """Returns the desired position of the body on the rope, (1,) [m]."""
        return self.stroke * action

    def terminal(self, episode: Episode) -> Array:
        """Returns True if the body is as high as the suspension point."""
        return jc.position(self.system, episode.state, "body")[1] > 0

    def marks(self, axes: Axes, episode: Episode) -> None:
        """Draws the links at their full length, the body, and the desired height."""
        end, world = np.zeros(2), (self.system, episode.state)
        for name in self.links:
            angle = float(jc.orientation(*world, name))
            tip = end + float(self.length) * np.array([np.sin(angle), -np.cos(angle)])
            axes.plot(*np.stack([end, tip], axis=1), color="C1", lw=3)
            end = tip
        x, y = np.asarray(jc.position(*world, "body"))
        axes.plot((end[0], x), (end[1], y), color="C1", lw=3)
        axes.plot(x, y, "o", color="C0", markersize=16)
        axes.axhline(float(episode.goal) - float(np.hypot(x, y)), color="k", ls=":")


def link_names(count: int) -> list[str]:
    """Returns the names of the links, from the top down."""
    return [f"link{i + 1}" for i in range(count)]


def below(depth: Number) -> Array:
    """Returns the point at a depth below the origin, (2,) [m]."""
    return jnp.stack([0 * depth, -depth])
