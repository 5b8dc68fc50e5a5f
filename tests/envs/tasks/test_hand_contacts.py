"""What touches what in HandReorient, beside MuJoCo's distances of the same geoms; the cube on the palm."""

import functools
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_tasks as tasks
from scipy.spatial.transform import Rotation

from rewax.physics import rigid
from rewax.physics.rigid.forces import contacts, kinematics, mjx_data

NAME = "HandReorient"
NUM = 64


def solid():
    """Geoms that are the hand and the cube; the cube's corners are part of its box."""
    mj = tasks.make(NAME).model.static.mj
    return [g for g in range(mj.ngeom) if not mj.geom(g).name.startswith("cube_")]


def are_neighbours(mj, a, b):
    """On one body, or on a body and its parent."""
    one, other = mj.geom_bodyid[a], mj.geom_bodyid[b]
    return one == other or mj.body_parentid[one] == other or mj.body_parentid[other] == one


@functools.cache
def poses():
    """Joints anywhere between their limits, the cube anywhere near the hand, shape (NUM, 23)."""
    env, rng = tasks.make(NAME), np.random.default_rng(0)
    low, high = tasks.ranges(NAME).T
    q = np.tile(np.asarray(env.model.home, np.float64), (NUM, 1))
    q[:, :16] = low + (high - low) * rng.uniform(size=(NUM, 16))
    q[:, 16:19] = [0.0, -0.08, 0.54] + rng.uniform(-0.08, 0.08, (NUM, 3))
    q[:, 19:] = Rotation.random(NUM, random_state=0).as_quat()
    return q


@functools.cache
def found_contacts():
    """Distances and pairs of geoms of all contacts in these poses."""
    model = tasks.make(NAME).model

    @jax.jit
    @jax.vmap
    def of(q):
        state = rigid.initial_state(model, q)
        found = contacts(model, *mjx_data(model, kinematics(model, q), state, jnp.zeros(16)))
        return found.distance, found.geoms

    distance, geoms = of(jnp.float32(poses()))
    return np.asarray(distance), np.asarray(geoms)[0]


def test_everything_that_overlaps_touches_and_as_deep():
    """By MuJoCo: no overlap of two links, a link and the palm, or the cube and any of them is missed."""
    mj = tasks.make(NAME).model.static.mj
    distance, geoms = found_contacts()
    column = {frozenset(map(int, pair)): k for k, pair in enumerate(geoms)}
    data, seen, errors = mujoco.MjData(mj), set(), []
    pairs = [pair for pair in itertools.combinations(solid(), 2) if not are_neighbours(mj, *pair)]
    for i, q in enumerate(poses()):
        data.qpos[:] = q
        mujoco.mj_kinematics(mj, data)
        for a, b in pairs:
            apart = np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b]) - mj.geom_rbound[a] - mj.geom_rbound[b]
            depth = -mujoco.mj_geomDistance(mj, data, a, b, 1.0, None) if apart < 0 else 0.0
            if depth > 1e-5:
                names = frozenset((mj.geom(a).name, mj.geom(b).name))
                assert frozenset((a, b)) in column, f"{names} overlap by {depth}, but do not touch"
                ours = -float(distance[i, column[frozenset((a, b))]])
                assert ours > 0.0, f"{names} overlap by {depth}, but are apart by {-ours}"
                seen.add(names)
                errors.append(ours - depth)
    print(len(seen), len(errors), np.quantile(errors, [0.0, 0.01, 0.5, 0.99, 1.0]))
    # Of a sphere in a box MuJoCo's depth is that of the nearest point; edges almost parallel count a little late.
    assert len(seen) > 50 and np.mean(np.abs(errors) < 1e-5) > 0.95 and np.abs(errors).max() < 2e-3


def test_pairs_are_boxes_and_tips_and_corners_on_the_palm():
    mj = tasks.make(NAME).model.static.mj
    pairs = [frozenset(mj.geom(g).name for g in pair) for pair in zip(mj.pair_geom1, mj.pair_geom2, strict=True)]
    assert len(set(pairs)) == len(pairs) == 123 and not mj.geom_contype.any() and not mj.geom_conaffinity.any()
    corners = [f"cube_{i}" for i in range(1, 9)]
    for corner in corners:
        np.testing.assert_allclose(np.abs(mj.geom(corner).pos) + mj.geom(corner).size[0], 0.0325, atol=1e-9)
    whole = {mj.geom(g).name for g in solid()}
    assert {frozenset(("cube", geom)) for geom in whole - {"cube"}} <= set(pairs)
    assert {pair for pair in pairs if not pair <= whole} == {frozenset((corner, "palm")) for corner in corners}
    np.testing.assert_allclose(tasks.make(NAME).model.parameters["pair_friction"][:, :2], 0.5)


def test_the_hand_is_softer_with_itself_than_with_the_cube():
    for scale in ("paper", "small"):
        law = tasks.make(NAME, scale).model.penalty
        assert law.boxes_touch_once and float(law.among.stiffness) == 2000.0 and float(law.stiffness) >= 5000.0


def test_the_thumb_presses_on_the_palm_from_the_start():
    """Its proximal box is in the palm's by some millimetres, whatever the start."""
    env, q = tasks.make(NAME), tasks.starts(NAME, 64)[0]
    of = jax.jit(jax.vmap(lambda q: rigid.contact_distances(env.model, rigid.initial_state(env.model, q), body="palm")))
    deepest = np.asarray(of(q)).min(axis=1)
    print(np.quantile(deepest, [0.0, 0.5, 1.0]))
    assert np.all((deepest < -1e-3) & (deepest > -0.012))


def test_distances_of_a_body_that_is_not_there_are_refused():
    env = tasks.make(NAME)
    with pytest.raises(ValueError, match="no body 'dice': known are"):
        rigid.contact_distances(env.model, rigid.initial_state(env.model), body="dice")


def test_the_cube_rests_on_the_palm():
    """Flat on four corners: 0.5 kg on as many springs, and nowhere deeper than 2 mm."""
    env, first, rng = tasks.make(NAME), tasks.start(NAME), np.random.default_rng(7)
    palm = env.model.static.mj.body("palm")
    frame = Rotation.from_quat(palm.quat[[1, 2, 3, 0]])
    local = np.array([0.0111 + 0.0325, -0.015, -0.043]) + rng.uniform(-3e-3, 3e-3, (8, 3)) * [0, 1, 1]
    q = np.array(first.physics.rigid.qpos)
    q[:, :16], q[:, 0] = 0.0, 0.3
    q[:, 16:19] = palm.pos + frame.apply(local)
    q[:, 19:] = (frame * Rotation.from_euler("x", rng.uniform(-0.05, 0.05, (8, 1)))).as_quat()[:, [3, 0, 1, 2]]
    bodies = first.physics.rigid.replace(qpos=jnp.float32(q), qvel=0.0 * first.physics.rigid.qvel)
    state = first.replace(physics=first.physics.replace(rigid=bodies))
    for _ in range(60):
        state = tasks.step(NAME)(state, jnp.zeros((8, 16)))
    distances = jax.jit(jax.vmap(lambda s: rigid.contact_distances(env.model, s, body="cube")))
    depth = -np.asarray(distances(state.physics.rigid)).min(axis=1)
    speed = np.linalg.norm(state.physics.rigid.qvel[:, 16:], axis=1)
    print(depth, speed)
    assert speed.max() < 0.1 and depth.max() < 2e-3 and depth.min() > 0.0
