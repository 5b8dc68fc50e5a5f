"""Options given to load: they are heeded, wrong ones are named, what has no effect on the motion is left out."""

import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models
from rigid_cases import hop

from rewax.physics import rigid
from rewax.physics.rigid.overrides import moving_geoms, with_overrides
from rewax.physics.rigid.spring_contacts import Penalty

REFUSED_AS_WRITTEN = """<mujoco><option integrator="RK4" cone="elliptic" noslip_iterations="3" timestep="0.003" iterations="7" solver="PGS"
  gravity="0 0 -2"><flag energy="enable" fwdinv="enable" sleep="enable"/></option><worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <body name="ball" pos="0 0 .3"><freejoint/><geom size=".1"/></body></worldbody>
  <sensor><accelerometer site="eye"/></sensor></mujoco>"""


def test_a_model_that_is_refused_loads_with_overrides(x64):
    text = REFUSED_AS_WRITTEN.replace('<geom size=".1"/>', '<geom size=".1"/><site name="eye"/>')
    given = {"integrator": "implicitfast", "cone": "pyramidal", "noslip_iterations": 0, "flags": {"sleep": False}}
    for left_out in given:
        with pytest.raises(ValueError, match=r"load\(\.\.\., "):
            rigid.load(text, **{name: value for name, value in given.items() if name != left_out})
    model = rigid.load(text, dt=0.002, gravity=(0, 0, -3.0), iterations=9, impratio=2.0, **given)
    option = model.static.mj.opt
    assert (option.timestep, option.iterations, option.impratio, option.noslip_iterations) == (0.002, 9, 2.0, 0)
    assert (option.integrator, option.cone) == (
        mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
        mujoco.mjtCone.mjCONE_PYRAMIDAL,
    )
    np.testing.assert_array_equal(model.gravity, [0, 0, -3.0])
    np.testing.assert_allclose(rigid.step(model, rigid.initial_state(model)).qvel[2], -3.0 * 0.002, rtol=1e-12)


def test_flags_are_those_of_mjcf():
    mj = mujoco.MjModel.from_xml_string(rigid_models.ball())
    changed = with_overrides(mj, {"flags": {"gravity": False, "energy": True, "contact": True, "filterparent": False}})
    bits = mujoco.mjtDisableBit
    assert changed.opt.disableflags == int(bits.mjDSBL_GRAVITY) | int(bits.mjDSBL_FILTERPARENT)
    assert changed.opt.enableflags == int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    back = with_overrides(changed, {"flags": {"gravity": True, "filterparent": True, "energy": False}})
    assert back.opt.disableflags == back.opt.enableflags == 0
    assert mj.opt.disableflags == 0 and with_overrides(mj, {}) is mj


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ({"integrator": "RK4"}, "integrator is 'RK4': use one of 'Euler', 'implicitfast'"),
        ({"cone": "round"}, "cone is 'round': use one of 'pyramidal', 'elliptic'"),
        ({"timestep": 0.1}, "load has no override 'timestep': known are cone, density, flags, gravity, impratio, "),
        ({"gravity": 9.81}, "gravity has shape (): give an array of shape (3,)"),
        ({"density": -1.0}, "density is -1.0, but must be 0 or more: give it in kg/m^3"),
        ({"iterations": 2.5}, "iterations is 2.5: give an integer"),
        ({"flags": {"gravy": True}}, "MuJoCo has no flag 'gravy': known are actuation, "),
        (
            {"max_geom_pairs": 4},
            "the model has no max_geom_pairs to change: write <custom><numeric name='max_geom_pairs' ",
        ),
        ({"max_contact_points": 0}, "max_contact_points is 0: give an integer, at least 1, or None for no limit"),
    ],
)
def test_wrong_overrides_are_named(overrides, sentence):
    with pytest.raises(ValueError, match="^" + re.escape(sentence)):
        rigid.load(rigid_models.ball(), **overrides)


def test_an_elliptic_cone_means_nothing_to_a_penalty():
    model = rigid.load(rigid_models.ball(), penalty=Penalty(stiffness=1e4), cone="elliptic")
    assert model.penalty is not None


DRESSED = """<asset><mesh name="gem" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/><hfield name="hill" nrow="2" ncol="2" size="1 1 1 1"/></asset>
<worldbody><geom type="hfield" hfield="hill" contype="0" conaffinity="0"/><geom type="mesh" mesh="gem" contype="0" conaffinity="0"/>"""
SENSORS = """<sensor><framepos objtype="body" objname="ball"/><subtreeangmom body="ball"/><touch site="eye"/><clock/>
<contact body1="ball" reduce="netforce" num="1" data="force"/></sensor></mujoco>"""


def test_what_only_shows_or_measures_is_left_out(x64):
    """Meshes, height fields, sensors that MJX knows not, energy: the same motion, and no poses of these geoms."""
    plain = rigid_models.ball()
    dressed = plain.replace("<worldbody>", DRESSED).replace("</mujoco>", SENSORS)
    dressed = dressed.replace('<geom name="ball"', '<site name="eye" size=".1"/><geom type="mesh" mesh="gem" mass="0" contype="0"'
                              ' conaffinity="0"/><geom name="ball"')  # fmt: skip
    mj = mujoco.MjModel.from_xml_string(dressed)
    mj.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY) | int(mujoco.mjtEnableBit.mjENBL_FWDINV)
    models = [rigid.load(plain), rigid.load(mj)]
    names = [{model.static.mj.geom(g).name for g in model.static.moving_geoms} for model in models]
    assert names == [{"floor", "ball"}] * 2 and mj.ngeom == 5
    ends = []
    for model in models:
        state = rigid.initial_state(model, model.home.at[2].set(0.095), jnp.arange(6) * 0.3)
        ends.append(hop(model, state, jnp.zeros(0)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15), *ends)


def test_geoms_that_tendons_wrap_count():
    mj = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><site name="a" pos="-1 0 1"/>
      <geom name="drum" type="cylinder" size=".1 .1" contype="0" conaffinity="0"/><geom name="sign" size=".1" contype="0" conaffinity="0"/>
      <body pos="1 0 0"><joint type="slide"/><geom name="bob" size=".1" contype="0" conaffinity="0"/><site name="b"/></body></worldbody>
      <tendon><spatial><site site="a"/><geom geom="drum"/><site site="b"/></spatial></tendon></mujoco>""")
    assert [mj.geom(g).name for g in moving_geoms(mj)] == ["drum"]
