"""Cameras placed so that they show something."""

from typing import Any

import numpy as np

from rewax.physics.shapes.solid import corners_of
from rewax.sensors.camera import Camera
from rewax.sensors.world import World

_RIGHT, _ABOVE = 0.3, 1.4
"""How far the eye is to the right and above, where it is 1 in front."""
_MARGIN = 1.2
"""Size that a picture shows, in sizes of what is there."""


def overlooking(middle: Any, size: float, *, up: Any, **fields: Any) -> Camera:
    """A camera above, in front and to the right of something, which then fills most of the picture. Gradient: none.

    The front is where z points to, or -y where z points up.

    Args:
      middle: of what is seen [m], shape (3,).
      size: of what is seen, along its longest side [m].
      up: unit vector against gravity, shape (3,).
      **fields: of ``Camera``; they replace ``near``, ``far`` and ``field_of_view``.

    Raises:
      ValueError: a field of ``Camera`` is illegal.
    """
    middle, up, across = np.asarray(middle, np.float32), np.asarray(up), np.float32(size)
    side = np.array([0.0, -1.0, 0.0]) if abs(up[2]) > 0.5 else np.array([0.0, 0.0, 1.0])
    eye = middle + across * (side + _ABOVE * up + _RIGHT * np.cross(up, side))
    away = float(np.linalg.norm(eye - middle))
    placed = {"near": float(away - 0.8 * across), "far": float(away + 1.2 * across), "field_of_view": 40.0, **fields}
    return Camera.look_at(middle - 0.02 * up, eye=eye, up=up, **placed)


def framing(world: World, up: Any, **fields: Any) -> Camera:
    """A camera that shows all that a world has; it leaves out shapes without bounds, planes for example.

    Args:
      world: of a state, with numbers that are known (not traced).
      up, **fields: see ``overlooking``.

    Raises:
      ValueError: nothing in the world has bounds.
    """
    corners = [np.asarray(balls.center) for balls in world.balls]
    corners += [np.asarray(surface.vertices) for surface in world.triangles]
    for solid in world.solids:
        if solid.shape.is_bounded:
            low, high = (np.asarray(corner, float) for corner in corners_of(solid.shape))
            picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
            local = np.where(picks, high, low)
            corners.append(np.asarray(solid.pose.position) + local @ np.asarray(solid.pose.rotation).T)
    if not corners:
        raise ValueError("nothing in the world has bounds, so nothing says where to look: place a Camera")
    every = np.concatenate(corners)
    low, high = every.min(axis=0), every.max(axis=0)
    return overlooking(0.5 * (low + high), _MARGIN * float((high - low).max()), up=up, **fields)


def carried(camera: Camera, world: World, body: int | None) -> Camera:
    """The camera that a body carries, with the pose in the world that it has now; None: it stays where it is.

    Raises:
      ValueError: there is no such body.
    """
    if body is None:
        return camera
    mount = world.body(body)
    back = np.asarray(mount.rotation).T
    position = back @ (np.asarray(camera.position) - np.asarray(mount.position))
    return camera.replace(
        position=np.float32(position), rotation=np.float32(back @ np.asarray(camera.rotation)), body=body
    )


__all__ = ["carried", "framing", "overlooking"]
