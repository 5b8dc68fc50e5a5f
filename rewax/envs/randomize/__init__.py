"""Domain randomisation by name: leaves of an environment drawn from distributions, anew for every episode."""

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
