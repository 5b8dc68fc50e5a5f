"""``rewax train``: train an algorithm on an environment; defaults of all options come from the presets."""

import argparse
import contextlib
import ctypes
import dataclasses
import logging
import math
import os
import re
from collections.abc import Sequence
from typing import Annotated, Any, TypeAlias

import tyro
from rich.console import Console

from rewax.agents.config import steps_in
from rewax.agents.legal import NATURAL, Count, Legal, Natural, Seed, is_whole
from rewax.agents.registry import Algorithm, algorithm, build_agent
from rewax.cli.documented import option_group, with_options
from rewax.cli.env_from import env_and_scale, env_arguments, sentences
from rewax.cli.options import Imports, build_env, import_modules, parse
from rewax.envs.randomize.stored import read_result

_PROG = "rewax train"
_FAILED_RUN = 1
_MOST_SEEDS = 1024
_NumSeeds: TypeAlias = Annotated[
    int,
    Legal(
        f"give an integer from 1 to {_MOST_SEEDS}, and start several commands for more",
        lambda v: is_whole(v) and 1 <= v <= _MOST_SEEDS,
    ),
]
_OPTION = re.compile(r"^--[^=]+")


def run(argv: Sequence[str]) -> int:
    """Train an agent.

    Args:
      argv: arguments after ``train``.

    Returns:
      Exit code: 0; 1 after a run that failed; 128 + signal after an interruption.

    Raises:
      ValueError: an error in the input; one sentence.
    """
    from rewax.fixed_sources import build_ahead
    from rewax.training.loop.estimate import cost_sentence
    from rewax.training.loop.progress import say
    from rewax.training.loop.seeds import train_seeds
    from rewax.training.loop.train import train
    from rewax.training.storage.cache import enable_compilation_cache

    build_ahead(transfers=False)  # the compiler works while Python imports
    keep_freed_memory()
    quiet()
    console = Console(highlight=False)
    enable_compilation_cache()
    first = _look_ahead(argv)
    _set_devices(first, console)
    if first.env_from and first.env is None:  # names the run directory
        first.env = (read_result(first.env_from)["made_by"] or {}).get("env")
    modules = import_modules(first.imports) or _recorded_modules(first)
    chosen = algorithm(first.algo)
    use = "values" if first.env_from_values else "draws"
    made_by = env_arguments(first.env, first.scale, first.env_from, use, _recorded(first))
    first.env, scale = made_by.env, made_by.scale
    kwargs = {**made_by.kwargs, **_sensor_arguments(first)}
    env: Any = build_env(first.env, scale, **kwargs)
    preset = _preset(first, scale, chosen)
    options = _options(first, scale, preset)
    args: Any = parse(options, argv, prog=_PROG, description=_description(first.algo, first.env, scale))
    if args.num_seeds > 1 and args.distributed:
        raise ValueError(f"num-seeds is {args.num_seeds}: with --distributed train one seed, and start a run for each")

    given = with_options(preset, getattr(args, first.algo))
    if args.steps is not None and given.num_iterations != preset.num_iterations:
        raise ValueError(f"--steps and --{first.algo}.num-iterations both say how long to train: give one of them")
    agent_config, num_iterations, num_steps = _length(given, env, args.steps)
    say(console, _scale_sentence(scale, first.scale or first.env_from))
    if "identified" in kwargs:
        for sentence in sentences(env.env if kwargs.get("sensors") else env, kwargs["identified"]):
            say(console, sentence)
    if kwargs.get("sensors"):
        observed = ", ".join(f"{name} {spec.shape}" for name, spec in env.observation_spec.items())
        say(console, f"observations: {observed}; --{first.algo}.observe chooses those of the policy")
    if scale == "paper" and (cost := cost_sentence(env, agent_config, num_steps)):
        say(console, cost)
    configs = _configs(args, first, scale, num_iterations, num_steps)
    for config in configs:
        say(
            console,
            f"{first.algo} on {first.env}, seed {config.seed}, {num_iterations} iterations, in {config.run_dir}",
        )
    describe = {"env": first.env, "scale": scale, "agent": first.algo, first.algo: agent_config}
    if modules:
        describe["imports"] = modules
    if kwargs:
        describe["env_kwargs"] = kwargs
    build_ahead(transfers=hasattr(getattr(env, "unwrapped", env), "particles"))
    agent = build_agent(first.algo, env, agent_config)
    if args.num_seeds == 1:
        results = [train(agent, env, configs[0], describe={**describe, "seed": args.seed}, console=console)]
    else:
        results = train_seeds(agent, env, configs, describe=describe, console=console)
    if any(result.failure for result in results):  # the run has printed it
        return _FAILED_RUN
    signum = max(result.signum for result in results)
    return 128 + signum if signum else 0


def _set_devices(first: Any, console: Console) -> None:
    """Make CPU cores devices, and join the other processes of a distributed run."""
    from rewax.training.loop.hosts import connect, leads, num_processes

    NATURAL.check("devices", first.devices)
    if first.distributed:
        cores_as_devices(first.devices // (num_processes() or 1))
        connect()
        console.quiet = not leads()
    else:
        cores_as_devices(first.devices)


def _configs(args: Any, first: Any, scale: str, num_iterations: int, num_steps: int) -> list[Any]:
    """The configuration of each seed's run."""
    from rewax.training.config import TrainConfig

    report = {field.name: getattr(args.train, field.name) for field in dataclasses.fields(args.train)}
    return [
        TrainConfig(
            **report,
            num_iterations=num_iterations,
            num_steps=num_steps,
            run_dir=_run_dir(args, first.env, first.algo, scale, seed),
            seed=seed,
            resume=args.resume,
            init_from=args.init_from,
            devices=args.devices,
        )
        for seed in range(args.seed, args.seed + args.num_seeds)
    ]


def _run_dir(args: Any, env: str, algo: str, scale: str, seed: int) -> str:
    """Directory of a seed's run; its name has the algorithm unless that is SAPO."""
    if args.run_dir:
        return args.run_dir if args.num_seeds == 1 else f"{args.run_dir}/{seed}"
    return f"runs/{env}-{scale}{'' if algo == 'sapo' else f'-{algo}'}-{seed}"


def cores_as_devices(num_devices: int = 0) -> None:
    """Make the cores of a CPU devices of JAX, each of which computes a few environments.

    This has an effect only before JAX computes anything, and none on an accelerator.

    Args:
      num_devices: number of devices; 0: all cores.
    """
    import jax

    with contextlib.suppress(RuntimeError):  # JAX has begun to compute
        jax.config.update("jax_num_cpu_devices", num_devices or os.cpu_count() or 1)


def keep_freed_memory() -> None:
    """Let glibc keep up to 512 MB of freed memory, on a system that has glibc.

    XLA allocates the temporary arrays of a program at every call. By default glibc maps those above 32 MB anew each
    time, and writing a fresh page costs a page fault: 6 % of the time of RollingFlat's train step.
    """
    trim_threshold, mmap_threshold = -1, -3  # malloc.h
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        for option in (trim_threshold, mmap_threshold):
            ctypes.CDLL(None).mallopt(option, 2**29)


def quiet() -> None:
    """Silence libraries' messages of success, and warnings without a remedy for users."""
    for noisy in ("absl", "orbax", "jax._src.xla_bridge"):
        logging.getLogger(noisy).setLevel(logging.ERROR)


def _look_ahead(argv: Sequence[str]) -> Any:
    """Options that the defaults of the others depend on: ``env``, ``scale``, ``algo``, ``imports`` and so on.

    As everywhere, their names may have ``_`` instead of ``-``.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--env", default=None)
    parser.add_argument("--env-from", default="")
    parser.add_argument("--env-from-values", action="store_true")
    parser.add_argument("--sensors", nargs="*", default=None)
    parser.add_argument("--resolution", type=int, default=None)
    parser.add_argument("--scale", default=None)
    parser.add_argument("--algo", default="sapo")
    parser.add_argument("--devices", type=int, default=0)
    parser.add_argument("--distributed", action="store_true")
    parser.add_argument("--import", dest="imports", action="append", default=[])
    parser.add_argument("--run-dir", default=None)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--num-seeds", type=int, default=1)
    parser.add_argument("--resume", action="store_true")
    try:
        known, _ = parser.parse_known_args([_OPTION.sub(lambda name: name[0].replace("_", "-"), word) for word in argv])
    except argparse.ArgumentError as error:
        raise ValueError(f"{error}; {_PROG} --help lists the options") from None
    return known


def _sensor_arguments(first: Any) -> dict[str, Any]:
    """Arguments of ``rewax.make`` for the sensors of the command line; a resumed run keeps its own."""
    if first.sensors == []:
        raise ValueError("--sensors stands without names: give some, for example --sensors camera")
    if first.resolution is not None and not first.sensors:
        raise ValueError("--resolution is that of sensors: name them, for example --sensors camera")
    if not first.sensors:
        return {}
    size = {} if first.resolution is None else {"resolution": first.resolution}
    return {"sensors": list(first.sensors), **size}


def _preset(first: Any, scale: str, chosen: Algorithm) -> Any:
    """The algorithm's configuration for this environment and scale."""
    config = chosen.preset(first.env, scale)
    if not isinstance(config, chosen.config_type):
        raise ValueError(f"the preset of {first.algo} returned {config!r}: return a {chosen.config_type.__name__}")
    return config


def _recorded_modules(first: Any) -> list[dict[str, str]]:
    """The modules that the run to be resumed was started with; they are imported."""
    from rewax.training.storage.modules import import_recorded

    if stored := _recorded(first):
        import_recorded(stored, first.run_dir or "the run")
    return stored.get("imports", [])


def _recorded(first: Any) -> dict[str, Any]:
    """``config.json`` of the run to be resumed; empty for a new run."""
    from rewax.training.storage.description import read_config

    if not first.resume:
        return {}
    if first.run_dir and not os.path.isdir(first.run_dir):
        raise ValueError(f"there is no run directory {first.run_dir}: check the path, or start a new run there")
    env, scale = env_and_scale(first.env, first.scale, first.env_from)
    return read_config(_run_dir(first, env, first.algo, scale, first.seed))


def _options(first: Any, scale: str, agent_config: Any) -> type:
    """The dataclass that the command line fills; its defaults are those of this environment, scale and algorithm."""
    from rewax.training.config import ReportConfig

    def nested(value: Any) -> Any:
        return dataclasses.field(default_factory=lambda: value)

    group, report = option_group(agent_config), option_group(ReportConfig(eval_at_start=not _is_slow(scale)))
    options = dataclasses.make_dataclass(
        "Options",
        [
            ("env", str, first.env),
            ("scale", str, scale),
            ("env_from", str, ""),
            ("env_from_values", tyro.conf.FlagCreatePairsOff[bool], False),
            ("sensors", tuple[str, ...], ()),
            ("resolution", Count | None, None),
            ("algo", str, first.algo),
            ("imports", Imports, ()),
            ("seed", Seed, 0),
            ("num_seeds", _NumSeeds, 1),
            ("steps", Count | None, None),
            ("run_dir", str | None, None),
            ("resume", tyro.conf.FlagCreatePairsOff[bool], False),
            ("init_from", str, ""),
            ("devices", Natural, 0),
            ("distributed", tyro.conf.FlagCreatePairsOff[bool], False),
            (first.algo, type(group), nested(group)),
            ("train", type(report), nested(report)),
        ],
        frozen=True,
        kw_only=True,
    )
    options.__doc__ = """Options.

    Attributes:
      env: name of the environment.
      scale: small (made for a CPU) or paper (the constants of the paper, for an accelerator); follows the device.
      env_from: JSON file of rewax identify: the environment draws the parameters that it found, with their
        uncertainty, at every reset; env, scale and num_substeps are those of the fit unless given.
      env_from_values: take the values found instead of draws.
      sensors: names of sensors whose observations are added, camera or cloud for example; rewax envs NAME lists them.
      resolution: pixels along each side of their pictures, by default 64.
      algo: name of the algorithm.
      imports: module or .py file that registers environments or algorithms.
      seed: of all random numbers of the run.
      num_seeds: number of seeds, from --seed on, batched in one program, with a run directory for each.
      steps: total number of control steps, rounded up to whole iterations; by default that of the preset.
      run_dir: directory of the run, by default runs/<env>-<scale>[-<algo>]-<seed>.
      resume: continue the run in run-dir from its newest checkpoint.
      init_from: directory of a run of the same algorithm: start with its networks, temperature and statistics.
      devices: number of devices (on a CPU: cores) that the environments, or several seeds, are sharded over; 0: the
        largest number that divides their number.
      distributed: train with several processes, on one machine or many; each is started with this command and
        JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID, or by Slurm or MPI.
    """
    return options


def _is_slow(scale: str) -> bool:
    """Whether an evaluation takes many minutes, so that the first one waits for some training."""
    import jax

    return scale == "paper" and jax.default_backend() == "cpu"


def _description(name: str, env_name: str, scale: str) -> str:
    return f"Train {name} on {env_name}. Defaults shown are those of --env {env_name} --scale {scale}."


def _length(agent_config: Any, env: Any, steps: int | None) -> tuple[Any, int, int]:
    """The agent's configuration, the number of iterations and of control steps; ``steps`` overrides the preset."""
    per_iteration = agent_config.num_envs * steps_in(agent_config, env)
    if steps is None:
        return agent_config, agent_config.num_iterations, agent_config.num_iterations * per_iteration
    num_iterations = math.ceil(steps / per_iteration)
    return dataclasses.replace(agent_config, num_iterations=num_iterations), num_iterations, steps


def _scale_sentence(scale: str, wanted: str | None) -> str:
    if wanted:
        return f"scale {scale}, as asked"
    other, found = ("paper", "no accelerator") if scale == "small" else ("small", "an accelerator")
    return f"scale {scale}, because JAX found {found}; choose the other with --scale {other}"


__all__ = ["quiet", "run"]
