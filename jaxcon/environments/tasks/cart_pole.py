"""Cart-pole swing-up with one pole, or with two poles in series."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, DType
from jaxcon.environments.environment import (
    Channel,
    Environment,
    Episode,
    Number,
    angle_channels,
    near,
    spread,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TRACK = 3.0
"""The largest distance of the cart from the middle of the track [m]."""


@pytree
class CartPole(Environment):
    """A motor moves a cart along a rail to swing its hanging poles up and balance them.

    Action: the force of the motor. ±1 is its largest force, which is the gear of "push" [N].

    Observation: position [m] and velocity [m/s] of the cart. Then, for each pole from the cart
    outwards, cosine and sine of its angle from upright, and its angular velocity [rad/s].

    Reward, 0 to 1: u · (1 + near(d, 1 m))/2 · (1 + near(ω, 5 rad/s))/2 · (4 + near(action, 1))/5,
    with near(x, s) = 1/(1 + (x/s)²). The height u of the tip is 0 at its lowest point and 1 at its
    highest. d is the distance of the cart from the middle of the track. ω is the root mean square
    of the angular velocities of the poles.

    An episode starts with all poles hanging within 0.1 rad and the cart within 0.1 m of the middle.
    Initial velocities are within 0.05 of zero. The episode terminates when the cart is 3 m from the
    middle.

    Attributes:
        lengths: the lengths of the poles, (n,) [m].

    References:
        Tassa et al., DeepMind Control Suite (2018), cart-pole swing-up, for the form of the reward.
    """

    at_once: ClassVar[int] = 512
    lengths: Array

    @classmethod
    def build(
        cls,
        lengths: Array | Sequence[Number] = (0.6,),
        masses: Array | Sequence[Number] = (0.3,),
        cart: Number = 1.0,
        force: Number = 20.0,
        *,
        dt: Number = 0.01,
        skip: int = 2,
        horizon: int | None = 500,
        method: jc.Method | None = None,
        dtype: DType | None = None,
    ) -> CartPole:
        """Builds the environment. Its numeric options may be traced.

        Args:
            lengths: the lengths of the poles from the cart outwards, (n,) [m].
            masses: the masses of the poles, (n,) [kg].
            cart: the mass of the cart [kg].
            force: the largest force of the motor [N].
            dt: the step size h [s].
            skip: the number of steps for which an action is held.
            horizon: the number of actions after which an episode is truncated; None for no limit.
            method: integrator, stabilizer and solvers; by default with `jc.solvers.Sparse()`.
            dtype: the floating dtype of the scene.

        Raises:
            ValueError: there is no pole, or `lengths` and `masses` differ in shape.
        """
        scene = jc.Scene(dim=2, dtype=dtype)
        lengths, masses = (jnp.asarray(x, scene.dtype) for x in (lengths, masses))
        if lengths.shape != masses.shape or lengths.ndim != 1 or not lengths.size:
            raise ValueError(
                "CartPole: lengths and masses must be as many, one for each pole, got shapes"
                f" {lengths.shape} and {masses.shape}."
            )
        scene.add_body("cart", mass=cart, inertia=1.0)  # does not rotate: any inertia will do
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
        method = jc.Method(solver=jc.solvers.Sparse()) if method is None else method
        return cls(system, method, jnp.asarray(dt, scene.dtype), skip, horizon, lengths)

    @property
    def poles(self) -> list[str]:
        """The names of the poles, from the cart outwards."""
        return pole_names(len(self.lengths))

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The observation channels of the cart, then of each pole."""
        cart = Channel("cart", "m", -2 * TRACK, 2 * TRACK), Channel("speed", "m/s", -50.0, 50.0)
        return *cart, *(channel for name in self.poles for channel in angle_channels(name, 100.0))

    @property
    def actions(self) -> tuple[str, ...]:
        """The component of an action: the force of the motor."""
        return ("push, of the motor's largest force",)

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The view of images, (left, right) and (bottom, top) [m]: the whole track."""
        reach = 1.1 * float(np.sum(self.lengths))
        return (-TRACK, TRACK), (-max(reach, 1.2), max(reach, 1.2))

    def start(self, key: Array) -> tuple[jc.State, tuple[()]]:
        """Draws a state with hanging poles, nearly at rest."""
        n = len(self.lengths)
        x, rates = spread(key, 1.0, (2, 1 + n), self.dtype)
        hanging = jnp.array([0.0, *n * [jnp.pi]], self.dtype)
        q, v = jax.jvp(self.place, (hanging + 0.1 * x,), (0.05 * rates,))
        return jc.init(self.system, self.method, q, v), ()

    def place(self, x: Array) -> Array:
        """Returns positions (n_q,) for a cart at x[0] [m] and poles at angles x[1:] [rad]."""
        layout, zero = self.system.layout, jnp.zeros((), self.dtype)
        q = jnp.zeros(layout.n_q, self.dtype).at[layout.q("cart")[0]].set(x[0])
        foot = jnp.stack([x[0], zero])
        for name, length, angle in zip(self.poles, self.lengths, x[1:], strict=True):
            along = length * jnp.stack([-jnp.sin(angle), jnp.cos(angle)])
            q = q.at[layout.q(name)].set(jnp.append(foot + along / 2, angle))
            foot = foot + along
        return q

    def angles(self, episode: Episode) -> tuple[Array, Array]:
        """Returns angles from upright [rad] and angular velocities [rad/s] of poles, (n,) each."""
        world = self.system, episode.state
        angles = jnp.stack([jc.orientation(*world, name) for name in self.poles])
        return angles, jnp.stack([jc.angular_velocity(*world, name) for name in self.poles])

    def cart(self, episode: Episode) -> tuple[Array, Array]:
        """Returns position [m] and velocity [m/s] of the cart."""
        state = episode.state
        x, v = (f(self.system, state, "cart")[0] for f in (jc.position, jc.velocity))
        return x, v

    def observation(self, episode: Episode) -> Array:
        """Returns position and velocity of the cart, then cosine, sine and rate of each pole."""
        angles, rates = self.angles(episode)
        poles = jnp.stack([jnp.cos(angles), jnp.sin(angles), rates], axis=1)
        return jnp.append(jnp.stack(self.cart(episode)), poles.ravel())

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Returns the height of the tip, reduced by cart offset, pole motion and force."""
        angles, rates = self.angles(after)
        height = jnp.sum(self.lengths * jnp.cos(angles)) / jnp.sum(self.lengths)
        middle = (1 + near(self.cart(after)[0], 1.0)) / 2
        calm = (1 + near(jnp.sqrt(jnp.mean(rates**2)), 5.0)) / 2
        return (1 + height) / 2 * middle * calm * (4 + near(action[0], 1.0)) / 5

    def marks(self, axes: Axes, episode: Episode) -> None:
        """Draws the track, the cart, and the poles at their full length."""
        x = float(self.cart(episode)[0])
        foot = np.array([x, 0.0])
        axes.plot((-TRACK, TRACK), (0.0, 0.0), "k", lw=1)
        axes.plot((x - 0.2, x + 0.2), (0.0, 0.0), color="C0", lw=12, solid_capstyle="butt")
        for i, angle in enumerate(np.asarray(self.angles(episode)[0])):
            tip = foot + float(self.lengths[i]) * np.array([-np.sin(angle), np.cos(angle)])
            axes.plot(*np.stack([foot, tip], axis=1), color=f"C{i + 1}", lw=4)
            foot = tip

    def terminal(self, episode: Episode) -> Array:
        """Returns True if the cart has reached the end of the track."""
        return jnp.abs(self.cart(episode)[0]) > TRACK


def double_cart_pole(
    lengths: Array | Sequence[Number] = (0.6, 0.6),
    masses: Array | Sequence[Number] = (0.3, 0.3),
    *,
    dt: Number = 5e-3,
    horizon: int | None = 1000,
    **options: Any,
) -> CartPole:
    """Builds `CartPole` with two poles in series and actions of 10 ms."""
    return CartPole.build(lengths, masses, dt=dt, horizon=horizon, **options)


def pole_names(count: int) -> list[str]:
    """Returns the names of the poles, from the cart outwards."""
    return [f"pole{i + 1}" for i in range(count)]
