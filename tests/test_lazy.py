"""Packages whose names are imported when they are first used."""

import subprocess
import sys

import pytest

import rewax.envs.kit
import rewax.training


@pytest.mark.parametrize("package", [rewax.envs.kit, rewax.training])
def test_every_name_that_is_listed_is_there(package):
    assert set(package.__all__) <= set(dir(package))
    for name in package.__all__:
        assert getattr(package, name).__module__.startswith(package.__name__), name
    with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'nothing'"):
        _ = package.nothing


def test_importing_a_package_imports_none_of_its_modules():
    inside = ("rewax.training.", "rewax.envs.kit.")
    program = f"import sys, rewax.training, rewax.envs.kit; print([m for m in sys.modules if m.startswith({inside})])"
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
