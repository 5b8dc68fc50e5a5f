"""Predicted peak memory against what XLA allocates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material

from rewax.physics import mpm
from rewax.physics.contact.colliders import Collider
from rewax.physics.mpm import Hencky, VonMises
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.memory import predict_peak_bytes
from rewax.physics.mpm.walls import Wall, Walls
from rewax.physics.shapes import Capsule


def make(num_colliders: int, max_active_nodes: int | None, plasticity: type[VonMises] | None) -> mpm.MPMScene:
    def pin(radius: float) -> Collider:
        shape = Capsule(radius=jnp.asarray(radius), half_length=jnp.asarray(0.1))
        return Collider(shape=shape, offset=jnp.zeros(3), rotation=jnp.eye(3), friction=jnp.asarray(0.5))

    return mpm.make_scene(
        grid=Grid(shape=(24, 16, 20), spacing=0.05), dt=1e-3, particle_volume=jnp.asarray(1e-5),
        material=flat_material(
            youngs_modulus=jnp.asarray(1e4), poissons_ratio=jnp.asarray(0.3), density=jnp.asarray(1000.0),
            yield_stress=jnp.asarray(100.0 if plasticity is VonMises else jnp.inf), elasticity=Hencky, plasticity=plasticity,
        ),
        colliders=tuple(pin(0.05 * (1 + i)) for i in range(num_colliders)), max_active_nodes=max_active_nodes,
        walls=Walls(lower=(None, Wall(position=0.1), None), upper=(None,) * 3),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("scene", "particles", "substeps", "envs", "horizon", "store_every"),
    [
        (make(0, 1000, None), 700, 10, 4, 3, 1),
        pytest.param(make(1, 900, VonMises), 300, 32, 2, 20, 8, marks=pytest.mark.slow),
        pytest.param(make(2, None, VonMises), 1500, 4, 1, 2, 1, marks=pytest.mark.slow),
    ],
)
def test_prediction_is_within_15_percent(scene, particles, substeps, envs, horizon, store_every):
    def height(v):
        def control_step(state, _):
            poses = mpm.static_poses(substeps, len(scene.colliders))
            poses = poses._replace(position=poses.position + v)  # bodies that move with what is differentiated
            return mpm.step(scene, state, poses, store_every=store_every), None

        state = mpm.initial_state(jnp.full((particles, 3), 0.5))
        state = state.replace(v=state.v + v)
        return jax.lax.scan(jax.checkpoint(control_step), state, length=horizon)[0].x[:, 1].mean()

    memory = jax.jit(jax.vmap(jax.grad(height))).lower(jnp.zeros((envs, 3))).compile().memory_analysis()
    allocated = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    options = {"num_envs": envs, "horizon": horizon, "store_every": store_every}
    predicted = predict_peak_bytes(scene, num_particles=particles, num_substeps=substeps, **options)
    print(predicted, allocated, predicted / allocated)
    assert predicted == pytest.approx(allocated, rel=0.15)


def test_grows_with_what_it_should():
    scene = make(0, 1000, None)
    size = {"num_particles": 1000, "num_substeps": 40}

    def predict(**changes):
        return predict_peak_bytes(scene, **{**size, **changes})

    assert predict(num_envs=32) == 32 * predict()
    assert predict(bytes_per_float=8) == 2 * predict()
    state = 4 * 24 * 1000
    assert predict(num_substeps=80) - predict() == 40 * state
    assert predict() - predict(store_every=5) == (40 - 13) * state
    np.testing.assert_allclose(predict(horizon=11) - predict(horizon=1), 10 * state, rtol=0.15)
    with pytest.raises(ValueError, match="store_every is 7: give an integer that divides the 40 substeps"):
        predict(store_every=7)
    with pytest.raises(ValueError, match="store_every is None, and what XLA then stores is not predicted"):
        predict(store_every=None)
