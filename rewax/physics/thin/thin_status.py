"""Status bits of a state of cloth and ropes."""

import jax
import jax.numpy as jnp

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import POSITIVE, Number, any_illegal
from rewax.physics.numerics.fields import checked, instance, optional
from rewax.physics.numerics.pose import Pose
from rewax.physics.thin import elements
from rewax.physics.thin.grasps import grasp_numbers
from rewax.physics.thin.incremental import inverse_edges
from rewax.physics.thin.safe_speed import is_too_thick
from rewax.physics.thin.scene import SCENE, STATE, ThinScene, ThinState, check_vertices
from rewax.physics.thin.scene_checks import cloth_is_unstable, law_does_not_fit, scene_numbers
from rewax.physics.thin.self_status import self_status
from rewax.physics.thin.stable_dt import largest_stable_dt
from rewax.physics.thin.stencils import corners
from rewax.status import Status, all_finite, flag
from rewax.types import Array

FLATTENED = 1e-6
"""Squared ratio of area at which a triangle counts as flattened."""


@checked(scene=SCENE, state=STATE, poses=optional(instance(Pose, "give a Pose, or None")))
def check_status(scene: ThinScene, state: ThinState, *, poses: Pose | None = None) -> Array:
    """Status bits of a state of cloth and ropes, and of its scene.

    - ``NAN``: a number of the state is not finite.
    - ``INVERTED``: a triangle is flattened.
    - ``INVALID_PARAMETERS``: a number of the scene is illegal.
    - ``UNSOLVED``: an implicit substep of the last ``step`` missed its tolerance.
    - ``FULL_PAIRS``: a list of pairs of self-contact was full.
    - ``CROSSED``: layers crossed, or a vertex was faster than ``max_speed`` or ``largest_safe_speed``.

    Full lists and fast vertices are remembered from all steps since ``initial_state``; ``state.replace(filled=0.0,
    speed=0.0)`` forgets them. Crossed layers are those of this state.

    Args:
      scene: the scene.
      state: vertices.
      poses: poses of its bodies, as for ``step``, to check that they are finite.

    Returns:
      Bits of ``rewax.status.Status``, shape (), int32. Gradient: none.
    """
    check_vertices(scene, state)
    scene, state = jax.lax.stop_gradient((scene, state))
    flat = jnp.bool_(False)
    if scene.cloth is not None:
        strain = elements.green_strain(
            corners(scene.topology.triangles, cp.split_vector(state.x)), inverse_edges(scene)
        )
        flat = jnp.any(elements.square_area_ratio(strain) <= FLATTENED)
    numbers = [
        *scene_numbers(
            scene.cloth, scene.rope, scene.drag, scene.gravity, scene.contact, scene.ground, scene.colliders, poses
        ),
        *([] if scene.self_contact is None else scene.self_contact.legal_numbers("self_contact")),
        *grasp_numbers(scene.grasps),
        Number("mass", scene.mass, POSITIVE, "give the vertices' masses in kg"),
        Number("rest.area", scene.rest.area, POSITIVE, "give the triangles' areas in m^2"),
        Number("rest.length", scene.rest.length, POSITIVE, "give the segments' lengths in m"),
    ]
    soft = jnp.bool_(False)
    if scene.cloth is not None:
        soft = jnp.any(cloth_is_unstable(scene.cloth) | law_does_not_fit(scene.law, scene.cloth))
    if scene.stepper is not None and scene.contact is not None:
        # The force would jump, and an implicit step might have no solution.
        soft |= jnp.any((jnp.asarray(scene.contact.damping) > 0) & ~(jnp.asarray(scene.contact.onset) > 0))
    soft |= is_too_thick(scene)
    # The tolerance keeps a dt at the limit legal when the limit is rounded to float32.
    too_long = ~(scene.dt <= (1.0 + 1e-5) * largest_stable_dt(scene))
    missed = jnp.bool_(False)
    if scene.stepper is not None:
        missed = jnp.logical_not(state.error <= scene.stepper.tolerance)
    return (
        flag(~all_finite((state.x, state.v, state.holds, state.crease)), Status.NAN)
        | flag(missed, Status.UNSOLVED)
        | flag(flat, Status.INVERTED)
        | flag(any_illegal(numbers) | soft | too_long, Status.INVALID_PARAMETERS)
        | self_status(scene, state)
    )


__all__ = ["check_status"]
