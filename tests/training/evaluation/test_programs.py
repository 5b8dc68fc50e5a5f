"""Programs compiled in a thread: the same numbers, each traced once, and no failure before its first use."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax.lowering.report import note, recorded
from rewax.training.config import ReportConfig
from rewax.training.evaluation.episodes import constant_policy, make_evaluate, uniform_policy
from rewax.training.evaluation.programs import MODES, Programs
from rewax.training.evaluation.recording import record

CONFIG = dataclasses.replace(ReportConfig(), num_eval_episodes=3)
STATE, KEY = {"gain": jnp.float32(-0.5)}, jax.random.key(4)


class Counted:
    """A policy that knows how often it was traced."""

    def __init__(self):
        self.traces = 0

    def __call__(self, train_state, obs, key, deterministic=False):
        self.traces += 1
        noise = 0.0 if deterministic else 0.1 * jax.random.normal(key, (1,))
        return jnp.clip(train_state["gain"] * obs["x"] + noise, -1.0, 1.0)


@pytest.fixture(scope="module")
def env():
    return toys.point_mass(4)


def test_what_the_thread_compiled_is_not_traced_again_and_gives_the_same_numbers(env):
    policy = Counted()
    programs = Programs(env, policy, CONFIG)
    programs.compile_in_background(STATE, KEY)
    programs.wait()
    traces = policy.traces
    found = {mode: programs.evaluate(STATE, mode, KEY) for mode in MODES}
    recording = programs.record(STATE, KEY, "one")
    assert policy.traces == traces > 0
    baselines = {"no action": constant_policy(jnp.zeros(1)), "random actions": uniform_policy(env)}
    for mode in MODES:
        alone = make_evaluate(env, baselines.get(mode, policy), 3)(STATE, KEY, deterministic=mode == "deterministic")
        np.testing.assert_allclose(found[mode]["returns"], alone["returns"], rtol=1e-6)
    again = record(env, policy, STATE, KEY, name="one")
    np.testing.assert_array_equal(recording.rewards, again.rewards)
    np.testing.assert_array_equal(recording.particles, again.particles)
    assert len(recording.rewards) == 4 and recording.name == "one"


def test_a_program_that_cannot_be_compiled_says_so_at_its_first_use(env):
    def broken(train_state, obs, key, deterministic=False):
        raise ValueError("no policy here")

    programs = Programs(env, broken, CONFIG)
    programs.compile_in_background(STATE, KEY)
    programs.wait()
    for use in (lambda: programs.evaluate(STATE, "sampled", KEY), lambda: programs.record(STATE, KEY, "")):
        with pytest.raises(ValueError, match="no policy here"):
            use()


def test_what_another_thread_lowers_is_not_recorded_here(env):
    class Noting(Counted):
        def __call__(self, *args, **options):
            note("somewhere.else", "value", None)
            return super().__call__(*args, **options)

    programs = Programs(env, Noting(), CONFIG)
    with recorded() as decisions:
        programs.compile_in_background(STATE, KEY)
        note("here", "value", None)
        programs.wait()
    assert [decision.function for decision in decisions] == ["here"]
