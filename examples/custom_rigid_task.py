"""Your own robot as a task: a model in MJCF, a reward, SAPO. The first joint of `--mjcf` is free or a slide joint."""

import jax.numpy as jnp
import tyro

from rewax import struct
from rewax.agents.sapo import SAPOConfig, make_sapo
from rewax.envs.kit.rigid_task import RigidTask, uniform
from rewax.physics import rigid
from rewax.physics.rigid import Penalty
from rewax.testing import check_env
from rewax.training import TrainConfig, train_and_compare

CRAWLER = """<mujoco><option timestep="0.004"/><default><geom type="capsule" size="0.03"/><motor gear="12"/>
<joint axis="0 1 0"/><default class="leg"><joint range="-60 60" stiffness="12" damping="0.6" armature="0.02"/></default>
</default><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.25"><geom type="box" size="0.25 0.1 0.03"/>
  <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="hinge"/>
  <body pos="-0.2 0 0"><geom fromto="0 0 0 -0.05 0 -0.2"/><joint class="leg" name="hind"/></body>
  <body pos="0.2 0 0"><geom fromto="0 0 0 0.05 0 -0.2"/><joint class="leg" name="front"/></body></body></worldbody>
<actuator><motor joint="hind"/><motor joint="front"/></actuator></mujoco>"""


@struct.dataclass
class Run(RigidTask):
    """Run along x: the reward is the velocity along x - 0.01 |action|^2. The position along x is not observed."""

    def start(self, key):
        return rigid.initial_state(self.model, qvel=uniform(key, self.model.num_dofs, 0.1)), None

    def observe(self, physics):
        return {"state": jnp.concatenate([physics.rigid.qpos[1:], 0.1 * physics.rigid.qvel])}

    def reward(self, physics):
        velocity = physics.rigid.qvel[0]
        return velocity - 0.01 * jnp.sum(physics.action**2), {"velocity": velocity}


def main(mjcf: str = CRAWLER, substeps: int = 5, iterations: int = 150, seed: int = 0) -> tuple[float, float]:
    limits = {
        "limit_stiffness": 50.0,
        "limit_damping": 0.5,
    }  # soft: a damper that stops a limb within a substep is unstable
    model = rigid.load(mjcf, penalty=Penalty(stiffness=1e4, damping=50.0, friction_damping=50.0, onset=0.005, **limits))
    assert model.static.mj.jnt_type[0] in (0, 2), "the first joint is not free or a slide: write another reward for it"
    env = Run(model=model, num_substeps=substeps, max_steps=200)
    check_env(env, check_full_episode=False)
    networks = {"actor_widths": (64, 64), "critic_widths": (64, 64), "vector_features": 64, "differentiate": "full"}
    agent = make_sapo(env, SAPOConfig(num_envs=32, num_iterations=iterations, initial_temperature=0.1, **networks))
    config = TrainConfig(num_iterations=iterations, run_dir=f"runs/custom-{seed}", seed=seed, eval_every=iterations)
    return train_and_compare(agent, env, config)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
