"""Random crumples of a sheet and random knots of a rope for ``crumples.py``, as batches whose scenes differ in numbers.

A case draws its size, material, contact law and motion. Its ``max_speed`` is ``thin.largest_safe_speed``.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import thin
from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.penalty import PenaltyContact
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Plane

EVERY = 8
"""Substeps of a round of the search, and of a frame."""
SEGMENTS = 40
WAYPOINTS = 6
KINDS = ("walls", "corners", "throw")
UNIT = thin.Cloth(warp=1.0, weft=1.0, shear=0.35, coupling=0.3, density=1.0)


class Drive(NamedTuple):
    """The motion that is prescribed, at scale 1."""

    held: np.ndarray
    """Waypoints of the held vertices [m], shape (num_waypoints, num_held, 3)."""
    walls: np.ndarray
    """Distance of the walls from the middle at the start and at the end [m], shape (2,)."""
    v: np.ndarray
    """Velocity of the vertices at the start [m/s], shape (num_vertices, 3)."""
    speed: np.ndarray
    """Speed of walls and held vertices [m/s], shape ()."""


class Batch(NamedTuple):
    """Cases along the first axis of all arrays."""

    scene: Any
    x: np.ndarray
    """Positions at the start [m]."""
    drive: Drive
    rows: list[dict[str, Any]]
    """What the rows say about the cases."""


# --- Numbers ----------------------------------------------------------------------------------------------------------


class Numbers(NamedTuple):
    """What a case draws; arrays over the cases."""

    cell: np.ndarray
    """Side of a cell or length of a segment [m]."""
    thickness: np.ndarray
    """Over ``cell``."""
    density: np.ndarray
    """[kg/m^2], or [kg/m] of a rope."""
    wave: np.ndarray
    """Time in which a wave of stretch crosses a cell [s]."""
    spring: np.ndarray
    """sqrt(mass of a vertex / stiffness of contact) [s]."""
    bending: np.ndarray
    """Flexural rigidity over stretch times cell^2."""
    damping: np.ndarray
    """Kelvin-Voigt time over ``wave``."""
    pair_damping: np.ndarray
    """Over mass / spring."""
    friction: np.ndarray
    points: np.ndarray
    """Vertices at rest [m]."""


def drawn(rng: np.random.Generator, count: int, thickness: tuple[float, float], points: Any) -> Numbers:
    """Sizes and times are uniform in the logarithm, ratios uniform."""

    def size(low: float, high: float) -> np.ndarray:
        return np.exp(rng.uniform(np.log(low), np.log(high), count))

    cell, ratio = size(0.01, 0.05), rng.uniform(*thickness, count)
    return Numbers(
        cell=cell, thickness=ratio, density=size(0.05, 0.5), wave=size(1.3e-3, 2e-3),
        spring=size(8e-4, 1.6e-3), bending=size(1e-5, 3e-3), damping=rng.uniform(0.0, 0.05, count),
        pair_damping=rng.uniform(0.0, 0.5, count), friction=rng.uniform(0.0, 0.6, count),
        points=np.stack([a * points(h) for a, h in zip(cell, ratio, strict=True)]),
    )  # fmt: skip


def scenes(template: Any, numbers: Numbers) -> Any:
    """The template with the numbers of each case, 0.9 of the smallest stable dt of all, and each one's safe speed."""

    def one(own: Numbers) -> Any:
        is_rope = template.rope is not None
        mass = own.density * own.cell ** (1 if is_rope else 2)
        stretch = own.density * (own.cell / own.wave) ** 2
        bending, damping = own.bending * stretch * own.cell**2, own.damping * own.wave
        rest = thin.rest_shape(template.topology, own.points)
        cloth = rope = None
        if is_rope:
            rope = thin.Rope(stretch=stretch, bending=bending, density=own.density, damping=damping)
        else:
            cloth = UNIT.replace(
                warp=stretch, weft=stretch, coupling=0.3 * stretch, shear=0.35 * stretch, bending=bending,
                bending_ratio=0.3, density=own.density, damping=damping,
            )  # fmt: skip
        rate = mass / own.spring
        law = template.self_contact.replace(
            thickness=own.thickness * own.cell, stiffness=rate / own.spring, damping=own.pair_damping * rate,
            friction=own.friction, friction_damping=0.2 * rate,
        )  # fmt: skip
        contact = PenaltyContact(stiffness=rate / own.spring, damping=0.3 * rate, friction_damping=0.2 * rate)
        mass_of = thin.vertex_mass(template.topology, rest, cloth, rope)
        return template.replace(
            rest=rest, mass=mass_of, cloth=cloth, rope=rope, self_contact=law, contact=contact if cloth else None
        )

    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), numbers)
    found, stable = jax.jit(jax.vmap(lambda n: (one(n), thin.largest_stable_dt(one(n)))))(single)
    found = found.replace(dt=0.9 * float(stable.min()))
    safe = jax.jit(jax.vmap(lambda scene: 0.999 * thin.largest_safe_speed(scene)))(found)
    return found.replace(self_contact=found.self_contact.replace(max_speed=safe))


def _law(thickness: float) -> thin.SelfContact:
    return thin.SelfContact(
        thickness=thickness,
        stiffness=1e-3,
        damping=0.0,
        friction=0.0,
        friction_damping=0.0,
        max_speed=1e-6,
        every=EVERY,
        pairs_per_element=12,
    )


def _rows(batch: Any, numbers: Numbers, group: str, kinds: list[str]) -> list[dict[str, Any]]:
    limits = np.asarray(batch.self_contact.max_speed)
    values = zip(kinds, numbers.cell, numbers.thickness * numbers.cell, limits, strict=True)
    return [
        {"group": group, "kind": kind, "cell": f"{a:.4g}", "thickness": f"{h:.4g}", "max_speed": f"{v:.4g}"}
        for kind, a, h, v in values
    ]


# --- Sheets -----------------------------------------------------------------------------------------------------------


def crumples(num_cells: int, count: int, seed: int) -> Batch:
    """Sheets of ``num_cells`` x ``num_cells`` cells, all kinds in turn."""
    rng = np.random.default_rng((seed, num_cells))
    mesh = thin.sheet(float(num_cells), float(num_cells), num_cells, num_cells)
    template = thin.make_scene(
        mesh=mesh, dt=1e-5, cloth=UNIT, drag=0.5, gravity=(0.0, 0.0, 0.0), held=[0, len(mesh.vertices) - 1],
        contact=PenaltyContact(stiffness=1e-3, friction_damping=1e-6), self_contact=_law(0.3),
        colliders=tuple(Collider(shape=Plane(), body=k, friction=0.2) for k in range(4)),
    )  # fmt: skip
    numbers = drawn(rng, count, (0.12, 0.33), lambda thickness: rolled(rng, num_cells, thickness))
    batch = scenes(template, numbers)
    kinds = [KINDS[n % 3] for n in range(count)]
    limits = np.asarray(batch.self_contact.max_speed)
    own = zip(kinds, numbers.cell, numbers.thickness, limits, numbers.points, strict=True)
    each = [_motion(rng, num_cells, *one) for one in own]
    free = jnp.asarray([kind != "corners" for kind in kinds])[:, None]
    batch = batch.replace(mobility=jnp.where(free, 1.0, batch.mobility))
    x, drive = jax.tree.map(lambda *a: np.stack(a).astype(np.float32), *each)
    return Batch(batch, x, drive, _rows(batch, numbers, f"{num_cells} x {num_cells}", kinds))


def rolled(rng: np.random.Generator, num_cells: int, thickness: float) -> np.ndarray:
    """A sheet of cells of side 1 that is rolled up, or folded in zigzag, its layers a little more than touching apart.

    Cells along x keep their length.
    """
    turns, pitch = [0.0], 0.25 + rng.uniform(1.1, 1.6) * thickness
    if rng.random() < 0.5:
        for _ in range(num_cells - 1):
            radius = 0.8 + pitch * turns[-1] / (2.0 * np.pi)
            turns.append(turns[-1] + 1.0 / radius)
        angles = np.asarray(turns)
    else:
        panel = rng.integers(2, 4)
        slope = np.arccos(min(0.9, pitch / panel))
        angles = slope * np.where(np.arange(num_cells) // panel % 2 == 0, 1.0, -1.0)
    steps = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    line = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    line -= line.mean(axis=0)
    along = np.arange(num_cells + 1.0) - num_cells / 2
    return np.concatenate([np.repeat(line, num_cells + 1, axis=0), np.tile(along, num_cells + 1)[:, None]], axis=1)


def _motion(
    rng: np.random.Generator, num_cells: int, kind: str, a: float, thickness: float, limit: float, rest: np.ndarray
) -> tuple[np.ndarray, Drive]:
    size = num_cells * a
    x = rest + 0.03 * thickness * a * rng.standard_normal(rest.shape)
    v, walls, held = np.zeros_like(x), np.full(2, 10.0 * size), np.repeat(x[None, [0, -1]], WAYPOINTS, axis=0)
    if kind == "walls":
        room = np.sqrt(size * thickness * a / rng.uniform(0.35, 0.6))
        near = np.abs(x[:, :2]).max()
        walls = np.array([near + 0.2 * a, min(0.5 * room, 0.8 * near)])
    elif kind == "corners":
        held = _waypoints(rng, x[[0, -1]], 0.4 * size, 3.0 * a)
    else:
        v = _velocity_field(rng, x, size) * limit
    return x, Drive(held, walls, v, np.asarray(0.5 * limit))


def _waypoints(rng: np.random.Generator, start: np.ndarray, radius: float, apart: float) -> np.ndarray:
    """Random points in a ball; two held vertices keep ``apart`` on the straight ways between them."""
    path = [start]
    while len(path) < WAYPOINTS:
        points = rng.standard_normal((2, 3))
        points *= radius * rng.uniform(0.2, 1.0, (2, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
        ways = np.linspace(path[-1], points, 20)
        if np.linalg.norm(ways[:, 0] - ways[:, 1], axis=-1).min() > apart:
            path.append(points)
    return np.stack(path)


def _velocity_field(rng: np.random.Generator, x: np.ndarray, size: float) -> np.ndarray:
    """Waves of random directions and a contraction; the largest speed relative to the mean is 1."""
    v = -x * rng.uniform(0.5, 2.0) / size
    for _ in range(4):
        wave, push = rng.standard_normal(3) * 3.0 / size, rng.standard_normal(3)
        v = v + np.sin(x @ wave + rng.uniform(0.0, 2.0 * np.pi))[:, None] * push * rng.uniform(0.1, 0.5)
    v = v - v.mean(axis=0)
    return v / np.linalg.norm(v, axis=1).max()


def wall_poses(distance: jax.Array) -> Pose:
    """Poses of four walls around the z axis at ``distance`` [m], shape (num,); their normals point to the axis."""
    turns = []
    for axis in range(2):
        for sign in (1.0, -1.0):
            y, x = sign * np.eye(3)[axis], np.eye(3)[(axis + 1) % 3]
            turns.append(np.stack([x, y, np.cross(x, y)], axis=1))
    rotation = jnp.asarray(np.stack(turns), jnp.float32)
    position = -rotation[:, :, 1] * distance[:, None, None]
    return Pose(position, jnp.broadcast_to(rotation, (len(distance), 4, 3, 3)))


# --- Ropes ------------------------------------------------------------------------------------------------------------


def knots(thickness: tuple[float, float], count: int, seed: int) -> Batch:
    """Ropes in a loose overhand knot, whose ends are pulled apart.

    Args:
      thickness: its range, over the length of a segment; elements that are neighbours must be the same in all of it.
    """
    rng = np.random.default_rng((seed, round(100 * thickness[0])))
    template = thin.make_scene(
        mesh=thin.rope(overhand(2.0, 0.9, 1.2)), dt=1e-5, rope=thin.Rope(stretch=1.0, density=1.0), drag=5.0,
        gravity=(0.0, 0.0, 0.0), held=[0, SEGMENTS], self_contact=_law(float(np.mean(thickness))),
    )  # fmt: skip
    numbers = drawn(
        rng, count, thickness, lambda _: overhand(*(np.array([2.0, 0.9, 1.2]) * rng.uniform(0.92, 1.08, 3)))
    )
    batch = scenes(template, numbers)
    x, away = numbers.points, SEGMENTS * numbers.cell[:, None, None] * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    held = np.stack([x[:, [0, -1]], x[:, [0, -1]] + away], axis=1)
    drive = Drive(held, np.zeros((count, 2)), np.zeros_like(x), 0.95 * np.asarray(batch.self_contact.max_speed))
    x, drive = jax.tree.map(lambda a: np.asarray(a, np.float32), (x, drive))
    return Batch(batch, x, drive, _rows(batch, numbers, f"{thickness[0]:g} to {thickness[1]:g}", ["knot"] * count))


def overhand(far: float, near: float, high: float) -> np.ndarray:
    """A trefoil on a torus, opened at its outside, with ends that point away; segments of about length 1."""
    t = np.linspace(0.2, 2.0 * np.pi - 0.2, 4001)
    radius = far + near * np.cos(3.0 * t)
    p = np.stack([radius * np.cos(2.0 * t), radius * np.sin(2.0 * t), high * np.sin(3.0 * t)], axis=-1)
    tail = 0.07 * np.linalg.norm(np.diff(p, axis=0), axis=-1).sum()
    p = np.concatenate([p[:1] + tail * np.array([0.6, 0.8, 0.0]), p, p[-1:] + tail * np.array([0.6, -0.8, 0.0])])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=-1))])
    at = np.linspace(0.0, along[-1], SEGMENTS + 1)
    return np.stack([np.interp(at, along, p[:, k]) for k in range(3)], axis=-1) / at[1]


__all__ = ["EVERY", "KINDS", "Batch", "Drive", "crumples", "knots", "wall_poses"]
