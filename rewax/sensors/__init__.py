"""Sensors of a robot: cameras, clouds of points, touch. Pure functions of the visible world and of contact."""

from rewax.sensors.camera import Camera, View
from rewax.sensors.depth_cloud import DepthCloud
from rewax.sensors.framing import overlooking
from rewax.sensors.labels import Labels
from rewax.sensors.noise import DepthNoise
from rewax.sensors.touch import Touch, octants, touch_everywhere
from rewax.sensors.world import NOTHING, Balls, Solid, Triangles, World, half_space, placed_colliders

__all__ = [
    "NOTHING", "Balls", "Camera", "DepthCloud", "DepthNoise", "Labels", "Solid", "Touch", "Triangles", "View", "World",
    "half_space", "octants", "overlooking", "placed_colliders", "touch_everywhere",
]  # fmt: skip
