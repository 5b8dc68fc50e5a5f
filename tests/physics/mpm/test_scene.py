"""Scenes of particles: the largest stable substep, masses, what is refused when a scene is built."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material
from material_cases import SOLIDS
from mpm_bodies import DT, GRID, cube, modulus_at, run

from rewax.physics import mpm
from rewax.physics.contact.colliders import Collider
from rewax.physics.mpm import Snow, Tait, VonMises
from rewax.physics.mpm.laws import MAX_HARDENING
from rewax.physics.mpm.materials import sound_speed
from rewax.physics.mpm.scene import STABLE_DIFFUSION_NUMBER, per_material
from rewax.physics.mpm.walls import Wall, Walls
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Sphere
from rewax.status import Status

SNOW = Snow(critical_compression=0.02, critical_stretch=0.01, hardening=5.0)


@pytest.mark.parametrize("elasticity", SOLIDS)
def test_stable_at_the_limit_and_not_far_above_it(elasticity):
    """A perturbed cube at the largest stable dt calms down; at 1.4 times the sound's time through a cell it explodes."""
    growth = []
    for courant_number in (mpm.STABLE_COURANT_NUMBER, 1.4):
        scene, state = cube(courant_number, elasticity=elasticity)
        speed = 1e-3 * float(sound_speed(scene.material))
        state = state.replace(v=speed * jax.random.normal(jax.random.key(3), state.x.shape))
        end = run(scene, state)
        growth.append(float(jnp.sqrt(jnp.mean(end.v**2) / jnp.mean(state.v**2))))
    assert growth[0] < 0.6
    assert not growth[1] < 10.0


def test_viscosity_is_stable_at_its_limit_and_not_far_above_it():
    """The same for a viscous fluid at the largest dt that sound allows; at three times what viscosity allows it explodes."""
    growth = []
    speed = mpm.STABLE_COURANT_NUMBER * GRID.spacing / DT
    for number in (STABLE_DIFFUSION_NUMBER, 3 * STABLE_DIFFUSION_NUMBER):
        scene, state = cube()
        viscosity = number * 1000.0 * GRID.spacing**2 / DT
        material = flat_material(density=1000.0, speed_of_sound=speed, viscosity=viscosity, elasticity=Tait)
        limit = float(mpm.largest_stable_dt(material, GRID))
        assert limit == pytest.approx(DT * STABLE_DIFFUSION_NUMBER / number, rel=1e-5)
        scene = scene.replace(material=jax.tree.map(lambda a: jnp.asarray(a, float), material))
        state = state.replace(v=1e-3 * speed * jax.random.normal(jax.random.key(3), state.x.shape))
        growth.append(float(jnp.sqrt(jnp.mean(run(scene, state).v ** 2) / jnp.mean(state.v**2))))
    assert growth[0] < 0.6
    assert not growth[1] < 10.0


def test_largest_stable_dt_is_the_number_used():
    material = flat_material(youngs_modulus=modulus_at(mpm.STABLE_COURANT_NUMBER), poissons_ratio=0.3, density=1000.0)
    assert float(mpm.largest_stable_dt(material, GRID)) == pytest.approx(DT, rel=1e-5)
    c = float(sound_speed(material))
    assert float(mpm.largest_stable_dt(material, GRID, max_speed=c)) == pytest.approx(DT / 2, rel=1e-5)
    snow = material.replace(plasticity=SNOW)
    assert float(mpm.largest_stable_dt(snow, GRID)) == pytest.approx(DT / MAX_HARDENING**0.5, rel=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dt": 1.01e-4}, "dt is 0.000101 s, above the largest stable 0.0001 s .* smaller dt"),
        ({"dt": 0.0}, "dt is 0.0, but must be positive"),
        ({"youngs_modulus": -1.0}, "elasticity.youngs_modulus is -1.0, but must be positive: give"),
        ({"youngs_modulus": float("nan")}, "elasticity.youngs_modulus is nan, but must be positive"),
        ({"density": 0.0}, "density is 0.0, but must be positive"),
        ({"poissons_ratio": 0.5}, "poissons_ratio is 0.5, but must be above -1 and below 0.5"),
        ({"poissons_ratio": -1.0}, "poissons_ratio is -1.0, but must be above -1"),
        ({"yield_stress": 0.0, "plasticity": VonMises}, "plasticity.yield_stress is 0.0, but must be positive"),
        ({"particle_volume": -1e-6}, "particle_volume is -1e-06, but must be positive"),
    ],
)
def test_impossible_scenes_are_refused_with_the_remedy(changes, message):
    material = dict(youngs_modulus=modulus_at(mpm.STABLE_COURANT_NUMBER), poissons_ratio=0.3, density=1000.0)
    scene = dict(grid=GRID, dt=0.999e-4, particle_volume=1e-6)
    mpm.make_scene(material=flat_material(**material), **scene)
    for name, value in changes.items():
        (scene if name in scene else material)[name] = value
    with pytest.raises(ValueError, match=message):
        mpm.make_scene(material=flat_material(**material), **scene)


def test_particles_must_begin_inside_the_box_and_outside_the_colliders():
    scene, state = cube()
    with pytest.raises(
        ValueError, match=r"1 particles lie outside the grid's box from \(-0.275, .* particle 7 at .*: move them"
    ):
        mpm.initial_state(state.x.at[7, 1].set(2.0), scene)
    with pytest.raises(ValueError, match=r"x\[7, 1\] is nan, but must be finite"):
        mpm.initial_state(state.x.at[7, 1].set(jnp.nan), scene)
    collider = Collider(shape=Sphere(radius=0.04), offset=jnp.zeros(3), rotation=jnp.eye(3), friction=0.5)
    scene = scene.replace(colliders=(collider,))
    mpm.check_placement(scene, state, Pose(jnp.array([[0.1, 0.0, 0.0]]), jnp.eye(3)[None]))
    with pytest.raises(ValueError, match=r"particles lie up to 0.0298 m inside collider 0 \(Sphere\): move it"):
        mpm.check_placement(scene, state)
    mpm.check_placement(scene, state, tolerance=0.04)


@pytest.mark.parametrize(("side", "inward"), [("lower", 1.0), ("upper", -1.0)])
def test_particles_may_begin_at_most_a_cell_behind_a_wall(side, inward):
    scene, state = cube()
    first = inward * float(jnp.min(inward * state.x[:, 1]))

    def check(cells):
        wall = (None, Wall(position=first + inward * cells * GRID.spacing), None)
        mpm.check_placement(
            scene.replace(walls=Walls(**{"lower": (None,) * 3, "upper": (None,) * 3, side: wall})), state
        )

    check(0.9)
    with pytest.raises(
        ValueError, match=rf"particles lie up to 0.055 m behind walls.{side}\[1\], which is at .*: move"
    ):
        check(1.1)


def test_mass_of_each_particle_is_its_volume_times_the_density_of_its_material():
    one, two = (flat_material(youngs_modulus=1e3, poissons_ratio=0.3, density=d) for d in (1000.0, 250.0))
    scene = mpm.make_scene(grid=GRID, dt=DT, material=(one, two), particle_counts=(2, 3), particle_volume=2e-6)
    np.testing.assert_allclose(mpm.particle_mass(scene, jnp.zeros(5)), [2e-3] * 2 + [5e-4] * 3, rtol=1e-6)
    volumes = jnp.array([1e-6, 2e-6, 3e-6, 4e-6, 5e-6])
    scene = scene.replace(particle_volume=volumes)
    np.testing.assert_allclose(mpm.particle_mass(scene, jnp.zeros(5)), volumes * jnp.array([1e3] * 2 + [250.0] * 3))


def test_each_material_gets_its_own_particles_and_results_keep_their_order():
    one, two = (flat_material(youngs_modulus=1e3, poissons_ratio=0.3, density=d) for d in (1000.0, 250.0))
    scene = mpm.make_scene(grid=GRID, dt=DT, material=(one, two), particle_counts=(2, 3), particle_volume=2e-6)
    x = jnp.arange(10.0).reshape(5, 2)
    got = per_material(scene, lambda m, p: (p[0] * m.density, p[1][:, 0]), (x, -x))
    np.testing.assert_array_equal(got[0], x * jnp.array([1000.0] * 2 + [250.0] * 3)[:, None])
    np.testing.assert_array_equal(got[1], -x[:, 0])
    alone = mpm.make_scene(grid=GRID, dt=DT, material=one, particle_volume=2e-6)
    np.testing.assert_array_equal(per_material(alone, lambda m, p: p * m.density, x), 1000.0 * x)


def test_an_inversion_that_only_the_memory_tells_is_reported():
    solid = flat_material(youngs_modulus=1e3, poissons_ratio=0.3, density=400.0)
    snow, x = solid.replace(plasticity=SNOW), jnp.array([[0.0, 0.1, 0.0], [0.1, 0.0, 0.0]])
    for material, counts in ((snow, None), ((solid, snow), (1, 1))):
        scene = mpm.make_scene(grid=GRID, dt=DT / 3, material=material, particle_counts=counts, particle_volume=1e-6)
        state = mpm.initial_state(x, scene)
        assert int(mpm.check_status(scene, state)) == Status.OK
        state = state.replace(memory=state.memory.at[1].set(0.0))
        assert int(mpm.check_status(scene, state)) == Status.INVERTED


def test_particles_begin_undeformed_at_rest_and_only_snow_remembers():
    solid = flat_material(youngs_modulus=1e3, poissons_ratio=0.3, density=400.0)
    snow = solid.replace(plasticity=SNOW)
    x = jnp.array([[0.0, 0.1, 0.0], [0.1, 0.0, 0.0]])
    for material, memory in ((solid, None), (snow, [[1.0], [1.0]])):
        state = mpm.initial_state(x, mpm.make_scene(grid=GRID, dt=DT, material=material, particle_volume=1e-6))
        np.testing.assert_array_equal(state.x, x)
        np.testing.assert_array_equal(state.v, np.zeros((2, 3)))
        np.testing.assert_array_equal(state.C, np.zeros((2, 3, 3)))
        np.testing.assert_array_equal(state.F, np.tile(np.eye(3), (2, 1, 1)))
        if memory is None:
            assert state.memory is None
        else:
            np.testing.assert_array_equal(state.memory, memory)
