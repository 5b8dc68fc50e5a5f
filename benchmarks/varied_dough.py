"""Does SAPO earn more on HandFlip if each episode draws another dough? Rows of docs/suites/varied_dough/results.csv.

    python benchmarks/varied_dough.py            # the cells that have no row yet, about ten minutes each on two cores
    python benchmarks/varied_dough.py --table

Each cell (column, seed) trains SAPO with its preset at scale ``small``. Its 64 episodes of evaluation are those of the
task itself, with deterministic actions and from the same starts. ``num_substeps`` is 20 in all columns, so that the
stiffest dough is stable. Columns:

    same      every episode has the task's dough
    varied    each episode multiplies Young's modulus and yield stress by factors between a half and two
"""

import dataclasses
from pathlib import Path
from typing import Any

import tyro
from rows import fill, mean, read
from trained import earned, trained

import rewax
from rewax.agents.presets import sapo_preset
from rewax.agents.sapo import make_sapo
from rewax.envs.randomize import LogUniform, Scale, hook
from rewax.training import enable_compilation_cache

FACTOR = Scale(LogUniform(0.5, 2.0))
DRAWS = {"scene.material.elasticity.youngs_modulus": FACTOR, "scene.material.plasticity.yield_stress": FACTOR}
COLUMNS = {"same": None, "varied": DRAWS}
EPISODES = 64
OUT = Path(__file__).resolve().parent.parent / "docs/suites/varied_dough/results.csv"
FIELDS = ("column", "seed", "return", "std", "seconds", "env_steps", "commit", "processor")


def run_cell(column: str, seed: int) -> dict[str, Any]:
    """Train one policy; its evaluation with the task's dough."""
    env: Any = rewax.make("HandFlip", scale="small", num_substeps=20)
    config, draws = sapo_preset("HandFlip", "small"), COLUMNS[column]
    agent = make_sapo(env, config, randomize=None if draws is None else hook(draws))
    ts, seconds = trained(agent, config.num_iterations, seed, column)
    return {**earned(env, agent.policy, ts, EPISODES), "seconds": seconds, "env_steps": int(ts.env_steps)}


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the benchmark.

    Attributes:
      columns, seeds: cells to run, all columns of a seed first.
      out: file of the rows.
      table: print the table of the rows that are there, and stop.
    """

    columns: tuple[str, ...] = tuple(COLUMNS)
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    out: Path = OUT
    table: bool = False


def table(rows: list[dict[str, str]]) -> str:
    """Markdown: mean return, its seeds, and the returns of the seeds."""
    lines = ["| dough in training | mean return (seeds) | returns |", "|---|---|---|"]
    for column in COLUMNS:
        returns = ", ".join(f"{float(row['return']):.1f}" for row in rows if row["column"] == column)
        lines.append(f"| {column} | {mean(rows, column=column)} | {returns or '-'} |")
    return "\n".join(lines)


def main(args: Args) -> None:
    if args.table:
        print(table(read(args.out)))
        return
    enable_compilation_cache()
    fill(({"column": c, "seed": seed} for seed in args.seeds for c in args.columns), run_cell, FIELDS, args.out)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
