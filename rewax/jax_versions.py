"""Versions of JAX that rewax is tested with, and versions that it excludes."""

import functools
import importlib.metadata
import warnings

OLDEST = (0, 10, 1)
NEWEST = (0, 12)
"""Includes all of 0.12. A newer JAX is expected to work and causes one warning; see ``untested``."""
EXCLUDED = {
    "0.10.2": "miscompiles some programs on the CPU",
    "0.11.0": "compiles sums of particles for GPUs into slow loops of compare-and-swap",
}
"""Excluded releases of that range, and the reasons."""


def requirement() -> str:
    """Requirement for pip, as in ``pyproject.toml``, without an upper bound."""
    return ",".join([f"jax>={_dotted(OLDEST)}", *(f"!={version}" for version in EXCLUDED)])


def tested() -> str:
    """The tested range in words."""
    return f"{_dotted(OLDEST)} to {_dotted(NEWEST)}"


def untested(version: str) -> str | None:
    """A warning about a JAX that is newer than the tested ones, else None."""
    if numbers(version)[: len(NEWEST)] <= NEWEST:
        return None
    return (
        f"jax {version} is newer than those that rewax is tested with ({tested()}): if something fails or is slow, "
        f"pip install 'jax<{_dotted((*NEWEST[:-1], NEWEST[-1] + 1))}'"
    )


@functools.cache
def warn_if_untested() -> None:
    """Warns once per process if the installed JAX is newer than the tested ones."""
    sentence = untested(importlib.metadata.version("jax"))
    if sentence is not None:
        warnings.warn(sentence, UserWarning, stacklevel=3)


def numbers(version: str) -> tuple[int, ...]:
    """Leading numbers of a version: 0.12.8rc1 gives (0, 12, 8)."""
    found = []
    for part in version.split("."):
        digits = part[: len(part) - len(part.lstrip("0123456789"))]
        if not digits:
            break
        found.append(int(digits))
    return tuple(found)


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))


__all__ = ["EXCLUDED", "NEWEST", "OLDEST", "numbers", "requirement", "tested", "untested", "warn_if_untested"]
