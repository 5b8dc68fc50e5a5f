"""Leaves of a training state: their names, stored arrays and descriptions, and a comparison with another structure."""

import zlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

ENTRIES = {"shape", "dtype", "stored_shape", "stored_dtype", "crc32", "impl"}
"""Keys of the dict that ``describe_leaf`` returns."""


class OtherStructure(ValueError):
    """A checkpoint has other fields, shapes or types than the configuration."""


def named_leaves(tree: Any) -> list[tuple[str, Any]]:
    """Leaves in order, with their paths as in ``.critic_params['params']``."""
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree.leaves_with_path(tree)]


def to_numpy(leaf: Any) -> np.ndarray:
    """The array that is stored for a leaf; for a typed key its data."""
    return np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf)


def from_numpy(value: np.ndarray, like: Any, impl: str | None) -> Any:
    """The leaf for a stored array, on the devices of ``like``; ``impl`` names the generator of a key."""
    array = jax.device_put(value) if getattr(like, "sharding", None) is None else jax.device_put(value, like.sharding)
    return array if impl is None else jax.random.wrap_key_data(array, impl=impl)


def describe_leaf(leaf: Any, value: np.ndarray) -> dict[str, Any]:
    """Shape, type and checksum of a leaf and of ``value``, the array stored for it."""
    stored = {"stored_shape": value.shape, "stored_dtype": str(value.dtype), "crc32": checksum(value)}
    return _signature(leaf) | stored | {"impl": str(jax.random.key_impl(leaf)) if is_key(leaf) else None}


def checksum(value: np.ndarray) -> int:
    """CRC-32 of the array's bytes."""
    return zlib.crc32(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)


def check_structure(described: dict[str, Any], wanted: dict[str, Any], path: Path) -> None:
    """Compare the arrays of a checkpoint with those of a configuration.

    Args:
      described: description of every stored leaf by name, see ``describe_leaf``.
      wanted: arrays or shapes, by name.
      path: of the checkpoint.

    Raises:
      OtherStructure: a field is missing on either side, or has another shape or type.
    """
    remedy = "restore it with the configuration it was made with (config.json beside it)"
    for name in described.keys() | wanted.keys():
        if name not in wanted:
            raise OtherStructure(
                f"checkpoint {path} has a field {name} that this configuration does not have: {remedy}"
            )
        if name not in described:
            raise OtherStructure(f"checkpoint {path} lacks the field {name} of this configuration: {remedy}")
    for name, leaf in wanted.items():
        there, here = described[name], _signature(leaf)
        if any(there[part] != here[part] for part in here):
            raise OtherStructure(
                f"checkpoint {path} holds {name} as {there['dtype']} of shape {tuple(there['shape'])}, "
                f"but this configuration needs {here['dtype']} of shape {tuple(here['shape'])}: {remedy}"
            )


def is_key(leaf: Any) -> bool:
    return jnp.issubdtype(getattr(leaf, "dtype", np.float32), jax.dtypes.prng_key)


def _signature(leaf: Any) -> dict[str, Any]:
    """Shape and dtype, which must agree between a checkpoint and a configuration; a key's dtype names its generator."""
    leaf = leaf if hasattr(leaf, "dtype") else np.asarray(leaf)
    return {"shape": list(leaf.shape), "dtype": str(leaf.dtype)}
