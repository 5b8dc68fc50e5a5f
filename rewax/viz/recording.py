"""What pictures, videos and the player are made of: an episode as arrays of numpy, nothing of physics or of JAX."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rewax.viz.shapes import Drawing, check_cloud, check_drawing

FRAMES_PER_SECOND = 30.0
"""What a video shows at most."""
_SHORT = 3.0
"""Episodes that last less are slowed down [s]."""
_STEPS_PER_SECOND = 25.0
"""Speed of an environment that does not say how long its steps last."""


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """An episode.

    Attributes:
      steps: control steps since the beginning of each frame, shape (num_frames,).
      rewards: of every control step, shape (num_steps,).
      status: bits of ``rewax.status.Status`` after every control step, shape (num_steps,).
      actions: of every control step, shape (num_steps, num_actions); None where they are not kept.
      metrics: named numbers of every control step, shape (num_steps,) each.
      particles: positions [m], shape (num_frames, num_particles, 3); None without particles.
      values: named numbers of each particle (``speed``, ``strain``), shape (num_frames, num_particles) each.
      drawings: rigid shapes of each frame (``rewax.viz.shapes``): the same kinds, meshes with the same triangles.
      control_dt: duration of a control step [s]; None where the environment does not say.
      up: unit vector that points up, shape (3,).
      triangles: surface of the particles where they are vertices of a mesh, shape (num_triangles, 3).
      materials: index of each particle's material in ``material_names``, shape (num_particles,).
      material_names: ``dough``, ``water``, ``sand``, ``snow``, ``elastic``, ``muscle``, ...
      floor: height of the floor along ``up`` [m]; None: that of the highest level plane among the drawings below
        everything else, or just below the lowest point.
      camera: ``azimuth`` and ``elevation`` [degrees], ``zoom``, ``follow``; see ``rewax.viz.camera``.
      name: of what is shown.
    """

    steps: np.ndarray
    rewards: np.ndarray
    status: np.ndarray
    actions: np.ndarray | None = None
    metrics: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    particles: np.ndarray | None = None
    values: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    drawings: Sequence[Sequence[Drawing]] = ()
    control_dt: float | None = None
    up: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0.0, 1.0, 0.0]))
    triangles: np.ndarray | None = None
    materials: np.ndarray | None = None
    material_names: Sequence[str] = ()
    floor: float | None = None
    camera: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        if len(self.steps) == 0:
            raise ValueError("a recording has no frames: record at least one")
        for cloud in () if self.particles is None else self.particles:
            check_cloud(cloud)
        kinds = [tuple(check_drawing(drawing) or drawing["kind"] for drawing in frame) for frame in self.drawings]
        if len(set(kinds)) > 1:
            raise ValueError("render_shapes gives other kinds of drawings in some frames: give the same ones in all")
        for frame in self.drawings[1:]:
            for i, (first, later) in enumerate(zip(self.drawings[0], frame, strict=True)):
                if first["kind"] == "mesh" and not _same_mesh(first, later):
                    raise ValueError(f"drawing {i} is a mesh that changes: give the same vertices and triangles always")
        if self.particles is None and not any(kind != "plane" for kind in (kinds or [()])[0]):
            raise ValueError("there is nothing to show: give the environment particles or render_shapes")

    @property
    def num_frames(self) -> int:
        return len(self.steps)

    @property
    def step_dt(self) -> float:
        """Duration of a control step on screen [s], before any slowing down."""
        return 1.0 / _STEPS_PER_SECOND if self.control_dt is None else float(self.control_dt)

    @property
    def times(self) -> np.ndarray:
        """Time of each frame [s], shape (num_frames,)."""
        return np.asarray(self.steps) * self.step_dt

    @property
    def totals(self) -> np.ndarray:
        """Sum of the rewards up to each frame, shape (num_frames,)."""
        return np.concatenate([[0.0], np.cumsum(self.rewards)])[np.asarray(self.steps)]

    def shapes(self, frame: int) -> Sequence[Drawing]:
        """Drawings of a frame."""
        return self.drawings[frame] if len(self.drawings) else ()

    def take(self, frames: Sequence[int] | np.ndarray) -> "Recording":
        """Some of the frames; rewards and status stay whole."""
        frames = np.asarray(frames, int)
        return dataclasses.replace(
            self,
            steps=np.asarray(self.steps)[frames],
            particles=None if self.particles is None else self.particles[frames],
            values={name: value[frames] for name, value in self.values.items()},
            drawings=[self.drawings[i] for i in frames] if len(self.drawings) else (),
        )

    def subsample(self, num_frames: int) -> "Recording":
        """At most so many frames, equally spaced from first to last."""
        return self.take(np.unique(np.linspace(0, self.num_frames - 1, num_frames).round().astype(int)))


def _same_mesh(first: Drawing, later: Drawing) -> bool:
    keys = ("vertices", "triangles")
    return all(first[key] is later[key] or np.array_equal(first[key], later[key]) for key in keys)


def playback(recording: Recording) -> tuple[Recording, float, float]:
    """Frames to show, how many a second, and how fast that is.

    Returns:
      The recording, subsampled to at most 30 frames a second; frames per second; speed: 1 is real time, 0.25 four
      times as slow. Episodes shorter than three seconds are slowed down, as far as their frames last.
    """
    times = recording.times
    duration = float(times[-1] - times[0])
    if recording.num_frames < 2 or duration <= 0.0:
        return recording, 1.0, 1.0
    slowest = recording.num_frames / 10.0 / duration  # ten frames a second are the fewest that look like motion
    wanted = max(1, int(np.ceil(_SHORT / duration))) if duration < _SHORT else 1
    slow = max(1, min(wanted, int(slowest)))
    rate = (recording.num_frames - 1) / (duration * slow)
    every = max(1, int(np.ceil(rate / FRAMES_PER_SECOND - 1e-6)))
    shown = recording.take(range(0, recording.num_frames, every))
    return shown, rate / every, 1.0 / slow


def describe_speed(recording: Recording, speed: float) -> str:
    """``in real time``, ``4 times slower than real time``; for steps without a duration how many are shown a second."""
    if recording.control_dt is None:
        return f"{_STEPS_PER_SECOND * speed:.3g} steps per second"
    return "in real time" if speed == 1.0 else f"{1.0 / speed:.3g} times slower than real time"


def diameters(recording: Recording) -> np.ndarray:
    """Diameter of each particle's sphere [m], shape (num_particles,), so that those of a material fill their volume."""
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
    """Median distance of some points to the nearest other one."""
    if len(points) < 2:
        return default
    some = np.random.default_rng(0).permutation(len(points))[:256]
    square = ((points[some, None] - points[None]) ** 2).sum(-1)
    square[np.arange(len(some)), some] = np.inf
    return max(float(np.sqrt(np.median(square.min(axis=1)))), 0.25 * default)


__all__ = ["FRAMES_PER_SECOND", "Recording", "describe_speed", "diameters", "playback"]
