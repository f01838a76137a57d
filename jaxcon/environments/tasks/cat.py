"""A task in which a falling cat turns over with zero angular momentum."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.numerics import safe_sqrt
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, DType
from jaxcon.environments.environment import Channel, Environment, Episode, Number, near, spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LENGTH, RADIUS, LEGS = 0.25, 0.07, 0.15
"""Length and radius of each half of the cat, a cylinder, and the length of the legs [m]."""
SIDES = (("front", 1.0), ("rear", -1.0))


def spine(
    front: jc.extend.Motion, rear: jc.extend.Motion, t: Array, u: Array, params: dict[str, Array]
) -> tuple[Array, Array]:
    """Returns the wrenches of the spine on the front and the rear half of the cat, (6,) each.

    The torque on the rear half is the sum of the three torques below, in the frame of the front
    half. The torque on the front half is its opposite.

    Muscles exert the torque τ u about y and z, with the largest torque τ and the control u. The
    elastic torque is −2 k s with stiffness k and s = n tan(β/2), for a bend β about the axis n. For
    small β its size is k β. The damping torque is −c (s·ω) s with the bending rate ω.

    Without damping, muscles that act in phase with the bend would fold the spine double. A bend of
    constant size that travels around the spine is not damped.
    """
    relative = turn_between(front.orientation, rear.orientation)
    bending = jc.quaternion.rotate(relative, rear.angular_velocity) - front.angular_velocity
    muscles = jnp.append(jnp.zeros((), u.dtype), params["torque"] * u)
    s = relative[1:] / relative[0]
    gain = 2 * params["stiffness"] + params["damping"] * jnp.dot(s, bending)
    torque = front.rotation @ (muscles - gain * s)
    zero = jnp.zeros_like(torque)
    return jnp.concatenate([zero, -torque]), jnp.concatenate([zero, torque])


@pytree
class CatRighting(Environment):
    """A cat of two halves is dropped feet up and must land on its feet.

    The joint between the halves bends in any direction but does not twist. Apart from gravity, only
    the torques of the spine act, so angular momentum stays zero. The cat turns over in three
    phases: it bends, lets the bend travel around the spine, and straightens.

    Action: the torques of the spine about y (left) and z (out of the back) of the front half. ±1 is
    the largest torque (`torque` among the parameters of "spine").

    Observation, in the frame of the front half unless noted: the world's upward direction (3,). The
    bend: the rotation vector from the front to the rear half, along y and z (2,) [rad]. The angular
    velocity of the front half (3,), and that of the rear half relative to it, along y and z (2,)
    [rad/s]. Height [m] and vertical velocity [m/s] of the center of mass.

    Reward, 0 to 1: (1 + u)/2 · (1 + near(β, 0.8 rad))/2 · (4 + near(action, 1))/5, with near(x, s)
    = 1/(1 + (x/s)²). Here u, −1 to 1, is the upward component of the back direction, averaged over
    both halves, and β is the bend. In near(action, 1), the action is the root mean square of its
    components.

    An episode starts at rest with the back down, within 0.3 rad of roll and 0.2 rad of pitch, with
    any heading. The spine is bent by up to 0.1 rad about y and z. The episode terminates when the
    center of mass is 0.15 m above the ground, the length of the legs. From the default height this
    takes 0.54 s.

    Attributes:
        height: the height of the center of mass at the start, () [m].

    References:
        Kane and Scher, A dynamical explanation of the falling cat phenomenon, Int. J. Solids
        Structures 5 (1969), for the joint without twist.
    """

    height: Array

    @classmethod
    def build(
        cls,
        mass: Number = 2.0,
        torque: Number = 8.0,
        stiffness: Number = 6.0,
        height: Number = 1.6,
        *,
        damping: Number = 0.2,
        dt: Number = 2e-3,
        skip: int = 5,
        horizon: int | None = 100,
        method: jc.Method | None = None,
        dtype: DType | None = None,
    ) -> CatRighting:
        """Builds the environment. Its numeric options may be traced.

        Args:
            mass: the mass of each half [kg].
            torque: the largest torque of the spine about each axis [N m].
            stiffness: the stiffness k of the spine [N m/rad].
            height: the height of the center of mass at the start [m].
            damping: the damping c of the spine, which has no effect while it is straight [N m
                s/rad].
            dt: the step size h [s].
            skip: the number of steps for which an action is held.
            horizon: the number of actions after which an episode is truncated; None for no limit.
            method: integrator, stabilizer and solvers; by default `jc.integrators.RATTLE()`, which
                conserves angular momentum to rounding.
            dtype: the floating dtype of the scene.
        """
        scene = jc.Scene(dtype=dtype)
        along, across = RADIUS**2 / 2, (3 * RADIUS**2 + LENGTH**2) / 12
        moments = mass * jnp.asarray([along, across, across], scene.dtype)
        for name, side in SIDES:
            middle = (side * LENGTH / 2, 0.0, 0.0)
            scene.add_body(name, mass=mass, inertia=moments, position=middle)
        axis = (1.0, 0.0, 0.0)
        scene.add(jc.joints.ConstantVelocity("waist", "front", "rear", np.zeros(3), axis))
        numbers = {"torque": torque, "stiffness": stiffness, "damping": damping}
        params = {name: jnp.asarray(x, scene.dtype) for name, x in numbers.items()}
        scene.add(jc.forces.CustomForce("spine", ("front", "rear"), spine, params, controls=2))
        system, _ = scene.build()
        method = (
            jc.Method(jc.integrators.RATTLE(), solver=jc.solvers.Sparse())
            if method is None
            else method
        )
        dt, height = (jnp.asarray(x, scene.dtype) for x in (dt, height))
        return cls(system, method, dt, skip, horizon, height)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The observation channels of the front half, the spine and the fall."""
        up = [Channel(f"upwards along {axis}", "1", -1.0, 1.0) for axis in "xyz"]
        bend = [Channel(f"bend about {axis}", "rad", -3.2, 3.2) for axis in "yz"]
        spin = [Channel(f"rate about {axis}", "rad/s", -100.0, 100.0) for axis in "xyz"]
        bending = [Channel(f"bending about {axis}", "rad/s", -200.0, 200.0) for axis in "yz"]
        fall = Channel("height", "m", -10.0, 10.0), Channel("velocity", "m/s", -20.0, 20.0)
        return *up, *bend, *spin, *bending, *fall

    @property
    def actions(self) -> tuple[str, ...]:
        """The components of an action: the two torques of the spine."""
        return "torque about y, of the largest", "torque about z, of the largest"

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The view of images, (left, right) and (bottom, top) [m].

        It shows the whole fall from the default height.
        """
        return (-0.7, 0.7), (0.0, 1.9)

    def start(self, key: Array) -> tuple[jc.State, tuple[()]]:
        """Draws a state with the feet up, at rest."""
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
        """Returns positions (n_q,) with the center of mass at the initial height.

        Args:
            front: the orientation of the front half, a quaternion (4,).
            bend: the rotation vector from the front to the rear half, along y and z, (2,) [rad].
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
        """Returns how far the backs point up, averaged over both halves, () in −1 to 1.

        For each half, this is the upward component of the direction out of its back.
        """
        return jnp.mean(jnp.stack([self.upwards(episode, name)[2] for name, _ in SIDES]))

    def upwards(self, episode: Episode, name: str) -> Array:
        """Returns the world's upward direction in the frame of a half, (3,)."""
        turn = jc.orientation(self.system, episode.state, name)
        up = jnp.asarray((0.0, 0.0, 1.0), self.dtype)
        return jc.quaternion.rotate(jc.quaternion.conjugate(turn), up)

    def bend(self, episode: Episode) -> tuple[Array, Array]:
        """Returns the bend of the spine and its rate, in the frame of the front half.

        Returns:
            The rotation vector from the front to the rear half, (3,) [rad], and the angular
            velocity of the rear half relative to the front half, (3,) [rad/s].
        """
        world = self.system, episode.state
        front, rear = (jc.orientation(*world, name) for name, _ in SIDES)
        relative = turn_between(front, rear)
        front_spin, rear_spin = (jc.angular_velocity(*world, name) for name, _ in SIDES)
        rate = jc.quaternion.rotate(relative, rear_spin) - front_spin
        return jc.quaternion.log(relative), rate

    def observation(self, episode: Episode) -> Array:
        """Returns the states of the front half, the spine and the fall as one vector."""
        bend, bending = self.bend(episode)
        spin = jc.angular_velocity(self.system, episode.state, "front")
        fall = jnp.stack([x[2] for x in jc.center_of_mass(self.system, episode.state)])
        up = self.upwards(episode, "front")
        return jnp.concatenate([up, bend[1:], spin, bending[1:], fall])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Returns a reward that is high for feet down, a straight back and little torque."""
        bend, _ = self.bend(after)
        straight = (1 + near(safe_sqrt(bend @ bend), 0.8)) / 2
        effort = (4 + near(safe_sqrt(jnp.mean(action**2)), 1.0)) / 5
        return (1 + self.upright(after)) / 2 * straight * effort

    def terminal(self, episode: Episode) -> Array:
        """Returns True if the cat has landed."""
        return jc.center_of_mass(self.system, episode.state)[0][2] < LEGS

    def marks(self, axes: Axes, episode: Episode) -> None:
        """Draws the ground, both halves at their full length, and one leg of each half."""
        axes.axhline(0.0, color="k", lw=1)
        for i, (name, side) in enumerate(SIDES):
            points = np.array([(-side, 0.0, 0.0), (side, 0.0, 0.0), (side * 0.8, 0.0, 0.0)])
            points = points * LENGTH / 2 - np.array([(0, 0, 0), (0, 0, 0), (0, 0, LEGS)])
            seen = [jc.position(self.system, episode.state, name, point) for point in points]
            x, _, z = np.asarray(seen).T
            axes.plot(x[:2], z[:2], color=f"C{i}", lw=8)
            axes.plot(x[1:], z[1:], color=f"C{i}", lw=2)


def turn_between(front: Array, rear: Array) -> Array:
    """Returns the rotation from the front half to the rear half, a quaternion (4,)."""
    return jc.quaternion.multiply(jc.quaternion.conjugate(front), rear)
