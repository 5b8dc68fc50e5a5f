"""Touch of tasks: steps of soft bodies with and without patches that feel."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rewax.physics.contact import Collider, Patches, Wrench
from rewax.physics.contact.patches import no_touch
from rewax.physics.numerics import Pose
from rewax.types import Array


def untouched(touch: dict[str, Patches] | None, like: Array) -> dict[str, Wrench] | None:
    """``physics.felt`` at the beginning of an episode: zero, or None where nothing feels."""
    return None if touch is None else no_touch(touch, like)


def felt_step(solver: Any, scene: Any, soft: Any, poses: Pose, touch: Any, store_every: int) -> tuple[Any, Any]:
    """``step`` of a solver (``mpm`` or ``tets``) and None without ``touch``; ``step_with_touch`` with it."""
    if touch is None:
        return solver.step(scene, soft, poses, store_every=store_every), None
    return solver.step_with_touch(scene, soft, poses, touch, store_every=store_every)


def moved_origin(felt: Any, shift: Array) -> Any:
    """Touch of walls in a world whose origin lies at ``shift`` [m], shape (3,): torques about the true origin."""
    return jax.tree.map(
        lambda one: Wrench(one.force, one.torque + jnp.cross(shift, one.force)),
        felt,
        is_leaf=lambda tree: isinstance(tree, Wrench),
    )


def named_tools(colliders: Sequence[Collider]) -> dict[str, int]:
    """The bodies of colliders by name: ``tool``, or ``tool_0``, ``tool_1``, ... of several."""
    bodies = sorted({collider.body for collider in colliders})
    return {"tool" if len(bodies) == 1 else f"tool_{body}": body for body in bodies}


__all__ = ["felt_step", "moved_origin", "named_tools", "untouched"]
