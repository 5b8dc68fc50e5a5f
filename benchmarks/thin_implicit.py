"""Processor time per control step of a hanging cloth, explicit and implicit, in turns, with and without the gradient.

    python benchmarks/thin_implicit.py --cells 16 --youngs-moduli 1e5 1e7

A square sheet of 0.4 m, 0.5 mm thick, swings from two of its corners. A control step is 10 ms. The explicit solver
takes as many substeps as ``largest_stable_dt`` asks for, the implicit one ``--implicit-substeps``. The gradient is that
of the mean final height with respect to the initial state. Printed are the best processor times, which other programs
hardly change, and the difference of both ends relative to the distance that the cloth moved, after ``--warm-up``
control steps of the explicit solver.

    JAX_ENABLE_X64=1 python benchmarks/thin_implicit.py --cells 16 --youngs-moduli 1e7 --tolerances 1e-4 1e-6 1e-7

prints instead the error of the gradient of the implicit solver after four control steps of warm-up, for values of
``Implicit.gradient_tolerance``, relative to the gradient with a tolerance of 1e-12.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import thin

CONTROL_DT, SIDE, THICKNESS, DENSITY = 0.01, 0.4, 5e-4, 300.0


def scene_of(
    cells: int, youngs_modulus: float, damping: float, substeps: int | None, tolerance: float = 1e-6
) -> thin.ThinScene:
    """The sheet with implicit substeps and a tolerance of their gradient, or with explicit substeps for None."""
    cloth = thin.isotropic_cloth(
        youngs_modulus=youngs_modulus, poissons_ratio=0.3, thickness=THICKNESS, density=DENSITY, damping=damping
    )
    given = {"mesh": thin.sheet(SIDE, SIDE, cells, cells), "cloth": cloth, "held": [0, cells], "drag": 0.5}
    if substeps is not None:
        stepper = thin.Implicit(gradient_tolerance=tolerance)
        return thin.make_scene(**given, dt=CONTROL_DT / substeps, stepper=stepper)
    probe = thin.make_scene(**given, dt=1e-9)
    count = int(np.ceil(CONTROL_DT / float(thin.largest_stable_dt(probe))))
    return probe.replace(dt=CONTROL_DT / count)


def programs(scene: thin.ThinScene) -> dict[str, Callable]:
    count = round(CONTROL_DT / scene.dt)
    poses = thin.static_poses(count)
    divisors = [d for d in range(1, count + 1) if count % d == 0]
    every = min(divisors, key=lambda d: abs(d - count**0.5)) if scene.stepper is None else 1

    def step(state: thin.ThinState) -> thin.ThinState:
        return thin.step(scene, state, poses, store_every=every)

    slope = jax.grad(lambda state: jnp.mean(step(state).x[:, 1]))
    return {"forward": jax.jit(step), "forward + backward": jax.jit(slope)}


def seconds(function: Callable, state: Any) -> float:
    start = time.process_time()
    jax.block_until_ready(function(state))
    return time.process_time() - start


def print_errors(cells: int, modulus: float, args: argparse.Namespace) -> None:
    """Errors of the gradient with respect to positions and velocities, by tolerance."""

    def gradient(tolerance: float) -> np.ndarray:
        each = programs(scene_of(cells, modulus, args.damping, args.implicit_substeps, tolerance))
        state = thin.initial_state(thin.sheet(SIDE, SIDE, cells, cells).vertices)
        for _ in range(4):
            state = each["forward"](state)
        slope = each["forward + backward"](state)
        return np.concatenate([np.ravel(slope.x), np.ravel(slope.v)])

    exact = gradient(1e-12)
    for tolerance in args.tolerances:
        error = np.linalg.norm(gradient(tolerance) - exact) / np.linalg.norm(exact)
        print(f"{cells} x {cells} cells, E = {modulus:g} Pa, tolerance {tolerance:g}: error {error:.1e}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[8, 16])
    parser.add_argument("--youngs-moduli", type=float, nargs="+", default=[1e5, 1e7])
    parser.add_argument("--damping", type=float, default=1e-4)
    parser.add_argument("--implicit-substeps", type=int, default=2)
    parser.add_argument("--warm-up", type=int, default=10)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--tolerances", type=float, nargs="+", default=[])
    args = parser.parse_args()
    for cells in args.cells:
        for modulus in args.youngs_moduli:
            if args.tolerances:
                print_errors(cells, modulus, args)
                continue
            explicit = scene_of(cells, modulus, args.damping, None)
            implicit = scene_of(cells, modulus, args.damping, args.implicit_substeps)
            both = {"explicit": programs(explicit), "implicit": programs(implicit)}
            state = thin.initial_state(thin.sheet(SIDE, SIDE, cells, cells).vertices)
            for _ in range(args.warm_up):
                state = both["explicit"]["forward"](state)
            ends = {name: each["forward"](state) for name, each in both.items()}
            status = int(thin.check_status(implicit, ends["implicit"]))
            moved = float(jnp.abs(ends["explicit"].x - state.x).max())
            apart = float(jnp.abs(ends["explicit"].x - ends["implicit"].x).max()) / moved
            print(
                f"{cells} x {cells} cells, E = {modulus:g} Pa: {round(CONTROL_DT / explicit.dt)} explicit substeps, "
                f"{args.implicit_substeps} implicit; difference {100 * apart:.1f} % of {1e3 * moved:.1f} mm; "
                f"status {status}",
                flush=True,
            )
            for what in ("forward", "forward + backward"):
                for each in both.values():
                    seconds(each[what], state)
                best = dict.fromkeys(both, np.inf)
                for _ in range(args.turns):
                    for name, each in both.items():
                        best[name] = min(best[name], seconds(each[what], state))
                print(
                    f"  {what}: {1e3 * best['explicit']:.1f} ms explicit, {1e3 * best['implicit']:.1f} ms implicit, "
                    f"ratio {best['explicit'] / best['implicit']:.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
