"""``rewax doctor``: versions, devices and caches, and known problems with them."""

import contextlib
import dataclasses
import importlib.metadata
import os
import platform
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from rewax import jax_versions, xla_options
from rewax.cli.options import Imports, build_env, import_modules, parse
from rewax.jax_versions import numbers

_PACKAGES = ("rewax", "jax", "jaxlib", "flax", "optax", "distrax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy")
_PROBLEMS_FOUND = 1
_NO_DEVICE = (RuntimeError, AssertionError)
"""What JAX raises for a platform that it does not know, and for one that has no device here."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options.

    Attributes:
      env: name of an environment, see ``rewax envs``: also print which of its functions run in C++.
      scale: ``small`` or ``paper``, of that environment.
      imports: module or .py file that registers environments.
    """

    env: str = ""
    scale: str = "small"
    imports: Imports = ()


def run(argv: Sequence[str]) -> int:
    """Print versions, devices and caches, then each problem with its remedy.

    Returns:
      Exit code: 0 without problems, else 1.
    """
    options = parse(Options, argv, prog="rewax doctor", description="Print versions, devices and problems.")
    versions = {name: _version(name) for name in _PACKAGES}
    print(f"Python {platform.python_version()}, {platform.platform()}, {os.cpu_count()} cores")
    print(*(f"{name} {version or 'is not installed'}" for name, version in versions.items()), sep=", ")
    problems = list(version_problems(versions))
    if versions["jax"]:
        problems += _device_problems()
        problems += native_problems()
        problems += cache_problems()
        problems += flag_problems(os.environ.get("XLA_FLAGS", ""))
    for note in version_notes(versions):
        print(f"note: {note}")
    if versions["jax"]:
        import_modules(options.imports)
    if options.env and versions["jax"] and _backend():
        print_lowering(options.env, options.scale)
    for problem, remedy in problems:
        print(f"problem: {problem}: {remedy}")
    print(f"{len(problems)} problems" if problems else "no problems found")
    return _PROBLEMS_FOUND if problems else 0


def version_problems(versions: Mapping[str, str | None]) -> Iterator[tuple[str, str]]:
    """Missing and incompatible packages, each with its remedy.

    Args:
      versions: versions of packages by name; None: not installed.
    """
    for name, version in versions.items():
        if version is None and name != "rewax":
            yield f"{name} is not installed", f"pip install {name}"
    jax = versions.get("jax")
    if jax and versions.get("jaxlib") and numbers(jax)[:2] != numbers(versions["jaxlib"] or "")[:2]:
        yield f"jax {jax} and jaxlib {versions['jaxlib']} do not belong together", f"pip install 'jaxlib=={jax}'"
    if jax in jax_versions.EXCLUDED:
        yield f"jax {jax} {jax_versions.EXCLUDED[jax]}", f"pip install '{jax_versions.requirement()}'"
    if jax and numbers(jax) < jax_versions.OLDEST:
        yield f"jax {jax} is older than rewax needs", f"pip install -U '{jax_versions.requirement()}'"
    flax = versions.get("flax")
    if flax and numbers(flax) < (0, 12, 8):
        yield f"flax {flax} fails to import beside new versions of jax", "pip install -U 'flax>=0.12.8'"
    mjx = versions.get("mujoco-mjx")
    if mjx and numbers(mjx) >= (4,):
        yield f"mujoco-mjx {mjx} is not known to agree with rewax's use of it", "pip install 'mujoco-mjx>=3.17,<4'"


def version_notes(versions: Mapping[str, str | None]) -> Iterator[str]:
    """Notes on packages that should work, but that rewax is not tested with.

    Args:
      versions: as for ``version_problems``.
    """
    jax = versions.get("jax")
    sentence = jax_versions.untested(jax) if jax else None
    if sentence is not None:
        yield sentence


def _device_problems() -> Iterator[tuple[str, str]]:
    import jax

    try:
        devices = jax.devices()
    except _NO_DEVICE as error:
        reason = (str(error).strip().splitlines() or [f"JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS', '')}"])[0]
        yield f"JAX finds no device ({reason})", "unset JAX_PLATFORMS, or set it to cpu"
        return
    kinds = sorted({f"{device.platform} ({device.device_kind})" for device in devices})
    print(f"JAX computes on {len(devices)} x {', '.join(kinds)}")
    if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        yield "double precision is on (JAX_ENABLE_X64): training takes about twice as long", "unset it for training"
    if devices[0].platform == "cpu" and shutil.which("nvidia-smi") and "cpu" not in os.environ.get("JAX_PLATFORMS", ""):
        yield "there is an NVIDIA driver, but JAX computes on the CPU", "pip install 'rewax[cuda]'"


def _backend() -> str | None:
    """The platform on which JAX computes; None: it finds no device."""
    import jax

    with contextlib.suppress(*_NO_DEVICE):
        return jax.default_backend()
    return None


def native_problems() -> Iterator[tuple[str, str]]:
    """Print whether physics runs in C++ on a CPU and where its libraries come from; yield problems with it."""
    from rewax.fixed_sources import fixed_sources
    from rewax.lowering import build

    if build.is_off():
        print("physics on a CPU: with JAX, for REWAX_NATIVE=0 is set")
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        print(_compiler_line(), _cache_line(), sep="\n")
        found = [build.load(source) for source in fixed_sources()]
    for sentence in dict.fromkeys(str(warning.message) for warning in caught):
        yield sentence, "C++ is built again where need be"
    missing = next((reason for library, reason in found if library is None), None)
    if missing is None:
        print(f"physics on a CPU: in C++, {_origin([Path(reason) for _, reason in found])}")
    if _backend() != "cpu":
        return
    if missing is not None:
        yield (
            f"physics is not computed in C++ ({missing}): a CPU takes 2 times as long for soft bodies, 8 for rigid",
            "install a C++ compiler, g++ or clang++, or set CXX to one",
        )


def print_lowering(name: str, scale: str) -> None:
    """Print whether each function of an environment's step and its derivatives runs in C++ or in XLA on a CPU.

    Args:
      name: of the environment.
      scale: ``small`` or ``paper``.

    Raises:
      ValueError: there is no such environment or scale.
    """
    from rewax.lowering.report import LoweringWarning
    from rewax.testing import where_it_runs

    env = build_env(name, scale)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LoweringWarning)  # the list below has these
        try:
            decisions = where_it_runs(env)
        except ValueError as error:
            print(f"{name} at scale {scale}: {error}")
            return
    left = [decision for decision in decisions if decision.reason]
    print(f"{name} at scale {scale}: {len(decisions) - len(left)} rules run in C++, {len(left)} in XLA")
    print(*(f"  {decision}" for decision in decisions), sep="\n")


def _compiler_line() -> str:
    from rewax.lowering import build, compiler

    words = compiler.command()
    if words is None:
        return build.no_compiler()
    try:
        return f"C++ compiler: {build.compiler()} ({(compiler.version(words).splitlines() or ['?'])[0]})"
    except compiler.CompilerError as error:
        return f"C++ compiler: {build.compiler()}, which does not work: {error}"


def _cache_line() -> str:
    from rewax.lowering import library_cache

    folder = library_cache.folder()
    return f"C++ libraries are kept in {folder}: {len(list(folder.glob('*.so')))} files"


def _origin(paths: Sequence[Path]) -> str:
    """A phrase about the origin of libraries."""
    from rewax.lowering import shipped

    packaged = [path.parent for path in paths if shipped.FOLDER in path.parents]
    built = len(paths) - len(packaged)
    parts = [f"{len(packaged)} libraries that came with rewax ({packaged[0]})"] if packaged else []
    return ", ".join(parts + ([f"{built} libraries that were built here"] if built else []))


def cache_problems() -> Iterator[tuple[str, str]]:
    """Print the size of the cache of compiled programs; yield a problem if it cannot be written."""
    from rewax.training.storage.cache import enable_compilation_cache

    folder = enable_compilation_cache()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder):
            pass
    except OSError as error:
        yield (
            f"compiled programs cannot be kept in {folder} ({error.strerror}), so every start compiles anew",
            "set JAX_COMPILATION_CACHE_DIR to a directory that can be written",
        )
        return
    files = [path for path in Path(folder).rglob("*") if path.is_file()]
    print(f"compiled programs: {len(files)} files, {sum(f.stat().st_size for f in files) / 2**20:.0f} MiB in {folder}")


def flag_problems(flags: str) -> Iterator[tuple[str, str]]:
    """XLA flags that make rewax slow or its gradients wrong.

    Args:
      flags: value of the environment variable XLA_FLAGS.
    """
    if xla_options.is_on(flags, "xla_gpu_deterministic_ops"):
        yield (
            "--xla_gpu_deterministic_ops makes the particles' scatter a serial loop on a GPU",
            "remove it from XLA_FLAGS",
        )
    wrong = xla_options.wrong_gradients(flags)
    if wrong is not None:
        yield wrong, "remove one of the two from XLA_FLAGS"


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "from this directory" if name == "rewax" and "rewax" in sys.modules else None
