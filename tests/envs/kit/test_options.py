"""Substeps that fill a control step, and checks of the options of tasks."""

import numpy as np
import pytest

import rewax
from rewax.envs.kit.options import Substeps, substeps

DEFAULT = Substeps(5e-4, 40, list_every=5)


def test_without_options_the_default_is_returned_as_it_is():
    assert substeps(None, None, DEFAULT) is DEFAULT and substeps(None, 40, DEFAULT) is DEFAULT


@pytest.mark.parametrize("num", [1, 7, 16, 39, 40, 41, 100, 400])
def test_the_control_step_stays_when_one_of_both_is_given(num):
    by_number, by_dt = substeps(None, num, DEFAULT), substeps(0.02 / num, None, DEFAULT)
    for found in (by_number, by_dt):
        assert found.num == num and found.dt * found.num == pytest.approx(0.02, rel=1e-12)
        # Lists of active nodes divide the control step, and serve no longer than by default.
        assert found.num % found.list_every == 0
        assert found.list_every == 1 or found.list_every * found.dt <= 5 * 5e-4 * (1 + 1e-9)


def test_a_finer_control_step_gets_longer_lists():
    assert substeps(None, 80, DEFAULT).list_every == 10
    assert substeps(None, 80, Substeps(5e-4, 40)).list_every is None


def test_both_make_another_control_step():
    assert substeps(1e-4, 10, DEFAULT)[:2] == (1e-4, 10)


def test_a_substep_that_does_not_divide_the_control_step_is_refused():
    with pytest.raises(
        ValueError, match=r"^dt is 0\.003 s, which does not divide the control step of 0\.02 s: give num_substeps=7"
    ):
        substeps(3e-3, None, DEFAULT)
    with pytest.raises(ValueError, match="give num_substeps=1, for example"):
        substeps(0.03, None, DEFAULT)
    with pytest.raises(
        ValueError, match=r"dt is 1e-30 s, of which a control step of 0\.02 s has 2e\+28: give at least 2e-"
    ):
        substeps(1e-30, None, DEFAULT)


@pytest.mark.parametrize("name", rewax.list_envs())
def test_every_task_keeps_its_control_step(name):
    env = rewax.make(name, scale="small")
    finer = rewax.make(name, scale="small", num_substeps=2 * env.num_substeps)
    by_dt = rewax.make(name, scale="small", dt=env.control_dt / (2 * env.num_substeps))
    for other in (finer, by_dt):
        assert other.num_substeps == 2 * env.num_substeps and other.max_steps == env.max_steps
        np.testing.assert_allclose(other.control_dt, env.control_dt, rtol=1e-12)


def test_stiff_dough_is_made_with_the_substeps_that_its_error_advises():
    with pytest.raises(ValueError, match="take more substeps of smaller dt"):
        rewax.make("RollingFlat", scale="small", youngs_modulus=3000.0)
    env = rewax.make("RollingFlat", scale="small", youngs_modulus=3000.0, num_substeps=20)
    np.testing.assert_allclose(env.control_dt, 7e-3)
