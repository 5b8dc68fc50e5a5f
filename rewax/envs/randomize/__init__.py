"""Domain randomisation by name: every episode draws parameters of the environment from distributions."""

from rewax.envs.randomize.distributions import (
    Choice,
    Constant,
    Distribution,
    LogUniform,
    Normal,
    Per,
    Scale,
    Shift,
    Uniform,
)
from rewax.envs.randomize.hooks import Draw, LeafDraws, hook, leaves

__all__ = [
    "Choice", "Constant", "Distribution", "Draw", "LeafDraws", "LogUniform", "Normal", "Per", "Scale", "Shift",
    "Uniform", "hook", "leaves",
]  # fmt: skip
