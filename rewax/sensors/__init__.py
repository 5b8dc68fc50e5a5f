"""What a robot has instead of the state: cameras, clouds of points, touch. Pure functions of what there is to see."""

from rewax.sensors.camera import Camera, View
from rewax.sensors.world import NOTHING, Balls, Solid, Triangles, World, half_space, solids

__all__ = ["NOTHING", "Balls", "Camera", "Solid", "Triangles", "View", "World", "half_space", "solids"]
