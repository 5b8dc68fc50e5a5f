"""Domain randomisation by name: every episode draws parameters of the environment from distributions."""

from rewax.envs.randomize.cameras import camera
from rewax.envs.randomize.distributions import (
    Choice,
    Constant,
    Distribution,
    LogNormal,
    LogUniform,
    Normal,
    Per,
    Scale,
    Shift,
    Turn,
    Uniform,
)
from rewax.envs.randomize.hooks import Draw, LeafDraws, hook, leaves, with_numbers
from rewax.envs.randomize.stored import identified

__all__ = [
    "Choice", "Constant", "Distribution", "Draw", "LeafDraws", "LogNormal", "LogUniform", "Normal", "Per", "Scale",
    "Shift", "Turn", "Uniform", "camera", "hook", "identified", "leaves", "with_numbers",
]  # fmt: skip
