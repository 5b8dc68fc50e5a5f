"""check_env passes a sound environment and names what is wrong with a broken one."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax import struct
from rewax.envs.base import ArraySpec, first_state
from rewax.envs.wrappers import AutoReset
from rewax.status import Status
from rewax.testing import check_env
from rewax.testing.functions import check_same


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


def weakly_unclipped(self, state, action):
    return self.after(state, state.physics + self.gain * jnp.clip(action, -1.0, 1.0) + 1e-6 * action)


def with_many_actions(change, weight):
    """Twenty actions that move the point. ``change`` is applied to one of them, which has a weight of its own."""

    def step(self, state, action):
        action = jnp.clip(action, -1.0, 1.0)
        action = action.at[3].set(weight * change(action[3]))
        return self.after(state, state.physics + 0.05 * jnp.sum(action))

    return {"step": step, "action_spec": property(lambda self: ArraySpec((20,), -1.0, 1.0))}


def noisy(of):
    """An observation with noise that ``of(state)``, a key, draws."""

    def change(new, old, action):
        return new.replace(obs={"x": new.obs["x"] + 0.01 * jax.random.normal(of(old))})

    return change


def half_cut(new, old, action):
    """A reward whose second part has no gradient."""
    return new.replace(reward=new.reward + jnp.sum(jax.lax.stop_gradient(new.obs["x"])))


def blind(new, old, action):
    """An observation that policies see, but gradients do not."""
    return new.replace(obs=jax.lax.stop_gradient(new.obs))


def jumping(new, old, action):
    """A reward that jumps too often for any difference, and has the slope of its smooth part."""
    action = jnp.clip(jnp.nan_to_num(action), -1.0, 1.0)
    return new.replace(reward=jnp.sum(action) + 100.0 * jnp.sum(12345.0 * jax.lax.stop_gradient(action) % 1.0))


def straight_through(new, old, action):
    """A reward that is constant in the action, but has the derivative of a slope."""
    return new.replace(reward=jnp.sum(action - jax.lax.stop_gradient(action)))


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


def counting(self, state, action):
    """A step that depends on how often it was traced."""
    return self.after(state, state.physics + self.gain * jnp.clip(action, -1.0, 1.0) + 0.1 * next(COUNTER))


def calling_back(new, old, action):
    """A step that depends on how often it ran."""
    count = jax.pure_callback(
        lambda: np.float32(next(COUNTER)), jax.ShapeDtypeStruct((), jnp.float32), vmap_method="sequential"
    )
    return new.replace(reward=new.reward + count)


@jax.custom_batching.custom_vmap
def less_the_mean(x):
    return x


@less_the_mean.def_vmap
def _(axis_size, batched, x):
    return x - jnp.mean(x), True


def deciding(self, state, action):
    """A step that asks for the value of a leaf."""
    return toys.PointMass.step(self, state, action if self.gain > 0 else -action)


def rounded(self, state, action):
    return toys.PointMass.step(self, state, jnp.round(action))


def later(**broken):
    """What a step of the second half of an episode gives."""

    def change(new, old, action):
        return new.replace(
            **{
                name: jax.tree.map(lambda a, value=value: jnp.where(new.step_count > 3, value, a), getattr(new, name))
                for name, value in broken.items()
            }
        )

    return change


def failing_at(count):
    def change(new, old, action):
        failed = new.step_count == count
        return new.replace(status=jnp.where(failed, int(Status.NAN), 0), terminated=failed)

    return change


def ends_early(both):
    """An episode ends with its second step. One that reaches the time limit ends there in both ways, or in none."""

    def change(new, old, action):
        limit = both & (new.step_count >= 5)
        return new.replace(terminated=(new.step_count == 2) | limit, truncated=limit)

    return change


def late_reward(new, old, action):
    """As that of a tool that reaches the material with the fourth step."""
    return new.replace(reward=jnp.where(new.step_count >= 4, new.reward, 0.0))


def unending(new, old, action):
    """An environment that builds its state by hand, and never ends an episode that has failed."""
    return new.replace(status=jnp.int32(0), terminated=jnp.bool_(False))


def unnoticed(new, old, action):
    """Takes an action of NaN into its physics, and does not say so."""
    lost = jnp.isnan(action[0])
    return new.replace(physics=jnp.where(lost, jnp.nan, new.physics), status=jnp.where(lost, 0, new.status))


COUNTER = itertools.count()
BALL = {"kind": "sphere", "center": (0.0, 0.0, 0.0), "radius": 0.1}


def drawn(*drawings, **more):
    """Methods of an environment that draws these shapes and no particles."""
    return {"particles": None, "render_shapes": lambda self, physics: list(drawings), **more}


START = float(toys.point_mass().reset(jax.random.key(0)).physics[0])


BROKEN = {
    "obs 'x' of step 4 holds a number that is not finite": {"step": step_with(later(obs=jnp.nan))},
    "the reward of step 4 is not finite": {"step": step_with(later(reward=jnp.inf))},
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
    "the same key in the state": {"reset": reset_with(lambda s: s.replace(key=jax.random.key(0)))},
    "reset sets the status NAN: begin where the physics is sound": {
        "reset": lambda self, key: first_state(
            physics=jnp.full(1, jnp.nan), obs={"x": jnp.ones(1)}, metrics={"distance": jnp.ones(())}, key=key
        )
    },
    "obs 'x' draws the same numbers in every step: split state.key in step": {
        "step": step_with(noisy(lambda old: old.key))
    },
    r"metrics of reset and step differ in \['more'\]": {
        "step": step_with(lambda new, *_: new.replace(metrics={**new.metrics, "more": new.reward}))
    },
    r"\.metrics\['distance'\] of the state is a Python number after reset and an array after step, so that": {
        "reset": reset_with(lambda s: s.replace(metrics={"distance": jnp.asarray(0.0)}))
    },
    r"\.physics of the state is float32": {
        "step": step_with(lambda new, *_: new.replace(physics=jnp.tile(new.physics, 2)))
    },
    "different structure": {"step": step_with(lambda new, *_: new.replace(physics={"x": new.physics}))},
    "it must be a scalar": {"reset": reset_with(lambda s: s.replace(metrics={"distance": jnp.zeros(2)}))},
    "reward of step is not finite": {"step": step_with(lambda new, *_: new.replace(reward=jnp.float32(jnp.inf)))},
    r"jit\(step\) and step differ in \.reward": {"step": step_with(eager_only)},
    "clip the action in step": {"step": unclipped},
    "its bound -1.0 and at it differ in .* clip the action in step": {"step": weakly_unclipped},
    "the gradient of the reward at action 0 holds a number that is not finite: .* take rewax.envs.kit.rewards.smooth_norm": {
        "step": step_with(
            lambda new, state, action: new.replace(reward=-jnp.sqrt(jnp.sum((new.physics - state.physics) ** 2)))
        )
    },
    "not finite": {"step": infinite_slope},
    "zero gradient with respect to their actions, and so has the whole state: a stop_gradient, a rounding, .* cuts it; let": {
        "step": step_with(lambda new, *_: jax.lax.stop_gradient(new))
    },
    "a rounding, a comparison or an integer cuts it; let the action enter": {"step": rounded},
    r"of 3 steps has a zero gradient .*, though obs\['x'\], physics of the state follow them: .* Where a tool begins away from the material, begin within reach of it, or reward the tool for coming nearer, or check with more gradient_steps": {
        "step": step_with(late_reward)
    },
    r"the derivative of the reward of 3 steps along a direction .* is -?[\d.]+, and central differences give -?[\d.]+: a stop_gradient": {
        "step": step_with(half_cut)
    },
    r"the derivative of obs\['x'\] after 3 steps \(summed with random signs\) along a direction of their actions is 0, and": {
        "step": step_with(blind)
    },
    r"the reward of 3 steps along components 3 of their actions is 0, and central differences give": with_many_actions(
        jax.lax.stop_gradient, 0.2
    ),
    r"is 3, and central differences give 0: a stop_gradient, .* custom derivative": {
        "step": step_with(straight_through)
    },
    r"reward of reset has shape \(1,\): it must be a scalar": {
        "reset": reset_with(lambda s: s.replace(reward=jnp.zeros(1)))
    },
    "reward of reset has dtype int32: use a float": {"reset": reset_with(lambda s: s.replace(reward=jnp.int32(0)))},
    r"is float32\(1,\) after reset, float16\(1,\) after step: a scan needs them the same": {
        "step": step_with(lambda new, *_: new.replace(physics=new.physics.astype(jnp.float16)))
    },
    r"jit\(step\) and step differ in \.physics of the state: let step depend on state and action alone": {
        "step": counting
    },
    r"two steps from one state differ in \.reward of the state: let step depend on": {"step": step_with(calling_back)},
    r"a loop over them, differ in \.reward of the state: let an environment depend on itself only": {
        "step": step_with(lambda new, *_: new.replace(reward=less_the_mean(new.reward)))
    },
    "step cannot be compiled with traced parameters .*: use jnp.where or lax.cond instead of if": {"step": deciding},
    "the first step sets the status OUT_OF_DOMAIN: give a larger box, or walls that keep particles inside; rewax.Status says": {
        "step": step_with(lambda new, *_: new.replace(status=jnp.int32(Status.OUT_OF_DOMAIN)))
    },
    r"step 4 of random actions fails numerically \(NAN\): give shorter substeps": {"step": step_with(failing_at(4))},
    r"3 steps of random actions fail numerically \(<Status.NAN: 1>\): give shorter substeps": {
        "step": step_with(failing_at(2))
    },
    "both terminated and truncated": {"step": step_with(lambda new, *_: new.replace(terminated=new.truncated))},
    "not truncated at episode_length": {"step": late},
    "a step is both terminated and truncated at the time limit": {"step": step_with(ends_early(True))},
    "the episode is not truncated at episode_length 5": {"step": step_with(ends_early(False))},
    "metric 'distance' of reset is not finite": {
        "reset": reset_with(lambda s: s.replace(metrics={"distance": jnp.nan * s.reward}))
    },
    "step gives the same key for different keys, so that later episodes begin alike: keep state.key, or split it": {
        "step": step_with(lambda new, *_: new.replace(key=jax.random.key(0)))
    },
    "a step whose physics is NaN does not end the episode with Status.NAN: build the state with next_state": {
        "step": step_with(unending)
    },
    "a step with an action of NaN does not end the episode with Status.NAN": {"step": step_with(unnoticed)},
    "a step whose physics is NaN has a reward that is not finite: give 0 there": {
        "step": step_with(lambda new, old, action: new.replace(reward=jnp.where(new.status, jnp.nan, new.reward)))
    },
    "before episode_length": {"step": step_with(lambda new, *_: new.replace(truncated=new.step_count >= 3))},
}


def test_a_sound_environment_passes():
    lines = []
    check_env(toys.point_mass(), notify=lines.append)
    assert lines[0] == "check_env PointMass, 0 s: specs and parameters" and lines[-1].endswith(" s: passed")
    assert any(line.endswith("gradient through 3 steps") for line in lines)
    check_env(broken(**drawn(BALL)), notify=None)


def test_what_may_be_meant_passes():
    """An action without effect, an observation that never changes, episodes that begin alike: the last is said."""
    goal = {"goal": jnp.ones(2)}

    def reset(self, key):
        return first_state(
            physics=jnp.ones(1), obs={"x": jnp.ones(1), **goal}, metrics={"distance": jnp.ones(())}, key=key
        )

    def step(self, state, action):
        new = many["step"](self, state.replace(obs={"x": state.obs["x"]}), action)
        new = noisy(lambda old: jax.random.fold_in(old.key, old.step_count))(new, state, action)
        return new.replace(obs={**new.obs, **goal})

    many, lines = with_many_actions(lambda a: a, 0.0), []
    spec = property(lambda self: {"x": ArraySpec((1,)), "goal": ArraySpec((2,))})
    check_env(broken(**{**many, "reset": reset, "step": step, "observation_spec": spec}), notify=lines.append)
    assert sum("all episodes begin with the same numbers" in line for line in lines) == 1
    assert not any("settle" in line for line in lines)


def test_a_reward_that_comes_late_passes_with_more_steps(capsys):
    check_env(broken(step=step_with(late_reward)), gradient_steps=4)
    assert "gradient through 4 steps" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"^gradient_steps is 0: use 1 or more$"):
        check_env(toys.point_mass(), gradient_steps=0)
    with pytest.raises(ValueError, match=r"^env is 'RollingFlat': give an environment"):
        check_env("RollingFlat")


def test_a_gradient_that_is_changed_on_purpose_passes_on_request():
    check_env(broken(step=step_with(half_cut)), gradient_tolerance=None, notify=None)


def test_differences_that_do_not_settle_are_named_and_pass():
    lines = []
    check_env(broken(step=step_with(jumping)), notify=lines.append)
    assert sum("differences do not settle" in line for line in lines) == 2


@pytest.mark.parametrize("sentence", BROKEN, ids=range(len(BROKEN)))
def test_a_broken_environment_is_named(sentence):
    with pytest.raises(AssertionError, match=sentence) as caught:
        check_env(broken(**BROKEN[sentence]))
    assert "\n" not in str(caught.value)


def test_an_environment_that_agents_cannot_take_apart_is_named():
    class Plain(toys.PointMass):
        def __init__(self):
            pass

        length = 5

    with pytest.raises(AssertionError, match=r"^Plain is no pytree: .*; decorate Plain with rewax.struct.dataclass$"):
        check_env(Plain(), notify=None)
    named = toys.point_mass().replace(gain="half")
    with pytest.raises(AssertionError, match=r"^.gain of PointMass is a str: .* make its field a static_field"):
        check_env(named, notify=None)


def test_an_infinite_number_hides_no_difference_beside_it():
    one, other = {"best": jnp.array([1.0, jnp.inf])}, {"best": jnp.array([500.0, jnp.inf])}
    check_same(one, one, 1e-3, "two steps", "be pure")
    check_same({"best": jnp.array([jnp.nan])}, {"best": jnp.array([jnp.nan])}, 1e-3, "two steps", "be pure")
    for wrong in (other, {"best": jnp.array([1.0, -jnp.inf])}, {"best": jnp.array([1.0, 2.0])}):
        for a, b in ((one, wrong), (wrong, one)):
            with pytest.raises(AssertionError, match=r"two steps differ in \['best'\] of the state: be pure"):
                check_same(a, b, 1e-3, "two steps", "be pure")


def test_an_automatic_reset_is_found():
    class Resetting(toys.PointMass):
        def step(self, state, action):
            return AutoReset(env=toys.point_mass()).step(state, action).replace(final_obs=None)

    with pytest.raises(AssertionError, match="AutoReset"):
        check_env(struct.dataclass(Resetting)(gain=jnp.float32(0.5)))
    with pytest.raises(AssertionError, match=r"^env has an AutoReset, and agents add one: give it without AutoReset$"):
        check_env(AutoReset(env=toys.point_mass()), notify=None)
