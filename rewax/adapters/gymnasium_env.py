"""Environments for gymnasium and the libraries that use it, single or in a batch.

    env = gymnasium.make("rewax/RollingFlat-small-v0")      # or 'paper'; options of rewax.make as keyword arguments
    env = GymnasiumEnv(rewax.make("RollingFlat"))
    envs = GymnasiumVectorEnv(rewax.make("RollingFlat"), num_envs=16)

Observations are ``Dict`` spaces of float32; a point cloud has shape (num_points, 3). To get one vector, wrap one
environment in ``FlattenObservation`` of gymnasium, and give ``flat=True`` for a batch. No gradient passes through.
Importing this module registers the names of ``gymnasium_ids``.
"""

from typing import Any, ClassVar

import jax
import numpy as np

from rewax.adapters.conversion import (
    batch_observation,
    check_action,
    check_one_episode,
    checked_num_envs,
    compiled,
    key_from,
    missing,
    numpy_metrics,
    numpy_observation,
    state_info,
)
from rewax.adapters.gymnasium_ids import register_envs
from rewax.envs.base import ArraySpec, Env, State
from rewax.envs.kit.options import integer_option
from rewax.envs.registry import make, require_env
from rewax.envs.wrappers import AutoReset, Vmap
from rewax.training.evaluation.recording import snapshots
from rewax.viz.steady import SteadyPictures

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise missing("gymnasium", "gymnasium") from error

register_envs()


class GymnasiumEnv(gymnasium.Env):
    """One environment. Call ``reset`` after the end of an episode.

    ``info`` holds the metrics of the task, and ``status``: "OK", or the names of the status bits.

    Args:
      env: an environment of rewax, unbatched, without ``AutoReset``.
      render_mode: ``"rgb_array"``: ``render`` draws the present state, uint8 (height, width, 3); None: nothing.
      size: height and width of a picture.

    Raises:
      ValueError: another render mode or size, ``env`` is no environment, resets by itself or is a batch. ``step``:
        an action of another shape, or one that is not finite.
      gymnasium.error.ResetNeeded: ``step`` or ``render`` before ``reset``.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 25}

    def __init__(self, env: Env, *, render_mode: str | None = None, size: tuple[int, int] = (360, 480)) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}: give 'rgb_array' or None")
        check_one_episode(env)
        self.env, self.render_mode, self._size = env, render_mode, _checked_size(size)
        self._record = None if render_mode is None else snapshots(env)
        if getattr(env, "control_dt", None):
            self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / float(env.control_dt)))}  # type: ignore[attr-defined]
        self.observation_space = observation_space(env)
        self.action_space = box(env.action_spec)
        self._reset, self._step = compiled(env)
        self._state: State | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._state = state = self._reset(key_from(self.np_random))
        self._pictures = SteadyPictures(self._size)
        return numpy_observation(state), state_info(state)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset before step")
        self._state = state = self._step(self._state, check_action(action, self.env.action_spec.shape))
        ends = bool(state.terminated), bool(state.truncated)
        return numpy_observation(state), float(state.reward), *ends, state_info(state)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """A picture of the present state.

        The camera stands still until something leaves its picture, see ``rewax.viz.steady``. Each reset places it anew.
        """
        if self._record is None:
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset before render")
        return self._pictures.draw(self._record([self._state]))


class GymnasiumVectorEnv(VectorEnv):
    """Many environments in one compiled program. Each begins a new episode in the step that ends one.

    In that step ``infos["final_obs"]`` and ``infos["final_info"]`` hold the end of the old episode, as in gymnasium's
    mode ``SAME_STEP``. All other entries of ``infos`` are arrays over the environments, with a mask of those that have
    them: metrics belong to a step, and a new episode has made none. ``status`` holds bits of ``rewax.Status``.

    Args:
      env: an environment of rewax, unbatched, without ``AutoReset``.
      num_envs: number of environments.
      flat: observations are one vector for each environment, arrays in the order of their names.

    Raises:
      ValueError: ``env`` is no environment, resets by itself or is a batch, or ``num_envs`` is below 1. ``step``:
        actions of another shape, or not finite.
      gymnasium.error.ResetNeeded: ``step`` before ``reset``.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, env: Env, num_envs: int, *, flat: bool = False) -> None:
        require_env(env)
        self.env, self.num_envs, self.flat = env, checked_num_envs(num_envs), flat
        space = observation_space(env)
        self.single_observation_space = spaces.flatten_space(space) if flat else space
        self.single_action_space = box(env.action_spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset, self._step = compiled(Vmap(env=AutoReset(env=env)))
        self._state: State | None = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """First states of all environments. ``seed`` is one number, or one for each environment; None draws it."""
        if options and "reset_mask" in options:
            raise ValueError("reset_mask is given, but environments that end begin anew by themselves: leave it out")
        if seed is None or isinstance(seed, (int, np.integer)):
            super().reset(seed=None if seed is None else int(seed))
            keys = jax.random.split(key_from(self.np_random), self.num_envs)
        else:
            if len(seed) != self.num_envs:
                raise ValueError(f"there are {len(seed)} seeds for {self.num_envs} environments: give one for each")
            drawn = np.random.SeedSequence().generate_state(self.num_envs)
            seed = [int(new if s is None else s) for s, new in zip(seed, drawn, strict=True)]
            later = np.random.SeedSequence(seed)  # later resets without seeds repeat, too
            super().reset(seed=int(later.generate_state(1)[0]))
            keys = jax.numpy.stack([key_from(np.random.default_rng(s)) for s in seed])
        self._state = state = self._reset(keys)
        return batch_observation(state.obs, flat=self.flat), self._infos(state, np.zeros(self.num_envs, bool))

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset before step")
        shape = (self.num_envs, *self.env.action_spec.shape)
        self._state = state = self._step(self._state, check_action(actions, shape))
        done = np.asarray(state.done)
        infos = self._infos(state, done)
        if done.any():
            assert state.final_obs is not None
            last = batch_observation(state.final_obs, flat=self.flat)
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(done):
                final[i] = jax.tree.map(lambda value, i=i: value[i], last)
            metrics = numpy_metrics(state)
            ended = {**metrics, **{f"_{name}": done for name in metrics}}
            infos |= {"final_obs": final, "_final_obs": done, "final_info": ended, "_final_info": done}
        rewards = np.asarray(state.reward, np.float64)
        return (
            batch_observation(state.obs, flat=self.flat),
            rewards,
            np.array(state.terminated),
            np.array(state.truncated),
            infos,
        )

    def _infos(self, state: State, done: np.ndarray) -> dict[str, Any]:
        metrics = numpy_metrics(state)
        return {**metrics, **{f"_{name}": ~done for name in metrics}}


def make_gymnasium_env(
    *, task: str, scale: str, render_mode: str | None = None, size: tuple[int, int] = (360, 480), **options: Any
) -> GymnasiumEnv:
    """Entry point of ``gymnasium.make("rewax/RollingFlat-small-v0", ...)``; options are those of ``rewax.make``."""
    return GymnasiumEnv(make(task, scale=scale, **options), render_mode=render_mode, size=size)


def make_gymnasium_vector_env(
    *, task: str, scale: str, num_envs: int = 1, flat: bool = False, **options: Any
) -> GymnasiumVectorEnv:
    """Entry point of ``gymnasium.make_vec("rewax/RollingFlat-small-v0", num_envs=16)``."""
    return GymnasiumVectorEnv(make(task, scale=scale, **options), num_envs, flat=flat)


def _checked_size(size: Any) -> tuple[int, int]:
    """Height and width of a picture."""
    remedy = "give height and width in pixels, (360, 480) for example"
    if not isinstance(size, (tuple, list)) or len(size) != 2:
        raise ValueError(f"size is {size!r}: {remedy}")
    height, width = (integer_option(f"size[{i}]", pixels, remedy) for i, pixels in enumerate(size))
    return height, width


def observation_space(env: Env) -> spaces.Dict:
    """The observation as a ``Dict`` with a ``Box`` of float32 for each array."""
    return spaces.Dict({name: box(spec) for name, spec in env.observation_spec.items()})


def box(spec: ArraySpec) -> spaces.Box:
    """A spec as a ``Box`` of float32."""
    return spaces.Box(low=spec.low, high=spec.high, shape=spec.shape, dtype=np.float32)
