"""Bad models, options and arguments: each is refused by one sentence that names what is wrong and what helps."""

import re

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rewax.physics import rigid
from rewax.physics.rigid import ContactPair, Penalty

NAN = float("nan")
HEAD = '<mujoco><option integrator="Euler" cone="pyramidal"'
ARM = '<body name="arm"><joint name="x"/><geom name="bob" size=".1"/></body><body name="hand" mocap="true"/>'


def mjcf(bodies=ARM, *, option="", more=""):
    return f"{HEAD} {option}/><worldbody>{bodies}</worldbody>{more}</mujoco>"


def edited(field, value):
    """A compiled model with another value, which MuJoCo's compiler never saw."""
    mj = mujoco.MjModel.from_xml_string(mjcf())
    getattr(mj, field)[1 if field.startswith("body") else 0] = value
    return mj


def touching(function, kinds=("sphere", "sphere")):
    return rigid.load(mjcf(), contact_pairs=[ContactPair(kinds, 1, function)])


@pytest.fixture(scope="module")
def arm():
    model = rigid.load(mjcf())
    return model, rigid.initial_state(model)


@pytest.fixture(scope="module")
def ball():
    model = rigid.load(mjcf('<body><freejoint/><geom size=".1"/></body>'), penalty=Penalty(stiffness=1e3))
    return model, rigid.initial_state(model)


WRAPPED = """<site name="a" pos="0 0 1"/><site name="b" pos=".2 0 .9"/><site name="c" pos="0 0 2"/>
<geom name="w" type="cylinder" size=".1 .2" pos="9 0 9" contype="0" conaffinity="0"/>"""
BALL = WRAPPED.replace('type="cylinder" size=".1 .2" pos="9 0 9"', 'size=".3" pos="0 0 1"')
AROUND = '<tendon><spatial><site site="a"/><geom geom="w" sidesite="{}"/><site site="c"/></spatial></tendon>'
INSIDE = (
    "a tendon wraps geom 'w', a sphere, with a sidesite that is inside it or on another body, where MJX has no finite "
    "derivative or takes another path than MuJoCo: move the sidesite outside, on the sphere's body"
)
MODELS = {
    "mass": (mjcf(ARM.replace("size", 'mass="nan" size')), "mass is 'nan' in line 1 of the MJCF: give finite numbers"),
    "gravity": (mjcf(option='gravity="0 0 nan"'), "gravity is '0 0 nan' in line 1 of the MJCF: give finite numbers"),
    "timestep": (mjcf(option='timestep="-1"'), "the model's timestep is -1.0, but must be positive: give load a dt in seconds"),
    "no time": (mjcf(option='timestep="0"'), "the model's timestep is 0.0, but must be positive: give load a dt in seconds"),
    "iterations": (mjcf(option='iterations="-3"'), "the model's iterations is -3: give an integer, at least 0"),
    "impratio": (mjcf(option='impratio="-1"'), "the model's impratio is -1.0, but must be positive: give a ratio"),
    "range": (mjcf(ARM.replace('name="x"', 'name="x" range="1 -1"')), "joint 'x' has the range 1 to -1: give the lower limit first"),
    "margin": (mjcf(ARM.replace('name="x"', 'name="x" range="-1 1" limited="true" margin="1.1"')), "joint 'x' has a margin of more than half its range, for which MJX has one constraint where MuJoCo has two: give a smaller margin"),
    "side site": (mjcf(ARM + WRAPPED, more='<tendon><spatial><site site="a"/><geom geom="w" sidesite="b"/><site site="c"/></spatial></tendon>'), "a tendon wraps geom 'w', a cylinder, with a sidesite, where MJX takes another path than MuJoCo: remove the sidesite"),
    "inner side site": (mjcf(ARM + BALL, more=AROUND.format("b")), INSIDE),
    "foreign side site": (mjcf(ARM.replace("/></body>", '/><site name="d"/></body>', 1) + BALL, more=AROUND.format("d")), INSIDE),
    "impedance": (mjcf(ARM.replace('name="x"', 'name="x" range="-1 1" limited="true" solimplimit=".1 .9 .01 .5 1.5"')), "joint 'x' has a solimp with the power 1.5, with which the gradient is not finite: give 1, 2 or another integer"),
    "limit": (mjcf(more='<custom><numeric name="max_geom_pairs" data="2.5"/></custom>'), "the model's max_geom_pairs is 2.5: give an integer, at least 0, or -1 for no limit"),
    "size": (mjcf(ARM.replace('".1"', '"-.1"')), "the model cannot be read: size 0 must be positive in geom (element name 'bob', id 0, line 1): correct the MJCF"),
    "inertia": (mjcf('<body><joint/></body>'), "the model cannot be read: mass and inertia of moving bodies must be larger than mjMINVAL (element id 1, line 1): correct the MJCF"),
    "element": ("<mujoco>\n<foo/></mujoco>", "the model cannot be read: Schema violation: unrecognized element (element 'foo', line 2): correct the MJCF"),
    "mesh": (mjcf('<body><joint/><geom type="mesh" mesh="m"/></body>'), "the model cannot be read: mesh 'm' not found in geom 0 (element id 0, line 1): correct the MJCF"),
    "long name": ("a" * 5000, f"there is no MJCF file '{200 * 'a'}': give a path, MJCF text, an MjSpec or an MjModel"),
    "massless": (edited("body_mass", 0.0), "joint 'x' moves no mass: give its body a positive mass and inertia"),
    "quaternion": (edited("body_quat", 0.0), "body_quat[1] has length 0, but must have length 1: divide by its length"),
    "axis": (edited("jnt_axis", [0.0, 0.0, 2.0]), "jnt_axis[0] has length 2, but must have length 1: divide by its length"),
}  # fmt: skip


@pytest.mark.parametrize("case", MODELS)
def test_bad_models(case):
    source, sentence = MODELS[case]
    with pytest.raises(ValueError, match="^" + re.escape(sentence) + "$"):
        rigid.load(source)


OPTIONS = {
    "dt": (lambda: {"dt": True}, "dt is True, a boolean: give the duration of a substep in seconds"),
    "large dt": (lambda: {"dt": 10**30}, "dt is 1000000000000000000000000000000, which is too large: give the duration of a substep in seconds"),
    "density": (lambda: {"density": True}, "density is True, a boolean: give it in kg/m^3"),
    "iterations": (lambda: {"iterations": True}, "iterations is True: give an integer, at least 1"),
    "integrator": (lambda: {"integrator": ["Euler"]}, "integrator is ['Euler']: use one of 'Euler', 'implicitfast'"),
    "contacts": (lambda: {"max_contact_points": True}, "max_contact_points is True: give an integer, at least 1, or None for no limit"),
    "flags": (lambda: {"flags": "gravity"}, "flags is 'gravity': give a dictionary of booleans, such as {\"gravity\": False}"),
    "flag": (lambda: {"flags": {"gravity": "off"}}, "the flag 'gravity' is 'off': give True to enable it, or False"),
    "pairs": (lambda: {"contact_pairs": None}, "contact_pairs is None: give a sequence, contact_pairs=(pair,) for one"),
    "among": (lambda: {"penalty": Penalty(stiffness=10.0, among="soft")}, "the penalty's among is 'soft': give a Penalty(stiffness=...), or None"),
    "surfaces": (lambda: {"penalty": Penalty(stiffness=10.0, at_surfaces="no")}, "the penalty's at_surfaces is 'no': give True or False"),
    "boxes": (lambda: {"penalty": Penalty(stiffness=10.0, boxes_touch_once=3)}, "the penalty's boxes_touch_once is 3: give True or False"),
    "boolean": (lambda: {"penalty": Penalty(stiffness=True)}, "the penalty's stiffness is True, a boolean: see Penalty for its unit"),
    "digits": (lambda: {"penalty": Penalty(stiffness=10**400)}, f"the penalty's stiffness is {str(10**400)[:97]}..., which is too large: see Penalty for its unit"),
    "many": (lambda: {"penalty": Penalty(stiffness=[10.0, 20.0])}, "the penalty's stiffness has shape (2,): give one number"),
}  # fmt: skip


@pytest.mark.parametrize("case", OPTIONS)
def test_bad_options(case):
    options, sentence = OPTIONS[case]
    with pytest.raises(ValueError, match="^" + re.escape(sentence) + "$"):
        rigid.load(mjcf(), **options())


FUNCTIONS = {
    "text": (lambda: touching(lambda a, b: ("near", a.position, a.position)),
             "the function of the contact pair sphere-sphere returned 'near' as distance: return an array"),
    "nothing": (lambda: touching(lambda a, b: None), "the function of the contact pair sphere-sphere returned None: return distance, point and normal"),
    "one argument": (lambda: touching(lambda a: None), "the function of the contact pair sphere-sphere cannot be traced (TypeError: "),
    "concrete": (lambda: touching(lambda a, b: float(a.position[0])), "the function of the contact pair sphere-sphere cannot be traced (ConcretizationTypeError: "),
}  # fmt: skip


@pytest.mark.parametrize("case", FUNCTIONS)
def test_bad_contact_functions(case):
    call, sentence = FUNCTIONS[case]
    with pytest.raises(ValueError, match="^" + re.escape(sentence) + "[^\n]*$"):
        call()


ASKED = "give a model that rigid.load returned"
START = "give a state that rigid.initial_state returned"
CALLS = {
    "qpos": (lambda m, s: rigid.initial_state(m, "home"), "qpos is 'home', which is no array of real numbers: give joint positions"),
    "qvel": (lambda m, s: rigid.initial_state(m, None, [[1], [2, 3]]), "qvel is [[1], [2, 3]], which is no array of real numbers: give joint velocities"),
    "booleans": (lambda m, s: rigid.initial_state(m, np.array([True])), "qpos is array([ True]), which is no array of real numbers: give joint positions"),
    "ctrl": (lambda m, s: rigid.step(m, s, "full"), "ctrl is 'full', which is no array of real numbers: give an array"),
    "wrenches": (lambda m, s: rigid.step(m, s, wrenches=1j * np.ones((3, 6))), "wrenches is an array of complex128 of shape (3, 6), which is no array of real numbers:"),
    "substeps": (lambda m, s: rigid.step(m, s, num_substeps=True), "num_substeps is True: give an integer, at least 1"),
    "path": (lambda m, s: rigid.step("arm.xml", s), f"model is 'arm.xml': {ASKED}"),
    "positions": (lambda m, s: rigid.step(m, np.zeros(1)), f"state is array([0.]): {START}"),
    "no model": (lambda m, s: rigid.initial_state(None), f"model is None: {ASKED}"),
    "poses": (lambda m, s: rigid.body_poses(None, s), f"model is None: {ASKED}"),
    "geoms": (lambda m, s: rigid.geom_poses(m, 3), f"state is 3: {START}"),
    "velocities": (lambda m, s: rigid.body_velocities(m, None), f"state is None: {START}"),
    "centers": (lambda m, s: rigid.centers_of_mass(m, {}), f"state is {{}}: {START}"),
    "shapes": (lambda m, s: rigid.shapes(m, None), f"state is None: {START}"),
    "status": (lambda m, s: rigid.check_status(0), f"state is 0: {START}"),
    "stale mass": (lambda m, s: rigid.step_with_stale_mass("ant", s), f"model is 'ant': {ASKED}"),
    "body": (lambda m, s: m.body(None), "the name of a body is None: give a string"),
    "geom": (lambda m, s: m.geom(3), "the name of a geom is 3: give a string"),
    "joint": (lambda m, s: m.joint(b"x"), "the name of a joint is b'x': give a string"),
    "pairs of a body": (lambda m, s: rigid.contact_distances(m, s, body=0), "the name of a body is 0: give a string"),
    "parameter": (lambda m, s: m.with_parameters(body_mass="heavy"), "body_mass is 'heavy', which is no array of real numbers: give an array of numbers in MuJoCo's unit"),
    "quaternions": (lambda m, s: m.with_parameters(body_quat=np.zeros((3, 4))), "body_quat[0] has length 0, but must have length 1: divide by its length"),
    "mocap": (lambda m, s: m.with_mocap("up"), "position is 'up', which is no array of real numbers: give one row per mocap body"),
    "mocap position": (lambda m, s: m.with_mocap(np.full((1, 3), NAN)), "position[0, 0] is nan, but must be finite: give a position in metres"),
    "mocap quaternion": (lambda m, s: m.with_mocap(np.zeros((1, 3)), np.zeros((1, 4))), "the quaternion's squared length[0] is 0.0, but must be positive: give (w, x, y, z)"),
    "friction": (lambda m, s: rigid.colliders(m, friction="ice"), "friction is 'ice', which is no real number: give a Coulomb coefficient"),
    "softness": (lambda m, s: rigid.colliders(m, softness=True), "softness is True, a boolean: give a decay per metre"),
    "spacing": (lambda m, s: rigid.colliders(m, mesh_spacing="fine"), "mesh_spacing is 'fine', which is no real number: give the spacing of a grid in metres"),
    "chosen": (lambda m, s: rigid.colliders(m, chosen="bob"), "chosen is 'bob': give a function of the names of body and geom"),
    "no colliders": (lambda m, s: rigid.colliders("arm.xml"), f"model is 'arm.xml': {ASKED}"),
    "poses of text": (lambda m, s: rigid.poses(m, "home"), "qpos is 'home', which is no array of real numbers: give joint positions"),
    "poses of four": (lambda m, s: rigid.poses(m, np.zeros((2, 4))), "qpos has shape (2, 4): give shape (..., 1), as in the model"),
}  # fmt: skip


@pytest.mark.parametrize("case", CALLS)
def test_bad_arguments(case, arm):
    call, sentence = CALLS[case]
    with pytest.raises(ValueError, match="^" + re.escape(sentence) + "[^\n]*$"):
        call(*arm)


def test_a_state_of_another_model(arm, ball):
    asked = r"the state's qpos has shape \(7,\): give shape \(1,\) of this model \(map batches with jax.vmap\)"
    for call in (rigid.step, rigid.body_poses, rigid.body_velocities, rigid.geom_poses, rigid.contact_distances):
        with pytest.raises(ValueError, match=f"^{asked}$"):
            call(arm[0], ball[1])


def test_a_quaternion_of_zeros_is_no_start(ball):
    with pytest.raises(
        ValueError, match=r"^qpos\[3:7\] is a quaternion of zeros: give \(1, 0, 0, 0\) for no rotation$"
    ):
        rigid.initial_state(ball[0], jnp.zeros(7))


def test_text_may_begin_with_a_byte_order_mark():
    assert rigid.load("\ufeff" + mjcf()).num_dofs == 1
