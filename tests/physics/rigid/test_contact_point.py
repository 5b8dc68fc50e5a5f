"""Where contacts act, halfway or at the surfaces, and contacts of one tree with a law of their own."""

import jax
import numpy as np
import pytest

from rewax.physics import rigid
from rewax.physics.rigid.spring_contacts import Penalty
from rewax.xla_options import unoptimised

STEP = jax.jit(rigid.step, compiler_options=unoptimised())
LAW = Penalty(stiffness=2000.0, damping=30.0, friction_damping=12.0)
SLIDING_BALL = """<mujoco><option gravity="0 0 0"/><worldbody><geom name="floor" type="plane" size="1 1 1"/>
<body pos="0 0 .09"><freejoint/><geom name="ball" size=".1" mass="1" friction=".5"/></body></worldbody></mujoco>"""
CHAIN = """<mujoco><option gravity="0 0 0"/><default><geom contype="0" conaffinity="0" size=".05"/></default><worldbody>
<geom name="wall" pos="-.09 0 0"/><body><joint type="slide" axis="1 0 0"/><geom name="near" mass="1"/>
<body pos=".09 0 0"><joint type="slide" axis="1 0 0"/><geom name="far" mass="1"/></body></body></worldbody>
<contact><pair geom1="{}" geom2="near"/></contact></mujoco>"""


def accelerated(law, text, qvel=None):
    """Accelerations of the model as written."""
    model = rigid.load(text, dt=1e-4, penalty=law)
    state = rigid.initial_state(model, qvel=qvel)
    return np.asarray(STEP(model, state).qvel - state.qvel) / model.dt


@pytest.mark.parametrize(("at_surfaces", "arm"), [(False, 0.095), (True, 0.1)])
def test_friction_pulls_at_the_surface_or_half_way_to_the_other(x64, at_surfaces, arm):
    """A ball that slides 1 cm deep in the floor: the arm of friction is the depth of the point."""
    velocity = np.array([0.3, 0, 0, 0, 0, 0])
    acceleration = accelerated(LAW.replace(at_surfaces=at_surfaces), SLIDING_BALL, velocity)
    force, torque = acceleration[0], 0.4 * 0.1**2 * acceleration[4]
    np.testing.assert_allclose(force, -12.0 * 0.3, rtol=1e-9)
    np.testing.assert_allclose(torque / force, -arm, rtol=1e-9)


@pytest.mark.parametrize(("at_surfaces", "arm"), [(False, 0.095), (True, 0.1)])
def test_the_velocity_that_counts_is_that_of_the_point(x64, at_surfaces, arm):
    """The same ball turns on the spot."""
    velocity = np.array([0, 0, 0, 0, 0.3, 0])
    acceleration = accelerated(LAW.replace(at_surfaces=at_surfaces), SLIDING_BALL, velocity)
    np.testing.assert_allclose(acceleration[0], 12.0 * 0.3 * arm, rtol=1e-9)


@pytest.mark.parametrize(("other", "stiffness", "sign"), [("far", 500.0, -1.0), ("wall", 2000.0, 1.0)])
def test_bodies_of_one_tree_may_have_a_law_of_their_own(x64, other, stiffness, sign):
    """Balls of 1 kg, 1 cm deep in each other: one pushed by the next of its tree, or by the world."""
    law = LAW.replace(among=LAW.replace(stiffness=500.0))
    text = CHAIN.format(other)
    np.testing.assert_allclose(accelerated(law, text)[0], sign * stiffness * 0.01, rtol=1e-9)
    np.testing.assert_allclose(accelerated(LAW, text)[0], sign * 2000.0 * 0.01, rtol=1e-9)


def test_numbers_of_that_law_are_checked():
    with pytest.raises(ValueError, match=r"stiffness is -1.0, but must be 0 or more"):
        rigid.load(SLIDING_BALL, penalty=LAW.replace(among=Penalty(stiffness=-1.0)))


def test_a_changed_law_compiles_nothing(x64):
    """The numbers of both laws are parameters."""
    model = rigid.load(SLIDING_BALL, dt=1e-4, penalty=LAW.replace(among=LAW, at_surfaces=True))
    assert len(jax.tree.leaves(model.penalty)) == 2 * len(jax.tree.leaves(LAW))
    step = jax.jit(rigid.step)
    state = rigid.initial_state(model)
    among = model.penalty.among.replace(stiffness=2.0 * model.penalty.among.stiffness)
    for other in (model, model.replace(penalty=model.penalty.replace(among=among))):
        step(other, state)
    assert step._cache_size() == 1
