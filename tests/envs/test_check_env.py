"""Every registered environment is one, by the check that users have."""

import pytest

import rewax
from rewax.testing import check_env

QUICK = ("CartpoleSwingUp",)


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in rewax.list_envs()]
)
def test_a_registered_environment_passes(name):
    check_env(rewax.make(name, scale="small"), check_full_episode=name in QUICK)
