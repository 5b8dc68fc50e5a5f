"""Margins, friction and stiffness of contacts: MuJoCo's in C, and MJX's to the bit; derivatives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from rewax.physics.rigid.contact_parameters import contact_parameters
from rewax.physics.rigid.geom_pairs import geom_pairs

KINDS = (
    'friction=".7 .01 .002" margin=".003" solref=".03 1.1" solimp=".8 .9 .01 .5 2"', 'solmix="3" solref="-500 -20"',
    'solmix="0" friction="0 .1 .1"', 'priority="2" friction=".2 .1 .1" solref=".05 .9"',
    'priority="1" solimp=".7 .8 .02 .4 3"', 'solmix="0" margin=".001"',
)  # fmt: skip
LISTED = """<pair geom1="g0" geom2="g1" friction="0 .5 .1 .2 .3" margin=".002" solref=".04 1" solreffriction=".1 1"/>
<pair geom1="g4" geom2="g2" solimp=".6 .7 .03 .3 4"/>"""
BODIES = "".join(f'<body><freejoint/><geom name="g{i}" size=".1" {text}/></body>' for i, text in enumerate(KINDS))
WORLD = f"<mujoco><worldbody>{BODIES}</worldbody><contact>{LISTED}</contact></mujoco>"


def test_parameters_are_those_of_mujoco_and_of_mjx(x64):
    """Six spheres of different kinds at one place: all fifteen pairs, two of them explicit."""
    mj = mujoco.MjModel.from_xml_string(WORLD)
    data, m = mujoco.MjData(mj), mjx.put_model(mj, impl="jax")
    mujoco.mj_kinematics(mj, data)
    mujoco.mj_collision(mj, data)
    in_c = {tuple(sorted(c.geom)): c for c in data.contact}
    (group,) = geom_pairs(mj, np.arange(mj.npair))
    ours = contact_parameters(mj, m, group)
    (theirs,) = collision_driver._contact_groups(m, mjx.make_data(mj, impl="jax")).values()
    names = ("includemargin", "friction", "solref", "solreffriction", "solimp")
    for value, name in zip(ours, names, strict=True):
        np.testing.assert_array_equal(value, getattr(theirs, name), err_msg=name)
    assert len(group.geoms) == len(in_c) == 15
    for i, geoms in enumerate(group.geoms):
        c = in_c[tuple(sorted(geoms))]
        expected = (c.includemargin, np.maximum(c.friction, 0), c.solref, c.solreffriction, c.solimp)
        for value, number, name in zip(ours, expected, names, strict=True):
            np.testing.assert_allclose(
                value[i], number, rtol=1e-12, atol=1e-4 if name == "friction" else 0, err_msg=name
            )


def test_derivatives_of_what_is_mixed(x64, central_difference):
    """By friction and stiffness of geoms of all priorities: friction is the larger, the rest a weighted mean."""
    mj = mujoco.MjModel.from_xml_string(WORLD)
    (group,), m = geom_pairs(mj, np.arange(mj.npair)), mjx.put_model(mj, impl="jax")
    weights = jax.random.normal(jax.random.key(0), (15, 15))

    def total(x):
        numbers = {
            name: getattr(m, name) * (1.0 + x[i])
            for i, name in enumerate(("geom_friction", "geom_solref", "geom_solimp"))
        }
        parts = contact_parameters(mj, m.replace(**numbers), group)
        return jnp.sum(weights * jnp.column_stack(parts))

    x = jnp.array([0.1, 0.05, -0.02])
    slope = jax.grad(total)(x)
    for i in range(3):
        np.testing.assert_allclose(slope[i], central_difference(total, x, jnp.eye(3)[i]), rtol=1e-7)
