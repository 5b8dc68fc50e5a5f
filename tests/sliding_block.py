"""A block that slides and flattens by known formulas: an environment of which every identification is known by hand."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.base import ArraySpec, first_state, next_state
from rewax.identify.records import Record, padded
from rewax.status import Status, flag
from rewax.types import Array

LATTICE = np.stack(np.meshgrid(*[np.linspace(0.0, 0.3, 6)] * 3, indexing="ij"), -1).reshape(-1, 3)


@struct.dataclass
class BlockPhysics(struct.Replaceable):
    """Shift along x [m], and the logarithm of the height."""

    shift: Array
    height: Array
    action: Array


class Spacing(NamedTuple):
    spacing: float


class Scene(NamedTuple):
    grid: Spacing


@struct.dataclass
class SlidingBlock(struct.Replaceable):
    """Action 0 moves the block along x by ``gain * grip``, action 1 flattens it by ``softness``; ``idle`` does nothing.

    A gain above ``limit`` is an invalid parameter, as a stiffness beyond the substep is.
    """

    rest_positions: Array
    gain: Array
    grip: Array
    softness: Array
    idle: Array
    limit: Array
    control_dt: float = struct.static_field(default=0.1)
    scene: "Scene | None" = struct.static_field(default=None)

    observation_spec = property(lambda self: {"shift": ArraySpec((1,))})
    action_spec = property(lambda self: ArraySpec((2,), -1.0, 1.0))
    episode_length = property(lambda self: 20)

    def reset(self, key):
        physics = BlockPhysics(shift=jnp.zeros(()), height=jnp.zeros(()), action=jnp.zeros(2))
        return first_state(physics=physics, obs={"shift": physics.shift[None]}, metrics={}, key=key)

    def step(self, state, action):
        before = state.physics
        physics = BlockPhysics(
            shift=before.shift + 0.02 * self.gain * self.grip * action[0],
            height=before.height - 0.05 * self.softness * action[1] + 0.0 * self.idle,
            action=action,
        )
        status = flag(self.gain > self.limit, Status.INVALID_PARAMETERS)
        return next_state(
            state, physics=physics, obs={"shift": physics.shift[None]}, reward=jnp.zeros(()), metrics={},
            episode_length=20, status=status,
        )  # fmt: skip

    def particles(self, physics):
        scale = jnp.stack([jnp.exp(-0.5 * physics.height), jnp.exp(physics.height), jnp.exp(-0.5 * physics.height)])
        return self.rest_positions * scale + jnp.stack([physics.shift, jnp.zeros(()), jnp.zeros(())])


def block(**numbers):
    """A block with gain, grip and softness 1."""
    known = {"gain": 1.0, "grip": 1.0, "softness": 1.0, "idle": 1.0, "limit": 1e9, **numbers}
    return SlidingBlock(
        rest_positions=jnp.asarray(LATTICE, jnp.float32), **{k: jnp.float32(v) for k, v in known.items()}
    )


def on_grid(spacing, **numbers):
    """A block that slides as if its particles lay on a grid of this spacing [m]: the coarser, the further it slides."""
    numbers["grip"] = numbers.get("grip", 1.0) * float(np.exp(10.0 * spacing))
    return block(**numbers).replace(scene=Scene(Spacing(spacing)))


def seen(env, *, noise=0.001, outliers=0, seed=0, frames=(0.0, 0.15, 0.3, 0.5, 0.8)):
    """A record of the block's upper and two other sides by the formulas, times between control steps included."""
    generator = np.random.Generator(np.random.PCG64(seed))
    actions = np.tile([1.0, 1.0], (8, 1)).astype(np.float32)
    clouds, masks = [], []
    surface = generator.uniform(-0.02, 0.32, (90, 3))  # the particles' balls reach beyond their centres
    surface[np.arange(90), np.arange(90) % 3] = 0.32
    for time in frames:
        height = -0.05 * float(env.softness) * time / 0.1
        shift = 0.02 * float(env.gain * env.grip) * time / 0.1
        points = surface * np.exp([-0.5 * height, height, -0.5 * height]) + [shift, 0.0, 0.0]
        points = points + noise * generator.normal(size=points.shape)
        points[: outliers if time else 0] += 0.4
        cloud, mask = padded(points, 100)
        clouds.append(cloud)
        masks.append(mask)
    return Record(
        times=np.asarray(frames), clouds=np.stack(clouds), mask=np.stack(masks), actions=actions, control_dt=0.1
    )
