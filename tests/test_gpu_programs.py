"""Every task's step, its gradient and a train step can be lowered for CUDA, on a machine without a GPU."""

import jax
import jax.numpy as jnp
import pytest
from jax import export

import rewax
from rewax.agents.registry import algorithm
from rewax.envs import list_envs
from rewax.physics.mpm.active_nodes import list_nodes
from rewax.physics.mpm.grid import Grid

FEW = ("RollingFlat", "SoftJumper", "AntRun")
TASKS = [name if name in FEW else pytest.param(name, marks=pytest.mark.slow) for name in list_envs()]


def lowered(function, *args):
    """The program for CUDA as text. What only a CPU has makes this fail."""
    return export.export(jax.jit(function), platforms=["cuda"])(*args).mlir_module()


@pytest.mark.parametrize("name", TASKS)
def test_step_and_gradient(name):
    env = rewax.make(name, scale="paper")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    action = jax.ShapeDtypeStruct(env.action_spec.shape, jnp.float32)

    def value_and_gradient(state, action):
        def reward(action):
            after = env.step(state, action)
            return after.reward, after

        return jax.value_and_grad(reward, has_aux=True)(action)

    assert "stablehlo.while" in lowered(value_and_gradient, state, action)


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow) for name in list_envs()])
def test_train_step(name):
    known = algorithm("sapo")
    agent = known.make(rewax.make(name, scale="small"), known.preset(name, "small"))
    lowered(agent.train_step, jax.eval_shape(agent.init, jax.random.key(0)))


def test_a_list_of_active_nodes_is_found_without_a_loop():
    """A loop of searches is 36 kernels: two scatters and a window instead, and sums with no ladder of windows."""
    grid = Grid(shape=(49, 49, 49), spacing=1.0 / 48)
    x = jax.ShapeDtypeStruct((4, 100, 3), jnp.float32)
    text = lowered(jax.vmap(lambda x: list_nodes(grid, x, 1000, reach=0.5)), x)
    assert "stablehlo.while" not in text
    assert text.count('"stablehlo.scatter"') == 2
    assert text.count('"stablehlo.reduce_window"') == 1
