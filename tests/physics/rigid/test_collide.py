"""Contacts of a model: a user's pair is used, MJX's own are as MJX gives them, and MJX itself stays as it is."""

import functools
import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from rewax.physics import rigid
from rewax.physics.rigid import ContactPair, Penalty, forces
from rewax.physics.rigid.collide import collide
from rewax.physics.shapes import Cylinder, signed_distance
from rewax.xla_options import unoptimised

FIELDS = ("dist", "pos", "frame", "includemargin", "friction", "solref", "solimp", "geom")


def sphere_cylinder(sphere, cylinder):
    """By the cylinder's signed distance; shapes lie along y, geoms along z."""
    x, y, z = cylinder.rotation.T @ (sphere.position - cylinder.position)
    shape = Cylinder(radius=cylinder.size[0], half_length=cylinder.size[1])
    distance, (u, v, w) = signed_distance(shape, jnp.stack([x, z, -y]))
    normal = -cylinder.rotation @ jnp.stack([u, -w, v])
    distance = distance - sphere.size[0]
    return distance, sphere.position + normal * (sphere.size[0] + 0.5 * distance), normal


def cylinder_box(cylinder, box):
    """No contact but that of the cylinder's center."""
    across = box.position - cylinder.position
    distance = jnp.sqrt(jnp.sum(across**2))
    return distance, cylinder.position + 0.5 * across, across / distance


CAN = ContactPair(("sphere", "cylinder"), 1, sphere_cylinder)
IN_BOX = ContactPair(("cylinder", "box"), 1, cylinder_box)


def found_in(model, qpos):
    """All contacts at one or many positions."""

    @functools.partial(jax.jit, compiler_options=unoptimised())
    @jax.vmap
    def contacts(qpos):
        kin, state = forces.kinematics(model, qpos), rigid.initial_state(model, qpos)
        m, d = forces.mjx_data(model, kin, state, jnp.zeros(0))
        return collide(model.static.collisions, m, d)

    return contacts(jnp.atleast_2d(jnp.asarray(qpos)))


def poses(num, bodies, seed=0, reach=0.12):
    """Positions of free bodies that overlap at random."""
    rng, qpos = np.random.default_rng(seed), np.zeros((num, bodies, 7))
    turn = rng.standard_normal((num, bodies, 4))
    qpos[..., :3] = rng.uniform(-reach, reach, (num, bodies, 3)) + [0, 0, reach]
    qpos[..., 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    return qpos.reshape(num, 7 * bodies)


ON_CANS = """<mujoco><worldbody><body><freejoint/><geom size=".06" margin=".004"/></body>
<body><freejoint/><geom type="cylinder" size=".05 .08"/></body><body><freejoint/><geom size=".04"/></body></worldbody></mujoco>"""


def test_a_pair_of_the_user_is_mujocos(x64):
    """Spheres on a cylinder: MuJoCo finds the nearest point in C, MJX iterates."""
    mj = mujoco.MjModel.from_xml_string(ON_CANS)
    model, data, qpos = rigid.load(mj, contact_pairs=[CAN]), mujoco.MjData(mj), poses(40, 3)
    ours, theirs, touched = found_in(model, qpos), found_in(rigid.load(mj), qpos), 0
    error = 0.0
    for i in range(len(qpos)):
        data.qpos[:] = qpos[i]
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_collision(mj, data)
        for c in data.contact:
            (row,) = np.flatnonzero((np.asarray(ours.geom[i]) == c.geom).all(axis=1))
            np.testing.assert_allclose(ours.dist[i, row], c.dist, atol=1e-9)
            error = max(error, abs(float(theirs.dist[i, row]) - c.dist))
            inside = 1 in c.geom and np.abs(data.geom_xmat[1].reshape(3, 3).T @ (c.pos - data.geom_xpos[1]))[2] > 0.079
            if not inside:  # where the nearest face is the cap or the side
                np.testing.assert_allclose(ours.frame[i, row].ravel(), c.frame, atol=1e-6)
                np.testing.assert_allclose(ours.pos[i, row], c.pos, atol=1e-7)
            touched += 1
    assert touched > 20 and error > 1e-7


def test_kinds_that_mjx_lacks_are_loaded_with_a_pair_of_the_user(x64):
    """A can, a box and a stone that all may touch: without the pair MJX refuses the model."""
    text = """<mujoco><asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset><worldbody>
    <geom type="plane" size="9 9 9"/><body><freejoint/><geom name="can" type="cylinder" size=".1 .1" margin=".01"/></body>
    <body><freejoint/><geom name="box" type="box" size=".1 .1 .1"/></body><body><freejoint/><geom type="mesh" mesh="m"/></body>
    </worldbody><contact>{}</contact></mujoco>"""
    pair = '<pair geom1="box" geom2="can" condim="1" margin=".02"/>'
    for extra, margin in (("", 0.01), (pair, 0.02)):
        text_ = text.format(extra).replace('mesh="m"/></body>', 'mesh="m" contype="2" conaffinity="0"/></body>')
        text_ = text_.replace('type="box"', 'type="box" conaffinity="3"')
        with pytest.raises(ValueError, match=r"collisions not implemented.*or give contact_pairs one of these kinds"):
            rigid.load(text_)
        model = rigid.load(text_, contact_pairs=[IN_BOX])
        qpos = np.concatenate([[0, 0, 3, 1, 0, 0, 0], [0.3, 0.4, 3, 1, 0, 0, 0], [0, 0, 9, 1, 0, 0, 0]])
        contact = found_in(model, qpos)
        (row,) = np.flatnonzero((np.asarray(contact.geom[0]) == [1, 2]).all(axis=1))
        np.testing.assert_allclose(contact.dist[0, row], 0.5)
        np.testing.assert_allclose(contact.frame[0, row, 0], [0.6, 0.8, 0.0], atol=1e-15)
        np.testing.assert_allclose(contact.includemargin[0, row], margin)
        meshes = np.asarray(contact.geom[0])[(np.asarray(contact.geom[0]) == 3).any(axis=1)]
        assert {tuple(map(int, geoms)) for geoms in meshes} == {(2, 3)}


def test_a_pair_of_the_user_comes_before_those_built_in(x64):
    """Under both laws, explicit pairs among them; a step then follows it: at this distance nothing pushes."""
    far = ContactPair(("capsule", "capsule"), 1, lambda a, b: (jnp.array(0.5), a.position, jnp.array([0.0, 0.0, 1.0])))
    text = """<mujoco><option gravity="0 0 0"/><worldbody><body><freejoint/><geom name="a" type="capsule" size=".1 .1"/></body>
    <body pos=".1 0 0"><freejoint/><geom name="b" type="capsule" size=".1 .1"/></body></worldbody>{}</mujoco>"""
    listed = '<contact><pair geom1="a" geom2="b"/></contact>'
    for law in (None, Penalty(stiffness=1e4)):
        for extra in ("", listed):
            other = text.format(extra)
            if extra:
                other = other.replace("/></body>", ' contype="0" conaffinity="0"/></body>')
            moved = []
            for pairs in ((), (far,)):
                model = rigid.load(other, dt=1e-3, penalty=law, contact_pairs=pairs)
                end = jax.jit(rigid.step, compiler_options=unoptimised())(model, rigid.initial_state(model))
                moved.append(float(jnp.abs(end.qvel).max()))
                if pairs:
                    np.testing.assert_allclose(rigid.contact_distances(model, rigid.initial_state(model)), [0.5])
            assert moved[0] > 0.01 and moved[1] == 0.0


HEAP = """<mujoco>{}<asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset><worldbody><geom type="plane" size="9 9 9" solmix="2"/>
<body name="a"><freejoint/><geom name="a" size=".06"/></body><body name="b"><freejoint/><geom name="b" size=".05" priority="1" condim="4"/></body>
<body name="c"><freejoint/><geom type="mesh" mesh="m"/></body><body name="d"><freejoint/><geom name="d" size=".04" friction=".3"/></body>
</worldbody><contact><pair geom1="d" geom2="a" condim="1" friction="0 0 0 0 0" margin=".003"/><exclude body1="b" body2="d"/></contact></mujoco>"""
LIMITS = {
    "all": "",
    "points": '<custom><numeric name="max_contact_points" data="3"/></custom>',
    "pairs": '<custom><numeric name="max_geom_pairs" data="1"/></custom>',
    "both": '<custom><numeric name="max_geom_pairs" data="2"/><numeric name="max_contact_points" data="2"/></custom>',
    "none": '<option><flag contact="disable"/></option>',
}


@pytest.mark.parametrize("limits", LIMITS)
def test_contacts_of_mjx_are_as_mjx_gives_them(limits):
    """To the bit, in its order, with its parameters, and with its limits; of explicit pairs and without excluded ones."""
    mj = mujoco.MjModel.from_xml_string(HEAP.format(LIMITS[limits]))
    model, m, qpos = rigid.load(mj), mjx.put_model(mj, impl="jax"), jnp.asarray(poses(16, 4), jnp.float32)

    @functools.partial(jax.jit, compiler_options=unoptimised())
    @jax.vmap
    def both(qpos):
        kin, state = forces.kinematics(model, qpos), rigid.initial_state(model, qpos)
        ours, d = forces.mjx_data(model, kin, state, jnp.zeros(0))
        stock = mjx.make_data(mj, impl="jax").replace(geom_xpos=d.geom_xpos, geom_xmat=d.geom_xmat)
        return collide(model.static.collisions, ours, d), mjx.collision(m, stock)._impl.contact

    ours, theirs = both(qpos)
    np.testing.assert_array_equal(ours.dim, theirs.dim)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    most = {"all": 12, "points": 7, "pairs": 11, "both": 5, "none": 0}[limits]
    assert ours.dist.shape == (16, len(ours.dim)) and len(ours.dim) == most
    assert limits == "none" or float(ours.dist.min()) < 0.0


SIZES = {"sphere": ".1", "capsule": ".1 .1", "cylinder": ".1 .1", "box": ".1 .1 .1", "ellipsoid": ".1 .1 .1"}


@pytest.mark.parametrize("kind", ["sphere", "capsule", "box", "ellipsoid"])
def test_the_nearest_pairs_are_those_of_the_present_sizes(kind):
    """The middle body is nearer to the first one, until the third one grows and meets it."""
    bodies = "".join(
        f'<body pos="{x} 0 0"><freejoint/><geom type="{kind}" size="{SIZES[kind]}"/></body>' for x in (-0.6, 0.0, 0.9)
    )
    text = f'<mujoco><custom><numeric name="max_geom_pairs" data="1"/></custom><worldbody>{bodies}</worldbody></mujoco>'
    model = rigid.load(text)
    grown = model.with_parameters(geom_size=model.parameters["geom_size"].at[2].multiply(9.5))
    distance = jax.jit(rigid.contact_distances, compiler_options=unoptimised())
    assert float(distance(model, rigid.initial_state(model)).min()) > 0.0
    assert float(distance(grown, rigid.initial_state(grown)).min()) < 0.0


CUBE = """<mujoco>{}<worldbody><geom type="plane" size="9 9 9"/><body pos="0 0 .07"><freejoint/>
<geom type="box" size=".05 .06 .07"/></body></worldbody></mujoco>"""


def test_contacts_may_be_limited_as_in_mjx_and_the_limit_lifted(x64):
    """Four corners of a cube on a plane; of these, the two deepest."""
    custom = '<custom><numeric name="max_contact_points" data="2"/></custom>'
    text = CUBE.format(custom)
    for overrides, count in (({}, 2), ({"max_contact_points": 3}, 3), ({"max_contact_points": None}, 4)):
        model = rigid.load(text, **overrides)
        state = rigid.initial_state(model, model.home.at[2].set(0.069))
        distance = jax.jit(rigid.contact_distances)(model, state)
        assert len(distance) == count
        np.testing.assert_allclose(distance, -0.001, atol=1e-12)


PLAIN = """<mujoco><worldbody><geom type="plane" size="9 9 9"/><body pos="0 0 .05"><freejoint/><geom type="capsule" size=".06 .08"/></body>
<body pos=".1 0 .06"><freejoint/><geom size=".07"/></body></worldbody></mujoco>"""


def test_other_users_of_mjx_are_untouched():
    """MJX's contacts are the same before a model of ours is built, while it is traced, and afterwards."""
    mj = mujoco.MjModel.from_xml_string(PLAIN)
    m, table, seen = mjx.put_model(mj, impl="jax"), dict(collision_driver._COLLISION_FUNC), []

    def stock():
        d = mjx.make_data(mj, impl="jax")
        touch = jax.jit(lambda d: mjx.collision(m, mjx.kinematics(m, d)), compiler_options=unoptimised())
        contact = touch(d)._impl.contact
        return [np.asarray(getattr(contact, name)).tobytes() for name in FIELDS]

    def threads(work):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()

    results, from_thread = [stock()], []

    def looking(first, second):
        seen.append(dict(collision_driver._COLLISION_FUNC))
        if len(from_thread) < 2:
            threads(lambda: from_thread.append((dict(collision_driver._COLLISION_FUNC), stock())))
        return between(first, second)

    def between(first, second):
        across = second.position - first.position
        length = jnp.sqrt(jnp.sum(across**2) + 1e-9)
        return length - 0.1, first.position + 0.5 * across, across / length

    model = rigid.load(PLAIN, contact_pairs=[ContactPair(("sphere", "capsule"), 1, looking)])
    results.append(stock())
    end = jax.jit(rigid.step, compiler_options=unoptimised())(model, rigid.initial_state(model))
    results.append(stock())
    assert np.isfinite(end.qpos).all() and len(seen) >= 2
    assert all(
        entries == table
        for entries in (*seen, *(entries for entries, _ in from_thread), collision_driver._COLLISION_FUNC)
    )
    assert len(from_thread) == 2 and all(result == results[0] for result in (*results, *(r for _, r in from_thread)))
