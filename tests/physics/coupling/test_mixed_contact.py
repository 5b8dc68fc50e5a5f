"""Sand and cloth together: nothing is lost, each alone where they are apart, exact gradients."""

import jax
import jax.numpy as jnp
import numpy as np
from mixed_bodies import RUN, SPACING, bag_mesh, both, cloth_scene, sand_scene

from rewax.physics import coupling, mpm, rigid, thin
from rewax.physics.contact import Collider, PenaltyContact
from rewax.physics.coupling import articulated, free_body
from rewax.physics.mpm import invariants
from rewax.physics.shapes import Sphere, fill_box


def touching(**changes):
    """A cloth, free to move, and a ball of sand in contact with it that fly towards each other."""
    mesh = thin.ThinMesh(vertices=thin.sheet(0.1, 0.1, 4, 4).vertices - [0.05, 0.0, 0.05],
                         triangles=thin.sheet(0.1, 0.1, 4, 4).triangles)  # fmt: skip
    particles = sand_scene(gravity=(0.0, 0.0, 0.0))
    cloth = cloth_scene(mesh, gravity=(0.0, 0.0, 0.0), **changes)
    grains = fill_box((0.003, 0.0125, 0.002), (0.03, 0.025, 0.03), SPACING)
    scene, state = both(mesh, grains, particles=particles, thin_scene=cloth)
    rng = np.random.default_rng(0)
    noise = [0.02 * rng.standard_normal(a.shape) for a in (state.particles.v, state.thin.v)]
    return scene, state.replace(
        particles=state.particles.replace(v=jnp.asarray(noise[0]) + jnp.array([0.1, -0.5, 0.0])),
        thin=state.thin.replace(v=jnp.asarray(noise[1])),
    )


def test_momentum_is_conserved_to_rounding(x64):
    scene, state = touching()
    scene = scene.replace(contact=scene.contact.replace(friction=jnp.zeros(())))  # whose forces have a torque

    def totals(state):
        p, t = (scene.particles, state.particles), (scene.thin, state.thin)
        return invariants.momentum(*p) + thin.momentum(*t), invariants.angular_momentum(*p) + thin.angular_momentum(*t)

    end = RUN(scene, state, coupling.static_poses(80, dtype=float))
    moved = float(jnp.abs(thin.momentum(scene.thin, end.thin) - thin.momentum(scene.thin, state.thin)).max())
    assert moved > 1e-4
    linear, angular = zip(totals(end), totals(state), strict=True)
    np.testing.assert_allclose(*linear, atol=1e-12 * moved)
    np.testing.assert_allclose(*angular, atol=1e-12 * moved)


def test_far_apart_each_moves_as_alone(x64):
    mesh, rim = bag_mesh(4)
    grains = fill_box((0.0, 0.05, 0.0), (0.03, 0.03, 0.03), SPACING)
    scene, state = both(mesh, grains, thin_scene=cloth_scene(mesh, held=rim))
    end = RUN(scene, state, coupling.static_poses(40, dtype=float))
    sand = jax.jit(mpm.step)(scene.particles, state.particles, mpm.static_poses(40, dtype=float))
    cloth = jax.jit(thin.step)(scene.thin, state.thin, thin.static_poses(40, dtype=float))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), end, end.replace(particles=sand, thin=cloth)
    )


def test_a_free_body_between_both_loses_nothing(x64):
    """A ball flies into the sand that lies on a cloth: all three share its momentum."""
    ball = Collider(shape=Sphere(radius=0.015), friction=0.3)
    scene, state = touching(
        colliders=(ball,), contact=PenaltyContact(stiffness=50.0, friction_damping=0.01, radius=2e-3)
    )
    scene = scene.replace(particles=scene.particles.replace(colliders=(ball,)))
    inertia = free_body.Inertia(mass=jnp.array([0.01]), moment=1e-6 * jnp.eye(3)[None])
    body = free_body.bodies_at_rest(jnp.array([[0.0, -0.012, 0.0]])).replace(velocity=jnp.array([[0.0, 0.4, 0.1]]))

    def total(state, body):
        soft = invariants.momentum(scene.particles, state.particles) + thin.momentum(scene.thin, state.thin)
        return soft + free_body.momentum(body, inertia)

    end, after, wrench = jax.jit(coupling.step)(scene, inertia, state, body, coupling.static_poses(40, dtype=float))
    change = 0.01 * (after.velocity - body.velocity)[0]
    assert float(jnp.abs(change).max()) > 1e-5
    np.testing.assert_allclose(wrench.force[0] * 40 * scene.dt, change, rtol=1e-9)
    np.testing.assert_allclose(total(end, after), total(state, body), atol=1e-14)


HAND = """
<mujoco><option gravity="0 0 0"/><worldbody><body name="hand" pos="0 .01 0"><freejoint/>
  <geom type="box" size=".01 .01 .01" mass=".05" contype="0" conaffinity="1"/></body></worldbody></mujoco>
"""


def test_a_robot_that_holds_a_cloth_with_sand_loses_nothing(x64):
    """A hand that floats freely grasps the cloth on which sand lands: all three share their momentum."""
    model = rigid.load(HAND, dt=2e-4)
    grasp = thin.Grasp(radius=0.06, stiffness=50.0, damping=0.05, body=1)
    scene, state = touching(grasps=(grasp,))
    robot = rigid.initial_state(model, qvel=jnp.zeros(6).at[1].set(0.3))
    state = state.replace(thin=thin.open_grasps(scene.thin, state.thin, rigid.body_poses(model, robot)))

    def total(state, robot):
        soft = invariants.momentum(scene.particles, state.particles) + thin.momentum(scene.thin, state.thin)
        return soft + 0.05 * robot.qvel[:3]

    step = jax.jit(articulated.step, static_argnames="num_substeps")
    end, after, _ = step(scene, model, state, robot, grips=jnp.ones(1), num_substeps=20)
    assert float(jnp.abs(after.qvel - robot.qvel).max()) > 1e-2
    np.testing.assert_allclose(total(end, after), total(state, robot), atol=1e-14)


def landed(scene, state):
    """A number from 12 substeps of sand that hits a cloth."""
    end = coupling.step_prescribed(scene, state, coupling.static_poses(12, dtype=float), store_every=3)
    leaves = (end.particles.x, 0.01 * end.particles.v, end.thin.x, 0.01 * end.thin.v)
    return sum(jnp.sum(jnp.cos(jnp.arange(a.size)).reshape(a.shape) * a) for a in leaves)


def test_reverse_is_forward_is_finite_difference(x64, agree_along):
    scene, state = touching(held=[0, 4])
    zero = jax.tree.map(jnp.zeros_like, (scene, state))
    rng = np.random.default_rng(3)

    def noise(a):
        return jnp.asarray(rng.standard_normal(a.shape))

    law = jax.tree.map(lambda a: 0.1 * a, scene.contact).replace(max_speed=jnp.zeros(()))
    directions = {
        "contact": (zero[0].replace(contact=law), zero[1]),
        "particles": (zero[0], zero[1].replace(
            particles=zero[1].particles.replace(x=noise(state.particles.x), v=noise(state.particles.v)))),
        "cloth": (zero[0], zero[1].replace(thin=zero[1].thin.replace(x=noise(state.thin.x), v=noise(state.thin.v)))),
        "density of sand": (zero[0].replace(particles=zero[0].particles.replace(
            material=zero[0].particles.material.replace(density=jnp.asarray(1e4)))), zero[1]),
    }  # fmt: skip
    agree_along(landed, (scene, state), directions, step=1e-7, exact=1e-8, bar=1e-4, least=1e-9)
