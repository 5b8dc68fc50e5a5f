"""Persistent cache of compiled programs."""

import os
from pathlib import Path

import jax


def enable_compilation_cache() -> Path:
    """Turn on JAX's persistent compilation cache, so that a second run starts without compiling.

    The directory is that of ``JAX_COMPILATION_CACHE_DIR`` or ``jax.config`` if one of them is set, else
    ``$XDG_CACHE_HOME/rewax/jax`` (``~/.cache/rewax/jax``). Call it before anything is compiled.

    XLA prints long lines, ``Loading XLA:CPU AOT result. Target machine feature +prefer-no-gather is not supported``,
    when it reads a program. They are harmless. Set the environment variable ``TF_CPP_MIN_LOG_LEVEL=3`` before Python
    imports JAX to hide them.

    Returns:
      The directory.
    """
    chosen = getattr(jax.config, "jax_compilation_cache_dir", None)
    if chosen is None:
        chosen = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rewax" / "jax"
        jax.config.update("jax_compilation_cache_dir", str(chosen))
    return Path(chosen)
