"""Which geoms may touch: those that MuJoCo says, in the groups and in the order of MJX."""

import mujoco
import numpy as np
import pytest
from mujoco.mjx._src import collision_driver

from rewax.physics.rigid.geom_pairs import geom_pairs, kind

HEIGHTS = " ".join(str(i % 3 / 3) for i in range(42))
WORLD = f"""<mujoco>{{}}<asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/>
<mesh name="n" vertex="0 0 0 .2 0 0 0 .1 0 0 0 .1"/><hfield name="h" nrow="6" ncol="7" size="1 1 .2 .1" elevation="{HEIGHTS}"/></asset>
<worldbody><geom type="hfield" hfield="h"/><geom type="plane" size="9 9 9"/><geom name="stone" size=".1" priority="1"/>
<body name="a"><freejoint/><geom name="box" type="box" size=".1 .1 .1" condim="1"/><geom type="mesh" mesh="m" pos="1 0 0"/>
  <body name="b" pos="0 0 1"><joint/><geom name="rod" type="capsule" size=".1 .1" condim="4"/><geom size=".01" pos="1 0 0"/>
    <body name="c"><joint/><geom name="ball" size=".3" contype="2" conaffinity="3"/><geom name="idle" size=".1" contype="0" conaffinity="0"/>
      <body name="d" pos="0 1 0"><geom type="mesh" mesh="n" condim="6" priority="2"/></body></body></body></body>
<body name="e"><freejoint/><geom name="last" type="box" size=".1 .1 .1" contype="2" conaffinity="1"/><geom type="mesh" mesh="m"/></body>
</worldbody><contact>{{}}</contact></mujoco>"""
LISTED = '<pair geom1="box" geom2="rod" condim="6"/><pair geom1="idle" geom2="stone"/><pair geom1="last" geom2="box"/>'
EXCLUDED = '<exclude body1="a" body2="e"/><exclude body1="world" body2="c"/>'
CASES = {
    "plain": ("", ""),
    "listed": ("", LISTED),
    "excluded": ("", LISTED + EXCLUDED),
    "parents": ('<option><flag filterparent="disable"/></option>', EXCLUDED),
    "none": ('<option><flag contact="disable"/></option>', LISTED),
}


@pytest.mark.parametrize("case", CASES)
def test_groups_are_those_of_mjx(case):
    mj = mujoco.MjModel.from_xml_string(WORLD.format(*CASES[case]))
    found = geom_pairs(mj, np.arange(mj.npair))
    if case == "none":
        assert found == () and mj.npair == 3
        return
    expected = collision_driver._geom_groups(mj)
    assert len(found) == len(expected) > 12
    for ours, (key, theirs) in zip(found, expected.items(), strict=True):
        assert ours.kinds == tuple(kind(mj, pair[i]) for pair in theirs[:1] for i in (0, 1))
        assert ours.condim == key.condim
        np.testing.assert_array_equal(np.column_stack([ours.geoms, ours.listed]), theirs)


def test_explicit_pairs_may_be_left_out():
    """The penalty law has some apart. They count as listed no more, so masks decide."""
    mj = mujoco.MjModel.from_xml_string(WORLD.format("", LISTED))
    number = next(i for i in range(3) if "idle" in {mj.geom(g).name for g in (mj.pair_geom1[i], mj.pair_geom2[i])})
    found = geom_pairs(mj, np.array([number]))
    names = [
        ({mj.geom(g).name for g in geoms}, pair)
        for group in found
        for geoms, pair in zip(group.geoms, group.listed, strict=True)
    ]
    assert [(pair, listed) for pair, listed in names if listed >= 0] == [({"idle", "stone"}, number)]
    assert ({"last", "box"}, -1) in names and not [pair for pair, _ in names if pair == {"box", "rod"}]
