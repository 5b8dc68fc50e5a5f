"""Models that cannot be simulated are refused with a sentence that names what is wrong and what to do about it."""

import re

import mujoco
import numpy as np
import pytest
import rigid_models

from rewax.physics import rigid
from rewax.physics.rigid import mjcf, model
from rewax.physics.rigid.spring_contacts import Penalty

PENALTY = Penalty(stiffness=1e4)


def tiny(
    option: str = "",
    flag: str = "",
    joint: str = "",
    body: str = "",
    geom: str = "",
    tendon: str = "",
    motor: str = "",
    actuator: str = "",
    extra: str = "",
) -> str:
    """A pendulum over a floor with a tendon and a motor."""
    return f"""<mujoco><compiler autolimits="true"/><option {option}><flag {flag}/></option><worldbody>
      <geom name="floor" type="plane" size="1 1 1"/>
      <body name="arm" pos="0 0 1"><joint name="swing" {joint}/><geom name="rod" size=".1" {geom}/><site name="tip"/>{body}</body>
    </worldbody><tendon><fixed name="cord" {tendon}><joint joint="swing" coef="1"/></fixed></tendon>
    <actuator><motor name="pull" joint="swing" {motor}/>{actuator}</actuator>{extra}</mujoco>"""  # fmt: skip


REFUSED = {
    "rk4": (
        tiny(option='integrator="RK4"'),
        "the model's integrator is RK4, which is not supported: load(..., integrator=\"Euler\"), or \"implicitfast\"",
    ),
    "implicit": (
        tiny(option='integrator="implicit"'),
        "the model's integrator is IMPLICIT, which is not supported: load(..., integrator=\"Euler\"), or \"implicitfast\"",
    ),
    "fast_in_air": (
        tiny(option='integrator="implicitfast" density="1.2"'),
        "the model's integrator is IMPLICITFAST in a medium with drag, which is not supported: load(..., "
        'integrator="Euler"), or density=0.0, viscosity=0.0',
    ),
    "elliptic": (
        tiny(option='cone="elliptic"'),
        'the model\'s friction cone is elliptic, for which gradients are not finite: load(..., cone="pyramidal"), or with '
        "a Penalty",
    ),
    "noslip": (
        tiny(option='noslip_iterations="3"'),
        "the model has noslip_iterations, which are not supported: load(..., noslip_iterations=0)",
    ),
    "group": (
        tiny(option='actuatorgroupdisable="1"'),
        "the model has an actuatorgroupdisable, which is not supported: remove it, or the actuators",
    ),
    "sleeping": (
        tiny(flag='sleep="enable"'),
        'the model lets bodies sleep, which is not supported: load(..., flags={"sleep": False})',
    ),
    **{
        flag: (
            tiny(flag=f'{flag}="enable"'),
            f'the model enables the flag {flag}, which is not supported: load(..., flags={{"{flag}": False}})',
        )
        for flag in ("override", "diagexact", "speculative")
    },
    "turned_site": (
        tiny(body='<site name="root"/>', actuator='<motor name="twist" site="tip" refsite="root" gear="0 0 0 1 0 0"/>'),
        "actuator 'twist' turns a site against its refsite, which is not supported: set the last three numbers of its gear "
        "to zero, or remove the refsite",
    ),
    "springs": (
        tiny(flag='spring="disable"'),
        "the model disables its springs, which is not supported: remove the flag and set stiffness to zero",
    ),
    "dampers": (
        tiny(flag='damper="disable"'),
        "the model disables its dampers, which is not supported: remove the flag and set damping to zero",
    ),
    "still": (
        "<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>",
        "no body of the model has a joint, so nothing can move: give one a joint",
    ),
    "flex": (
        rigid_models.mjcf('<flexcomp name="f" type="grid" count="2 2 1" spacing=".1 .1 .1" dim="2"/>'),
        "the model has flexes or plugins, which are not supported: remove them",
    ),
    "crank": (
        tiny(actuator='<motor name="crank" cranksite="tip" slidersite="tip" cranklength=".1"/>'),
        "actuator 'crank' has a trntype that is not supported: use one of joint, jointinparent, site, tendon",
    ),
    "suction": (
        tiny(actuator='<adhesion name="suction" body="arm" ctrlrange="0 1"/>'),
        "actuator 'suction' has a trntype that is not supported: use one of joint, jointinparent, site, tendon",
    ),
    "user": (
        tiny(actuator='<general name="own" joint="swing" dyntype="user"/>'),
        "actuator 'own' has a dyntype that is not supported: use one of none, integrator, filter, filterexact, muscle",
    ),
    "gain": (
        tiny(actuator='<general name="own" joint="swing" gaintype="user"/>'),
        "actuator 'own' has a gaintype that is not supported: use one of fixed, affine, muscle",
    ),
    "bias": (
        tiny(actuator='<general name="own" joint="swing" biastype="user"/>'),
        "actuator 'own' has a biastype that is not supported: use one of none, affine, muscle",
    ),
    "actearly": (
        tiny(actuator='<general name="slow" joint="swing" dyntype="filter" dynprm=".1" actearly="true"/>'),
        "actuator 'slow' has actearly, which is not supported: remove it",
    ),
    "delay": (tiny(motor='delay=".02" nsample="9"'), "actuator 'pull' has a delay, which is not supported: remove it"),
    "rotor": (tiny(motor='armature=".1"'), "actuator 'pull' has an armature, which is not supported: remove it"),
    "damped": (tiny(motor='damping=".1"'), "actuator 'pull' has a damping, which is not supported: remove it"),
    "stiffness": (tiny(joint='stiffness="1 2"'), "joint 'swing' has a nonlinear stiffness, which is not supported: remove it"),
    "damping": (tiny(joint='damping="1 2"'), "joint 'swing' has a nonlinear damping, which is not supported: remove it"),
    "yield": (tiny(joint='stiffness="1" springyield=".1"'), "joint 'swing' has a springyield, which is not supported: remove it"),
    "cord": (tiny(tendon='stiffness="1 2"'), "tendon 'cord' has a nonlinear stiffness, which is not supported: remove it"),
    "cord_damping": (tiny(tendon='damping="1 2"'), "tendon 'cord' has a nonlinear damping, which is not supported: remove it"),
    "cord_mass": (tiny(tendon='armature=".1"'), "tendon 'cord' has an armature, which is not supported: remove it"),
    "cord_yield": (
        tiny(tendon='stiffness="1" springyield=".1"'),
        "tendon 'cord' has a springyield, which is not supported: remove it",
    ),
    "sticky": (tiny(geom='adhesion="1"'), "geom 'rod' has an adhesion, which is not supported: remove it"),
    "belt": (tiny(geom='surfacevel="1 0 0"'), "geom 'rod' has a surfacevel, which is not supported: remove it"),
    "swims": (tiny(geom='fluidshape="ellipsoid"'), "geom 'rod' has a fluidshape, which is not supported: remove it"),
    "pair": (
        tiny(extra='<contact><pair name="touch" geom1="floor" geom2="rod" adhesion="1"/></contact>'),
        "pair 'touch' has an adhesion, which is not supported: remove it",
    ),
    "colliding": (
        rigid_models.mjcf(
            '<geom name="can" type="cylinder" size=".1 .1"/><body><freejoint/><geom name="box" type="box" size=".1 .1 .1"/></body>',
            extra=rigid_models.touching(("can", "box")),
        ),
        "MJX does not support this model ((mjtGeom.mjGEOM_CYLINDER, mjtGeom.mjGEOM_BOX) collisions not implemented.): "
        "remove that, or set contype and conaffinity of such geoms to 0, or give contact_pairs one of these kinds",
    ),
}  # fmt: skip


def test_what_mjx_refuses_is_said(monkeypatch):
    def refuse(*args):
        raise NotImplementedError("a new feature")

    monkeypatch.setattr(model, "_Model", refuse)
    with pytest.raises(ValueError, match=r"MJX does not support this model \(a new feature\): remove that, or set"):
        rigid.load(tiny())


@pytest.mark.parametrize("what", REFUSED)
def test_unsupported_models_are_refused(what):
    text, sentence = REFUSED[what]
    with pytest.raises(ValueError, match="^" + re.escape(sentence) + "$"):
        rigid.load(text)


def test_the_tiny_model_itself_is_fine():
    model = rigid.load(tiny())
    assert (model.num_dofs, model.num_actuators, model.num_bodies) == (1, 1, 2)
    mjcf.check_model(mujoco.MjModel.from_xml_string(tiny(option='cone="elliptic"')), penalty=True)
    mjcf.check_model(mujoco.MjModel.from_xml_string(rigid_models.contraption()), penalty=False)


CANNOT_HOLD = (
    "the model has equality constraints, dry friction or tendon limits, which a Penalty does not support: remove them, or load "
    "it without a Penalty"
)
REFUSED_WITH_PENALTY = {
    "uneven": (
        tiny(extra='<contact><pair name="skate" geom1="floor" geom2="rod" friction=".1 .9"/></contact>'),
        "pair 'skate' has two coefficients of sliding friction, but a Penalty has one: make them equal",
    ),
    "rolling_pair": (
        tiny(extra='<contact><pair name="skate" geom1="floor" geom2="rod" condim="6"/></contact>'),
        "pair 'skate' has a condim above 3, but a Penalty has no torsional or rolling friction: give that pair condim 3",
    ),
    "rolling_geom": (
        tiny(geom='condim="4"'),
        "geom 'rod' has a condim above 3, but a Penalty has no torsional or rolling friction: give that geom condim 3",
    ),
    "ball": (
        rigid_models.mjcf('<body><joint name="neck" type="ball" range="0 1"/><geom size=".1"/></body>'),
        "joint 'neck' is a ball joint with a limit, which a Penalty does not support: remove the limit",
    ),
    "equality": (tiny(extra='<equality><joint joint1="swing"/></equality>'), CANNOT_HOLD),
    "friction": (tiny(joint='frictionloss=".1"'), CANNOT_HOLD),
    "cord_limit": (tiny(tendon='range="0 1"'), CANNOT_HOLD),
    "cord_friction": (tiny(tendon='frictionloss=".1"'), CANNOT_HOLD),
    "flag": (
        tiny(flag='limit="disable"'),
        "the model disables limits or all constraints, which a Penalty does not: remove the flag and unwanted ranges and contacts",
    ),
}


@pytest.mark.parametrize("what", REFUSED_WITH_PENALTY)
def test_models_that_a_penalty_cannot_hold_are_refused(what):
    text, sentence = REFUSED_WITH_PENALTY[what]
    mjcf.check_model(mujoco.MjModel.from_xml_string(text), penalty=False)
    with pytest.raises(ValueError, match="^" + re.escape(sentence) + "$"):
        rigid.load(text, penalty=PENALTY)


def test_a_list_in_a_penalty_is_refused_without_a_warning():
    with pytest.raises(ValueError, match=r"^the penalty's limit_damping has shape \(1, 0\): give one number$"):
        rigid.load(tiny(), penalty=Penalty(stiffness=1e4, limit_damping=[[]]))


def test_what_is_not_a_model(tmp_path):
    asked = "give a path, MJCF text, an MjSpec or an MjModel"
    missing = tmp_path / "missing.xml"
    for source in (missing, str(missing)):
        with pytest.raises(ValueError, match=re.escape(f"there is no MJCF file {str(missing)!r}: {asked}")):
            rigid.load(source)
    with pytest.raises(ValueError, match=f"^a dict is not a model: {asked}$"):
        rigid.load({})
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody></mujoco>")
    for source in (broken, broken.read_text()):
        with pytest.raises(ValueError, match=r"^the model cannot be read: .*XML"):
            rigid.load(source)
    with pytest.raises(ValueError, match=r"^the model cannot be read: .*unrecognized attribute.*'mas'"):
        rigid.load('<mujoco><worldbody><body><joint/><geom size=".1" mas="2"/></body></worldbody></mujoco>')
    with pytest.raises(ValueError, match=r"^the model cannot be read: .*no_such.xml"):
        rigid.load('<mujoco><include file="no_such.xml"/></mujoco>')


def test_every_way_to_give_a_model(tmp_path):
    text = tiny()
    path = tmp_path / "model.xml"
    path.write_text(text)
    sources = (
        text,
        "\n  " + text,
        path,
        str(path),
        mujoco.MjSpec.from_string(text),
        mujoco.MjModel.from_xml_string(text),
    )
    first, *others = (mjcf.compile_model(source) for source in sources)
    for other in others:
        np.testing.assert_array_equal(other.body_mass, first.body_mass)
        assert (other.nq, other.nu, other.njnt) == (first.nq, first.nu, first.njnt)


def test_a_gear_that_turns_a_site_against_its_refsite_is_refused_later_too():
    model = rigid.load(
        tiny(body='<site name="root"/>', actuator='<motor name="twist" site="tip" refsite="root" gear="1 0 0 0 0 0"/>')
    )
    gear = model.parameters["actuator_gear"]
    model.with_parameters(actuator_gear=2.0 * gear)
    with pytest.raises(ValueError, match=r"^actuator 'twist' turns a site against its refsite, which is not supported"):
        model.with_parameters(actuator_gear=gear.at[-1, 3].set(1.0))
