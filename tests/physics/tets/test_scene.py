"""Scenes of tetrahedra: masses and moduli known by hand, the largest stable substep, what is refused."""

import numpy as np
import pytest
from tet_bodies import CONTACT, FLOOR, MESH, body, run, shaken

from rewax.physics import tets
from rewax.physics.tets import tetmesh


@pytest.mark.parametrize("damping", [0.0, 200.0])
def test_stable_at_the_limit_and_not_far_above_it(x64, damping):
    """Shaken by 1 %, a block at the largest stable dt keeps its energy, within the swing of a
    symplectic integrator near its limit; at 2.5 times that it explodes."""
    scene, state = body(damping=damping)
    limit = float(tets.largest_stable_dt(scene))
    state = shaken(state, 0.002, 0.0)
    growth = []
    for factor in (1.0, 2.5):
        # Time scales with dt: the same compiled program, with moduli and damping in its place.
        scale = factor * limit / scene.dt
        faster = scene.replace(mu=scene.mu * scale**2, lam=scene.lam * scale**2, damping=scene.damping * scale)
        assert float(tets.largest_stable_dt(faster)) == pytest.approx(scene.dt / factor)
        end = run(faster, state)
        before, after = (float(tets.elastic_energy(faster, s) + tets.kinetic_energy(faster, s)) for s in (state, end))
        growth.append(after / before)
    assert growth[0] < (0.1 if damping else 3.0) and not growth[1] < 10.0, growth


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dt": 0.1}, "dt is 0.1 s, above the largest stable .* take more substeps"),
        ({"contact": CONTACT.replace(stiffness=1e8)}, "dt is 0.0005 s, above the largest stable .* softer contact"),
        ({"dt": 0.0}, "dt is 0.0, but must be positive: give the duration"),
        ({"density": -1.0}, "density is -1.0, but must be positive: give the rest density"),
        ({"mu": 0.0}, "mu is 0.0, but must be positive"),
        ({"lam": np.nan}, "lam is nan, but must be positive"),
        ({"lam": 4e3}, "lam is 4000 with mu 40000, but must be above mu / 8"),
        ({"mu": np.full(3, 1e4)}, r"mu has shape \(3,\): give a number or an array of shape \(10,\)"),
        ({"damping": -1.0}, "damping is -1.0, but must be 0 or more"),
        ({"activation": np.inf}, "activation is inf, but must be finite"),
        ({"ground": FLOOR}, "contact is None, but the scene has a ground or colliders: give a PenaltyContact"),
        ({"contact": CONTACT.replace(stiffness=0.0)}, "contact.stiffness is 0.0, but must be positive"),
        ({"contact": CONTACT.replace(friction=-0.1)}, "contact.friction is -0.1, but must be 0 or more"),
        ({"contact": CONTACT, "ground": FLOOR.replace(normal=np.array([0.0, 2.0, 0.0]))}, "ground.normal has length 2: give a unit vector"),
        ({"held": [0.5]}, "held is an array of float64 of shape .*: give different indices of vertices, or a mask"),
        ({"held": [12]}, "held has indices from 12 to 12, but there are 12 vertices: give indices from 0 to 11"),
        ({"mesh": tetmesh.TetMesh(MESH.vertices, MESH.tets[:, [1, 0, 2, 3]])}, "tets has 10 of 10 inverted"),
    ],
)  # fmt: skip
def test_impossible_scenes_are_refused_with_the_remedy(changes, message):
    with pytest.raises(ValueError, match=message):
        body(**changes)


UNIT = tetmesh.TetMesh(np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4]]), np.array([[0, 1, 2, 3]]))
"""One corner of a box of 2 x 3 x 4 m, of 4 m^3."""
MU, LAM, DENSITY = 4e4, 6e4, 500.0


def corner(**changes):
    return tets.make_scene(**(dict(mesh=UNIT, density=DENSITY, mu=MU, lam=LAM, dt=1e-4) | changes))


def test_masses_volumes_and_edges_of_a_corner():
    """A quarter of 2000 kg for each vertex; edges along the axes."""
    scene = corner()
    np.testing.assert_allclose(scene.mass, 500.0)
    np.testing.assert_allclose(scene.rest_volume, 4.0)
    np.testing.assert_allclose(scene.inverse_rest_edges, [np.diag([1 / 2, 1 / 3, 1 / 4])], rtol=1e-6)
    np.testing.assert_array_equal(scene.gravity, np.float32([0.0, -9.81, 0.0]))
    assert scene.mobility is None and scene.dt == 1e-4
    np.testing.assert_array_equal(scene.tets, UNIT.tets)


def test_density_per_tet_goes_to_its_own_vertices():
    """Vertices that two tetrahedra share get a quarter of each."""
    pair = tetmesh.TetMesh(np.concatenate([UNIT.vertices, [[2.0, 3, 4]]]), np.array([[0, 1, 2, 3], [4, 2, 1, 3]]))
    scene = tets.make_scene(mesh=pair, density=[100.0, 300.0], mu=MU, lam=LAM, dt=1e-4)
    first, second = (100.0, 300.0) * pair.volumes / 4.0
    np.testing.assert_allclose(scene.mass, [first, *[first + second] * 3, second], rtol=1e-6)


def test_held_vertices_by_index_or_mask_do_not_move():
    by_index, by_mask = corner(held=[1, 3]), corner(held=np.array([False, True, False, True]))
    np.testing.assert_array_equal(by_index.mobility, [1.0, 0.0, 1.0, 0.0])
    np.testing.assert_array_equal(by_mask.mobility, by_index.mobility)


@pytest.mark.parametrize("damping", [0.0, 30.0])
def test_largest_stable_dt_of_a_corner_by_hand(x64, damping):
    """0.8 * 4 / (c + sqrt(c^2 + 4 w^2)) with w^2 = K / m and c of its formula, of one tetrahedron."""
    slopes = 2 * (1 / 4 + 1 / 9 + 1 / 16)  # of the three legs, and of the corner, whose gradient is minus their sum
    w2 = 4.0 * slopes * (LAM + 7 / 8 * MU) / 500.0
    c = 4.0 * slopes * 2 * damping / 500.0
    expected = 0.8 * 4 / (c + np.sqrt(c * c + 4 * w2))
    assert float(tets.largest_stable_dt(corner(damping=damping))) == pytest.approx(expected, rel=1e-12)
    corner(dt=0.999 * expected, damping=damping)
    with pytest.raises(ValueError, match="above the largest stable"):
        corner(dt=1.001 * expected, damping=damping)


def test_contact_makes_it_smaller_and_what_is_held_does_not_count(x64):
    """Twice the body's own stiffness and as much again from contact; with all vertices held there is no limit."""
    own = 4.0 * 2 * (1 / 4 + 1 / 9 + 1 / 16) * (LAM + 7 / 8 * MU)
    free = float(tets.largest_stable_dt(corner()))
    touching = corner(contact=CONTACT.replace(stiffness=own, damping=0.0))
    assert float(tets.largest_stable_dt(touching)) == pytest.approx(free / np.sqrt(2), rel=1e-12)
    assert float(tets.largest_stable_dt(corner(held=[0, 1, 2, 3]))) == np.inf


def test_vertices_begin_at_rest_where_the_mesh_is():
    state = tets.initial_state(UNIT.vertices)
    np.testing.assert_array_equal(state.x, UNIT.vertices)
    np.testing.assert_array_equal(state.v, np.zeros((4, 3)))
    assert state.x.dtype == state.v.dtype == np.float32
