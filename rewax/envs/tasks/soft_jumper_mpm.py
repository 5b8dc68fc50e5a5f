"""SoftJumperMPM: the soft table of SoftJumper made of particles, with muscle fibres, so that solvers can be compared.

Body, actions, observations, reward and reset noise are those of SoftJumper; ``docs/soft_tasks.md`` says what differs.
The table can run as far as it likes: the grid's box goes with it by whole cells.
"""

# Its base class has tetrahedra where this one has particles: types that a checker cannot follow.
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportIncompatibleMethodOverride=false
# pyright: reportOptionalMemberAccess=false, reportArgumentType=false

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.start_noise import reset_noise
from rewax.envs.tasks.soft_jumper import REFERENCE, SoftJumper
from rewax.physics import mpm, tets
from rewax.physics.mpm import Grid, Material, MPMScene, MPMState, Muscle, NeoHookean, Newtonian, Wall, WallKind, Walls
from rewax.physics.numerics import Pose
from rewax.physics.tets import tetmesh
from rewax.types import Array, Key, PyTree

BOX = (5.6, 6.4, 5.6)
"""Of the grid [m]: the table is 2.5 m wide and 1.8 m high."""

SINK = 0.2
"""How far below y = 0 the nodes lie that stop the table, in cells. They begin to act before particles reach them; with
this, doing nothing earns about what it earns with tetrahedra."""


class Table(NamedTuple):
    """The table as particles, in the order in which tasks hold them."""

    positions: np.ndarray
    """Those nearest to the tets' vertices come first, in the vertices' order [m], shape (num_particles, 3)."""
    muscle: np.ndarray
    """Which action drives each: that of the tet in which it lies, shape (num_particles,)."""
    fibre: np.ndarray
    """Upright in the legs, along x in the slab, shape (num_particles, 3)."""


@struct.dataclass
class SoftJumperMPM(SoftJumper):
    """The environment; build it with ``rewax.make("SoftJumperMPM", scale=...)``.

    An action pulls (positive) or pushes along the fibres of the particles in two tets of SoftJumper's mesh, 222 in all.

    Attributes:
      strength: muscle stress for action 1 [Pa].
      start_height: mean height of the particles at rest [m].
      per_cell: particles along each edge of the table's cells (static).
    """

    per_cell: int = struct.static_field()

    @property
    def num_actions(self) -> int:
        return int(table(self.per_cell).muscle.max()) + 1

    def actuated(self, action: Array) -> MPMScene:
        activation = self.strength * action[table(self.per_cell).muscle]
        material = self.scene.material
        return self.scene.replace(material=material.replace(muscle=material.muscle.replace(activation=activation)))

    def start(self, positions: Array, key: Key) -> tuple[MPMState, PyTree]:
        """Strained as the noise stretches it, like SoftJumper's tets."""
        del key
        soft = self.at_rest(positions)
        extent, rest = (jnp.ptp(x[:, 0]) for x in (positions, self.rest_positions))
        return soft.replace(F=soft.F * (extent / rest)), None

    def _move(self, scene: MPMScene, soft: MPMState, poses: Pose) -> tuple[MPMState, Array]:
        """In a box that has moved by whole cells to where the table is: physics is the same wherever it is."""
        away = jax.lax.stop_gradient(soft.x.mean(0)) * jnp.array([1.0, 0.0, 1.0])
        shift = jnp.round(away / scene.grid.spacing) * scene.grid.spacing
        end, status = super()._move(scene, soft.replace(x=soft.x - shift), poses)
        return end.replace(x=end.x + shift), status


@functools.cache
def table(per_cell: int) -> Table:
    """SoftJumper's table with so many particles along each edge of its cells, each cubed a cell's volume."""
    mesh, h = tets.soft_jumper_table(), tetmesh.TABLE_CELL
    low = mesh.vertices.min(axis=0)
    occupied = np.zeros((7, 5, 7), bool)
    occupied[:, 3:] = True
    occupied[np.ix_((0, 6), (0, 1, 2), (0, 6))] = True
    inside = (np.stack(np.meshgrid(*[np.arange(per_cell)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) / per_cell
    cells = np.repeat(np.argwhere(occupied), len(inside), axis=0)
    positions = low + h * (cells + np.tile(inside, (int(occupied.sum()), 1)))
    nearest = np.linalg.norm(mesh.vertices[:, None] - positions, axis=-1).argmin(axis=1)
    order = np.concatenate([nearest, np.setdiff1d(np.arange(len(positions)), nearest)])
    upright = (cells[:, 1] < 3)[:, None]
    fibre = np.where(upright, [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    return Table(positions[order], (_tets_around(mesh, positions[order]) // 2).astype(np.int32), fibre[order])


def _tets_around(mesh: tetmesh.TetMesh, points: np.ndarray) -> np.ndarray:
    """The tet in which each point lies, shape (num_points,)."""
    corners = mesh.vertices[mesh.tets]
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    # Points of a lattice lie on faces: a little off, each is in one tet.
    off = points + 1e-4 * tetmesh.TABLE_CELL * np.array([1.0, 2.3, 3.7])
    weights = np.einsum("tij,ntj->nti", inverse, off[:, None] - corners[:, 0])
    return np.minimum(weights.min(axis=-1), 1.0 - weights.sum(axis=-1)).argmax(axis=1)


def _soft_jumper(*, per_cell: int, dt: float, max_active_nodes: int, **changes: Any) -> SoftJumperMPM:
    """A table of so many particles a cell, two for each node along an axis."""
    r, body = REFERENCE, table(per_cell)
    elastic = tets.small_strain_moduli(r["mu"], r["lam"])
    spacing = 2.0 * tetmesh.TABLE_CELL / per_cell
    floor = -SINK * spacing
    ground = Wall(position=floor + 0.01, kind=WallKind.SEPARATING, friction=r["friction"])
    counts = [int(np.ceil(edge / spacing)) for edge in BOX]
    scene = mpm.make_scene(
        grid=Grid(
            shape=(counts[0] + 1, counts[1] + 1, counts[2] + 1),
            spacing=spacing,
            origin=(-0.5 * counts[0] * spacing, floor - 2.0 * spacing, -0.5 * counts[2] * spacing),
        ),
        dt=dt,
        material=Material(
            density=r["density"],
            elasticity=NeoHookean(youngs_modulus=elastic.youngs_modulus, poissons_ratio=elastic.poissons_ratio),
            viscosity=Newtonian(
                viscosity=0.5 * r["damping"]
            ),  # damping acts on dF/dt, viscosity on twice its symmetric part
            muscle=Muscle(fibre=body.fibre, activation=np.zeros(len(body.positions))),
        ),
        particle_volume=(tetmesh.TABLE_CELL / per_cell) ** 3,
        gravity=(0.0, r["gravity"], 0.0),
        walls=Walls(lower=(None, ground, None), upper=(None, None, None)),
        max_active_nodes=max_active_nodes,
    )
    rest = jnp.asarray(body.positions + np.array([0.0, r["height"], 0.0]), jnp.result_type(float))
    options = {
        "max_steps": r["max_steps"],
        "noise": reset_noise(r["shift_lower"], r["shift_upper"], r["stretch"]),
        **changes,
    }
    return SoftJumperMPM(
        scene=scene,
        rest_positions=rest,
        cloud=PointCloud(num_points=r["num_observed"]),
        strength=r["strength"] * r["lam"],
        effort=r["effort"],
        start_height=rest[:, 1].mean(),
        per_cell=per_cell,
        **options,
    )


def paper() -> SoftJumperMPM:
    """2970 particles and SoftJumper's control steps and episodes."""
    return _soft_jumper(per_cell=3, dt=1.0 / 60.0 / 16.0, max_active_nodes=5120, num_substeps=16)


def small() -> SoftJumperMPM:
    """880 particles, and SoftJumper's shorter episodes and smaller noise at this scale."""
    return _soft_jumper(
        per_cell=2,
        dt=1.0 / 60.0 / 8.0,
        max_active_nodes=2048,
        num_substeps=8,
        max_steps=90,
        noise=reset_noise((-0.8, 0.0, -0.8), (0.8, 0.1, 0.8), 0.02),
    )
