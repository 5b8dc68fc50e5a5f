"""Spaces: the built-in ones fit their algorithms, and what cannot be is refused."""

import dataclasses
import tomllib
from importlib import resources

import pytest

from rewax.agents.registry import algorithm
from rewax.training.tuning.space import Range, preset_values, read_space

SPACES = tomllib.loads((resources.files("rewax.training.tuning") / "spaces.toml").read_text())


@pytest.mark.parametrize("name", sorted(SPACES))
def test_every_corner_of_a_built_in_space_is_legal(name):
    space, preset = read_space(name), algorithm(name).preset("Hopper", "small")
    for option, where in space.items():
        for value in where.choices or (where.low, where.high):
            assert where.holds(value) and where.value(where.stored(value)) == value
            assert getattr(dataclasses.replace(preset, **{option: value}), option) == value


@pytest.mark.parametrize("name", sorted(SPACES))
@pytest.mark.parametrize("task", ["Hopper", "RollingFlat"])
def test_a_preset_lies_in_its_built_in_space(name, task):
    space = read_space(name)
    assert set(preset_values(space, algorithm(name).preset(task, "small"))) == set(space)


def test_nine_algorithms_have_one():
    assert set(SPACES) == {"sapo", "shac", "apg", "ahac", "rpo", "ppo", "sac", "flash_sac", "trajopt"}


def test_a_preset_is_in_its_space_as_far_as_it_can_be():
    space = {"epochs": Range(1, 20), "minibatches": Range(choices=(2, 4)), "clip_range": Range(0.3, 0.4)}
    assert preset_values(space, algorithm("ppo").preset("Hopper", "small")) == {"epochs": 10, "minibatches": 1}


def test_integers_are_those_between_integers():
    assert Range(1, 4).integers and not Range(1, 4.0).integers
    assert Range(1, 4).holds(4) and not Range(1, 4).holds(2.5) and not Range(0.0, 1.0).holds(True)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[ppo]\nepoch = {low = 1, high = 2}", "ppo has no option 'epoch'"),
        ("[ppo]\nepochs = {low = 2, high = 1}", "give finite numbers low < high"),
        ("[ppo]\nepochs = {low = 1, high = inf}", "give finite numbers low < high"),
        ("[ppo]\nepochs = {low = 0, high = 1, log = true}", "above 0 with log = true"),
        ("[ppo]\nepochs = {low = 0, high = 4}", "epochs in the search space is 0: give an integer of at least 1"),
        ("[ppo]\nepochs = {low = 1.0, high = 4.0}", "epochs in the search space is 1.0: give an integer of at least 1"),
        ("[ppo]\nepochs = {choices = [2, 'four']}", "epochs in the search space is 'four': give an integer"),
        ("[ppo]\nnum_iterations = {low = 1, high = 4}", "num_iterations follows from the control steps of a trial"),
        ("[ppo]\nepochs = 3", "the search space of epochs is 3: write {low"),
        ("[ppo]\nepochs = {choices = []}", "choices of epochs are \\[\\]"),
        ("[sac]\nupdates = {low = 1, high = 2}", "has no table \\[ppo\\] for ppo"),
        ("[ppo", "is not TOML"),
        ("[ppo]\n# \udcff", "is not TOML"),
    ],
)
def test_a_space_that_cannot_be_is_refused(tmp_path, text, sentence):
    (tmp_path / "space.toml").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ValueError, match=sentence):
        read_space("ppo", tmp_path / "space.toml")


def test_there_has_to_be_one():
    with pytest.raises(ValueError, match=r"no search space for shac2: write a table \[shac2\]"):
        read_space("shac2")
    with pytest.raises(ValueError, match=r"there is no file 'nowhere\.toml'"):
        read_space("ppo", "nowhere.toml")
