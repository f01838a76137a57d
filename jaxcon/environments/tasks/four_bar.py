"""The crank of a four-bar linkage follows a rate that changes."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

import jaxcon as jc
from jaxcon.core import checks
from jaxcon.core.numerics import wrap
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.environments.environment import (
    Channel,
    Environment,
    Episode,
    angle_channels,
    near,
)
from jaxcon.scenes import CRANK_ROCKER, four_bar, four_bar_poses

PARTS = ("crank", "coupler", "rocker")


@pytree
class Reference:
    """A crank's angle over time, θ(t) = θ₀ + s t + a (1 − cos w t)/w, so that θ̇ = s + a sin w t.

    Attributes:
        angle: θ₀ [rad].
        speed: s [rad/s].
        swing: a [rad/s].
        pulse: w [rad/s].
    """

    angle: Array
    speed: Array
    swing: Array
    pulse: Array

    def at(self, t: Array) -> tuple[Array, Array]:
        """θ [rad] and θ̇ [rad/s]."""
        phase = self.pulse * t
        angle = self.angle + self.speed * t + self.swing * (1 - jnp.cos(phase)) / self.pulse
        return angle, self.speed + self.swing * jnp.sin(phase)


@pytree
class FourBarTracking(Environment):
    """A motor at the crank of a planar crank-rocker under gravity follows a reference of its angle.

    Action: torque, −1 to 1 of the motor's largest, which is the gear of the motor "drive" [N m].
    Observation: cosine, sine and rate [rad/s] of the crank and of the rocker, the error of the
    crank's angle wrapped to half a turn [rad], the wanted rate [rad/s], and the error of the rate.

    Reward, 0 to 1: near(e, 0.3 rad) · (1 + near(ė, 2 rad/s))/2 · (9 + near(action, 1))/10 with the
    errors e of the angle and ė of the rate, and near(x, s) = 1/(1 + (x/s)²).
    An episode draws a mean rate of 2 to 6 rad/s either way, a swing of it of up to 2 rad/s at 1 to
    4 rad/s, and a crank's angle anywhere, at rest, with the reference within 0.5 rad of it. It is
    never over before its time.

    Attributes:
        lengths: of ground, crank, coupler and rocker, (4,) [m].
    """

    at_once: ClassVar[int] = 512
    lengths: Array

    @classmethod
    def build(
        cls,
        lengths: Any = CRANK_ROCKER,
        masses: Any = (0.3, 0.9, 0.7),
        torque: Any = 15.0,
        *,
        dt: Any = 5e-3,
        skip: int = 4,
        horizon: int | None = 500,
        method: jc.Method | None = None,
        dtype: Any = None,
    ) -> FourBarTracking:
        """The environment; its numbers may be traced.

        Args:
            lengths: of ground, crank, coupler and rocker, (4,) [m]; a crank-rocker, whose crank
                turns over.
            masses: of crank, coupler and rocker, (3,) [kg].
            torque: the largest of the motor [N m].
            dt: h [s].
            skip: steps of h an action is held for.
            horizon: actions until an episode is truncated, or None.
            method: of the simulation.
            dtype: of every number.

        Raises:
            ValueError: other than four lengths or three masses.
        """
        dtype = checks.chosen_dtype(lengths, masses) if dtype is None else dtype
        lengths = checks.real("FourBarTracking", "lengths", lengths, dtype, (4,))
        masses = checks.real("FourBarTracking", "masses", masses, dtype, (3,))
        motor = jc.Motor("drive", "ground_crank", gear=torque)
        system, _ = four_bar(lengths, masses, rate=0.0, elements=(motor,))
        method = jc.Method(solver=jc.Sparse()) if method is None else method
        return cls(system, method, jnp.asarray(dt, lengths.dtype), skip, horizon, lengths)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """Crank, rocker, errors."""
        bars = (*angle_channels("crank", 60.0), *angle_channels("rocker", 60.0))
        off = Channel("error of the angle", "rad", -3.2, 3.2)
        wanted = Channel("wanted rate", "rad/s", -10.0, 10.0)
        return *bars, off, wanted, Channel("error of the rate", "rad/s", -60.0, 60.0)

    @property
    def actions(self) -> tuple[str, ...]:
        """One torque."""
        return ("torque, of the motor's largest",)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """All places of the stock linkage."""
        return (-0.6, 1.9), (-0.9, 1.0)

    def start(self, key: Array) -> tuple[jc.State, Reference]:
        """The crank anywhere, at rest, near its reference."""
        keys = jax.random.split(key, 6)
        low = jnp.asarray([-jnp.pi, -0.5, 2.0, 0.0, 1.0], self.dtype)
        high = jnp.asarray([jnp.pi, 0.5, 6.0, 2.0, 4.0], self.dtype)
        angle, off, speed, swing, pulse = jax.vmap(
            lambda k, a, b: jax.random.uniform(k, (), self.dtype, a, b)
        )(keys[:5], low, high)
        way = jnp.where(jax.random.bernoulli(keys[5]), 1, -1).astype(self.dtype)
        q = self.place(angle)
        state = jc.init(self.system, self.method, q, jnp.zeros_like(q))
        return state, Reference(angle + off, way * speed, way * swing, pulse)

    def place(self, angle: Array) -> Array:
        """Positions (n_q,) of the assembled linkage with the crank at an angle [rad]."""
        layout = self.system.layout
        poses = four_bar_poses(self.lengths, angle)
        q = jnp.zeros(layout.n_q, self.dtype)
        for name, pose in zip(PARTS, poses, strict=True):
            q = q.at[layout.q(name)].set(pose)
        return q

    def errors(self, episode: Episode) -> tuple[Array, Array]:
        """Wanted less actual angle, wrapped [rad], and rate [rad/s]."""
        angle, rate = episode.goal.at(episode.state.time)
        crank, spin = self.turn(episode, "crank")
        return wrap(angle - crank), rate - spin

    def turn(self, episode: Episode, name: str) -> tuple[Array, Array]:
        """Angle [rad] and rate [rad/s] of a bar."""
        given = self.system, episode.state, name
        return jc.orientation(*given), jc.angular_velocity(*given)

    def observation(self, episode: Episode) -> Array:
        """Crank, rocker, errors."""
        bars = []
        for name in ("crank", "rocker"):
            angle, rate = self.turn(episode, name)
            bars += [jnp.cos(angle), jnp.sin(angle), rate]
        off, slow = self.errors(episode)
        return jnp.stack([*bars, off, episode.goal.at(episode.state.time)[1], slow])

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """For being where and as fast as wanted, with little torque."""
        off, slow = self.errors(after)
        effort = (9 + near(action[0], 1.0)) / 10
        return near(off, 0.3) * (1 + near(slow, 2.0)) / 2 * effort

    def marks(self, axes: Any, episode: Episode) -> None:
        """Where the end of the crank should be."""
        angle, length = float(episode.goal.at(episode.state.time)[0]), float(self.lengths[1])
        axes.plot(length * jnp.cos(angle), length * jnp.sin(angle), "kx", markersize=10)
