"""The worlds of ``identify_cases.py``: a body, a pin that pushes it, and what is unknown.

All bodies stand on a floor that grips, on a node of all grids. The pin is that of RollingFlat, but its contact reaches
one cell (``softness=None``): with a reach of less, bodies sink half a cell into it, and what is found depends on the
grid. Each kind has a push that is fitted and another one that is held out.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

import rewax
from rewax.envs.kit.soft_parts import box_walls, lattice_box
from rewax.envs.randomize import LogUniform, Uniform
from rewax.physics import mpm

FLOOR = 1.0 / 12.0
RADIUS = 0.05
_MODULUS, _YIELD = "scene.material.elasticity.youngs_modulus", "scene.material.plasticity.yield_stress"


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of world.

    Attributes:
      material: with numbers at which every substep is stable.
      priors: of the unknowns, by name.
      size: of the body [m].
      gravity: [m/s^2], downwards.
      substeps: of a control step of 7 ms on a grid of 24 cells a metre; finer grids have more in proportion.
      start: x and height of the pin above the floor [m].
      push, held_out: stretches of constant actions: their number, along x, and upwards.
    """

    material: mpm.Material
    priors: dict[str, Any]
    size: tuple[float, float, float]
    gravity: float
    substeps: int
    start: tuple[float, float]
    push: tuple[tuple[int, float, float], ...]
    held_out: tuple[tuple[int, float, float], ...]

    def actions(self, held_out: bool = False) -> np.ndarray:
        """Of the fitted push or of the held-out one, shape (num_steps, 3), fractions of 2 cm and 4 mm."""
        pushes = self.held_out if held_out else self.push
        return np.concatenate([np.tile([x, y, 0.0], (n, 1)) for n, x, y in pushes]).astype(np.float32)

    def truth(self, case: int) -> dict[str, float]:
        """True numbers: draws from the priors."""
        generator = np.random.Generator(np.random.PCG64(1000 + case))
        return {name: _drawn(prior, generator) for name, prior in self.priors.items()}

    def median(self) -> dict[str, float]:
        """The priors' medians."""
        middle = {LogUniform: lambda p: (p.low * p.high) ** 0.5, Uniform: lambda p: 0.5 * (p.low + p.high)}
        return {name: middle[type(prior)](prior) for name, prior in self.priors.items()}


def _drawn(prior: Any, generator: np.random.Generator) -> float:
    if isinstance(prior, LogUniform):
        return float(np.exp(generator.uniform(np.log(prior.low), np.log(prior.high))))
    return float(generator.uniform(prior.low, prior.high))


def _solid(youngs_modulus: float, density: float, poissons_ratio: float = 0.2, plasticity: Any = None) -> mpm.Material:
    elasticity = mpm.Hencky(youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio)
    return mpm.Material(density=density, elasticity=elasticity, plasticity=plasticity)


_DOUGH = _solid(750.0, 1.0, plasticity=mpm.VonMises(yield_stress=15.0))
_PRESSED = {"size": (0.3, 0.125, 0.3), "gravity": 90.0, "substeps": 20, "start": (0.5, 0.175)}
_BLOCK = {"size": (0.2, 0.16, 0.3), "gravity": 90.0, "substeps": 14, "start": (0.5, 0.21)}
_HEAP = {"size": (0.2, 0.16, 0.3), "gravity": 9.81, "substeps": 10, "start": (0.3, 0.08)}
_SLUMP, _SWEEP = ((16, 0.1, 1.0), (16, 0.8, -0.5)), ((32, 0.4, 0.0),)
KINDS = {
    "dough": Kind(
        material=_DOUGH, priors={_MODULUS: LogUniform(300.0, 3000.0), _YIELD: LogUniform(8.0, 80.0)}, **_PRESSED,
        push=((12, 0.3, -1.0), (4, 0.3, 1.0)), held_out=((6, -0.4, -1.0), (8, 0.6, -0.5), (2, 0.0, 1.0)),
    ),
    "elastic": Kind(
        material=_solid(200.0, 1.0, 0.3), **_BLOCK,
        priors={_MODULUS: LogUniform(60.0, 600.0), "scene.material.elasticity.poissons_ratio": Uniform(0.05, 0.4)},
        push=((6, 0.2, -1.0), (10, 0.0, 1.0)), held_out=((10, -0.4, -1.0), (6, 0.0, 1.0)),
    ),
    "sand": Kind(
        material=_solid(1e5, 1000.0, plasticity=mpm.DruckerPrager(friction_angle=0.4)), **_HEAP,
        priors={"scene.material.plasticity.friction_angle": LogUniform(0.1, 1.0)}, push=_SLUMP, held_out=_SWEEP,
    ),
    "water": Kind(
        material=mpm.Material(
            density=1000.0, elasticity=mpm.QuadraticFluid(youngs_modulus=1e5, poissons_ratio=0.3),
            viscosity=mpm.Newtonian(viscosity=30.0),
        ),
        priors={"scene.material.viscosity.viscosity": LogUniform(10.0, 100.0)}, **_HEAP, push=_SLUMP, held_out=_SWEEP,
    ),
    "friction": Kind(
        material=_solid(200.0, 1.0, 0.3), priors={"scene.colliders[0].friction": LogUniform(0.1, 1.0)}, **_BLOCK,
        push=((8, 0.0, -1.0), (8, 0.3, 0.0)), held_out=((6, 0.0, -1.0), (8, -0.4, -0.2), (2, 0.0, 1.0)),
    ),
}  # fmt: skip
"""Doughs, elastic blocks, heaps of sand, thick water with a paddle; and the friction of the tool on a known block."""


def world(
    kind: Kind, cells: int, spacing: float, *, shake: float = 0.0, seed: int = 0, softness: float | None = None,
    thinner: float = 0.0,
) -> Any:  # fmt: skip
    """A world on a grid of ``cells`` a metre.

    Args:
      kind: of ``KINDS``.
      cells: a metre.
      spacing: of the particles [m].
      shake: displacement of particles in cells of their lattice; 0: a lattice.
      seed: of the displacement.
      softness: of the pin, see ``Collider`` [1/m].
      thinner: by how much the radius of the pin is below ``RADIUS`` [m].
    """
    substeps = round(kind.substeps * cells / 24)
    env: Any = rewax.make("RollingFlat", scale="small", num_substeps=substeps)
    counts = tuple(max(2, round(length / spacing)) for length in kind.size)
    center = (0.5, FLOOR + 0.5 * kind.size[1], 0.5)
    rest = np.asarray(lattice_box(center, kind.size, counts))
    generator = np.random.Generator(np.random.PCG64(seed))
    rest = rest + shake * generator.uniform(-0.5, 0.5, rest.shape) * np.asarray(kind.size) / np.asarray(counts)
    dx = 1.0 / cells
    pins = tuple(
        c.replace(softness=softness, shape=c.shape.replace(radius=RADIUS - thinner)) for c in env.scene.colliders
    )
    low, reach = np.array([0.0625, FLOOR - 2.0 * dx, 0.125]), np.array([0.9, 0.36, 0.76])
    shape = [int(np.ceil(length * cells)) for length in reach]
    scene = mpm.make_scene(
        grid=mpm.Grid(shape=(shape[0], shape[1], shape[2]), spacing=dx, origin=tuple(low)),
        dt=env.scene.dt, material=kind.material, particle_volume=float(np.prod(kind.size)) / len(rest),
        gravity=(0.0, -kind.gravity, 0.0), colliders=pins,
        walls=box_walls(floor=FLOOR, lower=(0.15, 0.25), upper=(0.85, 0.75)),
    )  # fmt: skip
    x, height = kind.start
    return env.replace(
        scene=scene, rest_positions=jnp.asarray(rest, jnp.float32),
        joint_start=jnp.asarray([x, FLOOR + height, 0.0]),
        joint_lower=jnp.asarray([0.2, FLOOR + RADIUS + 0.02, -1.0]), joint_upper=jnp.asarray([0.8, FLOOR + 0.25, 1.0]),
    )  # fmt: skip


__all__ = ["FLOOR", "KINDS", "Kind", "world"]
