"""Trained policies in the package, one per task and scale: an .npz file with weights, and a card (JSON).

The .npz file holds those leaves of a training state that ``Agent.policy`` reads. ``load_policy`` puts them into a
training state whose other leaves (optimizers, critics, environments) are None, so code for runs takes a policy too.
"""

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rewax.agents.registry import algorithm, build_agent
from rewax.envs import registry
from rewax.envs.base import Env
from rewax.envs.memory import stage
from rewax.training.storage.description import plain
from rewax.training.storage.leaves import from_numpy, named_leaves, to_numpy
from rewax.training.storage.saved import SavedRun, agent_config, load_run

FOLDER = Path(__file__).resolve().parents[2] / "policies"
"""Folder in the package with ``<env>-<scale>.npz`` and ``<env>-<scale>.json``."""
_COUNTERS = (".iteration", ".env_steps")


def list_policies(folder: str | Path | None = None) -> list[tuple[str, str]]:
    """Tasks and scales with a trained policy, sorted: ``[("Ant", "small"), ...]``."""
    return sorted(
        (name, scale) for name, _, scale in (path.stem.rpartition("-") for path in _home(folder).glob("*-*.json"))
    )


def read_card(name: str, *, scale: str | None = None, folder: str | Path | None = None) -> dict[str, Any]:
    """The card of a policy: the command that trained it, its returns, the machine, the specs of the task.

    Args:
      name: of the task.
      scale: None: the one that suits the device, or the only one.
      folder: of the policies; None: that of the package.

    Raises:
      ValueError: there is none, and the message lists the policies that exist; or its card is damaged.
    """
    scales = [known for env, known in list_policies(folder) if env == name]
    if not scales or (scale is not None and scale not in scales):
        raise ValueError(_no_policy(name, scales, folder))
    if scale is None:
        scale = scales[0] if len(scales) == 1 else registry.default_scale()
    path = _home(folder) / f"{name}-{scale}.json"
    try:
        card: Any = json.loads(path.read_bytes())
    except ValueError:
        card = None
    if not _is_card(card):
        raise _damaged(path, folder)
    return card


def load_policy(
    name: str, *, scale: str | None = None, env: Env | None = None, folder: str | Path | None = None
) -> SavedRun:
    """A trained policy of a task, in the form that ``load_run`` returns for a run.

        run = rewax.load_policy("HandFlip")
        state = run.env.reset(jax.random.key(0))
        state = run.env.step(state, run.act(state.obs))

    Args:
      name: of the task, see ``list_policies()``.
      scale: ``"small"`` or ``"paper"``; None: the one that suits the device, or the only one.
      env: environment to act in, by default the task's; it must have the same observations and actions.
      folder: of the policies; None: that of the package.

    Returns:
      A run whose ``train_state`` holds the leaves that the policy reads; the others are None. ``config`` is the card.

    Raises:
      ValueError: in one sentence: there is none, a file of it is damaged, ``env`` is no environment, or the task has
        changed since it was trained.
    """
    if env is not None:
        registry.require_env(env)
    card = read_card(name, scale=scale, folder=folder)
    weights = _read_weights(_home(folder) / f"{card['env']}-{card['scale']}.npz", card, folder)
    env = registry.make(card["env"], scale=card["scale"], **card["env_kwargs"]) if env is None else env
    _check_task(card, env)
    known = algorithm(card["agent"])
    agent = build_agent(card["agent"], env, agent_config(known.config_type, card[card["agent"]]))
    like = jax.eval_shape(agent.init, jax.random.key(0))
    named = named_leaves(like)
    shapes = {key: leaf.shape for key, leaf in named}
    for key, value in weights.items():
        if shapes.get(key) != value.shape:
            raise ValueError(f"the policy of {name} does not fit this {card['agent']} ({key}): {_remedy(card)}")
    leaves = [from_numpy(weights[key], leaf, None) if key in weights else None for key, leaf in named]
    return SavedRun(env, agent, jax.tree.unflatten(jax.tree.structure(like), leaves), card)


def open_run(where: str | Path, *, step: int | None = None, scale: str | None = None) -> SavedRun:
    """A run from its directory, or the packaged policy of a task.

    Args:
      where: directory of a run, or name of a task.
      step: iteration of the run's checkpoint; by default the newest that can be read.
      scale: of the task; that of a run is known.

    Raises:
      ValueError: there is neither, or it cannot be loaded; one sentence.
    """
    if not is_policy(where):
        if Path(where).is_dir():
            run = load_run(where, step=step)
            if scale not in (None, of_run := run.config.get("scale")):
                raise ValueError(f"scale is {scale!r}, but {where} is a run at scale {of_run!r}: leave the scale out")
            return run
        raise ValueError(_no_policy(str(where), [], None))
    if step is not None:
        raise ValueError(f"step is {step}, but the policy of {where} is of one iteration: leave the step out")
    return load_policy(str(where), scale=scale)


def is_policy(where: str | Path) -> bool:
    """Whether ``open_run`` treats this as the name of a task; a directory with a checkpoint is a run."""
    if str(where) not in dict(list_policies()):
        return False
    from rewax.training.storage.checkpoint import latest_step  # orbax is slow to import

    return latest_step(where) is None


def save_policy(run: SavedRun, folder: str | Path, card: Mapping[str, Any]) -> Path:
    """Write the leaves that the policy of a run reads, and its card.

    Args:
      run: its environment must have been built by ``rewax.make``.
      folder: made if missing.
      card: further entries of the card.

    Returns:
      Path of the weights; the card is beside it.

    Raises:
      ValueError: the run's algorithm learns no policy of observations, but a sequence of actions.
    """
    if not run.looks:
        raise ValueError(f"{run.config['agent']} learns a sequence of actions, no policy: choose another algorithm")
    agent = run.config["agent"]
    stem = Path(folder) / f"{run.config['env']}-{run.config['scale']}"
    read = {*_leaves_read(run), *_COUNTERS}
    stem.parent.mkdir(parents=True, exist_ok=True)
    path = stem.with_name(f"{stem.name}.npz")
    np.savez(path, **{key: to_numpy(leaf) for key, leaf in named_leaves(run.train_state) if key in read})  # pyright: ignore[reportArgumentType]
    made = {name: run.config[name] for name in ("env", "scale", "agent", agent)}
    made |= {"env_kwargs": run.config.get("env_kwargs", {})}
    described = {**made, "task": _task(run.env), "crc32": zlib.crc32(path.read_bytes()), **card}
    stem.with_name(f"{stem.name}.json").write_text(json.dumps(plain(described), indent=1) + "\n")
    return path


def _leaves_read(run: SavedRun) -> set[str]:
    """Names of the leaves of the training state that the policy reads, sampled or deterministic."""
    obs = jax.eval_shape(stage(run.env, run.agent.policy).reset, jax.random.key(0)).obs

    def both(train_state: Any, obs: Any, key: Any) -> Any:
        return [run.agent.policy(train_state, obs, key, deterministic=chosen) for chosen in (False, True)]

    program = jax.make_jaxpr(both)(run.train_state, obs, jax.random.key(0)).jaxpr
    read = {id(variable) for equation in program.eqns for variable in equation.invars}
    # The training state's leaves are the first variables of the program.
    return {key for (key, _), v in zip(named_leaves(run.train_state), program.invars, strict=False) if id(v) in read}


def _task(env: Env) -> dict[str, Any]:
    """Properties of a task that must be those of the policy's training."""
    return {
        **{f"observation {name}": list(spec.shape) for name, spec in env.observation_spec.items()},
        "action": list(env.action_spec.shape),
        "steps of an episode": env.episode_length,
        "control step [s]": float(f"{float(getattr(env, 'control_dt', 0.0)):.6g}"),
    }


def _check_task(card: Mapping[str, Any], env: Env) -> None:
    then, now = card["task"], _task(env)
    for what in {**then, **now}:
        if then.get(what) != now.get(what):
            raise ValueError(
                f"{card['env']} has changed since its policy was trained: {what} was {then.get(what, 'absent')} and is "
                f"{now.get(what, 'absent')}: {_remedy(card)}"
            )


def _remedy(card: Mapping[str, Any]) -> str:
    return f"train another one, {card.get('command', 'rewax train')}, or use the version of rewax that it came with"


def _is_card(card: Any) -> bool:
    """Whether a card has the entries that ``load_policy`` reads."""
    if not isinstance(card, dict) or not all(isinstance(card.get(name), str) for name in ("env", "scale", "agent")):
        return False
    parts = (card.get("env_kwargs"), card.get("task"), card.get(card["agent"]))
    return isinstance(card.get("crc32"), int) and all(isinstance(part, dict) for part in parts)


def _damaged(path: Path, folder: str | Path | None) -> ValueError:
    remedy = "install rewax anew" if folder is None else "write it anew with save_policy"
    return ValueError(f"{path} is missing or damaged: {remedy}")


def _read_weights(path: Path, card: Mapping[str, Any], folder: str | Path | None) -> dict[str, np.ndarray]:
    if not path.is_file() or zlib.crc32(path.read_bytes()) != card["crc32"]:
        raise _damaged(path, folder)
    with np.load(path) as file:
        return {key: file[key] for key in file.files}


def _home(folder: str | Path | None) -> Path:
    return FOLDER if folder is None else Path(folder)


def _no_policy(name: str, scales: list[str], folder: str | Path | None) -> str:
    known = sorted({env for env, _ in list_policies(folder)})
    if scales:
        return f"there is no trained policy of {name} at another scale than {', '.join(scales)}: use that, or train one"
    if name in registry.list_envs():
        return (
            f"there is no trained policy of {name} yet: train one, rewax train --env {name}, and give the run's "
            f"directory, or use one of {', '.join(known)}"
        )
    return (
        f"{name!r} is neither the directory of a run nor a task with a trained policy: "
        f"{registry.did_you_mean(name, registry.list_envs())}give a run's directory, or one of {', '.join(known)}"
    )


__all__ = ["FOLDER", "is_policy", "list_policies", "load_policy", "open_run", "read_card", "save_policy"]
