"""Complete training states on disk, bit-exact.

A checkpoint is one directory ``<run>/checkpoints/<iteration>`` holding ``arrays/`` (written by Orbax), ``leaves.json``
(name, shape, dtype and checksum of every array) and ``checksums.json`` (of ``leaves.json``; older ones have none). It
is written under another name and renamed when it is complete, so a directory with a number for a name and these
contents is complete. All other files and folders there are left alone.
"""

import contextlib
import errno
import json
import logging
import shutil
import threading
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp

from rewax.agents.base import Agent
from rewax.agents.run_state import RunState
from rewax.physics.numerics.checks import static_integer
from rewax.training.storage.leaves import (
    ENTRIES,
    OtherStructure,
    check_structure,
    checksum,
    describe_leaf,
    from_numpy,
    named_leaves,
    to_numpy,
)
from rewax.whole_files import replacing

T = TypeVar("T")
_SIMULATED = (".environments.state.physics", ".environments.state.metrics")
"""Beginnings of the names of arrays that a new episode makes anew."""
_PASSING = ("RESOURCE_EXHAUSTED", "PERMISSION_DENIED", "UNAVAILABLE", "DEADLINE_EXCEEDED")
"""Errors of the machine in messages of Orbax and JAX."""
_OF_THE_FILE = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EIO)
"""Errors of the system that a damaged checkpoint causes, or a damaged disk."""
_HEALTHY = "healthy"
"""Beside the checkpoints: the iteration of the last one from before failures."""


class DamagedCheckpoint(ValueError):
    """A checkpoint that cannot be read."""


class Unread(ValueError):
    """A checkpoint that could not be read now, although it may be whole: the machine failed, not the file."""


def save(run_dir: str | Path, train_state: Any, *, keep: int = 3, protect: int | None = None) -> Path:
    """Write a checkpoint of a training state, then remove all but the newest ``keep``.

    Args:
      run_dir: directory of the run, made if missing.
      train_state: pytree of arrays and typed PRNG keys with a field ``iteration``.
      keep: number of checkpoints that are kept, at least 1.
      protect: iteration of a checkpoint that is kept as well.

    Returns:
      The checkpoint's directory. It appears complete or not at all, even if the process is killed.
    """
    folder = Path(run_dir).absolute() / "checkpoints"
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in (*folder.glob(".writing-*"), *folder.glob(".removing-*")):  # of a process that was killed
        _remove(leftover)
    step = int(train_state.iteration)
    unfinished, final = folder / f".writing-{step}", folder / str(step)
    try:
        _write(unfinished, train_state)
    except BaseException:
        with contextlib.suppress(OSError):  # a full disk has room again
            _remove(unfinished)
        raise
    if _is_checkpoint(final):
        _discard(final)
    elif final.exists():
        _set_aside(final, "stray")
    unfinished.rename(final)
    for old in steps(run_dir)[: -max(keep, 1)]:
        if old != protect:
            _discard(folder / str(old))
    return final


def _write(folder: Path, train_state: Any) -> None:
    """Write the files of a checkpoint."""
    folder.mkdir()
    leaves = {name: to_numpy(leaf) for name, leaf in named_leaves(train_state)}
    described = {name: describe_leaf(leaf, leaves[name]) for name, leaf in named_leaves(train_state)}
    # Orbax refuses arrays without elements; their description is sufficient.
    stored = {name: value for name, value in leaves.items() if value.size}
    with _silent_threads(), _checkpointer() as checkpointer:
        checkpointer.save(folder / "arrays", args=ocp.args.StandardSave(stored))
    text = json.dumps(described, indent=1)
    (folder / "leaves.json").write_text(text)
    (folder / "checksums.json").write_text(json.dumps({"leaves.json": zlib.crc32(text.encode())}) + "\n")


@contextlib.contextmanager
def _silent_threads() -> Iterator[None]:
    """An exception in a thread of Orbax is raised by ``save`` too: its traceback is neither printed nor logged."""
    log, usual = logging.getLogger("absl"), threading.excepthook
    level = log.level
    threading.excepthook = lambda _: None
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        threading.excepthook = usual
        log.setLevel(level)


def steps(run_dir: str | Path) -> list[int]:
    """Iterations of the checkpoints of a run, in order; other files and folders are ignored."""
    folder = Path(run_dir) / "checkpoints"
    found = folder.iterdir() if folder.is_dir() else ()
    return sorted(int(path.name) for path in found if _is_number(path.name) and _is_checkpoint(path))


def latest_step(run_dir: str | Path) -> int | None:
    """Iteration of the newest checkpoint of a run, None if there is none."""
    found = steps(run_dir)
    return found[-1] if found else None


def healthy_step(run_dir: str | Path) -> int | None:
    """The iteration of the last checkpoint from before failures, if it is still there; else that of the newest."""
    try:
        known = int((Path(run_dir) / "checkpoints" / _HEALTHY).read_text())
    except (OSError, ValueError):
        known = None
    return known if known in steps(run_dir) else latest_step(run_dir)


def write_healthy(run_dir: str | Path, step: int | None) -> None:
    """Keep the iteration of the last checkpoint from before failures for the process that resumes the run."""
    if step is not None:
        with replacing(Path(run_dir) / "checkpoints" / _HEALTHY) as file:
            file.write_text(str(step))


def _warn(sentence: str) -> None:
    warnings.warn(sentence.removeprefix("warning: "), stacklevel=3)


def restore(
    run_dir: str | Path,
    like: T,
    *,
    step: int | None = None,
    restart: Agent | None = None,
    set_aside: bool = False,
    notify: Callable[[str], None] = _warn,
) -> T:
    """Read a training state back, bit for bit.

    Args:
      run_dir: directory of the run.
      like: a training state of the same structure, or its ``jax.eval_shape``; values are not used.
      step: iteration of the checkpoint; by default the newest that can be read.
      restart: the agent: if only the state of the simulation has other fields, as that of another
        version of rewax, keep all that was learnt and begin new episodes. Needs a ``RunState``. None: raise an error.
      set_aside: rename the damaged checkpoints that were skipped, so that the run does not find them again.
      notify: called with a sentence about each damaged checkpoint that was skipped, and about new episodes; a Python
        warning by default.

    Raises:
      ValueError: in one sentence: ``step`` is no integer, the directory is missing, holds no checkpoint, none can be
        read (``DamagedCheckpoint``), a field has another shape or type than ``like`` (``OtherStructure``), or the
        machine failed while reading (``Unread``), which leaves the checkpoint as it is.
    """
    return _newest(run_dir, lambda path: _read(path, like, restart, notify), step, set_aside, notify)


def stored_leaves(run_dir: str | Path) -> dict[str, Any]:
    """Arrays of the newest readable checkpoint by name, such as ``.actor_params['params']['mean']['bias']``.

    Raises:
      ValueError: in one sentence: there is no checkpoint that can be read.
    """

    def read(path: Path) -> dict[str, Any]:
        described = _read_description(path)
        arrays = _read_arrays(path, described)
        return {name: from_numpy(arrays[name], None, entry["impl"]) for name, entry in described.items()}

    return _newest(run_dir, read, None, False, _warn)


def _newest(
    run_dir: str | Path, read: Callable[[Path], T], step: int | None, set_aside: bool, notify: Callable[[str], None]
) -> T:
    """The result of ``read`` for the newest checkpoint that is not damaged; arguments as for ``restore``."""
    run_dir = Path(run_dir).absolute()
    if step is not None:
        step = static_integer("step", step, 0, "give the iteration of a checkpoint, or None for the newest")
    if not run_dir.is_dir():
        raise ValueError(f"there is no run directory {run_dir}: check the path, or start a new run there")
    found = steps(run_dir)
    if step is not None and step not in found:
        raise ValueError(
            f"{run_dir} holds no checkpoint of iteration {step}: choose one of {', '.join(map(str, found)) or 'none'}"
        )
    if not found:
        raise ValueError(f"{run_dir} holds no complete checkpoint: start the run afresh in another directory")
    damaged: dict[int, DamagedCheckpoint] = {}
    for candidate in [step] if step is not None else found[::-1]:
        try:
            restored = read(run_dir / "checkpoints" / str(candidate))
        except DamagedCheckpoint as error:
            damaged[candidate] = error
            continue
        there = steps(run_dir)  # a process that trains may have removed old ones meanwhile
        for other, error in damaged.items():
            if other not in there:
                continue
            kept = ""
            if set_aside:
                kept = f"; it is kept as {_set_aside(run_dir / 'checkpoints' / str(other), 'damaged').name}"
            notify(f"warning: {error}: using the one of iteration {candidate} before it{kept}")
        return restored
    if step is None and steps(run_dir) != found:
        return _newest(run_dir, read, None, set_aside, notify)
    newest = next(iter(damaged.values()))
    raise DamagedCheckpoint(f"{newest}: choose another one, or start the run afresh in another directory")


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit() and str(int(name)) == name


def _is_checkpoint(path: Path) -> bool:
    """A complete checkpoint, or the remains of one."""
    return (path / "leaves.json").is_file() or (path / "arrays").is_dir()


def _discard(path: Path) -> None:
    """Remove a checkpoint. It is renamed first, so that an interruption leaves nothing that looks complete."""
    _remove(path.rename(path.with_name(f".removing-{path.name}")))


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def _set_aside(path: Path, what: str) -> Path:
    """Rename ``9`` to ``9.<what>``, or to ``9.<what>-2`` and so on where that is taken."""
    name, number = f"{path.name}.{what}", 1
    while path.with_name(name).exists():
        number += 1
        name = f"{path.name}.{what}-{number}"
    return path.rename(path.with_name(name))


def _read(path: Path, like: T, restart: Agent | None, notify: Callable[[str], None]) -> T:
    """A checkpoint as ``like``; ``restart`` and ``notify`` as for ``restore``."""
    described = _read_description(path)
    named = named_leaves(like)
    lost: set[str] = set()
    try:
        check_structure(described, dict(named), path)
    except OtherStructure:
        lost = {name for name in {**described, **dict(named)} if name.startswith(_SIMULATED)}
        if restart is None or not isinstance(like, RunState):
            raise
        kept, wanted = ({n: v for n, v in of.items() if n not in lost} for of in (described, dict(named)))
        check_structure(kept, wanted, path)
    arrays = _read_arrays(path, described)
    leaves = [None if name in lost else from_numpy(arrays[name], leaf, described[name]["impl"]) for name, leaf in named]
    read = jax.tree.unflatten(jax.tree.structure(like), leaves)
    if not lost or restart is None:
        return read
    notify(
        f"note: the simulation of {path} had another state, as in another version of rewax: all that was learnt is "
        "kept, and new episodes begin"
    )
    return jax.jit(type(read).restarted, static_argnums=1)(read, restart.config)


def _read_description(path: Path) -> dict[str, Any]:
    try:
        text, sums = (path / "leaves.json").read_bytes(), path / "checksums.json"
        if sums.is_file() and json.loads(sums.read_text())["leaves.json"] != zlib.crc32(text):
            raise ValueError("leaves.json does not have its checksum")
        described = json.loads(text)
        complete = all(entry.keys() >= ENTRIES for entry in described.values())
    except Exception as error:
        raise _unreadable(path, error) from error
    if not complete:
        raise _unreadable(path, "leaves.json lacks entries")
    return described


def _read_arrays(path: Path, described: dict[str, Any]) -> dict[str, np.ndarray]:
    try:
        empty = {name: np.empty(entry["stored_shape"], entry["stored_dtype"]) for name, entry in described.items()}
        stored = {name: value for name, value in empty.items() if value.size}
        with _checkpointer() as checkpointer:
            arrays = checkpointer.restore(path / "arrays", args=ocp.args.StandardRestore(stored))
    except Exception as error:  # Orbax raises many kinds
        raise _unreadable(path, error) from error
    arrays = {name: np.asarray(value) for name, value in (empty | arrays).items()}
    for name, value in arrays.items():
        if checksum(value) != described[name]["crc32"]:
            raise _unreadable(path, f"checksum of {name} differs")
    return arrays


def _checkpointer() -> ocp.Checkpointer:
    """A checkpointer of this process alone: Orbax's default would wait for the other processes."""
    alone = ocp.options.MultiprocessingOptions(primary_host=jax.process_index(), active_processes={jax.process_index()})
    if jax.process_count() == 1:
        alone = ocp.options.MultiprocessingOptions()
    return ocp.Checkpointer(ocp.StandardCheckpointHandler(multiprocessing_options=alone), multiprocessing_options=alone)


def _may_pass(error: BaseException | None) -> bool:
    """Whether the machine failed, not the file: too many open files, no memory, no permission."""
    while error is not None:
        of_system = isinstance(error, OSError) and error.errno not in (*_OF_THE_FILE, None)
        if of_system or isinstance(error, MemoryError) or any(code in str(error) for code in _PASSING):
            return True
        error = error.__cause__ or error.__context__
    return False


def _unreadable(path: Path, error: object) -> DamagedCheckpoint | Unread:
    reason = str(error).strip().split("\n")[0][:200] or type(error).__name__
    if isinstance(error, BaseException) and _may_pass(error):
        return Unread(f"checkpoint {path} could not be read now ({reason}): remove the cause, and repeat the command")
    return DamagedCheckpoint(f"checkpoint {path} is damaged and cannot be read ({reason})")


__all__ = ["DamagedCheckpoint", "OtherStructure", "Unread", "latest_step", "restore", "save", "steps", "stored_leaves"]
