"""Options of ``make`` that cannot be: each is refused with one sentence that names it."""

import inspect
import random
import re

import numpy as np
import pytest

import rewax
from rewax.envs import factories, registry

NO_NUMBERS = ["abc", "", "0.001", True, False, [], {}, [1.0, 2.0], (0.1, 0.1), object(), 1 + 2j, np.zeros((2, 2)),
              np.array("x"), np.array([0.1]), float("nan"), float("inf"), -1.0, -3]  # fmt: skip
BAD = {
    "dt": [*NO_NUMBERS, 0.0, 1e30, 1.37e-5],
    "num_substeps": [*NO_NUMBERS, 0, 2.5, 10.0],
    "youngs_modulus": [*NO_NUMBERS, 0.0, None, 1e30],
    "yield_stress": [*NO_NUMBERS, 0.0, None],
    "softness": [*NO_NUMBERS, 0.0, None],
    "thickness": [*NO_NUMBERS, 0.0, None, 3.5],
    "onset": [*NO_NUMBERS, None],
    "stale_mass_matrix": [v for v in NO_NUMBERS if not isinstance(v, bool)] + [None, 0, 1],
    "contact": [*NO_NUMBERS, {"stiffness": 500.0}],
}
MISSPELT = {"yungs_modulus": "youngs_modulus", "DT": "dt", "num_substep": "num_substeps", "onst": "onset"}


def options_of(name):
    factory = registry._FACTORIES[name]
    found = factories.imported(name, factory if isinstance(factory, str) else factory["small"])
    return [option for option in inspect.signature(found).parameters if option != "scale"]


def cases():
    """For each task and option five bad values, drawn from all with a fixed seed."""
    rng = random.Random(0)
    drawn = [
        (name, option, value)
        for name in rewax.list_envs()
        for option in options_of(name)
        for value in rng.sample(BAD[option], 5)
    ]
    return [pytest.param(*case, id=f"{case[0]}-{case[1]}-{i}") for i, case in enumerate(drawn)]


@pytest.mark.parametrize(("name", "option", "value"), cases())
def test_a_bad_value_is_refused_in_one_sentence(name, option, value):
    with pytest.raises(ValueError) as caught:
        rewax.make(name, scale="small", **{option: value})
    sentence = str(caught.value)
    # A modulus that is too large is refused for its substep, a wall that is too thick for its particles.
    assert option in sentence or re.search(r"\bdt\b", sentence)
    assert ":" in sentence and "\n" not in sentence and len(sentence) < 400


@pytest.mark.parametrize("name", rewax.list_envs())
def test_a_misspelt_option_is_named_with_the_right_one(name):
    for wrong, right in MISSPELT.items():
        with pytest.raises(ValueError, match=f"{name} has no option {wrong!r}") as caught:
            rewax.make(name, scale="small", **{wrong: 1.0})
        assert right not in options_of(name) or f"did you mean {right!r}?" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "scale", "sentence"),
    [
        (["Ant"], "small", "there is no environment named ['Ant']: did you mean 'Ant'?"),
        ({}, "small", "there is no environment named {}: "),
        ("rollingflat", "small", "there is no environment named 'rollingflat': did you mean 'RollingFlat'?"),
        ("Ant", "Small", "scale is 'Small': did you mean 'small'? use one of 'paper', 'small'"),
        ("RollingFlat", ["small"], "scale is ['small']: did you mean 'small'? use one of"),
        ("RollingFlat", True, "scale is True: use one of"),
        ("RollingFlat", np.array("small"), "scale is array('small', dtype='<U5'): did you mean 'small'? use one of"),
    ],
)  # fmt: skip
def test_a_bad_name_or_scale_is_refused_with_what_is_near(name, scale, sentence):
    with pytest.raises(ValueError) as caught:
        rewax.make(name, scale=scale)
    assert str(caught.value).startswith(sentence)


def test_a_factory_must_return_an_environment(monkeypatch):
    monkeypatch.setattr(registry, "_FACTORIES", {"Number": lambda scale: 3.0})
    with pytest.raises(
        ValueError, match=r"^the factory of 'Number' returned .*, which has no method reset: return an environment"
    ):
        rewax.make("Number", scale="small")
