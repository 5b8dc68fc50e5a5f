"""Cloth and ropes as closed surfaces: sheets with two sides, ropes as tubes, and balls for particles beside them."""

import dataclasses
from typing import NamedTuple

import numpy as np

from rewax.viz.balls import ball
from rewax.viz.recording import Recording, diameters

_CORNERS = 8
"""Corners of a tube's section."""


class Skin(NamedTuple):
    """A closed surface around a part of a recording's particles.

    Attributes:
      vertices: in each frame [m], shape (num_frames, num_vertices, 3).
      triangles: counter-clockwise seen from outside, shape (num_triangles, 3).
      owners: the particle that each vertex belongs to, shape (num_vertices,).
      back: whether a vertex belongs to the back of cloth, shape (num_vertices,).
    """

    vertices: np.ndarray
    triangles: np.ndarray
    owners: np.ndarray
    back: np.ndarray


def skinned(recording: Recording) -> Recording:
    """The recording with closed surfaces in place of cloth, ropes and loose particles; others are returned unchanged.

    The back of cloth has a shade of its own: a material with the name of the front's and ``_2``.
    """
    if recording.thickness is None:
        return recording
    assert recording.particles is not None
    x, half = np.asarray(recording.particles, np.float64), 0.5 * recording.thickness
    skins = [] if recording.triangles is None else [sheet(x, np.asarray(recording.triangles), half)]
    skins += [tube(x, line, half) for line in lines(np.asarray(recording.segments))] if recording.has_segments else []
    elements = [part for part in (recording.triangles, recording.segments) if part is not None and len(part)]
    loose = np.setdiff1d(np.arange(x.shape[1]), np.concatenate([np.reshape(part, -1) for part in elements]))
    skins += [balls(x, loose, 0.5 * diameters(recording))] if len(loose) else []
    starts = np.cumsum([0, *(skin.vertices.shape[1] for skin in skins[:-1])])
    owners, back = (np.concatenate([getattr(skin, name) for skin in skins]) for name in ("owners", "back"))
    names = tuple(recording.material_names) or ("cloth",)
    materials = np.zeros(x.shape[1], int) if recording.materials is None else np.asarray(recording.materials)
    materials = materials[owners]
    fronts = np.unique(materials[back])
    materials = np.where(back, len(names) + np.searchsorted(fronts, materials), materials)
    names = (*names, *(f"{names[front]}_2" for front in fronts))
    return dataclasses.replace(
        recording,
        particles=np.concatenate([skin.vertices for skin in skins], axis=1).astype(np.float32),
        triangles=np.concatenate([skin.triangles + start for skin, start in zip(skins, starts, strict=True)]),
        values={name: np.asarray(value)[:, owners] for name, value in recording.values.items()},
        materials=materials,
        material_names=names,
        segments=None,
        thickness=None,
    )


def sheet(x: np.ndarray, triangles: np.ndarray, half: float) -> Skin:
    """Cloth of a thickness: its triangles on both sides, and a rim along its edges.

    Args:
      x: of all particles [m], shape (num_frames, num_particles, 3).
      triangles: of the cloth, shape (num_triangles, 3).
      half: half of the thickness [m].
    """
    owners, local = np.unique(triangles, return_inverse=True)
    local, at = local.reshape(triangles.shape), x[:, owners]
    faces = np.cross(at[:, local[:, 1]] - at[:, local[:, 0]], at[:, local[:, 2]] - at[:, local[:, 0]])
    normals = np.zeros_like(at)
    for corner in local.T:
        for frame in range(len(x)):
            np.add.at(normals[frame], corner, faces[frame])
    normals = _unit(normals)
    directed = local[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    inner = {(b, a) for a, b in map(tuple, directed.tolist())}
    rim = np.array([edge for edge in map(tuple, directed.tolist()) if edge not in inner], int).reshape(-1, 2)
    a, b = rim.T
    n = len(owners)
    rims = np.concatenate([np.stack([a, a + n, b + n], axis=1), np.stack([a, b + n, b], axis=1)])
    return Skin(
        vertices=np.concatenate([at + half * normals, at - half * normals], axis=1),
        triangles=np.concatenate([local, local[:, ::-1] + n, rims]),
        owners=np.concatenate([owners, owners]),
        back=np.repeat([False, True], n),
    )


def tube(x: np.ndarray, line: np.ndarray, radius: float) -> Skin:
    """A tube around a polyline, with pointed ends; its section does not twist along the line.

    Args:
      x: of all particles [m], shape (num_frames, num_particles, 3).
      line: indices of the polyline's particles, shape (num_points,).
      radius: of the tube [m].
    """
    at = x[:, line]
    along = _unit(np.diff(at, axis=1))
    tangents = _unit(np.concatenate([along[:, :1], along[:, :-1] + along[:, 1:], along[:, -1:]], axis=1))
    side = _unit(np.cross(tangents[:, 0], np.eye(3)[np.argmin(np.abs(tangents[:, 0]), axis=-1)]))
    rings, angle = [], np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)[None, :, None]
    for k in range(len(line)):  # each section has the direction of the one before, without its part along the line
        t = tangents[:, k]
        side = _unit(side - np.sum(side * t, axis=-1, keepdims=True) * t)
        other = np.cross(t, side)
        rings.append(at[:, k, None] + radius * (np.cos(angle) * side[:, None] + np.sin(angle) * other[:, None]))
    ends = [at[:, :1] - radius * tangents[:, :1], at[:, -1:] + radius * tangents[:, -1:]]
    corner = np.arange(_CORNERS)
    following, last = (corner + 1) % _CORNERS, _CORNERS * (len(line) - 1)
    first = np.arange(len(line) - 1)[:, None] * _CORNERS
    a, b, c, d = first + corner, first + following, first + following + _CORNERS, first + corner + _CORNERS
    tip = np.full(_CORNERS, last + _CORNERS)
    parts = [(a, b, c), (a, c, d), (tip, following, corner), (tip + 1, last + corner, last + following)]
    owners = np.concatenate([np.repeat(line, _CORNERS), line[:1], line[-1:]])
    return Skin(
        vertices=np.concatenate([*rings, *ends], axis=1),
        triangles=np.concatenate([np.stack(part, axis=-1).reshape(-1, 3) for part in parts]),
        owners=owners,
        back=np.zeros(len(owners), bool),
    )


def balls(x: np.ndarray, which: np.ndarray, radii: np.ndarray) -> Skin:
    """A ball at each of some particles.

    Args:
      x: of all particles [m], shape (num_frames, num_particles, 3).
      which: indices of the particles, shape (n,).
      radii: of all particles [m], shape (num_particles,).
    """
    directions, triangles = ball()
    count = len(directions)
    vertices = x[:, which, None] + radii[which, None, None] * directions
    return Skin(
        vertices=vertices.reshape(len(x), -1, 3),
        triangles=(triangles.astype(int) + count * np.arange(len(which))[:, None, None]).reshape(-1, 3),
        owners=np.repeat(which, count),
        back=np.zeros(len(which) * count, bool),
    )


def lines(segments: np.ndarray) -> list[np.ndarray]:
    """The polylines that segments form, as indices of their points in order; knots of nets and ends divide them."""
    left = {tuple(sorted(pair)) for pair in segments.tolist()}
    near: dict[int, list[int]] = {}
    for a, b in sorted(left):
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    found = []
    ends = [point for point in sorted(near) if len(near[point]) != 2]
    for start in [*ends, *sorted(near)]:  # after all ends, the points of closed loops
        for following in near[start]:
            line, ahead = [start], following
            while tuple(sorted((line[-1], ahead))) in left:
                left.discard(tuple(sorted((line[-1], ahead))))
                line.append(ahead)
                if len(near[ahead]) != 2:
                    break
                ahead = next(point for point in near[ahead] if point != line[-2])
            if len(line) > 1:
                found.append(np.array(line))
    return found


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-12)


__all__ = ["Skin", "balls", "lines", "sheet", "skinned", "tube"]
