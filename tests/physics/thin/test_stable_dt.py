"""The stable dt of cloth and ropes holds, and is not far too small."""

import jax.numpy as jnp
import pytest
from thin_bodies import KINDS, LINE, SHEET, cloth_scene, rope_scene, run, shaken

from rewax.physics import thin
from rewax.struct import replace_leaf

CASES = {
    **KINDS,
    "stiffly bending rope": lambda: (rope_scene(bending=10.0, stretch=1.0, dt=1e-6), LINE),
    "stiffly bending hinges": lambda: (
        replace_leaf(cloth_scene(dt=1e-6, bending_law=thin.BendingLaw.HINGES), "cloth.bending", jnp.asarray(10.0)),
        SHEET,
    ),
    "stiffly bending cloth": lambda: (replace_leaf(cloth_scene(dt=1e-6), "cloth.bending", jnp.asarray(10.0)), SHEET),
}


@pytest.mark.parametrize(("factor", "grows"), [(0.99, False), (2.0, True)])
@pytest.mark.parametrize(
    "kind", ["StVK", "rope", "stiffly bending rope", "stiffly bending cloth", "stiffly bending hinges"]
)
def test_the_stable_dt_is_stable_and_twice_as_much_is_not(x64, kind, factor, grows):
    scene, mesh = CASES[kind]()
    dt = factor * float(thin.largest_stable_dt(scene))
    start = shaken(mesh, size=1e-6, speed=0.0)
    end = run(scene.replace(dt=dt), start, 2000)
    moved = float(jnp.abs(end.x - mesh.vertices).max())
    assert (not moved < 1e-3) == grows, moved
