"""A worker for the MLS-MPM comparison with Warp and Taichi: the same scene through rewax.

It speaks the protocol of that comparison's ``bench_common.py``, which must be importable;
``docs/measured/benchmarks.md`` gives the command line of a whole run.

    python mpm_worker.py SCENE        # a: 2500 particles, 48^3; b: 8 of them side by side; c: 30000 particles, 64^3
"""

import functools
import sys

import bench_common  # pyright: ignore[reportMissingImports]
import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import mpm
from rewax.physics.mpm import FixedCorotated, Grid, Material, Wall, Walls
from rewax.status import describe
from rewax.training import enable_compilation_cache

ACTIVE_NODES = {48: 2560, 64: 10240}
"""Room for the block and a few cells to move in, by nodes per axis of the grid."""
CONTROL_STEP = 25
"""Substeps for which one list of active nodes has to suffice."""


class Worker:
    """Corotated block that falls onto a slippery floor; ``fwd(n)`` and ``grad(n)`` run n substeps."""

    def __init__(self, scene: dict) -> None:
        enable_compilation_cache()
        nodes, dx = scene["grid"], scene["dx"]
        sides = tuple(Wall(position=bench_common.BOUND * dx) for _ in range(3))
        far = tuple(Wall(position=(nodes - bench_common.BOUND) * dx) for _ in range(3))
        self.scene = mpm.make_scene(
            grid=Grid(shape=(nodes, nodes, nodes), spacing=dx),
            dt=scene["dt"],
            material=Material(
                density=jnp.asarray(bench_common.RHO),
                elasticity=FixedCorotated(
                    youngs_modulus=jnp.asarray(bench_common.E), poissons_ratio=jnp.asarray(bench_common.NU)
                ),
            ),
            particle_volume=jnp.asarray(scene["p_vol"]),
            gravity=(0.0, bench_common.GRAVITY, 0.0),
            walls=Walls(lower=sides, upper=far),
            max_active_nodes=ACTIVE_NODES[nodes],
        )
        self.envs = scene["envs"]
        self.x = jnp.asarray(np.tile(scene["x"][None], (self.envs, 1, 1)))
        self.v = jnp.asarray(np.tile(scene["v"][None], (self.envs, 1, 1)))
        self._forward = jax.jit(functools.partial(self._mean_height, store_every=None), static_argnums=2)
        backward = jax.value_and_grad(functools.partial(self._mean_height, store_every=1), has_aux=True)
        self._backward = jax.jit(backward, static_argnums=2)

    def _mean_height(
        self, v: jax.Array, x: jax.Array, num_substeps: int, store_every: int | None
    ) -> tuple[jax.Array, jax.Array]:
        poses = mpm.static_poses(CONTROL_STEP)

        def control_step(state: mpm.MPMState, _: None) -> tuple[mpm.MPMState, jax.Array]:
            new = mpm.step(self.scene, state, poses, store_every=store_every)
            return new, mpm.check_status(self.scene, new, start=state)

        if num_substeps % CONTROL_STEP:
            raise ValueError(f"{num_substeps} substeps: give a multiple of {CONTROL_STEP}")

        def run(v: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
            state = mpm.initial_state(x).replace(v=v)
            state, status = jax.lax.scan(control_step, state, length=num_substeps // CONTROL_STEP)
            return state.x[:, 1].mean(), status

        height, status = jax.vmap(run)(v, x)
        return height.mean(), status

    def fwd(self, n: int) -> dict:
        value, status = self._forward(self.v, self.x, n)
        return {"val": self._checked(value, status)}

    def _checked(self, value: jax.Array, status: jax.Array) -> float:
        if np.any(status):
            raise RuntimeError(f"the run was not valid: {describe(int(np.bitwise_or.reduce(status, axis=None)))}")
        return float(value)

    def grad(self, n: int) -> dict:
        (value, status), gradient = jax.block_until_ready(self._backward(self.v, self.x, n))
        return {"val": self._checked(value, status), "g": np.asarray(gradient).sum((0, 1)).tolist()}


if __name__ == "__main__":
    bench_common.serve(Worker, sys.argv[1])
