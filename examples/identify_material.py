"""System identification: recover Young's modulus from an observed motion by differentiating the environment itself.

An environment is a pytree whose leaves are physical parameters. Somebody pressed the pin into a dough of unknown
stiffness and recorded its particles; here the stiffness follows from ``jax.value_and_grad`` with respect to the
environment.

    python examples/identify_material.py
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax
import tyro

import rewax
from rewax.training import enable_compilation_cache


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this example."""

    true_modulus: float = 900.0
    """Young's modulus of the observed dough [Pa]."""
    first_guess: float = 400.0
    """[Pa]"""
    iterations: int = 25
    steps: int = 8
    """Control steps that were observed."""


def with_modulus(env, modulus: jax.Array):
    """The same environment with another stiffness."""
    return rewax.replace_leaf(env, "scene.material.elasticity.youngs_modulus", modulus)


def observe(env, actions: jax.Array) -> jax.Array:
    """Particle positions over the motion [m], shape (steps, num_particles, 3)."""

    def step(state: rewax.State, action: jax.Array):
        state = env.step(state, action)
        return state, env.particles(state.physics)

    return jax.lax.scan(step, env.reset(jax.random.key(0)), actions)[1]


def main(args: Args) -> float:
    enable_compilation_cache()
    env = rewax.make("RollingFlat", scale="small")
    # A dough that does not yield: what is observed then depends on its stiffness alone.
    env = rewax.replace_leaf(env, "scene.material.plasticity.yield_stress", 1e6)
    actions = jnp.tile(jnp.asarray([0.3, -1.0, 0.0]), (args.steps, 1))
    recorded = jax.jit(observe)(with_modulus(env, jnp.asarray(args.true_modulus)), actions)

    @jax.jit
    def loss_and_grad(log_modulus: jax.Array):
        def loss(env) -> jax.Array:
            return jnp.mean((observe(env, actions) - recorded) ** 2) * 1e6  # mm^2

        guess = with_modulus(env, jnp.exp(log_modulus))
        value, grad = jax.value_and_grad(loss, allow_int=True)(guess)  # a gradient for every leaf of the environment
        return value, grad.scene.material.elasticity.youngs_modulus * jnp.exp(log_modulus)

    # The mismatch of the right modulus is zero, which Polyak's step length makes use of.
    optimizer = optax.chain(optax.polyak_sgd(max_learning_rate=1e6), optax.clip(0.5))
    log_modulus = jnp.log(jnp.asarray(args.first_guess))
    opt_state = optimizer.init(log_modulus)
    for i in range(args.iterations):
        value, grad = loss_and_grad(log_modulus)
        print(f"{i:4d}  E = {float(jnp.exp(log_modulus)):8.1f} Pa   mismatch {float(value):10.4g} mm^2", flush=True)
        updates, opt_state = optimizer.update(grad, opt_state, log_modulus, value=value)
        log_modulus = optax.apply_updates(log_modulus, updates)
    found = float(jnp.exp(log_modulus))
    print(f"recovered {found:.1f} Pa, true {args.true_modulus:.1f} Pa")
    return found


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
