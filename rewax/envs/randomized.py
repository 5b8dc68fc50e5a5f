"""Domain randomisation: parameters of an environment that are drawn at every reset."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.envs.base import State
from rewax.envs.copied_geoms import check_colliders
from rewax.envs.wrappers import _Wrapper, check_began, check_inside, count_inside, is_number
from rewax.physics.numerics.checks import shown
from rewax.types import Array, Key

Randomize = Callable[[Key, Any], Any]
"""A hook ``(key, env) -> env`` that draws parameters and keeps shapes and static fields. ``rewax.envs.randomize.hook``
makes one from names and distributions."""


@struct.dataclass
class Randomized(_Wrapper):
    """An environment whose parameters are drawn at each reset and kept until the next one.

    ``State.drawn`` holds the parameters that the hook changed, by name, beside those of a ``Randomized`` inside. Around
    n others, the names begin with the number and a colon, ``"1:.env.gain"``.

    Attributes:
      env: the environment that the hook gets at every reset.
      randomize: the hook (static): ``lambda key, env: env.replace(...)``.

    Gradient: exact. ``step`` reads drawn parameters from ``State.drawn``: their gradient reaches ``env`` only through
      the ``reset`` of the episode, and not if ``AutoReset`` made it.

    Raises:
      ValueError: ``randomize`` is no function, or the wrapper is around ``AutoReset`` or a batch. ``reset``: the hook
        returns no environment, or changes a shape, a static field, or the type of a parameter from integer to float.
        ``step``: the state has no drawn parameters, as that of a reset of ``env`` alone.
    """

    randomize: Randomize = struct.static_field()

    def __post_init__(self) -> None:
        check_inside(self)
        _check_callable(self.randomize)

    def reset(self, key: Key) -> State:
        key, draw_key = jax.random.split(key)
        env = self.randomize(draw_key, self.env)
        own = {self._prefix + name: value for name, value in _changed(self.env, env).items()}
        state = env.reset(key)
        return state.replace(drawn={**(state.drawn or {}), **own})

    def step(self, state: State, action: Array) -> State:
        check_began(self, state.drawn is not None)
        return self.with_draws(state.drawn or {}).step(state, action)

    def with_draws(self, drawn: dict[str, Array]) -> Any:
        """``env`` with the parameters that this hook drew. ``drawn`` is that of a state."""
        prefix = self._prefix
        own = {name.removeprefix(prefix): value for name, value in drawn.items() if name.startswith(prefix)}
        return with_parameters(self.env, own)

    @property
    def _prefix(self) -> str:
        """What tells the names of this layer from those of the layers inside, which begin elsewhere."""
        inside = count_inside(self, Randomized)
        return f"{inside}:" if inside else ""


def check_hook(env: Any, randomize: Randomize) -> None:
    """Raises ValueError for a hook that cannot draw parameters of this environment, or whose draw of a robot's geoms
    would not reach the soft body."""
    _check_callable(randomize)
    jax.eval_shape(lambda key: changed_by(randomize, key, env), jax.random.key(0))
    check_colliders(env, randomize(jax.random.key(0), env))


def _check_callable(randomize: Any) -> None:
    if not callable(randomize):
        raise ValueError(f"randomize is {shown(randomize)}: give a function (key, env) -> env, as hook({{...}}) makes")


def changed_by(randomize: Randomize, key: Key, env: Any) -> dict[str, Array]:
    """The parameters that a hook draws, by name."""
    return _changed(env, randomize(key, env))


def _changed(old: Any, new: Any) -> dict[str, Array]:
    """The arrays of ``new``, by name, that are other objects than those of ``old``."""
    if type(new) is not type(old):
        raise ValueError(f"randomize returned {shown(new)}: return the environment with other parameters")
    if jax.tree.structure(old) != jax.tree.structure(new):
        raise ValueError("randomize changed a static field or the kind of the environment: draw parameters only")
    before, after = jax.tree.leaves(old), jax.tree.leaves_with_path(new)
    found = {}
    for a, (path, b) in zip(before, after, strict=True):
        if a is b or (is_number(a) and is_number(b) and a == b):
            continue
        name = jax.tree_util.keystr(path)
        if jnp.shape(a) != jnp.shape(b):
            raise ValueError(f"randomize gave {name} shape {jnp.shape(b)} instead of {jnp.shape(a)}: keep the shape")
        old, drawn = jnp.result_type(a), jnp.result_type(b)
        if jnp.issubdtype(drawn, jnp.inexact) and not jnp.issubdtype(old, jnp.inexact):
            raise ValueError(
                f"randomize gave {name} the type {drawn} instead of {old}: draw whole numbers, or make the parameter "
                "of the environment a float"
            )
        found[name] = jnp.asarray(b, old)
    return found


def with_parameters(env: Any, parameters: dict[str, Array]) -> Any:
    """The environment with some parameters replaced, by name."""
    return jax.tree.map_with_path(lambda path, leaf: parameters.get(jax.tree_util.keystr(path), leaf), env)


def innermost(env: Any, drawn: dict[str, Array]) -> Any:
    """The environment inside all wrappers, with the parameters that ``Randomized`` among them drew for an episode.

    Args:
      env: an environment, wrapped or not.
      drawn: ``State.drawn`` of a state of it.
    """
    while isinstance(env, _Wrapper):
        env = env.with_draws(drawn) if isinstance(env, Randomized) else env.env
    return getattr(env, "unwrapped", env)
