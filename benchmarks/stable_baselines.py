"""PPO and SAC of rewax beside those of Stable-Baselines3, on one task with the networks and options of one preset.

    pip install 'rewax[stable-baselines3]'
    python benchmarks/stable_baselines.py --algo sac --env CartpoleSwingUp --steps 102400 307200 --seeds 0 1 2 3 4
    python benchmarks/stable_baselines.py --algo ppo --env Hopper --steps 409600 --seeds 0 1 2 3 4

Prints the mean return of 64 episodes with sampled actions after the given numbers of control steps, counted over all
environments. ``--options name=value`` changes the preset of both libraries, ``--rewax name=value`` that of rewax alone.
``--shift-rewards C`` adds C to every reward in training; the printed returns are without it.

Both have the preset's number of environments, horizon, layers (linear, LayerNorm, activation), batches, updates,
learning rates and weight decay. With ``normalize_rewards`` rewax's SAC divides rewards by the root mean square of the
returns in the replay buffer. Stable-Baselines3's ``VecNormalize`` divides them by the standard deviation of its running
returns.
Other differences of Stable-Baselines3:

- Its initialisers.
- PPO: actions of the normal distribution are clipped instead of squashed, the standard deviation is a parameter,
  ``target_kl`` ends the epochs of an iteration early where that of rewax changes the learning rate, and rewards are
  normalised where rewax normalises values.
- SAC: no gradient is clipped, and the temperature has the learning rate of the networks.

``--like-for-like`` removes those of SAC: orthogonal initialisers with the preset's gain, gradients clipped to
``max_grad_norm``, the temperature's own learning rate.
"""

import argparse
import ast
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium
import jax
import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

import rewax
from benchmarks.rows import spread
from rewax import struct
from rewax.adapters.stable_baselines3 import StableBaselinesVecEnv
from rewax.agents.registry import algorithm
from rewax.envs.base import Env, State
from rewax.training.evaluation.episodes import make_evaluate
from rewax.training.storage.cache import enable_compilation_cache

NUM_EPISODES = 64
ACTIVATIONS = {"silu": nn.SiLU, "elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh}


@struct.dataclass
class Shifted:
    """An environment that adds ``by`` to every reward."""

    env: Any
    by: jax.Array

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def step(self, state: State, action: jax.Array) -> State:
        state = self.env.step(state, action)
        return state.replace(reward=state.reward + self.by)


class ClippedAdamW(torch.optim.AdamW):
    """AdamW on a gradient whose global norm is clipped."""

    def __init__(self, params: Any, max_grad_norm: float, **options: Any) -> None:
        super().__init__(params, **options)
        self._max_norm = max_grad_norm

    def step(self, closure: Any = None) -> Any:
        for group in self.param_groups:
            nn.utils.clip_grad_norm_(group["params"], self._max_norm)
        return super().step(closure)


class SACLikeOurs(SAC):
    """SAC with the initialisers and the temperature's learning rate of a configuration of rewax."""

    def start_like(self, config: Any) -> None:
        """Draw the networks' parameters anew; call it once, before training."""
        self._temperature_rate = config.temperature_learning_rate
        for layer in self.policy.modules():
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, config.initial_gain)
                nn.init.zeros_(layer.bias)
        self.critic_target.load_state_dict(self.critic.state_dict())

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)
        update_learning_rate(self.ent_coef_optimizer, self._temperature_rate)


def layers(size: int, widths: Sequence[int], activation: str, *, end: int | None = None) -> nn.Sequential:
    """Linear, LayerNorm and activation for each width; with ``end`` one more linear layer."""
    parts: list[nn.Module] = []
    for width in widths:
        parts += [nn.Linear(size, width), nn.LayerNorm(width, eps=1e-6), ACTIVATIONS[activation]()]
        size = width
    return nn.Sequential(*parts, *([] if end is None else [nn.Linear(size, end)]))


class Encoder(BaseFeaturesExtractor):
    """The first layer of rewax's networks. Actor and critic have one each."""

    def __init__(self, observation_space: gymnasium.spaces.Box, width: int, activation: str) -> None:
        size = observation_space.shape[0]
        super().__init__(observation_space, width or size)
        self.layers = layers(size, [width] if width else [], activation)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self.layers(obs)


class Heads(nn.Module):
    """The layers after the encoders of PPO's actor and critic."""

    def __init__(self, size: int, config: Any) -> None:
        super().__init__()
        self.latent_dim_pi, self.latent_dim_vf = config.actor_widths[-1], config.critic_widths[-1]
        self.forward_actor = layers(size, config.actor_widths, config.activation)
        self.forward_critic = layers(size, config.critic_widths, config.activation)


def ppo_policy(config: Any) -> type[ActorCriticPolicy]:
    """PPO's policy with the preset's layers."""

    class Policy(ActorCriticPolicy):
        def _build_mlp_extractor(self) -> None:
            self.mlp_extractor = Heads(self.features_dim, config)

    return Policy


def sac_policy(config: Any) -> type[SACPolicy]:
    """SAC's policy with the preset's layers."""

    class Policy(SACPolicy):
        def make_actor(self, features_extractor: Any = None) -> Any:
            actor = super().make_actor(features_extractor)
            actor.latent_pi = layers(actor.features_dim, config.actor_widths, config.activation)
            return actor

        def make_critic(self, features_extractor: Any = None) -> Any:
            critic = super().make_critic(features_extractor)
            size = critic.features_extractor.features_dim + int(np.prod(self.action_space.shape))
            for i in range(critic.n_critics):
                setattr(critic, f"qf{i}", layers(size, config.critic_widths, config.activation, end=1))
            critic.q_networks = [getattr(critic, f"qf{i}") for i in range(critic.n_critics)]
            return critic

    return Policy


def learner(name: str, config: Any, env: VecEnv, seed: int, *, like_ours: bool) -> Any:
    """Stable-Baselines3's algorithm with a configuration of rewax."""
    features = {"width": config.vector_features, "activation": config.activation}
    shared = {"gamma": config.discount, "learning_rate": config.actor_learning_rate, "seed": seed, "device": "cpu"}
    policy_kwargs = {
        "features_extractor_class": Encoder,
        "features_extractor_kwargs": features,
        "optimizer_class": torch.optim.AdamW,
        "optimizer_kwargs": {"weight_decay": config.weight_decay, "betas": (config.adam_b1, config.adam_b2)},
        "share_features_extractor": False,
    }
    if name == "ppo":
        return PPO(
            ppo_policy(config), env, n_steps=config.horizon, batch_size=config.samples // config.minibatches,
            n_epochs=config.epochs, gae_lambda=config.gae_lambda, clip_range=config.clip_range,
            ent_coef=config.entropy_coefficient, vf_coef=config.value_coefficient / 2,  # theirs has no factor 1/2
            max_grad_norm=config.max_grad_norm, target_kl=config.target_kl, policy_kwargs=policy_kwargs, **shared,
        )  # fmt: skip
    sizes = {"pi": list(config.actor_widths), "qf": list(config.critic_widths)}
    if like_ours:
        policy_kwargs["optimizer_class"] = ClippedAdamW
        policy_kwargs["optimizer_kwargs"]["max_grad_norm"] = config.max_grad_norm
    sac = (SACLikeOurs if like_ours else SAC)(
        sac_policy(config), env, batch_size=config.batch_size, tau=config.target_rate, n_steps=config.num_steps,
        buffer_size=config.replay_size, learning_starts=config.warmup_steps * config.num_envs,
        train_freq=config.horizon, gradient_steps=config.updates, ent_coef=f"auto_{config.initial_temperature}",
        target_entropy=-config.target_entropy_scale * np.prod(env.action_space.shape),
        policy_kwargs={**policy_kwargs, "net_arch": sizes, "n_critics": config.num_critics}, **shared,
    )  # fmt: skip
    if like_ours:
        sac.start_like(config)
    return sac


def theirs(
    name: str, task: Env, trained: Env, config: Any, steps: Sequence[int], seed: int, *, like_ours: bool
) -> Iterator[float]:
    """Returns of Stable-Baselines3 on ``task`` after each number of control steps on ``trained``."""
    scaled = {"norm_reward": name == "ppo" or config.normalize_rewards, "gamma": config.discount}
    limited = {"norm_obs": config.normalize_observations, "clip_obs": config.observation_clip or np.inf}
    env = VecNormalize(StableBaselinesVecEnv(trained, config.num_envs, seed=seed, flat=True), **scaled, **limited)
    model = learner(name, config, env, seed, like_ours=like_ours)
    for total in steps:
        model.learn(total - model.num_timesteps, reset_num_timesteps=model.num_timesteps == 0)
        yield evaluated(model, env, task, seed)


def evaluated(model: Any, trained_in: VecNormalize, task: Any, seed: int) -> float:
    """Mean return of each environment's first episode, with sampled actions."""
    env = StableBaselinesVecEnv(task, NUM_EPISODES, seed=1000 + seed, flat=True)
    obs, returns = env.reset(), np.full(NUM_EPISODES, np.nan)
    while np.isnan(returns).any():
        obs, _, done, infos = env.step(model.predict(trained_in.normalize_obs(obs), deterministic=False)[0])
        for i in np.flatnonzero(done & np.isnan(returns)):
            returns[i] = infos[i]["episode"]["r"]
    return float(returns.mean())


def ours(name: str, task: Env, trained: Env, config: Any, steps: Sequence[int], seed: int) -> Iterator[float]:
    """Returns of rewax on ``task`` after each number of control steps on ``trained``."""
    agent = algorithm(name).make(trained, config)
    evaluate = make_evaluate(task, agent.policy, NUM_EPISODES)
    state = agent.init(jax.random.key(seed))
    for total in steps:
        while int(state.iteration) * config.samples < total:
            state, _ = agent.train_step(state)
        yield float(evaluate(state, jax.random.key(1000 + seed))["mean"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", choices=("ppo", "sac"), default="sac")
    parser.add_argument("--env", default="CartpoleSwingUp")
    parser.add_argument("--steps", type=int, nargs="+", default=[102_400, 307_200])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--options", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--rewax", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--shift-rewards", type=float, default=0.0, metavar="C")
    parser.add_argument("--like-for-like", action="store_true")
    parser.add_argument("--only", choices=("rewax", "stable-baselines3"))
    args = parser.parse_args()
    enable_compilation_cache()
    torch.set_num_threads(1)
    task = rewax.make(args.env, scale="small")
    trained = Shifted(env=task, by=np.float32(args.shift_rewards)) if args.shift_rewards else task
    config = changed(algorithm(args.algo).preset(args.env, "small"), args.options)
    runs = {
        "rewax": lambda seed: ours(args.algo, task, trained, changed(config, args.rewax), args.steps, seed),
        "stable-baselines3": lambda seed: theirs(
            args.algo, task, trained, config, args.steps, seed, like_ours=args.like_for_like
        ),
    }
    for name, run in runs.items():
        if args.only not in (None, name):
            continue
        rows = []
        for seed in args.seeds:
            rows.append([])
            for total, value in zip(args.steps, run(seed), strict=True):
                rows[-1].append(value)
                print(f"{name:18s} seed {seed} {total:10,d} steps: {value:10.1f}", flush=True)
        print(f"{name:18s} mean after {args.steps}:", *(spread(values, 1) for values in zip(*rows, strict=True)))


def changed(config: Any, changes: Sequence[str]) -> Any:
    """A configuration with other values of some options, written ``name=value``."""
    return dataclasses.replace(
        config, **{name: ast.literal_eval(value) for name, value in (c.split("=") for c in changes)}
    )


if __name__ == "__main__":
    main()
