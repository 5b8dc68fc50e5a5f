"""Gradients through rollouts of rigid bodies: how they grow with the horizon, and whether all of them are finite.

Ant, hopper, hand and humanoid move for a second under random controls until they lie on the ground or in the hand, and
then for 32 control steps more of 1/60 s (8 substeps each): the gradient is that of a random combination of the last
positions by the controls of these, and by the positions and velocities before them. Its part by the last H controls is
the gradient over the horizon H. Under MuJoCo's constraints with its default impedance and with a soft onset (the same
program: they are parameters), and under springs and dampers.

    python benchmarks/rigid_gradients.py --out docs/pictures/rigid_gradients.png
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import tyro
from rigid_models import MODELS, Contact, penalty_of

from rewax.physics import rigid
from rewax.status import all_finite
from rewax.training import enable_compilation_cache

HORIZONS = (1, 4, 8, 16, 32)
SOFT = (1e-4, 0.95, 0.02, 0.5, 2.0)
SUBSTEPS = 8
DT = 1 / 60 / SUBSTEPS


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    models: tuple[str, ...] = tuple(MODELS)
    rollouts: int = 2000
    at_once: int = 250
    """Rollouts side by side."""
    settle: int = 60
    """Control steps before the gradient begins."""
    out: str = "rigid_gradients.png"


def variants(name: str) -> dict[str, rigid.RigidModel]:
    """The model under each law."""
    default = rigid.load(MODELS[name](Contact(dt=DT)))
    pairs = default.parameters["pair_solimp"].shape[0]
    soft = default.with_parameters(pair_solimp=jnp.tile(jnp.array(SOFT), (pairs, 1)))
    springs = rigid.load(MODELS[name](Contact(dt=DT)), penalty=penalty_of(name))
    return {"default impedance": default, "soft onset": soft, "springs and dampers": springs}


def gradient_norms(args: Args, model: rigid.RigidModel, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """For one rollout: gradient norms over the horizons; whether the state before and all gradients are finite."""
    start, push, act, weigh = jax.random.split(key, 4)
    controls = jax.random.uniform(act, (args.settle + max(HORIZONS), model.num_actuators), minval=-1.0, maxval=1.0)
    weights = jax.random.normal(weigh, (model.num_positions,))
    weights = weights / jnp.linalg.norm(weights)

    def rollout(state: rigid.RigidState, controls: jax.Array) -> rigid.RigidState:
        def step(state: rigid.RigidState, ctrl: jax.Array) -> tuple[rigid.RigidState, None]:
            return rigid.step(model, state, ctrl, num_substeps=SUBSTEPS), None

        return jax.lax.scan(step, state, controls)[0]

    qpos = model.home + 0.02 * jax.random.normal(start, model.home.shape)
    state = rigid.initial_state(model, qpos, 0.5 * jax.random.normal(push, (model.num_dofs,)))
    state = rollout(state, controls[: args.settle])
    outcome = lambda controls, state: rollout(state, controls).qpos @ weights  # noqa: E731
    by_controls, by_state = jax.grad(outcome, argnums=(0, 1))(controls[args.settle :], state)
    norms = jnp.stack([jnp.linalg.norm(by_controls[-horizon:]) for horizon in HORIZONS])
    return norms, all_finite(state.qpos), all_finite((by_controls, by_state.qpos, by_state.qvel))


def study(args: Args, run: Any, model: rigid.RigidModel) -> tuple[np.ndarray, int, int]:
    """Norms of all rollouts at the horizons; how many states and gradients were not finite."""
    parts = []
    for first in range(0, args.rollouts, args.at_once):
        keys = jax.vmap(jax.random.key)(jnp.arange(first, first + args.at_once))
        parts.append(jax.tree.map(np.asarray, run(model, keys)))
    norms, states, gradients = (np.concatenate(part) for part in zip(*parts, strict=True))
    return norms, int((~states).sum()), int((~gradients).sum())


def main(args: Args) -> int:
    enable_compilation_cache()
    matplotlib.use("Agg")
    run = jax.jit(jax.vmap(lambda model, key: gradient_norms(args, model, key), in_axes=(None, 0)))
    figure, panels = plt.subplots(1, len(args.models), figsize=(3.0 * len(args.models), 3.2), squeeze=False)
    bad = 0
    print("| model | law | not finite | " + " | ".join(f"H = {h}" for h in HORIZONS) + " |")
    print("|---|---|---|" + "---|" * len(HORIZONS))
    for name, axes in zip(args.models, panels[0], strict=True):
        for law, model in variants(name).items():
            norms, states, gradients = study(args, run, model)
            bad += states + gradients
            middle, high = np.quantile(norms, (0.5, 0.95), axis=0)
            cells = " | ".join(
                f"{m:.2g}, {h:.2g}, {top:.2g}" for m, h, top in zip(middle, high, norms.max(0), strict=True)
            )
            print(f"| {name} | {law} | {gradients} of {len(norms)} | {cells} |", flush=True)
            (line,) = axes.loglog(HORIZONS, middle, marker="o", markersize=3, label=law)
            axes.loglog(HORIZONS, high, ls="--", lw=1, color=line.get_color())
        axes.set_title(name, fontsize=10)
        axes.set_xticks(HORIZONS, [str(h) for h in HORIZONS])
        axes.minorticks_off()
        axes.set_xlabel("control steps")
    panels[0][0].set_ylabel("norm of the gradient by controls")
    panels[0][0].legend(fontsize=7, frameon=False)
    figure.suptitle("Growth of gradients with the horizon: median, and 95 % (dashed)", fontsize=10)
    figure.tight_layout()
    figure.savefig(args.out, dpi=150)
    return bad


if __name__ == "__main__":
    raise SystemExit(min(main(tyro.cli(Args, description=__doc__)), 1))
