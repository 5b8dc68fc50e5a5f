"""A box floats in water as deep as Archimedes says: what it displaces weighs as much as the box.

Water (Tait's law) in plane strain and a free rigid box, coupled both ways. The box is let go below its equilibrium,
bobs, and comes to rest; how deep it lies is measured from the level at which the water beside it stands. The water
sticks to the box, as water does. (A box that it slips along lies 5 to 7 % too deep, at any resolution: nodes inside
the box, near its lower edges but nearer to its sides, are then free to move up.)
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import fill, fit_oscillation, held, relative, save
from rewax.physics import coupling, mpm
from rewax.physics.contact import Collider
from rewax.physics.coupling import FreeBodies, free_body
from rewax.physics.mpm import TAIT_EXPONENT, Grid, Material, Newtonian, Tait, Wall, Walls
from rewax.physics.shapes import Box

CELLS = {"tiny": 20, "small": 32, "full": 48}
"""Over the depth of the water."""
DENSITIES = {"tiny": (0.7,), "small": (0.7,), "full": (0.5, 0.8)}
"""Of the box, as fractions of the water's."""
WIDTH, DEPTH, GRAVITY, WATER = 2.4, 1.0, 9.81, 1000.0
HALF_WIDTH, HALF_HEIGHT = 0.6, 0.25
SPEED = 6.0 * float(np.sqrt(GRAVITY * DEPTH))
TOO_DEEP = 0.05
"""How far from rest the box begins [m]."""
DURATION, NUM_SAMPLES = 3.0, 100
NO_SLIP = 100.0
"""Friction coefficient with which water sticks to the box."""
SETTLED = NUM_SAMPLES // 4
"""Samples before this one are not used: the water gets used to the box."""
VISCOSITY = 100.0
"""Of the water [Pa s]: it damps the bobbing within a few swings."""


def tank(cells: int, density: float) -> tuple[mpm.MPMScene, free_body.Inertia, mpm.MPMState, FreeBodies]:
    """The water at rest around a box of the given density [kg/m^3], a little deeper than it will lie."""
    spacing, draft = DEPTH / cells, 2 * HALF_HEIGHT * density / WATER + TOO_DEEP
    center = np.array([0.5 * WIDTH, DEPTH - draft + HALF_HEIGHT, 0.0])
    x = fill((0.0, 0.0), (WIDTH, DEPTH), spacing)
    box = Box(half_size=jnp.asarray([HALF_WIDTH, HALF_HEIGHT, 1.0]))
    x = x[(np.abs(x - center) > [HALF_WIDTH, HALF_HEIGHT, 1.0]).any(axis=1)]
    # Contact begins half a cell away: on average that is where nodes on both sides of a face put the water's border.
    collider = Collider(shape=box, friction=NO_SLIP, softness=np.log(10.0) / (0.5 * spacing))
    near, far = Wall(position=0.01 * spacing), Wall(position=WIDTH - 0.01 * spacing)
    scene = mpm.make_scene(
        grid=Grid(
            shape=(round(WIDTH * cells) + 5, round(1.5 * cells) + 5, 4),
            spacing=spacing,
            origin=(-2 * spacing, -2 * spacing, -spacing),
        ),
        dt=0.3 * spacing / SPEED,
        material=Material(
            density=WATER,
            elasticity=Tait(speed_of_sound=SPEED),
            viscosity=Newtonian(viscosity=VISCOSITY),
        ),
        particle_volume=(spacing / 2) ** 3,
        gravity=(0.0, -GRAVITY, 0.0),
        colliders=(collider,),
        walls=Walls(lower=(near, near, held(spacing)), upper=(far, None, held(spacing))),
    )
    thickness = 0.5 * spacing
    mass, moment = free_body.solid(Box(half_size=jnp.asarray([HALF_WIDTH, HALF_HEIGHT, 0.5 * thickness])), density)
    inertia = free_body.Inertia(mass=jnp.asarray(mass)[None], moment=moment[None])
    state = mpm.initial_state(jnp.asarray(x), scene)
    # Compressed by its own weight from the start: p = rho g (H - y) with Tait's law solved for J.
    head = TAIT_EXPONENT * GRAVITY * (DEPTH - state.x[:, 1]) / SPEED**2
    side = (1.0 + head) ** (-1.0 / (3.0 * TAIT_EXPONENT))
    return scene, inertia, state.replace(F=side[:, None, None] * state.F), free_body.bodies_at_rest(center[None])


@jax.jit
def bob(scene: mpm.MPMScene, inertia: free_body.Inertia, state: mpm.MPMState, bodies: FreeBodies) -> Any:
    """Draft of the box, and the force on it over its weight, over time."""
    poses = mpm.static_poses(round(DURATION / NUM_SAMPLES / scene.dt))

    def sample(carry: Any, _: None) -> Any:
        state, bodies, wrench = coupling.step(scene, inertia, *carry, poses, store_every=None)
        x = state.x
        beside = jnp.abs(x[:, 0] - bodies.position[0, 0]) > HALF_WIDTH + 2 * scene.grid.spacing
        # Water of constant density is twice as high as its middle.
        level = 2.0 * jnp.sum(jnp.where(beside, x[:, 1], 0.0)) / jnp.sum(beside)
        draft = level - (bodies.position[0, 1] - HALF_HEIGHT)
        weight = inertia.mass[0] * GRAVITY
        return (state, bodies), (draft, wrench.force[0, 1] / weight)

    return jax.lax.scan(sample, (state, bodies), None, NUM_SAMPLES)


def run(scale: str = "small") -> dict[str, Any]:
    """Drafts over time, and at rest, for boxes of several densities."""
    checks, histories = [], {}
    times = (np.arange(NUM_SAMPLES) + 1) * DURATION / NUM_SAMPLES
    for fraction in DENSITIES[scale]:
        scene, inertia, state, bodies = tank(CELLS[scale], fraction * WATER)
        (end, _), (draft, force) = bob(scene, inertia, state, bodies)
        theory = 2 * HALF_HEIGHT * fraction
        omega = np.sqrt(GRAVITY / theory)
        at_rest = fit_oscillation(times[SETTLED:], draft[SETTLED:], omega)["mean"]
        bar = 0.1 if scale == "tiny" else 0.05  # a draft of five cells
        checks.append(relative(f"draft of a box of {fraction:g} of the water's density", at_rest, theory, bar, "m"))
        checks.append(relative("  force of the water over the box's weight", np.mean(force[SETTLED:]), 1.0, 0.02))
        histories[fraction] = np.asarray(draft)
    return {"checks": checks, "t": times, "drafts": histories, "x": np.asarray(end.x)}


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
    for fraction, draft in results["drafts"].items():
        (line,) = left.plot(results["t"], draft, lw=1.2, label=f"density {fraction:g} of the water's")
        left.axhline(2 * HALF_HEIGHT * fraction, color=line.get_color(), ls=":", lw=1)
    left.set(xlabel="time [s]", ylabel="draft [m]", title="dotted: Archimedes")
    left.legend(frameon=False, fontsize=8)
    right.plot(*results["x"][:, :2].T, ".", ms=1)
    right.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="the water at the end, last box")
    save(figure, path)
