"""Energy and momentum of tetrahedra: by hand, and conserved."""

import jax.numpy as jnp
import numpy as np
import pytest
from tet_bodies import NUM_TETS, body, run, shaken

from rewax.physics import tets
from rewax.physics.tets.law import stable_parameters


def test_a_free_body_keeps_momentum_angular_momentum_and_mass(x64):
    """Over 1000 substeps, with activation and damping at work; damping takes energy out."""
    activation = np.linspace(-0.2, 0.2, NUM_TETS)
    ends = {}
    for damping in (0.0, 10.0):
        scene, state = body(damping=damping, activation=activation)
        state = shaken(state)
        end = run(scene, state)
        assert float(jnp.abs(end.x - state.x).max()) > 0.01
        for conserved in (tets.momentum, tets.angular_momentum):
            np.testing.assert_allclose(conserved(scene, end), conserved(scene, state), rtol=1e-11, atol=1e-11)
        before, after = (float(tets.elastic_energy(scene, s) + tets.kinetic_energy(scene, s)) for s in (state, end))
        ends[damping] = (after - before) / float(tets.kinetic_energy(scene, state))
    assert float(jnp.sum(scene.mass)) == pytest.approx(1000.0 * 0.016)
    print("energy after 1000 substeps, over the kinetic energy at first", ends)
    assert abs(ends[0.0]) < 0.05 and ends[10.0] < -0.3


def test_energy_and_momentum_of_a_rigid_motion_by_hand(x64, rotations):
    """Of lumped masses: sum m v, sum m r x v, sum m/2 v^2, -sum m g . x; no elastic energy, however turned."""
    scene, state = body(gravity=(0.5, -9.81, 2.0))
    omega, drift, turn = np.array([1.0, -2.0, 3.0]), np.array([0.3, 0.1, -0.7]), rotations(0, 1)[0]
    x = np.asarray(state.x) @ turn.T + [1.0, 2.0, 3.0]
    v = np.cross(omega, x) + drift
    moving = state.replace(x=jnp.asarray(x), v=jnp.asarray(v))
    mass = np.asarray(scene.mass)[:, None]
    about = np.array([0.2, -0.4, 0.6])
    np.testing.assert_allclose(tets.momentum(scene, moving), (mass * v).sum(axis=0), rtol=1e-12)
    np.testing.assert_allclose(
        tets.angular_momentum(scene, moving, about), (mass * np.cross(x - about, v)).sum(axis=0), rtol=1e-12
    )
    # The block's centre of mass is (1, 2, 3), its mass 16 kg.
    np.testing.assert_allclose(tets.momentum(scene, moving), 16.0 * (np.cross(omega, [1, 2, 3]) + drift), rtol=1e-12)
    potential = -16.0 * np.dot([0.5, -9.81, 2.0], [1.0, 2.0, 3.0])
    assert float(tets.gravitational_energy(scene, moving)) == pytest.approx(potential, rel=1e-12)
    assert float(tets.kinetic_energy(scene, moving)) == pytest.approx(0.5 * (mass * v**2).sum(), rel=1e-12)
    assert abs(float(tets.elastic_energy(scene, moving))) < 1e-9


def test_elastic_energy_of_a_small_stretch_is_hookes(x64):
    """E e^2 / 2 per volume of a bar that is pulled by e and thins by nu e."""
    E, nu, e = 1e5, 0.3, 1e-4
    mu, lam = stable_parameters(E, nu)
    scene, state = body(mu=mu, lam=lam)
    pulled = state.replace(x=state.x * jnp.array([1 + e, 1 - nu * e, 1 - nu * e]))
    assert float(tets.elastic_energy(scene, pulled)) == pytest.approx(0.016 * 0.5 * E * e**2, rel=1e-3)
