"""HandFlip: fold a flat piece of dough on a hand, by closing the hand.

Scale ``paper`` is the task of the SAPO paper (DexDeform's flip as Rewarped simulates it): a Shadow hand, palm up, under
a thin disc of dough. Scale ``small`` has the same hand, softer and coarser dough, and fewer, longer steps.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.envs.kit.options import Substeps, integer_option, number_option, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.shadow_hand import HandTask, hand_colliders, joint_limits, load_hand
from rewax.envs.kit.soft_body import Soft
from rewax.envs.kit.soft_parts import box_walls, dough
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.envs.kit.start_noise import reset_noise
from rewax.physics import mpm
from rewax.physics.mpm import Grid
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Key, PyTree

REFERENCE = {
    "grid": 48,
    "dt": 5e-5,
    "num_substeps": 40,
    "max_steps": 300,
    "gravity": -90.0,
    "friction": 0.5,
    "softness": 666.0,
    "youngs_modulus": 4000.0,
    "yield_stress": 130.0,
    "num_particles": 2500,
    "particle_volume": (1.0 / 64.0 / 2.0) ** 2,
    "center": (0.5, 0.38, 0.6),
    "radius": 0.1,
    "half_thickness": 0.003,
    "hand_scale": 2.5,
    "hand_position": (0.5, 0.30, 0.3),
    "joint_step": 0.33 * 0.002 * 40,
    "shift_lower": (-0.1, 0.0, -0.1),
    "shift_upper": (0.1, 0.1, 0.1),
    "stretch": 0.05,
    "num_observed": 250,
    "stride": 10,
}
"""Xing, Luk and Oh 2025 and Rewarped; lengths in m, times in s, moduli in Pa for dough of density 1. Rewarped
squares a length for the volume of a particle; with a prescribed hand the volume does not affect the motion."""

START = (
    *(-0.16514339750464327, -0.31973286565062153),
    *(0.14340512546557435, 0.32028208333591573, 0.7126053607727917, 0.6705281001412586),
    *(0.000246444303701037, 0.3152655251085491, 0.7659800313729842, 0.7323156897425923),
    *(0.00038520700007378114, 0.36743546201985233, 0.7119514095008576, 0.6699446327514138),
    *(0.0525442258033891, -0.13615534724474673, 0.39872030433433003, 0.7415570009679252, 0.704096378652974),
    *(0.003673823825070126, 0.5506291436028695, -0.014515151997119306, -0.0015229223564485414, -0.7894883021600622),
)
"""Joint angles of wrist, first, middle, ring, little finger and thumb at the start [rad]: the Shadow hand's pose in
Gymnasium-Robotics (``DEFAULT_INITIAL_QPOS``), which DexDeform and Rewarped start from."""


@struct.dataclass
class HandFlip(HandTask):
    """The task; ``rewax.make("HandFlip", scale=...)`` builds it.

    The particles i and i + n/2, of n particles, are mirror images of each other at rest. ``physics.task`` is D0, the
    mean distance of the reward's pairs at the first step of the episode [m], shape (); before that step it is negative.

    Attributes:
      pair_stride: distance between the indices of two pairs of the reward, which does not depend on the cloud (static).
    """

    pair_stride: int = struct.static_field()

    def __post_init__(self) -> None:
        super().__post_init__()
        integer_option("pair_stride", self.pair_stride, "give 1 for all mirror pairs, n for every n-th one")
        if not isinstance(self.rest_positions, Tracer):
            _check_mirrored(np.asarray(self.rest_positions))

    def start(self, positions: Array, key: Key) -> tuple[Soft, PyTree]:
        return self.at_rest(positions), -jnp.ones((), positions.dtype)

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """clip((D0 - D) / D0, -1, 1), with D the mean distance of mirror pairs. D0 has no gradient."""
        distance = self.pair_distance(physics)
        first = self.first_distance(physics)
        closed = (first - distance) / first
        return jnp.clip(closed, -1.0, 1.0), {"pair_distance": distance}

    def next_task(self, physics: SoftPhysics, key: Key) -> PyTree:
        return self.first_distance(physics)

    def pair_distance(self, physics: SoftPhysics) -> Array:
        """Mean distance of every ``pair_stride``-th mirror pair [m], shape ()."""
        first, second = (half[:: self.pair_stride] for half in jnp.split(physics.soft.x, 2))
        return jnp.mean(jnp.sqrt(jnp.sum((first - second) ** 2, axis=-1) + 1e-12))

    def first_distance(self, physics: SoftPhysics) -> Array:
        """D0 [m], shape (). Gradient: none."""
        now = jax.lax.stop_gradient(self.pair_distance(physics))
        return jnp.where(physics.task > 0.0, physics.task, now)

    @property
    def default_camera(self) -> Camera:
        return overlooking((0.47, 0.3, 0.6), 0.4, up=self.up)


def _check_mirrored(positions: np.ndarray) -> None:
    """Raises ValueError unless the second half of the particles mirrors the first in some plane of constant z."""
    half = positions.shape[-2] // 2
    first, second = positions[..., :half, :], positions[..., half:, :]
    mirrored = first.shape == second.shape
    if mirrored:
        planes = first[..., 2] + second[..., 2]
        errors = first[..., :2] - second[..., :2], planes - planes.mean(axis=-1, keepdims=True)
        mirrored = max(np.abs(e).max(initial=0.0) for e in errors) < 1e-4
    if not mirrored:
        raise ValueError(
            "the second half of rest_positions does not mirror the first in z, and the reward measures such pairs: "
            "give positions as those of mirrored_disc"
        )


def mirrored_disc(center: tuple[float, ...], radius: float, half_thickness: float, num_particles: int) -> Array:
    """Random points of a disc about y, from a fixed seed: one half with z >= 0, then its mirror images in z = 0.

    Each half is sorted by z, then x, then y; shape (num_particles, 3).
    """
    draw, kept = np.random.Generator(np.random.PCG64(0)), np.zeros((0, 3))
    while len(kept) < num_particles // 2:
        points = draw.uniform(-1.0, 1.0, (num_particles, 3)) * [radius, half_thickness, radius]
        inside = (points[:, 0] ** 2 + points[:, 2] ** 2 <= radius**2) & (points[:, 2] >= 0.0)
        kept = np.concatenate([kept, points[inside]])
    half = kept[: num_particles // 2]
    half = half[np.lexsort((half[:, 1], half[:, 0], half[:, 2]))]
    both = np.concatenate([half, half * [1.0, 1.0, -1.0]]) + np.asarray(center)
    return jnp.asarray(both, jnp.result_type(float))


def paper(
    *,
    youngs_modulus: float = REFERENCE["youngs_modulus"],
    yield_stress: float = REFERENCE["yield_stress"],
    dt: float | None = None,
    num_substeps: int | None = None,
) -> HandFlip:
    """The constants of Rewarped."""
    steps = substeps(dt, num_substeps, Substeps(REFERENCE["dt"], REFERENCE["num_substeps"], list_every=5))
    r, hand = REFERENCE, load_hand(scale=REFERENCE["hand_scale"], position=REFERENCE["hand_position"])
    scene = mpm.make_scene(
        grid=Grid(shape=(49, 49, 49), spacing=1.0 / r["grid"]),
        dt=steps.dt,
        material=dough(youngs_modulus, yield_stress),
        particle_volume=r["particle_volume"],
        gravity=(0.0, r["gravity"], 0.0),
        colliders=hand_colliders(hand, friction=r["friction"], softness=r["softness"]),
        walls=box_walls(floor=0.0625, lower=(0.0625, 0.0625), upper=(0.9375, 0.9375), ceiling=0.9375),
        max_active_nodes=10752,
        reach=0.5,
    )
    return _hand_flip(scene, hand, steps, r["num_particles"], num_observed=r["num_observed"], exact_limits=False)


def _hand_flip(scene, hand, steps: Substeps, num_particles: int, *, num_observed: int, **changes) -> HandFlip:
    r, (lower, upper), stride = REFERENCE, joint_limits(hand), num_particles // num_observed
    options = {
        "noise": reset_noise(r["shift_lower"], r["shift_upper"], r["stretch"]),
        "joint_step": jnp.full(len(START), r["joint_step"]),
        "max_steps": r["max_steps"],
        "rest_positions": mirrored_disc(r["center"], r["radius"], r["half_thickness"], num_particles),
        **changes,
    }
    return HandFlip(
        scene=scene,
        hand=hand,
        joint_start=START,
        joint_lower=lower,
        joint_upper=upper,
        num_substeps=steps.num,
        list_every=steps.list_every,
        cloud=PointCloud(num_points=num_observed, stride=stride),
        pair_stride=stride,
        **options,
    )


def small(
    *,
    youngs_modulus: float = 800.0,
    yield_stress: float = 26.0,
    dt: float | None = None,
    num_substeps: int | None = None,
    softness: float = 100.0,
) -> HandFlip:
    """A task that learns within minutes on two cores; ``docs/soft_tasks.md`` has the reason for each difference."""
    steps = substeps(dt, num_substeps, Substeps(4e-4, 15, list_every=5))
    softness = number_option("softness", softness, remedy="give a decay per metre")
    r, hand = REFERENCE, load_hand(scale=REFERENCE["hand_scale"], position=REFERENCE["hand_position"])
    spacing, num_particles = 1.0 / 32, 256
    scene = mpm.make_scene(
        grid=Grid(shape=(20, 17, 20), spacing=spacing, origin=(6 * spacing, 4 * spacing, 9 * spacing)),
        dt=steps.dt,
        material=dough(youngs_modulus, yield_stress),
        particle_volume=r["particle_volume"] * r["num_particles"] / num_particles,
        gravity=(0.0, r["gravity"], 0.0),
        colliders=hand_colliders(hand, friction=r["friction"], softness=softness),
        walls=box_walls(floor=0.2, lower=(0.25, 0.35), upper=(0.72, 0.82)),
        max_active_nodes=704,
        reach=0.5,
    )
    return _hand_flip(
        scene,
        hand,
        steps,
        num_particles,
        num_observed=64,
        max_steps=60,
        joint_step=jnp.full(len(START), 0.06),
        noise=reset_noise((-0.03, -0.04, -0.03), (0.03, -0.04, 0.03)),
    )
