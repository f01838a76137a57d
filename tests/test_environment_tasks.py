"""Each task can be done: a hand-made controller earns nearly everything, doing nothing does not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon import environments
from jaxcon.environments.tasks.stewart import FEET, HEADS, HEIGHT


def play(environment, policy, actions=None, copies=2):
    """Rewards (copies, actions) under a policy of the observation; 0 once the task is over."""

    def one(key):
        def act(now, _):
            episode, alive = now
            episode, outcome = environment.step(episode, policy(environment.observe(episode)))
            return (episode, alive & ~outcome.terminated), jnp.where(alive, outcome.reward, 0)

        start = environment.reset(key), jnp.asarray(True)
        return jax.lax.scan(act, start, None, actions or environment.horizon)[1]

    return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), copies)))


def idle(environment, actions=None):
    return play(environment, lambda _: jnp.zeros(len(environment.actions)), actions)


def swing_up(seen):
    """Energy into the pole, then feedback of its lean; numbers of the stock cart-pole."""
    x, speed, cosine, sine, rate = seen
    mass, length, cart, force = 0.3, 0.6, 1.0, 20.0
    energy = mass * length**2 / 6 * rate**2 + mass * 9.81 * length / 2 * (cosine - 1)
    pump = jnp.clip(-8.0 * energy * rate * cosine, -8.0, 8.0) - x - 1.5 * speed
    lean = jnp.arctan2(sine, cosine)
    hold = 2.0 * x + 4.0 * speed - 40.0 * lean - 8.0 * rate
    push = jnp.where(jnp.abs(lean) < 0.5, hold, (mass + cart) * pump)
    return jnp.stack([push / force])


def test_a_cart_pole_is_swung_up_and_stands():
    environment = environments.make("CartPole")
    earned = play(environment, swing_up)
    assert earned.mean() > 0.75
    assert earned[:, -100:].min() > 0.99
    assert idle(environment, 50).max() < 1e-2


def test_a_double_cart_pole_that_stands_earns_all():
    environment = environments.make("DoubleCartPole")
    up = jnp.zeros(3)
    q = environment.place(up)
    state = jc.init(environment.system, environment.method, q, jnp.zeros_like(q))
    episode = environment.reset(jax.random.key(0))
    stands = dataclasses.replace(episode, state=state)
    reward, terminated, truncated = environment.judge(stands, jnp.zeros(1), stands)
    assert reward == 1
    assert not terminated | truncated
    assert environment.judge(episode, jnp.zeros(1), episode)[0] < 0.01
    away = environment.place(up.at[0].set(3.1))
    away = jc.init(environment.system, environment.method, away, jnp.zeros_like(away))
    assert environment.judge(stands, jnp.zeros(1), dataclasses.replace(stands, state=away))[1]


def test_a_crank_follows_its_reference_under_pd_control():
    environment = environments.make("FourBarTracking")
    earned = play(environment, lambda seen: jnp.stack([2.0 * seen[6] + 0.2 * seen[8]]))
    assert earned.mean() > 0.85
    assert earned[:, -100:].mean() > 0.85
    assert idle(environment).mean() < 0.2


def test_a_reference_of_the_crank_is_an_integral_of_its_rate():
    goal = environments.make("FourBarTracking").reset(jax.random.key(2)).goal
    times = jnp.linspace(0.0, 5.0, 7)
    slopes = jax.vmap(jax.grad(lambda t: goal.at(t)[0]))(times)
    np.testing.assert_allclose(slopes, goal.at(times)[1], rtol=1e-12)


def polar(seen):
    """Drives on a curve to the place, forwards or backwards, and arrives in its direction.

    References:
        Aicardi, Casalino, Bicchi, Balestrino, Closed loop steering of unicycle-like vehicles via
        Lyapunov techniques, IEEE Robotics & Automation Magazine 2 (1995).
    """
    ahead, left, cosine, sine, speed, yaw = seen
    way = jnp.where(ahead < 0, -1.0, 1.0)
    aside = jnp.arctan2(way * left, way * ahead)
    wanted = way * jnp.minimum(1.2 * jnp.hypot(ahead, left), 1.5) * jnp.cos(aside)
    turning = 2.5 * aside + 0.8 * (jnp.arctan2(sine, cosine) + aside)
    thrust, torque = 20 * wanted + 60 * (wanted - speed), 4 * turning + 8 * (turning - yaw)
    return jnp.stack([thrust / 60, torque / 10])


def test_a_sleigh_is_parked():
    environment = environments.make("Parking")
    earned = play(environment, polar, copies=8)
    assert earned.mean() > 0.7
    assert earned[:, -100:].min() > 0.95
    assert idle(environment, 20).mean() < 0.2


def legs(turn):
    """What the legs are longer than at home with the platform turned in place, (6,) [m]."""
    home = np.array([0.0, 0.0, HEIGHT])
    arms = jnp.asarray(HEADS - home)
    heads = home[None] + jax.vmap(lambda x: jc.quaternion.rotate(jc.quaternion.exp(turn), x))(arms)
    return jnp.linalg.norm(heads - FEET, axis=1) - np.linalg.norm(HEADS - FEET, axis=1)


def tilt(seen):
    """Leans the plate against where the ball is and goes."""
    x, y, u, w = seen[:4]
    turn = jnp.stack([0.8 * y + 0.6 * w, -0.8 * x - 0.6 * u, 0.0 * x])
    return legs(turn) / 0.1


def test_a_ball_is_kept_on_the_plate():
    method = jc.Method(solver=jc.Schur())
    environment = environments.make("StewartBalancing", method=method)
    earned = play(environment, tilt, 150)
    assert earned[:, -20:].min() > 0.95
    assert earned.mean() > 0.8
