"""Scenes of implicit steps with everything that pushes or pulls, and what is known at a step's beginning, for tests."""

import jax
import jax.numpy as jnp
import numpy as np
from self_contact_bodies import folded
from thin_bodies import KINDS, SHEET, shaken

from rewax.physics import thin
from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Sphere
from rewax.physics.thin import implicit_step
from rewax.physics.thin.self_contact import close_pairs
from rewax.physics.thin.stepping import split

TIGHT = thin.Implicit(tolerance=1e-10, newton_iterations=60, cg_tolerance=1e-4, gradient_tolerance=1e-12)
CONTACT = {"stiffness": 50.0, "damping": 0.1, "friction_damping": 0.1, "friction": 0.2, "onset": 0.01}


def touched(kind="StVK", **changes):
    """A shaken body that a moving sphere and the ground push: scene, state, poses of one step."""
    given = {
        "held": [0, 3],
        "damping": 1e-3,
        "dt": 2e-3,
        "stepper": TIGHT,
        "contact": PenaltyContact(**CONTACT),
        "ground": Ground(normal=(0.0, 1.0, 0.0), height=-0.001),
        "colliders": (Collider(shape=Sphere(radius=0.1), body=0, friction=0.3),),
    }
    scene, mesh = KINDS[kind](**given | changes)
    position = jnp.asarray([[[0.2, -0.09, 0.1]], [[0.201, -0.089, 0.1]]])
    return (
        scene,
        shaken(mesh, size=0.005),
        Pose(position, jnp.broadcast_to(jnp.eye(3), (2, 1, 3, 3))),
    )


def met():
    """A sheet folded on itself: scene, state, poses of one step."""
    scene, state = folded()
    scene = scene.replace(stepper=TIGHT, dt=1e-3)
    return scene, state, thin.static_poses(1, dtype=float)


def known(scene, state, poses):
    """``implicit_step.Known`` of the step that begins with a state."""
    pairs = None if scene.self_contact is None else close_pairs(scene, split(state).x)
    ends = jax.tree.map(lambda a: a[0], poses), jax.tree.map(lambda a: a[1], poses)
    at = implicit_step.Step(*split(state)[:2], jnp.zeros(()))
    return implicit_step._known(scene, at, ends, None, pairs)


CASES = {**{kind: lambda kind=kind: touched(kind) for kind in KINDS}, "self-contact": met}
SIZE = len(SHEET.vertices)


def noise(like, seed):
    rng = np.random.default_rng(seed)
    return tuple(jnp.asarray(rng.standard_normal(a.shape)) for a in like)
