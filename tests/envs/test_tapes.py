"""The machine runs the physics of tasks: an operation that it lacks would be slow without a word."""

import jax
import jax.numpy as jnp
import pytest
from jax.sharding import PartitionSpec
from native_cases import NEEDS_COMPILER

from rewax.agents.devices import AXIS, mesh_of
from rewax.envs import make
from rewax.lowering import kernels, machine


def passes_of(monkeypatch, module):
    """What passes go to C++ from now on; none may be left to JAX."""
    passes, target = [], module._target

    def refuse(which, *args):
        raise AssertionError(f"there is no C++ for the {which}")

    def found(which, *args):
        passes.append(which)
        return target(which, *args)

    target.cache_clear()
    monkeypatch.setattr(module, "_with_jax", refuse)
    monkeypatch.setattr(module, "_target", found)
    return passes


def gradient(env):
    return jax.grad(lambda action, state: env.step(state, action).reward)


@NEEDS_COMPILER
@pytest.mark.parametrize("task", ["AntRun", "HandReorient", "Hopper", "Quadruped"])
def test_a_step_and_its_gradient(monkeypatch, task):
    passes, env = passes_of(monkeypatch, machine), make(task, scale="small")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    jax.jit(gradient(env)).lower(jnp.zeros(env.action_spec.shape), state)
    assert {"value", "cotangent"} <= set(passes)


@NEEDS_COMPILER
@pytest.mark.parametrize(("task", "module"), [("CartpoleSwingUp", machine), ("RollingFlat", kernels)])
def test_where_environments_are_divided_over_devices(monkeypatch, task, module):
    passes, env = passes_of(monkeypatch, module), make(task, scale="small")
    states = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 2))
    spec = PartitionSpec(AXIS)
    with jax.set_mesh(mesh_of(jax.devices()[:1])):
        own = jax.shard_map(jax.vmap(gradient(env)), in_specs=(spec, spec), out_specs=spec, check_vma=False)
        jax.jit(own).lower(jnp.zeros((2, *env.action_spec.shape)), states)
    assert {"value", "cotangent"} <= set(passes)
