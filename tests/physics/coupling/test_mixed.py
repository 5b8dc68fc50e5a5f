"""Sand in a cloth bag: nothing escapes; scenes refuse what is illegal; status."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mixed_bodies import RUN, SPACING, bag_mesh, both, cloth_scene, sand_scene, side

from rewax.physics import coupling, mpm, thin
from rewax.physics.contact import Collider
from rewax.physics.coupling import mixed
from rewax.physics.mpm import Material
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Sphere, fill_box
from rewax.status import Status


def test_500_particles_of_sand_stay_in_a_held_bag_for_half_a_second():
    """They fall from 2 cm above into the bag, and hop as it gives way: for moments above ``max_speed``."""
    mesh, rim = bag_mesh()
    grains = fill_box((0.0, -0.01, 0.0), (0.05, 0.05, 0.05), SPACING)
    assert len(grains) >= 500
    scene, state = both(mesh, grains, thin_scene=cloth_scene(mesh, held=rim, drag=5.0))
    up = np.sign(side([[0.0, 0.0, 0.0]], mesh.vertices, mesh.triangles))
    for _ in range(10):
        state = RUN(scene, state, coupling.static_poses(500), store_every=None)
        assert (up * side(state.particles.x, state.thin.x, mesh.triangles)).min() > 0.0
        assert not int(mixed.check_status(scene, state)) & (Status.NAN | Status.FULL_PAIRS)
    x = np.asarray(state.particles.x)
    assert np.abs(x[:, [0, 2]]).max() < 0.1 and x[:, 1].max() < 0.02  # none over the rim
    np.testing.assert_array_less(np.asarray(state.thin.x)[:, 1].min(), -0.06)  # their weight draws the bag down


def test_a_start_has_the_types_of_a_steps_result():
    """A weak type would compile the second step again."""
    mesh, _ = bag_mesh()
    start = jax.jit(lambda grains: both(mesh, grains)[1])(fill_box((0.0, -0.01, 0.0), (0.02, 0.02, 0.02), SPACING))
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(start))


def thrown(times):
    """Smallest height of eight layers of sand, thrown at a held sheet at a multiple of the largest safe speed."""
    mesh = thin.ThinMesh(vertices=thin.sheet(0.1, 0.1, 5, 5).vertices - [0.05, 0.0, 0.05],
                         triangles=thin.sheet(0.1, 0.1, 5, 5).triangles)  # fmt: skip
    grains = fill_box((0.0, 0.03, 0.0), (0.03, 8 * SPACING, 0.03), SPACING)
    scene, state = both(mesh, grains, thin_scene=cloth_scene(mesh, held=range(36)), damping=0.0)
    speed = times * mixed.largest_safe_particle_speed(scene)
    state = state.replace(particles=state.particles.replace(v=state.particles.v.at[:, 1].set(-speed)))
    seen = int(mixed.check_status(scene, state.replace(particles=state.particles.replace(
        x=state.particles.x - jnp.array([0.0, float(state.particles.x[:, 1].min()) - 3e-3, 0.0])))))  # fmt: skip
    lowest = []
    for _ in range(4):
        state = RUN(scene, state, coupling.static_poses(100), store_every=None)
        lowest.append(float(state.particles.x[:, 1].min()))
    return min(lowest), bool(seen & Status.CROSSED)


@pytest.mark.slow
def test_sand_does_not_pass_at_the_safe_speed_and_does_far_beyond():
    lowest, seen = thrown(0.97)
    assert lowest > 0.0 and not seen
    lowest, seen = thrown(8.0)
    assert lowest < 0.0 and seen


def test_scenes_refuse_what_is_illegal_and_status_says_what_became_so(x64):
    mesh, rim = bag_mesh(4)
    grains = fill_box((0.0, -0.03, 0.0), (0.03, 0.03, 0.03), SPACING)
    for wrong, message in (
        ({"particles": sand_scene(5e-5)}, "particles.dt is 5e-05 s and thin.dt 0.0001 s"),
        ({"stiffness": 1e6}, "above the largest stable"),
        ({"max_speed": 50.0}, "contact.max_speed is 50 m/s, above"),
        ({"thickness": -1.0}, "contact.thickness is -1.0"),
    ):
        with pytest.raises(ValueError, match=message):
            both(mesh, grains, **wrong)
    rope = thin.rope(np.linspace([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], 5))
    strand = thin.make_scene(mesh=rope, dt=1e-4, rope=thin.Rope(stretch=100.0, density=0.1))
    with pytest.raises(ValueError, match="thin has no triangles"):
        both(rope, grains, thin_scene=strand)
    scene, state = both(mesh, grains, thin_scene=cloth_scene(mesh, held=rim))
    status = jax.jit(mixed.check_status)
    assert int(status(scene, state)) == 0
    short = scene.replace(contact=scene.contact.replace(pairs_per_particle=1, thickness=jnp.asarray(0.03)))
    assert int(status(short, state)) & Status.FULL_PAIRS
    end = RUN(short, state, thin.static_poses(2, dtype=float))
    apart = end.replace(thin=end.thin.replace(x=end.thin.x + jnp.array([0.0, 1.0, 0.0])))
    assert int(status(short, apart)) & Status.FULL_PAIRS  # remembered: nothing is close any more
    assert int(status(short, apart.replace(full=jnp.bool_(False)))) & Status.FULL_PAIRS == 0
    stiff = scene.replace(contact=scene.contact.replace(stiffness=jnp.asarray(1e9)))
    assert int(status(stiff, state)) & Status.INVALID_PARAMETERS


def test_limits_are_those_of_the_lightest_and_the_heaviest_particle(x64):
    mesh = thin.sheet(0.1, 0.1, 2, 2)
    grains, sand = np.zeros((3, 3)), sand_scene().material
    assert isinstance(sand, Material)
    heavy = sand.replace(density=6000.0)
    volumes = SPACING**3 * np.array([1.0, 4.0, 1.0])
    scenes = [
        both(mesh, grains, particles=particles, max_speed=0.4)[0]
        for particles in (
            sand_scene(),
            sand_scene(material=heavy),
            sand_scene(particle_volume=volumes),
            sand_scene(material=sand.replace(density=1500.0 * volumes / SPACING**3)),
            sand_scene(material=(sand, heavy), particle_counts=(1, 2)),
        )
    ]
    light, all_heavy, *mixtures = (
        (mixed.largest_stable_mixed_dt(s), mixed.largest_safe_particle_speed(s)) for s in scenes
    )
    for dt, speed in mixtures:
        np.testing.assert_allclose(dt, light[0])
        np.testing.assert_allclose(speed, all_heavy[1])
    np.testing.assert_allclose(all_heavy[1], 0.5 * light[1])


def flying(speed, **grid):
    """A grain 12 mm above a held sheet, three times as far as pairs reach."""
    mesh = thin.sheet(0.1, 0.1, 2, 2)
    scene, state = both(
        mesh, [[0.04, 0.012, 0.05]], particles=sand_scene(**grid), thin_scene=cloth_scene(mesh, held=range(9))
    )
    v = state.particles.v.at[:, 1].set(-speed)
    return scene, state.replace(particles=state.particles.replace(v=v))


def test_a_particle_that_passes_between_two_searches_is_seen(x64):
    scene, start = flying(30.0)
    end = RUN(scene, start, thin.static_poses(8, dtype=float))
    assert float(end.particles.x[0, 1]) < -8e-3  # on the other side, again farther than pairs reach
    away = end.replace(particles=end.particles.replace(v=jnp.zeros((1, 3))))
    assert int(mixed.check_status(scene, away)) == Status.CROSSED
    slow, start = flying(3.0)
    assert int(mixed.check_status(slow, start)) == 0
    beside = start.replace(
        particles=start.particles.replace(x=start.particles.x - jnp.array([0.0, 8e-3, 0.0]), v=0.2 * start.particles.v)
    )
    assert int(mixed.check_status(slow, beside)) == 0
    softer = slow.replace(contact=slow.contact.replace(stiffness=20.0))
    assert int(mixed.check_status(softer, beside)) == Status.CROSSED


def test_a_particle_that_is_all_but_through_is_seen_however_slow_and_remembered(x64):
    """The contact is 4 mm thick."""
    scene, above = flying(0.0)
    for height, status in ((8e-4, 0), (3e-4, Status.CROSSED)):
        x = above.particles.x.at[0, 1].set(height)
        assert int(mixed.check_status(scene, above.replace(particles=above.particles.replace(x=x)))) == status
    end = RUN(scene, above.replace(particles=above.particles.replace(x=x)), thin.static_poses(8, dtype=float))
    assert float(end.depth) == pytest.approx(1.0 - 3e-4 / 4e-3)
    out = end.replace(particles=above.particles, speed=jnp.zeros(()))
    assert int(mixed.check_status(scene, out)) == Status.CROSSED
    assert int(mixed.check_status(scene, out.replace(depth=jnp.zeros(())))) == 0


def test_status_remembers_nodes_that_did_not_suffice(x64):
    scene, start = flying(0.0, max_active_nodes=125)
    assert int(mixed.check_status(scene, start)) == 0
    assert int(mixed.check_status(flying(0.0, max_active_nodes=124)[0], start)) == Status.INACTIVE_NODES
    scene, start = flying(30.0, max_active_nodes=125)
    end = RUN(scene, start, thin.static_poses(8, dtype=float))  # two cells between two searches
    calm = end.replace(particles=start.particles.replace(v=jnp.zeros((1, 3))), speed=jnp.zeros(()))
    assert int(mixed.check_status(scene, calm)) == Status.INACTIVE_NODES
    assert int(mixed.check_status(scene, calm.replace(missed=jnp.zeros(())))) == 0


def test_listed_nodes_follow_particles_through_many_cells(x64):
    """A list is renewed with each search: within a step a grain crosses more cells than a list allows."""
    ends = []
    for nodes in (None, 125):
        scene, start = flying(-3.0, max_active_nodes=nodes)
        scene = scene.replace(contact=scene.contact.replace(every=8))

        def height(v, scene=scene, start=start):
            moving = start.replace(particles=start.particles.replace(v=v))
            end = RUN(scene, moving, thin.static_poses(64, dtype=float))
            return end.particles.x[0, 1], end

        (y, end), slope = jax.value_and_grad(height, has_aux=True)(start.particles.v)
        ends.append((y, slope))
        assert int(mixed.check_status(scene, end)) == 0
    assert y - start.particles.x[0, 1] > 2.5 * SPACING
    np.testing.assert_allclose(ends[1][0], ends[0][0], rtol=1e-12)
    np.testing.assert_allclose(ends[1][1], ends[0][1], rtol=1e-9)


def test_a_coupled_step_evaluates_all_colliders(x64):
    ball = Collider(shape=Sphere(radius=0.01), friction=0.0)
    scene, state = flying(0.0, colliders=(ball, ball.replace(body=1)), max_near_colliders=1)
    place = state.particles.x[0] + jnp.array([[0.0, 0.01, 0.0], [0.01, 0.0, 0.0]])
    poses = Pose(jnp.tile(place, (2, 1, 1)), jnp.tile(jnp.eye(3), (2, 2, 1, 1)))
    assert int(mpm.check_status(scene.particles, state.particles, start=state.particles, poses=poses))
    assert int(mixed.check_status(scene, state, poses=poses)) == 0
