"""A Stewart platform keeps a rolling ball in the middle of its plate."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.numerics import safe_sqrt
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Channel, Environment, Episode, near, spread

HEIGHT, PLATE, THICK = 1.0, 0.4, 0.02
"""The height of the platform at home, its radius, and its surface above its centre [m]."""
LEGS = range(6)


def ring(radius: float, apart: float) -> np.ndarray:
    """Six points in three pairs on a circle, (6, 3) [m]."""
    pair, side = np.arange(6) // 2, np.arange(6) % 2 * 2 - 1
    angle = pair * 2 * np.pi / 3 + side * apart
    return radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)


FEET = ring(0.8, 0.25)
HEADS = ring(PLATE, np.pi / 3 - 0.25) + np.array([0.0, 0.0, HEIGHT])


@pytree
class StewartBalancing(Environment):
    """Six servos lengthen and shorten the legs of a platform on which a ball rolls.

    Fifteen bodies and their six freedoms: each leg is a cylinder on a cross joint, a piston that
    slides in it, and a ball joint under the platform; five independent loops, and a ball that rolls
    without slip on the plate and stays on it.

    Action: what each leg is to be longer than at home, −1 to 1 of `stroke` [m]; a servo follows.
    Observation: place and velocity of the ball in the frame of the plate, (2,) [m] and (2,) [m/s],
    then of the platform its place from home (3,) [m], its turn as a vector (3,) [rad], its velocity
    (3,) [m/s] and angular velocity (3,) [rad/s], and of the legs what they are longer than at home,
    (6,) [m].

    Reward, 0 to 1: near(d, 0.1 m) · (1 + near(v, 0.4 m/s))/2 · (4 + near(action, 1))/5 with the
    ball's distance d from the middle and its speed v over the plate, and near(x, s) =
    1/(1 + (x/s)²), of the root of the mean square where there are several. An episode starts with
    the platform at home and at rest and the ball within 0.15 m of the middle along x and y, rolling
    at up to 0.2 m/s along each; it is over when the ball leaves the plate, 0.4 m from the middle.

    Attributes:
        stroke: how far a leg goes either way [m].
        radius: of the ball [m].
        home: positions as assembled, the ball in the middle, (n_q,).
    """

    stroke: Array
    radius: Array
    home: Array

    @classmethod
    def build(
        cls,
        ball: Any = 0.2,
        radius: Any = 0.04,
        platform: Any = 20.0,
        stroke: Any = 0.1,
        stiffness: Any = 2e4,
        damping: Any = 1e3,
        *,
        dt: Any = 4e-3,
        skip: int = 5,
        horizon: int | None = 500,
        method: jc.Method | None = None,
        dtype: Any = None,
    ) -> StewartBalancing:
        """The environment; its numbers may be traced.

        Args:
            ball: its mass [kg].
            radius: of the ball [m].
            platform: its mass [kg].
            stroke: how far a leg goes either way [m].
            stiffness: of the servos [N/m].
            damping: of the servos [N s/m].
            dt: h [s].
            skip: steps of h an action is held for.
            horizon: actions until an episode is truncated, or None.
            method: of the simulation.
            dtype: of every number.
        """
        scene = jc.Scene(dtype=dtype)
        moments = platform * np.array([0.04, 0.04, 0.08])
        scene.add_body("platform", mass=platform, inertia=moments, position=(0.0, 0.0, HEIGHT))
        for i in LEGS:
            add_leg(scene, i, stiffness, damping)
        moment = 0.4 * ball * radius**2 * np.ones(3)
        up = np.array([0.0, 0.0, 1.0])
        middle = (HEIGHT + THICK + radius) * up
        scene.add_body("ball", mass=ball, inertia=moment, position=middle)
        scene.add(jc.RollingSphere("rolling", "platform", "ball", radius))
        system, state = scene.build()
        method = jc.Method(solver=jc.Sparse()) if method is None else method
        dt, stroke, radius = (jnp.asarray(x, scene.dtype) for x in (dt, stroke, radius))
        return cls(system, method, dt, skip, horizon, stroke, radius, state.q)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """Ball, platform, legs."""
        vectors = [
            ("ball", "m", 1.0, "xy"),
            ("velocity of ball", "m/s", 10.0, "xy"),
            ("platform", "m", 1.0, "xyz"),
            ("turn", "rad", 3.2, "xyz"),
            ("velocity", "m/s", 10.0, "xyz"),
            ("angular velocity", "rad/s", 30.0, "xyz"),
            ("leg", "m", 1.0, "123456"),
        ]
        return tuple(
            Channel(f"{name} {axis}", unit, -most, most)
            for name, unit, most, axes in vectors
            for axis in axes
        )

    @property
    def actions(self) -> tuple[str, ...]:
        """Six lengths."""
        return tuple(f"leg {i + 1}, of the stroke" for i in LEGS)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Seen along y."""
        return (-1.0, 1.0), (-0.1, 1.4)

    def start(self, key: Array) -> tuple[jc.State, Any]:
        """The platform at home, the ball rolling: ω = n × v/r."""
        place, velocity = jax.random.split(key)
        x, y = spread(place, 0.15, (2,), self.dtype)
        u, w = spread(velocity, 0.2, (2,), self.dtype)
        layout, zero = self.system.layout, jnp.zeros((), self.dtype)
        q = self.home.at[layout.q("ball")[:2]].set(jnp.stack([x, y]))
        rolling = jnp.stack([u, w, zero, -w / self.radius, u / self.radius, zero])
        v = jnp.zeros(layout.n_v, self.dtype).at[layout.v("ball")].set(rolling)
        return jc.init(self.system, self.method, q, v), ()

    def control(self, episode: Episode, action: Array) -> Array:
        """The lengths that the servos are to follow [m]."""
        return self.stroke * action

    def ball(self, episode: Episode) -> tuple[Array, Array]:
        """Its place and velocity over the plate, in the frame of the plate, (2,) [m], [m/s]."""
        system, state = self.system, episode.state
        center, velocity = (f(system, state, "ball") for f in (jc.position, jc.velocity))
        origin, turn = (f(system, state, "platform") for f in (jc.position, jc.orientation))
        back = jc.quaternion.conjugate(turn)
        place = jc.quaternion.rotate(back, center - origin)
        spin = jc.angular_velocity(system, state, "platform")
        moved = jc.quaternion.rotate(back, velocity - jc.velocity(system, state, "platform"))
        return place[:2], (moved - jnp.cross(spin, place))[:2]

    def observation(self, episode: Episode) -> Array:
        """Ball, platform, legs."""
        given = self.system, episode.state
        up = jnp.asarray((0.0, 0.0, HEIGHT), self.dtype)
        platform = (
            jc.position(*given, "platform") - up,
            jc.quaternion.log(jc.orientation(*given, "platform")),
            jc.velocity(*given, "platform"),
            jc.angular_velocity(*given, "platform"),
        )
        legs = jnp.stack([jc.coordinate(*given, f"leg{i + 1}") for i in LEGS])
        return jnp.concatenate([*self.ball(episode), *platform, legs])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """For the ball in the middle and at rest, with little motion of the legs."""
        away, fast = (safe_sqrt(x @ x) for x in self.ball(after))
        effort = (4 + near(safe_sqrt(jnp.mean(action**2)), 1.0)) / 5
        return near(away, 0.1) * (1 + near(fast, 0.4)) / 2 * effort

    def terminal(self, episode: Episode) -> Array:
        """Returns True where the ball has left the plate."""
        place, _ = self.ball(episode)
        return place @ place > PLATE**2

    def marks(self, axes: Any, episode: Episode) -> None:
        """The ball as a disc."""
        from matplotlib.patches import Circle

        x, _, z = jc.position(self.system, episode.state, "ball")
        axes.add_patch(Circle((float(x), float(z)), float(self.radius), color="k"))


def add_leg(scene: jc.Scene, i: int, stiffness: Any, damping: Any) -> None:
    """A cylinder at a foot, a piston at a head, and the servo between them."""
    foot, head, name = FEET[i], HEADS[i], f"{i + 1}"
    along = (head - foot) / np.linalg.norm(head - foot)
    first = np.cross(along, [0.0, 0.0, 1.0])  # also the axis of the turn that takes z to the leg
    lean = np.arctan2(np.linalg.norm(first), along[2])
    turn = np.asarray(jc.quaternion.from_axis_angle(-first, lean))
    part = jc.inertia.cylinder(2.0, 0.03, 0.5)
    ends = (f"cylinder{name}", foot + 0.3 * along), (f"piston{name}", head - 0.3 * along)
    for body, middle in ends:
        scene.add_body(body, inertia=part, position=middle, quaternion=turn)
    (cylinder, _), (piston, _) = ends
    crossed = {"axis_a": first, "axis_b": np.cross(along, first)}
    scene.add(jc.Universal(f"foot{name}", jc.WORLD, cylinder, foot, **crossed))
    scene.add(jc.Prismatic(f"leg{name}", cylinder, piston, axis=along))
    scene.add(jc.Spherical(f"head{name}", piston, "platform", head))
    scene.add(jc.PositionServo(f"servo{name}", f"leg{name}", stiffness, damping))
