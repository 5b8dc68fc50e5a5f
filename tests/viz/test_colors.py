"""Colours by material, height and values."""

import numpy as np
import pytest
import recordings

from rewax.viz.colors import (
    MATERIALS,
    color_by,
    color_names,
    material_colors,
    named_values,
    particle_colors,
    renamed,
    scale_colors,
    shape_color,
    value_range,
)


def test_materials_have_their_colours_and_unknown_ones_another():
    recording = recordings.cloud(2, num_particles=3, material_names=("water", "jam"))
    colors = particle_colors(recording)
    np.testing.assert_allclose(colors[0], MATERIALS["water"])
    np.testing.assert_array_equal(colors[0], colors[2])
    assert not any(np.allclose(colors[1], known) for known in MATERIALS.values())


def test_materials_of_one_kind_have_colours_of_their_own():
    kinds = [*MATERIALS, "jam"]
    colors = material_colors([kind + suffix for kind in kinds for suffix in ("", "_2", "_3", "_4")])
    assert colors.min() >= 0.0 and colors.max() <= 1.0
    for of_kind in colors.reshape(len(kinds), 4, 3):
        gaps = np.linalg.norm(of_kind[:, None] - of_kind, axis=-1)
        assert gaps[~np.eye(4, dtype=bool)].min() > 0.08
    np.testing.assert_array_equal(colors[0], np.float32(MATERIALS["dough"]))


def test_the_scale_goes_from_blue_to_red_and_stops_at_its_ends():
    colors = scale_colors(np.array([-5.0, 0.0, 0.5, 1.0, 9.0]), 0.0, 1.0)
    np.testing.assert_array_equal(colors[0], colors[1])
    np.testing.assert_array_equal(colors[3], colors[4])
    assert colors[1, 2] > colors[1, 0] and colors[2, 1] > 0.8 and colors[3, 0] > colors[3, 2]


def test_numbers_that_are_not_finite_take_the_low_end():
    values = np.array([0.0, 1.0, np.nan])
    assert value_range(values) == pytest.approx((0.01, 0.99)) and value_range(values[2:]) == (0.0, 1.0)
    np.testing.assert_array_equal(scale_colors(values, 0.0, 1.0)[2], scale_colors(values, 0.0, 1.0)[0])


def test_height_is_along_up_and_outliers_do_not_stretch_the_scale():
    recording = recordings.cloud(2, num_particles=500)
    colors = particle_colors(recording, "height")
    heights = recording.particles[0, :, 1]
    assert colors[0, np.argmin(heights), 2] > colors[0, np.argmin(heights), 0]
    assert colors[0, np.argmax(heights), 0] > colors[0, np.argmax(heights), 2]
    assert value_range(np.concatenate([np.linspace(0.0, 1.0, 999), [1e9]]))[1] < 1.01
    with pytest.raises(ValueError, match="cannot be coloured by 'mass'"):
        particle_colors(recording, "mass")


def test_names_that_are_taken_are_changed_until_no_two_are_the_same():
    known = "height (recorded)"
    assert renamed(("height", "speed"), ("height",)) == (known, "speed")
    assert renamed(("height", known), ("height",)) == (f"{known} (recorded)", known)
    assert len({*renamed(("a", "a (recorded)"), ("a", "a (recorded)")), "a", "a (recorded)"}) == 4
    values = {"height": np.zeros((1, 60)), known: np.ones((1, 60))}
    recording = recordings.cloud(1, values=values)
    assert color_by(recording) == color_names(values) == ("material", "height", f"{known} (recorded)", known)
    assert named_values(recording)[known].all() and not named_values(recording)[f"{known} (recorded)"].any()


def test_shapes_have_a_colour_of_their_own_or_the_common_one():
    color, opacity = shape_color({**recordings.BALL, "color": (0.1, 0.2, 0.3), "opacity": 0.5})
    np.testing.assert_allclose(color, [0.1, 0.2, 0.3])
    assert opacity == 0.5 and shape_color(recordings.BALL)[1] == 1.0
