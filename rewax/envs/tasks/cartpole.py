"""CartpoleSwingUp: a cart swings a pole up and holds it there."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.rigid_task import RigidPhysics, RigidTask, load_asset, uniform
from rewax.physics import rigid
from rewax.physics.rigid import Penalty, RigidState
from rewax.types import Array, Key, Observation, PyTree

_HANGING = np.array([0.0, -np.pi])
_WEIGHTS = {"angle": 1.0, "angle_rate": 0.1, "position": 0.05, "velocity": 0.1}


@struct.dataclass
class CartpoleSwingUp(RigidTask):
    """The task; ``rewax.make("CartpoleSwingUp")`` builds it.

    Observation ``state``: position and velocity of the cart, sine, cosine and rate of the pole's angle (0 upright). The
    force on the cart is 1000 N times the action. Both scales are the same.
    """

    def start(self, key: Key) -> tuple[RigidState, PyTree]:
        position_key, velocity_key = jax.random.split(key)
        qpos = _HANGING + uniform(position_key, 2, 0.5 * np.pi)
        return rigid.initial_state(self.model, qpos, uniform(velocity_key, 2, 0.25)), None

    def observe(self, physics: RigidPhysics) -> Observation:
        (x, angle), (velocity, rate) = physics.rigid.qpos, physics.rigid.qvel
        return {"state": jnp.stack([x, velocity, jnp.sin(angle), jnp.cos(angle), rate])}

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """-(angle^2 + 0.1 rate^2 + 0.05 position^2 + 0.1 velocity^2)."""
        (x, angle), (velocity, rate) = physics.rigid.qpos, physics.rigid.qvel
        angle = angle - 2.0 * np.pi * jnp.round(angle / (2.0 * np.pi))
        terms = {"angle": angle**2, "angle_rate": rate**2, "position": x**2, "velocity": velocity**2}
        return -jnp.sum(jnp.stack([_WEIGHTS[name] * term for name, term in terms.items()])), terms


def make_cartpole_swing_up(*, scale: str, dt: float | None = None, num_substeps: int | None = None) -> CartpoleSwingUp:
    """Factory for the registry: 240 control steps of 1/60 s, by default with 4 substeps each."""
    del scale
    steps = substeps(dt, num_substeps, Substeps(1.0 / 240, 4))
    model = load_asset("cartpole.xml", dt=steps.dt, penalty=Penalty(stiffness=0.0))
    return CartpoleSwingUp(model=model, num_substeps=steps.num, max_steps=240)
