"""Every task can be solved: a hand-made controller earns nearly all, zero actions little."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon import environments
from jaxcon.environments.tasks.hopper import HIP, SHANK, SIDES, SOLE, THIGH, knee_of
from jaxcon.environments.tasks.stewart import FEET, HEADS, HEIGHT


def play(environment, policy, actions=None, copies=2):
    """Returns the rewards (copies, actions) of a policy; 0 after the end of the task."""

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
    """Pumps energy into the pole, then balances it; with the numbers of the default cart-pole."""
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
    """Drives on a curve to the parking place, forwards or backwards, and arrives in its direction.

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
    """Returns the changes of leg lengths when the platform rotates in place, (6,) [m]."""
    home = np.array([0.0, 0.0, HEIGHT])
    arms = jnp.asarray(HEADS - home)
    heads = home[None] + jax.vmap(lambda x: jc.quaternion.rotate(jc.quaternion.exp(turn), x))(arms)
    return jnp.linalg.norm(heads - FEET, axis=1) - np.linalg.norm(HEADS - FEET, axis=1)


def tilt(seen):
    """Tilts the plate against the position and the velocity of the ball."""
    x, y, u, w = seen[:4]
    turn = jnp.stack([0.8 * y + 0.6 * w, -0.8 * x - 0.6 * u, 0.0 * x])
    return legs(turn) / 0.1


def test_a_ball_is_kept_on_the_plate():
    method = jc.Method(solver=jc.solvers.Schur())
    environment = environments.make("StewartBalancing", method=method)
    earned = play(environment, tilt, 150)
    assert earned[:, -20:].min() > 0.95
    assert earned.mean() > 0.8


KINDS = {"by hand": (1.0, 0.0), "idle": (0.0, 0.0), "random": (0.0, 1.0), "lost": (np.nan, 0.0)}
"""Weights of the policy and of noise within −1 to 1 in an action, by kind."""


def compare(environment, policy, look, actions, copies=2):
    """Runs a policy, zero actions, noise and NaN actions in one program.

    Returns:
        By kind, for each copy and action: reward (0 after the end of the task), whether the task
        was still running, outcome, and the result of `look` for the episode.
    """

    def one(weights, key):
        def act(now, key):
            episode, alive = now
            noise = jax.random.uniform(key, (len(environment.actions),), minval=-1.0, maxval=1.0)
            action = weights[0] * policy(environment.observe(episode)) + weights[1] * noise
            episode, outcome = environment.step(episode, action)
            reward = jnp.where(alive, outcome.reward, 0)
            return (episode, alive & ~outcome.terminated), (reward, alive, outcome, look(episode))

        own, noise = jax.random.split(key)
        start = environment.reset(own), jnp.asarray(True)
        return jax.lax.scan(act, start, jax.random.split(noise, actions))[1]

    keys = jnp.tile(jax.random.split(jax.random.key(0), copies), len(KINDS))
    weights = jnp.repeat(jnp.asarray(list(KINDS.values())), copies, axis=0)
    run = jax.jit(jax.vmap(one))
    first, again = (jax.tree.map(np.asarray, run(weights, keys)) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, again)  # bitwise reproducible
    parts = [slice(i * copies, (i + 1) * copies) for i in range(len(KINDS))]
    return {k: jax.tree.map(lambda x, p=p: x[p], first) for k, p in zip(KINDS, parts, strict=True)}


def assert_sound(found, violation):
    """Checks reward bounds, the absence of divergence except by NaN, and constraint violations."""
    for kind, (reward, _, outcome, _) in found.items():
        lost = kind == "lost"
        assert reward.min() >= 0
        assert reward.max() <= (0 if lost else 1)
        assert np.all(outcome.info["diverged"] == lost)
        assert np.isfinite(outcome.observation).all()
        assert lost or outcome.info["violation"].max() < violation


def returns(found):
    """Returns the mean return of the copies, by kind."""
    return {kind: rewards.sum(axis=-1).mean() for kind, (rewards, *_) in found.items()}


def smooth(x):
    """Returns a smooth step from 0 at x = 0 to 1 at x = 1, constant outside."""
    x = jnp.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def turn_over(seen):
    """Bends the cat, moves the bend once around the spine, and stretches.

    Numbers of the default cat.

    A body of two equal halves without twist turns by half a turn for a bend β with
    A cos² β/2 + B sin² β/2 = 2 A cos β/2, with moments A along the spine and B across it.
    """
    along, across = 0.07**2 / 2, (3 * 0.07**2 + 0.25**2) / 12
    ratio = across / along
    β = 2 * np.arccos((np.sqrt(1 + ratio * (ratio - 1)) - 1) / (ratio - 1))
    fall = np.sqrt(2 * (1.6 - 0.15) / 9.81)

    def wanted(t):
        size = β * smooth(t / 0.45) * smooth((0.97 - t) / 0.45)
        phase = 2 * jnp.pi * smooth((t - 0.22) / 0.52)
        return size * jnp.stack([jnp.cos(phase), jnp.sin(phase)])

    t = (0.005 - seen[11] / 9.81) / fall
    place, rate = jax.jvp(wanted, (t,), (jnp.ones_like(t),))
    bend, bending = seen[3:5], seen[8:10]
    return (60 * (place - bend) + 0.5 * (rate / fall - bending) + 6 * bend) / 8


def test_a_cat_lands_on_its_feet_without_angular_momentum():
    method = jc.Method(jc.integrators.RATTLE(), solver=jc.solvers.Schur())
    environment = environments.make("CatRighting", method=method)

    def look(episode):
        system, state = environment.system, episode.state
        halves = [
            [f(system, state, name) for f in (jc.position, jc.velocity, jc.orientation)]
            + [jc.angular_velocity(system, state, name)]
            for name in ("front", "rear")
        ]
        return environment.upright(episode), halves

    found = compare(environment, turn_over, look, 54)
    assert_sound(found, 1e-14)
    up = {kind: seen[0][:, -1] for kind, (*_, seen) in found.items()}
    assert up["by hand"].min() > 0.95
    assert up["idle"].max() < -0.9
    earned = returns(found)
    assert earned["by hand"] > 20
    assert earned["idle"] < 1
    assert earned["random"] < 8

    moments = 2.0 * np.array([0.07**2 / 2, *2 * [(3 * 0.07**2 + 0.25**2) / 12]])
    halves = [[np.reshape(x, (-1, x.shape[-1])) for x in half] for half in found["by hand"][3][1]]
    center, drift = (np.mean([half[i] for half in halves], axis=0) for i in (0, 1))
    total = 0
    for place, velocity, turn, spin in halves:
        rotation = np.stack([np.asarray(jc.quaternion.matrix(x)) for x in turn])
        own = np.einsum("nij,nj->ni", rotation, moments * spin)
        total = total + own + np.cross(place - center, 2.0 * (velocity - drift))
    assert np.abs(moments * spin).max() > 0.1
    assert np.abs(total).max() < 1e-13


def test_no_muscles_fold_the_cat_double():
    """Torques in phase with the bending velocity, at full strength, add the most energy."""
    cat = environments.make("CatRighting", dtype="float32")

    def act(episode, _):
        rates = cat.bend(episode)[1][1:]
        episode = cat.act(episode, jnp.where(rates < 0, -1.0, 1.0).astype("float32"))
        return episode, (jnp.linalg.norm(cat.bend(episode)[0]), episode.state.status)

    starts = jax.vmap(cat.reset)(jax.random.split(jax.random.key(0), 8))
    run = jax.jit(jax.vmap(lambda s: jax.lax.scan(act, s, None, length=54)[1]))
    bend, status = run(starts)
    assert not np.any(status)
    assert 2.0 < np.max(bend) < 2.8


def pump(seen):
    """Raises the body below the suspension and lowers it at the ends, up to the target height.

    √(height) and speed are cosine and sine of the phase of a swing. Twice that phase, advanced by
    the lag of the servo, controls the climbing.
    """
    cosine, sine, rate, distance = seen[:4]
    x = jnp.sign(sine) * jnp.sqrt(distance * (1 - cosine))
    v = distance * rate / np.sqrt(2 * 9.81)
    height, lead = x**2 + v**2, 0.6
    phase = (np.cos(lead) * (v**2 - x**2) + np.sin(lead) * 2 * x * v) / (height + 1e-6)
    return jnp.stack([jnp.clip(3 * phase, -1, 1) * jnp.clip(4 * (seen[-1] - height), -1, 1)])


def period(lengths, masses, moments, last):
    """Returns the period of the slowest small oscillation of a hanging chain.

    The last body is fixed to the last link. The link angles obey M φ̈ + K φ = 0. With the
    horizontal lever arms a of the bodies by angle, M = Σ m a aᵀ + moments, and K = g Σ m a on the
    diagonal.
    """
    n = len(lengths)
    arms = np.array([[*lengths[:k], lengths[k] / 2, *np.zeros(n - k - 1)] for k in range(n)])
    arms = np.vstack([arms, [*lengths[:-1], lengths[-1] + last]])
    inertia = np.diag([*moments[: n - 1], moments[n - 1] + moments[n]])
    stiff = 9.81 * np.diag(masses @ arms)
    rates = np.linalg.eigvals(np.linalg.solve(arms.T @ (masses[:, None] * arms) + inertia, stiff))
    return 2 * np.pi / np.sqrt(rates.real.min())


def test_a_swing_on_a_rope_is_pumped_up_to_its_height():
    environment = environments.make("RopeSwing")

    def look(episode):
        return environment.height(episode), environment.polar(episode)[0], episode.goal

    found = compare(environment, pump, look, environment.horizon)
    assert_sound(found, 1e-3)
    height, _, goal = found["by hand"][3]
    np.testing.assert_allclose(height[:, -25:], goal[:, -25:], atol=0.02)
    assert height[:, 0].max() < 0.06
    earned = returns(found)
    assert earned["by hand"] > 160
    assert max(earned["idle"], earned["random"]) < 35

    masses, moments = np.array([0.3] * 4 + [30.0]), [0.3 * 0.5**2 / 12] * 4 + [0.4 * 30 * 0.15**2]
    sag = 30 * 9.81 / 6e3
    slow = period([0.5] * 4, masses, moments, 0.4 + sag)
    for angle in found["idle"][3][1]:
        at = np.flatnonzero(np.diff(np.sign(angle)))
        times = 0.04 * (at + angle[at] / (angle[at] - angle[at + 1]))
        size = np.abs(angle).max()
        measured = 2 * np.diff(times).mean() / (1 + size**2 / 16)
        np.testing.assert_allclose(measured, slow, rtol=5e-4)


def hop(seen):
    """A spring between trunk and foot, stiffer on the way up.

    In flight the foot is placed ahead in proportion to the speed and its error.

    The transposed Jacobian of the foot converts forces into torques.

    References:
        Raibert, Legged Robots That Balance (1986), section 2, for the placement of the foot.
    """
    height, speed, rise = seen[:3]
    foot, velocity, goal = seen[7:9], seen[9:11], seen[11]
    ahead = jnp.clip(0.1 * speed + 0.1 * (speed - goal), -0.15, 0.15)
    swing = 600 * (jnp.stack([ahead, jnp.full_like(ahead, -0.4)]) - foot) - 15 * velocity
    up = jnp.clip(2e3 * (0.4 + foot[1]) + jnp.where(rise > 0, 20.0, 0.0), 0.0, 300.0)
    push = jnp.clip(40 * (goal - speed), -0.6 * up, 0.6 * up)
    stands = height + foot[1] - SOLE < 3e-3
    force = jnp.where(stands, -jnp.stack([push, up]), swing)
    slopes = [jax.jacfwd(lambda p, s=s: knee_of(s, p))(foot) for _, s in SIDES]
    knees = [knee_of(s, foot) - jnp.asarray([s * HIP, 0.0]) for _, s in SIDES]
    rows = [(k[0] * d[1] - k[1] * d[0]) / THIGH**2 for k, d in zip(knees, slopes, strict=True)]
    return jnp.linalg.solve(jnp.stack(rows, axis=1), force) / 20


def test_sweeps_over_stops_and_contact_hop_as_far():
    """Sweeps are the default of the task; the next test solves its rows to rounding."""
    environment = environments.make("FiveBarHopper")
    assert isinstance(environment.method.contact_solver, jc.solvers.GaussSeidel)
    cheap = dataclasses.replace(environment.method, solver=jc.solvers.Schur())
    earned = play(dataclasses.replace(environment, method=cheap), hop)
    assert earned.sum(axis=1).min() > 190


ENDS = [
    (part, side * x / 2) for part, x in (("thigh", THIGH), ("shank", SHANK)) for side in (-1, 1)
]
"""The ends of the bars of a leg, from the hip down to the foot."""


def test_a_five_bar_leg_hops_forward():
    """In flight the momenta follow ballistic motion; on the ground forces obey Coulomb's law."""
    environment = environments.make("FiveBarHopper", method=jc.Method(solver=jc.solvers.Schur()))
    masses = {"trunk": 4.0, "thigh": 0.3, "shank": 0.2, "carriage": 0.2}
    weights = {name: masses[name.split("_")[-1]] for name in environment.system.layout.bodies}

    def look(episode):
        system, state = environment.system, episode.state
        legs = [
            [jc.position(system, state, f"{side}_{part}", (end, 0.0)) for part, end in ENDS]
            for side, _ in SIDES
        ]
        moving = {name: m * jc.velocity(system, state, name) for name, m in weights.items()}
        ahead = sum(x[0] for x in moving.values())
        up = sum(x[1] for name, x in moving.items() if name != "carriage")
        low = legs[0][3][1] - SOLE
        return legs, ahead, up, low, jc.velocity(system, state, "trunk")[0], episode.goal

    found = compare(environment, hop, look, environment.horizon)
    assert_sound(found, 1e-3)
    earned = returns(found)
    assert earned["by hand"] > 190
    assert earned["idle"] < 10
    assert earned["random"] < 20
    *_, low, speed, goal = found["by hand"][3]
    assert found["by hand"][1].all()  # the robot never falls
    np.testing.assert_allclose(speed[:, -100:].mean(axis=1), goal[:, -1], atol=0.15)
    assert low[:, -100:].max() > 0.15
    hops = np.sum((low[:, 1:] > 0.02) & (low[:, :-1] <= 0.02), axis=1)
    assert hops.min() >= 5

    for kind in ("by hand", "random"):
        _, alive, _, (legs, ahead, up, low, *_) = found[kind]
        alive = alive[:, 1:] & alive[:, :-1]
        (_, knee, hinge, foot), (_, other, hung, met) = legs
        for a, b in ((knee, hinge), (other, hung), (foot, met)):
            assert np.abs(a - b)[:, 1:][alive].max() < 1e-3
        normal = np.diff(up) + 9.81 * (sum(weights.values()) - 0.2) * 0.01
        # a step leaves φ = O(h³) on either side of the ground; without J̇ v it leaves O(h²),
        # for a swinging foot always above it: 91 µm where a leg pushes, millimeters under noise
        pushes = alive & (normal > 0.02)
        assert pushes.sum() > 40
        if kind == "by hand":
            assert np.abs(low[:, 1:][pushes]).max() < 2e-6
        assert low.min() > -4e-5
        normal = normal[alive]
        along = np.abs(np.diff(ahead))[alive]
        assert normal.min() > -1e-12
        assert np.max(along - 0.8 * normal) < 1e-12
        flies = np.minimum(low[:, 1:], low[:, :-1])[alive] > 0.05
        assert flies.sum() > 20
        assert max(normal[flies].max(), along[flies].max()) < 1e-12
