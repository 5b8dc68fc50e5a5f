"""Numerical failures of a simulation as bits of ``State.status``.

A compiled program cannot raise exceptions, so a numerical failure sets bits in ``State.status``. A fatal failure ends
the episode with zero gradient. Metrics count all failures, and other environments are not affected.
"""

import enum

import jax
import jax.numpy as jnp

from rewax.types import Array, PyTree


class Status(enum.IntFlag):
    """Bits of ``State.status``; several can be set at once."""

    OK = 0
    NAN = 1
    """A non-finite number in the physics, an observation or the reward, or a position or velocity of rigid bodies of
    1e6 or more. Fatal: the episode ends."""
    OUT_OF_DOMAIN = 2
    """A particle left the simulated box and was clamped to its border. Not fatal."""
    CFL = 4
    """A particle crosses more than one cell per substep: the result is unreliable. Not fatal."""
    INACTIVE_NODES = 8
    """A step needs more nodes than the scene's ``max_active_nodes``, or a particle at its end is more than a cell (the
    scene's ``reach``) away from where it was at the beginning: the result is unreliable. A particle that moves further
    and returns within the step is not seen. Give a larger number, or shorter steps. Not fatal."""
    INVERTED = 16
    """A particle or tet is flattened or inverted (det F <= 0), or a triangle of cloth is flattened: the substep is too
    long for its motion, or it is crushed. Not fatal."""
    FAR_COLLIDERS = 32
    """More colliders are near than the scene's ``max_near_colliders``: some may have been left out. Give a larger
    number. Not fatal."""
    INVALID_PARAMETERS = 64
    """The scene or model holds an illegal value: not finite, friction below 0, a size, softness, density or volume that
    is not positive, a substep too long for the stiffness, a pose that is not finite. Building a scene refuses such
    values; this bit reports values that were traced or replaced. Fatal: the episode ends."""
    PENETRATION = 128
    """A particle lies more than 1.5 cells inside a tool that moves as prescribed, or the center of a collider lies
    inside a tet. The force of a prescribed tool has no limit: it tears or crushes a body that cannot give way. Leave
    room for the body, or slow the tool. For particles, a tool thinner than three cells cannot set it. Not fatal."""
    FULL_PAIRS = 256
    """More elements of cloth and ropes are, or were in a substep, close to each other than the scene's
    ``self_contact.pairs_per_element``, or more particles to triangles than ``contact.pairs_per_particle`` of a mixed
    scene: some contacts may have been left out. Give a larger number. Not fatal."""
    CROSSED = 512
    """Cloth or a rope passes through itself or another one or lies at the same place, or a vertex is, or was, faster
    than the scene's ``self_contact.max_speed`` or ``thin.largest_safe_speed``, above which it may. In a mixed scene
    also: a particle may meet cloth faster than ``contact.max_speed`` or ``mixed.largest_safe_particle_speed``, or was
    pressed through nine tenths of the contact's thickness. Not fatal."""
    UNSOLVED = 1024
    """An implicit step of cloth or ropes left a larger error than the scene's ``stepper.tolerance``, or the constraint
    forces of rigid bodies did not balance within the model's ``iterations``: its gradient is wrong. Not fatal."""


FATAL = Status.NAN | Status.INVALID_PARAMETERS
"""Bits that end an episode."""


_REMEDIES = {
    Status.OUT_OF_DOMAIN: "a larger box, or walls that keep particles inside",
    Status.INACTIVE_NODES: "a larger max_active_nodes",
    Status.FAR_COLLIDERS: "a larger max_near_colliders",
    Status.INVALID_PARAMETERS: "numbers that make_scene or load accept",
    Status.FULL_PAIRS: "a larger self_contact.pairs_per_element, or contact.pairs_per_particle of a mixed scene",
    Status.CROSSED: "slower motion, a smaller dt, or a stiffer or thicker self_contact with a larger max_speed",
    Status.UNSOLVED: "a smaller dt, or more iterations (rigid.load), newton_iterations or cg_iterations (stepper)",
    Status.PENETRATION: "a slower tool, more room for the body, a tool driven by forces, or a finer mesh",
}


def remedy(status: int) -> str:
    """Remedies for the bits of a status: ``remedy(8) == 'a larger max_active_nodes'``."""
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
    """Names of the bits of a status, joined by ``|``: ``describe(3) == 'NAN|OUT_OF_DOMAIN'``.

    Raises:
      ValueError: a bit that is none of ``Status``.
    """
    if int(status) & ~sum(Status):
        raise ValueError(f"status is {status}, which has bits that are none of Status: give a State.status")
    names = [bit.name or "" for bit in Status if bit is not Status.OK and status & bit]
    return "|".join(names) or "OK"
