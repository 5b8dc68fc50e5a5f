"""Environments with sensors: pictures, clouds and touch as further named observations."""

import inspect
import math
from collections.abc import Mapping
from typing import Any, Protocol

import jax
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.envs.base import SENSOR_LEAF, ArraySpec, State, with_first_observations, with_observations
from rewax.envs.kit.checks import as_numbers
from rewax.envs.randomized import innermost
from rewax.envs.wrappers import _Wrapper, check_began, check_inside, count_inside, forwarded
from rewax.physics.contact import Patches
from rewax.physics.numerics.checks import as_array, shown
from rewax.sensors.touch import Touch
from rewax.sensors.world import World
from rewax.types import Array, Key, Observation

_STREAM = 0x5E45
"""Folded into a state's key, so that sensors draw from a stream of their own and physics is the same without them."""


class Sensor(Protocol):
    """A sensor that can be added to an environment: a pytree with one method.

    It may also have ``bounds``, the least and the largest number that the observation can hold.
    """

    def see(self, world: World, key: Key) -> Array:
        """The observation of one state.

        Args:
          world: what there is.
          key: for noise.
        """
        ...


@struct.dataclass
class Sensing(struct.Replaceable, _Wrapper):
    """An environment with additional observations from sensors; nothing else of it changes.

    Numbers of the sensors (a camera's position, the size of its noise) are parameters of the environment. So they can
    be randomised, and they may differ between the environments of a batch. A step in which a sensor observes a
    non-finite number fails: ``Status.NAN`` is set, the episode terminates with reward 0, and the observations of all
    sensors stay as they were.

    Attributes:
      env: an environment with the method ``world(physics, up)``, as all tasks of rewax have.
      sensors: by the name of the observation.
      up: unit vector against gravity; by default that of ``env`` (static).

    Example:
      >>> env = Sensing(env=make("RollingFlat"), sensors={"depth": Camera.look_at((0, 0.1, 0), eye=(0, 0.6, 0.6))})

    Gradient: as for ``env``. An observation has the gradient of its sensor: that of a ``Touch`` is exact; a ``Camera``
      has one only with ``gradient=True``.

    Raises:
      ValueError: the environment has no ``world(physics, up)`` or observes one of the names already; a sensor is no
        pytree or has no ``see(world, key)``; ``up`` is no unit vector; or the wrapper is around ``AutoReset`` or a
        batch. ``reset``: a sensor returns no array. ``step``: the state is that of ``env`` alone.
    """

    sensors: dict[str, Any] = struct.field(default_factory=dict)
    up: tuple[float, float, float] | None = struct.static_field(default=None)

    def __post_init__(self) -> None:
        check_inside(self)
        bare = getattr(self.env, "unwrapped", self.env)
        if not isinstance(self.sensors, Mapping) or not all(isinstance(name, str) for name in self.sensors):
            raise ValueError(f'sensors is {shown(self.sensors)}: give them by name, {{"depth": Camera.look_at(...)}}')
        placed = {
            name: sensor.on(bare) if isinstance(sensor, Touch) else sensor for name, sensor in self.sensors.items()
        }
        object.__setattr__(self, "sensors", placed)
        if not callable(getattr(bare, "world", None)):
            raise ValueError(
                f"{type(bare).__name__} has no world(physics, up), which says what sensors can see: define it, see "
                "rewax.envs.kit.worlds"
            )
        known = self.env.observation_spec
        for name, sensor in self.sensors.items():
            if name in known:
                raise ValueError(f"sensors has {name!r}, which the environment observes already: choose another name")
            if not callable(getattr(sensor, "see", None)):
                raise ValueError(
                    f"sensors[{name!r}] is {sensor!r}: give a Camera, or another object with see(world, key)"
                )
            _check_arguments(name, sensor)
            if any(leaf is sensor for leaf in jax.tree.leaves(sensor)):
                raise ValueError(
                    f"sensors[{name!r}] is of the class {type(sensor).__name__}, which is no pytree: decorate it with "
                    "rewax.struct.dataclass"
                )
        given = bare.up if self.up is None else self.up
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(given)):
            raise ValueError("up follows from traced numbers of the environment: give it, up=(0.0, 1.0, 0.0)")
        up = as_array(given)
        if up.shape != (3,) or up.dtype.kind not in "fiu" or not abs(np.linalg.norm(up) - 1.0) < 1e-3:
            raise ValueError(f"up is {shown(given)}: give a unit vector against gravity, (0.0, 1.0, 0.0)")
        object.__setattr__(self, "up", tuple(up.astype(float).tolist()))

    def reset(self, key: Key) -> State:
        state = self._feeling.reset(key)
        return with_first_observations(state, self._see(state), leaf=SENSOR_LEAF)

    def step(self, state: State, action: Array) -> State:
        check_began(self, all(name in state.obs for name in self.sensors))
        own = {name: value for name, value in state.obs.items() if name not in self.sensors}
        after = self._feeling.step(state.replace(obs=own), action)
        return with_observations(after, self._see(after), state.obs, leaf=SENSOR_LEAF)

    def world(self, physics: Any, up: np.ndarray | None = None) -> World:
        """The world of the environment's own parameters, by default with ``self.up``. Gradient: exact."""
        return getattr(self.env, "unwrapped", self.env).world(physics, np.asarray(self.up if up is None else up))

    def world_of(self, state: State) -> World:
        """The world that the sensors see: with the parameters that ``Randomized`` inside drew. Gradient: exact."""
        return innermost(self.env, state.drawn or {}).world(state.physics, np.asarray(self.up))

    def __getattr__(self, name: str) -> Any:
        """Everything else is the environment's own: pictures, rewards, what tasks offer beyond the protocol."""
        return forwarded(self, name, "sensors")

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        state = jax.eval_shape(self.reset, jax.random.key(0))
        added = {
            name: ArraySpec(tuple(state.obs[name].shape), *getattr(sensor, "bounds", (-math.inf, math.inf)))
            for name, sensor in self.sensors.items()
        }
        return {**self.env.observation_spec, **added}

    @property
    def _feeling(self) -> Any:
        """The environment; with a ``Touch`` among the sensors its physics keeps what is felt."""
        touch = {name: sensor.patches for name, sensor in self.sensors.items() if isinstance(sensor, Touch)}
        return _with_touch(self.env, touch) if touch else self.env

    @property
    def _inside(self) -> int:
        """How many environments with sensors this one is wrapped around: each has random numbers of its own."""
        return count_inside(self, Sensing)

    def _see(self, state: State) -> Observation:
        world = self.world_of(state)
        key = jax.random.fold_in(jax.random.fold_in(state.key, _STREAM + self._inside), state.step_count)
        keys = jax.random.split(key, max(len(self.sensors), 1))
        felt = getattr(state.physics, "felt", None) or {}
        seen = {
            name: self.sensors[name].see(world.replace(felt=felt[name]) if name in felt else world, keys[i])
            for i, name in enumerate(sorted(self.sensors))
        }
        remedy = "return an array of real numbers"
        return {name: as_numbers(f"sensors[{name!r}].see(world, key)", value, remedy) for name, value in seen.items()}


def _check_arguments(name: str, sensor: Any) -> None:
    """Raises ValueError if ``see`` of a sensor cannot be called with a world and a key."""
    try:
        inspect.signature(sensor.see).bind(None, None)
    except TypeError:
        raise ValueError(
            f"sensors[{name!r}].see takes {inspect.signature(sensor.see)}: let it take (world, key)"
        ) from None
    except ValueError:  # a function that has no signature
        return


def _with_touch(env: Any, touch: dict[str, Patches]) -> Any:
    """The environment, inside all wrappers, with patches that feel beside those that it has."""
    if hasattr(env, "unwrapped"):
        return env.replace(env=_with_touch(env.env, touch))
    return env.replace(touch={**(env.touch or {}), **touch})


__all__ = ["Sensing", "Sensor"]
