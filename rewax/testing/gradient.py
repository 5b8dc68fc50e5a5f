"""Checks of the gradient of the reward with respect to actions: finite, not zero, equal to central differences."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.status import Status, remedy
from rewax.testing.states import finite
from rewax.testing.traced import named, random_action
from rewax.types import Array, Key

_STEPS = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4)
"""Steps of the central differences, in halves of the range of the actions."""
_SETTLED = 0.05
"""Differences of two steps, one three times the other, that agree to this are those of a smooth function."""
_ROUNDING = 100.0
"""Changes of the summed reward below this many units of rounding say nothing."""


class _Rewards(NamedTuple):
    """The summed reward of a few steps, the bits that they set, and the last state."""

    total: Array
    status: Array
    last: State


class RewardGradient:
    """The gradient of the summed reward of a few random steps with respect to their actions, compiled once."""

    def __init__(self, env: Env, state: State, key: Key, num_steps: int) -> None:
        self._env, self._key, self._leaves = env, key, EnvLeaves.of(env)
        self._state, self._num_steps = state, num_steps
        self._actions = 0.9 * jax.vmap(lambda k: random_action(env, k))(jax.random.split(key, num_steps))
        self._program = jax.jit(jax.grad(_summed, has_aux=True))

    def check(self) -> None:
        """Checks that the gradient is finite, and that at least one of its entries is nonzero."""
        gradient, rewards = self._at(self._state, self._actions)
        failed = Status(int(np.asarray(rewards.status)))
        assert failed == Status.OK, (
            f"{self._num_steps} steps of random actions fail numerically ({failed!r}): give {remedy(failed)}"
        )
        assert finite(gradient), (
            "the gradient of the reward with respect to the actions holds a number that is not finite: a root, a norm "
            "or a division at 0 does it, in the branch of a jnp.where that is not taken too; jax.debug_nans(True) "
            "finds it"
        )
        assert finite(self._at(self._state, jnp.zeros_like(self._actions))[0]), (
            "the gradient of the reward at action 0 holds a number that is not finite: a root or a norm at 0 does it; "
            "take rewax.envs.kit.rewards.smooth_norm, or add a small number under the root"
        )
        if not bool(jnp.any(gradient != 0)):
            raise AssertionError(self._what_follows())

    def check_differences(self, state: State, tolerance: float, say: Callable[[str], None]) -> None:
        """Checks derivatives along two directions against central differences of the reward, from ``state``.

        A direction passes with the first difference that agrees. It fails if none agrees and the two differences with
        the smallest steps agree with each other. If they do not either, as where contacts begin within the smallest
        step, or where rounding hides them, then ``say`` gets a line.

        Args:
          state: a state some steps after a reset. Rewards may refer to the first steps of an episode.
          tolerance: largest difference, relative to the derivative.
          say: takes a line.
        """
        gradient, _ = self._at(state, self._actions)
        half = (self._env.action_spec.high - self._env.action_spec.low) / 2
        signs = jax.random.rademacher(self._key, self._actions.shape, self._actions.dtype)
        # The derivative along random signs is about as large as this norm. One that is smaller by cancellation is not
        # expected to be more accurate.
        norm = half * float(jnp.linalg.norm(gradient))
        for direction in (half * jnp.sign(gradient), half * signs):
            derivative = float(jnp.vdot(gradient, direction))
            differences = []
            for difference in self._differences(state, direction, derivative):
                differences.append(difference)
                if abs(difference - derivative) <= tolerance * max(abs(difference), abs(derivative), norm):
                    break
            else:
                settled = np.isclose(*differences[-2:], rtol=_SETTLED, atol=0.0) if len(differences) > 1 else False
                if not settled:
                    say("differences do not settle (contacts begin or end, or rounding): one direction is not compared")
                    continue
                raise AssertionError(
                    f"the derivative of the reward of {self._num_steps} steps along a direction of their actions is "
                    f"{derivative:.4g}, and central differences give {differences[-1]:.4g}: a stop_gradient, a "
                    "rounding, a comparison or a custom derivative cuts or changes a part; if that is meant, check "
                    "with gradient_tolerance=None"
                )

    def _differences(self, state: State, direction: Array, derivative: float) -> Iterator[float]:
        """Central differences, from the largest step to the smallest that exceeds rounding."""
        for step in _STEPS:
            above = float(self._at(state, self._actions + step * direction)[1].total)
            below = float(self._at(state, self._actions - step * direction)[1].total)
            rounding = _ROUNDING * float(jnp.finfo(direction.dtype).eps) * max(abs(above), abs(below))
            if max(abs(above - below), abs(2 * step * derivative)) <= rounding:
                return
            yield (above - below) / (2 * step)

    def _at(self, state: State, actions: Array) -> tuple[Array, _Rewards]:
        return named("step", self._program, actions, self._leaves, state)

    def _what_follows(self) -> str:
        """The error message for a zero gradient. It says whether the actions change the state."""

        def end(actions: Array) -> dict[str, Array]:
            last = _summed(actions, self._leaves, self._state)[1].last
            leaves = jax.tree.leaves_with_path({"physics": last.physics, "obs": dict(last.obs)})
            names = [jax.tree_util.keystr(path[:1], simple=True) + jax.tree_util.keystr(path[1:]) for path, _ in leaves]
            pairs = zip(names, (leaf for _, leaf in leaves), strict=True)
            return {name: leaf for name, leaf in pairs if jnp.issubdtype(leaf.dtype, jnp.floating)}

        # The forward derivative along one direction of the actions shows which arrays of the last state change.
        _, changes = jax.jit(lambda a: jax.jvp(end, (a,), (jnp.ones_like(a),)))(self._actions)
        moved = [name for name, change in changes.items() if bool(jnp.any(change != 0))]
        what = f"the reward of {self._num_steps} steps has a zero gradient with respect to their actions"
        if not moved:
            return (
                f"{what}, and so has the whole state: a stop_gradient, a rounding, a comparison or an integer cuts it; "
                "let the action enter the physics through smooth operations"
            )
        return (
            f"{what}, though {', '.join(moved[:3])} of the state follow them: the reward does not depend on what they "
            "move, or not yet. Where a tool begins away from the material, begin within reach of it, or reward the "
            "tool for coming nearer, or check with more gradient_steps, up to the horizon of the agent"
        )


def _summed(actions: Array, leaves: EnvLeaves, state: State) -> tuple[Array, _Rewards]:
    env = leaves.build()

    def body(state: State, action: Array) -> tuple[State, tuple[Array, Array]]:
        state = env.step(state, action)
        return state, (state.reward, state.status)

    last, (rewards, status) = jax.lax.scan(body, state, actions)
    total = jnp.sum(rewards)
    return total, _Rewards(total, jax.lax.reduce(status, status.dtype.type(0), jax.lax.bitwise_or, (0,)), last)


__all__ = ["RewardGradient"]
