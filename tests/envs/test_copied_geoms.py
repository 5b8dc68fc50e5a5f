"""A change of a robot's geoms that does not reach the soft body is refused, others are not."""

import numpy as np
import pytest

import rewax
from rewax.envs.history import History
from rewax.envs.randomize import Constant, LogUniform, Scale, Shift, hook
from rewax.envs.randomized import Randomized, check_hook
from rewax.identify.unknowns import space_of
from rewax.physics import rigid
from rewax.training.evaluation.sweep import with_parameters

FACTOR = Scale(Constant(1.5))
ROBOTS = {"GripperLift": "model", "HandFlip": "hand"}


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request):
    return ROBOTS[request.param], rewax.make(request.param, scale="small")


def test_a_draw_of_geoms_alone_is_refused(robot):
    name, env = robot
    for part, of in (("friction", "friction"), ("size", "shape"), ("pos", "offset")):
        alone = hook({f"{name}.parameters[geom_{part}]": Shift(Constant(0.01))})
        with pytest.raises(ValueError, match=rf"geom_{part}\] of geom \d+ is changed, .*colliders\[\d+\]\.{of}, which"):
            check_hook(env, alone)
    with pytest.raises(ValueError, match=r"is changed, but not its copy scene\.colliders"):
        check_hook(History(env=env, steps=2), hook({f"env.{name}.parameters[geom_friction]": FACTOR}))


def test_a_draw_that_reaches_the_soft_body_passes(robot):
    name, env = robot
    check_hook(env, hook({(f"{name}.parameters[geom_friction]", "scene.colliders[*].friction"): FACTOR}))
    check_hook(env, hook({"scene.colliders[*].friction": FACTOR}))
    check_hook(env, hook({f"{name}.parameters[geom_friction][:,1]": FACTOR}))  # torsion, which no collider has
    check_hook(env, hook({f"{name}.parameters[body_mass]": FACTOR}))


def test_a_geom_that_is_no_collider_may_change_alone():
    """The base of the gripper touches nothing soft."""
    env = rewax.make("GripperLift", scale="small")
    fingers = env.scene.replace(colliders=rigid.colliders(env.model, chosen=lambda body, geom: "left" in body + geom))
    left = {collider.body for collider in fingers.colliders}
    others = [g for g, body in enumerate(env.model.static.mj.geom_bodyid) if int(body) not in left]
    assert fingers.colliders and others
    one_sided = env.replace(scene=fingers)
    check_hook(one_sided, hook({f"model.parameters[geom_friction][{others[0]}]": FACTOR}))
    with pytest.raises(ValueError, match="is changed, but not its copy scene"):
        check_hook(one_sided, hook({"model.parameters[geom_friction]": FACTOR}))


def test_a_geom_beside_a_collider_on_its_body_may_change_alone():
    env = rewax.make("HandFlip", scale="small")
    bodies = [int(body) for body in env.hand.static.mj.geom_bodyid]
    beside = next(i for i, body in enumerate(bodies) if bodies.count(body) > 1)
    kept = tuple(collider for i, collider in enumerate(env.scene.colliders) if i != beside)
    assert len(env.scene.colliders) == len(bodies) and bodies[beside] in {collider.body for collider in kept}
    fewer = env.replace(scene=env.scene.replace(colliders=kept))
    one = hook({f"hand.parameters[geom_friction][{beside}]": FACTOR})
    check_hook(fewer, one)
    with pytest.raises(ValueError, match=rf"of geom {beside} is changed, but not its copy scene"):
        check_hook(env, one)


def test_colliders_made_anew_pass():
    env = rewax.make("GripperLift", scale="small")

    def thicker(key, env):
        sizes = env.model.parameters["geom_size"] * 1.1
        model = env.model.replace(parameters={**env.model.parameters, "geom_size": sizes})
        return env.replace(model=model, scene=env.scene.replace(colliders=rigid.colliders(model)))

    check_hook(env, thicker)
    drawn = Randomized(env=env, randomize=thicker)
    np.testing.assert_allclose(
        drawn.randomize(None, env).scene.colliders[0].shape.half_size, 1.1 * env.scene.colliders[0].shape.half_size
    )


def test_settings_and_unknowns_are_compared_too():
    env = rewax.make("GripperLift", scale="small")
    name = "model.parameters[geom_friction][1]"
    with pytest.raises(ValueError, match="is changed, but not its copy scene"):
        with_parameters(env, {name: 0.3})
    with pytest.raises(ValueError, match="is changed, but not its copy scene"):
        space_of({name: LogUniform(0.1, 1.0)}, env)
    both = (name, "scene.colliders[0].friction")
    assert space_of({both: LogUniform(0.1, 1.0)}, env).labels == (name,)
