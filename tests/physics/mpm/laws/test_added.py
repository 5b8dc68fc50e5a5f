"""Added stresses, by components."""

import jax.numpy as jnp
import numpy as np

from rewax.physics.mpm import Muscle, Newtonian
from rewax.physics.numerics import components as cp


def test_newtonian_stress_is_deviatoric_and_grows_with_volume(x64):
    C = np.random.default_rng(0).normal(size=(3, 3))
    F = 1.2 * np.eye(3)
    stress = Newtonian(viscosity=0.5).stress(*(cp.split_matrix(jnp.asarray(a)) for a in (F, C)))
    sym = 0.5 * (C + C.T)
    np.testing.assert_allclose(
        cp.join_matrix(stress), 2 * 1.2**3 * 0.5 * (sym - np.trace(sym) / 3 * np.eye(3)), rtol=1e-12, atol=1e-14
    )


def test_muscles_pull_along_their_deformed_fibres(x64):
    F = np.random.default_rng(1).normal(size=(3, 3))
    stress = Muscle(fibre=(0, 1, 0), activation=7.0).stress(cp.split_matrix(jnp.asarray(F)))
    np.testing.assert_allclose(cp.join_matrix(stress), 7.0 * np.outer(F[:, 1], F[:, 1]), rtol=1e-12)
