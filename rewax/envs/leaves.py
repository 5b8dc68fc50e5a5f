"""Environments as data: the arrays of an environment, separate from its static structure.

A compiled program takes the arrays of an environment as arguments, so that new values need no compilation. Objects of
a ``struct.dataclass`` hold arrays only. Python numbers that other objects hold are constants of the program.
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
    """The static part of an environment; hashable.

    Attributes:
      treedef: structure of the environment.
      names: names of its leaves, in order.
      numbers: for each leaf its value if it is a Python number, None if it is an array.
      spelled: the same with their types, because 1 == 1.0 == True and 0.0 == -0.0.
    """

    treedef: struct.Structure
    names: tuple[str, ...]
    numbers: tuple[float | None, ...]
    spelled: tuple[str, ...]


@struct.dataclass
class EnvLeaves(struct.Replaceable):
    """The arrays and the static structure of an environment or a batch; a part of every agent's training state.

    Attributes:
      arrays: the parameters of the environment, by name (``".scene.material.density"``).
      form: everything else (static).
      axis: the axis of the arrays that enumerates environments; None: there is one environment (static).
    """

    arrays: dict[str, Array]
    form: _Form = struct.static_field()
    axis: int | None = struct.static_field(default=None)

    @classmethod
    def of(cls, env: Any) -> "EnvLeaves":
        """Partition an environment, or a batch: ``Vmap(env=..., env_axis=0)``, see ``stack``."""
        axis = env.env_axis if isinstance(env, Vmap) else None
        env = env.env if axis is not None else env
        named, treedef = jax.tree.flatten_with_path(env)
        names = tuple(jax.tree_util.keystr(path) for path, _ in named)
        numbers = tuple(leaf if is_number(leaf) else None for _, leaf in named)
        arrays = {
            name: strongly_typed(leaf)
            for name, number, (_, leaf) in zip(names, numbers, named, strict=True)
            if number is None
        }
        spelled = tuple(_spelled(number) for number in numbers)
        return cls(arrays=arrays, form=_Form(struct.Structure.of(treedef), names, numbers, spelled), axis=axis)

    def build(self) -> Any:
        """The environment. Gradient: exact with respect to ``arrays``."""
        numbers = zip(self.form.names, self.form.numbers, strict=True)
        leaves = [self.arrays[name] if number is None else number for name, number in numbers]
        return self.form.treedef.unflatten(leaves)

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
                    f"num_envs is {num_envs}, but {name} of the batch has shape {jnp.shape(a)}: give every array a "
                    f"first axis of {num_envs} (rewax.envs.stack makes one), or another num_envs"
                )


def stack(envs: Sequence[Any]) -> Vmap:
    """A batch of environments of one kind, each with parameters of its own.

    Args:
      envs: at least one environment. Their static fields and the shapes of their arrays must agree.

    Returns:
      ``Vmap(env=..., env_axis=0)``: every array has a first axis of ``len(envs)``. A Python number that is the same in
      all environments stays a Python number.

    Raises:
      ValueError: there are no environments, or they differ in more than the values of parameters.
    """
    if not envs:
        raise ValueError("envs is empty: give at least one environment")
    if len({jax.tree.structure(env) for env in envs}) > 1:
        raise ValueError(
            "the environments differ in a static field or in their kind: stack those that differ in parameters only"
        )

    def join(*leaves: Any) -> PyTree:
        if all(is_number(leaf) and _spelled(leaf) == _spelled(leaves[0]) for leaf in leaves):
            return leaves[0]
        if len({np.shape(leaf) for leaf in leaves}) > 1:
            shapes = [np.shape(leaf) for leaf in leaves]
            raise ValueError(f"a parameter has shapes {shapes}: give it the same shape in all environments")
        return jnp.stack([jnp.asarray(leaf) for leaf in leaves])

    return Vmap(env=jax.tree.map(join, *envs), env_axis=0)


def _spelled(number: float | None) -> str:
    return f"{type(number).__name__} {number!r}"


def strongly_typed(leaf: Any) -> Array:
    """An array without a weak type. A weakly typed input would recompile the program for its own, strong output."""
    a = jnp.asarray(leaf)
    return jax.lax.convert_element_type(a, a.dtype) if jnp.issubdtype(a.dtype, jnp.number) else a
