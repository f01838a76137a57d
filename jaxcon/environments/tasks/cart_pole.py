"""A cart swings one pole, or two on top of each other, up and keeps them up."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.environments.environment import (
    Channel,
    Environment,
    Episode,
    angle_channels,
    near,
    spread,
)

TRACK = 3.0
"""How far the cart may be from the middle [m]."""


@pytree
class CartPole(Environment):
    """A motor on a rail moves a cart; its poles begin hanging and are to stand.

    Action: the push of the motor, −1 to 1 of its largest force, which is the gear of the motor
    "push" [N]. Observation: place of the cart [m], its velocity [m/s], and for each pole from the
    cart outwards the cosine and sine of its angle from upright and its rate [rad/s].

    Reward, 0 to 1: u · (1 + near(x, 1 m))/2 · (1 + near(θ̇, 5 rad/s))/2 · (4 + near(action, 1))/5,
    where u is 0 with the tip at its lowest and 1 at its highest, and near(x, s) = 1/(1 + (x/s)²).
    An episode starts with all poles hanging within 0.1 rad, the cart within 0.1 m of the middle and
    everything within 0.05 of rest; it is over when the cart is 3 m from the middle.

    Attributes:
        lengths: of the poles, (n,) [m].

    References:
        Tassa et al., DeepMind Control Suite (2018), cart-pole swing-up, for the form of the reward.
    """

    at_once: ClassVar[int] = 512
    lengths: Array

    @classmethod
    def build(
        cls,
        lengths: Any = (0.6,),
        masses: Any = (0.3,),
        cart: Any = 1.0,
        force: Any = 20.0,
        *,
        dt: Any = 0.01,
        skip: int = 2,
        horizon: int | None = 500,
        method: jc.Method | None = None,
        dtype: Any = None,
    ) -> CartPole:
        """The environment; its numbers may be traced.

        Args:
            lengths: of the poles from the cart outwards, (n,) [m].
            masses: of the poles, (n,) [kg].
            cart: its mass [kg].
            force: the largest of the motor [N].
            dt: h [s].
            skip: steps of h an action is held for.
            horizon: actions until an episode is truncated, or None.
            method: of the simulation.
            dtype: of every number.

        Raises:
            ValueError: other than one length and one mass for each of at least one pole.
        """
        scene = jc.Scene(dim=2, dtype=dtype)
        lengths, masses = (jnp.asarray(x, scene.dtype) for x in (lengths, masses))
        if lengths.shape != masses.shape or lengths.ndim != 1 or not lengths.size:
            raise ValueError(
                "CartPole: lengths and masses must be as many, one for each pole, got shapes"
                f" {lengths.shape} and {masses.shape}."
            )
        scene.add_body("cart", mass=cart, inertia=1.0)
        scene.add(jc.Prismatic("rail", jc.WORLD, "cart", axis=(1.0, 0.0)))
        scene.add(jc.Motor("push", "rail", gear=force))
        below, foot = "cart", jnp.zeros((), scene.dtype)
        for i, name in enumerate(pole_names(len(lengths))):
            length, mass = lengths[i], masses[i]
            middle = jnp.stack([0 * foot, foot + length / 2])
            scene.add_body(name, mass=mass, inertia=mass * length**2 / 12, position=middle)
            point = jnp.stack([0 * foot, foot])
            scene.add(jc.Revolute(f"pivot{i + 1}", below, name, point=point))
            below, foot = name, foot + length
        system, _ = scene.build()
        method = jc.Method(solver=jc.Sparse()) if method is None else method
        return cls(system, method, jnp.asarray(dt, scene.dtype), skip, horizon, lengths)

    @property
    def poles(self) -> list[str]:
        """Their names, from the cart outwards."""
        return pole_names(len(self.lengths))

    @property
    def observed(self) -> tuple[Channel, ...]:
        """Cart, then pole by pole."""
        cart = Channel("cart", "m", -2 * TRACK, 2 * TRACK), Channel("speed", "m/s", -50.0, 50.0)
        return *cart, *(channel for name in self.poles for channel in angle_channels(name, 100.0))

    @property
    def actions(self) -> tuple[str, ...]:
        """One push."""
        return ("push, of the motor's largest force",)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The track."""
        reach = 1.1 * float(np.sum(self.lengths))
        return (-TRACK, TRACK), (-max(reach, 1.2), max(reach, 1.2))

    def start(self, key: Array) -> tuple[jc.State, Any]:
        """Hanging, all but still."""
        n = len(self.lengths)
        x, rates = spread(key, 1.0, (2, 1 + n), self.dtype)
        hanging = jnp.array([0.0, *n * [jnp.pi]], self.dtype)
        q, v = jax.jvp(self.place, (hanging + 0.1 * x,), (0.05 * rates,))
        return jc.init(self.system, self.method, q, v), ()

    def place(self, x: Array) -> Array:
        """Positions (n_q,) with the cart at x[0] [m] and the poles at angles x[1:] [rad]."""
        layout, zero = self.system.layout, jnp.zeros((), self.dtype)
        q = jnp.zeros(layout.n_q, self.dtype).at[layout.q("cart")[0]].set(x[0])
        foot = jnp.stack([x[0], zero])
        for name, length, angle in zip(self.poles, self.lengths, x[1:], strict=True):
            along = length * jnp.stack([-jnp.sin(angle), jnp.cos(angle)])
            q = q.at[layout.q(name)].set(jnp.append(foot + along / 2, angle))
            foot = foot + along
        return q

    def angles(self, episode: Episode) -> tuple[Array, Array]:
        """Returns the angles of the poles from upright, and their rates, (n,) [rad], [rad/s]."""
        given = self.system, episode.state
        angles = jnp.stack([jc.orientation(*given, name) for name in self.poles])
        return angles, jnp.stack([jc.angular_velocity(*given, name) for name in self.poles])

    def cart(self, episode: Episode) -> tuple[Array, Array]:
        """Its place [m] and velocity [m/s]."""
        state = episode.state
        x, v = (f(self.system, state, "cart")[0] for f in (jc.position, jc.velocity))
        return x, v

    def observation(self, episode: Episode) -> Array:
        """Cart, then pole by pole."""
        angles, rates = self.angles(episode)
        poles = jnp.stack([jnp.cos(angles), jnp.sin(angles), rates], axis=1)
        return jnp.append(jnp.stack(self.cart(episode)), poles.ravel())

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """The height of the tip, times what keeps the cart in the middle and all calm."""
        angles, rates = self.angles(after)
        height = jnp.sum(self.lengths * jnp.cos(angles)) / jnp.sum(self.lengths)
        middle = (1 + near(self.cart(after)[0], 1.0)) / 2
        calm = (1 + near(jnp.sqrt(jnp.mean(rates**2)), 5.0)) / 2
        return (1 + height) / 2 * middle * calm * (4 + near(action[0], 1.0)) / 5

    def marks(self, axes: Any, episode: Episode) -> None:
        """The track, the cart, and the poles in full length."""
        x = float(self.cart(episode)[0])
        foot = np.array([x, 0.0])
        axes.plot((-TRACK, TRACK), (0.0, 0.0), "k", lw=1)
        axes.plot((x - 0.2, x + 0.2), (0.0, 0.0), color="C0", lw=12, solid_capstyle="butt")
        for i, angle in enumerate(np.asarray(self.angles(episode)[0])):
            tip = foot + float(self.lengths[i]) * np.array([-np.sin(angle), np.cos(angle)])
            axes.plot(*np.stack([foot, tip], axis=1), color=f"C{i + 1}", lw=4)
            foot = tip

    def terminal(self, episode: Episode) -> Array:
        """Returns True where the cart has come to the end of the track."""
        return jnp.abs(self.cart(episode)[0]) > TRACK


def double_cart_pole(
    lengths: Any = (0.6, 0.6),
    masses: Any = (0.3, 0.3),
    *,
    dt: Any = 5e-3,
    horizon: int | None = 1000,
    **options: Any,
) -> CartPole:
    """`CartPole.build` with two poles on top of each other, and 10 ms an action."""
    return CartPole.build(lengths, masses, dt=dt, horizon=horizon, **options)


def pole_names(count: int) -> list[str]:
    """From the cart outwards."""
    return [f"pole{i + 1}" for i in range(count)]
