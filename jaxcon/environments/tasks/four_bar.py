"""A task in which the crank of a four-bar linkage tracks a reference of varying rate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp

import jaxcon as jc
from jaxcon.core import checks
from jaxcon.core.numerics import wrap
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
from jaxcon.scenes import CRANK_ROCKER, four_bar, four_bar_poses

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PARTS = ("crank", "coupler", "rocker")


@pytree
class CrankReference:
    """The reference angle of the crank, θ(t) = θ₀ + s t + a (1 − cos w t)/w.

    Its rate θ̇ = s + a sin w t oscillates about a mean.

    Attributes:
        angle: θ₀, the angle at t = 0 [rad].
        speed: s, the mean rate [rad/s].
        swing: a, the amplitude of the rate [rad/s].
        pulse: w, the angular frequency of the rate [rad/s].
    """

    angle: Array
    speed: Array
    swing: Array
    pulse: Array

    def at(self, t: Array) -> tuple[Array, Array]:
        """Returns the reference angle θ [rad] and rate θ̇ [rad/s] at a time t, () [s]."""
        phase = self.pulse * t
        angle = self.angle + self.speed * t + self.swing * (1 - jnp.cos(phase)) / self.pulse
        return angle, self.speed + self.swing * jnp.sin(phase)


@pytree
class FourBarTracking(Environment):
    """A motor drives the crank of a planar crank-rocker along a reference angle, under gravity.

    Action: the torque of the motor. ±1 is its largest torque, which is the gear of "drive" [N m].

    Observation: cosine, sine and rate [rad/s] of the crank and of the rocker. Then the error of the
    crank angle, wrapped to half a turn [rad], the reference rate and the error of the rate [rad/s].

    Reward, 0 to 1: near(e, 0.3 rad) · (1 + near(ė, 2 rad/s))/2 · (9 + near(action, 1))/10, with the
    errors e of the angle and ė of the rate, and near(x, s) = 1/(1 + (x/s)²).

    An episode draws a reference with a mean rate of 2 to 6 rad/s in either direction. The rate
    oscillates by up to 2 rad/s at 1 to 4 rad/s. The crank starts at rest at any angle, within 0.5
    rad of the reference. An episode never terminates.

    Attributes:
        lengths: the lengths of ground, crank, coupler and rocker, (4,) [m].
    """

    at_once: ClassVar[int] = 512
    lengths: Array

    @classmethod
    def build(
        cls,
        lengths: Array | Sequence[Number] = CRANK_ROCKER,
        masses: Array | Sequence[Number] = (0.3, 0.9, 0.7),
        torque: Number = 15.0,
        *,
        dt: Number = 5e-3,
        skip: int = 4,
        horizon: int | None = 500,
        method: jc.Method | None = None,
        dtype: DType | None = None,
    ) -> FourBarTracking:
        """Builds the environment. Its numeric options may be traced.

        Args:
            lengths: the lengths of ground, crank, coupler and rocker, (4,) [m]. They must form a
                crank-rocker, whose crank makes full turns.
            masses: the masses of crank, coupler and rocker, (3,) [kg].
            torque: the largest torque of the motor [N m].
            dt: the step size h [s].
            skip: the number of steps for which an action is held.
            horizon: the number of actions after which an episode is truncated; None for no limit.
            method: integrator, stabilizer and solvers; by default with `jc.solvers.Sparse()`.
            dtype: the floating dtype of the scene.

        Raises:
            ValueError: there are not four lengths and three masses.
        """
        dtype = checks.chosen_dtype(lengths, masses) if dtype is None else dtype
        lengths = checks.real("FourBarTracking", "lengths", lengths, dtype, (4,))
        masses = checks.real("FourBarTracking", "masses", masses, dtype, (3,))
        motor = jc.Motor("drive", "ground_crank", gear=torque)
        system, _ = four_bar(lengths, masses, rate=0.0, elements=(motor,))
        method = jc.Method(solver=jc.solvers.Sparse()) if method is None else method
        return cls(system, method, jnp.asarray(dt, lengths.dtype), skip, horizon, lengths)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The observation channels of crank, rocker and tracking errors."""
        bars = (*angle_channels("crank", 60.0), *angle_channels("rocker", 60.0))
        angle = Channel("error of the angle", "rad", -3.2, 3.2)
        rate = Channel("wanted rate", "rad/s", -10.0, 10.0)
        return *bars, angle, rate, Channel("error of the rate", "rad/s", -60.0, 60.0)

    @property
    def actions(self) -> tuple[str, ...]:
        """The component of an action: the torque of the motor."""
        return ("torque, of the motor's largest",)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The view of images, (left, right) and (bottom, top) [m].

        It shows all positions that the default linkage can reach.
        """
        return (-0.6, 1.9), (-0.9, 1.0)

    def start(self, key: Array) -> tuple[jc.State, CrankReference]:
        """Draws an initial state at rest, and a reference that starts near its crank angle."""
        keys = jax.random.split(key, 6)
        low = jnp.asarray([-jnp.pi, -0.5, 2.0, 0.0, 1.0], self.dtype)
        high = jnp.asarray([jnp.pi, 0.5, 6.0, 2.0, 4.0], self.dtype)
        angle, offset, speed, swing, pulse = jax.vmap(
            lambda k, a, b: jax.random.uniform(k, (), self.dtype, a, b)
        )(keys[:5], low, high)
        sign = jnp.where(jax.random.bernoulli(keys[5]), 1, -1).astype(self.dtype)
        q = self.place(angle)
        state = jc.init(self.system, self.method, q, jnp.zeros_like(q))
        return state, CrankReference(angle + offset, sign * speed, sign * swing, pulse)

    def place(self, angle: Array) -> Array:
        """Returns positions (n_q,) of the assembled linkage with the crank at an angle [rad]."""
        layout = self.system.layout
        poses = four_bar_poses(self.lengths, angle)
        q = jnp.zeros(layout.n_q, self.dtype)
        for name, pose in zip(PARTS, poses, strict=True):
            q = q.at[layout.q(name)].set(pose)
        return q

    def errors(self, episode: Episode) -> tuple[Array, Array]:
        """Returns the errors of crank angle, wrapped to half a turn [rad], and crank rate [rad/s].

        Errors are reference minus actual value.
        """
        angle, rate = episode.goal.at(episode.state.time)
        crank, spin = self.turn(episode, "crank")
        return wrap(angle - crank), rate - spin

    def turn(self, episode: Episode, name: str) -> tuple[Array, Array]:
        """Returns angle [rad] and angular velocity [rad/s] of a bar."""
        bar = self.system, episode.state, name
        return jc.orientation(*bar), jc.angular_velocity(*bar)

    def observation(self, episode: Episode) -> Array:
        """Returns the states of crank and rocker, and the tracking errors, as one vector."""
        bars = []
        for name in ("crank", "rocker"):
            angle, rate = self.turn(episode, name)
            bars += [jnp.cos(angle), jnp.sin(angle), rate]
        angle_error, rate_error = self.errors(episode)
        desired_rate = episode.goal.at(episode.state.time)[1]
        return jnp.stack([*bars, angle_error, desired_rate, rate_error])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Returns a reward that is high for a small tracking error with little torque."""
        angle_error, rate_error = self.errors(after)
        effort = (9 + near(action[0], 1.0)) / 10
        return near(angle_error, 0.3) * (1 + near(rate_error, 2.0)) / 2 * effort

    def marks(self, axes: Axes, episode: Episode) -> None:
        """Draws the reference position of the end of the crank."""
        angle, length = float(episode.goal.at(episode.state.time)[0]), float(self.lengths[1])
        axes.plot(length * jnp.cos(angle), length * jnp.sin(angle), "kx", markersize=10)
