"""What MJX is shown of a model: the geoms that it has to collide touch, and no others; nothing else changes."""

import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from rewax.physics.rigid.geom_pairs import geom_pairs
from rewax.physics.rigid.shown_to_mjx import with_groups_that_touch, with_one_group, without_contacts

WORLD = """<mujoco><custom><numeric name="max_contact_points" data="2"/><numeric name="max_geom_pairs" data="3"/></custom>
<asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/><mesh name="n" vertex="0 0 0 .2 0 0 0 .1 0 0 0 .1"/></asset>
<worldbody><geom name="floor" type="plane" size="9 9 9"/>
<body><freejoint/><geom name="can" type="cylinder" size=".1 .1" margin=".01"/><geom type="mesh" mesh="m" contype="2" conaffinity="0"/></body>
<body><freejoint/><geom name="box" type="box" size=".1 .1 .1" conaffinity="3"/></body><body><freejoint/><geom name="egg" type="ellipsoid" size=".1 .1 .1"/></body>
<body><freejoint/><geom name="idle" type="mesh" mesh="n" contype="0" conaffinity="0"/></body>
</worldbody><contact><pair geom1="can" geom2="box"/><pair geom1="egg" geom2="floor" condim="1"/><pair geom1="floor" geom2="box"/></contact></mujoco>"""
REFUSED = {("cylinder", "box"), ("ellipsoid", "box"), ("plane", "box")}
"""By MJX, but for the last."""


@pytest.fixture
def shown():
    """The model, the groups that MJX has to find, and what it is shown."""
    mj = mujoco.MjModel.from_xml_string(WORLD)
    groups = geom_pairs(mj, np.arange(mj.npair))
    theirs = [group for group in groups if group.kinds not in REFUSED]
    return mj, theirs, with_groups_that_touch(mj, theirs)


def test_kinds_that_mjx_lacks_do_not_touch(shown):
    mj, theirs, copy = shown
    with pytest.raises(NotImplementedError, match="collisions not implemented"):
        mjx.put_model(mj, impl="jax")
    m = mjx.put_model(copy, impl="jax")
    wanted = {(group.kinds, *geoms) for group in theirs for geoms in group.geoms}
    touching = {(first, second) for first, second, pair in collision_driver.geom_pairs(copy) if first != second}
    assert {pair[1:] for pair in wanted} <= touching
    kinds = {tuple(sorted(int(mj.geom_type[g]) for g in pair)) for pair in touching}
    assert kinds == {tuple(sorted(int(mj.geom_type[g]) for g in pair[1:])) for pair in wanted}
    assert [convex is not None for convex in m._impl.mesh_convex] == [True, False]  # the mesh that touches nothing
    assert mj.npair == 3 and mj.geom("can").margin == 0.01 and np.any(mj.geom_contype)  # the model is as it was


def test_nothing_touches_in_the_model_of_mjx(shown):
    _, _, copy = shown
    m = without_contacts(copy, mjx.put_model(copy, impl="jax"))
    data = mjx.make_data(m, impl="jax")
    assert data._impl.ncon == 0 and collision_driver._geom_groups(m) == {}
    assert m.numeric_data.tolist() == [-1.0, 3.0] and copy.numeric_data.tolist() == [2.0, 3.0]


def test_one_group_is_one_call(x64, shown):
    """MJX then finds this group, with each contact's pair in place of its margin; all floats are of one type."""
    _, theirs, copy = shown
    m = without_contacts(copy, mjx.put_model(copy, impl="jax"))
    for group in theirs:
        one = with_one_group(m, group)
        ((key, pairs),) = collision_driver._geom_groups(one).items()
        assert key.condim == group.condim and one.pair_friction.dtype == one.pair_solimp.dtype == np.float64
        np.testing.assert_array_equal([pair[:2] for pair in pairs], group.geoms)
        (contact,) = collision_driver._contact_groups(one, mjx.make_data(one, impl="jax")).values()
        np.testing.assert_array_equal(contact.includemargin, np.arange(len(group.geoms)))
    assert len(theirs) >= 4 and jax.tree.structure(m) != jax.tree.structure(one)
