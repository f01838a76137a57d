"""A swinger on a rope pumps: by climbing a little and letting down again it swings up."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core import checks
from jaxcon.core.numerics import safe_sqrt
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.environments.environment import (
    Channel,
    Environment,
    Episode,
    angle_channels,
    near,
)

GRAVITY = 9.81
"""What the bodies hang in [m/s²]."""


@pytree
class RopeSwing(Environment):
    """A rope of links hangs from a point, and a servo moves a body along its last link.

    The servo pulls with a fifth to three times the body's weight, so that the rope stays taut, and
    has no moment about the point that it hangs from: the swing grows where the body is pulled up as
    it passes below the point, and let down where it turns.

    Action: how much higher on the rope the body is to be than at assembly, −1 to 1 of `stroke`.
    Observation: cosine, sine and rate [rad/s] of the angle at which the body hangs from the point,
    its distance from it [m] and the rate of that [m/s], cosine, sine and rate of the angle of each
    link from above, and the wanted height [m].

    Reward, 0 to 1: near(h − h*, 0.15 m) · (4 + near(action, 1))/5 with near(x, s) = 1/(1 + (x/s)²),
    the wanted height h*, and the height to which the body swings, which is h = r (1 − cos θ) +
    (r θ̇)²/(2 g) at the angle θ and the distance r from the point. An episode draws a height of 0.4
    to 0.8 m, and starts with a straight rope at 0.1 to 0.2 rad to either side and at rest; it is
    over when the body is as high as the point.

    Attributes:
        stroke: how far the body climbs either way [m].
        length: of a link [m].
        hold: from the end of the rope down to the body at assembly [m].

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
        length: Any = 0.5,
        mass: Any = 0.3,
        body: Any = 30.0,
        hold: Any = 0.4,
        stroke: Any = 0.25,
        stiffness: Any = 6e3,
        damping: Any = 800.0,
        friction: Any = 0.05,
        *,
        dt: Any = 5e-3,
        skip: int = 8,
        horizon: int | None = 400,
        method: jc.Method | None = None,
        dtype: Any = None,
    ) -> RopeSwing:
        """The environment; its numbers may be traced.

        Args:
            links: how many.
            length: of a link [m].
            mass: of a link [kg].
            body: its mass [kg]; it is a ball of 0.15 m.
            hold: from the end of the rope down to the body at assembly [m].
            stroke: how far the body climbs either way [m].
            stiffness: of the servo [N/m].
            damping: of the servo [N s/m].
            friction: viscous, of each hinge [N m s/rad].
            dt: h [s].
            skip: steps of h an action is held for.
            horizon: actions until an episode is truncated, or None.
            method: of the simulation.
            dtype: of every number.

        Raises:
            ValueError: `links` is no whole number from 1.
        """
        scene = jc.Scene(dim=2, gravity=(0.0, -GRAVITY), dtype=dtype)
        checks.count("RopeSwing", "links", links)
        given = dt, length, mass, body, hold, stroke
        dt, length, mass, body, hold, stroke = (jnp.asarray(x, scene.dtype) for x in given)
        above = jc.WORLD
        for i, name in enumerate(link_names(links)):
            inertia = mass * length**2 / 12
            scene.add_body(name, mass=mass, inertia=inertia, position=below((i + 0.5) * length))
            hinge = f"hinge{i + 1}"
            scene.add(jc.Revolute(hinge, above, name, point=below(i * length)))
            scene.add(jc.JointDamper(f"friction{i + 1}", hinge, friction))
            above = name
        moment = 0.4 * body * 0.15**2
        scene.add_body("body", mass=body, inertia=moment, position=below(links * length + hold))
        scene.add(jc.Prismatic("grip", above, "body", axis=(0.0, 1.0)))
        pull = jnp.asarray((0.2 * GRAVITY, 3 * GRAVITY), scene.dtype) * body
        scene.add(jc.PositionServo("climb", "grip", stiffness, damping, force_range=pull))
        system, _ = scene.build()
        method = jc.Method(solver=jc.Sparse()) if method is None else method
        return cls(system, method, dt, skip, horizon, stroke, length, hold)

    @property
    def links(self) -> list[str]:
        """Their names, from the point downwards."""
        return [name for name in self.system.layout.bodies if name != "body"]

    @property
    def observed(self) -> tuple[Channel, ...]:
        """Body, links, goal."""
        distance = Channel("distance", "m", 0.0, 20.0), Channel("climbing", "m/s", -20.0, 20.0)
        links = [channel for name in self.links for channel in angle_channels(name, 50.0)]
        body = *angle_channels("body", 50.0), *distance
        return *body, *links, Channel("wanted height", "m", 0.0, 2.0)

    @property
    def actions(self) -> tuple[str, ...]:
        """One place on the rope."""
        return ("climb, of the stroke",)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The swing below the point."""
        reach = 1.1 * float(len(self.links) * self.length + self.hold + self.stroke)
        return (-reach, reach), (-reach, 0.2)

    def start(self, key: Array) -> tuple[jc.State, Array]:
        """To either side, at rest, with a height to swing to."""
        side, angle, goal = jax.random.split(key, 3)
        way = jnp.where(jax.random.bernoulli(side), 1, -1).astype(self.dtype)
        size = jax.random.uniform(angle, (), self.dtype, 0.1, 0.2)
        q = self.place(way * size)
        state = jc.init(self.system, self.method, q, jnp.zeros_like(q))
        return state, jax.random.uniform(goal, (), self.dtype, 0.4, 0.8)

    def place(self, angle: Array) -> Array:
        """Positions (n_q,) of the straight rope at an angle [rad], the body as assembled."""
        layout, n = self.system.layout, len(self.links)
        along = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
        q = jnp.zeros(layout.n_q, self.dtype)
        for i, name in enumerate(self.links):
            q = q.at[layout.q(name)].set(jnp.append((i + 0.5) * self.length * along, angle))
        end = n * self.length + self.hold
        return q.at[layout.q("body")].set(jnp.append(end * along, angle))

    def polar(self, episode: Episode) -> tuple[Array, Array, Array, Array]:
        """The body's angle from hanging [rad], its rate, its distance [m] and the rate of that."""
        given = self.system, episode.state, "body"
        (x, y), (u, w) = jc.position(*given), jc.velocity(*given)
        distance = safe_sqrt(x**2 + y**2)
        rate, pull = (u * -y + w * x) / distance**2, (u * x + w * y) / distance
        return jnp.arctan2(x, -y), rate, distance, pull

    def height(self, episode: Episode) -> Array:
        """How high the body would swing as it is, () [m]."""
        angle, rate, distance, _ = self.polar(episode)
        gravity = -self.system.gravity[1]
        return distance * (1 - jnp.cos(angle)) + (distance * rate) ** 2 / (2 * gravity)

    def observation(self, episode: Episode) -> Array:
        """Body, links, goal."""
        angle, rate, distance, pull = self.polar(episode)
        numbers = [jnp.cos(angle), jnp.sin(angle), rate, distance, pull]
        for name in self.links:
            given = self.system, episode.state, name
            own = jc.orientation(*given)
            numbers += [jnp.cos(own), jnp.sin(own), jc.angular_velocity(*given)]
        return jnp.stack([*numbers, episode.goal])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """For swinging as high as wanted, with little climbing."""
        effort = (4 + near(action[0], 1.0)) / 5
        return near(self.height(after) - after.goal, 0.15) * effort

    def control(self, episode: Episode, action: Array) -> Array:
        """The place on the rope, [m]."""
        return self.stroke * action

    def terminal(self, episode: Episode) -> Array:
        """Returns True where the body is as high as the point that the rope hangs from."""
        return jc.position(self.system, episode.state, "body")[1] > 0

    def marks(self, axes: Any, episode: Episode) -> None:
        """The links in full length, the body, and the height wanted."""
        end, given = np.zeros(2), (self.system, episode.state)
        for name in self.links:
            angle = float(jc.orientation(*given, name))
            tip = end + float(self.length) * np.array([np.sin(angle), -np.cos(angle)])
            axes.plot(*np.stack([end, tip], axis=1), color="C1", lw=3)
            end = tip
        x, y = np.asarray(jc.position(*given, "body"))
        axes.plot((end[0], x), (end[1], y), color="C1", lw=3)
        axes.plot(x, y, "o", color="C0", markersize=16)
        axes.axhline(float(episode.goal) - float(np.hypot(x, y)), color="k", ls=":")


def link_names(count: int) -> list[str]:
    """From the point downwards."""
    return [f"link{i + 1}" for i in range(count)]


def below(depth: Any) -> Array:
    """The point so far below the origin, (2,) [m]."""
    return jnp.stack([0 * depth, -depth])
