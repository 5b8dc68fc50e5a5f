"""Counts and arrays per particle have to fit together."""

import re

import numpy as np
import pytest
from flat_materials import flat_material
from plain_scenes import SOLID, WATER, scene

from rewax.physics import mpm
from rewax.physics.mpm import Grid
from rewax.physics.mpm.scene_checks import check_box


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"particle_counts": (5, 0)}, "particle_counts[1] is 0: give the number of particles of material[1], at least 1"),
        ({"particle_counts": (5, -2)}, "particle_counts[1] is -2: give the number"),
        ({"particle_counts": (5, 2.5)}, "particle_counts[1] is 2.5: give the number"),
        ({"particle_counts": 7}, "particle_counts is 7 with 2 materials: give a tuple of materials"),
        ({"particle_counts": (5, 2), "particle_volume": np.full(6, 1e-4)}, "particle_volume has 6 entries, but there are "
         "7 particles: give shape (), or one entry for each particle"),
    ],
)  # fmt: skip
def test_particle_counts_must_add_up(changes, sentence):
    both = (flat_material(**SOLID), flat_material(**WATER))
    scene(both, particle_counts=(5, 2), particle_volume=np.full(7, 1e-4))
    with pytest.raises(ValueError, match="^" + re.escape(sentence)):
        scene(both, **changes)


def test_arrays_per_particle_must_fit():
    dense = {**SOLID, "density": np.full(6, 1000.0)}
    fits = scene(dense, particle_volume=np.full(6, 1e-4))
    with pytest.raises(ValueError, match=r"density has 6 entries, but there are 7 particles: give shape \(\)"):
        scene(dense, particle_volume=np.full(7, 1e-4))
    with pytest.raises(ValueError, match=r"material\[1\].density has 6 entries, but there are 3 particles"):
        scene((flat_material(**WATER), flat_material(**dense)), particle_counts=(3, 3))
    with pytest.raises(ValueError, match=r"particle_volume has 6 entries, but there are 5 particles"):
        mpm.initial_state(np.full((5, 3), 0.3), fits)
    with pytest.raises(ValueError, match=r"particle_volume has shape \(6, 1\): give shape \(\), or one entry"):
        scene(SOLID, particle_volume=np.full((6, 1), 1e-4))


def test_particles_must_lie_in_the_box():
    grid = Grid(shape=(8, 9, 10), spacing=0.1)
    check_box(grid, np.array([grid.lower, grid.upper]))
    with pytest.raises(
        ValueError, match=r"^1 particles lie outside the grid's box from \(0\.05, .* particle 1 at \(0\.3, 0\.76"
    ):
        check_box(grid, np.array([[0.3, 0.3, 0.3], [0.3, 0.76, 0.3]]))
