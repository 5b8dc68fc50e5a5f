"""Which versions of JAX are tested, refused, or named once."""

import tomllib
import warnings
from pathlib import Path

import jax
import pytest

import rewax
from rewax import jax_versions
from rewax.jax_versions import numbers, untested, warn_if_untested

PROJECT = tomllib.loads((Path(__file__).resolve().parent.parent / "pyproject.toml").read_text())["project"]


@pytest.fixture
def installed(monkeypatch):
    """``installed("0.13.0")``: that version of JAX, and nobody warned yet."""
    warn_if_untested.cache_clear()
    yield lambda version: monkeypatch.setattr("importlib.metadata.version", lambda name: version)
    warn_if_untested.cache_clear()


def test_the_package_asks_for_these_versions():
    assert jax_versions.requirement() in PROJECT["dependencies"]
    (cuda,) = PROJECT["optional-dependencies"]["cuda"]
    assert cuda.replace("jax[cuda13]", "jax") == jax_versions.requirement()


def test_this_jax_is_in_the_range():
    assert numbers(jax.__version__) >= jax_versions.OLDEST and jax.__version__ not in jax_versions.EXCLUDED


@pytest.mark.parametrize("version", ["0.10.1", "0.11.2", "0.12.0", "0.12.0.1", "0.12.7"])
def test_tested_versions_are_silent(installed, version):
    installed(version)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_if_untested()
        rewax.make("CartpoleSwingUp", scale="small")
    assert untested(version) is None


@pytest.mark.parametrize("version", ["0.13.0", "0.13.0.dev20270101", "1.0"])
def test_a_newer_one_works_and_is_named_once(installed, version):
    installed(version)
    with pytest.warns(UserWarning, match=rf"jax {version} is newer .* \(0\.10\.1 to 0\.12\).*'jax<0\.13'") as said:
        env = rewax.make("CartpoleSwingUp", scale="small")
        rewax.make("CartpoleSwingUp", scale="small")
    assert len(said) == 1 and said[0].filename == __file__
    assert env.num_actions == 1


def test_numbers_of_versions():
    assert numbers("0.12.8rc1") == (0, 12, 8) and numbers("dev") == ()
