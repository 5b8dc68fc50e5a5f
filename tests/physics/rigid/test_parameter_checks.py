"""Numbers of rigid models are refused where they are given and flagged where they are traced."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics import rigid
from rewax.physics.rigid import Penalty
from rewax.physics.rigid.parameter_checks import has_invalid_parameters
from rewax.status import Status

nan, inf = float("nan"), float("inf")
BALL = '<mujoco><worldbody><body><freejoint/><geom size="0.1" mass="1"/></body></worldbody></mujoco>'


@pytest.mark.parametrize(
    ("text", "penalty", "sentence"),
    [
        (BALL, Penalty(stiffness=1e3, friction_damping=inf), "the penalty's friction_damping is inf, but must be 0 or mor"),
        (BALL, Penalty(stiffness="stiff"), "the penalty's stiffness is 'stiff', which is no real number: see Penalty"),
        (BALL.replace('mass="1"', 'mass="1" friction="-0.5"'), None, "geom_friction[0, 0] is -0.5, but must be 0 or more"),
    ],
)  # fmt: skip
def test_rigid_models_refuse_impossible_numbers(text, penalty, sentence):
    with pytest.raises(ValueError, match="^" + re.escape(sentence)):
        rigid.load(text, dt=1e-3, penalty=penalty)


def test_rigid_parameters_are_checked_when_replaced():
    model = rigid.load(BALL)
    with pytest.raises(ValueError, match=r"body_mass\[1\] is nan, but must be 0 or more and finite"):
        model.with_parameters(body_mass=np.array([0.0, nan]))
    with pytest.raises(ValueError, match=r"geom_friction\[0, 1\] is -1.0, but must be 0 or more"):
        model.with_parameters(geom_friction=np.array([[1.0, -1.0, 0.0]]))


def test_traced_parameters_are_flagged():
    model = rigid.load(BALL, penalty=Penalty(stiffness=1e3))
    invalid = jax.jit(
        lambda p, damping: has_invalid_parameters(
            p, model.gravity, model.penalty.replace(damping=damping), model.static.mj, model.static.on_field
        )
    )
    mass = jnp.array([0.0, -1.0])
    assert not invalid(model.parameters, 0.0)
    assert invalid(model.parameters, -1.0)
    assert invalid({**model.parameters, "body_mass": mass}, 0.0)


RAIL = """<mujoco><worldbody><body><joint name="j" type="slide" range="-1 1" limited="true"/><geom size="0.1"/></body>
</worldbody><actuator><motor joint="j" ctrllimited="true" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize("name", ["jnt_range", "actuator_ctrlrange"])
def test_reversed_limits_are_refused_and_flagged(name):
    """With them a control would have no gradient, and a joint would be thrown from limit to limit."""
    model = rigid.load(RAIL)
    reversed_limits = model.parameters[name][:, ::-1]
    with pytest.raises(
        ValueError, match=rf"^upper minus lower limit of {name}\[0\] is -2.0, .*: give the lower limit first"
    ):
        model.with_parameters(**{name: reversed_limits})
    flagged = jax.jit(
        lambda limits: rigid.check_status(rigid.initial_state(model), model.with_parameters(**{name: limits}))
    )
    assert flagged(model.parameters[name]) == Status.OK
    assert flagged(reversed_limits) == Status.INVALID_PARAMETERS


@pytest.mark.parametrize("name", ["jnt_axis", "body_quat", "geom_quat", "body_iquat"])
def test_replaced_axes_and_quaternions_of_another_length_are_flagged(name):
    model = rigid.load(RAIL)
    twice = model.replace(parameters={**model.parameters, name: 2.0 * model.parameters[name]})
    assert rigid.check_status(rigid.initial_state(model), twice) == Status.INVALID_PARAMETERS


def test_dry_friction_is_that_of_the_joints_that_were_loaded_with_it():
    joints = '<body><joint name="a" frictionloss=".2"/><geom size=".1"/></body><body><joint name="b"/><geom size=".1"/></body>'
    model = rigid.load(f"<mujoco><worldbody>{joints}</worldbody></mujoco>")
    model.with_parameters(dof_frictionloss=np.array([0.5, 0.0]))
    with pytest.raises(ValueError, match=r"^joint 'b' was loaded without dof_frictionloss, so it cannot change"):
        model.with_parameters(dof_frictionloss=np.array([0.2, 5.0]))


def flagged(model, name, value):
    replaced = model.replace(parameters={**model.parameters, name: value})
    return rigid.check_status(rigid.initial_state(model), replaced)


def test_powers_of_impedances_without_a_finite_derivative_are_refused_and_flagged():
    model = rigid.load(BALL)
    powers = {power: model.parameters["geom_solimp"].at[0, 4].set(power) for power in (0.5, 1.0, 1.5, 2.0)}
    for power, solimp in powers.items():
        assert flagged(model, "geom_solimp", solimp) == (Status.INVALID_PARAMETERS if power == 1.5 else Status.OK)
    with pytest.raises(
        ValueError, match=r"fractional part of the power of geom_solimp\[0\] is -0\.5, .*: give a power up"
    ):
        model.with_parameters(geom_solimp=powers[1.5])


FIELD = """<mujoco><asset><hfield name="h" nrow="9" ncol="9" size="1 1 .1 .1"/><mesh name="m" vertex="0 0 0 .2 0 0 0 .1 0 0 0 .1"/>
</asset><worldbody><geom type="hfield" hfield="h"/><body pos="0 0 1"><freejoint/><geom size="0.1"/></body>
<body pos="2 2 1"><freejoint/><geom name="gem" type="mesh" mesh="m" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""


def test_geoms_on_a_height_field_do_not_grow():
    """As many of its cells are searched as they covered when they were loaded."""
    model = rigid.load(FIELD)
    size = model.parameters["geom_size"]
    larger, smaller = size.at[1, 0].set(0.11), size.at[1, 0].set(0.09)
    assert flagged(model, "geom_size", smaller) == flagged(model, "geom_size", size) == Status.OK
    assert flagged(model, "geom_size", larger) == Status.INVALID_PARAMETERS
    model.with_parameters(geom_size=smaller)
    with pytest.raises(ValueError, match=r"the growth of geom_size .* is 0\.0\d+, .*: load the model with the largest"):
        model.with_parameters(geom_size=larger)


def test_the_size_of_a_mesh_is_no_parameter():
    model = rigid.load(FIELD)
    with pytest.raises(
        ValueError, match=r"^geom 'gem' is a mesh or a height field, whose geom_size has no effect: scale"
    ):
        model.with_parameters(geom_size=model.parameters["geom_size"].at[2].multiply(2.0))
