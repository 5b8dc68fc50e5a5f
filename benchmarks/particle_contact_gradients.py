"""How soft should contact with particles be? Do gradients through it point where the landscape slopes?

A free block is dropped onto an elastic slab; a pin that moves as prescribed presses dough and rolls over it. In two
dimensions, in double precision, for several values of softness times the grid's spacing. For 16 starts the gradient of
the outcome (the block's height, the dough's mean height) is compared with the slope of the landscape, the central
difference over ``Task.steps``: cosine (median and lowest tenth; each component times its step), the derivative by the
first parameter, stiffness or depth, over its slope (quartiles), and the spread of this derivative over that of the
slope. And the gap between the block and the slab at the end, between the pin at its deepest and the dough: negative is
penetration.

    python benchmarks/particle_contact_gradients.py
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from rewax.physics import coupling, mpm
from rewax.physics.contact import Collider
from rewax.physics.coupling import free_body
from rewax.physics.mpm import Grid, Hencky, Material, MPMScene, VonMises, Wall, WallKind, Walls
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box, Capsule, fill_box
from rewax.struct import replace_leaf
from rewax.training import enable_compilation_cache

WIDTH, HEIGHT = 0.4, 0.1
"""Of slab and dough [m]."""
LONG = 10.0
"""Half-length of block and pin out of the plane [m]."""
BLOCK, BLOCK_DENSITY = (0.06, 0.03), 500.0
PIN = 0.04
STARTS_SEED = 0


class Task(NamedTuple):
    """What is simulated.

    Attributes:
      material: of the slab or the dough.
      collider: the block or the pin.
      outcome: ``(scene, x, parameters) -> (outcome, gap)``; the gap is between the tool and the particles [m].
      low, high: of the parameters.
      steps: of the central differences.
      duration: [s].
      dt: substep over spacing [s/m].
    """

    material: Material
    collider: Collider
    outcome: Callable[..., tuple[jax.Array, jax.Array]]
    low: tuple[float, ...]
    high: tuple[float, ...]
    steps: tuple[float, ...]
    duration: float
    dt: float


def make_scene(task: Task, spacing: float) -> tuple[MPMScene, jax.Array]:
    """The scene, and particles at rest on the floor: one layer, held between two walls."""
    h = spacing / 2
    x = fill_box((WIDTH / 2, HEIGHT / 2, 0.0), (WIDTH, HEIGHT, h), h)
    held, floor = Wall(position=0.5 * spacing, kind=WallKind.SLIP), Wall(position=1e-6, kind=WallKind.GRIPPING)
    margin = 4
    scene = mpm.make_scene(
        grid=Grid(
            shape=(round(WIDTH / spacing) + 2 * margin, round(2.0 * HEIGHT / spacing) + margin, 4),
            spacing=spacing,
            origin=(-margin * spacing, -2 * spacing, -spacing),
        ),
        dt=task.dt * spacing,
        material=task.material,
        particle_volume=h**3,
        colliders=(task.collider,),
        walls=Walls(lower=(None, floor, held), upper=(None, None, held)),
    )
    return scene, jnp.asarray(x)


def top(x: jax.Array, center: jax.Array, half_width: float, spacing: float) -> jax.Array:
    """Upper surface of the particles below a tool [m]. Gradient: none."""
    below = jnp.abs(x[:, 0] - center) < 0.5 * half_width
    return jax.lax.stop_gradient(jnp.max(jnp.where(below, x[:, 1], -jnp.inf)) + 0.25 * spacing)


def drop(scene: MPMScene, x: jax.Array, num_substeps: int, parameters: jax.Array) -> tuple[jax.Array, jax.Array]:
    """parameters: log of a factor of stiffness, gap [m], vertical velocity [m/s], place [m], tilt. Outcome: height."""
    log_factor, gap, velocity, place, tilt = parameters
    modulus = jnp.exp(log_factor) * scene.material.elasticity.youngs_modulus
    scene = replace_leaf(scene, "material.elasticity.youngs_modulus", modulus)
    thickness = 0.5 * scene.grid.spacing
    solid = Box(half_size=jnp.array([*BLOCK, thickness / 2]))
    mass, moment = free_body.solid(solid, BLOCK_DENSITY)
    inertia = free_body.Inertia(mass=mass[None], moment=moment[None])
    bodies = free_body.bodies_at_rest(jnp.array([[WIDTH / 2, HEIGHT + BLOCK[1], 0.0]]))
    bodies = bodies.replace(
        position=bodies.position + jnp.stack([place, gap, jnp.zeros_like(gap)]),
        velocity=bodies.velocity.at[0, 1].add(velocity),
        orientation=jnp.stack([jnp.cos(tilt / 2), 0.0 * tilt, 0.0 * tilt, jnp.sin(tilt / 2)])[None],
    )
    poses = mpm.static_poses(num_substeps)
    state, bodies, _ = coupling.step(scene, inertia, mpm.initial_state(x), bodies, poses, store_every=10)
    height = bodies.position[0, 1]
    above = top(state.x, bodies.position[0, 0], BLOCK[0], scene.grid.spacing)
    return height, height - BLOCK[1] - above


def press(scene: MPMScene, x: jax.Array, num_substeps: int, parameters: jax.Array) -> tuple[jax.Array, jax.Array]:
    """parameters: depth that the pin reaches [m], way that it rolls [m], place [m]. Outcome: mean height of the dough.

    The pin moves down in the first third of the time, sideways in the second, up in the last.
    """
    depth, way, place = parameters
    third, steps = num_substeps // 3, num_substeps // 3 * 3
    times = jnp.linspace(0.0, 3.0, steps + 1)
    down, side, up = (jnp.clip(times - i, 0.0, 1.0) for i in range(3))
    first = 0.01
    y = HEIGHT + PIN + first - (first + depth) * (down - up)
    along = WIDTH / 2 - 0.5 * way + place + way * side
    position = jnp.stack([along, y, jnp.zeros_like(y)], axis=1)[:, None]
    poses = Pose(position, jnp.broadcast_to(jnp.eye(3), (steps + 1, 1, 3, 3)))
    first_part = jax.tree.map(lambda a: a[: third + 1], poses)
    rest = jax.tree.map(lambda a: a[third:], poses)
    pressed = mpm.step(scene, mpm.initial_state(x), first_part, store_every=10)
    gap = y[third] - PIN - top(pressed.x, along[0], PIN, scene.grid.spacing)
    return mpm.step(scene, pressed, rest, store_every=10).x[:, 1].mean(), gap


def tasks() -> dict[str, Task]:
    axis = jnp.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # capsules lie along y
    block = Collider(shape=Box(half_size=jnp.array([*BLOCK, LONG])), friction=0.5)
    pin = Collider(shape=Capsule(radius=jnp.asarray(PIN), half_length=jnp.asarray(LONG)), rotation=axis, friction=0.9)
    slab = Material(
        density=1000.0,
        elasticity=Hencky(youngs_modulus=jnp.asarray(5e4), poissons_ratio=0.3),
    )
    dough = replace_leaf(slab, "elasticity.youngs_modulus", 2e4).replace(plasticity=VonMises(yield_stress=500.0))
    return {
        "block on slab": Task(
            material=slab, collider=block, outcome=drop,
            low=(-0.2, 0.01, -0.3, -0.0125, -0.1), high=(0.2, 0.03, 0.0, 0.0125, 0.1),
            steps=(0.02, 2e-3, 0.02, 2e-3, 0.01), duration=0.3, dt=0.02,
        ),
        "pin on dough": Task(
            material=dough, collider=pin, outcome=press,
            low=(0.01, 0.0, -0.0125), high=(0.03, 0.1, 0.0125),
            steps=(2e-3, 2e-3, 2e-3), duration=0.6, dt=0.04,
        ),
    }  # fmt: skip


def over(function: Callable[..., Any], at_once: int) -> Callable[..., Any]:
    """``function(softness, parameters)`` for many parameters."""
    return jax.jit(lambda s, many: jax.lax.map(lambda one: function(s, one), many, batch_size=at_once))


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this study."""

    tasks: tuple[str, ...] = ("block on slab", "pin on dough")
    starts: int = 16
    at_once: int = 4
    """Starts that are computed together."""
    spacings: tuple[float, ...] = (0.025, 1 / 60)
    softness: tuple[float, ...] = (16.65, 8.0, 4.0, 2.3, 1.5)
    """Softness times spacing; 16.65 is the reference's 666 1/m on cells of 2.5 cm."""


def main(args: Args) -> None:
    jax.config.update("jax_enable_x64", True)
    enable_compilation_cache()
    columns = (
        "task", "cell", "softness x cell", "reach in cells", "cosine", "lowest tenth", "derivative / slope: quartiles",
        "spread", "gap",
    )  # fmt: skip
    print("| " + " | ".join(columns) + " |")
    print("|" + "---|" * len(columns))
    for name in args.tasks:
        task = tasks()[name]
        rng = np.random.default_rng(STARTS_SEED)
        starts = jnp.asarray(rng.uniform(task.low, task.high, (args.starts, len(task.low))))
        steps = np.asarray(task.steps)

        for spacing in args.spacings:
            base, x = make_scene(task, spacing)

            def run(softness, parameters, base=base, x=x, task=task):
                scene = base.replace(colliders=(base.colliders[0].replace(softness=softness),))
                return task.outcome(scene, x, round(task.duration / scene.dt), parameters)

            value, slope_of = (over(f, args.at_once) for f in (run, jax.grad(run, argnums=1, has_aux=True)))
            for scaled in args.softness:
                softness = jnp.asarray(scaled / spacing)
                gradient, gap = (np.asarray(a) for a in slope_of(softness, starts))
                assert np.isfinite(gradient).all()
                moved = [[np.asarray(value(softness, starts + s * d)[0]) for s in (1, -1)] for d in np.diag(steps)]
                change = np.stack([(a - b) / 2.0 for a, b in moved], axis=1)
                found = gradient * steps
                cosine = np.sum(found * change, 1) / np.maximum(
                    np.linalg.norm(found, axis=1) * np.linalg.norm(change, axis=1), 1e-30
                )
                ratio = np.quantile(found[:, 0] / change[:, 0], (0.25, 0.5, 0.75))
                numbers = (
                    f"{100 * spacing:.3g} cm | {scaled:g} | {math.log(10.0) / scaled:.2f} | {np.median(cosine):.3f} | "
                    f"{np.quantile(cosine, 0.1):.3f} | {ratio[0]:.2f}, {ratio[1]:.2f}, {ratio[2]:.2f} | "
                    f"{found[:, 0].std() / change[:, 0].std():.2f} | "
                    f"{1e3 * gap.mean():.1f} mm"
                )
                print(f"| {name} | {numbers} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
