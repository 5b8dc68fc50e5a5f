"""The observation of a soft body: a subset of its points."""

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.envs.kit.options import flag_option, integer_option, number_option
from rewax.physics.numerics.checks import NOT_NEGATIVE
from rewax.types import Array, Key, Observation, Scalar


@struct.dataclass
class PointCloud(struct.Replaceable):
    """Which points are observed, with or without velocities and noise.

    The fixed points are every ``stride``-th point, at most ``num_points``. Rewards never see random points or noise.

    Attributes:
      num_points: largest number of observed points (static).
      stride: distance between the indices of two fixed points (static).
      random: observe points that are drawn at every step, without replacement, instead of the fixed ones (static).
      velocities: observe the velocity of each point beside its position (static).
      noise: standard deviation of the noise of observed positions, in their unit (metres, but for ``SoftJumper``, which
        observes scaled ones); None for exact positions.
    """

    num_points: int = struct.static_field()
    stride: int = struct.static_field(default=1)
    random: bool = struct.static_field(default=False)
    velocities: bool = struct.static_field(default=False)
    noise: Scalar | None = None

    def __post_init__(self) -> None:
        integer_option("PointCloud.num_points", self.num_points, "give the largest number of observed points")
        integer_option("PointCloud.stride", self.stride, "give 1 for all points, n for every n-th one")
        flag_option("PointCloud.random", self.random)
        flag_option("PointCloud.velocities", self.velocities)
        if self.noise is not None:
            number_option("PointCloud.noise", self.noise, NOT_NEGATIVE, remedy="give a standard deviation, or None")

    @property
    def draws(self) -> bool:
        """Whether the observation depends on a key."""
        return self.random or self.noise is not None

    def pick(self, points: Array) -> Array:
        """The entries of the fixed points in an array over all points, shape (num_all, ...). Gradient: exact."""
        return points[:: self.stride][: self.num_points]

    def shown(self, obs: Observation, points: tuple[Array, Array], key: Key) -> tuple[Observation, Key]:
        """The observations with ``particle_q`` replaced by the observation of this cloud, and an unused key.

        With random points or noise ``com_q``, if present, becomes the mean of what is observed: the exact mean would
        reveal what the noise hides.

        Args:
          obs: named observations. ``particle_q``, if present, holds the fixed points, and ``com_q`` a mean of points.
          points: positions and velocities of all points, in the frame of ``particle_q``, shape (num_all, 3) each.
          key: draws points and noise.
        """
        if "particle_q" not in obs or not (self.draws or self.velocities):
            return obs, key
        seen_key = None
        if self.draws:
            key, seen_key = jax.random.split(key)
        seen = self.see(*points, seen_key)
        mean = {"com_q": seen[:, :3].mean(0)} if self.draws and "com_q" in obs else {}
        return {**obs, **mean, "particle_q": seen}, key

    def see(self, positions: Array, velocities: Array, key: Key | None) -> Array:
        """The observed points, shape (num_points, 3), or (num_points, 6) with velocities.

        Args:
          positions, velocities: of all points, shape (num_all, 3) each.
          key: draws points and noise; may be None unless ``draws``.

        Gradient: exact.
        """
        seen = jnp.concatenate([positions, velocities], axis=-1) if self.velocities else positions
        if key is None:
            return self.pick(seen)
        which_key, noise_key = jax.random.split(key)
        if self.random:
            count = min(self.num_points, len(positions))
            seen = seen[jax.random.permutation(which_key, len(positions))[:count]]
        else:
            seen = self.pick(seen)
        if self.noise is None:
            return seen
        noise = self.noise * jax.random.normal(noise_key, (len(seen), 3), seen.dtype)
        return seen.at[:, :3].add(noise)
