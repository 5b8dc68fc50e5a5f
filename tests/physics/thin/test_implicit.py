"""Settings of implicit steps."""

import pytest

from rewax.physics import thin


@pytest.mark.parametrize(
    "name", ["tolerance", "newton_iterations", "cg_iterations", "cg_tolerance", "gradient_tolerance"]
)
def test_illegal_settings_are_refused(name):
    with pytest.raises(ValueError, match=rf"stepper\.{name} is -1"):
        thin.Implicit(**{name: -1})


def test_settings_are_a_key_of_programs():
    assert hash(thin.Implicit(tolerance=1e-4)) == hash(thin.Implicit(tolerance=1e-4))
    assert thin.Implicit(tolerance=1e-4) != thin.Implicit()
