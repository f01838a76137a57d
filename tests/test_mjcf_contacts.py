"""Joint limits, dry friction and contacts of models, compared with MuJoCo's constraint rows."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.contact.rows import linearize_bounds

mujoco = pytest.importorskip("mujoco")
sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import legged  # noqa: E402
from benchmarks import mjcf_agreement as agreement  # noqa: E402

EXACT = 1e-9
"""Tolerance of gaps and their rates, in meters and seconds."""


def model(bodies, rest="", default="", flag=""):
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option cone="elliptic">{flag}</option>'
        f"<default>{default}</default><worldbody>{bodies}</worldbody>{rest}</mujoco>"
    )


def moved(m, seed=0, qpos=None):
    """Returns MuJoCo's data at a random state, and the inequality rows of jaxcon there."""
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    data.qpos[:], data.qvel[:] = (x[0] for x in agreement.random_states(m, 1, seed)[:2])
    data.qpos[:] = data.qpos if qpos is None else qpos
    mujoco.mj_forward(m, data)
    return data, rows(read, data.qpos, data.qvel)


def rows(read, qpos, qvel):
    """Returns the inequality rows at a state."""
    state, control = read.state(qpos, qvel), jnp.zeros(read.system.layout.n_u)
    return linearize_bounds(read.system, state.q, state.v, state.time, control, jnp.asarray(1e-3))


def elements(found):
    """Returns gap, rate and friction of every inequality element, by name."""
    first = [np.arange(len(found.rate))[found.layout.rows(n)][0] for n in found.layout.names]
    friction = np.concatenate([np.zeros(found.kinds.normal), found.friction])
    return {
        n: (found.gap[i], found.rate[i], friction[i])
        for n, i in zip(found.layout.names, first, strict=True)
    }


def touching(m, data):
    """Returns gap, rate, friction and condim of MuJoCo's contacts, by the names of two geoms."""
    result = {}
    for c in (data.contact[i] for i in range(data.ncon)):
        names = " and ".join(m.geom(int(g)).name for g in c.geom)
        numbers = c.dist - c.includemargin, data.efc_vel[c.efc_address], c.friction[0], c.dim
        result.setdefault(names, []).append(numbers)
    return result


def own(found, pair):
    """Returns the elements of a pair: one, or one for each of its points."""
    numbered = {n for n in found if n.startswith(f"{pair} ") and n.rsplit(" ", 1)[1].isdigit()}
    return [np.array(found[n]) for n in found if n == pair or n in numbered]


SHAPES = """
<geom name="floor" type="plane" size="1 1 1" pos="0.1 0.2 -0.3" euler="0.1 0.3 0" friction="0.5"
  conaffinity="3"/>
<body pos="0 0 0.5"><freejoint/>
  <geom name="ball" size="0.1" pos="0.1 0.2 0.3" friction="0.7"/></body>
<body pos="1 0 0.5" euler="0.3 0.1 0.2"><freejoint/>
  <geom name="capsule" type="capsule" size="0.1 0.3" pos="0.1 0 0" euler="1 0.4 0.2" gap="0.01"/>
  </body>
<body pos="0 1 0.5"><freejoint/>
  <geom name="rod" type="capsule" fromto="0 0 0 0.5 0.2 0.1" size="0.05" margin="4"/></body>
<body pos="1 1 0.7"><freejoint/>
  <geom name="box" type="box" size="0.1 0.2 0.3" pos="0 0.1 0" euler="0.3 0.6 0.2" contype="2"
  conaffinity="0"/></body>
"""
FAR = '<geom margin="5"/>'
"""A margin so large that MuJoCo lists all pairs of geoms."""


@pytest.mark.parametrize("seed", range(4))
def test_gaps_and_their_rates_are_those_of_mujoco(seed):
    """MuJoCo lists the four lower corners of a box; for other shapes it lists all points."""
    m = model(SHAPES, default=FAR)
    data, found = moved(m, seed)
    found, expected = elements(found), touching(m, data)
    assert "floor and box" in expected
    for pair, contacts in expected.items():
        got = own(found, pair)
        assert len(got) == {"floor and box": 8}.get(pair, len(contacts))
        for gap, rate, friction, _ in contacts:
            nearest = min(got, key=lambda x, gap=gap: abs(x[0] - gap))
            np.testing.assert_allclose(nearest, (gap, rate, friction), atol=EXACT)
        np.testing.assert_allclose(min(x[0] for x in got), min(x[0] for x in contacts), atol=EXACT)
    assert sum(len(own(found, pair)) for pair in expected) == len(found)


FILTERED = """
<geom name="floor" type="plane" size="1 1 1" friction="0.5" condim="1"/>
<geom name="wall" type="plane" size="1 1 1" friction="0.2" priority="1"/>
<geom name="post" size="0.1" condim="1" friction="2"/>
<body name="a"><freejoint/><geom name="a1" size="0.1" friction="0.7"/>
  <body><geom name="welded" size="0.1" condim="1" priority="1"/></body>
  <body name="b"><joint/><geom name="b1" size="0.1" condim="1"/>
    <body name="c"><joint/><geom name="c1" size="0.1" condim="1" friction="1.5"/></body>
  </body></body>
<body name="d"><freejoint/><geom name="d1" size="0.1" contype="4" conaffinity="0"/>
  <geom name="d2" size="0.1" contype="0" conaffinity="2"/>
  <geom name="d3" size="0.1" contype="2"/></body>
<body name="e"><joint axis="0 1 0"/><geom name="e1" size="0.1"/></body>
"""
LISTED = """<contact><exclude body1="a" body2="c"/><exclude body1="e" body2="d"/>
<pair geom1="a1" geom2="c1" friction="0.3 0.3" margin="7"/>
<pair geom1="floor" geom2="a1" condim="1"/><pair geom1="d1" geom2="d2"/></contact>"""


@pytest.mark.parametrize("flag", ["", '<flag filterparent="disable"/>'])
def test_pairs_and_their_friction_are_those_of_mujoco(flag):
    """Covers masks, parents, welds, exclusions, listed pairs and priorities in one model."""
    m = model(FILTERED, LISTED, '<geom margin="5"/><pair margin="9"/>', flag)
    data, found = moved(m)
    found, expected = elements(found), touching(m, data)
    expected.pop("d1 and d2")  # geoms of one body cannot move relative to each other
    assert set(found) == set(expected)
    for pair, ((gap, _, friction, condim),) in expected.items():
        rough = friction if condim > 1 else 0.0
        np.testing.assert_allclose(found[pair][::2], (gap, rough), atol=EXACT)


def test_contacts_between_what_moves_can_be_left_out():
    """Contacts with the ground and the walls remain; ignoring "contact" removes all."""
    m = model(FILTERED, LISTED)
    names = {n for group in jc.from_mjcf(m).system.bounds for n in group.names}
    left = jc.from_mjcf(m, ignore=("self_contact",)).system.bounds
    fixed = {n for n in names if n.split(" and ")[0] in ("floor", "wall", "post")}
    assert {n for group in left for n in group.names} == fixed < names
    assert not jc.from_mjcf(m, ignore=("contact",)).system.bounds


TURNING = """
<geom name="floor" type="plane" size="1 1 1" friction="0.5 0.02 0.03"/>
<body pos="0 0 1"><freejoint/><geom name="spins" size="0.1" friction="0.7 0.01 0.04" condim="4"/>
</body>
<body pos="1 0 1"><freejoint/><geom name="rolls" size="0.1" friction="0.7 0.01 0.04" condim="6"
  priority="1"/></body>
<body pos="0 1 1"><freejoint/><geom name="slides" size="0.1" condim="3"/></body>
"""


def test_torsional_and_rolling_friction_are_those_of_mujoco():
    """Rows of MuJoCo: normal, both tangents, spinning, rolling about both tangents."""
    m = model(TURNING, default=FAR)
    data, found = moved(m)
    rates = {}
    for c in (data.contact[i] for i in range(data.ncon)):
        names = " and ".join(m.geom(int(g)).name for g in c.geom)
        rates[names] = data.efc_vel[c.efc_address : c.efc_address + c.dim], c.friction
    numbers = jc.from_mjcf(m).system.params
    sizes = set()
    for name, (expected, friction) in rates.items():
        rows = found.rate[np.arange(len(found.rate))[found.layout.rows(name)]]
        assert len(rows) == len(expected)
        sizes.add(len(rows))
        np.testing.assert_allclose(numbers[name]["friction"], friction[0])
        if len(rows) > 3:
            spinning, rolling = expected[3], np.linalg.norm(expected[4:])
            np.testing.assert_allclose(abs(rows[-1]), abs(spinning), atol=EXACT)
            np.testing.assert_allclose(np.linalg.norm(rows[3:-1]), rolling, atol=EXACT)
            np.testing.assert_allclose(numbers[name]["spinning"], friction[2])
        if len(rows) > 4:
            np.testing.assert_allclose(numbers[name]["rolling"], friction[3])
    assert sizes == {3, 4, 6}
    plain = jc.from_mjcf(m, ignore=("torsion",)).system.params
    assert not any("spinning" in x or "rolling" in x for x in plain.values() if isinstance(x, dict))


@pytest.mark.parametrize("qvel", [(0.3, 0, 0, 0, 3.0, 0), (0, 0, 0, 0, 0, 8.0)])
def test_a_ball_rolls_and_spins_as_in_mujoco(qvel):
    """The motion is compared up to 3 %: MuJoCo's friction is soft, and its bounds share a cone."""
    m = model(
        '<geom type="plane" size="1 1 1" condim="1" friction="0 0 0"/><body pos="0 0 0.1">'
        '<freejoint/><geom size="0.1" condim="6" friction="1 0.02 0.02"/></body>',
    )
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    data.qvel[:], m.opt.timestep, steps = qvel, 1e-3, 100
    method = read.method()
    state = read.state(data.qpos, data.qvel)
    state = jc.init(read.system, method, state.q, state.v)
    end, _ = jax.jit(lambda s: jc.rollout(read.system, method, s, None, 1e-3, steps))(state)
    mujoco.mj_step(m, data, steps)
    change = data.qvel - qvel
    assert max(abs(change)) > 0.5
    got = np.asarray(read.qvel(end)) - qvel
    np.testing.assert_allclose(got, change, atol=0.03 * max(abs(change)))


JOINTS = """
<body><joint name="hinge" {0} ref="0.1" {2} axis="0 1 0"/><geom size="0.1" contype="0"/>
<body pos="0 0 1"><joint name="slide" type="slide" axis="1 0 0" {1}/><geom size="0.1" contype="0"/>
<body pos="0 1 0"><joint name="ball" type="ball" {2}/><geom size="0.1" contype="0"/></body></body>
</body>"""
RANGES = 'range="-0.5 0.3" margin="0.3"', 'range="0.1 0.4" margin="0.1"'
RUBS = 'frictionloss="0.3"'


def test_ranges_are_limits():
    """MuJoCo's row of a joint limit within its margin is pos − margin."""
    m = model(JOINTS.format(*RANGES, ""))
    data, found = moved(m, qpos=[-0.4, 0.35, 1, 0, 0, 0])
    rows, found = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT), elements(found)
    assert rows.sum() == len(found) == 2
    gaps = dict(zip(("hinge limit", "slide limit"), data.efc_pos - data.efc_margin, strict=True))
    for name, rate in zip(gaps, data.efc_vel, strict=True):
        np.testing.assert_allclose(found[name][:2], (gaps[name], rate), atol=EXACT)


def test_frictionloss_is_dry_friction():
    """Friction of a hinge acts along its angle, friction of a ball joint about the body's axes."""
    data, found = moved(model(JOINTS.format("", "", RUBS)))
    assert found.kinds.boxes == len(found.rate) == 4
    np.testing.assert_allclose(found.upper, data.efc_frictionloss)
    np.testing.assert_allclose(found.lower, -data.efc_frictionloss)
    np.testing.assert_allclose(found.rate, data.efc_vel, atol=EXACT)


@pytest.mark.parametrize(
    ("ignore", "flag"),
    [(("limit", "friction"), ""), ((), '<flag limit="disable" frictionloss="disable"/>')],
)
def test_ranges_and_friction_can_be_left_out(ignore, flag):
    assert not jc.from_mjcf(model(JOINTS.format(*RANGES, RUBS), flag=flag), ignore).system.bounds


def test_hopper_stands_on_its_foot():
    """The hopper falls 4 cm and stays above the floor; the floor's mean force equals the weight."""
    m = legged.load("hopper")
    read = jc.from_mjcf(m)
    system, method = (
        read.system,
        jc.Method(solver=jc.solvers.Sparse(), contact_solver=jc.solvers.GaussSeidel(30)),
    )
    state = jc.init(system, method, read.start.q, read.start.v)

    def record(state, info):
        return read.qpos(state), info.reactions.multipliers, info.reactions.residual

    def idle(_):
        return jnp.zeros(3)

    run = jax.jit(lambda s: jc.rollout(system, method, s, idle, 2e-3, 100, record=record))
    final, (qpos, forces, residual) = run(state)
    jc.raise_for_status(final)
    assert max(legged.depth(m, np.asarray(qpos))) < 1e-9
    kinds = linearize_bounds(system, state.q, state.v, state.time, jnp.zeros(3), jnp.ones(())).kinds
    normals = jnp.mean(kinds.split(forces.T).normal, axis=1)
    np.testing.assert_allclose(jnp.sum(normals), mujoco.mj_getTotalmass(m) * 9.81, rtol=1e-6)
    assert jnp.max(residual) < 1e-6


SOLIDS = """
<geom name="floor" type="plane" size="1 1 1" euler="0.1 0.3 0" contype="2" conaffinity="1"/>
<body pos="0 0 3"><freejoint/><geom name="ball" size="0.3"/></body>
<body pos="1 0 3"><freejoint/><geom name="capsule" type="capsule" size="0.2 0.3" pos="0.1 0 0"/>
  </body>
<body pos="2 0 3"><freejoint/><geom name="cylinder" type="cylinder" size="0.2 0.3" euler="1 1 0"/>
  </body>
<body pos="3 0 3"><freejoint/><geom name="box" type="box" size="0.2 0.3 0.4" euler="0 1 0"/></body>
<body pos="0 4 3"><freejoint/><geom name="brick" type="box" size="0.3 0.3 0.1"/></body>
<body pos="4 0 3"><freejoint/><geom name="egg" type="ellipsoid" size="0.2 0.3 0.4"/></body>
<body pos="5 0 3"><freejoint/><geom name="stone" type="mesh" mesh="stone"/></body>
"""
STONE = """<asset><mesh name="stone" vertex="0 0 0 1 0 0 0 1 0 0 0 1 1 1 0.2"/></asset>"""
EXACT_PAIRS = {
    ("floor", "ball"), ("floor", "capsule"), ("floor", "cylinder"), ("floor", "box"),
    ("floor", "egg"), ("floor", "stone"), ("ball", "cylinder"), ("ball", "box"), ("ball", "egg"),
    ("capsule", "cylinder"), ("capsule", "box"), ("ball", "brick"), ("capsule", "brick"),
    ("floor", "brick"), ("ball", "capsule"),
}  # fmt: skip


FACED_PAIRS = {("box", "brick")}


def solids(margin):
    """Returns a model in which all kinds of shapes may touch each other and the floor."""
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><default><geom margin="{margin}"/></default>{STONE}'
        f"<worldbody>{SOLIDS}</worldbody></mujoco>"
    )


def test_distances_of_shapes_are_those_of_mujoco():
    """Compares the smallest gaps with `mj_geomDistance`, where the axis of a capsule is outside.

    Boxes that overlap have MuJoCo's depth, up to 1 % of the smallest half edge. If
    they are apart, they have a positive gap, which is the distance along their best axis.
    """
    m = solids(0.0)
    read, data = jc.from_mjcf(m, ignore=("shape",)), mujoco.MjData(m)
    gaps = jax.jit(lambda q, v: rows(read, q, v).gap)
    layout = rows(read, m.qpos0, np.zeros(m.nv)).layout
    found, expected = {}, {}
    for seed in range(40):
        data.qpos[:] = agreement.random_states(m, 1, seed)[0][0]
        data.qpos.reshape(-1, 7)[:, :3] *= 0.5 if seed % 2 else 0.1
        mujoco.mj_forward(m, data)
        gap = np.asarray(gaps(data.qpos, data.qvel))
        for name in layout.names:
            first, second = (x.split(" ")[0] for x in name.split(" and "))
            pair, ids = (first, second), [m.geom(x).id for x in (first, second)]
            least = gap[np.atleast_2d(layout.rows(name))[:, 0]].min()
            each = found.setdefault(pair, {})
            each[seed] = min(least, each.get(seed, np.inf))
            distance = mujoco.mj_geomDistance(m, data, *ids, 100.0, np.zeros(6))
            expected.setdefault(pair, {})[seed] = distance
    assert found.keys() == EXACT_PAIRS | FACED_PAIRS
    for pair in found:
        got, want = (np.array([x[pair][k] for k in range(40)]) for x in (found, expected))
        off = (got - want)[got > (-0.199 if "capsule" in pair else -np.inf)]
        if pair in FACED_PAIRS:
            assert np.all(got[want > 0] > 0)
            deep = want < 0
            assert np.sum(deep) > 5
            assert np.all(np.abs(got - want)[deep] < 0.0101 * 0.1)
        else:
            # MuJoCo's depth of an ellipsoid is that of an iteration
            tight = 1e-3 if pair == ("ball", "egg") else EXACT
            np.testing.assert_allclose(off, 0.0, atol=tight, err_msg=str(pair))


def test_shapes_touch_from_the_margin_on():
    """The margin of the pair and its friction are those of MuJoCo."""
    models = solids(0.0), solids(0.1)
    read, v = [jc.from_mjcf(m, ignore=("shape",)) for m in models], np.zeros(models[0].nv)
    near, far = (rows(x, m.qpos0, v) for x, m in zip(read, models, strict=True))
    apart = near.gap - far.gap
    exists = np.asarray(near.gap)[: near.kinds.contacts] < 50
    want = np.where(exists, apart[0], apart[: len(exists)])
    np.testing.assert_allclose(apart[: len(exists)], want, atol=1e-12)
    assert apart[0] > 0.09
    np.testing.assert_allclose(near.friction, 1.0)


def test_a_mesh_of_many_vertices_is_reduced_with_a_warning():
    """The message names the mesh, and tells by how much the hull exceeds the remaining points."""
    points = np.random.default_rng(0).normal(size=(100, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    text = " ".join(map(str, points.ravel()))
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><mesh name="stone" vertex="{text}"/></asset><worldbody>'
        '<geom name="floor" type="plane" size="1 1 1"/>'
        '<body pos="0 0 2"><freejoint/><geom name="g" type="mesh" mesh="stone"/></body>'
        "</worldbody></mujoco>"
    )
    with pytest.warns(UserWarning, match="mesh 'stone' has .* use 16 of them, .* by up to 0.") as w:
        read = jc.from_mjcf(m)
    assert read.system.params["floor and g"]["anchor_b"].shape == (16, 3)
    assert float(str(w[0].message).split("up to ")[1].split()[0]) < 0.3
