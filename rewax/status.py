"""What went wrong in a simulation, as a bit field that lives inside jitted code.

Exceptions cannot leave a compiled program, so a numerical failure sets bits in ``State.status`` instead: the
episode ends with zero gradient, the failure is counted in the metrics, and no other environment is touched.
"""

import enum

import jax
import jax.numpy as jnp

from rewax.types import Array, PyTree


class Status(enum.IntFlag):
    """Bits of ``State.status``; several can be set at once."""

    OK = 0
    NAN = 1
    """A non-finite number in the physics, an observation or the reward. Fatal: the episode ends."""
    OUT_OF_DOMAIN = 2
    """A particle left the simulated box and was clamped to its border. Not fatal."""
    CFL = 4
    """A particle crosses more than one cell per substep: the result is not to be trusted. Not fatal."""
    INACTIVE_NODES = 8
    """More nodes were needed than the scene's ``max_active_nodes``, or a particle moved by more than a cell within a
    step of such a scene: the result is not to be trusted. Give a larger number, or shorter steps. Not fatal."""
    INVERTED = 16
    """A particle is flattened or turned inside out (det F <= 0): the time step is too long for what happens to it, or
    something crushes it. Not fatal."""
    FAR_COLLIDERS = 32
    """More colliders were near than the scene's ``max_near_colliders``: some may have been left out. Give a larger
    number. Not fatal."""
    INVALID_PARAMETERS = 64
    """A number that cannot be, in the scene or the model: not finite, friction below 0, a size, softness, density or
    volume that is not positive, a substep too long for the stiffness, a pose that is not finite. Such numbers are
    refused when a scene is built; this bit tells of those that were traced or replaced. Fatal: the episode ends."""


FATAL = Status.NAN | Status.INVALID_PARAMETERS
"""Bits that end an episode."""


_REMEDIES = {
    Status.OUT_OF_DOMAIN: "a larger box, or walls that keep particles inside",
    Status.INACTIVE_NODES: "a larger max_active_nodes",
    Status.FAR_COLLIDERS: "a larger max_near_colliders",
    Status.INVALID_PARAMETERS: "numbers that make_scene or load accept",
}


def remedy(status: int) -> str:
    """What helps against the bits set in one status: ``remedy(8) == 'a larger max_active_nodes'``."""
    known = [what for bit, what in _REMEDIES.items() if status & bit]
    unknown = status & ~sum(_REMEDIES)
    return ", ".join(known + ["shorter substeps or softer contacts"] * bool(unknown or not known))


def flag(condition: Array, status: Status) -> Array:
    """``status`` where ``condition`` holds, ``OK`` elsewhere. Shape of ``condition``, int32. Gradient: none."""
    return jnp.where(condition, jnp.int32(status), jnp.int32(Status.OK))


def all_finite(tree: PyTree) -> Array:
    """True if every floating-point leaf of the tree is finite everywhere. Shape (). Gradient: none."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves])) if leaves else jnp.bool_(True)


def describe(status: int) -> str:
    """The names of the bits set in one status, joined by ``|``: ``describe(3) == 'NAN|OUT_OF_DOMAIN'``."""
    names = [bit.name or "" for bit in Status if bit is not Status.OK and status & bit]
    return "|".join(names) or "OK"
