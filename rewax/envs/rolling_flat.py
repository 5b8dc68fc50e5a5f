"""RollingFlat: flatten a piece of dough with a rolling pin.

At scale ``paper`` this is the task of the SAPO paper (PlasticineLab's rolling pin as Rewarped simulates it). At scale
``small`` the same task is made for minutes on two cores: softer dough, a thicker pin that starts on the dough, longer
strokes per control step, shorter episodes; ``docs/rolling_flat.md`` says what differs and why.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.base import ArraySpec, State, first_state, next_state
from rewax.physics import mpm
from rewax.physics.contact import Collider
from rewax.physics.mpm import Elasticity, Grid, Material, MPMScene, MPMState, Plasticity, Wall, WallKind, Walls
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Capsule
from rewax.types import Array, Key, Observation

_Y_TO_Z = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
"""Turns a capsule, whose axis is y, so that it lies along z."""


@struct.dataclass
class RollingFlatPhysics:
    """Dough and pin.

    Attributes:
      dough: the particles.
      joint_q: pin position x, height y [m] and yaw about y [rad], shape (3,).
      joint_qd: motion of the pin in the last control step, in units of the largest possible, shape (3,).
    """

    dough: MPMState
    joint_q: Array
    joint_qd: Array


@struct.dataclass
class RollingFlat(struct.Replaceable):
    """The environment; build it with ``rewax.make("RollingFlat", scale=...)``.

    Every array is a leaf: differentiate with respect to it or vmap over it.

    Attributes:
      scene: dough, pin and box.
      rest_positions: dough before the noise of a reset [m], shape (num_particles, 3).
      pin_pivot: position of the pin's joint for joint_q = 0 [m], shape (3,); yaw turns about it.
      joint_start, joint_lower, joint_upper: first joint_q and its limits [m, m, rad], shape (3,).
      joint_step: change of joint_q per control step for action 1 [m, m, rad], shape (3,).
      shift_lower, shift_upper: range of the dough's shift at a reset [m], shape (3,).
      stretch: range of the dough's stretch about the origin at a reset [-].
      height_scale: height of the dough that counts as 1 in the reward [m].
      height_origin: height that counts as 0 in the reward [m].
      num_substeps: per control step (static).
      max_steps: control steps per episode (static).
      observed_stride, num_observed: which particles are observed: every so many, at most so many (static).
      store_every: substeps between stored particles in the backward pass, see ``mpm.step`` (static).
      observe_velocity: whether the pin's last motion is observed as joint_qd (static).
    """

    scene: MPMScene
    rest_positions: Array
    pin_pivot: Array
    joint_start: Array
    joint_lower: Array
    joint_upper: Array
    joint_step: Array
    shift_lower: Array
    shift_upper: Array
    stretch: Array
    height_scale: Array
    height_origin: Array
    num_substeps: int = struct.static_field()
    max_steps: int = struct.static_field()
    observed_stride: int = struct.static_field()
    num_observed: int = struct.static_field()
    store_every: int = struct.static_field(default=1)
    observe_velocity: bool = struct.static_field(default=False)

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        spec = {"particle_q": ArraySpec((self.num_observed, 3)), "com_q": ArraySpec((3,)), "joint_q": ArraySpec((3,))}
        return {**spec, "joint_qd": ArraySpec((3,))} if self.observe_velocity else spec

    @property
    def action_spec(self) -> ArraySpec:
        """Pin motion along x, along y and in yaw, as fractions of ``joint_step``."""
        return ArraySpec((3,), -1.0, 1.0)

    @property
    def episode_length(self) -> int:
        return self.max_steps

    @property
    def control_dt(self) -> float:
        """Duration of a control step [s]."""
        return self.num_substeps * self.scene.dt

    def reset(self, key: Key) -> State:
        key, shift_key, stretch_key = jax.random.split(key, 3)
        shift = jax.random.uniform(shift_key, (3,), minval=self.shift_lower, maxval=self.shift_upper)
        stretch = self.stretch * jax.random.uniform(stretch_key, (), minval=-1.0, maxval=1.0)
        positions = (self.rest_positions + _round3(shift)) * (1.0 + _round3(stretch))
        physics = RollingFlatPhysics(
            dough=mpm.initial_state(positions), joint_q=self.joint_start, joint_qd=jnp.zeros_like(self.joint_start)
        )
        _, metrics = self._reward(physics)
        return first_state(physics=physics, obs=self._observe(physics), metrics=metrics, key=key)

    def step(self, state: State, action: Array) -> State:
        """One control step: the pin moves by ``joint_step * clip(action)``, as far as its limits allow.

        Gradient: exact through the dough; the limits are frozen (as in the reference), so a pin that is held by a
        limit passes no gradient to the action that pushes against it.
        """
        physics: RollingFlatPhysics = state.physics
        q = physics.joint_q
        frozen = jax.lax.stop_gradient(q)
        motion = jnp.clip(action, -1.0, 1.0) * self.joint_step
        motion = jnp.clip(motion, self.joint_lower - frozen, self.joint_upper - frozen)
        fraction = jnp.linspace(0.0, 1.0, self.num_substeps + 1, dtype=q.dtype)
        poses = self._pin_poses(q + fraction[:, None] * motion)
        dough = mpm.step(self.scene, physics.dough, poses, store_every=self.store_every)
        new = RollingFlatPhysics(dough=dough, joint_q=q + motion, joint_qd=motion / self.joint_step)
        reward, metrics = self._reward(new)
        return next_state(
            state,
            physics=new,
            obs=self._observe(new),
            reward=reward,
            metrics=metrics,
            episode_length=self.max_steps,
            status=mpm.check_status(self.scene, dough, start=physics.dough, poses=poses),
        )

    def particles(self, physics: RollingFlatPhysics) -> Array:
        """Particle positions for pictures [m], shape (num_particles, 3)."""
        return physics.dough.x

    def render_shapes(self, physics: RollingFlatPhysics) -> list[dict[str, Any]]:
        """Drawings of the pin's parts, see ``rewax.viz.shapes``."""
        pose = jax.tree.map(lambda a: a[0, 0], self._pin_poses(physics.joint_q[None]))
        shapes = []
        for collider in self.scene.colliders:
            assert isinstance(collider.shape, Capsule)
            shapes.append(
                {
                    "kind": "capsule",
                    "center": pose.position + pose.rotation @ collider.offset,
                    "radius": collider.shape.radius,
                    "half_length": collider.shape.half_length,
                    "direction": pose.rotation @ collider.rotation[:, 1],
                }
            )
        return shapes

    def _pin_poses(self, joint_q: Array) -> Pose:
        """joint_q (T, 3) -> poses of the one body, shapes (T, 1, 3) and (T, 1, 3, 3)."""
        x, y, yaw = joint_q[:, 0], joint_q[:, 1], joint_q[:, 2]
        zero, one, c, s = jnp.zeros_like(yaw), jnp.ones_like(yaw), jnp.cos(yaw), jnp.sin(yaw)
        rotation = jnp.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=-1).reshape(-1, 1, 3, 3)
        position = self.pin_pivot + jnp.stack([x, y, zero], axis=-1)
        return Pose(position[:, None], rotation)

    def _observed(self, physics: RollingFlatPhysics) -> Array:
        return physics.dough.x[:: self.observed_stride][: self.num_observed]

    def _observe(self, physics: RollingFlatPhysics) -> Observation:
        particles = self._observed(physics)
        obs = {"particle_q": particles, "com_q": particles.mean(0), "joint_q": physics.joint_q}
        return {**obs, "joint_qd": physics.joint_qd} if self.observe_velocity else obs

    def _reward(self, physics: RollingFlatPhysics) -> tuple[Array, dict[str, Array]]:
        """(1 / (1 + d))^2 (2 if d <= 0.33 else 1) - var(y), d the mean height of the observed particles."""
        y = self._observed(physics)[:, 1]
        d = (y.mean() - self.height_origin) / self.height_scale
        variance = y.var(ddof=1)
        reward = (1.0 / (1.0 + d)) ** 2 * jnp.where(d <= 0.33, 2.0, 1.0) - variance
        return reward, {"flatness": d, "height_variance": variance}


def _round3(a: Array) -> Array:
    """Three decimals, as the reference draws its noise. Gradient: as if it did not round."""
    return a + jax.lax.stop_gradient(jnp.round(a * 1000.0) / 1000.0 - a)


def _pin(radius: float, half_length: float, *, offset: tuple[float, float, float], friction: float) -> Collider:
    return Collider(
        shape=Capsule(radius=jnp.asarray(radius), half_length=jnp.asarray(half_length)),
        offset=jnp.asarray(offset),
        rotation=jnp.asarray(_Y_TO_Z),
        friction=jnp.asarray(friction),
        softness=jnp.asarray(666.0),
    )


def _box_walls(floor: float, lower: tuple[float, float], upper: tuple[float, float]) -> Walls:
    """A floor that holds what presses on it, and frictionless sides at (x, z) = lower and upper."""
    return Walls(
        lower=(Wall(position=lower[0]), Wall(position=floor, kind=WallKind.GRIPPING), Wall(position=lower[1])),
        upper=(Wall(position=upper[0]), None, Wall(position=upper[1])),
    )


def _random_box(center: tuple[float, ...], size: tuple[float, ...], num_particles: int) -> Array:
    """Uniform points of a box from a fixed seed, the same in every environment, shape (num_particles, 3)."""
    points = np.random.Generator(np.random.PCG64(0)).random((num_particles, 3))
    return jnp.asarray((points - 0.5) * np.asarray(size) + np.asarray(center), dtype=jnp.result_type(float))


def _dough(youngs_modulus: float, yield_stress: float) -> Material:
    return Material(
        youngs_modulus=jnp.asarray(youngs_modulus),
        poissons_ratio=jnp.asarray(0.2),
        density=jnp.asarray(1.0),
        yield_stress=jnp.asarray(yield_stress),
        elasticity=Elasticity.HENCKY,
        plasticity=Plasticity.VON_MISES,
    )


def paper(*, youngs_modulus: float = 5000.0, yield_stress: float = 50.0, dt: float = 5e-5) -> RollingFlat:
    """The reference's constants. The box of nodes is cut at height 0.42 m, above everything that happens."""
    size, count = (0.3, 0.125, 0.3), 2592
    scene = mpm.make_scene(
        grid=Grid(shape=(48, 20, 48), spacing=1.0 / 48),
        dt=dt,
        material=_dough(youngs_modulus, yield_stress),
        particle_volume=jnp.asarray(float(np.prod(size)) / count),
        gravity=(0.0, -90.0, 0.0),
        colliders=(
            _pin(0.03, 0.2, offset=(0.0, 0.0, 0.5), friction=0.9),
            _pin(0.012, 0.3, offset=(0.0, 0.0, 0.5), friction=0.9),
        ),
        walls=_box_walls(floor=0.0625, lower=(0.0625, 0.0625), upper=(0.9375, 0.9375)),
        max_active_nodes=5120,  # rolled flat or torn apart by the pin, dough needed 4000
    )
    return RollingFlat(
        scene=scene,
        rest_positions=_random_box((0.5, 0.15, 0.5), size, count),
        pin_pivot=jnp.zeros(3),
        joint_start=jnp.asarray([0.5, 0.2875, 0.0]),
        joint_lower=jnp.asarray([0.12, 0.1225, -0.66 * np.pi]),
        joint_upper=jnp.asarray([0.88, 0.3725, 0.66 * np.pi]),
        joint_step=jnp.asarray([0.01, 0.01, np.pi / 60]),
        shift_lower=jnp.asarray([-0.1, 0.0, -0.1]),
        shift_upper=jnp.asarray([0.1, 0.05, 0.1]),
        stretch=jnp.asarray(0.1),
        height_scale=jnp.asarray(0.125),
        height_origin=jnp.asarray(0.0),
        num_substeps=40,
        max_steps=300,
        observed_stride=10,
        num_observed=250,
    )


def small(*, youngs_modulus: float = 750.0, yield_stress: float = 15.0, dt: float = 7e-4) -> RollingFlat:
    """The same task for minutes on two cores; ``docs/rolling_flat.md`` gives the reason for each difference."""
    size, count, floor, spacing, radius = (0.3, 0.125, 0.3), 256, 0.0625, 1.0 / 24, 0.05
    top = floor + size[1]
    scene = mpm.make_scene(
        grid=Grid(shape=(20, 9, 15), spacing=spacing, origin=(2.5 * spacing, 0.0, 5.0 * spacing)),
        dt=dt,
        material=_dough(youngs_modulus, yield_stress),
        particle_volume=jnp.asarray(float(np.prod(size)) / count),
        gravity=(0.0, -90.0, 0.0),
        colliders=(_pin(radius, 0.25, offset=(0.0, 0.0, 0.0), friction=0.9),),
        walls=_box_walls(floor=floor, lower=(0.15, 0.25), upper=(0.85, 0.75)),
        max_active_nodes=1664,  # scripted rolling needed 1472
    )
    return RollingFlat(
        scene=scene,
        rest_positions=_random_box((0.5, floor + 0.5 * size[1], 0.5), size, count),
        pin_pivot=jnp.asarray([0.0, 0.0, 0.5]),
        joint_start=jnp.asarray([0.5, top + radius, 0.0]),
        joint_lower=jnp.asarray([0.15, floor + radius + 0.03, -0.66 * np.pi]),
        joint_upper=jnp.asarray([0.85, top + radius + 0.05, 0.66 * np.pi]),
        joint_step=jnp.asarray([0.02, 0.004, np.pi / 60]),
        shift_lower=jnp.asarray([-0.1, 0.0, 0.0]),
        shift_upper=jnp.asarray([0.1, 0.0, 0.0]),
        stretch=jnp.asarray(0.0),
        height_scale=jnp.asarray(size[1]),
        height_origin=jnp.asarray(floor),
        num_substeps=10,
        max_steps=60,
        observed_stride=4,
        num_observed=64,
        observe_velocity=True,
    )
