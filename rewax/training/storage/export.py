"""Trained policies for programs without rewax: StableHLO for JAX and XLA, and weights for NumPy."""

import json
import shutil
from pathlib import Path
from typing import Any

import flatbuffers  # noqa: F401 (jax.export needs it to serialize)
import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from rewax.agents.actor_critic import Actor, make_actor
from rewax.agents.config import AnyPolicyConfig
from rewax.agents.normalization import EPSILON
from rewax.agents.registry import algorithm
from rewax.envs.memory import MEMORY, remembered
from rewax.training.storage import numpy_policy
from rewax.training.storage.saved import SavedRun, agent_config
from rewax.types import Array, Observation
from rewax.whole_files import replacing

PLATFORMS = ("cpu", "cuda")


def export_policy(run: SavedRun, out: str | Path) -> list[Path]:
    """Write ``policy.stablehlo``, ``weights.npz`` with ``numpy_policy.py``, and their description ``policy.json``.

    Both policies compute ``action = tanh(mean(obs) + std(obs) * noise)`` and include the normalisation of the
    observations. Zero noise gives the deterministic action, standard normal noise a sampled one. ``policy.stablehlo``
    takes a batch of any size, on a CPU and on an NVIDIA GPU:

        # pip install jax flatbuffers; rewax is not needed
        exported = jax.export.deserialize(bytearray(Path("policy.stablehlo").read_bytes()))
        action = exported.call(obs, noise)        # with a leading axis of environments

    A policy with memory takes the memory too, zeros of shape (b, size) at first, and returns the next one:

        action, memory = exported.call(obs, noise, memory)

    Args:
      run: from ``load_run``.
      out: folder, made if missing. Each file appears once it is complete.

    Returns:
      Paths of the files.

    Raises:
      ValueError: the algorithm has no policy of ``make_actor``.
    """
    actor, params = _actor(run), run.train_state.actor_params
    statistics = run.train_state.environments.statistics
    out = Path(out)

    def action(obs: Observation, noise: Array, *memory: Array) -> Any:
        obs = {**obs, MEMORY: memory[0]} if memory else obs
        distribution, new = actor.decide(params, actor.normalize(statistics, obs))
        moved = remembered(jnp.tanh(distribution.mean + jnp.exp(distribution.log_std) * noise), new)
        return tuple(moved) if memory else moved

    (batch,) = export.symbolic_shape("b")
    shapes = _observed(actor)
    obs = {name: jax.ShapeDtypeStruct((batch, *shape), jnp.float32) for name, shape in shapes.items()}
    noise = jax.ShapeDtypeStruct((batch, actor.action_size), jnp.float32)
    size = actor.config.memory
    memory = [jax.ShapeDtypeStruct((batch, size), jnp.float32)] if size else []
    exported = export.export(jax.jit(jax.vmap(action)), platforms=PLATFORMS)(obs, noise, *memory)
    described = _description(run, actor)
    files = {name: out / name for name in ("policy.stablehlo", "weights.npz", "numpy_policy.py", "policy.json")}
    weights = _weights(actor, params, statistics)
    with replacing(files["policy.stablehlo"]) as unfinished:
        unfinished.write_bytes(exported.serialize())
    with replacing(files["weights.npz"]) as unfinished:
        np.savez(unfinished, describes=json.dumps(described), **weights)  # pyright: ignore[reportArgumentType]
    with replacing(files["numpy_policy.py"]) as unfinished:
        shutil.copyfile(numpy_policy.__file__, unfinished)
    with replacing(files["policy.json"]) as unfinished:
        unfinished.write_text(json.dumps(described, indent=1) + "\n")
    return list(files.values())


def _actor(run: SavedRun) -> Actor:
    config = run.config[run.config["agent"]]
    config = agent_config(algorithm(run.config["agent"]).config_type, config)
    if not isinstance(config, AnyPolicyConfig) or not hasattr(run.train_state, "actor_params"):
        raise ValueError(
            f"{run.config['agent']} has no policy of rewax.agents.actor_critic.make_actor, and no other can be "
            "exported: train with another algorithm, or read what it learns from load_run(run).train_state"
        )
    return make_actor(run.env, config)


def _observed(actor: Actor) -> dict[str, tuple[int, ...]]:
    """Shapes of the policy's observations, by name."""
    spec = actor.observation_spec
    return {name: spec[name].shape for name in actor.config.observe or spec}


def _description(run: SavedRun, actor: Actor) -> dict[str, Any]:
    return {
        "agent": run.config["agent"],
        "env": run.config.get("env"),
        "scale": run.config.get("scale"),
        "iteration": int(run.train_state.iteration),
        "observation": {name: list(shape) for name, shape in _observed(actor).items()},
        "action_size": actor.action_size,
        "memory": actor.config.memory,
        "activation": actor.config.activation,
        "log_std_range": list(actor.config.log_std_range),
        "observation_clip": actor.config.observation_clip,
    }


def _weights(actor: Actor, params: Any, statistics: Any) -> dict[str, np.ndarray]:
    """Parameters by path, and the mean and scale of each normalised observation."""
    leaves = jax.tree.leaves_with_path(params["params"])
    weights = {"/".join(str(part.key) for part in path): np.asarray(leaf) for path, leaf in leaves}
    if actor.config.normalize_observations:
        for name, mean in statistics.mean.items():
            weights[f"mean_of/{name}"] = np.asarray(mean)
            weights[f"scale_of/{name}"] = np.asarray(1.0 / np.sqrt(np.asarray(statistics.variance[name]) + EPSILON))
    return weights


__all__ = ["export_policy"]
