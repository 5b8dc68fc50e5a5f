"""What can be registered as an environment or a sensor, and what only its first use can tell."""

import pytest
import toys

import rewax
from rewax.envs import named_sensors, registry
from rewax.envs.factories import imported
from rewax.envs.named_sensors import register_sensor
from rewax.envs.registry import register

FUNCTION = "'package.module:function'"


@pytest.fixture(autouse=True)
def own(monkeypatch):
    """Nothing stays registered."""
    for module in (registry, named_sensors):
        monkeypatch.setattr(module, "_FACTORIES", dict(module._FACTORIES))


@pytest.mark.parametrize(("add", "kind"), [(register, "an environment"), (register_sensor, "a sensor")])
@pytest.mark.parametrize(
    ("name", "factory", "sentence"),
    [
        ("A", None, f"the factory of 'A' is None: give a function or {FUNCTION} that returns KIND"),
        ("A", toys.point_mass(), f"the factory of 'A' is a PointMass: give a function or {FUNCTION} that returns KIND"),
        ("A", "toys", f"the factory of 'A' is 'toys': give a function or {FUNCTION}"),
        ("A", "a:", f"the factory of 'A' is 'a:': give a function or {FUNCTION}"),
        ("A", ":f", f"the factory of 'A' is ':f': give a function or {FUNCTION}"),
        ("A", ".x:f", f"the factory of 'A' is '.x:f': give a function or {FUNCTION}"),
        ("A", "a:f:g", f"the factory of 'A' is 'a:f:g': give a function or {FUNCTION}"),
        (3, toys.point_mass, "the name of KIND is 3: give a string"),
        ([1], toys.point_mass, "the name of KIND is a list: give a string"),
        ("", toys.point_mass, "the name of KIND is '': give a string"),
    ],
)
def test_what_cannot_be_a_factory_is_refused_at_once(add, kind, name, factory, sentence):
    with pytest.raises(ValueError) as caught:
        add(name, factory)
    assert str(caught.value) == sentence.replace("KIND", kind)


@pytest.mark.parametrize(
    ("named", "sentence"),
    [
        ("math:pi", "the factory of 'A' is 'math:pi', which is 3.14159"),
        ("nopkg.m:f", "the factory of 'A' is 'nopkg.m:f', which cannot be imported (No module named 'nopkg'): correct"),
        ("toys:absent", "the factory of 'A' is 'toys:absent', but toys has no absent: correct its registration"),
    ],
)
def test_what_only_its_import_tells_is_a_sentence_of_the_first_use(named, sentence):
    register("A", named)
    register_sensor("A", named)
    for use in (lambda: rewax.make("A"), lambda: rewax.make("RollingFlat", scale="small", sensors=("A",))):
        with pytest.raises(ValueError) as caught:
            use()
        assert str(caught.value).startswith(sentence)


def test_a_function_is_found_by_its_name():
    assert imported("A", "toys:point_mass") is imported("A", toys.point_mass) is toys.point_mass
