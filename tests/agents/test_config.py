"""Hyper-parameters: defaults are the paper's, impossible values are refused."""

import dataclasses
import inspect

import numpy as np
import pytest

from rewax.agents.config import FirstOrderConfig
from rewax.agents.legal import legal_values
from rewax.agents.ppo import PPOConfig
from rewax.agents.registry import algorithm, list_algorithms
from rewax.agents.sac import SACConfig
from rewax.agents.shac import SHACConfig
from rewax.training.config import TrainConfig


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"num_envs": 0}, "num_envs is 0: give an integer of at least 1"),
        ({"horizon": -3}, "horizon is -3: give an integer of at least 1"),
        ({"horizon": 2.5}, "horizon is 2.5: give an integer"),
        ({"num_critics": 0}, "num_critics is 0: give an integer of at least 1"),
        ({"discount": 1.01}, "discount is 1.01: give a number between 0 and 1"),
        ({"td_lambda": -0.1}, "td_lambda is -0.1: give a number between 0 and 1"),
        ({"actor_learning_rate": 0.0}, "actor_learning_rate is 0.0: give a positive number"),
        ({"max_grad_norm": float("nan")}, "max_grad_norm is nan: give a positive number"),
        ({"actor_widths": (64, 1)}, "actor_widths is \\(64, 1\\): give integers of at least 2"),
        ({"vector_features": 1}, "vector_features is 1: give 0, or an integer of at least 2"),
        ({"point_features": 1}, "point_features is 1: give an integer of at least 2"),
        ({"observation_clip": 0.0}, "observation_clip is 0.0: give a positive number, or None for no limit"),
        (
            {"critic_chunk": 3},
            "critic_chunk is 3, which does not divide a minibatch of 256 samples "
            "\\(num_envs \\* horizon / critic_minibatches\\): choose a divisor, or None",
        ),
        (
            {"num_envs": 3, "horizon": 5},
            "critic_minibatches is 4, which does not divide num_envs \\* horizon = 15: choose a divisor",
        ),
    ],
)
def test_impossible_configurations_say_what_to_do(changes, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}$"):
        FirstOrderConfig(**changes)


def test_another_default_keeps_the_restriction():
    for config_type in (SHACConfig, SACConfig, PPOConfig):
        with pytest.raises(ValueError, match=r"^initial_gain is 0.0: give a positive number$"):
            config_type(initial_gain=0.0)

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Mine(FirstOrderConfig):
        discount: "float" = 0.9
        own: "Unresolved" = None  # noqa: F821

    assert Mine().discount == 0.9
    with pytest.raises(ValueError, match=r"^discount is 2.0: give a number between 0 and 1$"):
        Mine(discount=2.0)


def test_an_option_has_one_default_whatever_the_order_of_the_bases():
    """Groups of options have no base class and no common option.

    An algorithm has one combination of them, or extends another algorithm.
    """
    of_algorithms = {algorithm(name).config_type for name in list_algorithms()}
    for name in list_algorithms():
        config_type = algorithm(name).config_type
        parts = config_type.__mro__[1:-1]
        groups = [part for part in parts if part.__bases__ == (object,)]
        options = [field.name for part in groups for field in dataclasses.fields(part)]
        assert len(options) == len(set(options)), name
        extended = [part for part in parts if part in of_algorithms]
        if extended:
            known = {field.name for field in dataclasses.fields(extended[0])}
            assert config_type.__bases__ == (extended[0],) and not known & set(inspect.get_annotations(config_type)), (
                name
            )
        combinations = [part for part in parts if part not in groups and part not in of_algorithms]
        assert len(combinations) <= 1 and not any(map(inspect.get_annotations, combinations)), name


def test_a_list_is_as_good_as_a_tuple():
    config = FirstOrderConfig(actor_widths=[8, 4])
    assert config.actor_widths == (8, 4) and hash(config) == hash(dataclasses.replace(config))


def test_defaults_are_the_papers():
    c = FirstOrderConfig()
    assert (c.num_envs, c.horizon, c.discount, c.td_lambda) == (32, 32, 0.99, 0.95)
    assert (c.actor_learning_rate, c.critic_learning_rate, c.final_learning_rate) == (2e-3, 5e-4, 1e-5)
    assert (c.adam_b1, c.adam_b2, c.weight_decay, c.max_grad_norm) == (0.7, 0.95, 0.01, 0.5)
    assert (c.critic_passes, c.critic_minibatches, c.num_critics) == (16, 4, 2)
    assert (c.actor_widths, c.critic_widths) == ((512, 256), (256, 256))
    assert (c.point_widths, c.point_features, c.vector_features) == ((64, 128, 256), 64, 128)
    assert c.activation == "silu" and c.log_std_range == (-5.0, 2.0)


VALUES = (True, -3, 0, 2.5, float("nan"), float("inf"), None, "a", "", [], [1, "a"], [-1, -2], {}, b"a", object())
"""Most of these are legal for no option; none may be accepted for an option of another type, or raise another error."""


@pytest.mark.parametrize("name", ["report", *list_algorithms()])
def test_every_option_has_legal_values_and_refuses_others_in_one_sentence(name):
    config = TrainConfig(num_iterations=1, run_dir="a") if name == "report" else algorithm(name).config_type()
    legal = legal_values(type(config))
    for field in dataclasses.fields(config):
        for value in VALUES:
            try:
                changed = dataclasses.replace(config, **{field.name: value})
            except ValueError as error:
                message = str(error)
                assert field.name in message and ": " in message and "\n" not in message
                continue
            now, default = getattr(changed, field.name), getattr(config, field.name)
            assert legal[field.name].holds(now), field.name
            assert now is None or default is None or isinstance(now, bool) == isinstance(default, bool), field.name


def test_numpys_numbers_become_pythons():
    config = FirstOrderConfig(num_envs=np.int64(8), discount=np.float32(0.5))
    assert type(config.num_envs) is int and type(config.discount) is float


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"adam_b1": -3}, "adam_b1 is -3: give a number of at least 0 and below 1"),
        ({"quick_compile": -3}, "quick_compile is -3: give True or False"),
        ({"num_envs": True}, "num_envs is True: give an integer of at least 1"),
        ({"actor_widths": ["a"]}, r"actor_widths is \('a',\): give integers of at least 2"),
        ({"log_std_range": (2.0, -5.0)}, r"log_std_range is \(2.0, -5.0\): give two numbers in ascending order"),
        ({"initial_log_std": float("nan")}, "initial_log_std is nan: give a number"),
        ({"critic_chunk": "a"}, "critic_chunk is 'a': give an integer, or None"),
    ],
)
def test_types_and_ranges_are_checked(changes, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}$"):
        FirstOrderConfig(**changes)


def test_help_of_a_configuration_names_legal_values_without_the_functions_that_check_them():
    signature = str(inspect.signature(TrainConfig))
    assert "Legal(give an integer of at least 1)" in signature and "<function" not in signature
