"""Energy and momentum of cloth and ropes are conserved."""

import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import KINDS, run, shaken

from rewax.physics import thin


@pytest.mark.parametrize("kind", KINDS)
def test_ten_thousand_substeps_conserve_momentum_and_energy(x64, kind):
    scene, mesh = KINDS[kind]()
    start = shaken(mesh, size=1e-3)
    end = run(scene, start, 10_000)
    scale = float(jnp.sum(scene.mass))
    np.testing.assert_allclose(thin.momentum(scene, end), thin.momentum(scene, start), atol=1e-12 * scale)
    np.testing.assert_allclose(
        thin.angular_momentum(scene, end), thin.angular_momentum(scene, start), atol=1e-10 * scale
    )
    energy = [float(thin.elastic_energy(scene, s) + thin.kinetic_energy(scene, s)) for s in (start, end)]
    assert abs(energy[1] / energy[0] - 1) < 0.05, energy
