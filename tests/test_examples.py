"""Examples do what they say."""

import runpy
import types
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax import struct
from rewax.status import Status

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def example(name):
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_identification_recovers_the_stiffness_and_steps_back_from_one_that_is_too_high(capsys):
    names = example("identify_material")
    # The first step leads from 900 Pa to some 1190 Pa; the substeps are stable up to 1148 Pa.
    args = {"true_modulus": 1100.0, "first_guess": 900.0, "max_modulus": 1140.0, "step_factor": 3.0}
    assert names["main"](names["Args"](**args, iterations=8, steps=3)) == pytest.approx(1100.0, rel=0.01)
    text = capsys.readouterr().out
    assert "INVALID_PARAMETERS: half the step back" in text


def test_identification_refuses_to_record_what_its_substeps_do_not_allow():
    names = example("identify_material")
    with pytest.raises(ValueError, match=r"status .*INVALID_PARAMETERS: give a larger max_modulus"):
        names["main"](names["Args"](true_modulus=5000.0, steps=1))


def test_ilqr_takes_a_point_to_its_target_as_fast_as_the_actions_allow():
    names = example("ilqr")
    env = toys.point_mass()
    state = env.reset(jax.random.key(3))
    start, plan = float(state.physics[0]), np.zeros((4, 1), np.float32)
    for _ in range(6):
        plan = names["improved"](env, state, plan, 1e-6)
    x, best = start, 0.0
    for _ in range(4):
        x -= 0.5 * min(1.0, x / 0.5)
        best -= x**2
    assert start > 0.5 and float(names["returns"](env, state, plan[None])[0]) == pytest.approx(best, abs=0.01)
    assert plan[0] == -1.0 and np.abs(plan).max() <= 1.0


class Costly(NamedTuple):
    """State of an environment in which each step costs 1."""

    reward: jax.Array
    status: jax.Array


@struct.dataclass
class Fragile:
    """A step with an action above 0.9 fails."""

    def step(self, state, action):
        failed = action[0] > 0.9
        return Costly(jnp.where(failed, 0.0, -1.0), jnp.where(failed, int(Status.NAN), int(Status.OK)))


def test_ilqr_leaves_out_plans_that_fail():
    """A failed step has reward 0, which is more than any other here."""
    plans = np.zeros((3, 4, 1), np.float32)
    plans[1, 2], plans[2] = 1.0, 1.0
    start = Costly(jnp.zeros(()), jnp.zeros((), int))
    assert example("ilqr")["returns"](Fragile(), start, plans).tolist() == [-4.0, -np.inf, -np.inf]


def test_ilqr_of_the_rolling_pin_earns_more_than_no_action():
    names = example("ilqr")
    args = {"horizon": 5, "first_iterations": 2, "steps": 8}
    still, _ = names["main"](names["Args"](**args | {"first_iterations": 0, "iterations": 0}))
    assert names["main"](names["Args"](**args))[0] > still + 0.03
    with pytest.raises(ValueError, match="the largest reward of Hopper is not known here: give --bound"):
        names["main"](names["Args"](env="Hopper"))


def test_the_seconds_of_ilqr_are_those_of_planning_and_acting(monkeypatch):
    names, clock, compiled = example("ilqr"), [0.0], []
    inside = names["main"].__globals__

    def improved(env, state, plan, bound):
        clock[0] += 1.0
        return plan

    def step(env, state, action):
        compiled.append(action)
        clock[0] += 100.0
        return env.step(state, action)

    def make(env, scale):
        clock[0] += 100.0
        return toys.point_mass()

    monkeypatch.setattr(names["rewax"], "make", make)
    monkeypatch.setitem(inside, "time", types.SimpleNamespace(perf_counter=lambda: clock[0]))
    monkeypatch.setitem(inside, "improved", improved)
    monkeypatch.setitem(inside, "step", jax.jit(step))
    for _ in range(2):  # the second episode compiles nothing
        assert names["main"](names["Args"](steps=3, first_iterations=2))[1] == 4.0
    assert len(compiled) == 1


def test_the_bound_of_ilqr_may_be_zero_or_negative(monkeypatch):
    names, bounds = example("ilqr"), []
    monkeypatch.setattr(names["rewax"], "make", lambda env, scale: toys.point_mass())

    def keep(env, state, plan, bound):
        bounds.append(bound)
        return plan

    monkeypatch.setitem(names["main"].__globals__, "improved", keep)
    for bound in (0.0, -1.0):
        names["main"](names["Args"](env="RollingFlat", bound=bound, steps=1))
    assert set(bounds) == {0.0, -1.0}
