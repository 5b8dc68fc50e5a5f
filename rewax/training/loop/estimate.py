"""Estimates of speed, time and memory of a run on a CPU, before its program is compiled."""

from typing import Any

import jax

from rewax.agents.config import steps_in
from rewax.envs.base import Env
from rewax.training.loop.progress import duration

_PER_CORE = {True: 0.9e6, False: 4e6}
"""Particle-substeps per second and core, with and without the gradient (docs/measured/benchmarks.md)."""


def cost_sentence(env: Env, agent_config: Any, num_steps: int) -> str:
    """Memory and hours that a run of a task with particles takes on a CPU, roughly; empty on an accelerator.

    On other tasks: a sentence that says where the speed will stand.

    Args:
      env: unbatched environment.
      agent_config: of the algorithm.
      num_steps: control steps of all environments.
    """
    if jax.default_backend() != "cpu":
        return ""
    from rewax.physics import mpm

    inner: Any = getattr(env, "unwrapped", env)
    particles = isinstance(getattr(inner, "scene", None), mpm.MPMScene)
    if not (particles and all(hasattr(inner, name) for name in ("rest_positions", "num_substeps"))):
        return "the first progress line says how long the run takes on this CPU"

    count = inner.rest_positions.shape[0]
    differentiated = getattr(agent_config, "differentiate", "none") != "none"
    speed = _PER_CORE[differentiated] * jax.device_count() / (count * inner.num_substeps)
    hours = duration(num_steps / speed)
    text = f"about {speed:.3g} control steps a second on {jax.device_count()} cores, {hours} for all {num_steps:,}"
    if not differentiated:
        return text
    peak = mpm.predict_peak_bytes(
        inner.scene,
        num_particles=count,
        num_substeps=inner.num_substeps,
        num_envs=agent_config.num_envs,
        horizon=getattr(agent_config, "differentiated_steps", lambda env: steps_in(agent_config, env))(env),
    )
    return f"{text}; about {peak / 1e9:.2g} GB of memory for the gradient"


__all__ = ["cost_sentence"]
