"""Environments as data: the arrays of an environment apart from what shapes the program.

A compiled program takes an environment's arrays as arguments, so that other values compile nothing. Objects of a
``struct.dataclass`` hold no other leaves. Python numbers in other objects stay in the program.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.wrappers import Vmap, is_number
from rewax.types import Array, PyTree


@dataclasses.dataclass(frozen=True)
class _Form:
    """What is fixed about an environment; hashable.

    Attributes:
      treedef: structure of the environment.
      names: of its leaves, in order.
      numbers: leaves that are Python numbers; None where a leaf is an array.
    """

    treedef: Any
    names: tuple[str, ...]
    numbers: tuple[float | None, ...]


@struct.dataclass
class EnvLeaves(struct.Replaceable):
    """An environment, or a batch of them, taken apart; a part of every agent's training state.

    Attributes:
      arrays: the leaves that are arrays, by name (``".scene.material.density"``).
      form: everything else (static).
      axis: of the arrays along which environments lie; None: one environment (static).
    """

    arrays: dict[str, Array]
    form: _Form = struct.static_field()
    axis: int | None = struct.static_field(default=None)

    @classmethod
    def of(cls, env: Any) -> "EnvLeaves":
        """Take an environment apart; a batch is given as ``Vmap(env=..., env_axis=0)``, see ``stack``."""
        axis = getattr(env, "env_axis", None)
        env = env.env if axis is not None else env
        named, treedef = jax.tree.flatten_with_path(env)
        names = tuple(jax.tree_util.keystr(path) for path, _ in named)
        numbers = tuple(leaf if is_number(leaf) else None for _, leaf in named)
        arrays = {
            name: strongly_typed(leaf)
            for name, number, (_, leaf) in zip(names, numbers, named, strict=True)
            if number is None
        }
        return cls(arrays=arrays, form=_Form(treedef, names, numbers), axis=axis)

    def build(self) -> Any:
        """The environment. Gradient: exact with respect to ``arrays``."""
        numbers = zip(self.form.names, self.form.numbers, strict=True)
        leaves = [self.arrays[name] if number is None else number for name, number in numbers]
        return jax.tree.unflatten(self.form.treedef, leaves)

    def first(self) -> Any:
        """The first environment of a batch, or the only one."""
        if self.axis is None:
            return self.build()
        return self.replace(arrays={name: a[0] for name, a in self.arrays.items()}, axis=None).build()

    def check_size(self, num_envs: int) -> None:
        """Raises ValueError unless a batch holds ``num_envs`` environments."""
        for name, a in self.arrays.items():
            if self.axis is not None and (jnp.ndim(a) == 0 or a.shape[0] != num_envs):
                raise ValueError(
                    f"num_envs is {num_envs}, but the batch's leaf {name} has shape {jnp.shape(a)}: give every array "
                    f"leaf a first axis of {num_envs} (rewax.envs.stack makes one), or another num_envs"
                )


def stack(envs: Sequence[Any]) -> Vmap:
    """Environments of one kind side by side, each with leaves of its own.

    Args:
      envs: at least one; they must agree in their static fields and in the shapes of their leaves.

    Returns:
      ``Vmap(env=..., env_axis=0)``: every array leaf has a first axis of ``len(envs)``. Leaves that are one Python
      number in all of them stay that number.

    Raises:
      ValueError: no environments, or they differ in more than the values of leaves.
    """
    if not envs:
        raise ValueError("envs is empty: give at least one environment")
    if len({jax.tree.structure(env) for env in envs}) > 1:
        raise ValueError(
            "the environments differ in a static field or in their kind: stack those that differ in leaves only"
        )

    def join(*leaves: Any) -> PyTree:
        if all(is_number(leaf) and leaf == leaves[0] for leaf in leaves):
            return leaves[0]
        if len({np.shape(leaf) for leaf in leaves}) > 1:
            raise ValueError(f"a leaf has shapes {[np.shape(leaf) for leaf in leaves]}: give all the same")
        return jnp.stack([jnp.asarray(leaf) for leaf in leaves])

    return Vmap(env=jax.tree.map(join, *envs), env_axis=0)


def strongly_typed(leaf: Any) -> Array:
    """Python scalars leave weak types behind, with which a program would be compiled anew for its own output."""
    a = jnp.asarray(leaf)
    return jax.lax.convert_element_type(a, a.dtype) if jnp.issubdtype(a.dtype, jnp.number) else a
