"""A task in which a Stewart platform balances a rolling ball on its plate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.numerics import safe_sqrt
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, DType
from jaxcon.environments.environment import Channel, Environment, Episode, Number, near, spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HEIGHT, PLATE, THICK = 1.0, 0.4, 0.02
"""The height of the platform at home, its radius, and the surface height above its center [m]."""
LEGS = range(6)


def ring(radius: float, apart: float) -> np.ndarray:
    """Returns three pairs of points on a circle, around directions 120° apart, (6, 3) [m].

    Args:
        radius: the radius of the circle [m].
        apart: the angle between a point and the direction of its pair [rad].
    """
    pair, side = np.arange(6) // 2, np.arange(6) % 2 * 2 - 1
    angle = pair * 2 * np.pi / 3 + side * apart
    return radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)


FEET = ring(0.8, 0.25)
HEADS = ring(PLATE, np.pi / 3 - 0.25) + np.array([0.0, 0.0, HEIGHT])


@pytree
class StewartBalancing(Environment):
    """Six servos change the lengths of the legs of a platform on which a ball rolls.

    The scene has fourteen bodies. Each leg is a cylinder on a universal joint, a piston that slides
    in it, and a ball joint under the platform. The legs form five independent loops. The ball rolls
    without slip and does not lose contact with the plate.

    Action: the extension of each leg relative to home, which a servo tracks. ±1 is `stroke` [m].

    Observation: position (2,) [m] and velocity (2,) [m/s] of the ball in the frame of the plate.
    For the platform: displacement from home (3,) [m], rotation vector (3,) [rad], velocity (3,)
    [m/s] and angular velocity (3,) [rad/s]. The extension of each leg relative to home, (6,) [m].

    Reward, 0 to 1: near(d, 0.1 m) · (1 + near(v, 0.4 m/s))/2 · (4 + near(action, 1))/5, with
    near(x, s) = 1/(1 + (x/s)²). Here d is the distance of the ball from the center of the plate,
    and v its speed relative to the plate. In near(action, 1), the action is the root mean square of
    its components.

    An episode starts with the platform at home and at rest. The ball is within 0.15 m of the center
    along x and y, and rolls at up to 0.2 m/s along each. The episode terminates when the ball is
    0.4 m from the center, at the edge of the plate.

    Attributes:
        stroke: the largest extension of a leg, longer or shorter [m].
        radius: the radius of the ball [m].
        home: the positions as assembled, with the ball at the center, (n_q,).
    """

    stroke: Array
    radius: Array
    home: Array

    @classmethod
    def build(
        cls,
        ball: Number = 0.2,
        radius: Number = 0.04,
        platform: Number = 20.0,
        stroke: Number = 0.1,
        stiffness: Number = 2e4,
        damping: Number = 1e3,
        *,
        dt: Number = 4e-3,
        skip: int = 5,
        horizon: int | None = 500,
        method: jc.Method | None = None,
        dtype: DType | None = None,
    ) -> StewartBalancing:
        """Builds the environment. Its numeric options may be traced.

        Args:
            ball: the mass of the ball [kg].
            radius: the radius of the ball [m].
            platform: the mass of the platform [kg].
            stroke: the largest extension of a leg, longer or shorter [m].
            stiffness: the stiffness of the servos [N/m].
            damping: the damping of the servos [N s/m].
            dt: the step size h [s].
            skip: the number of steps for which an action is held.
            horizon: the number of actions after which an episode is truncated; None for no limit.
            method: integrator, stabilizer and solvers; by default with `jc.solvers.Sparse()`.
            dtype: the floating dtype of the scene.
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
        scene.add(jc.joints.RollingSphere("rolling", "platform", "ball", radius))
        system, state = scene.build()
        method = jc.Method(solver=jc.solvers.Sparse()) if method is None else method
        dt, stroke, radius = (jnp.asarray(x, scene.dtype) for x in (dt, stroke, radius))
        return cls(system, method, dt, skip, horizon, stroke, radius, state.q)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The observation channels of ball, platform and legs."""
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
        """The components of an action: the extensions of the six legs."""
        return tuple(f"leg {i + 1}, of the stroke" for i in LEGS)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The view of images, (left, right) and (bottom, top) [m]: the platform, seen along y."""
        return (-1.0, 1.0), (-0.1, 1.4)

    def start(self, key: Array) -> tuple[jc.State, tuple[()]]:
        """Draws an initial state: the platform at home, with a ball that rolls on it.

        A ball with velocity v and radius r has the angular velocity ω = n × v/r. n is the normal of
        the plate.
        """
        place, velocity = jax.random.split(key)
        x, y = spread(place, 0.15, (2,), self.dtype)
        u, w = spread(velocity, 0.2, (2,), self.dtype)
        layout, zero = self.system.layout, jnp.zeros((), self.dtype)
        q = self.home.at[layout.q("ball")[:2]].set(jnp.stack([x, y]))
        rolling = jnp.stack([u, w, zero, -w / self.radius, u / self.radius, zero])
        v = jnp.zeros(layout.n_v, self.dtype).at[layout.v("ball")].set(rolling)
        return jc.init(self.system, self.method, q, v), ()

    def control(self, episode: Episode, action: Array) -> Array:
        """Returns the desired extensions of the legs, (6,) [m]."""
        return self.stroke * action

    def ball(self, episode: Episode) -> tuple[Array, Array]:
        """Returns position [m] and velocity [m/s] of the ball in the plate frame, (2,) each."""
        system, state = self.system, episode.state
        center, velocity = (f(system, state, "ball") for f in (jc.position, jc.velocity))
        origin, turn = (f(system, state, "platform") for f in (jc.position, jc.orientation))
        to_plate = jc.quaternion.conjugate(turn)
        place = jc.quaternion.rotate(to_plate, center - origin)
        spin = jc.angular_velocity(system, state, "platform")
        relative = velocity - jc.velocity(system, state, "platform")
        relative = jc.quaternion.rotate(to_plate, relative)
        return place[:2], (relative - jnp.cross(spin, place))[:2]

    def observation(self, episode: Episode) -> Array:
        """Returns the states of ball, platform and legs as one vector."""
        world = self.system, episode.state
        up = jnp.asarray((0.0, 0.0, HEIGHT), self.dtype)
        platform = (
            jc.position(*world, "platform") - up,
            jc.quaternion.log(jc.orientation(*world, "platform")),
            jc.velocity(*world, "platform"),
            jc.angular_velocity(*world, "platform"),
        )
        legs = jnp.stack([jc.coordinate(*world, f"leg{i + 1}") for i in LEGS])
        return jnp.concatenate([*self.ball(episode), *platform, legs])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Returns a reward for a ball at rest at the center, with little extension of the legs."""
        distance, speed = (safe_sqrt(x @ x) for x in self.ball(after))
        effort = (4 + near(safe_sqrt(jnp.mean(action**2)), 1.0)) / 5
        return near(distance, 0.1) * (1 + near(speed, 0.4)) / 2 * effort

    def terminal(self, episode: Episode) -> Array:
        """Returns True if the ball has left the plate."""
        place, _ = self.ball(episode)
        return place @ place > PLATE**2

    def marks(self, axes: Axes, episode: Episode) -> None:
        """Draws the ball as a disc."""
        from matplotlib.patches import Circle

        x, _, z = jc.position(self.system, episode.state, "ball")
        axes.add_patch(Circle((float(x), float(z)), float(self.radius), color="k"))


def add_leg(scene: jc.Scene, i: int, stiffness: Number, damping: Number) -> None:
    """Adds a leg to the scene: cylinder, piston, joints and servo."""
    foot, head, name = FEET[i], HEADS[i], f"{i + 1}"
    along = (head - foot) / np.linalg.norm(head - foot)
    first = np.cross(along, [0.0, 0.0, 1.0])  # −first is the rotation axis from z to the leg
    lean = np.arctan2(np.linalg.norm(first), along[2])
    turn = np.asarray(jc.quaternion.from_axis_angle(-first, lean))
    inertia = jc.inertia.cylinder(2.0, 0.03, 0.5)
    ends = (f"cylinder{name}", foot + 0.3 * along), (f"piston{name}", head - 0.3 * along)
    for body, middle in ends:
        scene.add_body(body, inertia=inertia, position=middle, quaternion=turn)
    (cylinder, _), (piston, _) = ends
    crossed = {"axis_a": first, "axis_b": np.cross(along, first)}
    scene.add(jc.joints.Universal(f"foot{name}", jc.WORLD, cylinder, foot, **crossed))
    scene.add(jc.Prismatic(f"leg{name}", cylinder, piston, axis=along))
    scene.add(jc.Spherical(f"head{name}", piston, "platform", head))
    scene.add(jc.forces.PositionServo(f"servo{name}", f"leg{name}", stiffness, damping))
