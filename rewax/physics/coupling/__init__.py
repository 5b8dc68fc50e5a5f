"""Two-way coupling of rigid bodies with soft ones (particles, tetrahedra, cloth), and of particles with cloth.

``articulated``, the coupling with robots, is imported on first use, because it loads MuJoCo.
"""

import importlib
from typing import TYPE_CHECKING, Any

from rewax.physics.coupling import free_body, mixed
from rewax.physics.coupling.exchange import Wrench, no_wrench
from rewax.physics.coupling.free import step, step_prescribed
from rewax.physics.coupling.free_body import FreeBodies, Inertia, bodies_at_rest, inertia_of, poses, solid
from rewax.physics.coupling.mixed import MixedScene, MixedState, make_mixed_scene
from rewax.physics.coupling.particle_contact import ParticleContact
from rewax.physics.numerics.pose import static_poses

if TYPE_CHECKING:
    from rewax.physics.coupling import articulated

__all__ = [
    "FreeBodies", "Inertia", "MixedScene", "MixedState", "ParticleContact", "Wrench", "articulated", "bodies_at_rest",
    "free_body", "inertia_of", "make_mixed_scene", "mixed", "no_wrench", "poses", "solid", "static_poses", "step",
    "step_prescribed",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name != "articulated":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module("rewax.physics.coupling.articulated")
