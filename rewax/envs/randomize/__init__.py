"""Domain randomisation by name: every episode draws parameters of the environment from distributions."""

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
    Uniform,
)
from rewax.envs.randomize.hooks import Draw, LeafDraws, hook, leaves, with_numbers

__all__ = [
    "Choice", "Constant", "Distribution", "Draw", "LeafDraws", "LogNormal", "LogUniform", "Normal", "Per", "Scale",
    "Shift", "Uniform", "hook", "leaves", "with_numbers",
]  # fmt: skip
