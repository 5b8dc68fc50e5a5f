"""What ``check_status`` says about self-contact."""

import jax
import jax.numpy as jnp
import numpy as np
from self_contact_bodies import RUN, crossings, folded

from rewax.physics import thin
from rewax.status import Status

STATUS = jax.jit(thin.check_status)


def test_status_names_crossed_layers_speed_and_full_lists(x64):
    scene, state = folded()
    assert STATUS(scene, state) == 0
    fast = state.replace(v=state.v.at[0, 1].set(2.0))
    assert STATUS(scene, fast) == Status.CROSSED
    moving = state.replace(v=state.v + jnp.array([5.0, 0.0, 0.0]))  # all alike: nothing comes closer
    assert STATUS(scene, moving) == 0
    through = state.x.at[40:, 1].add(jnp.where(jnp.arange(5) % 2 == 0, -0.03, 0.0))
    assert crossings(thin.sheet(0.4, 0.2, 8, 4), np.asarray(through)) > 0
    assert STATUS(scene, state.replace(x=through)) & Status.CROSSED
    few = scene.replace(self_contact=scene.self_contact.replace(pairs_per_element=1, thickness=0.1))
    assert STATUS(few, state) & Status.FULL_PAIRS


def test_layers_at_the_same_place_count_as_crossed(x64):
    """Nothing parts them: the force has no direction."""
    sheet = thin.sheet(0.1, 0.1, 2, 2)
    mesh = thin.ThinMesh(
        vertices=np.concatenate([sheet.vertices, sheet.vertices + [0.0, 0.05, 0.0]]),
        triangles=np.concatenate([sheet.triangles, sheet.triangles + len(sheet.vertices)]),
    )
    cloth = thin.isotropic_cloth(youngs_modulus=1e5, poissons_ratio=0.3, thickness=1e-3, density=300.0)
    contact = thin.SelfContact(thickness=2e-3, stiffness=50.0, max_speed=0.1)
    scene = thin.make_scene(mesh=mesh, dt=1e-4, cloth=cloth, gravity=(0.0, 0.0, 0.0), self_contact=contact)
    for height, expected in ((0.0, Status.CROSSED), (1e-6, Status.CROSSED), (1e-4, 0), (0.05, 0)):
        placed = np.concatenate([sheet.vertices, sheet.vertices + [0.0, height, 0.0]])
        assert STATUS(scene, thin.initial_state(placed)) == expected


def test_a_contact_that_became_softer_is_safe_at_lower_speeds_alone(x64):
    scene, state = folded()
    state = state.replace(v=jnp.zeros_like(state.v).at[0, 1].set(0.3))
    assert STATUS(scene, state) == 0
    softer = scene.replace(self_contact=scene.self_contact.replace(stiffness=0.5))
    assert thin.largest_safe_speed(softer) < 0.3
    assert STATUS(softer, state) == Status.CROSSED
    assert STATUS(softer, state.replace(v=0.1 * state.v)) == 0


def test_a_step_remembers_full_lists_and_fast_vertices(x64):
    scene, state = folded()
    few = scene.replace(self_contact=scene.self_contact.replace(pairs_per_element=1, max_speed=100.0))
    fast = state.replace(v=state.v.at[0, 1].set(2.0))
    poses = thin.static_poses(8, dtype=float)
    flat = jnp.asarray(thin.sheet(0.4, 0.2, 8, 4).vertices)
    for own, start, bit, name in ((few, state, Status.FULL_PAIRS, "filled"), (scene, fast, Status.CROSSED, "speed")):
        end = RUN(own, start, poses).replace(x=flat, v=jnp.zeros_like(flat))
        assert STATUS(scene, end) & bit
        assert STATUS(scene, RUN(scene, end, poses)) & bit
        forgotten = end.replace(**{name: jnp.zeros_like(getattr(end, name))})
        assert STATUS(scene, forgotten) & bit == 0
    np.testing.assert_allclose(end.speed, 2.0, rtol=0.05)
