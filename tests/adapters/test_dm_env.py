"""dm_env's own conformance tests, and the same numbers as the environment itself."""

import unittest

import numpy as np
import pytest
from toys import point_mass

pytest.importorskip("dm_env", reason="pip install 'rewax[dm-env]'")

from dm_env import StepType, test_utils

from rewax.adapters.dm_env import DmEnvironment
from rewax.envs.wrappers import AutoReset


class TestConformance(test_utils.EnvironmentTestMixin, unittest.TestCase):
    def make_object_under_test(self):
        return DmEnvironment(point_mass(length=4))

    def make_action_sequence(self):
        for _ in range(12):
            yield np.array([0.3], np.float32)


def test_an_environment_that_begins_anew_is_refused():
    with pytest.raises(ValueError, match="has AutoReset: give it without"):
        DmEnvironment(AutoReset(env=point_mass()))


def test_an_episode_that_runs_out_of_time_keeps_its_discount():
    env = DmEnvironment(point_mass(length=2), seed=3)
    x = env.reset().observation["x"]
    env.step(np.array([0.5]))
    last = env.step(np.array([0.5]))
    assert last.step_type == StepType.LAST and last.discount == 1.0
    np.testing.assert_allclose(last.observation["x"], x + 0.5, rtol=1e-6)
    np.testing.assert_allclose(last.reward, -(float(x[0] + 0.5) ** 2), rtol=1e-6)
    assert env.step(np.array([0.5])).step_type == StepType.FIRST
    assert DmEnvironment(point_mass(length=2), seed=3).reset().observation["x"] == x
