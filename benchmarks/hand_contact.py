"""How deep HandReorient's cube sinks, at rest on the palm and held by the fingers, and how fast things get.

By the laws of both scales and by the reference's: 32 cubes laid flat onto the palm, 32 cubes in curled fingers that
push with constant torques, up to 0.3 N m, about what it takes to hold the cube, and up to 0.8 N m. Of those that rest
after two seconds (below 0.1 m/s and rad/s), the depth of the cube's deepest contact and its speed. And the largest
speeds of joints and cube in 64 episodes of 64 steps of full random actions, held for eight steps each.

    python benchmarks/hand_contact.py
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import rewax
from rewax.envs.tasks.hand_reorient import REFERENCE_CONTACT, HandReorient
from rewax.physics import rigid
from rewax.physics.numerics import quaternion_to_matrix
from rewax.training import enable_compilation_cache
from rewax.types import Array

NUM, NUM_STEPS = 32, 240


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    enable_compilation_cache()
    print("| scale, contact | flat on the palm | held, up to 0.3 N m | held, up to 0.8 N m | largest speeds |")
    print("|---|---|---|---|---|")
    for scale in ("paper", "small"):
        for name, contact in (("own", None), ("reference's", REFERENCE_CONTACT)):
            env = rewax.make("HandReorient", scale=scale, contact=contact)
            cells = [
                resting(env, *on_the_palm(env)),
                *(resting(env, *in_the_fingers(env, torque)) for torque in (0.3, 0.8)),
                random_speeds(env),
            ]
            print(f"| {scale}, {name} | {' | '.join(cells)} |", flush=True)


def on_the_palm(env: HandReorient) -> tuple[np.ndarray, np.ndarray]:
    """Positions and actions: the cube flat on the palm, the thumb aside."""
    mj, rng = env.model.static.mj, np.random.default_rng(0)
    palm = mj.body("palm")
    rotation = np.asarray(quaternion_to_matrix(jnp.asarray(palm.quat, jnp.float32)))
    shift = rng.uniform(-3e-3, 3e-3, (NUM, 3)) * [0, 1, 1]
    q = np.tile(mj.qpos0, (NUM, 1))
    q[:, 0] = 0.3
    q[:, 16:19] = palm.pos + (np.array([0.0436, -0.015, -0.043]) + shift) @ rotation.T
    q[:, 19:] = palm.quat
    return q, np.zeros((NUM, 16))


def in_the_fingers(env: HandReorient, torque: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and actions: the cube above half curled fingers that go on curling, with at most this torque [N m]."""
    rng = np.random.default_rng(1)
    q = np.tile(env.model.static.mj.qpos0, (NUM, 1))
    q[:, 4:16] = np.tile([0.0, 0.3, 0.5, 0.5], 3)
    q[:, 16:19] = [0.0, -0.055, 0.575]
    q[:, 19:] = np.asarray(jax.vmap(env.start)(jax.random.split(jax.random.key(0), NUM))[0].qpos[:, 19:])
    strength = rng.uniform(0.05, 0.5 * torque, (NUM, 1))
    actions = np.zeros((NUM, 16))
    for finger in (4, 8, 12):
        actions[:, finger + 1 : finger + 4] = strength * rng.uniform([0.8, 0.3, 0.1], [1.0, 0.8, 0.5], (NUM, 3))
    actions[:, :4] = 0.5 * torque * rng.uniform([0.0, -0.7, 0.0, 0.0], [1.0, 0.7, 1.0, 1.0], (NUM, 4))
    return q, actions


def resting(env: HandReorient, q: np.ndarray, actions: np.ndarray) -> str:
    """Of cubes that rest on the hand: how many, largest depth of their contacts [mm], largest speed [mm/s]."""

    def run(q: Array, action: Array) -> Array:
        state = rigid.initial_state(env.model, q)
        advance = lambda s, _: (rigid.step(env.model, s, action, num_substeps=env.num_substeps), None)  # noqa: E731
        state = jax.lax.scan(advance, state, None, length=NUM_STEPS)[0]
        rests = (jnp.abs(state.qvel[16:]).max() < 0.1) & (state.qpos[18] > 0.45)
        depth = -jnp.min(rigid.contact_distances(env.model, state, body="cube"))
        return jnp.stack([rests, 1e3 * depth, 1e3 * jnp.linalg.norm(state.qvel[16:19])])

    rests, depth, speed = np.asarray(jax.jit(jax.vmap(run))(jnp.float32(q), jnp.float32(actions))).T
    if not rests.any():
        return "none"
    depth, speed = depth[rests > 0], speed[rests > 0]
    return f"{len(depth)} of {NUM}, {np.median(depth):.1f} to {depth.max():.1f} mm, {speed.max():.1f} mm/s"


def random_speeds(env: HandReorient) -> str:
    """Under full random actions."""

    def run(key: Array) -> Array:
        start_key, action_key = jax.random.split(key)
        actions = jnp.repeat(jax.random.uniform(action_key, (8, 16), minval=-1.0, maxval=1.0), 8, axis=0)

        def advance(state: rigid.RigidState, action: Array) -> tuple[rigid.RigidState, Array]:
            state = rigid.step(env.model, state, action, num_substeps=env.num_substeps)
            hand, cube, spin = state.qvel[:16], state.qvel[16:19], state.qvel[19:]
            return state, jnp.stack([jnp.max(jnp.abs(hand)), jnp.linalg.norm(cube), jnp.linalg.norm(spin)])

        return jnp.max(jax.lax.scan(advance, env.start(start_key)[0], actions)[1], axis=0)

    speeds = np.asarray(jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(2), 64)))
    failed = int(np.sum(~np.isfinite(speeds).all(axis=1)))
    if failed:
        return f"{failed} of 64 fail"
    joint, cube, spin = speeds.max(axis=0)
    return f"{joint:.0f} rad/s; {cube:.1f} m/s, {spin:.0f} rad/s"


if __name__ == "__main__":
    main()
