"""Checks of the gradients of reward and observations by actions: finite, not zero, equal to central differences."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

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
_NAMED = 5
"""Components of an action that a message names at most."""
_ROUNDING = 100.0
"""Changes of a sum below this many units of rounding say nothing."""


class _Weights(NamedTuple):
    """What is differentiated: the factor of the summed reward, and those of each number of the last observation."""

    reward: Array
    obs: dict[str, Array]


class _Direction(NamedTuple):
    """Along which a derivative is compared with differences."""

    along: Array
    """Change of the actions, in their unit, shape (num_steps, *action_shape)."""
    size: float
    """Expected size of the derivative. One that is smaller by cancellation is not expected to be more accurate."""
    name: str


class _Result(NamedTuple):
    """The weighted sum after a few steps, the bits that they set, and the last state."""

    total: Array
    status: Array
    last: State


class ActionGradient:
    """The gradient of reward and observation of a few random steps with respect to their actions, compiled once."""

    def __init__(self, env: Env, state: State, key: Key, num_steps: int) -> None:
        self._env, self._key, self._leaves = env, key, EnvLeaves.of(env)
        self._state, self._num_steps = state, num_steps
        self._actions = 0.9 * jax.vmap(lambda k: random_action(env, k))(jax.random.split(key, num_steps))
        self._program = jax.jit(jax.grad(_summed, has_aux=True))
        floats = {name: value for name, value in state.obs.items() if jnp.issubdtype(value.dtype, jnp.floating)}
        none = {name: jnp.zeros_like(value) for name, value in floats.items()}
        self._reward = _Weights(jnp.ones_like(state.reward), none)
        self._observations = {
            name: _Weights(
                jnp.zeros_like(state.reward), {**none, name: jax.random.rademacher(key, value.shape, value.dtype)}
            )
            for name, value in floats.items()
            if name not in _sensors(env)
        }

    def check(self) -> None:
        """Checks that the gradient is finite, and that at least one of its entries is nonzero."""
        gradient, result = self._at(self._state, self._actions, self._reward)
        failed = Status(int(np.asarray(result.status)))
        assert failed == Status.OK, (
            f"{self._num_steps} steps of random actions fail numerically ({failed!r}): give {remedy(failed)}"
        )
        assert finite(gradient), (
            "the gradient of the reward with respect to the actions holds a number that is not finite: a root, a norm "
            "or a division at 0 does it, in the branch of a jnp.where that is not taken too; jax.debug_nans(True) "
            "finds it"
        )
        assert finite(self._at(self._state, jnp.zeros_like(self._actions), self._reward)[0]), (
            "the gradient of the reward at action 0 holds a number that is not finite: a root or a norm at 0 does it; "
            "take rewax.envs.kit.rewards.smooth_norm, or add a small number under the root"
        )
        if not bool(jnp.any(gradient != 0)):
            raise AssertionError(self._what_follows())

    def check_differences(self, state: State, tolerance: float, say: Callable[[str], None]) -> None:
        """Checks derivatives against central differences, from ``state``: of the reward, and of each observation.

        Policies and values get their gradients through both. Of an observation the sum is compared, with random signs.
        Those of sensors are left out: they have no gradient unless it is asked for. Each derivative is taken along the
        directions of ``_directions``. A direction passes with the first difference that agrees. It fails if none agrees
        and the two differences with the smallest steps agree with each other. If they do not either, as where contacts
        begin within the smallest step, or where rounding hides them, then ``say`` gets a line.

        Args:
          state: a state some steps after a reset. Rewards may refer to the first steps of an episode.
          tolerance: largest difference, relative to the derivative.
          say: takes a line.
        """
        self._compare(state, self._reward, f"the reward of {self._num_steps} steps", tolerance, say)
        for name, weights in self._observations.items():
            what = f"obs[{name!r}] after {self._num_steps} steps (summed with random signs)"
            self._compare(state, weights, what, tolerance, say)

    def _compare(
        self, state: State, weights: _Weights, what: str, tolerance: float, say: Callable[[str], None]
    ) -> None:
        gradient, _ = self._at(state, self._actions, weights)
        assert finite(gradient), f"the gradient of {what} with respect to the actions holds a number that is not finite"
        for direction in self._directions(gradient):
            derivative = float(jnp.vdot(gradient, direction.along))
            differences = []
            for difference in self._differences(state, weights, direction.along, derivative):
                differences.append(difference)
                if abs(difference - derivative) <= tolerance * max(abs(difference), abs(derivative), direction.size):
                    break
            else:
                if not differences and derivative == 0.0:  # the largest step changes nothing
                    continue
                settled = np.isclose(*differences[-2:], rtol=_SETTLED, atol=0.0) if len(differences) > 1 else False
                if not settled:
                    say("differences do not settle (contacts begin or end, or rounding): one direction is not compared")
                    continue
                raise AssertionError(
                    f"the derivative of {what} along {direction.name} of their actions is {derivative:.4g}, and "
                    f"central differences give {differences[-1]:.4g}: a stop_gradient, a rounding, a comparison or a "
                    "custom derivative cuts or changes a part; if that is meant, check with gradient_tolerance=None"
                )

    def _directions(self, gradient: Array) -> Iterator[_Direction]:
        """The signs of a gradient, random signs, and random signs where the gradient is exactly zero.

        The last one shows components that are cut. The other components would hide a small one of many.
        """
        half = (self._env.action_spec.high - self._env.action_spec.low) / 2
        signs = half * jax.random.rademacher(self._key, self._actions.shape, self._actions.dtype)
        nonzero = gradient != 0
        norm, count = half * float(jnp.linalg.norm(gradient)), int(nonzero.sum())
        if count:
            yield _Direction(half * jnp.sign(gradient), norm, "a direction")
        yield _Direction(signs, norm, "a direction")  # the derivative is about as large as the norm
        if 0 < count < nonzero.size:
            zero = np.flatnonzero(~np.asarray(nonzero).reshape(len(nonzero), -1).all(0))
            names = ", ".join(map(str, zero[:_NAMED])) + ", ..." * (len(zero) > _NAMED)
            each = norm / count**0.5  # the root mean square of the others
            yield _Direction(jnp.where(nonzero, 0.0, signs), each, f"components {names}")

    def _differences(self, state: State, weights: _Weights, direction: Array, derivative: float) -> Iterator[float]:
        """Central differences, from the largest step to the smallest that exceeds rounding."""
        for step in _STEPS:
            above = float(self._at(state, self._actions + step * direction, weights)[1].total)
            below = float(self._at(state, self._actions - step * direction, weights)[1].total)
            rounding = _ROUNDING * float(jnp.finfo(direction.dtype).eps) * max(abs(above), abs(below))
            if max(abs(above - below), abs(2 * step * derivative)) <= rounding:
                return
            yield (above - below) / (2 * step)

    def _at(self, state: State, actions: Array, weights: _Weights) -> tuple[Array, _Result]:
        return named("step", self._program, actions, self._leaves, state, weights)

    def _what_follows(self) -> str:
        """The error message for a zero gradient. It says whether the actions change the state."""

        def end(actions: Array) -> dict[str, Array]:
            last = _summed(actions, self._leaves, self._state, self._reward)[1].last
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


def _summed(actions: Array, leaves: EnvLeaves, state: State, weights: _Weights) -> tuple[Array, _Result]:
    env = leaves.build()

    def body(state: State, action: Array) -> tuple[State, tuple[Array, Array]]:
        state = env.step(state, action)
        return state, (state.reward, state.status)

    last, (rewards, status) = jax.lax.scan(body, state, actions)
    total = weights.reward * jnp.sum(rewards) + sum(jnp.vdot(w, last.obs[name]) for name, w in weights.obs.items())
    return total, _Result(total, jax.lax.reduce(status, status.dtype.type(0), jax.lax.bitwise_or, (0,)), last)


def _sensors(env: Any) -> frozenset[str]:
    """Names of the observations that sensors make, which see the world through any wrapper."""
    names: frozenset[str] = frozenset()
    while env is not None:
        names |= frozenset(getattr(env, "sensors", None) or ())
        env = getattr(env, "env", None)
    return names


__all__ = ["ActionGradient"]
