"""System identification: recover Young's modulus from an observed motion by differentiating the environment itself.

An environment is a pytree whose leaves are physical parameters. Somebody pressed the pin into a dough of unknown
stiffness and recorded its particles; here the stiffness follows from ``jax.value_and_grad`` with respect to the
environment.

Stiff dough needs short substeps. An environment whose stiffness is replaced beyond what its substep allows sets
``Status.INVALID_PARAMETERS``, keeps its state and has a gradient of zero. Hence two precautions: substeps with room for
every stiffness that may be tried, and a look at the status before a gradient is used.

    python examples/identify_material.py
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

import rewax
from rewax.physics import mpm
from rewax.status import describe
from rewax.training import enable_compilation_cache


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this example."""

    true_modulus: float = 900.0
    """Young's modulus of the observed dough [Pa]."""
    first_guess: float = 400.0
    """[Pa]"""
    max_modulus: float = 3000.0
    """The substeps are stable up to this Young's modulus [Pa]."""
    iterations: int = 25
    steps: int = 8
    """Control steps that were observed."""
    step_factor: float = 1.0
    """Factor of Polyak's step length; above 2 steps overshoot."""


def with_modulus(env, modulus: jax.Array):
    """The same environment with another stiffness."""
    return rewax.replace_leaf(env, "scene.material.elasticity.youngs_modulus", modulus)


def with_room_for(max_modulus: float):
    """RollingFlat with substeps that are stable up to a Young's modulus [Pa]; the control step stays."""
    env = rewax.make("RollingFlat", scale="small")
    stiffest = with_modulus(env, max_modulus).scene.material
    limit = float(np.min(mpm.largest_stable_dt(stiffest, env.scene.grid)))
    return rewax.make("RollingFlat", scale="small", num_substeps=math.ceil(env.control_dt / limit))


def observe(env, actions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Particle positions over the motion [m], shape (steps, num_particles, 3), and the status of each step."""

    def step(state: rewax.State, action: jax.Array):
        state = env.step(state, action)
        return state, (env.particles(state.physics), state.status)

    return jax.lax.scan(step, env.reset(jax.random.key(0)), actions)[1]


def bits(status: jax.Array) -> int:
    """The bits that any of the steps set; ``rewax.status.describe`` gives their names."""
    return int(np.bitwise_or.reduce(np.asarray(status)))


def main(args: Args) -> float:
    enable_compilation_cache()
    env = with_room_for(args.max_modulus)
    # A dough that does not yield: what is observed then depends on its stiffness alone.
    env = rewax.replace_leaf(env, "scene.material.plasticity.yield_stress", 1e6)
    actions = jnp.tile(jnp.asarray([0.3, -1.0, 0.0]), (args.steps, 1))
    recorded, status = jax.jit(observe)(with_modulus(env, jnp.asarray(args.true_modulus)), actions)
    if bits(status):
        raise ValueError(f"the observed motion has status {describe(bits(status))}: give a larger max_modulus")

    @jax.jit
    def loss_and_grad(log_modulus: jax.Array):
        def loss(env) -> tuple[jax.Array, jax.Array]:
            positions, status = observe(env, actions)
            return jnp.mean((positions - recorded) ** 2) * 1e6, status  # mm^2

        guess = with_modulus(env, jnp.exp(log_modulus))
        # A gradient with respect to every leaf of the environment; the chain rule gives that by log_modulus.
        (value, status), grad = jax.value_and_grad(loss, has_aux=True, allow_int=True)(guess)
        return value, grad.scene.material.elasticity.youngs_modulus * jnp.exp(log_modulus), status

    # The mismatch of the right modulus is zero, which Polyak's step length makes use of.
    optimizer = optax.chain(optax.polyak_sgd(max_learning_rate=1e6), optax.scale(args.step_factor), optax.clip(0.5))
    log_modulus = last_valid = jnp.log(jnp.asarray(args.first_guess))
    opt_state = optimizer.init(log_modulus)
    for i in range(args.iterations):
        value, grad, status = loss_and_grad(log_modulus)
        modulus = float(jnp.exp(log_modulus))
        if bits(status) and i == 0:
            raise ValueError(f"the first guess has status {describe(bits(status))}: give a larger max_modulus")
        if bits(status):  # the gradient is zero: go back half the way to the last modulus whose motion is valid
            print(f"{i:4d}  E = {modulus:8.1f} Pa   {describe(bits(status))}: half the step back", flush=True)
            log_modulus = 0.5 * (log_modulus + last_valid)
            continue
        print(f"{i:4d}  E = {modulus:8.1f} Pa   mismatch {float(value):10.4g} mm^2", flush=True)
        last_valid = log_modulus
        updates, opt_state = optimizer.update(grad, opt_state, log_modulus, value=value)
        log_modulus = optax.apply_updates(log_modulus, updates)
    found = float(jnp.exp(last_valid))
    print(f"recovered {found:.1f} Pa, true {args.true_modulus:.1f} Pa")
    return found


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
