"""Surfaces of cloth and ropes are closed, lie half a thickness away, and follow the particles."""

import numpy as np
import pytest
import recordings

from rewax.viz.colors import material_colors
from rewax.viz.player import write_player
from rewax.viz.render import pictures
from rewax.viz.skin import balls, lines, sheet, skinned, tube

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
TRIANGLES = np.array([[0, 2, 1], [0, 3, 2]])
"""Counter-clockwise seen from above, y up."""


def volume(skin):
    """By the divergence theorem, in each frame; positive if the triangles are seen counter-clockwise from outside."""
    a, b, c = (skin.vertices[:, corner] for corner in skin.triangles.T)
    return np.einsum("fni,fni->f", a, np.cross(b, c)) / 6.0


def assert_closed(skin):
    directed = skin.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert {tuple(edge) for edge in directed} == {tuple(edge[::-1]) for edge in directed}


def test_a_sheet_has_two_sides_and_a_rim():
    turned = SQUARE @ np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, -0.8, 0.6]])
    skin = sheet(np.stack([SQUARE, turned]), TRIANGLES, 0.05)
    assert_closed(skin)
    np.testing.assert_allclose(volume(skin), 0.1)
    np.testing.assert_allclose(skin.vertices[0, ~skin.back], SQUARE + [0.0, 0.05, 0.0])
    np.testing.assert_array_equal(skin.owners, [0, 1, 2, 3, 0, 1, 2, 3])


def test_a_tube_is_as_long_and_as_thick_as_its_line():
    angle = np.linspace(0.0, np.pi, 24)
    bent = np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1)
    skin = tube(np.stack([bent, bent + 1.0]), np.arange(24), 0.01)
    assert_closed(skin)
    section = 8 * 0.5 * 0.01**2 * np.sin(np.pi / 4)
    np.testing.assert_allclose(volume(skin), np.pi * section, rtol=0.01)
    rings = skin.vertices[0, :-2].reshape(24, 8, 3)
    np.testing.assert_allclose(np.linalg.norm(rings - bent[:, None], axis=-1), 0.01)


def test_balls_are_round_and_lie_at_their_particles():
    x = np.stack([SQUARE, SQUARE + 0.5])
    skin = balls(x, np.array([1, 3]), np.array([0.0, 0.1, 0.0, 0.2]))
    assert_closed(skin)
    np.testing.assert_allclose(volume(skin), 4.0 / 3.0 * np.pi * (0.1**3 + 0.2**3), rtol=0.15)
    away = np.linalg.norm(skin.vertices - x[:, skin.owners], axis=-1)
    np.testing.assert_allclose(away, np.broadcast_to(0.1 * (skin.owners - 1) / 2 + 0.1, away.shape), rtol=1e-5)


@pytest.mark.parametrize(
    ("segments", "wanted"),
    [
        ([(0, 1), (1, 2), (3, 2)], [[0, 1, 2, 3]]),
        ([(0, 1), (1, 2), (1, 3)], [[0, 1], [1, 2], [1, 3]]),
        ([(0, 1), (1, 2), (2, 0), (3, 4)], [[3, 4], [0, 1, 2, 0]]),
    ],
)
def test_lines_end_at_knots_and_close(segments, wanted):
    assert [line.tolist() for line in lines(np.array(segments))] == wanted


def cloth_and_rope(**options):
    points = np.concatenate([SQUARE, [[0.0, 1.0, 0.0], [0.5, 1.0, 0.0], [1.0, 1.0, 0.0]]])
    return recordings.made(
        2,
        particles=np.stack([points, points + [0.1, 0.0, 0.0]]),
        triangles=TRIANGLES,
        segments=np.array([[4, 5], [5, 6]]),
        thickness=0.1,
        materials=np.array([0, 0, 0, 0, 1, 1, 1]),
        material_names=("cloth", "rope"),
        values={"speed": np.arange(14.0).reshape(2, 7)},
        **options,
    )


def test_values_and_materials_are_those_of_the_owners():
    skin = skinned(cloth_and_rope())
    count = skin.particles.shape[1]
    assert count == 8 + 26 and skin.thickness is None and skinned(skin) is skin
    assert skin.material_names == ("cloth", "rope", "cloth_2")
    np.testing.assert_array_equal(skin.materials, [0] * 4 + [2] * 4 + [1] * 26)
    np.testing.assert_array_equal(skin.values["speed"][0], [0, 1, 2, 3, 0, 1, 2, 3, *[4] * 8, *[5] * 8, *[6] * 8, 4, 6])
    plain = recordings.cloud()
    assert skinned(plain) is plain


def test_the_back_is_named_by_the_clothes_own_material():
    """Wherever it stands among the materials, and for each of several."""
    two = np.concatenate([TRIANGLES, TRIANGLES + 4])
    points = np.concatenate([SQUARE, SQUARE + [0.0, 1.0, 0.0], SQUARE + [0.0, 2.0, 0.0]])
    skin = skinned(
        recordings.made(
            1, particles=points[None], triangles=two, thickness=0.1, materials=np.repeat([2, 1, 0], 4),
            material_names=("sand", "cloth", "cloth_2"),
        )
    )  # fmt: skip
    assert skin.material_names == ("sand", "cloth", "cloth_2", "cloth_2", "cloth_2_2")
    np.testing.assert_array_equal(skin.materials[:16], np.repeat([2, 1, 4, 3], 4))
    colors = material_colors(skin.material_names)
    assert not np.array_equal(colors[2], colors[4]) and np.argmax(colors[4]) == np.argmax(colors[2])


def test_particles_beside_cloth_become_balls():
    with_sand = cloth_and_rope()
    added = np.concatenate([with_sand.particles, [[[0.5, 0.5, 0.5]], [[0.5, 0.4, 0.5]]]], axis=1)
    with_sand = recordings.made(
        2,
        particles=added,
        triangles=TRIANGLES,
        thickness=0.1,
        materials=np.array([0] * 4 + [1] * 4),
        material_names=("cloth", "sand"),
        values={"speed": np.arange(16.0).reshape(2, 8)},
    )
    skin = skinned(with_sand)
    count = (skin.particles.shape[1] - 8) // 4
    assert skin.material_names == ("cloth", "sand", "cloth_2")
    np.testing.assert_array_equal(skin.materials, [0] * 4 + [2] * 4 + [1] * 4 * count)
    np.testing.assert_allclose(skin.particles[:, -count:].mean(axis=1), added[:, -1], atol=1e-6)
    np.testing.assert_array_equal(skin.values["speed"][1, -count:], 15.0)


def test_pictures_and_the_player_show_it(tmp_path):
    recording = cloth_and_rope(floor=-0.2)
    first, second = pictures(recording, size=(60, 80), renderer="software")
    empty = next(iter(pictures(recordings.moving_ball(1), size=(60, 80), renderer="software")))
    assert first.shape == empty.shape and np.abs(first.astype(int) - second).max() > 20
    page = write_player([recording], tmp_path / "player.html").read_text()
    assert '"count":34' in page and '"triangles":{' in page
