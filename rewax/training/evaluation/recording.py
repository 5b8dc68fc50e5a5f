"""Recordings of episodes for pictures: particles and bodies in each frame, rewards and status of each step."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from rewax.envs.base import Env, State
from rewax.envs.memory import action_of, stage
from rewax.envs.randomized import innermost
from rewax.envs.registry import did_you_mean
from rewax.envs.wrappers import AutoReset, Vmap, select
from rewax.training.evaluation.cameras import make_pixels, seen_by
from rewax.training.evaluation.episodes import Policy, with_step
from rewax.types import Key, PyTree
from rewax.viz.colors import color_names
from rewax.viz.recording import Recording

_NOTHING = "the environment has neither particles(physics) nor render_shapes(physics): define one of them for pictures"


def can_record(env: Any) -> bool:
    """Whether an environment, or the one inside its wrappers, has something to draw."""
    env = _bare(env)
    return hasattr(env, "particles") or hasattr(env, "render_shapes")


def check_color_by(env: Any, color_by: str) -> None:
    """Check that particles of an environment can be coloured by this, before an episode is recorded.

    Raises:
      ValueError: they cannot; the message lists what there is.
    """
    env = _bare(env)
    if not hasattr(env, "particles"):
        if color_by != "material":
            raise ValueError(f"color_by is {color_by!r}, but the environment has no particles: leave it out")
        return
    values: tuple[str, ...] = ()
    if hasattr(env, "particle_values"):
        try:
            physics = jax.eval_shape(env.reset, jax.random.key(0)).physics
            values = tuple(jax.eval_shape(lambda physics: dict(env.particle_values(physics)), physics))
        except Exception:  # the environment's code cannot be traced: the recording reports an error
            return
    known = color_names(values)
    if color_by not in known:
        raise ValueError(f"particles cannot be coloured by {color_by!r}: use one of {', '.join(known)}")


APPEARANCE = ("triangles", "segments", "thickness", "materials", "material_names", "floor", "camera")
"""What ``env.appearance`` may say, see ``Recording``."""


def record(
    env: Env,
    policy: Policy,
    train_state: PyTree,
    key: Key,
    *,
    max_frames: int = 301,
    deterministic: bool = True,
    name: str = "",
) -> Recording:
    """Run one episode and record what pictures need.

    Args:
      env: unbatched environment with ``particles(physics)``, ``render_shapes(physics)`` or both; ``up``,
        ``control_dt``, ``particle_values(physics)`` and ``appearance`` are optional. It may be wrapped: what the
        cameras of ``Sensing`` show is recorded, too.
      policy, train_state: as for ``make_evaluate``.
      key: draws the initial state and the policy's samples.
      max_frames: at least 2; of longer episodes every second step is recorded, or every third, ...
      deterministic: passed to the policy.
      name: of the recording.

    Returns:
      The episode up to its end. Frames are equally spaced, except for the last one.

    Raises:
      ValueError: too few frames, or the environment has nothing to draw.
    """
    made = make_record(env, policy, max_frames=max_frames, deterministic=deterministic)
    return made(train_state, key, name)


def make_record(
    env: Env, policy: Policy, *, max_frames: int = 301, deterministic: bool = True
) -> Callable[..., Recording]:
    """``record`` for several training states: ``(train_state, key, name) -> recording``, compiled once.

    The function's ``max_steps`` ends an episode early, after the first frame with that many steps.

    Raises:
      ValueError: too few frames, or the environment has nothing to draw.
    """
    if max_frames < 2:
        raise ValueError(f"max_frames is {max_frames}: use 2 or more")
    if not can_record(env):
        raise ValueError(_NOTHING)
    while isinstance(env, AutoReset):  # it would go on with the next episode
        env = env.env
    if isinstance(env, Vmap):
        raise ValueError("env is a batch of environments: record one of them")
    env = stage(env, policy)
    every = max(1, -(-env.episode_length // (max_frames - 1)))
    reset, advance = jax.jit(env.reset), _make_advance(env, policy, every, deterministic)
    bare = _bare(env)
    see, pixels = _make_see(env, jax.eval_shape(env.reset, jax.random.key(0))), make_pixels(env)

    def made(train_state: PyTree, key: Key, name: str = "", max_steps: int | None = None) -> Recording:
        reset_key, act_key = jax.random.split(key)
        state = _beside(train_state, reset(reset_key))
        seen, shown, steps, logged = [see(state)], [jax.device_get(pixels(state))], [0], []
        while not bool(state.done) and steps[-1] < (env.episode_length if max_steps is None else max_steps):
            state, of_steps = advance(train_state, state, act_key)
            count = int(state.step_count) - steps[-1]
            logged.append(jax.tree.map(lambda values: values[:count], jax.device_get(of_steps)))  # noqa: B023
            steps.append(int(state.step_count))
            seen.append(see(state))
            shown.append(jax.device_get(pixels(state)))
        recording = _recording(bare, seen, steps, logged, name)
        return dataclasses.replace(recording, seen=seen_by(env, state.physics, shown))

    return made


def snapshots(env: Env) -> Callable[[list[State]], Recording]:
    """A function from a list of states to a recording with one frame for each, without rewards.

    Raises:
      ValueError: the environment has nothing to draw.
    """
    if not can_record(env):
        raise ValueError(_NOTHING)
    bare = _bare(env)
    see = _make_see(env, jax.eval_shape(env.reset, jax.random.key(0)))

    def of(frames: list[State]) -> Recording:
        return _recording(bare, [see(state) for state in frames], list(range(len(frames))), [], "")

    return of


def _bare(env: Any) -> Any:
    """The environment inside its wrappers, which knows what there is to draw."""
    return getattr(env, "unwrapped", env)


def _beside(train_state: PyTree, state: State) -> State:
    """The state on the training state's device, where all later states are, so that one program takes them all."""
    arrays = [leaf for leaf in jax.tree.leaves(train_state) if isinstance(leaf, jax.Array)]
    devices = {device for array in arrays for device in array.devices()}
    return jax.device_put(state, devices.pop()) if len(devices) == 1 else state


def _make_advance(env: Env, policy: Policy, every: int, deterministic: bool) -> Callable[..., Any]:
    """``(train_state, state, key) -> state, logged`` of at most ``every`` steps, up to the episode's end.

    ``logged`` has ``rewards``, ``status``, ``actions`` and ``metrics`` of each step.
    """
    policy_at = with_step(policy)

    @jax.jit
    def advance(train_state: PyTree, state: State, act_key: Key) -> tuple[State, dict[str, Any]]:
        def body(state: State, _: None) -> tuple[State, dict[str, Any]]:
            step = state.step_count
            moved = policy_at(train_state, state.obs, jax.random.fold_in(act_key, step), step, deterministic)
            over = state.done | (step >= env.episode_length)
            new = select(over, state, env.step(state, moved))
            logged = {"rewards": new.reward, "status": new.status, "actions": action_of(moved), "metrics": new.metrics}
            return new, logged

        return jax.lax.scan(body, state, None, length=every)

    return advance


def _make_see(env: Any, state: State) -> Callable[[State], dict[str, Any]]:
    """A function from states to what is drawn, as NumPy arrays; compiled if the environment can be traced.

    ``state`` has the shapes of these states. Drawn is the environment with the parameters of the episode.
    """

    def see(drawn: dict[str, Any], physics: PyTree) -> dict[str, Any]:
        bare, found = innermost(env, drawn), {}
        if hasattr(bare, "particles"):
            found["particles"] = bare.particles(physics)
        if hasattr(bare, "particle_values"):
            found["values"] = dict(bare.particle_values(physics))
        if hasattr(bare, "render_shapes"):
            found["drawings"] = [dict(drawing) for drawing in bare.render_shapes(physics)]
        return found

    kept: dict[str, Any] = {}

    def arrays(drawn: dict[str, Any], physics: PyTree) -> list[Any]:
        """Arrays that change; kinds of drawings and triangles of meshes are constant and kept when this is traced."""
        leaves, kept["tree"] = jax.tree.flatten(see(drawn, physics))
        kept["rest"] = [leaf if isinstance(leaf, str | np.ndarray) else None for leaf in leaves]
        return [leaf for leaf in leaves if not isinstance(leaf, str | np.ndarray)]

    try:
        jax.eval_shape(arrays, state.drawn or {}, state.physics)
    except Exception:  # the environment's code may need concrete values
        return lambda state: jax.device_get(see(state.drawn or {}, state.physics))
    compiled = jax.jit(arrays)

    def call(state: State) -> dict[str, Any]:
        values = iter(jax.device_get(compiled(state.drawn or {}, state.physics)))
        return jax.tree.unflatten(kept["tree"], [next(values) if a is None else a for a in kept["rest"]])

    return call


def _recording(
    env: Any, seen: list[dict[str, Any]], steps: list[int], logged: list[dict[str, Any]], name: str
) -> Recording:
    first = seen[0]
    nothing = {"rewards": np.zeros(0), "status": np.zeros(0, np.int32), "actions": None, "metrics": {}}
    whole = jax.tree.map(lambda *parts: np.concatenate(parts), *logged) if logged else nothing
    options = dict(getattr(env, "appearance", {}))
    for option in options:
        if option not in APPEARANCE:
            near = did_you_mean(option, APPEARANCE)
            raise ValueError(f"appearance has {option!r}: {near}use some of {', '.join(APPEARANCE)}")
    dt = getattr(env, "control_dt", None)
    return Recording(
        steps=np.asarray(steps),
        rewards=np.asarray(whole["rewards"], float),
        status=whole["status"],
        actions=None if whole["actions"] is None else whole["actions"].reshape(len(whole["rewards"]), -1),
        metrics={metric: values for metric, values in whole["metrics"].items() if values.ndim == 1},
        particles=np.stack([np.asarray(frame["particles"], np.float32) for frame in seen])
        if "particles" in first
        else None,
        values={
            value: np.stack([np.asarray(frame["values"][value], np.float32) for frame in seen])
            for value in first.get("values", {})
        },
        drawings=[frame["drawings"] for frame in seen] if "drawings" in first else (),
        control_dt=None if dt is None else float(dt),
        up=np.asarray(getattr(env, "up", (0.0, 1.0, 0.0)), float),
        name=name,
        **options,
    )


__all__ = ["can_record", "check_color_by", "make_record", "record", "snapshots"]
