"""A cat that falls on its back turns itself over, with no angular momentum to turn by."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.numerics import safe_sqrt
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Channel, Environment, Episode, near, spread

LENGTH, RADIUS, LEGS = 0.25, 0.07, 0.15
"""Sizes of each half of the cat, a cylinder, and of the legs [m]."""
SIDES = (("front", 1.0), ("rear", -1.0))


def spine(front: jc.Motion, rear: jc.Motion, t: Array, u: Array, params: Any) -> tuple:
    """The torque of the back on the rear half, and its opposite on the front one, (6,) each.

    In the frame of the front half its muscles give τ u about y and z, its elasticity −2 k s with
    s = n tan β/2 for the bend β about n: k β while that is small. Its damping −c (s·ω) s takes out
    what muscles that work in time with the bend bring in, so that no torques fold the back double,
    and leaves a bend that runs round the spine alone.
    """
    relative = turn_between(front.orientation, rear.orientation)
    bending = jc.quaternion.rotate(relative, rear.angular_velocity) - front.angular_velocity
    muscles = jnp.append(jnp.zeros((), u.dtype), params["torque"] * u)
    s = relative[1:] / relative[0]
    own = muscles - (2 * params["stiffness"] + params["damping"] * jnp.dot(s, bending)) * s
    torque = front.rotation @ own
    zero = jnp.zeros_like(torque)
    return jnp.concatenate([zero, -torque]), jnp.concatenate([zero, torque])


@pytree
class CatRighting(Environment):
    """Two halves on a joint that bends any way and does not twist, dropped feet up.

    Nothing but the back's own torques acts besides gravity, so that angular momentum stays zero:
    the cat turns over by bending, letting the bend run round the spine, and stretching again.

    Action: the torques of the back about the axes y (to the left) and z (out of the back) of the
    front half, −1 to 1 of the largest (`torque` among the parameters of "spine"). Observation: the
    upward direction in the frame of the front half (3,), the bend as the vector of the turn from
    the front half to the rear one along y and z (2,) [rad], the angular velocity of the front half
    in its frame (3,) [rad/s], that of the rear one relative to it along y and z (2,) [rad/s], and
    height [m] and velocity [m/s] of the centre of mass.

    Reward, 0 to 1: (1 + u)/2 · (1 + near(β, 0.8 rad))/2 · (4 + near(action, 1))/5 with the mean u
    over both halves of how far the back points up, −1 to 1, the bend β, and near(x, s) =
    1/(1 + (x/s)²), of the root of the mean square where there are several. An episode starts at
    rest, the back pointing down but for 0.3 rad of roll and 0.2 rad of pitch, any heading, and the
    spine bent by up to 0.1 rad about y and z; it is over when the centre of mass has come down to
    the length of the legs, 0.15 m, which takes 0.54 s from the stock height.

    Attributes:
        height: of the centre of mass at the start, () [m].

    References:
        Kane and Scher, A dynamical explanation of the falling cat phenomenon, Int. J. Solids
        Structures 5 (1969), for the joint without twist.
    """

    height: Array

    @classmethod
    def build(
        cls,
        mass: Any = 2.0,
        torque: Any = 8.0,
        stiffness: Any = 6.0,
        height: Any = 1.6,
        *,
        damping: Any = 0.2,
        dt: Any = 2e-3,
        skip: int = 5,
        horizon: int | None = 100,
        method: jc.Method | None = None,
        dtype: Any = None,
    ) -> CatRighting:
        """The environment; its numbers may be traced.

        Args:
            mass: of each half [kg].
            torque: the largest of the back about each axis [N m].
            stiffness: k of the back [N m/rad].
            height: of the centre of mass at the start [m].
            damping: c of the back, of its bend, none while it is straight [N m s/rad].
            dt: h [s].
            skip: steps of h an action is held for.
            horizon: actions until an episode is truncated, or None.
            method: of the simulation; RATTLE unless given, which keeps angular momentum to
                rounding.
            dtype: of every number.
        """
        scene = jc.Scene(dtype=dtype)
        along, across = RADIUS**2 / 2, (3 * RADIUS**2 + LENGTH**2) / 12
        moments = mass * jnp.asarray([along, across, across], scene.dtype)
        for name, side in SIDES:
            middle = (side * LENGTH / 2, 0.0, 0.0)
            scene.add_body(name, mass=mass, inertia=moments, position=middle)
        axis = (1.0, 0.0, 0.0)
        scene.add(jc.ConstantVelocity("waist", "front", "rear", np.zeros(3), axis))
        numbers = {"torque": torque, "stiffness": stiffness, "damping": damping}
        params = {name: jnp.asarray(x, scene.dtype) for name, x in numbers.items()}
        scene.add(jc.CustomForce("spine", ("front", "rear"), spine, params, controls=2))
        system, _ = scene.build()
        method = jc.Method(jc.RATTLE(), solver=jc.Sparse()) if method is None else method
        dt, height = (jnp.asarray(x, scene.dtype) for x in (dt, height))
        return cls(system, method, dt, skip, horizon, height)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """Front half, back, fall."""
        up = [Channel(f"upwards along {axis}", "1", -1.0, 1.0) for axis in "xyz"]
        bend = [Channel(f"bend about {axis}", "rad", -3.2, 3.2) for axis in "yz"]
        spin = [Channel(f"rate about {axis}", "rad/s", -100.0, 100.0) for axis in "xyz"]
        bending = [Channel(f"bending about {axis}", "rad/s", -200.0, 200.0) for axis in "yz"]
        fall = Channel("height", "m", -10.0, 10.0), Channel("velocity", "m/s", -20.0, 20.0)
        return *up, *bend, *spin, *bending, *fall

    @property
    def actions(self) -> tuple[str, ...]:
        """Two torques."""
        return "torque about y, of the largest", "torque about z, of the largest"

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The fall from its stock height."""
        return (-0.7, 0.7), (0.0, 1.9)

    def start(self, key: Array) -> tuple[jc.State, Any]:
        """Feet up, at rest."""
        size = jnp.asarray((0.3, 0.2, jnp.pi, 0.1, 0.1), self.dtype)
        roll, pitch, heading, *bend = spread(key, 1.0, (5,), self.dtype) * size
        zero = jnp.zeros_like(roll)
        turns = ((jnp.pi + roll, zero, zero), (zero, pitch, zero), (zero, zero, heading))
        roll, pitch, heading = (jc.quaternion.exp(jnp.stack(turn)) for turn in turns)
        front = jc.quaternion.multiply(heading, jc.quaternion.multiply(pitch, roll))
        q = self.place(front, jnp.stack(bend))
        still = jnp.zeros(self.system.layout.n_v, self.dtype)
        return jc.init(self.system, self.method, q, still), ()

    def place(self, front: Array, bend: Array) -> Array:
        """Positions (n_q,) at the height of the start.

        Args:
            front: orientation of the front half, (4,).
            bend: vector of the turn to the rear half along y and z, (2,) [rad].
        """
        zero = jnp.zeros((), self.dtype)
        rear = jc.quaternion.exp(jnp.append(zero, bend))
        turns = {"front": front, "rear": jc.quaternion.multiply(front, rear)}
        half = jnp.asarray((LENGTH / 2, 0.0, 0.0), self.dtype)
        arms = [side * jc.quaternion.rotate(turns[name], half) for name, side in SIDES]
        waist = jnp.stack([zero, zero, self.height]) - (arms[0] + arms[1]) / 2
        q = jnp.zeros(self.system.layout.n_q, self.dtype)
        for (name, _), arm in zip(SIDES, arms, strict=True):
            pose = jnp.concatenate([waist + arm, turns[name]])
            q = q.at[self.system.layout.q(name)].set(pose)
        return q

    def upright(self, episode: Episode) -> Array:
        """How far the backs of both halves point up, −1 to 1 in the mean, ()."""
        return jnp.mean(jnp.stack([self.upwards(episode, name)[2] for name, _ in SIDES]))

    def upwards(self, episode: Episode, name: str) -> Array:
        """The upward direction in the frame of a half, (3,)."""
        turn = jc.orientation(self.system, episode.state, name)
        up = jnp.asarray((0.0, 0.0, 1.0), self.dtype)
        return jc.quaternion.rotate(jc.quaternion.conjugate(turn), up)

    def bend(self, episode: Episode) -> tuple[Array, Array]:
        """The turn from front to rear, its vector (3,) [rad], and the relative rate (3,) [rad/s].

        Both in the frame of the front half.
        """
        given = self.system, episode.state
        front, rear = (jc.orientation(*given, name) for name, _ in SIDES)
        relative = turn_between(front, rear)
        spin, other = (jc.angular_velocity(*given, name) for name, _ in SIDES)
        return jc.quaternion.log(relative), jc.quaternion.rotate(relative, other) - spin

    def observation(self, episode: Episode) -> Array:
        """Front half, back, fall."""
        bend, bending = self.bend(episode)
        spin = jc.angular_velocity(self.system, episode.state, "front")
        fall = jnp.stack([x[2] for x in jc.center_of_mass(self.system, episode.state)])
        up = self.upwards(episode, "front")
        return jnp.concatenate([up, bend[1:], spin, bending[1:], fall])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """For feet that point down and a straight back, with little effort."""
        bend, _ = self.bend(after)
        straight = (1 + near(safe_sqrt(bend @ bend), 0.8)) / 2
        effort = (4 + near(safe_sqrt(jnp.mean(action**2)), 1.0)) / 5
        return (1 + self.upright(after)) / 2 * straight * effort

    def terminal(self, episode: Episode) -> Array:
        """Returns True where it has landed."""
        return jc.center_of_mass(self.system, episode.state)[0][2] < LEGS

    def marks(self, axes: Any, episode: Episode) -> None:
        """The ground, the halves in full length, and a leg of each."""
        axes.axhline(0.0, color="k", lw=1)
        for i, (name, side) in enumerate(SIDES):
            points = np.array([(-side, 0.0, 0.0), (side, 0.0, 0.0), (side * 0.8, 0.0, 0.0)])
            points = points * LENGTH / 2 - np.array([(0, 0, 0), (0, 0, 0), (0, 0, LEGS)])
            seen = [jc.position(self.system, episode.state, name, point) for point in points]
            x, _, z = np.asarray(seen).T
            axes.plot(x[:2], z[:2], color=f"C{i}", lw=8)
            axes.plot(x[1:], z[1:], color=f"C{i}", lw=2)


def turn_between(front: Array, rear: Array) -> Array:
    """The quaternion (4,) that turns the frame of the front half into that of the rear one."""
    return jc.quaternion.multiply(jc.quaternion.conjugate(front), rear)
