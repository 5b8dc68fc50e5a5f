"""Recordings made by hand, for tests of pictures."""

import numpy as np

from rewax.viz.recording import Recording

BALL = {"kind": "sphere", "center": np.array([0.0, 0.5, 0.0]), "radius": 0.2}


def moving_ball(num_frames=5, travel=0.0, **options):
    """A ball over a ground at y = 0 that moves along x."""
    drawings = [
        [{"kind": "plane", "center": np.zeros(3), "direction": np.array([0.0, 2.0, 0.0])},
         {**BALL, "center": BALL["center"] + [travel * i, 0.0, 0.0]}]
        for i in range(num_frames)
    ]  # fmt: skip
    return made(num_frames, drawings=drawings, **options)


def cloud(num_frames=5, num_particles=60, travel=0.02, **options):
    """Particles of a cube of 0.4 m that move along x, half of them water, half dough."""
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (num_particles, 3)) + [0.0, 0.3, 0.0]
    steps = travel * np.arange(num_frames)[:, None, None] * np.array([1.0, 0.0, 0.0])
    options = {
        "particles": (points + steps).astype(np.float32),
        "materials": np.arange(num_particles) % 2,
        "material_names": ("water", "dough"),
        "values": {"speed": np.linspace(0.0, 1.0, num_frames * num_particles).reshape(num_frames, -1)},
        "floor": 0.0,
        **options,
    }
    return made(num_frames, **options)


def made(num_frames, **options):
    """A recording of a reward of 1 and no status, 20 ms a step."""
    return Recording(
        **{
            "steps": np.arange(num_frames),
            "rewards": np.ones(num_frames - 1),
            "status": np.zeros(num_frames - 1, int),
            "control_dt": 0.02,
            "name": "by hand",
            **options,
        }
    )
