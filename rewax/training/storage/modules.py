"""Users' own modules: imported by name or path, recorded in ``config.json``, imported again when a run is loaded."""

import importlib
import importlib.util
import linecache
import sys
import sysconfig
import traceback
from collections.abc import Mapping, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from rewax.agents.registry import list_algorithms
from rewax.envs.registry import list_envs

_REWAX = Path(__file__).resolve().parents[2]


def import_modules(names: Sequence[str]) -> list[dict[str, str]]:
    """Import modules that register environments or algorithms.

    Args:
      names: dotted names, found from the working directory too, or paths of ``.py`` files.

    Returns:
      For each module its ``name`` and the ``folder`` that it was found in: the entry ``imports`` of ``config.json``.

    Raises:
      ValueError: in one sentence: there is no such module or file, or the module raised an exception.
    """
    return [_import_file(Path(name)) if name.endswith(".py") else _import_name(name) for name in names]


def import_recorded(config: Mapping[str, Any], run_dir: str | Path) -> None:
    """Import the modules that a run was started with, if its environment or its algorithm is not registered yet.

    Args:
      config: contents of the run's ``config.json``.
      run_dir: directory of the run.

    Raises:
      ValueError: in one sentence: a module is gone or raised an exception, or the entry ``imports`` is damaged.
    """
    env, agent = config.get("env"), config.get("agent")
    if (not isinstance(env, str) or env in list_envs()) and (agent is None or agent in list_algorithms()):
        return
    modules = config.get("imports", [])
    if not isinstance(modules, list) or not all(_is_entry(entry) for entry in modules):
        raise ValueError(
            f"imports of {run_dir}/config.json is {modules!r}: restore the file, or set imports to [] and give --import"
        )
    for entry in modules:
        name, folder = entry["name"], Path(entry["folder"])
        if not _is_found(name, folder):
            raise ValueError(
                f"{run_dir} was trained with --import of the module {name!r} in {folder}, which is gone: put it back, "
                "or give its new place with --import"
            )
        installed = {"site-packages", "dist-packages"} & set(folder.parts)  # in another environment it lies elsewhere
        if not installed and _is_beside(name, folder) and (other := _other_folder(name, folder)):
            raise ValueError(
                f"{run_dir} was trained with the module {name!r} in {folder}, but that in {other} would be imported: "
                "rename one of them, or give the right one with --import"
            )
        _import(name, folder)


def user_error(error: BaseException, what: str) -> ValueError:
    """An exception of a user's own code as one sentence: what failed, the last line of that code, and the error."""
    where = ""
    if isinstance(error, SyntaxError) and error.filename:
        where = f" at {error.filename}:{error.lineno}"
    else:
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if _is_users(frame.filename)]
        if frames:
            line = linecache.getline(frames[-1].filename, frames[-1].lineno or 0).strip()
            where = f" at {frames[-1].filename}:{frames[-1].lineno} ({line})"
    message = " ".join(str(error.msg if isinstance(error, SyntaxError) else error).split())[:300]
    return ValueError(f"{what} failed{where}: {type(error).__name__}{': ' if message else ''}{message}")


def _is_users(filename: str) -> bool:
    """Whether a source file belongs neither to Python, nor to an installed package, nor to rewax."""
    if filename.startswith("<"):
        return False
    path, places = Path(filename).resolve(), sysconfig.get_paths()
    library = [Path(places[key]).resolve() for key in ("stdlib", "platstdlib", "purelib", "platlib")]
    return not any(path.is_relative_to(folder) for folder in (*library, _REWAX))


def _is_entry(entry: Any) -> bool:
    return isinstance(entry, Mapping) and all(isinstance(entry.get(key), str) for key in ("name", "folder"))


def _is_found(name: str, folder: Path) -> bool:
    top = name.partition(".")[0]
    return _is_beside(name, folder) or top in sys.modules or importlib.util.find_spec(top) is not None


def _is_beside(name: str, folder: Path) -> bool:
    top = name.partition(".")[0]
    return (folder / f"{top}.py").is_file() or (folder / top).is_dir()


def _other_folder(name: str, folder: Path) -> str:
    """The folder from which a module would be imported if it is not this one, else an empty text."""
    top = name.partition(".")[0]
    spec = sys.modules[top].__spec__ if top in sys.modules else importlib.util.find_spec(top)
    found = "" if spec is None or spec.origin is None else _folder_of(spec)  # None: its folders are merged
    return found if found != str(folder.resolve()) else ""


def _import_file(path: Path) -> dict[str, str]:
    if not path.is_file():
        raise ValueError(f"there is no file {str(path)!r} to import: check the path")
    path = path.resolve()
    if "." in path.stem or not _is_free(path.stem, path):
        raise ValueError(f"{str(path)!r} cannot be imported as {path.stem!r}, a name that is taken: rename the file")
    return _import(path.stem, path.parent)


def _is_free(name: str, path: Path) -> bool:
    """No other file is or would be imported by this name."""
    found = sys.modules[name].__spec__ if name in sys.modules else importlib.util.find_spec(name)
    return found is None or found.origin == str(path)


def _import_name(name: str) -> dict[str, str]:
    return _import(name, Path.cwd())


def _import(name: str, folder: Path) -> dict[str, str]:
    """Import a module; ``folder`` is searched after all other places."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
        importlib.invalidate_caches()
    try:
        importlib.import_module(name)
    except (Exception, SystemExit) as error:
        own = isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}.")
        if own or not all(name.split(".")):
            raise ValueError(
                f"there is no module {name!r} to import: check the name, or give the path of a .py file"
            ) from None
        raise user_error(error, f"the import of {name}") from error
    return {"name": name, "folder": _home(name)}


def _home(name: str) -> str:
    """The folder from which the first part of a module's name is imported."""
    top = sys.modules[name.partition(".")[0]]
    if top.__spec__ is not None and (found := _folder_of(top.__spec__)):
        return found
    file = getattr(top, "__file__", None)
    return str(Path(file).resolve().parent) if file else ""


def _folder_of(spec: ModuleSpec) -> str:
    """The folder that holds a module's file, or the folder of a package; empty for a module without a file."""
    if spec.submodule_search_locations:
        return str(Path(next(iter(spec.submodule_search_locations))).resolve().parent)
    return str(Path(spec.origin).resolve().parent) if spec.has_location and spec.origin else ""


__all__ = ["import_modules", "import_recorded", "user_error"]
