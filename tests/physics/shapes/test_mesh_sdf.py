"""Meshes baked to a grid: against analytic shapes, as colliders of dough, and what is wrong with a mesh."""

import builtins

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from rewax.physics import mpm
from rewax.physics import shapes as sdf
from rewax.physics.contact.colliders import Collider
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.laws import Hencky, VonMises
from rewax.physics.mpm.materials import Material
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes.mesh_sdf import bake_mesh, check_mesh, signed_volume
from rewax.physics.shapes.sampling import fill_box, volume

RADIUS = 0.5
BALL = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
SAG = 6e-4
"""How far the middles of the ball's faces are below the sphere [m]."""
HALF = np.array([0.15, 0.2, 0.1])
BRICK = trimesh.creation.box(2 * HALF)
evaluate = jax.jit(sdf.signed_distance)


def nodes(shape: sdf.SampledDistance) -> np.ndarray:
    axes = [np.asarray(shape.origin)[i] + float(shape.spacing) * np.arange(shape.values.shape[i]) for i in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def test_values_at_the_nodes_are_distances_to_the_mesh(x64):
    """Of a box exactly, of a ball of 5120 faces up to the faces' sag, with a margin on all sides."""
    brick = bake_mesh(BRICK, 0.03, margin=0.05)
    np.testing.assert_allclose(brick.values, sdf.signed_distance(sdf.Box(half_size=HALF), nodes(brick))[0], atol=1e-12)
    corners = nodes(brick)[0, 0, 0], nodes(brick)[-1, -1, -1]
    assert np.all(corners[0] <= -HALF - 0.05 + 1e-12) and np.all(corners[1] >= HALF + 0.05 - 1e-12)
    ball = bake_mesh(BALL, 0.08)
    below = np.asarray(ball.values) - (np.linalg.norm(nodes(ball), axis=-1) - RADIUS)
    assert below.min() > -1e-12 and below.max() < SAG


def test_a_baked_ball_becomes_a_sphere_with_its_spacing(x64):
    """Near the surface: the distance's error falls with spacing^2, the normal's with spacing."""
    direction = np.random.default_rng(0).normal(size=(500, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    p = direction * np.random.default_rng(1).uniform(0.9, 1.1, (500, 1)) * RADIUS
    errors = []
    for spacing in (0.1, 0.05):
        distance, normal = evaluate(bake_mesh(BALL, spacing, margin=0.1), p)
        errors.append(
            [
                np.abs(distance - np.linalg.norm(p, axis=1) + RADIUS).max() - SAG,
                np.linalg.norm(normal - direction, axis=1).max(),
            ]
        )
        # The interpolant of a function with curvatures up to 1 / 0.35 between these nodes.
        assert errors[-1][0] < 2 * spacing**2 / 8 / 0.35
    (distance_1, normal_1), (distance_2, normal_2) = errors
    assert distance_2 < 0.35 * distance_1 and normal_2 < 0.65 * normal_1 < 0.2


def test_volume_converges_to_the_mesh(x64):
    errors = [abs(float(volume(bake_mesh(BALL, h))) / BALL.volume - 1.0) for h in (0.1, 0.05)]
    assert errors[1] < 0.35 * errors[0] < 0.01
    np.testing.assert_allclose(signed_volume(np.asarray(BALL.triangles)), BALL.volume, rtol=1e-12)


def test_dough_under_a_mesh_moves_as_under_the_box_it_is_of(x64):
    """Ten substeps of dough that a brick presses and drags; its grid's nodes lie in its faces, so only edges differ."""
    grid = Grid(shape=(14, 12, 14), spacing=0.05)
    x = fill_box((0.325, 0.2, 0.325), (0.2, 0.1, 0.2), 0.025)
    material = Material(
        density=1000.0,
        elasticity=Hencky(youngs_modulus=1e4, poissons_ratio=0.3),
        plasticity=VonMises(yield_stress=300.0),
    )
    mesh = bake_mesh(BRICK, 0.01, margin=0.1)
    t = np.arange(11)[:, None, None]
    poses = Pose(
        jnp.array([0.325, 0.46, 0.325]) + t * np.array([1e-3, -2e-3, 0.0]), jnp.broadcast_to(jnp.eye(3), (11, 1, 3, 3))
    )
    step, state = jax.jit(mpm.step), mpm.initial_state(jnp.asarray(x))

    def end(shape, poses):
        brick = Collider(shape=shape, offset=jnp.zeros(3), rotation=jnp.eye(3), friction=0.5, softness=50.0)
        scene = mpm.make_scene(
            grid=grid, dt=1e-3, material=material, particle_volume=0.004 / len(x), colliders=(brick,)
        )
        return step(scene, state, poses).v

    box = sdf.Box(half_size=HALF)
    expected, untouched = end(box, poses), end(box, poses._replace(position=poses.position + 9.0))
    assert np.linalg.norm(expected - untouched) > 0.1 * np.linalg.norm(expected)
    assert np.linalg.norm(end(mesh, poses) - expected) < 0.005 * np.linalg.norm(expected - untouched)


@pytest.mark.slow
def test_twenty_substeps_against_a_mesh_reverse_forward_and_finite_difference(x64, random_like, derivatives, inner):
    """By particles, the baked values, their grid, and the poses of the mesh."""
    x = fill_box((0.325, 0.2, 0.325), (0.2, 0.1, 0.2), 0.05)
    material = Material(
        density=1000.0,
        elasticity=Hencky(youngs_modulus=1e4, poissons_ratio=0.3),
        plasticity=VonMises(yield_stress=300.0),
    )
    turn = np.linalg.qr(np.eye(3) + 0.3 * np.random.default_rng(0).standard_normal((3, 3)))[0]
    brick = Collider(shape=bake_mesh(BRICK, 0.04, margin=0.1), rotation=jnp.asarray(turn), friction=0.5, softness=50.0)
    scene = mpm.make_scene(
        grid=Grid(shape=(14, 12, 14), spacing=0.05),
        dt=1e-3,
        material=material,
        particle_volume=0.004 / len(x),
        colliders=(brick,),
    )
    t = np.arange(21)[:, None, None]
    poses = Pose(
        jnp.array([0.325, 0.45, 0.325]) + t * np.array([1e-3, -2e-3, 0.0]), jnp.broadcast_to(jnp.eye(3), (21, 1, 3, 3))
    )
    args = jax.tree.map(lambda a: jnp.asarray(a, float), (scene, mpm.initial_state(jnp.asarray(x)), poses))
    program = derivatives(lambda a: mpm.step(*a))
    sizes = jax.tree.map(lambda a: 1e-3 + 0.1 * jnp.sqrt(jnp.mean(jnp.where(jnp.isfinite(a), a, 0.0) ** 2)), args)
    move = jax.tree.map(lambda size, noise: size * noise, sizes, random_like(1, args))
    move = (move[0], move[1], jax.tree.map(lambda a: 0.01 * a, move[2]))
    still = jax.tree.map(jnp.zeros_like, move)
    shape_only = (still[0].replace(colliders=move[0].colliders), still[1], still[2])

    def weights(end):
        return random_like(2, end)

    for direction in (move, shape_only):
        _, tangent, cotangent, gradient = program(args, direction, weights=weights)
        reverse, forward = inner(gradient, direction), inner(cotangent, tangent)
        assert abs(forward) > 1e-3 and abs(reverse - forward) < 1e-9 * abs(forward)
        differences = []
        for h in (1e-6, 1e-7, 1e-8):
            ahead, behind = (
                program(jax.tree.map(lambda a, d: a + k * d, args, direction), direction, weights=weights)[0]
                for k in (h, -h)
            )
            differences.append((inner(ahead, cotangent) - inner(behind, cotangent)) / (2 * h))
        assert min(abs(reverse - d) for d in differences) < 1e-5 * abs(forward), (reverse, differences)


# --- What is wrong with a mesh ----------------------------------------------------------------------------------------


def changed(vertices=None, faces=None):
    return trimesh.Trimesh(
        BRICK.vertices if vertices is None else vertices, BRICK.faces if faces is None else faces, process=False
    )


FACES = np.asarray(BRICK.faces)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (changed(faces=FACES[:-1]), "not watertight: 3 of its 18 edges are open.*fill_holes"),
        (changed(faces=np.concatenate([FACES[:1, ::-1], FACES[1:]])), "at 3 of its 18 edges turn in opposite.*fix_normals"),
        (changed(faces=FACES[:, ::-1]), r"inside out \(its signed volume is -0.024 m\^3\).*mesh.invert"),
        (changed(faces=np.concatenate([FACES, [[0, 1, 1]]])), r"1 degenerate faces without area \(the first is face 12\)"),
        (changed(faces=np.zeros((0, 3), int)), "mesh has no faces"),
        (changed(vertices=np.where(np.arange(24).reshape(8, 3) == 5, np.nan, BRICK.vertices)), "nan, but must be finite: repair"),
        ("/nowhere/bunny.stl", "there is no such file"),
        (3.0, "mesh is 3.0: give a path or something with vertices and faces"),
    ],
)  # fmt: skip
def test_a_bad_mesh_gets_one_sentence(mesh, message):
    with pytest.raises(ValueError, match=message):
        bake_mesh(mesh, 0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spacing": 0.0}, "spacing is 0.0, but must be positive"),
        ({"spacing": 0.1, "margin": -1.0}, "margin is -1.0, but must be positive"),
        (
            {"spacing": 1e-4},
            "spacing is 0.0001, which makes a grid of 3005 x 4005 x 2005 nodes .* give a larger spacing",
        ),
    ],
)
def test_a_bad_grid_gets_one_sentence(options, message):
    with pytest.raises(ValueError, match=message):
        bake_mesh(BRICK, **options)


def test_files_are_read_and_trimesh_asked_for(tmp_path, monkeypatch):
    """STL repeats every vertex for each face: they are one again."""
    path = tmp_path / "brick.stl"
    BRICK.export(path)
    np.testing.assert_allclose(np.sort(check_mesh(path), axis=0), np.sort(BRICK.triangles, axis=0), atol=1e-7)
    original = builtins.__import__

    def without_trimesh(name, *args, **kwargs):
        if name == "trimesh":
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_trimesh)
    with pytest.raises(ImportError, match=r"needs trimesh, which is not installed: pip install 'rewax\[meshes\]'"):
        bake_mesh(path, 0.05)
