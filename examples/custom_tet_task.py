"""Your own task on tetrahedra: a soft bar bends by its muscles and moves forwards. Comments explain it."""

import jax.numpy as jnp
import numpy as np
import tyro

from rewax import struct
from rewax.agents.presets import SMALL
from rewax.agents.sapo import make_sapo
from rewax.envs.kit import PointCloud, SoftTask, reset_noise
from rewax.physics import tets
from rewax.physics.contact import Ground, PenaltyContact
from rewax.physics.tets import tetmesh
from rewax.testing import check_env
from rewax.training import TrainConfig, train_and_compare
from rewax.types import Array

MUSCLES = 4  # along the bar, above and below


@struct.dataclass
class Crawl(SoftTask):
    """The reward is the bar's velocity along x [m/s], less 0.01 times the mean square of the actions."""

    muscles: Array  # effect of each action on each tet, (num_tets, num_actions); a parameter, like every array

    @property
    def num_actions(self):  # by default one for each joint of the tools; there are no tools here
        return 2 * MUSCLES

    def actuated(self, action):  # the scene of a control step: the action sets the activations
        return self.scene.replace(activation=self.muscles @ action)

    def observe(self, physics):  # arrays of rank 2 are point clouds; all others form one vector
        x, v = physics.soft.x, physics.soft.v
        shape = (x - x.mean(0))[:: len(x) // 12]  # without the position along x, on which the reward does not depend
        return {"shape": shape.reshape(-1), "height": x[:, 1].mean(), "velocity": v.mean(0), "action": physics.action}

    def reward(self, physics):
        velocity = physics.soft.v[:, 0].mean()
        return velocity - 0.01 * jnp.mean(physics.action**2), {"velocity": velocity}


def make_crawl() -> Crawl:
    mesh = tetmesh.box((0.4, 0.1, 0.1), (8, 2, 2))  # or voxels of any shape, or load_tetmesh("body.msh")
    middles = mesh.vertices[mesh.tets].mean(1)
    along = np.clip((middles[:, 0] - mesh.vertices[:, 0].min()) / 0.4 * MUSCLES, 0, MUSCLES - 1).astype(int)
    above = middles[:, 1] > mesh.vertices[:, 1].mean()
    moduli = tets.stable_parameters(2e4, 0.3)  # Young's modulus [Pa] and Poisson's ratio
    scene = tets.make_scene(
        mesh=mesh,
        density=500.0,
        mu=moduli.mu,
        lam=moduli.lam,
        damping=20.0,
        dt=1e-3,  # an error names the largest stable dt if this one is too long
        ground=Ground(normal=(0.0, 1.0, 0.0)),
        contact=PenaltyContact(  # for each vertex: forces per metre of depth, and per metre per second
            stiffness=500.0,
            damping=1.0,
            friction_damping=5.0,
            friction=0.8,
            radius=0.01,
        ),
    )
    rest = (
        mesh.vertices - mesh.vertices.min(0) + np.array([0.0, 0.005, 0.0])
    )  # it touches the ground: in the air the gradient would be zero
    return Crawl(
        scene=scene,
        rest_positions=rest,
        noise=reset_noise((0.0, 0.0, 0.0), (0.0, 0.01, 0.0)),
        cloud=PointCloud(num_points=len(rest)),
        num_substeps=20,
        max_steps=100,
        muscles=0.3 * jnp.eye(2 * MUSCLES)[along + MUSCLES * above],  # positive activation contracts
    )


def main(iterations: int = 100, seed: int = 0, check: bool = True) -> tuple[float, float]:
    env = make_crawl()
    if check:
        check_env(env, check_full_episode=False)
    config = TrainConfig(num_iterations=iterations, run_dir=f"runs/crawl-{seed}", seed=seed, eval_every=iterations)
    return train_and_compare(make_sapo(env, SMALL), env, config)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
