"""One control step of each task at scale paper, from a disturbed state, in double precision: books and gradients.

Random actions bring tools and material together; then positions, velocities and deformations are disturbed. Of the
control step from there: status bits; whether everything stays in the domain; how far mass on the nodes is from the
particles', and how far the change of momentum is from gravity's and the tools' impulse (walls and ground left out of
that step), relative to the sizes of the terms; the gradient of the reward of two steps by actions, reverse against
forward mode and against central differences along a random direction.

    python benchmarks/paper_steps.py                       # minutes per task on two cores
    python benchmarks/paper_steps.py --tasks RollingFlat --scale small
"""

import dataclasses
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

import rewax  # noqa: E402
from rewax.envs.base import State  # noqa: E402
from rewax.envs.kit import CoupledTask, SoftTask  # noqa: E402
from rewax.physics import coupling, mpm, tets  # noqa: E402
from rewax.physics.coupling import FreeBodies, Inertia, articulated  # noqa: E402
from rewax.physics.mpm import MPMScene, Walls, invariants  # noqa: E402
from rewax.physics.mpm.packing import split  # noqa: E402
from rewax.physics.mpm.stepping import nodes_of_step, to_nodes  # noqa: E402
from rewax.physics.tets import invariants as tet_invariants  # noqa: E402
from rewax.status import describe  # noqa: E402
from rewax.training import enable_compilation_cache  # noqa: E402

SOFT = ("RollingFlat", "HandFlip", "HandLift", "FluidMove", "SoftJumper", "GripperLift", "SteerFloat")
DRIFT = {"RollingFlat": (0.3, -1.0, 0.0), "HandFlip": 0.6, "HandLift": 0.6, "GripperLift": (0.0, 0.8, 0.8)}
"""Mean actions that bring the tools to the material."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this check."""

    tasks: tuple[str, ...] = (*SOFT, "AntRun", "HandReorient")
    scale: str = "paper"
    warm: int = 30
    """Control steps before the disturbance."""
    seed: int = 0


def disturbed(env: Any, state: State, key: jax.Array) -> State:
    """Soft bodies: every point moved, pushed and strained; robots: other velocities."""
    physics, keys = state.physics, jax.random.split(key, 4)
    if hasattr(physics, "rigid"):
        noise = 0.1 * jax.random.normal(keys[0], physics.rigid.qvel.shape)
        physics = physics.replace(rigid=physics.rigid.replace(qvel=physics.rigid.qvel + noise))
    if hasattr(physics, "soft"):
        soft, scene = physics.soft, env.scene
        length = scene.grid.spacing if isinstance(scene, MPMScene) else float(jnp.cbrt(scene.rest_volume.mean()))
        speed = 0.01 * length / scene.dt
        changes = {
            "x": soft.x + 0.05 * length * jax.random.normal(keys[1], soft.x.shape),
            "v": soft.v + speed * jax.random.normal(keys[2], soft.v.shape),
        }
        if isinstance(scene, MPMScene):
            changes["F"] = soft.F + 0.02 * jax.random.normal(keys[3], soft.F.shape)
        physics = physics.replace(soft=soft.replace(**changes))
    return state.replace(physics=physics)


def books(env: Any, physics: Any, action: jax.Array) -> tuple[float, float]:
    """Relative errors of mass on the nodes and of momentum; nan where there is nothing to add up."""
    if isinstance(env, CoupledTask):
        return particle_books(env.scene, physics.soft, lambda scene: _coupled_step(env, scene, physics, action))
    if not isinstance(env, SoftTask):
        return np.nan, np.nan
    scene = env.actuated(action)
    if isinstance(scene, MPMScene):
        return particle_books(scene, physics.soft, lambda scene: _tool_step(env, scene, physics, action))
    free = scene.replace(ground=None)
    after = jax.jit(lambda s: tets.step(free, s, tets.static_poses(env.num_substeps)))(physics.soft)
    before = tet_invariants.momentum(free, physics.soft)
    change, by_gravity = tet_invariants.momentum(free, after) - before, free.gravity * env.control_dt
    return np.nan, balance(free.mass, physics.soft.v, change, by_gravity, 0.0)


def particle_books(scene: MPMScene, soft: Any, advance: Any) -> tuple[float, float]:
    mass = mpm.particle_mass(scene, soft.x)
    _, fields = jax.jit(lambda s: to_nodes(scene, nodes_of_step(scene, s.x), split(s)))(soft)
    on_nodes = float(abs(fields.mass.sum() / mass.sum() - 1.0))
    open_scene = scene.replace(walls=Walls(lower=(None,) * 3, upper=(None,) * 3))
    after, force, duration = advance(open_scene)
    change = invariants.momentum(open_scene, after) - invariants.momentum(open_scene, soft)
    return on_nodes, balance(mass, soft.v, change, scene.gravity * duration, -force * duration)


def balance(mass: Any, v: Any, change: Any, by_gravity: Any, impulse: Any) -> float:
    expected = mass.sum() * by_gravity + impulse
    size = jnp.sum(mass[:, None] * jnp.abs(v)) + jnp.linalg.norm(mass.sum() * by_gravity)
    return float(jnp.linalg.norm(change - expected) / size)


def _tool_step(env: SoftTask, scene: MPMScene, physics: Any, action: jax.Array) -> Any:
    motion = jnp.clip(
        action[: env.num_joints] * env.joint_step, env.joint_lower - physics.joint_q, env.joint_upper - physics.joint_q
    )
    along = physics.joint_q + jnp.linspace(0.0, 1.0, env.num_substeps + 1)[:, None] * motion
    parts = {"position": 3, "orientation": 4, "velocity": 3, "angular_velocity": 3}
    none = FreeBodies(**{name: jnp.zeros((0, size)) for name, size in parts.items()})
    inertia = Inertia(mass=jnp.zeros(0), moment=jnp.zeros((0, 3, 3)))
    after, _, wrench = jax.jit(lambda s, poses: coupling.step(scene, inertia, s, none, poses))(
        physics.soft, env.poses(along)
    )
    return after, wrench.force.sum(0), env.control_dt


def _coupled_step(env: CoupledTask, scene: MPMScene, physics: Any, action: jax.Array) -> Any:
    after, _, wrench = jax.jit(
        lambda s, r: articulated.step(scene, env.model, s, r, env.control(action), num_substeps=env.num_substeps)
    )(physics.soft, physics.rigid)
    return after, wrench.force.sum(0), env.control_dt


def in_domain(env: Any, state: State) -> bool:
    """Whether all particles are inside the walls, at most a cell behind one."""
    scene = getattr(env, "scene", None)
    if not isinstance(scene, MPMScene):
        return bool(jnp.isfinite(jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(state.obs)])).all())
    x, inside = np.asarray(state.physics.soft.x), True
    for axis in range(3):
        low, high = scene.walls.lower[axis], scene.walls.upper[axis]
        if low is not None:
            inside &= bool((x[:, axis] >= low.position - scene.grid.spacing).all())
        if high is not None:
            inside &= bool((x[:, axis] <= high.position + scene.grid.spacing).all())
    return inside


def slopes(env: Any, state: State, actions: jax.Array, key: jax.Array) -> tuple[float, float]:
    """Relative errors of reverse mode against forward mode, and against central differences, the best step of four."""

    @jax.jit
    def total(actions: jax.Array) -> jax.Array:
        def one(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, action)
            return state, state.reward

        return jax.lax.scan(one, state, actions)[1].sum()

    along = jax.random.normal(key, actions.shape)
    found = float(jnp.vdot(jax.jit(jax.grad(total))(actions), along))
    forward = float(jax.jit(lambda a: jax.jvp(total, (a,), (along,))[1])(actions))
    ends = [
        (float(total(actions + h * along) - total(actions - h * along)) / (2 * h)) for h in (1e-4, 1e-5, 1e-6, 1e-7)
    ]
    return abs(forward - found) / abs(found), min(abs(end - found) for end in ends) / abs(found)


def main(args: Args) -> int:
    enable_compilation_cache()
    print("| task | status | in its box | mass | momentum | reverse - forward | reverse - difference |")
    print("|---|---|---|---|---|---|---|", flush=True)
    failed = 0
    for task in args.tasks:
        env: Any = rewax.make(task, scale=args.scale)
        keys = jax.random.split(jax.random.key(args.seed), 4)
        step, state = jax.jit(env.step), jax.jit(env.reset)(keys[0])
        shape = env.action_spec.shape
        noise = jax.random.uniform(keys[1], (args.warm + 2, *shape), minval=-0.3, maxval=0.3)
        actions = jnp.clip(noise + jnp.asarray(DRIFT.get(task, 0.0)), -1.0, 1.0)
        for action in actions[: args.warm]:
            state = step(state, action)
        state = disturbed(env, state, keys[2])
        after = step(state, actions[-1])
        status, inside = int(after.status), in_domain(env, after)
        mass, momentum = books(env, state.physics, actions[-1])
        forward, difference = slopes(env, state, actions[-2:], keys[3])
        failed += status != 0 or not inside or not (forward < 1e-8 and difference < 1e-3)
        print(
            f"| `{task}` | {describe(status)} | {'yes' if inside else 'no'} | {mass:.1e} | {momentum:.1e} "
            f"| {forward:.1e} | {difference:.1e} |",
            flush=True,
        )
    return failed


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Args, description=__doc__)))
