"""What tasks tell pictures: materials, floors, surfaces, how fast and how strained particles are."""

import jax
import numpy as np
import pytest

import rewax
from rewax.envs.kit.appearance import soft_appearance, soft_values, unique_names
from rewax.physics.mpm import Grid, Hencky, Material, MPMState, make_scene
from rewax.viz.camera import frame_recording
from rewax.viz.colors import particle_colors
from rewax.viz.recording import Recording

NAMES = {
    "RollingFlat": ("dough",), "HandFlip": ("dough",), "FluidMove": ("water",), "SteerFloat": ("elastic", "water"),
    "SoftJumper": ("elastic",), "SoftJumperMPM": ("muscle",), "GripperLift": ("elastic",), "WhipRope": ("rope",),
    "CoverBox": ("cloth",), "FoldCloth": ("cloth",), "PourBag": ("cloth", "sand"),
}  # fmt: skip
FLOORS = {
    "RollingFlat": 0.0625, "FluidMove": 0.0625, "SteerFloat": 0.075, "SoftJumper": 0.0, "GripperLift": 0.08,
    "WhipRope": 0.0, "CoverBox": 0.0, "FoldCloth": 0.0, "PourBag": 0.0,
}  # fmt: skip


def first_frame(env):
    """A recording of the first moment."""

    @jax.jit
    def seen(key):
        physics = env.reset(key).physics
        return physics, env.particles(physics), env.particle_values(physics)

    physics, particles, values = jax.device_get(seen(jax.random.key(0)))
    return Recording(
        steps=np.zeros(1, int),
        rewards=np.zeros(0),
        status=np.zeros(0, int),
        particles=particles[None],
        values={name: value[None] for name, value in values.items()},
        drawings=[jax.device_get(env.render_shapes(physics))],
        up=env.up,
        **env.appearance,
    )


@pytest.mark.parametrize("name", NAMES)
def test_materials_have_names_and_everything_stands_on_the_floor(name):
    recording = first_frame(rewax.make(name, scale="small"))
    assert tuple(recording.material_names) == NAMES[name]
    floor = frame_recording(recording).floor
    assert floor == pytest.approx(FLOORS.get(name, floor))
    assert recording.particles[..., 1].min() > floor - 0.05
    assert len(np.unique(particle_colors(recording), axis=0)) == len(NAMES[name])
    assert all(value.shape == recording.particles.shape[:2] for value in recording.values.values())


def test_the_float_comes_before_the_water():
    env = rewax.make("SteerFloat", scale="small")
    materials = env.appearance["materials"]
    assert materials[: env.float_count].max() == 0 and materials[env.float_count :].min() == 1


def test_materials_of_one_kind_have_names_of_their_own():
    assert unique_names(["elastic", "water", "elastic", "elastic"]) == ("elastic", "water", "elastic_2", "elastic_3")
    soft, hard = (Material(density=1e3, elasticity=Hencky(youngs_modulus=e, poissons_ratio=0.3)) for e in (1e3, 1e4))
    scene = make_scene(
        grid=Grid(shape=(8, 8, 8), spacing=0.1),
        dt=1e-4,
        material=(soft, hard),
        particle_counts=(2, 3),
        particle_volume=1e-4,
    )
    appearance = soft_appearance(scene, np.array([0.0, 1.0, 0.0]))
    assert appearance["material_names"] == ("elastic", "elastic_2")
    np.testing.assert_array_equal(appearance["materials"], [0, 0, 1, 1, 1])


def test_the_surface_of_a_mesh_is_closed():
    triangles = rewax.make("SoftJumper", scale="small").appearance["triangles"]
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    assert np.all(np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0)


def test_speed_and_strain_are_those_of_the_motion():
    stretch = np.diag([1.2, 1.0, 1.0])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    state = MPMState(
        x=np.zeros((2, 3)), v=np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]]), C=np.zeros((2, 3, 3)),
        F=np.stack([turn, turn @ stretch]).astype(np.float32),
    )  # fmt: skip
    values = soft_values(state)
    np.testing.assert_allclose(values["speed"], [5.0, 0.0])
    np.testing.assert_allclose(values["strain"], [0.0, 0.5 * (1.44 - 1.0)], atol=1e-6)


def test_the_camera_of_a_rigid_task_is_one_that_pictures_know():
    env = rewax.make("AntRun", scale="small")
    drawings = [jax.device_get(env.render_shapes(jax.jit(env.reset)(jax.random.key(0)).physics))]
    recording = Recording(
        steps=np.zeros(1, int),
        rewards=np.zeros(0),
        status=np.zeros(0, int),
        drawings=drawings,
        up=env.up,
        **env.appearance,
    )
    assert frame_recording(recording).distance > 0.0
