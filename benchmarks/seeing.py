"""Policies that see: returns of policies from depth beside those from the state, and what noise, latency and pose cost.

    python benchmarks/seeing.py                                         # everything: many hours on two cores
    python benchmarks/seeing.py --tasks RollingFlat --columns depth state --seeds 0
    python benchmarks/seeing.py --table                                 # the tables of the rows that are there
    python benchmarks/seeing.py --keep runs/seeing --film depth.mp4 --tasks RollingFlat --columns depth --seeds 0

Each cell (task, column, seed) trains one policy at scale ``small`` and evaluates 64 episodes with deterministic actions
from the same starts. Its rows are written when it is finished, and finished cells are skipped. Columns:

    state          SAPO, all observations of the task
    depth          SAPO, depth of 64 x 64 pixels and joints; the critics observe the state
    depth close    as ``depth``, with a field of view of 26 degrees instead of 40
    depth slow     as ``depth``, with half of the actor's learning rate
    depth alone    as ``depth``, and the critics observe the same as the policy
    blind          SAPO, joints alone; the critics observe the state
    cloud          SAPO, 64 visible points of the soft body (of SteerFloat's float, without the water), and joints;
                   the critics observe the state
    ppo            PPO from depth with as many control steps as SAPO (GripperLift: 7 % fewer); the critic observes the
                   state
    ppo x10        the same with ten times as many
    varied         as ``depth``, trained with noise, latency, and a camera that is moved in each episode

``depth`` and ``varied`` are evaluated at the ends of the ranges too: noise, latency and pose alone and all together.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rows import append, mean, read
from trained import trained

import rewax
from rewax import struct
from rewax.agents.ppo import make_ppo
from rewax.agents.presets import ppo_preset, sapo_preset
from rewax.agents.sapo import make_sapo
from rewax.envs import Randomized
from rewax.envs.latency import Latency
from rewax.envs.named_sensors import default_camera
from rewax.envs.randomize import Choice, Constant, Per, Shift, Turn, Uniform, camera, hook
from rewax.envs.sensing import Sensing
from rewax.envs.wrappers import _Wrapper
from rewax.sensors import Camera, DepthCloud, DepthNoise
from rewax.training import enable_compilation_cache, make_evaluate, record
from rewax.training.storage import checkpoint
from rewax.training.storage.description import provenance
from rewax.viz.player import write_player
from rewax.viz.video import record_video

COLUMNS = ("depth", "state", "depth close", "depth slow", "depth alone", "blind", "cloud", "ppo", "ppo x10",
           "varied")  # fmt: skip
JOINTS = {"RollingFlat": ("joint_q", "joint_qd"), "SteerFloat": ("robot",), "GripperLift": ("joints",),
          "HandLift": ("joint_q",)}  # fmt: skip
"""What each robot feels of itself. ``robot`` of SteerFloat: joints, and the mark, which no camera sees."""
NOISE, DROPOUT = 0.004, 0.05
"""Largest standard deviation of depth [m], largest share of lost pixels [-]."""
LATENCY = {"observation": 2, "action": 1}
"""Longest delays [control steps]."""
POSITION, ROTATION = 0.01, 0.03
"""How far each coordinate of the camera is moved [m], and how far it is turned about each axis [rad]."""
ENDS = ("nominal", "noise", "latency", "pose", "all")
FIELDS = ("task", "column", "seed", "at", "return", "std", "seconds", "env_steps", "commit", "processor")
EPISODES = 64


@struct.dataclass
class Told(_Wrapper):
    """SteerFloat, whose robot is told its joints and the mark: no quantity of the float."""

    def reset(self, key: Any) -> Any:
        return self._told(self.env.reset(key))

    def step(self, state: Any, action: Any) -> Any:
        own = {name: value for name, value in state.obs.items() if name != "robot"}
        return self._told(self.env.step(state.replace(obs=own), action))

    @property
    def observation_spec(self) -> dict[str, Any]:
        return {**self.env.observation_spec, "robot": rewax.ArraySpec((8,))}

    def _told(self, state: Any) -> Any:
        vector = state.obs["vector"]
        mark = vector[14:16] + vector[jnp.array([0, 2])]
        return state.replace(obs={**state.obs, "robot": jnp.concatenate([vector[8:14], mark])})


def task_of(name: str) -> Any:
    env = rewax.make(name, scale="small")
    return Told(env=env) if name == "SteerFloat" else env


def inner(env: Any) -> Any:
    """The task itself, without ``Told``."""
    return getattr(env, "unwrapped", env)


def seeing(env: Any, seen: Camera, column: str) -> Any:
    """The task with the sensor of a column."""
    if column in ("state", "blind"):
        return env
    if column == "cloud":
        world = inner(env).world(env.reset(jax.random.key(0)).physics, np.asarray(inner(env).up))
        soft = tuple(name for balls in world.balls for name in balls.names if name != "water")
        return Sensing(env=env, sensors={"cloud": DepthCloud(camera=seen, num_points=64, of=soft)})
    if column == "depth close":
        seen = seen.replace(field_of_view=26.0)
    if column == "varied":
        seen = seen.replace(noise=DepthNoise(constant=0.0, dropout=0.0))
    sensing = Sensing(env=env, sensors={"depth": seen})
    if column != "varied":
        return sensing
    ranges = {name: (0, steps) for name, steps in LATENCY.items()}
    return Latency(env=sensing, of=("depth",), **ranges)


def drawn(prefix: str) -> Any:
    """The hook of the column ``varied``: noise, lost pixels and pose are drawn in each episode."""
    return hook(
        {
            f"{prefix}.noise.constant": Uniform(0.0, NOISE),
            f"{prefix}.noise.dropout": Uniform(0.0, DROPOUT),
            **camera(prefix, position=POSITION, rotation=ROTATION),
        }
    )


def at_the_end(env: Any, seen: Camera, which: str) -> Any:
    """The task where noise, latency or pose, or all of them, are at the ends of their ranges."""
    sensing = Sensing(env=env, sensors={"depth": seen.replace(noise=DepthNoise(constant=0.0, dropout=0.0))})
    late = Latency(env=sensing, of=("depth",), **(LATENCY if which in ("latency", "all") else {}))
    name, draws = "env.sensors[depth]", {}
    if which in ("noise", "all"):
        draws |= {f"{name}.noise.constant": Constant(NOISE), f"{name}.noise.dropout": Constant(DROPOUT)}
    if which in ("pose", "all"):
        draws |= {
            f"{name}.position": Shift(Choice((-POSITION, POSITION), per=Per.ELEMENT)),
            f"{name}.rotation": Turn(Choice((-ROTATION, ROTATION))),
        }
    return Randomized(env=late, randomize=hook(draws)) if draws else late


def agent_of(name: str, column: str, env: Any, bare: Any) -> tuple[Any, Any]:
    """The agent of a column, and its configuration."""
    joints, state = JOINTS[name], tuple(inner(bare).observation_spec)
    sees = {"state": state, "blind": joints, "cloud": ("cloud", *joints)}.get(column, ("depth", *joints))
    options = {"observe": sees, "critic_observe": sees if column == "depth alone" else state}
    if column.startswith("ppo"):
        preset = ppo_preset(name, "small")
        factor = 10 if column == "ppo x10" else 1
        config = dataclasses.replace(preset, **options, num_iterations=factor * preset.num_iterations)
        return make_ppo(env, config), config
    config = dataclasses.replace(sapo_preset(name, "small"), **options)
    if column == "depth slow":
        config = dataclasses.replace(config, actor_learning_rate=0.5 * config.actor_learning_rate)
    randomize = drawn("env.sensors[depth]") if column == "varied" else None
    return make_sapo(env, config, randomize=randomize), config


def run_cells(name: str, column: str, seeds: Iterable[int], keep: Path | None) -> Iterator[list[dict[str, Any]]]:
    """Train a policy per seed; the rows of each one's evaluations. All seeds share the compiled programs."""
    bare = task_of(name)
    seen = default_camera(bare)
    env = seeing(bare, seen, column)
    agent, config = agent_of(name, column, env, bare)
    ends = ENDS if column in ("depth", "varied") else ("nominal",)
    places = {at: at_the_end(bare, seen, at) if at != "nominal" or column == "varied" else env for at in ends}
    evaluations = {at: make_evaluate(place, agent.policy, EPISODES) for at, place in places.items()}
    for seed in seeds:
        ts, seconds = trained(agent, config.num_iterations, seed, f"{name} {column}")
        if keep is not None:
            checkpoint.save(folder(keep, name, column, seed), ts, keep=1)
        rows = []
        for at, evaluate in evaluations.items():
            found = evaluate(ts, jax.random.key(99), deterministic=True)
            print(f"{name} {column} {seed} at {at}: {float(found['mean']):.2f}", flush=True)
            rows.append(
                {"task": name, "column": column, "seed": seed, "at": at, "return": round(float(found["mean"]), 3),
                 "std": round(float(found["std"]), 3), "seconds": seconds, "env_steps": int(ts.env_steps)}
            )  # fmt: skip
        yield rows


def folder(keep: Path, name: str, column: str, seed: int) -> Path:
    """Where the policy of a cell is kept."""
    return keep / f"{name}-{column.replace(' ', '_')}-{seed}"


def film(name: str, column: str, seed: int, keep: Path, out: Path) -> None:
    """Draw an episode of a kept policy: a video, and a page beside it."""
    bare = task_of(name)
    env = seeing(bare, default_camera(bare), column)
    agent, _ = agent_of(name, column, env, bare)
    ts = checkpoint.restore(folder(keep, name, column, seed), jax.eval_shape(agent.init, jax.random.key(seed)))
    recording = record(env, agent.policy, ts, jax.random.key(99), name=f"{name}, {column}")
    speed = record_video(recording, out)
    page = write_player([recording], out.with_suffix(".html"), title=recording.name)
    print(f"wrote {out}, {speed}, and {page}: return {recording.totals[-1]:.2f}")


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the benchmark; lists choose cells.

    Attributes:
      tasks, columns, seeds: cells to run, in this order: seeds of a column, columns of a task.
      out: the file of rows.
      keep: folder for checkpoints of the trained policies; none are kept without it.
      film: draw an episode of the first cell's policy, which ``keep`` holds, as a video and a page, and stop.
      table: print tables of the rows that are there, and stop.
    """

    tasks: tuple[str, ...] = tuple(JOINTS)
    columns: tuple[str, ...] = COLUMNS
    seeds: tuple[int, ...] = (0, 1, 2)
    out: Path = Path("docs/suites/seeing/results.csv")
    keep: Path | None = None
    film: Path | None = None
    table: bool = False


def tables(rows: list[dict[str, str]]) -> str:
    """Markdown: mean return of the seeds by task and column, and by the end of the ranges."""

    tasks = list(dict.fromkeys(row["task"] for row in rows))
    lines = ["| trained | " + " | ".join(tasks) + " |", "|" + "---|" * (len(tasks) + 1)]
    for column in COLUMNS:
        found = [mean(rows, task=task, column=column, at="nominal") for task in tasks]
        lines.append(f"| {column} | " + " | ".join(found) + " |")
    lines += ["", "| task | trained | " + " | ".join(ENDS) + " |", "|" + "---|" * (len(ENDS) + 2)]
    for task in tasks:
        for column in ("depth", "varied"):
            found = [mean(rows, task=task, column=column, at=at) for at in ENDS]
            if any(value != "-" for value in found):
                lines.append(f"| {task} | {column} | " + " | ".join(found) + " |")
    return "\n".join(lines)


def main(args: Args) -> None:
    if args.table:
        print(tables(read(args.out)))
        return
    enable_compilation_cache()
    if args.film is not None:
        if args.keep is None:
            raise SystemExit("--film needs --keep, the folder of the kept policies")
        film(args.tasks[0], args.columns[0], args.seeds[0], args.keep, args.film)
        return
    where = {key: value for key, value in provenance().items() if key in FIELDS}
    for task in args.tasks:
        for column in args.columns:
            done = {row["seed"] for row in read(args.out) if (row["task"], row["column"]) == (task, column)}
            for rows in run_cells(task, column, [seed for seed in args.seeds if str(seed) not in done], args.keep):
                append(({**row, **where} for row in rows), FIELDS, args.out)
            jax.clear_caches()  # compiled programs of all columns together exhaust the process's memory maps


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
