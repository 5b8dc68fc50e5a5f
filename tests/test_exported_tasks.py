"""Steps and gradients of tasks leave the process: exported without C++, and sharded with JAX's own checks."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from jax.sharding import Mesh

from rewax.envs import make

RUN_AGAIN = """
import sys
import jax, numpy as np
given = np.load(sys.argv[2])
exported = jax.export.deserialize(bytearray(open(sys.argv[1], "rb").read()))
found = exported.call(*(given[f"in{k}"] for k in range(len(exported.in_avals))))
for k, value in enumerate(jax.tree.leaves(found)):
    np.testing.assert_allclose(value, given[f"out{k}"], rtol=2e-3, atol=2e-4)
print("the same numbers")
"""
TASKS = [
    "RollingFlat",
    pytest.param("AntRun", marks=pytest.mark.slow),
    pytest.param("GripperLift", marks=pytest.mark.slow),
]


def of_arrays(env):
    """A step's reward and observations, and its gradient by the action, as a function of arrays; and these arrays."""
    state = jax.jit(env.reset)(jax.random.key(0))
    leaves, treedef = jax.tree.flatten(state)
    keys = [jnp.issubdtype(a.dtype, jax.dtypes.prng_key) for a in leaves]

    def function(action, *arrays):
        given = [jax.random.wrap_key_data(a) if key else a for a, key in zip(arrays, keys, strict=True)]
        state = jax.tree.unflatten(treedef, given)

        def reward(action):
            after = env.step(state, action)
            return after.reward, after.obs

        (value, obs), gradient = jax.value_and_grad(reward, has_aux=True)(action)
        return value, obs, gradient

    plain = [jax.random.key_data(a) if key else a for a, key in zip(leaves, keys, strict=True)]
    return function, [0.3 * jnp.ones(env.action_spec.shape), *plain]


@pytest.mark.parametrize("task", TASKS)
def test_a_step_and_its_gradient_run_in_another_process(task, tmp_path, sharing_programs):
    function, arrays = of_arrays(make(task, scale="small"))
    exported = jax.export.export(jax.jit(function))(*arrays)
    assert "rewax_" not in exported.mlir_module()
    (tmp_path / "step").write_bytes(exported.serialize())
    numbers = {f"in{k}": np.asarray(a) for k, a in enumerate(arrays)}
    numbers |= {f"out{k}": np.asarray(a) for k, a in enumerate(jax.tree.leaves(jax.jit(function)(*arrays)))}
    np.savez(tmp_path / "numbers.npz", **numbers)
    command = [sys.executable, "-c", RUN_AGAIN, str(tmp_path / "step"), str(tmp_path / "numbers.npz")]
    environment = {**sharing_programs, **toys.subprocess_environment(), "REWAX_NATIVE": "0"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300)
    assert done.stdout == "the same numbers\n", done.stderr


@pytest.mark.parametrize("task", TASKS)
def test_sharded_with_the_defaults_of_shard_map(task):
    """Two environments on as many devices as there are, with ``check_vma=True``."""
    env = make(task, scale="small")
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2))
    actions = 0.3 * jnp.ones((2, *env.action_spec.shape))

    def gradient(actions, states):
        def total(actions):
            return jnp.sum(jax.vmap(env.step)(states, actions).reward)

        return jax.grad(total)(actions)

    mesh, spec = Mesh(np.array(jax.devices()[:2]), ("envs",)), jax.P("envs")
    sharded = jax.jit(jax.shard_map(gradient, mesh=mesh, in_specs=(spec, spec), out_specs=spec))
    np.testing.assert_allclose(sharded(actions, states), jax.jit(gradient)(actions, states), rtol=2e-3, atol=1e-6)
