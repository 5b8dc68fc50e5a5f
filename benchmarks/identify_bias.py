"""How far the resolution of a fit moves what it finds: Gauss-Newton steps from the true numbers, without a search.

    python benchmarks/identify_bias.py --kind dough --worlds 36 48 --cells 24 28 36

A line for each world, case and grid: found / true of each unknown, the mean and the range over placements of particles,
and the same of the logarithm per metre of difference in spacing of the grids.
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from identify_worlds import KINDS, RADIUS, Kind, world

from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomize import LogUniform
from rewax.identify import record
from rewax.identify.evaluation import evaluate
from rewax.identify.records import Record
from rewax.identify.simulate import data_of, without_reset_noise
from rewax.identify.starts import REGIONS, placements_of
from rewax.identify.surface import particle_spacing
from rewax.identify.unknowns import space_of
from rewax.training import enable_compilation_cache

DEVIATION = 0.004
"""Of a residual [m]."""
PIN = {"scene.colliders[0].shape.radius": LogUniform(0.5 * RADIUS, 1.5 * RADIUS)}
"""The pin's radius as a further unknown."""


def spacing_of_particles(cells: int) -> float:
    """So many that a cell has about eight [m]."""
    return 0.5 / cells


def seen_in(kind: Kind, cells: int, case: int) -> Record:
    """The fitted push in a world of ``cells`` a metre, without noise of the camera or occlusion."""
    real = world(kind, cells, spacing_of_particles(cells), shake=0.9, seed=case)
    space = space_of(kind.priors, real)
    latent = jnp.asarray(space.latent(list(kind.truth(case).values())), jnp.float32)
    return record(space.place(real, latent), kind.actions(), jax.random.key(case), every=2, num_points=384)


def ratios(
    kind: Kind,
    cells: int,
    case: int,
    seen: Record,
    placements: int,
    steps: int,
    further: dict[str, Any],
    thinner: float,
) -> np.ndarray:
    """Found / true of each unknown after some steps from the truth, shape (placements, num_unknowns).

    ``further`` are priors of other unknowns, and ``thinner`` is what the fit's pin lacks in radius [m].
    """
    env = without_reset_noise(world(kind, cells, spacing_of_particles(cells), thinner=thinner))
    space = space_of(kind.priors | further, env)
    truth = space.latent([*kind.truth(case).values(), *[RADIUS for _ in further]])
    spacing = particle_spacing(np.asarray(env.rest_positions))
    rest = placements_of(env, placements, 0.4, spacing, 0)
    weights = np.arange(seen.num_frames) > 0
    data, leaves = data_of(seen, 0.5 * spacing, REGIONS), EnvLeaves.of(env)
    latents = np.tile(truth, (placements, 1))
    for _ in range(steps):
        found = evaluate(
            jnp.asarray(latents, jnp.float32), jnp.asarray(rest, jnp.float32), leaves, data,
            jnp.asarray(weights, jnp.float32), jnp.float32(DEVIATION), space=space, residuals=None,
            num_regions=REGIONS**2,
        )  # fmt: skip
        gradients, hessians = np.asarray(found.gradient, float), np.asarray(found.hessian, float)
        moves = np.stack([-np.linalg.solve(h, g) for h, g in zip(hessians, gradients, strict=True)])
        latents = np.clip(latents + np.clip(moves, -1.0, 1.0), *space.bounds) if steps > 1 else latents + moves
    return np.stack(space.numbers(latents), -1) / np.array(space.numbers(truth))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", default="dough", choices=list(KINDS))
    parser.add_argument("--worlds", type=int, nargs="+", default=[36, 48])
    parser.add_argument("--cells", type=int, nargs="+", default=[24, 28, 36])
    parser.add_argument("--cases", type=int, default=2)
    parser.add_argument("--placements", type=int, default=2)
    parser.add_argument("--steps", type=int, default=1, help="Gauss-Newton steps; of more than one each is limited")
    parser.add_argument("--radius", action="store_true", help="the pin's radius is a further unknown")
    parser.add_argument(
        "--thinner", type=float, default=0.0, help="the fit's pin is thinner by this share of the difference in spacing"
    )
    args = parser.parse_args()
    further: dict[str, Any] = PIN if args.radius else {}
    enable_compilation_cache()
    kind = KINDS[args.kind]
    for real in args.worlds:
        for case in range(args.cases):
            seen = seen_in(kind, real, case)
            for cells in args.cells:
                apart = 1.0 / cells - 1.0 / real
                found = ratios(kind, cells, case, seen, args.placements, args.steps, further, args.thinner * apart)
                texts = []
                for name, own in zip([*kind.priors, *further], found.T, strict=True):
                    slope = f", {np.log(own).mean() / apart:.0f} per m" if apart else ""
                    texts.append(f"{name.split('.')[-1]} x{own.mean():.2f} ({own.min():.2f} to {own.max():.2f}){slope}")
                print(f"world {real} case {case} fit {cells}: {'; '.join(texts)}", flush=True)


if __name__ == "__main__":
    main()
