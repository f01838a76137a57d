"""A sleigh on a blade is to be parked: it moves along its blade and not sideways."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp

import jaxcon as jc
from jaxcon.core.numerics import safe_sqrt, wrap
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Channel, Environment, Episode, near, spread

LOT = 6.0
"""How far the blade may be from its place along x and y [m]."""
AHEAD = 0.2
"""How far the centre of mass lies ahead of the blade [m]."""


def drive(sleigh: jc.Motion, t: Array, u: Array, params: Any) -> Array:
    """Thrust along the blade and a torque, each against viscous friction: (F, τ), (3,)."""
    ahead = sleigh.direction(jnp.asarray((1.0, 0.0), sleigh.position.dtype))
    thrust = params["force"] * u[0] * ahead - params["drag"] * sleigh.velocity
    torque = params["torque"] * u[1] - params["turning_drag"] * sleigh.angular_velocity
    return jnp.append(thrust, torque)


@pytree
class Parking(Environment):
    """A Chaplygin sleigh, 20 kg on a knife edge, drives and turns to a place and a heading.

    The blade lies behind the centre of mass and never slips sideways, so that a place to the side
    is reached by driving there and back only.

    Action: thrust along the blade and torque, −1 to 1 of the largest (`force` and `torque` among
    the parameters of "drive"). Observation: where the place is, ahead of and to the left of the
    blade [m], cosine and sine of the heading from that wanted, speed along the blade [m/s] and
    yaw rate [rad/s].

    Reward, 0 to 1: near(d, 0.5 m) · (1 + near(ψ, 0.4 rad))/2 · (1 + near(v, 0.5 m/s))/2 with the
    distance d of the blade from its place, the heading ψ from that wanted, and the speed v along
    the blade; near(x, s) = 1/(1 + (x/s)²). An episode starts at rest, headed anywhere, within 2.5 m
    of the place along x and y; it is over when the blade leaves the lot, 6 m from the place along
    x or y.
    """

    at_once: ClassVar[int] = 512

    @classmethod
    def build(
        cls,
        mass: Any = 20.0,
        inertia: Any = 2.0,
        force: Any = 60.0,
        torque: Any = 10.0,
        drag: Any = 20.0,
        turning_drag: Any = 4.0,
        *,
        dt: Any = 0.01,
        skip: int = 5,
        horizon: int | None = 400,
        method: jc.Method | None = None,
        dtype: Any = None,
    ) -> Parking:
        """The environment; its numbers may be traced.

        Args:
            mass: [kg].
            inertia: about the centre of mass [kg m²].
            force: the largest thrust [N].
            torque: the largest torque [N m].
            drag: [N s/m].
            turning_drag: [N m s/rad].
            dt: h [s].
            skip: steps of h an action is held for.
            horizon: actions until an episode is truncated, or None.
            method: of the simulation.
            dtype: of every number.
        """
        scene = jc.Scene(dim=2, gravity=(0.0, 0.0), dtype=dtype)
        scene.add_body("sleigh", mass=mass, inertia=inertia, position=(AHEAD, 0.0))
        blade = jc.KnifeEdge("blade", jc.WORLD, "sleigh", edge=(1.0, 0.0), center=(0.0, 0.0))
        scene.add(blade)
        numbers = {"force": force, "torque": torque, "drag": drag, "turning_drag": turning_drag}
        params = {name: jnp.asarray(x, scene.dtype) for name, x in numbers.items()}
        scene.add(jc.CustomForce("drive", ("sleigh",), drive, params, controls=2))
        system, _ = scene.build()
        method = jc.Method(solver=jc.Sparse()) if method is None else method
        return cls(system, method, jnp.asarray(dt, scene.dtype), skip, horizon)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The place from the sleigh, then its motion."""
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
        """Thrust and torque."""
        return "thrust, of the largest", "torque, of the largest"

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The lot."""
        return (-LOT, LOT), (-LOT, LOT)

    def start(self, key: Array) -> tuple[jc.State, Any]:
        """At rest, anywhere."""
        size = jnp.asarray((2.5, 2.5, jnp.pi), self.dtype)
        x, y, heading = spread(key, 1.0, (3,), self.dtype) * size
        ahead = AHEAD * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        q = jnp.append(jnp.stack([x, y]) + ahead, heading)
        return jc.init(self.system, self.method, q, jnp.zeros_like(q)), ()

    def motion(self, episode: Episode) -> tuple[Array, Array, Array, Array]:
        """The blade's place (2,) [m], the heading [rad], speed [m/s] and yaw rate [rad/s]."""
        given, blade = (self.system, episode.state, "sleigh"), (-AHEAD, 0.0)
        heading = jc.orientation(*given)
        along = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        speed = jc.velocity(*given, blade) @ along
        return jc.position(*given, blade), heading, speed, jc.angular_velocity(*given)

    def observation(self, episode: Episode) -> Array:
        """The place from the sleigh, then its motion."""
        (x, y), heading, speed, yaw = self.motion(episode)
        c, s = jnp.cos(heading), jnp.sin(heading)
        return jnp.stack([-c * x - s * y, s * x - c * y, c, s, speed, yaw])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """For the place, the heading and being still."""
        place, heading, speed, _ = self.motion(after)
        there = near(safe_sqrt(place @ place), 0.5)
        turned = (1 + near(wrap(heading), 0.4)) / 2
        return there * turned * (1 + near(speed, 0.5)) / 2

    def terminal(self, episode: Episode) -> Array:
        """Returns True where the blade has left the lot."""
        return jnp.max(jnp.abs(self.motion(episode)[0])) > LOT

    def marks(self, axes: Any, episode: Episode) -> None:
        """The place with its heading, and the sleigh as an arrow."""
        (x, y), heading, *_ = self.motion(episode)
        axes.annotate("", (0.8, 0.0), (0.0, 0.0), arrowprops={"arrowstyle": "->", "ls": ":"})
        tip = x + 0.8 * jnp.cos(heading), y + 0.8 * jnp.sin(heading)
        style = {"arrowstyle": "-|>", "color": "C0", "lw": 3}
        axes.annotate("", tuple(map(float, tip)), (float(x), float(y)), arrowprops=style)
