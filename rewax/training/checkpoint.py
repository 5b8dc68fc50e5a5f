"""A run on disk: complete training states, bit-exact, and the configuration they belong to.

A checkpoint is one directory ``<run>/checkpoints/<iteration>`` holding ``arrays/`` (written by Orbax) and
``leaves.json`` (name, shape, dtype and checksum of every leaf). It is written under another name and renamed when it is
complete, so a directory with a number for a name is whole.
"""

import dataclasses
import importlib.metadata
import json
import shutil
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

T = TypeVar("T")
_PACKAGES = ("rewax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy")
_ENTRIES = {"shape", "dtype", "stored_shape", "stored_dtype", "crc32", "impl"}


def save(run_dir: str | Path, train_state: Any, *, keep: int = 3) -> Path:
    """Write a checkpoint of a whole training state, then remove all but the latest ``keep``.

    Args:
      run_dir: directory of the run, made if missing.
      train_state: pytree of arrays, typed PRNG keys among them, with a field ``iteration``.
      keep: number of checkpoints that stay, at least 1.

    Returns:
      The checkpoint's directory; it appears complete or not at all, however the process ends.
    """
    folder = Path(run_dir).absolute() / "checkpoints"
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(".*"):  # of a process that was killed
        shutil.rmtree(leftover)
    step = int(train_state.iteration)
    unfinished, final = folder / f".writing-{step}", folder / str(step)
    unfinished.mkdir()
    leaves = {name: _to_numpy(leaf) for name, leaf in _named_leaves(train_state)}
    described = {name: _describe(leaf, leaves[name]) for name, leaf in _named_leaves(train_state)}
    # Orbax refuses arrays without elements; their description says all there is to know.
    stored = {name: value for name, value in leaves.items() if value.size}
    with ocp.Checkpointer(ocp.StandardCheckpointHandler()) as checkpointer:
        checkpointer.save(unfinished / "arrays", args=ocp.args.StandardSave(stored))
    (unfinished / "leaves.json").write_text(json.dumps(described, indent=1))
    _discard(final)
    unfinished.rename(final)
    for old in _steps(folder)[: -max(keep, 1)]:
        _discard(folder / str(old))
    return final


def latest_step(run_dir: str | Path) -> int | None:
    """Iteration of the newest complete checkpoint of a run, None if there is none."""
    steps = _steps(Path(run_dir) / "checkpoints")
    return steps[-1] if steps else None


def restore(run_dir: str | Path, like: T, *, step: int | None = None) -> T:
    """Read a training state back, bit for bit.

    Args:
      run_dir: directory of the run.
      like: a training state of the same structure, or its ``jax.eval_shape``; values are not used.
      step: iteration of the checkpoint, the newest by default.

    Raises:
      ValueError: in one sentence: the directory is missing, holds no complete checkpoint, the checkpoint cannot be
        read, or a field has another shape or type than ``like``.
    """
    run_dir = Path(run_dir).absolute()
    if not run_dir.is_dir():
        raise ValueError(f"there is no run directory {run_dir}: check the path, or start a new run there")
    step = latest_step(run_dir) if step is None else step
    path = run_dir / "checkpoints" / str(step)
    if step is None or not path.is_dir():
        which = "complete checkpoint" if step is None else f"checkpoint of iteration {step}"
        raise ValueError(f"{run_dir} holds no {which}: start the run afresh in another directory")
    described = _read_description(path)
    named = _named_leaves(like)
    _check_structure(described, dict(named), path)
    arrays = _read_arrays(path, described)
    leaves = [_from_numpy(arrays[name], leaf, described[name]["impl"]) for name, leaf in named]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def write_config(run_dir: str | Path, config: Mapping[str, Any]) -> None:
    """Keep the configuration of a run, and the versions of the packages it rests on, in ``config.json``."""
    run_dir = Path(run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    unfinished = run_dir / "config.json.writing"
    content = plain(config) | {"versions": _versions()}
    unfinished.write_text(json.dumps(content, indent=2) + "\n")
    unfinished.replace(run_dir / "config.json")


def read_config(run_dir: str | Path) -> dict[str, Any]:
    """The configuration that ``write_config`` kept; empty if there is none.

    Raises:
      ValueError: the file is not JSON.
    """
    path = Path(run_dir) / "config.json"
    if not path.is_file():
        return {}
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is not readable as JSON ({error}): restore it, or remove it to go without") from None


def plain(value: Any) -> Any:
    """``value`` as JSON stores it: dataclasses and mappings as dicts, tuples as lists, what is left as text."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)


def _steps(folder: Path) -> list[int]:
    return sorted(int(path.name) for path in folder.glob("*") if path.name.isdigit() and path.is_dir())


def _discard(path: Path) -> None:
    """Remove a checkpoint; renamed first, so that a half-removed one does not look complete."""
    if path.exists():
        shutil.rmtree(path.rename(path.with_name(f".removing-{path.name}")))


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree.leaves_with_path(tree)]


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(getattr(leaf, "dtype", np.float32), jax.dtypes.prng_key)


def _to_numpy(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _from_numpy(value: np.ndarray, like: Any, impl: str | None) -> Any:
    array = jax.device_put(value) if getattr(like, "sharding", None) is None else jax.device_put(value, like.sharding)
    return array if impl is None else jax.random.wrap_key_data(array, impl=impl)


def _describe(leaf: Any, value: np.ndarray) -> dict[str, Any]:
    stored = {"stored_shape": value.shape, "stored_dtype": str(value.dtype), "crc32": _checksum(value)}
    return _signature(leaf) | stored | {"impl": str(jax.random.key_impl(leaf)) if _is_key(leaf) else None}


def _checksum(value: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)


def _signature(leaf: Any) -> dict[str, Any]:
    """What must agree between a checkpoint and a configuration. The dtype of a key names its generator."""
    leaf = leaf if hasattr(leaf, "dtype") else np.asarray(leaf)
    return {"shape": list(leaf.shape), "dtype": str(leaf.dtype)}


def _check_structure(described: dict[str, Any], wanted: dict[str, Any], path: Path) -> None:
    remedy = "restore it with the configuration it was made with (config.json beside it)"
    for name in described.keys() | wanted.keys():
        if name not in wanted:
            raise ValueError(f"checkpoint {path} has a field {name} that this configuration does not have: {remedy}")
        if name not in described:
            raise ValueError(f"checkpoint {path} lacks the field {name} of this configuration: {remedy}")
    for name, leaf in wanted.items():
        there, here = described[name], _signature(leaf)
        if any(there[part] != here[part] for part in here):
            raise ValueError(
                f"checkpoint {path} holds {name} as {there['dtype']} of shape {tuple(there['shape'])}, "
                f"but this configuration needs {here['dtype']} of shape {tuple(here['shape'])}: {remedy}"
            )


def _read_description(path: Path) -> dict[str, Any]:
    try:
        described = json.loads((path / "leaves.json").read_text())
        complete = all(entry.keys() >= _ENTRIES for entry in described.values())
    except Exception as error:
        raise _unreadable(path, error) from error
    if not complete:
        raise _unreadable(path, "leaves.json lacks entries")
    return described


def _read_arrays(path: Path, described: dict[str, Any]) -> dict[str, np.ndarray]:
    empty = {name: np.empty(entry["stored_shape"], entry["stored_dtype"]) for name, entry in described.items()}
    stored = {name: value for name, value in empty.items() if value.size}
    try:
        with ocp.Checkpointer(ocp.StandardCheckpointHandler()) as checkpointer:
            arrays = checkpointer.restore(path / "arrays", args=ocp.args.StandardRestore(stored))
    except Exception as error:  # Orbax raises many kinds
        raise _unreadable(path, error) from error
    arrays = {name: np.asarray(value) for name, value in (empty | arrays).items()}
    for name, value in arrays.items():
        if _checksum(value) != described[name]["crc32"]:
            raise _unreadable(path, f"checksum of {name} differs")
    return arrays


def _unreadable(path: Path, error: object) -> ValueError:
    reason = str(error).strip().split("\n")[0][:200] or type(error).__name__
    return ValueError(
        f"checkpoint {path} is damaged and cannot be read ({reason}): remove it to continue from an earlier one"
    )


def _versions() -> dict[str, str]:
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions
