"""What a run will take on a CPU is said before it is compiled."""

import pytest
import toys

import rewax
from rewax.agents.presets import ahac_preset, demonstrated_preset, ppo_preset, sapo_preset
from rewax.physics import mpm
from rewax.training.loop.estimate import cost_sentence


def test_a_task_with_particles_has_speed_time_and_memory():
    env, config = rewax.make("RollingFlat", scale="paper"), sapo_preset("RollingFlat", "paper")
    text = cost_sentence(env, config, 4_000_000)
    assert "control steps a second on" in text and "for all 4,000,000; about" in text
    memory = float(text.split("; about ")[1].split(" GB")[0])
    assert 0.5 < memory < 3.0  # 32 environments of 2592 particles over 32 steps: 0.748 GB with transfers in C++
    half = cost_sentence(env, config, 2_000_000)
    hours, half_hours = (int(one.split("cores, ")[1].split(":")[0]) for one in (text, half))
    assert abs(hours - 2 * half_hours) <= 1 and hours > 5
    without = cost_sentence(env, ppo_preset("RollingFlat", "paper"), 4_000_000)
    assert "memory" not in without and float(without.split()[1]) > 4 * float(text.split()[1])


def test_the_memory_is_that_of_all_steps_that_are_differentiated_at_once():
    env = rewax.make("RollingFlat", scale="paper")

    def memory(config):
        return float(cost_sentence(env, config, 4_000_000).split("; about ")[1].split(" GB")[0])

    sapo = memory(sapo_preset("RollingFlat", "paper"))
    assert memory(ahac_preset("RollingFlat", "paper")) > 1.2 * sapo  # room for 64 steps instead of 32
    assert memory(demonstrated_preset("RollingFlat", "paper")) > 3.0 * sapo  # whole episodes of 300 steps


def test_other_tasks_are_told_where_to_look():
    assert "the first progress line says" in cost_sentence(toys.point_mass(), sapo_preset("Ant", "paper"), 100)


@pytest.mark.parametrize("name", ["SoftJumper", "CoverBox", "WhipRope", "PourBag", "SoftJumperMPM", "Hopper"])
def test_every_kind_of_scene_has_a_sentence(name):
    env = rewax.make(name, scale="paper")
    sentence = cost_sentence(env, sapo_preset(name, "paper"), 1_000_000)
    particles = isinstance(getattr(env, "scene", None), mpm.MPMScene)
    assert ("control steps a second on" in sentence) == particles
    assert ("the first progress line says" in sentence) != particles
