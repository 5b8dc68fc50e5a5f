"""Policies that remember: returns with a GRU and with a history, beside those with the full and with one observation.

    python benchmarks/memory.py                                         # everything: hours on two cores
    python benchmarks/memory.py --tasks Goal --algorithms sapo --columns gru --seeds 0
    python benchmarks/memory.py --table | python benchmarks/page_tables.py docs/policies_that_remember.md

Each cell (task, algorithm, column, seed) trains one policy and evaluates 64 episodes with deterministic actions from
the same starts. Its row is written when it is finished, and finished cells are skipped. Tasks:

    Cartpole    CartpoleSwingUp; the velocity of the cart and the rate of the pole's angle are hidden
    Goal        a point reaches a goal in the plane, which it is shown at the first of 32 steps only

The critics of all columns get the full observation. The columns name the observations of the policy:

    full        everything: the velocities, the goal at every step
    one         the observation of this step
    history     the last four observations
    gru         the observation of this step, and its own memory
    gru x2      the same, trained with twice as many iterations
    none        not a policy: zeros as actions
"""

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from rows import fill, read, returns, spread
from trained import earned

import rewax
from rewax import struct
from rewax.agents.ppo import PPOConfig, make_ppo
from rewax.agents.presets import ppo_preset, sapo_preset
from rewax.agents.sapo import SAPOConfig, make_sapo
from rewax.envs.base import first_state, next_state
from rewax.envs.history import History
from rewax.envs.wrappers import _Wrapper
from rewax.training import enable_compilation_cache
from rewax.training.evaluation.episodes import constant_policy

TASKS, ALGORITHMS, COLUMNS = ("Goal", "Cartpole"), ("sapo", "ppo"), ("full", "gru", "gru x2", "history", "one", "none")
FIELDS = ("task", "algorithm", "column", "seed", "return", "std", "seconds", "env_steps", "commit", "processor")
EPISODES, STEPS = 64, 4
MEMORY = 32


@struct.dataclass
class Partly(_Wrapper):
    """CartpoleSwingUp with a second observation, ``seen``, without velocity and rate."""

    @property
    def observation_spec(self) -> dict[str, Any]:
        return {**self.env.observation_spec, "seen": rewax.ArraySpec((3,))}

    def reset(self, key: Any) -> Any:
        return self._seen(self.env.reset(key))

    def step(self, state: Any, action: Any) -> Any:
        return self._seen(self.env.step(state.replace(obs={"state": state.obs["state"]}), action))

    def _seen(self, state: Any) -> Any:
        return state.replace(obs={**state.obs, "seen": state.obs["state"][jnp.array([0, 2, 3])]})


@struct.dataclass
class Goal:
    """A point moves at up to ``speed`` [m] per step; the reward is minus its squared distance from the goal.

    Observations: ``state`` holds the position and the goal, ``seen`` the position, the goal at the first step and zeros
    at later ones, and whether this is the first step.
    """

    speed: Any
    length: int = struct.static_field(default=32)

    @property
    def observation_spec(self) -> dict[str, Any]:
        return {"state": rewax.ArraySpec((4,)), "seen": rewax.ArraySpec((5,))}

    @property
    def action_spec(self) -> Any:
        return rewax.ArraySpec((2,), -1.0, 1.0)

    @property
    def episode_length(self) -> int:
        return self.length

    def reset(self, key: Any) -> Any:
        key, start_key, goal_key = jax.random.split(key, 3)
        physics = {
            "x": jax.random.uniform(start_key, (2,), minval=-1.0, maxval=1.0),
            "goal": jax.random.uniform(goal_key, (2,), minval=-1.0, maxval=1.0),
        }
        return first_state(physics=physics, obs=_shown(physics, 1.0), metrics={}, key=key)

    def step(self, state: Any, action: Any) -> Any:
        goal = state.physics["goal"]
        x = state.physics["x"] + self.speed * jnp.clip(action, -1.0, 1.0)
        physics, reward = {"x": x, "goal": goal}, -jnp.sum((x - goal) ** 2)
        obs = _shown(physics, 0.0)
        return next_state(state, physics=physics, obs=obs, reward=reward, metrics={}, episode_length=self.length)


def _shown(physics: Any, first: float) -> dict[str, Any]:
    x, goal = physics["x"], physics["goal"]
    return {"state": jnp.concatenate([x, goal]), "seen": jnp.concatenate([x, first * goal, jnp.full(1, first)])}


def task_of(name: str, column: str) -> Any:
    """The task with the observations of a column."""
    if name == "Cartpole":
        env: Any = Partly(env=rewax.make("CartpoleSwingUp", scale="small"))
    else:
        env = Goal(speed=jnp.float32(0.2))
    return History(env=env, steps=STEPS, of=("seen",)) if column == "history" else env


def options_of(name: str, algorithm: str) -> Any:
    """The options of an algorithm on a task, without memory."""
    if name == "Cartpole":
        return (sapo_preset if algorithm == "sapo" else ppo_preset)("CartpoleSwingUp", "small")
    networks = {
        "actor_widths": (64, 64), "critic_widths": (64, 64), "vector_features": 64, "stagger_episodes": True,
        "quick_compile": True,
    }  # fmt: skip
    if algorithm == "ppo":
        return PPOConfig(**networks, num_envs=64, horizon=32, num_iterations=300, minibatches=4, epochs=10)
    return SAPOConfig(
        **networks, num_envs=32, horizon=16, num_iterations=400, critic_passes=8, critic_minibatches=2,
        initial_temperature=0.01, temperature_learning_rate=0.02, differentiate="full",
    )  # fmt: skip


def run_cell(task: str, algorithm: str, column: str, seed: int) -> dict[str, Any]:
    """Train one policy and evaluate it."""
    env = task_of(task, column)
    if column == "none":
        return earned(env, constant_policy(jnp.zeros(env.action_spec.shape)), (), EPISODES)
    config = dataclasses.replace(
        options_of(task, algorithm),
        observe=("state",) if column == "full" else ("seen",),
        critic_observe=("state",),
        memory=MEMORY if column.startswith("gru") else 0,
    )
    if column == "gru x2":
        config = dataclasses.replace(config, num_iterations=2 * config.num_iterations)
    agent = (make_sapo if algorithm == "sapo" else make_ppo)(env, config)
    began, ts = time.perf_counter(), agent.init(jax.random.key(seed))
    for i in range(config.num_iterations):
        ts, metrics = agent.train_step(ts)
        if i % 50 == 49:
            spent, last = time.perf_counter() - began, float(metrics["return"])
            print(f"{task} {algorithm} {column} {seed}: {i + 1}, {spent:.0f} s, {last:.2f}", flush=True)
    jax.block_until_ready(ts)
    seconds = round(time.perf_counter() - began)
    return {**earned(env, agent.policy, ts, EPISODES), "env_steps": int(ts.env_steps), "seconds": seconds}


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the benchmark; lists choose cells.

    Attributes:
      tasks, algorithms, columns, seeds: cells to run, in this order: seeds last.
      out: the file of rows.
      table: print the table of the rows that are there, and stop.
    """

    tasks: tuple[str, ...] = TASKS
    algorithms: tuple[str, ...] = ALGORITHMS
    columns: tuple[str, ...] = COLUMNS
    seeds: tuple[int, ...] = (0, 1, 2)
    out: Path = Path("docs/suites/memory/results.csv")
    table: bool = False


def table(rows: list[dict[str, str]]) -> str:
    """Markdown: mean and standard deviation of the seeds' returns, with their number in brackets."""

    def cell(task: str, algorithm: str, column: str) -> str:
        some = returns(rows, task=task, algorithm=algorithm, column=column)
        return f"{spread(some, 2)} ({len(some)})" if some else "-"

    lines = ["| task | algorithm | " + " | ".join(COLUMNS) + " |", "|" + "---|" * (len(COLUMNS) + 2)]
    for task in TASKS:
        for algorithm in ALGORITHMS:
            found = [cell(task, algorithm, column) for column in COLUMNS]
            lines.append(f"| {task} | {algorithm} | " + " | ".join(found) + " |")
    return "\n".join(lines)


def main(args: Args) -> None:
    if args.table:
        print(table(read(args.out)))
        return
    enable_compilation_cache()
    every = itertools.product(args.seeds, args.tasks, args.algorithms, args.columns)
    cells = (
        {"task": task, "algorithm": algorithm, "column": column, "seed": seed}
        for seed, task, algorithm, column in every
        if not (column == "none" and seed)
    )
    fill(cells, run_cell, FIELDS, args.out)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
