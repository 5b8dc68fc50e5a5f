"""Random crumples of a sheet and random knots of a rope, in batches of equal shape, for ``crumples.py``.

A case draws its size, material, contact law and motion. Its ``max_speed`` is ``thin.largest_safe_speed``. ``scale`` says
how fast it is driven: at 1, as fast as ``max_speed`` or slower.
"""

import dataclasses
import functools
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


class Drive(NamedTuple):
    """The motion that is prescribed, at scale 1."""

    held: jax.Array
    """Waypoints of the held vertices [m], shape (num_waypoints, num_held, 3)."""
    walls: jax.Array
    """Distance of the walls from the middle at the start and at the end [m], shape (2,)."""
    v: jax.Array
    """Velocity of the vertices at the start [m/s], shape (num_vertices, 3)."""
    speed: jax.Array
    """Speed of walls and held vertices [m/s], shape ()."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One case, and what its row says about it."""

    scene: Any
    state: Any
    drive: Drive
    about: dict[str, Any]


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Uniform in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


# --- Sheets -----------------------------------------------------------------------------------------------------------


def crumples(num_cells: int, count: int, seed: int) -> list[Case]:
    """Sheets of ``num_cells`` x ``num_cells`` cells, all kinds in turn."""
    rng = np.random.default_rng((seed, num_cells))
    drawn = [_sheet_numbers(rng, num_cells, KINDS[n % 3]) for n in range(count)]
    build = functools.partial(_sheet_scene, num_cells)
    return _with_common_dt(build, drawn, lambda scene, own: _sheet_motion(scene, own, num_cells))


def _sheet_numbers(rng: np.random.Generator, num_cells: int, kind: str) -> dict[str, Any]:
    """Times are those of a membrane's wave across a cell, and of the contact's spring with a vertex's mass."""
    return {
        "rng": rng.spawn(1)[0],
        "kind": kind,
        "cell": between(rng, 0.01, 0.05),
        "thickness": rng.uniform(0.12, 0.33),
        "density": between(rng, 0.05, 0.5),
        "wave": between(rng, 1e-3, 3e-3),
        "spring": between(rng, 8e-4, 3e-3),
        "bending": between(rng, 1e-5, 1e-2),
        "damping": rng.uniform(0.0, 0.1),
        "pair_damping": rng.uniform(0.0, 0.5),
        "friction": rng.uniform(0.0, 0.6),
    }


def _sheet_scene(num_cells: int, own: dict[str, Any]) -> Any:
    a, mass = own["cell"], own["density"] * own["cell"] ** 2
    stretch = own["density"] * (a / own["wave"]) ** 2
    cloth = thin.Cloth(
        warp=stretch, weft=stretch, coupling=0.3 * stretch, shear=0.35 * stretch, bending=own["bending"] * stretch * a**2,
        bending_ratio=0.3, density=own["density"], damping=own["damping"] * own["wave"],
    )  # fmt: skip
    spring = mass / own["spring"] ** 2
    contact = PenaltyContact(
        stiffness=spring, damping=0.3 * mass / own["spring"], friction_damping=0.2 * mass / own["spring"]
    )
    walls = tuple(Collider(shape=Plane(), body=k, friction=0.2) for k in range(6))
    return thin.make_scene(
        mesh=thin.sheet(num_cells * a, num_cells * a, num_cells, num_cells),
        dt=1e-9, cloth=cloth, drag=0.5, gravity=(0.0, 0.0, 0.0), held=[0, (num_cells + 1) ** 2 - 1],
        contact=contact, colliders=walls, self_contact=_law(own, own["thickness"] * a, mass),
    )  # fmt: skip


def _law(own: dict[str, Any], thickness: float, mass: float) -> thin.SelfContact:
    rate = mass / own["spring"]
    return thin.SelfContact(
        thickness=thickness, stiffness=rate / own["spring"], damping=own["pair_damping"] * rate, friction=own["friction"],
        friction_damping=0.2 * rate, max_speed=1e-9, every=EVERY, pairs_per_element=16,
    )  # fmt: skip


def _sheet_motion(scene: Any, own: dict[str, Any], num_cells: int) -> Case:
    rng, kind, a = own["rng"], own["kind"], own["cell"]
    size, limit = num_cells * a, float(scene.self_contact.max_speed)
    mesh = thin.sheet(size, size, num_cells, num_cells)
    x = np.asarray(mesh.vertices) - [size / 2, 0.0, size / 2] + 0.03 * a * rng.standard_normal(mesh.vertices.shape)
    v, far = np.zeros_like(x), 10.0 * size
    walls, held = np.array([far, far]), np.repeat(x[None, [0, -1]], WAYPOINTS, axis=0)
    if kind == "walls":
        room = (size**2 * own["thickness"] * a / rng.uniform(0.08, 0.2)) ** (1 / 3)
        walls = np.array([0.5 * size + a, 0.5 * min(room, size)])
    elif kind == "corners":
        held = _waypoints(rng, x[[0, -1]], 0.4 * size, 3.0 * a)
    else:
        v = _velocity_field(rng, x, size) * limit
    if kind != "corners":
        scene = scene.replace(mobility=jnp.ones_like(scene.mobility))
    drive = Drive(*(jnp.asarray(n, jnp.float32) for n in (held, walls, v, 0.5 * limit)))
    about = {"group": f"{num_cells} x {num_cells}", "kind": kind, "size": size, "thickness": own["thickness"] * a}
    return Case(scene, thin.initial_state(jnp.asarray(x, jnp.float32)), drive, about | {"max_speed": limit})


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


# --- Ropes ------------------------------------------------------------------------------------------------------------


def knots(thickness: float, count: int, seed: int) -> list[Case]:
    """Ropes in a loose overhand knot.

    Args:
      thickness: over the length of a segment; each case has up to 8 % more or less.
    """
    rng = np.random.default_rng((seed, round(100 * thickness)))
    drawn = [_rope_numbers(rng, thickness) for _ in range(count)]
    return _with_common_dt(_rope_scene, drawn, _rope_motion)


def _rope_numbers(rng: np.random.Generator, thickness: float) -> dict[str, Any]:
    segment = between(rng, 0.005, 0.05)
    shape = np.array([2.0, 0.9, 1.2]) * rng.uniform(0.92, 1.08, 3)
    return {
        "rng": rng.spawn(1)[0],
        "segment": segment,
        "thickness": thickness * rng.uniform(0.92, 1.08),
        "points": overhand(*shape) * segment,
        "density": between(rng, 0.01, 0.1),
        "wave": between(rng, 5e-4, 2e-3),
        "spring": between(rng, 5e-4, 2e-3),
        "bending": between(rng, 1e-4, 1e-2),
        "pair_damping": rng.uniform(0.0, 0.5),
        "friction": rng.uniform(0.0, 0.4),
    }


def overhand(far: float, near: float, high: float) -> np.ndarray:
    """A trefoil on a torus, opened at its outside, with ends that point away; segments of length 1."""
    t = np.linspace(0.2, 2.0 * np.pi - 0.2, 4001)
    radius = far + near * np.cos(3.0 * t)
    p = np.stack([radius * np.cos(2.0 * t), radius * np.sin(2.0 * t), high * np.sin(3.0 * t)], axis=-1)
    tail = 0.07 * np.linalg.norm(np.diff(p, axis=0), axis=-1).sum()
    p = np.concatenate([p[:1] + tail * np.array([0.6, 0.8, 0.0]), p, p[-1:] + tail * np.array([0.6, -0.8, 0.0])])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=-1))])
    at = np.linspace(0.0, along[-1], SEGMENTS + 1)
    return np.stack([np.interp(at, along, p[:, k]) for k in range(3)], axis=-1) / at[1]


def _rope_scene(own: dict[str, Any]) -> Any:
    a, mass = own["segment"], own["density"] * own["segment"]
    stretch = own["density"] * (a / own["wave"]) ** 2
    rope = thin.Rope(stretch=stretch, bending=own["bending"] * stretch * a**2, density=own["density"], damping=1e-4)
    law = _law(own, own["thickness"] * a, mass)
    return thin.make_scene(
        mesh=thin.rope(own["points"]), dt=1e-9, rope=rope, drag=5.0, gravity=(0.0, 0.0, 0.0), held=[0, SEGMENTS],
        self_contact=law,
    )  # fmt: skip


def _rope_motion(scene: Any, own: dict[str, Any]) -> Case:
    limit, x = float(scene.self_contact.max_speed), own["points"]
    away = SEGMENTS * own["segment"] * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    held = np.stack([x[[0, -1]], x[[0, -1]] + away])
    drive = Drive(*(jnp.asarray(n, jnp.float32) for n in (held, (0.0, 0.0), np.zeros_like(x), 0.95 * limit)))
    thickness = own["thickness"] * own["segment"]
    about = {"group": f"knot {own['thickness']:.1f}", "kind": "knot", "size": SEGMENTS * own["segment"]}
    state = thin.initial_state(jnp.asarray(x, jnp.float32))
    return Case(scene, state, drive, about | {"thickness": thickness, "max_speed": limit})


# --- Batches ----------------------------------------------------------------------------------------------------------


def _with_common_dt(build: Any, drawn: list[dict[str, Any]], motion: Any) -> list[Case]:
    """Cases whose scenes differ in numbers alone: one dt, 0.9 of the smallest stable one, and one tree for the search."""
    scenes = [build(own) for own in drawn]
    dt = 0.9 * min(float(thin.largest_stable_dt(scene)) for scene in scenes)
    scenes = [_at_limit(scene.replace(dt=dt)) for scene in scenes]
    first = scenes[0].contact_elements
    for scene in scenes:
        own = scene.contact_elements
        assert np.array_equal(own.near_edges, first.near_edges) and np.array_equal(own.near_triangles, first.near_triangles)
    same = [scene.replace(contact_elements=first, topology=scenes[0].topology) for scene in scenes]
    return [motion(scene, own) for scene, own in zip(same, drawn, strict=True)]


def _at_limit(scene: Any) -> Any:
    """The scene with the largest speed that ``make_scene`` accepts."""
    limit = 0.999 * float(thin.largest_safe_speed(scene))
    return scene.replace(self_contact=scene.self_contact.replace(max_speed=limit))


def wall_poses(distance: jax.Array) -> Pose:
    """Poses of six walls at ``distance`` [m] from the middle, shape (num,); their normals point to the middle."""
    turns = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            y = sign * np.eye(3)[axis]
            x = np.eye(3)[(axis + 1) % 3]
            turns.append(np.stack([x, y, np.cross(x, y)], axis=1))
    rotation = jnp.asarray(np.stack(turns), jnp.float32)
    position = -rotation[:, :, 1] * distance[:, None, None]
    return Pose(position, jnp.broadcast_to(rotation, (len(distance), 6, 3, 3)))


__all__ = ["EVERY", "KINDS", "Case", "Drive", "crumples", "knots", "overhand", "wall_poses"]
