"""HandLift: lift a cube of dough that lies on a hand, by closing the hand.

Scale ``paper`` is DexDeform's lift as Rewarped simulates it: a smaller Shadow hand than that of HandFlip, palm up,
under a cube of stiff and heavy dough. Scale ``small`` has coarser dough, and fewer, longer steps.
"""

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.shadow_hand import NUM_JOINTS, HandTask, hand_colliders, joint_limits, load_hand
from rewax.envs.kit.soft_parts import box_walls, dough, lattice_box, random_box
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.envs.kit.start_noise import no_noise, reset_noise
from rewax.physics import mpm
from rewax.physics.mpm import Grid, WallKind
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Vector

REFERENCE = {
    "grid": 64,
    "dt": 5e-5,
    "num_substeps": 40,
    "max_steps": 100,
    "gravity": -60.0,
    "friction": 0.9,
    "floor_friction": 0.3,
    "softness": 666.0,
    "youngs_modulus": float(np.exp(13.0)),
    "poissons_ratio": 0.25,
    "yield_stress": 3e4,
    "density": 1000.0,
    "num_particles": 8000,
    "center": (0.5, 0.285, 0.5),
    "edge": 0.09,
    "hand_scale": 1.5,
    "hand_position": (0.5, 0.2, 0.3),
    "joint_step": 0.33 * 0.002 * 40,
    "num_observed": 250,
    "stride": 32,
}
"""dexdeform.Lift of Rewarped; lengths in m, times in s, moduli in Pa. Substeps, motion per step and observed points are
those of HandFlip: the two share them in Rewarped's configuration."""


@struct.dataclass
class HandLift(HandTask):
    """The task; ``rewax.make("HandLift", scale=...)`` builds it.

    Attributes:
      datum: height at which the reward is 0 [m]; 0 in Rewarped.
      unit: height above the datum at which the reward is 1 [m]; 1 in Rewarped.
    """

    datum: Vector
    unit: Vector

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """(h - datum) / unit, with h the mean height of all particles [m]."""
        height = physics.soft.x[:, 1].mean()
        return (height - self.datum) / self.unit, {"height": height}

    @property
    def default_camera(self) -> Camera:
        return overlooking((0.48522618, 0.26500002, 0.50244516), 0.22500005, up=self.up)


def _hand_lift(*, grid: Grid, steps: Substeps, softness: float, walls: dict, scene: dict, **changes) -> HandLift:
    r = REFERENCE
    hand = load_hand(scale=r["hand_scale"], position=r["hand_position"])
    lower, upper = joint_limits(hand)
    edge, count = r["edge"], len(changes["rest_positions"])
    options = {
        "noise": no_noise(),
        "datum": 0.0,
        "unit": 1.0,
        "joint_step": jnp.full(NUM_JOINTS, r["joint_step"]),
        "max_steps": r["max_steps"],
        **changes,
    }
    return HandLift(
        hand=hand,
        scene=mpm.make_scene(
            grid=grid,
            dt=steps.dt,
            material=dough(
                r["youngs_modulus"],
                r["yield_stress"],
                poissons_ratio=r["poissons_ratio"],
                density=r["density"],
            ),
            particle_volume=edge**3 / count,
            gravity=(0.0, r["gravity"], 0.0),
            colliders=hand_colliders(hand, friction=r["friction"], softness=softness),
            walls=box_walls(floor_kind=WallKind.SEPARATING, floor_friction=r["floor_friction"], **walls),
            reach=0.5,
            **scene,
        ),
        joint_start=jnp.zeros(NUM_JOINTS),
        joint_lower=lower,
        joint_upper=upper,
        num_substeps=steps.num,
        list_every=steps.list_every,
        **options,
    )


def paper(*, dt: float | None = None, num_substeps: int | None = None) -> HandLift:
    """The constants of Rewarped."""
    r = REFERENCE
    bound = 3.0 / r["grid"]
    return _hand_lift(
        grid=Grid(shape=(65, 65, 65), spacing=1.0 / r["grid"]),
        steps=substeps(dt, num_substeps, Substeps(r["dt"], r["num_substeps"], list_every=5)),
        softness=r["softness"],
        walls={"floor": bound, "lower": (bound, bound), "upper": (1.0 - bound, 1.0 - bound), "ceiling": 1.0 - bound},
        scene={"max_active_nodes": 4096},
        rest_positions=random_box(r["center"], (r["edge"],) * 3, r["num_particles"]),
        cloud=PointCloud(num_points=r["num_observed"], stride=r["stride"]),
        exact_limits=False,
    )


def small(*, dt: float | None = None, num_substeps: int | None = None) -> HandLift:
    """A task that learns within minutes on two cores; ``docs/soft_tasks.md`` has the reason for each difference."""
    r, spacing = REFERENCE, 1.0 / 48
    center = (0.5, 0.265, 0.5)
    return _hand_lift(
        grid=Grid(shape=(17, 36, 19), spacing=spacing, origin=(16 * spacing, 6 * spacing, 15 * spacing)),
        steps=substeps(dt, num_substeps, Substeps(2e-4, 20, list_every=5)),
        softness=150.0,
        walls={"floor": 0.16, "lower": (0.36, 0.34), "upper": (0.64, 0.66)},
        scene={"max_active_nodes": 768},
        rest_positions=lattice_box(center, (r["edge"],) * 3, (6, 6, 6)),
        cloud=PointCloud(num_points=72, stride=3),
        noise=reset_noise((-0.015, 0.0, -0.015), (0.015, 0.0, 0.015)),
        joint_step=jnp.full(NUM_JOINTS, 0.06),
        max_steps=60,
        datum=0.24,
        unit=0.05,
    )
