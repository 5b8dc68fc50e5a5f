"""Pictures by numpy alone show things where the camera says, lit from above, with a shadow below."""

import numpy as np
import pytest
import recordings

from rewax.viz.camera import frame_recording
from rewax.viz.meshes import mesh
from rewax.viz.software import SoftwareRenderer

SIZE = (120, 160)


def picture(recording, frame=0, **options):
    return SoftwareRenderer(recording, height=SIZE[0], width=SIZE[1], **options).render(frame).astype(float) / 255.0


def place(recording, point, frame=0):
    """Row and column of a point."""
    column, row, _ = frame_recording(recording).camera(frame, recording.up).project(np.asarray(point), *SIZE)
    return int(row), int(column)


def colored(kind, **options):
    return {"kind": kind, "color": (0.9, 0.1, 0.1), **options}


def red(image):
    """Pixels in which red is strong."""
    return image[..., 0] > 1.6 * image[..., 1:].max(axis=-1)


def test_a_ball_is_where_it_is_and_lit_from_above():
    ball = colored("sphere", center=np.array([0.0, 0.5, 0.0]), radius=0.2)
    recording = recordings.made(1, drawings=[[ball]], floor=0.0)
    image = picture(recording)
    row, column = place(recording, ball["center"])
    rows, columns = np.nonzero(red(image))
    assert abs(rows.mean() - row) < 4 and abs(columns.mean() - column) < 4
    radius = abs(place(recording, ball["center"] + [0.0, 0.2, 0.0])[0] - row)
    assert len(rows) == pytest.approx(np.pi * radius**2, rel=0.2)
    top, bottom = image[row - radius // 2, column], image[row + radius // 2, column]
    assert top[0] > 1.15 * bottom[0]


def test_its_shadow_lies_on_the_floor_and_goes_with_it():
    drawings = [[{**recordings.BALL, "center": np.array([x, 0.5, 0.0])}] for x in (-1.0, 1.0)]
    low = recordings.made(2, drawings=drawings, floor=0.0, camera={"follow": False})
    renderer = SoftwareRenderer(low, height=SIZE[0], width=SIZE[1])
    first, second = (renderer.render(i).astype(float).mean(axis=-1) for i in (0, 1))
    here, there = place(low, [-1.0, 0.0, 0.0]), place(low, [1.0, 0.0, 0.0])
    change = first - second

    def around(at):
        return change[at[0] - 6 : at[0] + 7, at[1] - 12 : at[1] + 13]

    assert around(here).min() < -15.0 and around(there).max() > 15.0


@pytest.mark.parametrize("wall_first", [True, False])
def test_what_is_nearer_covers_particles_and_shapes_alike(wall_first):
    towards = frame_recording(recordings.cloud(1)).camera(0, np.eye(3)[1]).forward
    middle = np.array([0.0, 0.3, 0.0])
    for sign, visible in ((-1.0, True), (1.0, False)):
        wall = colored("box", center=middle + sign * 0.6 * towards, half_size=np.full(3, 0.12), rotation=np.eye(3))
        other = colored("sphere", center=middle, radius=0.01)
        shapes = [wall, other] if wall_first else [other, wall]
        recording = recordings.cloud(
            1, num_particles=1500, drawings=[shapes], material_names=("water", "water"), values={}
        )
        row, column = place(recording, wall["center"])
        assert bool(red(picture(recording))[row, column]) == visible


def test_glass_shows_what_is_behind():
    glass = {**colored("box"), "center": np.array([0.0, 0.3, 0.0]), "half_size": np.full(3, 0.3), "rotation": np.eye(3)}
    clear = recordings.cloud(1, num_particles=1000, drawings=[[{**glass, "opacity": 0.3}]], values={})
    solid = recordings.cloud(1, num_particles=1000, drawings=[[glass]], values={})
    at = place(clear, glass["center"])
    assert red(picture(solid))[at] and not red(picture(clear))[at]
    assert np.abs(picture(clear)[at] - picture(solid)[at]).max() > 0.1


TURN, _ = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))
TURN = TURN * np.sign(np.linalg.det(TURN))


def pictured(shape, **options):
    """One shape over a floor, its colour red unless it says another."""
    return picture(recordings.made(1, drawings=[[colored(**shape)]], floor=0.0, **options))


@pytest.mark.parametrize("opacity", [1.0, 0.4])
def test_a_mesh_of_a_box_is_drawn_like_the_box(opacity):
    box = {"kind": "box", "center": np.array([0.2, 0.5, 0.1]), "half_size": np.array([0.3, 0.2, 0.1]), "rotation": TURN}
    surface = mesh(box)
    other = {"kind": "mesh", "center": box["center"], "rotation": TURN, "opacity": opacity}
    ours = pictured({**other, "vertices": surface.vertices, "triangles": surface.triangles})
    expected = pictured({**box, "opacity": opacity})
    assert red(pictured(box)).sum() > 500
    assert np.mean(np.abs(ours - expected).max(axis=-1) > 0.02) < 0.02  # pixels at edges and at the shadow's


def test_a_mesh_of_a_ball_is_shaded_like_the_ball():
    ball = {"kind": "sphere", "center": np.array([0.0, 0.5, 0.0]), "radius": 0.3}
    surface = mesh(ball)
    body = {"kind": "mesh", "vertices": surface.vertices, "triangles": surface.triangles, "rotation": TURN}
    ours, expected = pictured({**body, "center": ball["center"]}), pictured(ball)
    both = red(ours) & red(expected)
    assert both.sum() > 0.97 * red(expected).sum()
    difference = np.abs(ours - expected)[both].max(axis=-1)
    assert np.percentile(difference, 95) < 0.025  # with one colour a triangle it is 0.05


def test_an_ellipsoid_of_equal_axes_is_drawn_like_the_sphere():
    ball = {"kind": "sphere", "center": np.array([0.0, 0.5, 0.0]), "radius": 0.3}
    egg = {"kind": "ellipsoid", "center": ball["center"], "semi_axes": np.full(3, 0.3), "rotation": TURN}
    difference = np.abs(pictured(egg) - pictured(ball)).max(axis=-1)
    assert red(pictured(ball)).sum() > 500 and np.mean(difference > 0.02) < 0.001


def test_light_falls_through_the_hole_of_a_ring():
    """A frame of four bars over the floor: the shadow is the frame's, not that of its convex hull."""
    bars = [mesh({"kind": "box", "half_size": np.array([0.5, 0.02, 0.06])}) for _ in range(4)]
    places = [([0.0, 0.0, z], np.eye(3)) for z in (-0.44, 0.44)]
    places += [([x, 0.0, 0.0], np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])) for x in (-0.44, 0.44)]
    vertices = np.concatenate([b.vertices @ turn.T + at for b, (at, turn) in zip(bars, places, strict=True)])
    triangles = np.concatenate([b.triangles + 24 * i for i, b in enumerate(bars)])
    frame = {"kind": "mesh", "center": np.array([0.0, 0.2, 0.0]), "vertices": vertices, "triangles": triangles,
             "rotation": np.eye(3)}  # fmt: skip
    recording = recordings.made(1, drawings=[[frame]], floor=0.0, camera={"elevation": 60.0})
    empty = recordings.made(1, drawings=[[{**frame, "opacity": 0.0}]], floor=0.0, camera={"elevation": 60.0})
    change = (picture(empty) - picture(recording)).mean(axis=-1)
    row, column = place(recording, [0.0, 0.0, 0.0])
    assert np.abs(change[row - 2 : row + 3, column - 2 : column + 3]).max() < 0.01
    assert change.max() > 0.1


def test_a_surface_of_triangles_is_filled():
    corners = np.array([[[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.3, 0.6]]], np.float32)
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    recording = recordings.made(
        1, particles=corners, triangles=tetrahedron, material_names=("muscle",), floor=-0.2, camera={"azimuth": 0.0}
    )
    image = picture(recording)
    for inside in ([0.0, 0.5, 0.1], [0.2, 0.2, 0.2]):
        assert red(image)[place(recording, inside)]
    assert not red(image)[place(recording, [-0.45, 0.9, 0.0])]


def test_colours_follow_a_number_and_every_frame_has_its_own():
    recording = recordings.cloud(2, num_particles=400, travel=0.0)
    slow, fast = (picture(recording, frame, color_by="speed") for frame in (0, 1))
    at = place(recording, [0.0, 0.3, 0.0])
    assert slow[at][2] > slow[at][0] and fast[at][0] > fast[at][2]  # blue is low, red is high


def test_repeats_are_identical_whatever_was_drawn_before():
    recording = recordings.moving_ball(30, travel=0.5)
    renderer = SoftwareRenderer(recording, height=SIZE[0], width=SIZE[1])
    first = renderer.render(3)
    renderer.render(20)
    np.testing.assert_array_equal(renderer.render(3), first)
