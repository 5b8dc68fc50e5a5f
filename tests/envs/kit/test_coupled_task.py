"""A task on a robot and tetrahedra: a paddle on a rail pushes a soft block, and feels it."""

import jax
import jax.numpy as jnp
import pytest

from rewax import struct
from rewax.envs.kit import coupled_task
from rewax.envs.kit.coupled_task import CoupledPhysics, CoupledTask
from rewax.envs.kit.point_cloud import PointCloud
from rewax.physics import rigid, tets, thin
from rewax.physics.contact import Ground, PenaltyContact
from rewax.physics.tets import tetmesh
from rewax.status import Status

MESH = tetmesh.box((0.1, 0.1, 0.1), (2, 2, 2), center=(0.0, 0.055, 0.0), tets_per_cell=5)
RAIL = """
<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="paddle" pos="-.1 .05 0"><joint name="rail" type="slide" axis="1 0 0" damping="1"/>
    <geom type="sphere" size=".04" mass=".2" contype="0" conaffinity="1"/></body>
</worldbody><actuator><motor joint="rail" gear="5" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>
"""


@struct.dataclass
class Push(CoupledTask):
    """The reward is how far the block has gone along x [m]."""

    def observe(self, physics):
        return {"particle_q": self.observed(physics), "touch": physics.touch.force[1]}

    def reward(self, physics: CoupledPhysics):
        return physics.soft.x[:, 0].mean(), {}


def push():
    model = rigid.load(RAIL, dt=2e-3)
    scene = tets.make_scene(
        mesh=MESH, density=500.0, mu=1e4, lam=1.5e4, damping=5.0, dt=1e-3, colliders=rigid.colliders(model),
        ground=Ground(normal=jnp.array([0.0, 1.0, 0.0])),
        contact=PenaltyContact(stiffness=5e2, damping=1.0, friction_damping=2.0, friction=0.2, radius=0.005),
    )  # fmt: skip
    rest = jnp.asarray(MESH.vertices, jnp.result_type(float))
    return Push(
        model=model, scene=scene, rest_positions=rest, cloud=PointCloud(num_points=8), num_substeps=10, max_steps=20
    )


@pytest.mark.parametrize(
    ("method", "returned", "sentence"),
    [
        ("control", None, "control returned None: return one number for each actuator"),
        (
            "start",
            (None, None, None),
            "start returned None for the robot, which must be a RigidState: return the robot, ",
        ),
    ],
)
def test_what_a_method_returns_wrongly_is_named(method, returned, sentence, monkeypatch):
    monkeypatch.setattr(Push, method, lambda self, *_: returned)
    env = push()
    with pytest.raises(ValueError, match=f"^Push.{sentence}"):
        jax.eval_shape(lambda key: env.step(env.reset(key), jnp.zeros(1)), jax.random.key(0))


def test_a_paddle_pushes_the_block_and_feels_it():
    env = push()
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0))
    assert state.obs["particle_q"].shape == (8, 3)
    states = [state]
    for _ in range(12):
        states.append(step(states[-1], jnp.ones(1)))
    end = states[-1]
    assert all(int(s.status) == Status.OK for s in states)
    assert float(end.reward) > 0.01 and float(end.physics.rigid.qvel[0]) > 0.0
    # What the block got along x beyond friction with the ground came from the paddle, which felt it.
    felt = sum(float(s.obs["touch"][0]) for s in states) * env.control_dt
    gained = float(tets.momentum(env.scene, end.physics.soft)[0])
    weight = float(env.scene.mass.sum()) * 9.81
    assert gained <= -felt <= gained + 0.2 * weight * 12 * env.control_dt
    assert felt < -0.1


def test_cloth_is_refused():
    env = push()
    scene = thin.make_scene(
        mesh=thin.sheet(0.1, 0.1, 1, 1), dt=1e-3,
        cloth=thin.isotropic_cloth(youngs_modulus=1e3, poissons_ratio=0.3, thickness=2e-3, density=200.0),
    )  # fmt: skip
    with pytest.raises(ValueError, match="scene is a ThinScene, but the soft body of a CoupledTask has particles or "):
        env.replace(scene=scene)


def test_each_piece_of_a_control_step_tells_what_it_did_not_solve(monkeypatch):
    """Forces do not balance in the first piece alone: the robot forgets that at the beginning of the next."""
    env = push().replace(num_substeps=4, list_every=2)
    physics, _ = env.begin(jax.random.key(0))

    def step(scene, model, soft, bodies, control, *, num_substeps):
        assert num_substeps == 2
        after = bodies.replace(qvel=bodies.qvel + 1.0, unsolved=1.0 - jnp.minimum(bodies.qvel[0], 1.0))
        return soft, after, physics.touch

    monkeypatch.setattr(coupled_task.articulated, "step", step)
    after, status = env.advance(physics, jnp.zeros(1))
    assert float(after.rigid.qvel[0]) == 2.0 and float(after.rigid.unsolved) == 0.0
    assert int(status) == Status.UNSOLVED
