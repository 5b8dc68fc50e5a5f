"""Spheres against boxes: MuJoCo's contacts, the box's signed distance, derivatives, and both ways a model gets there."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rewax.physics import rigid
from rewax.physics.rigid.sphere_box import sphere_box
from rewax.physics.rigid.spring_contacts import Penalty
from rewax.physics.shapes import Box, signed_distance
from rewax.xla_options import unoptimised

HALF, RADIUS = np.array([0.3, 0.2, 0.1]), 0.05
WORLD = f"""<mujoco><option gravity="0 0 -9.81"/><default><geom {{filter}}/></default><worldbody>
<body name="box"><freejoint/><geom name="box" type="box" size="0.3 0.2 0.1" density="300" friction="0.7"/></body>
<body name="ball" pos="0 0 1"><freejoint/><geom name="ball" size="{RADIUS}" density="900" friction="0.7"/></body>
</worldbody>{{pair}}</mujoco>"""
PAIRED = WORLD.format(
    filter='contype="0" conaffinity="0"',
    pair='<contact><pair geom1="box" geom2="ball" friction="0.7 0.7 0 0 0" margin="0.004"/></contact>',
)
FILTERED = WORLD.format(filter='margin="0.002"', pair="")  # MuJoCo adds up two geoms' margins
LAW = Penalty(stiffness=3e3, damping=20.0, friction_damping=15.0, onset=1e-2)


@pytest.fixture(scope="module")
def poses(rotations):
    """Centres of spheres around and inside boxes, and the boxes' poses: every kind of nearest feature, several times."""
    rng = np.random.default_rng(0)
    local = rng.uniform(-1.2, 1.2, (400, 3)) * HALF
    box, rotation = rng.uniform(-1.0, 1.0, (400, 3)), rotations(1, 400)
    return local, box + np.einsum("nij,nj->ni", rotation, local), box, rotation


def contacts(center, box, rotation, half=HALF, radius=RADIUS):
    n = len(center)
    return jax.jit(sphere_box)(
        center,
        jnp.full(n, radius),
        jnp.asarray(box),
        jnp.asarray(rotation),
        jnp.broadcast_to(jnp.asarray(half), (n, 3)),
    )


def test_contacts_are_mujocos(x64, poses):
    _, center, box, rotation = poses
    distance, point, normal = (np.asarray(a) for a in contacts(center, box, rotation))
    model = mujoco.MjModel.from_xml_string(PAIRED.replace("0.004", "9"))
    data, quaternion = mujoco.MjData(model), np.zeros(4)
    for i in range(len(center)):
        mujoco.mju_mat2Quat(quaternion, rotation[i].ravel())
        data.qpos[:] = [*box[i], *quaternion, *center[i], 1, 0, 0, 0]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        (theirs,) = data.contact
        assert [model.geom(g).name for g in theirs.geom] == ["ball", "box"]
        np.testing.assert_allclose(distance[i], theirs.dist, atol=1e-9)
        np.testing.assert_allclose(normal[i], theirs.frame[:3], atol=1e-7)
        np.testing.assert_allclose(point[i], theirs.pos, atol=1e-8)


def test_distances_and_normals_are_the_signed_distances(x64, poses):
    local, center, box, rotation = poses
    distance, point, normal = contacts(center, box, rotation)
    expected, outward = signed_distance(Box(half_size=jnp.asarray(HALF)), jnp.asarray(local))
    assert 50 < np.sum(np.all(np.abs(local) < HALF, axis=1)) < 350  # inside and outside
    np.testing.assert_allclose(distance, expected - RADIUS, atol=1e-12)
    np.testing.assert_allclose(normal, -np.einsum("nij,nj->ni", rotation, outward), atol=1e-10)
    # Halfway: as far from the one surface as from the other.
    np.testing.assert_allclose(np.linalg.norm(point - center, axis=1), np.abs(RADIUS + 0.5 * distance), atol=1e-12)


SPECIAL = {
    "on a face": [0.3, 0.05, 0.02],
    "on an edge": [0.3, 0.2, 0.03],
    "on a corner": [0.3, 0.2, 0.1],
    "at the middle": [0.0, 0.0, 0.0],
    "as near to two faces": [0.25, 0.15, 0.0],
    "just outside a face": [0.3 + 1e-9, 0.05, 0.02],
}


@pytest.mark.parametrize("precision", [False, True])
def test_derivatives_are_finite_and_normals_of_unit_length_everywhere(precision):
    with jax.enable_x64(precision):
        center = jnp.array(list(SPECIAL.values()))
        n = len(center)
        rest = (
            jnp.full(n, RADIUS),
            jnp.zeros((n, 3)),
            jnp.tile(jnp.eye(3), (n, 1, 1)),
            jnp.tile(jnp.asarray(HALF), (n, 1)),
        )
        slopes = jax.jit(jax.jacrev(sphere_box, argnums=range(5)))(center, *rest)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
        by_center = np.asarray(slopes[0][0])[np.arange(n), np.arange(n)]
        np.testing.assert_allclose(np.linalg.norm(by_center, axis=1), 1.0, atol=1e-5)
        np.testing.assert_allclose(-by_center, sphere_box(center, *rest)[2], atol=1e-5)


def test_derivatives_are_those_of_finite_differences(x64, poses, derivatives, central_difference, random_like, inner):
    """Where nothing jumps: away from where two faces are equally near."""
    local, center, box, rotation = poses
    gap = np.sort(HALF - np.abs(local), axis=1)
    smooth = (gap[:, 1] - gap[:, 0] > 1e-3) & (np.abs(gap).min(axis=1) > 1e-3)
    assert smooth.sum() > 300
    n = smooth.sum()
    x = (center[smooth], np.full(n, RADIUS), box[smooth], rotation[smooth], np.tile(HALF, (n, 1)))
    x = jax.tree.map(jnp.asarray, x)
    dx = random_like(2, x)
    _, forward, weights, reverse = derivatives(lambda x: sphere_box(*x))(x, dx, lambda v: random_like(3, v))
    expected = central_difference(jax.jit(lambda x: sphere_box(*x)), x, dx, 1e-7)
    for found, true in zip(forward, expected, strict=True):
        np.testing.assert_allclose(found, true, rtol=1e-4, atol=1e-4)
    assert inner(weights, forward) == pytest.approx(inner(reverse, dx), rel=1e-10)


def test_a_models_pair_acts_as_mjx_lets_it_act(x64):
    """The same two bodies, once as an explicit pair, which is ours, once through MJX: distances, and a step."""
    ours, theirs = (rigid.load(text, dt=1e-3, penalty=LAW) for text in (PAIRED, FILTERED))
    rng = np.random.default_rng(4)
    turn = rng.standard_normal((40, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    rotation = np.array([mat(q) for q in turn])
    local = rng.uniform(-1.4, 1.4, (40, 3)) * HALF
    box = rng.uniform(-0.3, 0.3, (40, 3))
    ball = box + np.einsum("nij,nj->ni", rotation, local)
    qpos = np.concatenate([box, turn, ball, np.tile([1.0, 0, 0, 0], (40, 1))], axis=1)
    qvel = rng.standard_normal((40, 12))

    def after(model):
        start = jax.vmap(lambda q, v: rigid.initial_state(model, q, v))(jnp.asarray(qpos), jnp.asarray(qvel))
        step = jax.jit(jax.vmap(lambda s: rigid.step(model, s)))
        return jax.jit(jax.vmap(lambda s: rigid.contact_distances(model, s)))(start), step(start)

    (distance, state), (known, expected) = after(ours), after(theirs)
    assert distance.shape == known.shape == (40, 1)
    touching = np.asarray(known)[:, 0] < 0.0
    assert 10 < touching.sum() < 35
    np.testing.assert_allclose(np.asarray(distance)[touching], np.asarray(known)[touching], atol=1e-12)
    # Within the margin, where MJX reports nothing, ours acts as MuJoCo's does.
    alike = touching | (np.asarray(distance)[:, 0] > 0.004)
    # MJX's nearest point of an edge is off by some 1e-6 of the edge's length.
    np.testing.assert_allclose(np.asarray(state.qvel)[alike], np.asarray(expected.qvel)[alike], atol=5e-4)
    assert np.abs(np.asarray(state.qvel)[touching] - qvel[touching]).max(axis=1).min() > 1e-2


def mat(quaternion):
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    return rotation.reshape(3, 3)


def test_numbers_of_pairs_may_be_changed_and_disabled_contacts_are_none(x64):
    model = rigid.load(PAIRED, penalty=LAW)
    q = np.array([0, 0, 0, 1, 0, 0, 0, 0, 0, 0.14, 1, 0, 0, 0])
    v = np.zeros(12)
    v[6] = 9.0  # slides at Coulomb's limit
    state = rigid.initial_state(model, q, v)
    friction, margin = (model.parameters[f"pair_{name}"] for name in ("friction", "margin"))
    changes = {}, {"pair_friction": 0.5 * friction}, {"pair_friction": 0.0 * friction}, {"pair_margin": 0.5 * margin}
    step = jax.jit(rigid.step, compiler_options=unoptimised())
    slowed = [9.0 - float(step(model.with_parameters(**change), state).qvel[6]) for change in changes]
    # The ball is 1 cm deep; the margin, over which contact acts already, is 4 mm.
    np.testing.assert_allclose(slowed[1:], slowed[0] * np.array([0.5, 0.0, 12 / 14]), rtol=1e-9)
    assert slowed[0] > 1e-3
    free = PAIRED.replace("<option ", "<option><flag contact='disable'/></option><option ")
    none = rigid.load(free, penalty=LAW)
    assert rigid.contact_distances(none, state).shape == (0,)
    np.testing.assert_allclose(step(none, state).qvel[6], 9.0)


@pytest.mark.slow
def test_a_listed_pair_that_could_touch_anyway_counts_once():
    """As in MuJoCo, where listing a pair replaces what its geoms' types say."""
    body = '<body pos="0 0 .199"><freejoint/><geom name="ball" size=".1" mass="1"/></body>'
    text = '<mujoco><worldbody><geom name="box" type="box" size=".1 .1 .1"/>{}</worldbody>{}</mujoco>'
    pair = '<contact><pair geom1="ball" geom2="box"/></contact>'
    ends = []
    for extra in ("", pair):
        model = rigid.load(text.format(body, extra), penalty=Penalty(stiffness=1e4))
        distances = rigid.contact_distances(model, rigid.initial_state(model))
        np.testing.assert_allclose(distances[distances < 0.5], [-1e-3], rtol=1e-4)
        ends.append(rigid.step(model, rigid.initial_state(model)).qvel[2])
    np.testing.assert_allclose(*ends, rtol=1e-5)
