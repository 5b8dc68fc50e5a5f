"""An episode as NumPy arrays, without physics and without JAX: the input of pictures, videos and the player."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rewax.viz.seen import Seen
from rewax.viz.shapes import Drawing, check_cloud, check_drawing

FRAMES_PER_SECOND = 30.0
"""Highest frame rate of a video [1/s]."""
_SHORT = 3.0
"""Shorter episodes are slowed down [s]."""
_STEPS_PER_SECOND = 25.0
"""Control steps per second on screen where an environment has no ``control_dt``."""


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """An episode.

    Attributes:
      steps: number of control steps before each frame, shape (num_frames,).
      rewards: of every control step, shape (num_steps,).
      status: bits of ``rewax.status.Status`` after every control step, shape (num_steps,).
      actions: of every control step, shape (num_steps, num_actions); None where they are not kept.
      metrics: named numbers of every control step, shape (num_steps,) each.
      particles: positions [m], shape (num_frames, num_particles, 3); None without particles.
      values: named numbers of each particle (``speed``, ``strain``), shape (num_frames, num_particles) each.
      drawings: rigid shapes of each frame (``rewax.viz.shapes``): the same kinds, meshes with the same triangles.
      seen: what the environment's cameras show in each frame.
      control_dt: duration of a control step [s]; None if the environment does not have it.
      up: unit vector that points up, shape (3,).
      triangles: of particles that are the vertices of a mesh, shape (num_triangles, 3); None for loose particles.
      segments: of particles that are the points of ropes, shape (num_segments, 2); None without ropes.
      thickness: of cloth and ropes [m]: ``triangles`` are then open sheets; None where there are neither.
      materials: index of each particle's material in ``material_names``, shape (num_particles,).
      material_names: ``dough``, ``water``, ``sand``, ``snow``, ``elastic``, ``muscle``, ...
      floor: height of the floor along ``up`` [m]. None: the highest level plane among the drawings, or, without one,
        the lowest point.
      camera: ``azimuth`` and ``elevation`` [degrees], ``zoom``, ``follow``; see ``rewax.viz.camera``.
      name: title of the recording.
    """

    steps: np.ndarray
    rewards: np.ndarray
    status: np.ndarray
    actions: np.ndarray | None = None
    metrics: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    particles: np.ndarray | None = None
    values: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    drawings: Sequence[Sequence[Drawing]] = ()
    seen: Sequence[Seen] = ()
    control_dt: float | None = None
    up: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0.0, 1.0, 0.0]))
    triangles: np.ndarray | None = None
    segments: np.ndarray | None = None
    thickness: float | None = None
    materials: np.ndarray | None = None
    material_names: Sequence[str] = ()
    floor: float | None = None
    camera: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        if len(self.steps) == 0:
            raise ValueError("a recording has no frames: record at least one")
        self._check_steps()
        if self.particles is not None:
            self._check_particles(self.particles)
        if len(self.drawings) not in (0, self.num_frames):
            raise ValueError(f"drawings has {len(self.drawings)} frames, not {self.num_frames}: give one for each")
        kinds = [tuple(check_drawing(drawing) or drawing["kind"] for drawing in frame) for frame in self.drawings]
        if len(set(kinds)) > 1:
            raise ValueError("render_shapes gives other kinds of drawings in some frames: give the same ones in all")
        for frame in self.drawings[1:]:
            for i, (first, later) in enumerate(zip(self.drawings[0], frame, strict=True)):
                if first["kind"] == "mesh" and not _same_mesh(first, later):
                    raise ValueError(f"drawing {i} is a mesh that changes: give the same vertices and triangles always")
        for seen in self.seen:
            if len(seen.pixels) != len(self.steps):
                raise ValueError(
                    f"{seen.title} has {len(seen.pixels)} frames, not {len(self.steps)}: give one for each"
                )
        if self.particles is None and not any(kind != "plane" for kind in (kinds or [()])[0]):
            raise ValueError("there is nothing to show: give the environment particles or render_shapes")

    def _check_steps(self) -> None:
        """Rewards may be missing, as in ``snapshots``. All else that belongs to steps is as long as they are."""
        count, status = len(self.rewards), np.asarray(self.status)
        if status.shape != (count,):
            raise ValueError(f"status has shape {status.shape}: give one number for each of {count} rewards")
        if self.actions is not None and (np.ndim(self.actions) != 2 or len(self.actions) != count):
            raise ValueError(f"actions has shape {np.shape(self.actions)}: give one row for each of {count} rewards")
        for name, metric in self.metrics.items():
            if np.shape(metric) != (count,):
                raise ValueError(
                    f"the metric {name} has shape {np.shape(metric)}: give one number for each of {count} rewards"
                )

    def _check_particles(self, particles: np.ndarray) -> None:
        if len(particles) != self.num_frames:
            raise ValueError(f"particles has {len(particles)} frames, not {self.num_frames}: give one for each")
        for cloud in particles:
            check_cloud(cloud)
        count = particles.shape[1]
        for name, value in self.values.items():
            if np.shape(value) != (self.num_frames, count):
                raise ValueError(
                    f"the value {name} has shape {np.shape(value)}: give a number for each of {self.num_frames} frames "
                    f"and {count} particles"
                )
        for name, corners, elements in (("triangles", 3, self.triangles), ("segments", 2, self.segments)):
            if elements is not None:
                _check_elements(name, np.asarray(elements), corners, count)
        if self.materials is not None:
            self._check_materials(count, np.asarray(self.materials))

    def _check_materials(self, num_particles: int, materials: np.ndarray) -> None:
        if materials.shape != (num_particles,):
            raise ValueError(
                f"materials has shape {materials.shape}: give one index for each of {num_particles} particles"
            )
        if not np.isin(materials, np.arange(max(1, len(self.material_names)))).all():
            raise ValueError(
                f"materials has an index beyond the {len(self.material_names)} material_names: give a name for each"
            )

    @property
    def has_segments(self) -> bool:
        return self.segments is not None and len(self.segments) > 0

    @property
    def num_frames(self) -> int:
        return len(self.steps)

    @property
    def step_dt(self) -> float:
        """Duration of a control step on screen at normal speed [s]."""
        return 1.0 / _STEPS_PER_SECOND if self.control_dt is None else float(self.control_dt)

    @property
    def times(self) -> np.ndarray:
        """Time of each frame [s], shape (num_frames,)."""
        return np.asarray(self.steps) * self.step_dt

    @property
    def totals(self) -> np.ndarray:
        """Sum of the rewards up to each frame, shape (num_frames,); zeros without rewards."""
        if not len(self.rewards):
            return np.zeros(self.num_frames)
        return np.concatenate([[0.0], np.cumsum(self.rewards)])[np.asarray(self.steps)]

    def shapes(self, frame: int) -> Sequence[Drawing]:
        """Drawings of a frame."""
        return self.drawings[frame] if len(self.drawings) else ()

    def take(self, frames: Sequence[int] | np.ndarray) -> "Recording":
        """A recording of some of the frames. Rewards, actions, metrics and status stay complete."""
        frames = np.asarray(frames, int)
        return dataclasses.replace(
            self,
            steps=np.asarray(self.steps)[frames],
            particles=None if self.particles is None else self.particles[frames],
            values={name: value[frames] for name, value in self.values.items()},
            drawings=[self.drawings[i] for i in frames] if len(self.drawings) else (),
            seen=[seen.take(frames) for seen in self.seen],
        )

    def subsample(self, num_frames: int) -> "Recording":
        """At most ``num_frames`` frames, equally spaced from the first to the last."""
        return self.take(np.unique(np.linspace(0, self.num_frames - 1, num_frames).round().astype(int)))


def _check_elements(name: str, elements: np.ndarray, corners: int, num_particles: int) -> None:
    if elements.ndim != 2 or elements.shape[1] != corners:
        raise ValueError(f"{name} has shape {elements.shape}: give {corners} indices of particles in a row")
    if not np.isin(elements, np.arange(num_particles)).all():
        raise ValueError(f"{name} has an index that is none of the {num_particles} particles: give 0 to the last one")


def _same_mesh(first: Drawing, later: Drawing) -> bool:
    keys = ("vertices", "triangles")
    return all(first[key] is later[key] or np.array_equal(first[key], later[key]) for key in keys)


def playback(recording: Recording) -> tuple[Recording, float, float]:
    """Choose the frames of a video, their rate and the playback speed.

    Returns:
      The recording with at most 30 frames a second, from its first frame to its last; the frames per second; the
      speed: 1 is real time, 0.25 is four times slower. Episodes shorter than three seconds are slowed down, but not
      below ten frames a second.
    """
    times = recording.times
    duration = float(times[-1] - times[0])
    if recording.num_frames < 2 or duration <= 0.0:
        return recording, 1.0, 1.0
    slowest = (recording.num_frames - 1) / 10.0 / duration  # below ten frames a second motion looks jerky
    wanted = max(1, int(np.ceil(_SHORT / duration))) if duration < _SHORT else 1
    slow = max(1, min(wanted, int(slowest)))
    rate = (recording.num_frames - 1) / (duration * slow)
    every = max(1, int(np.ceil(rate / FRAMES_PER_SECOND - 1e-6)))
    last = recording.num_frames - 1
    return recording.take([*range(0, last, every), last]), rate / every, 1.0 / slow


def describe_speed(recording: Recording, speed: float) -> str:
    """The speed in words: ``in real time``, ``4 times slower than real time``, or the steps per second."""
    if recording.control_dt is None:
        return f"{_STEPS_PER_SECOND * speed:.3g} steps per second"
    return "in real time" if speed == 1.0 else f"{1.0 / speed:.3g} times slower than real time"


def diameters(recording: Recording) -> np.ndarray:
    """Diameter of each particle's ball [m], shape (num_particles,): the balls of a material fill its volume."""
    assert recording.particles is not None
    cloud = np.asarray(recording.particles[0], np.float64)
    materials = np.zeros(len(cloud), int) if recording.materials is None else np.asarray(recording.materials)
    found = np.empty(len(cloud))
    for material in np.unique(materials):
        members = cloud[materials == material]
        extent = np.maximum(np.ptp(members, axis=0), 1e-3)
        filling = float((np.prod(extent) / len(members)) ** (1 / 3))
        found[materials == material] = 1.25 * min(filling, 2.0 * _neighbour_distance(members, filling))
    return found


def _neighbour_distance(points: np.ndarray, default: float) -> float:
    """Median distance to the nearest neighbour, over at most 256 of the points."""
    if len(points) < 2:
        return default
    some = np.random.default_rng(0).permutation(len(points))[:256]
    nearest = [np.partition(((points - points[i]) ** 2).sum(-1), 1)[1] for i in some]  # after the point itself
    return max(float(np.sqrt(np.median(nearest))), 0.25 * default)


__all__ = ["FRAMES_PER_SECOND", "Recording", "describe_speed", "diameters", "playback"]
