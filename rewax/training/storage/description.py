"""``config.json``: the description of a run, and the differences between two of them."""

import dataclasses
import functools
import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rewax.envs.registry import recipe
from rewax.lowering.report import Decision
from rewax.whole_files import replacing

_PACKAGES = ("rewax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy")


def describe_run(agent: Any, env: Any, given: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Entries of ``config.json`` from which ``load_run`` rebuilds environment and agent.

    Args:
      agent: its ``name`` becomes the entry ``agent``, its ``config`` the entry ``<name>``.
      env: ``env.made_by``, which ``rewax.make`` sets, becomes the entries ``env``, ``scale`` and ``env_kwargs``.
      given: further entries; they override those.
    """
    made_by, described = recipe(env), {}
    if made_by:
        described = {"env": made_by["env"], "scale": made_by["scale"], "env_kwargs": dict(made_by.get("kwargs", {}))}
    if agent.name:
        described |= {"agent": agent.name, agent.name: agent.config}
    return described | dict(given or {})


def write_config(run_dir: str | Path, config: Mapping[str, Any]) -> None:
    """Write the configuration of a run and the versions of the packages that it depends on to ``config.json``."""
    content = plain(config) | {"versions": versions()}
    with replacing(Path(run_dir) / "config.json") as unfinished:
        unfinished.write_text(json.dumps(content, indent=2) + "\n")


def write_environment(run_dir: str | Path) -> None:
    """Write Python, platform, devices and the versions of all installed packages to ``environment.txt``.

    It also says whether C++ was on; ``append_lowering`` adds which functions ran in C++.
    """
    import jax

    from rewax.lowering import machine

    devices = sorted({device.device_kind for device in jax.devices()})
    head = f"# Python {platform.python_version()}, {platform.platform()}, {len(jax.devices())} x {', '.join(devices)}"
    cpp = f"# C++ on a CPU: {'on' if machine.why_in_xla() is None else 'off'}"
    (Path(run_dir) / "environment.txt").write_text("\n".join([head, cpp, *_installed()]) + "\n")


@functools.cache
def _installed() -> tuple[str, ...]:
    """All installed packages with their versions, read once: it takes up to half a second."""
    found = (distribution.metadata for distribution in importlib.metadata.distributions())
    return tuple(sorted({f"{about['Name']}=={about['Version']}" for about in found if about["Name"]}, key=str.lower))


def provenance() -> dict[str, str]:
    """Provenance of a result: commit of rewax's checkout, processor, C++ on or off, version of JAX.

    The commit ends in ``+`` if files were changed; it is empty for an installed package.
    """
    import jax

    from rewax.lowering import machine

    kind = jax.devices()[0].device_kind
    processor = f"{os.cpu_count()} x {_processor()}" if kind == "cpu" else kind
    cpp = "on" if machine.why_in_xla() is None else "off"
    return {"commit": _commit(), "processor": processor, "cpp": cpp, "jax": jax.__version__}


def provenance_of_parts(stored: Mapping[str, Any], iteration: int) -> list[dict[str, Any]]:
    """Provenance of each part of a run, and the iteration ``after`` which it began.

    A run has another part where it was resumed with another commit, processor, C++ setting or JAX.

    Args:
      stored: contents of its ``config.json``; empty for a new run.
      iteration: from which it continues now.
    """
    listed = stored.get("provenance")
    parts = [part for part in listed if isinstance(part, dict)] if isinstance(listed, list) else []
    parts = [part for part in parts if isinstance(part.get("after"), int) and part["after"] < iteration]
    now = provenance()
    if parts and all(parts[-1].get(name) == value for name, value in now.items()):
        return parts
    return [*parts, {"after": iteration, **now}]


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _commit() -> str:
    folder = Path(__file__).resolve().parent
    try:
        ask = functools.partial(subprocess.run, cwd=folder, capture_output=True, text=True, check=True, timeout=10)
        ask(["git", "ls-files", "--error-unmatch", Path(__file__).name])  # not an enclosing repository
        commit = ask(["git", "rev-parse", "--short=12", "HEAD"]).stdout.strip()
        return commit + "+" * bool(ask(["git", "status", "--porcelain", "--untracked-files=no", "."]).stdout.strip())
    except (OSError, subprocess.SubprocessError):
        return ""


def append_lowering(run_dir: str | Path, decisions: Iterable[Decision]) -> None:
    """Add to ``environment.txt`` which functions of a compiled program run in C++ and which in XLA, and why."""
    lines = sorted({f"# {decision}" for decision in decisions})
    with (Path(run_dir) / "environment.txt").open("a") as file:
        file.writelines(f"{line}\n" for line in lines)


def read_config(run_dir: str | Path) -> dict[str, Any]:
    """The configuration that ``write_config`` wrote; empty if there is none.

    Raises:
      ValueError: the file cannot be read, is not JSON, or is not an object with named entries.
    """
    path = Path(run_dir) / "config.json"
    if not path.is_file():
        return {}
    try:
        config = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is not readable as JSON ({error}): restore it, or remove it to go without") from None
    if not isinstance(config, dict):
        found = path.read_text().strip()[:40]
        raise ValueError(f"{path} holds {found}, not named entries: restore it, or remove it to go without")
    return config


def plain(value: Any) -> Any:
    """``value`` for JSON: dataclasses and mappings as dicts, tuples as lists, unknown types as text."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)


def changes(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any, Any]]:
    """Entries that both descriptions have with different values: dotted name, old value, new value."""
    found = []
    for name in [name for name in new if name in old]:
        if isinstance(old[name], Mapping) and isinstance(new[name], Mapping):
            found += changes(old[name], new[name], f"{prefix}{name}.")
        elif old[name] != new[name]:
            found.append((prefix + name, old[name], new[name]))
    return found


def one_sided(old: Mapping[str, Any], new: Mapping[str, Any], table: str) -> list[tuple[str, Any, Any]]:
    """Entries of a table that only one of two descriptions has, as ``changes`` gives them."""
    before, after = old.get(table) or {}, new.get(table) or {}
    names = [name for name in {**before, **after} if (name in before) != (name in after)]
    default = "its default"
    return [(f"{table}.{name}", before.get(name, default), after.get(name, default)) for name in names]


def versions() -> dict[str, str]:
    """Versions of the packages that a run depends on."""
    return {package: _version(package) for package in _PACKAGES}


@functools.cache
def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


__all__ = [
    "append_lowering", "changes", "describe_run", "plain", "provenance", "provenance_of_parts", "read_config",
    "write_config", "write_environment",
]  # fmt: skip
