"""A trunk hops forward on one five-bar leg, whose two motors both sit on the trunk."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.numerics import safe_sqrt
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Channel, Environment, Episode, near

HIP, THIGH, SHANK, SOLE = 0.05, 0.2, 0.3, 0.02
"""From the middle of the trunk to a hip, of the bars, and of the ball at the foot [m]."""
DEPTH, LOW = 0.4, 0.2
"""How far the foot is below the hips at the start, and the height of hips that have fallen [m]."""
SIDES = (("left", -1.0), ("right", 1.0))
STOPS = (0.15, 1.75)
"""How far a thigh may be turned outwards from straight down [rad]."""
SWEEPS = 30
"""Over the rows of stops and contact in a step; an interior point waits for the slowest copy."""


@pytree
class FiveBarHopper(Environment):
    """Two thighs at the hips and two shanks that meet in the foot: a closed loop that hops.

    A mast on a carriage on a rail keeps the trunk from turning over, as those at which hopping legs
    are tried; it moves forward and up freely. The foot is a ball on the ground, with friction, and
    the hips have stops.

    Action: torques of the left and the right hip, −1 to 1 of the motors' largest, which is the gear
    of "left_motor" and "right_motor" [N m]. Observation: height of the trunk [m], its velocity
    forward and up (2,) [m/s], how far the left and the right thigh are turned outwards from
    straight down (2,) [rad] with rates (2,) [rad/s], place (2,) [m] and velocity (2,) [m/s] of the
    foot from the trunk, and the wanted speed [m/s].

    Reward, 0 to 1: near(v − v*, 0.3 m/s) · (2 − near(c, 0.02 m))/2 · (9 + near(action, 1))/10 with
    the speed v, the wanted speed v*, the foot's clearance c above the ground, and near(x, s) =
    1/(1 + (x/s)²), of the root of the mean square where there are several. An episode draws a speed
    of 0.4 to 0.8 m/s either way, and starts with the foot below the trunk, 0.02 to 0.1 m above the
    ground, all at rest; it is over when the trunk is lower than 0.2 m.

    References:
        Raibert, Legged Robots That Balance (1986), for the task.
    """

    @classmethod
    def build(
        cls,
        trunk: Any = 4.0,
        thigh: Any = 0.3,
        shank: Any = 0.2,
        carriage: Any = 0.2,
        torque: Any = 20.0,
        friction: Any = 0.8,
        *,
        dt: Any = 2e-3,
        skip: int = 5,
        horizon: int | None = 300,
        method: jc.Method | None = None,
        dtype: Any = None,
    ) -> FiveBarHopper:
        """The environment; its numbers may be traced.

        Args:
            trunk: its mass [kg].
            thigh: mass of each [kg].
            shank: mass of each [kg].
            carriage: mass of what moves along the rail with the trunk [kg].
            torque: the largest of each motor [N m].
            friction: of the foot on the ground.
            dt: h [s].
            skip: steps of h an action is held for.
            horizon: actions until an episode is truncated, or None.
            method: of the simulation; `Sparse()` with sweeps over stops and contact unless given,
                which leave 10 µm and 1 mrad of the hardest blows, where an interior point leaves
                nothing and takes twenty times as long.
            dtype: of every number.
        """
        scene = jc.Scene(dim=2, dtype=dtype)
        hips, foot = np.array([0.0, DEPTH + SOLE]), np.array([0.0, SOLE])
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
                way = end - start
                scene.add_body(
                    f"{side}_{name}",
                    mass=mass,
                    inertia=mass * float(way @ way) / 12,
                    position=(start + end) / 2,
                    angle=np.arctan2(way[1], way[0]),
                )
            scene.add(jc.Revolute(f"{side}_hip", "trunk", f"{side}_thigh", hip))
            scene.add(jc.Revolute(f"{side}_knee", f"{side}_thigh", f"{side}_shank", knee))
            scene.add(jc.Motor(f"{side}_motor", f"{side}_hip", gear=torque))
            turned = np.arctan2(knee[0] - hip[0], hip[1] - knee[1])
            ends = sorted(sign * np.array(STOPS) - turned)
            scene.add(jc.Limit(f"{side}_stops", f"{side}_hip", *ends))
        scene.add(jc.Revolute("ankle", "left_shank", "right_shank", foot))
        ball = {"radius": SOLE, "center": foot, "friction": friction}
        scene.add(jc.PlaneContact("ground", jc.WORLD, "left_shank", **ball))
        system, _ = scene.build()
        if method is None:
            method = jc.Method(solver=jc.Sparse(), bounded=jc.GaussSeidel(SWEEPS))
        return cls(system, method, jnp.asarray(dt, scene.dtype), skip, horizon)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """Trunk, thighs, foot, goal."""
        speeds = [Channel(f"velocity {way}", "m/s", -20.0, 20.0) for way in ("forward", "up")]
        turns = [Channel(f"{side} thigh", "rad", -3.2, 3.2) for side, _ in SIDES]
        rates = [Channel(f"rate of {side} thigh", "rad/s", -100.0, 100.0) for side, _ in SIDES]
        foot = [Channel(f"foot {way}", "m", -1.0, 1.0) for way in ("forward", "up")]
        moves = [Channel(f"foot's velocity {way}", "m/s", -20.0, 20.0) for way in ("forward", "up")]
        goal = Channel("wanted speed", "m/s", -2.0, 2.0)
        return Channel("height", "m", -1.0, 5.0), *speeds, *turns, *rates, *foot, *moves, goal

    @property
    def actions(self) -> tuple[str, ...]:
        """Two torques."""
        return tuple(f"{side} torque, of the motor's largest" for side, _ in SIDES)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Where it can come in an episode."""
        return (-3.0, 3.0), (-0.2, 1.2)

    def start(self, key: Array) -> tuple[jc.State, Array]:
        """Above the ground, at rest, with a speed to reach."""
        keys = jax.random.split(key, 3)
        drop = jax.random.uniform(keys[0], (), self.dtype, 0.02, 0.1)
        speed = jax.random.uniform(keys[1], (), self.dtype, 0.4, 0.8)
        way = jnp.where(jax.random.bernoulli(keys[2]), 1, -1).astype(self.dtype)
        zero = jnp.zeros_like(drop)
        trunk, foot = jnp.stack([zero, DEPTH + SOLE + drop]), jnp.stack([zero, zero - DEPTH])
        q = self.place(trunk, foot)
        return jc.init(self.system, self.method, q, jnp.zeros_like(q)), way * speed

    def place(self, trunk: Array, foot: Array) -> Array:
        """Positions (n_q,) with the trunk at (2,) and the foot at (2,) from there [m]."""
        layout, zero = self.system.layout, jnp.zeros((), self.dtype)
        q = jnp.zeros(layout.n_q, self.dtype)
        rail = jnp.asarray(DEPTH + SOLE, self.dtype)
        q = q.at[layout.q("carriage")].set(jnp.stack([trunk[0], rail, zero]))
        q = q.at[layout.q("trunk")].set(jnp.append(trunk, zero))
        for side, sign in SIDES:
            hip, knee = jnp.asarray([sign * HIP, 0.0], self.dtype), knee_of(sign, foot)
            for name, start, end in (("thigh", hip, knee), ("shank", knee, foot)):
                way = end - start
                pose = jnp.append(trunk + (start + end) / 2, jnp.arctan2(way[1], way[0]))
                q = q.at[layout.q(f"{side}_{name}")].set(pose)
        return q

    def foot(self, episode: Episode) -> tuple[Array, Array]:
        """Place (2,) [m] and velocity (2,) [m/s] of the middle of the ball at the foot."""
        given = self.system, episode.state, "left_shank", (SHANK / 2, 0.0)
        return jc.position(*given), jc.velocity(*given)

    def clearance(self, episode: Episode) -> Array:
        """Returns the height of the foot above the ground, () [m]."""
        return self.foot(episode)[0][1] - SOLE

    def observation(self, episode: Episode) -> Array:
        """Trunk, thighs, foot, goal."""
        given = self.system, episode.state
        trunk, speed = (f(*given, "trunk") for f in (jc.position, jc.velocity))
        place, velocity = self.foot(episode)
        turns = [s * (jc.orientation(*given, f"{n}_thigh") + jnp.pi / 2) for n, s in SIDES]
        rates = [s * jc.angular_velocity(*given, f"{n}_thigh") for n, s in SIDES]
        leg = jnp.stack([*turns, *rates])
        parts = trunk[1:], speed, leg, place - trunk, velocity - speed, episode.goal[None]
        return jnp.concatenate(parts)

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """For the wanted speed with the foot off the ground, with little torque."""
        speed = jc.velocity(self.system, after.state, "trunk")[0]
        hop = (2 - near(self.clearance(after), 0.02)) / 2
        effort = (9 + near(safe_sqrt(jnp.mean(action**2)), 1.0)) / 10
        return near(speed - after.goal, 0.3) * hop * effort

    def terminal(self, episode: Episode) -> Array:
        """Returns True where the trunk has fallen."""
        return jc.position(self.system, episode.state, "trunk")[1] < LOW

    def marks(self, axes: Any, episode: Episode) -> None:
        """The ground, the trunk, and the bars in full length."""
        given = self.system, episode.state
        axes.axhline(0.0, color="k", lw=1)
        axes.plot(*np.asarray(jc.position(*given, "trunk")), "s", color="C0", markersize=14)
        for side, _ in SIDES:
            for i, (name, length) in enumerate((("thigh", THIGH), ("shank", SHANK))):
                ends = np.array([[-length / 2, 0.0], [length / 2, 0.0]])
                points = [jc.position(*given, f"{side}_{name}", end) for end in ends]
                axes.plot(*np.asarray(points).T, color=f"C{i + 1}", lw=3)


def knee_of(sign: float, foot: Any) -> Array:
    """Where a knee is (2,) [m], bent outwards, with the foot at a place (2,); from the trunk."""
    hip = jnp.asarray([sign * HIP, 0.0], jnp.result_type(foot))
    way = foot - hip
    length = jnp.sqrt(way @ way)
    bent = jnp.arccos((THIGH**2 + length**2 - SHANK**2) / (2 * THIGH * length))
    turn = jnp.arctan2(way[1], way[0]) + sign * bent
    return hip + THIGH * jnp.stack([jnp.cos(turn), jnp.sin(turn)])
