"""Colours of particles and shapes: by material, or by a number."""

import colorsys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rewax.viz.recording import Recording
    from rewax.viz.shapes import Drawing

MATERIALS: Mapping[str, tuple[float, float, float]] = {
    "dough": (0.89, 0.62, 0.34),
    "water": (0.22, 0.55, 0.88),
    "sand": (0.83, 0.70, 0.44),
    "snow": (0.88, 0.93, 0.98),
    "elastic": (0.86, 0.40, 0.42),
    "muscle": (0.80, 0.33, 0.38),
    "cloth": (0.34, 0.56, 0.78),
    "rope": (0.78, 0.58, 0.32),
}
"""Red, green and blue of a material by its name, between 0 and 1."""
OTHER = (0.45, 0.66, 0.42)
SOLID = (0.62, 0.66, 0.72)
"""Colour of a shape without ``color``."""
SCALE = np.array(
    [[0.19, 0.07, 0.23], [0.27, 0.42, 0.90], [0.16, 0.73, 0.92], [0.20, 0.94, 0.60], [0.71, 0.97, 0.22],
     [0.98, 0.73, 0.22], [0.93, 0.36, 0.08], [0.70, 0.10, 0.01]]
)  # fmt: skip
"""The Turbo colour map (Mikhailov 2019), sampled at equal distances."""
_ALWAYS = ("material", "height")
"""What particles of every recording can be coloured by."""


def material_colors(names: Sequence[str]) -> np.ndarray:
    """Colour of each material, shape (num_materials, 3); ``water_2`` and ``water_3`` are shades of ``water``."""
    return np.array([_material_color(name) for name in names] or [OTHER], np.float32)


def _material_color(name: str) -> tuple[float, float, float]:
    base, _, number = name.rpartition("_")
    if not (base and number.isdecimal()):
        return MATERIALS.get(name, OTHER)
    hue, lightness, saturation = colorsys.rgb_to_hls(*_material_color(base))
    step = max(int(number) - 1, 0)
    return colorsys.hls_to_rgb((hue + 0.11 * step) % 1.0, lightness * 0.8**step, saturation)


def scale_colors(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Colours from dark blue (low) through green to red (high) of values of shape (...,), shape (..., 3)."""
    known = np.nan_to_num(np.asarray(values), nan=low)
    place = np.clip((known - low) / max(high - low, 1e-12), 0.0, 1.0) * (len(SCALE) - 1)
    index = np.minimum(place.astype(int), len(SCALE) - 2)
    part = (place - index)[..., None]
    return ((1.0 - part) * SCALE[index] + part * SCALE[index + 1]).astype(np.float32)


def color_by(recording: "Recording") -> tuple[str, ...]:
    """What particles can be coloured by: the material, the height, and the recording's own values."""
    return color_names(recording.values)


def color_names(values: Iterable[str]) -> tuple[str, ...]:
    """What particles can be coloured by if a recording has values of these names."""
    return (*_ALWAYS, *renamed(values, _ALWAYS))


def named_values(recording: "Recording") -> dict[str, np.ndarray]:
    """The recording's own values by the names that ``color_by`` has for them."""
    names = renamed(recording.values, _ALWAYS)
    return {name: np.asarray(value) for name, value in zip(names, recording.values.values(), strict=True)}


def renamed(names: Iterable[str], taken: Sequence[str]) -> tuple[str, ...]:
    """The names, where one that is taken becomes ``<name> (recorded)``. No two of them become the same."""
    names, found = tuple(names), []
    for name in names:
        shown = name
        while shown in (*taken, *found) or (shown != name and shown in names):
            shown = f"{shown} (recorded)"
        found.append(shown)
    return tuple(found)


def particle_colors(recording: "Recording", by: str = "material") -> np.ndarray:
    """Colours of particles, shape (num_particles, 3) for the material, else (num_frames, num_particles, 3).

    Raises:
      ValueError: there is no value of this name.
    """
    assert recording.particles is not None
    count = recording.particles.shape[1]
    if by == "material":
        index = np.zeros(count, int) if recording.materials is None else np.asarray(recording.materials)
        return material_colors(recording.material_names)[index]
    if by not in color_by(recording):
        raise ValueError(f"particles cannot be coloured by {by!r}: use one of {', '.join(color_by(recording))}")
    values = recording.particles @ np.asarray(recording.up) if by == "height" else named_values(recording)[by]
    low, high = value_range(values)
    return scale_colors(values, low, high)


def value_range(values: np.ndarray) -> tuple[float, float]:
    """Values at the ends of the colour scale: the 1st and the 99th percentile over all frames."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (1.0, 99.0)) if known.size else (0.0, 1.0)
    return float(low), max(float(high), float(low) + max(1e-9, 1e-6 * abs(float(low))))  # of a constant, too


def shape_color(drawing: "Drawing") -> tuple[np.ndarray, float]:
    """Colour and opacity of a shape."""
    return np.asarray(drawing.get("color", SOLID), np.float32), float(drawing.get("opacity", 1.0))


__all__ = [
    "MATERIALS", "color_by", "color_names", "material_colors", "named_values", "particle_colors", "renamed",
    "scale_colors", "shape_color", "value_range",
]  # fmt: skip
