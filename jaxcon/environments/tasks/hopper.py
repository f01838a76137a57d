"""A task for a planar hopper with one five-bar leg, whose two motors sit on the trunk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.numerics import safe_sqrt
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, DType
from jaxcon.environments.environment import Channel, Environment, Episode, Number, near

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HIP, THIGH, SHANK, SOLE = 0.05, 0.2, 0.3, 0.02
"""Half the distance between the hips, the lengths of the bars, and the radius of the foot [m]."""
DEPTH, LOW = 0.4, 0.2
"""The initial hip-to-foot distance, and the trunk height below which an episode terminates [m]."""
SIDES = (("left", -1.0), ("right", 1.0))
STOPS = (0.15, 1.75)
"""The joint limits of a thigh: its least and largest outward angle from straight down [rad]."""
SWEEPS = 30
"""Gauss–Seidel sweeps over the joint limits and the contact in a step."""


@pytree
class FiveBarHopper(Environment):
    """A hopper must move at a desired velocity on a leg that is a closed loop.

    The leg has two thighs at the hips, and two shanks that meet in the foot. The trunk moves freely
    forward and up, but does not rotate: it slides on a mast, whose carriage slides on a rail. The
    foot is a ball with friction on the ground. The hips have joint limits.

    Action: the torques of the left and the right hip. ±1 is the largest torque, which is the gear
    of "left_motor" and "right_motor" [N m].

    Observation: height [m] and velocity, forward and up (2,) [m/s], of the trunk. Outward angles of
    the left and the right thigh from straight down (2,) [rad], and their rates (2,) [rad/s].
    Position (2,) [m] and velocity (2,) [m/s] of the foot relative to the trunk. The desired
    velocity [m/s].

    Reward, 0 to 1: near(v − v*, 0.3 m/s) · (2 − near(c, 0.02 m))/2 · (9 + near(action, 1))/10, with
    near(x, s) = 1/(1 + (x/s)²). Here v is the velocity, v* the desired velocity, and c the
    clearance of the foot above the ground. In near(action, 1), the action is the root mean square
    of its components.

    An episode draws a desired velocity of 0.4 to 0.8 m/s in either direction. It starts at rest
    with the foot below the trunk and 0.02 to 0.1 m above the ground. It terminates when the trunk
    is lower than 0.2 m.

    References:
        Raibert, Legged Robots That Balance (1986), for the task.
    """

    @classmethod
    def build(
        cls,
        trunk: Number = 4.0,
        thigh: Number = 0.3,
        shank: Number = 0.2,
        carriage: Number = 0.2,
        torque: Number = 20.0,
        friction: Number = 0.8,
        *,
        dt: Number = 2e-3,
        skip: int = 5,
        horizon: int | None = 300,
        method: jc.Method | None = None,
        dtype: DType | None = None,
    ) -> FiveBarHopper:
        """Builds the environment. Its numeric options may be traced.

        Args:
            trunk: the mass of the trunk [kg].
            thigh: the mass of each thigh [kg].
            shank: the mass of each shank [kg].
            carriage: the mass of the carriage of the mast [kg].
            torque: the largest torque of each motor [N m].
            friction: the friction coefficient of the foot on the ground.
            dt: the step size h [s].
            skip: the number of steps for which an action is held.
            horizon: the number of actions after which an episode is truncated; None for no limit.
            method: integrator, stabilizer and solvers; by default `jc.solvers.Sparse()`, with
                `jc.solvers.GaussSeidel` for limits and contact. After the hardest impacts, its
                sweeps leave errors of 10 µm and 1 mrad. An interior-point method leaves none, and
                takes twenty times as long.
            dtype: the floating dtype of the scene.
        """
        scene = jc.Scene(dim=2, dtype=dtype)
        hips, foot = np.array([0.0, DEPTH + SOLE]), np.array([0.0, SOLE])
        # carriage and trunk do not rotate, so their inertia has no effect
        scene.add_body("carriage", mass=carriage, inertia=1.0, position=hips)
        scene.add_body("trunk", mass=trunk, inertia=1.0, position=hips)
        scene.add(jc.Prismatic("rail", jc.WORLD, "carriage", axis=(1.0, 0.0)))
        scene.add(jc.Prismatic("mast", "carriage", "trunk", axis=(0.0, 1.0)))
        for side, sign in SIDES:
            hip = hips + np.array([sign * HIP, 0.0])
            knee = hips + np.asarray(knee_of(sign, foot - hips))
            for name, mass, start, end in (
                ("thigh", thigh, hip, knee),
                ("shank", shank, knee, foot),
            ):
                bar = end - start
                scene.add_body(
                    f"{side}_{name}",
                    mass=mass,
                    inertia=mass * float(bar @ bar) / 12,
                    position=(start + end) / 2,
                    angle=np.arctan2(bar[1], bar[0]),
                )
            scene.add(jc.Revolute(f"{side}_hip", "trunk", f"{side}_thigh", hip))
            scene.add(jc.Revolute(f"{side}_knee", f"{side}_thigh", f"{side}_shank", knee))
            scene.add(jc.Motor(f"{side}_motor", f"{side}_hip", gear=torque))
            start_angle = np.arctan2(knee[0] - hip[0], hip[1] - knee[1])
            limits = sorted(sign * np.array(STOPS) - start_angle)
            scene.add(jc.Limit(f"{side}_stops", f"{side}_hip", *limits))
        scene.add(jc.Revolute("ankle", "left_shank", "right_shank", foot))
        ball = {"radius": SOLE, "center": foot, "friction": friction}
        scene.add(jc.PlaneContact("ground", jc.WORLD, "left_shank", **ball))
        system, _ = scene.build()
        # in a batch, an interior-point method waits for its slowest copy; sweeps do not
        if method is None:
            method = jc.Method(
                solver=jc.solvers.Sparse(), contact_solver=jc.solvers.GaussSeidel(SWEEPS)
            )
        return cls(system, method, jnp.asarray(dt, scene.dtype), skip, horizon)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The observation channels of trunk, thighs, foot and goal."""
        speeds = [Channel(f"velocity {way}", "m/s", -20.0, 20.0) for way in ("forward", "up")]
        turns = [Channel(f"{side} thigh", "rad", -3.2, 3.2) for side, _ in SIDES]
        rates = [Channel(f"rate of {side} thigh", "rad/s", -100.0, 100.0) for side, _ in SIDES]
        foot = [Channel(f"foot {way}", "m", -1.0, 1.0) for way in ("forward", "up")]
        moves = [Channel(f"foot's velocity {way}", "m/s", -20.0, 20.0) for way in ("forward", "up")]
        goal = Channel("wanted speed", "m/s", -2.0, 2.0)
        return Channel("height", "m", -1.0, 5.0), *speeds, *turns, *rates, *foot, *moves, goal

    @property
    def actions(self) -> tuple[str, ...]:
        """The components of an action: the two hip torques."""
        return tuple(f"{side} torque, of the motor's largest" for side, _ in SIDES)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The view of images, (left, right) and (bottom, top) [m].

        It shows all places that the hopper can reach in an episode.
        """
        return (-3.0, 3.0), (-0.2, 1.2)

    def start(self, key: Array) -> tuple[jc.State, Array]:
        """Draws an initial state, at rest above the ground, and a desired velocity."""
        keys = jax.random.split(key, 3)
        drop = jax.random.uniform(keys[0], (), self.dtype, 0.02, 0.1)
        speed = jax.random.uniform(keys[1], (), self.dtype, 0.4, 0.8)
        sign = jnp.where(jax.random.bernoulli(keys[2]), 1, -1).astype(self.dtype)
        zero = jnp.zeros_like(drop)
        trunk, foot = jnp.stack([zero, DEPTH + SOLE + drop]), jnp.stack([zero, zero - DEPTH])
        q = self.place(trunk, foot)
        return jc.init(self.system, self.method, q, jnp.zeros_like(q)), sign * speed

    def place(self, trunk: Array, foot: Array) -> Array:
        """Returns the positions (n_q,) of all bodies.

        Args:
            trunk: the position of the trunk, (2,) [m].
            foot: the position of the foot relative to the trunk, (2,) [m].
        """
        layout, zero = self.system.layout, jnp.zeros((), self.dtype)
        q = jnp.zeros(layout.n_q, self.dtype)
        rail = jnp.asarray(DEPTH + SOLE, self.dtype)
        q = q.at[layout.q("carriage")].set(jnp.stack([trunk[0], rail, zero]))
        q = q.at[layout.q("trunk")].set(jnp.append(trunk, zero))
        for side, sign in SIDES:
            hip, knee = jnp.asarray([sign * HIP, 0.0], self.dtype), knee_of(sign, foot)
            for name, start, end in (("thigh", hip, knee), ("shank", knee, foot)):
                bar = end - start
                pose = jnp.append(trunk + (start + end) / 2, jnp.arctan2(bar[1], bar[0]))
                q = q.at[layout.q(f"{side}_{name}")].set(pose)
        return q

    def foot(self, episode: Episode) -> tuple[Array, Array]:
        """Returns position (2,) [m] and velocity (2,) [m/s] of the ball at the foot."""
        point = self.system, episode.state, "left_shank", (SHANK / 2, 0.0)
        return jc.position(*point), jc.velocity(*point)

    def clearance(self, episode: Episode) -> Array:
        """Returns the clearance of the foot above the ground, () [m]."""
        return self.foot(episode)[0][1] - SOLE

    def observation(self, episode: Episode) -> Array:
        """Returns the states of trunk, thighs and foot, and the goal, as one vector."""
        world = self.system, episode.state
        trunk, speed = (f(*world, "trunk") for f in (jc.position, jc.velocity))
        place, velocity = self.foot(episode)
        turns = [s * (jc.orientation(*world, f"{n}_thigh") + jnp.pi / 2) for n, s in SIDES]
        rates = [s * jc.angular_velocity(*world, f"{n}_thigh") for n, s in SIDES]
        leg = jnp.stack([*turns, *rates])
        parts = trunk[1:], speed, leg, place - trunk, velocity - speed, episode.goal[None]
        return jnp.concatenate(parts)

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Returns a reward for the desired velocity with the foot raised and little torque."""
        speed = jc.velocity(self.system, after.state, "trunk")[0]
        hop = (2 - near(self.clearance(after), 0.02)) / 2
        effort = (9 + near(safe_sqrt(jnp.mean(action**2)), 1.0)) / 10
        return near(speed - after.goal, 0.3) * hop * effort

    def terminal(self, episode: Episode) -> Array:
        """Returns True if the trunk is lower than 0.2 m."""
        return jc.position(self.system, episode.state, "trunk")[1] < LOW

    def marks(self, axes: Axes, episode: Episode) -> None:
        """Draws the ground, the trunk, and the bars at their full length."""
        world = self.system, episode.state
        axes.axhline(0.0, color="k", lw=1)
        axes.plot(*np.asarray(jc.position(*world, "trunk")), "s", color="C0", markersize=14)
        for side, _ in SIDES:
            for i, (name, length) in enumerate((("thigh", THIGH), ("shank", SHANK))):
                ends = np.array([[-length / 2, 0.0], [length / 2, 0.0]])
                points = [jc.position(*world, f"{side}_{name}", end) for end in ends]
                axes.plot(*np.asarray(points).T, color=f"C{i + 1}", lw=3)


def knee_of(sign: float, foot: Array | np.ndarray) -> Array:
    """Returns the position (2,) [m] of an outward-bent knee relative to the trunk.

    Args:
        sign: −1 for the left side, 1 for the right.
        foot: the position of the foot relative to the trunk, (2,) [m].
    """
    hip = jnp.asarray([sign * HIP, 0.0], jnp.result_type(foot))
    leg = foot - hip
    length = jnp.sqrt(leg @ leg)
    # law of cosines in the triangle of hip, knee and foot
    hip_angle = jnp.arccos((THIGH**2 + length**2 - SHANK**2) / (2 * THIGH * length))
    angle = jnp.arctan2(leg[1], leg[0]) + sign * hip_angle
    return hip + THIGH * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
