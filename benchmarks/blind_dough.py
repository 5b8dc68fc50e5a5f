"""What touch is worth: a policy without a camera lifts dough whose weight is drawn anew in each episode.

    python benchmarks/blind_dough.py                                # what has no row yet: an hour and more on two cores
    python benchmarks/blind_dough.py --columns touch --seeds 0
    python benchmarks/blind_dough.py --table                        # the table of the rows that are there
    python benchmarks/blind_dough.py --time                         # a control step with and without touch

Each cell (column, seed) trains SAPO on HandLift at scale ``small`` and evaluates 64 episodes with deterministic actions
from the same starts: with drawn weights, and with the lightest and the heaviest. Its rows are written when it is
finished. The critics of all columns observe the state and the weight. Columns say what the policy observes:

    joints    the joints of the hand
    touch     joints, and the force on each body of the hand
    told      joints, and the weight: the bound of what touch could tell
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rows import fill, mean, read
from trained import earned, trained

import rewax
from rewax import struct
from rewax.agents.presets import sapo_preset
from rewax.agents.sapo import make_sapo
from rewax.envs import Randomized
from rewax.envs.randomize import Constant, LogUniform, Scale, hook
from rewax.envs.sensing import Sensing
from rewax.envs.wrappers import _Wrapper
from rewax.sensors import Touch
from rewax.training import enable_compilation_cache

COLUMNS = {"joints": ("joint_q",), "touch": ("joint_q", "touch"), "told": ("joint_q", "weight")}
LIGHT, HEAVY = 0.5, 2.0
"""Factors of the dough's density."""
WEIGHTS = {"drawn": LogUniform(LIGHT, HEAVY), "light": Constant(LIGHT), "heavy": Constant(HEAVY)}
FIELDS = ("column", "seed", "at", "return", "std", "seconds", "env_steps", "commit", "processor")
EPISODES = 64


@struct.dataclass
class Weighed(_Wrapper):
    """A task with the logarithm of the density, in units of the reference, as the observation ``weight``."""

    def reset(self, key: Any) -> Any:
        return self._weighed(self.env.reset(key))

    def step(self, state: Any, action: Any) -> Any:
        own = {name: value for name, value in state.obs.items() if name != "weight"}
        return self._weighed(self.env.step(state.replace(obs=own), action))

    @property
    def observation_spec(self) -> dict[str, Any]:
        return {**self.env.observation_spec, "weight": rewax.ArraySpec((1,))}

    def _weighed(self, state: Any) -> Any:
        weight = jnp.log(jnp.asarray(self.env.scene.material.density, state.reward.dtype) / 1000.0)
        return state.replace(obs={**state.obs, "weight": weight[None]})


def env_of(column: str) -> Any:
    env = Weighed(env=rewax.make("HandLift", scale="small"))
    return Sensing(env=env, sensors={"touch": Touch(torque=False)}) if column == "touch" else env


def draws(env: Any, factor: Any) -> Any:
    """The hook that draws the density, wherever the task lies in its wrappers."""
    return hook({f"{'env.' * (2 if isinstance(env, Sensing) else 1)}scene.material.density": Scale(factor)})


def agent_of(column: str, env: Any) -> tuple[Any, Any]:
    state = (*env.unwrapped.observation_spec, "weight")
    config = dataclasses.replace(sapo_preset("HandLift", "small"), observe=COLUMNS[column], critic_observe=state)
    return make_sapo(env, config, randomize=draws(env, WEIGHTS["drawn"])), config


def run_cell(column: str, seed: int) -> list[dict[str, Any]]:
    """Train one policy; the rows of its evaluations."""
    env = env_of(column)
    agent, config = agent_of(column, env)
    ts, seconds = trained(agent, config.num_iterations, seed, column)
    rows = []
    for at, factor in WEIGHTS.items():
        where = Randomized(env=env, randomize=draws(env, factor))
        found = earned(where, agent.policy, ts, EPISODES)
        rows.append({"at": at, **found, "seconds": seconds, "env_steps": int(ts.env_steps)})
    return rows


def time_steps(num_envs: int = 8, repeats: int = 15) -> None:
    """CPU time of a control step with its gradient, with and without touch: in turns, the least of several."""
    keys, programs, least = jax.random.split(jax.random.key(0), num_envs), {}, {}
    for column in ("joints", "touch"):
        env = env_of(column)
        state = jax.jit(jax.vmap(env.reset))(keys)

        def total(action: Any, env: Any = env, state: Any = state) -> Any:
            after = jax.vmap(env.step)(state, action)
            return sum(jnp.sum(value) for value in after.obs.values()) + jnp.sum(after.reward)

        action, began = jnp.full((num_envs, *env.action_spec.shape), 0.2), time.process_time()
        programs[column] = (jax.jit(jax.value_and_grad(total)).lower(action).compile(), action)
        print(f"{column}: {time.process_time() - began:.0f} s of CPU time to trace and compile", flush=True)
    for _ in range(repeats):
        for column, (program, action) in programs.items():
            began = time.process_time()
            jax.block_until_ready(program(action))
            least[column] = min(least.get(column, np.inf), time.process_time() - began)
    print({column: f"{1e3 * seconds:.0f} ms" for column, seconds in least.items()})


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the benchmark.

    Attributes:
      columns, seeds: cells to run, all columns of a seed first.
      out: the file of rows.
      table: print the table of the rows that are there, and stop.
      time: time a control step with and without touch, and stop.
    """

    columns: tuple[str, ...] = tuple(COLUMNS)
    seeds: tuple[int, ...] = (0, 1, 2)
    out: Path = Path("docs/suites/blind_dough/results.csv")
    table: bool = False
    time: bool = False


def table(rows: list[dict[str, str]]) -> str:
    """Markdown: mean return of the seeds by column and weight."""
    lines = ["| policy observes | " + " | ".join(WEIGHTS) + " |", "|" + "---|" * (len(WEIGHTS) + 1)]
    for column in COLUMNS:
        found = [mean(rows, column=column, at=at) for at in WEIGHTS]
        lines.append(f"| {column} | " + " | ".join(found) + " |")
    return "\n".join(lines)


def main(args: Args) -> None:
    if args.table:
        print(table(read(args.out)))
        return
    if args.time:
        time_steps()
        return
    enable_compilation_cache()
    fill(({"column": c, "seed": seed} for seed in args.seeds for c in args.columns), run_cell, FIELDS, args.out)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
