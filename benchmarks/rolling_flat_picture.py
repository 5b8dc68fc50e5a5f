"""The README's picture: moments of an episode of the RollingFlat policy that comes with rewax.

python benchmarks/rolling_flat_picture.py --out docs/pictures/rolling_flat.png
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import numpy as np
from PIL import Image

from rewax.training import enable_compilation_cache, record
from rewax.training.storage.policies import open_run
from rewax.viz.recording import Recording
from rewax.viz.render import pictures

MOMENTS = (0, 20, 40)
"""Frames, one for each control step."""
SIZE = (300, 400)
_CAMERA = {"zoom": 1.2, "follow": True, "elevation": 30.0}


def draw(recording: Recording, out: Path) -> None:
    """Write some frames side by side, dough as a surface."""
    shown = dataclasses.replace(recording, camera={**recording.camera, **_CAMERA}).take(MOMENTS)
    frames = list(pictures(shown, size=SIZE, renderer="software"))
    Image.fromarray(np.concatenate(frames, axis=1)).save(out, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("rolling_flat.png"))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    enable_compilation_cache()
    saved = open_run("RollingFlat", scale="small")
    env = getattr(saved.env, "unwrapped", saved.env)
    draw(record(env, saved.agent.policy, saved.train_state, jax.random.key(args.seed)), args.out)


if __name__ == "__main__":
    main()
