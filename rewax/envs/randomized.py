"""Domain randomisation: leaves of an environment drawn anew at every reset."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.envs.base import State
from rewax.envs.wrappers import _Wrapper, is_number
from rewax.types import Array, Key

Randomize = Callable[[Key, Any], Any]
"""``(key, env) -> env`` with some leaves drawn anew; shapes and static fields stay. ``rewax.envs.randomize`` makes
them from names and distributions."""


@struct.dataclass
class Randomized(_Wrapper):
    """An environment whose leaves are drawn at each reset and kept until the next one.

    The drawn leaves travel in ``State.drawn``. Only those that the hook changed are kept there.

    Attributes:
      env: what the hook starts from; the same at every reset.
      randomize: the hook (static): ``lambda key, env: env.replace(...)``.

    Gradient: through the step as ever, also to ``env``; none through the hook's draw of the leaves in an episode that
    a wrapper started by itself (``AutoReset``).
    """

    randomize: Randomize = struct.static_field()

    def reset(self, key: Key) -> State:
        key, draw_key = jax.random.split(key)
        env = self.randomize(draw_key, self.env)
        return env.reset(key).replace(drawn=_changed(self.env, env))

    def step(self, state: State, action: Array) -> State:
        return _with_leaves(self.env, state.drawn or {}).step(state, action)


def check_hook(env: Any, randomize: Randomize) -> None:
    """Raises ValueError, without computing anything, for a hook that cannot draw leaves of this environment."""
    jax.eval_shape(lambda key: _changed(env, randomize(key, env)), jax.random.key(0))


def _changed(old: Any, new: Any) -> dict[str, Array]:
    """Leaves of ``new``, by name, that are not the very leaves of ``old``."""
    if jax.tree.structure(old) != jax.tree.structure(new):
        raise ValueError("randomize changed a static field or the kind of the environment: draw leaves only")
    before, after = jax.tree.leaves(old), jax.tree.leaves_with_path(new)
    found = {}
    for a, (path, b) in zip(before, after, strict=True):
        if a is b or (is_number(a) and is_number(b) and a == b):
            continue
        name = jax.tree_util.keystr(path)
        if jnp.shape(a) != jnp.shape(b):
            raise ValueError(f"randomize gave {name} shape {jnp.shape(b)} instead of {jnp.shape(a)}: keep the shape")
        found[name] = jnp.asarray(b, jnp.result_type(a))
    return found


def _with_leaves(env: Any, leaves: dict[str, Array]) -> Any:
    """The environment with some leaves, by name, replaced."""
    return jax.tree.map_with_path(lambda path, leaf: leaves.get(jax.tree_util.keystr(path), leaf), env)
