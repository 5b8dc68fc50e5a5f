"""The command line that the examples share: environment, scale and every hyper-parameter, defaults from the presets."""

import argparse
import dataclasses
import logging
import math
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any

import tyro
from rich.console import Console

_CLEAN_EXIT, _FAILED_RUN, _BAD_INPUT = 0, 1, 2


def main(
    name: str,
    make_agent: Callable[[Any, Any], Any],
    preset: Callable[[str, str], Any],
    *,
    default_env: str = "RollingFlat",
    argv: Sequence[str] | None = None,
) -> int:
    """Train an agent as the command line says.

    Args:
      name: of the algorithm; prefix of its options (``--sapo.actor-lr``) and part of the run's description.
      make_agent: ``(env, agent_config) -> Agent``.
      preset: ``(env_name, scale) -> agent_config``, a frozen dataclass with num_envs, horizon and num_iterations.
      default_env: environment without ``--env``.
      argv: arguments, those of the process by default.

    Returns:
      Exit code: 0; 1 after a run that failed; 2 after a sentence about an input that cannot be; 128 + signal after an
      interruption.
    """
    quiet()
    argv = sys.argv[1:] if argv is None else list(argv)
    console = Console(highlight=False)
    try:
        return _run(name, make_agent, preset, default_env, argv, console)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return _BAD_INPUT
    except KeyboardInterrupt:  # before the loop listens for it
        return 128 + signal.SIGINT


def quiet() -> None:
    """Silence what libraries say on success, and warnings that users cannot act upon."""
    for noisy in ("absl", "orbax", "jax._src.xla_bridge"):
        logging.getLogger(noisy).setLevel(logging.ERROR)


def _run(name: str, make_agent: Any, preset: Any, default_env: str, argv: list[str], console: Console) -> int:
    from rewax.envs import registry
    from rewax.training.cache import enable_compilation_cache
    from rewax.training.config import ReportConfig, TrainConfig
    from rewax.training.loop import train
    from rewax.training.progress import say

    enable_compilation_cache()
    env_name, wanted_scale = _parse_env_and_scale(argv, default_env)
    scale = wanted_scale or registry.default_scale()
    env = registry.make(env_name, scale=scale)
    options = _options(name, env_name, scale, preset(env_name, scale), ReportConfig())
    args = tyro.cli(
        options, args=argv, prog=os.path.basename(sys.argv[0]), description=_description(name, env_name, scale)
    )

    agent_config, num_iterations = _length(getattr(args, name), args.steps)
    run_dir = args.run_dir or f"runs/{env_name}-{scale}-{args.seed}"
    report = {field.name: getattr(args.train, field.name) for field in dataclasses.fields(args.train)}
    config = TrainConfig(**report, num_iterations=num_iterations, run_dir=run_dir, seed=args.seed, resume=args.resume)
    say(console, _scale_sentence(scale, wanted_scale))
    say(console, f"{name} on {env_name}, seed {args.seed}, {num_iterations} iterations, in {run_dir}")
    describe = {"env": env_name, "scale": scale, "seed": args.seed, "agent": name, name: agent_config}
    result = train(make_agent(env, agent_config), env, config, describe=describe, console=console)
    if result.failure:  # said by the run
        return _FAILED_RUN
    return 128 + result.signum if result.signum else _CLEAN_EXIT


def _parse_env_and_scale(argv: list[str], default_env: str) -> tuple[str, str | None]:
    """Look ahead at what the other defaults depend on; ``--env X`` and ``--env=X``."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--env", default=default_env)
    parser.add_argument("--scale", default=None)
    try:
        known, _ = parser.parse_known_args(argv)
    except argparse.ArgumentError as error:
        raise ValueError(str(error)) from None
    return known.env, known.scale


def _options(name: str, env_name: str, scale: str, agent_config: Any, report: Any) -> type:
    """The dataclass that the command line fills, its defaults those of this environment and scale."""

    def nested(value: Any) -> Any:
        return dataclasses.field(default_factory=lambda: value)

    options = dataclasses.make_dataclass(
        "Options",
        [
            ("env", str, env_name),
            ("scale", str, scale),
            ("seed", int, 0),
            ("steps", int | None, None),
            ("run_dir", str | None, None),
            ("resume", tyro.conf.FlagCreatePairsOff[bool], False),
            (name, type(agent_config), nested(agent_config)),
            ("train", type(report), nested(report)),
        ],
        frozen=True,
        kw_only=True,
    )
    options.__doc__ = """Options.

    Attributes:
      env: name of the environment.
      scale: small (made for a CPU) or paper (the constants of the paper, for an accelerator); follows the device.
      seed: everything random follows from it.
      steps: environment steps in all, rounded up to whole iterations; by default what the preset says.
      run_dir: directory of the run; runs/<env>-<scale>-<seed> by default.
      resume: continue the run in run-dir from its newest checkpoint.
    """
    return options


def _description(name: str, env_name: str, scale: str) -> str:
    return f"Train {name} on {env_name}. Defaults shown are those of --env {env_name} --scale {scale}."


def _length(agent_config: Any, steps: int | None) -> tuple[Any, int]:
    """The agent's configuration and number of iterations for so many environment steps."""
    if steps is None:
        return agent_config, agent_config.num_iterations
    if steps < 1:
        raise ValueError(f"steps is {steps}: use 1 or more")
    num_iterations = math.ceil(steps / (agent_config.num_envs * agent_config.horizon))
    return dataclasses.replace(agent_config, num_iterations=num_iterations), num_iterations


def _scale_sentence(scale: str, wanted: str | None) -> str:
    if wanted:
        return f"scale {scale}, as asked"
    other, found = ("paper", "no accelerator") if scale == "small" else ("small", "an accelerator")
    return f"scale {scale}, because JAX found {found}; choose the other with --scale {other}"
