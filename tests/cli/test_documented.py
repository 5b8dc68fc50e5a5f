"""Every option has help, and a group of options gives back the configuration that it was made of."""

import dataclasses
import importlib

import pytest

from rewax.agents.registry import algorithm, list_algorithms
from rewax.cli.documented import field_help, option_group, with_options
from rewax.cli.main import COMMANDS
from rewax.training.config import ReportConfig, TrainConfig

CONFIGS = {name: algorithm(name).config_type for name in list_algorithms()}
CONFIGS |= {"report": ReportConfig, "run": TrainConfig}
CONFIGS |= {
    name: importlib.import_module(home).Options
    for name, home in COMMANDS.items()
    if hasattr(importlib.import_module(home), "Options")
}


@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_no_option_is_without_help(name):
    texts = field_help(CONFIGS[name])
    assert not [field.name for field in dataclasses.fields(CONFIGS[name]) if not texts.get(field.name)]


def test_help_of_a_shared_entry_is_that_of_all_its_fields_and_subclasses_go_first():
    texts = field_help(algorithm("ppo").config_type)
    assert texts["adam_b1"] == texts["adam_b2"] != "" and texts["weight_decay"] != texts["adam_b1"]
    assert texts["num_critics"] == "must be 1."
    assert texts["num_envs"] == field_help(CONFIGS["sapo"])["num_envs"]


@pytest.mark.parametrize("name", list_algorithms())
def test_a_group_gives_its_configuration_back(name):
    config = algorithm(name).preset("RollingFlat", "small")
    group = option_group(config)
    assert with_options(config, group) == config
    assert with_options(config, dataclasses.replace(group, num_envs=64)).num_envs == 64
    with pytest.raises(ValueError, match="num_envs is 0"):
        with_options(config, dataclasses.replace(group, num_envs=0))
