"""Tuned configurations."""

import pytest

from rewax.agents.presets import (
    ahac_preset,
    apg_preset,
    demonstrated_preset,
    ppo_preset,
    sapo_preset,
    shac_preset,
    trajopt_preset,
)
from rewax.agents.sapo import SAPOConfig
from rewax.agents.shac import SHACConfig
from rewax.envs import list_envs
from rewax.training.suites.suite import read_suite


@pytest.mark.parametrize("scale", ["paper", "small"])
def test_every_environment_has_one(scale):
    for name in list_envs():
        config = sapo_preset(name, scale)
        assert isinstance(config, SAPOConfig) and hash(config)
        assert scale == "small" or config.horizon == 32


def test_an_environment_of_ones_own_has_that_of_its_scale():
    assert sapo_preset("Mine", "paper") == SAPOConfig()
    assert sapo_preset("Mine", "small").num_envs == 8


def test_there_is_no_other_scale():
    with pytest.raises(ValueError, match="there is no scale 'huge': use paper or small"):
        sapo_preset("RollingFlat", "huge")


def test_networks_of_the_paper():
    ant, hand = (sapo_preset(name, "paper") for name in ("AntRun", "HandReorient"))
    assert (ant.num_envs, ant.actor_widths, ant.critic_widths) == (64, (128, 64, 32), (64, 64))
    assert (hand.num_envs, hand.actor_widths, hand.critic_widths) == (64, (512, 256), (256, 256))
    assert ant.vector_features == hand.vector_features == 0
    assert sapo_preset("AntRun", "small").vector_features == 64


def test_other_algorithms_take_over_the_limit_of_each_environments_gradient():
    limit = sapo_preset("FluidMove", "small").max_env_grad_norm
    assert limit is not None
    assert [preset("FluidMove", "small").max_env_grad_norm for preset in (shac_preset, apg_preset)] == [limit, limit]


ACTOR = ("activation", "initial_gain", "state_dependent_std")


def test_shac_has_sapos_actor_in_short_runs_and_the_papers_settings_elsewhere():
    sapo, short = sapo_preset("RollingFlat", "small"), shac_preset("RollingFlat", "small")
    papers = SHACConfig()
    assert [getattr(short, name) for name in ACTOR] == [getattr(sapo, name) for name in ACTOR]
    assert short.target_decay == 0.2
    apg = apg_preset("Hopper", "small")
    assert [getattr(apg, name) for name in ACTOR] == [getattr(sapo, name) for name in ACTOR]
    assert apg_preset("Hopper", "paper").activation == "elu"
    ahac = ahac_preset("Hopper", "small")
    assert [getattr(ahac, name) for name in (*ACTOR, "target_decay")] == [
        getattr(short, name) for name in (*ACTOR, "target_decay")
    ]
    assert ahac_preset("Hopper", "paper").target_decay is None
    assert ahac.max_env_grad_norm == 10.0 and ahac_preset("Hopper", "paper").max_env_grad_norm is None
    assert ahac_preset("Quadruped", "small").max_env_grad_norm is None
    assert [ahac_preset(*task).horizon for task in (("AntRun", "paper"), ("AntRun", "small"))] == [32, 64]
    assert [ahac_preset("AntRun", scale).actor_value for scale in ("paper", "small")] == ["mean", "min"]
    ablations = read_suite("ablations")
    for config in (shac_preset("RollingFlat", "paper"), ablations.config("HandFlip", "shac")):
        for name in (*ACTOR, "target_decay"):
            assert getattr(config, name) == getattr(papers, name), name
    ant = shac_preset("AntRun", "paper")
    assert (ant.target_decay, ant.critic_learning_rate) == (0.2, 2e-3)
    assert shac_preset("RollingFlat", "paper").critic_learning_rate != 2e-3


def test_the_last_layer_of_ppos_policy_begins_small():
    for scale in ("small", "paper"):
        assert ppo_preset("Hopper", scale).action_gain == 0.01


def test_sequences_on_fluid_move_change_slowly():
    """With the rate of the other soft tasks they earn less than no action (docs/measured/small_suite.md)."""
    rates = {name: trajopt_preset(name, "small").learning_rate for name in ("FluidMove", "HandFlip")}
    assert rates == {"FluidMove": 0.01, "HandFlip": 0.1}
    assert demonstrated_preset("FluidMove", "small").sequence_learning_rate == 0.02
