"""Persistent cache of compiled programs."""

import os
from pathlib import Path

import jax


def enable_compilation_cache() -> Path:
    """Turn on JAX's persistent compilation cache, so that a second run starts without compiling.

    The directory is that of ``JAX_COMPILATION_CACHE_DIR`` or ``jax.config`` if one of them is set, else
    ``$XDG_CACHE_HOME/rewax/jax`` (``~/.cache/rewax/jax``). Call it before anything is compiled.

    Returns:
      The directory.
    """
    chosen = getattr(jax.config, "jax_compilation_cache_dir", None)
    if chosen is None:
        chosen = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rewax" / "jax"
        jax.config.update("jax_compilation_cache_dir", str(chosen))
    return Path(chosen)
