"""A camera: depth, bodies and normals of what it sees, a pure function of the world."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import FINITE, POSITIVE, Legal, check_numbers, numbers_of, static_number
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.fields import real
from rewax.physics.numerics.pose import Pose, placed_at, turned
from rewax.sensors.hits import Hits, Rays, nearest
from rewax.sensors.noise import DepthNoise
from rewax.sensors.solids import see_solids
from rewax.sensors.surfaces import see_triangles
from rewax.sensors.world import NOTHING, World, frozen
from rewax.sensors.z_buffer import see_balls
from rewax.types import Array, Key, Scalar, Vector

_POINT = real(FINITE, "give three numbers", shape=(3,))
ZOOM = (0.5, 1.5)
"""A camera's zoom lies between these."""
_STATIC_NUMBERS = (
    ("field_of_view", Legal(0.0, 180.0), "give degrees between 0 and 180"),
    ("near", POSITIVE, "give a distance in metres, 0 < near < far"),
    ("far", POSITIVE, "give a finite distance in metres, 0 < near < far"),
)


class View(NamedTuple):
    """A picture. Row 0 is at the top, column 0 on the left."""

    depth: Array
    """Distance along the viewing direction [m], shape (height, width); ``far`` where nothing is seen."""
    label: Array
    """Object at each pixel: an index into ``World.names``, or ``NOTHING`` (-1), int32, shape (height, width)."""
    normal: Array
    """Unit normal of the surface in the world, towards the camera, zero where nothing is seen, (height, width, 3)."""


@struct.dataclass
class Camera(struct.Replaceable):
    """A pinhole camera that looks along its -z axis, x to the right and y up, as MuJoCo's do.

    ``Camera.look_at`` places one. Its depth is what a depth camera gives: the distance along the viewing direction.

    Attributes:
      position: of the pinhole [m], shape (3,), in the world or in the frame of ``body``.
      rotation: from the camera's frame to the world's or the body's, shape (3, 3).
      field_of_view: of the picture's height [degrees], between 0 and 180 (static).
      height, width: pixels (static).
      near: what is nearer is not seen [m], > 0 (static). It also bounds how many pixels a particle can cover, so a
        larger one is faster.
      far: depth of pixels that see nothing; what is farther is not seen [m] (static).
      zoom: factor of the focal length, above 0.5 and below 1.5; None: 1. Give 1 to make it a parameter, which can be
        drawn; it widens the window of pixels that each particle is written to.
      body: that carries the camera, an index; None: it stands still (static).
      noise: what ``see`` does to depth; None: nothing.
      gradient: whether the gradient flows from the picture into the world and the camera, see ``view`` (static).

    Raises:
      ValueError: an illegal number, a ``rotation`` that is none, or ``near`` not below ``far``. The message names the
        field and the remedy.
    """

    position: Vector = struct.number(FINITE, "give a position in metres", shape=(3,))
    rotation: Vector = struct.number(FINITE, "give a rotation matrix", shape=(3, 3))
    field_of_view: float = struct.static_field(default=45.0)
    height: int = struct.static_field(default=64)
    width: int = struct.static_field(default=64)
    near: float = struct.static_field(default=0.05)
    far: float = struct.static_field(default=10.0)
    zoom: Scalar | None = struct.number(Legal(*ZOOM), "give a factor, 1.0 for none", shape=(), default=None)
    body: int | None = struct.static_field(default=None)
    noise: DepthNoise | None = None
    gradient: bool = struct.static_field(default=False)

    def __post_init__(self) -> None:
        check_numbers(numbers_of(self, "Camera."))
        if not isinstance(self.rotation, Tracer):
            rotation = np.asarray(self.rotation, float)
            if not (np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0.0):
                raise ValueError(
                    f"Camera.rotation is {rotation.tolist()}, which is no rotation: give orthonormal columns, to the "
                    "right, up and backwards, or use Camera.look_at"
                )
        for name in ("height", "width", "body"):
            if isinstance(getattr(self, name), np.integer):
                object.__setattr__(self, name, int(getattr(self, name)))
        for name in ("height", "width"):
            size = getattr(self, name)
            if isinstance(size, bool) or not isinstance(size, int) or size < 1:
                raise ValueError(f"{name} of the camera is {size!r}: give an integer of pixels, at least 1")
        for name, legal, remedy in _STATIC_NUMBERS:
            object.__setattr__(self, name, static_number(name, getattr(self, name), legal, remedy))
        if self.body is not None and (isinstance(self.body, bool) or not isinstance(self.body, int) or self.body < 0):
            raise ValueError(f"body is {self.body!r}: give the index of a body, from 0 on, or None")
        if not (self.noise is None or isinstance(self.noise, DepthNoise)):
            raise ValueError(f"noise is of the type {type(self.noise).__name__}: give a DepthNoise, or None for none")
        if not self.near < self.far:
            raise ValueError(
                f"near is {self.near} and far {self.far}: give two distances in metres, 0 < near < far < infinity"
            )

    @classmethod
    def look_at(cls, target: Any, *, eye: Any, up: Any = (0.0, 1.0, 0.0), **fields: Any) -> "Camera":
        """A camera at ``eye`` that looks at ``target`` [m], shape (3,) each; ``fields`` are those of the class.

        Args:
          target, eye: in the world, or in the frame of ``body``.
          up: direction that is upwards in the picture; not that of the view.

        Raises:
          ValueError: one of them is no vector of finite numbers or is traced, eye and target are one point, or up is
            the direction of the view.
        """
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((target, eye, up))):
            raise ValueError(
                "target, eye or up is traced: make the camera outside jit, and replace its position and rotation inside"
            )
        for name, value in (("target", target), ("eye", eye), ("up", up)):
            _POINT(name, value)
        eye, target = np.asarray(eye, float), np.asarray(target, float)
        back = eye - target
        right = np.cross(np.asarray(up, float), back)
        if not np.linalg.norm(back) > 0.0 or not np.linalg.norm(right) > 1e-9 * np.linalg.norm(back):
            raise ValueError(
                f"eye {eye} and target {target} with up {np.asarray(up)} fix no view: give two points, and an up that "
                "is not the direction between them"
            )
        back, right = back / np.linalg.norm(back), right / np.linalg.norm(right)
        rotation = np.stack([right, np.cross(back, right), back], axis=1)
        return cls(position=jnp.asarray(eye, float), rotation=jnp.asarray(rotation, float), **fields)

    @property
    def focal_length(self) -> float:
        """Pixels per unit of tangent."""
        return 0.5 * self.height / math.tan(math.radians(0.5 * self.field_of_view))

    @property
    def _zoomed(self) -> Scalar:
        """The focal length with the zoom [pixels]."""
        return self.focal_length if self.zoom is None else self.focal_length * jnp.clip(self.zoom, *ZOOM)

    @property
    def pose(self) -> Pose:
        """In the world, or in the body's frame."""
        return Pose(self.position, self.rotation)

    def pose_in(self, world: World) -> Pose:
        """In the world. Gradient: exact."""
        return self.pose if self.body is None else placed_at(self.pose, world.body(self.body))

    def depth(self, world: World) -> Array:
        """Distance along the viewing direction [m], shape (height, width); ``far`` where nothing is seen.

        Gradient: none, unless ``gradient``.
        """
        return self._see(world, everything=False).depth.reshape(self.height, self.width)

    def with_noise(self, depth: Array, key: Key) -> Array:
        """A picture as the camera's ``noise`` leaves it [m], shape (height, width)."""
        return depth if self.noise is None else self.noise.apply(depth, self.far, key)

    @property
    def bounds(self) -> tuple[float, float]:
        """Bounds of the depth that ``see`` returns. Only noise makes depth smaller than ``near``."""
        return (0.0 if self.noise is None else -self.near / (self.far - self.near)), 1.0

    def see(self, world: World, key: Key) -> Array:
        """Depth as an observation, with noise: 0 at ``near``, 1 at ``far`` and beyond, shape (height, width, 1).

        Gradient: none, unless ``gradient``.
        """
        depth = self.with_noise(self.depth(world), key)
        return jnp.clip((depth - self.near) / (self.far - self.near), *self.bounds)[..., None]

    def view(self, world: World) -> View:
        """Depth, labels and normals.

        Gradient: none, unless ``gradient``. Then that of depth is exact for the surface that a pixel sees: by poses,
        sizes and positions; the picture's edges, where another surface comes into sight, are steps that no derivative
        sees.
        """
        hits = self._see(world, everything=True)
        assert hits.label is not None and hits.normal is not None
        return View(
            depth=hits.depth.reshape(self.height, self.width),
            label=hits.label.reshape(self.height, self.width),
            normal=cp.join_vector(hits.normal).reshape(self.height, self.width, 3),
        )

    def points(self, depth: Array, world: World | None = None) -> Array:
        """Points that pixels see, in the world [m], shape (height, width, 3).

        Args:
          depth: a picture of this camera, noise included [m], shape (height, width).
          world: needed where a body carries the camera.

        Raises:
          ValueError: a body carries the camera, and ``world`` is None.

        Gradient: exact.
        """
        if self.body is not None and world is None:
            raise ValueError(f"body {self.body} carries the camera: give the world, which knows where it is")
        pose = self.pose if world is None else self.pose_in(world)
        x, y = self._slopes()
        local = jnp.stack([x * depth.reshape(-1), y * depth.reshape(-1), -depth.reshape(-1)], axis=-1)
        return (pose.position + turned(pose.rotation, local)).reshape(self.height, self.width, 3)

    def _slopes(self) -> tuple[Array, Array]:
        """x and y of pixels' centres at depth 1, shape (height * width,) each."""
        columns = (np.arange(self.width) + 0.5 - 0.5 * self.width) / self.focal_length
        rows = (0.5 * self.height - np.arange(self.height) - 0.5) / self.focal_length
        x, y = np.meshgrid(columns, rows)
        dtype = jnp.result_type(self.position)
        x, y = jnp.asarray(x.reshape(-1), dtype), jnp.asarray(y.reshape(-1), dtype)
        factor = self._zoomed / self.focal_length
        return (x, y) if self.zoom is None else (x / factor, y / factor)

    def _see(self, world: World, *, everything: bool) -> Hits:
        if not self.gradient:
            world = frozen(world)
            camera = jax.tree.map(jax.lax.stop_gradient, self)
        else:
            camera = self
        pose = camera.pose_in(world)
        x, y = camera._slopes()
        ahead: Vec3 = (x, y, -jnp.ones_like(x))
        rotation = cp.split_matrix(pose.rotation)
        direction = cp.vector(lambda i: cp.dot(rotation[i], ahead))
        low, high = (1.0, 1.0) if self.zoom is None else ZOOM
        rays = Rays(
            pose=pose, origin=cp.split_vector(pose.position), direction=direction, slope=(x, y),
            height=self.height, width=self.width, focal_length=camera._zoomed, near=self.near,
            focal_range=(low * self.focal_length, high * self.focal_length),
            gradient=self.gradient,
        )  # fmt: skip
        labels = {name: i for i, name in enumerate(world.names)}
        layers = [
            *see_solids(world.solids, labels, rays, everything=everything),
            *(see_balls(balls, labels, rays, everything=everything) for balls in world.balls),
            *(see_triangles(surface, labels[surface.name], rays, everything=everything) for surface in world.triangles),
        ]
        hits = nearest(layers, rays, everything=everything)
        seen, normal = hits.depth < self.far, hits.normal
        return Hits(
            depth=jnp.where(seen, hits.depth, self.far),
            label=None if hits.label is None else jnp.where(seen, hits.label, NOTHING),
            normal=None if normal is None else cp.vector(lambda i: jnp.where(seen, normal[i], 0.0)),
        )
