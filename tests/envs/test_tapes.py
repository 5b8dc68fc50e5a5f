"""Rigid tasks run on tapes: an operation that has no place on one would be slow without a word."""

import jax
import jax.numpy as jnp
import pytest
from native_cases import NEEDS_COMPILER

from rewax.envs import make
from rewax.physics.numerics import tape


@NEEDS_COMPILER
@pytest.mark.parametrize("task", ["AntRun", "HandReorient", "Hopper", "Quadruped"])
def test_a_step_and_its_gradient(monkeypatch, task):
    passes = []

    def refuse(which, *args):
        raise AssertionError(f"there is no tape for the {which}")

    def found(which, *args):
        passes.append(which)
        return target(which, *args)

    target = tape._target
    monkeypatch.setattr(tape, "_with_jax", refuse)
    monkeypatch.setattr(tape, "_target", found)
    env = make(task, scale="small")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    action = jnp.zeros(env.action_spec.shape)
    jax.jit(jax.grad(lambda action, state: env.step(state, action).reward)).lower(action, state)
    assert {"value", "cotangent"} <= set(passes)
