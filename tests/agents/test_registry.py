"""Algorithms by name."""

import dataclasses

import pytest
import toys

from rewax.agents import registry
from rewax.agents.config import RunConfig
from rewax.agents.registry import Algorithm, algorithm, list_algorithms, make_agent, register_algorithm
from rewax.agents.sapo import SAPOConfig, make_sapo


def test_sapo_is_known_by_name():
    assert "sapo" in list_algorithms()
    known = algorithm("sapo")
    assert known.make is make_sapo and known.config_type is SAPOConfig
    assert known.preset("RollingFlat", "small").num_envs == 8
    agent = make_agent("sapo", toys.point_mass(), SAPOConfig(num_envs=2, horizon=2, critic_minibatches=1))
    assert agent.name == "sapo" and agent.config.horizon == 2


def test_an_unknown_name_is_answered_with_the_known_ones():
    with pytest.raises(
        ValueError, match=r"^there is no algorithm named 'sapoo': did you mean 'sapo'\? known are .*sapo"
    ):
        algorithm("sapoo")


@pytest.mark.parametrize("name", list_algorithms())
def test_the_configuration_of_another_algorithm_is_refused(name):
    known = algorithm(name)
    sentence = f"config is of type RunConfig: give a {known.config_type.__name__}, or None for its defaults"
    with pytest.raises(ValueError, match=f"^{sentence}$"):
        known.make(toys.point_mass(), RunConfig())


@pytest.mark.parametrize("name", ["sapo_ivw", "sapo_agpo", "sapo_from_demonstrations"])
def test_an_extended_configuration_is_that_of_its_algorithm_alone(name):
    extended = algorithm(name).config_type
    assert issubclass(extended, SAPOConfig)
    with pytest.raises(ValueError, match=f"^config is of type {extended.__name__}: give a SAPOConfig, or None for its"):
        make_sapo(toys.point_mass(), extended())

    class Mine(SAPOConfig):
        pass

    assert SAPOConfig.given(Mine()) == Mine()
    with pytest.raises(ValueError, match=f"^config is of type Mine: give a {extended.__name__}, or None"):
        extended.given(Mine())


def test_an_ablation_without_a_configuration_has_its_changes():
    for name in ("shac2", "sapo_hard_targets", "sapo_hard_return", "sapo_no_actor_entropy", "apg_full"):
        known = algorithm(name)
        expected = dataclasses.replace(known.config_type(), **known.changes)
        assert expected != known.config_type()
        made = make_agent(name, toys.point_mass()), known.make(toys.point_mass())
        assert [agent.config for agent in made] == [expected] * 2
        preset = known.preset("RollingFlat", "small")
        assert {field: getattr(preset, field) for field in known.changes} == dict(known.changes)
    assert not make_agent("shac2", toys.point_mass()).config.learn_temperature
    assert make_agent("apg_full", toys.point_mass()).config.horizon == 0


def test_a_configuration_that_undoes_an_ablation_is_told():
    env, full = toys.point_mass(), algorithm("sapo").config_type(num_envs=2, horizon=4)
    with pytest.warns(UserWarning, match="the configuration has entropy_in_return True, not False, .*begin with algor"):
        make_agent("shac2", env, full)
    with pytest.warns(UserWarning, match="the configuration has horizon 4, not 0: begin with"):
        algorithm("apg_full").make(env, algorithm("apg").config_type(num_envs=2, horizon=4))


def test_an_algorithm_of_ones_own(monkeypatch):
    monkeypatch.setattr(registry, "_ALGORITHMS", dict(registry._ALGORITHMS))
    mine = Algorithm(lambda env, config: toys.make_toy(env), dict, lambda name, scale: {})
    register_algorithm("mine", mine)
    register_algorithm("mine", mine)  # once more is no harm
    assert make_agent("mine", toys.point_mass()).name == ""
    with pytest.raises(ValueError, match=r"algorithm is <function .*: give an Algorithm\(make=\.\.\., config_type="):
        register_algorithm("other", make_sapo)
    with pytest.raises(ValueError, match="an algorithm named 'sapo' is registered already: choose another name"):
        register_algorithm("sapo", mine)
    for name in ("my-sapo", "2apg", "lambda", ""):
        with pytest.raises(ValueError, match=f"^name is '{name}': use letters, digits and _"):
            register_algorithm(name, mine)
    with pytest.raises(ValueError, match=r"the name 'seed' is that of an option of rewax train: choose another name"):
        register_algorithm("seed", mine)
