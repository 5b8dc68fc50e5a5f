"""Programs without rewax's C++, which run on any machine with XLA."""

from typing import Any

import jax

_portable = jax.make_user_context(False)


def portable() -> Any:
    """A context in which programs are compiled without rewax's C++.

    ``jax.export`` needs no context: exported programs are always portable.

    Example:
      >>> with portable():
      ...     jax.jit(env.step).lower(state, action).compile().as_text()  # no custom calls of rewax
    """
    return _portable(True)


def is_portable() -> bool:
    """Whether C++ must be left out: inside ``portable``, or while JAX exports a program."""
    return bool(_portable.value)
