"""SoftJumperMPM: the soft table of SoftJumper made of particles with muscle fibres, to compare the two solvers.

Body, actions, observations, reward and reset noise are those of SoftJumper; ``docs/soft_tasks.md`` lists the
differences. The grid moves with the table by whole cells, so the table may run any distance.
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
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.start_noise import reset_noise
from rewax.envs.kit.touching import moved_origin
from rewax.envs.tasks.soft_jumper import REFERENCE, SoftJumper
from rewax.physics import mpm, tets
from rewax.physics.mpm import Grid, Material, MPMScene, MPMState, Muscle, NeoHookean, Newtonian, Wall, WallKind, Walls
from rewax.physics.numerics import Pose
from rewax.physics.tets import tetmesh
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Key, PyTree

BOX = (5.6, 6.4, 5.6)
"""Edges of the grid's box [m]. The table is 2.5 m wide and 1.8 m high."""

SINK = 0.2
"""Depth below y = 0 of the nodes that stop the table, in cells. They act on particles above them. With this depth, the
return without actions is about that of SoftJumper."""


class Table(NamedTuple):
    """The particles of the table, in the order of the state."""

    positions: np.ndarray
    """Positions [m], shape (num_particles, 3). First come the nearest to each vertex of the tets, in their order."""
    muscle: np.ndarray
    """Index of the action component that drives each particle: that of its tet, shape (num_particles,)."""
    fibre: np.ndarray
    """Direction of the fibres, shape (num_particles, 3): upright in the legs, along x in the slab."""


@struct.dataclass
class SoftJumperMPM(SoftJumper):
    """The task; ``rewax.make("SoftJumperMPM", scale=...)`` builds it.

    Each of the 222 components of an action contracts (positive) or extends the fibres of the particles in two tets of
    SoftJumper's mesh.

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
        """The stretch of the reset noise strains the body, as it strains the tets of SoftJumper."""
        del key
        soft = self.at_rest(positions)
        extent, rest = (jnp.ptp(x[:, 0]) for x in (positions, self.rest_positions))
        return soft.replace(F=soft.F * (extent / rest)), None

    def _move(self, scene: MPMScene, soft: MPMState, poses: Pose) -> tuple[MPMState, Any, Array]:
        """The same substeps in a box that is shifted by whole cells to the table, which changes nothing else."""
        away = jax.lax.stop_gradient(soft.x.mean(0)) * jnp.array([1.0, 0.0, 1.0])
        shift = jnp.round(away / scene.grid.spacing) * scene.grid.spacing
        end, felt, status = super()._move(scene, soft.replace(x=soft.x - shift), poses)
        return end.replace(x=end.x + shift), moved_origin(felt, shift), status

    @property
    def default_camera(self) -> Camera:
        return overlooking((0.5, 1.0, 0.15), 5.5, up=self.up)


@functools.cache
def table(per_cell: int) -> Table:
    """The particles of SoftJumper's table, ``per_cell`` of them along each edge of each of its cells."""
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
    # Points of a lattice lie on faces of tets. A small shift puts each into one tet.
    off = points + 1e-4 * tetmesh.TABLE_CELL * np.array([1.0, 2.3, 3.7])
    weights = np.einsum("tij,ntj->nti", inverse, off[:, None] - corners[:, 0])
    return np.minimum(weights.min(axis=-1), 1.0 - weights.sum(axis=-1)).argmax(axis=1)


def _soft_jumper(steps: Substeps, *, per_cell: int, max_active_nodes: int, **changes: Any) -> SoftJumperMPM:
    """A table with ``per_cell`` particles along each edge of its cells. A cell of the grid has two along each axis."""
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
        dt=steps.dt,
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
        num_substeps=steps.num,
        **options,
    )


def paper(*, dt: float | None = None, num_substeps: int | None = None) -> SoftJumperMPM:
    """2970 particles; control steps and episodes are those of SoftJumper."""
    steps = substeps(dt, num_substeps, Substeps(1.0 / 60.0 / 16.0, 16))
    return _soft_jumper(steps, per_cell=3, max_active_nodes=5120)


def small(*, dt: float | None = None, num_substeps: int | None = None) -> SoftJumperMPM:
    """880 particles; episodes and noise are those of SoftJumper at this scale."""
    return _soft_jumper(
        substeps(dt, num_substeps, Substeps(1.0 / 60.0 / 8.0, 8)),
        per_cell=2,
        max_active_nodes=2048,
        max_steps=90,
        noise=reset_noise((-0.8, 0.0, -0.8), (0.8, 0.1, 0.8), 0.02),
    )
