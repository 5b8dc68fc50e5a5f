"""Cameras: depth against MuJoCo's rays, derivatives, batches, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_scenes import CAMERA, EYE, FAR, SCENES, STRAIGHT, UP, mjcf, ray_depth

from rewax import struct
from rewax.physics import rigid
from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Box, Shape, Sphere
from rewax.sensors import Balls, Camera, DepthNoise, Solid, Triangles, World, half_space
from rewax.sensors.labels import Labels
from rewax.sensors.robots import with_robot


def world_of_all_kinds(shift: jax.Array | float = 0.0) -> World:
    corners = jnp.array([[-0.2, -0.2, 0.5], [0.1, -0.2, 0.5], [0.0, 0.1, 0.6], [-0.1, 0.0, 0.4]])
    faces = jnp.array([[0, 1, 2], [0, 1, 3], [1, 2, 3], [2, 0, 3]], jnp.int32)
    at = jnp.array([0.3, 0.1, 0.2]) + shift
    return World(
        solids=(
            half_space(UP, -0.3, "floor"),
            Solid(shape=Sphere(radius=jnp.asarray(0.15)), pose=Pose(at, STRAIGHT), name="ball"),
            Solid(shape=Box(half_size=jnp.full(3, 0.1)), pose=Pose(-at, STRAIGHT), name="box"),
        ),
        balls=(Balls(center=jnp.array([[0.0, 0.0, 0.3], [0.02, 0.01, 0.31]]) + shift, radius=0.05, names=("a", "b"), counts=(1, 1)),),
        triangles=(Triangles(vertices=corners + shift, faces=faces, name="soft"),),
    )  # fmt: skip


@pytest.mark.parametrize("scene", SCENES)
def test_depth_is_that_of_mujocos_rays(scene):
    model = rigid.load(mjcf(scene), dt=1e-3)
    world = with_robot(World(), model, rigid.initial_state(model))
    view = jax.jit(CAMERA.view)(world)
    ahead = np.concatenate([np.stack(CAMERA._slopes(), -1), -np.ones((48 * 64, 1))], -1)
    forward = -np.asarray(CAMERA.rotation)[:, 2]
    expected = ray_depth(model.static.mj, ahead @ np.asarray(CAMERA.rotation).T, forward, FAR).reshape(48, 64)
    error = np.abs(np.asarray(view.depth) - expected)
    assert (expected < FAR).mean() > 0.03, "the scene is out of sight"
    assert (error < 1e-4).mean() > 0.995, (error.max(), (error > 1e-4).mean())
    seen = np.asarray(view.depth) < FAR
    assert np.allclose(np.linalg.norm(view.normal, axis=-1)[seen], 1.0, atol=1e-4)
    assert (
        (np.asarray(view.normal) * (ahead @ np.asarray(CAMERA.rotation).T).reshape(48, 64, 3)).sum(-1)[seen] < 1e-3
    ).all()


def test_a_body_named_like_something_in_the_world_has_a_mask_of_its_own():
    model = rigid.load(
        '<mujoco><worldbody><body name="dough" pos="0 0 0.3"><freejoint/><geom type="sphere" size="0.05"/></body>'
        "</worldbody></mujoco>",
        dt=1e-3,
    )
    balls = Balls(center=jnp.array([[0.2, 0.0, 0.3]]), radius=0.05, names=("dough",), counts=(1,))
    world = with_robot(World(balls=(balls,)), model, rigid.initial_state(model))
    assert world.names == ("dough_2", "dough")
    alone, robot = (
        np.asarray(Labels(camera=CAMERA, of=(n,)).see(world, jax.random.key(0))) for n in ("dough", "dough_2")
    )
    assert alone.any() and robot.any() and not (alone * robot).any()


def test_particles_are_those_of_a_brute_force_z_buffer():
    rng = np.random.default_rng(0)
    center = rng.uniform(-0.3, 0.3, (300, 3)).astype(np.float32)
    balls = Balls(center=jnp.asarray(center), radius=0.03, names=("mud", "sand"), counts=(100, 200))
    view = jax.jit(CAMERA.view)(World(balls=(balls,)))
    u, v = (np.asarray(a, np.float64) for a in CAMERA._slopes())
    local = (center - np.asarray(EYE)) @ np.asarray(CAMERA.rotation, np.float64)
    x, y, z = local[:, :1], local[:, 1:2], -local[:, 2:]
    square = u**2 + v**2 + 1
    foot = (u * x + v * y + z) / square
    chord = (0.03**2 - (x - foot * u) ** 2 - (y - foot * v) ** 2 - (z - foot) ** 2) / square
    depth = np.where(chord > 0, foot - np.sqrt(np.maximum(chord, 0)), np.inf)
    expected = np.minimum(depth.min(axis=0), FAR).reshape(48, 64)
    inner = np.abs(chord).min(axis=0).reshape(48, 64) > 1e-7  # rays that graze a ball may go either way
    np.testing.assert_allclose(np.asarray(view.depth)[inner], expected[inner], atol=2e-5)
    label = np.where(depth.min(axis=0) < FAR, (depth.argmin(axis=0) >= 100).astype(int), -1).reshape(48, 64)
    assert (np.asarray(view.label) == label)[inner].mean() > 0.999
    assert set(np.unique(view.label)) == {-1, 0, 1}


def test_no_ball_reaches_beyond_its_window():
    """A ball close to the camera, in a corner of a wide picture: where a window that is too small would cut it."""
    camera = CAMERA.replace(field_of_view=100.0, near=0.2)
    points = camera.points(jnp.full((48, 64), 0.23))
    balls = Balls(
        center=points[jnp.array([0, 0, -1, 24]), jnp.array([0, -1, 0, 32])], radius=0.05, names=("a",), counts=(4,)
    )
    one = [Solid(shape=Sphere(radius=jnp.asarray(0.05)), pose=Pose(c, STRAIGHT), name="a") for c in balls.center]
    seen, expected = camera.depth(World(balls=(balls,))), camera.depth(World(solids=tuple(one)))
    assert (np.asarray(expected) < FAR).sum() > 50
    np.testing.assert_allclose(seen, expected, atol=1e-4)


def test_what_is_nearest_is_seen_and_named():
    world = world_of_all_kinds()
    depth = jax.jit(CAMERA.depth)
    view = jax.jit(CAMERA.view)(world)
    seen = {world.names[i] for i in np.unique(view.label) if i >= 0}
    assert seen == {"floor", "ball", "box", "a", "b", "soft"}
    np.testing.assert_allclose(view.depth, depth(world), atol=2e-5)
    alone = [
        depth(World(solids=world.solids)),
        depth(World(balls=world.balls)),
        depth(World(triangles=world.triangles)),
    ]
    np.testing.assert_allclose(view.depth, np.minimum.reduce([np.asarray(a) for a in alone]), atol=2e-5)


def test_a_batch_is_its_pictures_one_by_one():
    shifts = jnp.linspace(-0.1, 0.1, 3)
    together = jax.jit(jax.vmap(lambda s: CAMERA.depth(world_of_all_kinds(s))))(shifts)
    one = jax.jit(lambda s: CAMERA.depth(world_of_all_kinds(s)))
    for depth, shift in zip(together, shifts, strict=True):
        np.testing.assert_allclose(depth, one(shift), atol=2e-5)


def test_the_gradient_is_zero_unless_it_is_asked_for_and_then_exact():
    with jax.enable_x64(True):
        camera = CAMERA.replace(
            position=jnp.asarray(EYE, jnp.float64), rotation=jnp.asarray(CAMERA.rotation, jnp.float64), gradient=True
        )

        def depth(shift, camera=camera):
            return camera.view(world_of_all_kinds(shift)).depth

        shift, step = jnp.asarray(0.013, jnp.float64), 1e-6
        assert not np.any(jax.jit(jax.jacfwd(lambda s: depth(s, camera.replace(gradient=False))))(shift))
        forward, reverse = jax.jit(lambda s: (jax.jacfwd(depth)(s), jax.jacrev(depth)(s)))(shift)
        np.testing.assert_allclose(forward, reverse, atol=1e-10)
        before, after = jax.jit(jax.vmap(depth))(shift + step * jnp.array([-1.0, 1.0]))
        slope = (after - before) / (2 * step)
        smooth = np.abs(slope) < 50  # a pixel at an edge sees another surface after the step
        assert smooth.mean() > 0.99 and (np.abs(slope)[smooth] > 0.1).sum() > 100
        np.testing.assert_allclose(np.asarray(forward)[smooth], np.asarray(slope)[smooth], atol=2e-4, rtol=1e-4)


def test_a_camera_on_a_body_moves_with_it():
    turn = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    bodies = Pose(jnp.array([[0.0, 0.0, 0.0], [0.2, 0.3, 0.1]]), jnp.stack([STRAIGHT, turn]))
    world = world_of_all_kinds().replace(bodies=bodies)
    carried = CAMERA.replace(body=1)
    fixed = CAMERA.replace(position=bodies.position[1] + turn @ CAMERA.position, rotation=turn @ CAMERA.rotation)
    np.testing.assert_allclose(carried.depth(world), fixed.depth(world), atol=1e-5)
    points = carried.points(carried.depth(world), world)
    np.testing.assert_allclose(points, fixed.points(fixed.depth(world)), atol=1e-5)
    with pytest.raises(ValueError, match="give the world"):
        carried.points(carried.depth(world))
    with pytest.raises(ValueError, match=r"body is 2, but 2 bodies"):
        CAMERA.replace(body=2).depth(world)


def test_points_of_pixels_lie_on_what_they_see():
    world = World(
        solids=(Solid(shape=Sphere(radius=jnp.asarray(0.3)), pose=Pose(jnp.zeros(3), STRAIGHT), name="ball"),)
    )
    depth = CAMERA.depth(world)
    points = CAMERA.points(depth)[depth < FAR]
    assert len(points) > 200
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1), 0.3, atol=1e-5)


def test_noise_grows_with_distance_and_holes_lie_at_edges():
    world, key = world_of_all_kinds(), jax.random.key(0)
    depth = CAMERA.depth(world)
    noisy = CAMERA.replace(noise=DepthNoise(constant=0.001, quadratic=0.004)).with_noise(depth, key)
    error, seen = np.asarray(noisy - depth), np.asarray(depth) < FAR
    assert not error[~seen].any()
    near, far = seen & (depth < np.median(depth[seen])), seen & (depth > np.quantile(depth[seen], 0.9))
    for where in (near, far):
        expected = np.sqrt(np.mean((0.001 + 0.004 * np.asarray(depth)[where] ** 2) ** 2))
        assert abs(error[where].std() / expected - 1) < 0.15
    stepped = CAMERA.replace(noise=DepthNoise(step=0.01)).with_noise(depth, key)
    np.testing.assert_allclose(np.asarray(stepped)[seen] / 0.01, np.round(np.asarray(stepped)[seen] / 0.01), atol=1e-3)
    holes = np.asarray(CAMERA.replace(noise=DepthNoise(edge_holes=1.0, edge=0.05)).with_noise(depth, key)) == FAR
    lost = holes & seen
    jump = np.abs(np.diff(np.asarray(depth), axis=1))
    assert lost.sum() > 20 and lost[:, 1:][(jump > 0.05) & seen[:, 1:]].all()
    dropped = np.asarray(CAMERA.replace(noise=DepthNoise(dropout=0.2)).with_noise(depth, key)) == FAR
    assert abs((dropped & seen).sum() / seen.sum() - 0.2) < 0.05


def test_steps_of_a_noisy_camera_leave_the_gradient():
    """Rounding alone has the derivative zero."""
    depth = jnp.linspace(0.5, 1.5, 12).reshape(3, 4).at[0, 0].set(FAR)
    for noise in (DepthNoise(step=0.01), DepthNoise(step=0.01, constant=0.001)):
        slope = jax.grad(lambda d, noise=noise: noise.apply(d, FAR, jax.random.key(0)).sum())(depth)
        np.testing.assert_array_equal(slope, (depth < FAR).astype(float))


def test_an_observation_lies_between_zero_and_one():
    seen = CAMERA.see(world_of_all_kinds(), jax.random.key(0))
    assert seen.shape == (48, 64, 1) and seen.min() >= 0 and seen.max() <= 1
    np.testing.assert_allclose(seen[..., 0] * (FAR - 0.3) + 0.3, CAMERA.depth(world_of_all_kinds()), atol=1e-5)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"height": 0}, "height of the camera is 0"),
        ({"width": 2.5}, "width of the camera is 2.5"),
        ({"field_of_view": 180.0}, "field_of_view is 180"),
        ({"near": 0.0}, "near is 0"),
        ({"near": 11.0}, "near is 11"),
        ({"position": jnp.zeros(2)}, "position"),
        ({"rotation": jnp.full((3, 3), jnp.nan)}, "rotation"),
        ({"noise": 0.1}, "noise is of the type"),
        ({"rotation": np.zeros((3, 3))}, "is no rotation: give orthonormal columns"),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "is no rotation"),
        ({"body": -1}, "body is -1"),
    ],
)
def test_bad_cameras_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        Camera(**{"position": CAMERA.position, "rotation": CAMERA.rotation, **wrong})


@pytest.mark.parametrize(("eye", "up"), [((0, 0, 0), UP), ((0.0, 0.0, 1.0), (0.0, 0.0, -2.0))])
def test_a_view_that_is_not_fixed_is_refused(eye, up):
    with pytest.raises(ValueError, match="fix no view"):
        Camera.look_at((0, 0, 0), eye=eye, up=up)


@pytest.mark.parametrize("wrong", [{"target": "a"}, {"eye": None}, {"eye": (0.0, 1.0)}, {"up": "y"}], ids=str)
def test_a_view_of_no_vectors_is_refused(wrong):
    with pytest.raises(ValueError, match=rf"^{next(iter(wrong))} (is|has) .*: give "):
        Camera.look_at(**{"target": (0, 0, 0), "eye": (0.0, 0.0, 1.0), **wrong})


def test_a_traced_view_is_refused_and_a_traced_angle_too():
    with pytest.raises(ValueError, match="make the camera outside jit, and replace its position and rotation inside"):
        jax.jit(lambda eye: Camera.look_at((0, 0, 0), eye=eye).position)(jnp.ones(3))
    with pytest.raises(ValueError, match="field_of_view is traced, but is part of the compiled program"):
        jax.jit(lambda angle: CAMERA.replace(field_of_view=angle).position)(40.0)
    assert isinstance(CAMERA.replace(field_of_view=jnp.float32(40.0)).field_of_view, float)


def test_a_shape_of_ones_own_may_have_the_name_of_another():
    @struct.dataclass
    class Ball(Shape):
        radius: float = struct.number(POSITIVE, "give a radius in metres", shape=())
        distance = Sphere.distance

    Ball.__name__ = Ball.__qualname__ = "Sphere"
    solids = tuple(
        Solid(shape=kind(radius=jnp.asarray(0.1)), pose=Pose(jnp.array([x, 0.0, 0.0]), jnp.eye(3)), name=name)
        for kind, x, name in ((Sphere, -0.2, "a"), (Ball, 0.2, "b"))
    )
    view = Camera.look_at((0, 0, 0), eye=(0, 0, 1)).view(World(solids=solids))
    assert {*np.unique(view.label).tolist()} == {-1, 0, 1}


def test_bodies_without_a_name_are_told_apart():
    bodies = "".join(f'<body pos="{x} 0 0"><freejoint/><geom size="0.1"/></body>' for x in (-0.2, 0.2))
    model = rigid.load(f"<mujoco><worldbody><geom size='0.05'/>{bodies}</worldbody></mujoco>")
    world = with_robot(World(), model, rigid.initial_state(model))
    assert world.names == ("world", "body_1", "body_2") and {*rigid.touching_bodies(model)} == {*world.names}


@pytest.mark.parametrize("zoom", [0.55, 1.0, 1.45])
def test_a_zoom_is_a_longer_focal_length(zoom):
    centers = np.random.default_rng(0).uniform(-0.4, 0.4, (60, 3)).astype(np.float32)
    world = World(balls=(Balls(center=jnp.asarray(centers), radius=0.05, names=("dough",), counts=(60,)),))
    fields = {"eye": (0.3, 0.5, 2.0), "near": 1.0, "far": 4.0, "height": 40, "width": 56}
    narrow = np.degrees(2.0 * np.arctan(np.tan(np.radians(20.0)) / zoom))
    zoomed = jax.jit(Camera.look_at((0, 0, 0), field_of_view=40.0, zoom=zoom, **fields).view)(world)
    plain = jax.jit(Camera.look_at((0, 0, 0), field_of_view=float(narrow), **fields).view)(world)
    seen = np.asarray((zoomed.label == 0) & (plain.label == 0))
    assert (np.asarray(zoomed.label) != plain.label).mean() < 2e-3 and seen.sum() > 50
    np.testing.assert_allclose(np.asarray(zoomed.depth)[seen], np.asarray(plain.depth)[seen], atol=2e-3)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"dropout": 5.0}, "DepthNoise.dropout is 5.*must be from 0 to 1: give a probability"),
        ({"edge_holes": -0.1}, "DepthNoise.edge_holes is -0.1.*must be from 0 to 1"),
        ({"constant": -0.1}, "DepthNoise.constant is -0.1.*must be 0 or more"),
    ],
)
def test_bad_noise_is_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        DepthNoise(**wrong)
    DepthNoise(dropout=1.0, edge_holes=0.0)
