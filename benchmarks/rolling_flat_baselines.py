"""What RollingFlat is worth without learning: the baselines of the README's table.

Evaluates on the same resets: no action, pressing straight down, scripted rolling (the pin sweeps about the dough's
centre while it presses; the best of several amplitudes), and random action sequences (open loop, uniform in [-1, 1];
mean and best of 64 by mean return). The untrained policy is evaluation 0 of a training run.

    python benchmarks/rolling_flat_baselines.py --scale small
"""

import dataclasses
import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rewax
from rewax.training import enable_compilation_cache


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    scale: str = "small"
    num_resets: int = 8
    num_sequences: int = 64
    seed: int = 1
    sequences_at_once: int = 8
    """Random sequences simulated side by side; lower it to save memory."""
    out: str = ""
    """Also write the numbers to this JSON file."""


AMPLITUDES = (0.025, 0.05, 0.075, 0.1, 0.125)


def scripted(state: rewax.State, amplitude: jax.Array, press: jax.Array) -> jax.Array:
    """Press with strength ``press``; sweep within ``amplitude`` [m] of the dough's centre (0: stay)."""
    physics = state.physics
    x, centre = physics.joint_q[0], state.obs["com_q"][0]
    direction = jnp.where(physics.joint_qd[0] < 0, -1.0, 1.0)
    direction = jnp.where(x > centre + amplitude, -1.0, jnp.where(x < centre - amplitude, 1.0, direction))
    return jnp.stack([jnp.where(amplitude > 0, direction, 0.0), -press, jnp.zeros_like(x)])


def main(args: Args) -> dict[str, float]:
    enable_compilation_cache()
    env = rewax.make("RollingFlat", scale=args.scale)
    steps, size = env.episode_length, env.action_spec.shape[0]
    keys = jax.random.split(jax.random.key(args.seed), args.num_resets)

    def episode(key, amplitude, press, actions):
        """Return of one episode: scripted action plus an open-loop one."""

        def step(state, action):
            state = env.step(state, scripted(state, amplitude, press) + action)
            return state, state.reward

        return jax.lax.scan(step, env.reset(key), actions)[1].sum()

    @jax.jit
    def returns(amplitudes, presses, actions):
        over_resets = jax.vmap(episode, in_axes=(0, None, None, None))
        return jax.vmap(over_resets, in_axes=(None, 0, 0, 0))(keys, amplitudes, presses, actions)

    def batched(amplitudes, presses, actions):
        n = args.sequences_at_once
        pad = -len(amplitudes) % n
        arrays = [jnp.concatenate([a, jnp.repeat(a[-1:], pad, axis=0)]) for a in (amplitudes, presses, actions)]
        parts = [returns(*(a[i : i + n] for a in arrays)) for i in range(0, len(arrays[0]), n)]
        return np.concatenate(parts)[: len(amplitudes)].mean(axis=1)

    amplitudes = jnp.asarray([0.0, 0.0, *AMPLITUDES])
    presses = jnp.asarray([0.0, 1.0] + [1.0] * len(AMPLITUDES))
    fixed = batched(amplitudes, presses, jnp.zeros((len(amplitudes), steps, size)))
    shape = (args.num_sequences, steps, size)
    actions = jax.random.uniform(jax.random.key(args.seed + 1), shape, minval=-1.0, maxval=1.0)
    none = jnp.zeros(args.num_sequences)
    random = batched(none, none, actions)
    best = int(np.argmax(fixed[2:]))
    result = {
        "no action": float(fixed[0]),
        "pressing straight down": float(fixed[1]),
        f"scripted rolling, amplitude {AMPLITUDES[best]} m": float(fixed[2 + best]),
        f"random sequences, mean of {args.num_sequences}": float(random.mean()),
        f"random sequences, best of {args.num_sequences}": float(random.max()),
    }
    print(f"RollingFlat {args.scale}: return per episode of {steps} steps, mean over {args.num_resets} resets")
    for name, value in result.items():
        print(f"  {name:40s} {value:8.2f}")
    if args.out:
        pathlib.Path(args.out).write_text(json.dumps(result, indent=2) + "\n")
    return result


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
