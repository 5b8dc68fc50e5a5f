"""check_env passes a sound environment and names what is wrong with a broken one."""

import jax
import jax.numpy as jnp
import pytest
import toys

from rewax import struct
from rewax.envs.base import ArraySpec
from rewax.envs.wrappers import AutoReset
from rewax.testing import check_env


def broken(**methods):
    """A point mass with some methods replaced."""
    return struct.dataclass(type("Broken", (toys.PointMass,), methods))(gain=jnp.float32(0.5))


def step_with(change):
    """A step followed by ``change(new_state, old_state, action)``."""
    return lambda self, state, action: change(toys.PointMass.step(self, state, action), state, action)


def reset_with(change):
    return lambda self, key: change(toys.PointMass.reset(self, key))


def unclipped(self, state, action):
    return self.after(state, state.physics + self.gain * action)


def late(self, state, action):
    x = state.physics + self.gain * jnp.clip(action, -1.0, 1.0)
    return self.after(state, x).replace(truncated=state.step_count + 1 > self.length)


def infinite_slope(self, state, action):
    x = state.physics + self.gain * jnp.clip(action, -1.0, 1.0)
    return self.after(state, x + 0.0 * jnp.sqrt(jnp.sum(action) - jnp.sum(action)))


def eager_only(new, old, action):
    """Traced and eager steps differ."""
    bonus = 1.0 if isinstance(action, jax.core.Tracer) else 0.0
    return new.replace(reward=new.reward + bonus)


BALL = {"kind": "sphere", "center": (0.0, 0.0, 0.0), "radius": 0.1}


def drawn(*drawings, **more):
    """Methods of an environment that draws these shapes and no particles."""
    return {"particles": None, "render_shapes": lambda self, physics: list(drawings), **more}


START = float(toys.point_mass().reset(jax.random.key(0)).physics[0])


BROKEN = {
    "render_shapes after reset cannot be drawn: the drawing of a sphere has no 'center', but has 'centre': give it center, radius": drawn(
        {"kind": "sphere", "centre": (0.0, 0.0, 0.0), "radius": 0.1}
    ),
    "render_shapes after reset cannot be drawn: cannot draw a shape of kind 'ball': use one of 'sphere'": drawn(
        {**BALL, "kind": "ball"}
    ),
    "render_shapes after reset gives nothing but planes": drawn(
        {"kind": "plane", "center": (0, 0, 0), "direction": (0, 1, 0)}
    ),
    "render_shapes raises KeyError after reset: 'pin'": drawn(render_shapes=lambda self, physics: [{}["pin"]]),
    "render_shapes after step cannot be drawn: radius of the drawing of a sphere is -1.0: give 0 or more": drawn(
        render_shapes=lambda self, physics: [{**BALL, "radius": 0.1 if float(physics[0]) == START else -1.0}]
    ),
    r"particles after reset cannot be drawn: particles have shape \(8, 2\): give \(num_particles, 3\)": {
        "particles": lambda self, physics: jnp.zeros((8, 2))
    },
    "obs 'x' of reset has shape": {"observation_spec": property(lambda self: {"x": ArraySpec((2,))})},
    r"differ in \['y'\]": {"observation_spec": property(lambda self: {"x": ArraySpec((1,)), "y": ArraySpec((1,))})},
    "leaves the bounds of its spec": {"observation_spec": property(lambda self: {"x": ArraySpec((1,), -0.1, 0.1)})},
    "observation_spec is": {"observation_spec": property(lambda self: {})},
    "action_spec is unbounded": {"action_spec": property(lambda self: ArraySpec((1,)))},
    "low must be below high": {"action_spec": property(lambda self: ArraySpec((1,), 1.0, -1.0))},
    "episode_length is 5.0": {"episode_length": property(lambda self: 5.0)},
    "has dtype int32: use a float": {"reset": reset_with(lambda s: s.replace(obs={"x": jnp.zeros(1, jnp.int32)}))},
    "begin with both false": {"reset": reset_with(lambda s: s.replace(terminated=jnp.bool_(True)))},
    "same state for different keys": {"reset": lambda self, key: toys.PointMass.reset(self, jax.random.key(0))},
    "the same key in the state": {"reset": reset_with(lambda s: s.replace(key=jax.random.key(0)))},
    r"metrics of reset and step differ in \['more'\]": {
        "step": step_with(lambda new, *_: new.replace(metrics={**new.metrics, "more": new.reward}))
    },
    r"\.physics of the state is float32": {
        "step": step_with(lambda new, *_: new.replace(physics=jnp.tile(new.physics, 2)))
    },
    "different structure": {"step": step_with(lambda new, *_: new.replace(physics={"x": new.physics}))},
    "it must be a scalar": {"reset": reset_with(lambda s: s.replace(metrics={"distance": jnp.zeros(2)}))},
    "reward of step is not finite": {"step": step_with(lambda new, *_: new.replace(reward=jnp.float32(jnp.inf)))},
    r"jit\(step\) and step differ in \.reward": {"step": step_with(eager_only)},
    "clip the action in step": {"step": unclipped},
    "not finite": {"step": infinite_slope},
    "zero gradient": {"step": step_with(lambda new, *_: jax.lax.stop_gradient(new))},
    "both terminated and truncated": {"step": step_with(lambda new, *_: new.replace(terminated=new.truncated))},
    "not truncated at episode_length": {"step": late},
    "before episode_length": {"step": step_with(lambda new, *_: new.replace(truncated=new.step_count >= 3))},
}


def test_a_sound_environment_passes():
    check_env(toys.point_mass())
    check_env(broken(**drawn(BALL)))


@pytest.mark.parametrize("sentence", BROKEN, ids=range(len(BROKEN)))
def test_a_broken_environment_is_named(sentence):
    with pytest.raises(AssertionError, match=sentence) as caught:
        check_env(broken(**BROKEN[sentence]))
    assert "\n" not in str(caught.value)


def test_an_automatic_reset_is_found():
    class Resetting(toys.PointMass):
        def step(self, state, action):
            return AutoReset(env=toys.point_mass()).step(state, action).replace(final_obs=None)

    with pytest.raises(AssertionError, match="AutoReset"):
        check_env(struct.dataclass(Resetting)(gain=jnp.float32(0.5)))
