"""How fast the parts are that RollingFlat does not use: tetrahedra, many colliders, bodies coupled both ways.

Each line is a program of its own: compile seconds, and milliseconds per environment and substep, forward and forward +
backward (the gradient of a sum over the last state by the first), best of several repeats.

    python benchmarks/features.py                  # all
    python benchmarks/features.py tetrahedra       # or: colliders, coupling
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from rewax.physics import coupling, mpm, tets
from rewax.physics.contact import Collider, Ground, Overlap, PenaltyContact
from rewax.physics.coupling import free_body
from rewax.physics.mpm import Grid, Hencky, Material, VonMises, Wall, Walls, count_nodes
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box, Capsule, fill_box
from rewax.physics.tets import tetmesh

Simulation = Callable[[Any], Any]


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """What to measure; none: everything."""
    num_envs: tuple[int, ...] = (1, 8)
    """Environments side by side."""
    repeats: int = 5


def measure(name: str, simulate: Simulation, start: Any, num_substeps: int, args: Args) -> None:
    """Prints a line for each number of environments."""

    def slope(start: Any) -> Any:
        return jax.grad(lambda s: sum(jnp.sum(leaf) for leaf in jax.tree.leaves(simulate(s))))(start)

    for num_envs in args.num_envs:
        starts = jax.tree.map(lambda a, n=num_envs: jnp.stack([a] * n), start)
        row = []
        for function in (simulate, slope):
            begun = time.perf_counter()
            program = jax.jit(jax.vmap(function)).lower(starts).compile()
            compiled = time.perf_counter() - begun
            jax.block_until_ready(program(starts))
            seconds = []
            for _ in range(args.repeats):
                begun = time.perf_counter()
                jax.block_until_ready(program(starts))
                seconds.append(time.perf_counter() - begun)
            row += [compiled, 1e3 * min(seconds) / num_substeps / num_envs]
        print(
            f"{name:38s} {num_envs:3d} envs   forward {row[1]:7.4f} ms (compiled in {row[0]:4.1f} s)   "
            f"forward + backward {row[3]:7.4f} ms ({row[2]:4.1f} s)",
            flush=True,
        )


def tetrahedra(args: Args) -> None:
    """The soft jumper's table: 204 vertices, 444 tets, on the ground."""
    table, num_substeps = tetmesh.soft_jumper_table(), 80
    scene = tets.make_scene(
        mesh=table,
        density=1.0,
        mu=1000.0,
        lam=1000.0,
        damping=1.0,
        dt=1 / 60 / num_substeps,
        ground=Ground(normal=jnp.array([0.0, 1.0, 0.0])),
        contact=PenaltyContact(stiffness=2e3, damping=0.1, friction_damping=10.0, friction=0.7, radius=0.05),
    )
    poses = mpm.static_poses(num_substeps)
    start = tets.initial_state(table.vertices + np.array([0.0, 0.05, 0.0]))
    measure("tetrahedra", lambda state: tets.step(scene, state, poses), start, num_substeps, args)


def colliders(args: Args) -> None:
    """Dough of 2500 particles under 20 capsules, of which 3 are near: all evaluated, or the 4 nearest."""
    num_substeps, dt, spacing = 20, 2e-4, 1 / 48
    x = jnp.asarray(fill_box((0.5, 0.2, 0.5), (13.5 * spacing,) * 3, spacing / 2)[:2500])
    top = float(x[:, 1].max())
    near = [(0.4 + 0.1 * i, top + 0.02, 0.5) for i in range(3)]
    far = [(a, 0.6, b) for a in np.linspace(0.1, 0.9, 5) for b in (0.1, 0.3, 0.6, 0.9)][:17]
    t = dt * jnp.arange(num_substeps + 1)[:, None, None]
    position = jnp.asarray(near + far) + t * jnp.array([0.05, -0.3, 0.0])
    poses = Pose(position, jnp.broadcast_to(jnp.eye(3), (*position.shape[:2], 3, 3)))
    grid = Grid(shape=(48, 32, 48), spacing=spacing)
    for name, changes in (
        ("20 colliders, all", {}),
        ("20 colliders, as a union", {"overlap": Overlap.NEAREST}),
        ("20 colliders, the 4 nearest", {"max_near_colliders": 4}),
    ):
        scene = mpm.make_scene(
            grid=grid,
            dt=dt,
            material=_dough(),
            particle_volume=(spacing / 2) ** 3,
            colliders=tuple(
                Collider(shape=Capsule(radius=0.02, half_length=0.04), friction=0.5, body=body) for body in range(20)
            ),
            walls=_floor(3 * spacing),
            max_active_nodes=int(1.3 * int(count_nodes(grid, x))),
            **changes,
        )

        def simulate(state: mpm.MPMState, scene: mpm.MPMScene = scene) -> mpm.MPMState:
            return mpm.step(scene, state, poses)

        measure(name, simulate, mpm.initial_state(x, scene), num_substeps, args)


def coupled(args: Args) -> None:
    """A box on dough of 2500 particles: moved as prescribed, or free."""
    num_substeps, dt, spacing = 20, 2e-4, 1 / 48
    x = jnp.asarray(fill_box((0.5, 0.2, 0.5), (13.5 * spacing,) * 3, spacing / 2)[:2500])
    box = Box(half_size=jnp.array([0.1, 0.05, 0.1]))
    grid = Grid(shape=(48, 32, 48), spacing=spacing)
    scene = mpm.make_scene(
        grid=grid,
        dt=dt,
        material=_dough(),
        particle_volume=(spacing / 2) ** 3,
        colliders=(Collider(shape=box, friction=0.5),),
        walls=_floor(3 * spacing),
        max_active_nodes=int(1.3 * int(count_nodes(grid, x))),
    )
    start = mpm.initial_state(x, scene)
    bodies = free_body.bodies_at_rest(jnp.asarray([[0.5, float(x[:, 1].max()) + 0.05, 0.5]]))
    inertia = free_body.inertia_of((box,), 500.0)
    still = jax.tree.map(
        lambda p: jnp.broadcast_to(p, (num_substeps + 1, *p.shape)), Pose(bodies.position, jnp.eye(3)[None])
    )
    measure("a box, as prescribed", lambda state: mpm.step(scene, state, still), start, num_substeps, args)
    none = mpm.static_poses(num_substeps)

    def simulate(start: Any) -> Any:
        return coupling.step(scene, inertia, *start, none)

    measure("a box, free", simulate, (start, bodies), num_substeps, args)


def _dough() -> Material:
    return Material(
        density=1e3,
        elasticity=Hencky(youngs_modulus=5e3, poissons_ratio=0.2),
        plasticity=VonMises(yield_stress=100.0),
    )


def _floor(height: float) -> Walls:
    return Walls(lower=(None, Wall(position=height), None), upper=(None, None, None))


PARTS = {"tetrahedra": tetrahedra, "colliders": colliders, "coupling": coupled}


def main(args: Args) -> None:
    unknown = set(args.names) - set(PARTS)
    if unknown:
        raise SystemExit(f"there is no part {', '.join(sorted(unknown))}: choose from {', '.join(PARTS)}")
    for name, part in PARTS.items():
        if not args.names or name in args.names:
            part(args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
