"""Materials of cloth: a plate by hand, and the laws agree at small strains."""

import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics import thin
from rewax.physics.thin.elements import membrane_energy, membrane_stress

PLATE = {"youngs_modulus": 2e5, "poissons_ratio": 0.25, "thickness": 0.01, "density": 500.0}


def test_a_plate_has_the_stiffness_of_plane_stress():
    cloth = thin.isotropic_cloth(**PLATE)
    np.testing.assert_allclose(cloth.warp, 2e5 * 0.01 / (1 - 0.25**2), rtol=1e-6)
    np.testing.assert_allclose(cloth.shear, 2e5 * 0.01 / 2.5, rtol=1e-6)
    np.testing.assert_allclose(cloth.bending, 2e5 * 1e-6 / 12 / (1 - 0.25**2), rtol=1e-6)
    np.testing.assert_allclose(cloth.density, 5.0, rtol=1e-6)


@pytest.mark.parametrize("law", thin.MembraneLaw)
def test_stress_is_linear_at_small_strains_and_energy_half_the_work(x64, law):
    cloth = thin.isotropic_cloth(**PLATE)
    strain = tuple(jnp.asarray(1e-6 * e) for e in (1.0, -0.4, 0.7))
    expected = (cloth.warp - 0.4 * cloth.coupling, cloth.coupling - 0.4 * cloth.warp, 0.7 * cloth.shear)
    stress = membrane_stress(strain, cloth, law)
    np.testing.assert_allclose(np.asarray(stress), 1e-6 * np.asarray(expected), rtol=1e-5)
    work = 0.5 * sum(s * e for s, e in zip(stress, strain, strict=True))
    np.testing.assert_allclose(membrane_energy(strain, cloth, law), work, rtol=1e-3)
