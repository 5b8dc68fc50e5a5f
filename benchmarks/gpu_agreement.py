"""Does a GPU compute what a CPU computes? Values and gradients of control steps of several tasks, on both.

Random actions bring tools and material together on the CPU; from there both devices take one control step and
differentiate its reward and the mean of the state's numbers by actions and state. For each group of arrays: the largest
difference over the array's largest number, and the array that has it. Single precision, and on a GPU the order of sums
varies, so 1e-5 is agreement, and 1e-3 is enough where contact amplifies; the repeat on one device beside it says how
much of a difference is the order of sums alone. An array whose numbers are all rounding errors of zero differs by 1:
the velocity gradients of a body that falls freely, a reward for progress before any.

Exit status 1 if a task raises an error, if the bits of ``status`` differ, or if an array differs by more than 1e-3 of
its largest number, 1e-6, and three times what repeats differ by.

    python benchmarks/gpu_agreement.py
    python benchmarks/gpu_agreement.py --tasks RollingFlat --scale small --warm-up 2
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rewax
from rewax.status import describe
from rewax.training import enable_compilation_cache


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    tasks: tuple[str, ...] = ("RollingFlat", "AntRun", "SoftJumper", "FluidMove", "HandFlip")
    scale: str = "paper"
    num_envs: int = 2
    warm_up: int = 10
    """Control steps on the CPU before the one that is compared."""


def program(env: Any, state: Any, action: jax.Array) -> Any:
    """Reward, the state after a control step, and the gradient of a sum of both by the state and the action."""

    def total(physics: Any, action: jax.Array) -> tuple[jax.Array, Any]:
        end = jax.vmap(env.step)(state.replace(physics=physics), action)
        numbers = [jnp.mean(a) for a in jax.tree.leaves(end.physics) if jnp.issubdtype(a.dtype, jnp.floating)]
        return end.reward.sum() + sum(numbers), end

    (_, end), by = jax.value_and_grad(total, argnums=(0, 1), has_aux=True, allow_int=True)(state.physics, action)
    return {
        "reward": end.reward,
        "state": end.physics,
        "status": end.status,
        "gradient by action": by[1],
        "gradient by state": by[0],
    }


def run(args: Args, task: str, device: Any, state: Any, action: Any) -> list[Any]:
    """What two runs of the program on one device give."""
    with jax.default_device(device):
        env = rewax.make(task, scale=args.scale)
        compiled = jax.jit(lambda s, a: program(env, s, a))
        inputs = jax.device_put((state, action), device)
        return [jax.device_get(compiled(*inputs)) for _ in range(2)]


def start(args: Args, task: str, device: Any) -> tuple[Any, Any]:
    """A state after some random control steps, and an action."""
    with jax.default_device(device):
        env = rewax.make(task, scale=args.scale)
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), args.num_envs))
        shape = (args.warm_up + 1, args.num_envs, *env.action_spec.shape)
        actions = jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0)
        step = jax.jit(jax.vmap(env.step))
        for action in actions[:-1]:
            state = step(state, action)
        return state, actions[-1]


def difference(a: Any, b: Any) -> tuple[float, str]:
    """The largest difference of an array over its largest number, and the array; NaN if there is one."""
    worst, where = 0.0, ""
    others = jax.tree.leaves(b)
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(a), others, strict=True):
        if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating) and x.size:
            x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
            apart = float(np.abs(x - y).max() / max(np.abs(x).max(), 1e-30))
            if np.isnan(apart):
                return apart, jax.tree_util.keystr(path)
            if apart > worst:
                worst, where = apart, jax.tree_util.keystr(path)
    return worst, where


def agrees(a: Any, b: Any, again: Any) -> bool:
    """Whether no array of two devices differs by more than the limits above; ``again`` is a repeat of ``b``."""
    for x, y, z in zip(*map(jax.tree.leaves, (a, b, again)), strict=True):
        if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating) and x.size:
            x, y, z = (np.asarray(array, np.float64) for array in (x, y, z))
            limit = np.max([1e-3 * np.abs(x).max(), 1e-6, 3.0 * np.abs(y - z).max()])
            if not np.abs(x - y).max() <= limit:  # nor is NaN
                return False
    return True


def main(args: Args) -> int:
    enable_compilation_cache()
    cpu, other = jax.devices("cpu")[0], jax.devices()[0]
    print(f"jax {jax.__version__}; CPU against {other.device_kind}; scale {args.scale}, {args.num_envs} environments")
    print(f"{'':14s} {'array':20s} {'devices differ':>15s} {'repeats differ':>15s}")
    failed = 0
    for task in args.tasks:
        try:
            state, action = start(args, task, cpu)
            first, _ = run(args, task, cpu, state, action)
            second, again = run(args, task, other, state, action)
        except Exception as error:  # the other tasks go on
            print(f"{task:14s} failed: {type(error).__name__}: {str(error).splitlines()[0][:160]}", flush=True)
            failed += 1
            continue
        for name in ("reward", "state", "gradient by action", "gradient by state"):
            (apart, where), (noise, _) = difference(first[name], second[name]), difference(second[name], again[name])
            end = "" if agrees(first[name], second[name], again[name]) else "  DIFFERS"
            print(f"{task:14s} {name:20s} {apart:15.1e} {noise:15.1e}  {where}{end}", flush=True)
            failed += bool(end)
        bits = [describe(int(np.bitwise_or.reduce(r["status"]))) for r in (first, second)]
        print(f"{task:14s} {'status':20s} {bits[0]:>15s} {bits[1]:>15s}", flush=True)
        failed += not np.array_equal(first["status"], second["status"])
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Args, description=__doc__)))
