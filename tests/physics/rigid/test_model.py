"""A loaded model: each of its parameters is heeded, one program per model, names."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models
from rigid_cases import STEPS, VERSIONS, advance, draw, home, hop, loaded, simulate_in_c

from rewax.physics import rigid
from rewax.physics.rigid.spring_contacts import Penalty

ADDED = {
    "qpos0",
    "qpos_spring",
    "body_pos",
    "body_quat",
    "body_ipos",
    "body_iquat",
    "jnt_pos",
    "jnt_axis",
    "geom_pos",
    "geom_quat",
}


def changed(mj, name: str) -> np.ndarray:
    """Other values of a parameter: factors differ by a few per cent, positions by a centimetre, angles by a degree."""
    value, rng = np.array(getattr(mj, name)), np.random.default_rng(len(name))
    new = (
        value + 0.02 * rng.standard_normal(value.shape)
        if name in ADDED
        else value * rng.uniform(1.02, 1.1, value.shape)
    )
    if name.endswith(("quat", "axis")):
        new /= np.linalg.norm(new, axis=1, keepdims=True)
    free = mj.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    if name == "jnt_pos":
        new[free] = value[free]  # a free joint has none
    if name.endswith("solimp"):
        new[:, 4] = value[:, 4]  # no power between integers has a derivative
    return new


@functools.cache
def plain_contraption():
    """In which C MuJoCo makes no use of what it knew about the numbers when it read the model."""
    mj, model = loaded("contraption")
    mj = mujoco.MjModel.from_xml_string(rigid_models.contraption())
    for field in ("body_sameframe", "geom_sameframe", "site_sameframe"):
        getattr(mj, field)[:] = 0
    assert not mj.body_simple[1:].any()
    mj.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    mj.geom_rbound[2:] *= 1.5
    return mj, model


@pytest.mark.parametrize("name", rigid.PARAMETERS)
def test_other_parameters_do_what_they_do_in_mujoco(x64, name):
    """Each of them is heeded, and none needs another program."""
    mj, model = plain_contraption()
    qpos, (qvel, ctrl, wrenches) = home(mj), draw(mj, speed=1.0)
    before, value = simulate_in_c(mj, qpos, qvel, ctrl, wrenches, STEPS)[0], np.array(getattr(mj, name))
    new = changed(mj, name)
    try:
        getattr(mj, name)[:] = new
        after = simulate_in_c(mj, qpos, qvel, ctrl, wrenches, STEPS)[0]
    finally:
        getattr(mj, name)[:] = value
    start = rigid.initial_state(model, qpos, qvel)
    unchanged = advance(model, start, ctrl, wrenches)
    np.testing.assert_allclose(unchanged.qpos, before.qpos, atol=1e-7)
    programs = advance._cache_size()
    state = advance(model.with_parameters(**{name: new}), start, ctrl, wrenches)
    assert advance._cache_size() == programs
    print(name, np.abs(state.qpos - after.qpos).max(), np.abs(after.qpos - before.qpos).max())
    np.testing.assert_allclose(state.qpos, after.qpos, atol=1e-7)  # as well as MuJoCo's solver converges
    assert np.abs(after.qpos - before.qpos).max() > 1e-7


@pytest.mark.parametrize("gravity", ["enable", "disable"])
def test_gravity_is_a_leaf_and_can_be_switched_off(x64, gravity):
    mj = mujoco.MjModel.from_xml_string(rigid_models.pendulum(1))
    mj.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY * (gravity == "disable")
    model = rigid.load(mj)
    expected = [0.0, 0.0, -9.81] if gravity == "enable" else [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(model.gravity, expected)


def test_names(x64):
    mj, model = loaded("contraption")
    for body in ("world", "cart", "stone"):
        assert model.body(body) == mj.body(body).id
    assert model.geom("bulb") == mj.geom("bulb").id
    assert model.joint("swing") == (mj.joint("swing").qposadr[0], mj.joint("swing").dofadr[0])
    known = ", ".join(mj.body(i).name for i in range(mj.nbody) if mj.body(i).name)
    with pytest.raises(ValueError, match=f"^the model has no body 'moon': known are {known}$"):
        model.body("moon")
    with pytest.raises(
        ValueError, match=r"^the model has no geom 'cart': known are floor, shelf, bulb, stone, puck, bead$"
    ):
        model.geom("cart")
    with pytest.raises(ValueError, match=r"^the model has no joint 'y': known are x, h, k, w, swing$"):
        model.joint("y")


def test_a_model_is_compiled_once(x64):
    """Other numbers, other states and the same MJCF read again are the same program; another model is another one."""
    text = rigid_models.ball()
    first, again = rigid.load(text), rigid.load(mujoco.MjSpec.from_string(text))
    assert first.static == again.static and hash(first.static) == hash(again.static)
    assert jax.tree.structure(first) == jax.tree.structure(again)
    state, before = rigid.initial_state(first), hop._cache_size()
    ends = [hop(first, state, jnp.zeros(0)), hop(again, state, jnp.zeros(0))]
    assert hop._cache_size() == before + 1
    np.testing.assert_array_equal(ends[0].qvel, ends[1].qvel)
    for name in ("body_mass", "pair_friction", "pair_solref", "pair_solimp", "geom_size"):
        value = again.parameters[name]
        other = again.with_parameters(**{name: value.at[:, :4].multiply(1.01) if value.ndim > 1 else 1.01 * value})
        ends.append(hop(other, ends[-1], jnp.zeros(0)))
    ends.append(
        hop(first.replace(gravity=jnp.array([0.0, 1.0, -3.0])), state.replace(qvel=state.qvel + 1.0), jnp.zeros(0))
    )
    assert hop._cache_size() == before + 1
    for other in (
        rigid_models.ball(dt=0.001),
        rigid_models.ball(gravity="0 0 -1"),
        text.replace('condim="3"', "").replace("<pair ", '<pair condim="1" ', 1),
        rigid_models.capsule(),
    ):
        assert rigid.load(other).static != first.static
    assert first.static != "a model"
    with_penalty = rigid.load(text, penalty=Penalty(stiffness=1e4))
    assert jax.tree.structure(with_penalty) != jax.tree.structure(first)
    with jax.enable_x64(False):
        single = rigid.load(text)
    assert single.static != first.static and single.home.dtype == np.float32


def test_parameters_have_the_shapes_of_mujoco():
    mj, model = loaded("contraption")
    for name in rigid.PARAMETERS:
        ours, theirs = getattr(mj, name).shape, getattr(model.static.mjx, name).shape
        assert ours == theirs, f"{VERSIONS} {name} has shape {theirs} in MJX and {ours} in MuJoCo"
