"""``rewax record``: what a camera sees while a script or a policy moves an environment's tool."""

import dataclasses
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import tyro

from rewax.agents.legal import Count, Natural, Seed
from rewax.cli.options import Imports, build_env, import_modules, parse
from rewax.cli.train import quiet
from rewax.envs.registry import recipe
from rewax.whole_files import check_can_write

Settings: TypeAlias = tyro.conf.UseAppendAction[
    Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="PARAMETER=VALUE")]
]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      env: name of the environment, see ``rewax envs``.
      scale: ``small`` or ``paper``; by default that of the run of ``policy``, else ``small``.
      out: file of the record, .npz.
      action: this action in all steps; one number for each component.
      script: CSV file without a heading, one action in a row, instead of --action.
      policy: directory of a run or name of a task with a packaged policy, instead of both.
      steps: control steps, with --action or --policy.
      every: control steps between two frames.
      points: largest number of points of a cloud.
      noise: standard deviation of depth [m].
      occlusion: share of the seen body that is hidden.
      settings: value of a physical parameter, repeated. youngs_modulus stands for the one parameter whose name ends so.
      num_substeps: substeps of a control step; 0: those of the environment.
      seed: of the reset, noise and occlusion.
      imports: module or .py file that registers environments.
    """

    env: str
    scale: str | None = None
    out: str = "record.npz"
    action: tuple[float, ...] = ()
    script: str | None = None
    policy: str | None = None
    steps: Count = 12
    every: Count = 1
    points: Count = 256
    noise: float = 0.0
    occlusion: float = 0.0
    settings: Settings = ()
    num_substeps: Natural = 0
    seed: Seed = 0
    imports: Imports = ()


def run(argv: Sequence[str]) -> int:
    """Write a record and print what it holds.

    Raises:
      ValueError: there is no such environment, parameter, script or policy, an action has another size, or there would
        be no second frame.
    """
    import jax

    from rewax.identify import record, save
    from rewax.training.evaluation.sweep import read_grid, with_parameters
    from rewax.training.storage.cache import enable_compilation_cache
    from rewax.training.storage.policies import open_run

    quiet()
    options = parse(Options, argv, prog="rewax record", description="Record what a camera sees of an environment.")
    enable_compilation_cache()
    import_modules(options.imports)
    saved = open_run(options.policy, scale=options.scale) if options.policy else None
    scale = options.scale or (saved.config.get("scale") if saved else None) or "small"
    env = task(options.env, scale, options.num_substeps, _sensors(saved))
    if not callable(getattr(env, "particles", None)) or not callable(getattr(env, "world", None)):
        raise ValueError(f"{options.env} has no soft body that a camera could see: choose a task on soft bodies")
    check_can_write(options.out)
    grid = read_grid(options.settings, env)
    if several := [name for name, numbers in grid.items() if len(numbers) > 1]:
        raise ValueError(f"--set gives {several[0]} {len(grid[several[0]])} values: a record has one, so give one")
    values = {name: number for name, (number,) in grid.items()}
    moved = with_parameters(env, values) if values else env
    script = _script(options, env, saved)
    steps = len(script) if saved is None else options.steps
    if options.every > steps:
        raise ValueError(f"--every is {options.every} with {steps} steps: give at most {steps}, for a second frame")
    made = record(
        moved, script, jax.random.key(options.seed), num_steps=options.steps, every=options.every,
        noise=options.noise, occlusion=options.occlusion, num_points=options.points,
        source=json.dumps({**(recipe(env) or {}), "values": values}),
    )  # fmt: skip
    path = save(made, options.out)
    print(
        f"wrote {path}: {made.num_frames} frames over {made.times[-1]:.4g} s, {made.mask.sum(1).min()} to "
        f"{made.mask.sum(1).max()} points each"
    )
    return 0


def task(name: str, scale: str, num_substeps: int, sensors: Mapping[str, Any] | None = None) -> Any:
    """A registered environment with a number of substeps, 0 for its own, and with sensors."""
    return build_env(name, scale, **({"num_substeps": num_substeps} if num_substeps else {}), **(sensors or {}))


def _sensors(saved: Any) -> dict[str, Any]:
    """Arguments of ``rewax.make`` for the sensors that a policy observes."""
    kwargs = {} if saved is None else saved.config.get("env_kwargs", {})
    return {name: kwargs[name] for name in ("sensors", "resolution") if name in kwargs}


def _script(options: Options, env: Any, saved: Any) -> Any:
    """Actions, shape (num_steps, num_actions), or a policy ``(state, key) -> action``."""
    given = [name for name in ("action", "script", "policy") if getattr(options, name)]
    if len(given) != 1:
        raise ValueError("give one of --action, --script and --policy: what moves the tool")
    size = env.action_spec.shape[0]
    if saved is not None:
        theirs, ours = ({name: one.shape for name, one in each.observation_spec.items()} for each in (saved.env, env))
        needed = getattr(saved.agent.config, "observe", ()) or theirs
        if other := [f"{name} {theirs[name]}" for name in needed if ours.get(name) != theirs[name]]:
            raise ValueError(
                f"the policy of {options.policy!r} observes {', '.join(other)}, which {options.env} does not: give the "
                "--env and --scale that it was trained in, and --import its module"
            )
        memory = saved.initial_memory
        if memory is None:
            return lambda state, key: saved.act(state.obs)

        def acting(state: Any, key: Any) -> Any:
            nonlocal memory
            action, memory = saved.act(state.obs, memory=memory)
            return action

        return acting
    if options.script:
        path = Path(options.script)
        if not path.is_file():
            raise ValueError(f"there is no script {options.script!r}: give a CSV file with one action in a row")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a file without rows
                actions = np.loadtxt(path, delimiter=",", ndmin=2)
        except ValueError as error:
            raise ValueError(f"{options.script!r} holds no rows of numbers: {error}") from None
        if not actions.size:
            raise ValueError(f"{options.script!r} holds no rows: give one action in a row")
    else:
        actions = np.tile(np.asarray(options.action, float), (options.steps, 1))
    if actions.shape[1] != size:
        raise ValueError(f"an action has {actions.shape[1]} numbers, but {options.env} takes {size}: give those")
    return actions.astype(np.float32)


__all__ = ["Options", "run", "task"]
