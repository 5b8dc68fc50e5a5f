"""Sensors by name: what ``rewax.make(..., sensors=("camera",))`` adds to a task."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

from rewax.envs.factories import check_name_and_factory, imported
from rewax.envs.sensing import Sensing, Sensor
from rewax.sensors.camera import Camera
from rewax.sensors.depth_cloud import DepthCloud
from rewax.sensors.framing import carried, framing
from rewax.sensors.labels import Labels
from rewax.sensors.touch import touch_everywhere

RESOLUTION = 64
"""Pixels along each side of a picture, unless ``make`` is told otherwise."""
_CLOUD = 256
"""Points of the sensor ``cloud``."""

SensorFactory: TypeAlias = Callable[[Any, int], Sensor] | str
"""A function ``(env, resolution) -> sensor``, or its name: ``"package.module:function"``."""

_FACTORIES: dict[str, SensorFactory] = {}


def register_sensor(name: str, factory: SensorFactory) -> None:
    """Make a sensor available to ``make(..., sensors=(name,))`` and to the command line.

    Args:
      name: of the sensor and of its observation.
      factory: called as ``factory(env, resolution)`` with an environment and the pixels along a side of its pictures.

    Raises:
      ValueError: the name is no string or is taken by another factory, or the factory is neither a function nor a
        string of that form.
    """
    check_name_and_factory("a sensor", name, factory)
    if _FACTORIES.get(name, factory) != factory:
        raise ValueError(f"a sensor named {name!r} is registered already: choose another name")
    _FACTORIES[name] = factory


def list_sensors(env: Any = None) -> list[str]:
    """The names of all registered sensors, sorted; none if an environment is given that sensors cannot see."""
    if env is not None and not callable(getattr(getattr(env, "unwrapped", env), "world", None)):
        return []
    feels = env is None or _can_feel(getattr(env, "unwrapped", env))
    return sorted(name for name, factory in _FACTORIES.items() if feels or factory is not _touch)


def with_sensors(env: Any, names: Sequence[str], resolution: int | None = None) -> Sensing:
    """An environment with registered sensors; their observations have the sensors' names.

    Args:
      env: an environment with the method ``world(physics, up)``.
      names: of registered sensors.
      resolution: pixels along each side of pictures; None: ``RESOLUTION``.

    Raises:
      ValueError: there is no such sensor, its factory cannot be imported, the environment cannot have it, the
        resolution is no positive integer, or none of the sensors takes pictures.
    """
    names = check_names(names)
    if resolution is not None and names and all(_FACTORIES[name] is _touch for name in names):
        raise ValueError(f"resolution is {resolution!r}, but {', '.join(names)} takes no pictures: leave it out")
    size = RESOLUTION if resolution is None else resolution
    if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or size < 1:
        raise ValueError(f"resolution is {resolution!r}: give an integer of pixels, at least 1")
    return Sensing(env=env, sensors={name: imported(name, _FACTORIES[name])(env, int(size)) for name in names})


def check_names(names: Any) -> tuple[str, ...]:
    """Names of sensors as a tuple.

    Raises:
      ValueError: no sensor has one of these names, or one comes twice.
    """
    from rewax.envs.registry import did_you_mean

    if not isinstance(names, Iterable):
        raise ValueError(f"sensors is {names!r}: give names, ('camera',) for example")
    listed = (names,) if isinstance(names, str) else tuple(names)
    for name in listed:
        if not isinstance(name, str) or name not in _FACTORIES:
            raise ValueError(
                f"there is no sensor named {name!r}: {did_you_mean(name, _FACTORIES)}known are "
                f"{', '.join(list_sensors())}; add others with Sensing(env=..., sensors=...)"
            )
    if len(set(listed)) < len(listed):
        raise ValueError(f"sensors is {listed}, with a name twice: give each once")
    return listed


def default_camera(env: Any, resolution: int = RESOLUTION) -> Camera:
    """The camera of a task: its ``default_camera``, or else one that shows all of the first state of ``key(0)``.

    Raises:
      ValueError: the environment says neither where to look nor what can be seen.
    """
    bare = getattr(env, "unwrapped", env)
    camera = getattr(bare, "default_camera", None)
    if camera is None:
        if not callable(getattr(bare, "world", None)):
            raise ValueError(f"{type(bare).__name__} has neither a default_camera nor world(physics, up): define one")
        up = np.asarray(bare.up)
        world = bare.world(jax.jit(env.reset)(jax.random.key(0)).physics, up)
        camera = carried(framing(world, up), world, getattr(bare, "camera_body", None))
    return camera.replace(height=resolution, width=resolution)


def _cloud(env: Any, resolution: int) -> DepthCloud:
    return DepthCloud(camera=default_camera(env, resolution), num_points=min(_CLOUD, resolution**2))


def _labels(env: Any, resolution: int) -> Labels:
    return Labels(camera=default_camera(env, resolution))


def _can_feel(bare: Any) -> bool:
    """Whether an environment says which bodies can feel contact, and has any."""
    try:
        return bool(getattr(bare, "feeling_bodies", None))
    except NotImplementedError:
        return False


def _touch(env: Any, resolution: int) -> Sensor:
    del resolution
    return touch_everywhere(getattr(env, "unwrapped", env))


register_sensor("camera", default_camera)
register_sensor("cloud", _cloud)
register_sensor("labels", _labels)
register_sensor("touch", _touch)

__all__ = ["RESOLUTION", "SensorFactory", "default_camera", "list_sensors", "register_sensor", "with_sensors"]
