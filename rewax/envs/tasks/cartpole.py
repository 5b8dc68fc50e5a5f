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
_WEIGHTS = {"angle": 1.0, "angle_rate": 0.1, "place": 0.05, "velocity": 0.1}


@struct.dataclass
class CartpoleSwingUp(RigidTask):
    """The environment; build it with ``rewax.make("CartpoleSwingUp")``.

    Observation ``state``: place and velocity of the cart, sine, cosine and rate of the pole's angle (0 upright). The
    action times 1000 N pushes the cart. Both scales are the same.
    """

    def start(self, key: Key) -> tuple[RigidState, PyTree]:
        place_key, velocity_key = jax.random.split(key)
        qpos = _HANGING + uniform(place_key, 2, 0.5 * np.pi)
        return rigid.initial_state(self.model, qpos, uniform(velocity_key, 2, 0.25)), None

    def observe(self, physics: RigidPhysics) -> Observation:
        (x, angle), (velocity, rate) = physics.rigid.qpos, physics.rigid.qvel
        return {"state": jnp.stack([x, velocity, jnp.sin(angle), jnp.cos(angle), rate])}

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """Minus the squares of angle, 0.1 its rate, 0.05 place and 0.1 velocity."""
        (x, angle), (velocity, rate) = physics.rigid.qpos, physics.rigid.qvel
        angle = angle - 2.0 * np.pi * jnp.round(angle / (2.0 * np.pi))
        terms = {"angle": angle**2, "angle_rate": rate**2, "place": x**2, "velocity": velocity**2}
        return -jnp.sum(jnp.stack([_WEIGHTS[name] * term for name, term in terms.items()])), terms


def make_cartpole_swing_up(*, scale: str, dt: float | None = None, num_substeps: int | None = None) -> CartpoleSwingUp:
    """Factory for the registry: four substeps, 240 steps of 1/60 s."""
    del scale
    steps = substeps(dt, num_substeps, Substeps(1.0 / 240, 4))
    model = load_asset("cartpole.xml", dt=steps.dt, penalty=Penalty(stiffness=0.0))
    return CartpoleSwingUp(model=model, num_substeps=steps.num, max_steps=240)
